"""The joint EKF over state blocks and all active landmarks, with full cross-covariance.

Nothing here is as wide as the state but P itself and the rows ``H P``: measurement Jacobians stay at the columns of the
blocks that are seen and 3 columns a landmark, and a frame is a fixed number of NumPy calls.
"""

from __future__ import annotations

from collections.abc import Sequence as SequenceType

import numpy as np
import scipy.sparse as sp

from ekfslam.arrays import Array, IntArray
from ekfslam.config import CalibrationConfig, FilterConfig
from ekfslam.errors import ConfigError
from ekfslam.filters import gates, lifecycle
from ekfslam.filters.gaussian import Conditioned, Gaussian, Rows
from ekfslam.filters.landmarks import LandmarkTable
from ekfslam.filters.lifecycle import Retired, Revival
from ekfslam.filters.log import Log, LogBook
from ekfslam.filters.reports import FrameReport, log_density, missed
from ekfslam.filters.result import Landmarks, Parameters
from ekfslam.filters.variants import VARIANTS
from ekfslam.geometry import se3
from ekfslam.models.blocks import StateBlock
from ekfslam.models.build import model_of
from ekfslam.models.model import Model, Moment, Seen, VelocityRows
from ekfslam.models.sensors.base import ACCEPTED, BEHIND_CAMERA, GATE, MOVING, Sensor


class JointEKF:
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
        model: Blocks, sensor and noise.
        variant: What is the variant's own.
        values: Estimate of every state block by name.
        T_predicted: (4, 4) ``T_imu_world`` before the last update.
        table: The active landmarks, in the order of their blocks in P.
        retired: Those that have left the state.
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
            model = model_of(sensor, sensor.noise, se3.inverse(T_world_imu), P_pose, calibration, blocks)
        self.model, self.config, self.revival = model, config, revival
        self.variant = VARIANTS[config.variant]
        self.values = model.initial_values()
        self.table, self.retired = LandmarkTable(model.sensor.dimension), Retired()
        self.T_predicted = self._T_predicted_before = self.values["pose"]
        self._gaussian = Gaussian(model.prior_covariance, model.layout.seen)
        self._gate = gates.threshold(config.gate_probability, model.sensor.dimension)
        self._coordinates = np.zeros(model.layout.body)  # as in the log
        self._imu_twist = self._imu_twist_before = np.zeros(6)
        self._tau_s, self._is_twist_known = 0.0, False
        self._log = LogBook(
            self.variant.first_estimates,
            self._gaussian.P[:6, :6].copy(),
            self.T_predicted,
            self._coordinates,
            self.values.get("up", np.empty(0)),
            model.sensor.dimension,
        )
        self._reported: list[Array] = []  # estimates and standard deviations (2, p) after each frame
        self._moving_ids: set[int] = set()
        self._log_likelihood = 0.0  # of the velocities measured since the last frame

    # --- what it knows ------------------------------------------------------------------------------------------------

    @property
    def P(self) -> Array:
        """(b+3n, b+3n) covariance of the blocks, in the columns of ``model.layout``, and of ``(d_1, ..., d_n)``.

        ``T_imu_world = exp(xi^) T_hat``, ``m = m_hat + d``. The pose has the first six columns.
        """
        return self._gaussian.P

    @P.setter
    def P(self, P: Array) -> None:
        self._gaussian.replace(np.ascontiguousarray(P, dtype=float))

    @property
    def sensor(self) -> Sensor:
        """What observes the landmarks, with the calibration as given."""
        return self.model.sensor

    @property
    def T_imu_world(self) -> Array:
        """(4, 4) estimate of the report's inverse pose."""
        return self.values["pose"]

    @property
    def T_world_imu(self) -> Array:
        """(4, 4) estimated pose of the IMU."""
        return se3.inverse(self.T_imu_world)

    @property
    def ids(self) -> IntArray:
        """(n,) ids of the active landmarks, in the order of their blocks in P."""
        return self.table.id

    @property
    def positions_m(self) -> Array:
        """(n, 3) their positions in world."""
        return self.table.position_m

    @property
    def linear_positions_m(self) -> Array:
        """(n, 3) positions at which H is taken, eq. (4)."""
        return self.variant.linear(self.table.position_m, self.table.initial_m)

    def covariance_of(self, ids: IntArray) -> Array:
        """Joint covariance (b+3k, b+3k) of the blocks and of some active landmarks.

        Raises:
            KeyError: An id is not active.
        """
        slot, body = self._slots(ids), np.arange(self._gaussian.body)
        columns = np.concatenate([body, (len(body) + 3 * slot[:, None] + np.arange(3)).ravel()])
        return self.P[np.ix_(columns, columns)]

    # --- prediction ---------------------------------------------------------------------------------------------------

    def begin(self, twist: Array) -> None:
        """Velocities (6,) at the first frame, which no prediction leads to; only a time offset asks for them."""
        values = {**self.values, "twist": twist}
        self._imu_twist, _ = self.model.imu_velocities(values, twist, self.T_imu_world[:3, :3])
        self._log.amend(imu_twist=self._imu_twist, seen_twist=self._imu_twist)

    def predict(self, twist: Array, tau_s: float, also: VelocityRows | None = None) -> None:
        """Eq. (1) and (2) over one interval.

        Args:
            twist: (6,) measured velocities, m/s and rad/s.
            tau_s: Duration.
            also: What further sensors measured of these velocities, where they are in the state.
        """
        model, at = self.model, self.model.layout["pose"]
        for block in model.wandering:
            self._wander(block, tau_s)
        if model.has_twist:
            self._measure_velocities(twist, also)
        T_linear = self.variant.linear(self.T_imu_world, self.T_predicted)
        step = model.step(self.values, twist, tau_s, T_linear, self.variant.first_estimates)
        self._gaussian.propagate(step.Phi, step.Q)
        T_departed, departed = self.T_imu_world, self._coordinates.copy()
        self._coordinates[at] = 0.0
        self.values = {**self.values, "pose": step.T_imu_world}
        if model.has_clone:
            self.values["previous_pose"] = T_departed
            self._coordinates[model.layout["previous_pose"]] = departed[at]
        self._T_predicted_before, self.T_predicted = self.T_predicted, step.T_imu_world
        self._imu_twist_before, self._imu_twist = self._imu_twist, step.twist
        self._tau_s, self._T_departed = tau_s, T_departed
        self._log.predicted(
            twist,
            tau_s,
            step.twist,
            T_departed,
            step.T_imu_world,
            departed,
            self._coordinates.copy(),
            self.values.get("up", np.empty(0)),
        )

    def _wander(self, block: StateBlock, tau_s: float) -> None:
        """A block that changes by itself; velocities that nothing has measured yet are not there to change."""
        if block.name == "twist" and not self._is_twist_known:
            return
        moves = block.transition(tau_s)
        assert moves is not None
        at, (phi, std) = self.model.layout[block.name], moves
        self._gaussian.wander(at, phi, std)
        self._coordinates[at] *= phi
        self.values = {**self.values, block.name: phi * self.values[block.name]}

    def _measure_velocities(self, twist: Array, also: VelocityRows | None) -> None:
        """Condition on velocity measurements; the first one of the IMU starts the twist."""
        model, std = self.model, self.model.noise.twist_std
        rows = [VelocityRows.of_imu(twist, std)]
        self._log.measured(VelocityRows.concatenate(rows if also is None else [*rows, also]))
        if not self._is_twist_known:
            at = model.layout["twist"]
            Phi, Q = model.twist_from_measurement(std)
            self._gaussian.propagate(Phi, Q)
            self.values = {**self.values, "twist": model.unbiased(np.asarray(twist, dtype=float), self.values)}
            self._coordinates[at] = self.values["twist"]
            self._is_twist_known, rows = True, []
        if also is not None:
            rows.append(also)
        if rows:
            measured = VelocityRows.concatenate(rows)
            H = model.velocity_jacobian(measured)
            residual = measured.value - H @ self._coordinates
            done = self._gaussian.condition_body(H, residual, measured.std**2, self._log.step + 1)
            self._log_likelihood += log_density(done.nis, done.log_det, len(residual))
            self._retract(done.correction)

    # --- update -------------------------------------------------------------------------------------------------------

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
        if self.config.retire != "never":
            self._retire(lifecycle.out_of_view(self.table, ids, frame, self.config.retire_after or 1), may_return=True)
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
        slot = slot[known]
        done, dof, verdict = self._correct(frame, slot, rows[known])
        log_likelihood = self._log_likelihood + log_density(done.nis, done.log_det, dof)
        self._log_likelihood = 0.0
        reason[known] = verdict
        self.table.accepted(slot[verdict == ACCEPTED], frame)
        self.table.misses[slot[missed(verdict)]] += 1
        # 4. Tracks that move go for good, tracks that jumped start anew.
        split = self._split(slot[verdict == MOVING])
        new = (~is_known & (reason == ACCEPTED)) | np.isin(ids, split)
        reason[new] = ACCEPTED
        self._log.amend(T_updated=self.T_imu_world, updated=self._coordinates.copy())
        # 5. Start new landmarks, eq. (5).
        self._start(frame, ids[new], rows[new])
        self._reported.append(self._report())
        return FrameReport(frame, ids, reason, done.nis, dof, split, log_likelihood)

    def _moment(self) -> Moment:
        """From where landmarks are seen now."""
        T = self.T_imu_world
        return Moment(T, self.variant.linear(T, self.T_predicted), self.values.get("calibration"), self._imu_twist)

    def _moment_before(self) -> Moment:
        """From where they were seen in the frame before, as far as the clone knows."""
        T = self.values["previous_pose"]
        T_linear = self.variant.linear(T, self._T_predicted_before)
        return Moment(T, T_linear, self.values.get("calibration"), self._imu_twist_before)

    def _observe(self, slot: IntArray, measured: Array) -> tuple[Seen, Rows]:
        """Landmarks at the slots (k,) as they are seen now, and the measurement rows of what was ``measured`` (k, d).

        Where tracks err, eq. (10), an observation that follows another one is the difference from it.
        """
        positions, linear = self.table.position_m[slot], self.linear_positions_m[slot]
        seen = self.model.see(self._moment(), positions, linear)
        error, H_x, H_m, residual = self.model.track_error, seen.H_x, seen.H_m, measured - seen.z
        if error is None:
            return seen, Rows(slot, H_x, H_m, residual, self.sensor.variance(measured))
        variance = error.absolute_variance(self._log.step - self.table.first_step[slot])
        follows = np.flatnonzero(self.table.last_step[slot] == self._log.step - 1)
        if len(follows):
            before = self.model.see(self._moment_before(), positions[follows], linear[follows], clone=True)
            H_x, H_m = H_x.copy(), H_m.copy()
            residual[follows] -= error.memory * (self.table.seen_rows[slot[follows]] - before.z)
            H_x[follows] -= error.memory * before.H_x
            H_m[follows] -= error.memory * before.H_m
            variance[follows] = error.walk_std**2
        return seen, Rows(slot, H_x, H_m, residual, variance)

    def _correct(self, frame: int, slot: IntArray, measured: Array) -> tuple[Conditioned, int, IntArray]:
        """Eq. (6) with its gates and the variant's retraction, for landmarks at ``slot`` (k,) with rows (k, d).

        A landmark must agree with the prediction, and with the prediction as corrected by all *other* landmarks of the
        frame: the first gate is weak while the pose itself is uncertain, the second is not. What the second rejects has
        been used already, and is taken out again.

        Returns:
            NIS and ``log det S`` of what was accepted, its degrees of freedom, and the verdict (k,) on each landmark.
        """
        verdict = np.full(len(slot), ACCEPTED)
        seen, rows = self._observe(slot, measured)
        verdict[~self.sensor.in_view(seen.q, self.config.min_depth_m)] = BEHIND_CAMERA
        some = self._gate_alone(frame, rows, seen, verdict)
        if len(some) == 0:
            return Conditioned(np.zeros(len(self.P)), 0.0, 0.0), 0, verdict
        if self.model.has_time_offset and self._tau_s:
            self._imu_twist = self._seen_twist(frame, rows.only(some))
            self._log.amend(seen_twist=self._imu_twist)
            _, rows = self._observe(slot, measured)
        rows = rows.only(some)
        P_prior = self.P.copy() if self.config.iterations > 1 else None
        done = self._gaussian.condition(rows, frame, self.ids[rows.slot])
        if np.isfinite(self._gate):
            left = rows.corrected(*self._parts(done.correction))
            inside = gates.agrees_with_others(self._gaussian, left, self._gate, frame, self.ids[rows.slot])
            if not inside.all():
                verdict[some[~inside]] = GATE
                out = left.only(~inside)
                done = done - self._gaussian.condition(out, frame, self.ids[out.slot], sign=-1.0)
                rows = rows.only(inside)
        taken = verdict == ACCEPTED
        slot, measured = slot[taken], measured[taken]
        self._log.amend(linear=self._coordinates.copy())
        positions = self.table.position_m[slot]
        if P_prior is not None and taken.any():
            done, positions = self._iterate(frame, P_prior, done, slot, measured)
        self._record(slot, measured, rows.variance, positions)
        self._retract(done.correction)
        return done, int(rows.residual.size), verdict

    def _gate_alone(self, frame: int, rows: Rows, seen: Seen, verdict: IntArray) -> IntArray:
        """Which landmarks (j,) of the rows pass the gate by themselves; the verdict (k,) on the others is written."""
        some = np.flatnonzero(verdict == ACCEPTED)
        rows = rows.only(verdict == ACCEPTED)
        S = self._gaussian.variances(rows) + gates.diagonal(rows.variance)
        squares = gates.normalised_squares(S, rows.residual, frame, self.ids[rows.slot])
        inside = squares <= self._gate
        verdict[some[~inside]] = GATE
        if self.model.track_error is not None and self._tau_s:
            h = seen.H_m[some] @ (self.T_imu_world[:3, :3].T @ (self._imu_twist[:3] * self._tau_s))
            sigma = self.config.moving_sigma / self.model.noise.margin
            moving = gates.moves_along(
                self.table, rows, h, S, squares, self._gate, sigma, self.config.moving_share
            )
            verdict[some[moving]] = MOVING
            inside &= ~moving
        return some[inside]

    def _seen_twist(self, frame: int, rows: Rows) -> Array:
        """The velocities (6,) that led to this frame, as corrected by its observations.

        A time offset counts in proportion to them. With the measured ones, whose noise the innovations show, too, it
        would come out far too small.
        """
        xi, _ = self._parts(self._gaussian.correction(rows, frame, self.ids[rows.slot]))
        T = se3.exp(xi[:6]) @ self.T_imu_world
        return -se3.log(T @ se3.inverse(self._T_departed)) / self._tau_s

    def _iterate(
        self, frame: int, P_prior: Array, done: Conditioned, slot: IntArray, measured: Array
    ) -> tuple[Conditioned, Array]:
        """Gauss-Newton on eq. (6): linearise again at the corrected state, always from the same prior.

        Rows taken at the corrected state are carried back into the prior's coordinates by the variant's derivative
        D, ``H_k D_k``, and the residual becomes ``r_k + H_k D_k (xi, d)_k``. Source: Bell and Cathey, "The
        iterated Kalman filter update as a Gauss-Newton method", IEEE TAC 1993.

        Returns:
            The last correction, and the landmarks (k, 3) at which it was linearised.
        """
        values, positions, coordinates = self.values, self.table.position_m, self._coordinates.copy()
        nis, log_det, m = done.nis, done.log_det, positions
        for _ in range(self.config.iterations - 1):
            x, d = self._parts(done.correction)
            self.values, m = self._retracted(values, positions, done.correction)
            self._log.amend(linear=coordinates + done.correction[: self._gaussian.body], T_linear=self.T_imu_world)
            if self.model.has_clone:
                self._log.amend(T_linear_before=self.values["previous_pose"])
            self.table.position_m = m
            _, rows = self._observe(slot, measured)
            rows = self.variant.carry_back(rows, self.model, values, self.values, (m - positions)[slot])
            self.values, self.table.position_m = values, positions
            self.P = P_prior.copy()
            done = self._gaussian.condition(rows.corrected(-x, -d), frame, self.ids[slot])
        return Conditioned(done.correction, nis, log_det), m[slot]

    def _record(self, slot: IntArray, measured: Array, variance: Array, positions: Array) -> None:
        """Write accepted observations into the log, and remember them for the next frame."""
        table, step = self.table, self._log.step
        follows = (table.last_step[slot] == step - 1) & (self.model.track_error is not None)
        previous = np.where(follows, table.last_observation[slot], -1)
        table.last_observation[slot] = self._log.observed(table.log_row[slot], measured, variance, positions, previous)
        table.last_step[slot], table.seen_rows[slot] = step, measured

    def _parts(self, correction: Array) -> tuple[Array, Array]:
        """What observations depend on (seen,), and the landmarks' part (n, 3) of a correction."""
        return correction[: self._gaussian.seen], correction[self._gaussian.body :].reshape(-1, 3)

    def _retracted(self, values: dict[str, Array], positions: Array, correction: Array) -> tuple[dict[str, Array], Array]:
        """Blocks and landmarks (n, 3) after a correction."""
        after = self.model.retract(values, correction)
        d = correction[self._gaussian.body :].reshape(-1, 3)
        after["pose"], m = self.variant.retract(values["pose"], positions, correction[:6], d)
        return after, m

    def _retract(self, correction: Array) -> None:
        """Move the mean, and re-express the covariance where the variant does."""
        before, positions = self.values, self.table.position_m
        self.values, self.table.position_m = self._retracted(before, positions, correction)
        self._coordinates += correction[: self._gaussian.body]
        self.variant.transport(self._gaussian, self.model, before, self.values, self.table.position_m - positions)

    # --- landmarks that come and go -----------------------------------------------------------------------------------

    def _start(self, frame: int, ids: IntArray, rows: Array) -> None:
        """Append new landmarks with their full cross-covariance, eq. (5)."""
        if len(ids) == 0:
            return
        error, fresh = self.model.track_error, np.zeros(len(ids), dtype=np.int64)
        variance = self.sensor.variance(rows) if error is None else error.absolute_variance(fresh)
        moment = self._moment()
        if self.variant.first_estimates:
            moment = Moment(moment.T_imu_world, self.T_predicted, moment.calibration, moment.twist)
        positions, G, covariance = self.model.initialise(moment, rows, variance)
        self._gaussian.augment(G, covariance)
        self.table.append(
            id=ids,
            first_frame=fresh + frame,
            last_frame=fresh + frame,
            observations=fresh + 1,
            log_row=self._log.started(ids, positions),
            first_step=fresh + self._log.step,
            last_step=fresh - 2,
            position_m=positions,
            initial_m=positions,
        )
        self._record(np.arange(len(self.ids) - len(ids), len(self.ids)), rows, variance, positions)
        self.retired.start_afresh(ids)

    def _retire(self, gone: Array, may_return: bool = False) -> None:
        """Marginalise landmarks (n,): drop their rows and columns, keep their last estimate."""
        if gone.any():
            self.retired.add(self.table, self._gaussian.landmark_blocks(), gone, may_return)
            self._gaussian.marginalise(~gone)
            self.table.keep(~gone)

    def _split(self, moving: IntArray) -> IntArray:
        """Retire the landmarks at the slots that move, for good, and those that missed too often in a row.

        Returns:
            Ids of the latter, which are then free to start anew.
        """
        moves = np.zeros(len(self.ids), dtype=bool)
        moves[moving] = True
        jumped = (self.table.misses >= self.config.split_after) & (self.config.split_after > 0) & ~moves
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
        self.values, self.table.position_m, self.P = {**self.values, **found.values}, found.position_m, found.P
        self._coordinates[found.columns] = found.coordinates
        self._log.amend(T_linear=self.T_imu_world, T_updated=self.T_imu_world)

    # --- what it has found --------------------------------------------------------------------------------------------

    def landmarks(self) -> Landmarks:
        """Every landmark so far, in the order of landmark initialisation, which is that of the log."""
        return self.retired.all_landmarks(self.table, self._gaussian.landmark_blocks())

    def log(self) -> Log:
        """What the filter has conditioned on so far, for the posterior over all poses and landmarks."""
        return self._log.log()

    def parameters(self) -> Parameters | None:
        """What is estimated besides poses and landmarks and has labels, after each frame; None: nothing."""
        blocks = [block for block in self.model.layout.blocks if block.labels]
        if not blocks:
            return None
        value, std = np.array(self._reported).transpose(1, 0, 2)
        return Parameters(
            name=tuple(label for block in blocks for label in block.labels),
            unit=tuple(unit for block in blocks for unit in block.units),
            prior_std=np.concatenate([block.reported_prior_std for block in blocks]),
            value=value,
            std=std,
        )

    def _report(self) -> Array:
        """Estimates and standard deviations (2, p) of the parameters."""
        blocks = [block for block in self.model.layout.blocks if block.labels]
        if not blocks:
            return np.empty((2, 0))
        P = self._gaussian.body_covariance
        found = [block.reported(self.values, P, self.model.layout) for block in blocks]
        return np.hstack([np.array(pair) for pair in found])

    @property
    def counts(self) -> dict[str, int]:
        """Totals: landmarks retired, those seen again that came back or started afresh, and tracks found to move."""
        return {
            "retired": len(self.retired),
            "revived": len(self.retired.revived),
            "reappeared": len(self.retired.reappeared),
            "moving": len(self._moving_ids),
        }

    # --- Jacobians for users ------------------------------------------------------------------------------------------

    def measurement_jacobian(self, ids: IntArray) -> sp.csr_array:
        """Full-width H (3k, b+3n) of the sensor's rows of active landmarks ``ids`` (k,), for inspection and tests.

        Raises:
            KeyError: An id is not active.
        """
        slot = self._slots(ids)
        seen = self.model.see(self._moment(), self.positions_m[slot], self.linear_positions_m[slot])
        k, d, width = seen.H_x.shape
        row = np.broadcast_to(np.arange(k * d).reshape(k, d, 1), (k, d, width + 3))
        own = (self._gaussian.body + 3 * slot)[:, None, None] + np.arange(3)
        columns = np.concatenate([np.broadcast_to(np.arange(width), (k, d, width)), np.broadcast_to(own, (k, d, 3))], -1)
        values = np.concatenate([seen.H_x, seen.H_m], axis=-1)
        return sp.csr_array((values.ravel(), (row.ravel(), columns.ravel())), shape=(k * d, len(self.P)))

    def transition_jacobian(self, twist: Array, tau_s: float) -> sp.csr_array:
        """Full-width F (b+3n, b+3n) of a prediction by velocities (6,), identity but for the rows of the body."""
        T_linear = self.variant.linear(self.T_imu_world, self.T_predicted)
        step = self.model.step(self.values, twist, tau_s, T_linear, self.variant.first_estimates)
        full = sp.lil_array(sp.identity(len(self.P)))
        full[: self._gaussian.body, : self._gaussian.body] = step.Phi
        return sp.csr_array(full)

    def _slots(self, ids: IntArray) -> IntArray:
        slot, is_known = self.table.lookup(np.asarray(ids))
        if not is_known.all():
            raise KeyError(f"landmark ids {np.asarray(ids)[~is_known].tolist()} are not active")
        return slot
