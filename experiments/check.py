"""The factor of `ekfslam check` against sqrt(NEES / 6), on simulated runs with one known fault each, and on recordings.

The stated noise is that of the healthy run: 0.1 m/s, 0.004 rad/s, 0.7 px. NEES is that of one run.

    python experiments/check.py [--seeds N] [--world city|loop] [--recordings] [--data DIR]
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from common import DATA, DENSE, REPORT, UTIAS, open_recording

from ekfslam.arrays import Array
from ekfslam.data.sequence import Noise, Sequence
from ekfslam.data.simulate import City, Loop, simulate
from ekfslam.errors import PosteriorError
from ekfslam.evaluation.honesty import judge
from ekfslam.evaluation.tables import markdown_table
from ekfslam.geometry import se3
from ekfslam.runner import run
from ekfslam.smoother.posterior import posterior

V, W, PX = 0.1, 0.004, 0.7
WORLDS: dict[str, City | Loop] = {
    "city": City(frames=200, max_tracks=40, outlier_fraction=0.0),
    "loop": Loop(frames=200, max_tracks=40),
}
HEALTHY = {"sigma_v_m_s": V, "sigma_w_rad_s": W, "sigma_px": PX}
# What the world has in place of the stated noise.
WORLD_FAULTS: dict[str, dict[str, Any]] = {
    "healthy": {},
    "pixels 2x noisier": {"sigma_px": 2 * PX},
    "pixels 3x noisier": {"sigma_px": 3 * PX},
    "pixels 3x better": {"sigma_px": PX / 3},
    "linear velocities 3x noisier": {"sigma_v_m_s": 3 * V},
    "angular velocities 3x noisier": {"sigma_w_rad_s": 3 * W},
    "velocities 3x better": {"sigma_v_m_s": V / 3, "sigma_w_rad_s": W / 3},
    "all 3x better": {"sigma_v_m_s": V / 3, "sigma_w_rad_s": W / 3, "sigma_px": PX / 3},
    "10 % outliers": {"outlier_fraction": 0.1},
    "four tracks a frame": {"max_tracks": 4},
}


def biased(axis: int, rate: float) -> Callable[[Array, np.random.Generator], Array]:
    return lambda twist, _: twist + rate * np.eye(6)[axis]


def wild(twist: Array, rng: np.random.Generator) -> Array:
    bad = rng.random(len(twist)) < 0.02
    return twist + bad[:, None] * 10 * np.repeat([V, W], 3) * rng.standard_normal(twist.shape)


# What is done to the velocities.
TWIST_FAULTS: dict[str, Callable[[Array, np.random.Generator], Array]] = {
    "bias forward .15 m/s": biased(0, 0.15),
    "bias lateral .15 m/s": biased(1, 0.15),
    "bias of the yaw rate .7 deg/s": biased(5, 0.012),
    "linear velocities 5 % too large": lambda twist, _: twist * np.repeat([1.05, 1.0], 3),
    "velocities one frame late": lambda twist, _: np.concatenate([twist[:1], twist[:-1]]),
    "2 % of the velocities wild": wild,
}


def turned(sequence: Sequence, axis: int) -> Sequence:
    R = se3.transform(se3.so3_exp(np.deg2rad(0.5) * np.eye(3)[axis]), np.zeros(3))
    return dataclasses.replace(sequence, T_cam_imu=R @ sequence.T_cam_imu)


def miscalibrated(sequence: Sequence, baseline: float, focal: float) -> Sequence:
    camera = sequence.camera
    changed = {"fu_px": camera.fu_px * focal, "fv_px": camera.fv_px * focal}
    changed["baseline_m"] = camera.baseline_m * baseline
    return dataclasses.replace(sequence, camera=dataclasses.replace(camera, **changed))


def offset(sequence: Sequence, shift_px: Array) -> Sequence:
    seen = sequence.observations
    return dataclasses.replace(sequence, observations=dataclasses.replace(seen, pixels_px=seen.pixels_px + shift_px))


def walking(sequence: Sequence, rng: np.random.Generator) -> Sequence:
    """Let errors (u, v, disparity) of each track walk by 0.25, 0.25, 0.15 px a frame."""
    seen = sequence.observations
    order = np.lexsort((seen.frame, seen.landmark))
    walk = np.cumsum(rng.normal(size=(len(order), 3)) * [0.25, 0.25, 0.15], axis=0)
    _, first, count = np.unique(seen.landmark[order], return_index=True, return_counts=True)
    error = np.empty_like(walk)
    error[order] = walk - np.repeat(walk[first], count, axis=0)
    u, v, disparity = error.T
    return offset(sequence, np.stack([u, v, u - disparity, v], axis=1))


CAMERA_FAULTS: dict[str, Callable[[Sequence, np.random.Generator], Sequence]] = {
    "camera turned .5 deg about x": lambda sequence, _: turned(sequence, 0),
    "camera turned .5 deg about y": lambda sequence, _: turned(sequence, 1),
    "baseline 2 % too long": lambda sequence, _: miscalibrated(sequence, 1.02, 1.0),
    "focal length 1 % too long": lambda sequence, _: miscalibrated(sequence, 1.0, 1.01),
    "disparity .5 px too small": lambda sequence, _: offset(sequence, np.array([0.0, 0.0, 0.5, 0.0])),
    "tracks walk": walking,
}


def simulated(world: str, seed: int) -> Iterator[tuple[str, Sequence]]:
    """Yield the name of each fault, and a recording with it."""
    stated = Noise.isotropic(V, W, PX)

    def record(**changes: Any) -> Sequence:
        made = dataclasses.replace(WORLDS[world], seed=seed, **{**HEALTHY, **changes})
        return dataclasses.replace(simulate(made), noise=stated)

    for name, changes in WORLD_FAULTS.items():
        yield name, record(**changes)
    for name, change in TWIST_FAULTS.items():
        true = record()
        yield name, true.with_velocities(change(true.twist, np.random.default_rng(seed)))
    for name, fault in CAMERA_FAULTS.items():
        yield name, fault(record(), np.random.default_rng(seed))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=2, metavar="N", help="default: %(default)s")
    parser.add_argument("--world", choices=WORLDS, default="city", help="default: %(default)s")
    parser.add_argument("--recordings", action="store_true", help="the recordings with truth, too")
    parser.add_argument("--data", type=Path, default=DATA, metavar="DIR", help="default: %(default)s")
    parsed = parser.parse_args()
    runs = [named for seed in range(parsed.seeds) for named in simulated(parsed.world, seed)]
    if parsed.recordings:
        runs += [(Path(file).stem, open_recording(parsed.data, file)) for file in (*UTIAS, *REPORT, DENSE)]
    rows, off = [], []
    for name, sequence in runs:
        result = run(sequence)
        try:
            smoothed = posterior(result)
        except PosteriorError:
            smoothed = None
        known = judge(result, smoothed, truth=sequence.truth, interpolated=sequence.interpolated)
        true = np.nan if known.truth is None else float(np.sqrt(known.truth.nees / 6))
        off.append(abs(np.log(known.factor / true)))
        said = ", ".join(dict.fromkeys(cause.kind for cause in (*known.causes, *known.findings)))
        rows.append([name, said, f"{true:.2f}", f"{known.factor:.2f}"])
        print(*rows[-1], sep="; ", flush=True)
    print(markdown_table(["fault", "named", "sqrt(NEES / 6)", "check"], rows, left=2, padded=True))
    given = np.array(off)[np.isfinite(off)]
    within, rms = int((given < np.log(1.5)).sum()), float(np.sqrt((given**2).mean()))
    print(f"{len(given)} numbers, {within} within 1.5x, r.m.s. of the log error {rms:.2f}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
