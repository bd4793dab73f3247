"""Columns of text files by the names in their header, as EuRoC, OpenVINS, evo and exports of ROS write them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from ekfslam.data.readers.text import Table, line_of, parse_table
from ekfslam.errors import DataError, LineError

# Names of columns without units, in lower case and without punctuation.
_AXES = {
    "": ("p{}", "t{}", "{}", "prsr{}", "pos{}", "position{}", "posepose position{}", "pwb{}", "translation{}"),
    "q": ("q{}", "qrs{}", "quat{}", "orientation{}", "rotation{}", "quaternion{}", "posepose orientation{}"),
    "v": ("v{}", "vel{}", "linear{}", "vrsr{}", "twistlinear{}", "twisttwistlinear{}", "linearvelocity{}"),
    "w": ("w{}", "omega{}", "angular{}", "gyro{}", "twistangular{}", "twisttwistangular{}", "angularvelocity{}"),
}
NAMES: dict[str, str] = {
    pattern.replace(" ", "").format(axis): f"{kind}{axis}"
    for kind, patterns in _AXES.items()
    for pattern in patterns
    for axis in ("xyzw" if kind == "q" else "xyz")
}
NAMES |= dict.fromkeys(("time", "timestamp", "t", "stamp", "times", "timestamps", "sec", "seconds"), "time")
_UNITS = {"ns": 1e-9, "nsec": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0, "sec": 1.0}
_STEPS = (100_000, 1000)  # least steps of stamps that count from 0 in ns (0.1 ms) and in us (1 ms)
_PREFIXES = ("field", "headerstamp", "header", "pose", "twist", "msg", "data")
_HEADER_WITHIN, _LONGEST_HEADER = 20, 5000  # lines, characters
POSE = ("time", "x", "y", "z", "qx", "qy", "qz", "qw")
TWIST = ("time", "vx", "vy", "vz", "wx", "wy", "wz")


@dataclass(frozen=True)
class Header:
    """Columns that the first line of a file names."""

    place: Mapping[str, int]  # column by canonical name: `POSE` and `TWIST`
    count: int  # number of columns
    line: int  # number of the line, from 1
    separator: str | None  # separator of columns; None for blanks
    second: float  # length of the unit of stamps, s


def header_of(lines: list[str]) -> Header | None:
    """Return the header of a file: a line before its numbers that names the stamp and two more known columns."""
    for number, line in enumerate(lines[:_HEADER_WITHIN]):
        text = line[:_LONGEST_HEADER].strip().lstrip("#%").strip()
        if text and text[:1] == line.strip()[:1] and not text[0].isalpha():
            return None
        # A unit may stand apart from its name: p_RS_R_x [m]
        text = re.sub(r"\s+([\[(])", r"\1", text)
        words = [word.strip() for word in text.split("," if "," in text else None)]
        known = [(_canonical(word), column) for column, word in enumerate(words)]
        place = dict(reversed([(name, column) for name, column in known if name]))
        if len(place) < 3 or "time" not in place:
            continue
        rows = [row for row in lines[number + 1 :][:_HEADER_WITHIN] if row.strip() and not row.lstrip().startswith("#")]
        separator = "," if "," in next(iter(rows), line) else None
        second = _second(words[place["time"]], [row.split(separator)[place["time"] :] for row in rows])
        return Header(place, len(words), number + 1, separator, second)
    return None


def _second(name: str, rows: list[list[str]]) -> float:
    """Return the length of the unit of stamps, s: as the header says, or by the steps or the first of whole numbers."""
    unit = re.search(r"[\[(](\w+)[\])]|_([num]?s)$", name)
    if unit is not None:
        return _UNITS.get(next(group for group in unit.groups() if group), 1.0)
    words = [row[0].strip() for row in rows if row]
    if not words or not words[0].isdecimal():
        return 1.0
    digits, stamps = len(words[0]), [int(word) for word in words if word.isdecimal()]
    step = min((later - earlier for earlier, later in pairwise(stamps) if later > earlier), default=0)
    limits = ((18, _STEPS[0], 1e-9), (15, _STEPS[1], 1e-6), (12, np.inf, 1e-3))
    return next((second for least, longest, second in limits if digits >= least or step >= longest), 1.0)


def _canonical(word: str) -> str | None:
    """Return the name of a column in `POSE` and `TWIST`; None for others."""
    name = re.sub(r"[\[(].*?[\])]", "", word.lower())
    name = re.sub(r"_(ns|us|ms|s|m|m_s|rad_s)$", "", name.strip())
    name = re.sub(r"[^a-z]", "", name)
    while name not in NAMES and (prefix := next((p for p in _PREFIXES if name.startswith(p) and name != p), None)):
        name = name.removeprefix(prefix)
    return NAMES.get(name)


def read_named(
    path: Path, lines: list[str], header: Header, names: tuple[str, ...], error: type[DataError] = LineError
) -> Table:
    """Return the rows of some named columns, in that order, with stamps in s; columns that are missing are 0.

    A line with another number of columns, or no number in one of these, raises an ``error``.
    """
    columns = [header.place.get(name, -1) for name in names]

    def stamp(word: str) -> float:
        # Nanoseconds since 1970 have more digits than a float; as integers they lose none.
        return int(word) / 1e9 if header.second == 1e-9 else float(word) * header.second

    picked = [""] * header.line
    for number, line in enumerate(lines[header.line :], start=header.line + 1):
        text = line.split("#")[0]
        words = [word.strip() for word in text.split(header.separator)] if text.strip() else []
        if words and len(words) != header.count:
            raise error(f"{len(words)} columns, expected {header.count}", **line_of(path, number))
        picked.append(" ".join((words[column] or "?") if column >= 0 else "0" for column in columns) if words else "")
    return parse_table(picked, path, columns=len(columns), converters={0: stamp}, error=error)


def without_repeats(table: Table) -> tuple[Table, tuple[str, ...]]:
    """Return a table without lines that repeat their predecessor, and a note; stamps must increase."""
    same = (np.diff(table.values, axis=0) == 0).all(axis=1)
    kept = np.flatnonzero(np.concatenate([[True], ~same])[: len(table.values)])
    found = Table(table.path, table.values[kept], table.line[kept])
    found.require_increasing()
    count = len(table.values) - len(kept)
    note = f"{count} lines of {table.path.name} repeat their predecessor and are left out."
    return found, (note,) if count else ()
