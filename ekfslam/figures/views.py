"""Figures of one result: `Result.map`, `Result.plot` and `Result.errors`."""

from __future__ import annotations

from typing import Any

from matplotlib.figure import Figure

from ekfslam.data.sequence import Truth
from ekfslam.errors import TruthError
from ekfslam.figures.maps import plot_map
from ekfslam.figures.run import plot_errors
from ekfslam.figures.series import BAND_SIGMAS, draw_series, trajectory
from ekfslam.figures.style import TRUTH, arrange, legend_of, line_of, share_x, styled
from ekfslam.filters.result import Result


def map_of(result: Result, truth: Any = None) -> Figure:
    """Draw the map from above by `plot_map`; ``truth`` is a `Truth`, or a `Sequence` or an `Archive` that has one."""
    return plot_map({result.mode: result}, _truth(truth))


def errors_of(result: Result, truth: Any) -> Figure:
    """Draw estimate minus truth over time by `plot_errors`, with ``truth`` as for `map_of`."""
    found = _truth(truth)
    if found is None or not len(found.frame):
        raise TruthError("errors need true poses, and there are none", source=result.sequence_name)
    if found.frame[-1] >= len(result.time_s):
        message = f"the truth has frame {found.frame[-1]}, the result has {len(result.time_s)} frames"
        raise TruthError(message, source=result.sequence_name)
    return plot_errors({result.mode: result}, found, getattr(truth, "interpolated", None))


def trajectory_of(result: Result, truth: Any = None) -> Figure:
    """Draw position and attitude over time by `plot_trajectory`, with ``truth`` as for `map_of`."""
    return plot_trajectory(result, _truth(truth))


@styled
def plot_trajectory(result: Result, truth: Truth | None = None) -> Figure:
    """Draw position (m, axes of world) and yaw, pitch and roll (degrees) over time with 3-sigma bands."""
    figure = Figure(figsize=(8.0, 7.6))
    axes = figure.subplots(3, 2)
    color = line_of(result.mode)["color"]
    for ax, (one, true) in zip(axes.T.ravel(), trajectory(result, truth), strict=True):
        if true is not None:
            draw_series(ax, true, color, TRUTH, label="truth")
        draw_series(ax, one, color, line_of(result.mode), label=f"{result.mode}, {BAND_SIGMAS:g} sigma")
    for column in axes.T:
        share_x(*column)
    figure.suptitle(f"{result.sequence_name}, {result.mode}: pose of the IMU in world")
    arrange(figure, bottom=0.5 + legend_of(figure, axes[0, :1], 2), top=0.5, gaps=(0.8, 0.13))
    return figure


def _truth(of: Any) -> Truth | None:
    found = getattr(of, "truth", of)
    if found is not None and not isinstance(found, Truth):
        raise TypeError(f"expected a Truth, a Sequence or an Archive, found {type(of).__name__}")
    return found
