"""Patches of first sight, to which features are aligned in every frame, so that tracks do not creep.

Inverse compositional alignment (Baker and Matthews, IJCV 2004) over translation, gain and bias: the image about a
feature is ``I(p + s x) = g T(x + d) + b``, linear in ``(g d, g, b)`` with constant derivatives. One product with a
stored matrix (4, pixels) a feature and iteration gives them. The scale s of a patch is the ratio of disparities.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Self

import numpy as np

from ekfslam.arrays import Array, BoolArray, Float32Array, IntArray
from ekfslam.frontend.opencv import opencv

SIDE = 15  # of a patch, px
_ITERATIONS = 8
_CONVERGED_PX = 0.005
_RIDGE = 1e-6


@cache
def grid(side: int) -> Float32Array:
    """Return offsets (side^2, 2) of the pixels of a patch from its centre, row by row, float32."""
    offsets = np.arange(side) - side // 2
    v, u = np.meshgrid(offsets, offsets, indexing="ij")
    return np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float32)


@cache
def weights(side: int) -> Float32Array:
    """Return (side^2,) Gaussian weights of the pixels of a patch, which sum to 1."""
    weight = np.exp(-0.5 * (grid(side) ** 2).sum(axis=1) / (side / 4.0) ** 2)
    return (weight / weight.sum()).astype(np.float32)


def sample(image: Float32Array, pixels: Array, scale: Array, side: int) -> Float32Array:
    """Return patches (n, side^2) about pixels (n, 2), bilinear, with pixels ``scale`` (n,) apart."""
    cv2, offsets = opencv(), grid(side)
    if not len(pixels):
        return np.empty((0, side**2), dtype=np.float32)
    at = pixels.astype(np.float32)[:, None] + scale.astype(np.float32)[:, None, None] * offsets
    return cv2.remap(image, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


@dataclass(frozen=True)
class Rows:
    """Base of dataclasses whose fields have one row for each feature."""

    def keep(self, kept: IntArray | BoolArray) -> Self:
        """Return some rows, by index or mask."""
        fields = vars(self).values()
        return type(self)(*(rows.keep(kept) if isinstance(rows, Rows) else rows[kept] for rows in fields))

    def and_more(self, others: Self) -> Self:
        """Return these rows and others."""
        pairs = zip(vars(self).values(), vars(others).values(), strict=True)
        return type(self)(*(a.and_more(b) if isinstance(a, Rows) else np.concatenate([a, b]) for a, b in pairs))


@dataclass(frozen=True)
class Templates(Rows):
    """Patches (n, side^2) of one image, and their solutions (n, 4, side^2) for ``(g d_u, g d_v, g, b)``."""

    patch: Float32Array
    solver: Float32Array

    @staticmethod
    def of(image: Float32Array, pixels: Array) -> Templates:
        """Return patches about pixels (n, 2)."""
        side = SIDE
        wide = sample(image, pixels, np.ones(len(pixels)), side + 2).reshape(-1, side + 2, side + 2)
        T = wide[:, 1:-1, 1:-1].reshape(len(pixels), side**2)
        T_u = 0.5 * (wide[:, 1:-1, 2:] - wide[:, 1:-1, :-2]).reshape(T.shape)
        T_v = 0.5 * (wide[:, 2:, 1:-1] - wide[:, :-2, 1:-1]).reshape(T.shape)
        J = np.stack([T_u, T_v, T, np.ones_like(T)], axis=1)
        JW = J * weights(side)
        normal = JW @ np.swapaxes(J, 1, 2)
        solver = np.linalg.solve(normal + _RIDGE * np.eye(4), JW.astype(float))
        return Templates(T, solver.astype(np.float32))

    def align(self, image: Float32Array, pixels: Array, scale: Array) -> tuple[Array, Array]:
        """Align features from pixels (n, 2) to patches scaled (n,); return pixels and correlations, or -1."""
        pixels, active = pixels.copy(), np.arange(len(pixels))
        fails = np.zeros(len(pixels), dtype=bool)
        for _ in range(_ITERATIONS):
            if not len(active):
                break
            seen = sample(image, pixels[active], scale[active], SIDE)
            solution = (self.solver[active] @ seen[..., None])[..., 0]
            gain = solution[:, 2]
            is_odd = gain < 0.1
            step = np.clip(solution[:, :2] / np.where(is_odd, 1.0, gain)[:, None], -1.0, 1.0)
            pixels[active] -= scale[active, None] * np.where(is_odd[:, None], 0.0, step)
            fails[active[is_odd]] = True
            active = active[~is_odd & (np.abs(step).max(axis=1) > _CONVERGED_PX)]
        score = correlation(self.patch, sample(image, pixels, scale, SIDE), weights(SIDE))
        return pixels, np.where(fails, -1.0, score)


def correlation(a: Float32Array, b: Float32Array, weight: Float32Array) -> Array:
    """Return the weighted, normalised cross-correlation (n,) of patches (n, side^2)."""
    a, b = a - (a @ weight)[:, None], b - (b @ weight)[:, None]
    norm = np.sqrt((a * a) @ weight * ((b * b) @ weight))
    return ((a * b) @ weight) / np.maximum(norm, 1e-9)
