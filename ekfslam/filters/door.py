"""Checks of the arguments of a filter, before it changes."""

from __future__ import annotations

from typing import Any

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.data.checks import LARGEST, LARGEST_PX, LARGEST_VELOCITY, require_finite, require_shape, validate_stamps
from ekfslam.data.interval import Interval
from ekfslam.data.observations import LARGEST_ID
from ekfslam.errors import DataError, DuplicateObservationError, ShapeError, StampError
from ekfslam.models.process import Measured
from ekfslam.models.sensors.base import Sensor
from ekfslam.models.sensors.monocular import Monocular
from ekfslam.models.sensors.stereo import Rig

ROUNDING = 1e-9  # of a covariance, relative to its largest entry
# Numbers of an observation, by its sensor; others are judged by their rows.
_WIDTHS: dict[type, tuple[int, ...]] = {Rig: (4,), Monocular: (2, 4)}


def checked_numbers(value: Any, name: str, largest: float = LARGEST) -> Array:
    """Return real, finite numbers of any shape as a new array; raise `DataError` for anything else."""
    found = _plain(value, name)
    if found.dtype.kind not in "iuf":
        raise DataError(f"expected real numbers, found {found.dtype}", field=name)
    numbers = found.astype(float)
    require_finite(numbers, name, largest)
    return numbers


def checked_stamp(t: Any) -> float:
    """Return a stamp in s; raise `DataError` if it is none."""
    if type(t) is float and -LARGEST <= t <= LARGEST:
        return t
    found = _plain(t, "t")
    if found.dtype.kind not in "iuf":
        raise DataError(f"expected a number of seconds, found {found.dtype}", field="t")
    require_shape(found, (), "t")
    if np.isfinite(found):
        validate_stamps(found.astype(float)[None])
    require_finite(found.astype(float), "t")
    return float(found)


def checked_inputs(value: Any, size: int, name: str) -> Array:
    """Return velocities or samples (size,), see `checked_numbers`."""
    found = checked_numbers(value, name, LARGEST_VELOCITY)
    require_shape(found, (size,), name)
    return found


def checked_covariance(value: Any, size: int, name: str) -> Array:
    """Return a covariance (size, size); raise `DataError` unless it is symmetric and positive semi-definite."""
    P = checked_numbers(value, name)
    require_shape(P, (size, size), name)
    scale = np.abs(P).max()
    if np.abs(P - P.T).max() > ROUNDING * scale or np.linalg.eigvalsh(0.5 * (P + P.T))[0] < -ROUNDING * scale:
        raise DataError("expected a symmetric, positive semi-definite matrix", field=name)
    return P


def checked_interval(inputs: Interval | Any, tau_s: Any, is_gap: bool) -> Interval:
    """Return the interval of a prediction, given one or its only inputs (6,)."""
    if not isinstance(inputs, Interval):
        one = checked_inputs(inputs, 6, "inputs")
        inputs = Interval.of_one(one, checked_stamp(tau_s), bool(is_gap))
    tau, dt_s = checked_stamp(inputs.tau_s), checked_numbers(inputs.dt_s, "dt_s")
    rows = checked_numbers(inputs.inputs, "inputs", LARGEST_VELOCITY)
    if dt_s.ndim != 1 or rows.shape != (len(dt_s), 6):
        require_shape(dt_s, (None,), "dt_s")
        require_shape(rows, (len(dt_s), 6), "inputs")
    if not tau > 0 or not len(dt_s) or dt_s.min() < 0:
        raise StampError(f"time must increase, found an interval of {tau:g} s in pieces of {dt_s} s", field="tau_s")
    if not (doubt := checked_stamp(inputs.doubt)) > 0:
        raise DataError(f"must be positive, found {doubt}", field="doubt")
    return Interval(tau, dt_s, rows, bool(inputs.is_gap), doubt)


def require_measured(also: Measured | None) -> None:
    """Raise `DataError` unless measurements of further sensors are finite, with positive standard deviations."""
    if also is None:
        return
    if not isinstance(also, Measured):
        raise DataError(f"expected Measured, found {type(also).__name__}", field="also")
    n = len(also.axis)
    for name in ("value", "std"):
        require_shape(checked_numbers(getattr(also, name), f"also.{name}"), (n,), f"also.{name}")
    require_shape(also.is_biased, (n,), "also.is_biased")
    if not (also.std > 0).all():
        raise DataError("must be positive", field="also.std")
    if not np.isin(also.axis, np.arange(6)).all():
        raise DataError(f"must be from 0 to 5, found {also.axis}", field="also.axis")


def checked_frame(value: Any) -> int:
    """Return the number of a frame; raise `DataError` unless it is a whole number that is not negative."""
    if isinstance(value, int | np.integer) and not isinstance(value, bool) and value >= 0:
        return int(value)
    raise DataError(f"expected a whole number that is not negative, found {value!r}", field="frame")


def checked_observations(sensor: Sensor, ids: Any, measured: Any) -> tuple[IntArray, Array]:
    """Return ids (n,) and measurements (n, m) of a sensor's landmarks, such as pixels; raise `DataError` for others."""
    landmark, numbers = _checked_ids(ids), checked_numbers(measured, "pixels", LARGEST_PX)
    widths = _WIDTHS.get(type(sensor))
    if not numbers.size and not len(landmark):
        return landmark, np.empty((0, 4))
    if numbers.ndim != 2 or len(numbers) != len(landmark):
        require_shape(numbers, (len(landmark), None), "pixels")
    if widths is not None and numbers.shape[1] not in widths:
        wanted = " or ".join(map(str, widths))
        raise ShapeError(f"expected {wanted} numbers an observation, found {numbers.shape[1]}", field="pixels")
    ascending = np.sort(landmark)
    is_twice = ascending[1:] == ascending[:-1]
    if is_twice.any():
        twice = ascending[1:][is_twice][0]
        raise DuplicateObservationError(f"landmark {twice} is observed twice", field="ids")
    if widths is None:
        rows = np.asarray(sensor.rows(numbers), dtype=float)
        require_shape(rows, (len(landmark), sensor.dimension), "pixels (as rows)")
        require_finite(rows, "pixels (as rows)")
    return landmark, numbers


def ascending(ids: IntArray, measured: Array) -> tuple[IntArray, Array]:
    """Return observations in the order of their ids (n,)."""
    order = np.argsort(ids)
    return ids[order], measured[order]


def _checked_ids(ids: Any) -> IntArray:
    found = _plain(ids, "ids")
    require_shape(found, (None,), "ids")
    if found.dtype.kind not in "iuf" or (found.dtype.kind == "f" and not (found == np.floor(found)).all()):
        raise DataError(f"expected whole numbers, found {found.dtype}", field="ids")
    if found.size and (found.min() < 0 or found.max() > LARGEST_ID):
        at = int(np.flatnonzero((found < 0) | (found > LARGEST_ID))[0])
        raise DataError(f"{found[at]} is negative or larger than {LARGEST_ID}", field="ids", index=at)
    return found.astype(np.int64)


def _plain(value: Any, name: str) -> np.ndarray:
    """Return an array of anything but booleans and ragged lists."""
    if _has_booleans(value):
        raise DataError("expected numbers, found a truth value", field=name)
    if np.ma.is_masked(value):
        raise DataError("expected numbers, found a masked entry", field=name)
    try:
        return np.asarray(value)
    except (ValueError, OverflowError, TypeError) as error:
        raise ShapeError(f"expected numbers of a regular shape: {error}", field=name) from None


def _has_booleans(value: Any) -> bool:
    if isinstance(value, np.ndarray):
        return value.dtype.kind == "b"
    if isinstance(value, list | tuple):
        return any(map(_has_booleans, value))
    return isinstance(value, bool | np.bool_) or getattr(getattr(value, "dtype", None), "kind", "") == "b"
