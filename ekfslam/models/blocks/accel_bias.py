"""The bias of a accelerometer."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ekfslam.arrays import Array
from ekfslam.models.blocks.base import StateBlock


@dataclass(frozen=True)
class AccelBias(StateBlock):
    """Bias (3,) of a accelerometer, m/s^2: measured = true + bias + white noise. The inertial process lets it walk.

    Args:
        std_m_s2: Standard deviation of the first bias, each axis.
        first_m_s2: (3,) first estimate.
    """

    std_m_s2: float = 0.1
    first_m_s2: Array = field(default_factory=lambda: np.zeros(3))

    name = "accel_bias"
    size = 3
    per_frame = True
    labels = ("bias of f_x", "bias of f_y", "bias of f_z")
    units = ("m/s^2",) * 3

    def initial(self) -> Array:
        return self.first_m_s2

    def prior_covariance(self) -> Array:
        return self.std_m_s2**2 * np.eye(3)
