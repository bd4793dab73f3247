"""New features: corners, spread over the image."""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.data.images.pairs import Image
from ekfslam.frontend.config import FrontEndConfig
from ekfslam.frontend.opencv import opencv


def corners(image: Image, config: FrontEndConfig) -> tuple[Array, Array]:
    """Corners by the smaller eigenvalue of the structure tensor (Shi and Tomasi, CVPR 1994), strongest first.

    Returns:
        Pixels (n, 2) and eigenvalues (n,).
    """
    cv2 = opencv()
    response = cv2.cornerMinEigenVal(image, config.corner_block)
    largest = cv2.dilate(response, np.ones((config.spacing + 1, config.spacing + 1), np.uint8))
    is_corner = (response == largest) & (response > config.corner_quality * float(response.max()))
    margin = np.zeros(image.shape, dtype=bool)
    margin[config.border : -config.border, config.border : -config.border] = True
    v, u = np.nonzero(is_corner & margin)
    order = np.argsort(-response[v, u], kind="stable")
    return np.stack([u, v], axis=1)[order].astype(float), response[v, u][order].astype(float)


def away_from(found: Array, taken: Array, distance: float) -> BoolArray:
    """Which pixels (n, 2) are at least so far from all pixels (m, 2): (n,) truth values."""
    if not len(taken):
        return np.ones(len(found), dtype=bool)
    squared = (found**2).sum(axis=1)[:, None] - 2.0 * found @ taken.T + (taken**2).sum(axis=1)
    return squared.min(axis=1) >= distance**2


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
