"""Jitter of the camera against the IMU."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ekfslam.arrays import Array, BoolArray
from ekfslam.models.blocks.base import optional_block
from ekfslam.models.blocks.gauss_markov import GaussMarkov


@optional_block
@dataclass(frozen=True)
class CameraJitter(GaussMarkov):
    """Error n of the camera's pose that all landmarks of a frame share: ``q = T_cam_imu exp(n^) T_imu_world m``.

    Swinging mounts, jitter of stamps, motion blur and rolling shutters look like it. It is a Gauss-Markov process of
    time, [m; rad] along the axes of the IMU.
    """

    translation_m: float = 0.02  # translation_m, rotation_deg: stationary standard deviations, each axis
    rotation_deg: float = 0.06
    time_s: float = 0.6  # its time constant

    name = "camera_jitter"
    is_seen = True
    laws: ClassVar = {"camera_share": "one"}

    @property
    def stationary_std(self) -> Array:
        return np.repeat([self.translation_m, np.deg2rad(self.rotation_deg)], 3)

    @property
    def scales(self) -> tuple[Array | float, Array | float]:
        return self.time_s, np.inf

    @classmethod
    def automatic(cls, white_std: Array | None, is_clean: bool, has_checked_tracks: bool) -> dict[str, float] | None:
        """Return the defaults; None without velocities, if tracks are checked: no unit jitters against the camera."""
        return None if has_checked_tracks and white_std is None else {}

    def camera_share(self, way_m: Array, is_difference: BoolArray) -> Array | None:
        return np.ones(np.shape(is_difference))
