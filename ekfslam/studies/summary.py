"""The figures of merit of a Monte Carlo study, and the table of its levels and variants."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ekfslam.arrays import Array
from ekfslam.evaluation.consistency import average_over_runs, chi2_bounds, time_average
from ekfslam.evaluation.tables import document, markdown_table, plus_minus, significant
from ekfslam.studies.study import StudyArchive

BOUND_PROBABILITY = 0.999

# Field, degrees of freedom of one value.
_NEES = (
    ("pose_nees", 6),
    ("orientation_nees", 3),
    ("position_nees", 3),
    ("landmark_nees", 3),
)


def summarise_study(archive: StudyArchive) -> dict[str, Any]:
    """Figures of merit per level and variant as plain Python numbers, ready for JSON; of the runs that are in.

    Averages are over time first, then over runs: ``{"mean", "half_width", "median", "runs"}`` as in `RunAverage`, with
    what a consistent filter is ``expected`` to have and, for NEES, the two-sided 99.9 % ``bounds`` of the mean of as
    many values at one instant (a time average keeps well inside). A run that diverged counts as long as it has values.
    """
    summary: dict[str, Any] = {"study": archive.study.parameters, "bound_probability": BOUND_PROBABILITY, "levels": {}}
    for level, variants in archive.data.items():
        done = archive.done[level]
        summary["levels"][level] = {
            variant: _summarise({field: value[done] for field, value in values.items()})
            for variant, values in variants.items()
        }
    return summary


def _summarise(values: Mapping[str, NDArray]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for field, dof in _NEES:
        average = average_over_runs(time_average(values[field]))
        bounds = [float(b) for b in chi2_bounds(dof, BOUND_PROBABILITY, max(average.runs, 1))]
        out[field] = {**dataclasses.asdict(average), "expected": dof, "bounds": bounds}
    dof_total = values["nis_dof"].sum(axis=1)
    per_dof = np.where(dof_total > 0, np.nansum(values["nis"], axis=1) / np.maximum(dof_total, 1), np.nan)
    for name, per_run in (
        ("joint_nees_per_dof", time_average(values["joint_nees_per_dof"])),
        ("nis_per_dof", per_dof),
    ):
        out[name] = {**dataclasses.asdict(average_over_runs(per_run)), "expected": 1}
    out["position_rmse_m"] = _rms(values["position_error"])
    rotation = _rms(values["rotation_error"])
    out["rotation_rmse_deg"] = None if rotation is None else float(np.degrees(rotation))
    out["diverged"] = int(values["diverged"].sum())
    out["runs"] = len(values["diverged"])
    return out


def _rms(errors: Array) -> float | None:
    """Root mean square length of (runs, T, 3) over all runs and frames that have a value."""
    squares = np.sum(errors**2, axis=-1)
    squares = squares[np.isfinite(squares)]
    return float(np.sqrt(squares.mean())) if len(squares) else None


_HEADINGS = (
    *("level", "variant", "pose NEES (6)", "median", "orientation (3)", "position (3)", "landmark (3)"),
    *("joint / dof (1)", "NIS / dof (1)", "RMSE [m]", "RMSE [deg]", "diverged"),
)
_MEANS = ("orientation_nees", "position_nees", "landmark_nees", "joint_nees_per_dof", "nis_per_dof")


def study_table(summary: Mapping[str, Any]) -> str:
    """Markdown table of `summarise_study`, one row a level and variant."""
    rows = []
    for level, variants in summary["levels"].items():
        for variant, found in variants.items():
            pose = found["pose_nees"]
            rows.append(
                [
                    level,
                    variant,
                    plus_minus(significant(pose["mean"]), significant(pose["half_width"])),
                    significant(pose["median"]),
                    *(significant(found[name]["mean"]) for name in _MEANS),
                    significant(found["position_rmse_m"]),
                    significant(found["rotation_rmse_deg"]),
                    f"{found['diverged']} of {found['runs']}",
                ]
            )
    study = summary["study"]
    low, high = chi2_bounds(6, BOUND_PROBABILITY, study["runs"])
    note = (
        f"{study['runs']} runs, seed {study['seed']}. Expected values in brackets; ± is three standard errors over "
        "runs. "
        f"Two-sided {100 * BOUND_PROBABILITY:g} % bounds of the mean pose NEES of as many runs at one instant: "
        f"{low:.2f} to {high:.2f}."
    )
    return document(markdown_table(_HEADINGS, rows, left=len(_HEADINGS), padded=True), note)
