"""The direction up, by which velocities of a level frame are turned into the IMU frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.noise import Noise
from ekfslam.geometry import motion, se3
from ekfslam.models.blocks.base import Layout, StateBlock, Values


@dataclass(frozen=True)
class Up(StateBlock):
    """Unit vector (3,) against gravity in world, ``up = exp(psi^) up_hat``: one for the drive.

    With the pose ``T_imu_world = exp([rho; theta]^) T_hat`` of rotation R, up in the IMU frame is ``R up`` and turns by
    ``exp(phi^)``, ``phi = theta + R psi``: nothing when the world turns as a whole.
    """

    direction: Array  # (3,) first estimate
    # (3,) standard deviations of its angles about the axes of the first pose; the third one turns nothing.
    tilt_rad: Array
    R_world_imu: Array  # (3, 3) rotation of the first pose

    name = "up"
    size = 3
    is_curved = True
    retraction = "direction"
    laws: ClassVar = {"turn_velocities": "up"}
    labels = ("roll", "pitch")
    units = ("rad", "rad")

    @classmethod
    def of_first_pose(cls, R_world_imu: Array, noise: Noise) -> Up:
        """Return the block for a first rotation (3, 3), level by ``noise.tilt_rad`` or tilted as in ``first_tilt``."""
        if noise.first_tilt is None:
            return cls(R_world_imu[:, 2], np.full(3, noise.tilt_rad), R_world_imu)
        (roll, pitch), (roll_std, pitch_std) = noise.first_tilt
        up = [-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)]
        return cls(R_world_imu @ np.array(up), np.array([roll_std, pitch_std, noise.tilt_rad]), R_world_imu)

    def initial(self) -> Array:
        return self.direction

    def prior_covariance(self) -> Array:
        root = self.R_world_imu * self.tilt_rad
        return root @ root.T

    def retract(self, value: Array, correction: Array) -> Array:
        return (se3.so3_exp(correction) @ value[..., None])[..., 0]

    def in_imu(self, values: Values) -> Array:
        """Return up (..., 3) in the IMU frame."""
        return (values["pose"][..., :3, :3] @ values[self.name][..., None])[..., 0]

    def turn_velocities(
        self, twist: Array, by: Array, values: Values, R_linear: Array, layout: Layout
    ) -> tuple[Array, Array]:
        twist, by_level, by_phi = motion.imu_twist(twist, self.in_imu(values))
        by = by_level @ by
        by[..., layout[self.name]] += by_phi @ R_linear
        by[..., layout["pose"].start + 3 : layout["pose"].stop] += by_phi
        return twist, by

    def reported(self, values: Values, covariance: Array, layout: Layout) -> tuple[Array, Array]:
        """Return roll and pitch of the IMU and their standard deviations, rad."""
        up = self.in_imu(values)
        begin, psi, R = layout["pose"].start + 3, layout[self.name], values["pose"][:2, :3]
        theta = slice(begin, begin + 2)
        variance = ((2.0 * covariance[theta, psi] + R @ covariance[psi, psi]) * R).sum(axis=1)
        variance += covariance[theta, theta].diagonal()
        return np.array([np.arctan2(up[1], up[2]), -np.arcsin(up[0])]), np.sqrt(variance)

    @property
    def reported_prior_std(self) -> Array:
        return self.tilt_rad[:2]
