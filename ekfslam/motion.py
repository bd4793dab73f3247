"""The report's SE(3) prediction from body velocities, and its covariance.

A twist ``u = [v; w]`` (m/s, rad/s, IMU frame) sampled at ``t[k]`` drives the interval ``(t[k-1], t[k]]``. Its white
noise has covariance W per sample. The state is the report's inverse pose ``T_imu_world`` with error
``T_imu_world = exp(xi^) T_hat``.
"""

from __future__ import annotations

import numpy as np

from ekfslam import se3
from ekfslam.se3 import Array


def increment(twist: Array, tau_s: Array | float) -> Array:
    """``E = exp(-tau u^)`` of eq. (1), the prediction ``T_imu_world+ = E T_imu_world``: (..., 6) to (..., 4, 4)."""
    return se3.exp(-np.asarray(tau_s)[..., None] * twist)


def error_jacobian(E: Array) -> Array:
    """``F = Ad_E`` of eq. (2): how the pose error goes through the prediction, (..., 4, 4) to (..., 6, 6)."""
    return se3.adjoint(E)


def twist_jacobian(twist: Array, tau_s: Array | float) -> Array:
    """``G = tau J_l(-tau u)``: (..., 6) to (..., 6, 6). A velocity error adds ``-G`` times itself to the pose error."""
    tau = np.asarray(tau_s)[..., None]
    return tau[..., None] * se3.left_jacobian(-tau * twist)


def process_noise(twist: Array, tau_s: Array | float, twist_std: Array, misalignment_rad: float = 0.0) -> Array:
    """``Q = G W G^T`` with G of `twist_jacobian`, eq. (2): (..., 6) to (..., 6, 6).

    ``twist_std`` (6,) holds the standard deviations per sample, m/s and rad/s; ``W`` is the diagonal of their squares,
    and where the frame of the velocities is turned by small angles of deviation ``misalignment_rad`` against the IMU,
    ``B B^T misalignment_rad^2`` besides, with ``B = [v^; w^]``.
    """
    twist = np.asarray(twist, dtype=float)
    G = twist_jacobian(twist, tau_s)
    Q = (G * np.asarray(twist_std) ** 2) @ np.swapaxes(G, -1, -2)
    if misalignment_rad:
        B = misalignment_rad * np.concatenate([se3.skew(twist[..., :3]), se3.skew(twist[..., 3:])], axis=-2)
        turned = G @ B
        Q = Q + turned @ np.swapaxes(turned, -1, -2)
    return Q
