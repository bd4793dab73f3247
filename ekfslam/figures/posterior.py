"""Figures of posteriors: the map before and after smoothing, and the sparsity that makes it cheap."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ekfslam.arrays import Array, IntArray
from ekfslam.data.sequence import Truth
from ekfslam.evaluation.tables import MISSING
from ekfslam.figures import registry
from ekfslam.figures.maps import SIGMAS, add_ellipses, dot_size, draw_paths, spread
from ekfslam.figures.style import LANDMARK_COLOR, style_of, styled
from ekfslam.filters.result import Result
from ekfslam.geometry.motion import world_axes_covariance
from ekfslam.smoother.sparse.information import JointInformation

_POSES = 16  # with an ellipse
_CELLS = 500  # across a picture of a sparsity pattern


@registry.figure("map_before_and_after", needs={"full", "smoothed"})
def plot_map_before_and_after(full: Result, smoothed: Result, truth: Truth | None = None) -> Figure:
    """Draw the maps of filter and posterior from above at one scale, poses and landmarks with 2-sigma ellipses.

    The view is the middle half of the smoothed drive. If the drive closes a loop, the poses before it gain most: the
    last map of the filter knows of the loop, its earlier poses do not.
    """
    path = smoothed.T_world_imu[:, :2, 3]
    quarter = len(path) // 4
    low, high = path[quarter : 3 * quarter + 1].min(axis=0), path[quarter : 3 * quarter + 1].max(axis=0)
    margin = 0.1 * (high - low).max() + 5.0
    low, high = low - margin, high + margin
    aspect = float(np.clip((high[1] - low[1]) / (high[0] - low[0]), 0.3, 2.0))
    figure = Figure(figsize=(10.0, 4.6 * aspect + 1.5))
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    for ax, result, title in ((axes[0], full, "filter"), (axes[1], smoothed, "posterior")):
        ax.set_aspect("equal", adjustable="box")
        ax.set_xlim(low[0], high[0])
        ax.set_ylim(low[1], high[1])
        landmarks = result.landmarks
        inside = ((landmarks.position_m[:, :2] > low) & (landmarks.position_m[:, :2] < high)).all(axis=1)
        xy, covariance = landmarks.position_m[inside, :2], landmarks.covariance[inside, :2, :2]
        add_ellipses(ax, xy, covariance, LANDMARK_COLOR, 0.7, 0.6, share=0.3)
        ax.plot(*xy.T, ".", color=LANDMARK_COLOR, markersize=dot_size(len(xy)), label=f"landmark, {SIGMAS:g} sigma")
        draw_paths(ax, {result.mode: result}, truth)
        some = spread(len(path), _POSES)
        of_poses, _ = world_axes_covariance(result.T_world_imu, result.covariance)
        color = style_of(result.mode)["color"]
        add_ellipses(ax, result.T_world_imu[some, :2, 3], of_poses[some, :2, :2], color, 1.0, 1.0, share=0.5)
        medians = f"position {_median_std(of_poses[:, :2, :2])} m, landmark {_median_std(covariance)} m"
        ax.set_title(f"{title}, median standard deviations:\n{medians}")
        ax.set_xlabel("x [m]")
    found = [ax.get_legend_handles_labels() for ax in axes]
    handles = {label: handle for handles, labels in found for handle, label in zip(handles, labels, strict=True)}
    figure.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=len(handles))
    axes[0].set_ylabel("y [m]")
    return figure


def _median_std(covariance: Array) -> str:
    """Return the median standard deviation of covariances (n, 2, 2) in the plane, as text."""
    return f"{np.sqrt(np.median(np.trace(covariance, axis1=1, axis2=2))):.3g}" if len(covariance) else MISSING


@styled
def plot_sparsity(information: JointInformation) -> Figure:
    """Draw the nonzero blocks of the information matrix and of its Cholesky factor; one cell is many blocks."""
    figure = Figure(figsize=(10.0, 5.2))
    own, of_factor, size = block_patterns(information)
    axes = figure.subplots(1, 2)
    for ax, (row, column), title, order in (
        (axes[0], own, "information matrix", "poses, then landmarks"),
        (axes[1], of_factor, "its Cholesky factor", "in the order of elimination"),
    ):
        _draw_pattern(ax, row, column, size)
        ax.set_title(f"{title}: {len(row):,} blocks, {100 * len(row) / (size * (size + 1) / 2):.2g} % of the triangle")
        ax.set_xlabel(f"block ({order})")
    axes[0].set_ylabel("block")
    return figure


def _draw_pattern(ax: Axes, row: IntArray, column: IntArray, size: int) -> None:
    cells = min(_CELLS, size)
    count, _, _ = np.histogram2d(row, column, bins=cells, range=[[0, size], [0, size]])
    # Any block at all shows, full cells are black.
    shade = np.where(count > 0, 0.35 + 0.65 * np.minimum(count / (size / cells) ** 2, 1.0), 0.0)
    ax.imshow(shade, cmap="Greys", vmin=0, vmax=1, extent=(0, size, size, 0), interpolation="nearest")
    ax.grid(False)


def draw_posterior_figures(
    before: Result, after: Result, information: JointInformation, truth: Truth | None = None
) -> dict[str, Figure]:
    """Draw ``map_before_and_after`` and ``sparsity``; return them by name."""
    return {
        "map_before_and_after": plot_map_before_and_after(before, after, truth),
        "sparsity": plot_sparsity(information),
    }


def block_patterns(information: JointInformation) -> tuple[tuple[IntArray, IntArray], tuple[IntArray, IntArray], int]:
    """Return rows and columns of the blocks of the information matrix, of its Cholesky factor, and their number.

    Of the information matrix those in the lower triangle: frames, aux, drive, landmarks. Those of the factor in the
    order of elimination.
    """
    s, factor = information.structure, information.factor
    before, eliminated = s.first["landmarks"], np.flatnonzero(~s.is_kept)
    count = before + len(s.ids)
    own = np.arange(count)
    blocks = [product.places for product in s.products if product.places is not None]
    blocks = [np.stack([own, own], axis=-1), *(places[places[:, 0] < before] for places in blocks)]
    blocks += [pairs + np.array([before, s.first[group]]) for group, pairs in s.pairs.items()]
    row, column = np.unique(np.concatenate(blocks), axis=0).T

    rank, place = np.cumsum(~s.is_kept) - 1, np.empty(len(s.block_sizes), dtype=np.int64)
    place[factor.pattern.order] = len(eliminated) + np.arange(len(place))
    L = factor.factor()
    block = np.repeat(np.sort(place), s.block_sizes[factor.pattern.order])
    of_column = np.repeat(np.arange(L.shape[1]), np.diff(L.indptr))
    rows, columns = ([part] for part in np.divmod(np.unique(block[L.indices] * count + block[of_column]), count))
    for group, pairs in s.pairs.items():
        landmark, index = pairs[~s.is_kept[pairs[:, 0]]].T
        rows.append(place[s.blocks(group, index)])
        columns.append(rank[landmark])
    for side in (rows, columns):
        side.append(np.arange(len(eliminated)))
    return (row, column), (np.concatenate(rows), np.concatenate(columns)), count
