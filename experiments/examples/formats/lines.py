"""A made-up text format of recordings. A file like this one may as well lie in ``ekfslam/data/readers``.

Every line is a keyword and numbers; all velocities and pixels belong to the frame above them::

    LINES 1
    camera fu fv cu cv baseline
    T_cam_imu r11 r12 r13 t1 ... 0 0 0 1
    noise sigma_v sigma_w sigma_px
    frame t vx vy vz wx wy wz
    seen id uL vL uR vR
"""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.noise import Noise
from ekfslam.data.readers.registry import Reader, Source
from ekfslam.data.readers.text import line_of, parse_numbers, read_lines, rows_of
from ekfslam.data.sequence import Observations, Sequence
from ekfslam.errors import LineError, ShapeError
from ekfslam.geometry.camera import StereoCamera

COUNTS = {"camera": 5, "T_cam_imu": 16, "noise": 3, "frame": 7, "seen": 5}


def _open(source: Source) -> Sequence:
    """Only the text is checked here: `Sequence` checks what the numbers say, and names the source."""
    lines: dict[str, list[list[float]]] = defaultdict(list)
    for number, content in rows_of(read_lines(source.path, READER.expected)):
        keyword, *words = content.split()
        where = line_of(source.path, number)
        if keyword == "LINES":
            continue
        if keyword not in COUNTS:
            raise LineError(f"unknown keyword {keyword!r}; known: {', '.join(COUNTS)}", **where)
        values = parse_numbers(words, COUNTS[keyword], where)
        lines[keyword].append([len(lines["frame"]) - 1, *values] if keyword == "seen" else values)
    for keyword in COUNTS:
        if not lines[keyword]:
            raise ShapeError("this line is missing", source=source.place, field=keyword)
    table: dict[str, Array] = {keyword: np.array(values) for keyword, values in lines.items()}
    frame, landmark = table["seen"][:, :2].T.astype(np.int64)
    return Sequence(
        name=source.path.stem,
        source=source.place,
        time_s=table["frame"][:, 0],
        twist=table["frame"][:, 1:],
        camera=StereoCamera(*lines["camera"][0]),
        T_cam_imu=table["T_cam_imu"][0].reshape(4, 4),
        observations=Observations(frame, landmark, table["seen"][:, 2:]),
        noise=Noise.isotropic(*lines["noise"][0]),
        attributes={"reader": READER.name},
    )


READER = Reader("lines", "a LINES 1 text file", lambda source: source.head.startswith(b"LINES 1"), _open)
