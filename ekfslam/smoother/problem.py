"""The batch problem: from the log to the rows of the joint posterior, linearised as the filter did, or anywhere else.

Its blocks, sensor and noise are those of the filter's `ekfslam.models.model.Model`. *As filtered*, unknowns are the
coordinates of the log: a pose counts from where it was predicted, a landmark from its initialisation; a standard or
first-estimates EKF that never retires a landmark has exactly the solution of these rows as its estimate.
*Relinearised*, all unknowns are errors of one state.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.errors import IllPosedError, PosteriorError
from ekfslam.filters.estimate import GIVEN
from ekfslam.filters.log import Log
from ekfslam.geometry import motion, se3
from ekfslam.models.model import Model, Moment, Seen, VelocityRows
from ekfslam.models.observation import landmark_by_pose
from ekfslam.models.sensors.base import DelayedSensor
from ekfslam.smoother.sparse.information import Elimination, JointInformation, LinearSystem


@dataclass(frozen=True)
class State:
    """A trajectory, a map, and the other blocks.

    Args:
        T_imu_world: (T, 4, 4) poses.
        positions_m: (M, 3) landmarks in world.
        zeta: (6,) the first pose in units of its prior: ``T_0 = exp((B zeta)^) T_prior``.
        aux: (T, a) coordinates of the blocks that each frame has besides its pose; they are vectors, so their values.
        drive: (g,) coordinates of the blocks of the drive: sums of corrections.
        drive_values: Values of the blocks of the drive, by name.
    """

    T_imu_world: Array
    positions_m: Array
    zeta: Array
    aux: Array
    drive: Array
    drive_values: Mapping[str, Array]


class BatchProblem:
    """The rows of a log.

    Args:
        log: What the filter conditioned on.
        model: Its blocks, sensor and noise.

    Raises:
        IllPosedError: The velocities have no noise, so that motion rows have no weight; names frames.
    """

    def __init__(self, log: Log, model: Model) -> None:
        self.log, self.model = log, model
        layout = model.layout
        # Symmetric root of the first pose's covariance, which may be singular.
        eigenvalues, vectors = np.linalg.eigh(log.initial_covariance)
        self.B = (vectors * np.sqrt(np.maximum(eigenvalues, 0.0))) @ vectors.T
        self.aux_blocks = [block for block in layout.blocks if block.per_frame and block.name != "pose"]
        self.drive_blocks = [block for block in layout.blocks if not block.per_frame and not block.is_pose]
        self.aux_columns = layout.columns(block.name for block in self.aux_blocks)
        self.drive_columns = layout.columns(block.name for block in self.drive_blocks)
        self._pose, self._clone = layout["pose"], layout.get("previous_pose")

    def elimination(self) -> Elimination:
        """The structure of the rows."""
        log = self.log
        return Elimination(
            log.frames, log.landmarks, log.frame, log.landmark, log.id, len(self.aux_columns), len(self.drive_columns)
        )

    # --- what does not depend on where the rows are linearised --------------------------------------------------------

    @cached_property
    def _weight_motion(self) -> Array:
        """``Q^-1/2`` (T-1, 6, 6) of eq. (2)."""
        log = self.log
        Q = self.model.process_noise(log.imu_twist[1:], log.tau_s[1:])
        smallest = np.linalg.eigvalsh(Q)[:, 0] if len(Q) else np.empty(0)
        if not (smallest > 0).all():
            raise IllPosedError(
                "velocities without noise (sigma_v or sigma_w is 0) before frames",
                1 + np.flatnonzero(~(smallest > 0)),
            )
        return np.linalg.inv(np.linalg.cholesky(Q))

    @cached_property
    def is_initial(self) -> BoolArray:
        """Whether (K,) an observation is the one that initialised its landmark."""
        _, first = np.unique(self.log.landmark, return_index=True)
        is_first = np.zeros(self.log.observations, dtype=bool)
        is_first[first] = True
        return is_first

    @cached_property
    def _first_frame(self) -> IntArray:
        """(M,) frame of each landmark's first observation."""
        frame = np.empty(self.log.landmarks, dtype=np.int64)
        frame[self.log.landmark[self.is_initial]] = self.log.frame[self.is_initial]
        return frame

    @cached_property
    def _follows(self) -> IntArray:
        """Observations that are differences from the one before."""
        return np.flatnonzero(self.log.previous >= 0)

    @cached_property
    def _velocities(self) -> VelocityRows:
        log = self.log
        return VelocityRows(log.velocity_axis, log.velocity_value, log.velocity_std, log.velocity_is_biased)

    @cached_property
    def _aux_moves(self) -> tuple[Array, Array]:
        """``phi`` and weights (T-1, a) of what blocks of a frame do by themselves; the twist starts at frame 1."""
        phi, weight = np.empty((2, self.log.frames - 1, len(self.aux_columns)))
        start = 0
        for block in self.aux_blocks:
            moves = block.transition(self.log.tau_s[1:])
            assert moves is not None
            at = slice(start, start + block.size)
            start = at.stop
            if not (moves[1] > 0).all():
                raise IllPosedError(f"{block.name} without noise: it has no weight before frames", [1])
            phi[:, at], weight[:, at] = moves[0], 1.0 / moves[1]
            if block.name == "twist":
                weight[:1, at] = 0.0
        return phi, weight

    def _common(self, aux: Array, drive: Array) -> dict[str, Any]:
        """Rows over aux and drive alone, whose right sides are what coordinates (T, a) and (g,) leave."""
        phi, weight = self._aux_moves
        prior = np.diag(self.model.prior_covariance)
        aux_std = prior[self.aux_columns] ** 0.5
        # What nothing is known of at frame 0 (the twist) is a certain 0 there: nothing depends on it.
        aux_prior = np.where(aux_std > 0, 1.0 / np.where(aux_std > 0, aux_std, 1.0), 1.0)
        drive_prior = 1.0 / np.sqrt(prior[self.drive_columns])
        velocities = self._velocities
        if len(velocities.axis):
            J = self.model.velocity_jacobian(velocities)[:, self.aux_columns] / velocities.std[:, None]
        else:
            J = np.empty((0, len(self.aux_columns)))
        at = self.log.velocity_frame
        return {
            "aux_prior": aux_prior,
            "r_aux_prior": -aux_prior * aux[0],
            "phi": phi,
            "aux_weight": weight,
            "r_aux": -weight * (aux[1:] - phi * aux[:-1]),
            "at": at,
            "J_at": J,
            "r_at": velocities.value / velocities.std - (J * aux[at]).sum(axis=1),
            "drive_prior": drive_prior,
            "r_drive": -drive_prior * drive,
        }

    def _motion_rows(self, Phi: Array, by_last: Array, by_next: Array, B: Array) -> dict[str, Any]:
        """Rows of the steps from Phi (T-1, 6, body), scaled by derivatives (T-1, 6, 6) of the residual."""
        W = self._weight_motion
        WPhi = -W @ by_last @ Phi
        J_from = WPhi[..., self._pose].copy()
        J_from[:1] = J_from[:1] @ B
        return {
            "J_from": J_from,
            "J_to": W @ by_next,
            "J_motion_aux": WPhi[..., self.aux_columns],
            "J_motion_drive": WPhi[..., self.drive_columns],
        }

    def _observation_rows(
        self, J_x: Array, J_p: Array | None, J_g: Array, J_m: Array, r: Array, scale: Array, B: Array
    ) -> dict[str, Any]:
        """Rows of the observations scaled by (K, d); those over the first pose become rows over zeta."""
        log, wide = self.log, scale[..., None]

        def over_zeta(J: Array, frame: IntArray) -> Array:
            J = wide * J
            which = np.flatnonzero(frame == 0)
            J[which] = J[which] @ B
            return J

        return {
            "landmarks": log.landmarks,
            "B": B,
            "frame": log.frame,
            "landmark": log.landmark,
            "previous": log.previous,
            "J_x": over_zeta(J_x, log.frame),
            "J_p": None if J_p is None else over_zeta(J_p, log.frame - 1),
            "J_g": wide * J_g,
            "J_m": wide * J_m,
            "r": scale * r,
        }

    # --- as filtered --------------------------------------------------------------------------------------------------

    def as_filtered(self) -> LinearSystem:
        """Rows frozen where the filter linearised them (motion, velocities, observations, initialisations)."""
        if isinstance(self.model.sensor, DelayedSensor):
            raise PosteriorError(
                "landmarks that waited for a second view have no rows as filtered; there is only 'map'"
            )
        log, W = self.log, self._weight_motion
        Phi = self._frozen_transition()
        identity = np.broadcast_to(np.eye(6), W.shape)
        zeros = np.zeros((log.frames, len(self.aux_columns)))
        return LinearSystem(
            r_prior=np.zeros(6),
            r_motion=-(W @ Phi @ log.departed[1:, :, None])[..., 0],
            **self._motion_rows(Phi, identity, identity, self.B),
            **self._observation_rows(*self._frozen_observations(), 1.0 / np.sqrt(log.variance), self.B),
            **self._common(zeros, np.zeros(len(self.drive_columns))),
        )

    def _frozen_transition(self) -> Array:
        """Phi (T-1, 6, body) of the steps, where the filter took it."""
        log, layout = self.log, self.model.layout
        T_from = log.T_predicted[:-1] if log.first_estimates else log.T_departed[1:]
        values = {block.name: log.departed[1:, layout[block.name]] for block in self.model.blocks}
        values |= {"pose": log.T_departed[1:], "up": log.up[1:]}
        _, by = self.model.imu_velocities(values, log.twist[1:], T_from[:, :3, :3])
        Phi = -motion.twist_jacobian(log.imu_twist[1:], log.tau_s[1:]) @ by
        Phi[..., self._pose] += motion.error_jacobian(log.T_predicted[1:] @ se3.inverse(T_from))
        return Phi

    def _frozen_observations(self) -> tuple[Array, Array | None, Array, Array, Array]:
        """Rows over pose, pose before, drive and landmark, and their right sides over coordinates, before weighting."""
        log, first, pose = self.log, self.is_initial, self._pose
        position, first_position = log.position_m, log.first_position_m[log.landmark]
        linear_position = first_position if log.first_estimates else position
        # A new landmark is initialised after the update of its frame, all others are linearised before it.
        T = np.where(first[:, None, None], log.T_updated[log.frame], log.T_linear[log.frame])
        x = np.where(first[:, None], log.updated[log.frame], log.linear[log.frame])
        T_linear = T
        if log.first_estimates:
            T_linear = np.where(first[:, None, None], T, log.T_predicted[log.frame])
        group = 2 * log.frame + first
        seen = self._see(group, T, T_linear, x, log.seen_twist[log.frame], position, linear_position)
        H_x, H_m, width = seen.H_x, seen.H_m, self.model.layout.seen
        if log.first_estimates:
            T_first = self._delayed(log.T_predicted[log.frame[first]], x[first], log.seen_twist[log.frame[first]])
            G = landmark_by_pose(T_first[0], first_position[first]) @ T_first[1]
            H_x[first, :, pose] = -H_m[first] @ G
        H_x = self._carried_back(H_x, pose, log.T_linear, log.T_predicted, log.frame, ~first)
        r = log.rows - seen.z + (H_x @ x[:, :width, None])[..., 0]
        J_p, follows = None, self._follows
        if len(follows):
            assert self._clone is not None
            memory, frame = self._memory, log.frame[follows]
            T = log.T_linear_before[frame]
            T_linear = log.T_predicted[frame - 1] if log.first_estimates else T
            before = self._see(
                frame,
                T,
                T_linear,
                x[follows],
                log.seen_twist[frame - 1],
                position[follows],
                linear_position[follows],
                "previous_pose",
            )
            B_x = self._carried_back(before.H_x, self._clone, log.T_linear_before, log.T_departed, frame, None)
            shifted = (B_x @ x[follows, :width, None])[..., 0]
            r[follows] -= memory * (log.rows[log.previous[follows]] - before.z + shifted)
            H_x[follows] -= memory * B_x
            H_m[follows] -= memory * before.H_m
            J_p = H_x[..., self._clone]
        r += (H_m @ (position - first_position)[..., None])[..., 0]
        wide = np.zeros((*H_x.shape[:2], self.model.layout.body))
        wide[..., :width] = H_x
        return H_x[..., pose], J_p, wide[..., self.drive_columns], H_m, r

    @property
    def _memory(self) -> float:
        error = self.model.track_error
        return 0.0 if error is None else error.memory

    def _see(
        self,
        group: IntArray,
        T: Array,
        T_linear: Array,
        coordinates: Array,
        twist: Array,
        positions_m: Array,
        linear_positions_m: Array,
        pose: str = "pose",
    ) -> Seen:
        """Landmarks (K, 3) from poses (K, 4, 4), calibrated as coordinates (K, body) say, alike within a group."""
        model, calibration = self.model, self.model.calibration
        if calibration is None:
            return model.see(Moment(T, T_linear), positions_m, linear_positions_m, pose)
        parts, order = [], np.argsort(group, kind="stable")
        for some in np.split(order, np.flatnonzero(np.diff(group[order])) + 1):
            found = calibration.retract(calibration.initial(), coordinates[some[0], model.layout["calibration"]])
            moment = Moment(T[some], T_linear[some], found, twist[some])
            parts.append(model.see(moment, positions_m[some], linear_positions_m[some], pose))
        back = np.argsort(order, kind="stable")
        return Seen(*(np.concatenate([getattr(part, field.name) for part in parts])[back] for field in fields(Seen)))

    def _delayed(self, T: Array, coordinates: Array, twist: Array) -> tuple[Array, Array]:
        """Poses (n, 4, 4) at the exposure, and how their errors follow from those at the stamp (n, 6, 6)."""
        calibration = self.model.calibration
        if calibration is None or not calibration.has_time_offset:
            return T, np.broadcast_to(np.eye(6), (len(T), 6, 6))
        start, at = calibration.initial(), self.model.layout["calibration"]
        found = np.array([calibration.retract(start, x[at]) for x in coordinates])
        delay = np.array([calibration.delay(c, u) for c, u in zip(found, twist, strict=True)])
        return delay @ T, se3.adjoint(delay)

    def _carried_back(
        self, H_x: Array, at: slice, T_linear: Array, T_reference: Array, frame: IntArray, which: BoolArray | None
    ) -> Array:
        """Rows of iterated updates in the coordinates before the update: the chain rule, as the filter has it."""
        shift = se3.log(T_linear @ se3.inverse(T_reference))
        moved = np.any(np.abs(shift) > 1e-12, axis=1)[frame]
        if which is not None:
            moved &= which
        if moved.any():
            H_x[moved, :, at] = H_x[moved, :, at] @ se3.left_jacobian(shift[frame[moved]])
        return H_x

    # --- at any state -------------------------------------------------------------------------------------------------

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
        """Whitened errors (T-1, 6) of the steps: how far the state is from eq. (1)."""
        return (self._weight_motion @ self._motion(state)[0][..., None])[..., 0]

    def block_cost(self, state: State) -> float:
        """Half the sum of squares of all rows over aux and drive alone, and of the first pose's prior."""
        rows = self._common(state.aux, state.drive)
        names = ("r_aux_prior", "r_aux", "r_at", "r_drive")
        return 0.5 * float((state.zeta**2).sum() + sum((rows[name] ** 2).sum() for name in names))

    def _moments(self, state: State) -> Moment:
        """From where every frame sees."""
        T, twist = state.T_imu_world, np.zeros((len(state.T_imu_world), 6))
        if self.model.has_time_offset:
            # Velocities as the trajectory has them; that they change with it is of second order.
            tau = np.where(self.log.tau_s > 0, self.log.tau_s, 1.0)[1:, None]
            twist = np.concatenate([self.log.seen_twist[:1], -se3.log(T[1:] @ se3.inverse(T[:-1])) / tau])
        return Moment(T, T, state.drive_values.get("calibration", GIVEN), twist)

    def points(self, state: State) -> Array:
        """Every observed landmark (K, 3) m as the sensor has it."""
        moment = self._moments(state).at(self.log.frame)
        return self.model.points(moment, state.positions_m[self.log.landmark])

    def observation_residual(self, q: Array, state: State) -> Array:
        """Whitened right sides (K, d) of the observations at the points of `points`."""
        log, follows = self.log, self._follows
        r = log.rows - self.model.sensor_at(state.drive_values.get("calibration", GIVEN)).predict(q)
        if len(follows):
            # Seen from the frame before is what the observation before has seen: the same landmark.
            r[follows] -= self._memory * r[log.previous[follows]]
        return r / np.sqrt(log.variance)

    def relinearised(self, state: State, weight: Array | None = None) -> LinearSystem:
        """Rows at a state, those of observation k scaled by ``sqrt(weight[k])`` (K,) where given."""
        log, W = self.log, self._weight_motion
        e, E, twist, by = self._motion(state)
        Phi = -motion.twist_jacobian(twist, log.tau_s[1:]) @ by
        Phi[..., self._pose] += motion.error_jacobian(E)
        # d log(exp(e^) exp(a^)) and d log(exp(a^) exp(e^)) by a, at a = 0.
        by_next, by_last = se3.left_jacobian_inverse(e), se3.left_jacobian_inverse(-e)
        B = se3.left_jacobian(self.B @ state.zeta) @ self.B
        scale = 1.0 / np.sqrt(log.variance)
        if weight is not None:
            scale = scale * np.sqrt(weight)[:, None]
        return LinearSystem(
            r_prior=-state.zeta,
            r_motion=-(W @ e[..., None])[..., 0],
            **self._motion_rows(Phi, by_last, by_next, B),
            **self._observation_rows(*self._observations(state), scale, B),
            **self._common(state.aux, state.drive),
        )

    def _observations(self, state: State) -> tuple[Array, Array | None, Array, Array, Array]:
        """Rows over pose, pose before, drive and landmark at a state, and their right sides, before weighting."""
        log, follows, moments = self.log, self._follows, self._moments(state)
        positions = state.positions_m[log.landmark]
        seen = self.model.see(moments.at(log.frame), positions, positions)
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
            J_p = H_x[..., self._clone]
        wide = np.zeros((*H_x.shape[:2], self.model.layout.body))
        wide[..., : H_x.shape[-1]] = H_x
        return H_x[..., self._pose], J_p, wide[..., self.drive_columns], H_m, r

    def moved(self, state: State, step: JointInformation) -> State:
        """A state moved by the solution of its rows.

        Landmarks move in the frame of the pose that saw them first, by what the corrections are there to first order:
        where a long stretch of the trajectory moves and turns as a whole, its landmarks go along to all orders.
        """
        before, zeta, d = state.T_imu_world, state.zeta + step.zeta, step.d
        T = se3.exp(step.eps) @ before
        # The first pose is where its prior says, of which eps is the first order.
        T[0] = se3.exp(self.B @ zeta) @ self.log.T_predicted[0]
        eps = np.concatenate([se3.log(T[:1] @ se3.inverse(before[:1])), step.eps[1:]])
        k = self._first_frame
        s = se3.apply(before[k], state.positions_m)
        turned = np.cross(eps[k, 3:], s) + (before[k, :3, :3] @ d[..., None])[..., 0]
        positions = se3.apply(se3.inverse(T[k]), s + eps[k, :3] + turned)
        drive = self._drive(state.drive_values, step.drive)
        return State(T, positions, zeta, state.aux + step.aux, state.drive + step.drive, drive)

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
        drive = log.updated[-1, self.drive_columns]
        zeta, aux = np.linalg.pinv(self.B) @ xi, log.updated[:, self.aux_columns]
        return State(log.T_updated, positions_m, zeta, aux, drive, self._drive(self._initial_drive, drive))

    def solved_as_filtered(self, information: JointInformation) -> State:
        """The state that the solution of `as_filtered` stands for; corrections of it add up as those of the filter."""
        log = self.log
        T = se3.exp(information.eps) @ log.T_predicted
        positions = log.first_position_m + information.d
        drive = self._drive(self._initial_drive, information.drive)
        return State(T, positions, information.zeta, information.aux, information.drive, drive)

    def values(self, state: State) -> dict[str, Array]:
        """Values of the blocks besides the poses: of each frame (T, ...), or of the drive."""
        values, start = dict(state.drive_values), 0
        for block in self.aux_blocks:
            values[block.name] = state.aux[:, start : start + block.size]
            start += block.size
        return values

    def last_values(self, state: State) -> dict[str, Array]:
        """Values of a filter's blocks at the last frame."""
        of_frames = {block.name for block in self.aux_blocks}
        values = {name: value[-1] if name in of_frames else value for name, value in self.values(state).items()}
        values["pose"] = state.T_imu_world[-1]
        if self._clone is not None and len(state.T_imu_world) > 1:
            values["previous_pose"] = state.T_imu_world[-2]
        return values

    def last_coordinates(self, state: State) -> tuple[IntArray, Array]:
        """Columns (c,) of the blocks besides the poses, and their coordinates at the last frame."""
        columns = np.concatenate([self.aux_columns, self.drive_columns])
        return columns, np.concatenate([state.aux[-1], state.drive])
