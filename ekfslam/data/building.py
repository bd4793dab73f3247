"""`Sequence.from_tracks`: a recording from plain arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ekfslam.arrays import Array, IntArray
from ekfslam.data.dense import flat_observations
from ekfslam.data.inputs import InertialSamples, VelocityFrame
from ekfslam.data.noise import Noise
from ekfslam.data.sequence import (
    WITHOUT_VELOCITIES,
    Observations,
    Sequence,
    Truth,
    require_finite,
    require_shape,
    validate_stamps,
)
from ekfslam.errors import ExtrinsicsError, ShapeError
from ekfslam.geometry import se3
from ekfslam.geometry.camera import R_CAM_BODY, StereoCamera

SOURCE = "arrays"


def from_tracks(
    time_s: ArrayLike,
    pixels_px: ArrayLike,
    frame: ArrayLike | None,
    landmark: ArrayLike | None,
    twist: ArrayLike | None,
    imu: InertialSamples | None,
    T_cam_imu: ArrayLike | None,
    T_world_imu: ArrayLike | None,
    *,
    camera: StereoCamera,
    velocity_frame: VelocityFrame,
    noise: Noise | None,
    name: str,
) -> Sequence:
    """See `Sequence.from_tracks`."""
    stamps = _numbers(time_s, "time_s")
    validate_stamps(stamps)
    if T_cam_imu is None:
        if twist is not None or imu is not None:
            raise ExtrinsicsError(
                "velocities and inertial samples need the pose of the camera in their frame", field="T_cam_imu"
            )
        T_cam_imu = se3.transform(R_CAM_BODY, np.zeros(3))
    observations, notes = _observations(_numbers(pixels_px, "pixels_px"), frame, landmark, len(stamps))
    return Sequence(
        name=name,
        source=SOURCE,
        time_s=stamps,
        inputs=() if imu is None else (imu,),
        twist=None if twist is None else _numbers(twist, "twist"),
        camera=camera,
        T_cam_imu=_numbers(T_cam_imu, "T_cam_imu"),
        observations=observations,
        truth=None if T_world_imu is None else _truth(_numbers(T_world_imu, "T_world_imu"), len(stamps)),
        noise=noise,
        velocity_frame=velocity_frame,
        notes=notes,
        attributes=WITHOUT_VELOCITIES if twist is None else {},
    )


def _numbers(value: ArrayLike, name: str) -> Array:
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise ShapeError(f"not an array of numbers ({error})", field=name) from None


def _observations(
    pixels: Array, frame: ArrayLike | None, landmark: ArrayLike | None, frames: int
) -> tuple[Observations, tuple[str, ...]]:
    if frame is None and landmark is None:
        require_shape(pixels, (frames, None, 4), "pixels_px")
        return flat_observations(np.moveaxis(pixels, -1, 0), frame_axis=1, field="pixels_px")
    if frame is None or landmark is None:
        raise ShapeError("frame and landmark belong together", field="landmark" if landmark is None else "frame")
    require_shape(pixels, (None, 4), "pixels_px")
    numbers: list[IntArray] = []
    for name, value in (("frame", frame), ("landmark", landmark)):
        whole = _numbers(value, name)
        require_shape(whole, (len(pixels),), name)
        require_finite(whole, name)
        if (whole != np.round(whole)).any():
            raise ShapeError("not whole numbers", field=name, index=int(np.argmax(whole != np.round(whole))))
        numbers.append(np.asarray(value).astype(np.int64))
    return Observations(numbers[0], numbers[1], pixels), ()


def _truth(T_world_imu: Array, frames: int) -> Truth | None:
    """The poses that are known: those without NaN."""
    require_shape(T_world_imu, (frames, 4, 4), "T_world_imu")
    known = np.flatnonzero(~np.isnan(T_world_imu).any(axis=(1, 2)))
    return Truth(known, T_world_imu[known]) if len(known) else None
