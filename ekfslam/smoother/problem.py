"""The batch problem: from the log to the rows of the joint posterior, linearised as the filter did, or anywhere else.

Its blocks, sensor and noise are those of the filter's `ekfslam.models.model.Model`. *As filtered* see
`ekfslam.smoother.frozen`. *Relinearised*, all unknowns are errors of one state.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.filters.estimate import GIVEN
from ekfslam.geometry import motion, se3
from ekfslam.models.model import Moment
from ekfslam.smoother.frozen import FrozenRows
from ekfslam.smoother.rows import State
from ekfslam.smoother.sparse.information import JointInformation, LinearSystem

__all__ = ["BatchProblem", "State"]

# How far a landmark may lie from where it was initialised: so weak that no landmark with a depth feels it.
LANDMARK_PRIOR_M = 1e4


class BatchProblem(FrozenRows):
    """All rows of a log, to be linearised at any state.

    Args:
        log: What the filter conditioned on.
        model: Its blocks, sensor and noise.

    Raises:
        IllPosedError: The velocities have no noise, so that motion rows have no weight; names frames.
    """

    def _values_before(self, state: State) -> dict[str, Array]:
        """Values of all blocks as steps (T-1,) need them: poses of the frame before, all else of the frame after."""
        values: dict[str, Array] = {"pose": state.T_imu_world[:-1]}
        start = 0
        for block in self.aux_blocks:
            values[block.name] = state.aux[1:, start : start + block.size]
            start += block.size
        for name, value in state.drive_values.items():
            values[name] = np.broadcast_to(value, (self.log.frames - 1, *value.shape))
        return values

    def _motion(self, state: State) -> tuple[Array, Array, Array, Array]:
        """Error ``log(T_{k+1} T_k^-1 E_k^-1)`` (T-1, 6) of the steps, E, velocities, and their derivatives."""
        log, T = self.log, state.T_imu_world
        twist, by = self.model.imu_velocities(self._values_before(state), log.twist[1:], T[:-1, :3, :3])
        E = motion.increment(twist, log.tau_s[1:])
        return se3.log(T[1:] @ se3.inverse(E @ T[:-1])), E, twist, by

    def motion_residual(self, state: State) -> Array:
        """Whitened errors (T-1, w) of the steps: how far poses are from eq. (1), and shared blocks from their own."""
        of_poses = (self._weight_motion @ self._motion(state)[0][..., None])[..., 0]
        return np.hstack([of_poses, self._shared_residual(state.shared)])

    def block_cost(self, state: State) -> float:
        """Half the sum of squares of all rows over aux, drive or landmarks alone, and of the first pose's prior."""
        rows = {**self._common(state.aux, state.drive), **self._landmark_rows(state)}
        names = ("r_aux_prior", "r_aux", "r_at", "r_drive", "r_landmark")
        return 0.5 * float((state.zeta**2).sum() + sum((rows[name] ** 2).sum() for name in names))

    def _moments(self, state: State) -> Moment:
        """From where every frame sees."""
        T, twist = state.T_imu_world, np.zeros((len(state.T_imu_world), 6))
        if self.model.has_time_offset:
            # Velocities as the trajectory has them; that they change with it is of second order.
            tau = np.where(self.log.tau_s > 0, self.log.tau_s, 1.0)[1:, None]
            twist = np.concatenate([self.log.seen_twist[:1], -se3.log(T[1:] @ se3.inverse(T[:-1])) / tau])
        shared, start = {}, 0
        for block in self.shared_blocks:
            shared[block.name] = state.shared[:, start : start + block.size]
            start += block.size
        return Moment(T, T, state.drive_values.get("calibration", GIVEN), twist, shared, self._way_m)

    def points(self, state: State) -> Array:
        """Every observed landmark (K, 3) m as the sensor has it."""
        moment = self._moments(state).at(self.log.frame)
        return self.model.points(moment, state.positions_m[self.log.landmark], self.log.previous >= 0)

    def observation_residual(self, q: Array, state: State) -> Array:
        """Whitened right sides (K, d) of the observations at the points of `points`."""
        log, follows, moment = self.log, self._follows, self._moments(state).at(self.log.frame)
        r = log.rows - self.model.predicted(moment, q)
        if len(follows):
            # Seen from the frame before is what the observation before has seen: the same landmark.
            alone = r
            if self.model.has_drift:
                q = self.model.points(moment, state.positions_m[log.landmark])
                alone = log.rows - self.model.predicted(moment, q)
            r[follows] -= self._memory * alone[log.previous[follows]]
        return r / np.sqrt(log.variance)

    def relinearised(self, state: State, weight: Array | None = None) -> LinearSystem:
        """Rows at a state, those of observation k scaled by ``sqrt(weight[k])`` (K,) where given."""
        log, W = self.log, self._weight_motion
        e, E, twist, by = self._motion(state)
        Phi = -motion.twist_jacobian(twist, log.tau_s[1:]) @ by
        Phi[..., self._pose] += motion.error_jacobian(E)
        # d log(exp(e^) exp(a^)) and d log(exp(a^) exp(e^)) by a, at a = 0.
        by_next, by_last = se3.left_jacobian_inverse(e), se3.left_jacobian_inverse(-e)
        B = self.B.copy()
        B[:6, :6] = se3.left_jacobian(self.B[:6, :6] @ state.zeta[:6]) @ B[:6, :6]
        scale = 1.0 / np.sqrt(log.variance)
        if weight is not None:
            scale = scale * np.sqrt(weight)[:, None]
        return LinearSystem(
            r_prior=-state.zeta,
            r_motion=np.hstack([-(W @ e[..., None])[..., 0], -self._shared_residual(state.shared)]),
            **self._motion_rows(Phi, by_last, by_next, B),
            **self._observation_rows(*self._observations(state), scale, B),
            **self._common(state.aux, state.drive),
            **self._landmark_rows(state),
        )

    def _landmark_rows(self, state: State) -> dict[str, Any]:
        """Rows that say that landmarks are not infinitely far, where errors of tracks walk.

        Differences of successive observations leave the disparity itself open: some tracks fit best at infinity.
        """
        weight = 0.0 if self.model.track_error is None else 1.0 / LANDMARK_PRIOR_M
        return {"landmark_weight": weight, "r_landmark": weight * (self.log.first_position_m - state.positions_m)}

    def _observations(self, state: State) -> tuple[Array, Array | None, Array, Array, Array]:
        """Rows over pose, pose before, drive and landmark at a state, and their right sides, before weighting."""
        log, follows, moments = self.log, self._follows, self._moments(state)
        positions = state.positions_m[log.landmark]
        seen = self.model.see(moments.at(log.frame), positions, positions, "pose", log.previous >= 0)
        H_x, H_m, r, J_p = seen.H_x, seen.H_m, log.rows - seen.z, None
        if len(follows):
            # Seen from the frame before is what the observation before has seen: the same landmark.
            previous, memory = log.previous[follows], self._memory
            before = self.model.see(
                moments.at(log.frame[previous]), positions[follows], positions[follows], "previous_pose"
            )
            r[follows] -= memory * (log.rows[previous] - before.z)
            H_x[follows] -= memory * before.H_x
            H_m[follows] -= memory * before.H_m
            J_p = self._over_previous(H_x)
        wide = np.zeros((*H_x.shape[:2], self.model.layout.body))
        wide[..., : H_x.shape[-1]] = H_x
        return wide[..., self.frame_columns], J_p, wide[..., self.drive_columns], H_m, r

    def moved(self, state: State, step: JointInformation) -> State:
        """A state moved by the solution of its rows.

        Landmarks move in the frame of the pose that saw them first, by what the corrections are there to first order:
        where a long stretch of the trajectory moves and turns as a whole, its landmarks go along to all orders.
        """
        before, zeta, d = state.T_imu_world, state.zeta + step.zeta, step.d
        T = se3.exp(step.eps[:, :6]) @ before
        # The first frame is where its prior says, of which eps is the first order.
        T[0] = se3.exp((self.B @ zeta)[:6]) @ self.log.T_predicted[0]
        eps = np.concatenate([se3.log(T[:1] @ se3.inverse(before[:1])), step.eps[1:, :6]])
        shared = state.shared + step.eps[:, 6:]
        shared[0] = (self.B @ zeta)[6:]
        k = self._first_frame
        s = se3.apply(before[k], state.positions_m)
        turned = np.cross(eps[k, 3:], s) + (before[k, :3, :3] @ d[..., None])[..., 0]
        positions = se3.apply(se3.inverse(T[k]), s + eps[k, :3] + turned)
        drive = self._drive(state.drive_values, step.drive)
        return State(T, positions, zeta, shared, state.aux + step.aux, state.drive + step.drive, drive)

    @property
    def _initial_drive(self) -> dict[str, Array]:
        """Values of the drive's blocks before the first frame."""
        return {block.name: block.initial() for block in self.drive_blocks}

    def _drive(self, before: Mapping[str, Array], correction: Array) -> dict[str, Array]:
        """Values of the drive's blocks after a correction (g,)."""
        values, start = {}, 0
        for block in self.drive_blocks:
            part = correction[start : start + block.size]
            values[block.name] = block.retract(before[block.name], part)
            start += block.size
        return values

    def filtered_state(self, positions_m: Array) -> State:
        """The filter's own estimates as a state: its blocks after each update, and the map given."""
        log = self.log
        xi = se3.log(log.T_updated[0] @ se3.inverse(log.T_predicted[0]))
        drive, shared = log.updated[-1, self.drive_columns], log.updated[:, self.frame_columns[6:]]
        zeta, aux = np.linalg.pinv(self.B) @ np.concatenate([xi, shared[0]]), log.updated[:, self.aux_columns]
        return State(log.T_updated, positions_m, zeta, shared, aux, drive, self._drive(self._initial_drive, drive))

    def solved_as_filtered(self, information: JointInformation) -> State:
        """The state that the solution of `as_filtered` stands for; corrections of it add up as those of the filter."""
        log = self.log
        T, shared = se3.exp(information.eps[:, :6]) @ log.T_predicted, information.eps[:, 6:]
        positions = log.first_position_m + information.d
        drive = self._drive(self._initial_drive, information.drive)
        return State(T, positions, information.zeta, shared, information.aux, information.drive, drive)

    def values(self, state: State) -> dict[str, Array]:
        """Values of the blocks besides the poses: of each frame (T, ...), or of the drive."""
        values = dict(state.drive_values)
        for blocks, of_frames in ((self.shared_blocks, state.shared), (self.aux_blocks, state.aux)):
            start = 0
            for block in blocks:
                values[block.name] = of_frames[:, start : start + block.size]
                start += block.size
        return values

    def last_values(self, state: State) -> dict[str, Array]:
        """Values of a filter's blocks at the last frame."""
        of_frames = {block.name for block in (*self.shared_blocks, *self.aux_blocks)}
        found, clones = self.values(state), self.model.clones
        values = {name: value[-1] if name in of_frames else value for name, value in found.items()}
        values["pose"] = state.T_imu_world[-1]
        if len(state.T_imu_world) > 1:
            values |= {clone: found[name][-2] for clone, name in clones}
            if self._clone is not None:
                values["previous_pose"] = state.T_imu_world[-2]
        return values

    def last_coordinates(self, state: State) -> tuple[IntArray, Array]:
        """Columns (c,) of the blocks besides the poses, and their coordinates at the last frame."""
        shared, before = self.frame_columns[6:], self._cloned >= 6
        columns = [self.aux_columns, self.drive_columns, shared]
        parts = [state.aux[-1], state.drive, state.shared[-1]]
        if before.any() and len(state.shared) > 1:
            columns.append(self._clone_columns[before])
            parts.append(state.shared[-2, self._cloned[before] - 6])
        return np.concatenate(columns), np.concatenate(parts)
