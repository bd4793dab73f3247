"""Figures of a Monte Carlo study: NEES over time, errors of runs with their bounds, NEES run by run."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ekfslam.evaluation.consistency import chi2_bounds, nanmean
from ekfslam.figures.style import BOUNDS, EXPECTED, WIDE_BOUNDS, legend_of, line_of, log_axis, style_of, styled
from ekfslam.studies.study import LABELS, StudyArchive
from ekfslam.studies.summary import BOUND_PROBABILITY

_BOUNDS = ((BOUND_PROBABILITY, WIDE_BOUNDS), (0.95, BOUNDS))  # the narrow ones are drawn over the wide ones
_SHOWN_RUNS = 12  # lines of errors; more are a grey blot
_SHOWN_PERCENT = 98.0  # of the errors are within the view; a run that diverges must not flatten the others


@styled
def plot_study_nees(archive: StudyArchive, level: str) -> Figure:
    """Draw pose and landmark NEES over time: mean over runs of every variant, with its 95 % and 99.9 % bounds.

    The landmark NEES of a frame is a mean over landmarks that share the pose's error. Its bounds are those of a single
    landmark, and so err on the wide side.
    """
    figure = Figure(figsize=(9.0, 6.4))
    axes = figure.subplots(2, 1, sharex=True)
    time_s, variants = archive.time_s(level), archive.finished(level)
    runs = int(archive.done[level].sum())
    for ax, (field, name, dof) in zip(axes, (("pose_nees", "pose", 6), ("landmark_nees", "landmark", 3)), strict=True):
        for probability, style in _BOUNDS:
            low, high = chi2_bounds(dof, probability, runs)
            ax.axhspan(low, high, **style, label=f"{100 * probability:g} % bounds", zorder=0.5)
        ax.axhline(dof, **EXPECTED, label="expected")
        for variant, values in variants.items():
            ax.plot(time_s, nanmean(values[field], axis=0), **line_of(variant), label=LABELS[variant])
        log_axis(ax, (1.0, 3.0))
        ax.set_ylabel(f"{name} NEES ({dof} expected) [-]")
        ax.margins(x=0.01)
    axes[-1].set_xlabel("time [s]")
    legend_of(figure, axes[:1], 4)
    figure.suptitle(f"{level}: NEES, mean of {runs} runs")
    return figure


@styled
def plot_study_errors(archive: StudyArchive, level: str) -> Figure:
    """Draw position errors (x, y) and yaw error of the first runs over time, one column a variant, same scales.

    Bounds are the filter's three sigma, median over runs. Titles say how many errors of all runs are within their own
    run's bounds (99.7 % expected).
    """
    variants, time_s = archive.finished(level), archive.time_s(level)
    # Label, field, its column, column of the bounds, and scale.
    rows: tuple[tuple[str, str, int, int, float], ...] = (
        ("x [m]", "position_error", 0, 0, 1.0),
        ("y [m]", "position_error", 1, 1, 1.0),
        ("yaw [deg]", "rotation_error", 2, 5, 180 / np.pi),
    )
    figure = Figure(figsize=(2.9 * len(variants) + 0.5, 6.6))
    axes = figure.subplots(3, len(variants), sharex=True, sharey="row", squeeze=False)
    for column, (variant, values) in zip(axes.T, variants.items(), strict=True):
        color = style_of(variant)["color"]
        inside = []
        for ax, (label, field, axis, bound, scale) in zip(column, rows, strict=True):
            errors, bounds = scale * values[field][..., axis], scale * values["three_sigma"][..., bound]
            known = np.isfinite(errors)
            inside.append(np.abs(errors[known]) <= bounds[known])
            ax.plot(time_s, errors[:_SHOWN_RUNS].T, color="0.25", linewidth=0.5)
            seen = known.any(axis=0)
            middle = np.nanmedian(bounds[:, seen], axis=0)
            for side in (-1, 1):
                ax.plot(time_s[seen], side * middle, color=color, linewidth=1.6)
            ax.margins(x=0.01)
            if ax.get_subplotspec().is_first_col():
                ax.set_ylabel(label)
        column[0].set_title(f"{LABELS[variant]}\n{100 * np.concatenate(inside).mean():.1f} % inside own 3 sigma")
        column[-1].set_xlabel("time [s]")
    for row, (_, field, axis, _, scale) in zip(axes, rows, strict=True):
        errors = np.concatenate([scale * values[field][..., axis].ravel() for values in variants.values()])
        errors = np.abs(errors[np.isfinite(errors)])
        limit = 1.4 * float(np.percentile(errors, _SHOWN_PERCENT)) if len(errors) else 1.0
        row[0].set_ylim(-limit, limit)
    figure.align_ylabels()
    runs = int(archive.done[level].sum())
    shown = f"{_SHOWN_RUNS} of {runs} runs" if runs > _SHOWN_RUNS else f"{runs} runs"
    figure.suptitle(f"{level}: estimate minus truth of {shown}, world axes, with the median 3-sigma bounds")
    return figure


@styled
def plot_study_boxes(archive: StudyArchive) -> Figure:
    """Draw the time-averaged pose NEES of every run with median and quartiles, per level and variant, on a log axis."""
    levels = [level for level, mask in archive.done.items() if mask.any()]
    variants = archive.study.variants
    figure = Figure(figsize=(2.4 + 1.9 * len(levels), 4.4))
    axes = figure.subplots(1, len(levels), sharey=True, squeeze=False)[0]
    for ax, level in zip(axes, levels, strict=True):
        for place, (variant, values) in enumerate(archive.finished(level).items()):
            averages = nanmean(values["pose_nees"], axis=1)
            averages = averages[np.isfinite(averages)]
            color = style_of(variant)["color"]
            look: dict[str, Any] = {part: {"color": color} for part in ("boxprops", "whiskerprops", "capprops")}
            look["medianprops"] = {"color": color, "linewidth": 1.8}
            ax.boxplot(averages, positions=[place], widths=0.6, showfliers=False, **look)
            spread = np.linspace(-0.22, 0.22, len(averages))
            ax.plot(place + spread, averages, ".", color=color, markersize=3.0, alpha=0.6, markeredgewidth=0)
        ax.axhline(6.0, **EXPECTED, zorder=0.9)
        names = [LABELS[variant] for variant in variants]
        ax.set_xticks(range(len(names)), names, rotation=40, ha="right", rotation_mode="anchor")
        ax.grid(False, axis="x")
        ax.set_title(f"{level}, {int(archive.done[level].sum())} runs")
    log_axis(axes[0], (1.0, 3.0))
    axes[0].set_ylabel("pose NEES, time average of a run [-]")
    figure.suptitle("Pose NEES run by run; line: 6 expected")
    return figure


def draw_study_figures(archive: StudyArchive) -> dict[str, Figure]:
    """Draw ``boxes``, and ``nees_<level>`` and ``errors_<level>`` of every level; return them by name."""
    figures = {"boxes": plot_study_boxes(archive)}
    for level in archive.study.levels:
        figures[f"nees_{level}"] = plot_study_nees(archive, level)
        figures[f"errors_{level}"] = plot_study_errors(archive, level)
    return figures
