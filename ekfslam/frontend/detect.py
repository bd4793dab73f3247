"""New features: corners, spread over the image."""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.data.images import Image
from ekfslam.frontend.opencv import opencv

_BLOCK = 5  # side of the window of the structure tensor, px
_QUALITY = 4e-4  # least eigenvalue of a corner, as a share of the largest in the image
_BUCKETS = 12, 4  # columns and rows of the grid over which new features are spread


def corners(image: Image, free: BoolArray, spacing: int) -> Array:
    """Return corners (n, 2), strongest (Shi and Tomasi, CVPR 1994) first, ``spacing`` px apart at ``free`` pixels."""
    cv2 = opencv()
    response = cv2.cornerMinEigenVal(image, _BLOCK)
    largest = cv2.dilate(response, np.ones((spacing + 1, spacing + 1), np.uint8))
    is_corner = (response == largest) & (response > _QUALITY * float(response.max())) & free
    at = np.flatnonzero(is_corner)
    at = at[np.argsort(-response.ravel()[at], kind="stable")]
    return np.stack([at % image.shape[1], at // image.shape[1]], axis=1).astype(float)


def without(free: BoolArray, pixels: Array, radius: int) -> BoolArray:
    """Return ``free`` (height, width) without discs about pixels (n, 2)."""
    disc = np.zeros(free.shape, dtype=np.uint8)
    for u, v in np.round(pixels).astype(np.int64).tolist():
        opencv().circle(disc, (u, v), radius, 1, -1)
    return free & (disc == 0)


def spread(found: Array, taken: Array, size: tuple[int, int], wanted: int) -> IntArray:
    """Return indices of at most ``wanted`` features so that they cover an image of this width and height evenly.

    Every cell of a grid gives its best of ``found`` (n, 2), then its second best, and so on. Features that are already
    there, ``taken`` (m, 2), count first.
    """
    cell, count = _cells(found, size), np.bincount(_cells(taken, size), minlength=np.prod(_BUCKETS))
    order = np.argsort(cell, kind="stable")
    first = np.searchsorted(cell[order], cell[order])
    rank = np.empty(len(found), dtype=np.int64)
    rank[order] = np.arange(len(found)) - first + count[cell[order]]
    return np.lexsort((np.arange(len(found)), rank))[:wanted]


def _cells(pixels: Array, size: tuple[int, int]) -> IntArray:
    """Return the cell of the grid (n,) of each pixel (n, 2)."""
    column, row = np.clip((pixels * _BUCKETS / size).astype(np.int64), 0, np.array(_BUCKETS) - 1).T
    return column * _BUCKETS[1] + row


def eroded(mask: BoolArray, margin: int) -> BoolArray:
    """Return a mask (height, width) without pixels this close to its edge, or to that of the image."""
    kernel = np.ones((2 * margin + 1,) * 2, np.uint8)
    return opencv().erode(mask.astype(np.uint8), kernel, borderValue=0) > 0
