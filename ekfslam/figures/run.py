"""Figures of runs over time: errors, NIS, estimated parameters; and all figures of a run."""

from __future__ import annotations

from collections.abc import Mapping
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from ekfslam import files
from ekfslam.arrays import Array, BoolArray
from ekfslam.data.sequence import Truth
from ekfslam.evaluation.brief import ATE, brief_rows
from ekfslam.figures import maps as maps  # registers figures, as the next one does
from ekfslam.figures import posterior as posterior
from ekfslam.figures import registry, series
from ekfslam.figures.older import marked, pictures_of, remove_figures, require_own
from ekfslam.figures.series import BAND_SIGMAS, draw_series
from ekfslam.figures.style import PRIOR, TRUTH, ZERO, Format, arrange, legend_of, line_of, pngs, share_x, style_of
from ekfslam.filters.result import Result


@registry.figure("errors", needs={"truth"})
def plot_errors(results: Mapping[str, Result], truth: Truth, interpolated: BoolArray | None = None) -> Figure:
    """Draw estimate minus truth over time, world axes: position (m) and rotation (degrees) with 3-sigma bands.

    Each mode has a column with its own scales. Modes with equal trajectories (mapping-only and dead reckoning) share a
    column. NEES is of the frames that no ``interpolated`` interval (T,) leads to.
    """
    columns = different(results)
    figure = Figure(figsize=(4.4 * len(columns) + 0.4, 8.8))
    axes = figure.subplots(6, len(columns), squeeze=False)
    for column, (title, result) in zip(axes.T, columns.items(), strict=True):
        errors, color = series.errors(result, truth), style_of(result.mode)["color"]
        for ax, error in zip(column, errors, strict=True):
            draw_series(ax, error, color, {"color": "black", "linewidth": 1.0}, levels=ZERO)
        share_x(*column)
        said = [title, _ate_words(result, truth), series.inside_words(errors), _nees_words(result, truth, interpolated)]
        column[0].set_title("\n".join(said), fontsize=9.0)
    name, break_ = next(iter(results.values())).sequence_name, "\n" if len(columns) == 1 else " "
    figure.suptitle(f"{name}:{break_}estimate minus truth, world axes")
    arrange(figure, left=0.8, top=1.25 if len(columns) == 1 else 1.05, gaps=(0.8, 0.13))
    return figure


def different(results: Mapping[str, Result]) -> dict[str, Result]:
    """Return results with different trajectories, by the names of all modes that have them."""
    found: dict[str, Result] = {}
    for mode, result in results.items():
        twin = next((m for m, r in found.items() if np.array_equal(r.T_world_imu, result.T_world_imu)), None)
        name = mode if twin is None else f"{twin}, {mode}"
        found[name] = result if twin is None else found.pop(twin)
    return found


def _ate_words(result: Result, truth: Truth) -> str:
    return f"ATE (aligned) {brief_rows(result, truth)[ATE]}"


def _nees_words(result: Result, truth: Truth, interpolated: BoolArray | None) -> str:
    """Return the mean pose NEES for a title, and the one with truth noise if the truth states noise."""
    if not result.has_covariance:
        return ""
    exact, noisy = (series.nees(result, truth, interpolated, noise).mean for noise in (False, True))
    if exact is None:
        return ""
    words = f"mean NEES (6) {exact:.3g}"
    return words if truth.noise is None else f"{words}, {noisy:.3g} with truth noise"


@registry.figure("nis", needs={"updates"})
def plot_nis(results: Mapping[str, Result]) -> Figure:
    """Draw NIS per degree of freedom over time for each mode with updates, with each frame's 95 % chi-square bounds."""
    updated = {mode: result for mode, result in results.items() if result.innovation.dof.any()}
    if not updated:
        raise ValueError("no mode has an innovation to show")
    figure = Figure(figsize=(9.0, 0.6 + 2.9 * len(updated)))
    axes = figure.subplots(len(updated), 1, squeeze=False)[:, 0]
    for ax, (mode, result) in zip(axes, updated.items(), strict=True):
        nis, style = series.nis(result), style_of(mode)
        dots = {"color": style["color"], "marker": style["marker"], "markersize": 2.8, "markeredgewidth": 0}
        draw_series(ax, nis, style["color"], {**dots, "linestyle": ""})
        inside = f"{100 * nis.share_inside:.1f} % of {len(nis.y)} frames inside"
        ax.set_title(f"{mode}: {inside}, mean {nis.mean:.3g} (1 expected)")
    share_x(*axes)
    legend = legend_of(figure, axes[:1], 2)
    figure.suptitle(f"{next(iter(results.values())).sequence_name}: normalised innovation squared")
    arrange(figure, bottom=0.5 + legend, top=0.6)
    return figure


@registry.figure("parameters", needs={"parameters"})
def plot_parameters(full: Result) -> Figure:
    """Draw the estimated parameters over time with 3-sigma bands; dashed lines are the 3-sigma bounds of the prior."""
    drawn, color = series.parameters(full), style_of(full.mode)["color"]
    if full.parameters is None or not drawn:
        raise ValueError("there are no parameters to show")
    columns = min(len(drawn), 3)
    rows = -(-len(drawn) // columns)
    figure = Figure(figsize=(3.9 * columns, 0.6 + 2.2 * rows))
    figure.suptitle(f"{full.sequence_name}, {full.mode}: bands of {BAND_SIGMAS:g} sigma; dashed: those of the prior")
    for i, (one, is_observed) in enumerate(zip(drawn, full.parameters.is_observed, strict=True)):
        ax = figure.add_subplot(rows, columns, i + 1)
        draw_series(ax, one, color, {"color": color}, levels=PRIOR)
        title = one.name + ("" if is_observed else " (not observable)")
        ax.set(title=title, xlabel=one.labels[0], ylabel=f"[{one.unit or '-'}]")
    for i in range(columns):
        share_x(*figure.axes[i::columns])
    arrange(figure, left=0.85, top=0.6, gaps=(0.9, 0.35 if len(drawn) % columns == 0 else 0.7))
    return figure


def _range_of(*values: Array) -> tuple[float, float]:
    """Return limits with a margin about all values."""
    low, high = (float(pick([pick(part) for part in values])) for pick in (np.min, np.max))
    margin = 0.08 * (high - low) or 1.0
    return low - margin, high + margin


@registry.figure("inertial_{mode}", needs={"inertial"})
def plot_inertial(result: Result, truth: Truth | None = None) -> Figure:
    """Draw velocity, biases and tilt of an inertial unit over time with 3-sigma bands, and their true values.

    The velocity, and its error if the truth has one, are along the axes of world, the biases along those of the IMU.
    The first tenth, in which wide priors shrink, may leave the picture.
    """
    drawn, color = series.inertial(result, truth), style_of(result.mode)["color"]
    if not drawn:
        raise ValueError("no inertial samples moved the poses")
    rows = len(drawn) // 3
    figure = Figure(figsize=(10.6, 0.8 + 1.75 * rows))
    axes = figure.subplots(rows, 3)
    for ax, (one, true) in zip(axes.ravel(), drawn, strict=True):
        if true is not None:
            draw_series(ax, true, color, TRUTH, label="truth")
        line = {"color": "black", "linewidth": 1.0} if one.levels else line_of(result.mode)
        label = "error" if one.levels else f"{result.mode}, band: {BAND_SIGMAS:g} sigma"
        draw_series(ax, one, color, line, levels=ZERO, label=label)
        later = slice(len(one.y) // 10, None)
        ax.set_ylim(_range_of(*(part[later] for part in (one.y, one.low, one.high) if part is not None)))
    for column in axes.T:
        share_x(*column)
    figure.suptitle(f"{result.sequence_name}, {result.mode}: velocity (world), biases (IMU) and tilt (world)")
    arrange(figure, left=0.95, bottom=0.5 + legend_of(figure, axes[:, 0], 3), top=0.5, gaps=(1.0, 0.15))
    return figure


def draw_figures(
    results: Mapping[str, Result], truth: Truth | None = None, interpolated: BoolArray | None = None
) -> dict[str, Figure]:
    """Draw the registered figures that the results allow, by name.

    ``map`` and ``side`` always, ``errors`` with true poses, ``nis`` with updates, ``parameters`` if ``full`` estimated
    any, ``landmarks_<mode>`` for every mode with a map, ``inertial_<mode>`` for every mode with an inertial unit,
    ``map_before_and_after`` with ``full`` and ``smoothed``.
    """
    figures = {}
    for name, entry in registry.FIGURES.items():
        for some in [{mode: results[mode]} for mode in results] if "{mode}" in name else [results]:
            found = registry.offered(some, truth, interpolated)
            if all(found.get(need) is not None for need in entry.needs):
                figures[name.format(mode=next(iter(some)))] = entry.draw(**{key: found[key] for key in entry.takes})
    return figures


def save_figures(
    directory: str | Path,
    results: Mapping[str, Result],
    truth: Truth | None = None,
    interpolated: BoolArray | None = None,
    format: Format = "png",
    *,
    shown: Path | None = None,
    force: bool = True,
) -> list[Path]:
    """Write the figures of `draw_figures` into a folder, which is made if missing; return their paths.

    The figures name the archive ``shown``, and its older figures of other names are removed.

    Raises:
        WriteError: A figure there shows another archive, and ``force`` is false.
    """
    contents = pngs(directory, draw_figures(results, truth, interpolated), format=format)
    shows = [] if shown is None else [shown]
    if not force:
        require_own(contents, shows)
    stale = [
        path for path in pictures_of(shows, Path(directory)) if path.suffix == f".{format}" and _is_drawn(path.stem)
    ]
    files.write_all(marked(contents, shows))
    remove_figures(stale, contents)
    return list(contents)


def _is_drawn(stem: str) -> bool:
    """Return whether a name is that of a registered figure, whatever the mode."""
    return any(fnmatchcase(stem, name.replace("{mode}", "*")) for name in registry.FIGURES)
