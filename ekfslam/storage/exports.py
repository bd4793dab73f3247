"""Files for other programs: trajectories, tables, point clouds, graphs and the information matrix.

Poses are of the IMU in world unless a format says otherwise. `EXPORTS` has every format by name. A file that adds one
needs nothing else::

    EXPORTS["mine"] = Export("mine.txt", "last position: x y z", lambda result: str(result.T_world_imu[-1, :3, 3]))
"""

from __future__ import annotations

import csv
import io
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ekfslam import files
from ekfslam.arrays import Array
from ekfslam.data.readers.euroc import COLUMNS, MOTION
from ekfslam.data.readers.text import first_row
from ekfslam.data.readers.tum import COVARIANCE, COVARIANCE_ENDING, covariance_path
from ekfslam.data.trajectory import Moving, Trajectory, from_left_error
from ekfslam.errors import ArchiveError, ConfigError
from ekfslam.filters.log import Log
from ekfslam.filters.result import Result
from ekfslam.geometry import motion, se3
from ekfslam.models.sensors.stereo import Rig
from ekfslam.smoother.posterior import Posterior, is_inertial, posterior
from ekfslam.storage.archive import Archive
from ekfslam.storage.tables import columns, covariance_columns
from ekfslam.storage.trajectories import (
    bag_bytes,
    covariance_text,
    is_our_bag,
    kitti_text,
    numbers,
    position_and_quaternion,
    tum_text,
)

MADE_BY = "ekfslam"  # in files that have room for a remark
_UNITS = ("ns", *["m"] * 3, *[""] * 4, *["m s^-1"] * 3, *["rad s^-1"] * 3, *["m s^-2"] * 3)
_PLY = f"ply\nformat binary_little_endian 1.0\ncomment {MADE_BY}: landmarks in world, m and m^2\n"
_G2O = f"# {MADE_BY}: "


def export(result: Result, path: str | Path, format: str, *, frame: Moving | None = None) -> None:
    """Write a result for other programs in a format of `EXPORTS`, such as ``tum``, ``ply`` or ``csv-landmarks``.

    Args:
        result: The result.
        path: File; ``tum`` also writes the covariances of the poses beside it, see `contents`.
        format: Name of the format.
        frame: Moving frame of the poses of ``tum``, ``kitti`` and ``bag``; by default that of the left camera for
            ``kitti``, of the body for the others.

    Raises:
        ArchiveError: There is no such format, it cannot hold this result, or the file cannot be written.
        PosteriorError: The format is ``information``, and the result has no log.
        MissingPackageError: The format is ``bag``, and rosbags is not installed.
    """
    if format not in EXPORTS:
        raise ArchiveError(f"there is no format {format!r}; known: {', '.join(EXPORTS)}")
    written = contents(result if EXPORTS[format].poses is None else trajectory_of(result), path, format, frame)
    files.write_all(written, make_folders=False)


def contents(
    data: Result | Poses, path: str | Path, format: str, frame: Moving | None = None
) -> dict[Path, str | bytes]:
    """Return the contents of the files of an `export` by path; those of ``tum`` include ``poses.cov.txt``."""
    path, made = Path(path), EXPORTS[format]
    if not isinstance(data, Poses):
        if frame is not None:
            raise ConfigError(f"the format {format} has no frame; those of poses have: tum, kitti, bag")
        return {path: made.write(data)}
    assert made.poses is not None
    moving = data.of(frame or made.frame)
    found = {path: made.poses(moving)}
    beside = covariance_text(moving) if format == "tum" else None
    if beside is None and format == "tum" and covariance_path(path).exists():
        beside = f"# the poses of {path.name} have no covariances\n"  # in place of those of an earlier export
    return found if beside is None else {**found, covariance_path(path): beside}


class Poses(NamedTuple):
    """A trajectory of the body, and the extrinsics (4, 4) of the left camera."""

    trajectory: Trajectory
    T_cam_imu: Array

    def of(self, moving: Moving) -> Trajectory:
        """Return the trajectory of the body or of the left camera."""
        return self.trajectory if moving == "body" else self.trajectory.of_camera(self.T_cam_imu)


def trajectory_of(result: Result) -> Poses:
    """Return the poses of a result with their covariances."""
    poses = from_left_error(result.time_s, result.T_world_imu, result.covariance)
    return Poses(poses if result.has_covariance else replace(poses, covariance=None), result.T_cam_imu)


def true_trajectory(archive: Archive, place: str, format: str) -> Poses:
    """Return the true poses of an archive, one a frame of known pose; raise `ArchiveError` if it has none."""
    truth, frames = archive.truth, len(archive.time_s)
    if EXPORTS[format].poses is None:
        raise ArchiveError(f"{place}: the truth is written as tum, kitti or bag, not as {format}")
    if truth is None or not len(truth.frame):
        raise ArchiveError(f"{place}: holds no true pose")
    if format == "kitti" and len(truth.frame) < frames:
        raise ArchiveError(
            f"{place}: holds the true pose of {len(truth.frame)} of {frames} frames; kitti has no stamps, take tum"
        )
    return Poses(Trajectory(archive.time_s[truth.frame], truth.T_world_imu), archive.T_cam_imu)


def truth_text(archive: Archive, place: str, format: Literal["tum", "kitti"]) -> tuple[int, str]:
    """Return number and text of the true poses of an archive, see `true_trajectory`."""
    poses = true_trajectory(archive, place, format)
    write = EXPORTS[format].poses
    assert write is not None
    return len(poses.trajectory.time_s), str(write(poses.of(EXPORTS[format].frame)))


def csv_text(result: Result, table: str = "trajectory") -> str:
    """Return a table of `ekfslam.storage.tables` as comma-separated values with a heading, every number exactly."""
    found, out = columns(result, table), io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(found)
    writer.writerows(zip(*(values.tolist() for values in found.values()), strict=True))
    return out.getvalue()


def euroc_text(result: Result) -> str:
    """Return inertial states as EuRoC's csv of ground truth: ns (to 0.2 us since 1970), velocities along world."""
    velocity, states = result.velocity_world_m_s, result.inertial
    assert states is not None
    quaternion = position_and_quaternion(result.T_world_imu)[:, [6, 3, 4, 5]]
    biases = states.gyro_bias_rad_s, states.accel_bias_m_s2
    rows = np.hstack([result.T_world_imu[:, :3, 3], quaternion, velocity, *biases])
    lines = [f"#{', '.join(f'{name} [{unit}]' for name, unit in zip((*COLUMNS, *MOTION), _UNITS, strict=True))}"]
    for time_s, row in zip(result.time_s.tolist(), rows.tolist(), strict=True):
        seconds, rest = divmod(time_s, 1.0)
        lines.append(",".join([str(int(seconds) * 10**9 + round(rest * 1e9)), *(f"{value:.17g}" for value in row)]))
    return "\n".join([*lines, ""])


def ply_bytes(result: Result) -> bytes:
    """Return the landmarks with covariances as a point cloud (PLY), from blue (to 1 cm) to red (from 10 m)."""
    landmarks = result.landmarks
    if len(landmarks) and landmarks.id.max() > 1 << 53:
        raise ArchiveError(f"{result.sequence_name}: landmark id {landmarks.id.max()} is too large for PLY")
    std = np.sqrt(np.maximum(np.linalg.eigvalsh(landmarks.covariance)[:, -1], 1e-12))
    share = np.clip((np.log10(std) + 2.0) / 3.0, 0.0, 1.0)[:, None]
    colours = np.round((1.0 - share) * np.array([0, 114, 178]) + share * np.array([213, 94, 0])).astype(np.uint8)
    properties: dict[str, NDArray] = dict(zip("xyz", landmarks.position_m.T, strict=True))
    properties |= dict(zip(("red", "green", "blue"), colours.T, strict=True))
    properties |= {"id": landmarks.id.astype(float), "observations": landmarks.observations.astype(np.int32)}
    properties |= covariance_columns(landmarks.covariance, "cov_{}")
    types = {"f": ("double", "<f8"), "i": ("int", "<i4"), "u": ("uchar", "u1")}
    vertex = np.empty(len(landmarks), dtype=[(name, types[value.dtype.kind][1]) for name, value in properties.items()])
    for name, value in properties.items():
        vertex[name] = value
    declared = "".join(f"property {types[value.dtype.kind][0]} {name}\n" for name, value in properties.items())
    return (_PLY + f"element vertex {len(landmarks)}\n{declared}end_header\n").encode("ascii") + vertex.tobytes()


def g2o_text(result: Result) -> str:
    """Return the measurements of a full run as a graph for g2o: estimated poses of the IMU and landmarks, and edges.

    - ``EDGE_SE3:QUAT``: the motion of a step, eq. (1), by the velocities that moved the filter. Its information is
      that of eq. (2) for white velocity noise; the error is g2o's own, translation and vector part of the quaternion.
    - ``EDGE_SE3_TRACKXYZ``: a landmark in the frame of the IMU, triangulated from one observation, with the
      information ``A^T V^-1 A`` of its rows there, eq. (4). The camera is in no edge: some programs read no offset.
    - ``FIX``: the first pose.

    Velocities as states and errors of tracks have memory, which a graph of poses and points cannot express: steps have
    the noise of measured velocities then, and views that of a first view.

    Raises:
        ArchiveError: The result has no log (only the mode ``full`` has one), or inertial samples moved the poses.
    """
    if result.log is None:
        raise ArchiveError(f"{result.sequence_name}: mode {result.mode!r} has no log, hence no edges; take mode full")
    if is_inertial(result):
        raise ArchiveError(
            f"{result.sequence_name}: inertial samples moved the poses; g2o has no vertices for velocity and biases; "
            "take information"
        )
    if result.camera.is_monocular:
        raise ArchiveError(f"{result.sequence_name}: g2o has no vertices that one camera sees; take information")
    return "".join(f"{line}\n" for line in _graph(result, result.log))


def _graph(result: Result, log: Log) -> Iterator[str]:
    frames = len(result.time_s)
    yield f"{_G2O}{' '.join(result.sequence_name.split())}, vertices 0 to {frames - 1} are poses of the IMU"
    yield f"PARAMS_SE3OFFSET 0 {numbers(position_and_quaternion(np.eye(4)))}"
    for k, row in enumerate(position_and_quaternion(result.T_world_imu)):
        yield f"VERTEX_SE3:QUAT {k} {numbers(row)}"
    yield "FIX 0"
    for i, row in enumerate(result.landmarks.position_m):
        yield f"VERTEX_TRACKXYZ {frames + i} {numbers(row)}"
    # The velocities that moved the pose, as they were after biases and tilt.
    moved, noise = log.T_departed[1:] @ se3.inverse(log.T_predicted[1:]), result.noise
    step, twist = position_and_quaternion(moved), se3.log(moved) / log.tau_s[1:, None]
    std = np.where(log.is_gap[1:, None], np.hypot(noise.velocity_std, noise.gap_std), noise.velocity_std)
    std = std * log.doubt[1:, None]
    Q = motion.process_noise(twist, log.tau_s[1:], std)
    # The vector part of a quaternion is half the rotation.
    twice = np.repeat([1.0, 2.0], 3)
    for k, (row, information) in enumerate(zip(step, twice[:, None] * np.linalg.inv(Q) * twice, strict=True)):
        yield f"EDGE_SE3:QUAT {k} {k + 1} {numbers(row)} {numbers(information[np.triu_indices(6)])}"
    q, information = _triangulated(result, log)
    for k, i, row, block in zip(log.frame.tolist(), log.landmark.tolist(), q, information, strict=True):
        yield f"EDGE_SE3_TRACKXYZ {k} {frames + i} 0 {numbers(row)} {numbers(block[np.triu_indices(3)])}"


def _triangulated(result: Result, log: Log) -> tuple[Array, Array]:
    """Return points (K, 3) of the observations in the frame of the IMU, m, and their information (K, 3, 3)."""
    rig = Rig(result.camera, result.T_cam_imu, result.noise)
    q = rig.invert(log.rows)
    first = np.zeros(log.landmarks, dtype=np.int64)
    first[log.landmark[::-1]] = np.arange(len(log.landmark))[::-1]
    variance = np.where((log.previous >= 0)[:, None], log.variance[first[log.landmark]], log.variance)
    A = rig.jacobian(q) @ result.T_cam_imu[:3, :3]
    return se3.apply(se3.inverse(result.T_cam_imu), q), np.swapaxes(A, 1, 2) @ (A / variance[:, :, None])


def information_bytes(result: Result, found: Posterior | None = None) -> bytes:
    """Return `Posterior.information_matrix` and its columns as a file for `scipy.sparse.load_npz`, without pickle."""
    matrix, named = (found or posterior(result)).information_matrix()
    texts = {name: value.astype(np.bytes_) if value.dtype.kind == "U" else value for name, value in named.items()}
    arrays: dict[str, Any] = {name: getattr(matrix, name) for name in ("indices", "indptr", "shape", "data")}
    arrays |= {**texts, "format": np.bytes_("csc"), "made_by": np.bytes_(MADE_BY)}
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    return out.getvalue()


class Export(NamedTuple):
    """A format."""

    ending: str  # ending of its files
    words: str  # contents of a file
    write: Callable[[Result], str | bytes]  # function that returns the contents for a result
    begins: bytes = b""  # first bytes of a file, if they tell it from other formats
    columns: int = 0  # number of columns of a table of numbers, which tells its files from other formats
    # Function that returns the contents for a trajectory, if the format is of poses alone.
    poses: Callable[[Trajectory], str | bytes] | None = None
    frame: Moving = "body"  # moving frame of these poses by default


def is_export(path: Path, format: str) -> bool:
    """Return whether a file is an earlier export in a format of `EXPORTS`."""
    export = EXPORTS[format]
    if export.columns:
        is_covariance = format == "tum" and path.name.endswith(COVARIANCE_ENDING)
        allowed = (0, 1 + len(COVARIANCE)) if is_covariance else (export.columns,)
        return len(first_row(path).split()) in allowed
    if format == "bag":
        return is_our_bag(path)
    try:
        with path.open("rb") as file:
            is_similar = file.read(len(export.begins)) == export.begins
        if format == "information":
            with zipfile.ZipFile(path) as archive:
                return "made_by.npy" in archive.namelist()
    except (OSError, zipfile.BadZipFile):
        return False
    return is_similar


def _poses(
    ending: str, words: str, columns: int, write: Callable[[Trajectory], str | bytes], frame: Moving = "body"
) -> Export:
    of_result = lambda result: write(trajectory_of(result).of(frame))  # noqa: E731
    return Export(ending, words, of_result, b"", columns, write, frame)


def _csv(table: str, begins: bytes) -> Export:
    return Export(f"{table}.csv", f"table {table}", partial(csv_text, table=table), begins)


EXPORTS: dict[str, Export] = {
    "tum": _poses("tum.txt", "poses: time tx ty tz qx qy qz qw", 8, tum_text),
    "kitti": _poses(
        "kitti.txt", "poses of the left camera in its first frame: twelve entries", 12, kitti_text, "camera"
    ),
    "bag": _poses("mcap", "poses: ROS 2 bag of nav_msgs/Odometry with covariances", 0, bag_bytes),
    "euroc": Export("euroc.csv", "inertial states: ns, p, q, v, biases", euroc_text, b"#timestamp [ns], p_RS"),
    "csv": _csv("trajectory", b"time_s,x_m,"),
    "csv-landmarks": _csv("landmarks", b"id,x_m,"),
    "csv-innovation": _csv("innovation", b"time_s,nis,"),
    "csv-rejections": _csv("rejections", b"frame,time_s,"),
    "ply": Export("ply", "landmarks with covariances", ply_bytes, _PLY.encode()),
    "g2o": Export("g2o", "poses, landmarks and measurements as a graph", g2o_text, _G2O.encode()),
    "information": Export("information.npz", "joint information matrix, sparse", information_bytes),
}
