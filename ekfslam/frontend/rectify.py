"""Rectification of image pairs: both cameras become equal pinholes side by side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array, BoolArray, Float32Array
from ekfslam.data.images import Distortion, Image, LensCalibration, PairCalibration
from ekfslam.errors import CalibrationError
from ekfslam.frontend.opencv import opencv
from ekfslam.geometry import se3
from ekfslam.geometry.camera import StereoCamera
from ekfslam.geometry.lens import equidistant, radtan

_LEAST_COSINE = 0.5  # between the optical axes, and between them and the plane across the baseline


@dataclass(frozen=True)
class Rectification:
    """Warp of the images of a pair, or of one camera."""

    camera: StereoCamera  # rectified pair
    T_rectified_left: Array  # (4, 4) left optical frame to that of the rectified left camera: a rotation
    # Pixels (height, width, 2) float32 to read from each image; None leaves them as they are.
    maps: tuple[Float32Array, ...] | None
    # Masks (height, width) of the rectified pixels that show something; None for all.
    valid: tuple[BoolArray, ...] | None

    def apply(self, *images: Image) -> tuple[Image, ...]:
        """Return the rectified images."""
        if self.maps is None:
            return images
        cv2, pairs = opencv(), zip(images, self.maps, strict=True)
        return tuple(cv2.remap(image, m[..., 0], m[..., 1], cv2.INTER_LINEAR) for image, m in pairs)


def undistortion(calibration: LensCalibration) -> Rectification:
    """Return the warp of one camera into a pinhole with the same focal lengths and principal point."""
    K, (width, height) = calibration.K, calibration.size
    camera = StereoCamera(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
    if calibration.distortion.model == "none" and K[0, 1] == 0:
        return Rectification(camera, np.eye(4), None, None)
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    x, y = (u - camera.cu_px) / camera.fu_px, (v - camera.cv_px) / camera.fv_px
    pixels = _image(np.stack([x, y, np.ones(u.shape)], axis=-1), K, calibration.distortion).astype(np.float32)
    return Rectification(camera, np.eye(4), (pixels,), (_shows(pixels, calibration.size),))


def rectification(calibration: PairCalibration) -> Rectification:
    """Return the rectification of a pair.

    The new x axis is along the baseline, the new optical axis is the mean of the two across it (Fusiello, Trucco and
    Verri, "A compact algorithm for rectification of stereo pairs", MVA 2000). The focal length is the mean of the four.
    The principal point centres both images.
    """
    T, K_left, K_right = calibration.T_right_left, calibration.K_left, calibration.K_right
    if calibration.is_rectified:
        K = K_left
        return Rectification(StereoCamera(K[0, 0], K[1, 1], K[0, 2], K[1, 2], -T[0, 3]), np.eye(4), None, None)
    R_rectified_left = _rectifying_rotation(T)
    rotations = R_rectified_left, R_rectified_left @ T[:3, :3].T
    f = float(np.mean([K[i, i] for K in (K_left, K_right) for i in (0, 1)]))
    lenses = calibration.distortion_left, calibration.distortion_right
    sides = list(zip((K_left, K_right), lenses, rotations, strict=True))
    width, height = calibration.size
    middle = np.mean([_direction_of_middle(K, lens, R, calibration.size) for K, lens, R in sides], axis=0)
    cu, cv = 0.5 * (np.array([width, height]) - 1.0) - f * middle
    camera = StereoCamera(f, f, float(cu), float(cv), float(np.linalg.norm(T[:3, 3])))
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    rays = np.stack([(u - cu) / f, (v - cv) / f, np.ones(u.shape)], axis=-1)
    left, right = (_image(rays @ R, K, lens) for K, lens, R in sides)
    maps = left.astype(np.float32), right.astype(np.float32)
    valid = _shows(maps[0], calibration.size), _shows(maps[1], calibration.size)
    return Rectification(camera, se3.transform(R_rectified_left, np.zeros(3)), maps, valid)


def _rectifying_rotation(T_right_left: Array) -> Array:
    """Return the rotation (3, 3) from the left optical frame to the rectified one."""
    R_left_right = T_right_left[:3, :3].T
    x = -R_left_right @ T_right_left[:3, 3]  # position of the right camera in the left one
    x /= np.linalg.norm(x)
    if x[0] < 0:
        raise CalibrationError("the right camera is left of the left one: are they swapped?", field="T_right_left")
    ahead = np.array([0.0, 0.0, 1.0]) + R_left_right[:, 2]
    across = ahead - (ahead @ x) * x
    if R_left_right[2, 2] < _LEAST_COSINE or np.linalg.norm(across) < 2.0 * _LEAST_COSINE:
        raise CalibrationError("the cameras do not look side by side, so no rows agree", field="T_right_left")
    z = across / np.linalg.norm(across)
    return np.stack([x, np.cross(z, x), z])


def _direction_of_middle(K: Array, lens: Distortion, R: Array, size: tuple[int, int]) -> Array:
    """Return normalised rectified coordinates (2,) of the middle of an image, found by Newton's method."""
    target = (np.linalg.inv(K) @ (*(0.5 * (np.array(size) - 1.0)), 1.0))[:2]
    xy = target.copy()
    for _ in range(20):
        off, step = target - _distorted(xy, lens), 1e-6
        J = np.stack([(_distorted(xy + d, lens) - _distorted(xy - d, lens)) / (2 * step) for d in step * np.eye(2)], 1)
        xy = xy + np.linalg.solve(J, off)
    ray = R @ (*xy, 1.0)
    return ray[:2] / ray[2]


def _image(rays: Array, K: Array, lens: Distortion) -> Array:
    """Return the pixels (..., 2) of rays (..., 3); rays from behind are far outside of the image."""
    ahead = rays[..., 2:] > 1e-3
    xy = np.where(ahead, rays[..., :2] / np.where(ahead, rays[..., 2:], 1.0), 0.0)
    bent = np.concatenate([_distorted(xy, lens), np.ones((*xy.shape[:-1], 1))], axis=-1)
    return np.where(ahead, (bent @ K.T)[..., :2], -1e6)


def _distorted(xy: Array, lens: Distortion) -> Array:
    if lens.model == "radtan":
        return radtan(xy, lens.coefficients)
    return equidistant(xy, lens.coefficients) if lens.model == "equidistant" else xy


def _shows(pixels: Float32Array, size: tuple[int, int]) -> BoolArray:
    """Return whether pixels (height, width) of a map (height, width, 2) are inside the image that is read."""
    return np.all((pixels >= 0) & (pixels <= np.array(size) - 1), axis=-1)
