"""Measure time and memory of a frame and of the posterior against the number of landmarks M.

The world is `ekfslam.data.simulate.City` with short tracks: about 70 landmarks in view and 9 new ones a frame, so that
M = 10^5 is a drive of some 11 000 frames. Every size runs in a new process on one core, for its peak memory. Seconds
are CPU time of the process, since other work on the machine affects it least.

- *Filter*: the frames of the second half in which 66 to 74 landmarks are in view; median. The cost of a frame at the
  largest M is also held against that at M = 10^3 frame by frame in turn, in one process (`in_turn`).
- *Posterior*: as filtered and MAP, mean and all marginals; some marginals are checked against solves.
- *Dense reference*: a filter that never retires a landmark, and the dense inverse of the joint information matrix.

    python experiments/scaling.py [--out DIR] [--quick]
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from time import perf_counter, process_time
from typing import Any, TypeVar

import numpy as np
from common import argument_parser, truth_of, write
from matplotlib.figure import Figure
from threadpoolctl import threadpool_limits

from ekfslam import run
from ekfslam.arrays import Array
from ekfslam.config import Config, PosteriorConfig
from ekfslam.data.sequence import Sequence
from ekfslam.data.simulate import City, Loop, simulate
from ekfslam.evaluation.tables import document, markdown_table
from ekfslam.figures.style import GREY, log_axis, style_of, styled
from ekfslam.filters import JointEKF, loop
from ekfslam.filters.result import Result
from ekfslam.resolve import resolve
from ekfslam.smoother.posterior import Posterior, model_of_result, posterior
from ekfslam.smoother.problem import BatchProblem
from ekfslam.smoother.revival import MapRevival
from ekfslam.smoother.sparse.factors import LinearSystem
from ekfslam.smoother.sparse.information import JointInformation
from ekfslam.smoother.sparse.structure import Structure
from ekfslam.storage.archive import write_archive

SIZES = (100, 300, 1000, 3000, 10_000, 30_000, 100_000)
DENSE_SIZES = (100, 300, 1000, 2000)
QUICK = 1000  # the largest size of --quick
IN_TURN_WITH = 1000  # the size that the largest one is held against, frame by frame
CITY = City(landmarks_per_m=8.0, max_tracks=77, loss_probability=0.09)
IN_FIRST_FRAME, NEW_PER_FRAME = 70, 8.8  # of this world
LOOP_RADIUS_M, LOOP_FRAMES, LOOP_LANDMARKS = 40.0, 314, 400  # a lap at 8 m/s
IN_VIEW = (66, 74)
POOLED = 400  # frames of short drives that a median is taken of, at least
CHECKED = 8  # poses and landmarks whose marginals are compared with solves
Value = TypeVar("Value")
Row = dict[str, Any]


def world_of(landmarks: int, seed: int = 0) -> City:
    """Return the world with about that many landmarks."""
    return dataclasses.replace(CITY, frames=max(6, round((landmarks - IN_FIRST_FRAME) / NEW_PER_FRAME)), seed=seed)


def timed(work: Callable[[], Value]) -> tuple[Value, float]:
    """Call ``work`` and return its result and its CPU seconds."""
    begin = process_time()
    return work(), process_time() - begin


class PeakMemory:
    """Return the peak resident memory, MB (10^6 bytes), since the last call; Linux only, elsewhere since the start."""

    def __init__(self) -> None:
        self.overall = 0.0
        self()

    def __call__(self) -> float:
        status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
        peak = int(status["VmHWM"].split()[0]) * 1024 / 1e6
        self.overall = max(self.overall, peak)
        Path("/proc/self/clear_refs").write_text("5")  # resets the peak
        return peak


# --- Workers, one process each ---------------------------------------------------------------------------------------


def measure_size(landmarks: int) -> Row:
    """Measure filter and both posteriors of one size."""
    memory = PeakMemory()
    sequence = simulate(world_of(landmarks))
    simulation_mb = memory()
    result, filter_s = timed(lambda: run(sequence, "full"))
    log = result.log
    assert log is not None
    with tempfile.TemporaryDirectory() as folder:
        write_archive(Path(folder) / "run.h5", sequence, {"full": result})
        archive_mb = (Path(folder) / "run.h5").stat().st_size / 1e6
    ms = [counted_ms(sequence, result)]
    for seed in range(1, POOLED // log.frames):  # a short drive has few frames to take a median of
        again = simulate(world_of(landmarks, seed))
        ms.append(counted_ms(again, run(again, "full")))
    row: Row = {
        "landmarks": log.landmarks,
        "frames": log.frames,
        "observations": log.observations,
        "ms_per_frame": float(np.median(np.concatenate(ms))),
        "filter_s": filter_s,
        "filter_mb": memory(),
        "simulation_mb": simulation_mb,
        "log_mb": sum(v.nbytes for v in vars(log).values() if isinstance(v, np.ndarray)) / 1e6,
        "archive_mb": archive_mb,
        "filter_error_m": position_error_m(sequence, result.T_world_imu),
    }
    row["stages"] = measure_stages(result)
    memory()
    for linearisation in ("filtered", "map"):
        begin = perf_counter()
        config = PosteriorConfig(linearisation=linearisation)
        found, mean_s = timed(lambda config=config: posterior(result, config))  # type: ignore[misc]
        _, poses_s = timed(lambda found=found: found.pose_covariance)  # type: ignore[misc]
        _, landmarks_s = timed(lambda found=found: found.landmark_covariance)  # type: ignore[misc]
        row[linearisation] = {
            "mean_s": mean_s,
            "pose_marginals_s": poses_s,
            "landmark_marginals_s": landmarks_s,
            "total_s": mean_s + poses_s + landmarks_s,
            "wall_s": perf_counter() - begin,
            "iterations": len(found.costs) - 1,
            "mb": memory(),
            "error_m": position_error_m(sequence, found.T_world_imu),
            "against_solves": against_solves(found),
        }
        del found
    row["peak_mb"] = memory.overall
    return row


def counted_ms(sequence: Sequence, result: Result) -> Array:
    """Return the milliseconds of the counted frames, see the module."""
    in_view = np.bincount(sequence.observations.frame, minlength=len(sequence))
    second_half = np.arange(len(sequence)) >= len(sequence) // 2
    return result.ms_per_frame[second_half & (in_view >= IN_VIEW[0]) & (in_view <= IN_VIEW[1])]


def measure_stages(result: Result) -> Row:
    """Measure the seconds of the steps of one linearisation (as filtered)."""
    log = result.log
    assert log is not None
    rows = BatchProblem(log, model_of_result(result))
    state = rows.filtered_state(result.landmarks.position_m)
    system, rows_s = timed(lambda: rows.relinearised(state))
    structure, structure_s = timed(lambda: Structure(system))
    information, first_s = timed(lambda: JointInformation(system, structure=structure))
    _, again_s = timed(lambda: JointInformation(system, like=information))
    return {
        "structure_s": structure_s,
        "rows_s": rows_s,
        "first_solution_s": first_s,
        "next_solution_s": again_s,
        "factor_entries": information.factor.factor().nnz,
    }


def against_solves(found: Posterior) -> float:
    """Return the largest difference between marginals and solves of some blocks, by the scale of each block."""
    frames = np.linspace(1, len(found.T_world_imu) - 1, CHECKED).astype(int)
    landmarks = np.linspace(0, len(found.id) - 1, CHECKED).astype(int)
    solved = found.joint_covariance(frames, landmarks)
    worst = 0.0
    for marginals, index, size, start in (
        (found.pose_covariance, frames, 6, 0),
        (found.landmark_covariance, landmarks, 3, 6 * CHECKED),
    ):
        for i, marginal in enumerate(marginals[index]):
            block = slice(start + size * i, start + size * (i + 1))
            worst = max(
                worst, float(np.abs(marginal - solved[block, block]).max() / np.abs(solved[block, block]).max())
            )
    return worst


def position_error_m(sequence: Sequence, T_world_imu: Array) -> float:
    """Return the root mean square position error, without alignment: the first pose is known."""
    truth = truth_of(sequence)
    difference = T_world_imu[truth.frame, :3, 3] - truth.T_world_imu[:, :3, 3]
    return float(np.sqrt((difference**2).sum(axis=1).mean()))


def steps(sequence: Sequence, retire: str, variant: str = "invariant") -> Iterator[tuple[JointEKF, float]]:
    """Yield the joint filter after each frame, with the CPU milliseconds of the frame."""
    config = Config().with_overrides({"filter": {"retire": retire, "variant": variant}})
    problem = resolve(sequence, config, "dead-reckoning")
    model, settings = problem.model, problem.config.filter
    ekf = JointEKF(model, settings, revival=MapRevival(model, settings))
    for frame in loop.run_filter(ekf, sequence, clock=process_time):
        yield ekf, frame.ms


def measure_in_turn(landmarks: int) -> Row:
    """Time a frame at the end of a long drive and one of a short drive, one after the other."""
    large = simulate(world_of(landmarks))
    pairs = 300
    large_steps = steps(large, "unseen")
    for _ in range(len(large) - pairs):
        next(large_steps)

    def short_frames() -> Iterator[tuple[int, float]]:
        for seed in range(1, pairs):
            short = simulate(world_of(IN_TURN_WITH, seed))
            seen = np.bincount(short.observations.frame, minlength=len(short))
            for k, (_, ms) in enumerate(steps(short, "unseen")):
                if k >= len(short) // 2:
                    yield int(seen[k]), ms

    seen = np.bincount(large.observations.frame, minlength=len(large))[-pairs:]
    ms: dict[str, list[float]] = {"large": [], "small": []}
    for in_view, (_, ms_large), (in_view_small, ms_small) in zip(seen, large_steps, short_frames(), strict=False):
        if IN_VIEW[0] <= in_view <= IN_VIEW[1]:
            ms["large"].append(ms_large)
        if IN_VIEW[0] <= in_view_small <= IN_VIEW[1]:
            ms["small"].append(ms_small)
    medians = {f"{size}_ms": float(np.median(values)) for size, values in ms.items()}
    return {**medians, "ratio": medians["large_ms"] / medians["small_ms"], "frames": {k: len(v) for k, v in ms.items()}}


def measure_dense(landmarks: int) -> Row:
    """Measure the filter that never retires a landmark, and the dense inverse of the joint information matrix."""
    memory = PeakMemory()
    sequence = simulate(world_of(landmarks))
    ms: list[float] = []
    ekf = None
    for ekf, frame_ms in steps(sequence, "never"):  # noqa: B007  (its last value is used)
        ms.append(frame_ms)
    assert ekf is not None
    row: Row = {"landmarks": len(ekf.ids), "ms_per_frame": float(np.median(ms[-10:])), "filter_mb": memory()}

    log = ekf.log()
    system = BatchProblem(log, ekf.model).as_filtered()
    row["posterior_s"] = timed(lambda: dense_inverse(system))[1]
    row["posterior_mb"] = memory()
    return row


def dense_inverse(system: LinearSystem) -> Array:
    """Return the covariance of all poses and landmarks, (6T+3M, 6T+3M), with the first pose in units of its prior."""
    J, _ = system.rows()
    return np.asarray(np.linalg.inv((J.T @ J).toarray()))


def measure_loop(landmarks: int) -> Row:
    """Measure the CPU seconds of each lap of a ring, with revived landmarks and without retirement."""
    sequence = simulate(Loop(landmarks=landmarks, radius_m=LOOP_RADIUS_M, frames=3 * LOOP_FRAMES))
    row: Row = {"landmarks": len(sequence.observations.ids), "filters": []}
    for variant, retire in (("standard", "never"), ("standard", "unseen"), ("invariant", "unseen")):
        ms, solves, active, revived = [], [], [], 0
        position = np.zeros(3)
        for ekf, frame_ms in steps(sequence, retire, variant):
            ms.append(frame_ms)
            solves.append(len(ekf.retired.revived) > revived)
            active.append(len(ekf.ids))
            revived, position = len(ekf.retired.revived), ekf.T_world_imu[:3, 3]
        row["filters"].append(
            {
                "variant": variant,
                "retire": retire,
                "lap_s": [float(np.sum(lap)) / 1e3 for lap in np.split(np.array(ms), 3)],
                "solving_s": float(np.sum(np.array(ms)[solves])) / 1e3,
                "solves": [int(np.sum(lap)) for lap in np.split(np.array(solves), 3)],
                "active": [float(np.mean(lap)) for lap in np.split(np.array(active), 3)],
                "last_error_m": float(np.linalg.norm(position - truth_of(sequence).T_world_imu[-1, :3, 3])),
            }
        )
    return row


WORKERS: dict[str, Callable[[int], Row]] = {
    "size": measure_size,
    "in-turn": measure_in_turn,
    "dense": measure_dense,
    "loop": measure_loop,
}


def in_own_process(worker: str, landmarks: int) -> Row:
    """Measure in a new process."""
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, __file__, "--worker", worker, str(landmarks)]
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return dict(json.loads(done.stdout))


# --- Table and figure ------------------------------------------------------------------------------------------------


def slope(sizes: Array, values: Array) -> float:
    """Return the exponent of the power law through the upper half of the points."""
    upper = slice(len(sizes) // 2, None)
    return float(np.polyfit(np.log(sizes[upper]), np.log(values[upper]), 1)[0])


def table(found: Row) -> str:
    """Return the results as Markdown."""
    sizes, in_turn, loop = found["sizes"], found["in_turn"], found["loop"]
    return document(
        "# Cost against the size of the map",
        "Made by `experiments/scaling.py`; the world is `City` with short tracks, invariant variant. "
        f"{found['machine']}, one core; times are CPU times of the process. A frame in ms, median over frames of the "
        f"second half with {IN_VIEW[0]} to {IN_VIEW[1]} landmarks in view. Memory is the peak of the process in that "
        "stage, 10^6 bytes.",
        markdown_table(
            [
                *("M", "frames", "observations", "ms a frame", "filter s", "filter MB", "MAP s", "(iterations)"),
                *("MAP MB", "as filtered s", "as filtered MB", "archive MB"),
            ],
            map(size_cells, sizes),
            left=0,
        ),
        f"Peak memory of the whole run at M = {sizes[-1]['landmarks']}: {sizes[-1]['peak_mb']:.0f} MB.",
        f"A frame at the end of a drive with M = {sizes[-1]['landmarks']} against one with M = {IN_TURN_WITH}, in turn "
        f"in one process (CPU): {in_turn['large_ms']:.2f} ms against {in_turn['small_ms']:.2f} ms, "
        f"ratio **{in_turn['ratio']:.2f}**.",
        "## Where the posterior's seconds go",
        "Structure: coupling of poses by landmarks, found once. Rows: linearisation. Solution: Schur complements, "
        "CHOLMOD and mean; the first one with its symbolic analysis. Difference: largest between marginals and solves, "
        "relative to the block. Error: root mean square position error of the trajectory.",
        markdown_table(
            [
                *("M", "structure", "rows", "first solution", "next solution", "pose marginals"),
                *("landmark marginals", "factor entries", "difference", "error filter m", "error MAP m"),
            ],
            map(stage_cells, sizes),
            left=0,
        ),
        "## Dense reference",
        "A filter that never retires a landmark (a frame at the end, median of the last ten), and the inverse of the "
        "dense information matrix of all poses and landmarks.",
        markdown_table(
            ["M", "ms a frame", "filter MB", "posterior s", "posterior MB"], map(dense_cells, found["dense"]), left=0
        ),
        "## Landmarks that come back",
        f"Three laps of a ring of {LOOP_RADIUS_M:.0f} m radius with {loop['landmarks']} landmarks. A solve is a "
        "frame in which retired landmarks came back.",
        markdown_table(
            [
                *("variant", "retire", "lap 1 s", "lap 2 s", "lap 3 s", "of which in solves s", "solves"),
                *("mean active", "last error m"),
            ],
            map(loop_cells, loop["filters"]),
            left=2,
        ),
    )


def size_cells(r: Row) -> list[str]:
    """Return the cells of time and memory of one size."""
    f, m = r["filtered"], r["map"]
    return [
        *(f"{r[key]}" for key in ("landmarks", "frames", "observations")),
        *(f"{r['ms_per_frame']:.1f}", f"{r['filter_s']:.1f}", f"{r['filter_mb']:.0f}"),
        *(f"{m['total_s']:.2f}", f"{m['iterations']}", f"{m['mb']:.0f}", f"{f['total_s']:.2f}", f"{f['mb']:.0f}"),
        f"{r['archive_mb']:.1f}",
    ]


def stage_cells(r: Row) -> list[str]:
    """Return the cells of the posterior of one size: seconds of its steps and accuracy."""
    s, m = r["stages"], r["map"]
    return [
        f"{r['landmarks']}",
        *(f"{s[f'{stage}_s']:.2f}" for stage in ("structure", "rows", "first_solution", "next_solution")),
        *(f"{m[f'{kind}_marginals_s']:.2f}" for kind in ("pose", "landmark")),
        *(f"{s['factor_entries']:.1e}", f"{m['against_solves']:.0e}"),
        *(f"{r['filter_error_m']:.2f}", f"{m['error_m']:.2f}"),
    ]


def dense_cells(r: Row) -> list[str]:
    """Return the cells of the dense reference of one size."""
    return [
        *(f"{r['landmarks']}", f"{r['ms_per_frame']:.1f}", f"{r['filter_mb']:.0f}"),
        *(f"{r['posterior_s']:.2f}", f"{r['posterior_mb']:.0f}"),
    ]


def loop_cells(r: Row) -> list[str]:
    """Return the cells of one filter on the ring."""
    return [
        *(r["variant"], r["retire"]),
        *(f"{lap:.1f}" for lap in r["lap_s"]),
        *(f"{r['solving_s']:.1f}", ", ".join(map(str, r["solves"]))),
        *(", ".join(f"{n:.0f}" for n in r["active"]), f"{r['last_error_m']:.4f}"),
    ]


@styled
def plot(found: Row) -> Figure:
    """Draw time of a frame, time of the posterior and memory against M, with the dense reference."""
    sizes, dense = found["sizes"], found["dense"]
    M, M_dense = (np.array([r["landmarks"] for r in rows], dtype=float) for rows in (sizes, dense))
    figure = Figure(figsize=(12.0, 4.2))
    axes = figure.subplots(1, 3)
    full, smoothed, filtered = style_of("full"), style_of("smoothed"), style_of("as filtered")
    reference = {"color": GREY, "linestyle": "--", "marker": "s"}
    curves = (
        (0, M, [r["ms_per_frame"] for r in sizes], full, "ekfslam"),
        (0, M_dense, [r["ms_per_frame"] for r in dense], reference, "dense filter"),
        (1, M, [r["map"]["total_s"] for r in sizes], smoothed, "MAP and all marginals"),
        (1, M, [r["filtered"]["total_s"] for r in sizes], filtered, "as filtered and all marginals"),
        (1, M_dense, [r["posterior_s"] for r in dense], reference, "dense inverse"),
        (2, M, [r["peak_mb"] for r in sizes], smoothed, "whole run with MAP"),
        (2, M, [r["filter_mb"] for r in sizes], full, "filter"),
        (2, M_dense, [r["posterior_mb"] for r in dense], reference, "dense inverse"),
    )
    for panel, x, values, style, label in curves:
        y = np.array(values)
        exponent = "" if panel == 2 else f" (slope {slope(x, y):.1f})"
        axes[panel].loglog(x, y, **style, label=label + exponent)
    labels = ("CPU time of a frame, ms", "CPU time of the posterior, s", "peak memory, MB")
    for ax, label in zip(axes, labels, strict=True):
        ax.set_ylabel(label)
        log_axis(ax, (1.0,))
        ax.set_xlabel("landmarks M")
        ax.legend(loc="upper left")
        low, high = np.log10(ax.get_ylim())
        ax.set_ylim(10.0 ** np.floor(low), 10.0 ** (high + 0.3 * (high - low)))  # room for the legend
    return figure


def main() -> None:
    parser = argument_parser(__doc__, "scaling")
    parser.add_argument("--quick", action="store_true", help=f"sizes up to {QUICK} only")
    parser.add_argument("--worker", nargs=2, metavar=("WHAT", "M"), help=argparse.SUPPRESS)
    parsed = parser.parse_args()
    if parsed.worker:
        what, landmarks = parsed.worker
        # `run` times frames by the wall clock, which other work on the machine disturbs several times over.
        loop.perf_counter = process_time
        with threadpool_limits(1):
            print(json.dumps(WORKERS[what](int(landmarks))))
        return

    limit = QUICK if parsed.quick else SIZES[-1]
    found: Row = {"machine": f"{platform.machine()}, {platform.system()}, Python {platform.python_version()}"}
    for key, worker, sizes in (("sizes", "size", SIZES), ("dense", "dense", DENSE_SIZES)):
        found[key] = []
        for landmarks in (size for size in sizes if size <= limit):
            found[key].append(in_own_process(worker, landmarks))
            print(f"{worker} {landmarks}: {json.dumps(found[key][-1])}", flush=True)
    found["loop"] = in_own_process("loop", 100 if parsed.quick else LOOP_LANDMARKS)
    found["in_turn"] = in_own_process("in-turn", max(limit, 3 * IN_TURN_WITH + 1))
    write(parsed.out, "scaling", found, table(found), {"scaling": plot(found)}, indent=1)


if __name__ == "__main__":
    main()
