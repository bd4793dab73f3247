"""Relinearised window: the filter's last frames solved again, between filter and smoother (`filter.lag`).

After each update, the factors of the last n frames are linearised again at their common maximum a posteriori. The rest
is a Gaussian at the first frame of the window, `Prior`. A window that holds the whole log has the smoother's estimate
of the last frame. When a frame leaves, its factors are linearised a last time, at the estimate given the n frames after
it, and marginalised. Source: Sibley, Matthies, Sukhatme, "Sliding window filter with application to planetary landing",
JFR 2010.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.config import FilterConfig, PosteriorConfig
from ekfslam.errors import ConfigError, IllPosedError
from ekfslam.filters.estimate import Estimate
from ekfslam.filters.lifecycle import Marginal
from ekfslam.filters.log import Log
from ekfslam.models.model import Model
from ekfslam.models.sensors.base import DelayedSensor
from ekfslam.smoother.observations import ObservationFactors
from ekfslam.smoother.optimise import better_start, evaluate
from ekfslam.smoother.prior import Prior, first_of
from ekfslam.smoother.problem import BatchProblem, Information, State
from ekfslam.smoother.process import ProcessFactors
from ekfslam.smoother.revival import marginal_of
from ekfslam.smoother.sparse.dense import DenseInformation
from ekfslam.smoother.sparse.factors import FirstFrame, LinearSystem
from ekfslam.smoother.unknowns import Unknowns

# Each frame continues the solution of the frame before: mostly two or three steps suffice.
_SEARCH, _MOST_STEPS, _SHARES = PosteriorConfig(kernel="none"), 6, (1.0, 0.5, 0.25, 0.1)


class FixedLag:
    """The last n = ``config.lag`` frames of a filter; a search ends with a step of less ``gain`` in the cost.

    Attributes:
        prior, unknowns: Gaussian at the first frame of the window (None: not begun), and its unknowns.
        first: First frame of the log in the window.
        observed: First frame whose observations the prior does not contain.
        given_up: Number of windows that were given up, because a landmark came to lie behind a camera that saw it.
    """

    def __init__(self, model: Model, config: FilterConfig, gain: float = 0.05) -> None:
        if isinstance(model.sensor, DelayedSensor):
            raise ConfigError("filter.lag: not with landmarks that wait for a second view")
        self.model, self.config, self.gain = model, config, gain
        self.first, self.observed, self.given_up = 0, 0, 0
        self.unknowns = Unknowns(model, model.prior_covariance, model.initial_coordinates)
        self.prior: Prior | None = None
        self._state: State | None = None
        self._rows = np.empty(0, dtype=np.int64)
        self._solution: DenseInformation | None = None  # the last one, of a window that began at `_begins`
        self._begins = 0

    @property
    def landmarks(self) -> IntArray:
        """Rows in the filter's log of the landmarks that the prior knows."""
        return np.empty(0, dtype=np.int64) if self.prior is None else self.prior.landmarks

    def start_over(self, e: Estimate) -> None:
        """Begin a window at the present frame, with the estimate of a filter after its update as the prior."""
        u, layout = self.unknowns, self.model.layout
        columns = np.concatenate([u.frame_columns, u.aux_columns, u.drive_columns])
        at = np.concatenate([columns, layout.body + np.arange(3 * len(e.table))])
        P = e.covariance_of(e.table.id)[np.ix_(at, at)]
        shared, aux, drive = (e.coordinates[own] for own in (u.frame_columns[6:], u.aux_columns, u.drive_columns))
        values = {block.name: e.values[block.name] for block in u.of_drive}
        positions = e.table.position_m.copy()
        state = State(e.T_imu_world[None], positions, np.empty(0), shared[None], aux[None], drive, values)
        self.first, self.observed, self._rows, self._solution = e.step, e.step + 1, e.table.log_row.copy(), None
        self.prior, zeta = Prior.at_state(
            self.model, state, 0, self._rows, np.arange(len(positions)), np.zeros(len(P)), P, self.config.min_depth_m
        )
        self._state = dataclasses.replace(state, zeta=zeta)

    def marginal(self, e: Estimate, log: Log, rows: IntArray) -> Marginal | None:
        """Return the estimate of the last frame given the window; None: it was given up, and begins again there.

        The log begins at frame ``first`` with the landmarks of ``rows`` (M,) in the whole log, ascending; they contain
        `landmarks` and the active ones.
        """
        if self.prior is None:
            self._begin()
        problem = WindowProblem(self, log, rows)
        try:
            state, system, solution = self._solved(problem, self._continued(e, log, rows))
        except IllPosedError:
            self.given_up += 1
            self.start_over(e)
            return None
        active = np.searchsorted(rows, e.table.log_row)
        marginal = marginal_of(problem, state, solution, active)
        self._state, self._rows = state, rows
        self._solution, self._begins = solution, self.first
        if log.frames > (self.config.lag or 0):
            self._shift(problem, system, active)
        return marginal

    def cross(self, step: int) -> Array | None:
        """Return ``cov(xi_j, xi_k)`` (6, 6) of poses as reported at a step j and the last; None: j has left."""
        if self._solution is None or not self._begins <= step:
            return None
        last, w = len(self._solution.eps) - 1, self.unknowns.width
        return self._solution.covariance(frames=[step - self._begins, last])[:6, w : w + 6]

    def _solved(self, problem: WindowProblem, start: State) -> tuple[State, LinearSystem, DenseInformation]:
        """Return the maximum by Gauss-Newton with halved steps, and the factors and their solution next to it."""
        nearest = self.config.min_depth_m
        here = evaluate(problem, start, _SEARCH, nearest)
        here = here or evaluate(problem, problem.in_view(start, nearest), _SEARCH, nearest)
        if here is None:
            raise IllPosedError("landmarks behind a camera that saw them", [])
        for _ in range(_MOST_STEPS):
            step = DenseInformation(here.system, problem.known)
            if step.gain <= self.gain:
                return problem.moved(here.state, step), here.system, step
            for share in _SHARES:
                there = evaluate(problem, problem.moved(here.state, step.shortened(share)), _SEARCH, nearest)
                if there is not None and there.cost < here.cost:
                    break
            else:
                return here.state, here.system, step
            here = there
        return here.state, here.system, DenseInformation(here.system, problem.known)

    def _begin(self) -> None:
        """Take the model's prior, before the observations of the first frame."""
        u, model = self.unknowns, self.model
        columns = np.concatenate([u.frame_columns, u.aux_columns, u.drive_columns])
        P, none = model.prior_covariance[np.ix_(columns, columns)], np.empty(0, dtype=np.int64)
        T, drive = model.initial_values()["pose"][None], np.zeros(len(u.drive_columns))
        state = State(
            T, np.empty((0, 3)), np.empty(0), u.shared_mean[None], u.aux_mean[None], drive, u.drive_values(drive)
        )
        self.prior, zeta = Prior.at_state(model, state, 0, none, none, np.zeros(len(P)), P, self.config.min_depth_m)
        self._state = dataclasses.replace(state, zeta=zeta)

    def _continued(self, e: Estimate, log: Log, rows: IntArray) -> State:
        """Return the last solution, continued by the filter: its last frame, and all active landmarks."""
        last, u = self._state, self.unknowns
        assert last is not None and self.prior is not None
        known = len(last.T_imu_world)
        T = np.concatenate([last.T_imu_world, log.T_updated[known:]])
        shared = np.concatenate([last.shared, log.updated[known:, u.frame_columns[6:]]])
        aux = np.concatenate([last.aux, log.updated[known:, u.aux_columns]])
        positions = np.full((len(rows), 3), np.nan)
        _, old, new = np.intersect1d(self._rows, rows, assume_unique=True, return_indices=True)
        positions[new] = last.positions_m[old]
        positions[np.searchsorted(rows, e.table.log_row)] = e.table.position_m
        positions[np.searchsorted(rows, self.prior.landmarks)] = self.prior.at(last.zeta).positions_m
        return State(T, positions, last.zeta, shared, aux, last.drive, last.drive_values)

    def _shift(self, problem: WindowProblem, system: LinearSystem, active: IntArray) -> None:
        """Marginalise the first frame of the window, linearised at the present solution."""
        state, log = self._state, problem.log
        assert state is not None
        wanted = np.union1d(active, log.landmark[log.frame > 1])
        early = np.union1d(problem.known, log.landmark[log.frame <= 1])
        wanted = np.intersect1d(wanted, early)
        first = DenseInformation(first_of(system, early), np.searchsorted(early, problem.known))
        at = np.searchsorted(early, wanted)
        P = first.covariance(frames=[1], aux=[1], drive=[0], landmarks=at)
        delta = np.concatenate([first.eps[1], first.aux[1], first.drive, first.d[at].ravel()])
        self.prior, zeta = Prior.at_state(
            self.model, state, 1, self._rows[wanted], wanted, delta, P, self.config.min_depth_m
        )
        T, shared, aux = state.T_imu_world[1:], state.shared[1:], state.aux[1:]
        self._state = dataclasses.replace(state, T_imu_world=T, shared=shared, aux=aux, zeta=zeta)
        self.first, self.observed = self.first + 1, self.first + 2


class WindowProblem(BatchProblem):
    """Factors of a window after its prior of landmarks ``known`` (n,); ``rows`` (M,) are in the whole log."""

    def __init__(self, window: FixedLag, log: Log, rows: IntArray) -> None:
        assert window.prior is not None
        self.log, self.model, self.unknowns, self.prior = log, window.model, window.unknowns, window.prior
        self.process = ProcessFactors(log, self.model, self.unknowns, has_start=window.first == 0)
        self.observations = ObservationFactors(log, self.model, self.unknowns)
        self.known = np.searchsorted(rows, self.prior.landmarks)
        self._is_free = ~np.isin(np.arange(len(rows)), self.known)
        self._since = window.observed - window.first

    def relinearised(self, state: State) -> LinearSystem:
        """Return the factors after the prior, linearised at a state."""
        system, parts = super().relinearised(state), []
        for factor in system.factors:
            groups = {term.group for term in factor.terms}
            if groups == {"drive"}:  # in the prior
                continue
            if factor.observation is not None:
                factor = factor.only(self.log.frame[factor.observation] >= self._since)
            elif groups == {"landmarks"}:
                factor = factor.only(self._is_free[factor.terms[0].index])
            parts.append(factor)
        first = FirstFrame(self.prior.derivative(state.zeta), state.zeta, self.unknowns.width)
        sizes = {**system.sizes, "aux": len(self.unknowns.aux_columns)}
        return dataclasses.replace(system, factors=tuple(parts), first=first, sizes=sizes)

    def in_view(self, state: State, min_depth_m: float) -> State:
        """Return a state whose landmarks without a prior start where they fit better, as estimated or initialised."""
        found = better_start(self, state, _SEARCH, min_depth_m)
        found.positions_m[self.known] = state.positions_m[self.known]
        return found

    def first_frame(self, zeta: Array) -> tuple[Array, Array, Array]:
        first = self.prior.at(zeta)
        return first.T_imu_world, first.shared, first.aux

    def moved(self, state: State, step: Information) -> State:
        found = super().moved(state, step)
        found.positions_m[self.known] = self.prior.at(found.zeta).positions_m
        return found
