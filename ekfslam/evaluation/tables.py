"""Markdown tables, and the numbers in their cells.

print(markdown_table(["set", "ATE [m]"], [["0027", number(3.972, ".2f")], ["0022", number(None)]]))

| set | ATE [m] |
|---|---:|
| 0027 | 3.97 |
| 0022 | - |
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

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
            f"{cell:<{w}}" if i < left else f"{cell:>{w}}" for i, (cell, w) in enumerate(zip(line, widths, strict=True))
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
