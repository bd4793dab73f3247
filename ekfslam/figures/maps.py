"""Maps: from above with ellipses, from the side, and how far landmarks moved."""

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
from ekfslam.figures.series import BAND_SIGMAS, draw_series, height, height_of
from ekfslam.figures.style import FIRST_LANDMARK_COLOR, LANDMARK_COLOR, TRUTH, arrange, legend_of, line_of, style_of
from ekfslam.filters.result import Result
from ekfslam.geometry.motion import world_axes_covariance

SIGMAS = 2.0  # of ellipses

_ROOM, _ABOVE = 2.2, 0.5  # inches, above and below a map, and above it for a title of two lines
_MARKS = 10  # markers, pose ellipses and arrows along a trajectory
_ELLIPSES = 400  # of landmarks on a map; more are one blot
_HELD = f"{100 * (1 - np.exp(-(SIGMAS**2) / 2)):.0f} %"  # of a Gaussian in the plane, within an ellipse


@registry.figure("map")
def plot_map(results: Mapping[str, Result], truth: Truth | None = None) -> Figure:
    """Draw the map from above (x, y of world, metres): trajectories, landmarks and poses with 2-sigma ellipses.

    Landmarks are those of the full mode, or of the last mode that has any. The view holds trajectories and the bulk of
    the landmarks. Ellipses longer than a tenth (poses: half) of its diagonal are left out, and of more than 400
    landmarks all but 400; the legend counts missing ellipses and landmarks. Arrows are along the IMU's x axis.
    """
    mapper = map_of(results)
    landmarks, points = mapper.landmarks, mapper.landmarks.position_m[:, :2]
    figure, ax, outside = map_axes(results, truth, points)
    if len(landmarks):
        # The more there are, the fainter, or a dense map would be one blot.
        alpha = float(np.clip(20.0 / np.sqrt(len(landmarks)), 0.5, 0.8))
        some = spread(len(landmarks), _ELLIPSES)
        covariance = landmarks.covariance[some, :2, :2]
        left_out = add_ellipses(ax, points[some], covariance, LANDMARK_COLOR, 0.1, alpha=alpha, linewidths=0.6)
        left_out += len(landmarks) - len(some)
        uncertain = f", {left_out} without ellipse" if left_out else ""
        label = f"{len(landmarks)} landmarks ({mapper.mode}{_outside_text(outside)}{uncertain})"
        draw_dots(ax, points, label, zorder=1.5)
    draw_paths(ax, results, truth)
    for mode, result in results.items():
        add_pose_ellipses(ax, result, _MARKS)
        T, color = result.T_world_imu[spread(len(result.time_s), _MARKS)], style_of(mode)["color"]
        size: dict[str, Any] = {"units": "inches", "scale_units": "inches", "scale": 1 / 0.28, "width": 0.022}
        at, along = T[:, :2, 3], T[:, :2, 0]
        arrows = ax.quiver(*at.T, *along.T, color=color, angles="xy", zorder=4, clip_on=False, **size)
        arrows.set_in_layout(False)
    legend_below(figure, ax)
    drawn = f"{SIGMAS:g}-sigma ellipses ({_HELD} of a Gaussian), arrows along the IMU's x axis"
    ax.set_title(f"{mapper.sequence_name}: map from above\n{drawn}")
    return figure


@registry.figure("landmarks_{mode}", needs={"landmarks"})
def plot_landmark_arrows(result: Result, truth: Truth | None = None) -> Figure:
    """Draw landmarks from above (x, y of world, metres): from initialisation to final estimate, over the trajectory."""
    landmarks = result.landmarks
    start, end = landmarks.initial_position_m[:, :2], landmarks.position_m[:, :2]
    figure, ax, outside = map_axes({result.mode: result}, None, end)
    arrows = list(np.stack([start, end], axis=1)[~outside])
    ax.add_collection(LineCollection(arrows, colors=LANDMARK_COLOR, linewidths=0.5, alpha=0.6), autolim=False)
    draw_dots(ax, start, "initial", FIRST_LANDMARK_COLOR, zorder=2.5)
    draw_dots(ax, end, f"final ({len(landmarks)} landmarks{_outside_text(outside)})", zorder=3)
    if truth is not None and len(truth.frame):
        ax.plot(*truth.T_world_imu[:, :2, 3].T, **TRUTH, label="truth", zorder=2.2)
    ax.plot(*result.T_world_imu[:, :2, 3].T, **line_of(result.mode), label="trajectory", zorder=2.3)
    legend_below(figure, ax)
    ax.set_title(f"{result.sequence_name}, {result.mode}\nlandmarks from initialisation to final estimate")
    return figure


@registry.figure("side")
def plot_side(results: Mapping[str, Result], truth: Truth | None = None) -> Figure:
    """Draw the drive from the side: height z of world over the distance driven, metres, with 3-sigma bands.

    Landmarks are those of the map, at the distance at which they were last seen. The view holds the trajectories, the
    band of the mode with the map, and the bulk of the landmarks.
    """
    mapper, figure = map_of(results), Figure(figsize=(9.0, 4.2))
    ax, landmarks = figure.subplots(), mapper.landmarks
    heights = [result.T_world_imu[:, 2, 3] for result in results.values()]
    if len(landmarks):
        z, way = landmarks.position_m[:, 2], distance_along(mapper.T_world_imu)[landmarks.last_frame]
        label = f"{len(landmarks)} landmarks ({mapper.mode}), where seen last"
        draw_dots(ax, np.column_stack([way, z]), label, alpha=0.6, zorder=1.5)
        heights.append(np.percentile(z, [2, 98]))
    if truth is not None and len(truth.frame):
        draw_series(ax, height(truth.T_world_imu), "", {**TRUTH, "zorder": 2}, label="truth")
        heights.append(truth.T_world_imu[:, 2, 3])
    for mode, result in results.items():
        line = line_of(mode)
        one = height_of(result, truth, has_band=True)
        draw_series(ax, one, line["color"], {**line, "zorder": 3}, label=mode)
        if result is mapper and one.low is not None and one.high is not None:
            heights += [one.low, one.high]
    low, high = min(z.min() for z in heights), max(z.max() for z in heights)
    margin = 0.06 * (high - low) + 0.05
    ax.set_ylim(low - margin, high + margin)
    legend_below(figure, ax, keep_size=True)
    ax.set_title(f"{mapper.sequence_name}: from the side, {BAND_SIGMAS:g}-sigma bands")
    return figure


def map_of(results: Mapping[str, Result]) -> Result:
    """Return the result whose map is shown: full, else the last one with landmarks, else the last."""
    with_map = [result for result in results.values() if len(result.landmarks)]
    return results.get("full") or (with_map or list(results.values()))[-1]


def spread(length: int, count: int) -> IntArray:
    """Return at most ``count`` indices spread over ``length``, first and last included."""
    return np.unique(np.linspace(0, length - 1, count).astype(int))


def view_of(results: Mapping[str, Result], truth: Truth | None, points: Array) -> tuple[Array, Array, BoolArray]:
    """Return two corners around all paths and the bulk of points (n, 2), and a mask of points outside."""
    paths = [result.T_world_imu[:, :2, 3] for result in results.values()]
    if truth is not None:
        paths.append(truth.T_world_imu[:, :2, 3])
    shown = np.concatenate([*paths, np.percentile(points, [2, 98], axis=0) if len(points) else points])
    low, high = shown.min(axis=0), shown.max(axis=0)
    # A straight or standing trajectory must not make an infinitely thin picture.
    margin = 0.05 * (high - low) + 0.02 * (high - low).max() + 1e-3
    low, high = low - margin, high + margin
    return low, high, np.any((points < low) | (points > high), axis=1)


def map_axes(results: Mapping[str, Result], truth: Truth | None, points: Array) -> tuple[Figure, Axes, BoolArray]:
    """Return a new figure with axes for `view_of`, and its mask of points outside."""
    low, high, outside = view_of(results, truth, points)
    aspect = (high[1] - low[1]) / (high[0] - low[0])
    width = min(8.0, 7.0 / aspect)
    # Room for labels, title and legend around axes of the right shape.
    figure = Figure(figsize=(max(width + 0.85, 6.0), max(width * aspect, 1.5) + _ROOM))
    ax = figure.subplots()
    look_from_above(ax, low, high)
    ax.set_ylabel("y [m]")
    return figure, ax, outside


def look_from_above(ax: Axes, low: Array, high: Array) -> None:
    """Show the rectangle between two corners (2,) of the x-y plane at equal scales."""
    ax.set_aspect("equal", adjustable="box")
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x [m]")
    ax.set_autoscale_on(False)


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


def draw_dots(ax: Axes, xy: Array, label: str, color: str = LANDMARK_COLOR, **style: Any) -> Line2D:
    """Draw points (n, 2) as dots of a size at which so many remain legible."""
    size = float(np.clip(100.0 / np.sqrt(max(len(xy), 1)), 1.2, 4.0))
    look = {"color": color, "markersize": size, "markeredgewidth": 0, "label": label, **style}
    return ax.plot(*xy.T, ".", **look)[0]


def ellipse_axes(covariance: Array, sigmas: float = SIGMAS) -> tuple[Array, Array, Array]:
    """Return axes (longer first) and direction (degrees) of ellipses ``e^T P^-1 e = sigmas^2`` of P (..., 2, 2)."""
    values, vectors = np.linalg.eigh(covariance)
    lengths = 2.0 * sigmas * np.sqrt(np.maximum(values, 0.0))
    angle = np.degrees(np.arctan2(vectors[..., 1, 1], vectors[..., 0, 1]))
    return lengths[..., 1], lengths[..., 0], angle


def ellipses(ax: Axes, centres: Array, axes: tuple[Array, Array, Array], color: str, **style: Any) -> EllipseCollection:
    """Return ellipses in data coordinates, not yet added to the axes."""
    look = {"facecolors": "none", "edgecolors": color, **style}
    return EllipseCollection(*axes, units="xy", offsets=centres, offset_transform=ax.transData, **look)


def diagonal(ax: Axes) -> float:
    """Return the length of the diagonal of the view, in data coordinates."""
    return float(np.hypot(np.ptp(ax.get_xlim()), np.ptp(ax.get_ylim())))


def add_ellipses(ax: Axes, centres: Array, covariance: Array, color: str, share: float, **style: Any) -> int:
    """Draw covariances (n, 2, 2) up to a length of ``share`` of the view's diagonal; return the number left out."""
    axes = ellipse_axes(covariance)
    # Ellipses that hardly fit into the view are no more than lines across everything else.
    fits = axes[0] <= share * diagonal(ax)
    long, short, angle = (values[fits] for values in axes)
    ax.add_collection(ellipses(ax, centres[fits], (long, short, angle), color, **style), autolim=False)
    return int((~fits).sum())


def add_pose_ellipses(ax: Axes, result: Result, count: int) -> None:
    """Draw the covariances of ``count`` positions of a run."""
    some = spread(len(result.time_s), count)
    T, color = result.T_world_imu[some], style_of(result.mode)["color"]
    add_ellipses(ax, T[:, :2, 3], position_covariance(T, result.covariance[some]), color, 0.5, linewidths=1.0)


def position_covariance(T_world_imu: Array, covariance: Array) -> Array:
    """Return the covariances (n, 2, 2) of positions in the x-y plane of world."""
    return world_axes_covariance(T_world_imu, covariance)[0][:, :2, :2]


def _outside_text(outside: BoolArray) -> str:
    return f", {outside.sum()} outside the view" if outside.any() else ""


def legend_below(figure: Figure, ax: Axes, keep_size: bool = False) -> None:
    """Add a legend below a map and fit the figure around both; ``keep_size`` lowers the axes instead."""
    marks = []
    if any(line.get_marker() == "X" for line in ax.lines):
        look: dict[str, Any] = {"color": "white", "markeredgecolor": "black", "linestyle": ""}
        marks = [Line2D([], [], marker=marker, label=label, **look) for marker, label in (("o", "start"), ("X", "end"))]
    below = 0.5 + legend_of(figure, [ax], 3 if figure.get_figwidth() > 7.0 else 2, extra=marks)
    if not keep_size:
        width, height = figure.get_size_inches()
        figure.set_size_inches(width, height - _ROOM + below + _ABOVE)
    arrange(figure, bottom=below, top=_ABOVE)
