"""Readers: every recording becomes a validated `Sequence`, whatever file it comes in.

The content, not the name, decides which reader is used. Each format is one file of this folder, which
`ekfslam.data.readers.registry` finds by itself:

- .npz of the report and later editions of it (`ece276a`), .npy of those from 2025 on (`ece276a_npy`),
- .mat of UTIAS: KITTI drives and Starry Night (`utias`),
- ekfslam's own HDF5 form (`hdf5`, entered by `own`),
- a drive folder of KITTI raw (`kitti_raw`), which has no tracks and serves dead reckoning,
- ``builtin:NAME``, a simulated world (`simulated`),
- and true poses alone: `kitti_odometry`, `tum`, `euroc`, and again `kitti_raw` (see `truth`).
"""

from __future__ import annotations

from pathlib import Path
from typing import get_args

from ekfslam.data.readers.hdf5 import read_sequence, write_sequence
from ekfslam.data.readers.kitti_raw import KittiRaw, open_kitti_raw
from ekfslam.data.readers.registry import Extrinsics, Lateral, Reader, Source, discovered, listed
from ekfslam.data.readers.simulated import BUILTIN
from ekfslam.data.readers.truth import attach_truth
from ekfslam.data.sequence import Sequence
from ekfslam.errors import ConfigError, UnknownFormatError

__all__ = [
    "BUILTIN",
    "KittiRaw",
    "Reader",
    "Source",
    "attach_truth",
    "open_kitti_raw",
    "open_sequence",
    "read_sequence",
    "write_sequence",
]


def open_sequence(
    source: str | Path,
    *,
    extrinsics: Extrinsics = "corrected",
    lateral: Lateral = "corrected",
    truth: str | Path | None = None,
) -> Sequence:
    """The recording in a file or folder, or the built-in world ``builtin:NAME``.

    Args:
        source: Path of a recording, or ``builtin:NAME``. A drive folder of KITTI raw gives a sequence without tracks;
            `open_kitti_raw` takes tracks from elsewhere.
        extrinsics: How to take ``cam_T_imu`` of an .npz recording, see `read_ece276a`; other formats store
            ``T_cam_imu`` unambiguously and know only ``corrected``.
        lateral: How to take the lateral velocity of KITTI (.npz, .mat, a drive folder), which is stored with the wrong
            sign, see `with_lateral`; others know only ``corrected``. The attribute ``lateral`` says what was done.
        truth: File or folder of true poses (see `attach_truth`) to use instead of the recording's own truth.

    Raises:
        UnknownFormatError: The file is missing, empty, damaged or of unknown content, or there is no such world.
        ConfigError: The recording's format does not know ``extrinsics`` or ``lateral``.
        ArchiveError: A newer release wrote the file.
        DataError: A field is missing or malformed; the subclass says how.
    """
    choices = {"extrinsics": (extrinsics, Extrinsics), "lateral": (lateral, Lateral)}
    for name, (choice, known) in choices.items():
        if choice not in get_args(known):
            raise ConfigError(f"{name} must be one of {', '.join(get_args(known))}, found {choice!r}")
    sequence = _open(Source.at(source, extrinsics, lateral))
    for name, (choice, _) in choices.items():
        # A file of our own has been through a reader before: what was chosen then stands.
        if choice != "corrected" and choice != sequence.attributes.get(name):
            raise ConfigError(f"{source}: {name} {choice!r} mean nothing for this format")
    return sequence if truth is None else attach_truth(sequence, Path(truth))


def _open(source: Source) -> Sequence:
    from ekfslam.data.images.registry import image_readers  # which imports the registry of this package

    readers = discovered(Reader)
    reader = next((reader for reader in readers if reader.recognises(source)), None)
    if reader is not None:
        return reader.open(source)
    problem = f"cannot be read ({source.problem})" if source.problem else "unknown content"
    if not source.head and not source.problem:
        problem = "empty file"
    raise UnknownFormatError(f"{source.place}: {problem}; {listed((*readers, *image_readers()))}")
