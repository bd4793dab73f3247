"""Optical flow: features from one image to another, there and back."""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array, BoolArray
from ekfslam.data.images import Image
from ekfslam.frontend.opencv import opencv

_STEPS, _LEAST_STEP_PX, _LEAST_EIGENVALUE = 30, 0.01, 1e-4


def flow(
    source: Image, target: Image, pixels: Array, guess: Array, window: int, levels: int
) -> tuple[Array, BoolArray]:
    """Pyramidal Lucas-Kanade (Bouguet, "Pyramidal implementation of the Lucas Kanade feature tracker", 2001).

    Args:
        source, target: Images.
        pixels: (n, 2) features of the source.
        guess: (n, 2) where they may be in the target.
        window: Side of the window, px.
        levels: Of the pyramid; 1 is the image alone.

    Returns:
        Pixels (n, 2) in the target, and whether they were found (n,).
    """
    if not len(pixels):
        return np.empty((0, 2)), np.empty(0, dtype=bool)
    cv2 = opencv()
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        source,
        target,
        pixels.astype(np.float32).reshape(-1, 1, 2),
        guess.astype(np.float32).reshape(-1, 1, 2).copy(),
        winSize=(window, window),
        maxLevel=levels - 1,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, _STEPS, _LEAST_STEP_PX),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=_LEAST_EIGENVALUE,
    )
    found = found.reshape(-1, 2).astype(float)
    return found, (status.ravel() == 1) & np.isfinite(found).all(axis=1)


def returns(source: Image, target: Image, pixels: Array, found: Array, window: int, limit_px: float) -> BoolArray:
    """Whether features (n, 2) found in the target lead back to where they come from."""
    back, status = flow(target, source, found, pixels, window, 1)
    return status & (np.linalg.norm(back - pixels, axis=1) < limit_px)


def inside(pixels: Array, size: tuple[int, int], border: float) -> BoolArray:
    """Which pixels (n, 2) are in an image of this width and height, and so far from its border."""
    return np.all((pixels >= border) & (pixels <= np.array(size) - 1 - border), axis=1)
