"""The registry of figures of runs, to which `figure` adds one.

    @figure("speed_{mode}", needs={"truth"})
    def speed(result: Result, truth: Truth) -> Figure:
        ...

A file with such a function is all that a new figure takes. `ekfslam.figures.run.draw_figures` draws it once the file is
imported.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any, ParamSpec

from matplotlib.figure import Figure

from ekfslam.arrays import BoolArray
from ekfslam.data.sequence import Truth
from ekfslam.figures.style import styled
from ekfslam.filters.result import Result

P = ParamSpec("P")


@dataclass(frozen=True)
class Entry:
    """A registered figure: what it needs, what it takes, and the function that draws it."""

    needs: frozenset[str]
    takes: tuple[str, ...]
    draw: Callable[..., Figure]


FIGURES: dict[str, Entry] = {}


def figure(name: str, needs: Collection[str] = ()) -> Callable[[Callable[P, Figure]], Callable[P, Figure]]:
    """Register a function that draws a figure of runs, and draw it in the style of all figures.

    Its parameters are named after what it takes of `offered`.

    Args:
        name: Name of the file. With ``{mode}`` in it, the figure is drawn of each mode alone.
        needs: Names of `offered` without which the figure is left out.
    """

    def register(draw: Callable[P, Figure]) -> Callable[P, Figure]:
        drawn = styled(draw)
        FIGURES[name] = Entry(frozenset(needs), tuple(inspect.signature(draw).parameters), drawn)
        return drawn

    return register


def offered(results: Mapping[str, Result], truth: Truth | None, interpolated: BoolArray | None) -> dict[str, Any]:
    """Return what a figure may take or need, None for what is missing.

    ``results`` by mode, ``result`` (the first), each mode by its name, ``truth``, ``interpolated`` (T,) intervals of
    the recording; and as needs alone ``updates``, ``landmarks``, and ``parameters`` of the full run.
    """
    runs = list(results.values())
    return {
        "results": results,
        "result": runs[0],
        "truth": truth if truth is not None and len(truth.frame) else None,
        "interpolated": interpolated,
        "updates": any(run.innovation.dof.any() for run in runs) or None,
        "landmarks": any(len(run.landmarks) for run in runs) or None,
        "parameters": results["full"].parameters if "full" in results else None,
        **results,
    }
