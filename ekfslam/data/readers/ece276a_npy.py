"""The course data from 2025 on: a pickled dictionary in .npy, with tracks or, in ``dataset02_imgs.npy``, images."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.checks import require_rigid, spelled_as_in
from ekfslam.data.images import Image, ImageRecording, PairCalibration
from ekfslam.data.interpolation import interpolation_attributes, interpolation_notes
from ekfslam.data.observations import flat_observations
from ekfslam.data.readers.ece276a import AS_STORED_NOTE, camera_of, stamps_of
from ekfslam.data.readers.fields import checksum, recorded_tracks, require, require_numbers
from ekfslam.data.readers.pickled import MAGIC, read_pickled
from ekfslam.data.readers.registry import Reader
from ekfslam.data.sequence import LEVEL_VELOCITIES_NOTE, Sequence
from ekfslam.errors import CalibrationError, ExtrinsicsError, LostDataError, ShapeError, UnknownFormatError
from ekfslam.geometry import se3
from ekfslam.geometry.camera import T_CAM_BODY, StereoCamera

FIELDS = ("v_t", "w_t", "timestamps", "features", "K_l", "K_r", "extL_T_imu", "extR_T_imu")
IMAGE_FIELDS = ("cam_imgs_L", "cam_imgs_R")

_EXPECTED = f"expected an .npy file with a dictionary of {', '.join(FIELDS)}"
_NOTES = (
    "The stored extL_T_imu is a pose of the left camera with axes forward, left, up: T_cam_imu = oTr inv(extL_T_imu) "
    "is used, and the distance of both cameras as the baseline.",
    LEVEL_VELOCITIES_NOTE,
    AS_STORED_NOTE,
)
_LATERAL = {"lateral": "as-stored"}


def read_ece276a_npy(path: Path) -> Sequence:
    """Read ``v_t w_t`` (T x 3), ``timestamps``, ``features`` (4 x M x T), ``K_l K_r extL_T_imu extR_T_imu``.

    ``T_cam_imu = oTr inv(extL_T_imu)`` with the optical axes oTr, and the baseline is the length of the translation of
    ``inv(extL_T_imu) extR_T_imu``. A pixel row of -1 or NaN means unseen.
    """
    fields = read_pickled(path, _EXPECTED)
    if "v_t" not in fields:
        hint = " of images; give the recording itself" if IMAGE_FIELDS[0] in fields else ""
        raise UnknownFormatError(f"{path}: an .npy file{hint} with the fields [{', '.join(fields)}]; {_EXPECTED}")
    with spelled_as_in(str(path), {"time_s": "timestamps", "T_cam_imu": "extL_T_imu", "K": "K_l"}):
        time_s, twist = _motion(fields)
        camera, T_cam_imu = _rectified_camera(fields)
        if fields.get("features") is None:
            raise ShapeError("this field is missing: the recording has images only, see `track`", field="features")
        features = require_numbers(fields, "features", (4, None, len(time_s)), finite=False)
        observations, found = flat_observations(features, frame_axis=2, field="features")
        notes = (*_NOTES, *found)
        return recorded_tracks(path, READER.name, time_s, twist, camera, T_cam_imu, observations, notes, _LATERAL)


def open_ece276a_images(path: Path) -> ImageRecording | None:
    """Open images ``cam_imgs_L cam_imgs_R``, all in memory, with the velocities and the calibration of a recording."""
    name = path.stem.removesuffix("_imgs")
    recording, images = path.with_name(f"{name}.npy"), path.with_name(f"{name}_imgs.npy")
    if not (recording.is_file() and images.is_file()):
        return None
    fields = read_pickled(recording, _EXPECTED)
    pictures = read_pickled(images, f"expected a dictionary of {' and '.join(IMAGE_FIELDS)}")
    with spelled_as_in(str(recording)):
        time_s, twist = _motion(fields)
        T_cam_imu, T_right_left = _extrinsics(fields)
        K_left, K_right = (require_numbers(fields, name, (3, 3)) for name in ("K_l", "K_r"))
    with spelled_as_in(str(images)):
        left, right = (_images(pictures, name, len(time_s)) for name in IMAGE_FIELDS)
        size = _require_alike(left, right)
    with spelled_as_in(str(recording), {"K_left": "K_l", "K_right": "K_r", "T_right_left": "extR_T_imu"}):
        calibration = PairCalibration(K_left, K_right, size, T_right_left)
    facts = {"checksum_sha256": checksum(recording), "reader": "ece276a_npy_images", **_LATERAL}
    return ImageRecording(
        recording.stem,
        str(recording),
        time_s,
        calibration,
        lambda frame: (left[frame], right[frame]),
        T_cam_imu,
        twist,
        "level",
        notes=(*_NOTES, *interpolation_notes(twist)),
        attributes={**facts, **interpolation_attributes(twist)},
    )


def _motion(fields: dict[str, Any]) -> tuple[Array, Array]:
    """Return stamps (T,) and velocities (T, 6) of a recording, whose velocities are T x 3 or 3 x T."""
    time_s = stamps_of(fields, "timestamps")
    frames = len(time_s)
    velocities = []
    for name in ("v_t", "w_t"):
        is_wide = require(fields, name).shape == (3, frames) != (frames, 3)
        value = require_numbers(fields, name, (3, frames) if is_wide else (frames, 3))
        velocities.append(value.T if is_wide else value)
    return time_s, np.concatenate(velocities, axis=1)


def _extrinsics(fields: dict[str, Any]) -> tuple[Array, Array]:
    """Return ``T_cam_imu`` (4, 4) of the left optical frame, and ``T_right_left`` (4, 4) of the optical frames."""
    left, right = (require_numbers(fields, name, (4, 4)) for name in ("extL_T_imu", "extR_T_imu"))
    for name, pose in (("extL_T_imu", left), ("extR_T_imu", right)):
        require_rigid(pose, name, ExtrinsicsError)
    T_right_left = T_CAM_BODY @ se3.inverse(right) @ left @ se3.inverse(T_CAM_BODY)
    if not np.linalg.norm(T_right_left[:3, 3]) > 1e-6:
        raise CalibrationError("both cameras are at the same place", field="extR_T_imu")
    return T_CAM_BODY @ se3.inverse(left), T_right_left


def _rectified_camera(fields: dict[str, Any]) -> tuple[StereoCamera, Array]:
    """Return camera and ``T_cam_imu`` of features, which are those of a rectified pair."""
    T_cam_imu, T_right_left = _extrinsics(fields)
    K_left, K_right = (require_numbers(fields, name, (3, 3)) for name in ("K_l", "K_r"))
    camera = camera_of(K_left, float(np.linalg.norm(T_right_left[:3, 3])))
    if not np.allclose(K_left, K_right, rtol=1e-3):
        message = "the cameras have different intrinsics, so their features are not rectified"
        raise CalibrationError(message, field="K_r")
    return camera, T_cam_imu


def _images(pictures: dict[str, Any], name: str, count: int) -> list[Image]:
    """Return one image for each of ``count`` stamps."""
    if name not in pictures:
        raise ShapeError("this field is missing", field=name)
    found = pictures[name]
    images = list(found) if isinstance(found, list) or (isinstance(found, np.ndarray) and found.ndim) else []
    if len(images) != count or not count:
        raise LostDataError(f"{len(images)} images for {count} stamps", field=name)
    return images


def _require_alike(left: list[Image], right: list[Image]) -> tuple[int, int]:
    """Return width and height of all images; raise `ShapeError` unless they are (height, width) uint8."""
    shape = left[0].shape if isinstance(left[0], np.ndarray) else ()
    for name, images in zip(IMAGE_FIELDS, (left, right), strict=True):
        for index, image in enumerate(images):
            is_gray = isinstance(image, np.ndarray) and image.ndim == 2 and image.dtype == np.uint8
            if not is_gray or image.shape != shape:
                kind = f"{image.dtype} of {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
                raise ShapeError(f"expected gray images of uint8 {shape}, found {kind}", field=name, index=index)
    return shape[1], shape[0]


READER = Reader(
    "ece276a_npy",
    "an .npy recording (ECE 276A)",
    lambda source: source.head.startswith(MAGIC),
    tracks=lambda source: read_ece276a_npy(source.path),
    images=lambda source: open_ece276a_images(source.path),
)
