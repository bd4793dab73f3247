"""The HDF5 dialect of result archives, studies and recordings.

- A file appears under its name only when it is complete (`creating`, `replacing`).
- Its attributes ``format`` and ``format_version`` say what it is; `opened` refuses what it is not, and whatever damage
  shows while it is read becomes one named error.
- Data sets are declared in layouts, next to the records that they hold. Each has the attributes ``units`` and ``frame``
  (of reference).
- Text is read in both of HDF5's forms. Recordings, which are passed on, are written compactly: long arrays compressed,
  text of fixed length (libhdf5 hangs on some damaged files with text of variable length), and the newer file layout,
  which carries checksums of all but the arrays.

A leaf: readers of data use it as well as archives do, so it imports nothing of the package but the errors.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from operator import attrgetter
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ekfslam.errors import ArchiveError, EkfslamError

# Data set, field of the record that it holds (with dots for fields of fields), shape, units, frame. A letter in a shape
# is a length that data sets share.
Layout = tuple[tuple[str, str, tuple[str | int, ...], str, str], ...]

_LONG = 10_000  # entries from which compression pays


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A name to write a file under that takes the place of ``path`` when it is complete.

    Raises:
        ArchiveError: The file cannot be written.
    """
    path = Path(path)
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        yield unfinished
        unfinished.replace(path)
    except OSError as error:
        raise ArchiveError(f"{path}: cannot be written: {error}") from None
    finally:
        unfinished.unlink(missing_ok=True)


@contextmanager
def creating(path: str | Path, format: str, version: int, compact: bool = False) -> Iterator[h5py.File]:
    """A new file of a format and version, which replaces an old one when it is complete.

    Raises:
        ArchiveError: The file cannot be written.
    """
    with replacing(path) as unfinished, h5py.File(str(unfinished), "w", libver="v110" if compact else None) as h5file:
        write_attributes(h5file, {"format": format, "format_version": version}, compact)
        yield h5file


@contextmanager
def opened(
    path: str | Path, format: str, version: int, error: type[EkfslamError] = ArchiveError
) -> Iterator[h5py.File]:
    """A file, open for reading, of a format and of at most a version.

    Raises:
        ArchiveError: A newer release wrote the file.
        EkfslamError: Of type ``error``: it is missing, has another format, or turns out damaged while it is open.
    """
    try:
        with h5py.File(str(path), "r") as h5file:
            found, stored = plain(h5file.attrs.get("format")), h5file.attrs.get("format_version")
            if found != format:
                raise error(
                    f"{path}: an HDF5 file of format {found!r} with [{', '.join(h5file)}]; expected format {format!r}"
                )
            if not isinstance(stored, np.integer) or stored > version:
                raise ArchiveError(f"{path}: has format version {stored}, this release reads up to version {version}")
            yield h5file
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as problem:  # what h5py and json raise at damage
        raise error(f"{path}: damaged or no HDF5 file ({problem}); expected format {format!r}") from None


def write_fields(group: h5py.Group, layout: Layout, record: Any, compact: bool = False) -> None:
    """Write the data sets of a layout from the fields of a record, or the values of a mapping."""
    for name, field, _, units, frame in layout:
        value = record[field] if isinstance(record, Mapping) else attrgetter(field)(record)
        # HDF5 cannot chunk, hence not compress, an empty array.
        compression = "gzip" if compact and np.size(value) > _LONG else None
        dataset = group.create_dataset(name, data=value, compression=compression)
        write_attributes(dataset, {"units": units, "frame": frame}, compact)


def read_fields(group: h5py.Group, layout: Layout, sizes: Mapping[str, int] | None = None) -> dict[str, Any]:
    """The data sets of a layout by field, as stored; the first one along a shared length decides it.

    Args:
        group: To read from.
        layout: What to read.
        sizes: Shared lengths that are known.

    Raises:
        ArchiveError: A data set is missing or has another shape.
    """
    fields: dict[str, Any] = {}
    known = dict(sizes or {})
    for name, field, shape, _, _ in layout:
        if not isinstance(group.get(name), h5py.Dataset):
            raise ArchiveError(f"{_place(group)}/{name} is missing")
        value = group[name][()]
        if np.ndim(value) == len(shape):
            for n, length in zip(shape, np.shape(value), strict=True):
                if isinstance(n, str):
                    known.setdefault(n, length)
        wanted = tuple(known.get(n, n) if isinstance(n, str) else n for n in shape)
        if np.shape(value) != wanted:
            raise ArchiveError(f"{_place(group)}/{name} has shape {np.shape(value)}, expected {wanted}")
        fields[field] = value
    return fields


def subgroup(group: h5py.Group, name: str) -> h5py.Group:
    """A group below another.

    Raises:
        ArchiveError: It is missing.
    """
    if not isinstance(group.get(name), h5py.Group):
        raise ArchiveError(f"{_place(group, name)} is missing")
    return group[name]


def write_attributes(item: h5py.Group | h5py.Dataset, values: Mapping[str, Any], compact: bool = False) -> None:
    """Write attributes; those that are None are left out."""
    for name, value in values.items():
        if value is not None:
            item.attrs[name] = fixed_text(value) if compact and isinstance(value, str) else value


def attributes(item: h5py.Group | h5py.Dataset) -> dict[str, Any]:
    """All attributes as plain Python values; arrays stay arrays."""
    return {name: plain(value) for name, value in item.attrs.items()}


def attribute(item: h5py.Group | h5py.Dataset, name: str) -> Any:
    """One attribute as a plain Python value.

    Raises:
        ArchiveError: It is missing.
    """
    if name not in item.attrs:
        raise ArchiveError(f"{item.file.filename}: {_spoken(item, name)} is missing")
    return plain(item.attrs[name])


def json_table(item: h5py.Group | h5py.Dataset, name: str) -> dict[str, Any]:
    """One attribute that holds a JSON object.

    Raises:
        ArchiveError: It is missing, or holds something else.
    """
    text = attribute(item, name)
    try:
        table = json.loads(text)
    except (ValueError, TypeError):
        table = None
    if not isinstance(table, dict):
        raise ArchiveError(f"{item.file.filename}: {_spoken(item, name)} is no JSON object: {str(text)[:40]!r}")
    return table


def fixed_text(text: str) -> np.bytes_:
    """Text in HDF5's form of fixed length."""
    return np.bytes_(text.encode())


def plain(value: Any) -> Any:
    """A stored scalar as a plain Python value."""
    value = value.item() if isinstance(value, np.generic) else value
    return value.decode(errors="replace") if isinstance(value, bytes) else value


def texts(values: Any) -> tuple[str, ...]:
    """Stored texts as plain ones."""
    return tuple(str(plain(text)) for text in np.ravel(values))


def _spoken(item: h5py.Group | h5py.Dataset, name: str) -> str:
    return f"attribute {name} of {item.name.strip('/') or 'the file'}"


def _place(group: h5py.Group, name: str = "") -> str:
    return f"{group.file.filename}: {'/'.join(part for part in (group.name.strip('/'), name) if part)}"
