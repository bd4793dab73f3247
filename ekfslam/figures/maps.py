"""Maps: from above with ellipses, from the side, trajectories, and how far landmarks moved.

Every function returns a `matplotlib.figure.Figure` and touches no global state, so it works without a display and
from any thread. Colours and lines are those of `ekfslam.figures.style`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.data.sequence import Truth
from ekfslam.evaluation.trajectory import distance_along
from ekfslam.figures import registry
from ekfslam.figures.series import BAND_SIGMAS, draw_series, height
from ekfslam.figures.style import FIRST_LANDMARK_COLOR, LANDMARK_COLOR, TRUTH, line_of, style_of
from ekfslam.filters.result import Result
from ekfslam.geometry.motion import world_axes_covariance

SIGMAS = 2.0  # of ellipses

_MARKS = 10  # markers, pose ellipses and arrows along a trajectory
_ELLIPSES = 400  # of landmarks on a map; more are one blot
_HELD = f"{100 * (1 - np.exp(-(SIGMAS**2) / 2)):.0f} %"  # of a Gaussian in the plane, within an ellipse


def ellipse_axes(covariance: Array, sigmas: float) -> tuple[Array, Array, Array]:
    """Return axes and direction of the ellipse ``e^T P^-1 e = sigmas^2`` of covariances (..., 2, 2).

    Returns:
        Length of the longer axis and of the shorter one (...), in the unit of the standard deviations, and the angle
        of the longer one from x in degrees (...).
    """
    values, vectors = np.linalg.eigh(covariance)
    lengths = 2.0 * sigmas * np.sqrt(np.maximum(values, 0.0))
    angle = np.degrees(np.arctan2(vectors[..., 1, 1], vectors[..., 0, 1]))
    return lengths[..., 1], lengths[..., 0], angle


@registry.figure("map")
def plot_map(results: Mapping[str, Result], truth: Truth | None = None) -> Figure:
    """Draw the map from above (x, y of world, metres): trajectories, landmarks and poses with 2-sigma ellipses.

    Landmarks are those of the full mode, or of the last mode that has any. The view follows trajectories and the bulk
    of the landmarks; the legend says how many landmarks lie outside it. Ellipses longer than a tenth (poses:
    half) of the view's diagonal are left out, and of more than 400 landmarks all but 400; the legend says so. Arrows
    are along the IMU's x axis.
    """
    mapper = map_of(results)
    paths = [result.T_world_imu[:, :2, 3] for result in results.values()]
    if truth is not None and len(truth.frame):
        paths.append(truth.T_world_imu[:, :2, 3])
    landmarks = mapper.landmarks
    points = landmarks.position_m[:, :2]
    ax, outside = map_axes(np.concatenate(paths), points)
    if len(landmarks):
        # The more there are, the fainter, or a dense map would be one blot.
        alpha = float(np.clip(20.0 / np.sqrt(len(landmarks)), 0.5, 0.8))
        some = spread(len(landmarks), _ELLIPSES)
        covariance = landmarks.covariance[some, :2, :2]
        left_out = add_ellipses(ax, points[some], covariance, LANDMARK_COLOR, alpha, 0.6, share=0.1)
        left_out += len(landmarks) - len(some)
        uncertain = f", {left_out} without ellipse" if left_out else ""
        label = f"{len(landmarks)} landmarks ({mapper.mode}{_outside_text(outside)}{uncertain})"
        size = dot_size(len(landmarks))
        ax.plot(*points.T, ".", color=LANDMARK_COLOR, markersize=size, markeredgewidth=0, label=label, zorder=1.5)
    draw_paths(ax, results, truth)
    for mode, result in results.items():
        some = spread(len(result.time_s), _MARKS)
        covariance, _ = world_axes_covariance(result.T_world_imu[some], result.covariance[some])
        color, xy = style_of(mode)["color"], result.T_world_imu[some, :2, 3]
        add_ellipses(ax, xy, covariance[:, :2, :2], color, 1.0, 1.0, share=0.5)
        _add_arrows(ax, result.T_world_imu[some], color)
    _outside_legend(ax)
    drawn = f"{SIGMAS:g}-sigma ellipses ({_HELD} of a Gaussian), arrows along the IMU's x axis"
    ax.set_title(f"{mapper.sequence_name}: map from above\n{drawn}")
    return _figure_of(ax)


@registry.figure("landmarks_{mode}", needs={"landmarks"})
def plot_landmark_arrows(result: Result, truth: Truth | None = None) -> Figure:
    """Draw landmarks from above (x, y of world, metres): from initialisation to final estimate, over the trajectory.

    The view follows trajectory and the bulk of the final landmarks; the legend says how many lie outside it.
    """
    landmarks = result.landmarks
    start, end = landmarks.initial_position_m[:, :2], landmarks.position_m[:, :2]
    path = result.T_world_imu[:, :2, 3]
    ax, outside = map_axes(path, end)
    dot = dot_size(len(landmarks))
    arrows = np.stack([start, end], axis=1)[~outside]
    ax.add_collection(LineCollection(list(arrows), colors=LANDMARK_COLOR, linewidths=0.5, alpha=0.6), autolim=False)
    ax.plot(*start.T, ".", color=FIRST_LANDMARK_COLOR, markersize=dot, markeredgewidth=0, label="initial", zorder=2.5)
    label = f"final ({len(landmarks)} landmarks{_outside_text(outside)})"
    ax.plot(*end.T, ".", color=LANDMARK_COLOR, markersize=dot, markeredgewidth=0, label=label, zorder=3)
    if truth is not None and len(truth.frame):
        ax.plot(*truth.T_world_imu[:, :2, 3].T, **TRUTH, label="truth", zorder=2.2)
    ax.plot(*path.T, **line_of(result.mode), label="trajectory", zorder=2.3)
    _outside_legend(ax)
    ax.set_title(f"{result.sequence_name}, {result.mode}\nlandmarks from initialisation to final estimate")
    return _figure_of(ax)


@registry.figure("side")
def plot_side(results: Mapping[str, Result], truth: Truth | None = None) -> Figure:
    """Draw the drive from the side: height z of world over the distance driven, metres, with 3-sigma bands.

    Landmarks are those of the map from above. Each stands at the distance at which it was seen last. The view shows
    the trajectories and the bulk of the landmarks.
    """
    mapper, figure = map_of(results), Figure(figsize=(9.0, 4.2))
    ax = figure.subplots()
    landmarks, way = mapper.landmarks, distance_along(mapper.T_world_imu)
    heights = [result.T_world_imu[:, 2, 3] for result in results.values()]
    if len(landmarks):
        z, size = landmarks.position_m[:, 2], dot_size(len(landmarks))
        label = f"{len(landmarks)} landmarks ({mapper.mode}), where seen last"
        dots: dict[str, Any] = {"color": LANDMARK_COLOR, "markersize": size, "markeredgewidth": 0, "alpha": 0.6}
        ax.plot(way[landmarks.last_frame], z, ".", **dots, label=label, zorder=1.5)
        heights.append(np.percentile(z, [2, 98]))
    if truth is not None and len(truth.frame):
        true = height(truth.T_world_imu)
        draw_series(ax, true, "", {**TRUTH, "zorder": 2}, label="truth")
        heights.append(true.y)
    for mode, result in results.items():
        line = line_of(mode)
        one = height(result.T_world_imu, result.covariance)
        draw_series(ax, one, line["color"], {**line, "zorder": 3}, label=mode)
    low, high = min(z.min() for z in heights), max(z.max() for z in heights)
    margin = 0.06 * (high - low) + 0.05
    ax.set_ylim(low - margin, high + margin)
    _outside_legend(ax)
    ax.set_title(f"{mapper.sequence_name}: from the side, {BAND_SIGMAS:g}-sigma bands")
    return figure


def _add_arrows(ax: Axes, T_world_imu: Array, color: str) -> None:
    """Draw arrows along the IMU's x axis, seen from above, at poses (n, 4, 4)."""
    at, along = T_world_imu[:, :2, 3], T_world_imu[:, :2, 0]
    size: dict[str, Any] = {"units": "inches", "scale_units": "inches", "scale": 1 / 0.28, "width": 0.022}
    arrows = ax.quiver(*at.T, *along.T, color=color, angles="xy", zorder=4, clip_on=False, **size)
    arrows.set_in_layout(False)


def map_of(results: Mapping[str, Result]) -> Result:
    """Return the result whose map is shown: full, else the last one with landmarks, else the last."""
    with_map = [result for result in results.values() if len(result.landmarks)]
    return results.get("full") or (with_map or list(results.values()))[-1]


def _figure_of(ax: Axes) -> Figure:
    figure = ax.get_figure()
    assert isinstance(figure, Figure)
    return figure


def spread(length: int, count: int) -> IntArray:
    """Return at most ``count`` indices spread over ``length``, first and last included."""
    return np.unique(np.linspace(0, length - 1, count).astype(int))


def map_axes(path: Array, points: Array) -> tuple[Axes, BoolArray]:
    """Return equal-aspect axes of a new figure around a path and the bulk of points, and a mask of points outside."""
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


def draw_paths(ax: Axes, results: Mapping[str, Result], truth: Truth | None) -> None:
    """Draw the paths of truth and modes with marks; start as a circle, end as a cross."""
    if truth is not None and len(truth.frame):
        ax.plot(*truth.T_world_imu[:, :2, 3].T, **TRUTH, label="truth")
    for i, (mode, result) in enumerate(results.items()):
        style, xy = style_of(mode), result.T_world_imu[:, :2, 3]
        # Shifted marks keep modes apart that lie on one another.
        step = max(len(xy) // _MARKS, 1)
        ax.plot(*xy.T, **style, markevery=(i * step // len(results), step), label=mode, zorder=3)
        ax.plot(*xy[-1], "X", color=style["color"], markeredgecolor="black", markersize=8, zorder=5)
    start = next(iter(results.values())).T_world_imu[0, :2, 3]
    ax.plot(*start, "o", color="white", markeredgecolor="black", markersize=8, zorder=5)


def add_ellipses(
    ax: Axes, centres: Array, covariance: Array, color: str, alpha: float, linewidth: float, *, share: float
) -> int:
    """Draw covariances (n, 2, 2), not those longer than ``share`` of the view's diagonal; the number left out."""
    long, short, angle = ellipse_axes(covariance, SIGMAS)
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


def dot_size(count: int) -> float:
    """Return the diameter in points at which ``count`` dots remain legible."""
    return float(np.clip(100.0 / np.sqrt(max(count, 1)), 1.2, 4.0))


def _outside_text(outside: BoolArray) -> str:
    return f", {outside.sum()} outside the view" if outside.any() else ""


def _outside_legend(ax: Axes) -> None:
    """Add a legend below the axes, where it hides no data, with marks of start and end if they are drawn."""
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
