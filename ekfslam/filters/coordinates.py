"""Coordinates in which a correction acts on landmarks: eq. (7'), the image in the view that was updated last.

The error of a landmark seen once is Gaussian in the image (u, v, disparity), not in world. (x/z, y/z, 1/z), linear in
that image, needs no intrinsics and no second camera. The view must be an updated one: a predicted one turns by degrees
in the update, and images are not linear in that. Sources: Castellanos, Martinez-Cantin, Tardos, Neira, "Robocentric map
joining", RAS 2007 (a clone of the last pose); Civera, Davison, Montiel, "Inverse depth parametrization for monocular
SLAM", T-RO 2008.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.geometry import se3
from ekfslam.models.sensors.base import Sensor
from ekfslam.models.sensors.stereo import Rig

# Largest ratio of distances across and along the optical axis for image coordinates.
_MOST_OBLIQUE = 3.0
# Largest factor by which a correction may change a disparity.
LARGEST_FACTOR = 4.0
# Stands for points whose image is not wanted.
_AHEAD = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Change:
    """Landmark errors after a correction, ``d_i+ = M_i d_i + B_i x``."""

    slot: IntArray  # (n,) slots of the landmarks, ascending
    columns: IntArray  # (c,) body columns of x
    B: Array  # (n, 3, c)
    M: Array | None = None  # (n, 3, 3); None is the identity

    def only(self, slot: IntArray) -> Change:
        """Return the change of some of the landmarks."""
        at = np.searchsorted(self.slot, slot)
        return Change(slot, self.columns, self.B[at], None if self.M is None else self.M[at])


@dataclass(frozen=True)
class CameraPoints:
    """Landmarks in the frame of a camera."""

    q: Array  # (n, 3) points
    q_linear: Array  # q_linear, R_linear: (n, 3), (3, 3) points and rotation from world at which derivatives are taken
    R_linear: Array


@dataclass(frozen=True)
class CameraCoordinates:
    """Image coordinates of landmarks in a view.

    A landmark counts by its position (x, y, z) in the camera frame instead if it is behind the camera, far off its axis
    or without disparity, or if a correction would change its disparity by too large a factor.
    """

    sensor: Sensor  # sensor of the filter
    min_depth_m: float  # depth below which a landmark is behind the camera

    def retract(self, before: CameraPoints, T_after: Array, z: Array, d: Array) -> tuple[Array, BoolArray]:
        """Return ``m+`` (n, 3) of eq. (7'), and whether (n,) each landmark counts by its image.

        Points ``before`` the correction have derivatives at the estimate; z (6,) and d (n, 3) correct view and
        landmarks; ``T_after`` (4, 4) is ``T_cam_world`` after it.
        """
        q = before.q
        step = z[:3] + q @ se3.skew(z[3:]).T + d @ before.R_linear.T
        in_image = is_in_image(self.sensor, q, self.min_depth_m)
        q_after, in_image = moved_by_image(q, step, in_image, LARGEST_FACTOR)
        return se3.apply(se3.inverse(T_after), q_after), in_image


def points_in(T_cam_world: Array, positions_m: Array, T_linear: Array, linear_positions_m: Array) -> CameraPoints:
    """Return landmarks (n, 3) in a camera (4, 4); derivatives are at T_linear and other positions (FEJ)."""
    q = q_linear = se3.apply(T_cam_world, positions_m)
    if T_linear is not T_cam_world:
        q_linear = se3.apply(T_linear, linear_positions_m)
    return CameraPoints(q, q_linear, T_linear[:3, :3])


def change_in_view(
    slot: IntArray, columns: IntArray, before: CameraPoints, after: CameraPoints, in_image: BoolArray, turned: Array
) -> Change:
    """Return ``M`` and ``B`` of eq. (7') and the view's body columns; ``turned`` (6, 6) is D there."""
    # The image is its own inverse: its derivative at an image is the inverse of that at the point.
    J = image_jacobian(np.where(in_image[:, None], before.q, _AHEAD))
    J_inverse_after = image_jacobian(image(np.where(in_image[:, None], after.q, _AHEAD)))
    J = np.where(in_image[:, None, None], J_inverse_after @ J, np.eye(3))
    # Rows a of A q^ are a x q.
    by_turn, by_turn_after = np.cross(J, before.q_linear[:, None]), np.cross(np.eye(3), after.q_linear[:, None])
    by_after = np.concatenate([np.broadcast_to(np.eye(3), J.shape), -by_turn_after], axis=-1) @ turned
    B = np.concatenate([J, -by_turn], axis=-1) - by_after
    R, R_after = before.R_linear, after.R_linear
    return Change(slot, columns, R_after.T @ B, R_after.T @ J @ R)


def is_in_image(sensor: Sensor, q: Array, min_depth_m: float) -> BoolArray:
    """Return whether points (n, 3) in the camera frame are in front of the camera and near enough for an image."""
    z = q[:, 2]
    furthest_m = sensor.camera.furthest_m if isinstance(sensor, Rig) else np.inf
    is_ahead = np.abs(q[:, :2]).max(axis=1, initial=0.0) < _MOST_OBLIQUE * z
    return is_ahead & (z > min_depth_m) & (z < furthest_m)


def moved_by_image(q: Array, step: Array, in_image: BoolArray, factor: float) -> tuple[Array, BoolArray]:
    """Return points that a correction moves linearly in the image, ``y+ = y + J dq``, and which of them (n,) did.

    Points q (n, 3) in the camera frame without an image, and those whose disparity changes by more than ``factor``,
    move by dq itself.
    """
    front = np.where(in_image[:, None], q, _AHEAD)
    y = image(front)
    y_after = y + (image_jacobian(front) @ step[..., None])[..., 0]
    in_image = in_image & (y_after[:, 2] > y[:, 2] / factor) & (y_after[:, 2] < y[:, 2] * factor)
    return np.where(in_image[:, None], image(np.where(in_image[:, None], y_after, _AHEAD)), q + step), in_image


def image(q: Array) -> Array:
    """Return ``(x/z, y/z, 1/z)`` of points (..., 3); its own inverse."""
    return np.concatenate([q[..., :2], np.ones_like(q[..., 2:])], axis=-1) / q[..., 2:]


def image_jacobian(q: Array) -> Array:
    """Return the derivative (..., 3, 3) of `image` by the points."""
    y = image(q)
    J = np.zeros((*q.shape, 3))
    J[..., 0, 0] = J[..., 1, 1] = y[..., 2]
    J[..., 2] = -y * y[..., 2:]
    return J
