"""From the log to the rows of the joint posterior, linearised as the filter did, or at any other state.

Unknowns are the pose errors ``eps_k`` and landmark displacements ``d_j`` of `ekfslam.smoother.sparse.information`. *As
filtered*, ``eps_k`` is the error of the predicted pose of frame k and ``d_j`` counts from the first triangulation; a
standard or first-estimates EKF that never retires a landmark has exactly the solution of these rows as its estimate.
*Relinearised*, both are errors of one state for all rows, ``T_k = exp(eps_k^) T_hat_k`` and ``m_j = m_hat_j + d_j``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ekfslam.arrays import Array, IntArray
from ekfslam.errors import IllPosedError
from ekfslam.filters.log import Log
from ekfslam.filters.observing import Sensor, landmark_by_pose, linearise
from ekfslam.geometry import motion, se3
from ekfslam.smoother.sparse.information import LinearSystem


@dataclass(frozen=True)
class State:
    """A trajectory and a map.

    Args:
        T_imu_world: (T, 4, 4) poses.
        positions_m: (M, 3) landmarks in world.
        zeta: (6,) the first pose in units of its prior: ``T_0 = exp((B zeta)^) T_prior``.
    """

    T_imu_world: Array
    positions_m: Array
    zeta: Array


def aged(log: Log, sensor: Sensor) -> Log:
    """A log whose observations are worth less the further the rig has driven since their landmark was first seen.

    Rows know landmarks that stay. Where tracks wander (`Noise.drift`, `Noise.bearing_drift_rad`), each observation's
    variance grows by what its landmark may have moved since its first sight, seen at the filter's own estimates; that
    successive observations share most of it is left out.
    """
    noise = sensor.noise
    if not noise.landmarks_walk:
        return log
    position = se3.inverse(log.T_updated)[:, :3, 3]
    step = np.diff(position, axis=0, prepend=position[:1])
    way = np.cumsum(np.linalg.norm(step, axis=1))
    along = np.cumsum(step[:, :, None] * step[:, None, :], axis=0)
    _, first = np.unique(log.landmark, return_index=True)
    begin, now = log.frame[first][log.landmark], log.frame
    q, _, H_m = linearise(sensor, log.T_updated[now], log.position_m, log.position_m)
    across = noise.bearing_drift_rad**2 * (way[now] - way[begin]) * (q**2).sum(axis=1)
    moved = noise.drift**2 * (along[now] - along[begin]) + across[:, None, None] * np.eye(3)
    return replace(log, variance=log.variance + np.einsum("kij,kjl,kil->ki", H_m, moved, H_m))


class Rows:
    """The rows of a log.

    Args:
        log: What the filter conditioned on.
        sensor: What saw it.

    Raises:
        IllPosedError: The velocities have no noise, so that motion rows have no weight; names frames.
    """

    def __init__(self, log: Log, sensor: Sensor) -> None:
        self.log, self.sensor = log, sensor
        # Symmetric root of the first pose's covariance, which may be singular.
        eigenvalues, vectors = np.linalg.eigh(log.initial_covariance)
        self.B = (vectors * np.sqrt(np.maximum(eigenvalues, 0.0))) @ vectors.T

    @cached_property
    def _weight_motion(self) -> Array:
        """``Q^-1/2`` (T-1, 6, 6) of eq. (2)."""
        log = self.log
        noise = self.sensor.noise
        Q = motion.process_noise(log.twist[1:], log.tau_s[1:], noise.velocity_std, noise.misalignment_rad)
        smallest = np.linalg.eigvalsh(Q)[:, 0] if len(Q) else np.empty(0)
        if not (smallest > 0).all():
            raise IllPosedError(
                "velocities without noise (sigma_v or sigma_w is 0) before frames",
                1 + np.flatnonzero(~(smallest > 0)),
            )
        return np.linalg.inv(np.linalg.cholesky(Q))

    @cached_property
    def is_first_sight(self) -> NDArray[np.bool_]:
        """Whether (K,) an observation is the one that its landmark was triangulated from."""
        _, first = np.unique(self.log.landmark, return_index=True)
        is_first = np.zeros(self.log.observations, dtype=bool)
        is_first[first] = True
        return is_first

    @cached_property
    def _first_frame(self) -> IntArray:
        """(M,) frame of each landmark's first observation."""
        frame = np.empty(self.log.landmarks, dtype=np.int64)
        frame[self.log.landmark[self.is_first_sight]] = self.log.frame[self.is_first_sight]
        return frame

    def as_filtered(self) -> LinearSystem:
        """Rows frozen where the filter linearised them (motion, pixels, first sight)."""
        log = self.log
        delta = se3.log(log.T_updated @ se3.inverse(log.T_predicted))
        T_from = log.T_predicted if log.first_estimates else log.T_updated
        F = motion.error_jacobian(log.T_predicted[1:] @ se3.inverse(T_from[:-1]))
        W = self._weight_motion

        # A new landmark is triangulated after the update of its frame, all others before it.
        first = self.is_first_sight
        T = np.where(first[:, None, None], log.T_updated[log.frame], log.T_linear[log.frame])
        first_position = log.first_position_m[log.landmark]
        q, H_x, H_m = linearise(
            self.sensor, T, log.position_m, first_position if log.first_estimates else log.position_m
        )
        if log.first_estimates:
            G = landmark_by_pose(log.T_predicted[log.frame[first]], first_position[first])
            H_x[first] = -H_m[first] @ G
        shift = se3.log(log.T_linear @ se3.inverse(log.T_predicted))
        is_moved = np.any(shift != 0.0, axis=1)
        elsewhere = is_moved[log.frame] & ~first
        if elsewhere.any():
            H_x[elsewhere] = H_x[elsewhere] @ se3.left_jacobian(shift[log.frame[elsewhere]])
        shift = np.where(first[:, None], delta[log.frame], shift[log.frame])
        r = log.rows - self.sensor.predict(q) + (H_x @ shift[..., None])[..., 0]
        r += (H_m @ (log.position_m - first_position)[..., None])[..., 0]
        weight = 1.0 / np.sqrt(log.variance)
        return LinearSystem(
            landmarks=log.landmarks,
            B=self.B,
            r_prior=np.zeros(6),
            J_from=-W @ F,
            J_to=W,
            r_motion=-(W @ F @ delta[:-1, :, None])[..., 0],
            frame=log.frame,
            landmark=log.landmark,
            J_x=weight[..., None] * H_x,
            J_m=weight[..., None] * H_m,
            r=weight * r,
        )

    def motion_residual(self, state: State) -> Array:
        """Whitened ``log(T_{k+1} T_k^-1 E_k^-1)`` (T-1, 6): how far the state is from eq. (1)."""
        return (self._weight_motion @ self._motion_error(state)[..., None])[..., 0]

    def _motion_error(self, state: State) -> Array:
        T = state.T_imu_world
        E = motion.increment(self.log.twist[1:], self.log.tau_s[1:])
        return se3.log(T[1:] @ se3.inverse(E @ T[:-1]))

    def points(self, state: State) -> Array:
        """Every observed landmark (K, 3) m as the sensor has it."""
        T_cam_world = self.sensor.T_cam_imu @ state.T_imu_world
        return se3.apply(T_cam_world[self.log.frame], state.positions_m[self.log.landmark])

    def observation_residual(self, q: Array) -> Array:
        """Whitened ``z - h(q)`` (K, 3) at the points of `points`."""
        return (self.log.rows - self.sensor.predict(q)) / np.sqrt(self.log.variance)

    def relinearised(self, state: State, weight: Array | None = None) -> LinearSystem:
        """Rows at a state, those of observation k scaled by ``sqrt(weight[k])`` (K,) where given."""
        log, W = self.log, self._weight_motion
        e = self._motion_error(state)
        E = motion.increment(log.twist[1:], log.tau_s[1:])
        # d log(exp(e^) exp(a^)) and d log(exp(a^) exp(e^)) by a, at a = 0.
        by_next, by_last = se3.left_jacobian_inverse(e), se3.left_jacobian_inverse(-e) @ motion.error_jacobian(E)
        positions = state.positions_m[log.landmark]
        q, H_x, H_m = linearise(self.sensor, state.T_imu_world[log.frame], positions, positions)
        scale = 1.0 / np.sqrt(log.variance)
        if weight is not None:
            scale = scale * np.sqrt(weight)[:, None]
        return LinearSystem(
            landmarks=log.landmarks,
            B=se3.left_jacobian(self.B @ state.zeta) @ self.B,
            r_prior=-state.zeta,
            J_from=-W @ by_last,
            J_to=W @ by_next,
            r_motion=-(W @ e[..., None])[..., 0],
            frame=log.frame,
            landmark=log.landmark,
            J_x=scale[..., None] * H_x,
            J_m=scale[..., None] * H_m,
            r=scale * (log.rows - self.sensor.predict(q)),
        )

    def moved(self, state: State, eps: Array, d: Array, zeta: Array) -> State:
        """A state moved by corrections ``eps`` (T, 6), ``d`` (M, 3) and that of the first pose's ``zeta`` (6,).

        Landmarks move in the frame of the pose that saw them first, by what the corrections are there to first order:
        where a long stretch of the trajectory moves and turns as a whole, its landmarks go along to all orders.
        """
        before = state.T_imu_world
        T = se3.exp(eps) @ before
        # The first pose is where its prior says, of which eps is the first order.
        T[0] = se3.exp(self.B @ (state.zeta + zeta)) @ self.log.T_predicted[0]
        eps = np.concatenate([se3.log(T[:1] @ se3.inverse(before[:1])), eps[1:]])
        k = self._first_frame
        s = se3.apply(before[k], state.positions_m)
        turned = np.cross(eps[k, 3:], s) + (before[k, :3, :3] @ d[..., None])[..., 0]
        return State(T, se3.apply(se3.inverse(T[k]), s + eps[k, :3] + turned), state.zeta + zeta)

    def filtered_state(self, positions_m: Array) -> State:
        """The filter's own estimates as a state: its poses after each update, and the map given."""
        xi = se3.log(self.log.T_updated[0] @ se3.inverse(self.log.T_predicted[0]))
        return State(self.log.T_updated, positions_m, np.linalg.pinv(self.B) @ xi)
