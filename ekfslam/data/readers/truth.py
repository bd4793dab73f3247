"""Ground truth from elsewhere: poses of any format that a file of this folder reads, given to their frames."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.data.readers.fields import checksum
from ekfslam.data.readers.registry import Poses, TruthReader, discovered, listed
from ekfslam.data.readers.text import read_lines, rows_of
from ekfslam.data.sequence import Sequence, Truth
from ekfslam.errors import TruthError, UnknownFormatError

MIN_COVERAGE = 0.9  # a file that knows fewer of the frames belongs to another recording


def attach_truth(sequence: Sequence, path: Path) -> Sequence:
    """``sequence`` with the poses of a truth file or folder in place of the truth it had.

    The content, not the name, decides the format: KITTI odometry (`kitti_odometry`), TUM (`tum`), the csv of EuRoC or a
    folder with it (`euroc`), a drive folder of KITTI raw (`kitti_raw`). Where poses have stamps, each is given to the
    frame whose stamp is nearest, if it is within half the median time step; otherwise row i is frame i.

    Stamps are matched as they are, in seconds: where the sequence counts from another zero than the file, no pose
    fits, and the error names both spans. Text after ``#`` is a comment. Rows beyond the sequence are cut and missing
    ones leave frames without truth; a note says so.

    Poses of KITTI bring their noise (`ekfslam.data.truth_noise`); TUM and EuRoC state none, so theirs is None.

    Raises:
        UnknownFormatError: The file is missing, is not text, or of no known format.
        TruthError: A line is malformed or not a rigid transform, or less than 90 % of the frames are covered.
        NonFiniteError: A line holds NaN or infinity.
        StampError: The stamps do not increase.
        DataError: A drive folder of KITTI raw is malformed; the subclass says how.
    """
    poses = _read(path, sequence)
    truth = truth_of_frames(sequence.time_s, poses)
    frames, known, count = len(sequence), len(truth.frame), len(poses.T_world_imu)
    if known < MIN_COVERAGE * frames:
        spans = ""
        if poses.time_s is not None:
            spans = f"; its stamps are {_span(poses.time_s)}, the sequence's {_span(sequence.time_s)}"
        raise TruthError(
            f"{count} poses give truth to {known} of the {frames} frames of {sequence.source}; "
            f"at least {MIN_COVERAGE:.0%} are needed{spans}",
            source=str(path),
        )
    note = f"Truth of {known} of {frames} frames from {path.name}"
    note += f"; {count - known} of its {count} poses are not used." if known < count else "."
    return dataclasses.replace(
        sequence,
        truth=truth,
        notes=(*sequence.notes, note),
        attributes={**sequence.attributes, "truth_checksum_sha256": checksum(*poses.files)},
    )


def _read(path: Path, sequence: Sequence) -> Poses:
    readers = discovered(TruthReader)
    reader = next((reader for reader in readers if reader.recognises(path)), None)
    if reader is not None:
        return reader.read(path, sequence)
    expected = listed(readers)
    number, content = next(iter(rows_of(read_lines(path, expected))), (0, ""))
    if not content:
        raise UnknownFormatError(f"{path}: holds no poses; {expected}")
    raise UnknownFormatError(f"{path}: line {number} has {len(content.split())} columns; {expected}")


def _span(time_s: Array) -> str:
    return f"{time_s[0]:.3f} to {time_s[-1]:.3f} s"


def truth_of_frames(time_s: Array, poses: Poses) -> Truth:
    """The poses of frames with stamps (T,) that have one: see `attach_truth`."""
    if poses.time_s is None:
        used = min(len(time_s), len(poses.T_world_imu))
        return Truth(np.arange(used), poses.T_world_imu[:used], noise=poses.noise)
    # Nearest in both directions, so that no pose serves two frames.
    row = _nearest(poses.time_s, time_s)
    mutual = _nearest(time_s, poses.time_s)[row] == np.arange(len(time_s))
    tolerance_s = 0.5 * np.median(np.diff(time_s)) if len(time_s) > 1 else 0.0
    frame = np.flatnonzero(mutual & (np.abs(poses.time_s[row] - time_s) <= tolerance_s))
    return Truth(frame, poses.T_world_imu[row[frame]], noise=poses.noise)


def _nearest(ascending: Array, wanted: Array) -> IntArray:
    """Index into ``ascending`` of the entry nearest to each of ``wanted``."""
    right = np.clip(np.searchsorted(ascending, wanted), 1, max(len(ascending) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(ascending) - 1)
    return np.where(wanted - ascending[left] <= ascending[right] - wanted, left, right)
