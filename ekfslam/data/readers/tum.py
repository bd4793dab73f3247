"""Poses in text files of the TUM RGB-D benchmark: lines of ``time tx ty tz qx qy qz qw``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.inputs import VelocitySamples
from ekfslam.data.readers.columns import POSE, header_of, read_named
from ekfslam.data.readers.fields import checksum
from ekfslam.data.readers.poses import Poses, stamped_poses, velocities_of
from ekfslam.data.readers.registry import Reader, Source
from ekfslam.data.readers.text import first_row, parse_table, read_lines
from ekfslam.data.trajectory import Moving, Trajectory
from ekfslam.errors import DataError, LineError, LostDataError, ShapeError, TruthError
from ekfslam.stored import COVARIANCES

COLUMNS = ("time", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
_WIDTHS = (8, 20, 29, 44)  # alone, with covariances of rotation and position, with a triangle, with all 36
AXES = ("x", "y", "z", "rx", "ry", "rz")  # position, then rotation, along the axes of world
UPPER = np.triu_indices(len(AXES))
COVARIANCE = tuple(f"{AXES[i]}_{AXES[j]}" for i, j in zip(*UPPER, strict=True))
COVARIANCE_ENDING = ".cov.txt"
_ROUNDED = 0.01  # of the least time step: stamps of the two files that differ by less are the same


def covariance_path(path: Path) -> Path:
    """Return the file of the covariances of a file of poses: ``poses.cov.txt`` of ``poses.txt``."""
    return path.with_name(path.name.removesuffix(".txt") + COVARIANCE_ENDING)


def read_trajectory(path: str | Path, *, frame: Moving = "body") -> Trajectory:
    """Read the poses of a TUM file, and their covariances from the file beside it if there is one.

    Lines of ``poses.cov.txt`` are a stamp of ``poses.txt`` and 21 numbers: the upper triangle of the covariance by
    rows, ``x_x x_y x_z x_rx ... rz_rz``, along the axes of world, m and rad, see `Trajectory`. ``frame`` is the moving
    frame, which the file does not name.

    Raises:
        UnknownFormatError: A file is missing or no text.
        DataError: A line is malformed, or the stamps of the two files differ.
    """
    path = Path(path)
    poses = _read(path)
    assert poses.time_s is not None
    return Trajectory(poses.time_s, poses.T_world_imu, covariances_beside(path, poses.time_s), frame)


def covariance_file(path: Path) -> Path | None:
    """Return the file of the covariances of poses that exists; ``mine.cov.txt`` is that of ``mine.txt`` if both do."""
    other = path.with_suffix(COVARIANCE_ENDING)
    places = [covariance_path(path), *([] if path.with_suffix(".txt").exists() else [other])]
    return next((place for place in places if place.is_file()), None)


def covariances_beside(path: Path, time_s: Array) -> Array | None:
    """Return the covariances (n, 6, 6) of ``mine.cov.txt`` or ``mine.tum.cov.txt`` beside ``mine.tum``, if any."""
    beside = covariance_file(path)
    if beside is None:
        return None
    words = f"expected a stamp and {len(COVARIANCE)} numbers a line"
    table = parse_table(read_lines(beside, words), beside, columns=1 + len(COVARIANCE))
    if not len(table.values):
        return None
    found, words = table.values[:, 0], f"the stamps are not those of {path.name}"
    if len(found) != len(time_s):
        raise ShapeError(f"{words}: {len(found)} lines, {len(time_s)} poses", source=str(beside), field="time")
    # Programs round the stamps of their files differently.
    apart = np.abs(found - time_s) > (_ROUNDED * np.min(np.diff(time_s)) if len(time_s) > 1 else 0.0)
    if apart.any():
        k = int(np.argmax(apart))
        words += f": {found[k]:.6f} in line {table.line[k]}, where the pose has {time_s[k]:.6f}"
        raise ShapeError(words, source=str(beside), field="time")
    covariance = np.zeros((len(table.values), 6, 6))
    covariance[(slice(None), *UPPER)] = covariance[(slice(None), *UPPER[::-1])] = table.values[:, 1:]
    is_wrong = ~COVARIANCES.holds(covariance, {})
    if is_wrong.any():
        where = table.where(int(np.argmax(is_wrong)))
        raise ShapeError("the covariance is not positive semi-definite; expected the upper triangle by rows", **where)
    return covariance


def _read(path: Path, error: type[DataError] = LineError) -> Poses:
    """Read the eight columns, by their header if it names all columns of the file; a covariance may follow them."""
    lines = read_lines(path, f"expected {READER.expected}")
    header, width = header_of(lines), len(first_row(path).split())
    width = width if width in _WIDTHS else len(COLUMNS)
    if header is not None and header.count == width and header.place.keys() >= set(POSE):
        return stamped_poses(read_named(path, lines, header, POSE, error))
    return stamped_poses(parse_table(lines, path, columns=width, used=len(COLUMNS), error=error))


def _recognises(source: Source) -> bool:
    row = first_row(source.path)
    return len(row.split()) in _WIDTHS and "," not in row


def _inputs(source: Source) -> VelocitySamples:
    """Return the velocities between poses of an odometry."""
    poses = _read(source.path)
    assert poses.time_s is not None
    if len(poses.time_s) < 3:
        raise LostDataError(f"{len(poses.time_s)} poses; three are needed for velocities", source=str(source.path))
    time_s, twist, note = velocities_of(poses.time_s, poses.T_world_imu)
    attributes = {"velocities_sha256": checksum(source.path)}
    return VelocitySamples(str(source.path), time_s, twist, attributes=attributes, notes=(*poses.notes, note))


READER = Reader(
    "TUM",
    f"{len(COLUMNS)} numbers a line (TUM: {' '.join(COLUMNS)}), with a covariance or without",
    _recognises,
    truth=lambda source, _: _read(source.path, TruthError),
    inputs=_inputs,
)
