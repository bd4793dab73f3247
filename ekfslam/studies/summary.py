"""The figures of merit of a Monte Carlo study, and the table of its levels and variants."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ekfslam.arrays import Array
from ekfslam.evaluation.consistency import average_over_runs, chi2_bounds, nanmean
from ekfslam.evaluation.tables import document, markdown_table, plus_minus, significant
from ekfslam.studies.study import LABELS, TEXTBOOK, StudyArchive
from ekfslam.studies.sweep_table import SweepTable

BOUND_PROBABILITY = 0.999

# Averages per run: field, expected value, heading. The bounds of a NEES are those of its degrees of freedom.
_NEES = {
    "pose_nees": (6, "pose NEES (6)"),
    "orientation_nees": (3, "orientation (3)"),
    "position_nees": (3, "position (3)"),
    "landmark_nees": (3, "landmark (3)"),
}
_RATIOS = {"joint_nees_per_dof": "joint / dof (1)", "nis_per_dof": "NIS / dof (1)"}
_RMSE = {"position_rmse_m": "RMSE [m]", "rotation_rmse_deg": "RMSE [deg]"}
FIGURES = (*_NEES, *_RATIOS, *_RMSE)  # of `study_runs`


def summarise_study(archive: StudyArchive) -> dict[str, Any]:
    """Return figures of merit per level and variant as plain Python numbers, ready for JSON.

    Averages are over time first, then over finished runs: ``{"mean", "half_width", "median", "runs"}`` of
    `average_over_runs`, with the ``expected`` value of a consistent filter. NEES has the two-sided 99.9 % ``bounds`` of
    the mean of as many values at one instant; a time average varies less. A diverged run counts if it has values.
    """
    levels = {
        level: {variant: _summarise(values) for variant, values in archive.finished(level).items()}
        for level in archive.data
    }
    return {"study": archive.study.parameters, "bound_probability": BOUND_PROBABILITY, "levels": levels}


def study_runs(archive: StudyArchive) -> SweepTable:
    """Return the averages over time of every finished run, one row a level, run and variant."""
    rows = []
    for level in archive.data:
        for variant, values in archive.finished(level).items():
            found = _averages(values)
            for name, unit, scale in (("position", "m", 1.0), ("rotation", "deg", np.degrees(1.0))):
                squares = np.sum(values[f"{name}_error"] ** 2, axis=-1)
                found[f"{name}_rmse_{unit}"] = scale * np.sqrt(nanmean(squares, axis=1))
            for i, run in enumerate(np.flatnonzero(archive.done[level]).tolist()):
                facts = {"recording": level, "variant": LABELS[variant], "seed": run}
                rows.append({**facts, **{name: float(x[i]) for name, x in found.items()}})
    headings = {name: heading for name, (_, heading) in _NEES.items()} | _RATIOS | _RMSE | {"recording": "level"}
    return SweepTable.of_rows(rows, ("recording", "variant", "seed"), len(rows), headings)


def _averages(values: Mapping[str, NDArray]) -> dict[str, Array]:
    """Return the average over time (runs,) of each field; of NIS the sum over the sum of its degrees of freedom."""
    found = {name: nanmean(values[name], axis=1) for name in (*_NEES, "joint_nees_per_dof")}
    dof = values["nis_dof"].sum(axis=1)
    return found | {"nis_per_dof": np.where(dof > 0, np.nansum(values["nis"], axis=1) / np.maximum(dof, 1), np.nan)}


def _summarise(values: Mapping[str, NDArray]) -> dict[str, Any]:
    """Return the figures of merit of one variant from its fields (runs, ...)."""
    out: dict[str, Any] = {}
    for name, per_run in _averages(values).items():
        average, dof = average_over_runs(per_run), _NEES[name][0] if name in _NEES else 1
        out[name] = {**average, "expected": dof}
        if name in _NEES:
            out[name]["bounds"] = list(map(float, chi2_bounds(dof, BOUND_PROBABILITY, max(average["runs"], 1))))
    out["position_rmse_m"] = _rms(values["position_error"])
    rotation = _rms(values["rotation_error"])
    out["rotation_rmse_deg"] = None if rotation is None else float(np.degrees(rotation))
    out["diverged"] = int(values["diverged"].sum())
    out["runs"] = len(values["diverged"])
    return out


def _rms(errors: Array) -> float | None:
    """Return the root mean square length of (runs, T, 3) over all runs and frames with a value."""
    squares = np.sum(errors**2, axis=-1)
    squares = squares[np.isfinite(squares)]
    return float(np.sqrt(squares.mean())) if len(squares) else None


def study_table(summary: Mapping[str, Any]) -> str:
    """Return `summarise_study` as a Markdown table, one row a level and variant."""
    figures = [*(heading for _, heading in _NEES.values()), *_RATIOS.values(), *_RMSE.values()]
    headings, rows = ["level", "variant", figures[0], "median", *figures[1:], "diverged"], []
    for level, variants in summary["levels"].items():
        for variant, found in variants.items():
            pose, *means = (significant(found[name]["mean"]) for name in (*_NEES, *_RATIOS))
            pose = plus_minus(pose, significant(found["pose_nees"]["half_width"]))
            numbers = [pose, significant(found["pose_nees"]["median"]), *means, *(significant(found[x]) for x in _RMSE)]
            rows.append([level, LABELS[variant], *numbers, f"{found['diverged']} of {found['runs']}"])
    study = summary["study"]
    low, high = chi2_bounds(6, BOUND_PROBABILITY, study["runs"])
    note = (
        f"{study['runs']} runs, seed {study['seed']}. Expected values in brackets; ± is three standard errors over "
        f"runs. Two-sided {100 * BOUND_PROBABILITY:g} % bounds of the mean pose NEES of as many runs at one instant: "
        f"{low:.2f} to {high:.2f}."
    )
    if TEXTBOOK in study["variants"]:
        note += " All variants but the textbook one keep landmarks in image coordinates."
    return document(markdown_table(headings, rows, left=len(headings), padded=True), note)
