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

from ekfslam import kernels
from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.geometry import se3
from ekfslam.models.sensors.base import Sensor
from ekfslam.models.sensors.stereo import Rig

# Largest ratio of distances across and along the optical axis for image coordinates.
_MOST_OBLIQUE = 3.0
# Largest factor by which a correction may change a disparity.
LARGEST_FACTOR = 4.0


@dataclass(frozen=True)
class Change:
    """Landmark errors after a correction, ``d_i+ = M_i d_i + B_i x``.

    Args:
        slot: (n,) slots of the landmarks, ascending.
        columns: (c,) body columns of x.
        B: (n, 3, c).
        M: (n, 3, 3); None is the identity.
    """

    slot: IntArray
    columns: IntArray
    B: Array
    M: Array | None = None

    def only(self, slot: IntArray) -> Change:
        """Return the change of some of the landmarks."""
        at = np.searchsorted(self.slot, slot)
        return Change(slot, self.columns, self.B[at], None if self.M is None else self.M[at])


@dataclass(frozen=True)
class CameraPoints:
    """Landmarks in the frame of a camera.

    Args:
        q: (n, 3) points.
        q_linear, R_linear: (n, 3), (3, 3) points and rotation from world at which derivatives are taken.
    """

    q: Array
    q_linear: Array
    R_linear: Array


@dataclass(frozen=True)
class CameraCoordinates:
    """Image coordinates of landmarks in a view.

    A landmark counts by its position (x, y, z) in the camera frame instead if it is behind the camera, far off its axis
    or without disparity, or if a correction would change its disparity by too large a factor.

    Args:
        sensor: Sensor of the filter.
        min_depth_m: Depth below which a landmark is behind the camera.
    """

    sensor: Sensor
    min_depth_m: float

    def retract(self, before: CameraPoints, T_after: Array, z: Array, d: Array) -> tuple[Array, BoolArray]:
        """Return ``m+`` (n, 3) of eq. (7'), and whether (n,) each landmark counts by its image.

        Args:
            before: Points before the correction, with derivatives at the estimate.
            T_after: (4, 4) ``T_cam_world`` after the correction.
            z, d: (6,), (n, 3) correction of the view and of the landmarks.
        """
        q = before.q
        step = z[:3] + q @ se3.skew(z[3:]).T + d @ before.R_linear.T
        in_image = is_in_image(self.sensor, q, self.min_depth_m)
        q_after, in_image = kernels.moved_by_image(q, step, in_image, LARGEST_FACTOR)
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
    """Return ``M`` and ``B`` of eq. (7').

    Args:
        slot: (n,) slots of the landmarks.
        columns: (6,) body columns of the view.
        before, after: The landmarks before and after the correction.
        in_image: (n,) whether they count by their images.
        turned: (6, 6) D of eq. (7').
    """
    B, M = kernels.change_by_image(
        (before.q, before.q_linear, before.R_linear, np.eye(6)),
        (after.q, after.q_linear, after.R_linear, turned),
        in_image,
    )
    return Change(slot, columns, B, M)


def is_in_image(sensor: Sensor, q: Array, min_depth_m: float) -> BoolArray:
    """Return whether points (n, 3) in the camera frame are in front of the camera and near enough for an image."""
    z = q[:, 2]
    furthest_m = sensor.camera.furthest_m if isinstance(sensor, Rig) else np.inf
    is_ahead = np.abs(q[:, :2]).max(axis=1, initial=0.0) < _MOST_OBLIQUE * z
    return is_ahead & (z > min_depth_m) & (z < furthest_m)
