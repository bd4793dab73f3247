"""The .npz recordings of the report and of later editions: KITTI velocities and stereo tracks, without ground truth."""

from __future__ import annotations

import math
from collections.abc import Container, Mapping
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile

import numpy as np
from numpy.typing import NDArray

from ekfslam.arrays import Array
from ekfslam.data.checks import require_rigid, spelled_as_in
from ekfslam.data.observations import flat_observations
from ekfslam.data.readers.fields import LATERAL_NOTES, recorded_tracks, require, require_numbers, with_lateral
from ekfslam.data.readers.pickled import npy_header
from ekfslam.data.readers.registry import Extrinsics, Lateral, Reader
from ekfslam.data.sequence import LEVEL_VELOCITIES_NOTE, Sequence, validate_camera
from ekfslam.errors import CalibrationError, ExtrinsicsError, UnknownFormatError
from ekfslam.geometry import se3
from ekfslam.geometry.camera import StereoCamera
from ekfslam.limits import Budget, require_file

_ENTRY, _MOST_ENTRIES = b"PK\x01\x02", 10_000  # mark of an entry in the directory of a zip file
_COMMON = ("features", "time_stamps", "linear_velocity", "K", "b")
FIELDS = (*_COMMON, "rotational_velocity", "cam_T_imu")
LATER_FIELDS = (*_COMMON, "angular_velocity", "imu_T_cam")
_KNOWN = tuple(dict.fromkeys(FIELDS + LATER_FIELDS))

_EXTRINSICS_NOTES: dict[Extrinsics, str] = {
    "corrected": (
        "The stored cam_T_imu = [R, t] holds the camera's position t in the IMU frame; T_cam_imu = [R, -R t] is used."
    ),
    "as-stored": "The stored cam_T_imu = [R, t] is used as T_cam_imu, as in the report, although t is the camera's "
    "position in the IMU frame.",
}
_LATER_NOTE = (
    "The stored imu_T_cam is a pose in an IMU frame forward, right, down, while the velocities are forward, left, up: "
    "T_cam_imu = inv(imu_T_cam) diag(1, -1, -1, 1) is used."
)
AS_STORED_NOTE = "The lateral velocity is used as stored: no wrong sign is known in this edition."
_FLIPPED = np.diag([1.0, -1.0, -1.0, 1.0])


def read_ece276a(path: Path, extrinsics: Extrinsics = "corrected", lateral: Lateral = "corrected") -> Sequence:
    """Read ``features`` (4 x M x T, -1 or NaN where unseen), velocities (3 x T), stamps, ``K``, ``b``, extrinsics.

    The edition of the report has ``rotational_velocity`` and ``cam_T_imu``. The later one, of KITTI-360, has
    ``angular_velocity`` and ``imu_T_cam``, a true camera-to-IMU pose; it ignores both options.

    Args:
        extrinsics: ``corrected`` takes ``T_cam_imu = [R, -R t]`` from the stored rotation and translation;
            ``as-stored`` takes the stored matrix, which reproduces the report.
        lateral: Sign of the lateral velocity, see `with_lateral`; ``as-stored`` reproduces the report.
    """
    fields = _load(path)
    is_later = FIELDS[-1] not in fields and any(name in fields for name in LATER_FIELDS[-2:])
    turning, stored_name = LATER_FIELDS[-2:] if is_later else FIELDS[-2:]
    with spelled_as_in(str(path), {"time_s": "time_stamps", "T_cam_imu": stored_name, "baseline": "b"}):
        time_s = stamps_of(fields, "time_stamps")
        frames, names = len(time_s), ("linear_velocity", turning)
        twist = np.concatenate([require_numbers(fields, name, (3, frames)) for name in names]).T
        camera = camera_of(require_numbers(fields, "K", (3, 3)), float(require_numbers(fields, "b", ())))
        stored = require_numbers(fields, stored_name, (4, 4))
        features = require_numbers(fields, "features", (4, None, frames), finite=False)
        observations, found = flat_observations(features, frame_axis=2, field="features")
        choices: dict[str, str]
        if is_later:
            require_rigid(stored, stored_name, ExtrinsicsError)
            T_cam_imu, choices = se3.inverse(stored) @ _FLIPPED, {"lateral": "as-stored"}
            how, sign = _LATER_NOTE, AS_STORED_NOTE
        else:
            twist, choices = with_lateral(twist, lateral), {"extrinsics": extrinsics, "lateral": lateral}
            T_cam_imu = stored.copy()
            if extrinsics == "corrected":
                T_cam_imu[:3, 3] = -stored[:3, :3] @ stored[:3, 3]
            how, sign = _EXTRINSICS_NOTES[extrinsics], LATERAL_NOTES[lateral]
        notes = (how, LEVEL_VELOCITIES_NOTE, sign, *found)
        return recorded_tracks(path, READER.name, time_s, twist, camera, T_cam_imu, observations, notes, choices)


def stamps_of(fields: Mapping[str, NDArray], name: str) -> Array:
    """Return the stamps (T,) of a field that is a row, a column or a vector."""
    shape = require(fields, name).shape
    vector = (None,) if len(shape) == 1 else (None, 1) if len(shape) == 2 and shape[1] == 1 else (1, None)
    return require_numbers(fields, name, vector).ravel()


def _load(path: Path) -> dict[str, np.ndarray]:
    expected = f"expected an .npz file with the fields {', '.join(FIELDS)}"
    try:
        inspect_npz(path, _KNOWN)
        with np.load(path, allow_pickle=False) as file:
            names = file.files
            fields = {name: file[name] for name in _KNOWN if name in names} if "features" in names else {}
    except UnknownFormatError:
        raise
    except Exception as error:  # a damaged file makes the decoders raise almost anything
        raise UnknownFormatError(f"{path}: damaged .npz file ({error}); {expected}") from None
    if not fields:
        raise UnknownFormatError(f"{path}: an .npz file with the fields [{', '.join(names)}]; {expected}")
    return fields


def inspect_npz(path: Path, known: Container[str]) -> None:
    """Refuse known arrays that claim too much memory, or more than they have, before they are decompressed."""
    require_file(path)
    budget = Budget(str(path))
    with path.open("rb") as file:
        count = sum(piece.count(_ENTRY) for piece in iter(lambda: file.read(1 << 24), b""))
    if count > _MOST_ENTRIES:
        raise UnknownFormatError(f"{path}: a zip file of {count} entries, which no .npz is")
    with ZipFile(path) as archive:
        for entry in archive.infolist():
            if entry.filename.removesuffix(".npy") not in known:
                continue
            budget.take(entry.file_size, entry.filename)
            if entry.compress_type not in (ZIP_STORED, ZIP_DEFLATED):
                raise ValueError(f"{entry.filename} is compressed in a way that no .npz is")
            with archive.open(entry) as file:
                shape, dtype = npy_header(file)
            if math.prod(shape) * dtype.itemsize > entry.file_size:
                raise ValueError(f"{entry.filename} claims the shape {shape}, but has {entry.file_size} bytes")


def camera_of(K: Array, baseline_m: float) -> StereoCamera:
    """Return the camera of an intrinsic matrix (3, 3); raise `DataError` if it is none, or has skew."""
    if abs(np.linalg.det(K)) < 1e-9:
        raise CalibrationError("the intrinsic matrix is singular", field="K")
    pinhole = np.array([[K[0, 0], 0, K[0, 2]], [0, K[1, 1], K[1, 2]], [0, 0, 1]])
    wrong = np.argwhere(pinhole != K)
    if len(wrong):
        index = tuple(int(i) for i in wrong[0])
        message = f"found {K[index]:g}, but only [[fu, 0, cu], [0, fv, cv], [0, 0, 1]] without skew is supported"
        raise CalibrationError(message, field="K", index=index)
    camera = StereoCamera(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), baseline_m)
    validate_camera(camera)
    return camera


READER = Reader(
    "ece276a",
    "an .npz recording (ECE 276A)",
    lambda source: source.head.startswith(b"PK\x03\x04"),
    lambda source: read_ece276a(source.path, source.extrinsics, source.lateral),
)
