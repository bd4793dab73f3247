"""Tracked features, and how they are found in the next pair of images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.data.images import Image
from ekfslam.frontend.flow import flow, returns
from ekfslam.frontend.template import Greys, Rows, Templates


@dataclass(frozen=True)
class Features(Rows):
    """Tracked features."""

    id: IntArray  # (n,) ids of the tracks
    left: Array  # left, right: (n, 2) pixels, without the correction of the right camera's rotation
    right: Array
    strikes: IntArray  # (n,) number of frames in a row in which a feature did not move as the rig
    shape_left: Array  # shape_left, shape_right: (n, 2, 2) shapes of these patches in the images
    shape_right: Array
    patches_left: Templates  # patches_left, patches_right: patches of first sight
    patches_right: Templates


@dataclass(frozen=True)
class Followed:
    """Features in the next images."""

    left: Array  # left, right: (n, 2) pixels, aligned to the patches of first sight
    right: Array
    shape_left: Array  # shape_left, shape_right: (n, 2, 2) shapes of these patches
    shape_right: Array
    is_found: BoolArray  # is_found, is_found_back: (n,) whether optical flow found a feature, and its way back
    is_found_back: BoolArray
    score_left: Array  # score_left, score_right: (n,) correlation with first sight
    score_right: Array
    shift: Array  # (n,) shift by the alignment, px


def follow(
    features: Features,
    before: tuple[Image, Image],
    greys: tuple[Greys, Greys],
    guess: tuple[Array, Array],
    levels: int,
) -> Followed:
    """Find features in the next pair of images, given guesses of their pixels (n, 2) in both.

    Optical flow finds them in the left image, on some levels of the pyramid, and the way back. The right feature is
    sought at its guess, shifted by the error of the left one. Both are then aligned to the patches of first sight.
    """
    now = greys[0].image, greys[1].image
    found, is_found = flow(before[0], now[0], features.left, guess[0], levels)
    back = returns(before[0], now[0], features.left, found)
    seen, is_seen = flow(before[1], now[1], features.right, guess[1] + (found - guess[0]), 1)
    left, shape_left, score_left = features.patches_left.align(greys[0], found, features.shape_left)
    right, shape_right, score_right = features.patches_right.align(greys[1], seen, features.shape_right)
    shift = np.maximum(np.linalg.norm(left - found, axis=1), np.linalg.norm(right - seen, axis=1))
    return Followed(left, right, shape_left, shape_right, is_found & is_seen, back, score_left, score_right, shift)
