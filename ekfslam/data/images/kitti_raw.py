"""KITTI raw with images: a drive folder (sync) with ``image_00 image_01`` (gray) or ``image_02 image_03`` (colour)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ekfslam.data.images.folders import images_in
from ekfslam.data.images.pairs import ImageRecording, PairCalibration
from ekfslam.data.images.pixels import PairFiles, size_of
from ekfslam.data.images.registry import ImageReader
from ekfslam.data.readers.kitti_raw import CAMERAS, Pair, is_kitti_raw, open_kitti_raw
from ekfslam.data.readers.registry import Lateral, Source
from ekfslam.errors import LostDataError, UnknownFormatError
from ekfslam.geometry import se3

NAME = "kitti_raw_images"


def open_kitti_raw_images(folder: Path, lateral: Lateral = "corrected") -> ImageRecording:
    """The rectified images of a drive with its velocities and truth; frame k is packet k, as far as there are images.

    The gray pair is taken where there are both. See `open_kitti_raw` for velocities, truth and calibration.

    Args:
        folder: The drive folder, of the kind sync.
        lateral: Sign of the lateral velocity, see `with_lateral`.

    Raises:
        UnknownFormatError: A file is missing or damaged, or the drive is of the kind extract: not rectified.
        LostDataError: An image is missing in between, or in one of both cameras, or has no packet.
        DataError: A packet or a calibration is malformed; the subclass says how.
    """
    if folder.resolve().name.endswith("_extract"):
        raise UnknownFormatError(f"{folder}: images of an extract drive are not rectified; take the sync drive")
    pair: Pair = "gray" if _data(folder, "gray")[0].is_dir() else "color"
    left, right = (_numbered(place) for place in _data(folder, pair))
    drive = open_kitti_raw(folder, pair, lateral).sequence()
    first, last = min(left), max(left)
    if last >= len(drive):
        raise LostDataError(
            f"image {last:010d} has no packet, there are {len(drive)}", source=str(folder), field="oxts"
        )
    for place, found in zip(_data(folder, pair), (left, right), strict=True):
        _require_all(place, found, first, last)
    part = drive[first : last + 1]
    size = size_of(left[first])
    K = part.camera.matrix[:2, [0, 1, 2]]
    K = np.vstack([K, [0.0, 0.0, 1.0]])
    numbers = range(first, last + 1)
    files = PairFiles([left[number] for number in numbers], [right[number] for number in numbers], size)
    T_right_left = se3.transform(np.eye(3), np.array([-part.camera.baseline_m, 0.0, 0.0]))
    attributes = {name: value for name, value in part.attributes.items() if name != "tracks"}
    notes = tuple(note for note in part.notes if not note.startswith("KITTI raw has no tracks"))
    if len(part) < len(drive):
        notes = (*notes, f"The folder has images {first} to {last} of {len(drive)} packets.")
    return ImageRecording(
        name=part.name,
        source=part.source,
        time_s=part.time_s,
        calibration=PairCalibration(K, K, size, T_right_left),
        load=files,
        T_cam_imu=part.T_cam_imu,
        twist=part.twist,
        velocity_frame=part.velocity_frame,
        truth=part.truth,
        notes=notes,
        attributes={**attributes, "reader": NAME},
    )


def _require_all(folder: Path, found: dict[int, Path], first: int, last: int) -> None:
    for number in range(first, last + 1):
        if number not in found:
            raise LostDataError(f"image {number:010d} is missing", source=str(folder), field="images", index=number)


def _data(folder: Path, pair: Pair) -> tuple[Path, Path]:
    left, right = CAMERAS[pair]
    return folder / f"image_{left}" / "data", folder / f"image_{right}" / "data"


def _numbered(folder: Path) -> dict[int, Path]:
    """Images by their number."""
    found = {}
    for path in images_in(folder):
        if not path.stem.isdigit():
            raise UnknownFormatError(f"{path}: expected a number for a name, such as 0000000000.png")
        found[int(path.stem)] = path
    return found


def _recognises(source: Source) -> bool:
    folder = source.path
    return is_kitti_raw(folder) and any(_data(folder, pair)[0].is_dir() for pair in CAMERAS)


IMAGE_READER = ImageReader(
    NAME,
    "a drive folder of KITTI raw with images",
    _recognises,
    lambda source: open_kitti_raw_images(source.path, source.lateral),
)
