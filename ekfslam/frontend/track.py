"""From images to tracks: `track` makes a `Sequence` of an `ImageRecording`."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.data.images.pairs import ImageRecording
from ekfslam.data.sequence import WITHOUT_VELOCITIES, Observations, Sequence
from ekfslam.errors import EmptyTracksError
from ekfslam.frontend.config import FrontEndConfig
from ekfslam.frontend.opencv import one_thread
from ekfslam.frontend.rectify import rectification
from ekfslam.frontend.rotation import correction
from ekfslam.frontend.tracker import Tracker
from ekfslam.geometry import motion, se3
from ekfslam.progress import progress


@dataclass(frozen=True)
class TrackReport:
    """What became of the features.

    Args:
        frames, tracks, observations: How many there are.
        lengths: (tracks,) observations of each track.
        losses: How many tracks ended, by reason; the others were there at the end.
        withheld: Observations that did not move as the rig, and were not reported.
        refused: Corners without a match in the right image.
        rotation_px: (T, 3) pitch, yaw and roll of the right camera as known after each frame, times the focal length.
        rotation_std_px: (T, 3) their standard deviations.
    """

    frames: int
    tracks: int
    observations: int
    lengths: IntArray
    losses: dict[str, int]
    withheld: int
    refused: int
    rotation_px: Array
    rotation_std_px: Array

    @property
    def lines(self) -> tuple[str, ...]:
        """One sentence each."""
        shortest, middle, longest = np.percentile(self.lengths, (10, 50, 90))
        ended = sum(self.losses.values())
        reasons = ", ".join(f"{reason} {count}" for reason, count in sorted(self.losses.items(), key=lambda p: -p[1]))
        found = " ".join(
            f"{name} {value:+.2f} +- {std:.2f} px,"
            for name, value, std in zip(
                ("pitch", "yaw", "roll"), self.rotation_px[-1], self.rotation_std_px[-1], strict=True
            )
        )
        return (
            f"{self.tracks} tracks with {self.observations} observations, "
            f"{self.observations / self.frames:.0f} a frame; "
            f"a track lasts {middle:.0f} frames (median; 10 %: {shortest:.0f}, 90 %: {longest:.0f}).",
            f"{ended} tracks ended before the last frame: {reasons}.",
            f"{self.refused} corners had no match in the right image; {self.withheld} observations did not move as the "
            "rig and are left out.",
            f"The right camera is rotated against the calibration by {found} found from the tracks and taken out.",
        )


def track(recording: ImageRecording, config: FrontEndConfig | None = None) -> tuple[Sequence, TrackReport]:
    """Track features through the images of a recording.

    Args:
        recording: Images, calibration, and velocities if there are any.
        config: Settings; defaults where None.

    Returns:
        The recording with tracks, whose camera is the rectified pair; and what became of the features. Where nobody
        measured velocities, its attributes have `WITHOUT_VELOCITIES` and its velocities are 0.

    Raises:
        MissingPackageError: There is no OpenCV.
        CalibrationError: The pair cannot be rectified.
        EmptyTracksError: Not one feature is seen in both images.
        UnknownFormatError, DataError: An image cannot be read, or has another size.
    """
    config = config or FrontEndConfig()
    rectified = rectification(recording.calibration)
    T_cam_imu = rectified.T_rectified_left @ recording.T_cam_imu
    tracker = Tracker(rectified.camera, config, rectified.valid)
    seen, vectors, stds = [], [], []
    with one_thread():
        for k in progress(range(len(recording)), f"{recording.name}: tracking"):
            left, right = rectified.apply(*recording.load(k))
            seen.append(tracker.track(left, right, _prediction(recording, T_cam_imu, k)))
            vectors.append(tracker.rotation.vector)
            stds.append(tracker.rotation.std)
    rotation, std = np.array(vectors), np.array(stds)
    # Causal with a start: what is known of the rotation after a second is used for the frames before, too.
    used = np.maximum(np.arange(len(seen)), min(config.settling, len(seen) - 1))
    pixels = [
        np.hstack([frame.left, frame.right + correction(rectified.camera, rotation[used[k]], frame.right)])
        for k, frame in enumerate(seen)
    ]
    ids = np.concatenate([frame.id for frame in seen])
    if not len(ids):
        raise EmptyTracksError("not one feature is seen in both images of a pair", source=recording.source)
    observations = Observations(
        np.repeat(np.arange(len(seen)), [len(frame.id) for frame in seen]), ids, np.vstack(pixels)
    )
    lengths = np.unique(ids, return_counts=True)[1]
    report = TrackReport(
        len(seen),
        len(lengths),
        len(ids),
        lengths,
        {reason: n for reason, n in tracker.losses.items() if n},
        tracker.withheld,
        tracker.refused,
        rotation,
        std,
    )
    has_velocities = recording.twist is not None
    sequence = Sequence(
        name=recording.name,
        source=recording.source,
        time_s=recording.time_s,
        twist=recording.twist if has_velocities else np.zeros((len(recording), 6)),
        camera=rectified.camera,
        T_cam_imu=T_cam_imu,
        observations=observations,
        truth=recording.truth,
        noise=recording.noise,
        velocity_frame=recording.velocity_frame,
        notes=(*recording.notes, *report.lines),
        attributes={
            **recording.attributes,
            **({} if has_velocities else WITHOUT_VELOCITIES),
            **_account(config, report),
        },
    )
    return sequence, report


def _prediction(recording: ImageRecording, T_cam_imu: Array, k: int) -> Array | None:
    """(4, 4) motion of the camera in the interval before frame k, by the measured velocities; None without any."""
    if recording.twist is None or k == 0:
        return None
    tau_s = float(recording.time_s[k] - recording.time_s[k - 1])
    return T_cam_imu @ motion.increment(recording.twist[k], tau_s) @ se3.inverse(T_cam_imu)


def _account(config: FrontEndConfig, report: TrackReport) -> dict[str, str | int | float]:
    """Attributes that say how the tracks were made."""
    changed = {
        field.name: getattr(config, field.name)
        for field in dataclasses.fields(config)
        if getattr(config, field.name) != field.default
    }
    settings = {
        f"frontend_{name}": value if isinstance(value, int | float) else str(value) for name, value in changed.items()
    }
    yaw, std = report.rotation_px[-1], report.rotation_std_px[-1]
    names = ("pitch", "yaw", "roll")
    found = {f"right_camera_{name}_px": float(value) for name, value in zip(names, yaw, strict=True)}
    found |= {f"right_camera_{name}_std_px": float(value) for name, value in zip(names, std, strict=True)}
    return {"front_end": "stereo", **settings, **found}
