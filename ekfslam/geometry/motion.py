"""The report's SE(3) prediction from body velocities, and its covariance.

A twist ``u = [v; w]`` (m/s, rad/s, IMU frame) sampled at ``t[k]`` drives the interval ``(t[k-1], t[k]]``. Its white
noise has covariance W per sample. The state is the report's inverse pose ``T_imu_world`` with error
``T_imu_world = exp(xi^) T_hat``.
"""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array
from ekfslam.geometry import se3


def increment(twist: Array, tau_s: Array | float) -> Array:
    """``E = exp(-tau u^)`` of eq. (1), the prediction ``T_imu_world+ = E T_imu_world``: (..., 6) to (..., 4, 4)."""
    return se3.exp(-np.asarray(tau_s)[..., None] * twist)


def integrate(T_imu_world: Array, twist: Array, tau_s: Array) -> Array:
    """Poses (T, 4, 4) by eq. (1) from the first one (4, 4), velocities (T, 6) and intervals (T-1,) between frames."""
    E = increment(twist[1:], tau_s)
    T = np.empty((len(twist), 4, 4))
    T[0] = T_imu_world
    for k in range(1, len(T)):
        T[k] = E[k - 1] @ T[k - 1]
    return T


def error_jacobian(E: Array) -> Array:
    """Return ``F = Ad_E`` of eq. (2), the transition of the pose error: (..., 4, 4) to (..., 6, 6)."""
    return se3.adjoint(E)


def twist_jacobian(twist: Array, tau_s: Array | float) -> Array:
    """``G = tau J_l(-tau u)``: (..., 6) to (..., 6, 6). A velocity error adds ``-G`` times itself to the pose error."""
    tau = np.asarray(tau_s)[..., None]
    return tau[..., None] * se3.left_jacobian(-tau * twist)


def process_noise(twist: Array, tau_s: Array | float, twist_std: Array) -> Array:
    """Return ``Q = G W G^T`` (..., 6, 6), eq. (2), with W of ``twist_std`` (..., 6), m/s and rad/s per sample."""
    return process_noise_by(twist_jacobian(np.asarray(twist, dtype=float), tau_s), twist_std)


def process_noise_by(G: Array, twist_std: Array) -> Array:
    """Return `process_noise` for a known G."""
    return (G * np.asarray(twist_std)[..., None, :] ** 2) @ np.swapaxes(G, -1, -2)


def level_frame(up: Array) -> tuple[Array, Array]:
    """Return the level frame of an IMU: z up, x the horizontal part of its own x axis.

    Automotive units (OXTS) give velocities in it: forward, leftward and upward over level ground.

    Args:
        up: (..., 3) unit vectors against gravity, in the IMU frame; not along its x axis.

    Returns:
        ``R_imu_level`` (..., 3, 3), and Z (..., 3, 3): up turns by ``exp(phi^)``, the frame by ``exp((Z phi)^)``.
    """
    sine = up[..., :1]
    cosine = np.sqrt(1.0 - sine**2)
    x = -sine * up
    x[..., 0] += 1.0
    x /= cosine
    R_imu_level = np.stack([x, np.cross(up, x), up], axis=-1)
    # The part of phi along up turns nothing; instead the frame turns about up as far as keeps its y axis off forward.
    about_up = (sine / cosine * x - up)[..., None, :]
    return R_imu_level, np.eye(3) + up[..., :, None] * about_up


def imu_twist(level_twist: Array, up: Array) -> tuple[Array, Array, Array]:
    """Turn velocities (..., 6) of the level frame into the IMU frame, eq. (8); ``up`` (..., 3) is in the IMU frame.

    Returns:
        The velocities, their derivative (..., 6, 6) by ``level_twist``, and (..., 6, 3) by phi of ``exp(phi^) up``.
    """
    R, Z = level_frame(up)
    by_level = np.zeros((*R.shape[:-2], 6, 6))
    by_level[..., :3, :3] = by_level[..., 3:, 3:] = R
    twist = (by_level @ level_twist[..., None])[..., 0]
    return twist, by_level, -turned_by(twist) @ Z


def turned_by(twist: Array) -> Array:
    """``[v^; w^]``, velocities (..., 6) to (..., 6, 3): minus their derivative by small angles that turn them."""
    return np.concatenate([se3.skew(twist[..., :3]), se3.skew(twist[..., 3:])], axis=-2)


def world_axes_covariance(T_world_imu: Array, covariance: Array) -> tuple[Array, Array]:
    """Return covariances (T, 3, 3) of ``-R rho`` (m^2) and ``-R theta`` (rad^2), the errors along world axes."""
    R = T_world_imu[:, :3, :3]
    R_transposed = np.swapaxes(R, 1, 2)
    return R @ covariance[:, :3, :3] @ R_transposed, R @ covariance[:, 3:, 3:] @ R_transposed
