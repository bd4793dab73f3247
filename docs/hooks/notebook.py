"""Run a notebook without Jupyter: all cells share one namespace, and their output is kept.

The page of the tutorial and its test use it. Output is printed text, the last expression, and open figures.
"""

from __future__ import annotations

import ast
import base64
import contextlib
import html
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Cell:
    """One cell of a notebook after its run.

    Args:
        kind: ``markdown`` or ``code``.
        source: Text of the cell.
        shown: Output as Markdown.
    """

    kind: str
    source: str
    shown: str = ""


def execute(path: Path, namespace: dict[str, Any] | None = None) -> list[Cell]:
    """Run the code cells of a notebook in order.

    Args:
        path: The ``.ipynb`` file.
        namespace: Dictionary for the names of the notebook; by default a new one.
    """
    names = {} if namespace is None else namespace
    cells = []
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        shown = _run(source, names) if cell["cell_type"] == "code" else ""
        cells.append(Cell(cell["cell_type"], source, shown))
    return cells


def as_markdown(cells: list[Cell]) -> str:
    """Return the page of a notebook that has run."""
    parts = [
        cell.source if cell.kind == "markdown" else f"```python\n{cell.source}\n```\n\n{cell.shown}" for cell in cells
    ]
    return "\n\n".join(parts) + "\n"


def _run(source: str, names: dict[str, Any]) -> str:
    """Return the output of a code cell."""
    from matplotlib import pyplot

    tree, value = ast.parse(source), None
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(compile(tree, "<cell>", "exec"), names)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), "<cell>", "eval"), names)
    shown = [_text(printed.getvalue())] if printed.getvalue() else []
    shown += _shown(value)
    shown += [_picture(pyplot.figure(number)) for number in pyplot.get_fignums() if pyplot.figure(number) is not value]
    pyplot.close("all")
    return "\n\n".join(shown)


def _shown(value: Any) -> list[str]:
    """Return a value as a notebook shows it: a figure as a picture, else its HTML form if it has one, else its repr."""
    if value is None:
        return []
    if hasattr(value, "savefig"):
        return [_picture(value)]
    as_html = getattr(value, "_repr_html_", None)
    return [f'<div class="shown">{as_html()}</div>' if as_html else _text(repr(value))]


def _text(text: str) -> str:
    return f'<pre class="shown">{html.escape(text.rstrip())}</pre>'


def _picture(figure: Any) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=90, bbox_inches="tight")
    return f'<img alt="Figure" src="data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}">'
