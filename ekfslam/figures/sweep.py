"""Figures of a sweep, for the screen or a paper: any figure of merit against any setting."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ekfslam.arrays import Array
from ekfslam.evaluation.tables import MISSING
from ekfslam.figures.paper import Drawn, drawn, legend_below
from ekfslam.figures.series import LOG_RATIO
from ekfslam.figures.style import BAND_ALPHA, SERIES, legend_of, log_axis, styled
from ekfslam.studies.sweep_table import SweepTable, spoken, words_of

_MARKERS = "os^Dv<>P"
_MOST_LINES, _MOST_PANELS = 24, 24
_PANELS_A_ROW = 3
_PANEL_IN = 2.2  # least width of a panel in a paper


@styled
def plot_sweep(table: SweepTable, figure: str, setting: str) -> Figure:
    """Draw figures of merit against a setting: a line (mean over seeds, with range) for each choice of the others."""
    return _plotted(table, figure, setting, None)


@drawn
def paper_sweep(table: SweepTable, figure: str, setting: str, width: float) -> Drawn:
    """Draw `plot_sweep` as wide as ``width`` inches, with its caption."""
    said = f"{words_of(figure)} against {words_of(setting)}; lines: mean over seeds, bands: their range."
    return Drawn(_plotted(table, figure, setting, width), said)


def _plotted(table: SweepTable, figure: str, setting: str, paper: float | None) -> Figure:
    runs, table = len(table), table.without_repeats(setting)
    y, x = table.column(figure), table.column(setting)
    if y.dtype.kind != "f":
        raise ValueError(f"{figure} is no number")
    panels = {(): table} if setting == "recording" else table.groups("recording")
    told = [name for name in table.swept if len(set(table.column(name).tolist())) > 1]
    others = [name for name in told if name not in (setting, "seed", "recording")]
    choices = list(table.groups(*others)) if others else [()]
    if len(choices) > _MOST_LINES or len(panels) > _MOST_PANELS:
        found = f"{len(panels)} panels with {len(choices)} lines of {', '.join(others)}"
        raise ValueError(f"{found} are more than a figure can show: {_MOST_PANELS} with {_MOST_LINES}")
    columns = min(len(panels), _PANELS_A_ROW if paper is None else max(1, int(paper / _PANEL_IN)))
    rows = -(-len(panels) // columns)
    width, height = 8.0 if columns == 1 else 1.0 + 4.0 * columns, 4.2 if rows == 1 else 3.2 * rows
    size = (width, 0.6 + height + 0.09 * len(choices)) if paper is None else (paper, 1.6 * rows + 0.3)
    page = Figure(figsize=size)
    axes = page.subplots(rows, columns, squeeze=False, sharex=True).ravel()
    # Values of a setting that is text, in the order of their places on the axis.
    names = [] if x.dtype.kind == "f" else list(dict.fromkeys(x.tolist()))
    for ax, (name, panel) in zip(axes, panels.items(), strict=False):
        _draw_panel(ax, panel, figure, setting, others, choices, names)
        ax.set(title=", ".join(name), xlabel=words_of(setting), ylabel=words_of(figure))
    for ax in axes[len(panels) :]:
        ax.remove()
    if paper is not None:
        if others:
            legend_below(page, list(axes[:1]), paper)
        return page
    missing = int((~np.isfinite(y)).sum())
    page.suptitle(f"{words_of(figure)}, {runs - missing} runs" + (f", {missing} without it" if missing else ""))
    if others:
        legend_of(page, axes[:1], min(columns + 1, 3), ", ".join(map(words_of, others)))
    return page


def _draw_panel(
    ax: Axes,
    table: SweepTable,
    figure: str,
    setting: str,
    others: Sequence[str],
    choices: Sequence[tuple[Any, ...]],
    names: Sequence[str],
) -> None:
    """Draw the lines of one panel; a choice has the same style in all panels, and a legend entry even without runs."""
    parts = table.groups(*others) if others else {(): table}
    for i, choice in enumerate(choices):
        part = parts.get(choice)
        x, y = (np.empty(0), np.empty(0)) if part is None else (part.column(setting), part.column(figure))
        place = np.array([names.index(value) for value in x.tolist()], dtype=float) if names else x
        here = np.isfinite(y) & np.isfinite(place)
        at, mean, low, high = _over_seeds(place[here], y[here])
        style = SERIES[i % len(SERIES)]
        label = ", ".join(words for value in choice if (words := spoken(value)) != MISSING)
        ax.plot(at, mean, marker=_MARKERS[i % len(_MARKERS)], label=label or figure, **style)
        if (high > low).any():
            ax.fill_between(at, low, high, color=style["color"], alpha=BAND_ALPHA, linewidth=0)
    if names:
        ax.set_xticks(range(len(names)), [name or "default" for name in names])
    shown = table.column(figure)[np.isfinite(table.column(figure))]
    if len(shown) and shown.min() > 0 and shown.max() > LOG_RATIO * shown.min():
        log_axis(ax, (1.0, 2.0, 5.0))


def _over_seeds(x: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    """Return distinct x, and mean, least and largest y of each."""
    at = np.unique(x)
    groups = [y[x == value] for value in at]
    mean, low, high = (np.array([pick(group) for group in groups]) for pick in (np.mean, np.min, np.max))
    return at, mean, low, high
