"""Figures of papers: as wide as a column or a page, without titles, legible in grey; their captions in a file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ekfslam.arrays import BoolArray
from ekfslam.data.sequence import Truth
from ekfslam.errors import ConfigError
from ekfslam.evaluation.tables import document
from ekfslam.figures import maps, series
from ekfslam.figures.run import different
from ekfslam.figures.series import BAND_SIGMAS, Series, draw_series
from ekfslam.figures.style import (
    BOUNDS,
    EXPECTED,
    LANDMARK_COLOR,
    TRUTH,
    ZERO,
    Format,
    Style,
    legend_of,
    log_axis,
    pngs,
    style_of,
    styled,
)
from ekfslam.filters.result import Result

WIDTHS = {"column": 3.5, "page": 7.16}  # inches, of journals with two columns
NARROWEST, WIDEST = 2.5, 20.0
DPI = 300
CAPTIONS = "captions.md"
_RC: Mapping[Any, Any] = {
    **dict.fromkeys(("font.size", "axes.titlesize", "axes.labelsize", "legend.fontsize"), 8.0),
    "lines.linewidth": 1.0,
    "lines.markersize": 3.5,
    "grid.linewidth": 0.4,
    "axes.linewidth": 0.6,
    "legend.handlelength": 2.2,
    "legend.columnspacing": 1.0,
    "legend.handletextpad": 0.5,
    "legend.frameon": False,
    "figure.constrained_layout.h_pad": 0.02,
    "figure.constrained_layout.w_pad": 0.02,
}
_LINE_IN, _LETTER_IN = 0.17, 0.062  # height of a line of text, width of a letter
_HANDLE_IN = 0.42  # width of a line in a legend with its gaps
_LEAST = 1e-6  # of the largest error; the first pose has none
_MARKS = 8  # markers along a curve


class Drawn(NamedTuple):
    """A figure and its caption."""

    figure: Figure
    caption: str


def width_of(text: str | float) -> float:
    """Return the width in inches of ``column``, ``page`` or a number of inches; raise a `ConfigError` otherwise."""
    try:
        width = WIDTHS.get(str(text)) or float(text)
    except ValueError:
        width = 0.0
    if not NARROWEST <= width <= WIDEST:
        known = f"{', '.join(WIDTHS)}, or {NARROWEST:g} to {WIDEST:g} inches"
        raise ConfigError(f"a width of figures is {known}, found {text!r}")
    return width


def draw_paper(
    results: Mapping[str, Result], truth: Truth | None, interpolated: BoolArray | None, width: float
) -> dict[str, Drawn]:
    """Draw the figures that the results allow, by name, as wide as ``width`` inches.

    ``map`` and ``side`` always; with true poses ``errors`` (lengths, of all estimators), ``errors_<mode>`` (of each
    axis with 3-sigma bounds) and ``nees``; ``nis`` with updates.
    """
    found = {"map": _map(results, truth, width), "side": _side(results, truth, width)}
    if truth is not None and len(truth.frame):
        found["errors"] = _errors(results, truth, width)
        found |= {f"errors_{mode}": _axes(result, truth, width) for mode, result in results.items()}
        known = {name: result for name, result in different(results).items() if result.has_covariance}
        judged = {name: (result, series.nees(result, truth, interpolated)) for name, result in known.items()}
        if judged := {name: pair for name, pair in judged.items() if len(pair[1].y)}:
            found["nees"] = _nees(judged, width)
    if updated := {mode: result for mode, result in results.items() if result.innovation.dof.any()}:
        found["nis"] = _nis(updated, width)
    return found


def paper_contents(
    directory: str | Path, figures: Mapping[str, Drawn], format: Format = "pdf"
) -> dict[Path, str | bytes]:
    """Return figures and ``captions.md`` as files of a folder, for `ekfslam.files.write_all`."""
    drawings = {name: one.figure for name, one in figures.items()}
    captions = document(*(f"**{name}**: {one.caption}" for name, one in figures.items()))
    return {**pngs(directory, drawings, format=format, dpi=DPI), Path(directory) / CAPTIONS: captions}


def drawn(draw: Callable[..., Drawn]) -> Callable[..., Drawn]:
    """Decorate a function to draw in our style, in the size of papers."""

    def wrapper(*arguments: Any) -> Drawn:
        captions = []

        def figure(*given: Any) -> Figure:
            with mpl.rc_context(dict(_RC)):
                made = draw(*given)
                made.figure.draw_without_rendering()  # ticks have the settings of their first drawing
            captions.append(made.caption)
            return made.figure

        return Drawn(styled(figure)(*arguments), captions[0])

    return wrapper


def _stack(width: float, rows: int, height: float, columns: int = 1) -> tuple[Figure, Any]:
    figure = Figure(figsize=(width, height * rows + 0.3))
    return figure, figure.subplots(rows, columns, squeeze=False, sharex=True)


def legend_below(figure: Figure, axes: list[Axes], width: float) -> None:
    """Add a legend below with as many columns as fit, and its height to the figure."""
    labels = list(dict.fromkeys(label for ax in axes for label in ax.get_legend_handles_labels()[1]))
    for columns in range(len(labels), 0, -1):
        rows = -(-len(labels) // columns)
        longest = [max(map(len, labels[i : i + rows])) for i in range(0, len(labels), rows)]
        if columns == 1 or sum(_HANDLE_IN + _LETTER_IN * n for n in longest) < width:
            break
    legend_of(figure, axes, columns)
    figure.set_size_inches(width, figure.get_figheight() + _LINE_IN * rows)


def _marked(name: str, of: str, count: int, place: int) -> Style:
    """Return the style of a curve of ``count`` points, with few markers at places of its own."""
    step = max(count // _MARKS, 1)
    return {**style_of(of), "markevery": (place * step // 4 % step, step), "label": name}


@drawn
def _map(results: Mapping[str, Result], truth: Truth | None, width: float) -> Drawn:
    mapper = maps.map_of(results)
    points = mapper.landmarks.position_m[:, :2]
    low, high, outside = maps.view_of(results, truth, points)
    aspect = min(float((high[1] - low[1]) / (high[0] - low[0])), 1.4)
    figure = Figure(figsize=(width, max((width - 0.55) * aspect, 0.8) + 0.45))
    ax = figure.subplots()
    maps.look_from_above(ax, low, high)
    ax.set_ylabel("y [m]")
    caption = f"Map of {mapper.sequence_name} from above, {maps.SIGMAS:g}-sigma ellipses."
    if len(points):
        some = maps.spread(len(points), 200)
        covariance = mapper.landmarks.covariance[some, :2, :2]
        maps.add_ellipses(ax, points[some], covariance, LANDMARK_COLOR, 0.1, alpha=0.6, linewidths=0.4)
        maps.draw_dots(ax, points, f"landmarks ({mapper.mode})", zorder=1.5)
        caption += f" {len(points)} landmarks of {mapper.mode}, {int(outside.sum())} of them outside the view."
    if truth is not None and len(truth.frame):
        ax.plot(*truth.T_world_imu[:, :2, 3].T, **{**TRUTH, "linewidth": 1.8}, label="truth")
    for i, (name, result) in enumerate(different(results).items()):
        xy = result.T_world_imu[:, :2, 3]
        ax.plot(*xy.T, **_marked(name, result.mode, len(xy), i), zorder=3)
        maps.add_pose_ellipses(ax, result, _MARKS)
    legend_below(figure, [ax], width)
    return Drawn(figure, caption)


@drawn
def _side(results: Mapping[str, Result], truth: Truth | None, width: float) -> Drawn:
    figure, axes = _stack(width, 1, 1.5)
    ax = axes[0, 0]
    if truth is not None and len(truth.frame):
        draw_series(ax, series.height(truth.T_world_imu), "", {**TRUTH, "linewidth": 1.8}, label="truth")
    for i, (name, result) in enumerate(different(results).items()):
        one = series.height_of(result, truth, has_band=True)
        line = {key: value for key, value in _marked(name, result.mode, len(one.x), i).items() if key != "label"}
        draw_series(ax, one, style_of(result.mode)["color"], line, label=name)
    ax.set_ylabel("z [m]")
    legend_below(figure, [ax], width)
    name = next(iter(results.values())).sequence_name
    return Drawn(figure, f"Height of {name} over the distance driven; bands: {BAND_SIGMAS:g} sigma.")


@drawn
def _errors(results: Mapping[str, Result], truth: Truth, width: float) -> Drawn:
    figure, axes = _stack(width, 2, 1.2)
    upper, lower = axes[:, 0]
    for i, (name, result) in enumerate(different(results).items()):
        position, rotation = series.error_lengths(result, truth)
        for ax, one in ((upper, position), (lower, rotation)):
            kept = one.y > _LEAST * one.y.max()
            ax.plot(one.x[kept], one.y[kept], **_marked(name, result.mode, int(kept.sum()), i))
            ax.set_ylabel(f"{one.name} [{one.unit}]")
    for ax in (upper, lower):
        ax.set_yscale("log")
        ax.margins(x=0.01)
    lower.set_xlabel("time [s]")
    legend_below(figure, [upper], width)
    name = next(iter(results.values())).sequence_name
    return Drawn(figure, f"Lengths of the position and rotation errors on {name}, from a common first pose.")


@drawn
def _axes(result: Result, truth: Truth, width: float) -> Drawn:
    found, color = series.errors(result, truth), style_of(result.mode)["color"]
    figure, axes = _stack(width, 3, 0.85, 2)
    for ax, one in zip(axes.T.ravel(), found, strict=True):
        draw_series(ax, one, color, {"color": "black", "linewidth": 0.7}, levels=ZERO)
        ax.set_ylabel(f"{one.name.replace('position ', '').replace('rotation', 'rot.')} [{one.unit}]")
    figure.align_ylabels()
    said = f"Estimate minus truth of {result.mode} on {result.sequence_name}, world axes; {series.inside_words(found)}."
    return Drawn(figure, said)


@drawn
def _nees(judged: Mapping[str, tuple[Result, Series]], width: float) -> Drawn:
    figure, axes = _stack(width, 1, 1.6)
    ax, (first, band) = axes[0, 0], next(iter(judged.values()))
    ax.fill_between(band.x, band.low, band.high, **BOUNDS, label=f"{100 * series.PROBABILITY:g} % bounds")
    for i, (name, (result, one)) in enumerate(judged.items()):
        ax.plot(one.x, one.y, **_marked(name, result.mode, len(one.y), i))
    ax.axhline(6.0, **EXPECTED, zorder=1)
    log_axis(ax, (1.0, 3.0))
    ax.margins(x=0.01)
    ax.set(xlabel="time [s]", ylabel="pose NEES [-]")
    legend_below(figure, [ax], width)
    means = ", ".join(f"{name} {one.mean:.3g}" for name, (_, one) in judged.items())
    return Drawn(figure, f"Pose NEES on {first.sequence_name}, 6 expected; means: {means}.")


@drawn
def _nis(results: Mapping[str, Result], width: float) -> Drawn:
    figure, axes = _stack(width, len(results), 1.2)
    said = []
    for ax, (mode, result) in zip(axes[:, 0], results.items(), strict=True):
        nis, style = series.nis(result), style_of(mode)
        dots = {"color": style["color"], "marker": style["marker"], "markersize": 2.0, "markeredgewidth": 0}
        draw_series(ax, nis, style["color"], {**dots, "linestyle": ""}, label=mode)
        ax.set_ylabel("NIS / dof [-]")
        said.append(f"{mode} {100 * nis.share_inside:.1f} %")
    legend_below(figure, list(axes[:, 0]), width)
    name = next(iter(results.values())).sequence_name
    return Drawn(figure, f"NIS per degree of freedom on {name}; within the bounds of their frames: {', '.join(said)}.")
