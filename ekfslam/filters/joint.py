"""The joint EKF over state blocks and all active landmarks, with full cross-covariance.

`predict` is eq. (1) and (2), `update` is (3) to (7) and (10): one page in `ekfslam.filters.frame`. The equations are in
the modules `prediction` (1, 2), `observing` (3, 4, 10), `correction` (6), `retraction` (7, 7') and `starting` (5).
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as SequenceType
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import cast

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.config import CalibrationConfig, FilterConfig
from ekfslam.data.checks import checked_pose
from ekfslam.data.interval import Interval
from ekfslam.errors import ConfigError
from ekfslam.filters import compiled
from ekfslam.filters import frame as frames
from ekfslam.filters.door import (
    checked_covariance,
    checked_frame,
    checked_inputs,
    checked_interval,
    checked_numbers,
    checked_observations,
    require_measured,
)
from ekfslam.filters.estimate import Estimate
from ekfslam.filters.lifecycle import Marginal, Relinearised, Retired, Revival
from ekfslam.filters.log import Log
from ekfslam.filters.logbook import LogBook
from ekfslam.filters.observing import look, look_again
from ekfslam.filters.prediction import predict
from ekfslam.filters.reports import FrameReport, log_density
from ekfslam.filters.result import Landmarks, Parameters
from ekfslam.filters.standing import Stillness
from ekfslam.filters.starting import Waiting
from ekfslam.filters.undo import OneAtATime, all_or_nothing
from ekfslam.filters.variants import is_frozen_exactly
from ekfslam.geometry import se3
from ekfslam.models.blocks import PreviousView, StateBlock
from ekfslam.models.build import model_of
from ekfslam.models.model import Model
from ekfslam.models.process import Measured
from ekfslam.models.sensors.base import DelayedSensor, Sensor


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
        window: Maker of the relinearised window for ``config.lag``, `ekfslam.smoother.fixed_lag.FixedLag`.

    Raises:
        ConfigError: A calibration to estimate, but no `Rig`; neither a model nor a first pose; or a ``config.lag``
            without ``window``.
        DataError: The first pose is not rigid, or its covariance not symmetric and positive semi-definite.

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
            P_pose = (
                config.initial_covariance if covariance is None else checked_covariance(covariance, 6, "covariance")
            )
            checked_pose(checked_numbers(T_world_imu, "T_world_imu"), "T_world_imu")
            coordinates = config.landmark_coordinates
            model = model_of(sensor, sensor.noise, se3.inverse(T_world_imu), P_pose, calibration, blocks, coordinates)
        super().__init__(model, config)
        if config.lag and window is None:
            raise ConfigError("filter.lag needs a window: JointEKF(..., window=ekfslam.smoother.fixed_lag.FixedLag)")
        self._in_use = OneAtATime()
        self.window = window(model, config) if config.lag and window else None
        self._look_again()
        self.revival, self.retired, self._revived = revival, Retired(), False
        self._log = LogBook(self)
        self._reported: list[Array] = []  # estimates and standard deviations (2, p) after each frame
        delayed = model.sensor if isinstance(model.sensor, DelayedSensor) else None
        self._waiting = None if delayed is None else Waiting(delayed, config.gate_probability)
        self._stillness, self._at_rest = Stillness(), cast(Measured | None, None)  # rows for the next prediction
        self._log_likelihood, self._doubt = 0.0, 1.0  # of the velocities measured since the last frame

    def begin(self, inputs: Array) -> None:
        """Take the inputs (c,) at the first frame, for a time offset, eq. (9); no prediction leads to this frame."""
        self.imu_twist = self.model.process.begin(self.values, checked_inputs(inputs, 6, "inputs"))
        self._look_again()
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
            DataError: Inputs are no finite real numbers, or time does not increase.
            FilterError: Another thread uses the filter.

        An error leaves the filter as it was.
        """
        interval = checked_interval(inputs, tau_s, is_gap)
        require_measured(also)
        is_python = (
            also is not None or self._at_rest is not None or (self.engine is not None and not self.engine.predicts)
        )
        with self._in_use, self._all_or_nothing(is_python):
            found = predict(self, interval, also, self._at_rest)
            self._at_rest = None
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
            DataError: Arguments have another shape or kind, or are not finite.
            FilterError: Another thread uses the filter.

        An error leaves the filter as it was.
        """
        frame, (ids, measured) = checked_frame(frame), checked_observations(self.sensor, ids, measured)
        with self._in_use:
            returning = [] if self.revival is None else self.retired.among(ids)
            with self._all_or_nothing(bool(returning) or self.window is not None):
                return self._update(frame, ids, measured, returning)

    def _all_or_nothing(self, changes_engine: bool) -> AbstractContextManager[None]:
        return all_or_nothing(
            self, self._log, self.retired, (self.window, self._waiting, self._stillness), changes_engine
        )

    def _update(self, frame: int, ids: IntArray, measured: Array, returning: list[int]) -> FrameReport:
        # 1. Retire landmarks out of view, revive those that come back; correct with known landmarks, start new ones.
        if (engine := self.engine) is None:
            frames.rest(self, self.retired, frame, ids)
            self._revive(frame, returning)
            found = frames.update(self, self._log, self.retired, self._waiting, frame, ids, measured)
        else:
            if returning:
                compiled.rest(self, engine, self.retired, frame, ids)
                self._revive(frame, returning)
            found = compiled.update(self, engine, self._log, self.retired, frame, ids, measured, bool(returning))
        # 2. Linearise the last frames again.
        if self.window is not None and self.step:
            self._relinearise(self.window)
        likelihood = self._log_likelihood + log_density(found.nis, found.log_det, found.dof)
        self._log_likelihood = 0.0
        # 3. A rig that stands has no velocity.
        standing = self._stillness.judge(self, ids, measured)
        self._at_rest = None if standing is None else standing.measured
        is_standing = None if standing is None else standing.measured is not None
        doubt = max(self._doubt, self.motion.interval.doubt)
        self._reported.append(self.model.reported(self.values, self.gaussian.body_covariance))
        outcome = frame, ids, found.reason, found.nis, found.dof, found.split, likelihood, found.innovations
        return FrameReport(*outcome, doubt, is_standing)

    def _revive(self, frame: int, ids: list[int]) -> None:
        """Bring retired landmarks and their neighbours back: the state becomes the marginal of the batch problem."""
        if self.revival is None or not ids:
            return
        log, known = self._log.log(), self.landmarks()
        count = len(self.table)
        self.retired.fetch(self.table, known, log, ids, self.revival, frame)
        if self.engine is not None:
            self.engine.revive(self.table.columns(count))
        self._adopt(self.revival.marginal(log, known.position_m, self.table.log_row))
        self._revived = True
        if self.variant.first_estimates and not is_frozen_exactly(self.config):
            # All rows are linearised again: these are the first estimates from now on.
            self.table.initial_m = self.positions_m
            before = self.values.get(PreviousView.name, self.motion.W_predicted_before)
            self.motion = replace(self.motion, T_predicted=self.T_imu_world, W_predicted_before=before)
            look(self)

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
        self.coordinates = self.coordinates.copy()  # the log has those before
        self.coordinates[found.columns] = found.coordinates
        if self.engine is None:
            self.gaussian.start_over(found.P)
            look_again(self)
        else:
            self.values, self.coordinates = self.engine.adopt(self.values, self.coordinates, found.position_m, found.P)

    def _look_again(self) -> None:
        """Set the view of the first frame, in the covariance, too."""
        if self.engine is None:
            look_again(self)
        else:
            self.values, self.coordinates = self.engine.look_again(self.imu_twist)

    def landmarks(self) -> Landmarks:
        """Return every landmark so far, in the order of landmark initialisation."""
        return self.retired.all_landmarks(self.table, self.gaussian.landmark_blocks())

    def log(self) -> Log:
        """Return the log so far, for the posterior over all poses and landmarks; `PosteriorError` if it was dropped."""
        return self._log.log()

    @property
    def needs_log(self) -> bool:
        """Whether the filter reads its own log: for a map revival or a relinearised window."""
        return self.revival is not None or self.window is not None

    def drop_log(self) -> None:
        """Drop the log, landmarks that have left, and parameters of past frames, so that memory stays bounded."""
        if self.needs_log:
            raise ConfigError("a filter with map revival or a relinearised window needs its log")
        self._log.drop()
        self.retired.drop()
        del self._reported[:]

    def parameters(self) -> Parameters | None:
        """Return the estimates of blocks with labels after each frame; None: there are none."""
        name, unit, prior_std = self.model.labels
        if not name:
            return None
        value, std = np.array(self._reported).reshape(-1, 2, len(name)).transpose(1, 0, 2)
        return Parameters(name, unit, prior_std, value, std)

    @property
    def counts(self) -> dict[str, int]:
        """Totals of landmarks: retired, revived, reappeared (initialised again), moving; and of given up windows."""
        return {**self.retired.counts, **({"windows given up": self.window.given_up} if self.window else {})}
