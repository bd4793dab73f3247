"""New features: corners, spread over the image."""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.config import FrontEndConfig
from ekfslam.data.images import Image
from ekfslam.frontend.opencv import opencv


def corners(image: Image, free: BoolArray, config: FrontEndConfig) -> Array:
    """Corners by the smaller eigenvalue of the structure tensor (Shi and Tomasi, CVPR 1994).

    Args:
        image: In which to look.
        free: (height, width) where a feature may be.
        config: Settings.

    Returns:
        Pixels (n, 2), strongest first.
    """
    cv2 = opencv()
    response = cv2.cornerMinEigenVal(image, config.corner_block)
    largest = cv2.dilate(response, np.ones((config.spacing + 1, config.spacing + 1), np.uint8))
    is_corner = (response == largest) & (response > config.corner_quality * float(response.max())) & free
    at = np.flatnonzero(is_corner)
    at = at[np.argsort(-response.ravel()[at], kind="stable")]
    return np.stack([at % image.shape[1], at // image.shape[1]], axis=1).astype(float)


def without(free: BoolArray, pixels: Array, radius: int) -> BoolArray:
    """Where features may be (height, width) off pixels (n, 2) that are taken."""
    disc = np.zeros(free.shape, dtype=np.uint8)
    for u, v in np.round(pixels).astype(np.int64).tolist():
        opencv().circle(disc, (u, v), radius, 1, -1)
    return free & (disc == 0)


def spread(found: Array, taken: Array, size: tuple[int, int], wanted: int, buckets: tuple[int, int]) -> IntArray:
    """Which features to take so that the image is covered evenly.

    Every cell of a grid gives its best, then its second best, and so on; what a cell has already counts first.

    Args:
        found: (n, 2) pixels, best first.
        taken: (m, 2) pixels of the features that there are.
        size: Width and height of the image.
        wanted: How many to take.
        buckets: Columns and rows of the grid.

    Returns:
        Indices of at most ``wanted`` features, in the order in which they are taken.
    """
    cell, count = _cells(found, size, buckets), np.bincount(_cells(taken, size, buckets), minlength=np.prod(buckets))
    order = np.argsort(cell, kind="stable")
    first = np.searchsorted(cell[order], cell[order])
    rank = np.empty(len(found), dtype=np.int64)
    rank[order] = np.arange(len(found)) - first + count[cell[order]]
    return np.lexsort((np.arange(len(found)), rank))[:wanted]


def _cells(pixels: Array, size: tuple[int, int], buckets: tuple[int, int]) -> IntArray:
    """Number of the cell of the grid that each pixel (n, 2) is in."""
    column, row = (np.clip((pixels[:, i] * buckets[i] / size[i]).astype(np.int64), 0, buckets[i] - 1) for i in range(2))
    return column * buckets[1] + row


def eroded(mask: BoolArray, margin: int) -> BoolArray:
    """A mask (height, width) without what is so close to its edge, or to that of the image."""
    kernel = np.ones((2 * margin + 1,) * 2, np.uint8)
    return opencv().erode(mask.astype(np.uint8), kernel, borderValue=0) > 0
