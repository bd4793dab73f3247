"""The report's rectified stereo camera: projection, its Jacobian and triangulation, on arrays of points.

Points ``q`` are in the left optical frame (x right, y down, z forward, metres). Pixels are ``z = (uL, vL, uR, vR)``.

The two v rows have the same Jacobian, so filters work on the three *rectified rows* ``(uL, v, uR)``, where v is the
mean of vL and vR weighted by inverse variances: the same information in a smaller innovation covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array

# Body axes forward, left, up to optical axes right, down, forward.
T_CAM_BODY = np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
R_CAM_BODY = T_CAM_BODY[:3, :3]

# Least disparities, px: of a point with a depth, of one that shows the motion of the rig, and of one whose flow follows
# from its depth to a fraction of a pixel.
DEPTH_FROM_PX, MOTION_FROM_PX, FLOW_FROM_PX = 0.5, 1.0, 2.0


@dataclass(frozen=True)
class StereoCamera:
    """Intrinsics of a rectified stereo pair: focal lengths and principal point, px; baseline, m, 0 for one camera."""

    fu_px: float
    fv_px: float
    cu_px: float
    cv_px: float
    baseline_m: float = 0.0

    @property
    def is_monocular(self) -> bool:
        """Whether this is one camera."""
        return self.baseline_m == 0.0

    @property
    def matrix(self) -> Array:
        """The report's stereo calibration matrix M (4x4), rows uL, vL, uR, vR."""
        fu, fv, cu, cv, b = self.fu_px, self.fv_px, self.cu_px, self.cv_px, self.baseline_m
        return np.array([[fu, 0, cu, 0], [0, fv, cv, 0], [fu, 0, cu, -fu * b], [0, fv, cv, 0]])

    @property
    def furthest_m(self) -> float:
        """Depth of a point with the least disparity that shows a depth."""
        return self.fu_px * self.baseline_m / DEPTH_FROM_PX


def project(camera: StereoCamera, q: Array) -> Array:
    """Return ``z = M pi(q)``, ``pi(q) = q / q_z``, eq. (3), (..., 3) m to (..., 4) px; callers mask ``q_z <= 0``."""
    q_homogeneous = np.concatenate([q, np.ones((*q.shape[:-1], 1))], axis=-1)
    return (q_homogeneous / q[..., 2:3]) @ camera.matrix.T


def projection_jacobian(camera: StereoCamera, q: Array) -> Array:
    """``M dpi/dq`` without its fourth (homogeneous) column: points (..., 3) m to (..., 4, 3) px/m."""
    inverse_depth = 1.0 / q[..., 2]
    dpi_dq = np.zeros((*q.shape[:-1], 4, 3))
    dpi_dq[..., 0, 0] = dpi_dq[..., 1, 1] = inverse_depth
    dpi_dq[..., 0, 2] = -q[..., 0] * inverse_depth**2
    dpi_dq[..., 1, 2] = -q[..., 1] * inverse_depth**2
    dpi_dq[..., 3, 2] = -(inverse_depth**2)
    return camera.matrix @ dpi_dq


def rectified_rows(pixels_px: Array, pixel_std_px: Array) -> tuple[Array, Array]:
    """Rows ``(uL, v, uR)`` of pixels (..., 4) and their variances (3,) px^2, for pixel noise (4,) px."""
    variance = np.asarray(pixel_std_px, dtype=float) ** 2
    weight_left = variance[3] / (variance[1] + variance[3])
    v = weight_left * pixels_px[..., 1] + (1.0 - weight_left) * pixels_px[..., 3]
    rows = np.stack([pixels_px[..., 0], v, pixels_px[..., 2]], axis=-1)
    return rows, np.array([variance[0], weight_left * variance[1], variance[2]])


def rectified_jacobian(camera: StereoCamera, q: Array) -> Array:
    """`projection_jacobian` of the rectified rows, always square and regular: (..., 3) m to (..., 3, 3) px/m."""
    return projection_jacobian(camera, q)[..., :3, :]


def triangulate(camera: StereoCamera, rows_px: Array) -> Array:
    """Return the point (..., 3) m of rectified rows (..., 3) px with positive disparity: ``z = fu b / (uL - uR)``."""
    z = camera.fu_px * camera.baseline_m / (rows_px[..., 0] - rows_px[..., 2])
    x = (rows_px[..., 0] - camera.cu_px) / camera.fu_px * z
    y = (rows_px[..., 1] - camera.cv_px) / camera.fv_px * z
    return np.stack([x, y, z], axis=-1)
