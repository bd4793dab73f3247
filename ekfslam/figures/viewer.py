"""Archives for the Rerun viewer (rerun.io): poses that move, maps and errors in three dimensions.

/world/truth, /world/<mode>/path      lines
/world/<mode>/imu                     the pose over time, with the camera's image plane and a 2-sigma ellipsoid
/world/<mode>/landmarks               points with their standard deviation as radius, and ellipsoids
/errors/<mode>, /nis/<mode>           scalars over time
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import to_rgb
from scipy.spatial.transform import Rotation

from ekfslam import files
from ekfslam.arrays import Array
from ekfslam.errors import ConfigError, MissingPackageError
from ekfslam.evaluation.consistency import world_axes_errors
from ekfslam.figures.maps import SIGMAS, spread
from ekfslam.figures.style import LANDMARK_COLOR, style_of
from ekfslam.filters.result import Result
from ekfslam.geometry import se3
from ekfslam.storage.archive import Archive

_ELLIPSOIDS = 2000  # of landmarks: more are slow to draw


def write_viewer_file(archive: Archive, path: str | Path) -> None:
    """Write an archive as a file of Rerun (``.rrd``), as a whole or not at all."""
    files.require_writable(path)
    recording = _new_recording(archive.name)
    memory = recording.memory_recording()
    log_archive(archive, recording)
    recording.flush()
    files.write_all({Path(path): memory.drain_as_bytes()})


def is_viewer_file(path: Path) -> bool:
    """Return whether a file is one of Rerun."""
    with path.open("rb") as file:
        return file.read(3) == b"RRF"


def show_archive(archive: Archive) -> None:
    """Open the viewer on this machine, and show an archive in it."""
    recording = _new_recording(archive.name)
    try:
        recording.spawn()
    except (RuntimeError, OSError) as error:
        raise ConfigError(f"the viewer of Rerun cannot be started: {error}") from None
    log_archive(archive, recording)
    recording.flush()


def log_archive(archive: Archive, recording: Any) -> None:
    """Send an archive to a ``rerun.RecordingStream``."""
    rr = _rerun()
    time_s = archive.time_s - archive.time_s[0]
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    if archive.truth is not None and len(archive.truth.frame):
        lines = rr.LineStrips3D([archive.truth.T_world_imu[:, :3, 3]], colors=[(128, 128, 128)], labels=["truth"])
        recording.log("world/truth", lines, static=True)
    for mode, result in archive.results.items():
        part = rr.escape_entity_path_part(mode)
        color = _bytes(style_of(mode)["color"])
        path = rr.LineStrips3D([result.T_world_imu[:, :3, 3]], colors=[color])
        recording.log(f"world/{part}/path", path, static=True)
        _log_pose(recording, f"world/{part}/imu", result, time_s, color)
        if len(result.landmarks):
            _log_landmarks(recording, f"world/{part}/landmarks", result)
        _log_scalars(recording, part, archive, result, time_s)


def _log_pose(recording: Any, place: str, result: Result, time_s: Array, color: tuple[int, ...]) -> None:
    """Log the IMU over time: axes, the ellipsoid of its position, and the image plane of the camera."""
    rr = _rerun()
    T = result.T_world_imu
    moves = rr.Transform3D.columns(
        translation=T[:, :3, 3], quaternion=Rotation.from_matrix(np.array(T[:, :3, :3])).as_quat().astype(np.float32)
    )
    _send(recording, place, time_s, moves)
    axes, turns = ellipsoids(result.covariance[:, :3, :3])  # rho is along the axes of the IMU
    columns = rr.Ellipsoids3D.columns(centers=np.zeros((len(T), 3)), half_sizes=axes, quaternions=turns)
    recording.log(f"{place}/ellipsoid", rr.Ellipsoids3D.from_fields(colors=[color]), static=True)
    _send(recording, f"{place}/ellipsoid", time_s, columns)
    T_imu_cam, camera = se3.inverse(result.T_cam_imu), result.camera
    placed = rr.Transform3D(translation=T_imu_cam[:3, 3], mat3x3=T_imu_cam[:3, :3])
    focal, centre = [camera.fu_px, camera.fv_px], [camera.cu_px, camera.cv_px]
    size = [2 * camera.cu_px, 2 * camera.cv_px]  # archives do not hold the size of images
    pinhole = rr.Pinhole(focal_length=focal, principal_point=centre, resolution=size, image_plane_distance=1.0)
    recording.log(f"{place}/camera", placed, pinhole, static=True)


def _log_landmarks(recording: Any, place: str, result: Result) -> None:
    rr = _rerun()
    landmarks, color = result.landmarks, _bytes(LANDMARK_COLOR)
    position = landmarks.position_m
    recording.log(place, rr.Points3D(position, colors=[color], radii=[rr.Radius.ui_points(1.5)]), static=True)
    some = spread(len(landmarks), _ELLIPSOIDS)
    axes, turns = ellipsoids(landmarks.covariance[some])
    drawn = rr.Ellipsoids3D(centers=position[some], half_sizes=axes, quaternions=turns, colors=[color])
    recording.log(f"{place}/ellipsoids", drawn, static=True)


def _log_scalars(recording: Any, part: str, archive: Archive, result: Result, time_s: Array) -> None:
    rr = _rerun()
    truth, innovation = archive.truth, result.innovation
    if truth is not None and len(truth.frame):
        error = world_axes_errors(result.T_world_imu[truth.frame], truth.T_world_imu)[:, :3]
        columns = rr.Scalars.columns(scalars=np.linalg.norm(error, axis=1))
        _send(recording, f"errors/{part}", time_s[truth.frame], columns)
    seen = innovation.dof > 0
    if seen.any():
        columns = rr.Scalars.columns(scalars=innovation.nis[seen] / innovation.dof[seen])
        _send(recording, f"nis/{part}", time_s[seen], columns)


def _send(recording: Any, place: str, time_s: Array, columns: Any) -> None:
    """Send values over time."""
    recording.send_columns(place, indexes=[_rerun().TimeColumn("time", duration=time_s)], columns=columns)


def ellipsoids(covariance: Array) -> tuple[Array, Array]:
    """Return half axes (n, 3) of `SIGMAS` and quaternions (n, 4), scalar last, of covariances (n, 3, 3)."""
    values, vectors = np.linalg.eigh(covariance)
    vectors = vectors * np.sign(np.linalg.det(vectors))[:, None, None]
    turns = Rotation.from_matrix(vectors).as_quat()
    return (SIGMAS * np.sqrt(np.maximum(values, 0.0))).astype(np.float32), turns.astype(np.float32)


def _bytes(color: Any) -> tuple[int, ...]:
    return tuple(round(255 * value) for value in to_rgb(color))


def _new_recording(name: str) -> Any:
    return _rerun().RecordingStream(f"ekfslam {name}")


def _rerun() -> Any:
    try:
        import rerun
    except ImportError:
        raise MissingPackageError("rerun-sdk", "viewer", "the viewer") from None
    return rerun
