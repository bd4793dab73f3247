"""Content of a page of archives: the series of every run for its plots, and its judgement."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from matplotlib.colors import to_hex

from ekfslam.arrays import Array, IntArray
from ekfslam.config import MODES
from ekfslam.data.sequence import Truth
from ekfslam.evaluation.consistency import world_axes_std
from ekfslam.evaluation.honesty import Honesty, judge
from ekfslam.evaluation.summary import summarise
from ekfslam.evaluation.trajectory import distance_along
from ekfslam.figures import series
from ekfslam.figures.maps import SIGMAS, spread
from ekfslam.figures.series import Series
from ekfslam.figures.style import GREY, LANDMARK_COLOR, RUN_COLORS, style_of
from ekfslam.filters.result import Landmarks, Result
from ekfslam.geometry.motion import world_axes_covariance
from ekfslam.names import without_common_ends
from ekfslam.storage.archive import Archive

POINTS = 1500  # of a series; longer ones are thinned evenly
POSES = 24  # with an ellipse or an arrow
PART = " \u00b7 "  # between the parts of a label
_DASHES = {"-": "", "--": "7 4", ":": "2 3", "-.": "8 3 2 3"}
_PALETTE = tuple((color, dash) for dash in ("", "7 4", "2 3") for color in RUN_COLORS)
# A series, its name in tooltips, its style in ``report.css`` (``truth``, ``thin``, ``dots`` or none), and the numbers
# of the runs in whose colours the curve and its bounds are drawn (None: black and grey).
Curve = tuple[Series, str, str, int | None, int | None]


@dataclass(frozen=True)
class Run:
    """One mode of one archive: colour ``#rrggbb`` and SVG dashes of its lines, and whether maps show it at first."""

    label: str
    archive: Archive
    result: Result
    color: str
    dash: str
    shown: bool

    @property
    def truth(self) -> Truth | None:
        """The truth, if any pose of it is known."""
        truth = self.archive.truth
        return truth if truth is not None and len(truth.frame) else None

    @cached_property
    def summary(self) -> dict[str, float | int | None]:
        return summarise(self.archive, self.result)

    @cached_property
    def honesty(self) -> Honesty:
        """The judgement by innovations and truth."""
        return judge(self.result, truth=self.archive.truth, interpolated=self.archive.interpolated)

    @property
    def said(self) -> list[str]:
        """The verdict of `ekfslam check` and its reasons."""
        return [self.honesty.headline, *self.honesty.reasons]


@dataclass(frozen=True)
class Section:
    """Runs on one recording, which share maps and plots: a section of the page."""

    name: str
    runs: tuple[Run, ...]

    @property
    def archive(self) -> Archive:
        """The first archive, whose truth is shown."""
        return self.runs[0].archive

    @property
    def truth(self) -> Truth | None:
        """The truth of the first archive, if any pose of it is known."""
        return self.runs[0].truth

    @property
    def length_m(self) -> float:
        """Distance driven, by the truth or else the last run."""
        T = self.runs[-1].result.T_world_imu if self.truth is None else self.truth.T_world_imu
        return float(distance_along(T)[-1])


def sections_of(archives: Mapping[str, Archive]) -> list[Section]:
    """Return archives, given by label, in sections of recordings with the same name and stamps."""
    groups: dict[tuple[str, bytes], dict[str, Archive]] = {}
    for label, archive in archives.items():
        groups.setdefault((archive.name, archive.time_s.tobytes()), {})[label] = archive
    return [Section(name, tuple(_runs(group))) for (name, _), group in groups.items()]


def _runs(archives: Mapping[str, Archive]) -> Iterator[Run]:
    """Yield the runs of a recording: of one archive in the colours of their modes, of several each in its own."""
    if len(archives) == 1:
        archive = next(iter(archives.values()))
        for mode, result in archive.results.items():
            style = style_of(mode)
            yield Run(mode, archive, result, to_hex(style["color"]), _DASHES.get(style["linestyle"], ""), True)
        return
    best, others = iter(_PALETTE), iter(_PALETTE[len(archives) :] * len(MODES))
    for label, archive in zip(told_apart(list(archives)), archives.values(), strict=True):
        shown = "full" if "full" in archive.results else list(archive.results)[-1]
        for mode, result in archive.results.items():
            color, dash = next(best if mode == shown else others, (GREY, "1 3"))
            yield Run(f"{label}: {mode}", archive, result, to_hex(color), dash, mode == shown)


def told_apart(labels: Sequence[str]) -> list[str]:
    """Return labels without common parts at both ends, cut to the shortest ends that differ."""
    parts = [label.split(PART) for label in without_common_ends(labels, PART)]
    shortened = ([part[-length:] for part in parts] for length in range(1, max(map(len, parts)) + 1))
    ends = next(ends for ends in shortened if len(set(map(tuple, ends))) == len(set(map(tuple, parts))))
    return [PART.join(end) for end in ends]


def plotted(section: Section) -> dict[str, Any]:
    """Return the values that the script of a page draws of a recording, ready for JSON."""
    archive = section.archive
    time_s = archive.time_s - archive.time_s[0]
    kept, truth = spread(len(time_s), POINTS), section.truth
    return {
        "sigmas": SIGMAS,
        "landmarkColor": to_hex(LANDMARK_COLOR),
        "time": packed(time_s[kept]),
        "truth": truth and _truth(truth),
        "plots": _compared(section),
        "runs": [_plotted_run(section, j, kept) for j in range(len(section.runs))],
    }


def _truth(truth: Truth) -> dict[str, Any]:
    some = spread(len(truth.frame), POINTS)
    return {"xyz": packed(truth.T_world_imu[some, :3, 3]), "landmarks": packed(truth.position_m)}


def _compared(section: Section) -> list[dict[str, Any]]:
    """Return the plots that show several runs: heights, and distances from the truth."""
    shown, truth = [(j, run) for j, run in enumerate(section.runs) if run.shown], section.truth
    best = next((j for j, run in shown if run.result.mode == "full"), shown[0][0])
    heights: list[Curve] = [] if truth is None else [(series.height(truth.T_world_imu), "truth", "truth", None, None)]
    for j, run in shown:
        one = series.height_of(run.result, truth, has_band=j == best)
        heights.append((one, run.label, "", j, j))
    words = f"z in m over metres driven; band: {series.BAND_SIGMAS:g} sigma of {section.runs[best].label}"
    plots = [_plot("Height profile", words, heights)]
    off: list[Curve] = []
    for j, run in shown:
        if run.truth is not None:
            for align, name, kind in ((False, run.label, ""), (True, f"{run.label}, aligned", "thin")):
                off.append((series.distance_from_truth(run.result, run.truth, align), name, kind, j, None))
    if off:
        plots.append(_plot("Distance from the truth", "m from a common first pose; thin: SE(3)-aligned", off))
    return plots


def _plotted_run(section: Section, j: int, kept: IntArray) -> dict[str, Any]:
    run, truth = section.runs[j], section.runs[j].truth
    result, T = run.result, run.result.T_world_imu
    some = spread(len(T), POSES)
    errors = [] if truth is None else series.errors(result, truth)
    words = "Without truth there are no errors to show."
    if errors:
        words = f"Estimate minus truth along the axes of world, with bounds: {series.inside_words(errors)}."
    return {
        "label": run.label,
        "mode": result.mode,
        "dash": run.dash,
        "shown": run.shown,
        "xyz": packed(T[kept, :3, 3]),
        "std": packed(world_axes_std(T[kept], result.covariance[kept])[:, :3]),
        "marks": {
            "xyz": packed(T[some, :3, 3]),
            "forward": packed(T[some, :3, 0]),
            "cov": packed(_upper(world_axes_covariance(T[some], result.covariance[some])[0])),
        },
        "landmarks": _landmarks(result.landmarks),
        "words": words,
        "errors": [_plot(one.name, one.unit, [(one, "error", "thin", None, j)]) for one in errors],
        "inertial": list(_inertial(run, j)),
        "consistency": list(_consistency(run, j)),
    }


def _inertial(run: Run, j: int) -> Iterator[dict[str, Any]]:
    """Yield the plots of velocity and biases of an inertial unit; the errors of its pose are shown with all others."""
    for one, true in series.inertial(run.result, run.truth):
        if one.low is not None and not one.name.startswith(("tilt", "heading")):
            of_truth: list[Curve] = [] if true is None else [(true, "truth", "truth", None, None)]
            yield _plot(one.name, one.unit, [*of_truth, (one, run.label, "thin", None if one.levels else j, j)])


def _consistency(run: Run, j: int) -> Iterator[dict[str, Any]]:
    """Yield the plots of NEES and NIS of a run."""
    percent = f"{100 * series.PROBABILITY:g} %"
    if run.truth is not None and run.result.has_covariance:
        nees = series.nees(run.result, run.truth, run.archive.interpolated)
        if nees.mean is not None:
            words = f"6 expected, mean {nees.mean:.3g}; grey: {percent} of honest poses"
            yield _plot("Pose NEES", words, [(nees, "NEES", "thin", j, None)])
    nis = series.nis(run.result)
    if nis.mean is not None:
        words = (
            f"1 expected, mean {nis.mean:.3g}; {100 * nis.share_inside:.1f} % of frames within their {percent}, grey"
        )
        yield _plot("NIS per degree of freedom", words, [(nis, "NIS / dof", "dots", j, None)])


def _plot(title: str, words: str, curves: Sequence[Curve]) -> dict[str, Any]:
    """Return a plot of curves with the axes of the first one."""
    first, drawn = curves[0][0], []
    for one, name, kind, run, band in curves:
        some = one.only(spread(len(one.x), POINTS))
        arrays = {"x": some.x, "y": some.y, "low": some.low, "high": some.high}
        found = {key: packed(values) for key, values in arrays.items() if values is not None}
        drawn.append({"name": name, "kind": kind, "run": run, "band": band, **found})
    return {
        "title": title,
        "words": words,
        "unit": first.unit,
        "xUnit": first.x_unit,
        "xLabel": first.labels[0],
        "log": any(one.is_log for one, *_ in curves),
        "levels": first.levels,
        "curves": drawn,
    }


def _landmarks(landmarks: Landmarks) -> dict[str, Any] | None:
    if not len(landmarks):
        return None
    return {
        "id": [str(i) for i in landmarks.id.tolist()],  # a number of JavaScript holds 53 bits
        "xyz": packed(landmarks.position_m),
        "cov": packed(_upper(landmarks.covariance)),
        "count": landmarks.observations.tolist(),
    }


def packed(values: Array) -> dict[str, str]:
    """Return an array as base64 of its 32-bit floats, row by row."""
    return {"f32": base64.b64encode(np.ascontiguousarray(values, dtype="<f4").tobytes()).decode()}


def _upper(covariance: Array) -> Array:
    """Return xx, xy, xz, yy, yz, zz of (n, 3, 3) as (n, 6)."""
    rows, columns = np.triu_indices(3)
    return covariance[:, rows, columns]


def remarks_of(section: Section) -> Sequence[str]:
    """Return remarks on the plots."""
    frames = len(section.archive.time_s)
    return () if frames <= POINTS else (f"Plots show {POINTS} of {frames} frames; figures of merit are of all.",)
