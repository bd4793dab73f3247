"""Slow drift of vision: an error of the flow that all tracks share and that looks like a motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ekfslam.arrays import Array, BoolArray
from ekfslam.models.blocks.base import optional_block
from ekfslam.models.blocks.gauss_markov import GaussMarkov


@optional_block
@dataclass(frozen=True)
class VisionDrift(GaussMarkov):
    """Rates b of a motion that the flow of a frame shows in addition, [m/m; rad/m] along the axes of the IMU.

    From one frame to the next the errors of all tracks grow alike, by what a motion ``b way`` of the camera would do:
    ``z(k) - z(k-1) = h(exp(way b(k)^) T_k m) - h(T_k-1 m) + w``, eq. (10). Trackers that creep along edges and errors
    of the calibration look like it. It is a Gauss-Markov process of the way driven.

    Defaults are those of KLT tracks on eight drives, filtered with the true motion in place of the velocities: after
    the camera's rotation is estimated, translations of 5 (forward), 2 and 1.5 % are left, and rotations of 0.015 to
    0.04 deg/m, whose autocorrelation is below a third after 20 m.
    """

    # Stationary standard deviation of the translation, each axis, in percent of the way.
    translation_percent: float = 4.0
    rotation_deg_m: float = 0.02  # stationary standard deviation of the rotation, each axis, in degrees a metre of way
    length_m: float = 20.0  # way after which a share 1/e is left

    name = "vision_drift"
    is_seen = True
    laws: ClassVar = {"camera_share": "way"}
    least_way_m = 0.1  # a tracker drifts a little where the rig stands, too

    @property
    def stationary_std(self) -> Array:
        return np.repeat([self.translation_percent / 100.0, np.deg2rad(self.rotation_deg_m)], 3)

    @property
    def scales(self) -> tuple[Array | float, Array | float]:
        return np.inf, self.length_m

    @classmethod
    def automatic(cls, white_std: Array | None, is_clean: bool, has_checked_tracks: bool) -> dict[str, float] | None:
        """Return the defaults, for whatever velocities; checked tracks do not drift."""
        return None if has_checked_tracks else {}

    def camera_share(self, way_m: Array, is_difference: BoolArray) -> Array | None:
        return np.where(is_difference, np.maximum(way_m, self.least_way_m), 0.0)
