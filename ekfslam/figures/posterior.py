"""Figures of posteriors: the map before and after smoothing, and the sparsity that makes it cheap."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from ekfslam.arrays import Array, IntArray
from ekfslam.data.sequence import Truth
from ekfslam.evaluation.tables import MISSING
from ekfslam.figures import maps, registry
from ekfslam.figures.style import LANDMARK_COLOR, arrange, legend_of, styled
from ekfslam.filters.result import Result
from ekfslam.smoother.sparse.information import JointInformation

POSTERIOR_FIGURES = ("map_before_and_after", "sparsity")
_POSES = 16  # with an ellipse
_CELLS = 500  # across a picture of a sparsity pattern


@registry.figure("map_before_and_after", needs={"full", "smoothed"})
def plot_map_before_and_after(full: Result, smoothed: Result, truth: Truth | None = None) -> Figure:
    """Draw the maps of filter and posterior from above at one scale, poses and landmarks with 2-sigma ellipses.

    If the drive closes a loop, earlier poses gain most: the last map of the filter knows of the loop, its earlier poses
    do not.
    """
    low, high, _ = maps.view_of({"full": full, "smoothed": smoothed}, truth, smoothed.landmarks.position_m[:, :2])
    aspect = float(np.clip((high[1] - low[1]) / (high[0] - low[0]), 0.3, 2.0))
    figure = Figure(figsize=(10.0, 4.6 * aspect + 1.5))
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    for ax, result, title in ((axes[0], full, "filter"), (axes[1], smoothed, "posterior")):
        maps.look_from_above(ax, low, high)
        landmarks = result.landmarks
        inside = ((landmarks.position_m[:, :2] > low) & (landmarks.position_m[:, :2] < high)).all(axis=1)
        xy, covariance = landmarks.position_m[inside, :2], landmarks.covariance[inside, :2, :2]
        maps.add_ellipses(ax, xy, covariance, LANDMARK_COLOR, 0.3, alpha=0.7, linewidths=0.6)
        maps.draw_dots(ax, xy, f"landmark, {maps.SIGMAS:g} sigma", markeredgewidth=1.0)
        maps.draw_paths(ax, {result.mode: result}, truth)
        maps.add_pose_ellipses(ax, result, _POSES)
        of_poses = _median_std(maps.position_covariance(result.T_world_imu, result.covariance))
        medians = f"position {of_poses} m, landmark {_median_std(covariance)} m"
        ax.set_title(f"{title}, median standard deviations:\n{medians}")
    axes[0].set_ylabel("y [m]")
    arrange(figure, bottom=0.5 + legend_of(figure, axes, 5), top=0.5, gaps=(0.25, 0.0))
    return figure


def _median_std(covariance: Array) -> str:
    """Return the median standard deviation of covariances (n, 2, 2) in the plane, as text."""
    return f"{np.sqrt(np.median(np.trace(covariance, axis1=1, axis2=2))):.3g}" if len(covariance) else MISSING


@styled
def plot_sparsity(information: JointInformation) -> Figure:
    """Draw the nonzero blocks of the information matrix and of its Cholesky factor; one cell is many blocks."""
    figure = Figure(figsize=(10.0, 5.2))
    own, of_factor, size = block_patterns(information)
    cells = min(_CELLS, size)
    axes = figure.subplots(1, 2)
    for ax, (row, column), title, order in (
        (axes[0], own, "information matrix", "poses, then landmarks"),
        (axes[1], of_factor, "its Cholesky factor", "in the order of elimination"),
    ):
        count, _, _ = np.histogram2d(row, column, bins=cells, range=[[0, size], [0, size]])
        # Any block at all shows, full cells are black.
        shade = np.where(count > 0, 0.35 + 0.65 * np.minimum(count / (size / cells) ** 2, 1.0), 0.0)
        ax.imshow(shade, cmap="Greys", vmin=0, vmax=1, extent=(0, size, size, 0), interpolation="nearest")
        ax.grid(False)
        ax.set_title(f"{title}: {len(row):,} blocks, {100 * len(row) / (size * (size + 1) / 2):.2g} % of the triangle")
        ax.set_xlabel(f"block ({order})")
    axes[0].set_ylabel("block")
    return figure


def draw_posterior_figures(
    before: Result, after: Result, information: JointInformation, truth: Truth | None = None
) -> dict[str, Figure]:
    """Draw ``map_before_and_after`` and ``sparsity``; return them by name."""
    drawn = (plot_map_before_and_after(before, after, truth), plot_sparsity(information))
    return dict(zip(POSTERIOR_FIGURES, drawn, strict=True))


def block_patterns(information: JointInformation) -> tuple[tuple[IntArray, IntArray], tuple[IntArray, IntArray], int]:
    """Return rows and columns of the blocks of the information matrix and of its Cholesky factor, and counts."""
    s, factor = information.structure, information.factor
    before, eliminated = s.first["landmarks"], np.flatnonzero(~s.is_kept)
    count = before + len(s.ids)
    own = np.arange(count)
    blocks = [product.places for product in s.products]
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
