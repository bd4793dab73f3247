"""True poses in text files of the TUM RGB-D benchmark: lines of ``time tx ty tz qx qy qz qw``."""

from __future__ import annotations

from ekfslam.data.readers.poses import Poses, stamped_poses
from ekfslam.data.readers.registry import Reader, Source
from ekfslam.data.readers.text import first_row, parse_table, read_lines
from ekfslam.data.sequence import Sequence
from ekfslam.errors import TruthError

COLUMNS = ("time", "tx", "ty", "tz", "qx", "qy", "qz", "qw")


def _recognises(source: Source) -> bool:
    row = first_row(source.path)
    return len(row.split()) == len(COLUMNS) and "," not in row


def _truth(source: Source, sequence: Sequence) -> Poses:
    lines = read_lines(source.path, f"expected {READER.expected}")
    return stamped_poses(parse_table(lines, source.path, columns=len(COLUMNS), error=TruthError))


READER = Reader("TUM", f"{len(COLUMNS)} numbers a line (TUM: {' '.join(COLUMNS)})", _recognises, truth=_truth)
