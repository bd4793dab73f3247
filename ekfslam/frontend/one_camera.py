"""The tracker of one camera: corners followed from frame to frame.

Optical flow goes there and back, from where the gyroscope (or measured rates) turns each feature. Features that do not
fit the epipolar geometry of the others (RANSAC on the fundamental matrix) end. Errors add up from frame to frame: they
walk, and `ekfslam.models.track_noise` finds how far.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.config import FrontEndConfig
from ekfslam.data.images import Image
from ekfslam.frontend.detect import corners, eroded, spread, without
from ekfslam.frontend.flow import flow, inside, returns
from ekfslam.frontend.opencv import opencv
from ekfslam.geometry.camera import StereoCamera

_BORDER = 9  # least distance of a feature from the border of the image, px
_FOUND_SHARE = 0.5  # of the features, below which the flow is sought over more levels
_REFILL_SHARE = 0.8  # of the wanted features, below which new ones are detected
_EPIPOLAR_PX, _SURE, _LEAST = 1.0, 0.999, 15  # distance and confidence of RANSAC, features


class OneCameraTracker:
    """Tracker of features in undistorted images of one camera, frame after frame.

    ``valid`` is a mask (height, width) of the pixels that show something; None for all. ``losses`` counts tracks that
    ended, by reason.
    """

    def __init__(self, camera: StereoCamera, config: FrontEndConfig, valid: BoolArray | None = None) -> None:
        self.camera, self.config = camera, config
        self._valid = None if valid is None else eroded(valid, _BORDER)
        self.losses: Counter[str] = Counter()
        self._image: Image | None = None
        self._ids, self._pixels, self._before = np.empty(0, dtype=np.int64), np.empty((0, 2)), np.empty((0, 2))
        self._next_id = 0

    def track(self, image: Image, turn: Array | None = None) -> tuple[IntArray, Array]:
        """Return ids (n,) and pixels (n, 2) of the features of the next frame.

        Args:
            image: Undistorted image.
            turn: (3, 3) rotation of directions, from the camera of the frame before to the present one; None: unknown.
        """
        if self._image is not None:
            self._follow(self._image, image, turn)
        self._refill(image)
        self._image = image
        return self._ids, self._pixels

    def _follow(self, before: Image, now: Image, turn: Array | None) -> None:
        guess = self._pixels if turn is None else self._turned(turn)
        levels = self.config.levels + (turn is None)
        found, is_found = flow(before, now, self._pixels, guess, levels)
        if is_found.sum() < _FOUND_SHARE * len(is_found):
            found, is_found = flow(before, now, self._pixels, self._pixels, levels + 2)
        self._keep("not found", is_found, found)
        self._keep("not found back", returns(before, now, self._before, self._pixels))
        self._keep("out of the image", self._inside(self._pixels, now))
        self._keep("not moving as the scene", _agrees(self._before, self._pixels))

    def _keep(self, reason: str, kept: BoolArray, pixels: Array | None = None) -> None:
        """Keep features; those that are lost are counted. If their pixels (n, 2) are given, they are the new ones."""
        if pixels is not None:
            self._before, self._pixels = self._pixels, pixels
        self.losses[reason] += int((~kept).sum())
        self._ids, self._before, self._pixels = self._ids[kept], self._before[kept], self._pixels[kept]

    def _turned(self, turn: Array) -> Array:
        """Return where a rotation of the camera moves its features."""
        focal = np.array([self.camera.fu_px, self.camera.fv_px])
        centre = np.array([self.camera.cu_px, self.camera.cv_px])
        rays = np.hstack([(self._pixels - centre) / focal, np.ones((len(self._pixels), 1))]) @ turn.T
        ahead = rays[:, 2:] > 0.1
        return np.where(ahead, rays[:, :2] / np.where(ahead, rays[:, 2:], 1.0) * focal + centre, self._pixels)

    def _inside(self, pixels: Array, image: Image) -> BoolArray:
        found = inside(pixels, (image.shape[1], image.shape[0]), _BORDER)
        if self._valid is not None:
            u, v = np.round(pixels[found]).astype(np.int64).T
            found[found] = self._valid[v, u]
        return found

    def _refill(self, image: Image) -> None:
        """Detect new features if there are too few."""
        wanted = self.config.features - len(self._ids)
        if len(self._ids) > _REFILL_SHARE * self.config.features:
            return
        free = np.zeros(image.shape, dtype=bool)
        free[_BORDER:-_BORDER, _BORDER:-_BORDER] = True
        free = without(free if self._valid is None else free & self._valid, self._pixels, self.config.spacing)
        found = corners(image, free, self.config.spacing)
        found = found[spread(found, self._pixels, (image.shape[1], image.shape[0]), wanted)]
        ids = np.arange(self._next_id, self._next_id + len(found))
        self._next_id += len(found)
        self._ids, self._pixels = np.concatenate([self._ids, ids]), np.vstack([self._pixels, found])


def _agrees(before: Array, now: Array) -> BoolArray:
    """Return whether (n,) features fit the epipolar geometry of most; all, if they are few or fit none."""
    if len(now) < _LEAST:
        return np.ones(len(now), dtype=bool)
    cv2 = opencv()
    F, mask = cv2.findFundamentalMat(before, now, cv2.FM_RANSAC, _EPIPOLAR_PX, _SURE)
    return np.ones(len(now), dtype=bool) if F is None or mask is None else mask.ravel() > 0
