"""Text files of numbers: columns, comments, headers. Every error names the file and the line, counted from 1."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.errors import CalibrationError, DataError, LineError, NonFiniteError, StampError, UnknownFormatError
from ekfslam.limits import require_file

Converters = Mapping[int, Callable[[str], float]]
_NUMBERS = re.compile(r"[\d\s.,;eE+-]+")
Where = dict[str, Any]  # keyword arguments of a `DataError`


def line_of(path: Path, number: int) -> Where:
    """Return a line of a file, counted from 1, as keyword arguments of a `DataError`."""
    return {"source": str(path), "field": "line", "index": number}


@dataclass(frozen=True)
class Table:
    """Rows of finite numbers (n, columns) in a text file, and their lines (n,)."""

    path: Path
    values: Array
    line: IntArray

    def where(self, row: int) -> Where:
        """Return the line of a row as keyword arguments of a `DataError`."""
        return line_of(self.path, int(self.line[row]))

    def require_increasing(self) -> None:
        """Raise `StampError` unless the first column increases."""
        backwards = np.diff(self.values[:, 0]) <= 0
        if backwards.any():
            raise StampError("the stamp does not increase", **self.where(int(np.argmax(backwards)) + 1))


def with_commas(line: str) -> str:
    """Return a line with commas in place of semicolons, and points in place of the decimal commas beside these."""
    if ";" not in line:
        return line
    if "," not in line:
        return line.replace(";", ",")
    return line.replace(",", ".").replace(";", ",") if _NUMBERS.fullmatch(line) else line


def read_lines(path: Path, expected: str) -> list[str]:
    """Return the lines of a text file."""
    try:
        require_file(path, is_text=True)
        return [with_commas(line) for line in path.read_text(encoding="utf-8-sig").splitlines()]
    except (OSError, UnicodeDecodeError, UnknownFormatError) as error:
        raise UnknownFormatError(f"{path}: not a readable text file ({error}); {expected}") from None


def rows_of(lines: Iterable[str], comment: str | None = "#") -> Iterable[tuple[int, str]]:
    """Yield number and content of the lines that hold more than blanks and comments."""
    for number, line in enumerate(lines, start=1):
        content = (line.split(comment, 1)[0] if comment else line).strip()
        if content:
            yield number, content


def first_row(path: Path, comment: str | None = "#") -> str:
    """Return the first line that holds more than a comment, without that; empty if there is none, or no text file."""
    try:
        require_file(path, is_text=True)
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            return with_commas(next((content for _, content in rows_of(file, comment)), ""))
    except (OSError, UnknownFormatError):
        return ""


def parse_numbers(
    words: Sequence[str],
    columns: int,
    where: Where,
    *,
    converters: Converters = MappingProxyType({}),
    error: type[DataError] = LineError,
) -> list[float]:
    """Return the finite numbers of a line, one for each column; ``converters`` replace `float` in some columns."""
    if len(words) != columns:
        raise error(f"{len(words)} values, expected {columns}", **where)
    try:
        values = [converters.get(i, float)(word) for i, word in enumerate(words)]
    except (ValueError, OverflowError) as problem:
        raise error(str(problem), **where) from None
    if not np.isfinite(values).all():
        raise NonFiniteError("NaN or infinite value", **where)
    return values


def parse_table(
    lines: Iterable[str],
    path: Path,
    *,
    columns: int | None = None,
    used: int | None = None,
    separator: str | None = None,
    comment: str | None = "#",
    converters: Converters = MappingProxyType({}),
    error: type[DataError] = LineError,
) -> Table:
    """Return all rows of numbers; there may be none.

    Rows have ``columns`` numbers, by default those of the first one; the first ``used`` are read. See `parse_numbers`.
    """
    values: list[list[float]] = []
    numbers: list[int] = []
    for number, content in rows_of(lines, comment):
        words, where = [word.strip() for word in content.split(separator)], line_of(path, number)
        columns = len(words) if columns is None else columns
        if len(words) != columns:
            raise error(f"{len(words)} columns, expected {columns}", **where)
        words = words[:used]
        values.append(parse_numbers(words, len(words), where, converters=converters, error=error))
        numbers.append(number)
    width = len(values[0]) if values else (used or columns or 0)
    return Table(path, np.array(values).reshape(len(values), width), np.array(numbers, dtype=np.int64))


def read_keys(path: Path, counts: Mapping[str, int], expected: str) -> dict[str, Array]:
    """Read as many numbers of each key as ``counts`` says from lines ``KEY: numbers``; others may hold anything."""
    values: dict[str, Array] = {}
    for number, line in enumerate(read_lines(path, expected), start=1):
        key, _, rest = line.partition(":")
        if (key := key.strip()) in counts:
            values[key] = np.array(parse_numbers(rest.split(), counts[key], line_of(path, number)))
    for key in counts:
        if key not in values:
            raise CalibrationError("this key is missing", source=str(path), field=key)
    return values
