"""The tracker: it follows features of a stereo pair from frame to frame."""

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
from ekfslam.frontend.match import ROW_LIMIT_PX, first_pairs
from ekfslam.frontend.rotation import RightRotation, correction
from ekfslam.frontend.template import SIDE, Greys, Templates
from ekfslam.geometry import se3
from ekfslam.geometry.camera import DEPTH_FROM_PX, StereoCamera, project, triangulate
from ekfslam.geometry.stereo_motion import Alignment, agrees, align, sampled_motion

_LEAST_DEPTH_M = 0.1
_AGREE_SHARE = 0.5  # of the points, below which the motion is sampled again
_FOUND_SHARE = 0.4  # of the features, below which another prediction is tried
_REFILL_SHARE = 0.9  # of the wanted features, below which new ones are detected
_REFILL_EVERY = 2  # frames; at once if fewer than `_FEW` of the wanted features are left
_FEW = 0.5
_BORDER = 9  # least distance of a feature from the border of the image, px
_LEAST_SCORES = 0.9, 0.8  # correlation with first sight, left and right: contrasts of three and two times the noise
_LARGEST_SHIFT_PX = 2.0  # by the alignment to first sight
_KERNEL = 2.0  # scale of the robust kernel of the motion, in standard deviations
_RESIDUAL_PX = 2.0  # observations with larger residuals are not reported
_STRIKES = 2  # such observations in a row after which a feature is dropped
_DROP_PX = 10.0  # residual with which a feature is dropped at once
_SAMPLES = 200  # of three points each, if the motion is unknown
_ROTATION_GAP = 4  # frames between the two frames that show yaw
_L, _R = slice(0, 2), slice(2, 4)  # pixels of the left and the right image


@dataclass(frozen=True)
class Seen:
    """Reported features of a frame (ids, pixels as seen), and the motion (4, 4) of the camera before it, if known."""

    id: IntArray
    left: Array
    right: Array
    T_now_before: Array | None


class Tracker:
    """Tracker of features in rectified stereo images, frame after frame.

    ``valid`` are masks (height, width) of the pixels of both images that show something; None for all. Attributes are
    the present estimate ``rotation`` of the right camera, and the counts ``losses``, ``withheld`` and ``refused`` of
    `TrackReport`.
    """

    def __init__(
        self, camera: StereoCamera, config: FrontEndConfig, valid: tuple[BoolArray, ...] | None = None
    ) -> None:
        self.camera, self.config = camera, config
        self._valid = None if valid is None else tuple(eroded(mask, _BORDER) for mask in valid)
        self.rotation = RightRotation(camera, float(np.deg2rad(config.rotation_deg)), config.pixel_std)
        self.losses: Counter[str] = Counter()
        self.withheld, self.refused = 0, 0
        self._features: Features | None = None
        self._images: tuple[Image, Image] | None = None
        self._motion: Array | None = None
        self._next_id = self._waited = 0
        self._hopeless = np.empty((0, 2))
        self._past: deque[tuple[IntArray, Array, Array, Array]] = deque(maxlen=_ROTATION_GAP)
        self._generator = np.random.default_rng(config.seed)

    def track(self, left: Image, right: Image, prediction: Array | None = None) -> Seen:
        """Track the next frame of rectified images, predicted by a motion ``T_now_before``, by default the last one."""
        greys = Greys(left), Greys(right)
        motion, reported = None, np.empty(0, dtype=bool)
        guess = self._motion if prediction is None else prediction
        if self._images is not None:
            rows = self._follow(greys, prediction)
            motion, reported = self._agree(rows, guess)
            self._calibrate(reported, motion)
        fresh = self._refill(*greys)
        self._images, self._motion = (left, right), motion
        assert self._features is not None
        seen = self._features.keep(np.concatenate([reported, np.ones(fresh, dtype=bool)]))
        return Seen(seen.id, seen.left, seen.right, motion)

    def rows(self, features: Features) -> Array:
        """Return the rows (n, 3) of features, corrected by the rotation of the right camera."""
        right = features.right + correction(self.camera, self.rotation.vector, features.right)
        v = 0.5 * (features.left[:, 1] + right[:, 1])
        return np.stack([features.left[:, 0], v, right[:, 0]], axis=1)

    def _follow(self, greys: tuple[Greys, Greys], prediction: Array | None) -> Array:
        """Find the features in the new images, drop lost ones, and return the rows (n, 3) before of the others.

        If most are lost, the prediction may be wrong: then the last motion is tried, and no motion.
        """
        before, config = self._features, self.config
        assert before is not None and self._images is not None
        rows = self.rows(before)
        best: tuple[Followed, BoolArray, dict[str, int]] | None = None
        guesses = [guess for guess in (prediction, self._motion) if guess is not None]
        for guess in (*guesses, None):
            levels = config.levels + (guess is None)
            expected = self._predicted(before, rows, np.eye(4) if guess is None else guess)
            now = follow(before, self._images, greys, expected, levels)
            kept, losses = self._tested(now, greys[0].image.shape[1::-1])
            if best is None or kept.sum() > best[1].sum():
                best = now, kept, losses
            if kept.sum() >= _FOUND_SHARE * len(rows):
                break
        assert best is not None
        now, kept, losses = best
        self.losses.update(losses)
        names = "left", "right", "shape_left", "shape_right"
        self._features = replace(before, **{name: getattr(now, name) for name in names}).keep(kept)
        return rows[kept]

    def _tested(self, now: Followed, size: tuple[int, int]) -> tuple[BoolArray, dict[str, int]]:
        """Return whether (n,) features pass all tests, and the number that fails each test first."""
        row_error = now.left[:, 1] - now.right[:, 1] - self.rotation.row_offset(now.left)
        tests = {
            "out of the left image": self._inside(0, now.left, size, SIDE // 2),
            "out of the right image": self._inside(1, now.right, size, SIDE // 2),
            "not found": now.is_found,
            "not found back": now.is_found_back,
            "unlike first sight": (now.score_left >= _LEAST_SCORES[0]) & (now.score_right >= _LEAST_SCORES[1]),
            "aligned too far": now.shift <= _LARGEST_SHIFT_PX,
            "rows differ": np.abs(row_error) < ROW_LIMIT_PX,
            "no depth": now.left[:, 0] - now.right[:, 0] >= DEPTH_FROM_PX,
        }
        kept, losses = np.ones(len(row_error), dtype=bool), {}
        for reason, passes in tests.items():
            losses[reason] = int((kept & ~passes).sum())
            kept &= passes
        return kept, losses

    def _inside(self, side: int, pixels: Array, size: tuple[int, int], border: float) -> BoolArray:
        """Return whether (n,) the left (0) or right (1) image shows something at pixels (n, 2), off its border."""
        found = inside(pixels, size, border)
        if self._valid is not None:
            u, v = np.round(pixels[found]).astype(np.int64).T
            found[found] = self._valid[side][v, u]
        return found

    def _predicted(self, features: Features, rows: Array, T_now_before: Array) -> tuple[Array, Array]:
        """Return the predicted pixels (n, 2) of features in the left and right image after a motion."""
        q = se3.apply(T_now_before, triangulate(self.camera, rows))
        is_ahead = q[:, 2:] > _LEAST_DEPTH_M
        z = project(self.camera, np.where(is_ahead, q, (0.0, 0.0, 1.0)))
        left, right = (np.where(is_ahead, z[:, at] - rows[:, to], 0.0) for at, to in ((_L, [0, 1]), (_R, [2, 1])))
        return features.left + left, features.right + right

    def _agree(self, rows: Array, guess: Array | None) -> tuple[Array, BoolArray]:
        """Return the motion of the rig from rows (n, 3) before, and whether features move with it; drop outliers."""
        features = self._features
        assert features is not None
        found = self._aligned(rows, self.rows(features), guess)
        worst = np.abs(found.residual_px).max(axis=1, initial=0.0)
        is_still = worst <= _RESIDUAL_PX
        strikes = np.where(is_still, 0, features.strikes + 1)
        dropped = (worst > _DROP_PX) | (strikes >= _STRIKES)
        self.losses["not moving as the rig"] += int(dropped.sum())
        self.withheld += int((~is_still & ~dropped).sum())
        self._features = replace(features, strikes=strikes).keep(~dropped)
        return found.T_now_before, is_still[~dropped]

    def _aligned(self, before: Array, now: Array, guess: Array | None) -> Alignment:
        """Align the rows of two frames: from a guess or, if few agree with it, from the best of samples."""
        camera, config = self.camera, self.config
        if guess is not None:
            found = align(camera, before, now, guess, config.pixel_std, _KERNEL)
            if agrees(found, _RESIDUAL_PX).sum() >= _AGREE_SHARE * len(now):
                return found
        start = sampled_motion(camera, before, now, self._generator, _SAMPLES, _RESIDUAL_PX)
        return align(camera, before, now, start, config.pixel_std, _KERNEL)

    def _calibrate(self, reported: BoolArray, T_now_before: Array) -> None:
        """Update the rotation of the right camera from this frame, and from its motion since an earlier one."""
        assert self._features is not None
        features = self._features.keep(reported)
        self.rotation.observe_rows(features.left, features.right)
        past = [(ids, left, right, T_now_before @ T) for ids, left, right, T in self._past]
        self._past = deque(past, maxlen=_ROTATION_GAP)
        if len(past) == _ROTATION_GAP:
            ids, left, right, T = past[0]
            _, i, j = np.intersect1d(ids, features.id, assume_unique=True, return_indices=True)
            then = replace(features.keep(j), left=left[i], right=right[i])
            before, now = self.rows(then), self.rows(features.keep(j))
            if len(i):
                found = align(self.camera, before, now, T, self.config.pixel_std, _KERNEL)
                self.rotation.observe_motion(found, before, now)
        self._past.append((features.id, features.left, features.right, np.eye(4)))

    def _refill(self, left_greys: Greys, right_greys: Greys) -> int:
        """Detect new features if there are too few, and return their number."""
        config, features = self.config, self._features
        left, right = left_greys.image, right_greys.image
        taken = np.empty((0, 2)) if features is None else features.left
        missing, size = config.features - len(taken), (left.shape[1], left.shape[0])
        waits = self._waited + 1 < _REFILL_EVERY and len(taken) >= _FEW * config.features
        if features is not None and (waits or len(taken) >= _REFILL_SHARE * config.features):
            self._waited += 1
            return 0
        self._waited = 0
        free = without(without(self._free(left), taken, config.spacing), self._hopeless, 1)
        found = corners(left, free, config.spacing)
        found = found[spread(found, taken, size, missing)]
        paired, good = first_pairs(left, right, found, self.rotation.row_offset(found), config)
        good &= self._inside(1, paired, size, SIDE // 2)
        self.refused += int((~good).sum())
        self._hopeless = found[~good]
        new = self._started(found[good], paired[good], left_greys, right_greys)
        if features is None:
            self.rotation.observe_rows(new.left, new.right)
        self._features = new if features is None else features.and_more(new)
        return len(new.id)

    def _free(self, image: Image) -> BoolArray:
        """Return the mask (height, width) of pixels at which features may be."""
        if self._valid is not None:
            return self._valid[0]
        free = np.zeros(image.shape, dtype=bool)
        free[_BORDER:-_BORDER, _BORDER:-_BORDER] = True
        return free

    def _started(self, left_px: Array, right_px: Array, left: Greys, right: Greys) -> Features:
        count = len(left_px)
        ids = self._next_id + np.arange(count)
        self._next_id += count
        patches = Templates.of(left, left_px)
        refined, _, score = patches.align(right, right_px, patches.shape)
        good = (score >= _LEAST_SCORES[1]) & (np.abs(refined - right_px).max(axis=1) <= _LARGEST_SHIFT_PX)
        right_px = np.where(good[:, None], refined, right_px)
        others = Templates.of(right, right_px, patches.is_coarse)
        strikes = np.zeros(count, dtype=np.int64)
        return Features(ids, left_px, right_px, strikes, patches.shape, others.shape, patches, others)
