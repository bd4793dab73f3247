"""Poses in text files of the TUM RGB-D benchmark: lines of ``time tx ty tz qx qy qz qw``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ekfslam.data.readers.poses import Poses, stamped_poses
from ekfslam.data.readers.registry import Reader, Source
from ekfslam.data.readers.text import first_row, parse_table, read_lines
from ekfslam.data.sequence import Sequence
from ekfslam.data.trajectory import Moving, Trajectory
from ekfslam.errors import ShapeError, TruthError

COLUMNS = ("time", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
AXES = ("x", "y", "z", "rx", "ry", "rz")  # position, then rotation, along the axes of world
UPPER = np.triu_indices(len(AXES))
COVARIANCE = tuple(f"{AXES[i]}_{AXES[j]}" for i, j in zip(*UPPER, strict=True))
COVARIANCE_ENDING = ".cov.txt"


def covariance_path(path: Path) -> Path:
    """Return the file of the covariances of a file of poses: ``poses.cov.txt`` of ``poses.txt``."""
    return path.with_name(path.name.removesuffix(".txt") + COVARIANCE_ENDING)


def read_trajectory(path: str | Path, *, frame: Moving = "body") -> Trajectory:
    """Read the poses of a TUM file, and their covariances from the file beside it if there is one.

    Lines of ``poses.cov.txt`` are the stamps of ``poses.txt`` and 21 numbers: the upper triangle of the covariance by
    rows, ``x_x x_y x_z x_rx ... rz_rz``. The axes are those of world; x, y, z in m, the rotations about them in rad,
    see `Trajectory`.

    Args:
        path: File of poses.
        frame: Moving frame, which the file does not name.

    Raises:
        UnknownFormatError: A file is missing or no text.
        DataError: A line is malformed, or the stamps of the two files differ; the subclass says how.
    """
    path = Path(path)
    poses = stamped_poses(parse_table(read_lines(path, f"expected {READER.expected}"), path, columns=len(COLUMNS)))
    assert poses.time_s is not None
    beside = covariance_path(path)
    if not beside.is_file():
        return Trajectory(poses.time_s, poses.T_world_imu, None, frame)
    words = f"expected a stamp and {len(COVARIANCE)} numbers a line"
    table = parse_table(read_lines(beside, words), beside, columns=1 + len(COVARIANCE))
    if not len(table.values):
        return Trajectory(poses.time_s, poses.T_world_imu, None, frame)
    if not np.array_equal(table.values[:, 0], poses.time_s):
        raise ShapeError(f"the stamps are not those of {path.name}", source=str(beside), field="time")
    covariance = np.zeros((len(table.values), 6, 6))
    covariance[(slice(None), *UPPER)] = covariance[(slice(None), *UPPER[::-1])] = table.values[:, 1:]
    return Trajectory(poses.time_s, poses.T_world_imu, covariance, frame)


def _recognises(source: Source) -> bool:
    row = first_row(source.path)
    return len(row.split()) == len(COLUMNS) and "," not in row


def _truth(source: Source, sequence: Sequence) -> Poses:
    lines = read_lines(source.path, f"expected {READER.expected}")
    return stamped_poses(parse_table(lines, source.path, columns=len(COLUMNS), error=TruthError))


READER = Reader("TUM", f"{len(COLUMNS)} numbers a line (TUM: {' '.join(COLUMNS)})", _recognises, truth=_truth)
