"""Shared parts of the experiments: options, recordings and their truth, errors, and the files written.

Recordings are read from ``$EKFSLAM_DATA`` or ``../shared/data``; they may not be redistributed.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from ekfslam import files, open_sequence
from ekfslam.arrays import Array
from ekfslam.data.sequence import Sequence, Truth
from ekfslam.evaluation.trajectory import absolute_trajectory_error
from ekfslam.figures.style import pngs
from ekfslam.studies.executors import open_executor
from ekfslam.studies.sweep import Recording, Sweep, run_sweep
from ekfslam.studies.sweep_table import SweepTable

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
STARRY_NIGHT = "utias/dataset3.mat"
REPORT = ("ece276a/0020.npz", "ece276a/0027.npz", "ece276a/0042.npz")
DENSE = "ece276a/0027_dense_noisy.npz"  # of the drive 0027, whose clean edition has the same frames

# Recordings without truth of their own, and the poses of KITTI odometry that are theirs.
ODOMETRY = {"0020": "06", "0027": "07", "0042": "01", "0027_dense_noisy": "07"}


def argument_parser(
    description: str | None, results: str, *, data: bool = False, workers: bool = False
) -> argparse.ArgumentParser:
    """Return a parser with ``--out``, by default ``results/<results>``, and on request ``--data`` and ``--workers``."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    if data:
        parser.add_argument("--data", type=Path, default=DATA, metavar="DIR", help="default: %(default)s")
    if workers:
        parser.add_argument("--workers", type=int, default=2, metavar="N", help="processes, default: %(default)s")
    parser.add_argument("--out", type=Path, default=ROOT / "results" / results, metavar="DIR")
    return parser


def has_recordings(data: Path, *files: str) -> bool:
    """Return whether the recordings are there, and print the first missing one."""
    missing = [file for file in files if not (data / file).is_file()]
    if missing:
        print(f"no {missing[0]} in {data}; give --data or set EKFSLAM_DATA", file=sys.stderr)
    return not missing


def truth_file(data: Path, file: str) -> Path | None:
    """Return the file of true poses for a recording without truth of its own; None if there is none."""
    poses = ODOMETRY.get(Path(file).stem)
    return None if poses is None else data / "kitti_odometry_poses" / f"{poses}.txt"


def open_recording(data: Path, file: str, **arguments: Any) -> Sequence:
    """Open a recording with its `truth_file`."""
    return open_sequence(data / file, truth=truth_file(data, file), **arguments)


def recording(
    data: Path, file: str, prepare: Callable[[Sequence, int | None], Sequence] | None = None, name: str = ""
) -> Recording:
    """Return a recording of a sweep with its `truth_file`."""
    truth = truth_file(data, file)
    return Recording(str(data / file), name or Path(file).stem, None if truth is None else str(truth), prepare=prepare)


def swept(name: str, sweep: Sweep, workers: int) -> SweepTable:
    """Run a sweep or resume it, print failed runs, and return the table.

    The table is kept in ``results/local``, and computed again when the program has changed.
    """
    decides = hashlib.sha256("".join(task.key for task in sweep.tasks).encode()).hexdigest()[:12]
    path = ROOT / "results" / "local" / "sweeps" / f"{name}-{decides}.h5"
    with open_executor("processes", workers) as executor:
        table = run_sweep(sweep, path, executor)
    for why, failed in table.groups("error").items():
        if any(why):
            print(f"{name}: {why[0]}: {failed.rows(*table.swept)}", file=sys.stderr)
    return table


def truth_of(sequence: Sequence) -> Truth:
    """Return the truth of a sequence that has one."""
    assert sequence.truth is not None
    return sequence.truth


def trajectory_errors(sequence: Sequence, T_world_imu: Array) -> dict[str, float]:
    """Return the absolute trajectory error of poses (T, 4, 4) in metres, without alignment and aligned by SE(3)."""
    truth = truth_of(sequence)
    estimate = T_world_imu[truth.frame]
    return {
        "ate_m": absolute_trajectory_error(estimate, truth.T_world_imu, align=False),
        "ate_aligned_m": absolute_trajectory_error(estimate, truth.T_world_imu, align=True),
    }


def with_aligned(row: Mapping[str, Any], spec: str = ".2f") -> str:
    """Return a cell with an ATE, and in brackets the aligned one; a dash for none."""
    return "-" if row["ate_m"] is None else f"{row['ate_m']:{spec}} ({row['ate_aligned_m']:{spec}})"


def write(
    folder: Path, name: str, values: Any, text: str, figures: Mapping[str, Figure] | None = None, *, indent: int = 2
) -> None:
    """Write ``<name>.json``, ``<name>.md`` and the figures as PNG into a folder, made if missing."""
    texts = {folder / f"{name}.json": json.dumps(values, indent=indent) + "\n", folder / f"{name}.md": text}
    files.write_all({**texts, **pngs(folder, figures or {}, packed=True)})
