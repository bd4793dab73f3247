"""Ground truth of poses, picked by content: KITTI odometry (12 columns) and TUM (8 columns) text files, the csv of
EuRoC (commas), and drive folders of KITTI raw."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ekfslam.arrays import Array, IntArray
from ekfslam.data.readers.euroc import find_euroc_truth, is_euroc, parse_euroc
from ekfslam.data.readers.kitti_raw import checksum_of, is_kitti_raw, read_oxts
from ekfslam.data.sequence import Sequence, Truth, require_rigid
from ekfslam.errors import NonFiniteError, StampError, TruthError, UnknownFormatError
from ekfslam.geometry import se3

MIN_COVERAGE = 0.9  # a file that knows fewer of the frames belongs to another recording
_QUATERNION_TOLERANCE = 1e-3
_EXPECTED = (
    "12 numbers a line (KITTI odometry) or 8 (TUM: time tx ty tz qx qy qz qw), a EuRoC ground-truth csv or its folder, "
    "or a drive folder of KITTI raw"
)


def attach_truth(sequence: Sequence, path: Path) -> Sequence:
    """``sequence`` with the poses of a truth file or folder in place of the truth it had.

    - KITTI odometry, 3x4 matrices: row i is ``T_cam0_cam`` of frame i, the pose of the left camera in its first frame.
      ``T_world_imu = T_imu_cam T_cam0_cam T_cam_imu`` with the sequence's extrinsics, so the first pose is
      the identity.
    - TUM, ``time tx ty tz qx qy qz qw``: ``T_world_imu``, given to the frame whose stamp is nearest, if it is within
      half the median time step.
    - EuRoC, ``state_groundtruth_estimate0/data.csv`` or a folder with it (see `parse_euroc`): its poses of the body are
      ``T_world_imu``, matched by stamp as those of TUM.
    - KITTI raw, a drive folder (see `read_oxts`): ``T_world_imu``, matched by stamp too.

    Stamps are matched as they are, in seconds: where the sequence counts from another zero than the file, no pose
    fits, and the error names both spans. Text after ``#`` is a comment. Rows beyond the sequence are cut and missing
    ones leave frames without truth; a note says so.

    Raises:
        UnknownFormatError: The file is missing, is not text, or has another number of columns.
        TruthError: A line is malformed or not a rigid transform, or less than 90 % of the frames are covered.
        NonFiniteError: A line holds NaN or infinity.
        StampError: The stamps do not increase.
        DataError: A drive folder of KITTI raw is malformed; the subclass says how.
    """
    truth, poses, time_s, files = _read_truth(sequence, path)
    frames, known = len(sequence), len(truth.frame)
    if known < MIN_COVERAGE * frames:
        spans = "" if time_s is None else f"; its stamps are {_span(time_s)}, the sequence's {_span(sequence.time_s)}"
        raise TruthError(
            f"{poses} poses give truth to {known} of the {frames} frames of {sequence.source}; "
            f"at least {MIN_COVERAGE:.0%} are needed{spans}",
            source=str(path),
        )
    note = f"Truth of {known} of {frames} frames from {path.name}"
    note += f"; {poses - known} of its {poses} poses are not used." if known < poses else "."
    return dataclasses.replace(
        sequence,
        truth=truth,
        notes=(*sequence.notes, note),
        attributes={**sequence.attributes, "truth_checksum_sha256": checksum_of(files)},
    )


def _read_truth(sequence: Sequence, path: Path) -> tuple[Truth, int, Array | None, tuple[Path, ...]]:
    """Truth of the sequence, number of poses read, their stamps where they have any, and the files read."""
    if is_kitti_raw(path):
        oxts = read_oxts(path)
        time_s, T_world_imu = oxts.time_s[oxts.truth.frame], oxts.truth.T_world_imu
        return _by_stamp(sequence, time_s, T_world_imu), len(time_s), time_s, oxts.files
    file = find_euroc_truth(path) or path
    rows, lines = _read_table(file)
    if rows.shape[1] == 12:
        return _kitti(sequence, _rigid(rows.reshape(-1, 3, 4), lines, file)), len(rows), None, (file,)
    _require_increasing(rows[:, 0], lines, file)
    return _by_stamp(sequence, rows[:, 0], _poses_of_tum(rows, lines, file)), len(rows), rows[:, 0], (file,)


def _span(time_s: Array) -> str:
    return f"{time_s[0]:.3f} to {time_s[-1]:.3f} s"


def _read_table(path: Path) -> tuple[Array, IntArray]:
    """The numbers of a text file in the columns of KITTI odometry or TUM, and the line number (from 1) of each row."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UnknownFormatError(f"{path}: not a readable text file ({error}); expected {_EXPECTED}") from None
    if is_euroc(text):
        return parse_euroc(text, path)
    rows: list[list[float]] = []
    lines: list[int] = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        if not rows and len(words) not in (8, 12):
            raise UnknownFormatError(f"{path}: line {number} has {len(words)} columns; expected {_EXPECTED}")
        try:
            row = [float(word) for word in words]
        except ValueError as error:
            raise TruthError(str(error), source=str(path), field="line", index=number) from None
        if rows and len(row) != len(rows[0]):
            raise TruthError(
                f"{len(row)} columns, the lines before have {len(rows[0])}",
                source=str(path),
                field="line",
                index=number,
            )
        if not np.isfinite(row).all():
            raise NonFiniteError("NaN or infinite value", source=str(path), field="line", index=number)
        rows.append(row)
        lines.append(number)
    if not rows:
        raise UnknownFormatError(f"{path}: holds no poses; expected {_EXPECTED}")
    return np.array(rows), np.array(lines)


def _rigid(matrices: Array, lines: IntArray, path: Path) -> Array:
    """3x4 matrices (F, 3, 4) as transforms (F, 4, 4), every one checked."""
    T = se3.transform(matrices[:, :, :3], matrices[:, :, 3])
    try:
        require_rigid(T, "line", TruthError)
    except TruthError as error:
        assert isinstance(error.index, int)
        raise TruthError(error.message, source=str(path), field="line", index=int(lines[error.index])) from None
    return T


def _kitti(sequence: Sequence, T_cam0_cam: Array) -> Truth:
    used = min(len(sequence), len(T_cam0_cam))
    T_imu_cam = se3.inverse(sequence.T_cam_imu)
    return Truth(np.arange(used), T_imu_cam @ T_cam0_cam[:used] @ sequence.T_cam_imu)


def _poses_of_tum(rows: Array, lines: IntArray, path: Path) -> Array:
    defect = np.abs(np.linalg.norm(rows[:, 4:], axis=1) - 1.0)
    if (defect > _QUATERNION_TOLERANCE).any():
        index = int(np.argmax(defect > _QUATERNION_TOLERANCE))
        raise TruthError(
            f"not a unit quaternion: its norm is off by {defect[index]:.2g}",
            source=str(path),
            field="line",
            index=int(lines[index]),
        )
    return se3.transform(Rotation.from_quat(rows[:, 4:]).as_matrix(), rows[:, 1:4])


def _require_increasing(time_s: Array, lines: IntArray, path: Path) -> None:
    backwards = np.diff(time_s) <= 0
    if backwards.any():
        raise StampError(
            "the stamp does not increase", source=str(path), field="line", index=int(lines[np.argmax(backwards) + 1])
        )


def _by_stamp(sequence: Sequence, time_s: Array, T_world_imu: Array) -> Truth:
    # Nearest in both directions, so that no pose serves two frames.
    row = _nearest(time_s, sequence.time_s)
    mutual = _nearest(sequence.time_s, time_s)[row] == np.arange(len(sequence))
    tolerance_s = 0.5 * np.median(np.diff(sequence.time_s)) if len(sequence) > 1 else 0.0
    frame = np.flatnonzero(mutual & (np.abs(time_s[row] - sequence.time_s) <= tolerance_s))
    return Truth(frame, T_world_imu[row[frame]])


def _nearest(ascending: Array, wanted: Array) -> IntArray:
    """Index into ``ascending`` of the entry nearest to each of ``wanted``."""
    right = np.clip(np.searchsorted(ascending, wanted), 1, max(len(ascending) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(ascending) - 1)
    return np.where(wanted - ascending[left] <= ascending[right] - wanted, left, right)
