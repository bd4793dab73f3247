"""Map revival: landmarks that were retired come back from the batch problem behind the filter.

When retired landmarks are seen again, the filter's state is replaced by the marginal over its blocks, the active *and*
the returning landmarks. ``standard`` and ``fej`` with landmarks in xyz keep the rows where the filter linearised them:
the marginal is exactly the state of a filter that never retired anything. In all other variants, each correction moves
the errors of all landmarks, which no frozen row remembers. There all rows are linearised again at their common maximum
a posteriori, so that they see the same unobservable directions; FEJ has its first estimates there from then on.
"""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.config import FilterConfig, PosteriorConfig
from ekfslam.filters.lifecycle import Marginal
from ekfslam.filters.log import Log
from ekfslam.filters.variants import is_frozen_exactly
from ekfslam.models.blocks import PreviousView, View
from ekfslam.models.model import Model
from ekfslam.smoother.optimise import MOST_ITERATIONS, maximise
from ekfslam.smoother.problem import BatchProblem, State
from ekfslam.smoother.sparse.dense import DenseInformation
from ekfslam.smoother.sparse.information import JointInformation
from ekfslam.smoother.unknowns import Unknowns

# Observations have passed the gate: no kernel. The mean must be the linearisation point, so the tolerance is tight.
_MAXIMUM = PosteriorConfig(kernel="none", tolerance=1e-12)


class MapRevival:
    """Marginals of the batch problem behind a filter with this model and these settings."""

    def __init__(self, model: Model, config: FilterConfig) -> None:
        self._model, self._config = model, config
        self._last: State | None = None

    def neighbours(self, log: Log, returning: IntArray, candidates: IntArray) -> tuple[IntArray, IntArray]:
        """Return the ``config.revive`` candidates seen nearest to returning landmarks, and distances in frames."""
        role = np.zeros(log.landmarks, dtype=np.int64)
        role[returning], role[candidates] = 1, 2
        role_seen = role[log.landmark]
        anchors = log.frame[role_seen == 1]  # ascending, as frames are
        frame = log.frame[role_seen == 2]
        after = np.searchsorted(anchors, frame)
        distance = np.minimum(
            np.abs(frame - anchors[np.minimum(after, len(anchors) - 1)]),
            np.abs(frame - anchors[np.maximum(after - 1, 0)]),
        )
        nearest = np.full(log.landmarks, np.iinfo(np.int64).max)
        np.minimum.at(nearest, log.landmark[role_seen == 2], distance)
        chosen = candidates[np.argsort(nearest[candidates], kind="stable")[: self._config.revive]]
        return chosen, nearest[chosen]

    def marginal(self, log: Log, positions_m: Array, landmarks: IntArray) -> Marginal:
        """Return mean and covariance of the last frame's blocks and of landmarks (rows), given the whole log."""
        problem = BatchProblem(log, self._model)
        if is_frozen_exactly(self._config):
            information = JointInformation(problem.as_filtered())
            # The blocks' mean is the filter's already, but for rounding.
            positions = log.first_position_m[landmarks] + information.d[landmarks]
            none = np.empty(0, dtype=np.int64)
            by = problem.observations.frozen_views.by
            P = filter_covariance(self._model, problem.unknowns, information, log.frames - 1, landmarks, by)
            return Marginal({}, none, np.empty(0), positions, P)
        start = problem.filtered_state(positions_m)
        if self._last is not None:
            start = continued(self._last, start, log)
        found = maximise(problem, start, _MAXIMUM, self._config.min_depth_m, range(MOST_ITERATIONS))
        self._last = found.state
        return marginal_of(problem, found.state, found.information, landmarks)


def marginal_of(
    problem: BatchProblem, state: State, information: JointInformation | DenseInformation, landmarks: IntArray
) -> Marginal:
    """Return the marginal of the last frame and of some landmarks (n,) at a solution."""
    model, u, last = problem.model, problem.unknowns, len(state.T_imu_world) - 1
    W, by = problem.observations.views(state)
    values = u.last_values(state)
    if PreviousView.name in model.layout and last:
        values[PreviousView.name] = W[-2]
    P = filter_covariance(model, u, information, last, landmarks, by)
    return Marginal(values, *u.last_coordinates(state), state.positions_m[landmarks], P)


def filter_covariance(
    model: Model,
    u: Unknowns,
    information: JointInformation | DenseInformation,
    last: int,
    landmarks: IntArray,
    by: Array,
) -> Array:
    """Return the covariance (body+3n, body+3n) of the last frame and landmarks (n,), with views ``z = by x``."""
    layout, n = model.layout, len(landmarks)
    frames = [last, last - 1] if PreviousView.name in layout and last else [last]
    P = information.covariance(frames=frames, aux=[last], drive=[0], landmarks=landmarks)
    width, drive = u.width * len(frames), u.drive_columns < layout.seen
    columns = np.concatenate([u.frame_columns, u.aux_columns, u.drive_columns, layout.body + np.arange(3 * n)])
    E = np.zeros((layout.body + 3 * n, len(P)))
    E[columns, np.concatenate([np.arange(u.width), np.arange(width, len(P))])] = 1.0
    of_drive = width + len(u.aux_columns) + np.flatnonzero(drive)
    for i, name in enumerate([View.name, PreviousView.name][: len(frames)]):
        if name in layout:
            at, Y = layout[name], by[frames[i]]
            E[at, i * u.width : (i + 1) * u.width] = Y[:, u.frame_columns]
            E[at, of_drive] = Y[:, u.drive_columns[drive]]
    return np.asarray(E @ P @ E.T, dtype=float)


def continued(last: State, state: State, log: Log) -> State:
    """Return the maximum of an earlier revival, continued by the filter's estimates of everything seen since."""
    known = len(last.T_imu_world)
    unseen = np.ones(len(last.positions_m), dtype=bool)
    # Observations of the last frame of the maximum came after it.
    since = log.landmark[log.frame >= known - 1]
    unseen[since[since < len(unseen)]] = False
    positions = state.positions_m.copy()
    positions[: len(unseen)][unseen] = last.positions_m[unseen]
    T, shared, aux = (
        np.concatenate([getattr(last, name), getattr(state, name)[known:]]) for name in ("T_imu_world", "shared", "aux")
    )
    return State(T, positions, last.zeta, shared, aux, last.drive, last.drive_values)
