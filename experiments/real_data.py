"""Every recording, every mode, one configuration: noise from the data, no truth used but for the evaluation.

The recordings are looked for in ``../shared/data`` or ``$EKFSLAM_DATA``. The second table adds known white noise to the
clean velocities of the UTIAS drives (0.5 m/s and 0.05 rad/s a sample, five seeds); the filter is not told.

    python experiments/real_data.py [--data DIR] [--out DIR]
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import ekfslam
from ekfslam.data.sequence import Sequence
from ekfslam.evaluation.consistency import pose_nees
from ekfslam.evaluation.trajectory import absolute_trajectory_error
from ekfslam.figures.style import ORANGE, REFERENCE, marker_of, save_figure, styled
from ekfslam.filters.result import Result

ROOT = Path(__file__).parents[1]
DATA = Path(os.environ.get("EKFSLAM_DATA") or ROOT.parent / "shared" / "data")

UTIAS = tuple(
    f"utias/2011_{drive}_sync_KLT.mat"
    for drive in (
        "09_26_drive_0001",
        "09_26_drive_0009",
        "09_26_drive_0027",
        "09_26_drive_0036",
        "09_30_drive_0020",
        "09_30_drive_0027",
        "10_03_drive_0042",
    )
)
ECE276A = (("ece276a/0020.npz", "06"), ("ece276a/0027.npz", "07"), ("ece276a/0042.npz", "01"))
DENSE = ("ece276a/0027_dense_noisy.npz", "07")

# Heading, mode, settings.
ESTIMATORS: tuple[tuple[str, Any, dict[str, dict[str, Any]]], ...] = (
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
SEEDS = range(5)
ADDED_STD = np.repeat([0.5, 0.05], 3)


def main() -> None:
    options = parsed(__doc__)
    table: dict[str, dict[str, dict[str, float]]] = {}
    for name, sequence in recordings(options.data):
        table[name] = {}
        for heading, mode, settings in ESTIMATORS:
            try:
                result = ekfslam.run(sequence, mode, ekfslam.Config().with_overrides(settings))
            except ekfslam.EkfslamError as error:
                print(f"{name}: no {heading}: {error}", file=sys.stderr)
                continue
            table[name][heading] = {**errors(sequence, result), **statistics(sequence, result)}
        print(name, {key: round(value["ate_m"], 3) for key, value in table[name].items()}, flush=True)
    noisy = {}
    for path in UTIAS:
        sequence = ekfslam.open_sequence(options.data / path)
        noisy[Path(path).stem] = [with_noise_added(sequence, seed) for seed in SEEDS]
        print(Path(path).stem, noisy[Path(path).stem], flush=True)

    (options.out / "table.json").write_text(json.dumps({"clean": table, "noise added": noisy}, indent=1) + "\n")
    (options.out / "table.md").write_text(markdown(table, noisy), encoding="utf-8")
    save_figure(plot(table, noisy), options.out / "gain.png")


def parsed(description: str | None) -> argparse.Namespace:
    """The options ``data`` and ``out``; exits where there are no recordings."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA, metavar="DIR", help="default: %(default)s")
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "real_data", metavar="DIR")
    options = parser.parse_args()
    if not options.data.is_dir():
        sys.exit(f"{options.data} is absent; set $EKFSLAM_DATA to the folder of the recordings")
    options.out.mkdir(parents=True, exist_ok=True)
    return options


def recordings(data: Path) -> Iterator[tuple[str, Sequence]]:
    """Name and recording of every set with truth; the dense tracks once with the velocities of the clean edition."""
    for path in UTIAS:
        yield Path(path).stem, ekfslam.open_sequence(data / path)
    for path, poses in (*ECE276A, DENSE):
        yield Path(path).stem, ekfslam.open_sequence(data / path, truth=data / f"kitti_odometry_poses/{poses}.txt")
    dense = ekfslam.open_sequence(data / DENSE[0], truth=data / f"kitti_odometry_poses/{DENSE[1]}.txt")
    clean = ekfslam.open_sequence(data / "ece276a/0027.npz").twist
    yield "0027_dense, clean velocities", dataclasses.replace(dense, twist=clean)


def errors(sequence: Sequence, result: Result) -> dict[str, float]:
    """ATE, unaligned and aligned, in metres."""
    truth = sequence.truth
    assert truth is not None
    estimate = result.T_world_imu[truth.frame]
    return {
        "ate_m": absolute_trajectory_error(estimate, truth.T_world_imu, align=False),
        "ate_aligned_m": absolute_trajectory_error(estimate, truth.T_world_imu, align=True),
    }


def statistics(sequence: Sequence, result: Result) -> dict[str, float]:
    """What became of the observations, in shares of all; how large innovations and errors are for their covariance."""
    counts, innovation = result.counts, result.innovation
    assert sequence.truth is not None
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
        "pose_nees": float(np.nanmean(pose_nees(result, sequence.truth)[1])),
    }


def with_noise_added(sequence: Sequence, seed: int) -> dict[str, float]:
    """ATE in metres of dead reckoning and full SLAM on velocities with noise added."""
    noise = ADDED_STD * np.random.default_rng(seed).standard_normal(sequence.twist.shape)
    spoilt = dataclasses.replace(sequence, twist=sequence.twist + noise)
    return {mode: errors(spoilt, ekfslam.run(spoilt, mode))["ate_m"] for mode in ("dead-reckoning", "full")}


def gains(runs: list[dict[str, float]]) -> list[float]:
    """Dead reckoning's error over that of full SLAM, seed by seed."""
    return [run["dead-reckoning"] / run["full"] for run in runs]


def markdown(table: dict[str, dict[str, dict[str, float]]], noisy: dict[str, list[dict[str, float]]]) -> str:
    """Both tables."""
    headings = [heading for heading, _, _ in ESTIMATORS]
    lines = [
        "# Recordings, one configuration, noise from the data\n",
        "ATE in metres, unaligned (in brackets: SE(3)-aligned); gain is dead reckoning's over that of full. "
        "A dash stands where the posterior is ill-posed: tracks that travel with the rig fit a point at infinity.\n",
        f"| set | {' | '.join(headings)} | gain |",
        "|---|" + "---:|" * (len(headings) + 1),
    ]
    for name, row in table.items():
        cells = [f"{row[k]['ate_m']:.2f} ({row[k]['ate_aligned_m']:.2f})" if k in row else "-" for k in headings]
        gain = row["dead reckoning"]["ate_m"] / row["full"]["ate_m"]
        lines.append(f"| {name} | {' | '.join(cells)} | {gain:.2f} |")
    drives = [
        table[Path(path).stem]["dead reckoning"]["ate_m"] / table[Path(path).stem]["full"]["ate_m"] for path in UTIAS
    ]
    lines += [
        f"\nOf the {len(drives)} UTIAS drives {sum(gain > 1 for gain in drives)} gain, {np.median(drives):.2f}x in "
        "the median over all.\n",
        "Mapping-only maps on dead reckoning's poses; its trajectory is that.\n",
        *observations_table(table),
        "## Known noise added to the velocities\n",
        "0.5 m/s and 0.05 rad/s a sample, five seeds; ATE in metres, median (smallest to largest).\n",
        "| set | dead reckoning | full | gain |",
        "|---|---:|---:|---:|",
    ]
    for name, runs in noisy.items():
        values = [[run[mode] for run in runs] for mode in ("dead-reckoning", "full")]
        cells = [f"{np.median(v):.2f} ({min(v):.2f} to {max(v):.2f})" for v in (*values, gains(runs))]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    every = [gain for runs in noisy.values() for gain in gains(runs)]
    lines.append(
        f"\nGain over all sets and seeds: {np.median(every):.2f} in the median, {min(every):.2f} at the least."
    )
    return "\n".join(lines) + "\n"


def observations_table(table: dict[str, dict[str, dict[str, float]]]) -> list[str]:
    """What full SLAM did with the observations."""
    lines = [
        "## What became of the observations (full)\n",
        "Shares of all observations that were dropped by hygiene, turned down by the gate, or belong to tracks found "
        "to move; how many tracks hygiene cut and how many were found to move; normalised innovation squared a degree "
        "of freedom, which is below 1 as the assumed noise makes up for errors that agree among themselves; mean "
        "normalised error squared of the pose, 6 for an honest covariance.\n",
        f"| set | {' | '.join(SHARES)} | tracks cut | tracks moving | NIS/dof | pose NEES |",
        "|---|" + "---:|" * (len(SHARES) + 4),
    ]
    for name, row in table.items():
        full = row["full"]
        shares = " | ".join(f"{full[key]:.1%}" for key in SHARES)
        tracks = f"{full['cuts']:.0f} | {full['moving tracks']:.0f}"
        lines.append(f"| {name} | {shares} | {tracks} | {full['nis_per_dof']:.2f} | {full['pose_nees']:.0f} |")
    return [*lines, ""]


@styled
def plot(table: dict[str, dict[str, dict[str, float]]], noisy: dict[str, list[dict[str, float]]]) -> Figure:
    """Gain over dead reckoning, set by set: as recorded, and with noise added."""
    figure = Figure(figsize=(8.0, 4.2))
    ax = figure.subplots()
    names = list(table)
    clean = [table[name]["dead reckoning"]["ate_m"] / table[name]["full"]["ate_m"] for name in names]
    ax.plot(clean, range(len(names)), **marker_of("full"), label="as recorded")
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
    main()
