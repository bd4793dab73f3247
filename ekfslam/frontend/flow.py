"""Optical flow: features from one image to another, there and back."""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array, BoolArray
from ekfslam.data.images import Image
from ekfslam.frontend.opencv import opencv

_WINDOW = 15  # side, px
_STEPS, _LEAST_STEP_PX, _LEAST_EIGENVALUE = 30, 0.01, 1e-4
_RETURN_PX = 0.7  # largest error of a feature that is tracked there and back


def flow(source: Image, target: Image, pixels: Array, guess: Array, levels: int) -> tuple[Array, BoolArray]:
    """Return features (n, 2) of the source in the target from a ``guess``, and which are found (Bouguet 2001)."""
    if not len(pixels):
        return np.empty((0, 2)), np.empty(0, dtype=bool)
    cv2 = opencv()
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        source,
        target,
        pixels.astype(np.float32).reshape(-1, 1, 2),
        guess.astype(np.float32).reshape(-1, 1, 2).copy(),
        winSize=(_WINDOW, _WINDOW),
        maxLevel=levels - 1,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, _STEPS, _LEAST_STEP_PX),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=_LEAST_EIGENVALUE,
    )
    found = found.reshape(-1, 2).astype(float)
    return found, (status.ravel() == 1) & np.isfinite(found).all(axis=1)


def returns(source: Image, target: Image, pixels: Array, found: Array) -> BoolArray:
    """Return whether (n,) features found (n, 2) in the target lead back to their pixels (n, 2) in the source."""
    back, status = flow(target, source, found, pixels, 1)
    return status & (np.linalg.norm(back - pixels, axis=1) < _RETURN_PX)


def inside(pixels: Array, size: tuple[int, int], border: float) -> BoolArray:
    """Return whether (n,) pixels (n, 2) are in an image of a width and height, and this far from its border."""
    return np.all((pixels >= border) & (pixels <= np.array(size) - 1 - border), axis=1)
