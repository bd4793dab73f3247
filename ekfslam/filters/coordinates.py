"""Coordinates in which a correction acts on landmarks: eq. (7'), the image in the last updated camera.

The error of a landmark seen once is Gaussian in the image (u, v, disparity), not in world. (x/z, y/z, 1/z), linear in
that image, needs no intrinsics and no second camera. The camera must belong to an updated pose: a predicted one turns
by degrees in the update, and images are not linear in that. Sources: Castellanos, Martinez-Cantin, Tardos, Neira,
"Robocentric map joining", RAS 2007 (a clone of the last pose); Civera, Davison, Montiel, "Inverse depth
parametrization for monocular SLAM", T-RO 2008.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ekfslam import kernels
from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.geometry import se3
from ekfslam.models.blocks import Values
from ekfslam.models.model import Model
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
class View:
    """Landmarks in the camera frame.

    Args:
        q: (n, 3) points.
        q_linear, R_linear: (n, 3), (3, 3) points and rotation from world at which derivatives are taken.
        by_columns: (6, c) error of the camera's pose by columns of the body, ``dq = [I, -q^] by_columns x``.
    """

    q: Array
    q_linear: Array
    R_linear: Array
    by_columns: Array


@dataclass(frozen=True)
class CameraCoordinates:
    """Image coordinates of landmarks in the camera of a pose in the state.

    A landmark counts by its position (x, y, z) in the camera frame instead if it is behind the camera, far off its axis
    or without disparity, or if a correction would change its disparity by too large a factor.

    Args:
        model: Model of the filter.
        pose: Name of the pose's block.
        min_depth_m: Depth below which a landmark is behind the camera.
    """

    model: Model
    pose: str
    min_depth_m: float

    def view(self, values: Values, positions_m: Array, T_linear: Array, linear_positions_m: Array) -> View:
        """Return the view of landmarks (n, 3) in world; derivatives are at T_linear and other positions (FEJ)."""
        calibration, T_cam_imu = self.model.observer.calibration, self._T_cam_imu(values)
        by_columns = np.asarray(se3.adjoint(T_cam_imu), dtype=float)
        if calibration is not None:
            by_calibration = calibration.camera_by_extrinsic(values[calibration.name])
            by_columns = np.concatenate([by_columns, by_calibration], axis=1)
        q = q_linear = se3.apply(T_cam_imu @ values[self.pose], positions_m)
        if T_linear is not values[self.pose]:
            q_linear = se3.apply(T_cam_imu @ T_linear, linear_positions_m)
        return View(q, q_linear, T_cam_imu[:3, :3] @ T_linear[:3, :3], by_columns)

    def retract(self, before: View, after: Values, x: Array, d: Array) -> tuple[Array, BoolArray]:
        """Return ``m+`` (n, 3) of eq. (7'), and whether (n,) each landmark counts by its image.

        Args:
            before: View before the correction, with derivatives at the estimate.
            after: Blocks after the correction.
            x, d: (seen,), (n, 3) correction of the blocks and of the landmarks.
        """
        q, xi = before.q, before.by_columns @ x[self.columns]
        step = xi[:3] + q @ se3.skew(xi[3:]).T + d @ before.R_linear.T
        q_after, in_image = kernels.moved_by_image(
            q, step, is_in_image(self.model.sensor, q, self.min_depth_m), LARGEST_FACTOR
        )
        return se3.apply(se3.inverse(self._T_cam_imu(after) @ after[self.pose]), q_after), in_image

    def change(self, slot: IntArray, before: View, after: View, in_image: BoolArray, turned: Array) -> Change:
        """Return ``M`` and ``B`` of eq. (7') from the views before and after; ``turned`` is its D_p (6, 6)."""
        by_after = after.by_columns.copy()
        by_after[:, :6] = by_after[:, :6] @ turned
        B, M = kernels.change_by_image(
            (before.q, before.q_linear, before.R_linear, before.by_columns),
            (after.q, after.q_linear, after.R_linear, by_after),
            in_image,
        )
        return Change(slot, self.columns, B, M)

    @cached_property
    def columns(self) -> IntArray:
        """Columns (c,) of pose and camera in the body."""
        layout, calibration = self.model.layout, self.model.observer.calibration
        columns = layout.columns([self.pose])
        if calibration is None:
            return columns
        return np.concatenate([columns, layout[calibration.name].start + calibration.extrinsic])

    def _T_cam_imu(self, values: Values) -> Array:
        """Return the estimated extrinsics (4, 4)."""
        return self.model.observer.sensor_at(self.model.observer.parameters(values)).T_cam_imu


def is_in_image(sensor: Sensor, q: Array, min_depth_m: float) -> BoolArray:
    """Return whether points (n, 3) in the camera frame are in front of the camera and near enough for an image."""
    z = q[:, 2]
    furthest_m = sensor.camera.furthest_m if isinstance(sensor, Rig) else np.inf
    is_ahead = np.abs(q[:, :2]).max(axis=1, initial=0.0) < _MOST_OBLIQUE * z
    return is_ahead & (z > min_depth_m) & (z < furthest_m)
