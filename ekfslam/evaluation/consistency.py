"""NEES of poses and landmarks, averages over runs, and their bounds.

Errors and covariances are in the coordinates of `ekfslam.filters.result.ERROR_CONVENTION`. The NEES is correlated over
some sixty frames of a run, so only runs count as independent samples.
"""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri, gammaincinv

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.data.interpolation import interpolated_poses, stretches
from ekfslam.data.observations import TrueMotion
from ekfslam.data.sequence import Truth
from ekfslam.data.truth_noise import TruthNoise, doubts_of
from ekfslam.filters.result import Result
from ekfslam.geometry import se3
from ekfslam.geometry.motion import world_axes_covariance
from ekfslam.models.noise import GAP_STD

_ROUNDING = 1e-18  # of variances: 1e-9 of standard deviations


def pose_error(T_world_imu_est: Array, T_world_imu_true: Array) -> Array:
    """Return the pose error ``xi = log(T_imu_world_true T_imu_world_est^-1)`` (..., 6), m and rad, of every variant."""
    return se3.log(se3.inverse(T_world_imu_true) @ T_world_imu_est)


def world_axes_errors(T_world_imu_est: Array, T_world_imu_true: Array) -> Array:
    """Return estimate minus truth along world axes (n, 6): position, m, and ``log(R_est R_true^T)``, rad."""
    R_error = T_world_imu_est[:, :3, :3] @ np.swapaxes(T_world_imu_true[:, :3, :3], 1, 2)
    return np.hstack([T_world_imu_est[:, :3, 3] - T_world_imu_true[:, :3, 3], se3.so3_log(R_error)])


def world_axes_std(T_world_imu: Array, covariance: Array) -> Array:
    """Return the standard deviations (T, 6) of `world_axes_errors`, m and rad."""
    variance = [np.diagonal(c, axis1=1, axis2=2) for c in world_axes_covariance(T_world_imu, covariance)]
    return np.sqrt(np.maximum(np.hstack(variance), 0.0))


def nees(error: Array, covariance: Array) -> Array:
    """Return the NEES ``e^T P^-1 e`` (...) of (..., n) and (..., n, n); NaN if P is singular to rounding."""
    size = error.shape[-1]
    std = np.sqrt(np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), 0.0))
    scale = np.where(std > 0, std, 1.0)
    correlation = covariance / (scale[..., :, None] * scale[..., None, :])
    # Above this bound on the smallest eigenvalue, rounding cannot make a Cholesky factorisation fail.
    definite = np.linalg.eigvalsh(correlation)[..., 0] > size**2 * np.finfo(float).eps
    L = np.linalg.cholesky(np.where(definite[..., None, None], correlation, np.eye(size)))
    whitened = np.linalg.solve(L, (error / scale)[..., None])[..., 0]
    return np.where(definite, np.sum(whitened**2, axis=-1), np.nan)


def measured_truth(truth: Truth, interpolated: BoolArray, time_s: Array) -> Truth:
    """Return the truth of the frames (T,) that no interpolated interval leads to; only these can be judged.

    Intervals are ``interpolated`` (T,) by the velocities, or by the truth itself. If the first ones are, the first
    position is uncertain by the speed over that gap, and all other positions are relative to it.
    """
    interpolated = interpolated | interpolated_frames(truth, len(time_s))
    kept, noise, motion = ~interpolated[truth.frame], truth.noise, truth.motion
    if noise is not None and interpolated[1:2].any():
        invented_s = float(time_s[stretches(interpolated)[0][1]] - time_s[0])
        first_m = float(np.hypot(noise.first_position_m, GAP_STD[0] * invented_s))
        noise = dataclasses.replace(noise, first_position_m=first_m)
    motion = None if motion is None else TrueMotion(*(value[kept] for value in vars(motion).values()))
    frame, T_world_imu = truth.frame[kept], truth.T_world_imu[kept]
    return dataclasses.replace(truth, frame=frame, T_world_imu=T_world_imu, noise=noise, motion=motion)


def interpolated_frames(truth: Truth, frames: int) -> BoolArray:
    """Return the intervals (T,) in which the true poses are interpolated; an exact truth, without noise, has none."""
    found = np.zeros(frames, dtype=bool)
    if truth.noise is not None:
        found[truth.frame] = interpolated_poses(truth.T_world_imu)
    return found


def first_pose_error_covariance(noise: TruthNoise, T_world_imu_est: Array) -> Array:
    """Return the covariance (n, 6, 6) of errors that the first true pose, the world and the body add to later errors.

    An estimate starts at the first true pose, so with ``T_hat`` the estimated ``T_imu_world`` and
    ``A = Ad(T_hat_k T_hat_0^-1)``, an error ``e0 ~ N(0, P_0)`` of the first pose gives ``xi_k += A e0``. So does a
    world tilted by w about the first position, if the estimate knows the vertical: ``e0 = (0, R_hat_0 w)``. A body
    turned by a constant e gives ``xi_k += (A - I) e``.
    """
    first = np.array([noise.first_roll_rad, noise.first_pitch_rad, noise.first_yaw_rad])
    variance = np.concatenate([np.full(3, noise.first_position_m), first]) ** 2
    motion = se3.inverse(T_world_imu_est) @ T_world_imu_est[0]
    A = se3.adjoint(motion)
    tilt = np.zeros((6, 6))
    level = T_world_imu_est[0, :2, :3]  # level axes of the world along those of the first IMU
    tilt[3:, 3:] = noise.world_tilt_rad**2 * level.T @ level
    first_covariance = A @ (np.diag(variance) + tilt) @ np.swapaxes(A, -1, -2)
    return first_covariance + turned_body_covariance(noise, A) + scale_covariance(noise, motion)


def turned_body_covariance(noise: TruthNoise, A: Array) -> Array:
    """Return the covariance ``(A - I) E (A - I)^T`` (n, 6, 6) of motions with adjoints A, for a body that is turned."""
    turned = (A - np.eye(6))[..., 3:]
    return noise.turn_rad**2 * turned @ np.swapaxes(turned, -1, -2)


def scale_covariance(noise: TruthNoise, motion: Array) -> Array:
    """Return the covariance (n, 6, 6) of motions (n, 4, 4) whose translations t err by a share: ``xi = s (t, 0)``."""
    covariance = np.zeros((len(motion), 6, 6))
    t = noise.scale * motion[:, :3, 3]
    covariance[:, :3, :3] = t[:, :, None] * t[:, None, :]
    return covariance


def drift_covariance(noise: TruthNoise, lapse_s: Array) -> Array:
    """Return the covariance (n, 6, 6) of positions that have walked for some time (n,): equal along all axes."""
    return noise.drift_m_sqrt_s**2 * lapse_s[:, None, None] * np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])


def pose_noise_covariance(noise: TruthNoise, T_world_imu_true: Array, time_s: Array) -> Array:
    """Return the covariance ``stamp^2 u u^T + diag(position^2, attitude^2)`` (n, 6, 6) of single true poses.

    A stamp that is off by dt gives the pose ``exp(-dt u^) T_imu_world``. The velocities u of the IMU are taken from
    the true poses on both sides.
    """
    white = np.diag(np.repeat([noise.position_m, noise.attitude_rad], 3) ** 2)
    if len(time_s) < 2:
        return np.broadcast_to(white, (len(time_s), 6, 6))
    before, after = np.maximum(np.arange(len(time_s)) - 1, 0), np.minimum(np.arange(len(time_s)) + 1, len(time_s) - 1)
    step = se3.log(se3.inverse(T_world_imu_true[before]) @ T_world_imu_true[after])
    jitter = noise.stamp_s * step / (time_s[after] - time_s[before])[:, None]
    return white + jitter[:, :, None] * jitter[:, None, :]


def pose_errors(result: Result, truth: Truth, with_truth_noise: bool) -> tuple[Array, Array]:
    """Return the errors ``xi`` (n, 6) at the frames of the truth, and their covariance (n, 6, 6).

    With truth noise it is the covariance of estimate and truth, whose errors are independent. The estimate starts at
    the first true pose. A truth that states no noise is exact.
    """
    frame = truth.frame
    error = pose_error(result.T_world_imu[frame], truth.T_world_imu)
    covariance = result.covariance[frame]
    if with_truth_noise and truth.noise is not None:
        T_est = np.concatenate([result.T_world_imu[:1], result.T_world_imu[frame]])
        covariance = covariance + first_pose_error_covariance(truth.noise, T_est)[1:]
        covariance = covariance + pose_noise_covariance(truth.noise, truth.T_world_imu, result.time_s[frame])
        covariance = covariance + drift_covariance(truth.noise, result.time_s[frame] - result.time_s[0])
    return error, covariance


def pose_nees(result: Result, truth: Truth, with_truth_noise: bool = False) -> tuple[IntArray, Array]:
    """Return the frames with true pose (n,) and the pose NEES there (n,), of 6 degrees of freedom; NaN: singular."""
    values = nees(*pose_errors(result, truth, with_truth_noise=False))
    if with_truth_noise and truth.noise is not None:
        values = np.where(np.isnan(values), np.nan, nees(*pose_errors(result, truth, with_truth_noise)))
    return truth.frame, values


def pose_nees_apart(result: Result, truth: Truth) -> tuple[IntArray, Array] | None:
    """Return `pose_nees` with truth noise, but without what velocities and vision together say against the truth.

    Frames of doubtful stretches are left out. An offset e in the IMU frame of frame b adds ``(A e) (A e)^T`` with
    ``A = Ad(T_hat_k T_hat_b^-1)`` to all later ones, and the drift found is that of `drift_covariance`. None if there
    is nothing to say.
    """
    doubts, drift = doubts_of(result.attributes)
    if not doubts and not drift:
        return None
    error, covariance = pose_errors(result, truth, with_truth_noise=True)
    frame, kept = truth.frame, np.ones(len(truth.frame), dtype=bool)
    lapse_s = result.time_s[frame] - result.time_s[0]
    covariance = covariance + drift_covariance(TruthNoise(drift_m_sqrt_s=drift), lapse_s)
    T = result.T_world_imu
    for doubt in doubts:
        kept &= (frame <= doubt.begin) | (frame > doubt.end)
        moved = doubt.size * se3.adjoint(se3.inverse(T[frame]) @ T[doubt.begin])[..., doubt.axis]
        moved[frame <= doubt.begin] = 0.0
        covariance = covariance + moved[..., :, None] * moved[..., None, :]
    values = np.where(np.isnan(pose_nees(result, truth)[1]), np.nan, nees(error, covariance))
    return frame[kept], values[kept]


def pose_nees_by_axis(result: Result, truth: Truth) -> Array:
    """Return squared errors over variances (n, 6): position along axes of world, rotation along the IMU's."""
    error, covariance = pose_errors(result, truth, with_truth_noise=True)
    R = np.tile(np.eye(6), (len(error), 1, 1))
    R[:, :3, :3] = truth.T_world_imu[:, :3, :3]
    error = (R @ error[..., None])[..., 0]
    variance, own = (np.einsum("nij,njk,nik->ni", R, of, R) for of in (covariance, result.covariance[truth.frame]))
    is_uncertain = above_rounding(own)
    return np.where(is_uncertain, error**2 / np.where(is_uncertain, variance, 1.0), np.nan)


def above_rounding(variance: Array) -> BoolArray:
    """Return which variances (n, axes) are no mere rounding of a known value, beside the largest of their axis."""
    return np.asarray(variance > _ROUNDING * variance.max(axis=0, initial=0.0))


def average_over_runs(per_run: Array) -> dict[str, Any]:
    """Return mean, half width, median and number of runs of one value per run (runs,); NaN stands for no value.

    ``half_width`` is three standard errors of the mean, None for fewer than two runs. One run that diverges spoils the
    mean, but not the median.
    """
    values = per_run[np.isfinite(per_run)]
    runs = len(values)
    return {
        "mean": float(values.mean()) if runs else None,
        "half_width": float(3.0 * values.std(ddof=1) / np.sqrt(runs)) if runs > 1 else None,
        "median": float(np.median(values)) if runs else None,
        "runs": runs,
    }


def nanmean(values: Array, axis: int) -> Array:
    """Return the mean over an axis; NaN entries do not count, and the mean of none is NaN."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.asarray(np.nanmean(values, axis=axis))


def chi2_bounds(dof: ArrayLike, probability: float, runs: ArrayLike = 1) -> tuple[Array, Array]:
    """Return the two-sided bounds that hold the mean of ``runs`` chi-square values with ``probability``."""
    tails = (1.0 - probability) / 2.0
    runs = np.asarray(runs)
    total = np.asarray(dof) * runs
    total = np.where(total > 0, total, np.nan)
    # As `scipy.stats.chi2` does, whose import takes longer than a short run.
    return 2.0 * gammaincinv(total / 2.0, tails) / runs, chdtri(total, tails) / runs
