"""Files of `ekfslam.write_sequence` as recordings; see `ekfslam.data.readers.hdf5` for their layout."""

from __future__ import annotations

import dataclasses

from ekfslam.data.readers.fields import checksum
from ekfslam.data.readers.hdf5 import read_sequence
from ekfslam.data.readers.registry import Reader, Source
from ekfslam.data.sequence import Sequence

_UNKNOWN_LATERAL = (
    "The file does not say how the sign of the lateral velocity was taken, so it is used as it is; older releases "
    "wrote that of KITTI positive to the right."
)


def _tracks(source: Source) -> Sequence:
    sequence = read_sequence(source.path)
    own = {"checksum_sha256": checksum(source.path), "reader": READER.name}
    notes = sequence.notes
    if sequence.velocity_frame == "level" and "lateral" not in sequence.attributes:
        notes = (*notes, _UNKNOWN_LATERAL)
    return dataclasses.replace(sequence, attributes={**sequence.attributes, **own}, notes=notes)


READER = Reader("hdf5", "an ekfslam HDF5 file", lambda source: source.head.startswith(b"\x89HDF\r\n\x1a\n"), _tracks)
