"""Real samples of an inertial unit in flight, with stereo features simulated from the true poses: noise without truth.

    python experiments/semi_real.py mav0/imu0/data.csv truth.txt --frames 1200

Images are at the stamps of the truth (a TUM file), so that nothing is interpolated. Samples have the densities of the
data sheet; the densities of flight are found (`ekfslam.inertial.noise`), and so is the first state.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import ekfslam
from ekfslam.arrays import Array
from ekfslam.data.inputs import InertialNoise, InertialSamples
from ekfslam.data.noise import Noise
from ekfslam.data.observations import Truth
from ekfslam.data.room import CAMERA, IMAGE_SIZE_PX, Room
from ekfslam.data.sequence import Sequence
from ekfslam.data.worlds import View, observed
from ekfslam.evaluation.consistency import nees, pose_error
from ekfslam.geometry import se3

EUROC = InertialNoise(1.6968e-4, 2.0e-3, 1.9393e-5, 3.0e-3)
# The left camera of EuRoC, turned upright as its images are.
T_IMU_CAM = se3.transform(
    np.array([[0.0149, -0.9999, 0.0041], [0.9996, 0.0150, 0.0257], [-0.0258, 0.0038, 0.9997]]),
    np.array([-0.0216, -0.0647, 0.0098]),
)


def semi_real(
    imu: Path, truth: Path, first: int, frames: int, every: int, seed: int, noise: InertialNoise | None
) -> Sequence:
    """Return a recording of some true poses with the samples of a csv file."""
    poses = np.loadtxt(truth)[first : first + frames * every : every]
    begin_ns = round(poses[0, 0] * 1e9)
    ns = np.loadtxt(imu, delimiter=",", dtype=np.int64, usecols=0)
    values = np.loadtxt(imu, delimiter=",", usecols=range(1, 7))
    samples = InertialSamples((ns - begin_ns) * 1e-9, values[:, :3], values[:, 3:], noise)
    time_s = poses[:, 0] - poses[0, 0]
    T = se3.transform(Rotation.from_quat(poses[:, 4:]).as_matrix(), poses[:, 1:4])
    rng, world = np.random.default_rng(seed), Room(frames=len(T))
    R = se3.nearest_rigid(T_IMU_CAM)
    view = View(CAMERA, IMAGE_SIZE_PX, se3.inverse(R))
    observations, _, _ = observed(world, view, se3.inverse(T), box(T[:, :3, 3], rng), rng, ids_last=False)
    return Sequence(
        name="semi-real",
        source=str(imu),
        time_s=time_s,
        camera=CAMERA,
        T_cam_imu=view.T_cam_imu,
        observations=observations,
        inputs=(samples,),
        truth=Truth(np.arange(len(T)), T),
        noise=Noise.isotropic(0.0, 0.0, world.sigma_px),
    )


def levelled(true: Array, found: Array) -> Array:
    """Return true poses (T, 4, 4) turned by the tilt of the estimates against them: their world is not level."""
    tilt = np.median(se3.so3_log(found[:, :3, :3] @ np.swapaxes(true[:, :3, :3], 1, 2)), axis=0) * [1.0, 1.0, 0.0]
    print(f"world of the truth tilted by {1e3 * tilt[0]:.2f}, {1e3 * tilt[1]:.2f} mrad")
    R = se3.so3_exp(tilt)
    turn = se3.transform(R, true[0, :3, 3] - R @ true[0, :3, 3])
    return np.asarray(turn @ true)


def box(position_m: Array, rng: np.random.Generator, count: int = 1500) -> Array:
    """Return points (count, 3) on the sides of a box about a way (T, 3)."""
    margin = np.array([2.5, 2.5, 1.5])
    low, high = position_m.min(axis=0) - margin, position_m.max(axis=0) + margin
    area = np.prod(high - low) / (high - low)
    axis, points = rng.choice(3, count, p=area / area.sum()), rng.uniform(low, high, (count, 3))
    points[np.arange(count), axis] = np.where(rng.random(count) < 0.5, low[axis], high[axis])
    return points


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("imu", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--frames", type=int, default=1200)
    parser.add_argument("--every", type=int, default=1, help="use every n-th true pose")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--unstated", action="store_true", help="samples state no densities")
    parser.add_argument("--densities", type=float, nargs=4, help="use these")
    parser.add_argument("--level", action="store_true", help="turn the truth about its first position to be level")
    options = parser.parse_args()
    config = ekfslam.Config()
    if options.densities:
        names = (field.name for field in dataclasses.fields(InertialNoise))
        config = config.with_overrides({"inertial": dict(zip(names, options.densities, strict=True))})
    for seed in range(options.seeds):
        noise = None if options.unstated else EUROC
        sequence = semi_real(options.imu, options.truth, options.first, options.frames, options.every, seed, noise)
        result = ekfslam.run(sequence, "full", config)
        assert sequence.truth is not None
        true = sequence.truth.T_world_imu
        true = levelled(true, result.T_world_imu) if options.level else true
        squared = nees(pose_error(result.T_world_imu, true), result.covariance + 1e-14 * np.eye(6))
        ate = np.sqrt(np.mean(np.sum((result.T_world_imu - true)[:, :3, 3] ** 2, axis=1)))
        for key in ("inertial_noise", "inertial_start"):
            print(f"{key}: {result.attributes[key]}")
        nis = result.innovation.nis.sum() / result.innovation.dof.sum()
        print(
            f"seed {seed}: pose NEES mean {squared[1:].mean():.1f}, median {np.median(squared[1:]):.1f}, last "
            f"{squared[-1]:.1f}; ATE {1e3 * ate:.1f} mm; NIS / dof {nis:.3f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
