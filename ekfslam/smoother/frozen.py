"""The rows of the batch problem where the filter linearised them.

Unknowns are the coordinates of the log: a pose counts from where it was predicted, a landmark from its initialisation.
A
standard or first-estimates EKF that never retires a landmark has exactly the solution of these rows as its estimate.
"""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.errors import PosteriorError
from ekfslam.filters.estimate import GIVEN
from ekfslam.geometry import motion, se3
from ekfslam.models.model import Moment, Seen
from ekfslam.models.sensors.base import DelayedSensor
from ekfslam.smoother.rows import BatchRows
from ekfslam.smoother.sparse.information import LinearSystem


class FrozenRows(BatchRows):
    """Rows of motion, velocities, observations and landmark initialisations, as filtered."""

    def as_filtered(self) -> LinearSystem:
        """Rows frozen where the filter linearised them (motion, velocities, observations, initialisations)."""
        if isinstance(self.model.sensor, DelayedSensor):
            raise PosteriorError(
                "landmarks that waited for a second view have no rows as filtered; there is only 'map'"
            )
        log, W = self.log, self._weight_motion
        Phi = self._frozen_transition()
        identity = np.broadcast_to(np.eye(6), W.shape)
        zeros, shared = np.zeros((log.frames, len(self.aux_columns))), np.zeros((log.frames, self.width - 6))
        r_motion = -(W @ Phi @ log.departed[1:, :, None])[..., 0]
        return LinearSystem(
            r_prior=np.zeros(self.width),
            r_motion=np.hstack([r_motion, -self._shared_residual(shared)]),
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
        is_difference = log.previous >= 0
        position, first_position = log.position_m, log.first_position_m[log.landmark]
        linear_position = first_position if log.first_estimates else position
        # A new landmark is initialised after the update of its frame, all others are linearised before it.
        T = np.where(first[:, None, None], log.T_updated[log.frame], log.T_linear[log.frame])
        x = np.where(first[:, None], log.updated[log.frame], log.linear[log.frame])
        T_linear = T
        if log.first_estimates:
            T_linear = np.where(first[:, None, None], T, log.T_predicted[log.frame])
        group = 2 * log.frame + first
        seen_twist = log.seen_twist[log.frame]
        seen = self._see(group, T, T_linear, x, seen_twist, position, linear_position, "pose", is_difference)
        H_x, H_m, width = seen.H_x, seen.H_m, self.model.layout.seen
        if log.first_estimates:
            # A new landmark follows the pose as it was predicted, whatever it is seen from.
            T_first, at, place = log.T_predicted[log.frame[first]], group[first], first_position[first]
            there = self._see(at, T[first], T_first, x[first], seen_twist[first], place, place)
            H_x[first, :, pose] = H_m[first] @ np.linalg.solve(there.H_m, there.H_x[..., pose])
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
            J_p = self._over_previous(H_x)
        r += (H_m @ (position - first_position)[..., None])[..., 0]
        wide = np.zeros((*H_x.shape[:2], self.model.layout.body))
        wide[..., :width] = H_x
        return wide[..., self.frame_columns], J_p, wide[..., self.drive_columns], H_m, r

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
        is_difference: BoolArray | None = None,
    ) -> Seen:
        """Landmarks (K, 3) from poses (K, 4, 4), with blocks as coordinates (K, body) say, alike within a group."""
        model, calibration = self.model, self.model.calibration
        layout = model.layout
        clones = layout.clones if pose == "previous_pose" else {}
        shared = {block.name: coordinates[:, layout[clones.get(block.name, block.name)]] for block in model.shared}
        moment = Moment(T, T_linear, GIVEN, twist, shared, self._way_m[group // 2 if pose == "pose" else group])
        if calibration is None:
            return model.see(moment, positions_m, linear_positions_m, pose, is_difference)
        parts, order = [], np.argsort(group, kind="stable")
        for some in np.split(order, np.flatnonzero(np.diff(group[order])) + 1):
            found = calibration.retract(calibration.initial(), coordinates[some[0], layout["calibration"]])
            here = replace(moment.at(some), calibration=found)
            differs = None if is_difference is None else is_difference[some]
            parts.append(model.see(here, positions_m[some], linear_positions_m[some], pose, differs))
        back = np.argsort(order, kind="stable")
        return Seen(*(np.concatenate([getattr(part, field.name) for part in parts])[back] for field in fields(Seen)))

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
