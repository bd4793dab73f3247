"""Delayed landmark initialisation: tracks that wait, seen from an anchor, until a second view says where they are.

One clone of the pose, the anchor, serves all waiting tracks. Once the parallax between anchor and present suffices,
both views of a landmark, ``r = H_x x + H_m d + n`` whitened, are split by the QR factorisation
``H_m = [Q_1 Q_2] [R; 0]``:

    d = R^-1 Q_1^T (r - H_x x - n)      initialises it, as eq. (5) does,
    Q_2^T r = Q_2^T H_x x + Q_2^T n     is an ordinary measurement of pose and anchor.

Source: Li and Mourikis, "Optimization-based estimator design for vision-aided inertial navigation", RSS 2012.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.filters import gates
from ekfslam.filters.estimate import Estimate
from ekfslam.filters.observing import moment
from ekfslam.geometry import se3
from ekfslam.models.blocks import Anchor
from ekfslam.models.observer import Moment
from ekfslam.models.sensors.base import DelayedSensor


@dataclass(frozen=True)
class Started:
    """Landmarks that two views have initialised.

    Args:
        which: (n,) which of the new tracks they are.
        position_m: (k, 3) estimates.
        G, covariance: (k, 3, seen), (k, 3, 3) as in eq. (5).
        H, residual: (m, body), (m,) what is left over: whitened measurements of the blocks.
        step, rows: Frame of the anchor, and (k, d) views from it.
    """

    which: BoolArray
    position_m: Array
    G: Array
    covariance: Array
    H: Array
    residual: Array
    step: int
    rows: Array


class Waiting:
    """Tracks seen from the anchor that have no landmark yet.

    Args:
        sensor: Says which of them can start.
        gate_probability: Chi-square gate on what two views of a landmark leave over.
    """

    def __init__(self, sensor: DelayedSensor, gate_probability: float) -> None:
        self._sensor, self._gate_probability = sensor, gate_probability
        self._ids, self._rows = np.empty(0, dtype=np.int64), np.empty((0, 0))
        self._step, self._T_linear = 0, np.eye(4)

    def start(self, e: Estimate, ids: IntArray, rows: Array) -> Started:
        """Return the new tracks, of (n,) with rows (n, d), whose landmarks can be initialised now."""
        which = np.flatnonzero(np.isin(ids, self._ids))
        then = self._rows[np.searchsorted(self._ids, ids[which])] if len(which) else np.empty((0, rows.shape[1]))
        T_cam_imu, T_anchor = e.sensor.T_cam_imu, e.values[Anchor.name]
        T_now_anchor = T_cam_imu @ e.T_imu_world @ se3.inverse(T_cam_imu @ T_anchor)
        q, is_ready = self._sensor.triangulate(then, rows[which], T_now_anchor)
        position = se3.apply(se3.inverse(T_cam_imu @ e.T_imu_world), q)
        which, then, position = which[is_ready], then[is_ready], position[is_ready]

        H_x, H_m, r = self._views(e, position, then, rows[which])
        Q, R = np.linalg.qr(H_m, mode="complete")
        R_inverse = np.linalg.inv(R[:, :3])
        along = Q.swapaxes(1, 2)
        by_state, by_rows = along @ H_x, (along @ r[..., None])[..., 0]
        rest_H, rest_r = by_state[:, 3:], by_rows[:, 3:]
        P = e.gaussian.body_covariance[: e.gaussian.seen, : e.gaussian.seen]
        S = rest_H @ P @ rest_H.swapaxes(1, 2) + np.eye(rest_H.shape[1])
        gate = gates.threshold(self._gate_probability, rest_H.shape[1])
        inside = gates.normalised_squares(S, rest_r, e.step, ids[which]) <= gate

        chosen = np.zeros(len(ids), dtype=bool)
        chosen[which[inside]] = True
        R_inverse, kept = R_inverse[inside], int(inside.sum())
        H = np.zeros((rest_r[inside].size, e.gaussian.body))
        H[:, : e.gaussian.seen] = rest_H[inside].reshape(-1, e.gaussian.seen)
        return Started(
            chosen,
            position[inside] + (R_inverse @ by_rows[inside, :3, None])[..., 0],
            -R_inverse @ by_state[inside, :3],
            R_inverse @ R_inverse.swapaxes(1, 2) if kept else np.empty((0, 3, 3)),
            H,
            rest_r[inside].ravel(),
            self._step,
            then[inside],
        )

    def _views(self, e: Estimate, position: Array, then: Array, now: Array) -> tuple[Array, Array, Array]:
        """Whitened rows over blocks (k, 2d, seen) and landmark (k, 2d, 3), and right sides (k, 2d), of both views."""
        T_anchor, present = e.values[Anchor.name], moment(e, e.mean)
        T_linear = e.variant.linear(present.T_imu_world, e.motion.T_predicted)
        anchor = Moment(T_anchor, e.variant.linear(T_anchor, self._T_linear), present.calibration, present.twist)
        present = present.linearised_at(T_linear)
        views = (
            (e.model.observer.see(anchor, position, position, Anchor.name), then),
            (e.model.observer.see(present, position, position), now),
        )
        H_x, H_m, r = [], [], []
        for seen, rows in views:
            scale = 1.0 / np.sqrt(e.sensor.variance(rows))
            H_x.append(scale[..., None] * seen.H_x)
            H_m.append(scale[..., None] * seen.H_m)
            r.append(scale * (rows - seen.z))
        return np.concatenate(H_x, axis=1), np.concatenate(H_m, axis=1), np.concatenate(r, axis=1)

    def move_on(self, e: Estimate, ids: IntArray, rows: Array) -> None:
        """After a frame: of the tracks (n,) with rows (n, d) that have no landmark, say who waits, and from where."""
        still = np.isin(self._ids, ids)
        self._ids, self._rows = self._ids[still], self._rows[still]
        if len(self._ids) and e.step - self._step < self._sensor.patience:
            return
        # All tracks start to wait again, from here: the anchor takes the pose's place.
        layout = e.model.layout
        Phi = np.eye(layout.body)
        Phi[layout[Anchor.name], layout[Anchor.name]], Phi[layout[Anchor.name], layout["pose"]] = 0.0, np.eye(6)
        e.gaussian.propagate(Phi, np.zeros_like(Phi))
        e.values = {**e.values, Anchor.name: e.T_imu_world}
        self._ids, self._rows, self._step, self._T_linear = ids, rows, e.step, e.motion.T_predicted
