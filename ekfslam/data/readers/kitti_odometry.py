"""The KITTI odometry benchmark: folders of rectified stereo images, and text files of true poses.

A folder has ``image_0 image_1`` (gray) or ``image_2 image_3`` (colour), ``calib.txt`` and ``times.txt``. Poses are 12
numbers a line, one line a frame.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ekfslam.data.checks import require_rigid
from ekfslam.data.images import ImageRecording, PairCalibration, side_by_side
from ekfslam.data.readers.fields import BODY_IS_CAMERA
from ekfslam.data.readers.pictures import PairFiles, in_order, numbered_images, size_of
from ekfslam.data.readers.poses import Poses
from ekfslam.data.readers.registry import Reader
from ekfslam.data.readers.text import first_row, parse_table, read_keys, read_lines
from ekfslam.data.sequence import Sequence
from ekfslam.data.truth_noise import KITTI_TRUTH_NOISE
from ekfslam.errors import CalibrationError, LostDataError, ShapeError, TruthError, UnknownFormatError
from ekfslam.geometry import se3
from ekfslam.geometry.camera import T_CAM_BODY

_PAIRS = (("image_0", "image_1"), ("image_2", "image_3"))
_COLUMNS = 12


def open_kitti_odometry(folder: Path) -> ImageRecording:
    """Open a sequence of the benchmark: rectified pairs and stamps, without velocities.

    The body is the left camera. The gray pair is preferred.
    """
    names = next((pair for pair in _PAIRS if all((folder / name).is_dir() for name in pair)), None)
    if names is None:
        raise UnknownFormatError(
            f"{folder}: no pair of image folders; expected image_0 and image_1, or image_2 and image_3"
        )
    times = parse_table(read_lines(folder / "times.txt", "expected a stamp a line"), folder / "times.txt", columns=1)
    found = [numbered_images(folder / name) for name in names]
    frames, stamps = max(max(images) for images in found) + 1, len(times.values)
    left, right = (in_order(images, range(frames)) for images in found)
    if frames > stamps:
        raise LostDataError(f"{frames} images, but {stamps} stamps in times.txt", source=str(folder), field="times.txt")
    size = size_of(left[0])
    notes = ["There are no velocities.", BODY_IS_CAMERA]
    if frames < stamps:
        notes.append(f"The folder has the first {frames} of {stamps} images.")
    if names[0] == "image_2":
        notes.append("True poses of the benchmark are of the left gray camera, 6 cm from the left colour camera.")
    return ImageRecording(
        name=folder.resolve().name,
        source=str(folder),
        time_s=times.values[:frames, 0],
        calibration=_calibration(folder / "calib.txt", [f"P{name[-1]}" for name in names], size),
        load=PairFiles(left, right, size),
        T_cam_imu=T_CAM_BODY,
        notes=tuple(notes),
        attributes={"reader": IMAGES.name, "images": " ".join(names)},
    )


def _calibration(path: Path, keys: list[str], size: tuple[int, int]) -> PairCalibration:
    """Return the calibration of two cameras of ``calib.txt``, whose images are rectified."""
    values = read_keys(path, dict.fromkeys(keys, _COLUMNS), "expected P0: and 12 numbers")
    left, right = (values[key].reshape(3, 4) for key in keys)
    if not np.allclose(left[:, :3], right[:, :3], rtol=1e-6, atol=1e-9):
        raise ShapeError(
            "the two cameras have different intrinsics, so the pair is not rectified", source=str(path), field="P"
        )
    shift = np.linalg.solve(left[:, :3], right[:, 3] - left[:, 3])
    if not -shift[0] > 10.0 * np.abs(shift[1:]).max():
        raise CalibrationError("the right camera is not to the right of the left one", source=str(path), field="P")
    # The other two components of a rectified pair are rounding of the calibration.
    return PairCalibration(left[:, :3], left[:, :3], size, side_by_side(-shift[0]))


def read_kitti_odometry(path: Path, sequence: Sequence) -> Poses:
    """Read 3x4 matrices: row i is ``T_cam0_cam`` of frame i, the pose of the left camera in its first frame.

    ``T_world_imu = T_imu_cam T_cam0_cam T_cam_imu`` with the sequence's extrinsics, so the first pose is the identity.
    The poses are from the GPS/INS unit of KITTI, so their noise is `KITTI_TRUTH_NOISE`.
    """
    table = parse_table(read_lines(path, f"expected {POSES.expected}"), path, columns=_COLUMNS, error=TruthError)
    matrices = table.values.reshape(-1, 3, 4)
    T_cam0_cam = se3.transform(matrices[:, :, :3], matrices[:, :, 3])
    try:
        require_rigid(T_cam0_cam, "line", TruthError)
    except TruthError as error:
        assert isinstance(error.index, int)
        raise TruthError(error.message, **table.where(error.index)) from None
    T_world_imu = se3.inverse(sequence.T_cam_imu) @ T_cam0_cam @ sequence.T_cam_imu
    return Poses(T_world_imu, None, (path,), KITTI_TRUTH_NOISE)


IMAGES = Reader(
    "kitti_odometry_images",
    "a folder of KITTI odometry (image_0 image_1 calib.txt times.txt)",
    lambda source: (source.path / "calib.txt").is_file() and any((source.path / left).is_dir() for left, _ in _PAIRS),
    images=lambda source: open_kitti_odometry(source.path),
)
POSES = Reader(
    "KITTI odometry",
    f"{_COLUMNS} numbers a line (KITTI odometry)",
    lambda source: len(first_row(source.path).split()) == _COLUMNS,
    truth=lambda source, sequence: read_kitti_odometry(source.path, sequence),
)
