"""Tables in Markdown, LaTeX and CSV, and the numbers in their cells.

print(markdown_table(["set", "ATE [m]"], [["0027", number(3.972, ".2f")], ["0022", number(None)]]))

| set | ATE [m] |
|---|---:|
| 0027 | 3.97 |
| 0022 | - |
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

MISSING = "-"

_NARROWEST = 4  # a rule needs three dashes and a colon


def markdown_table(
    headings: Sequence[str], rows: Iterable[Sequence[str]], *, left: int = 1, padded: bool = False
) -> str:
    """Return a Markdown table without a final line end, padded for terminals or not; ``left`` columns are text."""
    lines = [[cell.replace("|", "\\|").replace("\n", " ") for cell in line] for line in (headings, *rows)]
    if any(len(line) != len(headings) for line in lines):
        raise ValueError(f"every row must have {len(headings)} cells")
    widths = [max(_NARROWEST, *map(len, column)) if padded else 0 for column in zip(*lines, strict=True)]
    texts, rule = [], []
    for line in lines:
        cells = (
            cell.ljust(w) if i < left else cell.rjust(w) for i, (cell, w) in enumerate(zip(line, widths, strict=True))
        )
        texts.append(f"|{'|'.join(f' {cell} ' if cell else ' ' for cell in cells)}|")
    for i, width in enumerate(widths):
        colon = "" if i < left else ":"
        rule.append("-" * (width + 2 - len(colon) if padded else 3) + colon)
    return "\n".join([texts[0], f"|{'|'.join(rule)}|", *texts[1:]])


def number(value: float | None, spec: str = "") -> str:
    """Return a number in a format such as ``.2f``; a dash for None."""
    return MISSING if value is None else format(value, spec)


def significant(value: float | None) -> str:
    """Return a number with about three significant digits; a dash for None."""
    if value is None:
        return MISSING
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.2f}" if abs(value) >= 1 else f"{value:.3f}"


def plus_minus(value: str, error: str) -> str:
    """Return a value with its error, a standard error or deviation; a dash for a missing one."""
    return value if MISSING in (value, error) else f"{value} ± {error}"


def document(*blocks: str) -> str:
    """Return headings, paragraphs and tables as the text of a file, with blank lines between them."""
    return "\n\n".join(block.strip("\n") for block in blocks) + "\n"


@dataclass(frozen=True)
class Column:
    """A column of a `Grid`."""

    heading: str  # with the unit
    values: Sequence[str | float | None]  # text or number of each row; None or NaN if missing
    errors: Sequence[float | None] = ()  # standard error of each number; none if empty
    is_compared: bool = False  # the lowest number of a group of rows is the best
    is_mixed: bool = False  # numbers are of different kinds, each with its own decimals
    decimals: int | None = None  # None: see `places`

    @property
    def is_text(self) -> bool:
        return any(isinstance(value, str) for value in self.values)

    @property
    def places(self) -> int:
        """Number of decimals: those of the median number in three digits, none of whole numbers."""
        sizes = sorted(abs(x) for x in self.values if isinstance(x, int | float) and math.isfinite(x) and x)
        if self.decimals is not None or not sizes or all(float(x).is_integer() for x in sizes):
            return self.decimals or 0
        return min(max(2 - math.floor(math.log10(sizes[len(sizes) // 2])), 0), 6)

    @property
    def cells(self) -> list[tuple[str, str]]:
        """Number and standard error of each row as text."""
        spec = ".3g" if self.is_mixed else f".{self.places}f"
        errors = self.errors or [None] * len(self.values)
        return [(_cell(x, spec), _cell(e, spec)) for x, e in zip(self.values, errors, strict=True)]


def _cell(value: str | float | None, spec: str) -> str:
    if isinstance(value, str):
        return value
    return MISSING if value is None or not math.isfinite(value) else format(value, spec)


@dataclass(frozen=True)
class Grid:
    """A table to write as Markdown, LaTeX or CSV."""

    columns: Sequence[Column]  # text before numbers
    groups: Sequence[Any] = ()  # group of each row, of which the best number is bold; empty: all are one group
    notes: Sequence[str] = ()  # below the table

    def above(self, other: Grid, label: str) -> Grid:
        """Return the grid with the columns of the same headings of another one below, as the group ``label``."""
        below, rows = {column.heading: column for column in other.columns}, len(other.columns[0].values)
        columns, count = [], len(self.columns[0].values)
        for column in self.columns:
            more = below.get(column.heading, Column("", [label] * rows))
            errors = [*(column.errors or [None] * count), *(more.errors or [None] * rows)]
            values = [*column.values, *more.values]
            is_bare = not column.errors and not more.errors
            columns.append(replace(column, values=values, errors=() if is_bare else errors, decimals=column.places))
        groups = [*(self.groups or [""] * count), *[label] * rows]
        return replace(self, columns=columns, groups=groups, notes=[*self.notes, *other.notes[:1]])

    def text(self, ending: str) -> str:
        """Return the table as a file with an ending of `WRITERS`."""
        return WRITERS[ending](self)

    @property
    def best(self) -> set[tuple[int, int]]:
        """Column and row of each cell that is the best of its group; equal ones all are."""
        found = set()
        groups = self.groups or [0] * len(self.columns[0].values)
        for c, column in enumerate(self.columns):
            texts = [text for text, _ in column.cells]
            for group in dict.fromkeys(groups) if column.is_compared else ():
                rows = [r for r, own in enumerate(groups) if own == group and texts[r] != MISSING]
                least = min((float(texts[r]) for r in rows), default=0.0)
                best = {(c, r) for r in rows if float(texts[r]) == least}
                found |= best if len(best) < len(rows) else set()
        return found


def _texts(
    grid: Grid, bold: Callable[[str], str], sign: str, escape: Callable[[str], str], minus: str = "-"
) -> list[list[str]]:
    """Return the cells of each row, with errors and the best in bold."""
    columns, best = [], grid.best
    for c, column in enumerate(grid.columns):
        cells = []
        for r, (text, error) in enumerate(column.cells):
            shown = escape(text) if column.is_text else minus + text[1:] if text.startswith("-") and text[1:] else text
            shown = bold(shown) if (c, r) in best else shown
            cells.append(shown if error == MISSING else f"{shown}{sign}{error}")
        columns.append(cells)
    return [list(row) for row in zip(*columns, strict=True)]


def _left(grid: Grid) -> int:
    return next((c for c, column in enumerate(grid.columns) if not column.is_text), len(grid.columns))


def markdown_text(grid: Grid) -> str:
    """Return a grid as Markdown that is also legible on a terminal."""
    rows = _texts(grid, lambda text: f"**{text}**", " ± ", str)
    headings = [column.heading for column in grid.columns]
    return document(markdown_table(headings, rows, left=_left(grid), padded=True), *grid.notes)


def latex_text(grid: Grid) -> str:
    """Return a grid as a tabular of booktabs; notes are comments. Equal texts of successive rows are written once."""
    rows = _texts(grid, lambda text: rf"\textbf{{{text}}}", r" $\pm$ ", latex, "$-$")
    heads = [_stacked(column.heading) for column in grid.columns]
    lines = [rf"\begin{{tabular}}{{{''.join('l' if c.is_text else 'r' for c in grid.columns)}}}", r"\toprule"]
    lines += [f"{' & '.join(heads)} \\\\", r"\midrule"]
    widths = [max(map(len, column)) for column in zip(heads, *rows, strict=True)]
    former = None
    for r, row in enumerate(rows):
        group = grid.groups[r] if grid.groups else None
        if r and group != former:
            lines.append(r"\addlinespace")
        elif r and grid.groups and row[0] == rows[r - 1][0] and _left(grid) > 1:
            row = ["", *row[1:]]
        former = group
        cells = (
            f"{cell:<{w}}" if column.is_text else f"{cell:>{w}}"
            for cell, w, column in zip(row, widths, grid.columns, strict=True)
        )
        lines.append(f"{' & '.join(cells)} \\\\")
    lines += [r"\bottomrule", r"\end{tabular}"]
    return "\n".join([*(f"% {line}" for note in grid.notes for line in note.splitlines() if line), *lines]) + "\n"


def _stacked(heading: str) -> str:
    """Return a heading with a line for each part between commas, so that columns are narrow."""
    first, *others = heading.split(", ")
    if not others:
        return latex(heading)
    return rf"\shortstack[r]{{{latex(first)}\\{latex(', '.join(others))}}}"


def csv_text(grid: Grid) -> str:
    """Return a grid as comma-separated values: numbers in full, a column of standard errors after theirs."""
    columns: dict[str, Sequence[str | float | None]] = {}
    for column in grid.columns:
        columns[column.heading] = column.values
        if column.errors:
            columns[f"{column.heading}, standard error"] = column.errors
    writer = csv.writer(out := io.StringIO(), lineterminator="\n")
    writer.writerow(columns)
    for row in zip(*columns.values(), strict=True):
        writer.writerow("" if x is None or x != x else x if isinstance(x, str) else repr(x) for x in row)
    return out.getvalue()


def is_table(path: Path) -> bool:
    """Return whether a file looks like an earlier table of `WRITERS`, by its beginning or its note."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, ValueError):
        return False
    first = text.partition("\n")[0]
    by_ending = {".tex": first.startswith(MADE_BY), ".md": f"\n\n{MADE_BY[2:]}" in text, ".csv": first.count(",") > 1}
    return by_ending.get(path.suffix, False)


MADE_BY = "% ekfslam "  # beginning of a table in LaTeX, whose first note names the program
WRITERS: Mapping[str, Callable[[Grid], str]] = {".md": markdown_text, ".tex": latex_text, ".csv": csv_text}
_LATEX = {c: rf"\{c}" for c in "&%$#_{}"} | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}"}
_LATEX |= {"^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}"}
_LATEX |= {"±": r"$\pm$", "\N{DEGREE SIGN}": r"$^\circ$", "\n": " "}


def latex(text: str) -> str:
    """Return a text with the characters escaped that mean something to LaTeX."""
    found = "".join(_LATEX.get(c, c) for c in text).replace("--", "-{}-").replace("--", "-{}-")  # no dash
    return f"{{}}{found}" if found[:1] in ("[", "*") else found  # after a line break they would be its argument
