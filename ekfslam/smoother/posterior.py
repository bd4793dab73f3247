"""Joint posterior over the whole trajectory and the whole map, from the log of the filter.

*As filtered*, rows stay where the filter linearised them: for the standard and first-estimates variants in xyz the
solution is, to rounding, the state of a dense EKF that never retired a landmark, with everything smoothed. The
*maximum a posteriori* linearises all rows again at their common solution. It is consistent by construction: every row
sees the same unobservable directions. (For the invariant variant, frozen rows are much too confident on long drives.)
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from time import perf_counter

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from ekfslam.arrays import Array, IntArray
from ekfslam.config import Config, FilterConfig, PosteriorConfig
from ekfslam.data.inputs import InertialNoise
from ekfslam.errors import PosteriorError
from ekfslam.filters.inertial_states import InertialStates
from ekfslam.filters.log import Log
from ekfslam.filters.loop import one_thread, solvable
from ekfslam.filters.result import Innovation, PosePairs, Rejections, Result
from ekfslam.geometry import se3
from ekfslam.models.build import blocks_and_process, model_of, sensor_of
from ekfslam.models.model import Model
from ekfslam.models.process.inertial import Inertial
from ekfslam.progress import progress
from ekfslam.shown import Card, Shown, count, figure
from ekfslam.smoother.optimise import MOST_ITERATIONS, maximise
from ekfslam.smoother.problem import BatchProblem, State
from ekfslam.smoother.sparse.information import JointInformation
from ekfslam.stored import empty

DENSE_LIMIT = 20_000  # columns of a dense covariance: 3.2 GB


@dataclass(frozen=True, repr=False)
class Posterior(Shown):
    """A Gaussian over all poses and all landmarks.

    Landmarks go by their row in ``id`` (`rows_of`), frames by their number, negative ones from the end. Covariances are
    of the stored errors (see `ekfslam`).

    Args:
        linearisation: ``map`` or ``filtered``.
        id: (M,) landmark ids; an id occurs again where a track was split.
        T_world_imu: (T, 4, 4) smoothed poses.
        position_m: (M, 3) the map.
        weight: (K,) robust weight of each observation of the log.
        costs: Cost (half the sum of squares, under the kernel) before each iteration and at the end.
        information: The factorised system.
        values: Estimates of the further state blocks by name: of each frame (T, ...), or of the drive.
        problem, state: Factors of the log, and where they are linearised.
    """

    linearisation: str
    id: IntArray
    T_world_imu: Array
    position_m: Array
    weight: Array
    costs: tuple[float, ...]
    information: JointInformation
    values: Mapping[str, Array]
    problem: BatchProblem
    state: State

    def card(self) -> Card:
        """Return the facts that ``repr`` and a notebook show, without computing anything."""
        frames, landmarks = len(self.T_world_imu), len(self.id)
        facts = {
            "of": f"{count(frames, 'pose')}, {count(landmarks, 'landmark')}, {count(len(self.weight), 'observation')}",
            "other blocks": ", ".join(self.values) or "none",
            "cost": f"{figure(self.costs[0])} to {figure(self.cost)} in {count(len(self.costs) - 1, 'iteration')}",
        }
        further = (".pose_covariance", ".landmark_covariance", ".joint_covariance(frames=[-1], landmarks=[0, 1])")
        title = "at the maximum a posteriori" if self.linearisation == "map" else "linearised as filtered"
        return Card(title, facts, further)

    @property
    def cost(self) -> float:
        """Cost at the end."""
        return self.costs[-1]

    @cached_property
    def pose_covariance(self) -> Array:
        """(T, 6, 6) marginals of all poses."""
        return self.information.frame_covariances()[:, :6, :6]

    @cached_property
    def landmark_covariance(self) -> Array:
        """(M, 3, 3) marginals of all landmarks."""
        return self.information.landmark_covariances()

    def block_covariance(self, name: str) -> Array:
        """Return the marginal covariance of a further state block: of each frame (T, n, n), or of the drive (n, n)."""
        u, of = self.problem.unknowns, self.information
        for blocks, find, first in (
            (u.aux, of.aux_covariances, 0),
            (u.shared, of.frame_covariances, 6),
            (u.of_drive, of.drive_covariance, 0),
        ):
            owners = [block.name for block in blocks for _ in range(block.size)]
            if name in owners:
                at = first + np.flatnonzero(np.array(owners) == name)
                return find()[..., at[:, None], at]
        raise PosteriorError(f"there is no state block {name!r}; there are {', '.join(self.values) or 'none'}")

    @cached_property
    def inertial(self) -> InertialStates | None:
        """Smoothed velocities and biases of an inertial unit, with their joint marginals; None without one."""
        process, u = self.problem.model.process, self.problem.unknowns
        if not isinstance(process, Inertial):
            return None
        own = u.places(process.columns)
        covariance = self.information.state_covariances[:, own][:, :, own]
        velocity, gyro_bias, accel_bias = (self.values[name] for name in process.own[1:])
        return InertialStates(velocity, gyro_bias, accel_bias, covariance)

    def rows_of(self, ids: ArrayLike) -> IntArray:
        """Return the rows (n,) of landmarks given by their ids; a track that was split has that of its last piece."""
        row = {landmark: i for i, landmark in enumerate(self.id.tolist())}
        wanted = np.atleast_1d(np.asarray(ids)).tolist()
        unknown = [landmark for landmark in wanted if landmark not in row]
        if unknown:
            raise PosteriorError(f"there is no landmark of id {unknown[0]}; `Posterior.id` has all")
        return np.array([row[landmark] for landmark in wanted], dtype=np.int64)

    def joint_covariance(self, frames: ArrayLike = (), landmarks: ArrayLike = ()) -> Array:
        """Return the covariance (6a+3b, 6a+3b) of a poses and b landmarks, given by frame and by row, in that order."""
        frame, width = _checked("frame", frames, len(self.T_world_imu)), self.problem.unknowns.width
        landmark = _checked("landmark row", landmarks, len(self.id))
        P = self.information.covariance(frames=frame, landmarks=landmark)
        # Of each frame its pose alone.
        of_poses = (width * np.arange(len(frame))[:, None] + np.arange(6)).ravel()
        kept = np.concatenate([of_poses, np.arange(width * len(frame), len(P))])
        return P[np.ix_(kept, kept)]

    def pairs(self, first: IntArray, second: IntArray) -> PosePairs:
        """Return the cross-covariances of pairs of smoothed poses, given by the frames (n,) of each."""
        cross = np.empty((len(first), 6, 6))
        for j in np.unique(first):
            own = np.flatnonzero(first == j)
            P = self.joint_covariance([j, *second[own]])
            cross[own] = P[:6, 6:].reshape(6, len(own), 6).swapaxes(0, 1)
        return PosePairs(first, second, cross)

    def dense_covariance(self, frames: ArrayLike = (-1,)) -> Array:
        """Return `joint_covariance` of some poses and all landmarks, refused if wider than 20 000 columns."""
        width = 6 * np.size(frames) + 3 * len(self.id)
        if width > DENSE_LIMIT:
            raise PosteriorError(
                f"a dense covariance of {width} columns is too large (limit {DENSE_LIMIT}); "
                "joint_covariance gives any block of it"
            )
        return self.joint_covariance(frames, np.arange(len(self.id)))

    def information_matrix(self) -> tuple[sp.csc_array, dict[str, Array]]:
        """Return the sparse joint information matrix (n, n): the inverse of the joint covariance of all unknowns.

        Columns are those of poses, further blocks of the frames, blocks of the drive, and landmarks; for each (n,) a
        second result has ``kind`` (``pose``, ``landmark`` or the name of a state block), ``frame`` (-1: none), ``id``
        of the landmark (-1: none), ``axis`` within its block. Components of the first frame that are known for certain
        have no column; a `PosteriorError` is raised if such a direction is no axis of ``xi``.
        """
        problem, frames = self.problem, len(self.T_world_imu)
        is_map = self.linearisation == "map"
        system = problem.relinearised(self.state).weighted(self.weight) if is_map else problem.as_filtered()
        matrix, kept = system.information_matrix()
        seen = [("pose", 6), *((block.name, block.size) for block in problem.unknowns.shared)]
        others = [(block.name, block.size) for block in problem.unknowns.aux]
        rows = [(name, k, -1, size) for of_frame in (seen, others) for k in range(frames) for name, size in of_frame]
        rows += [(block.name, -1, -1, block.size) for block in problem.unknowns.of_drive]
        rows += [("landmark", -1, landmark, 3) for landmark in self.id.tolist()]
        kind, frame, landmark, size = (np.array(column) for column in zip(*rows, strict=True))
        axis = np.concatenate([np.arange(n) for n in size])
        named = {"kind": kind, "frame": frame, "id": landmark}
        return matrix, {**{name: np.repeat(value, size)[kept] for name, value in named.items()}, "axis": axis[kept]}

    @property
    def log_determinant(self) -> float:
        """Log of the determinant of the covariance of everything but directions of the first pose known for certain."""
        return self.information.log_determinant

    def sample(self, rng: np.random.Generator, size: int = 1) -> tuple[Array, Array]:
        """Return independent draws: poses ``T_world_imu`` (size, T, 4, 4) and landmarks (size, M, 3)."""
        eps, d = self.information.sample(rng, size)
        return (
            se3.inverse(se3.exp((eps - self.information.eps)[..., :6]) @ se3.inverse(self.T_world_imu)),
            self.position_m + d - self.information.d,
        )


def posterior(result: Result, config: PosteriorConfig | None = None) -> Posterior:
    """Return the joint posterior of a run of the joint filter, from its `Result` (read from an archive or not).

    Args:
        result: A result of mode ``full``.
        config: Linearisation and kernel; by default those of the result.

    Raises:
        PosteriorError: The result has no log.
        IllPosedError: Something is undetermined; lists landmark ids or frames.
    """
    if result.log is None:
        raise PosteriorError(f"{result.sequence_name}: a result of mode {result.mode!r} has no log; run mode 'full'")
    stored = _config_of(result)
    model = model_of_result(result)
    return posterior_of_log(
        in_layout(result.log, model),
        model,
        result.landmarks.position_m,
        config or stored.posterior,
        stored.filter.min_depth_m,
        name=result.sequence_name,
    )


def is_inertial(result: Result) -> bool:
    """Return whether inertial samples moved the poses of a run."""
    return "inertial_gyro" in result.attributes


def model_of_result(result: Result) -> Model:
    """Return the model of a full run; raise `PosteriorError` if it had a block or noise that no longer exists."""
    assert result.log is not None
    stored, log = _config_of(result), result.log
    retired = [f"state block {name}" for name in sorted({*result.config.get("blocks", {})} - {*stored.blocks})]
    if "retired_noise" in result.attributes:
        retired.append(f"noise {result.attributes['retired_noise']}")
    if retired:
        raise PosteriorError(
            f"{result.sequence_name}: this result had the {' and '.join(retired)}, which no longer exists: run the "
            "recording again to smooth it"
        )
    start = log.T_predicted[0], log.initial_covariance[:6, :6]
    sensor = sensor_of(result.camera, result.T_cam_imu, result.noise)
    densities = None
    if is_inertial(result):
        names = (f"inertial_{field.name}" for field in dataclasses.fields(InertialNoise))
        densities = InertialNoise(*(float(result.attributes[name]) for name in names))
    blocks, process = blocks_and_process(stored.blocks, densities, stored.inertial.gravity_m_s2)
    coordinates = stored.filter.landmark_coordinates
    model = model_of(sensor, result.noise, *start, stored.calibration, blocks, coordinates, make_process=process)
    if (body := len(_columns_of(log, model))) == log.departed.shape[1] and len(log.initial_covariance) in (6, body):
        return model
    if not log.departed.shape[1] == len(log.initial_covariance) == 6:
        raise PosteriorError(
            f"{result.sequence_name}: the log has {log.departed.shape[1]} coordinates of state blocks, expected "
            f"{body} by its configuration"
        )
    # Archives before format version 4 know of poses alone: velocities are white there, and so are pixels.
    noise = dataclasses.replace(
        result.noise, twist_walk_std=None, tilt_rad=0.0, track_first_px=None, track_walk_px=None
    )
    return model_of(dataclasses.replace(sensor, noise=noise), noise, *start, coordinates="xyz")


def _columns_of(log: Log, model: Model) -> IntArray:
    """Return the columns (b,) of the layout that a log's coordinates have; -1: none, a clone of an older release."""
    layout = model.layout
    if log.has_views or not layout.views:
        return np.arange(layout.body)
    blocks = [block for block in layout.blocks if not block.is_view]
    seen, rest = ([block.name for block in blocks if block.is_seen is is_seen] for is_seen in (True, False))
    is_cloned = model.track_error is not None and "camera_jitter" in seen
    jitter = np.full(6 * is_cloned, -1)
    return np.concatenate(
        [layout.columns(["pose"]), np.full(6, -1), layout.columns(seen[1:]), jitter, layout.columns(rest)]
    )


def in_layout(log: Log, model: Model) -> Log:
    """Return a log with the coordinates of a model: older releases cloned pose and jitter, and had no views."""
    columns = _columns_of(log, model)
    if log.has_views or not model.layout.views:
        return log
    kept = np.flatnonzero(columns >= 0)

    def wide(array: Array) -> Array:
        found = np.zeros((len(array), model.layout.body))
        found[:, columns[kept]] = array[:, kept]
        return found

    initial = log.initial_covariance
    if len(initial) > 6:
        initial = wide(wide(initial).T)
    departed, linear, updated = wide(log.departed), wide(log.linear), wide(log.updated)
    return dataclasses.replace(log, initial_covariance=initial, departed=departed, linear=linear, updated=updated)


def _config_of(result: Result) -> Config:
    """Return the configuration of a run without iterations of its updates: some of older archives are refused today."""
    settings = dict(result.config.get("filter", {}))
    settings.pop("iterations", None)
    return Config.from_stored({**result.config, "filter": settings})


@one_thread()
@solvable()
def posterior_of_log(
    log: Log,
    model: Model,
    positions_m: Array,
    config: PosteriorConfig | None = None,
    min_depth_m: float = FilterConfig.min_depth_m,
    name: str = "posterior",
) -> Posterior:
    """Return the posterior of the log of a filter with any model, from ``positions_m`` (M, 3), see `posterior`."""
    config = config or PosteriorConfig()
    problem = BatchProblem(log, model)
    costs: tuple[float, ...]
    if config.linearisation == "filtered":
        information = JointInformation(problem.as_filtered())
        state = problem.solved_as_filtered(information)
        weight, costs, linearised = np.ones(log.observations), (information.cost,), state
    else:
        iterations = progress(range(MOST_ITERATIONS), f"{name}: smoothing")
        start = problem.filtered_state(positions_m)
        found = maximise(problem, start, config, min_depth_m, iterations)
        state, costs, information = found.state, found.costs, found.information
        weight, linearised = found.linearised.weight, found.linearised.state
    return Posterior(
        config.linearisation,
        log.id,
        se3.inverse(state.T_imu_world),
        state.positions_m,
        weight,
        costs,
        information,
        problem.unknowns.values(state),
        problem,
        linearised,
    )


@one_thread()
@solvable()
def smooth(result: Result, config: PosteriorConfig | None = None, found: Posterior | None = None) -> Result:
    """Return the posterior of a full run as a `Result`: smoothed trajectory, map, and all their marginals.

    Its mode is ``smoothed`` (``as filtered`` if linearised so). Arguments and errors are those of `posterior`; its
    return value, if known already, is ``found``.
    """
    begin = perf_counter()
    found = found or posterior(result, config)
    T, landmarks = len(result.time_s), result.landmarks
    covariance, landmark_covariance = found.pose_covariance, found.landmark_covariance
    pairs = None if result.pairs is None else found.pairs(result.pairs.first, result.pairs.second)
    seconds = perf_counter() - begin
    settings = dict(result.config)
    if config is not None:
        settings["posterior"] = dataclasses.asdict(config)
    return dataclasses.replace(
        result,
        mode="smoothed" if found.linearisation == "map" else "as filtered",
        T_world_imu=found.T_world_imu,
        covariance=covariance,
        landmarks=dataclasses.replace(landmarks, position_m=found.position_m, covariance=landmark_covariance),
        innovation=empty(Innovation, T=T),
        rejections=empty(Rejections),
        ms_per_frame=np.full(T, 1e3 * seconds / T),
        counts={
            "observations": len(found.weight),
            "observations weighted below one half": int((found.weight < 0.5).sum()),
            "iterations": len(found.costs) - 1,
        },
        config=settings,
        log=None,
        inertial=found.inertial,
        pairs=pairs,
        whitened=None,
    )


def _checked(what: str, index: ArrayLike, size: int) -> IntArray:
    index = np.atleast_1d(np.asarray(index, dtype=np.int64))
    if len(index) and not (-size <= index.min() and index.max() < size):
        raise PosteriorError(f"there is no {what} {index[(index < -size) | (index >= size)][0]}; there are {size}")
    return index % size if size else index
