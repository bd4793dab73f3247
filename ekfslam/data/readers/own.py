"""Files of `ekfslam.write_sequence` as recordings; what is in them `ekfslam.data.readers.hdf5` says."""

from __future__ import annotations

import dataclasses

from ekfslam.data.readers.fields import checksum
from ekfslam.data.readers.hdf5 import read_sequence
from ekfslam.data.readers.registry import Reader, Source
from ekfslam.data.sequence import Sequence


def _open(source: Source) -> Sequence:
    sequence = read_sequence(source.path)
    own = {"checksum_sha256": checksum(source.path), "reader": READER.name}
    return dataclasses.replace(sequence, attributes={**sequence.attributes, **own})


READER = Reader("hdf5", "an ekfslam HDF5 file", lambda source: source.head.startswith(b"\x89HDF\r\n\x1a\n"), _open)
