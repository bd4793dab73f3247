"""One door for every recording: finished tracks are read, images are tracked."""

from __future__ import annotations

from pathlib import Path

from ekfslam.config import FrontEndConfig
from ekfslam.data import readers
from ekfslam.data.images import open_images
from ekfslam.data.readers.registry import Extrinsics, Lateral
from ekfslam.data.readers.truth import attach_truth
from ekfslam.data.sequence import Sequence, VelocityFrame
from ekfslam.data.velocities import attach_velocities
from ekfslam.errors import ConfigError
from ekfslam.frontend.track import track


def open_sequence(
    source: str | Path,
    *,
    extrinsics: Extrinsics = "corrected",
    lateral: Lateral = "corrected",
    truth: str | Path | None = None,
    velocities: str | Path | None = None,
    velocity_frame: VelocityFrame | None = None,
    front_end: FrontEndConfig | None = None,
) -> Sequence:
    """The recording in a file or folder, or the built-in world ``builtin:NAME``.

    Args:
        source: Path of a recording, or ``builtin:NAME``. Where it has stereo images, they are tracked.
        extrinsics: How to take ``cam_T_imu`` of an .npz recording, see `read_ece276a`; other formats store
            ``T_cam_imu`` unambiguously and know only ``corrected``.
        lateral: How to take the lateral velocity of KITTI, see `ekfslam.data.readers.open_sequence`.
        truth: File or folder of true poses (see `attach_truth`) to use instead of the recording's own truth.
        velocities, velocity_frame: File or recording with velocities to use instead of its own, and in which frame they
            are, see `attach_velocities`.
        front_end: How to track images; defaults where None.

    Raises:
        UnknownFormatError: The file is missing, empty, damaged or of unknown content, or there is no such world.
        ConfigError: The recording's format does not know ``extrinsics`` or ``lateral``; or ``velocity_frame`` alone.
        ArchiveError: A newer release wrote the file.
        MissingPackageError: There are images, but no OpenCV.
        DataError: A field is missing or malformed; the subclass says how.
    """
    if velocity_frame is not None and velocities is None:
        raise ConfigError(
            "velocity_frame (--velocity-frame) says how to take velocities (--velocities), of which there are none"
        )
    images = open_images(source, lateral=lateral)
    if images is None:
        sequence = readers.open_sequence(source, extrinsics=extrinsics, lateral=lateral, truth=truth)
        if velocities is None:
            return sequence
        return attach_velocities(sequence, velocities, velocity_frame=velocity_frame, lateral=lateral)
    if velocities is not None:
        images = attach_velocities(images, velocities, velocity_frame=velocity_frame, lateral=lateral)
    sequence, _ = track(images, front_end)
    return sequence if truth is None else attach_truth(sequence, Path(truth))
