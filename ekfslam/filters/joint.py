"""The joint EKF over state blocks and all active landmarks, with full cross-covariance.

A frame is a fixed number of NumPy calls; nothing is as wide as the state but P itself and the rows ``H P``.
"""

from __future__ import annotations

from collections.abc import Sequence as SequenceType
from copy import copy

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.config import CalibrationConfig, FilterConfig
from ekfslam.errors import ConfigError
from ekfslam.filters import lifecycle
from ekfslam.filters.correction import correct
from ekfslam.filters.dense import DenseGaussian
from ekfslam.filters.estimate import Estimate
from ekfslam.filters.landmarks import LandmarkTable
from ekfslam.filters.lifecycle import Retired, Revival
from ekfslam.filters.log import Log
from ekfslam.filters.logbook import LogBook
from ekfslam.filters.reports import FrameReport, log_density, missed
from ekfslam.filters.result import Landmarks, Parameters
from ekfslam.filters.starting import start
from ekfslam.filters.variants import is_frozen_exactly
from ekfslam.filters.waiting import Waiting
from ekfslam.geometry import se3
from ekfslam.models.blocks import StateBlock
from ekfslam.models.build import model_of
from ekfslam.models.model import Model, VelocityRows
from ekfslam.models.sensors.base import ACCEPTED, DISPARITY, MOVING, WAITING, DelayedSensor, Sensor


class JointEKF(Estimate):
    """Joint EKF-SLAM: call `predict`, then `update`, once a frame.

    Args:
        sensor: What observes the landmarks, with its noise; or a whole model, and then nothing of what follows but
            ``config`` and ``revival``.
        config: Variant, gate, limits, retirement (``auto`` must have been resolved; it counts as ``unseen``).
        T_world_imu: (4, 4) first pose.
        covariance: (6, 6) of its error ``xi``; by default that of the configuration.
        calibration: What of the sensor's calibration is estimated (a `Rig` only); by default nothing. With a time
            offset, call `begin` before the first `update`.
        blocks: Further state blocks.
        revival: What brings retired landmarks back; None: they start afresh.

    Raises:
        ConfigError: A calibration to estimate, but no `Rig`; or neither a model nor a first pose.

    Attributes:
        retired: Landmarks that have left the state.
    """

    def __init__(
        self,
        sensor: Sensor | Model,
        config: FilterConfig,
        T_world_imu: Array | None = None,
        covariance: Array | None = None,
        calibration: CalibrationConfig | None = None,
        *,
        blocks: SequenceType[StateBlock] = (),
        revival: Revival | None = None,
    ) -> None:
        if isinstance(sensor, Model):
            model = sensor
        elif T_world_imu is None:
            raise ConfigError("a filter of a sensor needs a first pose")
        else:
            P_pose = config.initial_covariance if covariance is None else np.array(covariance, dtype=float)
            coordinates = config.landmark_coordinates
            model = model_of(sensor, sensor.noise, se3.inverse(T_world_imu), P_pose, calibration, blocks, coordinates)
        super().__init__(model, config)
        self.revival, self.retired = revival, Retired()
        self._log = LogBook(self)
        self._reported: list[Array] = []  # estimates and standard deviations (2, p) after each frame
        self._is_twist_known = False
        self._moving_ids: set[int] = set()
        delayed = model.sensor if isinstance(model.sensor, DelayedSensor) else None
        self._waiting = None if delayed is None else Waiting(delayed, config.gate_probability)
        self._log_likelihood = 0.0  # of the velocities measured since the last frame

    def begin(self, twist: Array) -> None:
        """Velocities (6,) at the first frame, which no prediction leads to; only a time offset asks for them."""
        values = {**self.values, "twist": twist}
        self.imu_twist, _ = self.model.imu_velocities(values, twist, self.T_imu_world[:3, :3])
        self._log.amend(imu_twist=self.imu_twist, seen_twist=self.imu_twist)

    def predict(self, twist: Array, tau_s: float, also: VelocityRows | None = None, is_gap: bool = False) -> None:
        """Eq. (1) and (2) over one interval.

        Args:
            twist: (6,) measured velocities, m/s and rad/s.
            tau_s: Duration.
            also: What further sensors measured of these velocities, where they are in the state.
            is_gap: Whether the velocities were interpolated across a gap, so that they are worth less.
        """
        model, pose = self.model, self.model.layout["pose"]
        self.way_m = model.way_m(np.asarray(twist, dtype=float), tau_s)
        self.coordinates = self.coordinates.copy()  # the log has those after the update
        self._wander(tau_s)
        if model.has_twist:
            self._measure_velocities(twist, also)
        elif also is not None:
            raise ConfigError("velocities of further sensors need the twist in the state: set twist_walk_std")
        step = model.step(self.values, twist, tau_s, self.linear_T_imu_world, self.variant.first_estimates, is_gap)
        self.gaussian.propagate(step.Phi, step.Q)
        departed = self.coordinates
        self.coordinates = departed.copy()
        self.coordinates[pose] = 0.0
        self.T_departed, self.values = self.T_imu_world, {**self.values, "pose": step.T_imu_world}
        if model.has_clone:
            self.values["previous_pose"] = self.T_departed
            self.coordinates[model.layout["previous_pose"]] = departed[pose]
        self.T_predicted_before, self.T_predicted = self.T_predicted, step.T_imu_world
        self.updated_pose = "previous_pose" if self.updated_pose == "pose" and model.has_clone else None
        self.imu_twist_before, self.imu_twist, self.tau_s = self.imu_twist, step.twist, tau_s
        self.step += 1
        self._log.predicted(self, twist, departed, is_gap)

    def _wander(self, tau_s: float) -> None:
        """Clones of shared blocks take their values; blocks that change by themselves, ``x+ = phi x + w``, do so."""
        model, layout, values = self.model, self.model.layout, dict(self.values)
        Phi, Q = np.eye(layout.body), np.zeros((layout.body, layout.body))
        for clone, name in model.clones:
            at, of = layout[clone], layout[name]
            Phi[at, at], Phi[at, of] = 0.0, np.eye(at.stop - at.start)
            self.coordinates[at], values[clone] = self.coordinates[of], values[name]
        for block in model.wandering:
            moves = block.transition(tau_s, self.way_m)
            # Velocities that nothing has measured yet are not there to change.
            if moves is not None and (block.name != "twist" or self._is_twist_known):
                at, (phi, std) = layout[block.name], moves
                Phi[at, at], Q[at, at] = np.diag(phi), np.diag(std**2)
                self.coordinates[at] *= phi
                values[block.name] = phi * values[block.name]
        self.values = values
        if model.clones or model.wandering:
            self.gaussian.propagate(Phi, Q)

    def _measure_velocities(self, twist: Array, also: VelocityRows | None) -> None:
        """Condition on velocity measurements; the first one of the IMU starts the twist."""
        model, std = self.model, self.model.noise.twist_std
        is_used = model.measures_twist or not self._is_twist_known
        rows = [*([VelocityRows.of_imu(twist, std)] if is_used else []), *([] if also is None else [also])]
        if rows:
            self._log.measured(VelocityRows.concatenate(rows))
        if not self._is_twist_known:
            self.gaussian.propagate(*model.twist_from_measurement(std))
            self.values = {**self.values, "twist": model.unbiased(np.asarray(twist, dtype=float), self.values)}
            self.coordinates[model.layout["twist"]] = self.values["twist"]
            self._is_twist_known, rows = True, rows[1:]
        if rows:
            measured = VelocityRows.concatenate(rows)
            H = model.velocity_jacobian(measured)
            residual = measured.value - H @ self.coordinates
            solution = self.gaussian.solve_body(H, residual, measured.std**2, self.step + 1)
            self.gaussian.apply(solution)
            done = solution.done
            self._log_likelihood += log_density(done.nis, done.log_det, len(residual))
            self.retract(done.correction)

    def update(self, frame: int, ids: IntArray, measured: Array) -> FrameReport:
        """Retire what is out of view, correct with what is known (6), start what is new (5).

        Args:
            frame: Frame index.
            ids: (n,) landmark ids seen, distinct.
            measured: (n, 4) their pixels (uL, vL, uR, vR), or what else the sensor measures.

        Returns:
            What became of each observation, and the innovation statistics.

        Raises:
            InnovationError: The innovation covariance is not positive definite.
        """
        # 1. Landmarks out of view leave, those that come back return.
        self._rest(frame, ids)
        if self.revival is not None and (returning := self.retired.among(ids)):
            self._revive(frame, returning)
        # 2. What cannot be used at all.
        rows = self.sensor.rows(measured)
        reason = self.sensor.screen(measured, self.config.min_depth_m)
        if known_to_move := self._moving_ids.intersection(ids.tolist()):
            reason[np.isin(ids, list(known_to_move))] = MOVING
        # 3. Correct with known landmarks, eq. (6) and (7).
        slot, is_known = self.table.lookup(ids)
        known = np.flatnonzero(is_known & (reason == ACCEPTED))
        found = correct(self, frame, slot[known], rows[known])
        self._log.corrected(self, found)
        self.table.observed(found.slot, self.step, found.measured, self._log.last(len(found.slot)))
        self.retract(found.done.correction)
        self.updated_pose = "pose" if found.dof else self.updated_pose
        reason[known] = found.verdict
        self.table.accepted(found.slot, frame)
        self.table.misses[slot[known[missed(found.verdict)]]] += 1
        # 4. Tracks that move go for good, tracks that jumped start anew.
        split = self._split(slot[known[found.verdict == MOVING]])
        new = (~is_known & (reason == ACCEPTED)) | np.isin(ids, split)
        reason[new] = ACCEPTED
        self._log.amend(T_updated=self.T_imu_world, updated=self.coordinates)
        # 5. Start new landmarks, eq. (5), or let them wait.
        started = start(self, self._log, self._waiting, frame, ids[new], rows[new])
        if not found.dof:  # nothing has updated the pose; yet where all that are awake are new, they have images here
            first_step = self.table.first_step[self.table.asleep == 0]
            self.updated_pose = "pose" if len(first_step) and (first_step == self.step).all() else None
        self.retired.start_afresh(ids[new][started])
        reason[np.flatnonzero(new)[~started]] = DISPARITY if self._waiting is None else WAITING
        self._reported.append(self.model.reported(self.values, self.gaussian.body_covariance))
        likelihood = self._log_likelihood + log_density(found.done.nis, found.done.log_det, found.dof)
        self._log_likelihood = 0.0
        return FrameReport(frame, ids, reason, found.done.nis, found.dof, split, likelihood, found.innovations)

    def _rest(self, frame: int, ids: IntArray) -> None:
        """Of landmarks out of view some sleep, and the others retire."""
        out = lifecycle.out_of_view(self.table, ids, frame, self.config.retire_after or 1)
        limit = None if self.config.retire == "never" else self.config.dormant or 0
        asleep = lifecycle.at_rest(out, self.table, limit)
        stay = ~out | asleep
        self._retire(~stay, may_return=True)
        self.table.asleep[:] = asleep[stay]
        self.gaussian.rest(asleep[stay])

    def _retire(self, gone: BoolArray, may_return: bool = False) -> None:
        """Marginalise landmarks (n,): drop their rows and columns, keep their last estimate."""
        if gone.any():
            self.retired.add(self.table, self.gaussian.landmark_blocks(np.flatnonzero(gone)), gone, may_return)
            self.gaussian.marginalise(~gone)
            self.table.keep(~gone)

    def _split(self, moving: IntArray) -> IntArray:
        """Retire the landmarks at the slots that move, for good, and those that missed too often in a row.

        Returns:
            Ids of the latter, which are then free to start anew.
        """
        moves = np.zeros(len(self.ids), dtype=bool)
        moves[moving] = True
        split_after = self.config.misses_to_split(self.model.track_error is not None)
        jumped = (self.table.misses >= split_after) & (split_after > 0) & ~moves
        ids = self.ids[jumped]
        self._moving_ids.update(self.ids[moves].tolist())
        self._retire(jumped | moves)
        return ids

    def _revive(self, frame: int, ids: list[int]) -> None:
        """Bring retired landmarks back, and with them the neighbours that will probably be seen next.

        Blocks, active and returning landmarks take the marginal of the batch problem behind.
        """
        assert self.revival is not None
        log, known = self._log.log(), self.landmarks()
        self.retired.fetch(self.table, known, log, ids, self.revival, frame)
        found = self.revival.marginal(log, known.position_m, self.table.log_row)
        self.values, self.table.position_m = {**self.values, **found.values}, found.position_m
        self.gaussian.start_over(found.P)
        self.coordinates[found.columns] = found.coordinates
        if self.variant.first_estimates and not is_frozen_exactly(self.config):
            # All rows are linearised again: these are the first estimates from now on.
            self.table.initial_m, self.T_predicted = found.position_m, self.values["pose"]
            self.T_predicted_before = self.values["previous_pose"]

    def landmarks(self) -> Landmarks:
        """Every landmark so far, in the order of landmark initialisation, which is that of the log."""
        return self.retired.all_landmarks(self.table, self.gaussian.landmark_blocks())

    def log(self) -> Log:
        """What the filter has conditioned on so far, for the posterior over all poses and landmarks."""
        return self._log.log()

    def parameters(self) -> Parameters | None:
        """What is estimated besides poses and landmarks and has labels, after each frame; None: nothing."""
        name, unit, prior_std = self.model.labels
        if not name:
            return None
        value, std = np.array(self._reported).transpose(1, 0, 2)
        return Parameters(name, unit, prior_std, value, std)

    @property
    def counts(self) -> dict[str, int]:
        """Totals: landmarks retired, those seen again that came back or started afresh, and tracks found to move."""
        return {
            "retired": len(self.retired),
            "revived": len(self.retired.revived),
            "reappeared": len(self.retired.reappeared),
            "moving": len(self._moving_ids),
        }


def without_landmarks(ekf: JointEKF) -> JointEKF:
    """The state blocks of a filter as a filter of their own, with an empty log: to look ahead with `predict`."""
    alone, body = copy(ekf), ekf.model.layout.body
    alone.gaussian = DenseGaussian(ekf.gaussian.body_covariance[:body, :body].copy(), ekf.model.layout.seen)
    alone.table, alone.retired = LandmarkTable(ekf.sensor.dimension), Retired()
    alone._log, alone._reported, alone._moving_ids = LogBook(alone), [], set()
    return alone
