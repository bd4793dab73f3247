"""Patches of first sight, to which features are aligned in every frame, so that tracks do not creep.

Inverse compositional alignment (Baker and Matthews, IJCV 2004) over translation, shape, gain and bias: the image about
a feature is ``I(p + A x) = g T((1 + D) x + d) + b``, linear in ``(g d, g D, g, b)`` with constant derivatives. One
product with a stored matrix (8, pixels) a feature and iteration gives them. The shape A (2, 2) starts as that of the
frame before, and has a prior about it: where a patch has no texture to tell its shape, it keeps it.

An aligned pixel has the covariance ``2 sigma^2 A G^-1 A^T`` with the structure tensor G of the patch (Shi and Tomasi,
CVPR 1994). Features whose patch tells their place worse than `_FINE_PX` get one of twice the width, of blurred images.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from typing import Self

import numpy as np

from ekfslam.arrays import Array, BoolArray, Float32Array, IntArray
from ekfslam.data.images import Image
from ekfslam.frontend.opencv import opencv

SIDE = 15  # of a patch, px; of a coarse one in pixels of twice the size
_ITERATIONS = 5
_CONVERGED_PX = 0.01
_RIDGE = 1e-6
_NOISE = 2.0  # grey levels of a camera of 8 bits
_BENDS = 0.02  # change of a shape from one frame to the next: parallax at which errors double (`ekfslam.models.noise`)
_LARGEST_BEND = 0.3  # of an iteration
_FINE_PX = 0.1  # error of u and v that the automatic noise states for a new feature


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


def sample(image: Float32Array, pixels: Array, shape: Array, side: int) -> Float32Array:
    """Return patches (n, side^2) about pixels (n, 2), bilinear; ``shape`` (n, 2, 2) maps offsets to the image."""
    cv2, offsets = opencv(), grid(side)
    if not len(pixels):
        return np.empty((0, side**2), dtype=np.float32)
    shape = shape.astype(np.float32)
    at = np.empty((len(pixels), len(offsets), 2), dtype=np.float32)
    for row in range(2):
        at[..., row] = shape[:, row] @ offsets.T + pixels[:, row, None].astype(np.float32)
    return cv2.remap(image, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


@dataclass(frozen=True)
class Greys:
    """Grey levels of an image, for coarse patches without the detail that they do not sample."""

    image: Image

    @cached_property
    def fine(self) -> Float32Array:
        return self.image.astype(np.float32)

    @cached_property
    def coarse(self) -> Float32Array:
        return opencv().blur(self.fine, (3, 3))

    def of(self, is_coarse: bool) -> Float32Array:
        """Return the grey levels for fine or coarse patches."""
        return self.coarse if is_coarse else self.fine


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
    """Patches of one image.

    Args:
        patch: (n, side^2) grey levels.
        solver: (n, 8, side^2) solutions for ``(g d, g D, g, b)``, D row by row.
        prior: (n, 8, 4) effect of the change of the shape so far in a frame, which its prior takes back.
        is_coarse: (n,) whether a patch has twice the width.
    """

    patch: Float32Array
    solver: Float32Array
    prior: Float32Array
    is_coarse: BoolArray

    @staticmethod
    def of(greys: Greys, pixels: Array, is_coarse: BoolArray | None = None) -> Templates:
        """Return patches about pixels (n, 2) of an image, coarse ones by default where the others are too vague."""
        J = _derivatives(greys.fine, pixels, False)
        is_coarse = _is_vague(J) if is_coarse is None else is_coarse
        J[is_coarse] = _derivatives(greys.coarse, pixels[is_coarse], True) if is_coarse.any() else 0.0
        JW = J * weights(SIDE)
        information = (JW @ np.swapaxes(J, 1, 2)).astype(float) + np.diag([_RIDGE] * 2 + [_STIFF] * 4 + [_RIDGE] * 2)
        inverse = np.linalg.inv(information)
        prior = _STIFF * inverse[:, :, 2:6]
        return Templates(J[:, 6].copy(), (inverse @ JW).astype(np.float32), prior.astype(np.float32), is_coarse)

    @property
    def shape(self) -> Array:
        """(n, 2, 2) shapes at first sight."""
        return np.where(self.is_coarse, 2.0, 1.0)[:, None, None] * np.eye(2)

    def align(self, greys: Greys, pixels: Array, shape: Array) -> tuple[Array, Array, Array]:
        """Align features from pixels (n, 2) and shapes (n, 2, 2); return both, and correlations or -1."""
        pixels, shape, score = pixels.copy(), shape.copy(), np.empty(len(pixels))
        for is_coarse in (False, True):
            if not len(rows := np.flatnonzero(self.is_coarse == is_coarse)):
                continue
            grey = greys.of(is_coarse)
            fails = self._align(grey, rows, pixels, shape)
            seen = sample(grey, pixels[rows], shape[rows], SIDE)
            score[rows] = np.where(fails[rows], -1.0, correlation(self.patch[rows], seen, weights(SIDE)))
        return pixels, shape, score

    def _align(self, image: Float32Array, active: IntArray, pixels: Array, shape: Array) -> BoolArray:
        """Align some features in place; return whether (n,) one cannot be aligned."""
        bent, fails = np.zeros((len(pixels), 4)), np.zeros(len(pixels), dtype=bool)
        for _ in range(_ITERATIONS):
            if not len(active):
                break
            seen = sample(image, pixels[active], shape[active], SIDE)
            solution = (self.solver[active] @ seen[..., None])[..., 0].astype(float)
            solution -= (self.prior[active] @ bent[active][..., None])[..., 0]
            is_odd = solution[:, 6] < 0.1
            fails[active[is_odd]] = True
            active, solution = active[~is_odd], solution[~is_odd]
            step, bend = np.split(solution[:, :6] / solution[:, 6:7], [2], axis=1)
            step, bend = np.clip(step, -1.0, 1.0), np.clip(bend, -_LARGEST_BEND, _LARGEST_BEND)
            pixels[active] -= (shape[active] @ step[..., None])[..., 0]
            shape[active] -= shape[active] @ bend.reshape(-1, 2, 2)  # the inverse of 1 + D to first order
            bent[active] += bend
            active = active[np.abs(step).max(axis=1) > _CONVERGED_PX]
        return fails


# Information of the prior of a shape in units of a patch's: differences of two noisy images have twice the variance.
_STIFF = 2.0 * _NOISE**2 * float((weights(SIDE) ** 2).sum()) / _BENDS**2


def _derivatives(image: Float32Array, pixels: Array, is_coarse: bool) -> Float32Array:
    """Return derivatives (n, 8, side^2) of patches about pixels (n, 2) by ``(d, D, g, b)``."""
    side, n = SIDE, len(pixels)
    if not n:
        return np.empty((0, 8, side**2), dtype=np.float32)
    shape = np.tile((1.0 + is_coarse) * np.eye(2), (n, 1, 1))
    wide = sample(image, pixels, shape, side + 2).reshape(-1, side + 2, side + 2)
    T = wide[:, 1:-1, 1:-1].reshape(n, side**2)
    T_u = 0.5 * (wide[:, 1:-1, 2:] - wide[:, 1:-1, :-2]).reshape(T.shape)
    T_v = 0.5 * (wide[:, 2:, 1:-1] - wide[:, :-2, 1:-1]).reshape(T.shape)
    u, v = grid(side).T
    return np.stack([T_u, T_v, T_u * u, T_u * v, T_v * u, T_v * v, T, np.ones_like(T)], axis=1)


def _is_vague(J: Float32Array) -> BoolArray:
    """Return whether (n,) patches, given their derivatives (n, 8, side^2), tell a place worse than `_FINE_PX`."""
    T_x = J[:, :2]
    G = (T_x * weights(SIDE)) @ np.swapaxes(T_x, 1, 2) - 0.5 * _NOISE**2 * np.eye(2)  # without the noise's own
    least = np.linalg.eigvalsh(G.astype(float))[:, 0]
    return least < 2.0 * _NOISE**2 * float((weights(SIDE) ** 2).sum()) / _FINE_PX**2


def correlation(a: Float32Array, b: Float32Array, weight: Float32Array) -> Array:
    """Return the weighted, normalised cross-correlation (n,) of patches (n, side^2)."""
    a, b = a - (a @ weight)[:, None], b - (b @ weight)[:, None]
    norm = np.sqrt((a * a) @ weight * ((b * b) @ weight))
    return ((a * b) @ weight) / np.maximum(norm, 1e-9)
