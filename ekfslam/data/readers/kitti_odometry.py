"""The KITTI odometry benchmark: rectified pairs, or one camera, with ``calib.txt times.txt``; poses (12 numbers)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.checks import require_rigid
from ekfslam.data.images import ImageRecording, LensCalibration, PairCalibration, side_by_side
from ekfslam.data.readers.fields import BODY_IS_CAMERA
from ekfslam.data.readers.pictures import PAIRS, find_one, find_pair, in_order, numbered_images, pair_files
from ekfslam.data.readers.poses import FIRST_IMAGE, Poses
from ekfslam.data.readers.registry import Reader
from ekfslam.data.readers.text import Table, first_row, parse_table, read_keys, read_lines, rows_of
from ekfslam.data.sequence import Sequence
from ekfslam.data.truth_noise import KITTI_TRUTH_NOISE
from ekfslam.errors import CalibrationError, LostDataError, ShapeError, TruthError, UnknownFormatError
from ekfslam.geometry import se3
from ekfslam.geometry.camera import T_CAM_BODY

_COLUMNS = 12
_LABELS = ("P0", "P1")


def open_kitti_odometry(folder: Path) -> ImageRecording:
    """Open a sequence of the benchmark, or a run of its images; the body is the left camera, or the only one."""
    names = _names(folder)
    lacking = _lacking(folder, names)
    if lacking or not names:
        raise UnknownFormatError(f"{folder}: looks like a folder of KITTI odometry, but lacks {', and '.join(lacking)}")
    path = folder / "times.txt"
    times = parse_table(read_lines(path, "expected a stamp a line"), path, columns=1).values[:, 0]
    sides = (0, 1) if names[0] == names[-1] and len(names) == 2 else (None, None)[: len(names)]
    found = [numbered_images(folder / name, side) for name, side in zip(names, sides, strict=True)]
    first, last = min(map(min, found)), max(map(max, found))
    frames, stamps = last - first + 1, len(times)
    left, *right = (in_order(images, range(first, last + 1)) for images in found)
    begin = _first_line(times, first, frames)
    if begin + frames > stamps:
        message = f"{frames} images, but {stamps} stamps in times.txt"
        message = message if first == 0 else f"images {first} to {last}, but {stamps} stamps in times.txt"
        raise LostDataError(message, source=str(folder), field="times.txt")
    load, notes = pair_files(left, right[0] if right else None)
    notes += ("There are no velocities.", BODY_IS_CAMERA, *(() if right else (f"There is one camera: {names[0]}.",)))
    if first:
        notes += (f"The folder has images {first} to {last}; times.txt has {stamps} stamps.",)
    elif frames < stamps:
        notes += (f"The folder has the first {frames} of {stamps} images.",)
    if names[0] == "image_2":
        notes += ("True poses of the benchmark are of the left gray camera, 6 cm from the left colour camera.",)
    elif names[0] in ("image_1", "image_3"):
        notes += ("True poses of the benchmark are of the left gray camera, half a metre from this one.",)
    is_numbered = set(names) <= {*PAIRS[0], *PAIRS[1]}
    keys = tuple(f"P{name[-1]}" for name in names) if is_numbered else _LABELS[: len(names)]
    return ImageRecording(
        name=folder.resolve().name,
        source=str(folder),
        time_s=times[begin : begin + frames],
        calibration=_calibration(folder / "calib.txt", keys, load.size),
        load=load,
        T_cam_imu=T_CAM_BODY,
        notes=notes,
        attributes={"reader": IMAGES.name, "images": " ".join(names), **({FIRST_IMAGE: first} if first else {})},
    )


def _first_line(times_s: Array, first: int, frames: int) -> int:
    """Return the line of the first image: its number, or 0 if the file was cut, too (whole ones begin at 0 s)."""
    if first and len(times_s) > 1:
        step_s = float(np.median(np.diff(times_s)))
        if step_s > 0 and times_s[0] > 0.5 * step_s and abs(times_s[0] / step_s - first) < 0.05 * first + 0.5:
            return 0
    return 0 if len(times_s) == frames else first


def _names(folder: Path) -> tuple[str, ...]:
    """Return the folders of left and right images, or of one camera."""
    one = find_one(folder)
    return find_pair(folder) or (() if one is None else (one,))


def _lacking(folder: Path, names: tuple[str, ...]) -> list[str]:
    """Return the parts of a sequence that a folder lacks, in words."""
    lacking = []
    if not names:
        lacking.append("folders of images (image_0 and image_1, image_2 and image_3, image_l and image_r, or one)")
    if not (folder / "times.txt").is_file():
        lacking.append("times.txt (a stamp in seconds a line)")
    lines = [line for _, line in rows_of(read_lines(folder / "calib.txt", "expected P0: and 12 numbers"))]
    if not any(":" in line for line in lines):
        found = f"{len(lines)} lines have none"
        lacking.append(f"labels in calib.txt (P0: and P1: before the 12 numbers of the cameras; {found})")
    return lacking


def _calibration(path: Path, keys: tuple[str, ...], size: tuple[int, int]) -> PairCalibration | LensCalibration:
    """Return the calibration of one or two cameras of ``calib.txt``, whose images are rectified."""
    values = read_keys(path, dict.fromkeys(keys, _COLUMNS), "expected P0: and 12 numbers")
    left, right = (values[key].reshape(3, 4) for key in (keys[0], keys[-1]))
    if len(keys) == 1:
        return LensCalibration(left[:, :3], size)
    if not np.allclose(left[:, :3], right[:, :3], rtol=1e-6, atol=1e-9):
        message = "the two cameras have different intrinsics, so the pair is not rectified"
        raise ShapeError(message, source=str(path), field="P")
    shift = np.linalg.solve(left[:, :3], right[:, 3] - left[:, 3])
    if not -shift[0] > 10.0 * np.abs(shift[1:]).max():
        raise CalibrationError("the right camera is not to the right of the left one", source=str(path), field="P")
    # The other two components of a rectified pair are rounding of the calibration.
    return PairCalibration(left[:, :3], left[:, :3], size, side_by_side(-shift[0]))


def read_kitti_odometry(path: Path, sequence: Sequence) -> Poses:
    """Read 3x4 matrices: row i is ``T_cam0_cam`` of frame i, with `KITTI_TRUTH_NOISE`, the noise of the GPS/INS unit.

    ``T_world_imu = T_imu_cam T_cam0_cam T_cam_imu`` with the sequence's extrinsics, so the first pose is the identity.
    """
    table = parse_table(read_lines(path, f"expected {POSES.expected}"), path, columns=_COLUMNS, error=TruthError)
    T_cam0_cam = _rigid_rows(table, 0)
    T_world_imu = se3.inverse(sequence.T_cam_imu) @ T_cam0_cam @ sequence.T_cam_imu
    return Poses(T_world_imu, None, (path,), KITTI_TRUTH_NOISE)


def _rigid_rows(table: Table, first: int) -> Array:
    """Return the transforms (n, 4, 4) in twelve columns of a file; raise `TruthError` for one that is not rigid."""
    matrices = table.values[:, first : first + 12].reshape(-1, 3, 4)
    T = se3.transform(matrices[:, :, :3], matrices[:, :, 3])
    try:
        require_rigid(T, "line", TruthError)
    except TruthError as error:
        assert isinstance(error.index, int)
        raise TruthError(error.message, **table.where(error.index)) from None
    return T


def _recognises(folder: Path) -> bool:
    if not (folder / "calib.txt").is_file():
        return False
    words = first_row(folder / "calib.txt").split()
    return bool(_names(folder)) or len([word for word in words if not word.endswith(":")]) == _COLUMNS


def read_kitti_360(path: Path, sequence: Sequence) -> Poses:
    """Read poses of KITTI-360: a number of an image, and ``T_world_imu`` (12 numbers) or ``T_world_cam0`` (16)."""
    lines = read_lines(path, f"expected {POSES_360.expected}")
    table = parse_table(lines, path, columns=len(first_row(path).split()), error=TruthError)
    frame = table.values[:, 0]
    if (frame != np.floor(frame)).any() or (np.diff(frame) <= 0).any() or (frame < 0).any():
        raise TruthError("the first column is no increasing number of an image", source=str(path), field="line")
    T = _rigid_rows(table, 1)
    of_camera = table.values.shape[1] == 17
    return Poses(T @ sequence.T_cam_imu if of_camera else T, None, (path,), frame=frame.astype(np.int64))


IMAGES = Reader(
    "kitti_odometry_images",
    "a folder of KITTI odometry (image_0 image_1 calib.txt times.txt)",
    lambda source: _recognises(source.path),
    images=lambda source: open_kitti_odometry(source.path),
)
POSES = Reader(
    "KITTI odometry",
    f"{_COLUMNS} numbers a line (KITTI odometry)",
    lambda source: len(first_row(source.path).split()) == _COLUMNS,
    truth=lambda source, sequence: read_kitti_odometry(source.path, sequence),
)
POSES_360 = Reader(
    "KITTI-360",
    "13 or 17 numbers a line (KITTI-360: frame and pose)",
    lambda source: len(first_row(source.path).split()) in (13, 17) and "," not in first_row(source.path),
    truth=lambda source, sequence: read_kitti_360(source.path, sequence),
)
