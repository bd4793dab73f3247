"""Run every mode on every recording with one configuration: noise from the data, truth for the evaluation only.

Errors are absolute trajectory errors against the true poses. The gain is the error of dead reckoning over that of full
SLAM. The last tables add white noise to the clean velocities of the UTIAS drives and of the dense tracks of 0027
(0.5 m/s and 0.05 rad/s per sample, several seeds), which the filter does not know.

    python experiments/real_data.py [--data DIR] [--out DIR] [--variants] [--workers N]
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from common import (
    DENSE,
    REPORT,
    UTIAS,
    argument_parser,
    has_recordings,
    recording,
    swept,
    with_aligned,
    write,
)
from matplotlib.figure import Figure

from ekfslam import open_sequence
from ekfslam.arrays import Array
from ekfslam.data.sequence import Sequence
from ekfslam.evaluation.tables import document, markdown_table, number
from ekfslam.figures.style import ORANGE, REFERENCE, legend_of, marker_of, styled
from ekfslam.filters.result import Result
from ekfslam.studies.sweep import Case, Column, Recording, Sweep
from ekfslam.studies.sweep_table import SweepTable

RELATIVE = {"relative_frames": 100}
CASES = {"dead reckoning": Case({"filter": RELATIVE}, "dead-reckoning"), "full": Case({"filter": RELATIVE})}
VARIANTS = {f"full, {name}": Case({"filter": {"variant": name, **RELATIVE}}) for name in ("standard", "fej")}
SMOOTHED = {"smoothed": Case({"filter": RELATIVE}, "smoothed")}
# Headings, and columns of the sweep.
SHARES = {
    "dropped by hygiene": "dropped by hygiene",
    "gate": "rejected: gate",
    "moves": "rejected: moving",
}
NEES = {
    "pose NEES": "pose_nees_mean",
    "with truth noise": "pose_nees_with_truth_noise_mean",
    "over 100 frames": "pose_nees_relative_100_mean",
    "height alone (1)": "pose_nees_z_mean",
}
SEEDS, DENSE_SEEDS = range(3), range(6)
ADDED_STD = np.repeat([0.5, 0.05], 3)  # m/s, rad/s
CLEAN_DENSE, CLEAN_EDITION = "0027_dense, clean velocities", "ece276a/0027.npz"

Runs = dict[tuple[str, str], dict[str, Any]]  # recording and case, column
Noisy = dict[str, dict[str, Array]]  # recording, figure, by seeds


def main() -> int:
    parser = argument_parser(__doc__, "real_data", data=True, workers=True)
    parser.add_argument("--variants", action="store_true", help="the standard and the first-estimates filter, too")
    parsed = parser.parse_args()
    if not has_recordings(parsed.data, *UTIAS, *REPORT, DENSE):
        return 0
    cases = {**CASES, **(VARIANTS if parsed.variants else {}), **SMOOTHED}
    clean = swept("real_data", Sweep(recordings(parsed.data), cases=cases, columns=COLUMNS), parsed.workers)
    both, edition = ("dead-reckoning", "full"), parsed.data / CLEAN_EDITION
    drives = tuple(recording(parsed.data, file, with_noise) for file in UTIAS)
    dense = recording(parsed.data, DENSE, partial(with_noise, edition=edition))
    noisy = (
        swept("noise_added", Sweep(drives, both, seeds=tuple(SEEDS)), parsed.workers),
        swept("noise_added_dense", Sweep((dense,), both, seeds=tuple(DENSE_SEEDS)), parsed.workers),
    )
    columns = ("ate_m", "ate_aligned_m", *NEES.values(), "nis_per_dof")
    values = {
        "clean": clean.rows("recording", "case", *columns, *COLUMNS),
        "noise added": [row for table in noisy for row in table.rows("recording", "seed", "mode", *columns)],
    }
    runs = {key: part.rows(*columns, *COLUMNS)[0] for key, part in clean.groups("recording", "case").items()}
    added = {name: of_seeds(part) for table in noisy for (name,), part in table.groups("recording").items()}
    write(parsed.out, "table", values, markdown(runs, added), {"gain": plot(runs, added)}, indent=1)
    return 0


def recordings(data: Path) -> tuple[Recording, ...]:
    """Return all recordings, and the dense tracks also with the velocities of the clean edition."""
    clean = recording(data, DENSE, partial(with_velocities, edition=data / CLEAN_EDITION), CLEAN_DENSE)
    return (*(recording(data, file) for file in (*UTIAS, *REPORT, DENSE)), clean)


def with_velocities(sequence: Sequence, seed: int | None, edition: Path) -> Sequence:
    """Return a sequence with the velocities of another edition of the same frames."""
    return sequence.with_velocities(open_sequence(edition).twist)


def with_noise(sequence: Sequence, seed: int | None, edition: Path | None = None) -> Sequence:
    """Add white noise to the velocities, or to those of another edition."""
    clean = sequence if edition is None else with_velocities(sequence, seed, edition)
    noise = ADDED_STD * np.random.default_rng(seed).standard_normal(clean.twist.shape)
    return clean.with_velocities(clean.twist + noise)


# --- Columns ---------------------------------------------------------------------------------------------------------


def share(sequence: Sequence, result: Result, of: str) -> float | None:
    """Return the share of a count in all observations."""
    counts = result.counts
    if "accepted" not in counts:
        return None
    return counts[of] / (counts["accepted"] + counts["rejected"] + counts["dropped by hygiene"])


def tracks_cut(sequence: Sequence, result: Result) -> float:
    """Return the number of tracks cut by hygiene."""
    cut = sum(value for key, value in result.counts.items() if key.startswith("hygiene: "))
    return float(cut - result.counts.get("dropped by hygiene", 0))


def tracks_moving(sequence: Sequence, result: Result) -> float:
    """Return the number of tracks found to move."""
    return float(result.counts.get("moving", 0))


def track_scale(sequence: Sequence, result: Result) -> float:
    """Return the automatic factor on the walk of track errors."""
    return float(result.config["noise"]["track_scale"] or 1.0)


COLUMNS: dict[str, Column] = {
    **{heading: partial(share, of=of) for heading, of in SHARES.items()},
    "tracks cut": tracks_cut,
    "tracks moving": tracks_moving,
    "track scale": track_scale,
}

# --- Tables and figure -----------------------------------------------------------------------------------------------


def of_seeds(part: SweepTable) -> dict[str, Array]:
    """Return ATE in metres of both modes, gain, and pose NEES of full, by seed of one recording."""
    modes = part.groups("mode")
    drive, full = (modes[mode,].column("ate_m") for mode in ("dead-reckoning", "full"))
    nees = modes["full",].column(NEES["with truth noise"])
    return {"dead reckoning": drive, "full": full, "gain": drive / full, "pose NEES": nees}


def gain(runs: Runs, name: str) -> float:
    """Return the error of dead reckoning over that of full SLAM on one recording."""
    return float(runs[name, "dead reckoning"]["ate_m"] / runs[name, "full"]["ate_m"])


def markdown(runs: Runs, noisy: Noisy) -> str:
    """Return the report of the experiment."""
    names, headings = (list(dict.fromkeys(column)) for column in zip(*runs, strict=True))
    drives = [gain(runs, Path(file).stem) for file in UTIAS]
    every = np.concatenate([found["gain"] for name, found in noisy.items() if name != Path(DENSE).stem])
    smoothed = [
        row["ate_m"] / runs[name, "full"]["ate_m"]
        for (name, case), row in runs.items()
        if case == "smoothed" and row["ate_m"] is not None
    ]
    return document(
        "# Recordings, one configuration, noise from the data",
        "ATE in metres, unaligned (in brackets: SE(3)-aligned); gain is dead reckoning's over that of full. "
        "A dash stands where the posterior is ill-posed. Mapping-only has the trajectory of dead reckoning.",
        markdown_table(
            ["set", *headings, "gain"],
            ([name, *(with_aligned(runs[name, k]) for k in headings), f"{gain(runs, name):.2f}"] for name in names),
        ),
        f"Of the {len(drives)} UTIAS drives {sum(value > 1 for value in drives)} gain, {np.median(drives):.2f}x in "
        f"the median. Smoothed over full: {np.median(smoothed):.2f} in the median over all sets.",
        "## Honesty of the covariance",
        "Mean normalised error squared of the pose, 6 for an honest covariance: with the truth as exact, with its own "
        "noise, and, with that noise, of the motion over 100 frames and of the z axis alone; normalised innovation "
        "squared a degree of freedom of full, and the factor on the walk of track errors that was found.",
        markdown_table(
            ["set", *(f"full, {name}" for name in NEES), *(f"smoothed, {name}" for name in NEES), "NIS/dof", "factor"],
            ([name, *honesty_cells(runs[name, "full"], runs[name, "smoothed"])] for name in names),
        ),
        "## What became of the observations (full)",
        "Shares of all observations that were dropped by hygiene, turned down by the gate and not started afresh, or "
        "belong to tracks found to move; how many tracks hygiene cut and how many were found to move.",
        markdown_table(
            ["set", *SHARES, "tracks cut", "tracks moving"],
            ([name, *observation_cells(runs[name, "full"])] for name in names),
        ),
        "## Known noise added to the velocities",
        f"0.5 m/s and 0.05 rad/s a sample, {len(SEEDS)} seeds ({len(DENSE_SEEDS)} of the dense tracks); ATE in metres "
        "and pose NEES of full with truth noise, median (smallest to largest).",
        markdown_table(
            ["set", *next(iter(noisy.values()))],
            (
                [name, *(f"{np.median(v):.2f} ({min(v):.2f} to {max(v):.2f})" for v in found.values())]
                for name, found in noisy.items()
            ),
        ),
        f"Gain over the UTIAS drives and seeds: {np.median(every):.2f} in the median, {min(every):.2f} at the least.",
    )


def honesty_cells(full: dict[str, Any], smoothed: dict[str, Any]) -> list[str]:
    """Return the table of the NEES of full and smoothed, NIS and the factor found."""
    nees = [number(row[key], ".1f") for row in (full, smoothed) for key in NEES.values()]
    return [*nees, f"{full['nis_per_dof']:.2f}", f"{full['track scale']:.2f}"]


def observation_cells(full: dict[str, Any]) -> list[str]:
    """Return the table of what full SLAM did with the observations."""
    shares = [f"{full[key]:.1%}" for key in SHARES]
    tracks = [f"{full[key]:.0f}" for key in ("tracks cut", "tracks moving")]
    return [*shares, *tracks]


@styled
def plot(runs: Runs, noisy: Noisy) -> Figure:
    """Draw the gain over dead reckoning for each set, as recorded and with noise added."""
    figure = Figure(figsize=(8.0, 4.4), layout="constrained")
    ax = figure.subplots()
    names = list(dict.fromkeys(name for name, _ in runs))
    ax.plot([gain(runs, name) for name in names], range(len(names)), **marker_of("full"), label="as recorded")
    for name, found in noisy.items():
        place = np.full(len(found["gain"]), names.index(name) + 0.25)
        label = "noise added, seed by seed" if name in names[:1] else None
        ax.plot(found["gain"], place, "x", color=ORANGE, label=label)
    ax.axvline(1.0, **REFERENCE)
    ax.set_xscale("log")
    ax.set_xticks([0.5, 0.8, 1, 2, 3, 5, 10], ["0.5", "0.8", "1", "2", "3", "5", "10"])
    ax.minorticks_off()
    ax.set_yticks(range(len(names)), names)
    ax.invert_yaxis()
    ax.set_xlabel("ATE of dead reckoning over that of full SLAM [-]; more is better")
    legend_of(figure, [ax], columns=2)
    return figure


if __name__ == "__main__":  # the worker processes import this file
    sys.exit(main())
