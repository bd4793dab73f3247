"""Inertial samples as files have them: units and stamps are checked; mistakes are errors, doubts are notes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.data.inputs import InertialNoise, InertialSamples
from ekfslam.errors import DataError, LostDataError, ShapeError, StampError

_GRAVITY = (9.0, 10.6)  # m/s^2, of a sound accelerometer at the quietest second
_FASTEST = 35.0  # rad/s: gyroscopes end at 2000 deg/s
_RATE_OFF = 0.1  # share by which a stated rate may be off
_SLOWEST_HZ = 80.0  # below, means of neighbouring samples integrate poorly
NOT_STATED = "Noise densities of the inertial unit are not stated."
_UNITS: dict[str, tuple[float, float, str]] = {  # range of the mean |f| at the quietest second, and what to do
    "m/s^2 with gravity removed": (0.0, 0.5, "take the accelerometer itself, not the phone's linear acceleration"),
    "g": (0.85, 1.15, "multiply by 9.80665"),
    "ft/s^2": (30.5, 34.0, "multiply by 0.3048"),
    "cm/s^2 or milli-g": (850.0, 1150.0, "multiply by 0.01 or by 0.00980665"),
    "mm/s^2": (9000.0, 10600.0, "multiply by 0.001"),
}


@dataclass(frozen=True)
class InertialRows:
    """Samples in the order of a file, on any clock."""

    source: str  # file or stream, for messages
    time_ns: IntArray  # (N,) stamps; integers, because those since 1970 have more digits than a float
    gyro_rad_s: Array  # gyro_rad_s, accel_m_s2: (N, 3) angular rates and specific forces
    accel_m_s2: Array
    noise: InertialNoise | None = None  # densities; None if nothing states them
    late_s: float = 0.0  # stamp of a sample less that of an image of the same instant
    stated_hz: float = 0.0  # rate that a file states; 0 if none does
    line: IntArray | None = None  # (N,) lines of a text file; None for other sources
    T_cam_imu: Array | None = None  # (4, 4) pose of the left camera, if the source states it
    sorts: bool = False  # whether stamps that go back are sorted. Else they are an error.
    notes: tuple[str, ...] = ()  # notes, attributes: facts for the recording that takes the samples
    attributes: Mapping[str, str | int | float] = field(default_factory=dict)

    def where(self, row: int) -> dict[str, Any]:
        """Return the place of a row as keyword arguments of a `DataError`."""
        if self.line is None:
            return {"source": self.source, "field": "sample", "index": row}
        return {"source": self.source, "field": "line", "index": int(self.line[row])}


def samples_of(rows: InertialRows) -> tuple[InertialSamples, tuple[str, ...]]:
    """Return the samples on the clock of the images, without repeated stamps and densities of 0, and notes."""
    rows, notes = in_order(rows)
    if len(rows.time_ns) < 2:
        raise ShapeError(f"there are {len(rows.time_ns)} inertial samples, two are needed", source=rows.source)
    noise = rows.noise
    if noise is not None and not all(vars(noise).values()):
        noise, notes = None, [*notes, "Densities of 0 among those of the inertial unit count as not stated."]
    late_ns = round(rows.late_s * 1e9)
    if late_ns:
        notes.append(f"Stamps of the inertial unit are {rows.late_s:+.6f} s against the images: they are corrected.")
    seconds, rest = np.divmod(rows.time_ns - late_ns, 1_000_000_000)
    samples = InertialSamples(seconds + rest / 1e9, rows.gyro_rad_s, rows.accel_m_s2, noise)
    notes += [] if noise is not None else [NOT_STATED]
    rate = 1.0 / samples.step_s
    if rows.stated_hz and abs(np.log(rate / rows.stated_hz)) > _RATE_OFF:
        notes.append(f"The inertial unit is stated to have {rows.stated_hz:g} Hz, but its stamps have {rate:.4g} Hz.")
    return samples, (*rows.notes, *notes, *inertial_notes(samples, rows.source))


def in_order(rows: InertialRows) -> tuple[InertialRows, list[str]]:
    """Return the rows with increasing stamps, and notes; raise `StampError` for stamps that go back unless sorted."""
    notes, steps = [], np.diff(rows.time_ns)
    back = np.flatnonzero(steps < 0)
    if len(back):
        if not rows.sorts:
            message = f"the stamp is {-steps[back[0]] / 1e9:g} s before that of the sample before it; sort the samples"
            raise StampError(message, **rows.where(int(back[0]) + 1))
        notes.append(f"{len(back)} inertial samples are stamped before their predecessors: they are sorted.")
        rows = _part(rows, np.argsort(rows.time_ns, kind="stable"))
    twice = np.concatenate([[False], np.diff(rows.time_ns) == 0])
    if twice.any():
        first = rows.where(int(np.argmax(twice)))
        at = f"{first['field']} {first['index']}"
        notes.append(f"{int(twice.sum())} inertial samples repeat a stamp, the first at {at}: they are dropped.")
        rows = _part(rows, ~twice)
    return rows, notes


def _part(rows: InertialRows, which: IntArray | BoolArray) -> InertialRows:
    line = None if rows.line is None else rows.line[which]
    arrays = {name: getattr(rows, name)[which] for name in ("time_ns", "gyro_rad_s", "accel_m_s2")}
    return replace(rows, line=line, **arrays)


def inertial_notes(samples: InertialSamples, source: str = "") -> tuple[str, ...]:
    """Return what is doubtful about samples, one sentence each; raise `DataError` if their units cannot be right."""
    gyro = np.linalg.norm(samples.gyro_rad_s, axis=1)
    quiet_f, quiet_w = (_at_rest(x, samples.step_s) for x in (samples.accel_m_s2, samples.gyro_rad_s))
    if _GRAVITY[0] <= quiet_w <= _GRAVITY[1] and not _GRAVITY[0] <= quiet_f <= _GRAVITY[1]:
        message = f"columns are swapped: the angular rates hold gravity, {quiet_w:.3g} at the quietest second"
        raise DataError(f"{message}; the gyroscope's columns come first", source=source, field="gyroscope")
    if np.mean(gyro > _FASTEST) > 0.01:
        message = f"angular rates look like deg/s: they reach {gyro.max():.3g}, more than any gyroscope in rad/s"
        raise DataError(f"{message}; multiply by pi / 180", source=source, field="gyroscope")
    for unit, (least, most, remedy) in _UNITS.items():
        if least <= quiet_f <= most:
            message = f"specific forces look like {unit}: {quiet_f:.3g} at the quietest second, expected 9.81 m/s^2"
            raise DataError(f"{message}; {remedy}", source=source, field="accelerometer")
    notes = []
    if not _GRAVITY[0] <= quiet_f <= _GRAVITY[1]:
        found = f"The mean specific force at the quietest second is {quiet_f:.3g} m/s^2, expected 9.81"
        notes.append(f"{found}: check the units of the accelerometer.")
    if (fast := int((gyro > _FASTEST).sum())) > 0:
        notes.append(f"{fast} angular rates exceed {_FASTEST:g} rad/s: spikes, or a unit other than rad/s.")
    if 0.5 / 57.3 < (turned := _turned_by_gravity(samples)) < 2.0 / 57.3:
        slow = f"Gravity in the samples turns {1 / turned:.0f} times slower than the angular rates say"
        notes.append(f"{slow}: they look like deg/s, multiply by pi / 180.")
    if 1.0 / samples.step_s < _SLOWEST_HZ:
        rate = f"The inertial unit has {1.0 / samples.step_s:.3g} Hz"
        notes.append(f"{rate}: below {_SLOWEST_HZ:g} Hz fast motion is integrated poorly.")
    count, longest_s = samples.gaps
    if count:
        gaps = f"{count} gaps of more than three steps; the longest is {longest_s:.3g} s"
        notes.append(f"The inertial samples have {gaps}.")
    return tuple(notes)


def _at_rest(values: Array, step_s: float) -> float:
    """Return the mean norm of (N, 3) during the second with the least variance."""
    n = int(np.clip(round(1.0 / step_s), 1, len(values)))
    centred = values - values.mean(axis=0)
    columns = np.column_stack([centred, (centred**2).sum(axis=1), np.linalg.norm(values, axis=1)])
    sums = np.vstack([np.zeros(5), np.cumsum(columns, axis=0)])
    mean = (sums[n:] - sums[:-n]) / n
    return float(mean[np.argmin(mean[:, 3] - (mean[:, :3] ** 2).sum(axis=1)), 4])


def _turned_by_gravity(samples: InertialSamples) -> float:
    """Return the turn rate of the specific force over the gyroscope's, by ``df/dt = -w x f``; NaN at rest."""
    n = max(1, round(0.5 / samples.step_s))
    count = len(samples.time_s) // n
    w, f = (x[: n * count].reshape(count, n, 3).mean(axis=1) for x in (samples.gyro_rad_s, samples.accel_m_s2))
    if count < 20:
        return np.nan
    df = 0.5 * (f[2:] - f[:-2]) / (n * samples.step_s)
    expected = -np.cross(w, f)[1:-1]
    power = float((expected**2).sum())
    factor = float((df * expected).sum()) / power if power > 0 else np.nan
    # Slow turns do not tell: noise hides them.
    error = np.sqrt(((df - factor * expected) ** 2).sum() / (3 * len(df)) / power) if power > 0 else np.inf
    return factor if error < 0.3 * abs(factor) else np.nan


def covered_frames(samples: InertialSamples, time_s: Array, source: str) -> tuple[int, int]:
    """Return the first frame and the end of those (T,) within the samples, or at most one step outside: two or more."""
    reach = samples.step_s
    begin = int(np.searchsorted(time_s, samples.time_s[0] - reach))
    end = int(np.searchsorted(time_s, samples.time_s[-1] + reach, side="right"))
    if end - begin < min(2, len(time_s)):
        spans = [f"{each[0]:.3f} to {each[-1]:.3f} s" for each in (samples.time_s, time_s)]
        message = f"inertial samples, {spans[0]}, do not cover the images, {spans[1]}"
        raise LostDataError(f"{message}: are both on one clock?", source=source, field="time_s")
    return begin, end
