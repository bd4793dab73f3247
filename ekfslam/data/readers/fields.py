"""Named fields of a file, checked one by one, and conventions that several formats share."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ekfslam.arrays import Array
from ekfslam.data.checks import require_finite, require_shape
from ekfslam.data.inputs import VelocityFrame
from ekfslam.data.interpolation import interpolation_attributes, interpolation_notes
from ekfslam.data.observations import Observations
from ekfslam.data.readers.registry import Lateral
from ekfslam.data.sequence import Sequence
from ekfslam.data.tracks import inspect_tracks
from ekfslam.errors import ShapeError
from ekfslam.geometry.camera import StereoCamera

BODY_IS_CAMERA = "The body is the left camera, with axes forward, left and up."
LATERAL_NOTES: dict[Lateral, str] = {
    "corrected": (
        "The lateral velocity is stored positive to the right, against the description of its format: it is negated."
    ),
    "as-stored": "The lateral velocity is used as stored, although it is positive to the right.",
}


def checksum(*paths: Path) -> str:
    """Return the SHA-256 of the contents of files in their order, hexadecimal."""
    digest = hashlib.sha256()
    for path in paths:
        with path.open("rb") as file:
            while part := file.read(1 << 20):
                digest.update(part)
    return digest.hexdigest()


def require(fields: Mapping[str, Any], name: str) -> NDArray:
    """Return a field of a file as an array of any type."""
    if name not in fields:
        raise ShapeError("this field is missing", field=name)
    try:
        return np.asarray(fields[name])
    except (ValueError, RecursionError):
        raise ShapeError("a list of lists of different lengths", field=name) from None


def require_numbers(
    fields: Mapping[str, Any], name: str, shape: tuple[int | None, ...], dtype: type = np.float64, finite: bool = True
) -> NDArray:
    """Return a field of a file as numbers of a shape (None stands for any length) and type, finite by default."""
    value = require(fields, name)
    if value.dtype.kind not in ("iu" if np.issubdtype(dtype, np.integer) else "iuf"):
        raise ShapeError(f"expected {np.dtype(dtype).name} numbers, found {value.dtype}", field=name)
    require_shape(value, shape, name)
    if finite and value.dtype.kind == "f":
        require_finite(value, name)
    return value.astype(dtype, copy=False)


def with_lateral(level_twist: Array, lateral: Lateral) -> Array:
    """Return level velocities (..., 6) of KITTI with the lateral one to the left: ``corrected`` negates it.

    The data format calls ``vl`` leftward, but on every drive it opposes the true lateral velocity, and already the
    first packet of 2011_09_26_drive_0001 contradicts its own velocity north and east. All other signs are right.
    """
    return level_twist if lateral == "as-stored" else level_twist * np.array([1.0, -1.0, 1.0, 1.0, 1.0, 1.0])


def recorded_tracks(
    path: Path,
    reader: str,
    time_s: Array,
    twist: Array,
    camera: StereoCamera,
    T_cam_imu: Array,
    observations: Observations,
    notes: tuple[str, ...],
    attributes: Mapping[str, str],
    velocity_frame: VelocityFrame = "level",
    **truth_and_noise: Any,
) -> Sequence:
    """Return a recording of one file, with notes on its velocities and tracks and its checksum among the attributes."""
    facts = {"checksum_sha256": checksum(path), "reader": reader, **attributes, **interpolation_attributes(twist)}
    return Sequence(
        path.stem,
        str(path),
        time_s,
        twist=twist,
        camera=camera,
        T_cam_imu=T_cam_imu,
        observations=observations,
        velocity_frame=velocity_frame,
        notes=(*notes, *interpolation_notes(twist), *inspect_tracks(observations, twist).notes),
        attributes=facts,
        **truth_and_noise,
    )
