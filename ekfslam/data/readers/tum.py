"""True poses in the text files of the TUM RGB-D benchmark: lines of ``time tx ty tz qx qy qz qw``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ekfslam.data.readers.registry import Poses, TruthReader
from ekfslam.data.readers.text import Table, first_row, parse_table, read_lines
from ekfslam.data.sequence import Sequence
from ekfslam.errors import StampError, TruthError
from ekfslam.geometry import se3

COLUMNS = ("time", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
_QUATERNION_TOLERANCE = 1e-3
_EXPECTED = f"{len(COLUMNS)} numbers a line (TUM: {' '.join(COLUMNS)})"


def stamped_poses(table: Table) -> Poses:
    """``T_world_imu`` from rows in the columns of TUM: seconds, metres, quaternion with w last.

    Raises:
        TruthError: A quaternion does not have the length 1.
        StampError: The stamps do not increase.
    """
    time_s, position_m, quaternion = table.values[:, 0], table.values[:, 1:4], table.values[:, 4:]
    backwards = np.diff(time_s) <= 0
    if backwards.any():
        raise StampError("the stamp does not increase", **table.where(int(np.argmax(backwards)) + 1))
    defect = np.abs(np.linalg.norm(quaternion, axis=1) - 1.0)
    if (defect > _QUATERNION_TOLERANCE).any():
        row = int(np.argmax(defect > _QUATERNION_TOLERANCE))
        raise TruthError(f"not a unit quaternion: its norm is off by {defect[row]:.2g}", **table.where(row))
    return Poses(se3.transform(Rotation.from_quat(quaternion).as_matrix(), position_m), time_s, (table.path,))


def read_tum(path: Path, sequence: Sequence) -> Poses:
    """The poses of a file; see `stamped_poses`.

    Raises:
        UnknownFormatError: The file is not text.
        TruthError, NonFiniteError, StampError: A line is malformed.
    """
    lines = read_lines(path, f"expected {_EXPECTED}")
    return stamped_poses(parse_table(lines, path, columns=len(COLUMNS), error=TruthError))


def _recognises(path: Path) -> bool:
    row = first_row(path)
    return len(row.split()) == len(COLUMNS) and "," not in row


TRUTH_READER = TruthReader("TUM", _EXPECTED, _recognises, read_tum)
