"""The figures of merit of a run, and the table that compares modes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from ekfslam.arrays import Array, BoolArray
from ekfslam.data.sequence import Sequence, Truth
from ekfslam.evaluation.consistency import measured_truth, pose_nees, pose_nees_by_axis
from ekfslam.evaluation.relative import FRAMES, PATHS_M, over_frames, over_path, relative_pose_nees
from ekfslam.evaluation.tables import document, markdown_table, number
from ekfslam.evaluation.trajectory import (
    absolute_trajectory_error,
    final_position_error,
    kitti_segment_errors,
    landmark_rmse,
    relative_pose_error_over_frames,
    relative_pose_error_over_path,
)
from ekfslam.filters.result import Result
from ekfslam.storage.archive import Archive

RPE_PATH_M = 10.0
AXES = ("x", "y", "z", "roll", "pitch", "yaw")  # of the error xi, in the IMU frame

# Key of a summary, heading of its row in the table, format of the value.
_ROWS = (
    ("ate_m", "ATE [m], unaligned", ".3f"),
    ("ate_aligned_m", "ATE [m], SE(3)-aligned", ".3f"),
    ("final_error_m", "final error [m]", ".3f"),
    ("rpe_1_frame_m", "RPE [m], 1 frame", ".4f"),
    ("rpe_1_frame_deg", "RPE [deg], 1 frame", ".4f"),
    ("rpe_10_m_m", f"RPE [m], {RPE_PATH_M:g} m", ".4f"),
    ("rpe_10_m_deg", f"RPE [deg], {RPE_PATH_M:g} m", ".4f"),
    ("t_rel_percent", "t_rel [%]", ".3f"),
    ("r_rel_deg_per_100m", "r_rel [deg/100 m]", ".4f"),
    ("pose_nees_mean", "pose NEES (6)", ".2f"),
    ("pose_nees_with_truth_noise_mean", "pose NEES (6), with truth noise", ".2f"),
    *((f"pose_nees_{axis}_mean", f"{axis} alone (1), with truth noise", ".2f") for axis in AXES),
    *((f"pose_nees_relative_{frames}_mean", f"over {frames} frames (6), with truth noise", ".2f") for frames in FRAMES),
    *(
        (f"pose_nees_relative_{path_m:g}_m_mean", f"over {path_m:g} m (6), with truth noise", ".2f")
        for path_m in PATHS_M
    ),
    ("nis_per_dof", "NIS / dof (1)", ".3f"),
    ("landmark_rmse_m", "landmark RMSE [m]", ".3f"),
    ("accepted", "accepted", "d"),
    ("rejected", "rejected", "d"),
    ("ms_per_frame_median", "ms/frame median", ".2f"),
    ("ms_per_frame_max", "ms/frame max", ".2f"),
    ("total_s", "total [s]", ".2f"),
)
KEYS = tuple(key for key, _, _ in _ROWS)  # of a summary, in the order of the table


def summarise(sequence: Sequence | Archive, result: Result) -> dict[str, float | int | None]:
    """Figures of merit of one run as plain Python numbers, ready for JSON; the sequence tells the truth.

    Trajectory errors are over the frames with known true pose, the estimate starting where the run started it; see
    `ekfslam.evaluation.trajectory` for their definitions. Only ``ate_aligned_m`` is aligned; ``ate_m``,
    ``final_error_m`` and ``landmark_rmse_m`` are of what stands in world. ``rpe_1_frame_*`` and ``rpe_10_m_*`` are
    relative errors over one frame and over 10 m of true path. ``pose_nees_mean`` (6 expected) is over the frames whose
    covariance is not singular, and takes the truth as exact. ``pose_nees_with_truth_noise_mean`` allows for the noise
    that the truth states. So do ``pose_nees_x_mean`` and its like (1 expected), each of a single axis of the error
    ``xi``, and ``pose_nees_relative_100_mean`` and its like (6 expected), of the motion over so many frames, or metres
    of true path. All of these leave interpolated stretches out, and trust a first pose within one less. ``nis_per_dof``
    (1 expected) is the sum of NIS over the sum of degrees of freedom, ``total_s`` the sum of the time spent on the
    frames. None stands where truth is missing or the value is undefined.
    """
    summary: dict[str, float | int | None] = dict.fromkeys(KEYS)
    truth = sequence.truth
    if truth is not None:
        summary["landmark_rmse_m"] = landmark_rmse(result.landmarks, truth)
    if truth is not None and len(truth.frame):
        T_est, T_true = result.T_world_imu[truth.frame], truth.T_world_imu
        summary["ate_m"] = absolute_trajectory_error(T_est, T_true, align=False)
        summary["ate_aligned_m"] = absolute_trajectory_error(T_est, T_true, align=True)
        summary["final_error_m"] = final_position_error(T_est, T_true)
        step = relative_pose_error_over_frames(T_est, T_true)
        if step is not None:
            summary["rpe_1_frame_m"], summary["rpe_1_frame_deg"] = step
        stretch = relative_pose_error_over_path(T_est, T_true, RPE_PATH_M)
        if stretch is not None:
            summary["rpe_10_m_m"], summary["rpe_10_m_deg"] = stretch
        segments = kitti_segment_errors(T_est, T_true)
        if segments is not None:
            summary["t_rel_percent"], summary["r_rel_deg_per_100m"] = segments
        summary |= _pose_consistency(result, truth, sequence.interpolated)
    innovation = result.innovation
    if innovation.dof.sum() > 0:
        summary["nis_per_dof"] = float(innovation.nis.sum() / innovation.dof.sum())
    summary["accepted"] = int(innovation.accepted.sum())
    summary["rejected"] = int(innovation.rejected.sum())
    summary["ms_per_frame_median"] = float(np.median(result.ms_per_frame))
    summary["ms_per_frame_max"] = float(result.ms_per_frame.max())
    summary["total_s"] = float(result.ms_per_frame.sum()) / 1e3
    return summary


def _pose_consistency(result: Result, truth: Truth, interpolated: BoolArray) -> dict[str, float | None]:
    """The part of `summarise` that compares pose errors with their covariance."""
    measured = measured_truth(truth, interpolated, result.time_s)
    found = {
        "pose_nees_mean": _mean(pose_nees(result, measured)[1]),
        "pose_nees_with_truth_noise_mean": _mean(pose_nees(result, measured, with_truth_noise=True)[1]),
    }
    for axis, values in zip(AXES, pose_nees_by_axis(result, measured).T, strict=True):
        found[f"pose_nees_{axis}_mean"] = _mean(values)
    pairs, values = relative_pose_nees(result, truth, interpolated)
    for frames in FRAMES:
        found[f"pose_nees_relative_{frames}_mean"] = _mean(values[over_frames(pairs, frames)])
    for path_m in PATHS_M:
        found[f"pose_nees_relative_{path_m:g}_m_mean"] = _mean(values[over_path(pairs, truth, path_m)])
    return found


def _mean(values: Array) -> float | None:
    """Mean of the values that are not NaN, if there are any."""
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else None


def compare_table(summary: Mapping[str, Any]) -> str:
    """Markdown table, one column a mode, of ``{"sequence", "frames", "landmarks", "modes": {mode: summarise(...)}}``.

    Rows without a value in any mode are left out; a value that is None is shown as a dash. Cells are padded, so that
    the table reads as well on a terminal.
    """
    modes = summary["modes"]
    landmarks = "" if summary["landmarks"] is None else f", {summary['landmarks']} landmarks"
    title = f"**{summary['sequence']}**: {summary['frames']} frames{landmarks}"
    return document(title, markdown_table(["", *modes], merit_rows(modes.values()), padded=True))


def merit_rows(summaries: Iterable[Mapping[str, Any]]) -> list[list[str]]:
    """Rows of a table with one column a summary: the heading, then the values as text; none without any value."""
    rows = []
    summaries = list(summaries)
    for key, heading, spec in _ROWS:
        values = [summary.get(key) for summary in summaries]  # older summaries lack some
        if any(value is not None for value in values):
            rows.append([heading, *(number(value, spec) for value in values)])
    return rows
