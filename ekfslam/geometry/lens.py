"""Distortion of lenses that are no pinholes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ekfslam.arrays import Array


def radtan(xy: Array, coefficients: Sequence[float]) -> Array:
    """Distort (..., 2) radially and tangentially (Brown 1966) by ``(k1, k2, p1, p2[, k3[, k4, k5, k6]])`` as OpenCV."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, *(0.0,) * (8 - len(coefficients)))
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return np.stack(
        [radial * x + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), radial * y + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y],
        axis=-1,
    )


def equidistant(xy: Array, coefficients: Sequence[float]) -> Array:
    """Distort (..., 2) as a fisheye (Kannala and Brandt, PAMI 2006): ``theta (1 + k1 theta^2 + ... + k4 theta^8)``."""
    r = np.linalg.norm(xy, axis=-1, keepdims=True)
    theta = np.arctan(r)
    t2 = theta * theta
    k1, k2, k3, k4 = coefficients
    bent = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    return xy * np.where(r > 1e-12, bent / np.maximum(r, 1e-12), 1.0)
