"""HDF5 files of results, studies and recordings.

- A file is made in memory (`image`) and appears under its name only when it is complete.
- Its attributes ``format`` and ``format_version`` identify it. `opened` rejects other files, and inspects all of a file
  before anything is read: no links, no data in other files, no types that our files do not have. Any damage found while
  reading raises one named error.
- Data sets follow from the records that they hold, see `ekfslam.stored`: attributes ``units`` and ``frame``, checks of
  the values both when writing and when reading, and a coordinate for every dimension. Older files have no coordinates.
- Text is read in both forms of HDF5 and written with fixed length: libhdf5 hangs on some damaged files with text of
  variable length. Files have the newer layout, with checksums of all but the arrays. Long arrays are compressed.
"""

from __future__ import annotations

import dataclasses
import io
import json
import math
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from ekfslam import stored
from ekfslam.errors import ArchiveError, EkfslamError, UnknownFormatError
from ekfslam.limits import Budget, require_file
from ekfslam.names import printable
from ekfslam.stored import Item

# Errors of h5py, zlib and json if a file is damaged.
_DAMAGE = (OSError, RuntimeError, LookupError, ValueError, TypeError, OverflowError, MemoryError, zlib.error)
_LONG = 10_000  # entries from which compression pays
# Level of compression. 1000 frames take 7.3 MB in place of 13.2, and 0.2 s more to write; level 9: 7.2 MB, 1.9 s.
_LEVEL, _CHUNK_BYTES = 1, 1 << 20
_MOST_OBJECTS = 100_000  # in a file; ours have some hundreds

Coordinates = Mapping[str, NDArray]
NONE: Coordinates = MappingProxyType({})


def image(format: str, version: int, fill: Callable[[h5py.File], None]) -> bytes:
    """Return the bytes of a new file that ``fill`` writes, in memory: libhdf5 crashes on a full disk."""
    content = io.BytesIO()
    # HDF5's own image of an open file will not do: until 2.0 the checksum of its first block is wrong.
    with h5py.File(content, "w", libver="v110") as h5file:
        write_attributes(h5file, {"format": format, "format_version": version})
        fill(h5file)
    return content.getvalue()


@contextmanager
def opened(
    path: str | Path, format: str, version: int, error: type[EkfslamError] = ArchiveError
) -> Iterator[h5py.File]:
    """Open a file for reading; it must have this format, and at most this version.

    A newer one raises `ArchiveError`; one that is missing, of another format, or proves damaged while open, an
    ``error``.
    """
    try:
        require_file(path)
        with _reading(path) as h5file:
            _inspect(h5file, error)
            found = plain(h5file.attrs.get("format"))
            if found != format:
                names = ", ".join(list(h5file)[:9])
                raise error(f"{path}: an HDF5 file of format {found!r} with [{names}]; expected {_named(format)}")
            if version_of(h5file) > version:
                raise ArchiveError(
                    f"{path}: has format version {version_of(h5file)}, this release reads up to version {version}"
                )
            yield h5file
    except UnknownFormatError as problem:
        raise error(str(problem)) from None
    except _DAMAGE as problem:
        raise error(f"{path}: damaged or no HDF5 file ({problem}); expected {_named(format)}") from None


def _named(format: str) -> str:
    return f"format {format!r}" + (", as `ekfslam run` writes it" if format == "ekfslam-archive" else "")


def _reading(path: str | Path) -> h5py.File:
    """Open a file for reading, even if this process has it open by other means, such as xarray."""
    if not Path(path).is_file():  # a pipe would never end
        raise FileNotFoundError(f"no regular file {path}")
    try:
        # Files are replaced as a whole and never changed, so that they need no locks.
        return h5py.File(str(path), "r", locking=False)
    except OSError as problem:
        # HDF5 opens a file a second time only with the locks of the first.
        if "locking flag" not in str(problem):
            raise
        return h5py.File(str(path), "r")


def format_of(path: str | Path) -> str:
    """Return the attribute ``format`` of an HDF5 file; empty for other files and damaged ones."""
    try:
        with _reading(path) as h5file:
            return str(plain(h5file.attrs["format"])) if h5file.attrs.get_id("format").shape == () else ""
    except _DAMAGE:
        return ""


def _inspect(h5file: h5py.File, error: type[EkfslamError]) -> None:
    """Raise an error if any object of a file is of a kind that our files do not have."""
    budget = Budget(h5file.filename, error)
    waiting, seen = [h5file], {h5py.h5o.get_info(h5file.id).addr}
    while waiting:
        group = waiting.pop()
        _inspect_attributes(group, budget)
        for name in group:
            place = _place(group, name)
            if name != printable(name):
                raise error(f"{place} has a name that cannot be printed")
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                raise error(f"{place} is a link, which no file of this format has")
            item = group[name]
            address = h5py.h5o.get_info(item.id).addr
            if address in seen or len(seen) > _MOST_OBJECTS:
                raise error(f"{place} is there twice, or one of too many")
            seen.add(address)
            if isinstance(item, h5py.Group):
                waiting.append(item)
                continue
            if not isinstance(item, h5py.Dataset):
                raise error(f"{place} is neither a group nor a data set")
            if item.is_virtual or item.external:
                raise error(f"{place} has its data in another file (external or virtual storage)")
            if item.shape is None or not _is_known(item.dtype):
                raise error(f"{place} is empty or of an unknown type")
            _inspect_attributes(item, budget)
            _inspect_size(item, place, budget)


def _inspect_attributes(item: h5py.Group | h5py.Dataset, budget: Budget) -> None:
    for i in range(h5py.h5a.get_num_attrs(item.id)):
        attribute = h5py.h5a.open(item.id, index=i)
        name = attribute.name.decode(errors="replace")
        if name != printable(name):
            raise budget.error(f"{item.file.filename}: {_spoken(item, name)} has a name that cannot be printed")
        space, dtype = attribute.get_space(), attribute.dtype
        if space.get_simple_extent_type() == h5py.h5s.NULL or not (_is_known(dtype) or _is_of_scales(name, dtype)):
            raise budget.error(f"{item.file.filename}: {_spoken(item, name)} is empty or of an unknown type")
        count = space.get_simple_extent_npoints()
        budget.take(count * dtype.itemsize, _spoken(item, name))
        if h5py.check_string_dtype(dtype) is not None and dtype.kind == "O":
            if count > 1:  # each may be the same text in the file
                whole = Path(item.file.filename).stat().st_size
                Budget(budget.source, budget.error).take(count * whole, _spoken(item, name))
            budget.take(sum(map(len, np.ravel(item.attrs[name]))), _spoken(item, name))


def _inspect_size(dataset: h5py.Dataset, place: str, budget: Budget) -> None:
    """Raise an error if a data set claims more than may be read, or more than the file has of it."""
    size = math.prod(dataset.shape) * dataset.dtype.itemsize
    budget.take(size, dataset.name.strip("/"))
    if dataset.dtype.kind == "O":  # texts of any length, which may all be the same in the file
        if dataset.size > _MOST_OBJECTS:
            raise budget.error(f"{place} has too many texts")
        for index in np.ndindex(dataset.shape):
            budget.take(len(dataset[index]), dataset.name.strip("/"))
    if dataset.chunks is None:
        if dataset.id.get_storage_size() < size:
            raise budget.error(f"{place} claims {size} bytes, of which the file has {dataset.id.get_storage_size()}")
        return
    chunk = math.prod(dataset.chunks) * dataset.dtype.itemsize
    budget.take(chunk, f"a part of {dataset.name.strip('/')}")
    if math.prod(-(-n // m) for n, m in zip(dataset.shape, dataset.chunks, strict=True)) > _MOST_OBJECTS:
        raise budget.error(f"{place} is in too many parts")
    plist = dataset.id.get_create_plist()
    filters = [plist.get_filter(i)[0] for i in range(plist.get_nfilters())]
    if not set(filters) <= {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}:
        raise budget.error(f"{place} is compressed in a way that no file of this format is")
    for part in dataset.iter_chunks():
        skipped, stored = dataset.id.read_direct_chunk(tuple(s.start for s in part))
        if h5py.h5z.FILTER_DEFLATE in filters and not skipped:
            stored = zlib.decompressobj().decompress(stored, chunk + 8)
        if len(stored) > chunk + 4:  # a checksum
            raise budget.error(f"{place} has parts that become larger than the {chunk} bytes that they claim")


def _is_of_scales(name: str, dtype: np.dtype) -> bool:
    """Return whether an attribute ties dimensions to data sets. Nothing here follows these references."""
    if name == "DIMENSION_LIST":
        return h5py.check_ref_dtype(h5py.check_vlen_dtype(dtype) or dtype) is h5py.Reference
    return name == "REFERENCE_LIST" and dtype.names == ("dataset", "dimension")


def _is_known(dtype: np.dtype) -> bool:
    """Return whether a type is one of numbers, truth values or text."""
    return dtype.kind in "fiubS" or h5py.check_string_dtype(dtype) is not None


def write_record(group: h5py.Group, record: Any, sizes: dict[str, int], coordinates: Coordinates = NONE) -> None:
    """Write attributes and data sets of a record, and a group for each record in it, as `write_fields` does."""
    stated = {name: getattr(record, name) for name in stored.attributes_of(type(record))}
    write_attributes(group, stated)
    coordinates = {**coordinates, **_named_entries(type(record), stated)}
    write_fields(group, stored.layout_of(type(record)), record, sizes, coordinates)
    for name in stored.groups_of(type(record)):
        if getattr(record, name) is not None:
            write_record(group.require_group(name), getattr(record, name), sizes, coordinates)


def read_record(
    group: h5py.Group,
    record: type,
    sizes: dict[str, int],
    coordinates: Coordinates = NONE,
    complete: Callable[[type, dict[str, Any]], dict[str, Any]] = lambda record, found: found,
    former: Mapping[type, stored.Layout] = MappingProxyType({}),
) -> dict[str, Any]:
    """Read the stored fields of a class of records, checked as `read_fields` does.

    ``complete``, a function of class and fields, adds fields that older releases did not write, by the data sets
    ``former`` that they wrote for a class.
    """
    layout = stored.layout_of(record)
    found: dict[str, Any] = {}
    defaults = {field.name: field.default for field in dataclasses.fields(record)}
    for name, (kind, _) in stored.attributes_of(record).items():
        if name not in group.attrs and defaults[name] is not dataclasses.MISSING:  # older releases lack it
            found[name] = defaults[name]
            continue
        value = attribute(group, name)
        found[name] = texts(value) if kind is tuple else printable(str(value)) if kind is str else kind(value)
    coordinates = {**coordinates, **_named_entries(record, found)}
    present = tuple(item for item in layout if item.name in group)
    earlier = tuple(item for item in former.get(record, ()) if item.name in group)
    found = complete(record, found | _read(group, (*present, *earlier), sizes))
    for item in layout:
        if item.field not in found:
            raise ArchiveError(f"{_place(group, item.name)} is missing")
    require_coordinates(group, present, coordinates)
    for name, (_, along) in stored.attributes_of(record).items():
        if along and len(found[name]) != sizes[along]:
            raise ArchiveError(
                f"{group.file.filename}: {_spoken(group, name)} has {len(found[name])} entries, expected {sizes[along]}"
            )
    optional = {field.name for field in dataclasses.fields(record) if field.default is None}
    for name, part in stored.groups_of(record).items():
        is_there = name in group or name not in optional
        below = read_record(subgroup(group, name), part, sizes, coordinates, complete, former) if is_there else None
        found[name] = None if below is None else part(**below)
    return found


def _named_entries(record: type, attributes: Mapping[str, Any]) -> dict[str, NDArray]:
    """Return the coordinates that attributes of a record give to dimensions, the first attribute of each."""
    named: dict[str, NDArray] = {}
    for name, (_, along) in stored.attributes_of(record).items():
        if along:
            named.setdefault(stored.AXES[along].name, fixed_texts(attributes[name]))
    return named


def write_fields(
    group: h5py.Group,
    layout: Iterable[Item],
    record: Any,
    sizes: dict[str, int] | None = None,
    coordinates: Coordinates = NONE,
) -> None:
    """Write the data sets of a layout, from a record or mapping with their fields, and their dimensions.

    Known shared lengths are ``sizes``; those found here are added. ``coordinates`` are values along dimensions by name,
    if no data set of the layout holds them. A value that breaks its check raises an `ArchiveError`.
    """
    layout = tuple(layout)
    values = [
        np.asarray(record[item.field] if isinstance(record, Mapping) else getattr(record, item.field))
        for item in layout
    ]
    _checked(group, layout, values, {} if sizes is None else sizes)
    made = [
        _create(group, item.name, value, {"units": item.units, "frame": item.frame, "names": item.codes or None})
        for item, value in zip(layout, values, strict=True)
    ]
    scales: dict[str, h5py.Dataset] = {}
    for item, dataset in zip(layout, made, strict=True):
        for i, (place, name) in enumerate(_scales_of(item)):
            if place not in scales:
                scales[place] = _scale(group, place, name, dataset.shape[i], coordinates)
            if place != item.name:
                dataset.dims[i].attach_scale(scales[place])


def _scales_of(item: Item) -> list[tuple[str, str]]:
    """Return path and name of the coordinate of each dimension of a data set: they lie in its folder."""
    folder, _ = item.place
    return [(f"{folder}/{name}" if folder else name, name) for name in item.dims]


def _create(group: h5py.Group, name: str, value: NDArray, attributes: Mapping[str, Any]) -> h5py.Dataset:
    if value.dtype == bool:  # HDF5's own truth values are an enumeration, which netCDF has not
        value, attributes = value.astype(np.uint8), {**attributes, "dtype": "bool"}
    storage = {}
    if value.size > _LONG:  # an empty array cannot be compressed
        rows = max(1, _CHUNK_BYTES * len(value) // value.nbytes)
        storage = {"chunks": (min(rows, len(value)), *value.shape[1:]), "compression": _LEVEL, "shuffle": True}
    dataset = group.create_dataset(name, data=value, **storage)
    write_attributes(dataset, attributes)
    return dataset


def _scale(group: h5py.Group, place: str, name: str, length: int, given: Coordinates) -> h5py.Dataset:
    """Return the coordinate of a dimension at a place below a group, made if missing."""
    scale = group.get(place)
    if scale is None:
        value = stored.coordinate(name, length, given)
        attributes = {"units": "s" if name == "time" else "1", "long_name": stored.meaning_of(name)}
        attributes |= {"frame": "clock of the recording" if name == "time" else "none"}
        scale = _create(group, place, value, attributes | ({"_Encoding": "utf-8"} if value.dtype.kind == "S" else {}))
    if scale.shape != (length,):
        raise ValueError(f"{_place(group, place)} is no coordinate of {length} entries")
    if not scale.is_scale:
        scale.make_scale(name)
    return scale


def require_coordinates(group: h5py.Group, layout: Iterable[Item], coordinates: Coordinates = NONE) -> None:
    """Raise an `ArchiveError` if a coordinate in a file differs from the one that `write_fields` would write."""
    layout = tuple(layout)
    seen = {item.name for item in layout}
    for item in layout:
        for i, (place, name) in enumerate(_scales_of(item)):
            if place in seen or place not in group:
                continue
            seen.add(place)
            expected = stored.coordinate(name, group[item.name].shape[i], coordinates)
            if not isinstance(group[place], h5py.Dataset) or not np.array_equal(group[place][()], expected):
                raise ArchiveError(f"{_place(group, place)} is not the coordinate of {item.name}")


def read_fields(
    group: h5py.Group, layout: Iterable[Item], sizes: dict[str, int] | None = None, coordinates: Coordinates = NONE
) -> dict[str, Any]:
    """Read the data sets of a layout by field, checked; the first one along a shared length decides it."""
    layout = tuple(layout)
    found = _read(group, layout, {} if sizes is None else sizes)
    require_coordinates(group, layout, coordinates)
    return found


def _read(group: h5py.Group, layout: stored.Layout, sizes: dict[str, int]) -> dict[str, NDArray]:
    for item in layout:
        if not isinstance(group.get(item.name), h5py.Dataset):
            raise ArchiveError(f"{_place(group, item.name)} is missing")
    values = _checked(group, layout, [group[item.name][()] for item in layout], sizes)
    return {item.field: value for item, value in zip(layout, values, strict=True)}


_TYPES = {"f": ("fiu", np.float64), "i": ("iu", np.int64), "b": ("biu", np.bool_), "S": ("SO", np.object_)}


def _checked(group: h5py.Group, layout: stored.Layout, values: list[Any], known: dict[str, int]) -> list[NDArray]:
    """Return the values of a layout in the types of their checks; raise an `ArchiveError` if one breaks its check."""
    for item, value in zip(layout, values, strict=True):
        if np.ndim(value) == len(item.shape):
            for n, length in zip(item.shape, np.shape(value), strict=True):
                known.setdefault(n, stored.fixed_length(n) or length)
        wanted = tuple(known.get(n, stored.fixed_length(n) or n) for n in item.shape)
        if np.shape(value) != wanted:
            raise ArchiveError(f"{_place(group, item.name)} has shape {np.shape(value)}, expected {wanted}")
    found = []
    for item, value in zip(layout, values, strict=True):
        kinds, dtype = _TYPES[item.check.kinds]
        value = np.asarray(value)
        if value.dtype.kind not in kinds and not (value.dtype.kind == "U" and "S" in kinds):
            raise ArchiveError(f"{_place(group, item.name)} is of type {value.dtype}, must {item.check.words}")
        wrong = np.argwhere(~item.check.holds(value, known))
        if len(wrong):
            index = tuple(int(i) for i in wrong[0])
            where = f"[{', '.join(map(str, index))}]" if index else ""
            shown = f" = {value[index]}" if np.ndim(value[index]) == 0 else ""
            raise ArchiveError(f"{_place(group, item.name)}{where}{shown}: must {item.check.words}")
        found.append(value if item.check.kinds == "S" else value.astype(dtype, copy=False))
    return found


def subgroup(group: h5py.Group, name: str) -> h5py.Group:
    """Return a group below another; raise an `ArchiveError` if it is missing."""
    if not isinstance(group.get(name), h5py.Group):
        raise ArchiveError(f"{_place(group, name)} is missing")
    return group[name]


def write_attributes(item: h5py.Group | h5py.Dataset, values: Mapping[str, Any], prefix: str = "") -> None:
    """Write values as attributes ``<prefix><name>`` except None, text with fixed length."""
    for key, value in values.items():
        name = prefix + key
        if isinstance(value, str):
            item.attrs[name] = np.bytes_(value.encode(errors="backslashreplace"))
        elif isinstance(value, tuple) and value and isinstance(value[0], str):
            item.attrs[name] = fixed_texts(value)
        elif value is not None:
            item.attrs[name] = value


def attributes(item: h5py.Group | h5py.Dataset) -> dict[str, Any]:
    """Return all attributes as plain Python values; arrays stay arrays."""
    return {name: plain(value) for name, value in item.attrs.items()}


def attribute(item: h5py.Group | h5py.Dataset, name: str) -> Any:
    """Return an attribute as a plain Python value; raise an `ArchiveError` if it is missing."""
    if name not in item.attrs:
        raise ArchiveError(f"{item.file.filename}: {_spoken(item, name)} is missing")
    return plain(item.attrs[name])


def version_of(item: h5py.Group) -> int:
    """Return the attribute ``format_version``; raise an `ArchiveError` unless it is a whole number."""
    version = attribute(item, "format_version")
    if type(version) is not int:
        raise ArchiveError(f"{item.file.filename}: {_spoken(item, 'format_version')} is no whole number: {version!r}")
    return version


def facts(item: h5py.Group | h5py.Dataset) -> dict[str, str | int | float]:
    """Return all attributes; raise an `ArchiveError` unless each is a text or a finite number."""
    found = attributes(item)
    for name, value in found.items():
        if not (isinstance(value, str) or (isinstance(value, int | float) and abs(value) < np.inf)):
            raise ArchiveError(f"{item.file.filename}: {_spoken(item, name)} is neither a text nor a finite number")
    return found


def json_table(item: h5py.Group | h5py.Dataset, name: str) -> dict[str, Any]:
    """Return an attribute that holds a JSON object; raise an `ArchiveError` if it holds anything else."""
    text = attribute(item, name)
    try:
        table = json.loads(text)
    except (ValueError, TypeError, RecursionError):
        table = None
    if not isinstance(table, dict):
        raise ArchiveError(f"{item.file.filename}: {_spoken(item, name)} is no JSON object: {str(text)[:40]!r}")
    return table


def fixed_texts(texts: Iterable[str]) -> NDArray:
    """Return texts in HDF5's form of fixed length, as an array."""
    return np.array([text.encode(errors="backslashreplace") for text in texts], dtype=np.bytes_)


def plain(value: Any) -> Any:
    """Return a stored scalar as a plain Python value, with control characters of a text written out."""
    value = value.item() if isinstance(value, np.generic) else value
    value = value.decode(errors="replace") if isinstance(value, bytes) else value
    return printable(value, keep="\n") if isinstance(value, str) else value


def texts(values: Any) -> tuple[str, ...]:
    """Return stored texts as plain ones."""
    return tuple(str(plain(text)) for text in np.ravel(values))


def _spoken(item: h5py.Group | h5py.Dataset, name: str) -> str:
    return f"attribute {name} of {item.name.strip('/') or 'the file'}"


def _place(group: h5py.Group, name: str) -> str:
    return f"{group.file.filename}: {f'{group.name}/{name}'.strip('/')}"
