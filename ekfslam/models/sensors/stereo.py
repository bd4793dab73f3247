"""The report's rectified stereo rig."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.data.noise import Noise
from ekfslam.geometry import camera as cam
from ekfslam.geometry import se3
from ekfslam.geometry.camera import StereoCamera
from ekfslam.models.sensors.base import ACCEPTED, DISPARITY

_NEWTON_STEPS = 6
_ROUNDING_PX = 1e-11
_LEAST_DISPARITY_PX = 1e-3
# What has less disparity (px) says nothing of a depth.
_NO_DEPTH_PX = 0.5
_DISPARITY_ROWS = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, -1.0]])


@dataclass(frozen=True)
class Rig:
    """A `Sensor`: measurements are pixels (n, 4), rows those of the rectified pair whose errors are independent.

    Where pixel noise is white these are (uL, v, uR), where tracks err they are (u, v, disparity) with u = uL.

    Args:
        camera: Intrinsics.
        T_cam_imu: (4, 4) extrinsics.
        noise: Of pixels, tracks and velocities.
        disparity_offset_px: Disparities come out larger by this than the camera's matrix says.
        right_rotation_rad: (3,) or one a point (n, 3): rotation psi of the right camera against the calibration,
            ``q_right = exp(psi^) (q - (b, 0, 0))``; None: the pair is rectified.
    """

    camera: StereoCamera
    T_cam_imu: Array
    noise: Noise
    disparity_offset_px: float = 0.0
    right_rotation_rad: Array | None = None

    dimension = 3

    def with_white_pixels(self) -> Rig:
        """The rig whose pixels have white noise alone."""
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
        rows = self._rectified(q)
        if self.disparity_offset_px:
            rows = rows - np.array([0.0, 0.0, self.disparity_offset_px])
        return rows @ _DISPARITY_ROWS.T if self._sees_disparity else rows

    def jacobian(self, q: Array) -> Array:
        A = cam.rectified_jacobian(self.camera, q)
        if self.right_rotation_rad is not None:
            right, by_point = self._seen_right(q)[1:]
            A = self._of_both(A, right @ by_point)
        return _DISPARITY_ROWS @ A if self._sees_disparity else A

    def by_right_rotation(self, q: Array) -> Array:
        """Derivative (n, 3, 3) of the rows by the rotation of the right camera, at ``right_rotation_rad``."""
        q_right, right, _ = self._seen_right(q)
        B = self._of_both(np.zeros((*q.shape, 3)), -right @ se3.skew(q_right) @ self._right_turn[1])
        return _DISPARITY_ROWS @ B if self._sees_disparity else B

    def by_disparity(self, q: Array) -> Array:
        """Derivative (n, 3) of the rows by an error of the disparity in px."""
        return np.broadcast_to([0.0, 0.0, 1.0 if self._sees_disparity else -1.0], q.shape)

    def by_log_baseline(self, q: Array) -> Array:
        """Derivative (n, 3) of the rows by the logarithm of the baseline."""
        if self.right_rotation_rad is None:
            return self.by_disparity(q) * (self.camera.fu_px * self.camera.baseline_m / q[:, 2:])
        _, right, R = self._seen_right(q)
        by_baseline = -self.camera.baseline_m * (right @ R[..., :1])
        B = self._of_both(np.zeros((*q.shape, 1)), by_baseline)
        return ((_DISPARITY_ROWS @ B) if self._sees_disparity else B)[..., 0]

    def invert(self, rows: Array) -> Array:
        if self._sees_disparity:  # _DISPARITY_ROWS is its own inverse
            rows = rows @ _DISPARITY_ROWS.T
        rows = rows + np.array([0.0, 0.0, self.disparity_offset_px])
        if self.right_rotation_rad is None:
            return cam.triangulate(self.camera, rows)
        # Newton's method in the rows: what a rectified pair would see of the point. Rotations are small, so few steps
        # reach rounding; a disparity below what the rotation makes of infinity has no point and stays at the limit.
        seen = rows
        for _ in range(_NEWTON_STEPS):
            step = rows - self._rectified(cam.triangulate(self.camera, self._in_front(seen)))
            seen = seen + step
            if np.abs(step).max(initial=0.0) < _ROUNDING_PX:
                break
        return cam.triangulate(self.camera, self._in_front(seen))

    def has_depth(self, q: Array) -> BoolArray:
        """Whether (n,) points (n, 3) of `invert` are in front of the rig, near enough to have a depth."""
        return (q[:, 2] > 0) & (q[:, 2] < self.camera.fu_px * self.camera.baseline_m / _NO_DEPTH_PX)

    @staticmethod
    def _in_front(rows: Array) -> Array:
        """Rows (uL, v, uR) whose disparity is positive."""
        return np.stack([rows[..., 0], rows[..., 1], np.minimum(rows[..., 2], rows[..., 0] - _LEAST_DISPARITY_PX)], -1)

    def _rectified(self, q: Array) -> Array:
        """Rows (uL, v, uR) of points (n, 3) by the camera's matrix and the rotation of the right camera."""
        rows = cam.project(self.camera, q)[..., :3]
        if self.right_rotation_rad is None:
            return rows
        q_right = self._in_right(q)
        return self._of_both(rows[..., None], cam.project(self._right_camera, q_right)[..., :2, None])[..., 0]

    @cached_property
    def _right_camera(self) -> StereoCamera:
        return replace(self.camera, baseline_m=0.0)

    @cached_property
    def _right_turn(self) -> tuple[Array, Array]:
        """Rotation of the right camera, (3, 3) or one a point, and its left Jacobian."""
        psi = np.zeros(3) if self.right_rotation_rad is None else self.right_rotation_rad
        return se3.so3_exp_and_left_jacobian(psi)

    def _in_right(self, q: Array) -> Array:
        """Points (n, 3) in the right camera."""
        return (self._right_turn[0] @ (q - np.array([self.camera.baseline_m, 0.0, 0.0]))[..., None])[..., 0]

    def _seen_right(self, q: Array) -> tuple[Array, Array, Array]:
        """Points (n, 3) in the right camera, the derivative (n, 2, 3) of its pixels by them, and theirs by ``q``."""
        q_right = self._in_right(q)
        return q_right, cam.projection_jacobian(self._right_camera, q_right)[..., :2, :], self._right_turn[0]

    def _of_both(self, left: Array, right: Array) -> Array:
        """Rows (uL, v, uR), or derivatives of them (n, 3, k), from those of the left camera and (uR, vR) (n, 2, k)."""
        weight = cam.weight_of_left_row(self.noise.pixel_std_px)
        v = weight * left[..., 1, :] + (1.0 - weight) * right[..., 1, :]
        return np.stack([left[..., 0, :], v, right[..., 0, :]], axis=-2)
