"""The report's rectified stereo rig."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.data.noise import Noise
from ekfslam.geometry import camera as cam
from ekfslam.geometry.camera import StereoCamera
from ekfslam.models.sensors.base import ACCEPTED, DISPARITY

_DISPARITY_ROWS = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, -1.0]])


@dataclass(frozen=True)
class Rig:
    """A `Sensor`: measurements are pixels (n, 4), rows those of the rectified pair whose errors are independent.

    If pixel noise is white these are (uL, v, uR); if tracks err they are (u, v, disparity) with u = uL.
    """

    # camera, T_cam_imu, noise: Intrinsics, extrinsics (4, 4), and noise of pixels, tracks and velocities.
    camera: StereoCamera
    T_cam_imu: Array
    noise: Noise
    disparity_offset_px: float = 0.0  # offset of all disparities from those of the camera's matrix

    dimension = 3

    def with_white_pixels(self) -> Rig:
        """Return the rig whose pixels have white noise alone."""
        return replace(self, noise=replace(self.noise, track_first_px=None, track_walk_px=None))

    @cached_property
    def variance_px2(self) -> Array:
        """White variances (3,) of the rows."""
        variance = cam.rectified_rows(np.zeros(4), self.noise.pixel_std_px)[1]
        return np.array([*variance[:2], variance[0] + variance[2]]) if self._sees_disparity else variance

    @cached_property
    def _sees_disparity(self) -> bool:
        return self.noise.track_error is not None

    def screen(self, measured: Array, min_depth_m: float) -> IntArray:
        reason = np.full(len(measured), ACCEPTED)
        # Limits tied to noise are the business of `ekfslam.data.hygiene`; here is only what has no depth at all.
        reason[measured[:, 0] <= measured[:, 2]] = DISPARITY
        return reason

    def in_view(self, q: Array, min_depth_m: float) -> BoolArray:
        return q[..., 2] > min_depth_m

    def rows(self, measured: Array) -> Array:
        rows = cam.rectified_rows(measured, self.noise.pixel_std_px)[0]
        return rows @ _DISPARITY_ROWS.T if self._sees_disparity else rows

    def variance(self, rows: Array) -> Array:
        return np.broadcast_to(self.variance_px2, rows.shape)

    def predict(self, q: Array) -> Array:
        rows = cam.project(self.camera, q)[..., :3]
        if self.disparity_offset_px:
            rows = rows - np.array([0.0, 0.0, self.disparity_offset_px])
        return rows @ _DISPARITY_ROWS.T if self._sees_disparity else rows

    def jacobian(self, q: Array) -> Array:
        A = cam.rectified_jacobian(self.camera, q)
        return _DISPARITY_ROWS @ A if self._sees_disparity else A

    def by_disparity(self, q: Array) -> Array:
        """Return the derivative (n, 3) of the rows by an error of the disparity in px."""
        return np.broadcast_to([0.0, 0.0, 1.0 if self._sees_disparity else -1.0], q.shape)

    def by_log_baseline(self, q: Array) -> Array:
        """Return the derivative (n, 3) of the rows by the logarithm of the baseline."""
        return self.by_disparity(q) * (self.camera.fu_px * self.camera.baseline_m / q[:, 2:])

    def invert(self, rows: Array) -> Array:
        if self._sees_disparity:  # _DISPARITY_ROWS is its own inverse
            rows = rows @ _DISPARITY_ROWS.T
        return cam.triangulate(self.camera, rows + np.array([0.0, 0.0, self.disparity_offset_px]))

    def has_depth(self, q: Array) -> BoolArray:
        """Return whether (n,) points (n, 3) of `invert` are in front of the rig and near enough to have a depth."""
        return (q[:, 2] > 0) & (q[:, 2] < self.camera.furthest_m)
