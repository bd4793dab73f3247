"""The linear velocity of an IMU, in its own frame."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.sequence import Sequence
from ekfslam.models.blocks.base import StateBlock


@dataclass(frozen=True)
class Velocity(StateBlock):
    """``u = C v`` (3,), m/s in the IMU frame, moved by the inertial process.

    Its additive error is the right-invariant error of the world velocity, turned into the body (Barrau and Bonnabel,
    "The invariant extended Kalman filter as a stable observer", 2017).

    Args:
        std_m_s: Standard deviation of the first velocity, each axis.
        first_m_s: (3,) first velocity.
    """

    std_m_s: float = 0.15
    first_m_s: Array = field(default_factory=lambda: np.zeros(3))

    name = "velocity"
    size = 3
    per_frame = True
    labels = ("v_x", "v_y", "v_z")
    units = ("m/s",) * 3

    def begun_by(self, sequence: Sequence) -> Velocity:
        return replace(self, first_m_s=sequence.initial_velocity_m_s)

    def initial(self) -> Array:
        return self.first_m_s

    def prior_covariance(self) -> Array:
        return self.std_m_s**2 * np.eye(3)
