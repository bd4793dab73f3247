"""What the readers share: named fields of a file, checked one by one, and dense tracks made flat."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ekfslam.arrays import Array
from ekfslam.data.readers.registry import Lateral
from ekfslam.data.sequence import Observations, require_finite, require_shape
from ekfslam.errors import DataError, EmptyTracksError, ShapeError

LATERAL_NOTES: dict[Lateral, str] = {
    "corrected": (
        "The lateral velocity is stored positive to the right, against the description of its format: it is negated."
    ),
    "as-stored": "The lateral velocity is used as stored, although it is positive to the right.",
}
UNSEEN = -1.0  # what the dense formats write into all four pixels of a track that a frame does not see


def checksum(*paths: Path) -> str:
    """SHA-256 of the contents of files in their order, hexadecimal."""
    digest = hashlib.sha256()
    for path in paths:
        with path.open("rb") as file:
            while part := file.read(1 << 20):
                digest.update(part)
    return digest.hexdigest()


@contextmanager
def spelled_as_in(source: str, spelling: Mapping[str, str] | None = None) -> Iterator[None]:
    """Let data errors raised inside name the file and spell the field as the file does.

    Args:
        source: The file.
        spelling: Field names of `Sequence` to field names of the file, where they differ.
    """
    try:
        yield
    except DataError as error:
        name = (spelling or {}).get(error.field, error.field)
        raise type(error)(error.message, source=source, field=name, index=error.index) from None


def require(fields: Mapping[str, Any], name: str) -> NDArray:
    """A field of a file as an array, whatever its type.

    Raises:
        ShapeError: The field is missing.
    """
    if name not in fields:
        raise ShapeError("this field is missing", field=name)
    return np.asarray(fields[name])


def require_numbers(
    fields: Mapping[str, Any], name: str, shape: tuple[int | None, ...], dtype: type = np.float64
) -> NDArray:
    """A field of a file as finite numbers of the wanted shape (None stands for any length) and type.

    Raises:
        ShapeError: The field is missing, is not numeric (integral where ``dtype`` is) or has another shape.
        NonFiniteError: It holds NaN or infinity.
    """
    value = require(fields, name)
    if value.dtype.kind not in ("iu" if np.issubdtype(dtype, np.integer) else "iuf"):
        raise ShapeError(f"expected {np.dtype(dtype).name} numbers, found {value.dtype}", field=name)
    require_shape(value, shape, name)
    if value.dtype.kind == "f":
        require_finite(value, name)
    return value.astype(dtype, copy=False)


def flat_observations(dense: Array, frame_axis: int, field: str) -> Observations:
    """Observations of a dense 4 x T x M (``frame_axis`` 1) or 4 x M x T (2) array of pixels; the column is the id.

    Raises:
        ShapeError: Only some of the four pixels are -1.
        EmptyTracksError: A track is never seen.
    """
    missing = dense == UNSEEN
    seen = ~missing.all(axis=0)
    partly = np.argwhere(missing.any(axis=0) & seen)
    if len(partly):
        position = tuple(int(i) for i in partly[0])
        row = int(np.argmax(missing[:, position[0], position[1]]))
        raise ShapeError(
            f"{len(partly)} observations have some but not all of their four pixels equal to -1 (unseen)",
            field=field,
            index=(row, *position),
        )
    never = np.flatnonzero(~seen.any(axis=frame_axis - 1))
    if len(never):
        raise EmptyTracksError(
            f"{len(never)} tracks are never seen, the first is track {never[0]}", field=field, index=int(never[0])
        )
    first, second = np.nonzero(seen)
    frame, landmark = (first, second) if frame_axis == 1 else (second, first)
    return Observations(frame, landmark, dense[:, first, second].T)


def with_lateral(level_twist: Array, lateral: Lateral) -> Array:
    """Level velocities (..., 6) of KITTI with the lateral one to the left: ``corrected`` negates it.

    The data format calls ``vl`` leftward, but on every drive it opposes the true lateral velocity, and already the
    first packet of 2011_09_26_drive_0001 contradicts its own velocity north and east. All other signs are right.
    """
    if lateral == "as-stored":
        return level_twist
    return level_twist * np.array([1.0, -1.0, 1.0, 1.0, 1.0, 1.0])
