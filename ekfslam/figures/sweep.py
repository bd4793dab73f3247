"""Figures of a sweep: any figure of merit against any setting.

As in `ekfslam.figures.maps`, every function returns a `matplotlib.figure.Figure` and touches no global state.
"""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from ekfslam.arrays import Array, IntArray
from ekfslam.figures.style import BAND_ALPHA, SERIES, styled
from ekfslam.studies.sweep_table import SweepTable

_MARKERS = "os^Dv<>P"
_LOG_RATIO = 20.0  # largest over smallest value from which a logarithmic axis shows more
_MOST_LINES = 24


@styled
def plot_sweep(table: SweepTable, figure: str, setting: str) -> Figure:
    """A column of figures of merit against one of settings: a line for each choice of all else, means over seeds.

    Bands go from the least to the largest seed. Runs without the figure are left out; the title says how many.

    Raises:
        ConfigError: There is no such column.
        ValueError: The figure is no number, or there are more than 24 lines to draw.
    """
    y, x = table.column(figure), table.column(setting)
    if y.dtype.kind != "f":
        raise ValueError(f"{figure} is no number")
    others = [
        name for name in table.swept if name not in (setting, "seed") and len(set(table.column(name).tolist())) > 1
    ]
    choices = list(dict.fromkeys(zip(*(table.column(name).tolist() for name in others), strict=True))) or [()]
    if len(choices) > _MOST_LINES:
        raise ValueError(f"{len(choices)} lines of {', '.join(others)} are more than a figure can show: {_MOST_LINES}")
    drawn = Figure(figsize=(8.0, 4.8 + 0.2 * max(len(choices) - 6, 0)))
    ax = drawn.subplots()
    place, names = _places(x)
    for i, choice in enumerate(choices):
        here = np.isfinite(y) & np.isfinite(place)
        for name, value in zip(others, choice, strict=True):
            here &= table.column(name) == value
        if not here.any():
            continue
        at, mean, low, high = _over_seeds(place[here], y[here])
        style = SERIES[i % len(SERIES)]
        label = ", ".join(f"{value:g}" if isinstance(value, float) else str(value) for value in choice)
        ax.plot(at, mean, marker=_MARKERS[i % len(_MARKERS)], label=label or figure, **style)
        if (high > low).any():
            ax.fill_between(at, low, high, color=style["color"], alpha=BAND_ALPHA, linewidth=0)
    if names:
        ax.set_xticks(range(len(names)), names)
    shown = y[np.isfinite(y)]
    if len(shown) and shown.min() > 0 and shown.max() > _LOG_RATIO * shown.min():
        ax.set_yscale("log")
    ax.set(xlabel=setting, ylabel=figure)
    missing = int((~np.isfinite(y)).sum())
    ax.set_title(f"{figure} against {setting}, {len(shown)} runs" + (f", {missing} without it" if missing else ""))
    if others:
        drawn.legend(title=", ".join(others), loc="outside lower center", ncols=2)
    return drawn


def _places(x: Array) -> tuple[Array, list[str]]:
    """Where values of a setting stand on the axis, and the names of places where they are text."""
    if x.dtype.kind == "f":
        return x, []
    names = list(dict.fromkeys(x.tolist()))
    return np.array([names.index(name) for name in x.tolist()], dtype=float), [name or "default" for name in names]


def _over_seeds(x: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    """Distinct x, and mean, least and largest y of each."""
    at: Array
    which: IntArray
    at, which = np.unique(x, return_inverse=True)
    groups = [y[which == i] for i in range(len(at))]
    return at, *(np.array([pick(group) for group in groups]) for pick in (np.mean, np.min, np.max))  # type: ignore[return-value]
