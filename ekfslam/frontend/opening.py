"""One door for every recording: finished tracks are read, images are tracked."""

from __future__ import annotations

from pathlib import Path

from ekfslam.config import FrontEndConfig
from ekfslam.data import readers
from ekfslam.data.images import open_images
from ekfslam.data.readers.registry import Extrinsics, Lateral
from ekfslam.data.readers.truth import attach_truth
from ekfslam.data.sequence import Sequence
from ekfslam.frontend.track import track


def open_sequence(
    source: str | Path,
    *,
    extrinsics: Extrinsics = "corrected",
    lateral: Lateral = "corrected",
    truth: str | Path | None = None,
    front_end: FrontEndConfig | None = None,
) -> Sequence:
    """The recording in a file or folder, or the built-in world ``builtin:NAME``.

    Args:
        source: Path of a recording, or ``builtin:NAME``. Where it has stereo images, they are tracked.
        extrinsics: How to take ``cam_T_imu`` of an .npz recording, see `read_ece276a`; other formats store
            ``T_cam_imu`` unambiguously and know only ``corrected``.
        lateral: How to take the lateral velocity of KITTI, see `ekfslam.data.readers.open_sequence`.
        truth: File or folder of true poses (see `attach_truth`) to use instead of the recording's own truth.
        front_end: How to track images; defaults where None.

    Raises:
        UnknownFormatError: The file is missing, empty, damaged or of unknown content, or there is no such world.
        ConfigError: The recording's format does not know ``extrinsics`` or ``lateral``.
        ArchiveError: A newer release wrote the file.
        MissingPackageError: There are images, but no OpenCV.
        DataError: A field is missing or malformed; the subclass says how.
    """
    images = open_images(source, lateral=lateral)
    if images is None:
        return readers.open_sequence(source, extrinsics=extrinsics, lateral=lateral, truth=truth)
    sequence, _ = track(images, front_end)
    return sequence if truth is None else attach_truth(sequence, Path(truth))
