"""Image coordinates of points: linear in pixels and disparity, without intrinsics."""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array


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
