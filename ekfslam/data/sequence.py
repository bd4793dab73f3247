"""The validated recording that readers return and filters take: `Sequence` checks all its fields."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from ekfslam.arrays import Array, BoolArray
from ekfslam.data.checks import LARGEST_PX, checked_pose, frozen, require_finite, spelled_as_in, validate_stamps
from ekfslam.data.inertial import inertial_notes
from ekfslam.data.inputs import InertialSamples, Input, Velocities, VelocityFrame, validate_inputs
from ekfslam.data.interpolation import INTERPOLATED, attributes_of_part, known_intervals
from ekfslam.data.interval import Interval
from ekfslam.data.noise import Noise, validate_noise
from ekfslam.data.observations import (
    Observations,
    Truth,
    numbers,
    observations_of,
    truth_of,
    validate_observations,
    validate_truth,
)
from ekfslam.data.once import Once
from ekfslam.errors import CalibrationError, ExtrinsicsError, LostDataError, ShapeError
from ekfslam.geometry import se3
from ekfslam.geometry.camera import T_CAM_BODY, StereoCamera
from ekfslam.names import printable
from ekfslam.shown import Card, Shown, count, figure
from ekfslam.stored import stored

# Attributes of a recording that has no tracks by its nature; in any other, no observation at all is a defect.
WITHOUT_TRACKS = {"tracks": "none"}
# Attributes of a recording whose tracks are compared with their first sight in every frame: those of `frontend`.
CHECKED_TRACKS = {"tracks": "checked"}
# Attribute of such a recording: standard deviation of the yaw of the right camera that the front end took out.
YAW_STD_PX = "right_camera_yaw_std_px"
# Attributes of a recording whose velocities were not measured. Any it has are those of its own odometry.
WITHOUT_VELOCITIES = {"velocities": "none"}
# Velocities that were measured, if only one kind was: the others are those of stereo odometry.
MEASURED_KINDS = ("linear", "angular")
# Attribute with the noise that a sensor states of its velocities: six numbers, m/s and rad/s.
TWIST_STD = "twist_std"

LEVEL_VELOCITIES_NOTE = (
    "The velocities are forward, left and up over level ground, whatever the vehicle's roll and pitch: full SLAM "
    "estimates these, dead reckoning takes them as none."
)


@dataclass(frozen=True, repr=False, init=False)
class Sequence(Once, Shown):
    """One recording of a stereo rig or of one camera, with velocities or inertial samples of its body.

    Args:
        name: Short name for folders and titles; characters that cannot be printed are escaped (``\\x1b``).
        source: File or built-in world, named in error messages.
        time_s: (T,) strictly increasing stamps.
        camera: Intrinsics; with one camera, the baseline becomes 0.
        T_cam_imu: (4, 4) extrinsics, IMU to left optical frame; made rigid to rounding, as files print few digits.
        observations: Observations by two cameras or one; none only if the attributes contain `WITHOUT_TRACKS`.
        truth: Ground truth, if there is any.
        noise: Noise that the source states, if it states any.
        inputs: Velocities and inertial samples, at any rate and from any number of sources.
        twist: (T, 6) velocities ``[v; w]``, short for an input `Velocities` at the stamps of the frames;
            ``twist[k]`` drives ``(t[k-1], t[k]]``. It replaces the velocities among the inputs; None keeps them.
        velocity_frame: Frame of the velocities, see `Velocities`. None keeps it, and is ``imu`` for a new ``twist``.
        notes: Findings and repairs of the reader, one sentence each.
        attributes: Further facts that every result keeps (seed, checksum, simulation parameters).
    """

    name: str
    source: str
    time_s: Array = field(metadata=stored("T", "s", "clock of the recording", name="time"))
    camera: StereoCamera
    T_cam_imu: Array = field(metadata=stored("row column", "m (translation)", "cam from imu"))
    observations: Observations
    truth: Truth | None
    noise: Noise | None
    inputs: tuple[Input, ...]
    notes: tuple[str, ...]
    attributes: Mapping[str, str | int | float]

    def __init__(
        self,
        name: str,
        source: str,
        time_s: ArrayLike,
        *,
        camera: StereoCamera,
        T_cam_imu: ArrayLike,
        observations: Observations,
        truth: Truth | None = None,
        noise: Noise | None = None,
        inputs: tuple[Input, ...] = (),
        twist: ArrayLike | None = None,
        velocity_frame: VelocityFrame | None = None,
        notes: tuple[str, ...] = (),
        attributes: Mapping[str, str | int | float] | None = None,
    ) -> None:
        given: dict[str, object] = {"name": printable(name), "source": source, "notes": notes}
        given |= {"time_s": frozen(np.asarray(time_s, dtype=float)), "attributes": attributes or {}}
        given |= {"camera": replace(camera, baseline_m=0.0) if observations.is_monocular else camera}
        given |= {"observations": observations, "truth": truth, "noise": noise}
        for field_name, value in given.items():
            object.__setattr__(self, field_name, value)
        with spelled_as_in(source):
            validate_stamps(self.time_s)
            object.__setattr__(self, "inputs", _with_twist(self, tuple(inputs), twist, velocity_frame))
            validate_inputs(self.inputs, self.time_s)
            validate_camera(self.camera, is_stereo=not observations.is_monocular)
            object.__setattr__(self, "T_cam_imu", checked_pose(T_cam_imu, "T_cam_imu"))
            if len(observations) or self.attributes.get("tracks") != WITHOUT_TRACKS["tracks"]:
                validate_observations(observations, len(self))
            if truth is not None:
                validate_truth(truth, len(self))
            if noise is not None:
                validate_noise(noise)

    def __len__(self) -> int:
        return len(self.time_s)

    def card(self) -> Card:
        seconds, seen = float(self.time_s[-1] - self.time_s[0]), self.observations
        per_frame = figure(len(seen) / len(self))
        facts = {
            "source": self.source,
            "frames": f"{len(self)}, {figure(seconds)} s",
            "tracks": f"{count(len(seen.ids), 'landmark')}, {per_frame} a frame{', one camera' * seen.is_monocular}",
            "truth": "none" if self.truth is None else self.truth.text,
            "noise": "not stated" if self.noise is None else "stated",
        }
        facts |= {"notes": count(len(self.notes), "sentence") + " in .notes"} if self.notes else {}
        return Card(self.name, facts, ("ekfslam.run(sequence)", "sequence[100:300]", "sequence.between(10.0, 20.0)"))

    def __getitem__(self, frames: slice) -> Sequence:
        """Return a stretch of successive frames, ``sequence[100:300]``, as a recording whose frames count from 0.

        Raise `ShapeError` for anything but a slice of some frames, `EmptyTracksError` if they see no landmark.
        """
        if not isinstance(frames, slice) or frames.step not in (None, 1):
            raise ShapeError("only a stretch of successive frames can be taken, such as sequence[100:300]")
        begin, end, _ = frames.indices(len(self))
        if begin >= end:
            raise ShapeError(f"there are no frames {begin}:{end}, the sequence has {len(self)}", source=self.source)
        return replace(
            self,
            time_s=self.time_s[begin:end],
            inputs=tuple(samples.between(self.time_s[begin], self.time_s[end - 1]) for samples in self.inputs),
            observations=self.observations.stretch(begin, end),
            truth=None if self.truth is None else self.truth.stretch(begin, end),
            attributes={
                **attributes_of_part(self.attributes, self.interpolated[begin:end]),
                "first_frame": int(self.attributes.get("first_frame", 0)) + begin,
            },
        )

    @staticmethod
    def from_tracks(
        time_s: ArrayLike,
        pixels_px: ArrayLike,
        camera: StereoCamera,
        *,
        frame: ArrayLike | None = None,
        landmark: ArrayLike | None = None,
        twist: ArrayLike | None = None,
        imu: InertialSamples | None = None,
        T_cam_imu: ArrayLike | None = None,
        T_world_imu: ArrayLike | None = None,
        velocity_frame: VelocityFrame = "imu",
        noise: Noise | None = None,
        name: str = "tracks",
    ) -> Sequence:
        """Build a recording from arrays; raise a `DataError` if one is malformed, or does not fit the others.

        Args:
            time_s: (T,) stamps.
            pixels_px: (T, M, 4) pixels (uL, vL, uR, vR) of M tracks, NaN if unseen; or (K, 4) with ``frame`` and
                ``landmark``. Tracks of one camera have 2 columns (u, v), undistorted.
            frame, landmark: (K,) frame index and id of each row of pixels.
            twist: (T, 6) measured velocities, see `Sequence`.
            imu: Samples of a gyroscope and an accelerometer.
            T_cam_imu: (4, 4), required with ``twist`` or ``imu``. By default the body is the left camera, with axes
                forward, left and up.
            T_world_imu: (T, 4, 4) true poses, NaN if unknown.
            camera, velocity_frame, noise, name: See `Sequence`.
        """
        stamps = numbers(time_s, "time_s")
        validate_stamps(stamps)
        observations, notes = observations_of(numbers(pixels_px, "pixels_px"), frame, landmark, len(stamps))
        return Sequence(
            name=name,
            source="arrays",
            time_s=stamps,
            inputs=() if imu is None else (imu,),
            twist=None if twist is None else numbers(twist, "twist"),
            camera=camera,
            T_cam_imu=_camera_pose(T_cam_imu, is_optional=twist is None and imu is None),
            observations=observations,
            truth=None if T_world_imu is None else truth_of(numbers(T_world_imu, "T_world_imu"), len(stamps)),
            noise=noise,
            velocity_frame=velocity_frame,
            notes=(*notes, *(() if imu is None else inertial_notes(imu, "arrays"))),
            attributes=WITHOUT_VELOCITIES if twist is None else {},
        )

    def between(self, begin_s: float, end_s: float) -> Sequence:
        """Return the frames whose stamps are in ``[begin_s, end_s)``, on the clock of the recording."""
        begin, end = np.searchsorted(self.time_s, (begin_s, end_s)).tolist()
        return self[begin:end]

    def with_velocities(self, twist: ArrayLike, velocity_frame: VelocityFrame | None = None) -> Sequence:
        """Return the recording with other velocities (T, 6); by default in the same frame as those before."""
        return replace(self, inputs=_with_twist(self, self.inputs, twist, velocity_frame))

    @cached_property
    def velocities(self) -> Velocities | None:
        """First input of velocities; None if there is none."""
        return next((samples for samples in self.inputs if isinstance(samples, Velocities)), None)

    @cached_property
    def inertial(self) -> InertialSamples | None:
        """First input of inertial samples; None if there is none."""
        return next((samples for samples in self.inputs if isinstance(samples, InertialSamples)), None)

    @cached_property
    def twist(self) -> Array:
        """Velocities (T, 6) ``[v; w]``; ``twist[k]`` drives ``(t[k-1], t[k]]``. Zero if there are none."""
        velocities = self.velocities
        return frozen(np.zeros((len(self), 6)) if velocities is None else velocities.mean(self.time_s))

    def interval(self, frame: int, kind: type[Input] = Velocities) -> Interval:
        """Return the inputs of a kind that lead to a frame from the frame before; `LostDataError` if there are none."""
        begin_s, end_s = float(self.time_s[frame - 1]), float(self.time_s[frame])
        if kind is InertialSamples:
            return _samples_of(self).interval(begin_s, end_s)
        if (velocities := self.velocities) is None or self.once(_has_one_velocity_a_frame):
            return Interval.of_one(self.twist[frame], end_s - begin_s, bool(self.interpolated[frame]))
        return velocities.interval(begin_s, end_s)

    def inputs_at(self, frame: int, kind: type[Input] = Velocities) -> Array:
        """Return the inputs (6,) of a kind at a frame; `LostDataError` if there are none."""
        return _samples_of(self).at(self.time_s[frame]) if kind is InertialSamples else self.twist[frame]

    @property
    def velocity_frame(self) -> VelocityFrame:
        """Frame of the velocities; ``imu`` if there are none."""
        return "imu" if self.velocities is None else self.velocities.frame

    @cached_property
    def interpolated(self) -> BoolArray:
        """Intervals (T,) whose velocities, and probably true poses, were interpolated rather than measured."""
        if self.velocities is None or self.velocities.has_stamps(self.time_s) or INTERPOLATED in self.attributes:
            return known_intervals(self.attributes, self.twist)
        return self.velocities.interpolated_at(self.time_s)

    @property
    def has_checked_tracks(self) -> bool:
        """Whether its tracks are compared with their first sight, see `ekfslam.frontend`."""
        return self.attributes.get("tracks") == CHECKED_TRACKS["tracks"]

    @property
    def has_velocities(self) -> bool:
        """Whether velocities of its body were measured; not if they are exactly 0 throughout."""
        return bool(self.measured_axes.any())

    @cached_property
    def measured_axes(self) -> BoolArray:
        """Mask (6,) of measured velocities; no measurement is exactly 0 throughout, see `Velocities.measured`."""
        said = self.attributes.get("velocities")
        if self.velocities is None or said == WITHOUT_VELOCITIES["velocities"]:
            return np.zeros(6, dtype=bool)
        kinds = np.repeat([said in (kind, None) or said not in MEASURED_KINDS for kind in MEASURED_KINDS], 3)
        return self.velocities.measured & kinds & np.isfinite(self.stated_twist_std)

    @cached_property
    def stated_twist_std(self) -> Array:
        """(6,) noise of a velocity sample that the attribute `TWIST_STD` states; 0: not stated, inf: not measured."""
        stated = str(self.attributes.get(TWIST_STD, "")).split()
        return np.array(stated, dtype=float) if len(stated) == 6 else np.zeros(6)

    @property
    def initial_T_world_imu(self) -> Array:
        """(4, 4) pose that estimates start from: the true first pose where it is known, identity elsewhere."""
        if self.truth is not None and len(self.truth.frame) and self.truth.frame[0] == 0:
            return se3.nearest_rigid(self.truth.T_world_imu[0])
        return np.eye(4)

    @property
    def initial_velocity_m_s(self) -> Array:
        """(3,) first velocity in the IMU frame that estimates start from: the true one if it is known, else 0."""
        if self.truth is None or self.truth.motion is None or self.truth.frame[0] != 0:
            return np.zeros(3)
        return self.truth.T_world_imu[0, :3, :3].T @ self.truth.motion.velocity_m_s[0]


def of_left_camera(sequence: Sequence) -> Sequence:
    """Return a recording as its left camera alone saw it; a recording of one camera stays as it is."""
    if sequence.camera.is_monocular:
        return sequence
    rig_only = {YAW_STD_PX, *(CHECKED_TRACKS if sequence.has_checked_tracks else ())}
    return replace(
        sequence,
        observations=sequence.observations.of_left_camera,
        attributes={name: value for name, value in sequence.attributes.items() if name not in rig_only},
        notes=(*sequence.notes, "The left camera alone is used."),
    )


def _has_one_velocity_a_frame(sequence: Sequence) -> bool:
    return sequence.velocities is not None and sequence.velocities.has_stamps(sequence.time_s)


def _samples_of(sequence: Sequence) -> InertialSamples:
    if sequence.inertial is None:
        raise LostDataError("the recording has no inertial samples", source=sequence.source, field="inputs")
    return sequence.inertial


def _camera_pose(T_cam_imu: ArrayLike | None, is_optional: bool) -> Array:
    if T_cam_imu is not None:
        return numbers(T_cam_imu, "T_cam_imu")
    if not is_optional:
        message = "velocities and inertial samples need the pose of the camera in their frame"
        raise ExtrinsicsError(message, field="T_cam_imu")
    return T_CAM_BODY


def validate_camera(camera: StereoCamera, is_stereo: bool = True) -> None:
    """Raise `NonFiniteError` or `CalibrationError` for unusable intrinsics, or baseline of a stereo rig."""
    values = np.array([camera.fu_px, camera.fv_px, camera.cu_px, camera.cv_px, camera.baseline_m])
    require_finite(values, "camera (fu, fv, cu, cv, baseline)", LARGEST_PX)
    if camera.fu_px <= 0 or camera.fv_px <= 0:
        message = f"intrinsic matrix K is singular or mirrored: fu {camera.fu_px:g}, fv {camera.fv_px:g}"
        raise CalibrationError(message, field="K")
    if is_stereo and camera.baseline_m <= 0:
        raise CalibrationError(f"stereo baseline must be positive, found {camera.baseline_m:g} m", field="baseline")


def _with_twist(
    sequence: Sequence, inputs: tuple[Input, ...], twist: ArrayLike | None, frame: VelocityFrame | None
) -> tuple[Input, ...]:
    """Return the inputs with the velocities ``twist`` (T, 6) in place of theirs, or with theirs in another frame."""
    if twist is None:
        if frame is None:
            return inputs
        return tuple(replace(each, frame=frame) if isinstance(each, Velocities) else each for each in inputs)
    others = tuple(samples for samples in inputs if not isinstance(samples, Velocities))
    frames: list[VelocityFrame] = [samples.frame for samples in inputs if isinstance(samples, Velocities)]
    velocities = Velocities(sequence.time_s, np.asarray(twist, dtype=float), frame or (*frames, "imu")[0])
    # Velocities of 0 that were never measured are none at all.
    if WITHOUT_VELOCITIES.items() <= sequence.attributes.items() and not velocities.twist.any():
        return others
    return (velocities, *others)


def stretch(text: str) -> slice:
    """Return the slice of frames that ``A:B`` names; either may be left out, as in Python."""
    begin, colon, end = text.partition(":")
    if not colon:
        raise ValueError(f"expected A:B, found {text!r}")
    return slice(*(int(bound) if bound.strip() else None for bound in (begin, end)))


def cut(sequence: Sequence, begin: int, end: int, T_world_imu: Array) -> Sequence | None:
    """Return frames ``begin`` to ``end - 1`` with the first pose (4, 4) as truth; None if nothing is observed."""
    seen = sequence.observations.frame
    if not ((seen >= begin) & (seen < end)).any():
        return None
    return replace(sequence[begin:end], truth=Truth(np.zeros(1, dtype=np.int64), T_world_imu[None]))
