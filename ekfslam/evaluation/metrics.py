"""The figures of merit of a run: functions with a key, a heading and a format, registered by `metric`.

    @metric("longest_step_s", "longest step [s]", ".3f")
    def longest_step(result: Result) -> float:
        return float(np.diff(result.time_s).max())

Summaries, tables, sweeps and report pages have a metric once its file is imported. Parameters without default name
entries of `offered`; if one is missing, the value is None.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from ekfslam.arrays import Array, BoolArray
from ekfslam.data.sequence import Truth
from ekfslam.evaluation import trajectory
from ekfslam.evaluation.consistency import measured_truth, pose_nees, pose_nees_apart, pose_nees_by_axis
from ekfslam.evaluation.inertial import inertial_nees
from ekfslam.evaluation.relative import FRAMES, PATHS_M, over_frames, over_path, relative_pose_nees
from ekfslam.evaluation.truth import estimated
from ekfslam.filters.inertial_states import InertialStates
from ekfslam.filters.result import Innovation, Result

RPE_PATH_M = 10.0
AXES = ("x", "y", "z", "roll", "pitch", "yaw")  # of position in world, of rotation in the IMU frame

Value = float | int | None
Function = Callable[..., Any]
_NOISE = "(6), with truth noise"


@dataclass(frozen=True)
class Metric:
    """A registered figure of merit."""

    heading: str  # heading, fmt: heading in tables, with unit or expected value, and format of the value
    fmt: str
    compute: Function  # function that returns the value, or the values of several metrics
    place: int | None = None  # place of the value among several; None if it is alone
    definition: str = ""  # the definition in one line, if the heading does not say all


METRICS: dict[str, Metric] = {}  # by key, in the order of tables


def metric(key: str, heading: str, fmt: str, definition: str = "") -> Callable[[Function], Function]:
    """Register a function that returns a figure of merit: its key in summaries, its heading and format in tables."""

    def register(compute: Function) -> Function:
        METRICS[key] = Metric(heading, fmt, compute, None, definition)
        return compute

    return register


def metrics(*rows: tuple[str, ...]) -> Callable[[Function], Function]:
    """Register a function that returns several figures of merit, or None: key, heading, format, definition of each."""

    def register(compute: Function) -> Function:
        for i, (key, heading, fmt, *definition) in enumerate(rows):
            METRICS[key] = Metric(heading, fmt, compute, i, *definition)
        return compute

    return register


def offered(result: Result, truth: Truth | None, interpolated: BoolArray) -> dict[str, Any]:
    """Return the values that metrics may take by name, None if missing.

    ``result``, its ``landmarks``, ``innovation`` (None without an update) and states of an ``inertial`` unit,
    ``truth``, the ``interpolated`` intervals (T,) of the recording, ``vertical`` if it is known; with true poses
    ``T_est`` and ``T_true`` (n, 4, 4) at their frames, and if there are covariances ``measured``, the truth of frames
    that no interpolated interval leads to.
    """
    truth = truth and estimated(result, truth)
    known = truth if truth is not None and len(truth.frame) else None
    return {
        "result": result,
        "vertical": result.knows_vertical or None,
        "landmarks": result.landmarks,
        "innovation": result.innovation if result.innovation.dof.any() else None,
        "interpolated": interpolated,
        "inertial": result.inertial,
        "truth": truth,
        "measured": known and (measured_truth(known, interpolated, result.time_s) if result.has_covariance else None),
        "T_est": known and result.T_world_imu[known.frame],
        "T_true": known and known.T_world_imu,
    }


def computed(found: dict[str, Any]) -> dict[str, Value]:
    """Return every registered metric from the values `offered`; None if it has no value."""
    values: dict[Function, Any] = {}
    summary: dict[str, Value] = {}
    for key, entry in METRICS.items():
        if entry.compute not in values:
            parameters = inspect.signature(entry.compute).parameters.items()
            taken = {name: found[name] for name, one in parameters if one.default is one.empty}
            is_missing = any(value is None for value in taken.values())
            values[entry.compute] = None if is_missing else entry.compute(**taken)
        value = values[entry.compute]
        summary[key] = value if entry.place is None or value is None else value[entry.place]
    return summary


metric("ate_m", "ATE [m], unaligned", ".3f")(partial(trajectory.absolute_trajectory_error, align=False))
metric("ate_aligned_m", "ATE [m], SE(3)-aligned", ".3f")(partial(trajectory.absolute_trajectory_error, align=True))


@metric(
    "ate_aligned_4dof_m",
    "ATE [m], aligned in yaw and position",
    ".3f",
    "Root mean square of position errors after the turn about the vertical and the shift of least squares; an inertial "
    "unit knows the vertical.",
)
def ate_aligned_4dof(T_est: Array, T_true: Array, vertical: bool) -> float:
    """Return the ATE after `align_yaw`, four degrees of freedom."""
    return trajectory.absolute_trajectory_error(T_est, T_true, align=True, by=trajectory.align_yaw)


metric("final_error_m", "final error [m]", ".3f")(trajectory.final_position_error)
metrics(("rpe_1_frame_m", "RPE [m], 1 frame", ".4f"), ("rpe_1_frame_deg", "RPE [deg], 1 frame", ".4f"))(
    trajectory.relative_pose_error_over_frames
)
metrics(*((f"rpe_10_m_{unit}", f"RPE [{unit}], {RPE_PATH_M:g} m", ".4f") for unit in ("m", "deg")))(
    partial(trajectory.relative_pose_error_over_path, path_m=RPE_PATH_M)
)
metrics(("t_rel_percent", "t_rel [%]", ".3f"), ("r_rel_deg_per_100m", "r_rel [deg/100 m]", ".4f"))(
    trajectory.kitti_segment_errors
)


@metric("pose_nees_mean", "pose NEES (6)", ".2f")
def nees(result: Result, measured: Truth) -> float | None:
    """Return the mean pose NEES over the frames whose covariance is not singular, against an exact truth."""
    return _mean(pose_nees(result, measured)[1])


@metric("pose_nees_with_truth_noise_mean", f"pose NEES {_NOISE}", ".2f")
def nees_with_truth_noise(result: Result, measured: Truth) -> float | None:
    """Return the mean pose NEES, with the noise that the truth states."""
    return _mean(pose_nees(result, measured, with_truth_noise=True)[1])


@metric("pose_nees_apart_mean", f"pose NEES {_NOISE}, where truth, velocities and vision agree", ".2f")
def nees_apart(result: Result, measured: Truth) -> float | None:
    """Return the mean pose NEES without stretches in which the truth stands alone; None if there are none."""
    found = pose_nees_apart(result, measured)
    return None if found is None else _mean(found[1])


@metrics(*((f"pose_nees_{axis}_mean", f"{axis} alone (1), with truth noise", ".2f") for axis in AXES))
def nees_by_axis(result: Result, measured: Truth) -> list[float | None]:
    """Return the mean squared error divided by its variance along each of `AXES`, truth noise included."""
    return [_mean(values) for values in pose_nees_by_axis(result, measured).T]


@metrics(
    *((f"pose_nees_relative_{frames}_mean", f"over {frames} frames {_NOISE}", ".2f") for frames in FRAMES),
    *((f"pose_nees_relative_{path_m:g}_m_mean", f"over {path_m:g} m {_NOISE}", ".2f") for path_m in PATHS_M),
)
def relative_nees(result: Result, truth: Truth, interpolated: BoolArray) -> list[float | None]:
    """Return the mean NEES of the motion over some frames, and over some true path, truth noise included."""
    pairs, values = relative_pose_nees(result, truth, interpolated)
    chosen = [over_frames(pairs, frames) for frames in FRAMES]
    chosen += [over_path(pairs, truth, path_m) for path_m in PATHS_M]
    return [_mean(values[which]) for which in chosen]


def _error_squared(of: str) -> str:
    return f"Mean of e^T P^-1 e, with e the error of {of} and P its covariance"


_FIRST = "position and yaw of the first true pose are those of the estimate"


@metrics(
    ("pose_nees_free_mean", "pose NEES (6), yaw and position free", ".2f", f"{_error_squared('the pose')}: {_FIRST}."),
    ("velocity_nees_mean", "velocity NEES (3)", ".2f", f"{_error_squared('the velocity in the IMU frame')}."),
    ("gyro_bias_nees_mean", "gyroscope bias NEES (3)", ".2f", f"{_error_squared('the bias of the gyroscope')}."),
    ("accel_bias_nees_mean", "accelerometer bias NEES (3)", ".2f", f"{_error_squared('that of the accelerometer')}."),
    (
        "inertial_nees_mean",
        "pose, velocity and biases NEES (15)",
        ".2f",
        f"{_error_squared('pose, velocity and biases together')}: {_FIRST}.",
    ),
)
def nees_of_inertial_states(result: Result, measured: Truth, inertial: InertialStates) -> list[float | None] | None:
    """Return the mean NEES of the pose with free yaw and position, of velocity and biases, and of all together."""
    found = inertial_nees(result, measured)
    parts = ("pose", "velocity", "gyro_bias", "accel_bias", "all")
    return None if found is None else [_mean(found[part]) if part in found else None for part in parts]


@metric("nis_per_dof", "NIS / dof (1)", ".3f")
def nis_per_dof(innovation: Innovation) -> float:
    """Return the sum of NIS divided by the sum of degrees of freedom."""
    return float(innovation.nis.sum() / innovation.dof.sum())


metric("landmark_rmse_m", "landmark RMSE [m]", ".3f")(trajectory.landmark_rmse)


@metrics(("accepted", "accepted", "d"), ("rejected", "rejected", "d"))
def observations(result: Result) -> tuple[int, int] | None:
    """Return the numbers of accepted and rejected observations; None of a posterior or another program."""
    if "observations" in result.counts or result.is_other:
        return None
    return int(result.innovation.accepted.sum()), int(result.innovation.rejected.sum())


@metrics(
    ("ms_per_frame_median", "ms/frame median", ".2f"),
    ("ms_per_frame_max", "ms/frame max", ".2f"),
    ("total_s", "total [s]", ".2f"),
)
def times(result: Result) -> tuple[float, float, float] | None:
    """Return the wall-clock time of frames: median and largest, ms, and the sum, s; None of another program."""
    ms = result.ms_per_frame
    if result.is_other:
        return None
    return float(np.median(ms)), float(ms.max()), float(ms.sum()) / 1e3


def _mean(values: Array) -> float | None:
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else None
