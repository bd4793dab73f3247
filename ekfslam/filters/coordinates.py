"""Coordinates in which a correction acts on landmarks: eq. (7'), the image in the last updated camera.

An error of a landmark seen once is Gaussian in the image (u, v, disparity) of the camera that saw it. In world it is
not: depth is the inverse of a disparity. Image coordinates are linear in (x/z, y/z, 1/z), which serve here instead: so
intrinsics do not matter, and one camera alone has them, too. The camera must be one whose pose is updated already. That
of the prediction turns by degrees in the update, and images are not linear in that.

Sources: Castellanos, Martinez-Cantin, Tardos, Neira, "Robocentric map joining", RAS 2007 (a clone of the last pose);
Civera, Davison, Montiel, "Inverse depth parametrization for monocular SLAM", T-RO 2008.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.geometry import se3
from ekfslam.models.blocks import Values
from ekfslam.models.model import Model
from ekfslam.models.observation import linearise
from ekfslam.models.sensors.stereo import Rig

# A landmark is beside the camera where a ray is this much longer across than along the optical axis.
_MOST_OBLIQUE = 3.0
# What has less disparity (px) is too far for its image to say anything of its depth.
_LEAST_DISPARITY_PX = 0.5
# Largest factor by which a correction may change a disparity.
_LARGEST_FACTOR = 4.0


@dataclass(frozen=True)
class Change:
    """``d_i+ = M_i d_i + B_i x``: landmark errors after a correction by those before, and by some of the body.

    Args:
        columns: (c,) of the body.
        B: (n, 3, c).
        M: (n, 3, 3); None is the identity.
    """

    columns: IntArray
    B: Array
    M: Array | None = None

    def only(self, slot: IntArray) -> Change:
        """The change of some of the landmarks."""
        return Change(self.columns, self.B[slot], None if self.M is None else self.M[slot])


@dataclass(frozen=True)
class Linear:
    """Where derivatives are taken: at a pose (4, 4) and landmarks (n, 3) in world."""

    T_imu_world: Array
    positions_m: Array


@dataclass(frozen=True)
class _Points:
    """What `linearise` asks of a sensor, for points in the camera frame as they are."""

    T_cam_imu: Array

    def jacobian(self, q: Array) -> Array:
        return np.broadcast_to(np.eye(3), (len(q), 3, 3))


@dataclass(frozen=True)
class CameraCoordinates:
    """Landmarks by their images in the camera of a pose in the state.

    Landmarks behind or beside the camera, those without disparity, and those whose disparity a correction would change
    by too large a factor count by their positions (x, y, z) in the camera frame instead.

    Args:
        model: Of the filter.
        pose: Name of the pose's block: of the last updated pose.
        min_depth_m: What is nearer is behind the camera.
    """

    model: Model
    pose: str
    min_depth_m: float

    def retract(self, before: Values, after: Values, positions_m: Array, x: Array, d: Array) -> tuple[Array, BoolArray]:
        """Landmarks ``m+`` (n, 3) of eq. (7') after a correction of blocks ``x`` (seen,) and landmarks d (n, 3).

        Args:
            before, after: Blocks before and after it.
            positions_m: (n, 3) landmarks before it.
            x, d: The correction.

        Returns:
            Also whether (n,) a landmark counts by its image.
        """
        q, Q_x, Q_m = self._points(before, positions_m, Linear(before[self.pose], positions_m))
        step = Q_x @ x[self._columns] + (Q_m @ d[..., None])[..., 0]
        in_image = self._is_in_image(q)
        front = np.where(in_image[:, None], q, _AHEAD)
        y = image(front)
        y_after = y + (image_jacobian(front) @ step[..., None])[..., 0]
        in_image &= (y_after[:, 2] > y[:, 2] / _LARGEST_FACTOR) & (y_after[:, 2] < y[:, 2] * _LARGEST_FACTOR)
        q_after = np.where(in_image[:, None], image(np.where(in_image[:, None], y_after, _AHEAD)), q + step)
        return se3.apply(se3.inverse(self._T_cam_imu(after) @ after[self.pose]), q_after), in_image

    def change(
        self,
        before: tuple[Values, Array, Linear],
        after: tuple[Values, Array, Linear],
        in_image: BoolArray,
        turned: Callable[[Array, Array], Array],
    ) -> Change:
        """``M`` and ``B`` of eq. (7').

        Args:
            before, after: Blocks, landmarks (n, 3), and where their derivatives are taken, before and after.
            in_image: (n,) which landmarks count by their images.
            turned: How the error of a pose before becomes that after, (6, 6), given both poses.
        """
        (values, _, _), (values_after, _, _) = before, after
        q, Q_x, Q_m = self._points(*before)
        q_after, Q_x_after, Q_m_after = self._points(*after)
        # The image is its own inverse: its derivative at an image is the inverse of that at the point.
        J = image_jacobian(np.where(in_image[:, None], q, _AHEAD))
        J_inverse_after = image_jacobian(image(np.where(in_image[:, None], q_after, _AHEAD)))
        J = np.where(in_image[:, None, None], J_inverse_after @ J, np.eye(3))
        by_pose = Q_x_after[..., :6] @ turned(values[self.pose], values_after[self.pose])
        back = Q_m_after.swapaxes(1, 2)  # a rotation
        B = back @ (J @ Q_x - np.concatenate([by_pose, Q_x_after[..., 6:]], axis=-1))
        return Change(self._columns, B, back @ J @ Q_m)

    @property
    def _columns(self) -> IntArray:
        """Columns of pose and camera in the body."""
        layout, calibration = self.model.layout, self.model.calibration
        columns = layout.columns([self.pose])
        if calibration is None:
            return columns
        return np.concatenate([columns, layout["calibration"].start + calibration.extrinsic])

    def _T_cam_imu(self, values: Values) -> Array:
        return self.model.sensor_at(values["calibration"] if self.model.calibration else _GIVEN).T_cam_imu

    def _points(self, values: Values, positions_m: Array, linear: Linear) -> tuple[Array, Array, Array]:
        """Points q (n, 3) in the camera frame, their derivatives by pose and camera (n, 3, c) and by landmarks."""
        T_cam_imu, calibration = self._T_cam_imu(values), self.model.calibration
        at = linear.T_imu_world, linear.positions_m
        q, Q_x, Q_m = linearise(_Points(T_cam_imu), values[self.pose], positions_m, *at)
        if calibration is not None:
            q_linear = se3.apply(T_cam_imu @ at[0], at[1])
            by_camera = calibration.points_by_extrinsic(values["calibration"], q_linear)
            Q_x = np.concatenate([Q_x, by_camera], axis=-1)
        return q, Q_x, Q_m

    def _is_in_image(self, q: Array) -> BoolArray:
        """Whether points (n, 3) are in front of the camera and near enough."""
        sensor, z = self.model.sensor, q[:, 2]
        furthest_m = np.inf
        if isinstance(sensor, Rig):
            furthest_m = sensor.camera.fu_px * sensor.camera.baseline_m / _LEAST_DISPARITY_PX
        is_ahead = np.abs(q[:, :2]).max(axis=1, initial=0.0) < _MOST_OBLIQUE * z
        return is_ahead & (z > self.min_depth_m) & (z < furthest_m)


# Stands for points whose image is not asked for.
_AHEAD = np.array([0.0, 0.0, 1.0])
_GIVEN = np.zeros(9)


def image(q: Array) -> Array:
    """``(x/z, y/z, 1/z)`` of points (..., 3); its own inverse."""
    return np.concatenate([q[..., :2], np.ones_like(q[..., 2:])], axis=-1) / q[..., 2:]


def image_jacobian(q: Array) -> Array:
    """Derivative (..., 3, 3) of `image` by the points."""
    y = image(q)
    J = np.zeros((*q.shape, 3))
    J[..., 0, 0] = J[..., 1, 1] = y[..., 2]
    J[..., 2] = -y * y[..., 2:]
    return J
