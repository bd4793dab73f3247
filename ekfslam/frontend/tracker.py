"""The tracker: features of a stereo pair, from frame to frame."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, replace

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.config import FrontEndConfig
from ekfslam.data.images import Image
from ekfslam.frontend.detect import corners, eroded, spread, without
from ekfslam.frontend.features import Features, Followed, follow
from ekfslam.frontend.flow import inside
from ekfslam.frontend.match import first_pairs
from ekfslam.frontend.rotation import RightRotation, correction
from ekfslam.frontend.template import Templates
from ekfslam.geometry import se3
from ekfslam.geometry.camera import StereoCamera, project, triangulate
from ekfslam.geometry.stereo_motion import Alignment, agrees, align, sampled_motion

LEAST_DISPARITY_PX = 0.5  # with less, a track has no depth to be predicted by
_LEAST_DEPTH_M = 0.1
_AGREE_SHARE = 0.5  # of the points, below which the motion is sampled anew
_FOUND_SHARE = 0.4  # of the features, below which another prediction is tried
_FEW = 0.5  # share of the wanted features, below which new ones do not wait
_L, _R = slice(0, 2), slice(2, 4)  # pixels of the left and the right image


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
        self._next_id = self._waited = 0
        self._hopeless = np.empty((0, 2))
        self._past: deque[tuple[IntArray, Array, Array, Array]] = deque(maxlen=config.rotation_gap)
        self._generator = np.random.default_rng(config.seed)

    def track(self, left: Image, right: Image, prediction: Array | None = None) -> Seen:
        """The next frame.

        Args:
            left, right: Rectified images (height, width).
            prediction: (4, 4) motion ``T_now_before`` of the camera; that of the last interval where None.
        """
        motion, reported = None, np.empty(0, dtype=bool)
        guess = self._motion if prediction is None else prediction
        if self._images is not None:
            rows = self._follow(left, right, prediction)
            motion, reported = self._agree(rows, guess)
            self._calibrate(reported, motion)
        fresh = self._refill(left, right)
        self._images, self._motion = (left, right), motion
        assert self._features is not None
        seen = self._features.keep(np.concatenate([reported, np.ones(fresh, dtype=bool)]))
        return Seen(seen.id, seen.left, seen.right, motion)

    def rows(self, features: Features) -> Array:
        """Rows (n, 3) of features, the rotation of the right camera taken out."""
        right = features.right + correction(self.camera, self.rotation.vector, features.right)
        v = 0.5 * (features.left[:, 1] + right[:, 1])
        return np.stack([features.left[:, 0], v, right[:, 0]], axis=1)

    def _follow(self, left: Image, right: Image, prediction: Array | None) -> Array:
        """Find the features in the new images, drop those that are lost; rows (n, 3) before of the others.

        Where most are lost, the prediction may be wrong: then the last motion is tried, and none.
        """
        before, config = self._features, self.config
        assert before is not None and self._images is not None
        rows = self.rows(before)
        best: tuple[Followed, BoolArray, dict[str, int]] | None = None
        guesses = [guess for guess in (prediction, self._motion) if guess is not None]
        for guess in (*guesses, None):
            levels = config.levels + (guess is None)
            expected = self._predicted(before, rows, np.eye(4) if guess is None else guess)
            now = follow(before, self._images, (left, right), expected, levels, config)
            kept, losses = self._tested(now, (left.shape[1], left.shape[0]))
            if best is None or kept.sum() > best[1].sum():
                best = now, kept, losses
            if kept.sum() >= _FOUND_SHARE * len(rows):
                break
        assert best is not None
        now, kept, losses = best
        self.losses.update(losses)
        self._features = replace(before, left=now.left, right=now.right).keep(kept)
        return rows[kept]

    def _tested(self, now: Followed, size: tuple[int, int]) -> tuple[BoolArray, dict[str, int]]:
        """Which features (n,) pass all tests, and how many fail, by the first test that they fail."""
        config, border = self.config, self.config.template // 2
        is_alike = (now.score_left >= config.template_score_left) & (now.score_right >= config.template_score_right)
        row_error = now.left[:, 1] - now.right[:, 1] - self.rotation.row_offset(now.left)
        tests = {
            "out of the left image": self._inside(0, now.left, size, border),
            "out of the right image": self._inside(1, now.right, size, border),
            "not found": now.is_found,
            "not found back": now.is_found_back,
            "unlike first sight": is_alike,
            "aligned too far": now.shift <= config.template_shift,
            "rows differ": np.abs(row_error) < config.row_limit,
            "no depth": now.left[:, 0] - now.right[:, 0] >= LEAST_DISPARITY_PX,
        }
        kept, losses = np.ones(len(row_error), dtype=bool), {}
        for reason, passes in tests.items():
            losses[reason] = int((kept & ~passes).sum())
            kept &= passes
        return kept, losses

    def _inside(self, side: int, pixels: Array, size: tuple[int, int], border: float) -> BoolArray:
        """Which pixels (n, 2) are where the left (0) or right (1) image shows something, off its border."""
        found = inside(pixels, size, border)
        if self._valid is not None:
            u, v = np.round(pixels[found]).astype(np.int64).T
            found[found] = self._valid[side][v, u]
        return found

    def _predicted(self, features: Features, rows: Array, T_now_before: Array) -> tuple[Array, Array]:
        """Pixels (n, 2) in the left and right image where features should be after a motion."""
        q = se3.apply(T_now_before, triangulate(self.camera, rows))
        is_ahead = q[:, 2:] > _LEAST_DEPTH_M
        z = project(self.camera, np.where(is_ahead, q, (0.0, 0.0, 1.0)))
        left, right = (np.where(is_ahead, z[:, at] - rows[:, to], 0.0) for at, to in ((_L, [0, 1]), (_R, [2, 1])))
        return features.left + left, features.right + right

    def _agree(self, rows: Array, guess: Array | None) -> tuple[Array, BoolArray]:
        """The rig's motion from rows (n, 3) before, and which features move with it; drop those that do not."""
        config, features = self.config, self._features
        assert features is not None
        found = self._aligned(rows, self.rows(features), guess)
        worst = np.abs(found.residual_px).max(axis=1, initial=0.0)
        is_still = worst <= config.residual_limit
        strikes = np.where(is_still, 0, features.strikes + 1)
        dropped = (worst > config.residual_drop) | (strikes >= config.strikes)
        self.losses["not moving as the rig"] += int(dropped.sum())
        self.withheld += int((~is_still & ~dropped).sum())
        self._features = replace(features, strikes=strikes).keep(~dropped)
        return found.T_now_before, is_still[~dropped]

    def _aligned(self, before: Array, now: Array, guess: Array | None) -> Alignment:
        """Rows of two frames brought together: from a guess, or where few agree, from the best of samples."""
        camera, config = self.camera, self.config
        if guess is not None:
            found = align(camera, before, now, guess, config.pixel_std, config.kernel)
            if agrees(found, config.residual_limit).sum() >= _AGREE_SHARE * len(now):
                return found
        start = sampled_motion(camera, before, now, self._generator, config.samples, config.residual_limit)
        return align(camera, before, now, start, config.pixel_std, config.kernel)

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
        waits = self._waited + 1 < config.refill_every and len(taken) >= _FEW * config.features
        if features is not None and (waits or len(taken) >= config.refill * config.features):
            self._waited += 1
            return 0
        self._waited = 0
        free = without(without(self._free(left), taken, config.spacing), self._hopeless, 1)
        found = corners(left, free, config)
        found = found[spread(found, taken, size, missing, (config.bucket_columns, config.bucket_rows))]
        paired, good = first_pairs(left, right, found, self.rotation.row_offset(found), config)
        good &= self._inside(1, paired, size, config.template // 2)
        self.refused += int((~good).sum())
        self._hopeless = found[~good]
        new = self._started(found[good], paired[good], left, right)
        if features is None:
            self.rotation.observe_rows(new.left, new.right)
        self._features = new if features is None else features.and_more(new)
        return len(new.id)

    def _free(self, image: Image) -> BoolArray:
        """Where features may be: (height, width)."""
        if self._valid is not None:
            return self._valid[0]
        margin = self.config.border
        free = np.zeros(image.shape, dtype=bool)
        free[margin:-margin, margin:-margin] = True
        return free

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
