"""The joint EKF over state blocks and all active landmarks, with full cross-covariance.

A frame on one page: `predict` is eq. (1) and (2), `update` is (3) to (7) and (10). The equations are in the modules
`prediction` (1, 2), `observing` (3, 4, 10), `correction` (6), `retraction` (7, 7') and `starting` (5) of this package.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as SequenceType
from dataclasses import replace

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.config import CalibrationConfig, FilterConfig
from ekfslam.data.interval import Interval
from ekfslam.errors import ConfigError
from ekfslam.filters import consensus, lifecycle
from ekfslam.filters.correction import Correction
from ekfslam.filters.estimate import Estimate
from ekfslam.filters.lifecycle import Marginal, Relinearised, Retired, Revival
from ekfslam.filters.log import Log
from ekfslam.filters.logbook import LogBook
from ekfslam.filters.prediction import predict
from ekfslam.filters.reports import FrameReport, log_density, missed
from ekfslam.filters.result import Landmarks, Parameters
from ekfslam.filters.retraction import retract
from ekfslam.filters.starting import Waiting, start
from ekfslam.filters.variants import is_frozen_exactly
from ekfslam.geometry import se3
from ekfslam.models.blocks import StateBlock
from ekfslam.models.build import model_of
from ekfslam.models.model import Model
from ekfslam.models.process import Measured
from ekfslam.models.sensors.base import ACCEPTED, DISPARITY, MOVING, WAITING, DelayedSensor, Sensor


class JointEKF(Estimate):
    """Joint EKF-SLAM: call `predict`, then `update`, once a frame.

    Args:
        sensor: Sensor of the landmarks with its noise; or a whole model, with ``config`` and ``revival`` alone.
        config: Settings of the filter (resolved: retirement ``auto`` means ``unseen``).
        T_world_imu: (4, 4) first pose.
        covariance: (6, 6) of its error ``xi``; by default that of the configuration.
        calibration: Estimated calibration of a `Rig`; by default none. With a time offset, call `begin` before the
            first `update`.
        blocks: Further state blocks.
        revival: Source of returning landmarks; None: they are initialised again.
        window: Maker of the relinearised window for ``config.lag``, `ekfslam.smoother.fixed_lag.FixedLag`; None: no
            frame is linearised again.

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
        window: Callable[[Model, FilterConfig], Relinearised] | None = None,
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
        self.window = window(model, config) if config.lag and window is not None else None
        self.revival, self.retired, self._revived = revival, Retired(), False
        self._log = LogBook(self)
        self._reported: list[Array] = []  # estimates and standard deviations (2, p) after each frame
        delayed = model.sensor if isinstance(model.sensor, DelayedSensor) else None
        self._waiting = None if delayed is None else Waiting(delayed, config.gate_probability)
        self._log_likelihood, self._doubt = 0.0, 1.0  # of the velocities measured since the last frame

    def begin(self, inputs: Array) -> None:
        """Take the inputs (c,) at the first frame, for a time offset, eq. (9); no prediction leads to this frame."""
        self.imu_twist = self.model.process.begin(self.values, np.asarray(inputs, dtype=float))
        self._log.amend(seen_twist=self.imu_twist)

    def predict(
        self, inputs: Interval | Array, tau_s: float = 0.0, also: Measured | None = None, is_gap: bool = False
    ) -> None:
        """Predict over one interval, eq. (1) and (2).

        Args:
            inputs: The interval; or one velocity (6,) ``[v; w]``, m/s and rad/s, with ``tau_s`` and ``is_gap``.
            tau_s: Duration.
            also: Measurements by further sensors during the interval, if the velocity is in the state.
            is_gap: Whether the velocity was interpolated across a gap.

        Raises:
            ConfigError: Measurements by further sensors of a velocity that is not in the state.
        """
        interval = inputs if isinstance(inputs, Interval) else Interval.of_one(inputs, tau_s, is_gap)
        found = predict(self, interval, also)
        self._log_likelihood += found.log_likelihood
        self._doubt = found.doubt
        self._log.predicted(self, interval, found)

    def update(self, frame: int, ids: IntArray, measured: Array) -> FrameReport:
        """Retire landmarks out of view, correct with known ones (6), start new ones (5).

        Args:
            frame: Frame index.
            ids: (n,) landmark ids seen, distinct.
            measured: (n, 4) their pixels (uL, vL, uR, vR), or the measurements of another sensor.

        Returns:
            The outcome of each observation, and the innovation statistics.

        Raises:
            InnovationError: The innovation covariance is not positive definite.
        """
        # 1. Retire landmarks out of view, revive those that come back.
        self._rest(frame, ids)
        if self.revival is not None and (returning := self.retired.among(ids)):
            self._revive(frame, returning)
        # 2. Screen observations that cannot be used at all.
        rows = self.sensor.rows(measured)
        reason = self.sensor.screen(measured, self.config.min_depth_m)
        if known_to_move := self.retired.moving.intersection(ids.tolist()):
            reason[np.isin(ids, list(known_to_move))] = MOVING
        # 3. Correct with known landmarks: solve eq. (6) for rows (3), (4), (10), then apply (6), (7) and (7').
        slot, is_known = self.table.lookup(ids)
        known = np.flatnonzero(is_known & (reason == ACCEPTED))
        found = consensus.correct(self, frame, slot[known], rows[known])
        self._take(found, frame)
        reason[known] = found.verdict
        self.table.misses[slot[known[missed(found.verdict)]]] += 1
        # 4. Retire tracks that move for good, and start tracks that jumped again.
        split = self._split(slot[known[found.verdict == MOVING]])
        new = (~is_known & (reason == ACCEPTED)) | np.isin(ids, split)
        reason[new] = ACCEPTED
        self._log.amend(T_updated=self.T_imu_world, updated=self.coordinates)
        # 5. Start new landmarks, eq. (5), or let them wait.
        enter = start if self._waiting is None else self._waiting.start
        started = enter(self, self._log, frame, ids[new], rows[new])
        if not found.dof:  # no update; but if every active landmark is new, its image coordinates refer to this pose
            first_step = self.table.first_step[self.table.asleep == 0]
            self.updated_pose = "pose" if len(first_step) and (first_step == self.step).all() else None
        self.retired.start_again(ids[new][started])
        reason[np.flatnonzero(new)[~started]] = DISPARITY if self._waiting is None else WAITING
        # 6. Linearise the last frames again.
        if self.window is not None and self.step:
            self._relinearise(self.window)
        return self._report(frame, ids, reason, split, found)

    def _take(self, found: Correction, frame: int) -> None:
        """Condition the covariance, eq. (6), and the mean, eq. (7), on a correction; count its observations."""
        if found.gaussian is not None:
            self.gaussian = found.gaussian
            self.motion = self.motion.doubted(found.doubt)
        self._log.corrected(self, found)
        self.table.observed(found.slot, self.step, found.measured, self._log.last(len(found.slot)))
        if found.solution is not None:
            self.gaussian.apply(found.solution)
        self.imu_twist = found.linear.imu_twist
        retract(self, found.done.correction)
        self.updated_pose = "pose" if found.dof else self.updated_pose
        self.table.accepted(found.slot, frame)

    def _report(self, frame: int, ids: IntArray, reason: IntArray, split: IntArray, found: Correction) -> FrameReport:
        """Return the report on a frame, and keep the estimates of blocks with labels."""
        self._reported.append(self.model.reported(self.values, self.gaussian.body_covariance))
        done = found.done
        likelihood = self._log_likelihood + log_density(done.nis, done.log_det, found.dof)
        self._log_likelihood = 0.0
        doubt = max(self._doubt, self.motion.interval.doubt)
        return FrameReport(frame, ids, reason, done.nis, found.dof, split, likelihood, found.innovations, doubt)

    def _rest(self, frame: int, ids: IntArray) -> None:
        """Let landmarks out of view sleep or retire."""
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
        """Retire landmarks at slots that move, for good, and those that missed too often; return ids of the latter."""
        moves = np.zeros(len(self.ids), dtype=bool)
        moves[moving] = True
        split_after = self.config.misses_to_split(self.model.track_error is not None)
        jumped = (self.table.misses >= split_after) & (split_after > 0) & ~moves
        ids = self.ids[jumped]
        self.retired.moving.update(self.ids[moves].tolist())
        self._retire(jumped | moves)
        return ids

    def _revive(self, frame: int, ids: list[int]) -> None:
        """Bring retired landmarks and their neighbours back: the state becomes the marginal of the batch problem."""
        assert self.revival is not None
        log, known = self._log.log(), self.landmarks()
        self.retired.fetch(self.table, known, log, ids, self.revival, frame)
        self._adopt(self.revival.marginal(log, known.position_m, self.table.log_row))
        self._revived = True
        if self.variant.first_estimates and not is_frozen_exactly(self.config):
            # All rows are linearised again: these are the first estimates from now on.
            self.table.initial_m = self.positions_m
            clone = self.values[self.model.layout.clones["pose"]]
            self.motion = replace(self.motion, T_predicted=self.T_imu_world, T_predicted_before=clone)

    def _relinearise(self, window: Relinearised) -> None:
        """Linearise the last frames again; after a map revival, they begin here."""
        if self._revived:
            self._revived = False
            window.start_over(self)
            return
        known = np.concatenate([window.landmarks, self.table.log_row])
        log, rows = self._log.since(window.first, window.observed, known)
        if (found := window.marginal(self, log, rows)) is not None:
            self._adopt(found)
            self._log.amend(T_updated=self.T_imu_world, updated=self.coordinates.copy())

    def _adopt(self, found: Marginal) -> None:
        """Replace mean and covariance of blocks and active landmarks."""
        self.values, self.table.position_m = {**self.values, **found.values}, found.position_m
        self.gaussian.start_over(found.P)
        self.coordinates = self.coordinates.copy()  # the log has those before
        self.coordinates[found.columns] = found.coordinates

    def landmarks(self) -> Landmarks:
        """Return every landmark so far, in the order of landmark initialisation."""
        return self.retired.all_landmarks(self.table, self.gaussian.landmark_blocks())

    def log(self) -> Log:
        """Return the log so far, for the posterior over all poses and landmarks."""
        return self._log.log()

    def parameters(self) -> Parameters | None:
        """Return the estimates of blocks with labels after each frame; None: there are none."""
        name, unit, prior_std = self.model.labels
        if not name:
            return None
        value, std = np.array(self._reported).transpose(1, 0, 2)
        return Parameters(name, unit, prior_std, value, std)

    @property
    def counts(self) -> dict[str, int]:
        """Totals of landmarks: retired, revived, reappeared (initialised again), moving; and of given up windows."""
        return {**self.retired.counts, **({"windows given up": self.window.given_up} if self.window else {})}
