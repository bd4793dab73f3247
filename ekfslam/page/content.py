"""What a page shows of archives: series of every run for its plots, and the judgement of each.

Archives of the same recording, by stamps, stand together: their runs share maps and plots.
"""

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
from ekfslam.evaluation.consistency import (
    chi2_bounds,
    measured_truth,
    pose_nees,
    world_axes_errors,
    world_axes_std,
)
from ekfslam.evaluation.honesty import Honesty, judge
from ekfslam.evaluation.summary import summarise
from ekfslam.evaluation.trajectory import distance_along
from ekfslam.figures.style import (
    BLUE,
    GREEN,
    GREY,
    LANDMARK_COLOR,
    ORANGE,
    PURPLE,
    SKY_BLUE,
    VERMILLION,
    style_of,
)
from ekfslam.filters.result import Landmarks, Result
from ekfslam.geometry.motion import world_axes_covariance
from ekfslam.storage.archive import Archive

POINTS = 1500  # of a series; longer ones are thinned evenly
POSES = 24  # with an ellipse or an arrow
BAND_SIGMAS = 3.0
PROBABILITY = 0.95  # of the bounds of NIS and NEES
PART = " \u00b7 "  # between the parts of a label
_DASHES = {"-": "", "--": "7 4", ":": "2 3", "-.": "8 3 2 3"}
_COLORS = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY_BLUE)
_PALETTE = tuple((color, dash) for dash in ("", "7 4", "2 3") for color in _COLORS)


@dataclass(frozen=True)
class Run:
    """One mode of one archive.

    Args:
        label: Names it on the page.
        archive, result: What it is of.
        color, dash: Of its lines: a colour as ``#rrggbb``, and lengths of dashes and gaps in SVG's way.
        shown: Whether maps show it from the beginning.
    """

    label: str
    archive: Archive
    result: Result
    color: str
    dash: str
    shown: bool

    @cached_property
    def summary(self) -> dict[str, float | int | None]:
        return summarise(self.archive, self.result)

    @cached_property
    def honesty(self) -> Honesty:
        """The judgement by innovations and truth."""
        return judge(self.result, truth=self.archive.truth, interpolated=self.archive.interpolated)

    @property
    def said(self) -> list[str]:
        """Verdicts in words: the main one, its reasons, and one line for each other verdict."""
        if not self.honesty.judgements:
            return [self.honesty.innovations_skipped]
        main, *others = self.honesty.judgements
        return [main.text, *main.reasons, *(f"{other.text}: {', '.join(other.reasons)}" for other in others)]


@dataclass(frozen=True)
class Recording:
    """Runs on the same recording."""

    name: str
    runs: tuple[Run, ...]

    @property
    def archive(self) -> Archive:
        """The first archive, whose truth is shown."""
        return self.runs[0].archive

    @property
    def length_m(self) -> float:
        """Way along the truth, or along the last run where there is none."""
        truth = self.archive.truth
        known = truth is not None and len(truth.frame) > 1
        T = truth.T_world_imu if truth is not None and known else self.runs[-1].result.T_world_imu
        return float(distance_along(T)[-1])


def recordings_of(archives: Mapping[str, Archive]) -> list[Recording]:
    """Archives, by label, sorted by recording: those with the same name and stamps stand together."""
    groups: list[dict[str, Archive]] = []
    for label, archive in archives.items():
        for group in groups:
            first = next(iter(group.values()))
            if first.name == archive.name and np.array_equal(first.time_s, archive.time_s):
                group[label] = archive
                break
        else:
            groups.append({label: archive})
    return [Recording(next(iter(group.values())).name, tuple(_runs(group))) for group in groups]


def _runs(archives: Mapping[str, Archive]) -> Iterator[Run]:
    """Runs of the archives of a recording: of one in the colours of their modes, of several each in its own."""
    if len(archives) == 1:
        archive = next(iter(archives.values()))
        for mode, result in archive.results.items():
            style = style_of(mode)
            yield Run(mode, archive, result, to_hex(style["color"]), _DASHES.get(style["linestyle"], ""), True)
        return
    best, others = iter(_PALETTE), iter(_PALETTE[len(archives) :] * len(MODES))
    for label, archive in zip(_told_apart(list(archives)), archives.values(), strict=True):
        shown = "full" if "full" in archive.results else list(archive.results)[-1]
        for mode, result in archive.results.items():
            color, dash = next(best if mode == shown else others, (GREY, "1 3"))
            yield Run(f"{label}: {mode}", archive, result, to_hex(color), dash, mode == shown)


def _told_apart(labels: Sequence[str]) -> list[str]:
    """Labels without the parts at their beginnings and ends that all have in common."""
    parts = [label.split(PART) for label in labels]
    for end in (0, -1):
        while min(map(len, parts)) > 1 and len({part[end] for part in parts}) == 1:
            parts = [part[1:] if end == 0 else part[:-1] for part in parts]
    return [PART.join(part) for part in parts]


def plotted(recording: Recording) -> dict[str, Any]:
    """Everything that the script of a page draws of a recording, ready for JSON; arrays as `packed`."""
    archive = recording.archive
    time_s = archive.time_s - archive.time_s[0]
    every = max(-(-len(time_s) // POINTS), 1)
    kept = np.unique(np.append(np.arange(0, len(time_s), every), len(time_s) - 1))
    return {
        "name": recording.name,
        "every": every,
        "landmarkColor": to_hex(LANDMARK_COLOR),
        "time": packed(time_s[kept]),
        "truth": _truth(archive, time_s),
        "runs": [_plotted_run(run, kept, time_s) for run in recording.runs],
    }


def _truth(archive: Archive, time_s: Array) -> dict[str, Any] | None:
    truth = archive.truth
    if truth is None or not len(truth.frame):
        return None
    some = thinned(len(truth.frame), POINTS)
    return {
        "time": packed(time_s[truth.frame[some]]),
        "xyz": packed(truth.T_world_imu[some, :3, 3]),
        "way": packed(distance_along(truth.T_world_imu)[some]),
        "landmarks": packed(truth.position_m),
    }


def _plotted_run(run: Run, kept: IntArray, time_s: Array) -> dict[str, Any]:
    result = run.result
    T, some = result.T_world_imu, thinned(len(result.time_s), POSES)
    std = world_axes_std(T[kept], result.covariance[kept])
    return {
        "label": run.label,
        "mode": result.mode,
        "dash": run.dash,
        "shown": run.shown,
        "xyz": packed(T[kept, :3, 3]),
        "std": packed(std[:, :3]),
        "way": packed(distance_along(T)[kept]),
        "marks": {
            "xyz": packed(T[some, :3, 3]),
            "forward": packed(T[some, :3, 0]),
            "cov": packed(_upper(world_axes_covariance(T[some], result.covariance[some])[0])),
        },
        "landmarks": _landmarks(result.landmarks),
        "errors": _errors(run, kept, time_s),
        "nis": _nis(result, time_s),
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


def _errors(run: Run, kept: IntArray, time_s: Array) -> dict[str, Any] | None:
    """Errors along world axes with their bands at true poses, and the NEES that they have."""
    truth = run.archive.truth
    if truth is None or not len(truth.frame):
        return None
    result = run.result
    of_truth = np.flatnonzero(np.isin(truth.frame, kept))
    frame, T_true = truth.frame[of_truth], truth.T_world_imu[of_truth]
    in_degrees = np.repeat([1.0, np.rad2deg(1.0)], 3)
    errors = in_degrees * world_axes_errors(result.T_world_imu[frame], T_true)
    bands = BAND_SIGMAS * in_degrees * world_axes_std(result.T_world_imu[frame], result.covariance[frame])
    judged = measured_truth(truth, run.archive.interpolated, result.time_s)
    judged_frame, nees = pose_nees(result, judged, with_truth_noise=True)
    shown = np.isfinite(nees) & np.isin(judged_frame, kept)
    low, high = chi2_bounds(6, PROBABILITY)
    return {
        "time": packed(time_s[frame]),
        "error": packed(errors),
        "band": packed(bands),
        "inside": float(np.mean(np.abs(errors) <= bands)),
        "neesTime": packed(time_s[judged_frame[shown]]),
        "nees": packed(nees[shown]),
        "neesBounds": [float(low), float(high)],
        "neesMean": float(np.nanmean(nees)) if np.isfinite(nees).any() else None,
    }


def _nis(result: Result, time_s: Array) -> dict[str, Any] | None:
    innovation = result.innovation
    seen = np.flatnonzero(innovation.dof > 0)
    if not len(seen):
        return None
    dof = innovation.dof[seen]
    value = innovation.nis[seen] / dof
    low, high = (bound / dof for bound in chi2_bounds(dof, PROBABILITY))
    some = thinned(len(seen), POINTS)
    return {
        "time": packed(time_s[seen[some]]),
        "value": packed(value[some]),
        "low": packed(low[some]),
        "high": packed(high[some]),
        "inside": float(np.mean((value >= low) & (value <= high))),
        "mean": float(innovation.nis.sum() / innovation.dof.sum()),
    }


def thinned(length: int, most: int) -> IntArray:
    """At most ``most`` indices spread over ``length``, first and last included."""
    return np.unique(np.linspace(0, length - 1, min(most, length)).astype(np.int64))


def packed(values: Array) -> str:
    """An array as base64 of its 32-bit floats, row by row: half the size of digits."""
    return base64.b64encode(np.ascontiguousarray(values, dtype="<f4").tobytes()).decode()


def _upper(covariance: Array) -> Array:
    """xx, xy, xz, yy, yz, zz of (n, 3, 3): (n, 6)."""
    rows, columns = np.triu_indices(3)
    return covariance[:, rows, columns]


def remarks_of(recording: Recording) -> Sequence[str]:
    """What has to be said of the plots."""
    frames = len(recording.archive.time_s)
    every = -(-frames // POINTS)
    return () if every < 2 else (f"Plots show every {every}th of {frames} frames; figures of merit are of all.",)
