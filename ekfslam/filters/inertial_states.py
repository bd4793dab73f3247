"""Velocity and biases of an inertial unit, as a filter or the smoother estimates them, with the errors of eq. (12)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ekfslam.arrays import Array
from ekfslam.geometry import se3
from ekfslam.stored import COVARIANCES, stored

# Columns of `InertialStates.covariance`, by part.
PARTS: Mapping[str, slice] = {
    "pose": slice(0, 6),
    "velocity": slice(6, 9),
    "gyro_bias": slice(9, 12),
    "accel_bias": slice(12, 15),
}
UNITS = {"velocity": "m/s", "gyro_bias": "rad/s", "accel_bias": "m/s^2"}
FIELDS = {"velocity": "velocity_m_s", "gyro_bias": "gyro_bias_rad_s", "accel_bias": "accel_bias_m_s2"}
_SQUARES = "squares of m, rad, m/s, rad/s, m/s^2 (rho, theta, velocity, gyroscope bias, accelerometer bias)"


@dataclass(frozen=True)
class InertialStates:
    """Velocity and biases of an inertial unit after each of T frames.

    Args:
        velocity_m_s: (T, 3) velocity of the IMU along its own axes.
        gyro_bias_rad_s, accel_bias_m_s2: (T, 3) biases of gyroscope and accelerometer: measured less true.
        covariance: (T, 15, 15) of the errors of pose (``xi``), velocity, gyroscope bias and accelerometer bias.
    """

    velocity_m_s: Array = field(metadata=stored("T xyz", "m/s", "imu", name="velocity"))
    gyro_bias_rad_s: Array = field(metadata=stored("T xyz", "rad/s", "imu", name="gyro_bias"))
    accel_bias_m_s2: Array = field(metadata=stored("T xyz", "m/s^2", "imu", name="accel_bias"))
    covariance: Array = field(metadata=stored("T inertial inertial", _SQUARES, "imu", COVARIANCES))

    @staticmethod
    def of_frames(values: Sequence[Sequence[Array]], covariance: Sequence[Array]) -> InertialStates | None:
        """Return the states of frames from velocity and biases (3 x (3,)) and covariance (15, 15); None of none."""
        if not values:
            return None
        velocity, gyro_bias, accel_bias = np.array(values).swapaxes(0, 1)
        return InertialStates(velocity, gyro_bias, accel_bias, np.array(covariance))

    def value(self, part: str) -> Array:
        """Return the estimates (T, 3) of ``velocity``, ``gyro_bias`` or ``accel_bias``, along the axes of the IMU."""
        return np.asarray(getattr(self, FIELDS[part]))

    def std(self, part: str) -> Array:
        """Return the standard deviations (T, 3) of `value`."""
        variance = np.diagonal(self.covariance, axis1=1, axis2=2)[:, PARTS[part]]
        return np.sqrt(np.maximum(variance, 0.0))

    @property
    def lines(self) -> tuple[str, ...]:
        """One line each for velocity and biases along the axes of the IMU: last estimates, standard deviations."""
        named = (
            f"{part.replace('_', ' ')}: {in_words(self.value(part), self.std(part), UNITS[part])}" for part in UNITS
        )
        return tuple(named)


def in_words(values: Array, std: Array, unit: str) -> str:
    """Return the last of vectors (T, 3) with its standard deviations in words."""
    axes = zip("xyz", values[-1], std[-1], strict=True)
    return ", ".join(f"{axis} {value:.3g} +- {one:.2g}" for axis, value, one in axes) + f" {unit} (1 sigma)"


def velocity_world(T_world_imu: Array, states: InertialStates) -> tuple[Array, Array]:
    """Return ``v = R u`` (T, 3) along world axes, m/s, and the covariance of its error ``R (u^ theta + du)``."""
    R, u = T_world_imu[:, :3, :3], states.velocity_m_s
    J = np.concatenate([se3.skew(u), np.broadcast_to(np.eye(3), R.shape)], axis=2)
    P = states.covariance[:, 3:9, 3:9]
    return (R @ u[..., None])[..., 0], R @ J @ P @ J.swapaxes(1, 2) @ R.swapaxes(1, 2)
