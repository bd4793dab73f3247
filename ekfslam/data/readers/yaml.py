"""Calibrations in YAML, as EuRoC and Kalibr write them.

Only ``key: value``, blocks by indentation, and lists of numbers (brackets or dashes) are read. Nothing is evaluated.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.readers.text import read_lines
from ekfslam.errors import CalibrationError
from ekfslam.limits import Budget
from ekfslam.names import printable

_KEY = re.compile(r"(\s*)(?:- )?([A-Za-z_][\w.]*)\s*:(?:\s+(.*)|(\[.*)|)$")
_WORD = re.compile(r"[A-Za-z~.]+")
_NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?(?![\w.])")


@dataclass(frozen=True)
class Calibration:
    """Texts of a file by key, such as ``cam0.T_cam_imu``."""

    path: Path  # file that was read
    values: Mapping[str, str]  # text by key; the key of a block and a dot precede the keys in it

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def word(self, key: str) -> str:
        """Return the word of a key; raise `CalibrationError` if it is missing."""
        if key not in self.values:
            raise CalibrationError("this key is missing", source=str(self.path), field=key)
        return self.values[key].strip().strip("\"'")

    def place(self, key: str) -> str:
        """Return the key of some numbers: ``data`` below a key if it is there, as in matrices of OpenCV and ROS."""
        return f"{key}.data" if f"{key}.data" in self.values else key

    def numbers(self, key: str, count: int | None = None) -> Array:
        """Return the numbers (n,) of a key; raise `CalibrationError` if they are missing or not ``count``."""
        key = self.place(key)
        text = self.word(key)
        found, word = _NUMBER.findall(text), _WORD.search(_NUMBER.sub("", text))
        if word is not None or count not in (None, len(found)):
            what = f"expected {count} numbers, found {len(found)}"
            if word is not None:
                what = f"expected numbers, found {printable(word.group())!r}"
            raise CalibrationError(what, source=str(self.path), field=key)
        return np.array(found, dtype=float)

    def matrix(self, key: str, rows: int, columns: int) -> Array:
        """Return the numbers of a key as a matrix."""
        return self.numbers(key, rows * columns).reshape(rows, columns)


def read_yaml(path: Path) -> Calibration:
    """Read the keys of a file."""
    parts: dict[str, list[str]] = {}
    above: list[tuple[int, str]] = []
    budget = Budget(str(path))
    for raw in read_lines(path, "expected a calibration in YAML"):
        line = (re.sub(r"(^|\s)#.*$", "", raw) if "#" in raw else raw).rstrip()
        if not line or line.startswith(("%", "---")):
            continue
        match = _KEY.match(line) if ":" in line else None
        if match:
            depth = len(match.group(1))
            above = [entry for entry in above if entry[0] < depth] + [(depth, match.group(2))]
            budget.take(sum(len(key) + 1 for _, key in above), "a key with those above it")
            last = parts[".".join(key for _, key in above)] = [match.group(3) or match.group(4) or ""]
        elif above:
            last.append(line)
    return Calibration(path, {key: " ".join(lines) for key, lines in parts.items()})
