"""Text files of an inertial unit, ``data.csv`` of EuRoC among them, and arrays of the export of OpenVINS's simulator.

A row is ``timestamp [ns], w_x, w_y, w_z [rad/s], a_x, a_y, a_z [m/s^2]``. A header may name other columns, orders and
units. Without a unit of the stamps, the step between them decides.
"""

from __future__ import annotations

import re
from dataclasses import replace
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import NamedTuple
from zipfile import BadZipFile

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.data.inertial import InertialRows
from ekfslam.data.readers.ece276a import inspect_npz
from ekfslam.data.readers.fields import checksum, require_numbers
from ekfslam.data.readers.imu_yaml import beside, calibrated, read_imu_yaml
from ekfslam.data.readers.registry import Reader, Source
from ekfslam.data.readers.text import first_row, line_of, parse_numbers, read_lines
from ekfslam.errors import LineError, StampError, UnknownFormatError

_PLACES = ("mav0/imu0/data.csv", "imu0/data.csv", "data.csv")
_NS = {"ns": 1, "us": 1_000, "ms": 1_000_000, "s": 1_000_000_000}
_UNITS = {
    "time": {**dict.fromkeys(_NS, 1.0), "nsec": 1.0, "sec": 1.0, "seconds": 1.0},
    "gyro": {"rad/s": 1.0, "deg/s": np.pi / 180, "dps": np.pi / 180, "mrad/s": 1e-3},
    "accel": {"m/s2": 1.0, "g": 9.80665, "mg": 9.80665e-3, "cm/s2": 1e-2, "mm/s2": 1e-3},
}
_NUMBER = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d+)?")
_SAME = {"nsec": "ns", "sec": "s", "seconds": "s"}
_RATES_HZ = 20.0, 8000.0  # of inertial units: at one of them a step tells the unit of stamps
_KIND = (
    ("", re.compile(r"cov|angular_?acc|orient|mag|temp|quat|seq")),
    ("gyro", re.compile(r"gyro|gyr$|omega|ang|rot_?rate|(^|_)(w|g)(_|$)")),
    ("accel", re.compile(r"acc|force|(^|_)(a|f)(_|$)")),
)
_WANTED = ("time", *(f"{kind} {axis}" for kind in ("gyro", "accel") for axis in "xyz"))
EXPECTED = "a csv of an inertial unit: timestamp, w_x, w_y, w_z (rad/s), a_x, a_y, a_z (m/s^2)"


class _Columns(NamedTuple):
    """Places (7,) of the columns in a row, factors (6,) of rates and forces, the unit of stamps, and notes."""

    place: list[int]
    factor: Array
    unit: str
    width: int
    notes: tuple[str, ...]


def read_imu(place: Path) -> InertialRows:
    """Read the samples of a text file, or of a folder ``imu0`` of EuRoC, with the densities beside them."""
    path = next((place / name for name in _PLACES if (place / name).is_file()), place)
    lines = read_lines(path, f"expected {EXPECTED}")
    rows = [(n, words) for n, line in enumerate(lines, 1) if (words := _words(line.split("#")[0]))]
    begin = next((n for n, words in rows if _NUMBER.fullmatch(words[0])), None)
    if begin is None:
        raise UnknownFormatError(f"{path}: holds no samples; expected {EXPECTED}")
    named = [line for line in lines[: begin - 1] if len(_words(line)) >= 7]
    header, rows = named[-1] if named else "", [row for row in rows if row[0] >= begin]
    columns = _columns(header, len(rows[0][1]), path)
    clock, values, numbers = _Clock(), [], []
    for number, words in rows:
        where = line_of(path, number)
        if len(words) != columns.width:
            raise LineError(f"{len(words)} columns, expected {columns.width}", **where)
        values.append(parse_numbers([words[i] for i in columns.place], 7, where, converters={0: clock}))
        numbers.append(number)
    table = np.array(values)
    time_ns, note = clock.stamps(table[:, 0], columns.unit, path)
    gyro, accel = table[:, 1:4] * columns.factor[:3], table[:, 4:] * columns.factor[3:]
    notes = (*columns.notes, *note)
    return _with_densities(InertialRows(str(path), time_ns, gyro, accel, line=np.array(numbers), notes=notes), path)


def _with_densities(rows: InertialRows, path: Path) -> InertialRows:
    """Return samples of a file with the densities beside it, and its digest."""
    calibration = beside(path.parent)
    rows = replace(rows, attributes={"imu_sha256": checksum(path, *([] if calibration is None else [calibration]))})
    return rows if calibration is None else calibrated(rows, read_imu_yaml(calibration))


def _words(line: str) -> list[str]:
    separator = next((mark for mark in (",", ";", "\t") if mark in line), None)
    return [word.strip() for word in line.strip().split(separator)] if line.strip() else []


def _columns(header: str, count: int, path: Path) -> _Columns:
    names = _words(header.lstrip("#% ")) if header else []
    if not names:
        if count != 7:
            raise UnknownFormatError(f"{path}: {count} columns without a header; expected {EXPECTED}")
        return _Columns(list(range(7)), np.ones(6), "", 7, ())
    found: dict[str, tuple[int, str]] = {}
    for i, name in enumerate(names):
        kind, unit = _kind_of(name)
        # The stamp in the header of a message is that of the sample; the first column may be that of writing.
        if kind and (kind not in found or "header.stamp" in name):
            found[kind] = i, unit
    if missing := [name for name in _WANTED if name not in found]:
        raise UnknownFormatError(f"{path}: the header names no column of {', '.join(missing)}; expected {EXPECTED}")
    notes, factor = [], np.ones(6)
    for j, name in enumerate(_WANTED[1:]):
        unit, known = found[name][1], _UNITS[name.split()[0]]
        if unit and unit not in known:
            raise UnknownFormatError(f"{path}: the unit {unit!r} of {name}; known: {', '.join(known)}")
        factor[j] = known.get(unit, 1.0)
        if factor[j] != 1.0 and name.endswith("x"):
            notes.append(f"The header states {unit} for {name.split()[0]} columns: they are converted.")
    unit = found["time"][1]
    if unit and unit not in _UNITS["time"]:
        raise UnknownFormatError(f"{path}: the unit {unit!r} of stamps; known: {', '.join(_NS)}")
    return _Columns([found[name][0] for name in _WANTED], factor, _SAME.get(unit, unit), len(names), tuple(notes))


def _kind_of(name: str) -> tuple[str, str]:
    """Return a name of `_WANTED`, empty for any other column, and the unit of a column; empty if not stated."""
    stem, unit = name.strip().strip("\"'").lower()[:200], ""
    if match := re.search(r"[\[(]([^\])]*)[\])]", stem):
        stem, unit = stem[: match.start()], match.group(1)
    elif match := re.search(r"_(ns|us|ms|s|nsec|sec|rad_s|rads|deg_s|dps|m_s2|m_s_2|ms2|mg)$", stem):
        stem, unit = stem[: match.start()], match.group(1)
        unit = {"rads": "rad/s", "ms2": "m/s2", "m_s_2": "m/s2"}.get(unit, unit.replace("_", "/", 1))
    unit = re.sub(r"\s*\*\*\s*|\^|\s", "", unit.replace("°", "deg"))
    unit = {"rads-1": "rad/s", "degs-1": "deg/s", "ms-2": "m/s2", "m/s/s": "m/s2", "cms-2": "cm/s2"}.get(unit, unit)
    unit = unit.replace("²", "2").replace("sec", "s") if "/" in unit else unit
    stem = re.sub(r"[^a-z0-9]+", "_", stem).strip("_")
    if re.search(r"time|stamp|^t$|^seconds", stem) and not re.search(r"_[xyz]$", stem):
        return "time", unit
    match = re.fullmatch(r"(.*?)_?([xyz])", stem)
    if match is None:
        return "", unit
    kind = next((kind for kind, pattern in _KIND if pattern.search(match.group(1))), "")
    return (f"{kind} {match.group(2)}" if kind else ""), unit


class _Clock:
    """Parses stamps as differences to the first one, which a float holds exactly."""

    first: Decimal | None = None

    def __call__(self, word: str) -> float:
        try:
            stamp = Decimal(word)
        except InvalidOperation:
            raise ValueError(f"could not convert {word!r} to a stamp") from None
        if not stamp.is_finite():
            return float("nan")
        self.first = stamp if self.first is None else self.first
        return float(stamp - self.first)

    def stamps(self, since: Array, stated: str, path: Path) -> tuple[IntArray, tuple[str, ...]]:
        """Return stamps (N,) in ns, given those since the first, and a note on a unit that was guessed."""
        assert self.first is not None
        steps = np.diff(since)
        steps = steps[steps > 0]
        step, first = float(np.median(steps)) if len(steps) else 0.0, float(abs(self.first))
        likely = [unit for unit, ns in _NS.items() if step and _RATES_HZ[0] <= 1e9 / (step * ns) <= _RATES_HZ[1]]
        since_1970 = next((unit for unit, least in (("ns", 1e17), ("us", 1e14), ("ms", 1e11)) if first >= least), "")
        unit = stated or (likely[0] if likely else since_1970 or "s")
        problem = ""
        if stated and step and likely and not 1.0 <= (rate := 1e9 / (step * _NS[stated])) <= 1e5:
            problem = f"stamps in {stated} with steps of {step:g} would be {rate:.3g} Hz: they look like {likely[0]}"
            problem += "; correct the header"
        elif first * _NS[unit] > 9e18:
            problem = f"stamps in {unit} are too large, the first is {self.first}"
        if problem:
            raise StampError(problem, source=str(path), field="time")
        note = () if stated or unit == "ns" else (f"Stamps of {path.name} are taken as {unit}, by their steps.",)
        return round(self.first * _NS[unit]) + np.round(since * _NS[unit]).astype(np.int64), note


def _read_arrays(source: Source) -> InertialRows | None:
    """Read ``imu_time_s``, ``gyro_rad_s`` and ``accel_m_s2`` of an .npz, and ``cam0_T_imu_cam`` if it is there."""
    path = source.path
    names = ("imu_time_s", "gyro_rad_s", "accel_m_s2")
    try:
        inspect_npz(path, names)
        with np.load(path, allow_pickle=False) as file:
            fields = {name: file[name] for name in names if name in file.files}
    except (OSError, ValueError, KeyError, BadZipFile) as error:
        raise UnknownFormatError(f"{path}: damaged ({error})") from None
    time_s = require_numbers(fields, "imu_time_s", (None,))
    gyro, accel = (require_numbers(fields, name, (len(time_s), 3)) for name in ("gyro_rad_s", "accel_m_s2"))
    seconds = np.floor(time_s)
    stamps = seconds.astype(np.int64) * 1_000_000_000 + np.round((time_s - seconds) * 1e9).astype(np.int64)
    return _with_densities(InertialRows(str(path), stamps, gyro, accel), path)


def _has_arrays(source: Source) -> bool:
    if not source.head.startswith(b"PK"):
        return False
    with source.path.open("rb") as file:
        file.seek(max(0, source.path.stat().st_size - 65536))  # the directory of a zip file is at its end
        return b"imu_time_s.npy" in file.read()


def _recognises(source: Source) -> bool:
    if source.path.is_dir():
        return any((source.path / name).is_file() for name in _PLACES)
    return len(_words(first_row(source.path))) >= 7


READER = Reader("imu", EXPECTED, _recognises, inertial=lambda source: read_imu(source.path))
ARRAYS = Reader("imu_arrays", "an .npz with imu_time_s, gyro_rad_s, accel_m_s2", _has_arrays, inertial=_read_arrays)
