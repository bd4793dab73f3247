"""Figures of runs against time: errors, innovation consistency, estimated parameters; and the files of a whole run.

As in `ekfslam.figures.maps`, every function returns a `matplotlib.figure.Figure` and touches no global state.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from ekfslam.arrays import Array, BoolArray
from ekfslam.data.sequence import Truth
from ekfslam.evaluation.consistency import (
    chi2_bounds,
    measured_truth,
    pose_nees,
    world_axes_errors,
    world_axes_std,
)
from ekfslam.figures.maps import plot_landmark_arrows, plot_map, plot_side
from ekfslam.figures.style import (
    BAND_ALPHA,
    BOUNDS,
    EXPECTED,
    PRIOR,
    ZERO,
    Format,
    log_axis,
    save_all,
    style_of,
    styled,
)
from ekfslam.figures.style import save_figure as save_figure  # one of `save_figures` by itself
from ekfslam.filters.result import Result
from ekfslam.geometry.motion import world_axes_covariance

_BAND_SIGMAS = 3.0
_IN_DEGREES = np.repeat([1.0, np.rad2deg(1.0)], 3)  # of three positions and three rotations
_NIS_PROBABILITY = 0.95
_LOG_RATIO = 20.0  # largest over smallest NIS per dof from which a logarithmic axis shows more


def world_error_covariance(result: Result) -> tuple[Array, Array]:
    """`world_axes_covariance` of a result: (T, 3, 3) m^2 and (T, 3, 3) rad^2."""
    return world_axes_covariance(result.T_world_imu, result.covariance)


@styled
def plot_errors(results: Mapping[str, Result], truth: Truth, interpolated: BoolArray | None = None) -> Figure:
    """Estimate minus truth against time, world axes: position (m) and rotation (degrees) with 3-sigma bands.

    One column a mode, each on its own scale, so that a small error stays legible beside a large one. Modes that share
    their trajectory (mapping-only and dead reckoning) share a column. NEES is of the frames that no ``interpolated``
    interval (T,) leads to.
    """
    columns: dict[str, Result] = {}
    for mode, result in results.items():
        twin = next((m for m, r in columns.items() if np.array_equal(r.T_world_imu, result.T_world_imu)), None)
        if twin is None:
            columns[mode] = result
        else:
            columns[f"{twin}, {mode}"] = columns.pop(twin)
    figure = Figure(figsize=(4.4 * len(columns) + 0.4, 8.8))
    axes = figure.subplots(6, len(columns), sharex=True, squeeze=False)
    for column, (title, result) in zip(axes.T, columns.items(), strict=True):
        color = style_of(result.mode)["color"]
        T_est, time_s = result.T_world_imu[truth.frame], result.time_s - result.time_s[0]
        errors = _IN_DEGREES * world_axes_errors(T_est, truth.T_world_imu)
        bands = _BAND_SIGMAS * _IN_DEGREES * world_axes_std(result.T_world_imu, result.covariance)
        for i, ax in enumerate(column):
            ax.fill_between(time_s, -bands[:, i], bands[:, i], color=color, alpha=BAND_ALPHA, linewidth=0)
            for side in (-1, 1):
                ax.plot(time_s, side * bands[:, i], color=color, linewidth=0.6)
            ax.plot(time_s[truth.frame], errors[:, i], color="black", linewidth=1.0)
            ax.axhline(0.0, **ZERO, zorder=1)
            kind, unit = ("position", "m") if i < 3 else ("rotation", "deg")
            ax.set_ylabel(f"{kind} {'xyz'[i % 3]} [{unit}]")
            ax.margins(x=0.01)
        inside = np.mean(np.abs(errors) <= bands[truth.frame])
        judged = truth if interpolated is None else measured_truth(truth, interpolated, result.time_s)
        nees = _nees_words(result, judged)
        column[0].set_title(f"{title}\n{100 * inside:.1f} % inside {_BAND_SIGMAS:g} sigma{nees}")
        column[-1].set_xlabel("time [s]")
    figure.align_ylabels()
    figure.suptitle(f"{next(iter(results.values())).sequence_name}: estimate minus truth, world axes")
    return figure


def _nees_words(result: Result, truth: Truth) -> str:
    """Mean pose NEES for a title, with truth noise besides where some is stated."""
    exact, noisy = (pose_nees(result, truth, with_noise)[1] for with_noise in (False, True))
    if not np.isfinite(exact).any():
        return ""
    words = f", mean NEES {np.nanmean(exact):.3g} (6 expected)"
    return words if truth.noise is None else f"{words}, {np.nanmean(noisy):.3g} with truth noise"


@styled
def plot_nis(results: Mapping[str, Result]) -> Figure:
    """NIS per degree of freedom against time for each mode with updates, with each frame's 95 % chi-square bounds.

    Raises:
        ValueError: No mode has an update.
    """
    updated = {mode: result for mode, result in results.items() if result.innovation.dof.any()}
    if not updated:
        raise ValueError("no mode has an innovation to show")
    figure = Figure(figsize=(9.0, 0.6 + 2.9 * len(updated)))
    axes = figure.subplots(len(updated), 1, sharex=True, squeeze=False)[:, 0]
    for ax, (mode, result) in zip(axes, updated.items(), strict=True):
        seen = result.innovation.dof > 0
        time_s, dof = (result.time_s - result.time_s[0])[seen], result.innovation.dof[seen]
        ratio = result.innovation.nis[seen] / dof
        low, high = (bound / dof for bound in chi2_bounds(dof, _NIS_PROBABILITY))
        style = style_of(mode)
        bounds_label = f"{100 * _NIS_PROBABILITY:g} % chi-square bounds"
        bounds = ax.fill_between(time_s, low, high, step="mid", **BOUNDS, label=bounds_label)
        expected = ax.axhline(1.0, **EXPECTED, label="expected mean")
        ax.plot(time_s, ratio, style["marker"], color=style["color"], markersize=2.8, markeredgewidth=0)
        if ratio.max() > _LOG_RATIO * ratio.min():
            log_axis(ax, (1.0, 2.0, 5.0))
        ax.margins(x=0.01)
        ax.set_ylabel("NIS per dof [-]")
        inside = np.mean((ratio >= low) & (ratio <= high))
        mean = result.innovation.nis.sum() / result.innovation.dof.sum()
        ax.set_title(f"{mode}: {100 * inside:.1f} % of {seen.sum()} frames inside, mean {mean:.3g} (1 expected)")
    figure.legend(handles=[bounds, expected], loc="outside lower center", ncols=2)
    axes[-1].set_xlabel("time [s]")
    figure.suptitle(f"{next(iter(results.values())).sequence_name}: normalised innovation squared")
    return figure


@styled
def plot_parameters(result: Result) -> Figure:
    """What was estimated besides poses and map (calibration, roll and pitch) against time, with bands of 3 sigma.

    Dashed lines bound what was known before: where the band still fills them at the end, nothing was observed.

    Raises:
        ValueError: Nothing of the kind was estimated.
    """
    parameters = result.parameters
    if parameters is None:
        raise ValueError("there are no parameters to show")
    count = len(parameters.name)
    columns = min(count, 3)
    rows = -(-count // columns)
    figure = Figure(figsize=(3.6 * columns, 0.6 + 2.2 * rows))
    axes = figure.subplots(rows, columns, sharex=True, squeeze=False).ravel()
    time_s = result.time_s - result.time_s[0]
    for i, ax in enumerate(axes[:count]):
        unit, factor = ("deg", np.rad2deg(1.0)) if parameters.unit[i] == "rad" else (parameters.unit[i], 1.0)
        value, band = factor * parameters.value[:, i], factor * _BAND_SIGMAS * parameters.std[:, i]
        color = style_of(result.mode)["color"]
        ax.fill_between(time_s, value - band, value + band, color=color, alpha=BAND_ALPHA, linewidth=0)
        ax.plot(time_s, value, color=color)
        for sign in (-1.0, 1.0):
            ax.axhline(sign * factor * _BAND_SIGMAS * parameters.prior_std[i], **PRIOR)
        ax.set_title(parameters.name[i] + ("" if parameters.is_observed[i] else " (not observable)"))
        ax.set_ylabel(f"[{'-' if unit == '1' else unit}]")
        ax.margins(x=0.01)
    for ax in axes[count:]:
        ax.set_visible(False)
    for ax in axes[max(count - columns, 0) : count]:
        ax.tick_params(labelbottom=True)
        ax.set_xlabel("time [s]")
    return figure


def draw_figures(
    results: Mapping[str, Result], truth: Truth | None = None, interpolated: BoolArray | None = None
) -> dict[str, Figure]:
    """The figures that the results allow, by name.

    ``map`` and ``side`` always, ``errors`` with true poses, ``nis`` with updates, ``parameters`` where more than
    poses and map was estimated, ``landmarks_<mode>`` for every mode with a map.
    """
    figures = {"map": plot_map(results, truth), "side": plot_side(results, truth)}
    if truth is not None and len(truth.frame):
        figures["errors"] = plot_errors(results, truth, interpolated)
    if any(result.innovation.dof.any() for result in results.values()):
        figures["nis"] = plot_nis(results)
    for mode, result in results.items():
        if mode == "full" and result.parameters is not None:
            figures["parameters"] = plot_parameters(result)
        if len(result.landmarks):
            figures[f"landmarks_{mode}"] = plot_landmark_arrows(result, truth)
    return figures


def save_figures(
    directory: str | Path,
    results: Mapping[str, Result],
    truth: Truth | None = None,
    interpolated: BoolArray | None = None,
    format: Format = "png",
) -> list[Path]:
    """Write the figures of `draw_figures` into a folder, made if missing; the paths written."""
    return save_all(directory, draw_figures(results, truth, interpolated), format=format)
