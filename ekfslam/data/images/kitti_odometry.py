"""KITTI odometry: a folder with ``image_0 image_1`` (gray) or ``image_2 image_3``, ``calib.txt`` and ``times.txt``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.images.pairs import ImageRecording, PairCalibration
from ekfslam.data.images.pixels import PairFiles, size_of
from ekfslam.data.images.registry import ImageReader
from ekfslam.data.readers.registry import Source
from ekfslam.data.readers.text import line_of, parse_numbers, parse_table, read_lines, rows_of
from ekfslam.errors import CalibrationError, LostDataError, ShapeError, UnknownFormatError
from ekfslam.geometry import se3
from ekfslam.geometry.camera import R_CAM_BODY

_PAIRS = (("image_0", "image_1"), ("image_2", "image_3"))
_EXPECTED = "a folder of KITTI odometry (image_0 image_1 calib.txt times.txt)"

# Without velocities there is no IMU: the body is the left camera with axes forward, left, up.


def open_kitti_odometry(folder: Path) -> ImageRecording:
    """A sequence of the benchmark: rectified pairs, stamps, no velocities.

    The body is the left camera, its axes forward, left and up. The gray pair is taken where there are both.

    Raises:
        UnknownFormatError: A file is missing or no text.
        CalibrationError: ``calib.txt`` lacks a camera, or the two are no rectified pair.
        LostDataError: An image is missing in between, or has no stamp.
        LineError: A line is malformed.
    """
    names = next((pair for pair in _PAIRS if all((folder / name).is_dir() for name in pair)), None)
    if names is None:
        raise UnknownFormatError(
            f"{folder}: no pair of image folders; expected image_0 and image_1, or image_2 and image_3"
        )
    times = parse_table(read_lines(folder / "times.txt", "expected a stamp a line"), folder / "times.txt", columns=1)
    left, right = (_numbered(folder / name) for name in names)
    if len(left) != len(right):
        raise LostDataError(
            f"{len(left)} left and {len(right)} right images",
            source=str(folder),
            field=names[0],
            index=min(len(left), len(right)),
        )
    if len(left) > len(times.values):
        raise LostDataError(
            f"{len(left)} images, but {len(times.values)} stamps in times.txt", source=str(folder), field="times.txt"
        )
    size = size_of(left[0])
    notes = ["There are no velocities: the body is the left camera, its axes forward, left and up."]
    if len(left) < len(times.values):
        notes.append(f"The folder has the first {len(left)} of {len(times.values)} images.")
    if names[0] == "image_2":
        notes.append("True poses of the benchmark are of the left gray camera, 6 cm beside the left colour camera.")
    calibration = _calibration(folder / "calib.txt", [int(name[-1]) for name in names], size)
    return ImageRecording(
        name=folder.resolve().name,
        source=str(folder),
        time_s=times.values[: len(left), 0],
        calibration=calibration,
        load=PairFiles(left, right, size),
        T_cam_imu=se3.transform(R_CAM_BODY, np.zeros(3)),
        notes=tuple(notes),
        attributes={"reader": "kitti_odometry_images", "images": f"{names[0]} {names[1]}"},
    )


def _numbered(folder: Path) -> tuple[Path, ...]:
    """Images 000000, 000001, ... of a folder, none of which is missing."""
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in (".png", ".jpg", ".jpeg"))
    if not found:
        raise UnknownFormatError(f"{folder}: there are no images")
    for number, path in enumerate(found):
        if not path.stem.isdigit() or int(path.stem) != number:
            raise LostDataError(
                f"expected image {number:06d}, found {path.name}", source=str(folder), field="images", index=number
            )
    return tuple(found)


def _calibration(path: Path, cameras: list[int], size: tuple[int, int]) -> PairCalibration:
    """Of two cameras of ``calib.txt``, whose images are rectified."""
    matrices: dict[str, Array] = {}
    for number, content in rows_of(read_lines(path, "expected P0: and 12 numbers")):
        name, _, values = content.partition(":")
        where = line_of(path, number)
        matrices[name.strip()] = np.array(parse_numbers(values.split(), 12, where)).reshape(3, 4)
    missing = [f"P{camera}" for camera in cameras if f"P{camera}" not in matrices]
    if missing:
        raise CalibrationError(f"there is no line {missing[0]}:", source=str(path), field=missing[0])
    left, right = (matrices[f"P{camera}"] for camera in cameras)
    if not np.allclose(left[:, :3], right[:, :3], rtol=1e-6, atol=1e-9):
        raise ShapeError(
            "the two cameras have different intrinsics, so the pair is not rectified", source=str(path), field="P"
        )
    shift = np.linalg.solve(left[:, :3], right[:, 3] - left[:, 3])
    if not -shift[0] > 10.0 * np.abs(shift[1:]).max():
        raise CalibrationError("the right camera is not to the right of the left one", source=str(path), field="P")
    # Images are rectified, so that what is left of the other two components is rounding of the calibration.
    T_right_left = se3.transform(np.eye(3), np.array([shift[0], 0.0, 0.0]))
    return PairCalibration(left[:, :3], left[:, :3], size, T_right_left)


def _recognises(source: Source) -> bool:
    folder = source.path
    return (folder / "calib.txt").is_file() and any((folder / left).is_dir() for left, _ in _PAIRS)


IMAGE_READER = ImageReader(
    "kitti_odometry_images", _EXPECTED, _recognises, lambda source: open_kitti_odometry(source.path)
)
