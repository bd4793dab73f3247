"""Images of the course data from 2025 on: ``dataset02_imgs.npy`` beside the recording ``dataset02.npy``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ekfslam.data.images.pairs import Image, ImageRecording, PairCalibration
from ekfslam.data.images.registry import ImageReader
from ekfslam.data.readers.ece276a_npy import (
    EXPECTED,
    IMAGE_FIELDS,
    attributes_of,
    extrinsics_of,
    motion_of,
    notes_of,
)
from ekfslam.data.readers.fields import require, require_numbers, spelled_as_in
from ekfslam.data.readers.pickled import MAGIC, read_pickled
from ekfslam.data.readers.registry import Source
from ekfslam.errors import LostDataError, ShapeError

NAME = "ece276a_npy_images"


def open_ece276a_images(path: Path) -> ImageRecording:
    """Lists of images ``cam_imgs_L cam_imgs_R``, and velocities and calibration of the recording; all are in memory.

    Args:
        path: Of the recording or of its images.

    Raises:
        UnknownFormatError: A file is damaged, names other things than arrays, or holds another dictionary.
        LostDataError: There are more or fewer images than stamps.
        DataError: A field is missing or malformed; the subclass says how.
    """
    recording, images = _files(path)
    fields = read_pickled(recording, EXPECTED)
    pictures = read_pickled(images, f"expected a dictionary of {' and '.join(IMAGE_FIELDS)}")
    with spelled_as_in(str(recording)):
        time_s, twist = motion_of(fields)
        T_cam_imu, T_right_left = extrinsics_of(fields)
        K_left, K_right = (require_numbers(fields, name, (3, 3)) for name in ("K_l", "K_r"))
    with spelled_as_in(str(images)):
        left, right = (_images(pictures, name, len(time_s)) for name in IMAGE_FIELDS)
        height, width = _shape(left[0], IMAGE_FIELDS[0])
        for name, found in zip(IMAGE_FIELDS, (left, right), strict=True):
            _require_alike(found, (height, width), name)
    with spelled_as_in(str(recording), {"K_left": "K_l", "K_right": "K_r", "T_right_left": "extR_T_imu"}):
        calibration = PairCalibration(K_left, K_right, (width, height), T_right_left)
    return ImageRecording(
        name=recording.stem,
        source=str(recording),
        time_s=time_s,
        calibration=calibration,
        load=lambda frame: (left[frame], right[frame]),
        T_cam_imu=T_cam_imu,
        twist=twist,
        velocity_frame="level",
        notes=notes_of(twist),
        attributes={**attributes_of(recording, twist), "reader": NAME},
    )


def _files(path: Path) -> tuple[Path, Path]:
    """The recording and its images."""
    name = path.stem.removesuffix("_imgs")
    return path.with_name(f"{name}.npy"), path.with_name(f"{name}_imgs.npy")


def _images(pictures: dict[str, Any], name: str, count: int) -> Sequence[Image]:
    """One image (height, width) uint8 a stamp."""
    found = pictures.get(name)
    if found is None:
        require(pictures, name)
    if not isinstance(found, list | np.ndarray) or len(found) != count or not count:
        number = len(found) if isinstance(found, list | np.ndarray) else 0
        raise LostDataError(f"{number} images for {count} stamps", field=name)
    return list(found)


def _shape(image: Any, name: str) -> tuple[int, int]:
    if not isinstance(image, np.ndarray) or image.ndim != 2:
        raise ShapeError("expected gray images, height x width", field=name, index=0)
    height, width = image.shape
    return height, width


def _require_alike(images: Sequence[Image], shape: tuple[int, int], name: str) -> None:
    for index, image in enumerate(images):
        if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.shape != shape:
            kind = f"{image.dtype} of {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
            raise ShapeError(f"expected gray images of uint8 {shape}, found {kind}", field=name, index=index)


def _recognises(source: Source) -> bool:
    return source.head.startswith(MAGIC) and all(file.is_file() for file in _files(source.path))


IMAGE_READER = ImageReader(
    NAME, "an .npy recording (ECE 276A) with its images", _recognises, lambda source: open_ece276a_images(source.path)
)
