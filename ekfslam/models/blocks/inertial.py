"""State of an inertial unit: its velocity, and the biases of gyroscope and accelerometer."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.sequence import Sequence
from ekfslam.models.blocks.base import StateBlock


class _Vector(StateBlock):
    """A vector (3,) that the inertial process moves; its settings are a standard deviation and a first value."""

    size = 3
    per_frame = True

    def initial(self) -> Array:
        _, first = vars(self).values()
        return first

    def prior_covariance(self) -> Array:
        std, _ = vars(self).values()
        return std**2 * np.eye(3)


@dataclass(frozen=True)
class Velocity(_Vector):
    """``u = C v`` (3,), m/s in the IMU frame.

    Its additive error is the right-invariant error of the world velocity, turned into the body (Barrau and Bonnabel,
    "The invariant extended Kalman filter as a stable observer", 2017).
    """

    std_m_s: float = 0.15  # standard deviation of the first velocity, each axis
    first_m_s: Array = field(default_factory=lambda: np.zeros(3))  # (3,) first velocity

    name = "velocity"

    def begun_by(self, sequence: Sequence) -> Velocity:
        return replace(self, first_m_s=sequence.initial_velocity_m_s)


@dataclass(frozen=True)
class GyroBias(_Vector):
    """Bias (3,) of a gyroscope, rad/s: measured = true + bias + white noise. The inertial process lets it walk."""

    std_rad_s: float = 0.05
    first_rad_s: Array = field(default_factory=lambda: np.zeros(3))

    name = "gyro_bias"


@dataclass(frozen=True)
class AccelBias(_Vector):
    """Bias (3,) of an accelerometer, m/s^2: measured = true + bias + white noise. The inertial process lets it walk."""

    std_m_s2: float = 0.1
    first_m_s2: Array = field(default_factory=lambda: np.zeros(3))

    name = "accel_bias"
