"""One camera with an inertial unit, which begins at rest: NEES, position error and scale in simulation.

python experiments/monocular.py --runs 20
python experiments/monocular.py --runs 5 --parallax 0.01 0.03 0.1 --wall 2.5 8
"""

from __future__ import annotations

import argparse
import dataclasses

import numpy as np
from inertial import PARTS, nees, true_values

from ekfslam.arrays import Array
from ekfslam.config import Config
from ekfslam.data.room import Room, simulate_room
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import one_thread, run_filter
from ekfslam.geometry import se3
from ekfslam.resolve import resolve

FIRST = 10  # frame from which the NEES counts: the first pose is exact


def scale_of(found_m: Array, true_m: Array) -> float:
    """Return the size of a path (n, 3) over that of the true one."""
    spread = [np.sqrt(np.mean(np.sum((path - path.mean(axis=0)) ** 2, axis=1))) for path in (found_m, true_m)]
    return float(spread[0] / spread[1])


def run(world: Room, parallax_rad: float, engine: str = "auto") -> tuple[dict[str, float], float, float]:
    """Return mean NEES after the rest by part, root mean square position error (m), and scale."""
    sequence = simulate_room(world)
    problem = resolve(sequence, Config().with_overrides({"filter": {"engine": engine}}))
    sensor = dataclasses.replace(problem.model.sensor, parallax_rad=parallax_rad)  # type: ignore[type-var]
    ekf = JointEKF(dataclasses.replace(problem.model, sensor=sensor), problem.config.filter)
    found, at, true_at = [], [], []
    with one_thread():
        for frame in run_filter(ekf, problem.sequence):
            truth = true_values(sequence, frame.number)
            if frame.number >= FIRST:
                found.append(nees(ekf, truth))
            at.append(ekf.T_world_imu[:3, 3])
            true_at.append(se3.inverse(truth[0])[:3, 3])
    error = np.sqrt(np.mean(np.sum((np.array(at) - np.array(true_at)) ** 2, axis=1)))
    mean = {part: float(np.mean([each[part] for each in found])) for part in PARTS}
    return mean, float(error), scale_of(np.array(at), np.array(true_at))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--frames", type=int, default=250)
    parser.add_argument("--parallax", type=float, nargs="+", default=[0.03], metavar="RAD")
    parser.add_argument("--wall", type=float, nargs="+", default=[2.5], metavar="M", help="least distance of walls")
    parser.add_argument("--period", type=float, nargs="+", default=[0.1], metavar="S", help="between images")
    options = parser.parse_args()
    print("| wall, period, parallax | " + " | ".join(PARTS) + " | ATE (max) mm | scale error (max) % |")
    for wall in options.wall:
        for period in options.period:
            for parallax in options.parallax:
                world = Room(frames=options.frames, cameras=1, wall_m=wall, max_range_m=4 * wall, frame_period_s=period)
                worlds = [dataclasses.replace(world, seed=seed) for seed in range(options.runs)]
                found = [run(each, parallax) for each in worlds]
                cells = []
                for part in PARTS:
                    values = np.array([outcome[0][part] for outcome in found])
                    cells.append(f"{values.mean():.2f} +- {values.std() / np.sqrt(max(len(found) - 1, 1)):.2f}")
                ate, scale = (np.array([outcome[i] for outcome in found]) for i in (1, 2))
                off = 100 * np.abs(scale - 1.0)
                cells += [f"{1e3 * np.median(ate):.0f} ({1e3 * ate.max():.0f})"]
                cells += [f"{np.median(off):.2f} ({off.max():.2f})"]
                print(f"| {wall} m, {period} s, {parallax} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
