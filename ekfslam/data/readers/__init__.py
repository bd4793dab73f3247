"""Readers: every recording becomes a validated `Sequence`, whatever file it comes in.

The file's content, not its name, decides which reader is used:

- .npz of the report and its dense, noisy edition (`ece276a`),
- .mat of UTIAS: KITTI drives and Starry Night (`utias`),
- ekfslam's own HDF5 form (`hdf5`),
- a drive folder of KITTI raw (`kitti_raw`), which has no tracks and serves dead reckoning,
- ``builtin:NAME``, a simulated world (`ekfslam.data.simulate`).
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import get_args

from ekfslam.data import simulate
from ekfslam.data.readers.ece276a import Extrinsics, read_ece276a
from ekfslam.data.readers.fields import checksum
from ekfslam.data.readers.hdf5 import read_sequence, write_sequence
from ekfslam.data.readers.kitti_raw import KittiRaw, is_kitti_raw, open_kitti_raw
from ekfslam.data.readers.truth import attach_truth
from ekfslam.data.readers.utias import read_utias
from ekfslam.data.sequence import Sequence
from ekfslam.errors import ConfigError, UnknownFormatError

__all__ = ["KittiRaw", "open_kitti_raw", "open_sequence", "read_sequence", "write_sequence"]

BUILTIN = "builtin:"

_EXPECTED = (
    "expected an .npz recording (ECE 276A), a .mat recording (UTIAS), an ekfslam HDF5 file or a drive folder of "
    "KITTI raw"
)


def open_sequence(
    source: str | Path, *, extrinsics: Extrinsics = "corrected", truth: str | Path | None = None
) -> Sequence:
    """The recording in a file or folder, or the built-in world ``builtin:NAME``.

    Args:
        source: Path of a recording, or ``builtin:NAME``. A drive folder of KITTI raw gives a sequence without tracks;
            `open_kitti_raw` takes tracks from elsewhere.
        extrinsics: How to take ``cam_T_imu`` of an .npz recording, see `read_ece276a`; other formats store
            ``T_cam_imu`` unambiguously and know only ``corrected``.
        truth: File or folder of true poses (see `attach_truth`) to use instead of the recording's own truth.

    Raises:
        UnknownFormatError: The file is missing, empty, damaged or of unknown content, or there is no such world.
        ConfigError: The recording's format does not know ``extrinsics``.
        ArchiveError: A newer release wrote the file.
        DataError: A field is missing or malformed; the subclass says how.
    """
    if extrinsics not in get_args(Extrinsics):
        raise ConfigError(f"extrinsics must be one of {', '.join(get_args(Extrinsics))}, found {extrinsics!r}")
    sequence = _open(source, extrinsics)
    if extrinsics != sequence.attributes.get("extrinsics", "corrected"):
        raise ConfigError(f"{source}: extrinsics {extrinsics!r} apply to .npz recordings only")
    return sequence if truth is None else attach_truth(sequence, Path(truth))


def _open(source: str | Path, extrinsics: Extrinsics) -> Sequence:
    if str(source).startswith(BUILTIN):
        return simulate.builtin(str(source).removeprefix(BUILTIN))
    path = Path(source)
    if is_kitti_raw(path):
        return open_kitti_raw(path).sequence()
    try:
        with path.open("rb") as file:
            head = file.read(128)
    except OSError as error:
        raise UnknownFormatError(f"{path}: cannot be read ({error.strerror}); {_EXPECTED}") from None
    if head.startswith(b"PK\x03\x04"):
        return read_ece276a(path, extrinsics)
    if head.startswith(b"MATLAB 5.0"):
        return read_utias(path)
    if head.startswith(b"\x89HDF\r\n\x1a\n"):
        sequence = read_sequence(path)
        own = {"checksum_sha256": checksum(path), "reader": "hdf5"}
        return dataclasses.replace(sequence, attributes={**sequence.attributes, **own})
    if head.startswith(b"MATLAB 7.3"):
        raise UnknownFormatError(f"{path}: a MATLAB 7.3 file, save it with -v7; {_EXPECTED}")
    raise UnknownFormatError(f"{path}: {'empty file' if not head else 'unknown content'}; {_EXPECTED}")
