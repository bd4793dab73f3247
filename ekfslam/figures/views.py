"""Figures of one result: `Result.map`, `Result.plot` and `Result.errors`.

Figures are shown by a notebook as they are: without pyplot, nothing else would tell it how.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from ekfslam.arrays import Array
from ekfslam.data.sequence import Truth
from ekfslam.errors import TruthError
from ekfslam.figures.maps import plot_map
from ekfslam.figures.run import plot_errors
from ekfslam.figures.style import BAND_ALPHA, TRUTH, line_of, png, styled
from ekfslam.filters.result import Result

_SIGMAS = 3.0


def map_of(result: Result, truth: Any = None) -> Figure:
    """Draw the map from above with trajectory and ellipses, see `ekfslam.figures.maps.plot_map`.

    Args:
        result: Any run.
        truth: `Truth`, or a record that has one (`Sequence`, `Archive`), drawn for comparison.
    """
    return _in_notebooks(plot_map({result.mode: result}, _truth(truth)))


def errors_of(result: Result, truth: Any) -> Figure:
    """Draw estimate minus truth against time with bands of 3 sigma, see `ekfslam.figures.run.plot_errors`.

    Args:
        result: Any run.
        truth: As for `map_of`.

    Raises:
        TruthError: The truth is missing or has no pose, or has frames that the result has not.
    """
    found = _truth(truth)
    if found is None or not len(found.frame):
        raise TruthError("errors need true poses, and there are none", source=result.sequence_name)
    if found.frame[-1] >= len(result.time_s):
        message = f"the truth has frame {found.frame[-1]}, the result has {len(result.time_s)} frames"
        raise TruthError(message, source=result.sequence_name)
    return _in_notebooks(plot_errors({result.mode: result}, found, getattr(truth, "interpolated", None)))


def trajectory_of(result: Result, truth: Any = None) -> Figure:
    """Draw position and attitude against time with bands of 3 sigma, see `plot_trajectory`.

    Args:
        result: Any run.
        truth: As for `map_of`.
    """
    return _in_notebooks(plot_trajectory(result, _truth(truth)))


@styled
def plot_trajectory(result: Result, truth: Truth | None = None) -> Figure:
    """Position (m) and attitude (degrees) against time with bands of 3 sigma, positions along the axes of world.

    The attitude is yaw about z of world, then pitch, then roll.
    """
    figure = Figure(figsize=(8.0, 7.6))
    axes = figure.subplots(3, 2, sharex=True)
    time_s = result.time_s - result.time_s[0]
    color = line_of(result.mode)["color"]
    std = np.hstack([result.position_std_world_m, np.degrees(_attitude_std(result.T_world_imu, result.covariance))])
    values = _unwrapped(result.T_world_imu)
    for i, (ax, name) in enumerate(zip(axes.T.ravel(), ("x", "y", "z", "roll", "pitch", "yaw"), strict=True)):
        value, band = values[:, i], _SIGMAS * std[:, i]
        ax.fill_between(time_s, value - band, value + band, color=color, alpha=BAND_ALPHA, linewidth=0)
        if truth is not None and len(truth.frame):
            true = _unwrapped(truth.T_world_imu)[:, i]
            turns = 360.0 * np.round((true[0] - value[truth.frame[0]]) / 360.0) if i >= 3 else 0.0
            ax.plot(time_s[truth.frame], true - turns, **TRUTH, label="truth")
        ax.plot(time_s, value, **line_of(result.mode), label=f"{result.mode}, {_SIGMAS:g} sigma")
        ax.set_ylabel(f"{name} [{'m' if i < 3 else 'deg'}]")
        ax.margins(x=0.01)
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
    figure.align_ylabels()
    figure.suptitle(f"{result.sequence_name}, {result.mode}: pose of the IMU in world")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure


def _unwrapped(T_world_imu: Array) -> Array:
    """Position (m), roll, pitch and yaw (degrees) of poses (T, 4, 4): (T, 6), angles without jumps."""
    yaw_pitch_roll = Rotation.from_matrix(T_world_imu[:, :3, :3]).as_euler("ZYX")
    return np.hstack([T_world_imu[:, :3, 3], np.degrees(np.unwrap(yaw_pitch_roll[:, ::-1], axis=0))])


def _attitude_std(T_world_imu: Array, covariance: Array) -> Array:
    """Standard deviations (T, 3) of roll, pitch and yaw, rad, to first order.

    The rotation error ``theta`` is about the axes of the IMU, ``R_true = R exp(-theta^)``. With roll r and pitch p, the
    derivatives of the angles by it are the rows of the matrix E below.
    """
    _, pitch, roll = Rotation.from_matrix(T_world_imu[:, :3, :3]).as_euler("ZYX").T
    sin, cos, zero = np.sin(roll), np.cos(roll), np.zeros_like(roll)
    level = np.maximum(np.cos(pitch), 1e-9)
    E = np.stack(
        [
            np.stack([zero + 1.0, sin * np.tan(pitch), cos * np.tan(pitch)], axis=-1),
            np.stack([zero, cos, -sin], axis=-1),
            np.stack([zero, sin / level, cos / level], axis=-1),
        ],
        axis=1,
    )
    return np.sqrt(np.maximum(np.einsum("tij,tjk,tik->ti", E, covariance[:, 3:, 3:], E), 0.0))


def _truth(of: Any) -> Truth | None:
    """The truth, of itself or of what has one."""
    found = getattr(of, "truth", of)
    if found is not None and not isinstance(found, Truth):
        raise TypeError(f"expected a Truth, a Sequence or an Archive, found {type(of).__name__}")
    return found


def _in_notebooks(figure: Figure) -> Figure:
    figure._repr_png_ = lambda: png(figure)  # type: ignore[attr-defined]
    return figure
