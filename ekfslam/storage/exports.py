"""What other programs read: trajectories as text."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from ekfslam import files
from ekfslam.arrays import Array
from ekfslam.errors import ArchiveError
from ekfslam.filters.result import Result
from ekfslam.storage.archive import Archive, read_archive


def export_trajectory(result: Result, path: str | Path, format: Literal["tum", "kitti"]) -> None:
    """Write the estimated poses ``T_world_imu`` as text, one line a frame, in 17 digits: every number exactly.

    Both formats hold the pose of the *IMU* in *world*; KITTI's own files hold the left camera in its first frame.

    Args:
        result: Run to export.
        path: File to write.
        format: ``tum``: ``time tx ty tz qx qy qz qw`` (s, m, unit quaternion); ``kitti``: the twelve entries of the
            upper 3x4 part row by row.

    Raises:
        ArchiveError: The file cannot be written.
    """
    files.write(path, trajectory_text(result, format))


def trajectory_text(result: Result, format: Literal["tum", "kitti"]) -> str:
    """What `export_trajectory` writes."""
    return _pose_text(result.time_s, result.T_world_imu, format)


def export_truth(archive: str | Path, path: str | Path, format: Literal["tum", "kitti"]) -> int:
    """Write the true poses that an archive holds, as `export_trajectory` does; one line a frame of known pose.

    Returns:
        The number of lines.

    Raises:
        ArchiveError: As `read_archive`; or there is no true pose, or not of every frame and the format is ``kitti``,
            which has no stamps to say of which; or the file cannot be written.
    """
    poses, text = truth_text(read_archive(archive), str(archive), format)
    files.write(path, text)
    return poses


def truth_text(archive: Archive, place: str, format: Literal["tum", "kitti"]) -> tuple[int, str]:
    """What `export_truth` writes of an archive read from a place, and the number of lines; raises as that does."""
    truth, frames = archive.truth, len(archive.time_s)
    if truth is None or not len(truth.frame):
        raise ArchiveError(f"{place}: holds no true pose")
    if format == "kitti" and len(truth.frame) < frames:
        raise ArchiveError(
            f"{place}: holds the true pose of {len(truth.frame)} of {frames} frames; kitti has no stamps to say of "
            "which, take tum"
        )
    return len(truth.frame), _pose_text(archive.time_s[truth.frame], truth.T_world_imu, format)


def _pose_text(time_s: Array, T: Array, format: Literal["tum", "kitti"]) -> str:
    if format == "tum":
        quaternion = Rotation.from_matrix(T[:, :3, :3]).as_quat()  # scalar last, as TUM has it
        rows = np.column_stack([time_s, T[:, :3, 3], quaternion])
    else:
        rows = T[:, :3].reshape(-1, 12)
    return "".join(" ".join(f"{value:.17g}" for value in row) + "\n" for row in rows.tolist())
