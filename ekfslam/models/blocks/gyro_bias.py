"""The bias of a gyroscope."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ekfslam.arrays import Array
from ekfslam.models.blocks.base import StateBlock


@dataclass(frozen=True)
class GyroBias(StateBlock):
    """Bias (3,) of a gyroscope, rad/s: measured = true + bias + white noise. The inertial process lets it walk.

    Args:
        std_rad_s: Standard deviation of the first bias, each axis.
        first_rad_s: (3,) first estimate.
    """

    std_rad_s: float = 0.01
    first_rad_s: Array = field(default_factory=lambda: np.zeros(3))

    name = "gyro_bias"
    size = 3
    per_frame = True
    labels = ("bias of w_x", "bias of w_y", "bias of w_z")
    units = ("rad/s",) * 3

    def initial(self) -> Array:
        return self.first_rad_s

    def prior_covariance(self) -> Array:
        return self.std_rad_s**2 * np.eye(3)
