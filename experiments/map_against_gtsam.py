"""Compare the smoothed trajectory with GTSAM: the same problem for the posterior, GTSAM's batch solver, and iSAM2.

The posterior of a run minimises, over all poses x_k = T_world_imu(k) and all landmarks m_j,

    sum_k |log(T_imu_world(k) T_imu_world(k-1)^-1 E_k^-1)|^2_Q / 2  +  sum_kj rho(|z_kj - h(x_k, m_j)|_V),

where E_k is the measured motion (1), Q its covariance (2), h the stereo camera (3) and rho the robust kernel. The
observations that the filter accepted become the same problem in GTSAM: `BetweenFactorPose3` over exp(tau u), with
rotation first as in GTSAM, `GenericStereoFactor3D`, and a prior on the first pose. GTSAM's motion residual,
log(E x_(k-1)^-1 x_k), is minus the one above, so Q is unchanged.

Both batch solvers start from the filter's estimate and stop at the same relative decrease of the cost. GTSAM then
continues until nothing decreases, which gives the reference cost. Every solution is put into both cost functions. They
differ if a landmark is behind a camera that saw it: ours is infinite then, GTSAM's a constant. iSAM2 gets one frame at
a time and never sees the filter: a new pose starts from the measured motion, a new landmark from triangulation. If a
landmark behind a camera leaves its system singular, it runs again with a weak prior on every landmark.

Seconds are wall-clock within the solvers: building GTSAM's factors from Python is not counted, nor are our marginals.

    python experiments/map_against_gtsam.py [--data DIR] [--out DIR] [SET ...]
"""

from __future__ import annotations

import dataclasses
import json
import sys
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np
from common import (
    DENSE,
    STARRY_NIGHT,
    UTIAS,
    argument_parser,
    has_recordings,
    open_recording,
    trajectory_errors,
    with_aligned,
    write,
)
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter
from threadpoolctl import threadpool_limits

import ekfslam
from ekfslam.arrays import Array
from ekfslam.config import PosteriorConfig
from ekfslam.data.sequence import Sequence, Truth
from ekfslam.evaluation.tables import MISSING, document, markdown_table, number
from ekfslam.figures.style import GREY, ORANGE, REFERENCE, marker_of, styled
from ekfslam.filters.log import Log
from ekfslam.filters.result import Result
from ekfslam.geometry import camera, motion, se3
from ekfslam.smoother.optimise import evaluate
from ekfslam.smoother.posterior import posterior
from ekfslam.smoother.problem import BatchProblem

try:
    import gtsam
    from gtsam.symbol_shorthand import L, X
except ModuleNotFoundError:
    sys.exit("GTSAM is missing: pip install 'ekfslam[bench]'")

# Noise was added to the velocities of the later edition; its tracks are rougher too.
NOISY = {"noise": {"sigma_v_m_s": 0.5, "sigma_w_rad_s": 0.05, "sigma_px": 2.0}}
# Recordings and their settings.
SETS: dict[str, dict[str, dict[str, float]]] = {
    "ece276a/0027.npz": {},
    "ece276a/0020.npz": {},
    "ece276a/0042.npz": {},
    DENSE: NOISY,
    "ece276a/0022_dense_noisy.npz": NOISY,
    **{file: {} for file in (*UTIAS, STARRY_NIGHT)},
}

# GTSAM's own default is 0.1 (metres and radians alike) at every tenth update; here it may relinearise at every one.
RELINEARISE = 0.1
RELINEARISE_OFTEN = 0.01
RELINEARISE_SKIP = 1
LANDMARK_STD_M = 1000.0  # of the weak prior, about the first guess

FIRST_POSE_STD = 1e-4  # metres and radians
ROTATION_FIRST = [3, 4, 5, 0, 1, 2]
MAX_ITERATIONS = 1000


# --- The problem in GTSAM --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Factors:
    """Problem of the posterior as factors of GTSAM: first pose, T-1 motions, K observations in the order of the log."""

    first: Any
    motion: list[Any]
    observation: list[Any]

    def graph(self) -> Any:
        """Return the graph of all factors."""
        graph = gtsam.NonlinearFactorGraph()
        for factor in (self.first, *self.motion, *self.observation):
            graph.push_back(factor)
        return graph


def factors_of(result: Result, config: PosteriorConfig) -> Factors:
    """Make GTSAM's factors from a run of the joint filter with an exact first pose."""
    log, rig = log_of(result), result.camera
    assert not log.initial_covariance.any() and (log.variance == log.variance[0]).all()

    twist = np.concatenate([np.zeros((1, 6)), log.inputs])
    measured = se3.inverse(motion.increment(twist, log.tau_s))
    Q = motion.process_noise(twist, log.tau_s, result.noise.velocity_std)
    Q = Q[:, ROTATION_FIRST][:, :, ROTATION_FIRST]
    # Not "smart", which would drop small covariances and with them 1e-5 of the cost.
    between = [
        gtsam.BetweenFactorPose3(
            X(k - 1), X(k), gtsam.Pose3(measured[k]), gtsam.noiseModel.Gaussian.Covariance(Q[k], False)
        )
        for k in range(1, log.frames)
    ]

    calibration = gtsam.Cal3_S2Stereo(rig.fu_px, rig.fv_px, 0.0, rig.cu_px, rig.cv_px, rig.baseline_m)
    T_imu_cam = gtsam.Pose3(se3.inverse(result.T_cam_imu))
    # Rows are (uL, v, uR), GTSAM has (uL, uR, v).
    pixels: Any = gtsam.noiseModel.Diagonal.Variances(log.variance[0, [0, 2, 1]])
    if config.kernel != "none":
        kernel: dict[str, Any] = {
            "huber": gtsam.noiseModel.mEstimator.Huber,
            "cauchy": gtsam.noiseModel.mEstimator.Cauchy,
        }
        pixels = gtsam.noiseModel.Robust.Create(kernel[config.kernel].Create(config.kernel_width), pixels)
    # A landmark that a step puts behind its camera must not end the optimisation: no exception, a large constant error.
    stereo = [
        gtsam.GenericStereoFactor3D(
            gtsam.StereoPoint2(u_left, u_right, v), pixels, X(k), L(j), calibration, False, False, T_imu_cam
        )
        for (u_left, v, u_right), k, j in zip(log.rows, log.frame.tolist(), log.landmark.tolist(), strict=True)
    ]
    # All else depends on relative poses only, so that this residual is 0 at the solution however loose the prior is. A
    # hard constraint has the same solution but costs iSAM2 a dense QR at each update: up to a hundred times the time.
    first = gtsam.PriorFactorPose3(
        X(0), gtsam.Pose3(se3.inverse(log.T_predicted[0])), gtsam.noiseModel.Isotropic.Sigma(6, FIRST_POSE_STD)
    )
    return Factors(first, between, stereo)


def to_gtsam(T_world_imu: Array, positions_m: Array) -> Any:
    """Return poses (T, 4, 4) and landmarks (M, 3) as GTSAM's values."""
    values = gtsam.Values()
    for k, T in enumerate(T_world_imu):
        values.insert(X(k), gtsam.Pose3(T))
    for j, m in enumerate(positions_m):
        values.insert(L(j), m)
    return values


def from_gtsam(values: Any, frames: int, landmarks: int) -> tuple[Array, Array]:
    """Return poses (T, 4, 4) and landmarks (M, 3)."""
    T_world_imu = np.array([values.atPose3(X(k)).matrix() for k in range(frames)])
    return T_world_imu, np.array([values.atPoint3(L(j)) for j in range(landmarks)])


def batch(graph: Any, start: Any, tolerance: float) -> tuple[Any, int, float]:
    """Run GTSAM's Levenberg-Marquardt with its default damping: values, iterations and seconds."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(tolerance)
    parameters.setAbsoluteErrorTol(0.0)
    parameters.setMaxIterations(MAX_ITERATIONS)
    begin = perf_counter()
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, start, parameters)
    values = optimiser.optimize()
    return values, optimiser.iterations(), perf_counter() - begin


def new_isam2(threshold: float) -> Any:
    """Return an iSAM2 that relinearises beyond a threshold at every update."""
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(threshold)
    parameters.relinearizeSkip = RELINEARISE_SKIP
    return gtsam.ISAM2(parameters)


class Frames:
    """New factors and first guesses of each frame, for solvers that get one frame at a time.

    Args:
        result: A run of the joint filter.
        factors: Its `factors_of`.
        landmark_std_m: Standard deviation of a prior on every landmark about its first guess; None for no prior.
    """

    def __init__(self, result: Result, factors: Factors, landmark_std_m: float | None = None) -> None:
        self.log, self._camera, self._factors, self._std_m = log_of(result), result.camera, factors, landmark_std_m
        inputs = np.concatenate([np.zeros((1, 6)), self.log.inputs])
        self._measured = se3.inverse(motion.increment(inputs, self.log.tau_s))
        self._T_imu_cam = se3.inverse(result.T_cam_imu)
        self._T_world_imu = se3.inverse(self.log.T_predicted[0])
        self._begin = np.searchsorted(self.log.frame, np.arange(self.log.frames + 1))
        self._is_known = np.zeros(self.log.landmarks, dtype=bool)

    def seen(self, k: int) -> Array:
        """Return the indices of the observations of a frame."""
        return np.arange(self._begin[k], self._begin[k + 1])

    def graph(self, k: int, seen: Array) -> tuple[Any, Any, Array]:
        """Return the factors of some observations of a frame, the first guesses, and the landmarks seen."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if k == 0:
            graph.push_back(self._factors.first)
        else:
            self._T_world_imu = self._T_world_imu @ self._measured[k]
            graph.push_back(self._factors.motion[k - 1])
        values.insert(X(k), gtsam.Pose3(self._T_world_imu))
        landmark = self.log.landmark[seen]
        new = seen[~self._is_known[landmark]]
        in_camera = camera.triangulate(self._camera, self.log.rows[new])
        points = se3.apply(self._T_world_imu @ self._T_imu_cam, in_camera)
        for j, point in zip(self.log.landmark[new].tolist(), points, strict=True):
            values.insert(L(j), point)
            if self._std_m is not None:
                weak = gtsam.noiseModel.Isotropic.Sigma(3, self._std_m)
                graph.push_back(gtsam.PriorFactorPoint3(L(j), point, weak))
        self._is_known[landmark] = True
        for i in seen.tolist():
            graph.push_back(self._factors.observation[i])
        return graph, values, landmark

    def continued_from(self, pose: Any) -> Array:
        """Take the solver's pose of the frame, from which the next one starts, and return it (4, 4)."""
        self._T_world_imu = np.asarray(pose.matrix())
        return self._T_world_imu


def incremental(
    result: Result,
    factors: Factors,
    threshold: float,
    landmark_std_m: float | None = None,
) -> tuple[Any, Array]:
    """Run iSAM2 frame by frame: its values after the last frame, and the seconds (T,) of each update.

    Args:
        result: A run of the joint filter.
        factors: Its `factors_of`.
        threshold: Change of a variable (metres and radians alike) beyond which it is linearised again.
        landmark_std_m: Standard deviation of a prior on every landmark about its first guess; none by default.

    Raises:
        RuntimeError: iSAM2 met a system that it could not solve.
    """
    isam, frames = new_isam2(threshold), Frames(result, factors, landmark_std_m)
    seconds = np.empty(frames.log.frames)
    for k in range(frames.log.frames):
        graph, values, _ = frames.graph(k, frames.seen(k))
        begin = perf_counter()
        isam.update(graph, values)
        frames.continued_from(isam.calculateEstimatePose3(X(k)))
        seconds[k] = perf_counter() - begin
    return isam.calculateEstimate(), seconds


# --- Our side --------------------------------------------------------------------------------------------------------


def log_of(result: Result) -> Log:
    assert result.log is not None
    return result.log


def start_of(result: Result, rows: BatchProblem) -> tuple[Array, Array]:
    """Return the start of the posterior: poses and map of the filter; landmarks behind a camera are triangulated."""
    log = log_of(result)
    sight = rows.observations.at(rows.filtered_state(result.landmarks.position_m))
    unseen = ~sight.in_view(result.config["filter"]["min_depth_m"])
    hidden = np.isin(np.arange(log.landmarks), log.landmark[unseen])
    return se3.inverse(log.T_updated), np.where(hidden[:, None], log.first_position_m, result.landmarks.position_m)


def cost_of(
    rows: BatchProblem, config: PosteriorConfig, T_world_imu: Array, positions_m: Array
) -> tuple[float | None, int]:
    """Return the cost of the posterior, None if infinite, and the number of observations from behind a camera."""
    # White noise and a certain first pose: poses and landmarks are all there is.
    start = rows.filtered_state(positions_m)
    state = replace(start, T_imu_world=se3.inverse(T_world_imu), zeta=0 * start.zeta)
    found = evaluate(rows, state, config, 0.0)
    return found.cost if found else None, int((~rows.observations.at(state).in_view(0.0)).sum())


def orthonormal(T: Array) -> Array:
    """Return the rigid transform next to one (..., 4, 4) whose rotation was printed with a few digits."""
    U, _, Vt = np.linalg.svd(T[..., :3, :3])
    return se3.transform(U @ Vt, T[..., :3, 3])


def open_set(data: Path, file: str) -> Sequence:
    """Return a recording whose rotations are exact to rounding.

    As printed they are off by 1e-7. Inverses by transposition and by GTSAM's product then differ by that, at positions
    some hundred metres from the origin enough to change the cost by 1e-4.
    """
    sequence = open_recording(data, file)
    known = sequence.truth
    if known is not None:
        known = Truth(known.frame, orthonormal(known.T_world_imu), known.landmark, known.position_m)
    return dataclasses.replace(sequence, T_cam_imu=orthonormal(sequence.T_cam_imu), truth=known)


# --- One set ---------------------------------------------------------------------------------------------------------


def solve_all(sequence: Sequence, overrides: dict[str, dict[str, float]]) -> dict[str, Any]:
    """Measure everything on one recording, for ``table.json``."""
    # White noise, as GTSAM's factors have it; what is not stated is that of a clean recording.
    settings = ekfslam.Config().with_overrides({"noise": {"model": "white"}}).with_overrides(overrides)
    config = settings.posterior
    dead_reckoning = ekfslam.run(sequence, "dead-reckoning", settings)
    result = ekfslam.run(sequence, "full", settings)
    log = log_of(result)
    begin = perf_counter()
    found = posterior(result)
    seconds = perf_counter() - begin
    rows = found.problem

    factors = factors_of(result, config)
    graph, start = factors.graph(), to_gtsam(*start_of(result, rows))

    def entry(T_world_imu: Array, positions_m: Array | None = None, **more: float | int) -> dict[str, Any]:
        """Return errors of one estimator, and its cost in both functions."""
        values: dict[str, Any] = {"ate_m": None, "ate_aligned_m": None, **more}
        if sequence.truth is not None and len(sequence.truth.frame):
            values |= trajectory_errors(sequence, T_world_imu)
        if positions_m is not None:
            values["cost"], values["behind"] = cost_of(rows, config, T_world_imu, positions_m)
            values["gtsam_cost"] = graph.error(to_gtsam(T_world_imu, positions_m))
        return values

    estimators = {
        "dead reckoning": entry(dead_reckoning.T_world_imu),
        "filter": entry(result.T_world_imu, seconds=float(result.ms_per_frame.sum()) / 1e3),
        "start": entry(*start_of(result, rows)),
        "MAP": entry(found.T_world_imu, found.position_m, iterations=len(found.costs) - 1, seconds=seconds),
    }
    values = start
    for name, tolerance in (("GTSAM batch", config.tolerance), ("GTSAM converged", 1e-14)):
        values, iterations, seconds = batch(graph, values, tolerance)
        estimators[name] = entry(*from_gtsam(values, log.frames, log.landmarks), iterations=iterations, seconds=seconds)
    for name, threshold in (("iSAM2", RELINEARISE), ("iSAM2, 0.01", RELINEARISE_OFTEN)):
        values, figures = incremental_or_tied(f"{sequence.name}: {name}", result, factors, threshold)
        estimators[name] = {**entry(*from_gtsam(values, log.frames, log.landmarks)), **figures}
    sizes = {"frames": log.frames, "landmarks": log.landmarks, "observations": log.observations}
    return {**sizes, "estimators": estimators}


def incremental_or_tied(
    label: str, result: Result, factors: Factors, threshold: float
) -> tuple[Any, dict[str, float | int]]:
    """Run `incremental`, with weak priors on landmarks if it fails without: its values and times."""
    tied = 0
    try:
        values, each = incremental(result, factors, threshold)
    except RuntimeError as error:
        print(f"{label} gave up, weak priors on landmarks added: {error}", file=sys.stderr)
        values, each = incremental(result, factors, threshold, LANDMARK_STD_M)
        tied = 1
    times = {"ms_per_frame_median": 1e3 * float(np.median(each)), "ms_per_frame_max": 1e3 * float(each.max())}
    return values, {"seconds": float(each.sum()), **times, "weak_priors": tied}


# --- Tables and figures ----------------------------------------------------------------------------------------------

COMPARED = ("dead reckoning", "filter", "MAP", "GTSAM batch", "iSAM2", "iSAM2, 0.01")
# Open marks may lie around others.
STYLES: dict[str, dict[str, Any]] = {
    "filter": {**marker_of("full"), "markerfacecolor": "none"},
    "GTSAM batch": {"color": ORANGE, "marker": "s", "markerfacecolor": "none", "markersize": 8, "linestyle": ""},
    "iSAM2": {"color": GREY, "marker": "^", "linestyle": ""},
    "MAP": {**marker_of("smoothed")},
}


def ratio(row: dict[str, Any], above: tuple[str, str], below: tuple[str, str]) -> float | None:
    """Return the quotient of two figures of a set, each (estimator, key); None if one is missing."""
    a, b = (row["estimators"][name][key] for name, key in (above, below))
    return None if a is None or b is None else a / b


def medians(table: dict[str, dict[str, Any]], above: tuple[str, str], below: tuple[str, str]) -> tuple[float, float]:
    """Return median and largest of a `ratio` over the sets."""
    values = [value for row in table.values() if (value := ratio(row, above, below)) is not None]
    return median(values), max(values)


def markdown(table: dict[str, dict[str, Any]], config: PosteriorConfig) -> str:
    """Return the report of the experiment."""
    kernel = config.kernel if config.kernel == "none" else f"{config.kernel}, width {config.kernel_width:g}"
    middle, largest = medians(table, ("MAP", "gtsam_cost"), ("GTSAM converged", "gtsam_cost"))
    return document(
        "# Maximum a posteriori, next to GTSAM",
        f"GTSAM {version('gtsam')}; kernel {kernel}; iSAM2 relinearises beyond {RELINEARISE:g} (its "
        f"default), in the last column beyond {RELINEARISE_OFTEN:g}, at every update. "
        "GTSAM and the posterior use the same observations, noise and kernel. Where iSAM2 has a star its system became "
        f"singular; the figures are with a prior of {LANDMARK_STD_M:g} m on every landmark.",
        "## Absolute trajectory error in metres (in brackets: aligned)",
        markdown_table(
            ["set", "frames", "landmarks", "observations", *COMPARED, "MAP / iSAM2 (aligned)"],
            ([name, *error_cells(row)] for name, row in table.items()),
        ),
        *(error_summary(table, key, what) for key, what in (("ate_m", "ATE"), ("ate_aligned_m", "aligned ATE"))),
        "## Cost at the solution, and time",
        "Costs are of GTSAM's function; *both* is how far the posterior's is from it at the posterior's solution. "
        "*Excess* is over GTSAM's batch driven on until nothing decreases any more. *Behind* counts the observations "
        "whose landmark is behind the camera at the solution: GTSAM then sees a constant, the posterior never gets "
        "there. The batch solvers stop where an iteration lowers the cost by less than "
        f"{config.tolerance:g} of it.",
        markdown_table(
            [
                *("set", "start", "MAP", "excess of MAP", "of GTSAM batch", "of iSAM2", "both", "behind GTSAM, iSAM2"),
                *("iterations MAP, GTSAM", "s filter", "MAP", "GTSAM batch", "iSAM2"),
            ],
            ([name, *cost_cells(row)] for name, row in table.items()),
        ),
        f"Cost, MAP / GTSAM: 1{middle - 1:+.1e} in the median over the sets, 1{largest - 1:+.1e} at the most.",
    )


def error_cells(row: dict[str, Any]) -> list[str]:
    """Return the cells of sizes and errors of one set."""
    found = row["estimators"]
    stars = {name: " *" if found[name].get("weak_priors") else "" for name in COMPARED}
    quotients = (number(ratio(row, ("MAP", key), ("iSAM2", key)), ".3f") for key in ("ate_m", "ate_aligned_m"))
    return [
        *(str(row[key]) for key in ("frames", "landmarks", "observations")),
        *(with_aligned(found[name], ".3f") + stars[name] for name in COMPARED),
        "{} ({})".format(*quotients),
    ]


def error_summary(table: dict[str, dict[str, Any]], key: str, what: str) -> str:
    """Return the cells that compare one kind of error with iSAM2's, over all sets."""
    middle, largest = medians(table, ("MAP", key), ("iSAM2", key))
    text = f"{what}, MAP / iSAM2: {middle:.3f} in the median over the sets, {largest:.3f} at the most;\n"
    middle, largest = medians(table, ("MAP", key), ("iSAM2, 0.01", key))
    return f"{text}MAP / iSAM2 that relinearises beyond {RELINEARISE_OFTEN:g}: {middle:.4f}, {largest:.3f}."


def cost_cells(row: dict[str, Any]) -> list[str]:
    """Return the cells of costs, iterations and seconds of one set."""
    e = row["estimators"]

    def excess(estimator: str) -> str:
        value = ratio(row, (estimator, "gtsam_cost"), ("GTSAM converged", "gtsam_cost"))
        return MISSING if value is None else f"{100 * (value - 1):.4f} %"

    return [
        f"{e['start']['gtsam_cost']:.1f}",
        f"{e['MAP']['gtsam_cost']:.2f}",
        *map(excess, ("MAP", "GTSAM batch", "iSAM2")),
        f"{e['MAP']['cost'] / e['MAP']['gtsam_cost'] - 1:.0e}",
        f"{e['GTSAM converged']['behind']}, {e['iSAM2']['behind']}",
        f"{e['MAP']['iterations']}, {e['GTSAM batch']['iterations']}",
        *(f"{e[name]['seconds']:.2f}" for name in ("filter", "MAP", "GTSAM batch", "iSAM2")),
    ]


@styled
def plot(table: dict[str, dict[str, Any]]) -> Figure:
    """Draw ATE over iSAM2's for every set with truth, and seconds."""
    figure = Figure(figsize=(9.0, 0.6 + 0.33 * len(table)))
    error_ax, time_ax = figure.subplots(1, 2, sharey=True)
    place = np.arange(len(table))

    def dots(ax: Axes, name: str, values: list[float | None]) -> None:
        known = [(x, y) for x, y in zip(values, place, strict=True) if x is not None]
        ax.plot(*zip(*known, strict=True), label=name, **STYLES[name])

    for name in ("filter", "GTSAM batch", "MAP"):
        dots(error_ax, name, [ratio(row, (name, "ate_m"), ("iSAM2", "ate_m")) for row in table.values()])
    for name in ("filter", "GTSAM batch", "iSAM2", "MAP"):
        dots(time_ax, name, [row["estimators"][name]["seconds"] for row in table.values()])
    error_ax.axvline(1.0, **REFERENCE)
    error_ax.axvline(1.15, **{**REFERENCE, "linestyle": "--"})
    error_ax.set_xlabel("ATE over that of iSAM2 [-]; dashed: 1.15")
    error_ax.set_yticks(place, list(table))
    error_ax.invert_yaxis()
    time_ax.set_xlabel("time for the whole set [s]")
    time_ax.set_xscale("log")
    time_ax.xaxis.set_major_formatter(FormatStrFormatter("%g"))
    handles, labels = time_ax.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4)
    figure.suptitle("The same problem solved by the posterior (MAP), by GTSAM's batch, and by iSAM2")
    return figure


def main() -> int:
    parser = argument_parser(__doc__, "map", data=True)
    parser.add_argument("sets", nargs="*", metavar="SET", help="names of sets, e.g. 0027; all by default")
    parsed = parser.parse_args()
    names = {Path(file).stem.replace("_drive", "").replace("_sync_KLT", ""): file for file in SETS}
    wanted = {name: file for name, file in names.items() if not parsed.sets or name in parsed.sets}
    if not wanted:
        parser.error(f"no such set: {' '.join(parsed.sets)}")
    if not has_recordings(parsed.data, *wanted.values()):
        return 0

    table: dict[str, dict[str, Any]] = {}
    # One thread for the filter's and the posterior's BLAS, as the library has it by itself.
    with threadpool_limits(1, user_api="blas"):
        for name, file in wanted.items():
            table[name] = solve_all(open_set(parsed.data, file), SETS[file])
            print(name, json.dumps(table[name]["estimators"]))

    config = PosteriorConfig()
    text = markdown(table, config)
    summary = {
        "gtsam": version("gtsam"),
        "posterior": dataclasses.asdict(config),
        "relinearise": {"threshold": RELINEARISE, "skip": RELINEARISE_SKIP},
        "sets": table,
    }
    write(parsed.out, "table", summary, text, {"against_gtsam": plot(table)})
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
