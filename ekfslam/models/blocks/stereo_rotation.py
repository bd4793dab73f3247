"""Rotation of the right camera against the calibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array
from ekfslam.models.blocks.base import optional_block
from ekfslam.models.blocks.gauss_markov import GaussMarkov


@optional_block
@dataclass(frozen=True)
class StereoRotation(GaussMarkov):
    """Rotation vector psi of the right camera, ``q_right = exp(psi^) (q - (b, 0, 0))``, slowly changing.

    Yaw (y) changes disparities by ``f (1 + x^2) psi_y``, so that all depths err alike; roll and pitch mostly show in
    the difference of the rows. A tenth of a degree is what mounts of stereo rigs keep between calibrations: Geiger et
    al., "Vision meets robotics", IJRR 2013, calibrate anew on every day of recording.

    Args:
        rotation_deg: Stationary standard deviation, each axis.
        time_s: Time constant of its change.
    """

    rotation_deg: float = 0.1
    time_s: float = 200.0

    name = "stereo_rotation"
    is_seen = True
    labels = ("right camera pitch", "right camera yaw", "right camera roll")
    units = ("rad",) * 3

    @property
    def stationary_std(self) -> Array:
        return np.full(3, np.deg2rad(self.rotation_deg))

    def lengths(self, tau_s: Array | float, way_m: Array | float) -> Array:
        return np.asarray(tau_s)[..., None] / self.time_s
