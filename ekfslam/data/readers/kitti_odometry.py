"""True poses in the text files of the KITTI odometry benchmark: 12 numbers a line, one line a frame."""

from __future__ import annotations

from pathlib import Path

from ekfslam.data.readers.registry import Poses, TruthReader
from ekfslam.data.readers.text import first_row, parse_table, read_lines
from ekfslam.data.sequence import Sequence, require_rigid
from ekfslam.data.truth_noise import KITTI_TRUTH_NOISE
from ekfslam.errors import TruthError
from ekfslam.geometry import se3

_COLUMNS = 12
_EXPECTED = f"{_COLUMNS} numbers a line (KITTI odometry)"


def read_kitti_odometry(path: Path, sequence: Sequence) -> Poses:
    """3x4 matrices: row i is ``T_cam0_cam`` of frame i, the pose of the left camera in its first frame.

    ``T_world_imu = T_imu_cam T_cam0_cam T_cam_imu`` with the sequence's extrinsics, so the first pose is the identity.
    They are from the GPS/INS unit of KITTI, so their noise is `KITTI_TRUTH_NOISE`.

    Raises:
        UnknownFormatError: The file is not text.
        TruthError: A line is malformed, or not a rigid transform.
        NonFiniteError: A line holds NaN or infinity.
    """
    table = parse_table(read_lines(path, f"expected {_EXPECTED}"), path, columns=_COLUMNS, error=TruthError)
    matrices = table.values.reshape(-1, 3, 4)
    T_cam0_cam = se3.transform(matrices[:, :, :3], matrices[:, :, 3])
    try:
        require_rigid(T_cam0_cam, "line", TruthError)
    except TruthError as error:
        assert isinstance(error.index, int)
        raise TruthError(error.message, **table.where(error.index)) from None
    T_world_imu = se3.inverse(sequence.T_cam_imu) @ T_cam0_cam @ sequence.T_cam_imu
    return Poses(T_world_imu, None, (path,), KITTI_TRUTH_NOISE)


def _recognises(path: Path) -> bool:
    return len(first_row(path).split()) == _COLUMNS


TRUTH_READER = TruthReader("KITTI odometry", _EXPECTED, _recognises, read_kitti_odometry)
