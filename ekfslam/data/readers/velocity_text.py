"""Text files of velocities, one sample a line: seconds, three linear and three angular velocities (m/s, rad/s).

Columns are separated by blanks, as in files of TUM, or by commas. A comment line ``# frame: level`` (or ``imu``) states
the frame of the velocities.
"""

from __future__ import annotations

import re
from typing import cast, get_args

from ekfslam.data.inputs import VelocityFrame, VelocitySamples
from ekfslam.data.readers.fields import checksum
from ekfslam.data.readers.registry import Reader, Source
from ekfslam.data.readers.text import first_row, parse_table, read_lines
from ekfslam.errors import ConfigError, UnknownFormatError

COLUMNS = ("time", "vx", "vy", "vz", "wx", "wy", "wz")
_FRAME_LINE = re.compile(r"#\s*frame\s*[:=]\s*(\S+)\s*", re.IGNORECASE)


def _recognises(source: Source) -> bool:
    return len(first_row(source.path).replace(",", " ").split()) == len(COLUMNS)


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
    separator = "," if "," in "".join(row.split("#")[0] for row in rows) else None
    table = parse_table(rows, path, columns=len(COLUMNS), separator=separator)
    if not len(table.values):
        raise UnknownFormatError(f"{path}: holds no velocities; expected {READER.expected}")
    table.require_increasing()
    frame = cast(VelocityFrame, stated or "imu")
    notes = () if stated else (f"{path.name} does not say in which frame its velocities are: they are taken as imu.",)
    attributes = {"velocities_sha256": checksum(path)}
    return VelocitySamples(str(path), table.values[:, 0], table.values[:, 1:], frame, None, attributes, notes)


READER = Reader(
    "velocities",
    f"a text file of {' '.join(COLUMNS)} (s, m/s, rad/s; blanks or commas)",
    _recognises,
    inputs=_inputs,
)
