"""What the experiments share: their options, the recordings and their truth, errors and gains, and the files written.

The recordings are looked for in ``../shared/data`` or ``$EKFSLAM_DATA``; they may not be shipped.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

import ekfslam
from ekfslam import files
from ekfslam.arrays import Array
from ekfslam.data.readers import open_sequence
from ekfslam.data.sequence import Sequence, Truth
from ekfslam.evaluation.trajectory import absolute_trajectory_error
from ekfslam.figures.style import pngs

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


def argument_parser(description: str | None, results: str, *, data: bool = False) -> argparse.ArgumentParser:
    """A parser with ``--out``, by default the folder ``results`` of `results`, and on request ``--data``."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    if data:
        parser.add_argument("--data", type=Path, default=DATA, metavar="DIR", help="default: %(default)s")
    parser.add_argument("--out", type=Path, default=ROOT / "results" / results, metavar="DIR")
    return parser


def has_recordings(data: Path, *files: str) -> bool:
    """Whether the recordings are there; if not, says so, and the experiment is left out without an error."""
    missing = [file for file in files if not (data / file).is_file()]
    if missing:
        print(f"no {missing[0]} in {data}; give --data or set EKFSLAM_DATA", file=sys.stderr)
    return not missing


def open_recording(data: Path, file: str, **arguments: Any) -> Sequence:
    """A recording, with the true poses of KITTI odometry where it has none of its own but they are known."""
    poses = ODOMETRY.get(Path(file).stem)
    truth = None if poses is None else data / "kitti_odometry_poses" / f"{poses}.txt"
    return open_sequence(data / file, truth=truth, **arguments)


def truth_of(sequence: Sequence) -> Truth:
    """The truth of a sequence that has one."""
    assert sequence.truth is not None
    return sequence.truth


def trajectory_errors(sequence: Sequence, T_world_imu: Array) -> dict[str, float]:
    """Absolute trajectory error of poses (T, 4, 4) in metres: as they stand in world, and aligned by SE(3)."""
    truth = truth_of(sequence)
    estimate = T_world_imu[truth.frame]
    return {
        "ate_m": absolute_trajectory_error(estimate, truth.T_world_imu, align=False),
        "ate_aligned_m": absolute_trajectory_error(estimate, truth.T_world_imu, align=True),
    }


def with_aligned(row: Mapping[str, Any], spec: str = ".2f") -> str:
    """A cell with an error of `trajectory_errors`, and in brackets what alignment leaves of it; a dash for none."""
    return "-" if row["ate_m"] is None else f"{row['ate_m']:{spec}} ({row['ate_aligned_m']:{spec}})"


def run_with(sequence: Sequence, mode: Any, settings: Mapping[str, Mapping[str, Any]]) -> ekfslam.Result:
    """A run with settings ``{table: {key: value}}`` other than the default ones."""
    return ekfslam.run(sequence, mode, ekfslam.Config().with_overrides(settings))


def write(
    folder: Path, name: str, values: Any, text: str, figures: Mapping[str, Figure] | None = None, *, indent: int = 2
) -> None:
    """Write ``<name>.json``, ``<name>.md`` and the figures as PNG into a folder, made if missing."""
    texts = {folder / f"{name}.json": json.dumps(values, indent=indent) + "\n", folder / f"{name}.md": text}
    files.write_all({**texts, **pngs(folder, figures or {}, packed=True)})
