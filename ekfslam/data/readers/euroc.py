"""Ground truth of EuRoC MAV recordings (Burri et al., IJRR 2016): ``mav0/state_groundtruth_estimate0/data.csv``."""

from __future__ import annotations

from pathlib import Path

from ekfslam.data.readers.registry import Poses, TruthReader
from ekfslam.data.readers.text import Table, first_row, line_of, parse_table, read_lines, rows_of
from ekfslam.data.readers.tum import stamped_poses
from ekfslam.data.sequence import Sequence
from ekfslam.errors import TruthError, UnknownFormatError

COLUMNS = ("timestamp", "p_RS_R_x", "p_RS_R_y", "p_RS_R_z", "q_RS_w", "q_RS_x", "q_RS_y", "q_RS_z")
_AS_TUM = [0, 1, 2, 3, 5, 6, 7, 4]  # quaternions w first there, w last in TUM
_FOLDERS = ("state_groundtruth_estimate0", "mocap0")  # mocap0: TUM-VI
_PLACES = ("data.csv", *(f"{above}{folder}/data.csv" for above in ("", "mav0/") for folder in _FOLDERS))
_EXPECTED = "a EuRoC ground-truth csv or its folder"


def find_euroc_truth(folder: Path) -> Path | None:
    """The ground-truth csv of a recording's folder, its ``mav0``, or the folder of the csv itself; None if none."""
    return next((folder / place for place in _PLACES if (folder / place).is_file()), None)


def read_euroc(path: Path, sequence: Sequence | None = None) -> Poses:
    """The poses of a csv, or of the csv that belongs to a folder.

    The csv holds the pose ``T_R_S`` of the body (the IMU) in the reference frame, stamped in ns, quaternions w first.
    Its header must name these eight columns; more may follow (velocity and biases), and are not read.

    Raises:
        UnknownFormatError: The file is not text, or there are no poses.
        TruthError: The header is missing or names other columns; a line is malformed, or has more or fewer columns.
        NonFiniteError: A pose holds NaN or infinity.
        StampError: The stamps do not increase.
    """
    path = find_euroc_truth(path) or path
    lines = read_lines(path, f"expected {_EXPECTED}")
    number, line = next(iter(rows_of(lines, comment=None)), (1, ""))
    header = [word.split("[")[0].strip() for word in line.removeprefix("#").split(",")]
    if not line.startswith("#") or tuple(header[: len(COLUMNS)]) != COLUMNS:
        expected = f"expected #{', '.join(COLUMNS)}, ..."
        raise TruthError(f"the header is missing or differs; {expected}", **line_of(path, number))
    table = parse_table(
        lines,
        path,
        columns=len(header),
        used=len(COLUMNS),
        separator=",",
        # Nanoseconds since 1970 have more digits than a float; as integers they lose none.
        converters={0: lambda word: int(word) / 1e9},
        error=TruthError,
    )
    if not len(table.values):
        raise UnknownFormatError(f"{path}: holds no poses; expected lines of {', '.join(COLUMNS)}, ...")
    return stamped_poses(Table(path, table.values[:, _AS_TUM], table.line))


def _recognises(path: Path) -> bool:
    # No other format of poses has commas.
    return find_euroc_truth(path) is not None or "," in first_row(path)


TRUTH_READER = TruthReader("EuRoC", _EXPECTED, _recognises, read_euroc)
