"""The .npz recordings of the report (and of the later, dense and noisy edition): clean or noisy KITTI velocities and
stereo tracks, without ground truth."""

from __future__ import annotations

import math
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.interpolation import interpolation_attributes, interpolation_notes
from ekfslam.data.readers.fields import (
    LATERAL_NOTES,
    checksum,
    flat_observations,
    require_numbers,
    spelled_as_in,
    with_lateral,
)
from ekfslam.data.readers.registry import Extrinsics, Lateral, Reader
from ekfslam.data.sequence import LEVEL_VELOCITIES_NOTE, Sequence, validate_camera
from ekfslam.data.tracks import inspect_tracks
from ekfslam.errors import CalibrationError, UnknownFormatError
from ekfslam.geometry.camera import StereoCamera
from ekfslam.limits import Budget, require_file

FIELDS = ("features", "time_stamps", "linear_velocity", "rotational_velocity", "K", "b", "cam_T_imu")

_EXTRINSICS_NOTES: dict[Extrinsics, str] = {
    "corrected": (
        "The stored cam_T_imu = [R, t] holds the camera's position t in the IMU frame; T_cam_imu = [R, -R t] is used."
    ),
    "as-stored": (
        "The stored cam_T_imu = [R, t] is used as T_cam_imu, as in the report, although t is the camera's position in "
        "the IMU frame."
    ),
}


def read_ece276a(path: Path, extrinsics: Extrinsics = "corrected", lateral: Lateral = "corrected") -> Sequence:
    """Read ``features`` (4 x M x T, -1 where unseen), velocities (3 x T), stamps (1 x T), ``K``, ``b``, ``cam_T_imu``.

    Args:
        path: The .npz file.
        extrinsics: ``corrected`` takes ``T_cam_imu = [R, -R t]`` from the stored rotation and translation;
            ``as-stored`` takes the stored matrix, which reproduces the report.
        lateral: Sign of the lateral velocity, see `with_lateral`; ``as-stored`` reproduces the report.

    Raises:
        UnknownFormatError: The file is damaged, or an .npz of other content.
        DataError: A field is missing or malformed; the subclass says how.
    """
    source = str(path)
    fields = _load(path)
    with spelled_as_in(source, {"time_s": "time_stamps", "T_cam_imu": "cam_T_imu", "baseline": "b"}):
        time_s = require_numbers(fields, "time_stamps", (1, None))[0]
        frames = len(time_s)
        twist = np.concatenate(
            [require_numbers(fields, name, (3, frames)) for name in ("linear_velocity", "rotational_velocity")]
        ).T
        twist = with_lateral(twist, lateral)
        camera = _camera(require_numbers(fields, "K", (3, 3)), float(require_numbers(fields, "b", ())))
        stored = require_numbers(fields, "cam_T_imu", (4, 4))
        observations = flat_observations(
            require_numbers(fields, "features", (4, None, frames)), frame_axis=2, field="features"
        )
        return Sequence(
            name=path.stem,
            source=source,
            time_s=time_s,
            twist=twist,
            camera=camera,
            T_cam_imu=stored if extrinsics == "as-stored" else _with_camera_position(stored),
            observations=observations,
            velocity_frame="level",
            notes=(
                _EXTRINSICS_NOTES[extrinsics],
                LEVEL_VELOCITIES_NOTE,
                LATERAL_NOTES[lateral],
                *interpolation_notes(twist),
                *inspect_tracks(observations, twist).notes,
            ),
            attributes={
                "checksum_sha256": checksum(path),
                "reader": READER.name,
                "extrinsics": extrinsics,
                "lateral": lateral,
                **interpolation_attributes(twist),
            },
        )


def _load(path: Path) -> dict[str, np.ndarray]:
    expected = f"expected an .npz file with the fields {', '.join(FIELDS)}"
    try:
        _inspect(path)
        with np.load(path, allow_pickle=False) as file:
            names = file.files
            fields = {name: file[name] for name in FIELDS if name in names} if "features" in names else {}
    except UnknownFormatError:
        raise
    except Exception as error:  # a damaged file makes the decoders raise almost anything
        raise UnknownFormatError(f"{path}: damaged .npz file ({error}); {expected}") from None
    if not fields:
        raise UnknownFormatError(f"{path}: an .npz file with the fields [{', '.join(names)}]; {expected}")
    return fields


def _inspect(path: Path) -> None:
    """Refuse arrays that claim more than may be read, or other than they have, before they are decompressed."""
    require_file(path)
    budget = Budget(str(path))
    with ZipFile(path) as archive:
        for entry in archive.infolist():
            if entry.filename.removesuffix(".npy") not in FIELDS:
                continue
            budget.take(entry.file_size, entry.filename)
            if entry.compress_type not in (ZIP_STORED, ZIP_DEFLATED):
                raise ValueError(f"{entry.filename} is compressed in a way that no .npz is")
            with archive.open(entry) as file:
                version = np.lib.format.read_magic(file)
                header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
                shape, _, dtype = header[version](file)
            if math.prod(shape) * dtype.itemsize > entry.file_size:
                raise ValueError(f"{entry.filename} claims the shape {shape}, but has {entry.file_size} bytes")


def _camera(K: Array, baseline_m: float) -> StereoCamera:
    if abs(np.linalg.det(K)) < 1e-9:
        raise CalibrationError("the intrinsic matrix is singular", field="K")
    pinhole = np.array([[K[0, 0], 0, K[0, 2]], [0, K[1, 1], K[1, 2]], [0, 0, 1]])
    wrong = np.argwhere(pinhole != K)
    if len(wrong):
        index = tuple(int(i) for i in wrong[0])
        raise CalibrationError(
            f"found {K[index]:g}, but only [[fu, 0, cu], [0, fv, cv], [0, 0, 1]] without skew is supported",
            field="K",
            index=index,
        )
    camera = StereoCamera(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), baseline_m)
    validate_camera(camera)
    return camera


def _with_camera_position(stored: Array) -> Array:
    """``T_cam_imu`` from its rotation and the position of the camera in the IMU frame."""
    corrected = stored.copy()
    corrected[:3, 3] = -stored[:3, :3] @ stored[:3, 3]
    return corrected


READER = Reader(
    "ece276a",
    "an .npz recording (ECE 276A)",
    lambda source: source.head.startswith(b"PK\x03\x04"),
    lambda source: read_ece276a(source.path, source.extrinsics, source.lateral),
)
