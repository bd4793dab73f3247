"""The summary of a run by the registered `ekfslam.evaluation.metrics`, and the table that compares modes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from ekfslam.data.sequence import Sequence
from ekfslam.evaluation.metrics import METRICS, Value, computed, offered
from ekfslam.evaluation.tables import document, markdown_table, number
from ekfslam.filters.result import Result
from ekfslam.storage.archive import Archive

KEYS = METRICS.keys()  # of a summary, in the order of the table


def summarise(sequence: Sequence | Archive, result: Result) -> dict[str, Value]:
    """Return the figures of merit of one run as plain Python numbers, ready for JSON; None if undefined.

    Trajectory errors are over the frames with known true pose. Only ``ate_aligned_m`` is aligned. Every NEES leaves
    interpolated intervals out.
    """
    return computed(offered(result, sequence.truth, sequence.interpolated))


def compare_table(summary: Mapping[str, Any]) -> str:
    """Return ``{"sequence", "frames", "landmarks", "modes": {mode: summarise(...)}}`` as a Markdown table."""
    modes = summary["modes"]
    landmarks = "" if summary["landmarks"] is None else f", {summary['landmarks']} landmarks"
    title = f"**{summary['sequence']}**: {summary['frames']} frames{landmarks}"
    return document(title, markdown_table(["", *modes], merit_rows(modes.values()), padded=True))


def merit_rows(summaries: Iterable[Mapping[str, Any]]) -> list[list[str]]:
    """Return table rows of a heading and one value for each summary as text; rows without any value are left out."""
    rows, summaries = [], list(summaries)
    for key, metric in METRICS.items():
        values = [summary.get(key) for summary in summaries]  # older summaries lack some
        if any(value is not None for value in values):
            rows.append([metric.heading, *(number(value, metric.fmt) for value in values)])
    return rows
