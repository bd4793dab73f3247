"""Every recording, every mode, one configuration: noise from the data, no truth used but for the evaluation.

Errors are absolute trajectory errors against the true poses. The gain is dead reckoning's over that of full SLAM:
above 1 where the camera helps. The last table adds known white noise to the clean velocities of the UTIAS drives
(0.5 m/s and 0.05 rad/s a sample, five seeds); the filter is not told.

    python experiments/real_data.py [--data DIR] [--out DIR]
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from common import (
    DENSE,
    REPORT,
    UTIAS,
    argument_parser,
    has_recordings,
    open_recording,
    run_with,
    trajectory_errors,
    with_aligned,
    write,
)
from matplotlib.figure import Figure

import ekfslam
from ekfslam.data.sequence import Sequence
from ekfslam.evaluation.summary import summarise
from ekfslam.evaluation.tables import MISSING, document, markdown_table, number
from ekfslam.figures.style import ORANGE, REFERENCE, marker_of, styled
from ekfslam.filters.result import Result

# Heading, mode, settings.
ESTIMATORS: tuple[tuple[str, str, dict[str, dict[str, Any]]], ...] = (
    ("dead reckoning", "dead-reckoning", {}),
    ("mapping-only", "mapping-only", {}),
    ("full", "full", {}),
    ("full, standard", "full", {"filter": {"variant": "standard"}}),
    ("full, fej", "full", {"filter": {"variant": "fej"}}),
    ("smoothed", "smoothed", {}),
)
# Of the second table: heading, and which of the counts.
SHARES = {
    "dropped by hygiene": "dropped by hygiene",
    "gate": "rejected: gate",
    "moves": "rejected: moving",
}
# Of the same table: heading, and key of the summary.
NEES = {
    "pose NEES": "pose_nees_mean",
    "with truth noise": "pose_nees_with_truth_noise_mean",
    "over 100 frames": "pose_nees_relative_100_mean",
}
SEEDS = range(5)
ADDED_STD = np.repeat([0.5, 0.05], 3)  # m/s, rad/s

Table = dict[str, dict[str, dict[str, Any]]]  # recording, estimator, figure
Noisy = dict[str, list[dict[str, float]]]  # recording, seed, ATE of each mode


def main() -> int:
    parsed = argument_parser(__doc__, "real_data", data=True).parse_args()
    if not has_recordings(parsed.data, *UTIAS, *REPORT, DENSE):
        return 0
    table: Table = {}
    for name, sequence in recordings(parsed.data):
        table[name] = {}
        for heading, mode, settings in ESTIMATORS:
            try:
                result = run_with(sequence, mode, settings)
            except ekfslam.EkfslamError as error:
                print(f"{name}: no {heading}: {error}", file=sys.stderr)
                continue
            table[name][heading] = {**trajectory_errors(sequence, result.T_world_imu), **statistics(sequence, result)}
        print(name, {key: round(value["ate_m"], 3) for key, value in table[name].items()}, flush=True)
    noisy: Noisy = {}
    for file in UTIAS:
        sequence, name = open_recording(parsed.data, file), Path(file).stem
        noisy[name] = [with_noise_added(sequence, seed) for seed in SEEDS]
        print(name, noisy[name], flush=True)

    values = {"clean": table, "noise added": noisy}
    write(parsed.out, "table", values, markdown(table, noisy), {"gain": plot(table, noisy)}, indent=1)
    return 0


def recordings(data: Path) -> Iterator[tuple[str, Sequence]]:
    """Name and recording of every set with truth; the dense tracks once with the velocities of the clean edition."""
    for file in (*UTIAS, *REPORT, DENSE):
        yield Path(file).stem, open_recording(data, file)
    clean = open_recording(data, "ece276a/0027.npz").twist
    yield "0027_dense, clean velocities", dataclasses.replace(open_recording(data, DENSE), twist=clean)


def statistics(sequence: Sequence, result: Result) -> dict[str, float | None]:
    """What became of the observations, in shares of all; how large innovations and errors are for their covariance."""
    counts, innovation, found = result.counts, result.innovation, summarise(sequence, result)
    if "accepted" not in counts:
        return {}
    total = counts["accepted"] + counts["rejected"] + counts["dropped by hygiene"]
    shares = {name: counts[key] / total for name, key in SHARES.items()}
    cut = sum(value for key, value in counts.items() if key.startswith("hygiene: "))
    return {
        **shares,
        "cuts": float(cut - counts["dropped by hygiene"]),
        "moving tracks": float(counts.get("moving", 0)),
        "nis_per_dof": float(innovation.nis.sum() / max(innovation.dof.sum(), 1)),
        **{name: found[key] for name, key in NEES.items()},
    }


def with_noise_added(sequence: Sequence, seed: int) -> dict[str, float]:
    """ATE in metres of dead reckoning and full SLAM on velocities with noise added."""
    noise = ADDED_STD * np.random.default_rng(seed).standard_normal(sequence.twist.shape)
    spoilt = dataclasses.replace(sequence, twist=sequence.twist + noise)
    return {
        mode: trajectory_errors(spoilt, run_with(spoilt, mode, {}).T_world_imu)["ate_m"]
        for mode in ("dead-reckoning", "full")
    }


# --- Tables and figure -----------------------------------------------------------------------------------------------


def gain(row: dict[str, dict[str, Any]]) -> float:
    """Dead reckoning's error over that of full SLAM on one recording."""
    return float(row["dead reckoning"]["ate_m"] / row["full"]["ate_m"])


def gains(runs: list[dict[str, float]]) -> list[float]:
    """The same with noise added, seed by seed."""
    return [run["dead-reckoning"] / run["full"] for run in runs]


def markdown(table: Table, noisy: Noisy) -> str:
    """The report of the experiment."""
    headings = [heading for heading, _, _ in ESTIMATORS]
    drives = [gain(table[Path(file).stem]) for file in UTIAS]
    every = [value for runs in noisy.values() for value in gains(runs)]
    return document(
        "# Recordings, one configuration, noise from the data",
        "ATE in metres, unaligned (in brackets: SE(3)-aligned); gain is dead reckoning's over that of full. "
        "A dash stands where the posterior is ill-posed: tracks that travel with the rig fit a point at infinity.",
        markdown_table(
            ["set", *headings, "gain"],
            (
                [name, *(with_aligned(row[k]) if k in row else MISSING for k in headings), f"{gain(row):.2f}"]
                for name, row in table.items()
            ),
        ),
        f"Of the {len(drives)} UTIAS drives {sum(value > 1 for value in drives)} gain, {np.median(drives):.2f}x in "
        "the median over all.",
        "Mapping-only maps on dead reckoning's poses; its trajectory is that.",
        "## What became of the observations (full)",
        "Shares of all observations that were dropped by hygiene, turned down by the gate, or belong to tracks found "
        "to move; how many tracks hygiene cut and how many were found to move; normalised innovation squared a degree "
        "of freedom, which is below 1 as the assumed noise makes up for errors that agree among themselves; mean "
        "normalised error squared of the pose, 6 for an honest covariance: with the truth as exact, with its own "
        "noise, and, with that noise, of the motion over 100 frames.",
        markdown_table(
            ["set", *SHARES, "tracks cut", "tracks moving", "NIS/dof", *NEES],
            ([name, *observation_cells(row["full"])] for name, row in table.items()),
        ),
        "## Known noise added to the velocities",
        "0.5 m/s and 0.05 rad/s a sample, five seeds; ATE in metres, median (smallest to largest).",
        markdown_table(
            ["set", "dead reckoning", "full", "gain"], ([name, *noisy_cells(runs)] for name, runs in noisy.items())
        ),
        f"Gain over all sets and seeds: {np.median(every):.2f} in the median, {min(every):.2f} at the least.",
    )


def observation_cells(full: dict[str, Any]) -> list[str]:
    """What full SLAM did with the observations."""
    shares = [f"{full[key]:.1%}" for key in SHARES]
    tracks = [f"{full[key]:.0f}" for key in ("cuts", "moving tracks")]
    return [*shares, *tracks, f"{full['nis_per_dof']:.2f}", *(number(full[name], ".0f") for name in NEES)]


def noisy_cells(runs: list[dict[str, float]]) -> list[str]:
    """Errors and gain over the seeds."""
    values = [[run[mode] for run in runs] for mode in ("dead-reckoning", "full")]
    return [f"{np.median(v):.2f} ({min(v):.2f} to {max(v):.2f})" for v in (*values, gains(runs))]


@styled
def plot(table: Table, noisy: Noisy) -> Figure:
    """Gain over dead reckoning, set by set: as recorded, and with noise added."""
    figure = Figure(figsize=(8.0, 4.2))
    ax = figure.subplots()
    names = list(table)
    ax.plot([gain(row) for row in table.values()], range(len(names)), **marker_of("full"), label="as recorded")
    for name, runs in noisy.items():
        place = np.full(len(runs), names.index(name) + 0.25)
        label = "noise added, five seeds" if name in names[:1] else None
        ax.plot(gains(runs), place, "x", color=ORANGE, label=label)
    ax.axvline(1.0, **REFERENCE)
    ax.set_xscale("log")
    ax.set_xticks([0.5, 0.8, 1, 2, 3, 5, 10], ["0.5", "0.8", "1", "2", "3", "5", "10"])
    ax.minorticks_off()
    ax.set_yticks(range(len(names)), names)
    ax.invert_yaxis()
    ax.set_xlabel("ATE of dead reckoning over that of full SLAM [-]; more is better")
    ax.legend(loc="lower right")
    return figure


if __name__ == "__main__":
    sys.exit(main())
