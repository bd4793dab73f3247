"""Text files of velocities, one sample a line: seconds, three linear and three angular velocities (m/s, rad/s).

Blanks or commas separate columns. Three columns are ``time vx wz`` of a planar robot. A header may name columns in any
order; the others are 0. A comment ``# frame: level`` (or ``imu``) states the frame of the velocities.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import cast, get_args

import numpy as np

from ekfslam.data.checks import spelled_as_in, validate_stamps
from ekfslam.data.inputs import VelocityFrame, VelocitySamples
from ekfslam.data.readers.columns import TWIST, Header, header_of, read_named, without_repeats
from ekfslam.data.readers.fields import checksum
from ekfslam.data.readers.registry import Reader, Source
from ekfslam.data.readers.text import first_row, parse_table, read_lines
from ekfslam.errors import ConfigError, UnknownFormatError

COLUMNS = ("time", "vx", "vy", "vz", "wx", "wy", "wz")
PLANAR = ("time", "vx", "wz")  # of a robot with wheels; the others are 0
_FRAME_LINE = re.compile(r"#\s*frame\s*[:=]\s*(\S+)\s*", re.IGNORECASE)


def _recognises(source: Source) -> bool:
    count = len(first_row(source.path).replace(",", " ").split())
    return count in (len(COLUMNS), len(PLANAR)) or _header(source.path) is not None


def _header(path: Path) -> Header | None:
    """Return a header that names velocities."""
    if not first_row(path):
        return None
    try:
        header = header_of(read_lines(path, f"expected {READER.expected}"))
    except UnknownFormatError:  # no text
        return None
    return header if header is not None and {"vx", "wz"} <= header.place.keys() else None


def _inputs(source: Source) -> VelocitySamples:
    path = source.path
    lines = read_lines(path, f"expected {READER.expected}")
    rows, stated = list(lines), ""
    for number, line in enumerate(lines):
        match = _FRAME_LINE.fullmatch(line.strip())
        stated = match.group(1) if match else stated
        # A header names the columns; it may stand there without the mark of a comment.
        if re.match(r"\s*[A-Za-z_]", line) and not any(row.split("#")[0].strip() for row in rows[:number]):
            rows[number] = ""
    if stated and stated not in get_args(VelocityFrame):
        raise ConfigError(f"{path}: the frame of velocities must be imu or level, found {stated!r}")
    if (header := _header(path)) is not None:
        table = read_named(path, lines, header, TWIST)
    else:
        separator = "," if "," in "".join(row.split("#")[0] for row in rows) else None
        is_planar = len(first_row(path).replace(",", " ").split()) == len(PLANAR)
        table = parse_table(rows, path, columns=len(PLANAR if is_planar else COLUMNS), separator=separator)
        if is_planar:
            planar = np.zeros((len(table.values), len(COLUMNS)))
            planar[:, [0, 1, 6]] = table.values
            table = replace(table, values=planar)
    if not len(table.values):
        raise UnknownFormatError(f"{path}: holds no velocities; expected {READER.expected}")
    table, repeated = without_repeats(table)
    with spelled_as_in(str(path)):
        validate_stamps(table.values[:, 0])
    frame = cast(VelocityFrame, stated or "imu")
    unsaid = f"{path.name} does not say in which frame its velocities are: they are taken as imu."
    notes = repeated if stated else (*repeated, unsaid)
    attributes = {"velocities_sha256": checksum(path)}
    return VelocitySamples(str(path), table.values[:, 0], table.values[:, 1:], frame, None, attributes, notes)


READER = Reader(
    "velocities",
    f"a text file of {' '.join(COLUMNS)} or {' '.join(PLANAR)} (s, m/s, rad/s; blanks or commas)",
    _recognises,
    inputs=_inputs,
)
