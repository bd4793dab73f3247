"""Readers: every recording becomes a validated `Sequence`, whatever file it comes in.

The content, not the name, decides which reader is used. Each format is one file of this folder, which
`ekfslam.data.readers.registry` finds by itself:

- .npz of the report and its dense, noisy edition (`ece276a`),
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
from ekfslam.data.readers.registry import Extrinsics, Reader, Source, discovered, listed
from ekfslam.data.readers.simulated import BUILTIN
from ekfslam.data.readers.truth import attach_truth
from ekfslam.data.sequence import Sequence
from ekfslam.errors import ConfigError, UnknownFormatError

__all__ = ["BUILTIN", "KittiRaw", "open_kitti_raw", "open_sequence", "read_sequence", "write_sequence"]


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
    sequence = _open(Source.at(source, extrinsics))
    if extrinsics != sequence.attributes.get("extrinsics", "corrected"):
        raise ConfigError(f"{source}: extrinsics {extrinsics!r} apply to .npz recordings only")
    return sequence if truth is None else attach_truth(sequence, Path(truth))


def _open(source: Source) -> Sequence:
    readers = discovered(Reader)
    reader = next((reader for reader in readers if reader.recognises(source)), None)
    if reader is not None:
        return reader.open(source)
    problem = f"cannot be read ({source.problem})" if source.problem else "unknown content"
    if not source.head and not source.problem:
        problem = "empty file"
    raise UnknownFormatError(f"{source.place}: {problem}; {listed(readers)}")
