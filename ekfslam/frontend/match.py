"""The first disparity of a feature: its patch sought along the row of the right image."""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array, BoolArray
from ekfslam.config import FrontEndConfig
from ekfslam.data.images import Image
from ekfslam.frontend.flow import flow, inside, returns
from ekfslam.frontend.opencv import opencv
from ekfslam.frontend.template import SIDE

ROW_LIMIT_PX = 1.0  # largest row difference of a pair, after the rotation of the right camera is taken out
_PATCH = 11  # side of the patch that is sought along the row, px
_LEAST_SCORE = 0.75  # normalised cross-correlation of a match
_LEAST_MARGIN = 0.03  # to the second best


def match_along_row(
    left: Image, right: Image, pixels: Array, row_offset: Array, config: FrontEndConfig
) -> tuple[Array, BoolArray]:
    """Return features (n, 2) of the left image in the right one, to a pixel, and whether (n,) they are good and unique.

    ``row_offset`` (n,) is ``vL - vR`` due to the rotation of the right camera.
    """
    cv2, half = opencv(), _PATCH // 2
    found, good = pixels.copy(), np.zeros(len(pixels), dtype=bool)
    corner = np.round(pixels).astype(np.int64)
    rows = np.round(pixels[:, 1] - row_offset).astype(np.int64)
    for i, ((u, v), row) in enumerate(zip(corner.tolist(), rows.tolist(), strict=True)):
        begin = max(u - half - int(config.max_disparity), 0)
        patch = left[v - half : v + half + 1, u - half : u + half + 1]
        strip = right[max(row - half, 0) : row + half + 1, begin : u + half + 1]
        if u < half or patch.shape != (_PATCH, _PATCH) or strip.shape[0] != _PATCH:
            continue
        score = cv2.matchTemplate(strip, patch, cv2.TM_CCOEFF_NORMED)[0]
        best = int(np.argmax(score))
        found[i, 0] += begin + best + half - u
        found[i, 1] -= row_offset[i]
        # The second best overlaps less than half of the best one.
        second = max(score[: max(best - half, 0)].max(initial=-1.0), score[best + half + 1 :].max(initial=-1.0))
        good[i] = score[best] >= _LEAST_SCORE and score[best] > second + _LEAST_MARGIN
    return found, good


def first_pairs(
    left: Image, right: Image, pixels: Array, row_offset: Array, config: FrontEndConfig
) -> tuple[Array, BoolArray]:
    """Return `match_along_row` to a fraction of a pixel, and whether (n,) the pixels can be trusted."""
    found, good = match_along_row(left, right, pixels, row_offset, config)
    refined = found.copy()
    refined[good], status = flow(left, right, pixels[good], found[good], 1)
    good[good] = status
    good[good] = returns(left, right, pixels[good], refined[good])
    good &= inside(refined, (right.shape[1], right.shape[0]), SIDE // 2)
    good &= np.abs(pixels[:, 1] - refined[:, 1] - row_offset) < ROW_LIMIT_PX
    good &= pixels[:, 0] - refined[:, 0] >= config.min_disparity
    return refined, good
