"""One camera: bearings alone, so that landmarks wait for parallax."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.data.noise import Noise
from ekfslam.geometry import camera as cam
from ekfslam.geometry.camera import StereoCamera
from ekfslam.models.sensors.base import ACCEPTED

NEAREST_M = 0.1  # nearer points are those of a turn that is taken for a motion


@dataclass(frozen=True)
class Monocular:
    """One camera as a `DelayedSensor`: of pixels (n, 4) or (n, 2) it takes (uL, vL). Scale comes from other inputs."""

    camera: StereoCamera  # intrinsics; the baseline is not used
    T_cam_imu: Array  # (4, 4) extrinsics
    noise: Noise  # white noise of pixels, and noise of velocities
    parallax_rad: float = 0.03  # angle between two rays beyond which their landmark is initialised
    patience: int = 40  # frames after which the anchor moves on

    dimension = 2

    def screen(self, measured: Array, min_depth_m: float) -> IntArray:
        return np.full(len(measured), ACCEPTED)

    def in_view(self, q: Array, min_depth_m: float) -> BoolArray:
        return q[..., 2] > min_depth_m

    def rows(self, measured: Array) -> Array:
        return np.array(measured[:, :2], dtype=float)

    def variance(self, rows: Array) -> Array:
        return np.broadcast_to(np.asarray(self.noise.pixel_std_px[:2]) ** 2, rows.shape)

    def predict(self, q: Array) -> Array:
        return cam.project(self.camera, q)[..., :2]

    def jacobian(self, q: Array) -> Array:
        return cam.projection_jacobian(self.camera, q)[..., :2, :]

    def invert(self, rows: Array) -> Array:
        raise NotImplementedError("one view of one camera has no depth")

    def rays(self, rows: Array) -> Array:
        """Return unit vectors (n, 3) along which pixels (n, 2) lie, in the camera frame."""
        x = (rows[:, 0] - self.camera.cu_px) / self.camera.fu_px
        y = (rows[:, 1] - self.camera.cv_px) / self.camera.fv_px
        rays = np.stack([x, y, np.ones_like(x)], axis=-1)
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def triangulate(self, rows_anchor: Array, rows: Array, T_now_anchor: Array) -> tuple[Array, BoolArray]:
        """Return the middle of the shortest line between both rays (n, 3), and whether (n,) parallax suffices."""
        a, b = self.rays(rows_anchor) @ T_now_anchor[:3, :3].T, self.rays(rows)
        origin = T_now_anchor[:3, 3]
        cosine = (a * b).sum(axis=1)
        sine_square = np.maximum(1.0 - cosine**2, np.finfo(float).tiny)
        # Depths s along a (from the anchor) and t along b of the two nearest points.
        s = (cosine * (b @ origin) - a @ origin) / sine_square
        t = (b @ origin - cosine * (a @ origin)) / sine_square
        q = 0.5 * (origin + s[:, None] * a + t[:, None] * b)
        is_ahead = (s > NEAREST_M) & (t > NEAREST_M)
        return q, (sine_square > np.sin(self.parallax_rad) ** 2) & is_ahead
