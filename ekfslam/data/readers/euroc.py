"""Ground truth of EuRoC MAV recordings (Burri et al., IJRR 2016): ``mav0/state_groundtruth_estimate0/data.csv``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.errors import NonFiniteError, TruthError, UnknownFormatError

COLUMNS = ("timestamp", "p_RS_R_x", "p_RS_R_y", "p_RS_R_z", "q_RS_w", "q_RS_x", "q_RS_y", "q_RS_z")
_AS_TUM = [0, 1, 2, 3, 5, 6, 7, 4]  # quaternions w first there, w last in TUM
_PLACES = ("data.csv", "state_groundtruth_estimate0/data.csv", "mav0/state_groundtruth_estimate0/data.csv")


def find_euroc_truth(folder: Path) -> Path | None:
    """The ground-truth csv of a recording's folder, its ``mav0``, or the folder of the csv itself; None if none."""
    return next((folder / place for place in _PLACES if (folder / place).is_file()), None)


def is_euroc(text: str) -> bool:
    """Whether the first line of a text that is no comment has commas, as no other format of poses does."""
    return "," in next((line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")), "")


def parse_euroc(text: str, path: Path) -> tuple[Array, IntArray]:
    """Rows of TUM, ``time tx ty tz qx qy qz qw`` (s, m), and the line number (from 1) of each.

    The csv holds the pose ``T_R_S`` of the body (the IMU) in the reference frame, stamped in ns, quaternions w first.
    Its header must name these eight columns; more may follow (velocity and biases), and are not read.

    Raises:
        UnknownFormatError: There are no poses.
        TruthError: The header is missing or names other columns; a line is malformed, or has more or fewer columns.
        NonFiniteError: A pose holds NaN or infinity.
    """
    rows: list[list[float]] = []
    lines: list[int] = []
    header: list[str] = []
    for number, line in enumerate(text.splitlines(), start=1):
        where: dict[str, Any] = {"source": str(path), "field": "line", "index": number}
        words = [word.strip() for word in line.split(",")]
        if not line.strip():
            continue
        if not header:
            header = [word.lstrip("#").split("[")[0].strip() for word in words]
            if not line.startswith("#") or tuple(header[: len(COLUMNS)]) != COLUMNS:
                raise TruthError(f"the header is missing or differs; expected #{', '.join(COLUMNS)}, ...", **where)
            continue
        if len(words) != len(header):
            raise TruthError(f"{len(words)} columns, the header has {len(header)}", **where)
        try:
            row = [int(words[0]) / 1e9, *(float(word) for word in words[1 : len(COLUMNS)])]
        except (ValueError, OverflowError) as error:
            raise TruthError(str(error), **where) from None
        if not np.isfinite(row).all():
            raise NonFiniteError("NaN or infinite value", **where)
        rows.append(row)
        lines.append(number)
    if not rows:
        raise UnknownFormatError(f"{path}: holds no poses; expected lines of {', '.join(COLUMNS)}, ...")
    return np.array(rows)[:, _AS_TUM], np.array(lines)
