"""Freezes results of this version, for later ones to be compared with: ``python tests/frozen/make.py``.

Writes beside itself one file for each built-in world, a study, and each recording that is present ($EKFSLAM_DATA). The
noise is white and stated throughout, and landmarks count by their positions in world: the textbook's filter. Everything
is decided by the seeds below, so that the same version writes the same numbers again, to rounding.

What is kept of a run: the last pose, poses and covariances of twelve instants (of recordings: neither), the counts, the
log-likelihood, and `projections` of everything else. These are random sums: of no use for anything but comparison, and
yet no entry can change without all of them changing.

Make new files only where a change of the numbers is meant, and say why in the commit.
"""

from __future__ import annotations

import dataclasses
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np

from ekfslam import Config, FilterConfig, NoiseConfig, Result, Sequence, Study, open_sequence, run, smooth
from ekfslam.config import VARIANTS
from ekfslam.data.simulate import simulate
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import one_thread
from ekfslam.geometry import se3
from ekfslam.models.sensors.stereo import Rig
from ekfslam.studies.study import LEVELS, STUDY_VARIANTS, TEXTBOOK, evaluate, filter_config, realisation

Frozen = dict[str, np.ndarray]

HERE = Path(__file__).parent
DATA = Path(os.environ.get("EKFSLAM_DATA") or HERE.resolve().parents[2] / "shared" / "data")

# Source, settings of the filter, and whether to keep poses and covariances.
WORLDS = {
    "city": ("builtin:city", {}, True),
    "loop": ("builtin:loop", {}, True),
    # Landmarks leave the state and come back.
    "revival": ("builtin:loop?frames=250", {"retire": "unseen"}, False),
}
RECORDINGS = ("0027", "0020")
STARRY_NIGHT = "utias/dataset3.mat"
WINDOWS, WINDOW_FRAMES = 6, 100
STUDY_RUNS = 2
FROZEN_VARIANTS = tuple(variant for variant in STUDY_VARIANTS if variant != TEXTBOOK)
STUDY = Study({"mid": dataclasses.replace(LEVELS["mid"], frames=100)}, FROZEN_VARIANTS, runs=STUDY_RUNS)

COUNTS = (
    "accepted",
    "rejected",
    "split",
    "retired",
    "revived",
    "reappeared",
    "moving",
    "dropped by hygiene",
    "observations",
    "observations weighted below one half",
    "iterations",
)
_INSTANTS = 12
_PROJECTIONS = 6
_ROUNDING = 1e-12


def projections(values: np.ndarray, seed: int = 0) -> np.ndarray:
    """Random sums of all entries of (n, ...) values: what is small in one of the n blocks counts as what is large.

    Each block is divided by its largest entry, and the logarithms of these are summed apart. NaN is taken as none; so
    are blocks that are nothing but rounding beside the others.
    """
    values = np.nan_to_num(np.asarray(values, dtype=float)).reshape(len(values), -1)
    largest = np.abs(values).max(axis=1, initial=0.0)
    scale = np.where(largest > _ROUNDING * largest.max(initial=0.0), largest, max(largest.max(initial=0.0), 1.0))
    rng = np.random.default_rng(seed)
    sums = [
        x @ rng.standard_normal((x.size, _PROJECTIONS)) / np.sqrt(max(x.size, 1))
        for x in ((values / scale[:, None]).ravel(), np.log(scale))
    ]
    return np.concatenate(sums)


def of_poses(T_world_imu: np.ndarray, covariance: np.ndarray) -> Frozen:
    return {
        "rotations": projections(T_world_imu[:, :3, :3]),
        "positions": projections(T_world_imu[:, :3, 3]),
        "covariances": projections(covariance),
    }


def of_map(position_m: np.ndarray, covariance: np.ndarray) -> Frozen:
    return {"landmarks": projections(position_m), "landmark covariances": projections(covariance)}


def of_result(result: Result, numbers: bool = True) -> Frozen:
    """What is kept of a run; without ``numbers`` no pose and no covariance is in it."""
    poses, landmarks = result.T_world_imu, result.landmarks
    kept = of_poses(poses, result.covariance)
    if len(landmarks):
        kept |= of_map(landmarks.position_m, landmarks.covariance)
        kept["landmark ids"] = projections(landmarks.id)
    if result.innovation.dof.any():
        kept["nis"] = projections(result.innovation.nis)
        kept["log likelihood"] = np.array(result.attributes["log_likelihood"])
    kept["counts"] = np.array([result.counts.get(name, -1) for name in COUNTS])
    if numbers:
        some = np.linspace(0, len(poses) - 1, _INSTANTS).astype(int)
        kept["last pose"] = poses[-1, :3]
        kept["some poses"] = poses[some, :3]
        kept["some covariances"] = result.covariance[some][:, *np.triu_indices(6)]
    return kept


def of_runs(
    sequence: Sequence, settings: dict, numbers: bool, variants: Iterable[str], smoothed: bool = True
) -> Iterator[tuple[str, Frozen]]:
    """All modes, the joint filter and its smoothed run in these variants; name and what is kept of each."""
    config = Config(noise=NoiseConfig(model="white"), filter=FilterConfig(landmark_coordinates="xyz", **settings))
    for mode in ("dead-reckoning", "mapping-only"):
        yield mode, of_result(run(sequence, mode, config), numbers)
    for variant in variants:
        result = run(sequence, "full", config.with_overrides({"filter": {"variant": variant}}))
        yield f"full, {variant}", of_result(result, numbers)
        if smoothed:
            yield f"smoothed, {variant}", of_result(smooth(result), numbers)


def of_world(name: str, variants: Iterable[str] = tuple(VARIANTS), smoothed: bool = True) -> Frozen:
    source, settings, numbers = WORLDS[name]
    return _joined(name, of_runs(open_sequence(source), settings, numbers, variants, smoothed))


def of_recording(name: str, path: Path, variants: Iterable[str] = tuple(VARIANTS)) -> Frozen:
    # As stored, as it was when these were frozen.
    return _joined(name, of_runs(open_sequence(path, lateral="as-stored"), {}, numbers=False, variants=variants))


def of_starry_night(path: Path) -> Frozen:
    """Windows of the recording, each from the true pose, displaced by a draw from the prior, with an empty map."""
    sequence = open_sequence(path)
    starts = np.linspace(0, len(sequence) - WINDOW_FRAMES, WINDOWS).astype(int)
    windows = ((f"{variant}, {start}", _window(sequence, variant, start)) for variant in VARIANTS for start in starts)
    return _joined("window", windows)


def _window(sequence: Sequence, variant: str, start: int) -> Frozen:
    truth, noise = sequence.truth, sequence.noise
    config = FilterConfig(
        variant,
        landmark_coordinates="xyz",
        retire="never",
        gate_probability=1.0,
        split_after=0,
        initial_position_std_m=0.01,
        initial_rotation_std_rad=0.01,
    )
    xi = 0.01 * np.random.default_rng(start).standard_normal(6)
    rig = Rig(sequence.camera, sequence.T_cam_imu, noise)
    ekf = JointEKF(rig, config, truth.T_world_imu[start] @ se3.exp(xi))
    poses, covariance, nis = [], [], []
    for k in range(start, start + WINDOW_FRAMES):
        if k > start:
            ekf.predict(sequence.twist[k], sequence.time_s[k] - sequence.time_s[k - 1])
        nis.append(ekf.update(k, *sequence.observations.at(k)).nis)
        poses.append(ekf.T_world_imu)
        covariance.append(ekf.P[:6, :6].copy())
    landmarks = ekf.landmarks()
    kept = of_poses(np.array(poses), np.array(covariance)) | of_map(landmarks.position_m, landmarks.covariance)
    return {**kept, "nis": projections(nis), "landmark ids": projections(landmarks.id)}


def of_study(number: int) -> Frozen:
    world = realisation(STUDY, "mid", number)
    sequence, records = simulate(world), []
    for variant in STUDY.variants:
        # Refused in a `Config`, iterated updates in world still say whether the filter is the same.
        config = dataclasses.replace(filter_config(world, variant), landmark_coordinates="xyz")
        with one_thread(), np.errstate(all="ignore"):
            record = evaluate(sequence, world, config)
        records.append((variant, {key: projections(np.atleast_1d(x)) for key, x in record.items()}))
    return _joined(f"run {number}", iter(records))


def _joined(name: str, parts: Iterator[tuple[str, Frozen]]) -> Frozen:
    return {f"{name}: {part}: {key}": value for part, kept in parts for key, value in kept.items()}


def write(path: Path, frozen: Frozen) -> None:
    """One vector of all values, beside the name and the size of each: a file of many small arrays is mostly headers."""
    names, values = list(frozen), [np.ravel(value).astype(float) for value in frozen.values()]
    np.savez_compressed(path, name=names, size=[len(value) for value in values], value=np.concatenate(values))


def read(path: Path) -> Frozen:
    """What `write` wrote, each entry as a vector."""
    with np.load(path) as file:
        parts = np.split(file["value"], np.cumsum(file["size"])[:-1])
        return dict(zip(file["name"].tolist(), parts, strict=True))


def main() -> int:
    made: dict[str, Callable[[], Frozen]] = {name: lambda name=name: of_world(name) for name in WORLDS}
    made["study"] = lambda: {key: value for n in range(STUDY_RUNS) for key, value in of_study(n).items()}
    for name in RECORDINGS:
        if (path := DATA / "ece276a" / f"{name}.npz").exists():
            made[name] = lambda name=name, path=path: of_recording(name, path)
    if (path := DATA / STARRY_NIGHT).exists():
        made["starry_night"] = lambda path=path: of_starry_night(path)
    for name, make in made.items():
        write(file := HERE / f"{name}.npz", make())
        print(f"{file.name}: {file.stat().st_size / 1e3:.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
