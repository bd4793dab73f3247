"""Test the covariance with velocities of which a few are wrong: 1 % by 10 standard deviations, in all six axes.

Both drives that are built in, with as many landmarks a frame as are in view and with five. The wrong samples are those
that the filter did not expect: the table counts how many of them it rejected, and how many good ones.

    python experiments/wild_velocities.py [--runs N] [--frames N] [--share S] [--sigmas S] [--axes N]
"""

from __future__ import annotations

import argparse
from typing import NamedTuple

import numpy as np

from ekfslam import open_sequence, run
from ekfslam.arrays import IntArray
from ekfslam.data.sequence import Sequence
from ekfslam.evaluation.consistency import pose_nees
from ekfslam.evaluation.tables import markdown_table
from ekfslam.evaluation.trajectory import absolute_trajectory_error

DRIVES = ("city", "loop")
TRACKS = {"dense": "", "5 landmarks": "&max_tracks=5"}


class Run(NamedTuple):
    """Outcome of one run: pose NEES, ATE in metres, and numbers of wild, found and wrongly rejected velocities."""

    nees: float
    ate_m: float
    wild: int
    found: int
    wrongly: int


def spoiled(
    sequence: Sequence, share: float, sigmas: float, axes: int, rng: np.random.Generator
) -> tuple[Sequence, IntArray]:
    """Return a sequence in which a share of the velocities is wrong in some axes, and the frames of these."""
    twist, noise = sequence.twist.copy(), sequence.noise
    assert noise is not None
    wild = 1 + np.flatnonzero(rng.random(len(twist) - 1) < share)
    for k in wild:
        some = rng.permutation(6)[:axes]
        twist[k, some] += sigmas * noise.twist_std[some] * rng.choice([-1.0, 1.0], axes)
    return sequence.with_velocities(twist), wild


def one_run(sequence: Sequence, wild: IntArray) -> Run:
    result = run(sequence)
    assert result.log is not None and sequence.truth is not None
    rejected = np.flatnonzero(result.log.doubt > 1.0)
    truth = sequence.truth
    ate_m = absolute_trajectory_error(result.T_world_imu[truth.frame], truth.T_world_imu, align=False)
    found = len(np.intersect1d(rejected, wild))
    return Run(float(np.nanmean(pose_nees(result, truth)[1])), ate_m, len(wild), found, len(rejected) - found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20, metavar="N", help="default: %(default)s")
    parser.add_argument("--frames", type=int, default=300, metavar="N", help="default: %(default)s")
    parser.add_argument("--share", type=float, default=0.01, metavar="S", help="default: %(default)s")
    parser.add_argument("--sigmas", type=float, default=10.0, metavar="S", help="default: %(default)s")
    parser.add_argument("--axes", type=int, default=6, metavar="N", help="default: %(default)s")
    parsed = parser.parse_args()
    heading = ["world", "landmarks", "wild", "NEES, mean", "median", "largest", "ATE, median, m", "found", "wrongly"]
    rows = []
    for drive in DRIVES:
        for name, query in TRACKS.items():
            for share in (0.0, parsed.share):
                runs = []
                for seed in range(parsed.runs):
                    world = open_sequence(f"builtin:{drive}?seed={seed}&frames={parsed.frames}{query}")
                    rng = np.random.default_rng(seed)
                    runs.append(one_run(*spoiled(world, share, parsed.sigmas, parsed.axes, rng)))
                nees, ate_m, wild, found, wrongly = np.array(runs).T
                mean = f"{nees.mean():.2f} +- {nees.std() / np.sqrt(len(runs)):.2f}"
                figures = [f"{np.median(nees):.2f}", f"{nees.max():.2f}", f"{np.median(ate_m):.3f}"]
                rows.append([drive, name, f"{share:.0%}", mean, *figures, f"{found.sum():.0f} of {wild.sum():.0f}"])
                rows[-1].append(f"{wrongly.sum():.0f}")
                print(" | ".join(rows[-1]), flush=True)
    print(markdown_table(heading, rows))


if __name__ == "__main__":
    main()
