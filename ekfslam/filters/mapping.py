"""Mapping-only, the report's second half: poses as given (P_xx(0) = 0, W = 0), every landmark its own 3x3 EKF."""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.config import FilterConfig
from ekfslam.filters import gates
from ekfslam.filters.landmarks import LandmarkTable
from ekfslam.filters.reports import FrameReport, log_density, missed
from ekfslam.filters.result import Landmarks
from ekfslam.models.observation import initialise, linearise
from ekfslam.models.sensors.base import ACCEPTED, BEHIND_CAMERA, GATE, Sensor


class IndependentLandmarks:
    """Independent EKF updates of all landmarks of a frame in one batch, given the exact poses (T, 4, 4)."""

    def __init__(self, sensor: Sensor, config: FilterConfig, T_imu_world: Array) -> None:
        self.sensor, self.config, self._poses = sensor, config, T_imu_world
        self.table = LandmarkTable(sensor.dimension, extra=9)
        self._gate = gates.threshold(config.gate_probability, sensor.dimension)
        self._split: list[Landmarks] = []

    def update(self, frame: int, ids: IntArray, measured: Array) -> FrameReport:
        """Correct known landmarks, split tracks that jumped, start new ones; see `JointEKF.update`."""
        table, T = self.table, self._poses[frame]
        rows = self.sensor.rows(measured)
        reason = self.sensor.screen(measured, self.config.min_depth_m)
        slot, is_known = table.lookup(ids)
        known = np.flatnonzero(is_known & (reason == ACCEPTED))
        position = table.position_m[slot[known]]
        q, _, H = linearise(self.sensor, T, position, T, position)
        in_front = self.sensor.in_view(q, self.config.min_depth_m)
        reason[known[~in_front]] = BEHIND_CAMERA
        known, q, H = known[in_front], q[in_front], H[in_front]

        residual = rows[known] - self.sensor.predict(q)
        HP = H @ self.table.extra[slot[known]].reshape(-1, 3, 3)
        S = HP @ np.swapaxes(H, -1, -2) + gates.diagonal(self.sensor.variance(rows[known]))
        squares = gates.normalised_squares(S, residual, frame, ids[known])
        inside = squares <= self._gate
        reason[known[~inside]] = GATE
        self._condition(slot[known[inside]], S[inside], HP[inside], residual[inside])

        table.accepted(slot[known[inside]], frame)
        table.misses[slot[is_known & missed(reason)]] += 1
        split_after = self.config.misses_to_split(tracks_walk=False)
        split = self._retire((table.misses >= split_after) & (split_after > 0))
        new = ~is_known & (reason == ACCEPTED)
        if len(split):
            new |= np.isin(ids, split)
            reason[new] = ACCEPTED
        if new.any():
            self._start(frame, ids[new], rows[new])
        nis, dof = float(squares[inside].sum()), int(residual[inside].size)
        likelihood = log_density(nis, np.linalg.slogdet(S[inside])[1].sum(), dof)
        return FrameReport(frame, ids, reason, nis, dof, split, likelihood)

    @property
    def covariance(self) -> Array:
        """(n, 3, 3) of the landmarks in the table, a copy."""
        return self.table.extra.reshape(-1, 3, 3)

    def _condition(self, slot: IntArray, S: Array, HP: Array, residual: Array) -> None:
        gain = np.swapaxes(np.linalg.solve(S, HP), -1, -2)
        self.table.position_m[slot] += (gain @ residual[..., None])[..., 0]
        P = self.table.extra[slot].reshape(-1, 3, 3) - gain @ HP
        self.table.extra[slot] = 0.5 * (P + np.swapaxes(P, -1, -2)).reshape(-1, 9)

    def _start(self, frame: int, ids: IntArray, rows: Array) -> None:
        T = self._poses[frame]
        positions, _, covariance = initialise(self.sensor, T, rows, self.sensor.variance(rows), T)
        at = np.full(len(ids), frame)
        self.table.append(
            id=ids,
            first_frame=at,
            last_frame=at,
            observations=at * 0 + 1,
            position_m=positions,
            initial_m=positions,
            extra=covariance.reshape(-1, 9),
        )

    def _retire(self, gone: BoolArray) -> IntArray:
        """Move landmarks (n,) that are gone out of the table, and return their ids, ascending."""
        slot = np.flatnonzero(gone)
        slot = slot[np.argsort(self.table.id[slot])]
        ids = self.table.id[slot]
        if len(slot):
            self._split.append(self.table.snapshot(slot, self.covariance[slot]))
            self.table.keep(~gone)
        return ids

    def landmarks(self) -> Landmarks:
        """Return the landmarks that were split off, then the others in the order of their ids."""
        slot = np.argsort(self.table.id)
        return Landmarks.concatenate([*self._split, self.table.snapshot(slot, self.covariance[slot])])
