"""Does the covariance tell the truth about the error? NEES of poses and landmarks, averages over runs, their bounds.

All errors are in the stored coordinates of `ekfslam.filters.result.ERROR_CONVENTION`, the ones the covariances are of.

NEES is correlated over some sixty frames, so that the frames of one run are nowhere near independent samples. Runs are:
`average_over_runs` bounds an average by their scatter alone, and `chi2_bounds` is for one instant of several runs.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

from ekfslam.arrays import Array, IntArray
from ekfslam.data.sequence import Truth
from ekfslam.evaluation.trajectory import match_landmarks
from ekfslam.filters.result import Landmarks, Result
from ekfslam.geometry import se3


def pose_error(T_world_imu_est: Array, T_world_imu_true: Array) -> Array:
    """Stored pose error ``xi = log(T_imu_world_true T_imu_world_est^-1)``: (..., 4, 4) twice to (..., 6), m and rad.

    The same ``xi`` is the right coordinate for every variant: the right-invariant error of ``T_world_imu`` is
    ``log(T_world_imu_true T_world_imu_est^-1) = -Ad(T_world_imu_est) xi`` exactly, and NEES does not see a linear map.
    """
    return se3.log(se3.inverse(T_world_imu_true) @ T_world_imu_est)


def nees(error: Array, covariance: Array) -> Array:
    """Normalised estimation error squared ``e^T P^-1 e``: (..., n) and (..., n, n) to (...).

    NaN where P is not positive definite to rounding, as at a first frame whose pose is known exactly. Units do not
    matter: definiteness is judged on the correlation matrix.
    """
    size = error.shape[-1]
    std = np.sqrt(np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), 0.0))
    scale = np.where(std > 0, std, 1.0)
    correlation = covariance / (scale[..., :, None] * scale[..., None, :])
    # Bound on the smallest eigenvalue from which rounding cannot make a Cholesky factorisation fail.
    definite = np.linalg.eigvalsh(correlation)[..., 0] > size**2 * np.finfo(float).eps
    L = np.linalg.cholesky(np.where(definite[..., None, None], correlation, np.eye(size)))
    whitened = np.linalg.solve(L, (error / scale)[..., None])[..., 0]
    return np.where(definite, np.sum(whitened**2, axis=-1), np.nan)


def pose_nees(result: Result, truth: Truth) -> tuple[IntArray, Array]:
    """Frames with true pose (n,) and the pose NEES there (n,), 6 degrees of freedom; NaN where P is singular."""
    error = pose_error(result.T_world_imu[truth.frame], truth.T_world_imu)
    return truth.frame, nees(error, result.covariance[truth.frame])


def landmark_nees(landmarks: Landmarks, truth: Truth) -> tuple[IntArray, Array]:
    """Rows of the landmarks with known true position (n,) and the NEES of ``d = m - m_hat`` there (n,), 3 dof.

    This is exact for filters whose landmark error is additive. The invariant variant's stored covariance is of ``d``
    only to first order in the rotation error of the pose at the same time; where that error is not small take
    `invariant_landmark_error` and `nees` instead.
    """
    rows, truth_rows = match_landmarks(landmarks, truth)
    error = truth.position_m[truth_rows] - landmarks.position_m[rows]
    return rows, nees(error, landmarks.covariance[rows])


def joint_nees(xi: Array, landmark_error: Array, P: Array) -> float:
    """NEES of pose and landmarks at once, 6 + 3n degrees of freedom; NaN where P is singular.

    ``xi`` (6,) and ``landmark_error`` (n, 3) in stored coordinates, P (6+3n, 6+3n) in the same order.
    """
    return float(nees(np.concatenate([xi, landmark_error.ravel()]), P))


def invariant_landmark_error(m_hat: Array, m_true: Array, T_world_imu_est: Array, T_world_imu_true: Array) -> Array:
    """Landmark error in stored coordinates as the invariant variant defines it: (..., 3) m, shapes broadcast.

    The right-invariant error couples a landmark to the rotation error ``e_theta`` of the pose of the same time,

        R_true = exp(e_theta) R_est,    m_true = exp(e_theta) m_hat + J_l(e_theta) e_i,

    and eq. (7) stores it as ``d_i = e_i - m_hat^ e_theta``, which is ``m_true - m_hat`` to first order.

    Args:
        m_hat: (..., 3) estimated positions in world.
        m_true: (..., 3) true positions in world.
        T_world_imu_est: (..., 4, 4) estimated poses at the time at which the landmark covariances hold.
        T_world_imu_true: (..., 4, 4) true poses at that time.
    """
    R_error = T_world_imu_true[..., :3, :3] @ np.swapaxes(T_world_imu_est[..., :3, :3], -1, -2)
    e_theta = se3.so3_log(R_error)
    offset = m_true - (R_error @ m_hat[..., None])[..., 0]
    e_i = (se3.so3_left_jacobian_inverse(e_theta) @ offset[..., None])[..., 0]
    return e_i - np.cross(m_hat, e_theta)


def world_axes_covariance(T_world_imu: Array, covariance: Array) -> tuple[Array, Array]:
    """Covariances (T, 3, 3) of position (m^2) and rotation error (rad^2), both along world axes.

    As ``T_world_imu = T_hat exp(-xi)``, an error ``xi = [rho; theta]`` moves the IMU by ``-R rho`` to first order and
    turns it by ``-R theta`` in world, with R the rotation of ``T_world_imu`` (T, 4, 4). ``covariance`` (T, 6, 6) is of
    ``xi``.
    """
    R = T_world_imu[:, :3, :3]
    R_transposed = np.swapaxes(R, 1, 2)
    return R @ covariance[:, :3, :3] @ R_transposed, R @ covariance[:, 3:, 3:] @ R_transposed


@dataclass(frozen=True)
class RunAverage:
    """Average of independent runs, each of which counts once.

    Args:
        mean: Over runs; None if no run has a value.
        half_width: Three standard errors, ``3 sd / sqrt(runs)``; None for fewer than two runs.
        median: Over runs; one run that diverges spoils the mean, but not this.
        runs: How many have a value.
    """

    mean: float | None
    half_width: float | None
    median: float | None
    runs: int


def average_over_runs(per_run: Array) -> RunAverage:
    """The average of one value per run (runs,); NaN stands for a run without a value."""
    values = per_run[np.isfinite(per_run)]
    if len(values) == 0:
        return RunAverage(None, None, None, 0)
    half_width = float(3.0 * values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else None
    return RunAverage(float(values.mean()), half_width, float(np.median(values)), len(values))


def time_average(values: Array) -> Array:
    """Mean over time of each run, (runs, T) to (runs,); NaN entries do not count, NaN if there are no others."""
    return _nanmean(values, axis=1)


def anees(values: Array, dof: int, probability: float) -> tuple[Array, Array, Array]:
    """Average over runs at every time, and the two-sided bounds it keeps with ``probability`` if P is true.

    Args:
        values: (runs, T) NEES; NaN entries (singular P, a filter that has stopped) do not count.
        dof: Degrees of freedom of one value.
        probability: Of the bounds, at one time.

    Returns:
        Mean, lower and upper bound, (T,) each; NaN where no run has a value.
    """
    runs = np.isfinite(values).sum(axis=0)
    low, high = chi2_bounds(np.full(len(runs), dof), probability, np.maximum(runs, 1))
    return _nanmean(values, axis=0), np.where(runs > 0, low, np.nan), np.where(runs > 0, high, np.nan)


def _nanmean(values: Array, axis: int) -> Array:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # NaN is the answer where there is nothing to average
        return np.asarray(np.nanmean(values, axis=axis))


def chi2_bounds(dof: ArrayLike, probability: float, runs: ArrayLike = 1) -> tuple[Array, Array]:
    """Two-sided bounds within which the mean of ``runs`` independent chi-square values lies with ``probability``.

    ``dof`` are the degrees of freedom of one value (any shape); lower and upper bound have its shape.
    """
    tails = (1.0 - probability) / 2.0
    runs = np.asarray(runs)
    total = np.asarray(dof) * runs
    return chi2.ppf(tails, total) / runs, chi2.isf(tails, total) / runs
