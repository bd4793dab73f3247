"""Self-calibration: rotation of the right camera against the calibration, estimated from tracks alone.

A small rotation (pitch a, yaw y, roll b; all times the focal length, px) moves the pixels of the right image by

    d uR = a x y + yaw (1 + x^2) - b y        d vR = a (1 + y^2) + b x

with x, y the normalised coordinates of a pixel. Rows show pitch and roll, ``vL - vR = a (1 + y^2) + b x + c y``; c, a
difference of focal lengths, is fitted but not used. Yaw changes all disparities and shows only when the rig moves:
depths of two frames and the flow between them must agree. The estimate is Gaussian and causal: a prior, then the
information of each frame.
"""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array
from ekfslam.geometry.camera import StereoCamera
from ekfslam.geometry.stereo_motion import Alignment

# Share of the information of a frame that counts. Successive frames see the same features with the same errors: without
# it, the standard deviation of yaw was five to ten times too small.
_INDEPENDENT_SHARE = 0.04
_ROBUST_PX = 1.0
_LEAST_POINTS = 10


class RightRotation:
    """Estimate of the rotation, from a prior ``std_rad`` of each axis and the standard deviation of one pixel."""

    def __init__(self, camera: StereoCamera, std_rad: float, pixel_std: float) -> None:
        self._camera, self._std = camera, pixel_std
        prior = (camera.fu_px * std_rad) ** -2
        self._rows_information, self._rows_vector = prior * np.eye(3), np.zeros(3)
        self._yaw_information, self._yaw_vector = prior, 0.0

    @property
    def rows(self) -> Array:
        """(3,) a, b, c, px."""
        return np.asarray(np.linalg.solve(self._rows_information, self._rows_vector), dtype=float)

    @property
    def yaw(self) -> float:
        return self._yaw_vector / self._yaw_information

    @property
    def vector(self) -> Array:
        """(3,) pitch, yaw and roll, px, which `correction` adds to the pixels of the right image."""
        a, b, _ = self.rows
        return np.array([a, self.yaw, b])

    @property
    def std(self) -> Array:
        """(3,) standard deviations of pitch, yaw and roll, px."""
        variance = np.diag(np.linalg.inv(self._rows_information))
        return np.sqrt([variance[0], 1.0 / self._yaw_information, variance[1]])

    def row_offset(self, left: Array) -> Array:
        """Return the predicted ``vL - vR`` (n,) of features at pixels (n, 2) of the left image."""
        return _row_terms(self._camera, left) @ self.rows

    def observe_rows(self, left: Array, right: Array) -> None:
        """Update pitch and roll from pairs of pixels (n, 2)."""
        J = _row_terms(self._camera, left)
        r = left[:, 1] - right[:, 1] - J @ self.rows
        weight = (1.0 + (r / _ROBUST_PX) ** 2) ** -2 * _INDEPENDENT_SHARE / (2.0 * self._std**2)
        self._rows_information = self._rows_information + (J * weight[:, None]).T @ J
        self._rows_vector = self._rows_vector + (J * weight[:, None]).T @ (r + J @ self.rows)

    def observe_motion(self, alignment: Alignment, before_px: Array, now_px: Array) -> None:
        """Update yaw from the rows (n, 3) of two frames and their alignment, with the motion eliminated."""
        if len(before_px) < _LEAST_POINTS:
            return
        by_yaw = np.zeros((len(before_px), 3, 1))
        by_yaw[:, 2, 0] = yaw_shape(self._camera, now_px[:, 2])
        by_yaw[..., 0] -= alignment.B[:, :, 2] * yaw_shape(self._camera, before_px[:, 2])[:, None]
        cross = np.einsum("nij,nik,nkl->jl", by_yaw, alignment.W, alignment.H)[0]
        own = np.einsum("nij,nik,nkl->jl", by_yaw, alignment.W, by_yaw)[0, 0]
        solved = np.linalg.solve(alignment.information + 1e-6 * np.eye(6), cross)
        information = float(own - cross @ solved)
        # residual(yaw) = r + by_yaw d, hence the minus.
        vector = -float(alignment.gradient(by_yaw)[0] - solved @ alignment.gradient(alignment.H))
        yaw = self.yaw
        self._yaw_information += _INDEPENDENT_SHARE * information
        self._yaw_vector += _INDEPENDENT_SHARE * (information * yaw + vector)


def yaw_shape(camera: StereoCamera, u_px: Array) -> Array:
    """Return ``1 + x^2``, the shift of columns (n,) by a yaw of 1 px."""
    return 1.0 + ((u_px - camera.cu_px) / camera.fu_px) ** 2


def correction(camera: StereoCamera, vector: Array, right: Array) -> Array:
    """Return the correction (n, 2) of pixels (n, 2) of the right image for pitch, yaw, roll (3,) or (n, 3), px."""
    x, y = (right[:, 0] - camera.cu_px) / camera.fu_px, (right[:, 1] - camera.cv_px) / camera.fv_px
    a, yaw, b = np.moveaxis(np.asarray(vector), -1, 0)
    return np.stack([a * x * y + yaw * (1.0 + x * x) - b * y, a * (1.0 + y * y) + b * x], axis=1)


def _row_terms(camera: StereoCamera, left: Array) -> Array:
    """Return derivatives (n, 3) of ``vL - vR`` by a, b and c."""
    x, y = (left[:, 0] - camera.cu_px) / camera.fu_px, (left[:, 1] - camera.cv_px) / camera.fv_px
    return np.stack([1.0 + y * y, x, y], axis=1)
