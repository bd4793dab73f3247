"""Dimensions of the data sets in HDF5 files, as netCDF has them: each has a name, and a coordinate along it.

A shape in a layout is of letters, each a length that data sets share, and of words, each an axis of fixed labels. In
the file, a dimension is a data set of its own beside those that have it (HDF5 calls it a dimension scale): stamps
along ``time``, ids along ``id``, labels such as ``rho_x`` along ``xi``, and numbers from 0 along all others. So
xarray, netCDF tools and h5py know what an axis is. A square matrix has the second axis as ``<name>_2``.

A leaf: it imports nothing of the package.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

SECOND = "_2"


class Axis(NamedTuple):
    """A dimension.

    Args:
        name: Of the dimension, and of its coordinate.
        meaning: What is counted along it.
        labels: Of its entries, where their number is fixed.
    """

    name: str
    meaning: str
    labels: tuple[str, ...] = ()


_XYZ = ("x", "y", "z")

# By how shapes in layouts spell it.
AXES: Mapping[str, Axis] = MappingProxyType(
    {
        "T": Axis("time", "frames; their stamps"),
        "M": Axis("id", "landmarks in the order of landmark initialisation; their ids, which may occur again"),
        "R": Axis("rejection", "rejected observations"),
        "K": Axis("observation", "observations"),
        "N": Axis("entry", "entries"),
        "B": Axis("coordinate", "coordinates of the state blocks"),
        "U": Axis("up_axis", "axes of the direction up; none where it is not estimated"),
        "P": Axis("parameter", "parameters by name"),
        "F": Axis("frame", "frames of known pose; their numbers"),
        "d": Axis("sensor_row", "rows of a measurement"),
        "n": Axis("note", "sentences"),
        "runs": Axis("run", "realisations"),
        "J": Axis("instant", "instants of the joint NEES"),
        "xi": Axis("xi", "pose error, translation first", (*(f"rho_{a}" for a in _XYZ), *(f"theta_{a}" for a in _XYZ))),
        "u": Axis("component", "velocity", (*(f"v_{a}" for a in _XYZ), *(f"w_{a}" for a in _XYZ))),
        "xyz": Axis("axis", "axes of a vector", _XYZ),
        "error": Axis("world_error", "position, then rotation", (*_XYZ, *(f"rotation_{a}" for a in _XYZ))),
        "row": Axis("row", "rows of a transform", (*_XYZ, "one")),
        "column": Axis("column", "columns of a transform", (*(f"{a}_axis" for a in _XYZ), "translation")),
        "pixels": Axis("pixel", "coordinates in the images", ("uL", "vL", "uR", "vR")),
    }
)
_BY_NAME = {axis.name: axis for axis in AXES.values()}

Shape = tuple[str, ...]


def names_of(shape: Shape, others: Mapping[str, str]) -> tuple[str, ...]:
    """Names of the dimensions of a shape; ``others`` are names of letters that a layout gives itself."""
    names: list[str] = []
    for letter in shape:
        name = others.get(letter, AXES[letter].name if letter in AXES else letter)
        names.append(name + SECOND if name in names else name)
    return tuple(names)


def fixed_length(letter: str) -> int | None:
    """Length of an axis of fixed labels; None for a shared length."""
    labels = AXES[letter].labels if letter in AXES else ()
    return len(labels) or None


def meaning_of(name: str) -> str:
    """What is counted along a dimension, by its name."""
    axis = _BY_NAME.get(name.removesuffix(SECOND))
    return axis.meaning if axis else f"each {name}".replace("_", " ")


def coordinate(name: str, length: int, given: Mapping[str, NDArray]) -> NDArray:
    """Values (length,) along a dimension: those ``given`` by name, else its labels, else numbers from 0."""
    if name in given:
        return np.asarray(given[name])
    axis = _BY_NAME.get(name.removesuffix(SECOND))
    if axis and axis.labels:
        # Of two bytes at least: readers take rows of single bytes for one text.
        return np.array([label.encode() for label in axis.labels], dtype=f"S{max(2, *map(len, axis.labels))}")
    return np.arange(length)
