"""Does the covariance tell the truth about the error? NEES of poses and landmarks, chi-square bounds.

All errors are in the stored coordinates of `ekfslam.result.ERROR_CONVENTION`, the ones the covariances are of.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

from ekfslam import se3
from ekfslam.metrics.trajectory import match_landmarks
from ekfslam.result import Landmarks, Result
from ekfslam.se3 import Array
from ekfslam.sequence import IntArray, Truth


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


def chi2_bounds(dof: ArrayLike, probability: float, runs: int = 1) -> tuple[Array, Array]:
    """Two-sided bounds within which the mean of ``runs`` independent chi-square values lies with ``probability``.

    ``dof`` are the degrees of freedom of one value (any shape); lower and upper bound have its shape.
    """
    tails = (1.0 - probability) / 2.0
    total = np.asarray(dof) * runs
    return chi2.ppf(tails, total) / runs, chi2.isf(tails, total) / runs
