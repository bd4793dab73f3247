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
        """Return the ``config.revive`` candidates that were seen nearest in time to returning landmarks.

        Args:
            log: Everything so far.
            returning, candidates: (a,), (b,) rows of the log, disjoint.

        Returns:
            Rows (c,) and, in frames, their distances (c,) from the nearest sighting of a returning landmark.
        """
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
        """Return mean and covariance of the last frame's blocks and of some landmarks, given everything in the log.

        Args:
            log: Everything so far, the prediction to the current frame included.
            positions_m: (M, 3) the filter's last estimates of all landmarks.
            landmarks: (n,) rows of the log.

        Raises:
            IllPosedError: Something is undetermined; names landmark ids or frames.
        """
        problem = BatchProblem(log, self._model)
        if is_frozen_exactly(self._config):
            information = JointInformation(problem.as_filtered())
            # The blocks' mean is the filter's already, but for rounding.
            positions = log.first_position_m[landmarks] + information.d[landmarks]
            none = np.empty(0, dtype=np.int64)
            P = filter_covariance(self._model, problem.unknowns, information, log.frames - 1, landmarks)
            return Marginal({}, none, np.empty(0), positions, P)
        start = problem.filtered_state(positions_m)
        if self._last is not None:
            start = continued(self._last, start, log)
        found, _, information = maximise(problem, start, _MAXIMUM, self._config.min_depth_m, range(MOST_ITERATIONS))
        self._last = state = found.state
        return Marginal(
            problem.unknowns.last_values(state),
            *problem.unknowns.last_coordinates(state),
            state.positions_m[landmarks],
            filter_covariance(self._model, problem.unknowns, information, log.frames - 1, landmarks),
        )


def filter_covariance(
    model: Model, u: Unknowns, information: JointInformation | DenseInformation, last: int, landmarks: IntArray
) -> Array:
    """Return the covariance (body+3n, body+3n) of the last frame and of landmarks (n,) in the columns of the filter."""
    has_clone = model.has_clone and last > 0
    frames = [last, last - 1] if has_clone else [last]
    P = information.covariance(frames=frames, aux=[last], drive=[0], landmarks=landmarks)
    # Of the frame before only what is cloned counts.
    before, of_clones = (u.cloned, u.clone_columns) if has_clone else (np.empty(0, dtype=np.int64),) * 2
    rest = np.arange(u.width * len(frames), len(P))
    kept = np.concatenate([np.arange(u.width), u.width + before, rest])
    columns = np.concatenate([u.frame_columns, of_clones, u.aux_columns, u.drive_columns])
    body = model.layout.body
    order = np.concatenate([columns, body + np.arange(3 * len(landmarks))])
    wide = np.zeros((body + 3 * len(landmarks),) * 2)
    wide[np.ix_(order, order)] = P[np.ix_(kept, kept)]
    return wide


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
