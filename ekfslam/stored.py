"""How records are stored: dimensions, unit, frame of reference and allowed values of each field.

A dataclass says so in the metadata of its fields, and nowhere else::

    @dataclass(frozen=True)
    class Innovation:
        nis: Array = field(metadata=stored("T"))
        dof: IntArray = field(metadata=stored("T", "count", check=COUNTS))

`layout_of` collects the fields that are data sets, `attributes_of` the attributes, and `groups_of` the records within a
record. `ekfslam.hdf5` writes, reads and checks by them. A new field needs its metadata, nothing else.

*Dimensions.* A shape consists of names of `AXES`: an axis with fixed labels, or a length that several fields share.
Other words are shared lengths, too. Each dimension has a name and a coordinate in the file (a dimension scale of HDF5):
stamps along ``time``, ids along ``id``, labels such as ``rho_x`` along ``xi``, and numbers from 0 along all others. So
xarray, netCDF tools and h5py know what an axis is. A square matrix has its second axis as ``<name>_2``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ekfslam.arrays import Array, BoolArray

Record = TypeVar("Record")
Sizes = Mapping[str, int]
Shape = tuple[str, ...]

LARGEST = 1e100  # a number whose square and cube are still numbers
MOST = 1 << 62  # a whole number to which one can be added
RIGID_TOLERANCE = 1e-6
COVARIANCE_TOLERANCE = 1e-6  # of correlations: far above rounding, far below what an ellipse shows


# --- allowed values ---------------------------------------------------------------------------------------------------


class Check(NamedTuple):
    """Allowed values of a field."""

    kinds: str  # NumPy kind: f numbers, i whole numbers, b truth values, S text
    words: str  # requirement of each value, as it follows "must"
    # Function of values and shared lengths that returns which values pass, in the shape of the first axes.
    holds: Callable[[NDArray, Sizes], NDArray]


def _in(low: float, high: float) -> Callable[[NDArray, Sizes], NDArray]:
    return lambda value, _: (value >= low) & (value <= high)  # holds for no NaN


def _ascends(value: NDArray, _: Sizes) -> NDArray:
    return (np.abs(value) <= LARGEST) & (np.diff(value, prepend=-np.inf) > 0)


def rigid_defect(T: Array) -> Array:
    """Return how far (...) finite (..., 4, 4) are from rigid transforms, by entries of R R^T; 2 or more if mirrored."""
    R = T[..., :3, :3]
    defect = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max(axis=(-1, -2))
    bottom = np.abs(T[..., 3, :] - np.array([0, 0, 0, 1])).max(axis=-1)
    return np.maximum(defect, bottom) + np.where(np.linalg.det(R) < 0, 2.0, 0.0)


def _is_rigid(T: Array, _: Sizes) -> BoolArray:
    found = np.nan_to_num(T, nan=0.0, posinf=0.0, neginf=0.0)
    return (rigid_defect(found) <= RIGID_TOLERANCE) & NUMBERS.holds(T, {}).all(axis=(-1, -2))


def _is_covariance(P: Array, _: Sizes) -> BoolArray:
    """Return which (...) of (..., n, n) are symmetric and positive semi-definite, judged by their correlations."""
    is_number = np.asarray(NUMBERS.holds(P, {}).all(axis=(-1, -2)))
    P = np.where(is_number[..., None, None], P, 0.0)
    variance = np.diagonal(P, axis1=-2, axis2=-1)
    std = np.sqrt(np.where(variance > 0, variance, 1.0))
    C = P / std[..., :, None] / std[..., None, :]
    is_symmetric = (np.abs(C - C.swapaxes(-1, -2)) <= COVARIANCE_TOLERANCE).all(axis=(-1, -2))
    C = np.clip(C, -2.0, 2.0)  # beyond 1 it is no correlation, but its eigenvalues must stay numbers
    smallest = np.linalg.eigvalsh((C + C.swapaxes(-1, -2)) / 2)[..., 0]
    return is_number & is_symmetric & (variance >= 0).all(axis=-1) & (smallest >= -COVARIANCE_TOLERANCE)


NUMBERS = Check("f", "be finite", _in(-LARGEST, LARGEST))
NUMBERS_OR_NONE = Check("f", "be finite or NaN", lambda value, _: ~(np.abs(value) > LARGEST))
NOT_NEGATIVE_OR_NONE = Check(
    "f", "be finite and not negative, or NaN", lambda value, _: ~((value < 0) | (value > LARGEST))
)
NOT_NEGATIVE = Check("f", "be finite and not negative", _in(0, LARGEST))
POSITIVE = Check("f", "be finite and positive", _in(1 / LARGEST, LARGEST))
ASCENDING = Check("f", "be finite and ascend", _ascends)
RIGID = Check("f", "be a rigid transform", _is_rigid)
COVARIANCES = Check("f", "be symmetric and positive semi-definite", _is_covariance)
FLAGS = Check("b", "be a truth value", lambda value, _: (value == 0) | (value == 1))
TEXTS = Check("S", "be text", lambda value, _: np.ones(value.shape, dtype=bool))


def index_of(length: str, least: int = 0) -> Check:
    """Allow whole numbers from ``least`` up to a shared length, which is excluded."""
    words = f"be an index from {least} to {length} - 1"
    return Check("i", words, lambda value, sizes: (value >= least) & (value < sizes[length]))


def whole(low: int, high: int = MOST) -> Check:
    """Allow whole numbers between two limits, both included."""
    return Check("i", f"be a whole number from {low} to {high}", _in(low, high))


COUNTS = whole(0)
FRAMES = index_of("T")


# --- dimensions -------------------------------------------------------------------------------------------------------


class Axis(NamedTuple):
    """A dimension: its name, the things counted along it, and names of its entries if their number is fixed."""

    name: str
    meaning: str
    labels: tuple[str, ...] = ()


SECOND = "_2"
_XYZ = ("x", "y", "z")

# Names of axes in shapes.
AXES: Mapping[str, Axis] = MappingProxyType(
    {
        "T": Axis("time", "frames; their stamps"),
        "M": Axis("id", "landmarks in the order of landmark initialisation; their ids, which may occur again"),
        "L": Axis("landmark_id", "landmarks of the log; their ids"),
        "R": Axis("rejection", "rejected observations"),
        "K": Axis("observation", "observations"),
        "B": Axis("coordinate", "coordinates of the state blocks"),
        "U": Axis("curved_axis", "values of blocks that are no sums of corrections"),
        "P": Axis("parameter", "parameters by name"),
        "F": Axis("frame", "frames of known pose; their numbers"),
        "d": Axis("sensor_row", "rows of a measurement"),
        "n": Axis("note", "sentences"),
        "runs": Axis("run", "realisations"),
        "J": Axis("instant", "instants of the joint NEES"),
        "xi": Axis("xi", "pose error, translation first", (*(f"rho_{a}" for a in _XYZ), *(f"theta_{a}" for a in _XYZ))),
        "u": Axis("component", "velocity", (*(f"v_{a}" for a in _XYZ), *(f"w_{a}" for a in _XYZ))),
        "xyz": Axis("axis", "axes of a vector", _XYZ),
        "inertial": Axis(
            "inertial_error",
            "errors of pose, velocity, gyroscope and accelerometer bias",
            tuple(f"{part}_{a}" for part in ("rho", "theta", "velocity", "gyro_bias", "accel_bias") for a in _XYZ),
        ),
        "error": Axis("world_error", "position, then rotation", (*_XYZ, *(f"rotation_{a}" for a in _XYZ))),
        "row": Axis("row", "rows of a transform", (*_XYZ, "one")),
        "column": Axis("column", "columns of a transform", (*(f"{a}_axis" for a in _XYZ), "translation")),
        "left_pixels": Axis("pixel_of_one_camera", "coordinates in the image of one camera", ("u", "v")),
        "pixels": Axis("pixel", "coordinates in the images", ("uL", "vL", "uR", "vR")),
    }
)
_BY_NAME = {axis.name: axis for axis in AXES.values()}


def fixed_length(axis: str) -> int | None:
    """Return the number of labels of an axis; None for a shared length."""
    return len(AXES[axis].labels) or None if axis in AXES else None


def meaning_of(name: str) -> str:
    """Return the things counted along a dimension of this name."""
    axis = _BY_NAME.get(name.removesuffix(SECOND))
    return axis.meaning if axis else f"each {name}".replace("_", " ")


def coordinate(name: str, length: int, given: Mapping[str, NDArray]) -> NDArray:
    """Return the values (length,) along a dimension: ``given`` ones, else its labels, else numbers from 0."""
    if name in given:
        return np.asarray(given[name])
    axis = _BY_NAME.get(name.removesuffix(SECOND))
    if axis and axis.labels:
        # Two bytes at least: readers take rows of single bytes for one text.
        return np.array([label.encode() for label in axis.labels], dtype=f"S{max(2, *map(len, axis.labels))}")
    return np.arange(length)


# --- fields of records ------------------------------------------------------------------------------------------------


class Item(NamedTuple):
    """A data set."""

    name: str  # path of the data set below its group
    field: str  # field of the record that it holds
    shape: Shape  # names of its axes, see `AXES`
    units: str  # attribute units
    frame: str  # attribute frame, the frame of reference
    check: Check = NUMBERS  # allowed values
    codes: tuple[str, ...] = ()  # meanings of whole numbers from 0, the attribute names

    @property
    def place(self) -> tuple[str, str]:
        """The folder below the group, and the name there."""
        folder, _, leaf = self.name.rpartition("/")
        return folder, leaf

    @property
    def dims(self) -> tuple[str, ...]:
        """Names of the dimensions."""
        names: list[str] = []
        for axis in self.shape:
            name = AXES[axis].name if axis in AXES else axis
            names.append(name + SECOND if name in names else name)
        return tuple(names)


Layout = tuple[Item, ...]


class Attribute(NamedTuple):
    """A field that is an attribute of the group."""

    kind: type  # bool, int, str, or tuple for several texts
    along: str = ""  # shared length that the texts name one by one


def stored(
    shape: str,
    units: str = "1",
    frame: str = "none",
    check: Check = NUMBERS,
    name: str = "",
    codes: tuple[str, ...] = (),
) -> dict[str, Any]:
    """Return the metadata of a field that is a data set, see `Item`; ``shape`` separates its axes by blanks."""
    check = whole(0, len(codes) - 1) if codes else check
    return {"stored": Item(name, "", tuple(shape.split()), units, frame, check, codes)}


def attribute(kind: type, along: str = "") -> dict[str, Any]:
    """Return the metadata of a field that is an attribute of the group, see `Attribute`."""
    return {"stored": Attribute(kind, along)}


def group(record: type) -> dict[str, Any]:
    """Return the metadata of a field that is a record, in a group; one with the default None may be missing."""
    return {"stored": record}


def _fields_of(record: type, kind: type) -> dict[str, Any]:
    found = {field.name: field.metadata.get("stored") for field in dataclasses.fields(record)}
    return {name: value for name, value in found.items() if isinstance(value, kind)}


def layout_of(record: type) -> Layout:
    """Return the data sets of a class of records."""
    return tuple(item._replace(name=item.name or name, field=name) for name, item in _fields_of(record, Item).items())


def attributes_of(record: type) -> dict[str, Attribute]:
    """Return the fields of a class of records that are attributes."""
    return _fields_of(record, Attribute)


def groups_of(record: type) -> dict[str, type]:
    """Return the fields of a class of records that are records, with their classes."""
    return _fields_of(record, type)


def layouts_of(record: type, name: str = "") -> Iterator[tuple[str, type, Layout]]:
    """Yield group, class and layout of a class of records and of all records in it."""
    yield name, record, layout_of(record)
    for field, part in groups_of(record).items():
        yield from layouts_of(part, f"{name}/{field}".strip("/"))


def values_of(record: Any, name: str = "") -> Iterator[tuple[str, Item, NDArray]]:
    """Yield name (with dots), item and value of every data set of a record and of the records in it."""
    for item in layout_of(type(record)):
        yield name + item.field, item, getattr(record, item.field)
    for field in groups_of(type(record)):
        if getattr(record, field) is not None:
            yield from values_of(getattr(record, field), f"{name}{field}.")


def zeros(layout: Layout, **sizes: int) -> dict[str, NDArray]:
    """Return the fields of a layout with the entry 0 for shared lengths, 0 by default."""
    types: dict[str, type] = {"f": np.float64, "i": np.int64, "b": np.bool_}
    return {
        item.field: np.zeros([fixed_length(axis) or sizes.get(axis, 0) for axis in item.shape], types[item.check.kinds])
        for item in layout
    }


def empty(record: type[Record], **sizes: int) -> Record:
    """Return a record with the entry 0 in each of its data sets for shared lengths, 0 by default."""
    return record(**zeros(layout_of(record), **sizes))


def along(record: Any, length: str, which: Any) -> dict[str, Any]:
    """Return some entries of the fields of a record whose first axis is a shared length."""
    return {
        item.field: getattr(record, item.field)[which] for item in layout_of(type(record)) if item.shape[0] == length
    }
