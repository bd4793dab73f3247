"""The registry of figures of runs: `figure` adds one, `draw_all` draws those that the runs allow.

    @figure("speed", needs={"full"})
    def speed(runs: Runs) -> Figure:
        ...

A module with such a function is all that a new figure takes, once it is imported.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

from matplotlib.figure import Figure

from ekfslam.arrays import BoolArray
from ekfslam.data.sequence import Truth
from ekfslam.figures.style import styled
from ekfslam.filters.result import Result

_EACH = "{mode}"  # in names of figures that are drawn for each mode


@dataclass(frozen=True)
class Runs:
    """Runs on one recording.

    Args:
        results: Mode to result.
        truth: Truth of the recording; None if it is unknown.
        interpolated: (T,) interpolated intervals of the recording; None if there are none.
    """

    results: Mapping[str, Result]
    truth: Truth | None = None
    interpolated: BoolArray | None = None

    @property
    def result(self) -> Result:
        """The first run: the only one in a figure of one mode."""
        return next(iter(self.results.values()))

    @property
    def offers(self) -> set[str]:
        """What figures may need: the modes, ``truth``, ``updates``, ``landmarks`` and ``parameters``."""
        found = {
            "truth": self.truth is not None and len(self.truth.frame) > 0,
            "updates": any(result.innovation.dof.any() for result in self.results.values()),
            "landmarks": any(len(result.landmarks) for result in self.results.values()),
            "parameters": any(result.parameters is not None for result in self.results.values()),
        }
        return set(self.results) | {name for name, is_there in found.items() if is_there}


@dataclass(frozen=True)
class Entry:
    """A registered figure, see `figure`."""

    needs: frozenset[str]
    draw: Callable[[Runs], Figure]


FIGURES: dict[str, Entry] = {}


def figure(name: str, needs: Collection[str] = ()) -> Callable[[Callable[[Runs], Figure]], Callable[[Runs], Figure]]:
    """Register a function that draws a figure of runs.

    Args:
        name: Name of the file. With ``{mode}`` in it, the figure is drawn of each mode alone.
        needs: Names of `Runs.offers` without which the figure is left out.
    """

    def register(draw: Callable[[Runs], Figure]) -> Callable[[Runs], Figure]:
        FIGURES[name] = Entry(frozenset(needs), styled(draw))
        return draw

    return register


def draw_all(runs: Runs) -> dict[str, Figure]:
    """Draw the registered figures that the runs allow, by name."""
    figures = {}
    for name, entry in FIGURES.items():
        alone = [dataclasses.replace(runs, results={mode: result}) for mode, result in runs.results.items()]
        for some in alone if _EACH in name else [runs]:
            if entry.needs <= some.offers:
                figures[name.replace(_EACH, some.result.mode)] = entry.draw(some)
    return figures
