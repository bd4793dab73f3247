"""Measure the time of a frame: engine and reference filter, and the joint filter against GTSAM's iSAM2.

Three tables, on one BLAS thread. Runs take turns (A B A B ...), so other work on the machine affects all alike:

- *Observations per frame*: `builtin:city` with 30 to 1000; engine and reference filter, the same to rounding.
- *Laps*: a ring of 40 m radius, driven three times. Landmarks out of view are dormant, and return exactly.
- *The race*: total seconds of the joint filter on the UTIAS drives, with white noise as in GTSAM's factors, and with
  the automatic model. iSAM2 (relinearizeSkip 10, Cauchy) runs on the observations that the filter accepted, without
  and with the covariance of its last pose in every frame. Building its factors is not counted.

    python experiments/benchmark.py [--data DIR] [--out DIR] [--repeat N] [--quick]
"""

from __future__ import annotations

import argparse
import platform
import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np
from common import UTIAS, argument_parser, has_recordings, trajectory_errors, write
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator
from threadpoolctl import threadpool_limits

import ekfslam
from ekfslam.data.sequence import Sequence
from ekfslam.data.simulate import builtin
from ekfslam.evaluation.tables import document, markdown_table, number
from ekfslam.figures.style import BAND_ALPHA, VARIANTS, styled

OBSERVATIONS = (30, 60, 120, 250, 500, 1000)
FILTERS = ("engine", "reference")
REFERENCE_LIMIT = 500  # beyond it fewer frames
WHITE: dict[str, dict[str, Any]] = {"noise": {"model": "white"}, "filter": {"relative_frames": 0}}
XYZ: dict[str, dict[str, Any]] = {**WHITE, "filter": {"relative_frames": 0, "landmark_coordinates": "xyz"}}
AUTOMATIC: dict[str, dict[str, Any]] = {"filter": {"relative_frames": 0}}


def in_turn(tasks: Mapping[str, Callable[[], Any]], repeat: int) -> dict[str, list[Any]]:
    """Run the tasks in turn, ``repeat`` times, and return the results of each."""
    found: dict[str, list[Any]] = {name: [] for name in tasks}
    with threadpool_limits(1, user_api="blas"):
        for _ in range(repeat):
            for name, task in tasks.items():
                found[name].append(task())
    return found


def city(observations: int, frames: int) -> Sequence:
    """Return a city with about that many observations in each frame."""
    tracks, density = int(1.1 * observations), max(4.0, observations / 12.0)
    return builtin(f"city?frames={frames}&max_tracks={tracks}&landmarks_per_m={density}")


def of_filter(name: str) -> dict[str, Any]:
    """Return the settings of one implementation of the filter."""
    return {"filter": {"engine": name, "relative_frames": 0}}


def milliseconds(sequence: Sequence, settings: dict[str, Any]) -> np.ndarray:
    """Return the milliseconds of each frame of a run in mode full."""
    return ekfslam.run(sequence, "full", ekfslam.Config().with_overrides(settings)).ms_per_frame


def by_observations(repeat: int, sizes: tuple[int, ...]) -> list[dict[str, Any]]:
    """Measure milliseconds per frame against observations per frame."""
    rows = []
    for size in sizes:
        sequence = city(size, 60 if size <= REFERENCE_LIMIT else 30)
        tasks = {name: partial(milliseconds, sequence, of_filter(name)) for name in FILTERS}
        found = {name: np.concatenate([ms[10:] for ms in all_ms]) for name, all_ms in in_turn(tasks, repeat).items()}
        row: dict[str, Any] = {"observations": float(np.bincount(sequence.observations.frame)[10:].mean())}
        for name, ms in found.items():
            row[name] = {"median": float(np.median(ms)), "p95": float(np.percentile(ms, 95)), "max": float(ms.max())}
        rows.append(row)
        print(row, flush=True)
    return rows


def by_laps(laps: int = 3) -> list[dict[str, Any]]:
    """Measure the seconds and the longest frame of each lap of a ring, where landmarks come back."""
    frames = int(laps * 2 * np.pi * 40.0 / 8.0 / 0.1)
    sequence = builtin(f"loop?radius_m=40&landmarks=394&landmark_offset_m=16&frames={frames}")
    settings: dict[str, dict[str, Any]] = {
        "never retired, reference filter": {"retire": "never", "engine": "reference"},
        "asleep out of view": {"retire": "never"},
        "retired, from the batch problem": {"retire": "unseen", "retire_after": 10},
    }
    rows = []
    tasks = {
        name: partial(milliseconds, sequence, {"filter": {**own, "relative_frames": 0}})
        for name, own in settings.items()
    }
    for name, (ms,) in in_turn(tasks, 1).items():
        each = np.array_split(ms, laps)
        row = {"name": name, "laps_s": [float(lap.sum()) / 1e3 for lap in each], "median_ms": float(np.median(ms))}
        rows.append({**row, "max_ms": [float(lap.max()) for lap in each]})
        print(rows[-1], flush=True)
    return rows


def race(data: Path, files: tuple[str, ...], repeat: int) -> list[dict[str, Any]]:
    """Measure total seconds of the filter, and of iSAM2 on the observations that it accepted."""
    from map_against_gtsam import RELINEARISE, factors_of, incremental, open_set

    def seconds_of_isam(result: ekfslam.Result, factors: Any, pose_covariance: bool = False) -> np.ndarray:
        # A weak prior on every landmark: without it a landmark behind a camera leaves the system singular.
        options = {"skip": 10, "pose_covariance": pose_covariance}
        return 1e3 * incremental(result, factors, RELINEARISE, 1000.0, **options)[1]  # type: ignore[arg-type]

    rows = []
    for file in files:
        sequence = open_set(data, file)
        settings = {**WHITE, "posterior": {"kernel": "cauchy"}}
        white = ekfslam.run(sequence, "full", ekfslam.Config().with_overrides(settings))
        factors = factors_of(white, ekfslam.PosteriorConfig(kernel="cauchy"))
        isam = partial(seconds_of_isam, white, factors)
        runs = in_turn(
            {
                "white": partial(milliseconds, sequence, WHITE),
                "white, xyz": partial(milliseconds, sequence, XYZ),
                "automatic": partial(milliseconds, sequence, AUTOMATIC),
                "iSAM2": isam,
                "iSAM2 with covariance": partial(isam, pose_covariance=True),
            },
            repeat,
        )
        row = {"name": sequence.name, "frames": len(sequence)}
        for name, all_ms in runs.items():
            ms = np.median(all_ms, axis=0)
            spread = {"median": float(np.median(ms)), "p95": float(np.percentile(ms, 95)), "max": float(ms.max())}
            row[name] = {"s": median(float(ms.sum()) / 1e3 for ms in all_ms), **spread}
        rows.append({**row, "ate_m": trajectory_errors(sequence, white.T_world_imu)["ate_m"]})
        print(rows[-1], flush=True)
    return rows


def dgemm_gflops() -> float:
    """Return the rate of one thread at 500 x 500 matrices."""
    A = np.random.default_rng(0).normal(size=(500, 500))
    with threadpool_limits(1, user_api="blas"):
        best = np.inf
        for _ in range(20):
            begin = perf_counter()
            A @ A
            best = min(best, perf_counter() - begin)
    return 2.0 * 500**3 / best / 1e9


@styled
def figure(rows: list[dict[str, Any]]) -> Figure:
    """Draw milliseconds per frame against observations per frame."""
    drawn = Figure(figsize=(5.0, 3.6))
    axes = drawn.add_subplot()
    for name, style in (("reference", VARIANTS["standard"]), ("engine", VARIANTS["invariant"])):
        x = [row["observations"] for row in rows]
        axes.plot(x, [row[name]["median"] for row in rows], **style, label=f"{name} name")
        lower, upper = ([row[name][key] for row in rows] for key in ("median", "p95"))
        axes.fill_between(x, lower, upper, color=style["color"], alpha=BAND_ALPHA, linewidth=0)
    axes.set(xscale="log", yscale="log", xlabel="observations a frame", ylabel="time a frame (ms), median to 95 %")
    axes.set_xticks(OBSERVATIONS[: len(rows)], [str(size) for size in OBSERVATIONS[: len(rows)]])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.legend()
    return drawn


def tables(found: dict[str, Any]) -> str:
    """Return all three tables as Markdown."""
    sizes = [
        [
            number(row["observations"], ".0f"),
            *(f"{row[name]['median']:.1f} ({row[name]['p95']:.1f})" for name in FILTERS),
            f"{row['reference']['median'] / row['engine']['median']:.2f}",
        ]
        for row in found["observations"]
    ]
    laps = [
        [
            row["name"],
            *(f"{s:.2f}" for s in row["laps_s"]),
            f"{row['laps_s'][2] / row['laps_s'][1]:.2f}",
            f"{max(row['max_ms']) / row['median_ms']:.1f}",
        ]
        for row in found["laps"]
    ]
    parts = [
        f"One BLAS thread of {found['machine']}, {found['dgemm_gflops']:.0f} Gflop/s at 500 x 500; runs take turns.",
        "Milliseconds a frame on `builtin:city`, median (95 %):",
        markdown_table(["observations", *FILTERS, "reference / engine"], sizes),
        "A ring of 40 m radius with 394 landmarks, seconds a lap:",
        markdown_table(["landmarks out of view", "lap 1", "lap 2", "lap 3", "3 / 2", "longest / median frame"], laps),
    ]
    if found["race"]:
        parts += race_tables(found["race"])
    return document("# Benchmark", *parts)


def race_tables(rows: list[dict[str, Any]]) -> list[str]:
    """Return total seconds and ratios on the recordings, and the spread over frames."""
    ours, theirs = ("white", "white, xyz", "automatic"), ("iSAM2", "iSAM2 with covariance")
    totals, ratios, spreads = [], [], []
    for row in rows:
        pairs = [(them, us) for us in ours for them in theirs]
        ratios.append([row[them]["s"] / row[us]["s"] for them, us in pairs])
        totals.append([row["name"], *(f"{row[name]['s']:.2f}" for name in ours + theirs)])
        totals[-1] += [f"{ratio:.1f}" for ratio in ratios[-1]]
        spreads.append([row["name"]])
        for name in ours + theirs:
            ms = row[name]
            spreads[-1].append(f"{ms['median']:.1f} ({ms['p95'] / ms['median']:.1f}, {ms['max'] / ms['median']:.1f})")
    totals.append(["median", *[""] * len(ours + theirs), *(f"{ratio:.1f}" for ratio in np.median(ratios, axis=0))])
    header = [f"{them} / {us}" for us in ours for them in theirs]
    return [
        "Total seconds on the recordings, of the joint filter (white noise with landmarks in image coordinates; the "
        "same in xyz; automatic model) and of iSAM2, without and with its pose covariance in each frame; and ratios:",
        markdown_table(["drive", *(f"{name} s" for name in ours + theirs), *header], totals),
        "A frame: median in ms (95 % and longest in medians):",
        markdown_table(["drive", *ours, *theirs], spreads),
    ]


def main() -> None:
    parser: argparse.ArgumentParser = argument_parser(__doc__, "benchmark", data=True)
    parser.add_argument("--repeat", type=int, default=3, metavar="N", help="runs of each (default: %(default)s)")
    parser.add_argument("--quick", action="store_true", help="small sizes only, no recordings")
    options = parser.parse_args()
    found: dict[str, Any] = {"machine": platform.machine(), "dgemm_gflops": dgemm_gflops()}
    sizes = OBSERVATIONS[:3] if options.quick else OBSERVATIONS
    found["observations"] = by_observations(options.repeat, sizes)
    found["laps"] = by_laps()
    found["race"] = []
    try:
        import gtsam  # noqa: F401
    except ModuleNotFoundError:
        print("no race: GTSAM is missing, pip install 'ekfslam[bench]'", file=sys.stderr)
    else:
        if not options.quick and has_recordings(options.data, *UTIAS):
            found["race"] = race(options.data, UTIAS, options.repeat)
    write(options.out, "benchmark", found, tables(found), {"benchmark": figure(found["observations"])})


if __name__ == "__main__":
    main()
