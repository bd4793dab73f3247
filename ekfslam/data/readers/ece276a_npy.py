"""The .npy recordings of the course from 2025 on: a pickled dictionary, with two cameras in an IMU frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.dense import flat_observations
from ekfslam.data.interpolation import interpolation_attributes, interpolation_notes
from ekfslam.data.readers.ece276a import AS_STORED_NOTE, camera_of, stamps_of
from ekfslam.data.readers.fields import checksum, require, require_numbers, spelled_as_in
from ekfslam.data.readers.pickled import MAGIC, read_pickled
from ekfslam.data.readers.registry import Reader
from ekfslam.data.sequence import LEVEL_VELOCITIES_NOTE, Sequence, require_rigid
from ekfslam.data.tracks import inspect_tracks
from ekfslam.errors import CalibrationError, ExtrinsicsError, ShapeError, UnknownFormatError
from ekfslam.geometry import se3
from ekfslam.geometry.camera import R_CAM_BODY, StereoCamera

FIELDS = ("v_t", "w_t", "timestamps", "features", "K_l", "K_r", "extL_T_imu", "extR_T_imu")
EXPECTED = f"expected an .npy file with a dictionary of {', '.join(FIELDS)}"
IMAGE_FIELDS = ("cam_imgs_L", "cam_imgs_R")

_EXTRINSICS_NOTE = (
    "The stored extL_T_imu is a pose of the left camera with axes forward, left, up: T_cam_imu = oTr inv(extL_T_imu) "
    "is used, and the distance of both cameras as the baseline."
)


def read_ece276a_npy(path: Path) -> Sequence:
    """Read ``v_t w_t`` (T x 3), ``timestamps``, ``features`` (4 x M x T), ``K_l K_r extL_T_imu extR_T_imu``.

    ``T_cam_imu = oTr inv(extL_T_imu)`` with the optical axes oTr, and the baseline is the length of the translation of
    ``inv(extL_T_imu) extR_T_imu``. A pixel row is unseen where it is -1 or NaN.

    Raises:
        UnknownFormatError: The file is damaged, names other things than arrays, or holds another dictionary.
        DataError: A field is missing or malformed; the subclass says how.
    """
    fields = read_pickled(path, EXPECTED)
    if "v_t" not in fields:
        hint = " of images; give the recording beside it" if IMAGE_FIELDS[0] in fields else ""
        raise UnknownFormatError(f"{path}: an .npy file{hint} with the fields [{', '.join(fields)}]; {EXPECTED}")
    with spelled_as_in(str(path), {"time_s": "timestamps", "T_cam_imu": "extL_T_imu", "K": "K_l"}):
        time_s, twist = motion_of(fields)
        camera, T_cam_imu = _rig(fields)
        if fields.get("features") is None:
            raise ShapeError("this field is missing: the recording has images only, see `track`", field="features")
        frames = len(time_s)
        features = require_numbers(fields, "features", (4, None, frames), finite=False)
        observations, found = flat_observations(features, frame_axis=2, field="features")
        return Sequence(
            name=path.stem,
            source=str(path),
            time_s=time_s,
            twist=twist,
            camera=camera,
            T_cam_imu=T_cam_imu,
            observations=observations,
            velocity_frame="level",
            notes=(
                *notes_of(twist),
                *found,
                *inspect_tracks(observations, twist).notes,
            ),
            attributes=attributes_of(path, twist),
        )


def motion_of(fields: dict[str, Any]) -> tuple[Array, Array]:
    """Stamps (T,) and velocities (T, 6) of a recording, whose velocities are T x 3 or 3 x T."""
    time_s = stamps_of(fields, "timestamps")
    frames = len(time_s)
    velocities = []
    for name in ("v_t", "w_t"):
        is_wide = require(fields, name).shape == (3, frames) != (frames, 3)
        value = require_numbers(fields, name, (3, frames) if is_wide else (frames, 3))
        velocities.append(value.T if is_wide else value)
    return time_s, np.concatenate(velocities, axis=1)


def notes_of(twist: Array) -> tuple[str, ...]:
    """What was made of the fields that this edition has, tracks or images."""
    return (_EXTRINSICS_NOTE, LEVEL_VELOCITIES_NOTE, AS_STORED_NOTE, *interpolation_notes(twist))


def attributes_of(path: Path, twist: Array) -> dict[str, str | int | float]:
    """Facts that are kept with every result of this edition."""
    return {
        "checksum_sha256": checksum(path),
        "reader": READER.name,
        "lateral": "as-stored",
        **interpolation_attributes(twist),
    }


def extrinsics_of(fields: dict[str, Any]) -> tuple[Array, Array]:
    """``T_cam_imu`` (4, 4) of the left optical frame, and ``T_right_left`` (4, 4) of the optical frames.

    Raises:
        DataError: A pose is missing or not rigid, or both cameras are at one place.
    """
    optical = se3.transform(R_CAM_BODY, np.zeros(3))
    left, right = (require_numbers(fields, name, (4, 4)) for name in ("extL_T_imu", "extR_T_imu"))
    for name, pose in (("extL_T_imu", left), ("extR_T_imu", right)):
        require_rigid(pose, name, ExtrinsicsError)
    T_right_left = optical @ se3.inverse(right) @ left @ se3.inverse(optical)
    if not np.linalg.norm(T_right_left[:3, 3]) > 1e-6:
        raise CalibrationError("both cameras are at the same place", field="extR_T_imu")
    return optical @ se3.inverse(left), T_right_left


def _rig(fields: dict[str, Any]) -> tuple[StereoCamera, Array]:
    """Camera and ``T_cam_imu`` of features, which are those of a rectified pair."""
    T_cam_imu, T_right_left = extrinsics_of(fields)
    baseline_m = float(np.linalg.norm(T_right_left[:3, 3]))
    K_left, K_right = (require_numbers(fields, name, (3, 3)) for name in ("K_l", "K_r"))
    camera = camera_of(K_left, baseline_m)
    if not np.allclose(K_left, K_right, rtol=1e-3):
        raise CalibrationError(
            "the cameras have different intrinsics, so their features are not rectified", field="K_r"
        )
    return camera, T_cam_imu


READER = Reader(
    "ece276a_npy",
    "an .npy recording (ECE 276A)",
    lambda source: source.head.startswith(MAGIC),
    lambda source: read_ece276a_npy(source.path),
)
