"""The joint EKF over state blocks and all active landmarks, with full cross-covariance.

A frame is a fixed number of NumPy calls; nothing is as wide as the state but P itself and the rows ``H P``.
"""

from __future__ import annotations

from collections.abc import Sequence as SequenceType
from copy import copy

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.config import CalibrationConfig, FilterConfig
from ekfslam.data.interval import Interval
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
from ekfslam.models.model import Model, Transition
from ekfslam.models.process import Measured
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
        self._moving_ids: set[int] = set()
        delayed = model.sensor if isinstance(model.sensor, DelayedSensor) else None
        self._waiting = None if delayed is None else Waiting(delayed, config.gate_probability)
        self._log_likelihood = 0.0  # of the velocities measured since the last frame

    def begin(self, inputs: Array) -> None:
        """Take the inputs (c,) at the first frame, to which no prediction leads; only a time offset needs them."""
        self.imu_twist = self.model.process.begin(self.values, np.asarray(inputs, dtype=float))
        self._log.amend(imu_twist=self.imu_twist, seen_twist=self.imu_twist)

    def predict(
        self, inputs: Interval | Array, tau_s: float = 0.0, also: Measured | None = None, is_gap: bool = False
    ) -> None:
        """Eq. (1) and (2) over one interval.

        Args:
            inputs: The interval; or one velocity (6,) ``[v; w]``, m/s and rad/s, that holds during it.
            tau_s: Duration, for one velocity.
            also: Measurements by further sensors during the interval, if the velocity is in the state.
            is_gap: Whether the one velocity was interpolated across a gap.

        Raises:
            ConfigError: Measurements by further sensors of a velocity that is not in the state.
        """
        model, process = self.model, self.model.process
        interval = inputs if isinstance(inputs, Interval) else Interval.of_one(inputs, tau_s, is_gap)
        self.way_m = process.way_m(self.values, interval)
        moved = model.wander(self.values, interval.tau_s, self.way_m)
        self.coordinates = self.coordinates.copy()  # the log has those after the update
        if moved is not None:
            self.coordinates, self.values = moved.Phi @ self.coordinates, moved.values
        if process.estimates_velocity:
            moved = self._measure(moved, interval, also)
        elif also is not None:
            raise ConfigError("velocities of further sensors need the twist in the state: set twist_walk_std")
        step = model.step(self.values, interval, self.linear_T_imu_world, self.variant.first_estimates)
        whole = step if moved is None else step.after(moved)
        self.gaussian.propagate(whole.Phi, whole.Q)
        departed, self.T_departed = self.coordinates, self.T_imu_world
        self.coordinates, self.values = model.coordinates_after(step, departed), step.values
        self.T_predicted_before, self.T_predicted = self.T_predicted, self.T_imu_world
        self.updated_pose = "previous_pose" if self.updated_pose == "pose" and model.has_clone else None
        self.imu_twist_before, self.imu_twist, self.tau_s = self.imu_twist, step.imu_twist, interval.tau_s
        self.step += 1
        self._log.predicted(self, interval, departed)

    def _measure(self, moved: Transition | None, interval: Interval, also: Measured | None) -> Transition | None:
        """Condition on measurements of blocks by the inputs; the first inputs start blocks instead.

        Returns:
            What the covariance has not followed yet of the transition so far.
        """
        model, is_first = self.model, self.step == 0
        own = model.process.measured(interval, is_first)
        rows = [some for some in (own, also) if some is not None]
        if rows:
            self._log.measured(Measured.concatenate(rows))
        if is_first and (start := model.process.start(self.values, interval)) is not None:
            begun = model.widened(self.values, start)
            moved = begun if moved is None else begun.after(moved)
            self.values = moved.values
            for name, value in start.values.items():
                self.coordinates[model.layout[name]] = value
            rows = [] if also is None else [also]
        if not rows:
            return moved
        if moved is not None:
            self.gaussian.propagate(moved.Phi, moved.Q)
        measured = Measured.concatenate(rows)
        H = model.process.jacobian(measured)
        residual = measured.value - H @ self.coordinates
        solution = self.gaussian.solve_body(H, residual, measured.std**2, self.step + 1)
        self.gaussian.apply(solution)
        done = solution.done
        self._log_likelihood += log_density(done.nis, done.log_det, len(residual))
        self.retract(done.correction)
        return None

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
