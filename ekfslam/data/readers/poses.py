"""True poses as files have them, and their frames."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.data.observations import TrueMotion
from ekfslam.data.readers.columns import without_repeats
from ekfslam.data.readers.text import Table
from ekfslam.data.sequence import Truth
from ekfslam.data.truth_noise import TruthNoise
from ekfslam.errors import TruthError
from ekfslam.geometry import se3

FIRST_IMAGE = "first_image"  # attribute of a recording that begins at a later image of its drive
_QUATERNION_TOLERANCE = 1e-3
_SAME_POSE = 1e-6


@dataclass(frozen=True)
class Poses:
    """True poses of a file."""

    T_world_imu: Array  # (F, 4, 4) poses
    time_s: Array | None  # (F,) increasing stamps; None if row i is the pose of frame i
    files: tuple[Path, ...]  # files that were read
    noise: TruthNoise | None = None  # accuracy of the poses; None if the format does not state it
    motion: TrueMotion | None = None  # velocities and biases of the same rows; None if the file has none
    # (F,) number of the image of each row in its drive; None if rows are all images, or have stamps.
    frame: IntArray | None = None
    notes: tuple[str, ...] = ()  # facts about the reading


def stamped_poses(table: Table) -> Poses:
    """Return the poses in rows of seconds, metres (3), and a quaternion (4) with w last."""
    from scipy.spatial.transform import Rotation

    table, notes = without_repeats(table)
    time_s, position_m, quaternion = table.values[:, 0], table.values[:, 1:4], table.values[:, 4:]
    defect = np.abs(np.linalg.norm(quaternion, axis=1) - 1.0)
    if (defect > _QUATERNION_TOLERANCE).any():
        row = int(np.argmax(defect > _QUATERNION_TOLERANCE))
        raise TruthError(f"not a unit quaternion: its norm is off by {defect[row]:.2g}", **table.where(row))
    T_world_imu = se3.transform(Rotation.from_quat(quaternion).as_matrix(), position_m)
    return Poses(T_world_imu, time_s, (table.path,), notes=notes)


def velocities_of(time_s: Array, T_world_body: Array) -> tuple[Array, Array, str]:
    """Return stamps (N-1,) amid intervals, and twists (N-1, 6) between successive poses, in the body, and a note."""
    step = np.diff(time_s)
    twist = se3.log(se3.inverse(T_world_body[:-1]) @ T_world_body[1:]) / step[:, None]
    note = (
        f"Velocities are differences of {len(time_s)} poses. Nothing states their noise: it is estimated like that of "
        "other velocities. A constant offset or drift of the poses is in it, jumps are not."
    )
    return time_s[:-1] + 0.5 * step, twist, note


def truth_of_frames(time_s: Array, poses: Poses, first: int = 0) -> Truth:
    """Return the poses of frames with stamps (T,), matched as `ekfslam.attach_truth` says.

    Without stamps, row ``first`` is the pose of the first frame, unless the file was cut there, too: it has as many
    rows as there are frames, or does not begin with the identity, as whole files do.
    """
    if poses.frame is not None:
        known = np.flatnonzero((poses.frame >= first) & (poses.frame < first + len(time_s)))
        return Truth(poses.frame[known] - first, poses.T_world_imu[known], noise=poses.noise)
    if poses.time_s is None:
        is_whole = not len(poses.T_world_imu) or bool(np.abs(poses.T_world_imu[0] - np.eye(4)).max() < _SAME_POSE)
        begin = first if is_whole and len(poses.T_world_imu) != len(time_s) else 0
        T_world_imu = poses.T_world_imu[begin : begin + len(time_s)]
        return Truth(np.arange(len(T_world_imu)), T_world_imu, noise=poses.noise)
    tolerance_s = 0.5 * np.median(np.diff(time_s)) if len(time_s) > 1 else 0.0
    row = nearest(poses.time_s, time_s)
    # Nearest in both directions, so that no pose serves two frames.
    mutual = nearest(time_s, poses.time_s)[row] == np.arange(len(time_s))
    frame = np.flatnonzero(mutual & (np.abs(poses.time_s[row] - time_s) <= tolerance_s))
    found, of_frames = poses.motion, row[frame]
    motion = None if found is None else TrueMotion(*(value[of_frames] for value in vars(found).values()))
    return Truth(frame, poses.T_world_imu[of_frames], noise=poses.noise, motion=motion)


def nearest(ascending: Array | IntArray, wanted: Array | IntArray) -> IntArray:
    """Return the index (n,) of the entry of ``ascending`` (m,) that is nearest to each of ``wanted`` (n,)."""
    right = np.clip(np.searchsorted(ascending, wanted), 1, max(len(ascending) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(ascending) - 1)
    return np.where(wanted - ascending[left] <= ascending[right] - wanted, left, right)
