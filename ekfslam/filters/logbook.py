"""How the joint filter keeps its `Log`: arrays are appended frame by frame and joined when asked for."""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.filters.log import Log


class LogBook:
    """Grows a `Log`, whose fields say what the arguments are.

    Args:
        first_estimates, initial_covariance: As in `Log`.
        T_imu_world: (4, 4) estimate of the first pose.
    """

    def __init__(self, first_estimates: bool, initial_covariance: Array, T_imu_world: Array) -> None:
        self._first_estimates, self._initial_covariance = first_estimates, initial_covariance
        self._twist, self._tau_s = [np.zeros(6)], [0.0]
        self._predicted, self._linear, self._updated = [T_imu_world], [T_imu_world], [T_imu_world]
        self._id, self._first_position = [np.empty(0, dtype=np.int64)], [np.empty((0, 3))]
        self._frame, self._landmark = [np.empty(0, dtype=np.int64)], [np.empty(0, dtype=np.int64)]
        self._rows, self._variance, self._position = [np.empty((0, 3))], [np.empty((0, 3))], [np.empty((0, 3))]
        self.landmarks = 0

    @property
    def frames(self) -> int:
        """Number of frames so far."""
        return len(self._tau_s)

    def predicted(self, twist: Array, tau_s: float, T_imu_world: Array) -> None:
        """A new frame, reached by a prediction."""
        self._twist.append(np.asarray(twist, dtype=float))
        self._tau_s.append(tau_s)
        for poses in (self._predicted, self._linear, self._updated):
            poses.append(T_imu_world)

    def linearised(self, T_imu_world: Array) -> None:
        """The pose at which the update of this frame was linearised, if not the predicted one."""
        self._linear[-1] = T_imu_world

    def updated(self, T_imu_world: Array) -> None:
        """The pose after the update of this frame."""
        self._updated[-1] = T_imu_world

    def started(self, ids: IntArray, positions_m: Array) -> IntArray:
        """New landmarks; returns their rows in the log."""
        self._id.append(ids)
        self._first_position.append(positions_m)
        self.landmarks += len(ids)
        return np.arange(self.landmarks - len(ids), self.landmarks)

    def observed(self, landmark: IntArray, rows: Array, variance: Array, position_m: Array) -> None:
        """Accepted observations of this frame."""
        self._frame.append(np.full(len(landmark), self.frames - 1))
        self._landmark.append(landmark)
        self._rows.append(rows)
        self._variance.append(variance)
        self._position.append(position_m)

    def log(self) -> Log:
        """The log so far."""
        return Log(
            first_estimates=self._first_estimates,
            initial_covariance=self._initial_covariance,
            twist=np.array(self._twist),
            tau_s=np.array(self._tau_s),
            T_predicted=np.array(self._predicted),
            T_linear=np.array(self._linear),
            T_updated=np.array(self._updated),
            id=np.concatenate(self._id),
            first_position_m=np.concatenate(self._first_position),
            frame=np.concatenate(self._frame),
            landmark=np.concatenate(self._landmark),
            rows=np.concatenate(self._rows),
            variance=np.concatenate(self._variance),
            position_m=np.concatenate(self._position),
        )
