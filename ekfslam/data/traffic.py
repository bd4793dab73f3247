"""Tracks of points that move over the ground, found from whole tracks and noisy velocities together.

Over one interval, the rows ``(u, v, disparity)`` of two successive observations of a track leave

    r = z_now - h(z_before; velocities) = H x + F c + k e + w

with x (6,) the errors of the interval's measured velocities, c (2,) the velocity of the point over the ground (forward
and to the right), e the constant error of the track's disparity, and w white noise. The velocities have a prior that
gains weight with the number of intervals. So it tells a road full of cars from standing points, whichever are more.

A point either stands (c is almost 0) or moves (c is as fast as traffic). A joint solution over a window judges each
track by what the velocities and all other tracks say of its c. Expectation propagation (Minka, "Expectation propagation
for approximate Bayesian inference", UAI 2001) finds the probabilities: an undecided track says nothing to the others.
It starts with all points free to move.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.data.noise import Noise, TrackError
from ekfslam.data.sequence import Observations, Sequence
from ekfslam.data.tracks import adjacent
from ekfslam.geometry import camera as cam
from ekfslam.geometry import motion, se3

_WINDOW = 20  # intervals; windows overlap by half
_ITERATIONS = 8
# Speed of traffic, and of points that stand: an error of 1 % of a car's way. Share of tracks that move, a priori.
_MOVING_M_S, _STANDING_M_S, _MOVING_SHARE = 15.0, 0.1, 0.2
# Vision itself errs by about 2 % of the way, an error that all tracks share, see the block `vision_drift`.
_VISION_SHARE = 0.02
_FREE_M_S = 1000.0  # at the start: so that a convoy does not pull
_OUTLIER = 3.0  # scale of the Geman-McClure kernel, standard deviations
_LEAST_DEPTH_M = 1.0
_LEAST_STD = np.repeat([1e-3, 1e-4], 3)  # of a velocity, m/s and rad/s: exact zeros are no measurements
# Columns of `Flow.rows`.
_VELOCITY, _POINT, _TRACK, _DISPARITY, _RESIDUAL = slice(0, 6), slice(6, 8), slice(6, 9), 8, 9


@dataclass(frozen=True)
class Flow:
    """Motion of tracks over single intervals, in units of the standard deviations of w."""

    frame: IntArray  # (n,) frame that the interval leads to
    track: IntArray  # (n,) landmark id, ascending
    rows: Array  # (n, 3, 10) derivatives H by x (6), F by c (2) and k by e, and the residual r

    def only(self, which: BoolArray) -> Flow:
        """Return the intervals that a mask (n,) selects."""
        return Flow(self.frame[which], self.track[which], self.rows[which])


class Prior(NamedTuple):
    """Information (m, 6, m, 6) and information vector (m, 6) of x over m intervals, and the std of e in px."""

    information: Array
    vector: Array
    disparity_std: float


def moving_tracks(sequence: Sequence, observations: Observations, noise: Noise) -> IntArray:
    """Return the ids (m,) of tracks that probably move; none unless velocities are noisy and errors of tracks walk."""
    error, ids = noise.track_error, observations.ids
    if error is None or noise.twist_walk_std is None or not sequence.has_velocities or not len(ids):
        return ids[:0]
    flow = flow_of(sequence, observations, error)
    probability, seen = np.zeros(len(ids)), np.zeros(len(ids), dtype=np.int64)
    for begin in range(1, max(2, len(sequence) - _WINDOW // 2), _WINDOW // 2):
        frames = np.arange(begin, min(begin + _WINDOW, len(sequence)))
        part = flow.only(np.isin(flow.frame, frames))
        if len(part.track):
            found, count = np.unique(part.track, return_counts=True)
            at = np.searchsorted(ids, found)
            moves = moving_probability(part, frames, velocity_prior(sequence, frames, noise))
            # The window that sees most of a track decides, or the highest probability of several such windows.
            former = np.where(count > seen[at], 0.0, probability[at])
            probability[at] = np.where(count < seen[at], former, np.maximum(moves, former))
            seen[at] = np.maximum(count, seen[at])
    return ids[probability > 0.5]


def flow_of(sequence: Sequence, observations: Observations, error: TrackError) -> Flow:
    """Return the motion of all tracks over single intervals, linearised at the measured velocities."""
    camera, C, px = sequence.camera, sequence.T_cam_imu, observations.pixels_px
    z = np.stack([px[:, 0], px[:, [1, 3]].mean(axis=1), px[:, 0] - px[:, 2]], axis=1)
    before, now = adjacent(observations)
    near = np.minimum(z[before, 2], z[now, 2]) > cam.MOTION_FROM_PX
    before, now = before[near], now[near]
    frame = observations.frame[now]
    twist, tau_s = sequence.twist[frame], np.diff(sequence.time_s, prepend=sequence.time_s[0])[frame]
    T = C @ motion.increment(twist, tau_s) @ se3.inverse(C)
    q_before = cam.triangulate(camera, _disparity_rows(z[before]))
    q = se3.apply(T, q_before)
    ahead = q[:, 2] > _LEAST_DEPTH_M
    q[~ahead] = (0.0, 0.0, _LEAST_DEPTH_M)
    A, A_before = (_disparity_rows(cam.rectified_jacobian(camera, some).swapaxes(1, 2)) for some in (q, q_before))
    A, A_before = A.swapaxes(1, 2), A_before.swapaxes(1, 2)
    rows = np.zeros((len(now), 3, 10))
    by_pose = np.concatenate([A, -A @ se3.skew(q)], axis=2)
    rows[..., _VELOCITY] = -by_pose @ se3.adjoint(C) @ motion.twist_jacobian(twist, tau_s)
    rows[..., _POINT] = A[..., [2, 0]] * tau_s[:, None, None]
    rows[..., _DISPARITY] = np.array([0.0, 0.0, 1.0]) - (A @ T[:, :3, :3] @ np.linalg.inv(A_before))[..., 2]
    rows[..., _RESIDUAL] = z[now] - _disparity_rows(cam.project(camera, q)[:, :3])
    parallax = tau_s * np.linalg.norm(twist[:, :3], axis=1) / q[:, 2]
    rows /= np.sqrt(error.step_variance(z[now] - z[before], parallax))[..., None]
    return Flow(frame, observations.landmark[now], rows).only(ahead)


def _disparity_rows(rows: Array) -> Array:
    """Return rows (..., 3) of ``(uL, v, disparity)`` from those of ``(uL, v, uR)``, or the other way round."""
    return np.stack([rows[..., 0], rows[..., 1], rows[..., 0] - rows[..., 2]], axis=-1)


def velocity_prior(sequence: Sequence, frames: IntArray, noise: Noise) -> Prior:
    """Return the prior of x over the intervals that lead to frames (m,): white noise, walk, shared drift and pitch."""
    assert noise.twist_walk_std is not None and noise.track_error is not None
    twist = sequence.twist[frames]
    std = np.hypot(noise.velocity_std, np.where(sequence.interpolated[frames, None], noise.gap_std, 0.0))
    std = np.maximum(std, _LEAST_STD)
    walk_std = np.maximum(noise.twist_walk_std, 0.01 * std[0])
    speed = float(np.sqrt((twist[:, :3] ** 2).sum(axis=1).mean()))
    shared = np.zeros(6)
    shared[:3] = speed * np.hypot(_VISION_SHARE, [0.0, 0.0, noise.tilt_rad])
    m, step = len(frames), np.diff(np.eye(len(frames)), axis=0)
    information, vector = np.zeros((m, 6, m, 6)), np.zeros((m, 6))
    for axis in range(6):
        walk = step.T @ step / walk_std[axis] ** 2
        information[:, axis, :, axis] = np.linalg.inv(np.diag(std[:, axis] ** 2) + shared[axis] ** 2) + walk
        vector[:, axis] = -walk @ twist[:, axis]  # the walk is that of the true velocities, twist + x
    return Prior(information, vector, float(noise.track_error.first_std[2]))


def moving_probability(flow: Flow, frames: IntArray, prior: Prior) -> Array:
    """Return the probability (n,) that a track moves, in ascending order of tracks, by their flow over frames (m,)."""
    rows, interval = flow.rows, flow.frame - frames[0]
    ids, track = np.unique(flow.track, return_inverse=True)
    products, weight, moves = rows.swapaxes(1, 2) @ rows, np.ones(len(rows)), np.zeros(len(ids))
    site = np.zeros((len(ids), 3, 3)), np.zeros((len(ids), 3))  # information of c and e, and information vector
    site[0][:] = np.diag([_FREE_M_S**-2, _FREE_M_S**-2, prior.disparity_std**-2])
    for _ in range(_ITERATIONS):
        x, y, covariance, by_c = _solved(weight[:, None, None] * products, interval, track, site, prior)
        information, vector = np.linalg.inv(covariance), np.linalg.solve(covariance, y[:, :2, None])[..., 0]
        others = information - site[0][:, :2, :2], vector - site[1][:, :2]
        free, moves, found = _judged(*others)
        for part, new in zip((site[0][:, :2, :2], site[1][:, :2]), found, strict=True):
            part[:] = 0.5 * (part + new)
        # An outlier is off its track's own course, with c free: else the motion of a point would be one.
        y = np.concatenate([free, y[:, 2:] + ((free - y[:, :2]) * by_c).sum(axis=1, keepdims=True)], axis=1)
        known = np.concatenate([x[interval], y[track]], axis=1)
        left = rows[..., _RESIDUAL] - (rows[..., :_RESIDUAL] @ known[..., None])[..., 0]
        weight = (1.0 + (left**2).mean(axis=1) / _OUTLIER**2) ** -2
    return moves


def _solved(
    products: Array, interval: IntArray, track: IntArray, site: tuple[Array, Array], prior: Prior
) -> tuple[Array, Array, Array, Array]:
    """Solve for all x (m, 6), c and e (n, 3); return also the covariance (n, 2, 2) of c and de/dc (n, 2).

    ``products`` (k, 10, 10) are weighted ``rows^T rows`` of single intervals and tracks, ``site`` has the information
    (n, 3, 3) of c and e beside them, and its vector.
    """
    m, n = len(prior.vector), len(site[0])
    of_interval, of_track = _summed(products, interval, m), _summed(products, track, n)
    Y = of_track[:, _TRACK, _TRACK] + site[0]
    couplings = np.zeros((n, 3, m, 6))
    couplings[track, :, interval] = products[:, _TRACK, _VELOCITY]
    X = couplings.reshape(n, 3, 6 * m)
    Y_inverse = np.linalg.inv(Y)
    YX = Y_inverse @ X
    # The Schur complement: c and e are eliminated.
    N = prior.information.copy()
    N[np.arange(m), :, np.arange(m)] += of_interval[:, _VELOCITY, _VELOCITY]
    by_track = YX.reshape(3 * n, 6 * m)
    P = np.linalg.inv(N.reshape(6 * m, 6 * m) - X.reshape(3 * n, 6 * m).T @ by_track)
    b = (prior.vector + of_interval[:, _VELOCITY, _RESIDUAL]).ravel()
    b_track = of_track[:, _TRACK, _RESIDUAL] + site[1]
    x = P @ (b - by_track.T @ b_track.ravel())
    y = (Y_inverse @ b_track[..., None])[..., 0] - YX @ x
    by_x = YX[:, :2]
    spread = (by_x.reshape(2 * n, 6 * m) @ P).reshape(n, 2, 6 * m) @ by_x.swapaxes(1, 2)
    return x.reshape(m, 6), y, Y_inverse[:, :2, :2] + spread, -Y[:, 2, :2] / Y[:, 2, 2:]


def _summed(products: Array, group: IntArray, groups: int) -> Array:
    """Return the sums (groups, 10, 10) of products (k, 10, 10) by the group (k,) of each."""
    to = csr_array((np.ones(len(group)), (group, np.arange(len(group)))), shape=(groups, len(group)))
    return np.asarray(to @ products.reshape(len(group), 100)).reshape(groups, 10, 10)


def _judged(information: Array, vector: Array) -> tuple[Array, Array, tuple[Array, Array]]:
    """Judge points by what the others say of c: information (n, 2, 2) and information vector (n, 2).

    Return c (n, 2) by that alone; the probability (n,) that a point moves; and the information (n, 2, 2) and vector (n,
    2) that bring c to the mean and covariance of the mixture of both hypotheses.
    """
    # A share of the free start keeps it regular where the others say nothing.
    V = np.linalg.inv(information + _FREE_M_S**-2 * np.eye(2))
    c = V @ vector[..., None]
    log_odds, means, covariances = [], [], []
    for std, share in ((_STANDING_M_S, 1.0 - _MOVING_SHARE), (_MOVING_M_S, _MOVING_SHARE)):
        S = V + std**2 * np.eye(2)
        fit = (c * np.linalg.solve(S, c)).sum(axis=(1, 2))
        log_odds.append(np.log(share) - 0.5 * (np.linalg.slogdet(S)[1] + fit))
        covariances.append(np.linalg.inv(information + np.eye(2) / std**2))
        means.append(covariances[-1] @ vector[..., None])
    moves = 1.0 / (1.0 + np.exp(np.clip(log_odds[0] - log_odds[1], -50.0, 50.0)))
    stand, p = 1.0 - moves[:, None, None], moves[:, None, None]
    mean, apart = stand * means[0] + p * means[1], means[1] - means[0]
    mixed = np.linalg.inv(stand * covariances[0] + p * covariances[1] + stand * p * apart @ apart.swapaxes(1, 2))
    found = mixed - information
    # Where the two are further apart than the others tell, the mixture says nothing.
    says = np.linalg.eigvalsh(found)[:, 0] > 0.0
    site = np.where(says[:, None, None], found, _FREE_M_S**-2 * np.eye(2))
    pull = np.where(says[:, None], (mixed @ mean)[..., 0] - vector, 0.0)
    return c[..., 0], moves, (site, pull)
