"""A sweep with a column and recordings of one's own: how much noise of the velocities vision can make up for.

One learns how to change recordings after they are read (seed by seed), how to add a column, how to name settings that
belong together, and how to read the table. Where it runs is another word for `open_executor`: ``processes`` takes all
cores, ``serial`` none but this one.
"""

from __future__ import annotations

import tempfile
from functools import partial
from pathlib import Path

import numpy as np

import ekfslam
from ekfslam.studies.executors import open_executor
from ekfslam.studies.sweep import Case, Recording, Sweep, run_sweep

LOOP = "builtin:loop?frames=80&landmarks=40"  # a path of a recording is as good
CASES = {
    "velocities alone": Case(mode="dead-reckoning"),
    "full": Case(),
    "full, no gate": Case({"filter": {"gate_probability": 1.0}}),
}


def with_noise(sequence: ekfslam.Sequence, seed: int | None, std_m_s: float) -> ekfslam.Sequence:
    """White noise added to the linear velocities."""
    noise = std_m_s * np.random.default_rng(seed).standard_normal((len(sequence), 3))
    return sequence.with_velocities(sequence.twist + np.pad(noise, ((0, 0), (0, 3))))


def landmarks(sequence: ekfslam.Sequence, result: ekfslam.Result) -> float:
    """How many there are in the map."""
    return float(len(result.landmarks))


def main() -> None:
    noisy = {f"{std_m_s} m/s": partial(with_noise, std_m_s=std_m_s) for std_m_s in (0.2, 1.0)}
    recordings = tuple(Recording(LOOP, name, prepare=prepare) for name, prepare in noisy.items())
    sweep = Sweep(recordings, cases=CASES, seeds=(0, 1), columns={"landmarks": landmarks})
    with tempfile.TemporaryDirectory() as folder, open_executor("serial") as executor:
        table = run_sweep(sweep, Path(folder) / "sweep.h5", executor)
    print(table.markdown(["ate_m", "landmarks"]))
    for (recording, case), part in table.groups("recording", "case").items():
        print(f"{recording}, {case}: ATE {part.column('ate_m').mean():.3f} m in the mean of {len(part)} seeds")


if __name__ == "__main__":  # processes would import this file, too
    main()
