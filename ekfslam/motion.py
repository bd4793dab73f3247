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


def process_noise(twist: Array, tau_s: Array | float, twist_std: Array) -> Array:
    """``Q = tau^2 J_l(-tau u) W J_l(-tau u)^T`` of eq. (2): (..., 6) to (..., 6, 6).

    ``twist_std`` (6,) holds the standard deviations per sample, m/s and rad/s; ``W`` is the diagonal of their squares.
    """
    tau = np.asarray(tau_s)[..., None]
    G = tau[..., None] * se3.left_jacobian(-tau * twist)
    return (G * np.asarray(twist_std) ** 2) @ np.swapaxes(G, -1, -2)
