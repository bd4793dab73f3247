"""Consistency of the inertial process: NEES of pose, velocity and biases, and large first errors.

    python experiments/inertial.py --trajectory V1_01.txt --trajectory room1.txt --runs 20 --out results/inertial
    python experiments/inertial.py --tilt --runs 6

Worlds are those of `builtin:room`: a made trajectory, and real ones as TUM files. Each run draws first errors from the
prior, whose tilt and accelerometer bias are correlated as after a moment at rest. ``--out`` writes the table, its
numbers and a figure. Values further than three standard errors from the expectation are marked with ``!``.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Iterable
from pathlib import Path
from time import perf_counter

import numpy as np
from matplotlib.figure import Figure

from ekfslam import files
from ekfslam.arrays import Array
from ekfslam.config import FilterConfig
from ekfslam.data.room import GRAVITY_M_S2, MAX_GAP_S, Room, simulate_room
from ekfslam.data.sequence import Sequence
from ekfslam.evaluation.tables import document, markdown_table
from ekfslam.figures.style import EXPECTED as EXPECTED_LINE
from ekfslam.figures.style import SERIES, legend_of, png, styled
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import one_thread, run_filter
from ekfslam.geometry import se3
from ekfslam.models.blocks import AccelBias, GyroBias, Velocity
from ekfslam.models.build import model_of
from ekfslam.models.model import Model
from ekfslam.models.process.inertial import inertial
from ekfslam.models.sensors.stereo import Rig

FILTER = FilterConfig(retire="unseen", retire_after=1, revive=-1)
PARTS = {"rotation": slice(3, 6), "position": slice(0, 3), "velocity": slice(6, 9)}
PARTS |= {"gyro bias": slice(9, 12), "accel bias": slice(12, 15), "pose": slice(0, 6), "all": slice(0, 15)}


@dataclasses.dataclass(frozen=True)
class Prior:
    """Standard deviations of first errors, each axis.

    Args:
        position_m, tilt_rad, yaw_rad, velocity_m_s, gyro_bias_rad_s, accel_bias_m_s2: Before anything is measured.
        rest_s: Time for which the accelerometer has seen gravity alone, which couples tilt and its bias; 0: none.
        exact_tilt_rad: Size of the first tilt, in a random direction; 0: it is drawn like all other errors.
    """

    position_m: float = 0.001
    tilt_rad: float = 0.3
    yaw_rad: float = 0.001
    velocity_m_s: float = 0.15
    gyro_bias_rad_s: float = 0.01
    accel_bias_m_s2: float = 0.1
    rest_s: float = 1.0
    exact_tilt_rad: float = 0.0

    def covariance(self, R_imu_world: Array, accel_density: float) -> Array:
        """Return the covariance (15, 15) at a rotation (3, 3)."""
        std = [self.position_m, 0.0, self.velocity_m_s, self.gyro_bias_rad_s, self.accel_bias_m_s2]
        P = np.diag(np.repeat(std, 3) ** 2)
        P[3:6, 3:6] = R_imu_world @ np.diag([self.tilt_rad, self.tilt_rad, self.yaw_rad]) ** 2 @ R_imu_world.T
        if self.rest_s:
            H = np.zeros((3, 15))
            H[:, 3:6], H[:, 12:] = se3.skew(R_imu_world @ [0.0, 0.0, -GRAVITY_M_S2]), np.eye(3)
            K = np.linalg.solve(H @ P @ H.T + accel_density**2 / self.rest_s * np.eye(3), H @ P).T
            P = (np.eye(15) - K @ H) @ P
        return (P + P.T) / 2

    def drawn(self, P: Array, R_imu_world: Array, rng: np.random.Generator) -> Array:
        """Return first errors (15,), given their covariance."""
        error = np.linalg.cholesky(P) @ rng.standard_normal(15)
        if self.exact_tilt_rad:
            in_world = R_imu_world.T @ error[3:6]
            in_world[:2] *= self.exact_tilt_rad / np.linalg.norm(in_world[:2])
            error[3:6] = R_imu_world @ in_world
        return error


# A tilt of 8.6 degrees, which is the root mean square of two axes with this prior.
TILT_RAD = 0.15
LARGE = Prior(0.1, TILT_RAD / np.sqrt(2), 0.1, 0.5, accel_bias_m_s2=0.3, rest_s=0.0, exact_tilt_rad=TILT_RAD)


def true_values(sequence: Sequence, frame: int) -> list[Array]:
    """Return pose, body velocity, gyroscope and accelerometer bias at a frame, which are the blocks of the process."""
    truth = sequence.truth
    assert truth is not None and truth.motion is not None
    T = se3.inverse(truth.T_world_imu[frame])
    motion = truth.motion
    return [T, T[:3, :3] @ motion.velocity_m_s[frame], motion.gyro_bias_rad_s[frame], motion.accel_bias_m_s2[frame]]


def model_from_prior(sequence: Sequence, prior: Prior, rng: np.random.Generator, noise_free: bool = False) -> Model:
    """Return a model whose first estimate has errors drawn from a prior.

    Args:
        sequence: Recording with true motion.
        prior: Its spread is the covariance of the model.
        rng: Draws the errors.
        noise_free: Whether the process has no noise.
    """
    T, u, gyro_bias, accel_bias = true_values(sequence, 0)
    assert sequence.inertial is not None and sequence.inertial.noise is not None and sequence.noise is not None
    densities = sequence.inertial.noise
    P = prior.covariance(T[:3, :3], densities.accel)
    error = prior.drawn(P, T[:3, :3], rng)
    if noise_free:
        densities = dataclasses.replace(densities, gyro=0.0, accel=0.0, gyro_walk=0.0, accel_walk=0.0)
    blocks = (
        Velocity(first_m_s=u - error[6:9]),
        GyroBias(first_rad_s=gyro_bias - error[9:12]),
        AccelBias(first_m_s2=accel_bias - error[12:]),
    )
    rig = Rig(sequence.camera, sequence.T_cam_imu, sequence.noise)
    first = se3.exp(-error[:6]) @ T
    model = model_of(rig, sequence.noise, first, np.eye(6), None, blocks, make_process=inertial(densities))
    joint, columns = np.zeros((model.layout.body, model.layout.body)), model.process.columns
    joint[np.ix_(columns, columns)] = P
    return dataclasses.replace(model, joint_prior=joint)


def nees(ekf: JointEKF, truth: list[Array]) -> dict[str, float]:
    """Return the NEES of each part of the inertial state."""
    own, columns = [ekf.values[name] for name in ekf.model.process.own], ekf.model.process.columns
    P = ekf.gaussian.body_covariance[np.ix_(columns, columns)]
    vectors = [true - found for true, found in zip(truth[1:], own[1:], strict=True)]
    e = np.concatenate([se3.log(truth[0] @ se3.inverse(own[0])), *vectors])
    return {name: float(e[at] @ np.linalg.solve(P[at, at], e[at])) for name, at in PARTS.items()}


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Figures of a run: mean NEES, root mean square position error without alignment, distance, ms per frame."""

    nees: dict[str, float]
    ate_m: float
    way_m: float
    ms: float


def run_once(sequence: Sequence, model: Model, config: FilterConfig = FILTER) -> Outcome:
    """Filter a recording and compare with its truth."""
    ekf, found, errors, begin = JointEKF(model, config), [], [], perf_counter()
    with one_thread():
        for frame in run_filter(ekf, sequence):
            truth = true_values(sequence, frame.number)
            found.append(nees(ekf, truth))
            errors.append((se3.inverse(truth[0]) - ekf.T_world_imu)[:3, 3])
    ms = 1e3 * (perf_counter() - begin) / len(sequence)
    assert sequence.truth is not None
    way = np.linalg.norm(np.diff(sequence.truth.T_world_imu[:, :3, 3], axis=0), axis=1).sum()
    ate = np.sqrt(np.mean(np.sum(np.square(errors), axis=1)))
    return Outcome({name: float(np.mean([each[name] for each in found])) for name in PARTS}, ate, float(way), ms)


def starts(trajectory: Path | None, seconds: float, runs: int) -> Iterable[float]:
    """Return the begins of recordings, spread evenly over the stretches of a trajectory without a gap."""
    if trajectory is None:
        return [0.0] * runs
    stamps = np.loadtxt(trajectory)[:, 0]
    stamps = stamps - stamps[0]
    edges = np.flatnonzero(np.diff(stamps) > MAX_GAP_S)
    begins, ends = np.append(stamps[:1], stamps[edges + 1]), np.append(stamps[edges], stamps[-1])
    room = np.maximum(ends - begins - seconds - 1.0, 0.0)
    at = np.linspace(0.0, room.sum() - 1e-9, runs)
    part = np.searchsorted(np.cumsum(room), at, side="right")
    return begins[part] + at - (np.cumsum(room) - room)[part]


def outcomes(world: Room, prior: Prior, config: FilterConfig, runs: int) -> list[Outcome]:
    """Return one outcome per seed."""
    trajectory = Path(world.trajectory) if world.trajectory else None
    found = []
    for seed, start_s in enumerate(starts(trajectory, world.frames * world.frame_period_s, runs)):
        sequence = simulate_room(dataclasses.replace(world, seed=seed, start_s=float(start_s)))
        model = model_from_prior(sequence, prior, np.random.default_rng([seed, 1]))
        found.append(run_once(sequence, model, config))
    return found


EXPECTED = {part: at.stop - at.start for part, at in PARTS.items()}
HEADINGS = [f"{part} ({dof})" for part, dof in EXPECTED.items()]
HEADINGS += ["ATE [mm] (largest)", "way [m]", "ATE / way [%]", "ms a frame"]


def figures_of(found: list[Outcome]) -> dict[str, float]:
    """Return mean NEES and standard error of each part, and mean errors, over runs."""
    figures: dict[str, float] = {"runs": len(found)}
    for part in PARTS:
        values = np.array([outcome.nees[part] for outcome in found])
        figures[part] = float(values.mean())
        figures[f"{part} error"] = float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else np.nan
    ate, way, ms = (np.array([getattr(o, key) for o in found]) for key in ("ate_m", "way_m", "ms"))
    figures |= {"ate_m": float(ate.mean()), "ate_max_m": float(ate.max()), "way_m": float(way.mean())}
    return {**figures, "ms": float(np.median(ms))}


def is_expected(figures: dict[str, float], part: str) -> bool:
    """Return whether a mean NEES is within three standard errors of its expectation."""
    return abs(figures[part] - EXPECTED[part]) <= 3 * figures[f"{part} error"]


def row(name: str, figures: dict[str, float]) -> list[str]:
    """Return the figures of a world as cells."""
    cells = [
        f"{figures[part]:.2f} ± {figures[f'{part} error']:.2f}{'' if is_expected(figures, part) else ' !'}"
        for part in PARTS
    ]
    ate = f"{1e3 * figures['ate_m']:.0f} ({1e3 * figures['ate_max_m']:.0f})"
    share = f"{100 * figures['ate_m'] / figures['way_m']:.3f}"
    return [f"{name} ({figures['runs']:.0f})", *cells, ate, f"{figures['way_m']:.0f}", share, f"{figures['ms']:.1f}"]


@styled
def plot(table: dict[str, dict[str, float]]) -> Figure:
    """Draw the mean NEES of each part over its expectation, with bars of three standard errors."""
    figure = Figure(figsize=(7.2, 4.2))
    ax, places = figure.subplots(), np.arange(len(PARTS))
    for i, (name, figures) in enumerate(table.items()):
        ratio = np.array([figures[part] / EXPECTED[part] for part in PARTS])
        bars = 3 * np.array([figures[f"{part} error"] / EXPECTED[part] for part in PARTS])
        shift, look = 0.12 * (i - (len(table) - 1) / 2), {"color": SERIES[i % len(SERIES)]["color"], "linestyle": ""}
        ax.errorbar(places + shift, ratio, bars, marker="os^Dv<>P"[i % 8], markersize=4, capsize=2, label=name, **look)
    ax.axhline(1.0, **EXPECTED_LINE)
    ax.set_xticks(places, list(PARTS))
    ax.set(ylabel="mean NEES / expectation", title="Mean NEES over runs, bars: three standard errors")
    legend_of(figure, [ax], 2)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trajectory", action="append", default=[], metavar="FILE", help="TUM file of real poses")
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=25.0)
    parser.add_argument("--variant", action="append", choices=("invariant", "fej", "standard"))
    parser.add_argument("--engine", action="append", choices=("auto", "reference"), help="default: auto")
    parser.add_argument("--tilt", action="store_true", help="first errors of 8.6 deg of tilt")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write table.md, table.json and nees.png")
    options = parser.parse_args()
    headings = ["world, variant, filter (runs)", *HEADINGS]
    print(markdown_table(headings, []), flush=True)
    prior, table = LARGE if options.tilt else Prior(), {}
    for trajectory in ["", *options.trajectory]:
        world = Room(frames=round(10 * options.seconds), trajectory=trajectory)
        for variant in options.variant or ["invariant"]:
            for engine in options.engine or ["auto"]:
                config = dataclasses.replace(FILTER, variant=variant, engine=engine)
                kind = "reference" if engine == "reference" else "engine"
                name = f"{Path(trajectory).stem or 'made'}, {variant}, {kind}"
                table[name] = figures_of(outcomes(world, prior, config, options.runs))
                print(f"| {' | '.join(row(name, table[name]))} |", flush=True)
    if options.out is not None:
        call = f"`python experiments/inertial.py {' '.join(map(_shown, sys.argv[1:]))}`"
        text = document(
            f"{call}: mean NEES ± standard error.", markdown_table(headings, [row(*item) for item in table.items()])
        )
        contents = {options.out / "table.md": text, options.out / "table.json": json.dumps(table, indent=2) + "\n"}
        files.write_all({**contents, options.out / "nees.png": png(plot(table), packed=True)})


def _shown(argument: str) -> str:
    """Return an argument without the folders of a file of data."""
    return argument if argument.startswith("results/") else Path(argument).name or argument


if __name__ == "__main__":
    main()
