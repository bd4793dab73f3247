"""Figures of results: map, errors against truth, innovation consistency, landmark corrections, trajectories.

Every function returns a `matplotlib.figure.Figure` and touches no global state, so it works without a display and
from any thread. Modes keep one colour, line style and marker throughout (Okabe-Ito colours, legible in grey).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import wraps
from io import BytesIO
from pathlib import Path
from typing import Any, ParamSpec

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray
from PIL import Image

from ekfslam.arrays import Array, IntArray
from ekfslam.data.sequence import Truth
from ekfslam.evaluation.consistency import chi2_bounds, pose_nees, world_axes_covariance
from ekfslam.filters.result import Result
from ekfslam.geometry import se3

DPI = 150

STYLE: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.labelsize": 9.0,
    "legend.fontsize": 8.0,
    "axes.grid": True,
    "grid.color": "0.88",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.framealpha": 0.9,
    "lines.linewidth": 1.4,
    "lines.markersize": 4.5,
    "figure.constrained_layout.use": True,
}

MODE_STYLES: dict[str, dict[str, Any]] = {
    "full": {"color": "#0072B2", "linestyle": "-", "marker": "o"},
    "dead-reckoning": {"color": "#D55E00", "linestyle": "--", "marker": "^"},
    "mapping-only": {"color": "#009E73", "linestyle": ":", "marker": "s"},
    "smoothed": {"color": "#CC79A7", "linestyle": "-.", "marker": "D"},
}
_OTHER_STYLE: dict[str, Any] = {"color": "#56B4E9", "linestyle": "-.", "marker": "v"}
_TRUTH_STYLE: dict[str, Any] = {"color": "black", "linestyle": "-", "linewidth": 2.2}
_LANDMARK_COLOR = "#8A5A00"

_MARKS = 10  # markers and pose ellipses along a trajectory
_SIGMAS = 2.0  # of map ellipses
_BAND_SIGMAS = 3.0  # of error bands
_NIS_PROBABILITY = 0.95
_LOG_RATIO = 20.0  # largest over smallest NIS per dof from which a logarithmic axis shows more

P = ParamSpec("P")


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Decorator: draw in this package's `STYLE`, whatever the caller's own is."""

    @wraps(draw)
    def drawn(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with mpl.rc_context(STYLE):
            return draw(*args, **kwargs)

    return drawn


def ellipse_axes(covariance: Array, sigmas: float) -> tuple[Array, Array, Array]:
    """Ellipse ``e^T P^-1 e = sigmas^2`` of 2x2 covariances (..., 2, 2): full axes and direction of the longer one.

    Returns:
        Length of the longer axis, length of the shorter one (...), in the unit of the deviations, and the angle of the
        longer one from x in degrees (...).
    """
    values, vectors = np.linalg.eigh(covariance)
    lengths = 2.0 * sigmas * np.sqrt(np.maximum(values, 0.0))
    angle = np.degrees(np.arctan2(vectors[..., 1, 1], vectors[..., 0, 1]))
    return lengths[..., 1], lengths[..., 0], angle


def world_error_covariance(result: Result) -> tuple[Array, Array]:
    """`world_axes_covariance` of a result: (T, 3, 3) m^2 and (T, 3, 3) rad^2."""
    return world_axes_covariance(result.T_world_imu, result.covariance)


@styled
def plot_map(results: Mapping[str, Result], truth: Truth | None = None) -> Figure:
    """Map from above (x, y of world, metres): trajectories of all modes, landmarks and poses with 2-sigma ellipses.

    Landmarks are those of the full mode, or of the last mode that has any. The view follows trajectories and the bulk
    of the landmarks; the legend says how many landmarks lie outside it. Ellipses longer than a tenth (poses:
    half) of the view's diagonal are left out; the legend says of how many landmarks.
    """
    mapper = _mapper(results)
    paths = [result.T_world_imu[:, :2, 3] for result in results.values()]
    if truth is not None and len(truth.frame):
        paths.append(truth.T_world_imu[:, :2, 3])
    landmarks = mapper.landmarks
    points = landmarks.position_m[:, :2]
    ax, outside = _top_down_axes(np.concatenate(paths), points)
    if len(landmarks):
        # The more there are, the fainter, or a dense map would be one blot.
        alpha = float(np.clip(20.0 / np.sqrt(len(landmarks)), 0.15, 0.8))
        left_out = _add_ellipses(ax, points, landmarks.covariance[:, :2, :2], _LANDMARK_COLOR, alpha, 0.5, share=0.1)
        uncertain = f", {left_out} without ellipse" if left_out else ""
        label = f"{len(landmarks)} landmarks ({mapper.mode}{_outside_text(outside)}{uncertain})"
        size = _dot_size(len(landmarks))
        ax.plot(*points.T, ".", color=_LANDMARK_COLOR, markersize=size, markeredgewidth=0, label=label, zorder=1.5)
    _draw_paths(ax, results, truth)
    for mode, result in results.items():
        some = _spread(len(result.time_s), _MARKS)
        position_covariance = world_error_covariance(result)[0][some, :2, :2]
        color, xy = _mode_style(mode)["color"], result.T_world_imu[some, :2, 3]
        _add_ellipses(ax, xy, position_covariance, color, 1.0, 1.0, share=0.5)
    _outside_legend(ax)
    ax.set_title(f"{mapper.sequence_name}: map from above, {_SIGMAS:g}-sigma ellipses")
    return _figure_of(ax)


@styled
def plot_trajectories(results: Mapping[str, Result], truth: Truth | None = None) -> Figure:
    """Trajectories from above (x, y of world, metres), with the direction of the IMU's x axis at start and end."""
    paths = {mode: result.T_world_imu for mode, result in results.items()}
    if truth is not None and len(truth.frame):
        paths["truth"] = truth.T_world_imu
    ax, _ = _top_down_axes(np.concatenate([T[:, :2, 3] for T in paths.values()]), np.empty((0, 2)))
    _draw_paths(ax, results, truth)
    for name, T in paths.items():
        ends = T[[0, -1]]
        arrows = ax.quiver(
            *ends[:, :2, 3].T,
            *ends[:, :2, 0].T,
            color="black" if name == "truth" else _mode_style(name)["color"],
            angles="xy",
            scale=18,
            width=0.005,
            zorder=4,
            clip_on=False,
        )
        arrows.set_in_layout(False)
    _outside_legend(ax)
    ax.set_title(f"{_first(results).sequence_name}\ntrajectories from above, arrows along the IMU's x axis")
    return _figure_of(ax)


@styled
def plot_errors(results: Mapping[str, Result], truth: Truth) -> Figure:
    """Estimate minus truth against time, world axes: position (m) and rotation (degrees) with 3-sigma bands.

    One column a mode, each on its own scale, so that a small error stays legible beside a large one. Modes that share
    their trajectory (mapping-only and dead reckoning) share a column.
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
        style = _mode_style(result.mode)
        T_est, time_s = result.T_world_imu[truth.frame], result.time_s - result.time_s[0]
        position = T_est[:, :3, 3] - truth.T_world_imu[:, :3, 3]
        rotation = se3.so3_log(T_est[:, :3, :3] @ np.swapaxes(truth.T_world_imu[:, :3, :3], 1, 2))
        errors = np.hstack([position, np.degrees(rotation)])
        position_std, rotation_std = (np.sqrt(np.diagonal(c, axis1=1, axis2=2)) for c in world_error_covariance(result))
        bands = _BAND_SIGMAS * np.hstack([position_std, np.degrees(rotation_std)])
        for i, ax in enumerate(column):
            ax.fill_between(time_s, -bands[:, i], bands[:, i], color=style["color"], alpha=0.18, linewidth=0)
            for side in (-1, 1):
                ax.plot(time_s, side * bands[:, i], color=style["color"], linewidth=0.6)
            ax.plot(time_s[truth.frame], errors[:, i], color="black", linewidth=1.0)
            ax.axhline(0.0, color="0.5", linewidth=0.6, zorder=1)
            kind, unit = ("position", "m") if i < 3 else ("rotation", "deg")
            ax.set_ylabel(f"{kind} {'xyz'[i % 3]} [{unit}]")
            ax.margins(x=0.01)
        inside = np.mean(np.abs(errors) <= bands[truth.frame])
        _, values = pose_nees(result, truth)
        nees = f", mean NEES {np.nanmean(values):.3g} (6 expected)" if np.isfinite(values).any() else ""
        column[0].set_title(f"{title}\n{100 * inside:.1f} % inside {_BAND_SIGMAS:g} sigma{nees}")
        column[-1].set_xlabel("time [s]")
    figure.align_ylabels()
    figure.suptitle(f"{_first(results).sequence_name}: estimate minus truth, world axes")
    return figure


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
        style = _mode_style(mode)
        bounds_label = f"{100 * _NIS_PROBABILITY:g} % chi-square bounds"
        bounds = ax.fill_between(time_s, low, high, step="mid", color="0.85", linewidth=0, label=bounds_label)
        expected = ax.axhline(1.0, color="black", linewidth=0.8, label="expected mean")
        ax.plot(time_s, ratio, style["marker"], color=style["color"], markersize=2.8, markeredgewidth=0)
        if ratio.max() > _LOG_RATIO * ratio.min():
            ax.set_yscale("log")
            ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            ax.yaxis.set_major_formatter(FormatStrFormatter("%g"))
            ax.yaxis.set_minor_formatter(NullFormatter())
        ax.margins(x=0.01)
        ax.set_ylabel("NIS per dof [-]")
        inside = np.mean((ratio >= low) & (ratio <= high))
        mean = result.innovation.nis.sum() / result.innovation.dof.sum()
        ax.set_title(f"{mode}: {100 * inside:.1f} % of {seen.sum()} frames inside, mean {mean:.3g} (1 expected)")
    figure.legend(handles=[bounds, expected], loc="outside lower center", ncols=2)
    axes[-1].set_xlabel("time [s]")
    figure.suptitle(f"{_first(results).sequence_name}: normalised innovation squared")
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
        color = _mode_style(result.mode)["color"]
        ax.fill_between(time_s, value - band, value + band, color=color, alpha=0.25, linewidth=0)
        ax.plot(time_s, value, color=color)
        for sign in (-1.0, 1.0):
            bound = sign * factor * _BAND_SIGMAS * parameters.prior_std[i]
            ax.axhline(bound, color="0.3", linestyle="--", linewidth=0.8)
        ax.set_title(parameters.name[i] + ("" if parameters.is_observed[i] else " (not observable)"))
        ax.set_ylabel(f"[{'-' if unit == '1' else unit}]")
        ax.margins(x=0.01)
    for ax in axes[count:]:
        ax.set_visible(False)
    for ax in axes[max(count - columns, 0) : count]:
        ax.tick_params(labelbottom=True)
        ax.set_xlabel("time [s]")
    return figure


@styled
def plot_landmark_arrows(result: Result, truth: Truth | None = None) -> Figure:
    """Landmarks from above (x, y of world, metres): from first triangulation to final estimate, over the trajectory.

    The view follows trajectory and the bulk of the final landmarks; the legend says how many lie outside it.
    """
    landmarks = result.landmarks
    start, end = landmarks.initial_position_m[:, :2], landmarks.position_m[:, :2]
    path = result.T_world_imu[:, :2, 3]
    ax, outside = _top_down_axes(path, end)
    color, dot = _mode_style(result.mode)["color"], _dot_size(len(landmarks))
    arrows = np.stack([start, end], axis=1)[~outside]
    ax.add_collection(LineCollection(list(arrows), colors=color, linewidths=0.5, alpha=0.6), autolim=False)
    ax.plot(*start.T, ".", color="#E69F00", markersize=dot, markeredgewidth=0, label="initial", zorder=2.5)
    label = f"final ({len(landmarks)} landmarks{_outside_text(outside)})"
    ax.plot(*end.T, ".", color=color, markersize=dot, markeredgewidth=0, label=label, zorder=3)
    if truth is not None and len(truth.frame):
        ax.plot(*truth.T_world_imu[:, :2, 3].T, **_TRUTH_STYLE, label="truth", zorder=2.2)
    ax.plot(*path.T, color="0.6", linewidth=1.2, label="trajectory", zorder=2.3)
    _outside_legend(ax)
    ax.set_title(f"{result.sequence_name}, {result.mode}\nlandmarks from first to final estimate")
    return _figure_of(ax)


def save_figures(directory: str | Path, results: Mapping[str, Result], truth: Truth | None = None) -> list[Path]:
    """Write the figures that the results allow as PNG into a folder, made if missing; the paths written.

    ``map.png`` always, ``errors.png`` with true poses, ``nis.png`` with updates, ``parameters.png`` where more than
    poses and map was estimated, ``landmarks_<mode>.png`` for every mode with a map.
    """
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    figures = {"map": plot_map(results, truth)}
    if truth is not None and len(truth.frame):
        figures["errors"] = plot_errors(results, truth)
    if any(result.innovation.dof.any() for result in results.values()):
        figures["nis"] = plot_nis(results)
    for mode, result in results.items():
        if mode == "full" and result.parameters is not None:
            figures["parameters"] = plot_parameters(result)
        if len(result.landmarks):
            figures[f"landmarks_{mode}"] = plot_landmark_arrows(result, truth)
    paths = []
    for name, figure in figures.items():
        paths.append(directory / f"{name}.png")
        save_figure(figure, paths[-1])
    return paths


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure with a palette of 256 colours: a third of the size or less, without a visible difference."""
    # The default median cut sacrifices rare colours, here a thin trajectory; this method keeps all within 15 of 255.
    buffer = BytesIO()
    figure.savefig(buffer, dpi=DPI)
    Image.open(buffer).convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE).save(
        path, dpi=(DPI, DPI), optimize=True
    )


def _mode_style(mode: str) -> dict[str, Any]:
    return MODE_STYLES.get(mode, _OTHER_STYLE)


def _first(results: Mapping[str, Result]) -> Result:
    return next(iter(results.values()))


def _mapper(results: Mapping[str, Result]) -> Result:
    """The result whose map is shown: full, else the last one with landmarks, else any."""
    with_map = [result for result in results.values() if len(result.landmarks)]
    return results.get("full") or (with_map or list(results.values()))[-1]


def _figure_of(ax: Axes) -> Figure:
    figure = ax.get_figure()
    assert isinstance(figure, Figure)
    return figure


def _spread(length: int, count: int) -> IntArray:
    """At most ``count`` indices spread over ``length``, first and last included."""
    return np.unique(np.linspace(0, length - 1, count).astype(int))


def _top_down_axes(path: Array, points: Array) -> tuple[Axes, NDArray[np.bool_]]:
    """Equal-aspect axes of a new figure around all of path and the bulk of points, and which points are outside."""
    bulk = np.percentile(points, [2, 98], axis=0) if len(points) else path[:0]
    shown = np.concatenate([path, bulk])
    low, high = shown.min(axis=0), shown.max(axis=0)
    # A straight or standing trajectory must not make an infinitely thin picture.
    margin = 0.05 * (high - low) + 0.02 * (high - low).max() + 1e-3
    low, high = low - margin, high + margin
    outside = np.any((points < low) | (points > high), axis=1)
    aspect = (high[1] - low[1]) / (high[0] - low[0])
    width = min(8.0, 7.0 / aspect)
    # Room for labels, title and legend around axes of the right shape.
    ax = Figure(figsize=(max(width + 0.8, 6.0), max(width * aspect, 1.5) + 2.2)).subplots()
    ax.set_aspect("equal", adjustable="box")
    ax.set_xlim(low[0], high[0])
    ax.set_ylim(low[1], high[1])
    ax.set_autoscale_on(False)
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    return ax, outside


def _draw_paths(ax: Axes, results: Mapping[str, Result], truth: Truth | None) -> None:
    """Truth and the modes' positions with marks; start as a circle, end as a cross."""
    if truth is not None and len(truth.frame):
        ax.plot(*truth.T_world_imu[:, :2, 3].T, **_TRUTH_STYLE, label="truth")
    for i, (mode, result) in enumerate(results.items()):
        style, xy = _mode_style(mode), result.T_world_imu[:, :2, 3]
        # Shifted marks keep modes apart that lie on one another.
        step = max(len(xy) // _MARKS, 1)
        ax.plot(*xy.T, **style, markevery=(i * step // len(results), step), label=mode, zorder=3)
        ax.plot(*xy[-1], "X", color=style["color"], markeredgecolor="black", markersize=8, zorder=5)
    ax.plot(*_first(results).T_world_imu[0, :2, 3], "o", color="white", markeredgecolor="black", markersize=8, zorder=5)


def _add_ellipses(
    ax: Axes, centres: Array, covariance: Array, color: str, alpha: float, linewidth: float, *, share: float
) -> int:
    """Draw covariances (n, 2, 2), not those longer than ``share`` of the view's diagonal; the number left out."""
    long, short, angle = ellipse_axes(covariance, _SIGMAS)
    # Ellipses that hardly fit into the view are no more than lines across everything else.
    fits = long <= share * np.hypot(np.ptp(ax.get_xlim()), np.ptp(ax.get_ylim()))
    ellipses = EllipseCollection(
        long[fits],
        short[fits],
        angle[fits],
        units="xy",
        offsets=centres[fits],
        offset_transform=ax.transData,
        facecolors="none",
        edgecolors=color,
        alpha=alpha,
        linewidths=linewidth,
    )
    ax.add_collection(ellipses, autolim=False)
    return int((~fits).sum())


def _dot_size(count: int) -> float:
    """Diameter in points at which ``count`` dots still show as dots."""
    return float(np.clip(100.0 / np.sqrt(max(count, 1)), 1.2, 4.0))


def _outside_text(outside: NDArray[np.bool_]) -> str:
    return f", {outside.sum()} outside the view" if outside.any() else ""


def _outside_legend(ax: Axes) -> None:
    """Legend below the axes, where it hides no data, with the marks of start and end where they are drawn."""
    handles, _ = ax.get_legend_handles_labels()
    if any(line.get_marker() == "X" for line in ax.lines):
        for marker, label in (("o", "start"), ("X", "end")):
            mark = Line2D([], [], marker=marker, color="white", markeredgecolor="black", linestyle="", label=label)
            handles.append(mark)
    figure = _figure_of(ax)
    columns = 3 if figure.get_figwidth() > 7.0 else 2
    legend = figure.legend(handles=handles, loc="outside lower center", ncols=columns)
    for handle in legend.legend_handles:
        if isinstance(handle, Line2D) and handle.get_marker() == ".":
            handle.set_markersize(8.0)  # dots small enough for a map of thousands are invisible in a legend
