"""A run in a few rows and one verdict with its next step: the words of terminal, report page and Python."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from ekfslam.data.sequence import Sequence, Truth
from ekfslam.evaluation.honesty import Honesty, judge
from ekfslam.evaluation.sanity import UNKNOWN, WERE_REJECTED
from ekfslam.evaluation.tables import MISSING, document, markdown_table, significant
from ekfslam.evaluation.trajectory import absolute_trajectory_error, align_se3, align_yaw
from ekfslam.evaluation.truth import estimated
from ekfslam.filters.result import Result
from ekfslam.storage.archive import Archive

ATE = "ATE (aligned)"


def brief_rows(result: Result, truth: Truth | None) -> dict[str, str]:
    """Return the rows of a run by heading; the ATE is left out without true poses.

    The aligned ATE is after the best rigid motion; for an inertial unit, after the best turn about the vertical and
    shift. The position's standard deviation is the root of the sum over the axes.
    """
    first, *rest = result.brief.items()
    rows = dict([first])
    truth = truth and estimated(result, truth)
    if truth is not None and len(truth.frame):
        T_est, T_true = result.T_world_imu[truth.frame], truth.T_world_imu
        by = align_yaw if result.knows_vertical else align_se3
        ate_m, aligned_m = (absolute_trajectory_error(T_est, T_true, align, by) for align in (False, True))
        rows[ATE] = f"{significant(ate_m)} m ({significant(aligned_m)} m)"
    return rows | dict(rest)


def brief_table(data: Sequence | Archive, results: Mapping[str, Result]) -> str:
    """Return `brief_rows` of all modes side by side, as a table that is legible on a terminal."""
    columns = [brief_rows(result, data.truth) for result in results.values()]
    headings = dict.fromkeys(heading for column in columns for heading in column)
    rows = [[heading, *(column.get(heading, MISSING) for column in columns)] for heading in headings]
    return markdown_table([data.name, *results], rows, left=len(results) + 1, padded=True)


def verdict_lines(data: Sequence | Archive, result: Result, archive: Any = "ARCHIVE") -> list[str]:
    """Return the verdict on a run, and the next step with ``archive`` in its command; nothing without innovations."""
    if result.whitened is None:
        return []
    found = judge(result, truth=data.truth, interpolated=data.interpolated)
    return [f"verdict: {found.headline}", f"next: {next_step(found, archive, result.remarks)}"]


def next_step(found: Honesty, archive: Any, remarks: Iterable[str] = ()) -> str:
    """Return the remedy of the first cause that has one, with the cause; without any, the command that shows more.

    A likely cause among the remarks on a run that most observations contradict takes precedence.
    """
    remarks = tuple(remarks)
    if found.innovations_skipped and remarks:
        return remarks[-1]
    for remark in remarks:
        likely = remark.partition(WERE_REJECTED)[2]
        if likely and not likely.endswith(UNKNOWN):
            return likely
    defects = sorted((*found.causes, *found.findings), key=lambda defect: defect.kind != "body")
    named = next((defect for defect in defects if defect.remedy), defects[0] if defects else None)
    if named is None:
        return f"ekfslam report {archive} draws map, errors and consistency"
    if not named.remedy:
        return f"{named.text} (ekfslam check {archive} shows more)"
    others = f" ({len(defects) - 1} more: ekfslam check {archive})" if len(defects) > 1 else ""
    return f"{named.text}; {named.remedy}{others}"


def brief(data: Sequence | Archive, results: Mapping[str, Result], skipped: Mapping[str, str], archive: Any) -> str:
    """Return the rows of some modes, reasons for missing ones, the verdict on the full run, and remarks."""
    lines = [f"No {mode}: {reason}" for mode, reason in skipped.items()]
    judged = results.get("full") or next(iter(results.values()))
    lines += verdict_lines(data, judged, archive)
    remarks: dict[str, list[str]] = {}
    for mode, result in results.items():
        for remark in result.remarks:
            if not any(other.endswith(WERE_REJECTED + remark) for other in result.remarks):
                remarks.setdefault(remark, []).append(mode)
    of = (f" on {', '.join(modes)}" if len(results) > 1 else "" for modes in remarks.values())
    lines += [f"note{modes}: {remark}" for modes, remark in zip(of, remarks, strict=True)]
    return document(brief_table(data, results), "\n".join(lines))
