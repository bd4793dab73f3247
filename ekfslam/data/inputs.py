"""Inputs of a recording: what moves the body between two images, at any rate and from any number of sources."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, TypeVar, get_args

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.data.checks import LARGEST_VELOCITY, frozen, require_finite, require_shape, validate_stamps
from ekfslam.data.interpolation import interpolated_intervals
from ekfslam.data.interval import Interval
from ekfslam.errors import DataError, LostDataError, ShapeError
from ekfslam.shown import Card, Shown
from ekfslam.stored import FLAGS, attribute, stored

VelocityFrame = Literal["imu", "level"]
GAP_STEPS = 3.0
_ZERO = 1e-9  # m/s and rad/s, below which a velocity is a rounded 0


@dataclass(frozen=True, repr=False)
class Velocities(Shown):
    """Measured body velocities; sample k drives the interval from stamp k-1 to stamp k.

    Args:
        time_s: (N,) strictly increasing stamps.
        twist: (N, 6) velocities ``[v; w]``, m/s and rad/s.
        frame: ``imu``, or ``level``: x forward, y left, z up over level ground, see `motion.level_frame`.
        interpolated: (N,) whether a sample was interpolated rather than measured. By default found from the samples.
    """

    time_s: Array = field(metadata=stored("sample", "s", "clock of the recording", name="time"))
    twist: Array = field(metadata=stored("sample u", "m/s (columns 0-2), rad/s (columns 3-5)", "imu"))
    frame: VelocityFrame = field(default="imu", metadata=attribute(str))
    interpolated: BoolArray = field(
        default=None,  # type: ignore[arg-type]  # filled in
        metadata=stored("sample", check=FLAGS),
    )

    def __post_init__(self) -> None:
        _freeze(self, "time_s", "twist")
        validate_stamps(self.time_s)
        require_shape(self.twist, (len(self.time_s), 6), "twist")
        require_finite(self.twist, "twist", LARGEST_VELOCITY)
        if self.frame not in get_args(VelocityFrame):
            message = f"expected {' or '.join(get_args(VelocityFrame))}, found {self.frame!r}"
            raise DataError(message, field="velocity_frame")
        found = interpolated_intervals(self.twist) if self.interpolated is None else self.interpolated
        require_shape(found, self.time_s.shape, "interpolated")
        object.__setattr__(self, "interpolated", frozen(np.asarray(found, dtype=bool)))

    @property
    def measured(self) -> BoolArray:
        """Mask (6,) of the axes that are not exactly 0 throughout, such as four of a robot's wheel odometry."""
        return is_measured(self.twist)

    @property
    def text(self) -> str:
        """The samples in words."""
        return f"{len(self.time_s)} velocities ({self.frame} frame), {_rate(self.time_s)}"

    def card(self) -> Card:
        """Return the card that ``repr`` and a notebook show."""
        return Card(
            self.text, {"stamps": f"{self.time_s[0]:.10g} to {self.time_s[-1]:.10g} s"}, (".time_s", ".twist", ".frame")
        )

    def between(self, begin_s: float, end_s: float) -> Velocities:
        """Return the samples that drive the time from ``begin_s`` to ``end_s``."""
        begin, last = np.searchsorted(self.time_s, (begin_s, end_s)).tolist()
        return _part(self, min(begin, len(self.time_s) - 1), last + 1)

    def interval(self, begin_s: float, end_s: float) -> Interval:
        """Return the samples that drive a time, with durations; `LostDataError` if it is a step or more outside."""
        part = self.between(begin_s, end_s)
        _require_cover(self, begin_s, end_s)
        ends = np.append(part.time_s[:-1], end_s)
        dt = np.diff(ends, prepend=begin_s)
        driving = dt > 0
        return Interval(end_s - begin_s, dt[driving], part.twist[driving], bool(part.interpolated[driving].any()))

    def has_stamps(self, time_s: Array) -> bool:
        """Return whether there is one sample for each of the stamps (T,)."""
        return np.array_equal(self.time_s, time_s)

    def is_twist_of(self, time_s: Array) -> bool:
        """Return whether stamps (T,), ``twist`` and ``frame`` alone restore the samples."""
        return self.has_stamps(time_s) and np.array_equal(self.interpolated, interpolated_intervals(self.twist))

    def mean(self, time_s: Array) -> Array:
        """Return the mean velocities (T, 6) over the intervals that end at the stamps (T,).

        The first is the velocity at the first stamp. Before the first sample and after the last, its value holds.
        """
        if self.has_stamps(time_s):
            return self.twist
        at = self._driving(time_s)
        grid = np.union1d(self.time_s, time_s)
        held = self.twist[self._driving(grid)]
        means = means_between(time_s, grid, held * np.diff(grid, prepend=grid[0])[:, None])
        return np.vstack([self.twist[at[:1]], means])

    def interpolated_at(self, time_s: Array) -> BoolArray:
        """Return whether a sample of each interval that ends at the stamps (T,) was interpolated."""
        before = np.concatenate([[0], np.cumsum(self.interpolated)])
        end = self._driving(time_s) + 1
        begin = np.minimum(np.concatenate([end[:1] - 1, end[:-1]]), end - 1)
        return np.asarray(before[end] > before[begin])

    def _driving(self, time_s: Array) -> IntArray:
        return np.clip(np.searchsorted(self.time_s, time_s), 0, len(self.time_s) - 1)


@dataclass(frozen=True)
class VelocitySamples:
    """Velocities as a file has them, before they are brought to the stamps of a recording."""

    source: str
    time_s: Array  # (N,) increasing stamps
    twist: Array  # (N, 6) [v; w] in velocity_frame
    velocity_frame: VelocityFrame = "imu"
    T_cam_imu: Array | None = None  # (4, 4) extrinsics of the recording that holds them; None for a text file
    # attributes, notes: Facts about these velocities for the recording that takes them.
    attributes: Mapping[str, str | int | float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class InertialNoise:
    """Continuous-time noise densities of an inertial unit, as in ``sensor.yaml`` of EuRoC and ``imu.yaml`` of Kalibr.

    The standard deviation of a sample is ``gyro * sqrt(rate)``; a bias changes by ``gyro_walk * sqrt(dt)`` in ``dt``.

    Args:
        gyro, accel: rad/s/sqrt(Hz), m/s^2/sqrt(Hz).
        gyro_walk, accel_walk: rad/s^2/sqrt(Hz), m/s^3/sqrt(Hz).
    """

    gyro: float
    accel: float
    gyro_walk: float
    accel_walk: float

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and 0 <= value <= LARGEST_VELOCITY):
                raise DataError(f"must be finite and not negative, found {value}", field=f"inertial noise {name}")


@dataclass(frozen=True, repr=False)
class InertialSamples(Shown):
    """Instantaneous samples of a gyroscope and an accelerometer, both in the IMU frame.

    Args:
        time_s: (N,) strictly increasing stamps, on the clock of the recording.
        gyro_rad_s: (N, 3) angular rates.
        accel_m_s2: (N, 3) specific forces: +9.81 along up at rest.
        noise: Densities; None if the source states none.
    """

    time_s: Array = field(metadata=stored("sample", "s", "clock of the recording", name="time"))
    gyro_rad_s: Array = field(metadata=stored("sample xyz", "rad/s", "imu", name="gyro"))
    accel_m_s2: Array = field(metadata=stored("sample xyz", "m/s^2", "imu", name="accel"))
    noise: InertialNoise | None = None

    def __post_init__(self) -> None:
        _freeze(self, "time_s", "gyro_rad_s", "accel_m_s2")
        validate_stamps(self.time_s)
        for name in ("gyro_rad_s", "accel_m_s2"):
            require_shape(getattr(self, name), (len(self.time_s), 3), name)
            require_finite(getattr(self, name), name, LARGEST_VELOCITY)

    @property
    def text(self) -> str:
        """The samples in words."""
        n, stated = self.noise, "densities of noise not stated: found from the recording"
        if n is not None:
            stated = f"gyroscope {n.gyro:.3g} rad/s/sqrt(Hz), accelerometer {n.accel:.3g} m/s^2/sqrt(Hz)"
        gaps, longest_s = self.gaps
        pauses = f"; {gaps} gaps, the longest {longest_s:.3g} s" if gaps else ""
        return f"{len(self.time_s)} inertial samples, {_rate(self.time_s)}{pauses}; {stated}"

    def card(self) -> Card:
        """Return the card that ``repr`` and a notebook show."""
        return Card(
            self.text,
            {"stamps": f"{self.time_s[0]:.10g} to {self.time_s[-1]:.10g} s"},
            (".time_s", ".gyro_rad_s", ".accel_m_s2", ".noise"),
        )

    def between(self, begin_s: float, end_s: float) -> InertialSamples:
        """Return the samples from ``begin_s`` to ``end_s``, with one more on each side to interpolate to both ends."""
        begin = int(np.searchsorted(self.time_s, begin_s, side="right")) - 1
        end = int(np.searchsorted(self.time_s, end_s)) + 1
        return _part(self, max(begin, 0), end)

    @cached_property
    def step_s(self) -> float:
        """Median time between samples."""
        return _median_step(self.time_s)

    @cached_property
    def gaps(self) -> tuple[int, float]:
        """Number of gaps, which are steps of more than three times the median, and the longest of them in s."""
        steps = np.diff(self.time_s)
        steps = steps[steps > GAP_STEPS * self.step_s]
        return len(steps), float(steps.max(initial=0.0))

    def at(self, time_s: Array | float) -> Array:
        """Return the samples ``[w; f]`` (..., 6) at some time, linear between stamps."""
        return linear(self.time_s, np.hstack([self.gyro_rad_s, self.accel_m_s2]), time_s)

    def interval(self, begin_s: float, end_s: float) -> Interval:
        """Return the mean samples ``[w; f]`` between stamps, linear to both ends; gaps exceed three medians."""
        _require_cover(self, begin_s, end_s)
        begin = max(int(np.searchsorted(self.time_s, begin_s, side="right")) - 1, 0)
        part = slice(begin, int(np.searchsorted(self.time_s, end_s)) + 1)
        time_s, rows = self.time_s[part], np.hstack([self.gyro_rad_s[part], self.accel_m_s2[part]])
        inside = (time_s > begin_s) & (time_s < end_s)
        first, last = linear(time_s, rows, np.array([begin_s, end_s]))
        stamps = np.concatenate([[begin_s], time_s[inside], [end_s]])
        values = np.concatenate([[first], rows[inside], [last]])
        is_gap = len(time_s) > 1 and bool(np.diff(time_s).max() > GAP_STEPS * self.step_s)
        return Interval(end_s - begin_s, np.diff(stamps), 0.5 * (values[1:] + values[:-1]), is_gap)


Input = Velocities | InertialSamples
AnyInput = TypeVar("AnyInput", Velocities, InertialSamples)


def is_measured(twist: Array) -> BoolArray:
    """Return the mask (6,) of velocities (T, 6) that are not exactly 0 throughout."""
    return np.asarray((np.abs(twist) > _ZERO).any(axis=0))


def linear(time_s: Array | IntArray, values: Array, wanted_s: Array | IntArray | float) -> Array:
    """Return the values (..., c) at some times, linear between those (N, c) at stamps (N,), constant outside."""
    return np.stack([np.interp(wanted_s, time_s, column) for column in values.T], axis=-1)


def means_between(time_s: Array, grid_s: Array, moved: Array) -> Array:
    """Return means (T-1, c) between stamps (T,), from integrals ``moved`` (N, c) over the steps that end at a grid."""
    way = np.cumsum(moved, axis=0)[np.searchsorted(grid_s, time_s)]
    return np.diff(way, axis=0) / np.diff(time_s)[:, None]


def validate_inputs(inputs: tuple[Input, ...], time_s: Array) -> None:
    """Raise `DataError` if an input is of another type, or has no time in common with the frames (T,)."""
    for i, samples in enumerate(inputs):
        if not isinstance(samples, Velocities | InertialSamples):
            raise DataError(f"expected Velocities or InertialSamples, found {type(samples).__name__}", field="inputs")
        if samples.time_s[-1] < time_s[0] or samples.time_s[0] > time_s[-1]:
            spans = [f"from {each[0]:.3f} to {each[-1]:.3f} s" for each in (samples.time_s, time_s)]
            message = f"samples {spans[0]} have no time in common with frames {spans[1]}"
            raise ShapeError(message, field="inputs", index=i)


def _median_step(time_s: Array) -> float:
    return float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0


def _extent(time_s: Array) -> dict[str, str]:
    return {"stamps": f"{time_s[0]:.10g} to {time_s[-1]:.10g} s"}


def _rate(time_s: Array) -> str:
    step_s = _median_step(time_s)
    return f"{1.0 / step_s:.4g} Hz" if step_s > 0 else "one instant"


def _require_cover(samples: Input, begin_s: float, end_s: float) -> None:
    """Raise `LostDataError` if an interval is not within the samples, or at most one step outside."""
    first, last = float(samples.time_s[0]), float(samples.time_s[-1])
    if begin_s >= first and end_s <= last:
        return
    reach = _median_step(samples.time_s)
    if begin_s < first - reach or end_s > last + reach:
        spans = f"from {begin_s:.3f} to {end_s:.3f} s, only from {first:.3f} to {last:.3f} s"
        raise LostDataError(f"there are no samples {spans}", field="inputs")


def _freeze(record: Input, *names: str) -> None:
    for name in names:
        object.__setattr__(record, name, frozen(np.asarray(getattr(record, name), dtype=float)))


def _part(record: AnyInput, begin: int, end: int) -> AnyInput:
    cut: dict[str, Any] = {name: x[begin:end] for name, x in vars(record).items() if isinstance(x, np.ndarray)}
    return replace(record, **cut)
