"""Noise of tracks from the data: their white errors, and the walk of errors that persist, found without truth.

With rows ``z_k``, the motion ``T_k`` between two frames, ``B_k = dh/dz``, white errors n (covariance Sigma) and steps w
of a walk (covariance W), the residual of a track over one frame is

    r_k = z_k - h(z_(k-1); T_k) = n_k - B_k n_(k-1) + w_k,   hence
    Sigma = -E r_k (B_(k+1)^-1 r_(k+1))^T,    W = E r_k r_k^T - Sigma - B_k Sigma B_k^T.

Each motion is fitted to the same tracks and takes a part of each row, its leverage p, with it. Hence residuals are
divided by ``sqrt(1 - p)``. The errors are those of a jackknife over parts of the recording. Every second stretch is
enough if errors clearly persist there.

Tracks of *one camera* have no depths. Their flow ``r_k = p_k + n_k - n_(k-1) + w_k``, less that of a motion before a
plane, has a part p_k of the depths, which changes smoothly. Second differences of it, D, have variances c_0 and, from
one frame to the next, covariances c_1, each for one row,

    c_0 = 20 sigma^2 + 6 w^2,  c_1 = -15 sigma^2 - 4 w^2,
    sigma^2 = -(2 c_0 + 3 c_1) / 5,  w^2 = (c_0 - 20 sigma^2) / 6.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.data.sequence import Sequence
from ekfslam.geometry.camera import MOTION_FROM_PX, rectified_rows
from ekfslam.geometry.stereo_motion import Alignment, align, sampled_motion
from ekfslam.models.noise import with_error

_STRETCH, _MOST_STRETCHES = 8, 12  # intervals, count
_LEAST_POINTS, _LEAST_PAIRS = 6, 100  # of an interval, of the recording
_LONG_STRETCH, _LEAST_FLOWS = 30, 10  # intervals, tracks: of one camera
_BLOCKS, _SURE = 12, 3.0  # of the jackknife; standard errors
# A first motion needs some limit in pixels; from there on all limits are multiples of the scatter that is found.
_SAMPLES, _START_PX, _LEAST_PX = 200, 2.0, 1e-3
_FITS, _SAME = 3, 1.5  # until the scatter changes by less than this factor
_KERNEL, _OUTLIER, _AGREE_SHARE = 3.0, 5.0, 0.7  # standard deviations, standard deviations, of the tracks
_LEAST_SHARE = 0.05  # of a row, which its leverage leaves
_MAD_TO_STD = 1.4826
_COORDINATES = np.array([1.0, 2.0, 1.0]) / 3.0  # weights of the variances of rows, in the variance of a coordinate


@dataclass(frozen=True)
class TrackNoise:
    """White errors of tracks and steps of their walk, rows ``(uL, v, uR)``, or ``(u, v)`` of one camera."""

    white: Array  # (d,) variances of white errors, px^2; negative if steps persist
    white_error: Array  # (d,) their standard errors
    step: Array  # (d,) variances of the walk from one frame to the next, px^2
    step_error: Array  # (d,) their standard errors
    length: int  # frames of the track of a typical observation

    @property
    def is_white(self) -> bool:
        """Whether white errors are seen in each row, and no walk that exceeds them half a track later."""
        walk = self.step - _SURE * self.step_error
        return bool(((self.white > _SURE * self.white_error) & (0.5 * self.length * walk < self.white)).all())

    @property
    def persists(self) -> bool:
        """Whether steps of errors clearly persist, so that errors are not white, however many more are seen."""
        return bool((self.white < -_SURE * self.white_error).any())

    @property
    def sigma_px(self) -> float:
        """Standard deviation of a pixel coordinate; the row v of a rig is the mean of two."""
        return max(float(self.white @ self._coordinates), 0.0) ** 0.5

    @property
    def sigma_error_px(self) -> float:
        """Standard error of `sigma_px`, if its rows err alike."""
        return float(self.white_error @ self._coordinates) / (2.0 * max(self.sigma_px, _LEAST_PX))

    @property
    def _coordinates(self) -> Array:
        return _COORDINATES if len(self.white) == len(_COORDINATES) else np.full(2, 0.5)

    @property
    def text(self) -> str:
        """The kind of the errors and their size in words, in u of the left image."""
        if not self.is_white:
            # A white part that is negative stands for steps that persist: it is part of a step, not beside it.
            step = float(self.step[0]) + 2.0 * min(float(self.white[0]), 0.0)
            return f"errors walk or persist, about {max(step, 0.0) ** 0.5:.2g} px a frame"
        return f"errors are white, {with_error(self.sigma_px, self.sigma_error_px)} px"


class _Residuals(NamedTuple):
    """Residuals r (n, 3) of tracks (n,) over an interval, less the leverage; B (n, 3, 3)."""

    ids: IntArray
    r: Array
    B: Array


class _Moments(NamedTuple):
    """Terms of the means of two successive intervals: of Sigma (n, 3, 3), of squared residuals (n, 3), and B."""

    white: Array
    square: Array
    B: Array


@dataclass
class _Fit:
    """Motion of the last interval and standard deviation of a row, from which the next fit starts."""

    T_now_before: Array | None = None
    std_px: float = _START_PX


def track_noise(sequence: Sequence) -> TrackNoise | None:
    """Return the noise of tracks from stretches of a recording; None: too few tracks."""
    if sequence.camera.is_monocular:
        return _of_one_camera(sequence)
    intervals = len(sequence) - 1
    count = min(max(1, intervals // _STRETCH), _MOST_STRETCHES)
    begins = (np.arange(count) * (intervals / count)).astype(int)
    moments: list[_Moments] = []
    found = None
    for part in (begins[::2], begins[1::2]):
        moments += [some for begin in part.tolist() for some in _stretch(sequence, begin, intervals)]
        found = None if sum(len(some.B) for some in moments) < _LEAST_PAIRS else _noise(moments, _length(sequence))
        if found is not None and found.persists:
            break
    return found


def _stretch(sequence: Sequence, begin: int, intervals: int) -> list[_Moments]:
    """Return the moments of the intervals of a stretch, each with the next."""
    last = _Fit()
    frames = range(begin + 1, min(begin + _STRETCH, intervals) + 1)
    residuals = [_residuals(sequence, k, last) for k in frames]
    return [_moments(before, now) for before, now in pairwise(residuals) if before is not None and now is not None]


def _noise(moments: list[_Moments], length: int) -> TrackNoise:
    """Return the noise by moments of successive intervals."""
    parts = np.array_split(np.arange(len(moments)), min(_BLOCKS, len(moments)))
    left_out = np.array([_variances([m for i, m in enumerate(moments) if i not in part]) for part in parts])
    white_error, step_error = np.sqrt((len(parts) - 1) * left_out.var(axis=0))
    white, step = _variances(moments)
    return TrackNoise(white, white_error, step, step_error, length)


def _variances(moments: list[_Moments]) -> tuple[Array, Array]:
    """Return the variances (3,) of white errors and of steps."""
    if not moments:
        return np.zeros(3), np.zeros(3)
    white, square, B = (np.concatenate(some) for some in zip(*moments, strict=True))
    Sigma = 0.5 * (white + np.swapaxes(white, 1, 2)).mean(axis=0)
    both = Sigma + (B @ Sigma @ np.swapaxes(B, 1, 2)).mean(axis=0)
    return np.diagonal(Sigma), square.mean(axis=0) - np.diagonal(both)


def _moments(before: _Residuals, now: _Residuals) -> _Moments:
    _, i, j = np.intersect1d(before.ids, now.ids, assume_unique=True, return_indices=True)
    back = np.linalg.solve(now.B[j], now.r[j][..., None])
    return _Moments(-before.r[i][..., None] * np.swapaxes(back, 1, 2), now.r[j] ** 2, now.B[j])


def _residuals(sequence: Sequence, k: int, last: _Fit) -> _Residuals | None:
    """Return the residuals from frame k - 1 to k, and update the fit; None: too few tracks agree on a motion."""
    (ids, before), (ids_now, now) = sequence.observations.at(k - 1), sequence.observations.at(k)
    ids, i, j = np.intersect1d(ids, ids_now, assume_unique=True, return_indices=True)
    rows, rows_now = (rectified_rows(pixels, np.ones(4))[0] for pixels in (before[i], now[j]))
    disparity = np.minimum(rows[:, 0] - rows[:, 2], rows_now[:, 0] - rows_now[:, 2])
    near = disparity >= MOTION_FROM_PX
    if near.sum() < _LEAST_POINTS:
        last.T_now_before = None
        return None
    found = _fitted(sequence, rows[near], rows_now[near], k, last)
    r = found.residual_px
    good = (np.abs(r) < _OUTLIER * _scatter(r)).all(axis=1) & (disparity[near] > _OUTLIER * last.std_px)
    if good.mean() < _AGREE_SHARE or good.sum() < _LEAST_POINTS:
        last.T_now_before = None
        return None
    # The diagonal of H (H^T W H)^-1 H^T W.
    try:
        covariance = np.linalg.inv(found.information)
    except np.linalg.LinAlgError:  # points that fix no motion
        last.T_now_before = None
        return None
    taken = ((found.H @ covariance) * (found.W @ found.H)).sum(axis=2)
    share = (1.0 - taken).clip(_LEAST_SHARE)
    return _Residuals(ids[near][good], (r / np.sqrt(share))[good], found.B[good])


def _fitted(sequence: Sequence, rows: Array, rows_now: Array, k: int, last: _Fit) -> Alignment:
    """Return the alignment of rows (n, 3), whose kernel is as wide as the scatter that it leaves."""
    T, camera = last.T_now_before, sequence.camera
    if T is None:
        T = sampled_motion(camera, rows, rows_now, np.random.default_rng(k), _SAMPLES, _START_PX)
    for _ in range(_FITS):
        found, fitted = align(camera, rows, rows_now, T, last.std_px, _KERNEL), last.std_px
        last.T_now_before = T = found.T_now_before
        last.std_px = float(np.sqrt(np.mean(_scatter(found.residual_px) ** 2) / 2.0))
        if 1.0 / _SAME < fitted / last.std_px < _SAME:
            break
    return found


def _scatter(r: Array) -> Array:
    """Return the standard deviations (3,) of residuals (n, 3) by their medians."""
    return np.maximum(_MAD_TO_STD * np.median(np.abs(r), axis=0), _LEAST_PX)


def _length(sequence: Sequence) -> int:
    """Return the median over observations of the number of observations of their track."""
    count = np.bincount(np.searchsorted(sequence.observations.ids, sequence.observations.landmark))
    return int(np.median(np.repeat(count, count)))


# --- one camera -------------------------------------------------------------------------------------------------------


def _of_one_camera(sequence: Sequence) -> TrackNoise | None:
    """Return the noise of tracks of one camera; None: too few tracks."""
    frames = len(sequence) - 1
    count = min(max(1, frames // _LONG_STRETCH), _MOST_STRETCHES)
    parts: list[tuple[Array, Array]] = []
    for begin in (np.arange(count) * (frames / count)).astype(int).tolist():
        flows = [_flow(sequence, k) for k in range(begin + 1, min(begin + _LONG_STRETCH, frames) + 1)]
        for _ in range(2):
            flows = [_common(a, b, np.subtract) for a, b in pairwise(flows)]
        if not any(len(ids) for ids, _ in flows):
            continue
        scatter = _scatter(np.concatenate([D for _, D in flows]))
        good = [(np.abs(D) < _OUTLIER * scatter).all(axis=1) for _, D in flows]
        flows = [(ids[some], D[some]) for (ids, D), some in zip(flows, good, strict=True)]
        pairs = [(a[1] ** 2, _common(a, b, np.multiply)[1]) for a, b in pairwise(flows)]
        parts += [(square, product) for square, product in pairs if len(product)]
    if sum(len(product) for _, product in parts) < _LEAST_PAIRS:
        return None
    blocks = np.array_split(np.arange(len(parts)), min(_BLOCKS, len(parts)))
    left_out = np.array([_of_second_differences([p for i, p in enumerate(parts) if i not in some]) for some in blocks])
    white_error, step_error = np.sqrt((len(blocks) - 1) * left_out.var(axis=0))
    white, step = _of_second_differences(parts)
    return TrackNoise(white, white_error, step, step_error, _length(sequence))


def _of_second_differences(parts: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Return the variances (2,) of white errors and of steps by squares of D and products of successive ones."""
    if not parts:
        return np.zeros(2), np.zeros(2)
    square, product = (np.concatenate(some).mean(axis=0) for some in zip(*parts, strict=True))
    white = -(2.0 * square + 3.0 * product) / 5.0
    return white, (square - 20.0 * white) / 6.0


def _common(a: tuple[IntArray, Array], b: tuple[IntArray, Array], of: np.ufunc) -> tuple[IntArray, Array]:
    """Return the ids that two parts share, and a function of the values (n, 2) of the second and the first."""
    ids, i, j = np.intersect1d(a[0], b[0], assume_unique=True, return_indices=True)
    return ids, of(b[1][j], a[1][i])


def _flow(sequence: Sequence, k: int) -> tuple[IntArray, Array]:
    """Return the ids (n,) and flows (n, 2) px from frame k - 1 to k, less that of a motion before a plane across."""
    (ids, before), (ids_now, now) = sequence.observations.at(k - 1), sequence.observations.at(k)
    ids, i, j = np.intersect1d(ids, ids_now, assume_unique=True, return_indices=True)
    if len(ids) < _LEAST_FLOWS:
        return ids[:0], np.empty((0, 2))
    camera, middle, flow = sequence.camera, 0.5 * (before[i] + now[j]), now[j] - before[i]
    focal = np.array([camera.fu_px, camera.fv_px])
    x, y = ((middle - [camera.cu_px, camera.cv_px]) / focal).T
    one, none = np.ones_like(x), np.zeros_like(x)
    by_u, by_v = [one, none, -x, x * y, -1.0 - x**2, y], [none, one, -y, 1.0 + y**2, -x * y, -x]
    A = np.stack([np.column_stack(by_u), np.column_stack(by_v)], axis=1) * focal[:, None]
    weight, p, share = np.ones(len(ids)), np.zeros(6), np.ones((len(ids), 2))
    for _ in range(_FITS):
        inverse = np.linalg.pinv(np.einsum("n,nij,nik->jk", weight, A, A))
        p = inverse @ np.einsum("n,nij,ni->j", weight, A, flow)
        r = flow - A @ p
        weight = 1.0 / (1.0 + (r**2).sum(axis=1) / (_KERNEL * _scatter(r).max()) ** 2)
    share = 1.0 - weight[:, None] * np.einsum("nij,jk,nik->ni", A, inverse, A)
    return ids, r / np.sqrt(share.clip(_LEAST_SHARE))
