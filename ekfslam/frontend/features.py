"""What is tracked, and how it is found again in the next pair of images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.config import FrontEndConfig
from ekfslam.data.images import Image
from ekfslam.frontend.flow import flow, returns
from ekfslam.frontend.template import Templates

_SCALES = 0.25, 4.0  # of a patch, that are sampled


@dataclass(frozen=True)
class Features:
    """What is tracked.

    Args:
        id: (n,) of the tracks.
        left, right: (n, 2) pixels, right ones as seen, without the correction of the camera's rotation.
        disparity: (n,) at first sight.
        strikes: (n,) how many frames in a row they did not move as the rig.
        patches_left, patches_right: Of first sight.
    """

    id: IntArray
    left: Array
    right: Array
    disparity: Array
    strikes: IntArray
    patches_left: Templates
    patches_right: Templates

    def keep(self, kept: IntArray | BoolArray) -> Features:
        """Some of them, by index or mask."""
        return Features(
            self.id[kept],
            self.left[kept],
            self.right[kept],
            self.disparity[kept],
            self.strikes[kept],
            self.patches_left.keep(kept),
            self.patches_right.keep(kept),
        )

    def and_more(self, others: Features) -> Features:
        """These and others."""
        return Features(
            np.concatenate([self.id, others.id]),
            np.concatenate([self.left, others.left]),
            np.concatenate([self.right, others.right]),
            np.concatenate([self.disparity, others.disparity]),
            np.concatenate([self.strikes, others.strikes]),
            self.patches_left.and_more(others.patches_left),
            self.patches_right.and_more(others.patches_right),
        )


@dataclass(frozen=True)
class Followed:
    """Where features are in the next images.

    Args:
        left, right: (n, 2) pixels, aligned to the patches of first sight.
        is_found, is_found_back: (n,) by optical flow, and by it the way back.
        score_left, score_right: (n,) correlation with first sight.
        shift: (n,) how far the alignment moved them, px.
    """

    left: Array
    right: Array
    is_found: BoolArray
    is_found_back: BoolArray
    score_left: Array
    score_right: Array
    shift: Array


def follow(
    features: Features,
    before: tuple[Image, Image],
    now: tuple[Image, Image],
    guess: tuple[Array, Array],
    levels: int,
    config: FrontEndConfig,
) -> Followed:
    """Find features in the next pair of images.

    Optical flow finds them in the left image, and the way back; where a left feature went beside its prediction, the
    right one did, and flow on the finest level finds it. Both are then aligned to the patches of first sight.

    Args:
        features: As they are in the images before.
        before, now: Left and right images.
        guess: (n, 2) pixels where they should be in both images now.
        levels: Of the pyramid in the left image.
        config: Settings.
    """
    found, is_found = flow(before[0], now[0], features.left, guess[0], config.window, levels)
    back = returns(before[0], now[0], features.left, found, config.window, config.backward_limit)
    seen, is_seen = flow(before[1], now[1], features.right, guess[1] + (found - guess[0]), config.window, 1)
    scale = np.clip((found[:, 0] - seen[:, 0]) / features.disparity, *_SCALES)
    left, score_left = features.patches_left.align(now[0].astype(np.float32), found, scale)
    right, score_right = features.patches_right.align(now[1].astype(np.float32), seen, scale)
    shift = np.maximum(np.linalg.norm(left - found, axis=1), np.linalg.norm(right - seen, axis=1))
    return Followed(left, right, is_found & is_seen, back, score_left, score_right, shift)
