"""Opening of any recording as a `Sequence`: tracks are read, images are tracked."""

from __future__ import annotations

from pathlib import Path

from ekfslam.config import FrontEndConfig
from ekfslam.data.imu import attach_inertial
from ekfslam.data.opening import attach_truth, open_recording
from ekfslam.data.readers.registry import Extrinsics, Lateral
from ekfslam.data.sequence import Sequence, VelocityFrame
from ekfslam.data.velocities import Recording, attach_velocities
from ekfslam.errors import ConfigError


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
    front_end: FrontEndConfig | None = None,
) -> Sequence:
    """Open the recording in a file or folder, or the built-in world ``builtin:NAME``.

    Args:
        source: Path of a recording, or ``builtin:NAME``. Stereo images are tracked.
        extrinsics: Reading of ``cam_T_imu`` of an .npz recording, see `read_ece276a`. All other formats store
            ``T_cam_imu`` unambiguously and accept only ``corrected``.
        lateral: Reading of the lateral velocity of KITTI (.npz, .mat, drive folder), which is stored with the wrong
            sign, see `with_lateral`. All other formats accept only ``corrected``.
        truth: File or folder of true poses to use in place of the recording's own, see `attach_truth`.
        velocities: File or recording with velocities to use in place of the recording's own, see `attach_velocities`.
        velocity_frame: Frame of these velocities.
        imu: File with inertial samples to use in place of the recording's own, see `attach_inertial`.
        imu_noise: File with the densities of their noise.
        front_end: Settings of tracking; None for the defaults.

    Raises:
        UnknownFormatError: The file is missing, empty, damaged or of unknown content, or there is no such world.
        ConfigError: The recording's format does not know ``extrinsics`` or ``lateral``; or ``velocity_frame`` is given
            without ``velocities``, or ``imu_noise`` without ``imu``.
        ArchiveError: A newer release wrote the file.
        MissingPackageError: There are images, but OpenCV is not installed.
        DataError: A field is missing or malformed; the subclass says how.
    """
    _require("velocity_frame", velocity_frame, "velocities", velocities)
    _require("imu_noise", imu_noise, "imu", imu)
    recording = open_recording(source, extrinsics=extrinsics, lateral=lateral)

    def with_inputs(one: Recording) -> Recording:
        if velocities is not None:
            one = attach_velocities(one, velocities, velocity_frame=velocity_frame, lateral=lateral)
        return one if imu is None else attach_inertial(one, imu, imu_noise)

    if isinstance(recording, Sequence):
        return with_inputs(recording if truth is None else attach_truth(recording, Path(truth)))
    from ekfslam.frontend.track import track

    tracked = track(with_inputs(recording), front_end)[0]
    return tracked if truth is None else attach_truth(tracked, Path(truth))


def _require(name: str, value: object, needed: str, other: object) -> None:
    if value is not None and other is None:
        flag = f"--{name.replace('_', '-')}"
        raise ConfigError(f"{name} ({flag}) is given without {needed} (--{needed})")
