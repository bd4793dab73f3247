"""The summary of a run by the registered `ekfslam.evaluation.metrics`, and the table that compares modes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from ekfslam.data.sequence import Sequence, Truth
from ekfslam.evaluation.metrics import METRICS, Value, computed, offered
from ekfslam.evaluation.tables import document, markdown_table, number, significant
from ekfslam.evaluation.trajectory import Part, absolute_trajectory_error, error_parts
from ekfslam.evaluation.truth import estimated, without_pose
from ekfslam.filters.result import Result
from ekfslam.storage.archive import Archive

_LEAST_POSES = 10  # for a statement on the errors of a trajectory
KEYS = METRICS.keys()  # of a summary, in the order of the table
_HONESTY = ("pose_nees_with_truth_noise_mean", "nis_per_dof")
KEY_FIGURES = ("ate_m", "ate_aligned_m", "t_rel_percent", *_HONESTY, "landmark_rmse_m")  # of many runs


def summarise(sequence: Sequence | Archive, result: Result) -> dict[str, Value]:
    """Return the figures of merit of one run as plain Python numbers, ready for JSON; None if undefined.

    Trajectory errors are over the frames with known true pose. Only ``ate_aligned_m`` is aligned. Every NEES leaves
    interpolated intervals out.
    """
    return computed(offered(result, sequence.truth, sequence.interpolated))


def summarise_all(sequence: Sequence | Archive, landmarks: int | None, results: Mapping[str, Result]) -> dict[str, Any]:
    """Return the summaries of all modes of a recording, and words on their trajectory errors, ready for JSON."""
    said = {mode: error_in_words(result, sequence.truth) for mode, result in results.items()}
    frames = len(sequence.time_s)
    counts = {mode: int(without_pose(result).sum()) for mode, result in results.items()}
    missing = {mode: count for mode, count in counts.items() if count}
    return {
        "sequence": sequence.name,
        "frames": frames,
        **({"without_pose": missing} if missing else {}),
        "landmarks": landmarks,
        "modes": {mode: summarise(sequence, result) for mode, result in results.items()},
        "errors": {mode: words for mode, words in said.items() if words},
    }


def error_in_words(result: Result, truth: Truth | None) -> str:
    """Return both ATE of a run, and the parts of the unaligned one in words; empty without true poses."""
    truth = truth and estimated(result, truth)
    if truth is None or len(truth.frame) < _LEAST_POSES:
        return ""
    T_est, T_true = result.T_world_imu[truth.frame], truth.T_world_imu
    ate_m, aligned_m = (absolute_trajectory_error(T_est, T_true, align) for align in (False, True))
    head = f"ATE {significant(ate_m)} m unaligned, {significant(aligned_m)} m aligned"
    parts = error_parts(T_est, T_true)
    if not parts:
        return f"{head}: a matter of shape, no turn of the first pose, shift or scale explains it"
    said = [f"{part.share:.0%} of its square is {_part_in_words(part)}" for part in parts]
    return f"{head}: {', '.join([said[0], *(words.replace('of its square ', '') for words in said[1:])])}"


def _part_in_words(part: Part) -> str:
    if part.name == "scale":
        return f"a scale of {100 * part.value:+.2g} %"
    if part.name in "xyz":
        return f"a shift of {part.value:+.2g} m along {part.name}"
    return f"the first pose's {part.name} of {np.degrees(part.value):+.2g} deg"


def compare_table(summary: Mapping[str, Any]) -> str:
    """Return what `summarise_all` returns as a Markdown table, with the words on errors below."""
    modes = summary["modes"]
    landmarks = "" if summary["landmarks"] is None else f", {summary['landmarks']} landmarks"
    title = f"**{summary['sequence']}**: {summary['frames']} frames{landmarks}"
    table = markdown_table(["", *modes], merit_rows(modes.values()), padded=True)
    errors = (f"{mode}: {words}." for mode, words in summary.get("errors", {}).items())
    return document(title, table, *errors, *(f"{heading}: {words}" for heading, words in definitions(modes.values())))


def merit_rows(summaries: Iterable[Mapping[str, Any]]) -> list[list[str]]:
    """Return table rows of a heading and one value for each summary as text; rows without any value are left out."""
    rows, summaries = [], list(summaries)
    for key, metric in METRICS.items():
        values = [summary.get(key) for summary in summaries]  # older summaries lack some
        if any(value is not None for value in values):
            rows.append([metric.heading, *(number(value, metric.fmt) for value in values)])
    return rows


def definitions(summaries: Iterable[Mapping[str, Any]]) -> list[tuple[str, str]]:
    """Return heading and definition of the rows of `merit_rows` whose heading does not say all."""
    found = {key for summary in summaries for key, value in summary.items() if value is not None}
    named = (metric for key, metric in METRICS.items() if key in found and metric.definition)
    return [(metric.heading, metric.definition) for metric in named]
