"""Race the joint filter against its reference, a textbook EKF, and GTSAM, frame by frame in turn.

Every frame goes to all contenders before the next one, on one BLAS thread, in CPU time of the process, so other work on
the machine affects all alike. Five tables:

- *The race*: engine and reference filter with the automatic model; engine with white noise; a textbook EKF (ordinary
  linearisation, landmarks in xyz, white noise); GTSAM's iSAM2 (relinearizeSkip 10, Cauchy), without and with the
  covariance of its last pose; GTSAM's fixed-lag smoother (20 frames); GTSAM's batch solver, once at the end. GTSAM gets
  the observations that the filter with white noise accepted, and the same noise. Building its factors from Python is
  not counted. The textbook EKF retires landmarks out of view, else a frame costs minutes.
- *A whole run*: `ekfslam.run` with all that it decides and reports, against the sum of iSAM2's updates.
- *Observations*: `builtin:city` with 30 to 1000 a frame, with the floating point operations of the engine's BLAS calls.
- *Length*: `builtin:city` with 10^3 to 5 10^4 frames, every one in a new process for its peak memory.
- *Laps*: a ring that is driven 20 times. Landmarks out of view are dormant, and return exactly.

    python experiments/benchmark.py [--data DIR] [--out DIR] [--only TABLE ...] [--quick]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from time import process_time
from typing import Any, NamedTuple

import numpy as np
from common import UTIAS, argument_parser, has_recordings, trajectory_errors, truth_of, write
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator
from threadpoolctl import threadpool_limits

import ekfslam
from ekfslam.arrays import Array
from ekfslam.config import Config, PosteriorConfig
from ekfslam.data.sequence import Sequence
from ekfslam.data.simulate import builtin
from ekfslam.engine.face import flops
from ekfslam.evaluation.tables import MISSING, document, markdown_table
from ekfslam.figures.style import BAND_ALPHA, GREY, ORANGE, VARIANTS, styled
from ekfslam.filters import JointEKF
from ekfslam.filters.loop import run_filter
from ekfslam.geometry import se3
from ekfslam.resolve import resolve
from ekfslam.smoother.revival import MapRevival

OBSERVATIONS = (30, 60, 120, 250, 500, 1000)
LENGTHS = (1000, 10_000, 50_000)
LAPS = 20
LAG = 20  # frames of the fixed-lag smoother
TIED_M = 1000.0  # prior on every landmark of GTSAM: without it one behind a camera leaves the system singular
WHITE: dict[str, dict[str, Any]] = {"noise": {"model": "white"}}
FILTERS: dict[str, dict[str, dict[str, Any]]] = {
    "engine": {"filter": {"engine": "engine"}},
    "reference": {"filter": {"engine": "reference"}},
    "engine, white": {**WHITE, "filter": {"engine": "engine"}},
    "textbook": {**WHITE, "filter": {"engine": "reference", "variant": "standard", "landmark_coordinates": "xyz"}},
}
ISAM, ISAM_P, FIXED_LAG, BATCH = "iSAM2", "iSAM2, covariance", "fixed lag", "batch"
CONTENDERS = (*FILTERS, ISAM, ISAM_P, FIXED_LAG)


class Step(NamedTuple):
    """One frame of a contender: CPU milliseconds, pose, covariance of ``T = exp(xi^) T_hat`` if it has one, Mflop."""

    ms: float
    T_world_imu: Array
    covariance: Array | None = None
    mflop: float = np.nan


# --- Contenders ------------------------------------------------------------------------------------------------------


def joint(sequence: Sequence, settings: Mapping[str, Mapping[str, Any]]) -> Iterator[Step]:
    """Yield the frames of the joint filter."""
    problem = resolve(sequence, Config().with_overrides(settings).with_overrides({"filter": {"relative_frames": 0}}))
    ekf = JointEKF(problem.model, problem.config.filter, revival=MapRevival(problem.model, problem.config.filter))
    before = flops()
    for frame in run_filter(ekf, problem.sequence, clock=process_time):
        P = ekf.gaussian.body_covariance[:6, :6].copy()
        yield Step(frame.ms, ekf.T_world_imu, P, 1e-6 * (flops() - before))
        before = flops()  # others have had their turn


def isam(white: ekfslam.Result, factors: Any, *, covariance: bool = False, lag: int | None = None) -> Iterator[Step]:
    """Yield the frames of iSAM2, or of the fixed-lag smoother that is built on it."""
    import gtsam
    from gtsam.symbol_shorthand import L, X
    from map_against_gtsam import RELINEARISE, ROTATION_FIRST, Frames, log_of

    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(RELINEARISE)
    parameters.relinearizeSkip = 10
    solver = gtsam.ISAM2(parameters) if lag is None else gtsam.IncrementalFixedLagSmoother(float(lag), parameters)
    log = log_of(white)
    seen_last = np.full(log.landmarks, -np.inf)
    frames = Frames(white, factors, TIED_M)
    for k in range(len(white.time_s)):
        seen = frames.seen(k)
        # A landmark that the lag has left behind is marginalised, and cannot be seen again.
        before = seen_last[log.landmark[seen]]
        gone = np.isfinite(before) & (before < k - (lag or np.inf))
        graph, values, known = frames.graph(k, seen if lag is None else seen[~gone])
        seen_last[known] = k
        begin = process_time()
        if lag is None:
            solver.update(graph, values)
        else:
            stamps = gtsam.FixedLagSmootherKeyTimestampMap()
            for key in (X(k), *map(L, known.tolist())):
                stamps.insert((key, float(k)))
            solver.update(graph, values, stamps)
        pose = frames.continued_from(solver.calculateEstimatePose3(X(k)))
        P = solver.marginalCovariance(X(k))[np.ix_(ROTATION_FIRST, ROTATION_FIRST)] if covariance else None
        yield Step(1e3 * (process_time() - begin), pose, P)


# --- The tables ------------------------------------------------------------------------------------------------------


def in_turn(contenders: Mapping[str, Iterator[Step]]) -> dict[str, list[Step]]:
    """Return the frames of all contenders, which take turns; one that fails ends there."""
    found: dict[str, list[Step]] = {name: [] for name in contenders}
    running = dict(contenders)
    with threadpool_limits(1, user_api="blas"):
        while running:
            for name, steps in list(running.items()):
                try:
                    found[name].append(next(steps))
                except StopIteration:
                    del running[name]
                except RuntimeError as error:
                    print(f"{name} ended after {len(found[name])} frames: {error}", file=sys.stderr)
                    del running[name]
    return found


def spread(steps: list[Step]) -> dict[str, float]:
    """Return total seconds, median, 95 % and longest milliseconds, and Mflop."""
    ms = np.array([step.ms for step in steps])
    return {
        "s": float(ms.sum()) / 1e3,
        "median": float(np.median(ms)),
        "p95": float(np.percentile(ms, 95)),
        "max": float(ms.max()),
        "mflop": float(np.median([step.mflop for step in steps])),
    }


def pose_nees(sequence: Sequence, steps: list[Step]) -> float | None:
    """Return the mean pose NEES (6 expected) over the frames with truth after the first one."""
    truth = truth_of(sequence)
    later = [(k, T) for k, T in zip(truth.frame.tolist(), truth.T_world_imu, strict=True) if 0 < k < len(steps)]
    if any(steps[k].covariance is None for k, _ in later):
        return None
    values = []
    for k, T in later:
        P = steps[k].covariance
        assert P is not None
        xi = se3.log(se3.inverse(T) @ steps[k].T_world_imu)
        values.append(float(xi @ np.linalg.solve(P, xi)))
    return float(np.mean(values))


def race(data: Path, files: tuple[str, ...]) -> list[dict[str, Any]]:
    """Measure every contender on recordings."""
    from map_against_gtsam import batch, factors_of, open_set, start_of, to_gtsam

    from ekfslam.smoother.posterior import posterior

    rows = []
    for file in files:
        sequence = open_set(data, file)
        config = PosteriorConfig(kernel="cauchy")
        white = ekfslam.run(sequence, "full", Config().with_overrides(WHITE))
        factors = factors_of(white, config)
        gtsam = {
            ISAM: isam(white, factors),
            ISAM_P: isam(white, factors, covariance=True),
            FIXED_LAG: isam(white, factors, lag=LAG, covariance=True),
        }
        found = in_turn({**{name: joint(sequence, own) for name, own in FILTERS.items()}, **gtsam})
        row: dict[str, Any] = {"name": sequence.name, "frames": len(sequence), "run_s": run_seconds(data / file)}
        for name, steps in found.items():
            row[name] = spread(steps)
            if len(steps) == len(sequence):
                errors = trajectory_errors(sequence, np.array([step.T_world_imu for step in steps]))
                row[name] |= {**errors, "nees": pose_nees(sequence, steps)}
        start = to_gtsam(*start_of(white, posterior(white, PosteriorConfig(linearisation="filtered")).problem))
        row[BATCH] = {"s": batch(factors.graph(), start, config.tolerance)[2]}
        rows.append(row)
        print(json.dumps(row), flush=True)
    return rows


def run_seconds(path: Path) -> float:
    """Return the CPU seconds of `ekfslam.run` of a recording that was read before."""
    sequence = ekfslam.open_sequence(path)
    begin = process_time()
    ekfslam.run(sequence, "full")
    return process_time() - begin


def city(observations: int, frames: int) -> Sequence:
    """Return a city with about that many observations in each frame."""
    tracks, density = int(1.1 * observations), max(4.0, observations / 12.0)
    return builtin(f"city?frames={frames}&max_tracks={tracks}&landmarks_per_m={density}")


def by_observations(sizes: tuple[int, ...]) -> list[dict[str, Any]]:
    """Measure milliseconds and Mflop of a frame against observations per frame."""
    rows = []
    for size in sizes:
        sequence = city(size, 60 if size <= 250 else 30)
        found = in_turn({name: joint(sequence, FILTERS[name]) for name in ("engine", "reference")})
        row: dict[str, Any] = {"observations": float(np.bincount(sequence.observations.frame)[10:].mean())}
        rows.append({**row, **{name: spread(steps[10:]) for name, steps in found.items()}})
        print(json.dumps(rows[-1]), flush=True)
    return rows


def measure_length(frames: int) -> dict[str, Any]:
    """Measure the frames of a drive of this length, and the peak memory of the process, MB (10^6 bytes)."""
    sequence = city(30, frames)
    simulated_mb = peak_mb()
    ms = np.array([step.ms for step in joint(sequence, FILTERS["engine"])])
    tenth = max(len(ms) // 10, 1)
    return {
        "frames": frames,
        "s": float(ms.sum()) / 1e3,
        "simulated_mb": simulated_mb,
        "peak_mb": peak_mb(),
        "first_ms": float(np.median(ms[10 : 10 + tenth])),
        "last_ms": float(np.median(ms[-tenth:])),
        "p95": float(np.percentile(ms, 95)),
        "max": float(ms.max()),
    }


def measure_laps(laps: int) -> list[dict[str, Any]]:
    """Measure the seconds and the longest frame of each lap of a ring, where landmarks come back."""
    frames = round(2 * np.pi * 40.0 / 8.0 / 0.1)
    sequence = builtin(f"loop?radius_m=40&landmarks=394&landmark_offset_m=16&frames={laps * frames}")
    rows = []
    for name, own in (
        ("asleep out of view", {"retire": "never"}),
        ("retired, from the batch problem", {"retire": "unseen", "retire_after": 10}),
    ):
        if name.startswith("retired"):
            sequence = sequence[: 3 * frames]  # each return solves the whole past
        ms = np.array([step.ms for step in joint(sequence, {"filter": own})])
        each = [ms[i : i + frames] for i in range(0, len(ms), frames)]
        row = {"name": name, "laps_s": [float(lap.sum()) / 1e3 for lap in each], "median_ms": float(np.median(ms))}
        rows.append({**row, "p95": float(np.percentile(ms, 95)), "max_ms": [float(lap.max()) for lap in each]})
        print(json.dumps(rows[-1]), flush=True)
    return rows


def peak_mb() -> float:
    """Return the peak memory of this process; that of `resource` would count the parent's, too."""
    status = Path("/proc/self/status")
    if not status.exists():
        return float("nan")
    return int(dict(line.split(":", 1) for line in status.read_text().splitlines())["VmHWM"].split()[0]) * 1024 / 1e6


def in_own_process(frames: int) -> dict[str, Any]:
    """Return `measure_length` of a new process."""
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, __file__, "--worker", str(frames)]
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    print(done.stdout.strip(), flush=True)
    return dict(json.loads(done.stdout))


def dgemm_gflops() -> float:
    """Return the rate of one thread at 500 x 500 matrices."""
    A = np.random.default_rng(0).normal(size=(500, 500))
    with threadpool_limits(1, user_api="blas"):
        best = np.inf
        for _ in range(20):
            begin = process_time()
            A @ A
            best = min(best, process_time() - begin)
    return 2.0 * 500**3 / best / 1e9


# --- Tables and figure -----------------------------------------------------------------------------------------------


def cell(found: Mapping[str, Any], key: str, spec: str) -> str:
    value = found.get(key)
    return MISSING if value is None else f"{value:{spec}}"


def race_tables(rows: list[dict[str, Any]]) -> list[str]:
    """Return times, ratios and errors on the recordings."""
    times, errors, ratios = [], [], []
    for row in rows:
        for name in CONTENDERS:
            row[name].setdefault("median", np.nan)
        times.append([row["name"], str(row["frames"])])
        times[-1] += [
            f"{row[name]['median']:.2f} ({row[name]['p95']:.2f}, {row[name]['max']:.1f})" for name in CONTENDERS
        ]
        times[-1].append(f"{row[BATCH]['s']:.1f}")
        errors.append([row["name"]])
        errors[-1] += [f"{cell(row[name], 'ate_m', '.2f')} / {cell(row[name], 'nees', '.1f')}" for name in CONTENDERS]
        engine = row["engine"]["s"]
        quotients = [row[name]["s"] / engine for name in ("reference", "textbook", ISAM, ISAM_P, FIXED_LAG)]
        ratios.append([*quotients, row[ISAM]["s"] / row["engine, white"]["s"], row[ISAM]["s"] / row["run_s"]])
    middle = [f"{value:.1f}" for value in np.median(ratios, axis=0)]
    quotients_of = [[row["name"], *(f"{value:.1f}" for value in each)] for row, each in zip(rows, ratios, strict=True)]
    over = [f"{name} / engine" for name in ("reference", "textbook", ISAM, ISAM_P, FIXED_LAG)]
    return [
        "## The race",
        "CPU milliseconds of a frame on seven drives, median (95 %, longest); for the batch solver seconds at the end:",
        markdown_table(["drive", "frames", *CONTENDERS, "batch s"], times),
        "Total CPU time over that of the engine with the automatic model; iSAM2 over the engine with white noise; and "
        "iSAM2's updates over a whole `ekfslam.run`, which chooses the model and reports as well:",
        markdown_table(["drive", *over, "iSAM2 / engine, white", "iSAM2 / run"], [*quotients_of, ["median", *middle]]),
        "Error and honesty: ATE in m, unaligned, and mean pose NEES (6 expected, from the second frame on):",
        markdown_table(["drive", *CONTENDERS], errors),
    ]


def size_tables(rows: list[dict[str, Any]], rate: float) -> list[str]:
    """Return the table of observations per frame."""
    first = next(row for row in rows if row["observations"] > 45)["engine"]["median"]
    cells = [
        [
            f"{row['observations']:.0f}",
            *(f"{row[name]['median']:.2f} ({row[name]['p95']:.2f})" for name in ("engine", "reference")),
            f"{row['reference']['median'] / row['engine']['median']:.1f}",
            f"{row['engine']['median'] / first:.1f}",
            f"{row['engine']['mflop']:.1f}",
            f"{row['engine']['mflop'] / rate / row['engine']['median']:.2f}",
        ]
        for row in rows
    ]
    header = ["observations", "engine", "reference", "reference / engine", "/ at 60", "Mflop", "floor / engine"]
    return [
        "## Observations",
        "A frame on `builtin:city`, milliseconds, median (95 %). *Mflop* counts BLAS calls of the engine; *floor* is "
        "their time at the rate of dgemm:",
        markdown_table(header, cells, left=0),
    ]


def length_tables(rows: list[dict[str, Any]]) -> list[str]:
    """Return the table of lengths of a drive."""
    keys = {"s": 2, "first_ms": 2, "last_ms": 2, "p95": 2, "max": 2, "simulated_mb": 0, "peak_mb": 0}
    cells = [[str(row["frames"]), *(f"{row[key]:.{digits}f}" for key, digits in keys.items())] for row in rows]
    header = ["frames", "filter s", "ms, first tenth", "ms, last tenth", "95 %", "longest", "MB before", "MB"]
    text = "`builtin:city` with 30 observations a frame, engine:"
    return ["## Length", text, markdown_table(header, cells, left=0)]


def lap_tables(rows: list[dict[str, Any]]) -> list[str]:
    """Return the table of laps."""
    cells = []
    for row in rows:
        s, median = row["laps_s"], row["median_ms"]
        cells.append([row["name"], str(len(s)), *(f"{lap:.2f}" for lap in (*s[:3], s[-1])), f"{s[2] / s[1]:.2f}"])
        cells[-1] += [f"{row['p95'] / median:.1f}", f"{max(row['max_ms']) / median:.1f}"]
    header = ["landmarks out of view", "laps", "1", "2", "3", "last", "3 / 2", "95 % / median", "longest / median"]
    return ["## Laps", "A ring of 40 m radius with 394 landmarks, seconds a lap:", markdown_table(header, cells)]


def tables(found: dict[str, Any]) -> str:
    """Return all tables as Markdown."""
    rate = found["dgemm_gflops"]
    parts = [
        f"One thread of {found['machine']}, dgemm {rate:.0f} Gflop/s at 500 x 500. Contenders take turns frame by "
        "frame; milliseconds are CPU time. Made by `experiments/benchmark.py`.",
    ]
    if found.get("race"):
        parts += race_tables(found["race"])
    if found.get("observations"):
        parts += size_tables(found["observations"], rate)
    if found.get("lengths"):
        parts += length_tables(found["lengths"])
    if found.get("laps"):
        parts += lap_tables(found["laps"])
    return document("# Benchmark", *parts)


STYLES: dict[str, Mapping[str, Any]] = {
    "engine": VARIANTS["invariant"],
    "reference": VARIANTS["standard"],
    "textbook": {"color": GREY, "marker": "s", "linestyle": ":"},
    ISAM: {"color": ORANGE, "marker": "^", "linestyle": "--"},
    ISAM_P: {"color": ORANGE, "marker": "v", "linestyle": ":"},
    FIXED_LAG: {"color": GREY, "marker": "P", "linestyle": "--"},
}


@styled
def figure(found: dict[str, Any]) -> Figure:
    """Draw the time of a frame on the drives, and against observations per frame."""
    drawn = Figure(figsize=(9.0, 3.8))
    panels = [(draw, found[key]) for key, draw in (("race", draw_race), ("observations", draw_sizes)) if found.get(key)]
    for axes, (draw, rows) in zip(np.atleast_1d(drawn.subplots(1, max(len(panels), 1))), panels, strict=False):
        draw(axes, rows, found["dgemm_gflops"])
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        low, high = axes.get_ylim()
        axes.set_ylim(low, high * (high / low) ** 0.35)  # room for the legend
        axes.legend(fontsize="x-small", ncols=2, loc="upper left")
    return drawn


def draw_race(axes: Axes, rows: list[dict[str, Any]], _: float) -> None:
    for name, style in STYLES.items():
        values = [row[name]["s"] / row["frames"] * 1e3 for row in rows]
        axes.plot(range(len(rows)), values, **{**style, "linestyle": ""}, label=name)
    drives = [row["name"].replace("2011_", "").replace("_drive", "").replace("_sync_KLT", "") for row in rows]
    axes.set_xticks(range(len(rows)), drives, rotation=40, ha="right")
    axes.set_ylabel("CPU time a frame, mean (ms)")


def draw_sizes(axes: Axes, rows: list[dict[str, Any]], gflops: float) -> None:
    x = [row["observations"] for row in rows]
    for name in ("reference", "engine"):
        axes.plot(x, [row[name]["median"] for row in rows], **STYLES[name], label=name)
        lower, upper = ([row[name][key] for row in rows] for key in ("median", "p95"))
        axes.fill_between(x, lower, upper, color=STYLES[name]["color"], alpha=BAND_ALPHA, linewidth=0)
    floor = [row["engine"]["mflop"] / gflops for row in rows]
    axes.plot(x, floor, color=GREY, linestyle=":", label="engine's flops at the rate of dgemm")
    axes.set(xscale="log", xlabel="observations a frame", ylabel="CPU time a frame, median to 95 % (ms)")
    axes.set_xticks(OBSERVATIONS, [str(size) for size in OBSERVATIONS])
    axes.xaxis.set_minor_locator(NullLocator())


def measured(options: argparse.Namespace) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """Yield the chosen tables."""
    quick, data = options.quick, options.data
    tables_of: dict[str, Callable[[], list[dict[str, Any]]]] = {
        "observations": lambda: by_observations(OBSERVATIONS[:3] if quick else OBSERVATIONS),
        "lengths": lambda: [in_own_process(frames) for frames in (LENGTHS[:1] if quick else LENGTHS)],
        "laps": lambda: measure_laps(3 if quick else LAPS),
        "race": lambda: race(data, UTIAS[:1] if quick else UTIAS),
    }
    for name, measure in tables_of.items():
        if name not in (options.only or tables_of):
            continue
        if name == "race" and (missing := race_is_missing(data)):
            print(missing, file=sys.stderr)
            continue
        with threadpool_limits(1, user_api="blas"):
            yield name, measure()


def race_is_missing(data: Path) -> str:
    """Return why there is no race; empty if it can be run."""
    try:
        import gtsam  # noqa: F401
    except ModuleNotFoundError:
        return "no race: GTSAM is missing, pip install 'ekfslam[bench]'"
    return "" if has_recordings(data, *UTIAS) else "no race: recordings are missing"


def main() -> None:
    parser: argparse.ArgumentParser = argument_parser(__doc__, "benchmark", data=True)
    choices = ("observations", "lengths", "laps", "race")
    parser.add_argument("--only", nargs="+", choices=choices, help="tables to measure; others are kept as they are")
    parser.add_argument("--quick", action="store_true", help="small sizes only")
    parser.add_argument("--worker", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        print(json.dumps(measure_length(options.worker)))
        return
    path = options.out / "benchmark.json"
    found: dict[str, Any] = json.loads(path.read_text()) if options.only and path.is_file() else {}
    found |= {"machine": platform.machine(), "dgemm_gflops": dgemm_gflops()}
    for name, rows in measured(options):
        found[name] = rows
        write(options.out, "benchmark", found, tables(found), {"benchmark": figure(found)})


if __name__ == "__main__":
    main()
