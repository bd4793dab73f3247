"""First state of the inertial process in motion, from a window of a stereo rig or of one camera.

1. Gyroscope bias: rotations of stereo motion against integrated samples.
2. First velocity and gravity, which are linear in displacements, then with the magnitude of gravity known. They are the
   displacements of stereo motion given the rotations of the gyroscope. Source: Mur-Artal and Tardos, "Visual-inertial
   monocular SLAM with map reuse", RA-L 2017, without the scale.
3. The joint maximum a posteriori of the window, by the factors of the smoother.

For one camera `ekfslam.inertial.bearings` gives the first two, over two or three seconds.

The mean is that of the window. The filter processes the window itself, and would use it twice if it started with the
marginal. The prior alone is so broad that the first frames throw the mean away again. So the covariance has the prior
and a sixteenth of the window's information: too large in the first frames, and right after the window.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from ekfslam.arrays import Array
from ekfslam.config import FilterConfig, PosteriorConfig
from ekfslam.data.inputs import InertialSamples
from ekfslam.data.sequence import Sequence
from ekfslam.errors import EkfslamError
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import one_thread, run_filter, solvable
from ekfslam.filters.reports import ACCEPTED, FrameReport
from ekfslam.geometry import se3
from ekfslam.geometry.preintegration import BG, PHI, Increment
from ekfslam.geometry.stereo_motion import Alignment
from ekfslam.inertial.bearings import Guess, RefusedWindowError, by_bearings, integrated
from ekfslam.models.blocks import AccelBias, GyroBias, Velocity
from ekfslam.models.inertial_start import FirstPrior, InertialStart
from ekfslam.models.model import Model
from ekfslam.models.odometry import stereo_motions
from ekfslam.smoother.optimise import MOST_ITERATIONS, maximise
from ekfslam.smoother.problem import BatchProblem

# Ends of windows, s; standard deviation before the window of the velocity, and of the tilt over that which the bias of
# the accelerometer leaves after it.
_ENDS_S, _LONG_S, _SPEED_M_S, _TILT_FACTOR = (1.0, 1.5, 2.0, 3.0), 1.0, 0.5, 3.0
_SHARE = 1.0 / 16.0  # of the information of the window that the first covariance has
_LEAST_MOTIONS, _LEAST_POINTS, _OFF_M_S2, _MOST_COST = 5, 10, 0.3, 3.0
# Of one camera, where a wrong scale costs less. Good windows cost 1 by white errors of tracks, and less by walking
# ones, since these are stated as they add up.
_MOST_COST_OF_ONE = 1.5
# Share of a window's last observations that the filter must accept from a start of one camera. A wrong start costs
# little if the filter lets most tracks wait for a depth that fits. The bound lies between both groups, of two or three
# seconds: on V1_01 0 to 21 % from wrong starts, and 27 to 96 % from right ones; in the room 24 to 88 %.
_LEAST_SHARE, _LATE_S = 1.0 / 3.0, 1.0
_PASSES = 4


def in_motion(
    sequence: Sequence, model: Model, prior: FirstPrior, config: FilterConfig
) -> tuple[InertialStart | None, str]:
    """Return the state at the first frame, from the first window that serves, and why earlier ones do not."""
    since, std_px = sequence.time_s - sequence.time_s[0], float(np.mean(model.noise.pixel_std_px))
    last = int(np.searchsorted(since, _ENDS_S[-1], "right"))
    is_one = sequence.camera.is_monocular
    motions = {} if is_one else dict(stereo_motions(sequence, last, std_px))
    refused: list[str] = []
    for end_s in _ENDS_S[2:] if is_one else _ENDS_S:
        end = int(np.searchsorted(since, end_s, "right"))
        if refused and since[end - 1] < end_s - 0.5:  # the recording ends before
            break
        inside = {k: motion for k, motion in motions.items() if end_s - _LONG_S - 1e-9 <= since[k - 1] and k < end}
        name = f"{since[min(inside, default=1) - 1]:.1f} to {since[end - 1]:.1f} s"
        try:
            first = by_bearings(sequence, end, std_px, prior) if is_one else _linear(sequence, prior, inside)
            start = _smoothed(sequence, model, prior, config, first, end)
            text = f"in motion, from {'one camera' if is_one else 'stereo'} over {name}: {start.text}"
            return dataclasses.replace(start, text=text), "; ".join(refused)
        except RefusedWindowError as error:
            refused.append(f"{name}: {error}")
        except np.linalg.LinAlgError:
            refused.append(f"{name}: its motions fix no velocity and no gravity")
    return None, "; ".join(refused)


def _linear(sequence: Sequence, prior: FirstPrior, motions: dict[int, Alignment]) -> Guess:
    """Solve for the first velocity and gravity by the motions (by frame) of a window."""
    motions = {k: motion for k, motion in motions.items() if len(motion.residual_px) >= _LEAST_POINTS}
    if len(motions) < _LEAST_MOTIONS:
        raise RefusedWindowError(f"only {len(motions)} motions of at least {_LEAST_POINTS} points")
    C = sequence.T_cam_imu
    bias: Array = np.zeros(3)
    intervals = [sequence.interval(k, InertialSamples) for k in range(1, max(motions) + 1)]
    Ad = se3.adjoint(C)
    for _ in range(2):
        parts = [integrated(interval.dt_s, interval.inputs, bias) for interval in intervals]
        A, b = 1e-12 * np.eye(3), np.zeros(3)
        for k, motion in motions.items():
            theta, by_theta = _against(motion, C, parts[k - 1])[3:], Ad.T @ motion.information @ Ad
            W = by_theta[3:, 3:] - by_theta[3:, :3] @ np.linalg.solve(by_theta[:3, :3], by_theta[:3, 3:])
            J = parts[k - 1].Phi[PHI, BG]
            A, b = A + J.T @ W @ J, b + J.T @ W @ theta
        bias = bias + np.linalg.solve(A, b).astype(float)
    rows, values = _displacements(C, motions, [integrated(i.dt_s, i.inputs, bias) for i in intervals])
    free, *_ = np.linalg.lstsq(rows, values, rcond=None)
    if abs(np.linalg.norm(free[3:]) - prior.gravity_m_s2) > _OFF_M_S2:
        raise RefusedWindowError(f"gravity comes out as {np.linalg.norm(free[3:]):.2f} m/s^2")
    v: Array = free[:3].astype(float)
    g: Array = free[3:].astype(float)
    for _ in range(_PASSES):
        g = prior.gravity_m_s2 * g / np.linalg.norm(g)
        tangent = np.linalg.svd(g[None])[2][1:].T
        x, *_ = np.linalg.lstsq(np.hstack([rows[:, :3], rows[:, 3:] @ tangent]), values - rows[:, 3:] @ g, rcond=None)
        v, g = x[:3].astype(float), g + tangent @ x[3:]
    text = f"|g| {np.linalg.norm(free[3:]):.2f} m/s^2 if free, "
    return Guess(v, -g / np.linalg.norm(g), bias, text)


def _against(motion: Alignment, T_cam_imu: Array, part: Increment) -> Array:
    """Return ``log`` (6,) of the motion of the IMU by samples, without translation, after the one of stereo."""
    M = se3.inverse(T_cam_imu) @ motion.T_now_before @ T_cam_imu
    return np.concatenate([np.zeros(3), se3.log(se3.transform(part.R.T @ M[:3, :3].T, np.zeros(3)))[3:]])


def _displacements(T_cam_imu: Array, motions: dict[int, Alignment], parts: list[Increment]) -> tuple[Array, Array]:
    """Return rows (3n, 6) and values (3n,) of displacements, linear in first velocity and gravity (first IMU frame)."""
    Ad, rows, values = se3.adjoint(T_cam_imu), [], []
    R, V, t = np.eye(3), np.zeros(3), 0.0
    for k, part in enumerate(parts, 1):
        tau = float(part.tau_s)
        if k in motions:
            # exp(xi^) M with the rotation of the samples, and the likeliest translation given it.
            information = Ad.T @ motions[k].information @ Ad
            theta = _against(motions[k], T_cam_imu, part)[3:]
            rho = -np.linalg.solve(information[:3, :3], information[:3, 3:] @ theta)
            M = se3.exp(np.concatenate([rho, theta])) @ se3.inverse(T_cam_imu) @ motions[k].T_now_before @ T_cam_imu
            d = se3.inverse(M)[:3, 3]
            W = np.linalg.cholesky(M[:3, :3].T @ information[:3, :3] @ M[:3, :3]).T
            rows.append(W @ R.T @ np.hstack([tau * np.eye(3), (t * tau + 0.5 * tau**2) * np.eye(3)]))
            values.append(W @ (d - R.T @ V * tau - part.p))
        R, V, t = R @ part.R, V + R @ part.v, t + tau
    return np.concatenate(rows), np.concatenate(values)


def _smoothed(
    sequence: Sequence, model: Model, prior: FirstPrior, config: FilterConfig, first: Guess, end: int, rounds: int = 2
) -> InertialStart:
    """Return the start at the maximum a posteriori of the frames before ``end``; of one camera in two rounds at most.

    The second one begins where the first one ended, if that explained too few observations.
    """
    T = prior.levelled(first.up)
    tilt_rad = _TILT_FACTOR * prior.accel_bias_std_m_s2 / prior.gravity_m_s2
    P = prior.covariance(T[:3, :3], tilt_rad, _SPEED_M_S)
    start = InertialStart(T, first.velocity_m_s, first.gyro_bias_rad_s, np.zeros(3), P, "")
    started = start.begun(model)
    try:
        with one_thread(), solvable():
            ekf = JointEKF(started, dataclasses.replace(config, lag=0, revive=-1))
            reports = [frame.report for frame in run_filter(ekf, sequence, range(end))]
            log = ekf.log()
            problem = BatchProblem(log, started)
            state = problem.filtered_state(ekf.landmarks().position_m)
            found = maximise(problem, state, PosteriorConfig(), config.min_depth_m, range(MOST_ITERATIONS))
    except EkfslamError as error:
        raise RefusedWindowError(str(error)) from None
    values = problem.unknowns.values(found.state)
    u, gyro_bias, accel_bias = (values[name][0] for name in (Velocity.name, GyroBias.name, AccelBias.name))
    up = found.state.T_imu_world[0, :3, 2]
    share = _share_accepted(sequence, reports, end)
    if sequence.camera.is_monocular and share < _LEAST_SHARE:
        if rounds == 1:
            raise RefusedWindowError(f"only {share:.0%} of the last observations fit")
        return _smoothed(sequence, model, prior, config, Guess(u, up, gyro_bias, first.text), end, rounds - 1)
    cost = 2.0 * found.costs[-1] / max(log.rows.size - 3 * log.landmarks, 1)
    if cost > (_MOST_COST_OF_ONE if sequence.camera.is_monocular else _MOST_COST):
        raise RefusedWindowError(f"observations err by {np.sqrt(cost):.1f} standard deviations")
    T = prior.levelled(up)
    text = f"{np.linalg.norm(u):.2f} m/s, {first.text}gyroscope bias ({', '.join(f'{x:.3g}' for x in gyro_bias)}) rad/s"
    own = problem.unknowns.places(started.process.columns)
    marginal = found.information.state_covariances[0][np.ix_(own, own)]
    P = _with_share(prior.covariance(T[:3, :3], tilt_rad, _SPEED_M_S), marginal)
    return InertialStart(T, u, gyro_bias, accel_bias, P, text)


def _share_accepted(sequence: Sequence, reports: list[FrameReport], end: int) -> float:
    """Return the share of the observations late in a window that the filter accepted."""
    late = [each.reason for each in reports if sequence.time_s[end - 1] - sequence.time_s[each.frame] < _LATE_S]
    return float(np.mean(np.concatenate(late) == ACCEPTED)) if sum(map(len, late)) else 0.0


def _with_share(prior: Array, marginal: Array) -> Array:
    """Return the covariance of a prior and of a share of what a marginal knows beyond it; directions may be certain."""
    prior, marginal = prior / (1.0 - _SHARE), marginal / _SHARE
    P = prior - prior @ np.linalg.pinv(prior + marginal, hermitian=True) @ prior
    return np.asarray((P + P.T) / 2)
