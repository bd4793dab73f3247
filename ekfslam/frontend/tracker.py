"""The tracker: features of a stereo pair, from frame to frame."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, replace

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.data.images.pairs import Image
from ekfslam.frontend.config import FrontEndConfig
from ekfslam.frontend.detect import away_from, corners, eroded, spread
from ekfslam.frontend.flow import flow, inside, returns
from ekfslam.frontend.match import first_pairs
from ekfslam.frontend.rotation import RightRotation, correction
from ekfslam.frontend.template import Templates
from ekfslam.geometry import se3
from ekfslam.geometry.camera import StereoCamera, project, triangulate
from ekfslam.geometry.stereo_motion import Alignment, agrees, align, sampled_motion

LEAST_DISPARITY_PX = 0.5  # with less, a track has no depth to be predicted by
_AGREE_SHARE = 0.5  # of the points, below which the motion is sampled anew


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

    def keep(self, kept: Array) -> Features:
        """Some of them, by index or mask."""
        arrays = (self.id, self.left, self.right, self.disparity, self.strikes)
        return Features(*(array[kept] for array in arrays), self.patches_left.keep(kept), self.patches_right.keep(kept))

    def and_more(self, others: Features) -> Features:
        """These and others."""
        pairs = (
            (getattr(self, name), getattr(others, name)) for name in ("id", "left", "right", "disparity", "strikes")
        )
        return Features(
            *(np.concatenate(pair) for pair in pairs),
            self.patches_left.and_more(others.patches_left),
            self.patches_right.and_more(others.patches_right),
        )


@dataclass(frozen=True)
class Seen:
    """What a frame shows.

    Args:
        id: (n,) of the tracks that are reported.
        left, right: (n, 2) their pixels; right ones without the correction.
        T_now_before: (4, 4) motion of the camera since the frame before; None in the first one.
    """

    id: IntArray
    left: Array
    right: Array
    T_now_before: Array | None


class Tracker:
    """Features of rectified stereo images, one frame after the other.

    Args:
        camera: Of the rectified pair.
        config: Settings.
        valid: Of the left and the right image, which pixels (height, width) show something; None: all.

    Attributes:
        rotation: Of the right camera, as known so far.
        losses: How many tracks ended, by reason.
        withheld: Observations that did not move as the rig, and were not reported.
        refused: Corners that were no new feature.
    """

    def __init__(
        self, camera: StereoCamera, config: FrontEndConfig, valid: tuple[BoolArray, BoolArray] | None = None
    ) -> None:
        self.camera, self.config = camera, config
        self._valid = None if valid is None else tuple(eroded(mask, config.border) for mask in valid)
        self.rotation = RightRotation(camera, float(np.deg2rad(config.rotation_deg)), config.pixel_std)
        self.losses: Counter[str] = Counter()
        self.withheld, self.refused = 0, 0
        self._features: Features | None = None
        self._images: tuple[Image, Image] | None = None
        self._motion: Array | None = None
        self._next_id = 0
        self._hopeless = np.empty((0, 2))
        self._past: deque[tuple[IntArray, Array, Array, Array]] = deque(maxlen=config.rotation_gap)
        self._generator = np.random.default_rng(config.seed)

    def track(self, left: Image, right: Image, prediction: Array | None = None) -> Seen:
        """The next frame.

        Args:
            left, right: Rectified images (height, width).
            prediction: (4, 4) motion ``T_now_before`` of the camera; that of the last interval where None.
        """
        motion = None
        reported = np.empty(0, dtype=bool)
        if self._images is not None and self._features is not None:
            self._follow(left, right, prediction)
            motion, reported = self._agree(prediction)
            self._calibrate(reported, motion)
        fresh = self._refill(left, right)
        self._images = (left, right)
        features = self._features
        assert features is not None
        seen = np.concatenate([reported, np.ones(fresh, dtype=bool)])
        self._motion = motion
        return Seen(features.id[seen], features.left[seen], features.right[seen], motion)

    def rows(self, features: Features) -> Array:
        """Rows (n, 3) of features, the rotation of the right camera taken out."""
        right = features.right + correction(self.camera, self.rotation.vector, features.right)
        v = 0.5 * (features.left[:, 1] + right[:, 1])
        return np.stack([features.left[:, 0], v, right[:, 0]], axis=1)

    def _follow(self, left: Image, right: Image, prediction: Array | None) -> None:
        """Find the features in the new images; drop those that are lost."""
        config, before = self.config, self._features
        assert before is not None and self._images is not None
        self._rows_before = self.rows(before)
        motion = prediction if prediction is not None else self._motion
        levels = config.levels if motion is not None else config.levels + 1
        guess_left, guess_right = self._predicted(before, np.eye(4) if motion is None else motion)
        found, ok = flow(self._images[0], left, before.left, guess_left, config.window, levels)
        back = returns(self._images[0], left, before.left, found, config.window, config.backward_limit)
        # Where the left feature went beside its prediction, the right one did.
        seen, ok_right = flow(
            self._images[1], right, before.right, guess_right + (found - guess_left), config.window, 1
        )
        images = left.astype(np.float32), right.astype(np.float32)
        scale = np.clip((found[:, 0] - seen[:, 0]) / before.disparity, 0.25, 4.0)
        aligned_left, score_left = before.patches_left.align(images[0], found, scale)
        aligned_right, score_right = before.patches_right.align(images[1], seen, scale)
        shift = np.maximum(*(np.linalg.norm(a - b, axis=1) for a, b in ((aligned_left, found), (aligned_right, seen))))
        size, border = (left.shape[1], left.shape[0]), config.template // 2
        offset = self.rotation.row_offset(aligned_left)
        tests = {
            "out of the left image": self._inside(0, aligned_left, size, border),
            "out of the right image": self._inside(1, aligned_right, size, border),
            "not found": ok & ok_right,
            "not found back": back,
            "unlike first sight": (score_left >= config.template_score[0]) & (score_right >= config.template_score[1]),
            "aligned too far": shift <= config.template_shift,
            "rows differ": np.abs(aligned_left[:, 1] - aligned_right[:, 1] - offset) < config.row_limit,
            "no depth": aligned_left[:, 0] - aligned_right[:, 0] >= LEAST_DISPARITY_PX,
        }
        kept = np.ones(len(found), dtype=bool)
        for reason, passes in tests.items():
            self.losses[reason] += int((kept & ~passes).sum())
            kept &= passes
        self._rows_before = self._rows_before[kept]
        self._features = replace(before, left=aligned_left, right=aligned_right).keep(kept)

    def _inside(self, side: int, pixels: Array, size: tuple[int, int], border: float) -> BoolArray:
        """Which pixels (n, 2) are where the left (0) or right (1) image shows something, off its border."""
        found = inside(pixels, size, border)
        if self._valid is not None:
            u, v = np.round(pixels[found]).astype(np.int64).T
            found[found] = self._valid[side][v, u]
        return found

    def _predicted(self, features: Features, T_now_before: Array) -> tuple[Array, Array]:
        """Pixels (n, 2) in the left and right image where features should be after a motion."""
        q = se3.apply(T_now_before, triangulate(self.camera, self._rows_before))
        ahead = q[:, 2] > 0.5
        z = project(self.camera, np.where(ahead[:, None], q, (0.0, 0.0, 1.0)))
        left = np.where(ahead[:, None], z[:, :2], features.left)
        moved = left - np.stack([self._rows_before[:, 0], self._rows_before[:, 1]], axis=1)
        right = np.where(ahead[:, None], z[:, 2:] - self._rows_before[:, [2, 1]], moved) + features.right
        return features.left + moved, right

    def _agree(self, prediction: Array | None) -> tuple[Array, BoolArray]:
        """The rig's motion, and which features move with it; drop those that do not for too long."""
        config, features = self.config, self._features
        assert features is not None
        now = self.rows(features)
        found = self._aligned(now, prediction if prediction is not None else self._motion)
        worst = np.abs(found.residual_px).max(axis=1, initial=0.0)
        still = worst <= config.residual_limit
        strikes = np.where(still, 0, features.strikes + 1)
        dropped = (worst > config.residual_drop) | (strikes >= config.strikes)
        self.losses["not moving as the rig"] += int(dropped.sum())
        self.withheld += int((~still & ~dropped).sum())
        self._features = replace(features, strikes=strikes).keep(~dropped)
        return found.T_now_before, still[~dropped]

    def _aligned(self, now: Array, guess: Array | None) -> Alignment:
        config, before = self.config, self._rows_before
        if guess is not None:
            found = align(self.camera, before, now, guess, config.pixel_std, config.kernel)
            if agrees(found, config.residual_limit).mean() >= _AGREE_SHARE:
                return found
        start = sampled_motion(self.camera, before, now, self._generator, config.samples, config.residual_limit)
        return align(self.camera, before, now, start, config.pixel_std, config.kernel)

    def _calibrate(self, reported: BoolArray, T_now_before: Array) -> None:
        """Learn the rotation of the right camera from this frame, and from this one and one some frames before."""
        assert self._features is not None
        features = self._features.keep(reported)
        self.rotation.observe_rows(features.left, features.right)
        past = [(ids, left, right, T_now_before @ T) for ids, left, right, T in self._past]
        self._past = deque(past, maxlen=self.config.rotation_gap)
        if len(past) == self.config.rotation_gap:
            ids, left, right, T = past[0]
            _, i, j = np.intersect1d(ids, features.id, assume_unique=True, return_indices=True)
            then = replace(features.keep(j), left=left[i], right=right[i])
            before, now = self.rows(then), self.rows(features.keep(j))
            if len(i):
                found = align(self.camera, before, now, T, self.config.pixel_std, self.config.kernel)
                self.rotation.observe_motion(found, before, now)
        self._past.append((features.id, features.left, features.right, np.eye(4)))

    def _refill(self, left: Image, right: Image) -> int:
        """Look for new features where there are too few; how many were found."""
        config, features = self.config, self._features
        taken = np.empty((0, 2)) if features is None else features.left
        missing, size = config.features - len(taken), (left.shape[1], left.shape[0])
        if features is not None and len(taken) >= config.refill * config.features:
            return 0
        found, _ = corners(left, config)
        found = found[away_from(found, taken, config.spacing) & away_from(found, self._hopeless, 2.0)]
        found = found[self._inside(0, found, size, config.border)]
        found = found[spread(found, taken, size, missing, config.buckets)]
        paired, good = first_pairs(left, right, found, self.rotation.row_offset(found), config)
        good &= self._inside(1, paired, size, config.template // 2)
        self.refused += int((~good).sum())
        self._hopeless = found[~good]
        new = self._started(found[good], paired[good], left, right)
        if features is None:
            self.rotation.observe_rows(new.left, new.right)
        self._features = new if features is None else features.and_more(new)
        return len(new.id)

    def _started(self, left_px: Array, right_px: Array, left: Image, right: Image) -> Features:
        count, side = len(left_px), self.config.template
        ids = self._next_id + np.arange(count)
        self._next_id += count
        return Features(
            ids,
            left_px,
            right_px,
            left_px[:, 0] - right_px[:, 0],
            np.zeros(count, dtype=np.int64),
            Templates.of(left.astype(np.float32), left_px, side),
            Templates.of(right.astype(np.float32), right_px, side),
        )
