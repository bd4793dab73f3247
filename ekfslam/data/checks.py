"""Checks of plain arrays, with errors that name field and index; every record of a recording uses them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ekfslam.arrays import Array
from ekfslam.errors import DataError, ExtrinsicsError, NonFiniteError, ScaleError, ShapeError, StampError
from ekfslam.geometry import se3
from ekfslam.stored import rigid_defect

ROTATION_TOLERANCE = 1e-4  # files print rotations with as few as five digits

# No quantity of a recording is larger, in s, m, m/s, rad/s or px: beyond, a square or a product loses all digits.
LARGEST = 1e12
LARGEST_VELOCITY, LARGEST_DISTANCE_M, LARGEST_PX = 1e6, 1e9, 1e7


def frozen(array: NDArray) -> NDArray:
    """Return a read-only view of an array, so that a frozen dataclass has frozen arrays."""
    view = array.view()
    view.flags.writeable = False
    return view


def require_shape(value: ArrayLike, shape: tuple[int | None, ...], name: str) -> None:
    """Raise `ShapeError` unless ``value`` has ``shape``, where None stands for any length."""
    found = np.shape(value)
    if len(found) != len(shape) or any(want not in (None, got) for want, got in zip(shape, found, strict=True)):
        wanted = " x ".join("n" if size is None else str(size) for size in shape)
        raise ShapeError(f"expected shape {wanted}, found {' x '.join(map(str, found)) or 'a scalar'}", field=name)


def require_finite(value: Array, name: str, largest: float = LARGEST) -> None:
    """Raise `NonFiniteError` with the index of the first number that is NaN, infinite, or larger than ``largest``."""
    small = np.abs(value) <= largest
    if not small.all():
        bad = np.argwhere(~small)
        index = tuple(int(i) for i in bad[0])
        kind = f"larger than {largest:g}" if np.isfinite(np.asarray(value)[index]) else "NaN or infinite"
        message = f"{len(bad)} values are {kind}, the first is {value[index]}"
        raise NonFiniteError(message, field=name, index=_position(index))


def require_rigid(T: Array, name: str, error: type[DataError]) -> None:
    """Raise ``error`` unless every (..., 4, 4) matrix is a rotation and a translation."""
    defect = rigid_defect(T)
    bad = np.argwhere(defect > ROTATION_TOLERANCE)
    if len(bad):
        index = tuple(int(i) for i in bad[0])
        found = f"orthogonality defect {defect[index]:.2g}, determinant {np.linalg.det(T[index][:3, :3]):.6g}"
        raise error(f"not a rigid transform: {found}", field=name, index=_position(index))


def require_scale(name: str, is_told: bool) -> None:
    """Raise `ScaleError` unless velocities or inertial samples tell the scale of a recording of one camera."""
    if not is_told:
        raise ScaleError(
            f"{name}: one camera alone cannot tell the scale: give inertial samples (imu, --imu) or "
            "measured velocities (twist, --velocities), or the tracks of both cameras"
        )


def _position(index: tuple[int, ...]) -> int | tuple[int, ...] | None:
    return index[0] if len(index) == 1 else index or None


def checked_pose(T: ArrayLike, name: str, largest_m: float = LARGEST_DISTANCE_M) -> Array:
    """Return a transform (4, 4), made rigid to rounding; raise a `DataError` if it is none."""
    T = np.asarray(T, dtype=float)
    require_shape(T, (4, 4), name)
    require_finite(T, name, largest_m)
    require_rigid(T, name, ExtrinsicsError)
    return frozen(se3.nearest_rigid(T))


@contextmanager
def spelled_as_in(source: str, spelling: Mapping[str, str] = MappingProxyType({})) -> Iterator[None]:
    """Add the file to data errors that are raised inside and name none, and its own names of fields (``spelling``)."""
    try:
        yield
    except DataError as error:
        name = spelling.get(error.field, error.field)
        raise type(error)(error.message, source=error.source or source, field=name, index=error.index) from None


def validate_stamps(time_s: Array) -> None:
    """Raise a `DataError` unless these are stamps (T,) of at least one frame that increase strictly."""
    require_shape(time_s, (None,), "time_s")
    if len(time_s) == 0:
        raise ShapeError("the sequence has no frames", field="time_s")
    least = float(np.abs(time_s).min())
    if LARGEST < least < np.inf:
        units = {1e14: "milliseconds", 1e17: "microseconds", np.inf: "nanoseconds"}
        unit = next(name for below, name in units.items() if least < below)
        text = f"stamp {time_s[0]:g} is no time in seconds, stamps look like {unit} since 1970"
        raise NonFiniteError(text, field="time_s", index=0)
    require_finite(time_s, "time_s")
    steps = np.diff(time_s)
    if (steps <= 0).any():
        index = int(np.argmax(steps <= 0)) + 1
        kind = "duplicates" if steps[index - 1] == 0 else "is before"
        message = f"stamp {time_s[index]:.6f} s {kind} its predecessor {time_s[index - 1]:.6f} s"
        raise StampError(message, field="time_s", index=index)
