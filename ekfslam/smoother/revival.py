"""The sparse system behind the filter, from which landmarks that were retired come back.

The filter's state is the marginal, over the current pose and the landmarks in view, of one system over all poses and
all landmarks. When retired landmarks are seen again, the marginal over the current pose, the active *and* the returning
landmarks takes its place:

- ``standard`` and ``fej``: the rows are frozen where the filter linearised them, and so the marginal is exactly the
  state of a filter that never retired anything. FEJ keeps its consistency, since a landmark comes back with its first
  estimate; standard is as inconsistent as it ever is.
- ``invariant``: a never-retired filter would have moved the error of every retired landmark with every correction,
  which no sparse row remembers. Here all rows are linearised again at their common maximum a posteriori, and mean and
  covariance are taken from there. All rows then see the same unobservable directions, those at the new mean, and
  nothing is learned about them: the invariant filter's own property, at a better estimate.
"""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.config import FilterConfig, PosteriorConfig
from ekfslam.filters.log import Log
from ekfslam.filters.observing import Sensor
from ekfslam.filters.variants import RULES
from ekfslam.smoother.optimise import maximise
from ekfslam.smoother.problem import Rows, State
from ekfslam.smoother.sparse.information import Elimination, JointInformation

# What came in has passed the gate: no kernel. The mean must be the linearisation point, so the tolerance is tight.
_MAXIMUM = PosteriorConfig(kernel="none", tolerance=1e-12)


class Behind:
    """Marginals of the system behind.

    Args:
        sensor, config: Those of the filter.
    """

    def __init__(self, sensor: Sensor, config: FilterConfig) -> None:
        self._sensor, self._config = sensor, config
        self._last: State | None = None

    def neighbours(self, log: Log, returning: IntArray, candidates: IntArray) -> tuple[IntArray, IntArray]:
        """Of the candidates those ``config.revive`` that were seen nearest in time to returning landmarks.

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

    def marginal(self, log: Log, positions_m: Array, landmarks: IntArray) -> tuple[Array, Array, Array]:
        """Mean and covariance of the last pose and some landmarks, given everything in the log.

        Args:
            log: Everything so far, the prediction to the current frame included.
            positions_m: (M, 3) the filter's last estimates of all landmarks.
            landmarks: (n,) rows of the log.

        Returns:
            ``T_imu_world`` (4, 4), positions (n, 3) and covariance (6+3n, 6+3n).

        Raises:
            IllPosedError: Something is undetermined; names landmark ids or frames.
        """
        rows = Rows(log, self._sensor)
        elimination = Elimination(log.frames, log.landmarks, log.frame, log.landmark, log.id)
        last = np.array([log.frames - 1])
        if RULES[self._config.variant].transport is None:
            information = JointInformation(elimination, rows.as_filtered())
            # The last pose has been predicted and nothing more: eps is 0 but for rounding.
            T = log.T_predicted[-1]
            positions = log.first_position_m[landmarks] + information.d[landmarks]
        else:
            start = self._start(rows, positions_m)
            found = maximise(rows, elimination, start, _MAXIMUM, self._config, range(_MAXIMUM.max_iterations))
            information, self._last = found.information, found.state
            T, positions = found.state.T_imu_world[-1], found.state.positions_m[landmarks]
        return T, positions, np.ascontiguousarray(information.covariance(last, landmarks))

    def _start(self, rows: Rows, positions_m: Array) -> State:
        """The last maximum, continued by the filter's estimates of what has been seen since."""
        state, log = rows.filtered_state(positions_m), rows.log
        if self._last is None:
            return state
        known = len(self._last.T_imu_world)
        unseen = np.ones(len(self._last.positions_m), dtype=bool)
        since = log.landmark[log.frame >= known - 1]
        unseen[since[since < len(unseen)]] = False
        positions = state.positions_m.copy()
        positions[: len(unseen)][unseen] = self._last.positions_m[unseen]
        T = np.concatenate([self._last.T_imu_world, state.T_imu_world[known:]])
        return State(T, positions, self._last.zeta)
