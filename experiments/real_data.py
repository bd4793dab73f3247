"""Every recording, every mode, one configuration: noise from the data, no truth used but for the evaluation.

Errors are absolute trajectory errors against the true poses. The gain is dead reckoning's over that of full SLAM:
above 1 where the camera helps. The last tables add known white noise to the clean velocities of the UTIAS drives and of
the dense tracks of 0027 (0.5 m/s and 0.05 rad/s a sample, several seeds); the filter is not told.

    python experiments/real_data.py [--data DIR] [--out DIR] [--variants] [--workers N]
"""

from __future__ import annotations

import dataclasses
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
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

# Of full SLAM besides the default one: heading and settings.
VARIANTS: dict[str, dict[str, dict[str, Any]]] = {
    "full, standard": {"filter": {"variant": "standard"}},
    "full, fej": {"filter": {"variant": "fej"}},
}
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
SEEDS, DENSE_SEEDS = range(3), range(6)
ADDED_STD = np.repeat([0.5, 0.05], 3)  # m/s, rad/s
CLEAN_DENSE = "0027_dense, clean velocities"
RECORDINGS = {**{Path(file).stem: file for file in (*UTIAS, *REPORT, DENSE)}, CLEAN_DENSE: DENSE}

Table = dict[str, dict[str, dict[str, Any]]]  # recording, estimator, figure
Noisy = dict[str, list[dict[str, Any]]]  # recording, seed, figures


def main() -> int:
    parser = argument_parser(__doc__, "real_data", data=True)
    parser.add_argument("--variants", action="store_true", help="the standard and the first-estimates filter, too")
    parser.add_argument("--workers", type=int, default=2, metavar="N", help="processes, default: %(default)s")
    parsed = parser.parse_args()
    if not has_recordings(parsed.data, *UTIAS, *REPORT, DENSE):
        return 0
    drives = {Path(file).stem: SEEDS for file in UTIAS}
    seeds = [(name, seed) for name, some in {**drives, Path(DENSE).stem: DENSE_SEEDS}.items() for seed in some]
    with ProcessPoolExecutor(parsed.workers, mp_context=get_context("spawn")) as pool:
        found = {name: pool.submit(as_recorded, parsed.data, name, parsed.variants) for name in RECORDINGS}
        added = [(name, pool.submit(with_noise_added, parsed.data, name, seed)) for name, seed in seeds]
        table: Table = {}
        for name, row in found.items():
            table[name] = row.result()
            print(name, {key: round(value["ate_m"], 3) for key, value in table[name].items()}, flush=True)
        noisy: Noisy = {}
        for name, run in added:
            noisy.setdefault(name, []).append(run.result())
            print(name, noisy[name][-1], flush=True)

    values = {"clean": table, "noise added": noisy}
    write(parsed.out, "table", values, markdown(table, noisy), {"gain": plot(table, noisy)}, indent=1)
    return 0


def recording(data: Path, name: str) -> Sequence:
    """A recording by its name; the dense tracks once with the velocities of the clean edition."""
    sequence = open_recording(data, RECORDINGS[name])
    if name != CLEAN_DENSE:
        return sequence
    return dataclasses.replace(sequence, twist=open_recording(data, "ece276a/0027.npz").twist)


def as_recorded(data: Path, name: str, variants: bool) -> dict[str, dict[str, Any]]:
    """Figures of every estimator on a recording; without those of a posterior that is ill-posed."""
    sequence = recording(data, name)
    full = run_with(sequence, "full", {})
    results = {"dead reckoning": run_with(sequence, "dead-reckoning", {}), "full": full}
    for heading, settings in VARIANTS.items() if variants else ():
        results[heading] = run_with(sequence, "full", settings)
    try:
        results["smoothed"] = ekfslam.smooth(full)
    except ekfslam.EkfslamError as error:
        print(f"{name}: no smoothed: {error}", file=sys.stderr)
    return {heading: figures(sequence, result) for heading, result in results.items()}


def figures(sequence: Sequence, result: Result) -> dict[str, Any]:
    """Errors of the trajectory, and of full SLAM what became of the observations."""
    found = summarise(sequence, result)
    consistency = {name: found[key] for name, key in NEES.items()}
    return {**trajectory_errors(sequence, result.T_world_imu), **consistency, **statistics(result)}


def statistics(result: Result) -> dict[str, float]:
    """What became of the observations, in shares of all, and how large innovations are for their covariance."""
    counts, innovation = result.counts, result.innovation
    if "accepted" not in counts:
        return {}
    total = counts["accepted"] + counts["rejected"] + counts["dropped by hygiene"]
    shares = {name: counts[key] / total for name, key in SHARES.items()}
    cut = sum(value for key, value in counts.items() if key.startswith("hygiene: "))
    return {
        **shares,
        "cuts": float(cut - counts["dropped by hygiene"]),
        "moving tracks": float(counts.get("moving", 0)),
        "track scale": float(result.config["noise"]["track_scale"] or 1.0),
        "nis_per_dof": float(innovation.nis.sum() / max(innovation.dof.sum(), 1)),
    }


def with_noise_added(data: Path, name: str, seed: int) -> dict[str, Any]:
    """ATE in metres of dead reckoning and full SLAM, and pose NEES of the latter, on velocities with noise added."""
    sequence = recording(data, name)
    clean = recording(data, CLEAN_DENSE).twist if name == Path(DENSE).stem else sequence.twist
    noise = ADDED_STD * np.random.default_rng(seed).standard_normal(clean.shape)
    spoilt = dataclasses.replace(sequence, twist=clean + noise)
    found = {mode: figures(spoilt, run_with(spoilt, mode, {})) for mode in ("dead-reckoning", "full")}
    return {**{mode: row["ate_m"] for mode, row in found.items()}, "nees": found["full"]["with truth noise"]}


# --- Tables and figure -----------------------------------------------------------------------------------------------


def gain(row: dict[str, dict[str, Any]]) -> float:
    """Dead reckoning's error over that of full SLAM on one recording."""
    return float(row["dead reckoning"]["ate_m"] / row["full"]["ate_m"])


def gains(runs: list[dict[str, Any]]) -> list[float]:
    """The same with noise added, seed by seed."""
    return [run["dead-reckoning"] / run["full"] for run in runs]


def markdown(table: Table, noisy: Noisy) -> str:
    """The report of the experiment."""
    headings = list(dict.fromkeys(heading for row in table.values() for heading in row))
    drives = [gain(table[Path(file).stem]) for file in UTIAS]
    every = [value for name, runs in noisy.items() if name != Path(DENSE).stem for value in gains(runs)]
    smoothed = [row["smoothed"]["ate_m"] / row["full"]["ate_m"] for row in table.values() if "smoothed" in row]
    return document(
        "# Recordings, one configuration, noise from the data",
        "ATE in metres, unaligned (in brackets: SE(3)-aligned); gain is dead reckoning's over that of full. "
        "A dash stands where the posterior is ill-posed. Mapping-only has the trajectory of dead reckoning.",
        markdown_table(
            ["set", *headings, "gain"],
            (
                [name, *(with_aligned(row[k]) if k in row else MISSING for k in headings), f"{gain(row):.2f}"]
                for name, row in table.items()
            ),
        ),
        f"Of the {len(drives)} UTIAS drives {sum(value > 1 for value in drives)} gain, {np.median(drives):.2f}x in "
        f"the median. Smoothed over full: {np.median(smoothed):.2f} in the median over all sets.",
        "## Honesty of the covariance",
        "Mean normalised error squared of the pose, 6 for an honest covariance: with the truth as exact, with its own "
        "noise, and, with that noise, of the motion over 100 frames; normalised innovation squared a degree of freedom "
        "of full, and the factor on the walk of track errors that was found.",
        markdown_table(
            ["set", *(f"full, {name}" for name in NEES), *(f"smoothed, {name}" for name in NEES), "NIS/dof", "factor"],
            ([name, *honesty_cells(row)] for name, row in table.items()),
        ),
        "## What became of the observations (full)",
        "Shares of all observations that were dropped by hygiene, turned down by the gate and not started afresh, or "
        "belong to tracks found to move; how many tracks hygiene cut and how many were found to move.",
        markdown_table(
            ["set", *SHARES, "tracks cut", "tracks moving"],
            ([name, *observation_cells(row["full"])] for name, row in table.items()),
        ),
        "## Known noise added to the velocities",
        f"0.5 m/s and 0.05 rad/s a sample, {len(SEEDS)} seeds ({len(DENSE_SEEDS)} of the dense tracks); ATE in metres "
        "and pose NEES of full with truth noise, median (smallest to largest).",
        markdown_table(
            ["set", "dead reckoning", "full", "gain", "pose NEES"],
            ([name, *noisy_cells(runs)] for name, runs in noisy.items()),
        ),
        f"Gain over the UTIAS drives and seeds: {np.median(every):.2f} in the median, {min(every):.2f} at the least.",
    )


def honesty_cells(row: dict[str, dict[str, Any]]) -> list[str]:
    """NEES of full and smoothed, NIS and the factor found."""
    nees = [number(row.get(mode, {}).get(name), ".1f") for mode in ("full", "smoothed") for name in NEES]
    return [*nees, f"{row['full']['nis_per_dof']:.2f}", f"{row['full']['track scale']:.2f}"]


def observation_cells(full: dict[str, Any]) -> list[str]:
    """What full SLAM did with the observations."""
    shares = [f"{full[key]:.1%}" for key in SHARES]
    tracks = [f"{full[key]:.0f}" for key in ("cuts", "moving tracks")]
    return [*shares, *tracks]


def noisy_cells(runs: list[dict[str, Any]]) -> list[str]:
    """Errors and gain over the seeds."""
    values = [[run[mode] for run in runs] for mode in ("dead-reckoning", "full")]
    columns = (*values, gains(runs), [run["nees"] for run in runs])
    return [f"{np.median(v):.2f} ({min(v):.2f} to {max(v):.2f})" for v in columns]


@styled
def plot(table: Table, noisy: Noisy) -> Figure:
    """Gain over dead reckoning, set by set: as recorded, and with noise added."""
    figure = Figure(figsize=(8.0, 4.2))
    ax = figure.subplots()
    names = list(table)
    ax.plot([gain(row) for row in table.values()], range(len(names)), **marker_of("full"), label="as recorded")
    for name, runs in noisy.items():
        place = np.full(len(runs), names.index(name) + 0.25)
        label = "noise added, seed by seed" if name in names[:1] else None
        ax.plot(gains(runs), place, "x", color=ORANGE, label=label)
    ax.axvline(1.0, **REFERENCE)
    ax.set_xscale("log")
    ax.set_xticks([0.5, 0.8, 1, 2, 3, 5, 10], ["0.5", "0.8", "1", "2", "3", "5", "10"])
    ax.minorticks_off()
    ax.set_yticks(range(len(names)), names)
    ax.invert_yaxis()
    ax.set_xlabel("ATE of dead reckoning over that of full SLAM [-]; more is better")
    ax.legend(loc="center left")
    return figure


if __name__ == "__main__":
    sys.exit(main())
