"""The registry of figures of runs, to which `figure` adds one.

    @figure("speed_{mode}", needs={"truth"})
    def speed(result: Result, truth: Truth) -> Figure:
        ...

`ekfslam.figures.run.draw_figures` draws a figure once its file is imported.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple, ParamSpec

from matplotlib.figure import Figure

from ekfslam.arrays import BoolArray
from ekfslam.data.sequence import Truth
from ekfslam.figures.style import styled
from ekfslam.filters.result import Result

P = ParamSpec("P")


class Entry(NamedTuple):
    """A registered figure: names that it needs, names that it takes, and the function that draws it."""

    needs: frozenset[str]
    takes: tuple[str, ...]
    draw: Callable[..., Figure]


FIGURES: dict[str, Entry] = {}


def figure(name: str, needs: Collection[str] = ()) -> Callable[[Callable[P, Figure]], Callable[P, Figure]]:
    """Register a function that draws a figure of runs, and draw it in the style of all figures.

    Args:
        name: Name of the file. If it contains ``{mode}``, each mode has a figure of its own.
        needs: Names of `offered` without which the figure is left out. Its parameters are such names, too.
    """

    def register(draw: Callable[P, Figure]) -> Callable[P, Figure]:
        drawn = styled(draw)
        FIGURES[name] = Entry(frozenset(needs), tuple(inspect.signature(draw).parameters), drawn)
        return drawn

    return register


def offered(results: Mapping[str, Result], truth: Truth | None, interpolated: BoolArray | None) -> dict[str, Any]:
    """Return the values that a figure may take or need, None if missing.

    ``results`` by mode, ``result`` (the first), each mode by its name, ``truth``, ``interpolated`` (T,) intervals;
    and as needs alone ``updates``, ``landmarks``, ``inertial``, and ``parameters`` of the full run.
    """
    runs = list(results.values())
    return {
        "results": results,
        "result": runs[0],
        "truth": truth if truth is not None and len(truth.frame) else None,
        "interpolated": interpolated,
        "updates": any(run.innovation.dof.any() for run in runs) or None,
        "landmarks": any(len(run.landmarks) for run in runs) or None,
        "inertial": runs[0].inertial,
        "parameters": results["full"].parameters if "full" in results else None,
        **results,
    }
