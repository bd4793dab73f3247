"""The pose."""

from __future__ import annotations

from dataclasses import dataclass

from ekfslam.arrays import Array
from ekfslam.geometry import se3
from ekfslam.models.blocks.base import StateBlock


@dataclass(frozen=True)
class Pose(StateBlock):
    """``T_imu_world = exp(xi^) T_hat``, moved by the process."""

    T_imu_world: Array  # (4, 4) first pose
    covariance: Array  # (6, 6) covariance of its error

    name = "pose"
    size = 6
    per_frame = True
    is_seen = True
    is_pose = True
    retraction = "pose"

    def initial(self) -> Array:
        return self.T_imu_world

    def prior_covariance(self) -> Array:
        return self.covariance

    def retract(self, value: Array, correction: Array) -> Array:
        return se3.exp(correction) @ value
