"""The velocities as a random walk that velocity sensors measure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ekfslam.arrays import Array
from ekfslam.models.blocks.base import StateBlock


@dataclass(frozen=True)
class Twist(StateBlock):
    """True velocities (6,) of an interval, m/s and rad/s, in the frame of the measured ones: a walk from the first."""

    walk_std: Array  # (6,) standard deviation of their change from one interval to the next
    is_measured: bool = True  # whether the recording's velocities measure them; else these only start them

    name = "twist"
    size = 6
    per_frame = True
    laws: ClassVar = {"transition": "walk"}

    def transition(self, tau_s: Array | float, way_m: Array | float) -> tuple[Array, Array] | None:
        std = np.broadcast_to(self.walk_std, (*np.shape(tau_s), 6))
        return np.ones_like(std), std

    def as_data(self) -> dict[str, Any] | None:
        data = super().as_data()
        return data and {**data, "std": np.broadcast_to(self.walk_std, 6).astype(float)}
