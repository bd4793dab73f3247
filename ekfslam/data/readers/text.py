"""Text files of numbers: lines of columns, with comments, empty lines and headers. The one parser of all formats.

Every error names the file and the line, counted from 1.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TypedDict

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.errors import DataError, LineError, NonFiniteError, UnknownFormatError
from ekfslam.limits import require_file

Converters = Mapping[int, Callable[[str], float]]


class Where(TypedDict):
    """The place that a `DataError` names."""

    source: str
    field: str
    index: int


def line_of(path: Path, number: int) -> Where:
    """A line of a file, counted from 1, as keyword arguments of a `DataError`."""
    return {"source": str(path), "field": "line", "index": number}


@dataclass(frozen=True)
class Table:
    """The rows of numbers in a text file.

    Args:
        path: The file.
        values: (n, columns) numbers, all finite.
        line: (n,) line of each row.
    """

    path: Path
    values: Array
    line: IntArray

    def where(self, row: int) -> Where:
        """The line of a row, as keyword arguments of a `DataError`."""
        return line_of(self.path, int(self.line[row]))


def read_lines(path: Path, expected: str) -> list[str]:
    """The lines of a text file.

    Raises:
        UnknownFormatError: It cannot be read, or is not text; the message ends with what was ``expected``.
    """
    try:
        require_file(path, is_text=True)
        return path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError, UnknownFormatError) as error:
        raise UnknownFormatError(f"{path}: not a readable text file ({error}); {expected}") from None


def rows_of(lines: Iterable[str], comment: str | None = "#") -> Iterable[tuple[int, str]]:
    """Number and content of the lines that hold more than blanks and comments."""
    for number, line in enumerate(lines, start=1):
        content = (line.split(comment, 1)[0] if comment else line).strip()
        if content:
            yield number, content


def first_line(path: Path) -> str:
    """The first line of a file; empty if there is none, or it is no text."""
    try:
        require_file(path)
        with path.open(encoding="utf-8") as file:
            return file.readline(1 << 16).rstrip("\n")
    except (OSError, UnicodeDecodeError, UnknownFormatError):
        return ""


def first_row(path: Path) -> str:
    """The first line of a file that holds more than a comment, without it; empty if there is none, or no file."""
    try:
        require_file(path, is_text=True)
        with path.open(encoding="utf-8", errors="replace") as file:
            return next((content for _, content in rows_of(file)), "")
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
    """Exactly as many finite numbers as there are to be columns.

    Args:
        words: What should be numbers.
        columns: How many there should be.
        where: The line that they are from.
        converters: By column, what makes a number of a word, where that is not `float`.
        error: What to raise for a malformed line.

    Raises:
        DataError: There are more or fewer words, or one is no number; ``error`` says which subclass.
        NonFiniteError: A number is NaN or infinite.
    """
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
    """All rows of numbers; there may be none.

    Args:
        lines: Of the file.
        path: The file, for messages.
        columns: How many every row has; as many as the first row by default.
        used: How many of them are read; the others may hold anything. All by default.
        separator: Between columns; blanks by default.
        comment: What begins a comment; None if nothing does.
        converters, error: See `parse_numbers`.

    Raises:
        DataError: A row is malformed, see `parse_numbers`.
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
