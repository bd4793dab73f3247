"""Equation (5): how new landmarks enter the state, at once or after waiting for a second view.

*Delayed*: one clone of the view, the anchor, serves all waiting tracks. Once the parallax from there suffices, both
views of a landmark, ``r = H_x x + H_m d + n`` whitened, are split by the QR factorisation ``H_m = [Q_1 Q_2] [R; 0]``:

    d = R^-1 Q_1^T (r - H_x x - n)      initialises it, as eq. (5) does,
    Q_2^T r = Q_2^T H_x x + Q_2^T n     is an ordinary measurement of view and anchor.

Source: Li and Mourikis, "Optimization-based estimator design for vision-aided inertial navigation", RSS 2012.
"""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.filters import gates
from ekfslam.filters.estimate import Estimate
from ekfslam.filters.logbook import LogBook
from ekfslam.filters.observing import Present, present
from ekfslam.filters.retraction import retract
from ekfslam.geometry import se3
from ekfslam.models.blocks import Anchor
from ekfslam.models.sensors.base import DelayedSensor

# Standard deviation of a first depth by the noise of two views, as a share of the depth, up to which they are enough.
LARGEST_DEPTH_ERROR = 0.1


def start(e: Estimate, log: LogBook, frame: int, ids: IntArray, rows: Array) -> BoolArray:
    """Append new landmarks with their full cross-covariance, eq. (5), given tracks (n,) that are not in the state.

    Return whether (n,) each track is in front of the sensor and has a landmark now.
    """
    error, parameters = e.model.track_error, e.model.observer.parameters(e.values)
    q, has_depth = e.model.observer.inverted(parameters, rows)
    ids, rows, q = ids[has_depth], rows[has_depth], q[has_depth]
    if len(ids):
        none = np.zeros(len(ids), dtype=np.int64)
        variance = e.sensor.variance(rows) if error is None else error.absolute_variance(none)
        now = present(e)
        positions, G, covariance = e.model.observer.initialise(
            parameters, now.T_cam_world, now.T_linear, now.by, q, variance
        )
        e.gaussian.augment(G, covariance)
        _append(e, log, frame, ids, positions, rows, (e.step, rows, variance))
    return has_depth


class Waiting:
    """Tracks seen from the anchor that have no landmark yet; a chi-square gate tests the remaining rows."""

    def __init__(self, sensor: DelayedSensor, gate_probability: float) -> None:
        self._sensor, self._gate_probability = sensor, gate_probability
        self._ids, self._rows = np.empty(0, dtype=np.int64), np.empty((0, 0))
        self._step, self._W_linear = 0, np.eye(4)

    def start(self, e: Estimate, log: LogBook, frame: int, ids: IntArray, rows: Array) -> BoolArray:
        """Append the landmarks that two views initialise; arguments and result as of the function `start`."""
        which, then, position = self._triangulated(e, ids, rows)
        H_x, H_m, r, variance = self._views(e, position, then, rows[which])
        Q, R = np.linalg.qr(H_m, mode="complete")
        R_inverse = np.linalg.inv(R[:, :3])
        by_state, by_rows = Q.swapaxes(1, 2) @ H_x, (Q.swapaxes(1, 2) @ r[..., None])[..., 0]
        rest_H, rest_r = by_state[:, 3:], by_rows[:, 3:]
        seen = e.gaussian.seen
        S = rest_H @ e.gaussian.body_covariance[:seen, :seen] @ rest_H.swapaxes(1, 2) + np.eye(rest_H.shape[1])
        gate = gates.threshold(self._gate_probability, rest_H.shape[1])
        inside = gates.normalised_squares(S, rest_r, e.step, ids[which]) <= gate
        T_cam_world = present(e).T_cam_world
        depth_m, depth_std_m = (
            se3.apply(T_cam_world, position)[:, 2],
            np.linalg.norm(T_cam_world[2, :3] @ R_inverse, axis=1),
        )
        inside &= depth_std_m <= LARGEST_DEPTH_ERROR * depth_m

        started = np.zeros(len(ids), dtype=bool)
        started[which[inside]] = True
        if inside.any():
            now, then, R_inverse = rows[started], then[inside], R_inverse[inside]
            position = position[inside] + (R_inverse @ by_rows[inside, :3, None])[..., 0]
            e.gaussian.augment(-R_inverse @ by_state[inside, :3], R_inverse @ R_inverse.swapaxes(1, 2))
            before, after = np.hsplit(variance[inside], 2)
            _append(e, log, frame, ids[started], position, now, (self._step, then, before), (e.step, now, after))
            H, residual = np.zeros((rest_r[inside].size, e.gaussian.body)), rest_r[inside].ravel()
            H[:, :seen] = rest_H[inside].reshape(-1, seen)
            solution = e.gaussian.solve_body(H, residual, np.ones(len(residual)), e.step)
            e.gaussian.apply(solution)
            retract(e, solution.done.correction)
        self._move_on(e, ids[~started], rows[~started])
        return started

    def _triangulated(self, e: Estimate, ids: IntArray, rows: Array) -> tuple[IntArray, Array, Array]:
        """Return the new tracks (k,) with enough parallax, their rows (k, d) at the anchor, and positions (k, 3)."""
        which = np.flatnonzero(np.isin(ids, self._ids))
        then = self._rows[np.searchsorted(self._ids, ids[which])] if len(which) else np.empty((0, rows.shape[1]))
        T_cam_world = present(e).T_cam_world
        T_now_anchor = T_cam_world @ se3.inverse(e.values[Anchor.name])
        q, is_ready = self._sensor.triangulate(then, rows[which], T_now_anchor)
        return which[is_ready], then[is_ready], se3.apply(se3.inverse(T_cam_world), q)[is_ready]

    def _views(self, e: Estimate, position: Array, then: Array, rows_now: Array) -> tuple[Array, Array, Array, Array]:
        """Return whitened H_x (k, 2d, seen), H_m (k, 2d, 3) and r (k, 2d) of the two views, and variances (k, 2d).

        If tracks have errors, the second view counts by its difference from the first.
        """
        observer, now, W = e.model.observer, present(e), e.values[Anchor.name]
        error, parameters = e.model.track_error, observer.parameters(e.values)
        by_anchor = np.zeros_like(now.by)
        by_anchor[:, e.model.layout[Anchor.name]] = np.eye(6)
        anchor = Present(W, e.variant.linear(W, self._W_linear), by_anchor)
        both = []
        for camera, rows in ((anchor, then), (now, rows_now)):
            seen = observer.project(parameters, camera.T_cam_world, position, camera.T_linear, position)
            both.append((observer.by_body(seen, camera.by), seen.H_m, rows - seen.z))
        first, second = both
        if error is None:
            variance = np.hstack([e.sensor.variance(then), e.sensor.variance(rows_now)])
        else:
            second = second[0] - first[0], second[1] - first[1], second[2] - first[2]
            way_m = np.linalg.norm((now.T_cam_world @ se3.inverse(W))[:3, 3])
            depth_m = np.maximum(se3.apply(now.T_cam_world, position)[:, 2], e.config.min_depth_m)
            step = error.step_variance(rows_now - then, way_m / depth_m, e.step - self._step)
            variance = np.hstack([error.absolute_variance(np.zeros(len(then), dtype=np.int64)), step])
        scale = 1.0 / np.sqrt(variance)
        H_x, H_m, r = (np.concatenate(parts, axis=1) for parts in zip(first, second, strict=True))
        return scale[..., None] * H_x, scale[..., None] * H_m, scale * r, variance

    def _move_on(self, e: Estimate, ids: IntArray, rows: Array) -> None:
        """Keep the tracks (n,) without a landmark that wait already; if none is left or patience ends, start again."""
        still = np.isin(self._ids, ids)
        self._ids, self._rows = self._ids[still], self._rows[still]
        if len(self._ids) and e.step - self._step < self._sensor.patience:
            return
        # All tracks start to wait again, from here: the anchor takes the view's place.
        now, at, Phi = present(e), e.model.layout[Anchor.name], np.eye(e.model.layout.body)
        Phi[at], Phi[at, : e.gaussian.seen] = 0.0, now.by
        e.gaussian.propagate(Phi, np.zeros_like(Phi))
        e.values = {**e.values, Anchor.name: now.T_cam_world}
        order = np.argsort(ids)
        self._ids, self._rows, self._step, self._W_linear = ids[order], rows[order], e.step, now.T_linear


def _append(
    e: Estimate,
    log: LogBook,
    frame: int,
    ids: IntArray,
    positions: Array,
    rows: Array,
    *views: tuple[int, Array, Array],
) -> None:
    """Write new landmarks into table and log."""
    fresh = np.zeros(len(ids), dtype=np.int64)
    e.table.append(
        id=ids,
        first_frame=fresh + frame,
        last_frame=fresh + frame,
        observations=fresh + len(views),
        log_row=log.started(ids, positions, *views, follows=e.model.track_error is not None),
        first_step=fresh + e.step,
        position_m=positions,
        initial_m=positions,
    )
    slot = np.arange(len(e.table) - len(ids), len(e.table))
    e.table.observed(slot, e.step, rows, log.last(len(ids)))
