"""Motion of a stereo rig between two frames, from the rows of common points.

Rows are ``(uL, v, uR)``, see `ekfslam.geometry.camera`. With ``h(z) = pi(T_now_before pi^-1(z))``, white noise w of
standard deviation s at both ends, and an error c of the disparity that a track keeps, the true rows are estimated, too
(orthogonal distance regression: Boggs, Byrd and Schnabel, SIAM J. Sci. Stat. Comput. 1987):

    r = z_now - h(z_true) - B (z_before - z_true) = w_now - B w_before + k c,    B = dh/dz at z_true
    k = (I - B) e,    e = (0, 0, 1): the row uR
    S = s^2 (I + B B^T) + s_c^2 k k^T
    z_true = z_before + (s^2 B^T - s_c^2 e k^T) S^-1 r
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from ekfslam.arrays import Array, BoolArray
from ekfslam.geometry import se3
from ekfslam.geometry.camera import StereoCamera, project, triangulate

try:
    _engine: Any = import_module("ekfslam.engine._engine")
except ImportError:  # not built: the same in NumPy
    _engine = None

_ITERATIONS = 12
_CONVERGED = 1e-4  # m and rad of a step, after which the next would be far smaller
_LEAST_DEPTH_M = 0.1
TRACK_STD_PX = 0.3  # s_c
_OF_ROWS = [0, 1, 0]  # coordinate of a point across the image, for rows (uL, v, uR)
_FITS = 9.0  # mean square of a point's rows, in variances


@dataclass(frozen=True)
class Alignment:
    """Motion between two frames, with residuals."""

    T_now_before: Array  # (4, 4) coordinates of the camera before to those of the camera now
    true_px: Array  # (n, 3) estimates of the true rows before
    residual_px: Array  # (n, 3) r; infinite for points behind the camera
    H: Array  # (n, 3, 6) derivative of the prediction by xi, T_now_before = exp(xi^) T_hat
    B: Array  # (n, 3, 3) derivative of the prediction by the rows before
    W: Array  # (n, 3, 3) robust weights, 1/px^2

    @property
    def information(self) -> Array:
        """(6, 6) information about xi."""
        return (self.W @ self.H).reshape(-1, 6).T @ self.H.reshape(-1, 6)

    def gradient(self, by: Array) -> Array:
        """``sum by^T W r`` of derivatives ``by`` (n, 3, p): (p,)."""
        r = np.where(np.isfinite(self.residual_px), self.residual_px, 0.0)
        return (self.W @ r[..., None]).reshape(-1) @ by.reshape(-1, by.shape[-1])


def linearise(
    camera: StereoCamera,
    before_px: Array,
    now_px: Array,
    T_now_before: Array,
    true_px: Array,
    std_px: float,
    scale: float,
) -> Alignment:
    """Return residuals, derivatives and weights at a motion (4, 4).

    Args:
        before_px, now_px: (n, 3) rows with positive disparity.
        true_px: (n, 3) estimates of the true rows before.
        std_px: Standard deviation s of one row.
        scale: Scale of the Geman-McClure kernel, in standard deviations; its weight is ``(1 + e^2 / scale^2)^-2``.
    """
    q_before, R = triangulate(camera, true_px), T_now_before[..., :3, :3]
    q = se3.apply(T_now_before, q_before)
    is_ahead = q[:, 2] > _LEAST_DEPTH_M
    q = np.where(is_ahead[:, None], q, (0.0, 0.0, 1.0))
    of_q = np.empty((len(q), 3, 6))
    of_q[..., :3], of_q[..., 3:] = np.eye(3), -se3.skew(q)
    H, predicted_px = _projected(camera, q, of_q)
    # By the rows before: depth is f b over the disparity, so a disparity moves a point along its ray.
    along = np.where(is_ahead[:, None], q - T_now_before[..., :3, 3], 0.0) / (true_px[:, 0] - true_px[:, 2])[:, None]
    of_rows = np.stack(
        [
            R[..., 0] * (q_before[:, 2] / camera.fu_px)[:, None] - along,
            R[..., 1] * (q_before[:, 2] / camera.fv_px)[:, None],
            along,
        ],
        axis=-1,
    )
    B, _ = _projected(camera, q, of_rows)
    r = now_px - predicted_px - (B @ (before_px - true_px)[..., None])[..., 0]
    k, finite = np.array([0.0, 0.0, 1.0]) - B[..., 2], np.where(is_ahead[:, None], r, 0.0)
    root = np.concatenate([std_px * B, TRACK_STD_PX * k[..., None]], axis=-1)
    W = _inverse(std_px**2 * np.eye(3) + root @ np.swapaxes(root, -1, -2))
    Wr = (W @ finite[..., None])[..., 0]
    squared = (finite * Wr).sum(axis=1) / 3.0
    weight = np.where(is_ahead, (1.0 + squared / scale**2) ** -2, 0.0)
    moved = before_px + std_px**2 * (np.swapaxes(B, -1, -2) @ Wr[..., None])[..., 0]
    moved[:, 2] -= TRACK_STD_PX**2 * (k * Wr).sum(axis=1)
    # Rows of an outlier say nothing about each other.
    fits = (squared < _FITS) & (moved[:, 0] - moved[:, 2] > 0.5 * (before_px[:, 0] - before_px[:, 2]))
    true_px = np.where(fits[:, None], moved, before_px)
    return Alignment(T_now_before, true_px, np.where(is_ahead[:, None], r, np.inf), H, B, W * weight[:, None, None])


def _projected(camera: StereoCamera, q: Array, of_q: Array) -> tuple[Array, Array]:
    """Return derivatives (n, 3, p) of rows, given those of points q (n, 3), and the rows (n, 3)."""
    f = np.array([camera.fu_px, camera.fv_px, camera.fu_px])
    ray = (q[:, _OF_ROWS] - (0.0, 0.0, camera.baseline_m)) / q[:, 2:]
    A = (of_q[:, _OF_ROWS] - ray[..., None] * of_q[:, 2:]) * (f / q[:, 2:])[..., None]
    return A, f * ray + (camera.cu_px, camera.cv_px, camera.cu_px)


def _inverse(S: Array) -> Array:
    """Return the inverses of symmetric matrices (n, 3, 3), by cofactors."""
    a, b, c, d, e, f = (S[:, i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
    rows = d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * rows[0] + b * rows[1] + c * rows[2]
    return np.stack(rows)[[[0, 1, 2], [1, 3, 4], [2, 4, 5]]].transpose(2, 0, 1) / determinant[:, None, None]


def align(
    camera: StereoCamera, before_px: Array, now_px: Array, T_now_before: Array, std_px: float = 0.2, scale: float = 2.0
) -> Alignment:
    """Align two frames by robust Gauss-Newton from a first guess of the motion; arguments as in `linearise`."""
    if _engine is not None:
        intrinsics = np.array([camera.fu_px, camera.fv_px, camera.cu_px, camera.cv_px, camera.baseline_m])
        T, true_px, r, H, B, W = _engine.align(intrinsics, before_px, now_px, T_now_before, std_px, scale)
        return Alignment(T, true_px, r, H.reshape(-1, 3, 6), B.reshape(-1, 3, 3), W.reshape(-1, 3, 3))
    return align_in_numpy(camera, before_px, now_px, T_now_before, std_px, scale)


def align_in_numpy(
    camera: StereoCamera, before_px: Array, now_px: Array, T_now_before: Array, std_px: float, scale: float
) -> Alignment:
    """Align two frames as `align` does, without the compiled engine."""
    found = linearise(camera, before_px, now_px, T_now_before, before_px, std_px, scale)
    for _ in range(_ITERATIONS):
        # A weak prior keeps the step finite if too few points are left.
        xi: Array = np.linalg.solve(found.information + 1e-6 * np.eye(6), found.gradient(found.H)).astype(float)
        T = se3.exp(xi) @ found.T_now_before
        found = linearise(camera, before_px, now_px, T, found.true_px, std_px, scale)
        if np.abs(xi).max() < _CONVERGED:
            break
    return found


def sampled_motion(
    camera: StereoCamera, before_px: Array, now_px: Array, generator: np.random.Generator, samples: int, limit_px: float
) -> Array:
    """Return the motion (4, 4) of three random points with which most agree (Fischler, Bolles, CACM 1981)."""
    count = len(before_px)
    if count < 3:
        return np.eye(4)
    chosen = np.argsort(generator.random((samples, count)), axis=1)[:, :3]
    q, p = triangulate(camera, before_px), triangulate(camera, now_px)
    T = _rigid(q[chosen], p[chosen])
    moved = se3.apply(T[:, None], q)
    ahead = moved[..., 2] > _LEAST_DEPTH_M
    predicted = project(camera, np.where(ahead[..., None], moved, (0.0, 0.0, 1.0)))[..., :3]
    worst = np.abs(now_px - predicted).max(axis=-1)
    cost = np.where(ahead, np.minimum(worst, limit_px), limit_px).sum(axis=1)
    return T[int(np.argmin(cost))]


def _rigid(q: Array, p: Array) -> Array:
    """Return transforms (s, 4, 4) that bring points q (s, n, 3) onto p in the least squares sense."""
    q_mean, p_mean = q.mean(axis=1), p.mean(axis=1)
    U, _, Vt = np.linalg.svd(np.swapaxes(p - p_mean[:, None], 1, 2) @ (q - q_mean[:, None]))
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    R = U @ Vt
    return se3.transform(R, p_mean - (R @ q_mean[..., None])[..., 0])


def agrees(alignment: Alignment, limit_px: float) -> BoolArray:
    """Return whether points (n,) move with the rig: no residual is above a limit."""
    return np.abs(alignment.residual_px).max(axis=-1, initial=0.0) <= limit_px
