"""Tracking of a whole recording: `track` makes a `Sequence` of an `ImageRecording`."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.config import FrontEndConfig
from ekfslam.data.images import Image, ImageRecording, LensCalibration, PairCalibration, baseline_doubt
from ekfslam.data.sequence import CHECKED_TRACKS, WITHOUT_VELOCITIES, Observations, Sequence
from ekfslam.errors import EmptyTracksError
from ekfslam.frontend.one_camera import OneCameraTracker
from ekfslam.frontend.opencv import one_thread
from ekfslam.frontend.rectify import rectification, undistortion
from ekfslam.frontend.rotation import correction
from ekfslam.frontend.tracker import Seen, Tracker
from ekfslam.geometry import motion, se3
from ekfslam.geometry.camera import StereoCamera
from ekfslam.progress import progress

_ANGLES = ("pitch", "yaw", "roll")
_SETTLING = 30  # first frames, whose pixels are corrected by the rotation known after them


@dataclass(frozen=True)
class TrackReport:
    """Statistics of the features.

    Args:
        frames, tracks, observations: Their numbers.
        lengths: (tracks,) number of observations of each track.
        losses: Number of tracks that ended before the last frame, by reason.
        withheld: Number of observations that did not move as the rig, and were not reported.
        refused: Number of corners without a match in the right image; 0 for one camera.
        single: Number of tracks that only one frame saw, which are left out.
        rotation_px, rotation_std_px: (T, 3) estimated pitch, yaw and roll of the right camera after each frame, times
            the focal length, and their standard deviations; (0, 3) for one camera.
    """

    frames: int
    tracks: int
    observations: int
    lengths: IntArray
    losses: dict[str, int]
    withheld: int
    refused: int
    single: int
    rotation_px: Array
    rotation_std_px: Array

    @property
    def lines(self) -> tuple[str, ...]:
        """Statistics, one sentence each."""
        shortest, middle, longest = np.percentile(self.lengths, (10, 50, 90))
        ended = sum(self.losses.values())
        reasons = ", ".join(f"{reason} {count}" for reason, count in sorted(self.losses.items(), key=lambda p: -p[1]))
        both = (
            f"{self.tracks} tracks with {self.observations} observations, "
            f"{self.observations / self.frames:.0f} a frame; "
            f"a track lasts {middle:.0f} frames (median; 10 %: {shortest:.0f}, 90 %: {longest:.0f}).",
            f"{ended} tracks ended before the last frame: {reasons}.",
        )
        if not len(self.rotation_px):
            return *both, f"{self.single} tracks were seen once: they are left out."
        last = zip(_ANGLES, self.rotation_px[-1], self.rotation_std_px[-1], strict=True)
        found = " ".join(f"{name} {value:+.2f} +- {std:.2f} px," for name, value, std in last)
        return (
            *both,
            f"{self.refused} corners had no match in the right image; {self.withheld} observations did not move as the "
            f"rig, and {self.single} tracks were seen once: both are left out.",
            f"The right camera is rotated against the calibration by {found} found from the tracks and taken out.",
        )


def track(recording: ImageRecording, config: FrontEndConfig | None = None) -> tuple[Sequence, TrackReport]:
    """Return a recording with tracks of its images, and statistics of the features.

    The camera is the rectified pair, or the one camera without distortion.

    If velocities were not measured, the attributes contain `WITHOUT_VELOCITIES`.

    Raises:
        MissingPackageError: OpenCV is not installed.
        DataError: The pair cannot be rectified, an image has another size, or not one feature is seen in both images.
    """
    if isinstance(recording.calibration, LensCalibration):
        return _of_one_camera(recording, recording.calibration, config or FrontEndConfig())
    tracking = Tracking(recording.calibration, recording.T_cam_imu, config)
    for k in progress(range(len(recording)), f"{recording.name}: tracking"):
        left, right = recording.load(k)
        tracking.add(left, right, _motion_before(recording, k))
    return tracking.sequence(recording)


def _of_one_camera(
    recording: ImageRecording, lens: LensCalibration, config: FrontEndConfig
) -> tuple[Sequence, TrackReport]:
    """Return a recording of one camera with its tracks, and statistics."""
    undistorted, seen = undistortion(lens), []
    valid = None if undistorted.valid is None else undistorted.valid[0]
    tracker = OneCameraTracker(undistorted.camera, config, valid)
    for k in progress(range(len(recording)), f"{recording.name}: tracking"):
        with one_thread():
            (image,) = undistorted.apply(*recording.load(k))
            seen.append(tracker.track(image, _turn_before(recording, k)))
    frame = np.repeat(np.arange(len(seen)), [len(ids) for ids, _ in seen])
    ids, pixels = np.concatenate([ids for ids, _ in seen]), np.vstack([pixels for _, pixels in seen])
    observations, single = _seen_twice(frame, ids, pixels)
    if not len(observations):
        raise EmptyTracksError("no feature is seen in two frames", source=recording.source)
    lengths = np.unique(observations.landmark, return_counts=True)[1]
    losses = {reason: count for reason, count in tracker.losses.items() if count}
    none = np.empty((0, 3))
    counts = len(seen), len(lengths), len(observations)
    report = TrackReport(*counts, lengths, losses, 0, 0, single, none, none)
    account = _changed(config)
    return _tracked(recording, undistorted.camera, recording.T_cam_imu, observations, account, report), report


class Tracking:
    """Tracking of image pairs, one after another; ``camera`` and ``T_cam_imu`` are those of the rectified pair."""

    def __init__(self, calibration: PairCalibration, T_cam_imu: Array, config: FrontEndConfig | None = None) -> None:
        self._config = config or FrontEndConfig()
        self._rectified = rectification(calibration)
        self.camera, self.T_cam_imu = self._rectified.camera, self._rectified.T_rectified_left @ T_cam_imu
        self._tracker = Tracker(self.camera, self._config, self._rectified.valid)
        self._seen: list[Seen] = []
        self._vectors: list[Array] = []
        self._stds: list[Array] = []

    def add(self, left: Image, right: Image, motion_before: Array | None = None) -> Seen:
        """Track a pair of images; ``motion_before`` (4, 4) is the predicted ``T_imu_now_before`` of the IMU, if any."""
        if motion_before is not None:
            motion_before = self.T_cam_imu @ motion_before @ se3.inverse(self.T_cam_imu)
        with one_thread():
            left, right = self._rectified.apply(left, right)
            seen = self._tracker.track(left, right, motion_before)
        self._seen.append(seen)
        self._vectors.append(self._tracker.rotation.vector)
        self._stds.append(self._tracker.rotation.std)
        return seen

    def last(self) -> tuple[IntArray, Array]:
        """Return ids (n,) and pixels (n, 4) of the last frame, with the present rotation of the right camera."""
        seen = self._seen[-1]
        right = seen.right + correction(self.camera, self._vectors[-1], seen.right)
        return seen.id, np.hstack([seen.left, right])

    def forget(self) -> None:
        """Forget all frames but the last one; tracks go on."""
        del self._seen[:-1], self._vectors[:-1], self._stds[:-1]

    def sequence(self, recording: ImageRecording) -> tuple[Sequence, TrackReport]:
        """Return a recording of the frames so far with their tracks, and statistics, see `track`."""
        rotation, std = np.array(self._vectors), np.array(self._stds)
        observations, single = _observations(self._seen, rotation, self.camera)
        if not len(observations):
            doubt = baseline_doubt(recording.baseline_m)
            causes = doubt or "is left right, or max_disparity too small?"
            message = f"no feature is seen in both images of two frames: {causes}"
            raise EmptyTracksError(message, source=recording.source)
        report = TrackReport(
            len(self._seen),
            len(observations.ids),
            len(observations),
            np.unique(observations.landmark, return_counts=True)[1],
            {reason: count for reason, count in self._tracker.losses.items() if count},
            self._tracker.withheld,
            self._tracker.refused,
            single,
            rotation,
            std,
        )
        account = _account(self._config, report)
        return _tracked(recording, self.camera, self.T_cam_imu, observations, account, report), report


def _tracked(
    recording: ImageRecording,
    camera: StereoCamera,
    T_cam_imu: Array,
    observations: Observations,
    account: dict[str, str | int | float],
    report: TrackReport,
) -> Sequence:
    """Return the recording with its tracks."""
    return Sequence(
        name=recording.name,
        source=recording.source,
        time_s=recording.time_s,
        inputs=() if recording.inertial is None else (recording.inertial,),
        twist=recording.twist,
        camera=camera,
        T_cam_imu=T_cam_imu,
        observations=observations,
        truth=recording.truth,
        noise=recording.noise,
        velocity_frame=recording.velocity_frame,
        notes=(*recording.notes, *report.lines),
        attributes={**recording.attributes, **(WITHOUT_VELOCITIES if recording.twist is None else {}), **account},
    )


def _observations(seen: list[Seen], rotation: Array, camera: StereoCamera) -> tuple[Observations, int]:
    """Return observations, corrected by rotations (T, 3) px, and the number of tracks that only one frame saw.

    The correction is causal except at the start: the first frames use the rotation known after them.
    """
    frame = np.repeat(np.arange(len(seen)), [len(found.id) for found in seen])
    ids = np.concatenate([found.id for found in seen])
    left, right = (np.vstack([getattr(found, side) for found in seen]) for side in ("left", "right"))
    used = np.maximum(frame, min(_SETTLING, len(seen) - 1))
    pixels = np.hstack([left, right + correction(camera, rotation[used], right)])
    return _seen_twice(frame, ids, pixels)


def _seen_twice(frame: IntArray, ids: IntArray, pixels: Array) -> tuple[Observations, int]:
    """Return the observations of tracks that more than one frame saw, and the number of others."""
    _, inverse, counts = np.unique(ids, return_inverse=True, return_counts=True)
    twice = counts[inverse] > 1
    return Observations(frame[twice], ids[twice], pixels[twice]), int((~twice).sum())


def _motion_before(recording: ImageRecording, k: int) -> Array | None:
    """Return the motion (4, 4) of the IMU before frame k by the measured velocities; None if there are none."""
    if recording.twist is None or k == 0:
        return None
    return motion.increment(recording.twist[k], float(recording.time_s[k] - recording.time_s[k - 1]))


def _turn_before(recording: ImageRecording, k: int) -> Array | None:
    """Return the rotation (3, 3) of directions from the camera of frame k - 1 to that of frame k; None if unknown."""
    R_cam_imu, M = recording.T_cam_imu[:3, :3], _motion_before(recording, k)
    if recording.inertial is not None and k:
        begin_s, end_s = (float(recording.time_s[i]) for i in (k - 1, k))
        rate = recording.inertial.between(begin_s, end_s).gyro_rad_s.mean(axis=0)
        return R_cam_imu @ se3.so3_exp(-rate * (end_s - begin_s)) @ R_cam_imu.T
    return None if M is None else R_cam_imu @ M[:3, :3] @ R_cam_imu.T


def _changed(config: FrontEndConfig) -> dict[str, str | int | float]:
    """Return attributes with the changed settings."""
    return {
        f"front_end_{setting.name}": getattr(config, setting.name)
        for setting in dataclasses.fields(config)
        if getattr(config, setting.name) != setting.default
    }


def _account(config: FrontEndConfig, report: TrackReport) -> dict[str, str | int | float]:
    """Return attributes with the changed settings and the rotation of the right camera."""
    kinds = {"px": report.rotation_px[-1], "std_px": report.rotation_std_px[-1]}
    found = {f"right_camera_{n}_{kind}": float(v[i]) for kind, v in kinds.items() for i, n in enumerate(_ANGLES)}
    return {**CHECKED_TRACKS, **_changed(config), **found}
