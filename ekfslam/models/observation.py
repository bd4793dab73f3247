"""Equations (4) and (5): landmarks as a sensor sees them, and new ones from what it sees."""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array
from ekfslam.geometry import se3
from ekfslam.models.sensors.base import Sensor


def linearise(
    sensor: Sensor, T_imu_world: Array, positions_m: Array, T_linear: Array, linear_positions_m: Array
) -> tuple[Array, Array, Array]:
    """Linearise observations of landmarks (n, 3) in world, eq. (4).

    A is taken at the estimates, the rest of H at the estimates or (FEJ) at the first ones. Return the points in the
    camera frame (n, 3) m; ``H_x`` (n, d, 6), derivative by the pose error ``xi`` of ``T_imu_world = exp(xi^) T_hat``;
    ``H_m`` (n, d, 3), derivative by the landmark position.
    """
    q = se3.apply(sensor.T_cam_imu @ T_imu_world, positions_m)
    A = sensor.jacobian(q) @ sensor.T_cam_imu[:3, :3]
    s = se3.apply(T_linear, linear_positions_m)
    return q, np.concatenate([A, -A @ se3.skew(s)], axis=-1), A @ T_linear[..., :3, :3]


def initialise(
    sensor: Sensor, T_imu_world: Array, rows: Array, variance: Array, T_linear: Array
) -> tuple[Array, Array, Array]:
    """Initialise landmarks from one observation each, rows (n, 3) with variances, eq. (5).

    Return positions (n, 3) in world; ``G`` (n, 3, 6), their derivative by the pose error, at ``T_linear`` (FEJ); the
    part (n, 3, 3) of their covariance that the measurement causes, ``C^T (A^T V^-1 A)^-1 C``, the exact limit of a
    diffuse prior.
    """
    q = sensor.invert(rows)
    T_world_cam = se3.inverse(sensor.T_cam_imu @ T_imu_world)
    positions = se3.apply(T_world_cam, q)
    A_inverse = T_world_cam[..., :3, :3] @ np.linalg.inv(sensor.jacobian(q))
    covariance = (A_inverse * variance[:, None, :]) @ np.swapaxes(A_inverse, -1, -2)
    return positions, landmark_by_pose(T_linear, positions), 0.5 * (covariance + np.swapaxes(covariance, -1, -2))


def landmark_by_pose(T_imu_world: Array, positions_m: Array) -> Array:
    """Return ``G = -C^T [I, -s^]`` (n, 3, 6) of eq. (5) for landmarks (n, 3) seen from (4, 4) or (n, 4, 4) poses."""
    s = se3.apply(T_imu_world, positions_m)
    minus_C_transposed = np.broadcast_to(-T_imu_world[..., :3, :3].swapaxes(-1, -2), (len(s), 3, 3))
    return np.concatenate([minus_C_transposed, -minus_C_transposed @ se3.skew(s)], axis=-1)
