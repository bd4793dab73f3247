"""Opening of any recording as a `Sequence`: tracks are read, images are tracked."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Literal, get_args

from ekfslam.config import FrontEndConfig
from ekfslam.data.checks import require_scale
from ekfslam.data.images import ImageRecording
from ekfslam.data.imu import with_inertial_files
from ekfslam.data.opening import attach_truth, open_recording
from ekfslam.data.readers.registry import Extrinsics, Lateral
from ekfslam.data.sequence import Sequence, VelocityFrame, of_left_camera
from ekfslam.data.velocities import Recording, attach_velocities
from ekfslam.errors import ConfigError

Camera = Literal["both", "left"]


def open_sequence(
    source: str | Path,
    *,
    extrinsics: Extrinsics = "corrected",
    lateral: Lateral = "corrected",
    truth: str | Path | None = None,
    velocities: str | Path | None = None,
    velocity_frame: VelocityFrame | None = None,
    imu: str | Path | None = None,
    imu_noise: str | Path | None = None,
    topics: Iterable[str] = (),
    calibration: str | Path | None = None,
    camera: Camera = "both",
    front_end: FrontEndConfig | None = None,
) -> Sequence:
    """Open the recording in a file or folder, or the built-in world ``builtin:NAME``.

    Args:
        source: Path of a recording, or ``builtin:NAME``. Stereo images are tracked.
        extrinsics: Reading of ``cam_T_imu`` of an .npz recording, see `read_ece276a`; else only ``corrected``.
        lateral: Sign of the lateral velocity of KITTI (.npz, .mat, folder), see `with_lateral`; else ``corrected``.
        truth: File or folder of true poses to use in place of the recording's own, see `attach_truth`.
        velocities, velocity_frame: File or recording with other velocities, their frame, see `attach_velocities`.
        imu, imu_noise: Files of inertial samples and of their noise densities, see `attach_inertial`. ``imu="none"``
            leaves out the samples of the recording.
        topics: Topics of a bag: images of a pair or one camera, velocities, samples. Others are chosen automatically.
        calibration: Calibration of the pair in place of the recording's own, see `read_pair`.
        camera: ``left`` takes the left camera of a stereo recording alone.
        front_end: Settings of tracking; None for the defaults.

    Raises:
        UnknownFormatError: The file is missing, empty, damaged or of unknown content, or there is no such world.
        ConfigError, ArchiveError: An argument means nothing here, or lacks another; a newer release wrote the file.
        MissingPackageError: There are images, but OpenCV is not installed.
        ScaleError: Images are of one camera, without velocities and inertial samples.
        DataError: A field is missing or malformed; the subclass says how.
    """
    _require(camera, "velocity_frame", velocity_frame, "velocities", velocities)
    recording = open_recording(source, extrinsics=extrinsics, lateral=lateral, topics=topics, calibration=calibration)

    def with_inputs(one: Recording) -> Recording:
        if velocities is not None:
            one = attach_velocities(one, velocities, velocity_frame=velocity_frame, lateral=lateral)
        return with_inertial_files(one, imu, imu_noise)

    if isinstance(recording, Sequence):
        recording = of_left_camera(recording) if camera == "left" else recording
        return with_inputs(recording if truth is None else attach_truth(recording, truth))
    tracked = _tracked(with_inputs(recording.of_left_camera if camera == "left" else recording), front_end)
    return tracked if truth is None else attach_truth(tracked, truth)


def _tracked(images: ImageRecording, front_end: FrontEndConfig | None) -> Sequence:
    from ekfslam.frontend.track import track

    require_scale(images.name, images.has_scale)  # before minutes of tracking
    return track(images, front_end)[0]


def _require(camera: str, name: str, value: object, needed: str, other: object) -> None:
    if camera not in get_args(Camera):
        raise ConfigError(f"camera (--camera) must be one of {', '.join(get_args(Camera))}, found {camera!r}")
    if value is not None and other is None:
        flag = f"--{name.replace('_', '-')}"
        raise ConfigError(f"{name} ({flag}) is given without {needed} (--{needed})")
