"""The joint EKF over one pose and all active landmarks: state 6 + 3n, full cross-covariance.

Nothing here is as wide as the state but P itself and the rows ``H P``: measurement Jacobians stay at 6 + 3 columns a
landmark, the prediction touches the pose rows and columns alone, and a frame is a fixed number of NumPy calls.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from time import perf_counter

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import blas, lapack

from ekfslam.arrays import Array, IntArray
from ekfslam.config import CalibrationConfig, FilterConfig
from ekfslam.data.sequence import Sequence
from ekfslam.errors import ConfigError, InnovationError
from ekfslam.filters import calibration as cal
from ekfslam.filters.log import Log
from ekfslam.filters.logbook import LogBook
from ekfslam.filters.observing import (
    ACCEPTED,
    BEHIND_CAMERA,
    GATE,
    MOVING,
    FrameReport,
    Rig,
    Sensor,
    diagonal,
    first_sight,
    linearise,
    log_density,
    lookup,
    missed,
    normalised_squares,
)
from ekfslam.filters.result import Landmarks, Parameters
from ekfslam.filters.symmetric import add_product, add_square
from ekfslam.filters.variants import RULES
from ekfslam.geometry import motion, se3
from ekfslam.smoother.revival import Behind

# Observations of a landmark after which it may be found to move.
_SEEN_TO_MOVE = 3

# Smallest share of an observation's variance that must be left after the update for the second gate to mean anything.
_LEAST_SHARE = 1e-6

# Frames that a neighbour fetched with a returning landmark stays without being seen, beyond twice its distance in time.
_PATIENCE = 30


@dataclass(frozen=True)
class _Rows:
    """Measurement rows of k landmarks: place in the state (k,), both blocks of H, residuals and variances (k, 3).

    ``H_x`` (k, 3, 6+c) is by the pose error and, where the calibration is estimated, its c parameters.
    """

    slot: IntArray
    H_x: Array
    H_m: Array
    residual: Array
    variance: Array

    def only(self, which: NDArray[np.bool_]) -> _Rows:
        return _Rows(*(getattr(self, field.name)[which] for field in fields(self)))

    def corrected(self, x: Array, d: Array) -> _Rows:
        """The rows with the residuals ``r - H (x, d)`` that corrections (6+c,) and (n, 3) leave."""
        residual = self.residual - self.H_x @ x - (self.H_m @ d[self.slot, :, None])[..., 0]
        return replace(self, residual=residual)


@dataclass(frozen=True)
class _Step:
    """One prediction: the next ``T_imu_world`` (4, 4); IMU velocities (6,) and up (3,); transition and noise (b, b)."""

    T_imu_world: Array
    twist: Array
    up: Array | None
    Phi: Array
    Q: Array


class JointEKF:
    """Joint EKF-SLAM: call `predict`, then `update`, once a frame.

    Args:
        sensor: What observes the landmarks, with its noise: a `Rig`.
        config: Variant, gate, limits, retirement (``auto`` must have been resolved; it counts as ``unseen``).
        T_world_imu: (4, 4) first pose.
        covariance: (6, 6) of its error ``xi``; by default that of the configuration.
        calibration: What of the sensor's calibration is estimated (a `Rig` only); by default nothing. With a time
            offset, call `begin` before the first `update`.

    Raises:
        ConfigError: A calibration to estimate, but no `Rig`.

    Attributes:
        T_imu_world: (4, 4) estimate of the report's inverse pose.
        P: (b+3n, b+3n) covariance of ``(xi, ..., d_1, ..., d_n)`` with ``T_imu_world = exp(xi^) T_hat``,
            ``m = m_hat + d``. b is 6, and more where the errors of further things stand behind ``xi``, in this order:
            the free parameters of the calibration; the velocities, where the noise states how they walk; which way is
            up, where the velocities are level ones: ``up = exp(phi^) up_hat``.
        parameters: (9,) estimate of the calibration parameters, see `ekfslam.filters.calibration`.
        twist: (6,) estimate of the velocities as they are measured, where they are in the state.
        up: (3,) estimate of the direction against gravity, in the IMU frame, where the velocities are level ones.
        ids: (n,) ids of the active landmarks, in the order of their blocks in P.
        positions_m: (n, 3) their positions in world.
        revived: Ids of retired landmarks that were seen again and came back.
        reappeared: Ids of retired landmarks that were seen again and started afresh.
    """

    def __init__(
        self,
        sensor: Sensor,
        config: FilterConfig,
        T_world_imu: Array,
        covariance: Array | None = None,
        calibration: CalibrationConfig | None = None,
    ) -> None:
        self.sensor, self.config = sensor, config
        self.rule = RULES[config.variant]
        self._gate = config.gate
        self.T_imu_world = self._T_predicted = se3.inverse(T_world_imu)
        self.P = config.initial_covariance if covariance is None else np.array(covariance, dtype=float)
        self._log = LogBook(self.rule.first_estimates, self.P.copy(), self.T_imu_world)
        self._parameter_std = cal.prior_std(calibration or CalibrationConfig())
        self.parameters = np.zeros(len(self._parameter_std))
        self._free = np.flatnonzero(self._parameter_std)
        if len(self._free) and not isinstance(sensor, Rig):
            raise ConfigError(f"calibration: only a stereo rig has parameters to estimate, not {type(sensor).__name__}")
        self._history: list[Array] = []  # of `further`: estimates and deviations (2, p) after each frame
        self.twist: Array | None = None
        self.up: Array | None = np.array([0.0, 0.0, 1.0]) if sensor.noise.tilt_rad else None
        self._imu_twist = np.zeros(6)  # by which a time offset of the images counts, see `_seen_twist`
        self._moved: tuple[Array, float] | None = None  # from which updated pose the last prediction led, and how long
        self._T_updated = self.T_imu_world
        self._extend()
        self.positions_m = np.empty((0, 3))
        self.revived: list[int] = []
        self.reappeared: list[int] = []
        # id, first frame, last frame, observations, misses in a row, row in the log, stays without being seen before
        self._books = np.empty((0, 7), dtype=np.int64)
        self._initial_m = np.empty((0, 3))
        self._retired: list[Landmarks] = []
        self._retired_rows: list[IntArray] = []
        self._retired_row: dict[int, int] = {}  # of what can come back: its id, its row in the log
        self._behind = Behind(sensor, config)
        self._step_m = np.zeros(3)  # last step of the rig in world
        self._evidence = np.empty((0, 2))  # that a landmark moves along with it: see `_moving`
        self._moving_ids: set[int] = set()
        self._log_likelihood = 0.0  # of the velocities measured since the last frame, where they are in the state

    def _extend(self) -> None:
        """Lay out what stands behind the pose in the state, with its prior."""
        self._columns = np.concatenate([np.arange(6), 6 + self._free])
        self._turns_camera = 6 + np.flatnonzero((self._free >= 3) & (self._free < 6))  # camera's rotation in the state
        self._seen = len(self._columns)  # leading columns of the state that an observation depends on
        walks = self.sensor.noise.twist_walk_std is not None
        self._at_twist = slice(self._seen, self._seen + 6 * walks)
        self._at_up = slice(self._at_twist.stop, self._at_twist.stop + 3 * (self.up is not None))
        self._body = self._at_up.stop
        std = np.zeros(self._body)
        std[6 : self._seen] = self._parameter_std[self._free]
        std[self._at_up] = self.sensor.noise.tilt_rad
        P = np.diag(std**2)
        P[:6, :6] = self.P
        self.P = P

    @property
    def ids(self) -> IntArray:
        return self._books[:, 0]

    @property
    def _linear_m(self) -> Array:
        """(n, 3) positions at which H is taken, eq. (4)."""
        return self._initial_m if self.rule.first_estimates else self.positions_m

    @property
    def _can_revive(self) -> bool:
        """The system behind knows poses, landmarks that stay and white velocities; with more they start afresh."""
        return self.config.revive >= 0 and self._body == 6 and not self.sensor.noise.landmarks_walk

    @property
    def T_world_imu(self) -> Array:
        """(4, 4) estimated pose of the IMU."""
        return se3.inverse(self.T_imu_world)

    def begin(self, twist: Array) -> None:
        """Velocities (6,) at the first frame, which no prediction leads to; only a time offset asks for them."""
        self._imu_twist = twist if self.up is None else motion.imu_twist(twist, self.up)[0]

    def predict(self, twist: Array, tau_s: float) -> None:
        """Eq. (1) and (2) over one interval: ``twist`` (6,) in m/s and rad/s, duration in s."""
        noise, b = self.sensor.noise, self._body
        velocities = twist if noise.twist_walk_std is None else self._filter_twist(twist, noise.twist_walk_std)
        step = self._step(velocities, tau_s)
        P_b = step.Phi @ self.P[:b]
        P_bb = P_b[:, :b] @ step.Phi.T + step.Q
        self.P[:b, b:] = P_b[:, b:]
        self.P[b:, :b] = P_b[:, b:].T
        self.P[:b, :b] = 0.5 * (P_bb + P_bb.T)
        self.T_imu_world = self._T_predicted = step.T_imu_world
        self._imu_twist = step.twist
        self._moved = (self._T_updated, tau_s)
        self._step_m = step.T_imu_world[:3, :3].T @ (step.twist[:3] * tau_s)
        self._let_landmarks_walk()
        self._log.predicted(twist, tau_s, step.T_imu_world)
        self.up = step.up

    def _let_landmarks_walk(self) -> None:
        """What tracks do that white pixel noise does not describe: P_mm grows with the last step of the rig."""
        noise = self.sensor.noise
        if not noise.landmarks_walk:
            return
        along = noise.drift * self._step_m
        square_distance_m2 = (se3.apply(self.T_imu_world, self.positions_m) ** 2).sum(axis=1)
        across = noise.bearing_drift_rad**2 * np.linalg.norm(self._step_m) * square_distance_m2
        self._landmark_blocks()[...] += np.outer(along, along) + across[:, None, None] * np.eye(3)

    def _step(self, twist: Array, tau_s: float) -> _Step:
        """Eq. (1) and (2) for all that moves with the pose; ``twist`` is in the frame of the measured velocities."""
        noise, up, by_twist, by_up = self.sensor.noise, self.up, np.eye(6), np.empty((6, 0))
        if up is not None:
            twist, by_twist, by_up = motion.imu_twist(twist, up)
        E = motion.increment(twist, tau_s)
        T_next = E @ self.T_imu_world
        std = noise.velocity_std if self.twist is None else noise.motion_std
        Phi, Q = np.eye(self._body), np.zeros((self._body, self._body))
        # FEJ: from the predicted pose, where the last frame was linearised, to the next predicted pose.
        Phi[:6, :6] = motion.error_jacobian(T_next @ se3.inverse(self._T_predicted) if self.rule.first_estimates else E)
        Q[:6, :6] = motion.process_noise(twist, tau_s, std, noise.misalignment_rad)
        if self.twist is not None:
            Phi[:6, self._at_twist] = -motion.twist_jacobian(twist, tau_s) @ by_twist
        if up is not None:
            # Up turns with the IMU, by the same velocities with the same errors.
            at, R = self._at_up, E[:3, :3]
            Phi[:6, at] = -motion.twist_jacobian(twist, tau_s) @ by_up
            Phi[at, 6:] = Phi[3:6, 6:]
            Phi[at, at] += R
            Q[at, :6], Q[:6, at], Q[at, at] = Q[3:6, :6], Q[:6, 3:6], Q[3:6, 3:6]
            up = R @ up
        return _Step(T_next, twist, up, Phi, Q)

    def _filter_twist(self, measured: Array, walk_std: Array) -> Array:
        """The velocities as a random walk that is measured: a rank 6 update (6) of the state, then their estimate."""
        variance, at = self.sensor.noise.twist_std**2, self._at_twist
        if self.twist is None:
            self.twist = np.array(measured, dtype=float)
            self.P[at, at] = np.diag(variance)
            return self.twist
        own = np.arange(at.start, at.stop)
        self.P[own, own] += walk_std**2
        HP = self.P[at].copy()
        S = HP[:, at] + np.diag(variance)
        Y_transposed, whitened, log_det = _whiten(S, HP, measured - self.twist, self._log.frames, self.ids)
        self._log_likelihood += log_density(float(whitened @ whitened), log_det, 6)
        add_square(self.P, Y_transposed, -1.0)
        self._retract(Y_transposed @ whitened)
        return self.twist

    def _landmark_blocks(self) -> Array:
        """The landmarks' own covariances (n, 3, 3), a view into P that can be written to."""
        n, b, stride = len(self.ids), self._body, self.P.strides[0]
        step = self.P.strides[1]
        return np.lib.stride_tricks.as_strided(
            self.P[b:, b:], (n, 3, 3), (3 * (stride + step), stride, step), writeable=True
        )

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
        if self.config.retire != "never":
            unseen_for = frame - np.maximum(self._books[:, 2], self._books[:, 6])
            out_of_view = (unseen_for >= (self.config.retire_after or 1)) & np.isin(self.ids, ids, invert=True)
            self._retired_row.update(self._books[out_of_view][:, [0, 5]].tolist())
            self._retire(out_of_view)
            returning = self._retired_row.keys() & set(ids.tolist())
            if returning and self._can_revive:
                self._revive(frame, sorted(returning))
        rows = self.sensor.rows(measured)
        reason = self.sensor.screen(measured, self.config)
        if known_to_move := self._moving_ids.intersection(ids.tolist()):
            reason[np.isin(ids, list(known_to_move))] = MOVING
        order = np.argsort(self.ids)
        index, is_known = lookup(self.ids[order], ids)
        known = np.flatnonzero(is_known & (reason == ACCEPTED))
        slot = order[index[known]]
        nis, log_det, dof, verdict = self._correct(frame, slot, rows[known])
        log_likelihood = self._log_likelihood + log_density(nis, log_det, dof)
        self._log_likelihood = 0.0
        reason[known] = verdict
        updated = slot[verdict == ACCEPTED]
        self._books[updated, 2] = frame
        self._books[updated, 3] += 1
        self._books[updated, 4] = 0
        self._books[slot[missed(verdict)], 4] += 1
        split = self._split(slot[verdict == MOVING])
        new = (~is_known & (reason == ACCEPTED)) | np.isin(ids, split)
        reason[new] = ACCEPTED
        self._log.updated(self.T_imu_world)
        self._start(frame, ids[new], rows[new])
        self._T_updated = self.T_imu_world
        self._history.append(self._further())
        return FrameReport(frame, ids, reason, nis, dof, split, log_likelihood)

    def landmarks(self) -> Landmarks:
        """Every landmark so far, in the order of first sight, which is that of the log."""
        row = np.concatenate([*self._retired_rows, self._books[:, 5]])
        everything = Landmarks.concatenate([*self._retired, self._active(np.arange(len(self.ids)))])
        # A landmark that came back and was retired again is there twice; its last estimate counts.
        _, last = np.unique(row[::-1], return_index=True)
        return everything.only(len(row) - 1 - last)

    def log(self) -> Log:
        """What the filter has conditioned on so far, for the posterior over all poses and landmarks.

        Velocities are those of the IMU: level ones are turned by what is known of up by now.
        """
        log = self._log.log()
        if self.up is None:
            return log
        up_world = self.T_imu_world[:3, :3].T @ self.up
        up = log.T_updated[:-1, :3, :3] @ up_world
        turned = [motion.imu_twist(twist, u)[0] for twist, u in zip(log.twist[1:], up, strict=True)]
        return replace(log, twist=np.array([log.twist[0], *turned]))

    def further(self) -> Parameters | None:
        """What is estimated besides poses and landmarks, if anything: calibration; roll and pitch of the IMU."""
        tilt = () if self.up is None else ("roll", "pitch")
        name = (*(cal.NAMES[i] for i in self._free), *tilt)
        if not name:
            return None
        unit = (*(cal.UNITS[i] for i in self._free), *("rad" for _ in tilt))
        value, std = np.array(self._history).transpose(1, 0, 2)
        prior = np.append(self._parameter_std[self._free], [self.sensor.noise.tilt_rad for _ in tilt])
        return Parameters(name, unit, prior, value, std)

    def _further(self) -> Array:
        """Estimates and deviations (2, p) of the parameters of `further`."""
        value, std = self.parameters[self._free], np.sqrt(np.diag(self.P)[6 : self._seen])
        if self.up is not None:
            roll_pitch = np.arctan2(self.up[1], self.up[2]), -np.arcsin(self.up[0])
            value = np.append(value, roll_pitch)
            std = np.append(std, np.sqrt(np.diag(self.P)[self._at_up][:2]))
        return np.array([value, std])

    @property
    def counts(self) -> dict[str, int]:
        """Totals: landmarks retired, those seen again that came back or started afresh, and tracks found to move."""
        return {
            "retired": sum(len(part) for part in self._retired),
            "revived": len(self.revived),
            "reappeared": len(self.reappeared),
            "moving": len(self._moving_ids),
        }

    def measurement_jacobian(self, ids: IntArray) -> sp.csr_array:
        """Full-width H (3k, b+3n) of the rectified rows of active landmarks ``ids`` (k,), for inspection and tests.

        Raises:
            KeyError: An id is not active.
        """
        order = np.argsort(self.ids)
        index, is_known = lookup(self.ids[order], np.asarray(ids))
        if not is_known.all():
            raise KeyError(f"landmark ids {np.asarray(ids)[~is_known].tolist()} are not active")
        slot = order[index]
        _, H_x, H_m = self._linearise(self.T_imu_world, self.parameters, self.positions_m[slot], self._linear_m[slot])
        row = np.arange(3 * len(slot)).reshape(-1, 3, 1)
        rows = np.broadcast_to(row, (len(slot), 3, self._seen + 3))
        pose_columns = np.broadcast_to(np.arange(self._seen), H_x.shape)
        own_columns = np.broadcast_to((self._body + 3 * slot)[:, None, None] + np.arange(3), (len(slot), 3, 3))
        columns = np.concatenate([pose_columns, own_columns], axis=-1)
        values = np.concatenate([H_x, H_m], axis=-1)
        return sp.csr_array((values.ravel(), (rows.ravel(), columns.ravel())), shape=(3 * len(slot), len(self.P)))

    def transition_jacobian(self, twist: Array, tau_s: float) -> sp.csr_array:
        """Full-width F (b+3n, b+3n) of a prediction by velocities (6,), identity but for the rows of the body."""
        full = sp.lil_array(sp.identity(len(self.P)))
        full[: self._body, : self._body] = self._step(twist, tau_s).Phi
        return sp.csr_array(full)

    def _sensor_now(self) -> Sensor:
        """The sensor with the calibration as estimated by now."""
        return cal.calibrated(self._rig, self.parameters) if len(self._free) else self.sensor

    @property
    def _rig(self) -> Rig:
        assert isinstance(self.sensor, Rig)
        return self.sensor

    def _linearise(
        self, T_imu_world: Array, parameters: Array, positions_m: Array, linear_positions_m: Array
    ) -> tuple[Array, Array, Array]:
        """`linearise`, with the columns of the free calibration parameters behind those of the pose."""
        if len(self._free) == 0:
            return linearise(self.sensor, T_imu_world, positions_m, linear_positions_m)
        q, H, H_m = cal.linearise_calibrated(
            self._rig, parameters, self._imu_twist, T_imu_world, positions_m, linear_positions_m
        )
        return q, H[..., self._columns], H_m

    def _first_sight(self, rows: Array) -> tuple[Array, Array, Array]:
        """`first_sight` at the present pose, G with the columns of the free calibration parameters."""
        T_linear = self._T_predicted if self.rule.first_estimates else self.T_imu_world
        if len(self._free) == 0:
            return first_sight(self.sensor, self.T_imu_world, rows, T_linear)
        positions, G, covariance = cal.first_sight_calibrated(
            self._rig, self.parameters, self._imu_twist, self.T_imu_world, rows, T_linear
        )
        return positions, G[..., self._columns], covariance

    def _correct(self, frame: int, slot: IntArray, measured: Array) -> tuple[float, float, int, IntArray]:
        """Eq. (6) with its gates and the variant's retraction, for landmarks at ``slot`` (k,) with rows (k, 3).

        A landmark must agree with the prediction, and with the prediction as corrected by all *other* landmarks of the
        frame: the first gate is weak while the pose itself is uncertain, the second is not. What the second rejects has
        been used already, and is taken out again.

        Returns:
            NIS of what was accepted, ``log det S``, the degrees of freedom, and the verdict (k,) on each landmark.
        """
        verdict = np.full(len(slot), ACCEPTED)
        sensor, positions = self._sensor_now(), self.positions_m[slot]
        q, H_x, H_m = self._linearise(self.T_imu_world, self.parameters, positions, self._linear_m[slot])
        verdict[~sensor.in_view(q, self.config)] = BEHIND_CAMERA
        some = np.flatnonzero(verdict == ACCEPTED)
        rows = _Rows(
            slot[some], H_x[some], H_m[some], measured[some] - sensor.predict(q[some]), sensor.variance(measured[some])
        )

        S = self._variances(rows) + diagonal(rows.variance)
        squares = normalised_squares(S, rows.residual, frame, self._of(rows))
        inside = squares <= self._gate
        verdict[some[~inside]] = GATE
        if sensor.noise.landmarks_walk:
            moving = self._moving(rows, S, squares)
            verdict[some[moving]] = MOVING
            inside &= ~moving
        some, rows = some[inside], rows.only(inside)
        if len(some) == 0:
            return 0.0, 0.0, 0, verdict
        if cal.TIME in self._free and self._moved is not None:
            self._imu_twist = self._seen_twist(frame, rows)
            q, H_x, H_m = self._linearise(self.T_imu_world, self.parameters, positions[some], self._linear_m[rows.slot])
            rows = replace(rows, H_x=H_x, H_m=H_m, residual=measured[some] - sensor.predict(q))

        P_prior = self.P.copy() if self.config.iterations > 1 else None
        correction, nis, log_det = self._condition(frame, rows)

        # With e_i = r_i - H_i (xi, d) and C_i = V - H_i P H_i^T after all of them, e_i^T C_i^-1 e_i is the normalised
        # square of landmark i's innovation given all others.
        if np.isfinite(self._gate):
            left = rows.corrected(*self._parts(correction))
            C = diagonal(left.variance) - self._variances(left)
            # Where C is nothing but rounding, no other landmark says anything about this one: it cannot be judged.
            deviation = np.sqrt(left.variance)
            share = np.linalg.eigvalsh(C / (deviation[:, :, None] * deviation[:, None, :]))[:, 0]
            judged = share > _LEAST_SHARE
            inside = np.ones(len(C), dtype=bool)
            inside[judged] = (
                normalised_squares(C[judged], left.residual[judged], frame, self._of(left)[judged]) <= self._gate
            )
            if not inside.all():
                verdict[some[~inside]] = GATE
                # Taking observations out is an update with noise -V: P + P H^T (V - H P H^T)^-1 H P.
                less_correction, less_nis, less_log_det = self._condition(frame, left.only(~inside), sign=-1.0)
                correction, nis, log_det = correction - less_correction, nis - less_nis, log_det - less_log_det
        taken = verdict == ACCEPTED
        slot, measured, positions = slot[taken], measured[taken], positions[taken]
        if P_prior is not None and taken.any():
            correction, T_linear, positions = self._iterate(frame, P_prior, correction, slot, measured)
            self._log.linearised(T_linear)
        self._log.observed(self._books[slot, 5], measured, sensor.variance(measured), positions)
        self._retract(correction)
        return nis, log_det, 3 * int(taken.sum()), verdict

    def _seen_twist(self, frame: int, rows: _Rows) -> Array:
        """The velocities (6,) that led to this frame, as corrected by its observations.

        A time offset counts in proportion to them. With the measured ones, whose noise the innovations show, too, it
        would come out far too small.
        """
        assert self._moved is not None
        T_before, tau_s = self._moved
        P = self.P.copy()
        xi, d = self._parts(self._condition(frame, rows)[0])
        self.P = P
        T, _ = self.rule.retract(self.T_imu_world, self.positions_m, xi[:6], d)
        return -se3.log(T @ se3.inverse(T_before)) / tau_s

    def _iterate(
        self, frame: int, P_prior: Array, correction: Array, slot: IntArray, measured: Array
    ) -> tuple[Array, Array, Array]:
        """Gauss-Newton on eq. (6): linearise again at the corrected state, always from the same prior.

        Rows taken at the corrected state are carried back into the prior's coordinates by the variant's derivative
        D, ``H_k D_k``, and the residual becomes ``r_k + H_k D_k (xi, d)_k``. Source: Bell and Cathey, "The
        iterated Kalman filter update as a Gauss-Newton method", IEEE TAC 1993.

        Returns:
            The correction (6+3n,); pose (4, 4) and landmarks (k, 3) at which it was linearised last.
        """
        for _ in range(self.config.iterations - 1):
            x, d = self._parts(correction)
            T, m = self.rule.retract(self.T_imu_world, self.positions_m, x[:6], d)
            parameters = self._moved_parameters(x)
            q, H_x, H_m = self._linearise(T, parameters, m[slot], m[slot])
            moved = (m - self.positions_m)[slot]
            by_pose, by_rotation, by_landmark = self.rule.derivative(self.T_imu_world, T, moved)
            H_x[..., :6] = H_x[..., :6] @ by_pose
            H_x[..., 3:6] += H_m @ by_rotation
            if self.rule.transport is not None and len(self._turns_camera):
                H_x[..., self._turns_camera] += H_m @ cal.turned_with_camera(
                    self._rig, self.parameters, self.T_imu_world, moved
                )
            H_m = H_m @ by_landmark
            sensor = cal.calibrated(self._rig, parameters) if len(self._free) else self.sensor
            residual = measured - sensor.predict(q)
            rows = _Rows(slot, H_x, H_m, residual, sensor.variance(measured)).corrected(-x, -d)
            self.P = P_prior.copy()
            correction, _, _ = self._condition(frame, rows)
        return correction, T, m[slot]

    def _condition(self, frame: int, rows: _Rows, sign: float = 1.0) -> tuple[Array, float, float]:
        """Eq. (6): condition P on the rows (sign 1), or take rows out that it was conditioned on (sign -1).

        Returns:
            The correction (6+3n,) to add (subtract), and the NIS and the ``log det S`` that the rows contribute.
        """
        HP, S = self._project(rows)
        S *= sign
        S.ravel()[:: len(S) + 1] += rows.variance.ravel()
        Y_transposed, whitened, log_det = _whiten(S, HP, rows.residual, frame, self._of(rows))
        add_square(self.P, Y_transposed, -sign)
        if sign < 0:
            # Here V - H P H^T = V S^-1 V, where S is the innovation covariance of these rows given the other ones.
            log_det = 2.0 * float(np.log(rows.variance).sum()) - log_det
        return Y_transposed @ whitened, float(whitened @ whitened), log_det

    def _of(self, rows: _Rows) -> IntArray:
        """Landmark ids (k,) of measurement rows."""
        return self.ids[rows.slot]

    def _project(self, rows: _Rows) -> tuple[Array, Array]:
        """``H P`` (3k, 6+3n) and ``H P H^T`` (3k, 3k)."""
        k, size = len(rows.slot), len(self.P)
        H_x, seen = rows.H_x.reshape(3 * k, -1), self._seen
        HP = (H_x @ self.P[:seen]).reshape(k, 3, size)
        HP += rows.H_m @ self.P[self._body :].reshape(-1, 3, size)[rows.slot]
        HP = HP.reshape(3 * k, size)
        own_columns = (self._body + 3 * rows.slot[:, None] + np.arange(3)).ravel()
        HPH = (rows.H_m @ HP.T[own_columns].reshape(k, 3, 3 * k)).reshape(3 * k, 3 * k)
        HPH += H_x @ HP[:, :seen].T
        return HP, HPH

    def _variances(self, rows: _Rows) -> Array:
        """``H_i P H_i^T`` (k, 3, 3) of each landmark's own rows, without what is between landmarks."""
        seen = self._seen
        cross = self.P[self._body :, :seen].reshape(-1, 3, seen)[rows.slot]
        cross = rows.H_m @ cross @ rows.H_x.swapaxes(1, 2)
        own = rows.H_m @ self._landmark_blocks()[rows.slot] @ rows.H_m.swapaxes(1, 2)
        return rows.H_x @ self.P[:seen, :seen] @ rows.H_x.swapaxes(1, 2) + cross + cross.swapaxes(1, 2) + own

    def _parts(self, correction: Array) -> tuple[Array, Array]:
        """What observations depend on, pose and calibration (6+c,), and landmark parts (n, 3) of a correction."""
        return correction[: self._seen], correction[self._body :].reshape(-1, 3)

    def _moved_parameters(self, x: Array) -> Array:
        """The calibration parameters (9,) after the correction ``x`` (6+c,)."""
        parameters = self.parameters.copy()
        parameters[self._free] += x[6:]
        return parameters

    def _retract(self, correction: Array) -> None:
        x, d = self._parts(correction)
        parameters_before, self.parameters = self.parameters, self._moved_parameters(x)
        if self.twist is not None:
            self.twist = self.twist + correction[self._at_twist]
        if self.up is not None:
            self.up = se3.so3_exp(correction[self._at_up]) @ self.up
        before, positions = self.T_imu_world, self.positions_m
        self.T_imu_world, self.positions_m = self.rule.retract(before, positions, x[:6], d)
        if self.rule.transport is not None:
            moved = self.positions_m - positions
            self.rule.transport(self.P, before, self.T_imu_world, moved)
            if len(self._turns_camera):
                # As in `transport_invariant`: d+ = d + B theta, and so P+ = P + B Z^T + Z B^T.
                at, B = self._turns_camera, np.zeros((len(self.P), 3))
                B[self._body :] = cal.turned_with_camera(self._rig, parameters_before, before, moved).reshape(-1, 3)
                add_product(self.P, B, self.P[:, at] + 0.5 * B @ self.P[np.ix_(at, at)])

    def _start(self, frame: int, ids: IntArray, rows: Array) -> None:
        """Append new landmarks with their full cross-covariance, eq. (5)."""
        if len(ids) == 0:
            return
        positions, G, covariance = self._first_sight(rows)
        G = G.reshape(-1, self._seen)
        size, grown = len(self.P), len(self.P) + len(G)
        P = np.empty((grown, grown))
        P[:size, :size] = self.P
        P[size:, :size] = G @ self.P[: self._seen]
        P[:size, size:] = P[size:, :size].T
        P_new = P[size:, : self._seen] @ G.T
        P[size:, size:] = 0.5 * (P_new + P_new.T)
        block = np.arange(len(ids))
        P[size:, size:].reshape(len(ids), 3, len(ids), 3)[block, :, block, :] += covariance
        self.P = P
        self.positions_m = np.concatenate([self.positions_m, positions])
        self._initial_m = np.concatenate([self._initial_m, positions])
        self._evidence = np.concatenate([self._evidence, np.zeros((len(ids), 2))])
        row = self._log.started(ids, positions)
        self._log.observed(row, rows, self.sensor.variance(rows), positions)
        books = np.column_stack([ids, *np.broadcast_to([[frame], [frame], [1], [0]], (4, len(ids))), row, row * 0])
        self._books = np.concatenate([self._books, books])
        again = sorted(self._retired_row.keys() & set(ids.tolist()))
        self.reappeared.extend(again)
        for i in again:
            del self._retired_row[i]

    def _revive(self, frame: int, ids: list[int]) -> None:
        """Bring retired landmarks back, and with them the neighbours that will probably be seen next.

        The state (pose, active and returning landmarks) becomes its marginal in the system behind: see
        `ekfslam.smoother.revival`.
        """
        log = self._log.log()
        returning = np.array([self._retired_row[i] for i in ids])
        retired = np.fromiter(self._retired_row.values(), dtype=np.int64, count=len(self._retired_row))
        neighbours, distance = self._behind.neighbours(log, returning, np.setdiff1d(retired, returning))
        back = np.concatenate([returning, neighbours])
        known = self.landmarks()
        came = known.only(back)
        stay_until = frame + np.concatenate([np.zeros_like(returning), 2 * distance + _PATIENCE])
        books = np.column_stack(
            [came.id, came.first_frame, came.last_frame, came.observations, np.zeros_like(back), back, stay_until]
        )
        self._books = np.concatenate([self._books, books])
        for i in came.id.tolist():
            del self._retired_row[i]
        self.revived.extend(ids)

        marginal = self._behind.marginal(log, known.position_m, self._books[:, 5])
        self.T_imu_world, self.positions_m, self.P = marginal
        self._initial_m = log.first_position_m[self._books[:, 5]]
        self._evidence = np.concatenate([self._evidence, np.zeros((len(back), 2))])
        self._log.linearised(self.T_imu_world)
        self._log.updated(self.T_imu_world)

    def _moving(self, rows: _Rows, S: Array, squares: Array) -> NDArray[np.bool_]:
        """Which landmarks (k,) travel with the rig or against it, by all that their tracks have shown so far.

        A landmark that moves by a share b of the rig's step dx between two frames has innovations of mean ``b h`` with
        ``h = H_m dx``. Over a track ``N = sum h^T S^-1 r`` and ``D = sum h^T S^-1 h`` estimate b as N / D with standard
        deviation ``D^-1/2``. Per-frame gates never see it: the pose gives way first.

        Args:
            rows: Their measurement rows.
            S: (k, 3, 3) their innovation covariances.
            squares: (k,) their normalised innovations squared; gross outliers count as at the gate.
        """
        h = rows.H_m @ self._step_m
        weighted = np.linalg.solve(S, h[..., None])[..., 0]
        clip = np.sqrt(np.minimum(1.0, self._gate / np.maximum(squares, np.finfo(float).tiny)))
        self._evidence[rows.slot, 0] += clip * (weighted * rows.residual).sum(axis=1)
        self._evidence[rows.slot, 1] += (weighted * h).sum(axis=1)
        N, D = self._evidence[rows.slot].T
        sigma = self.config.moving_sigma / self.sensor.noise.margin
        least = np.maximum(sigma * np.sqrt(D), self.config.moving_share * D)
        return (np.abs(N) > least) & (self._books[rows.slot, 3] >= _SEEN_TO_MOVE)

    def _split(self, moving: IntArray) -> IntArray:
        """Retire the landmarks at the slots that move, for good, and those that missed too often in a row.

        Returns:
            Ids of the latter, which are then free to start anew.
        """
        jumped = np.zeros(len(self.ids), dtype=bool)
        if self.config.split_after:
            jumped = self._books[:, 4] >= self.config.split_after
        jumped[moving] = False
        gone, ids = jumped.copy(), self.ids[jumped]
        gone[moving] = True
        self._moving_ids.update(self.ids[moving].tolist())
        self._retire(gone)
        return ids

    def _retire(self, gone: NDArray[np.bool_]) -> None:
        """Marginalise landmarks: drop their rows and columns, keep their last estimate."""
        if not gone.any():
            return
        self._retired.append(self._active(np.flatnonzero(gone)))
        self._retired_rows.append(self._books[gone, 5])
        stay = ~gone
        kept = np.flatnonzero(np.concatenate([np.ones(self._body, dtype=bool), np.repeat(stay, 3)]))
        self.P = self.P[kept].take(kept, axis=1)
        self.positions_m, self._initial_m = self.positions_m[stay], self._initial_m[stay]
        self._evidence = self._evidence[stay]
        self._books = self._books[stay]

    def _active(self, slot: IntArray) -> Landmarks:
        identifier, first, last, count = self._books[slot, :4].T
        return Landmarks(
            identifier, self.positions_m[slot], self._landmark_blocks()[slot], self._initial_m[slot], first, last, count
        )


def _whiten(S: Array, HP: Array, residual: Array, frame: int, ids: IntArray) -> tuple[Array, Array, float]:
    """``Y^T = (L^-1 H P)^T`` and ``L^-1 r`` of eq. (6), with ``S = L L^T``, and ``log det S``.

    Raises:
        InnovationError: S is not positive definite.
    """
    # LAPACK sees row-major arrays as their transposes: S is symmetric, and (H P)^T is what dtrsm wants.
    L, failed = lapack.dpotrf(S.T, lower=1, clean=0, overwrite_a=1)
    if failed:
        raise InnovationError(frame, ids)
    Y_transposed = blas.dtrsm(1.0, L, HP.T, side=1, lower=1, trans_a=1, overwrite_b=1)
    log_det = 2.0 * float(np.log(L.diagonal()).sum())
    return Y_transposed, blas.dtrsm(1.0, L, residual.reshape(-1, 1), lower=1)[:, 0], log_det


def run_joint(
    sequence: Sequence,
    rig: Rig,
    config: FilterConfig,
    frames: Iterable[int],
    calibration: CalibrationConfig | None = None,
) -> tuple[JointEKF, Array, Array, list[FrameReport], Array]:
    """`JointEKF` over the given frames of a sequence.

    Returns:
        The filter as it ended; ``T_imu_world`` (T, 4, 4) and the pose covariance (T, 6, 6) after each frame; one report
        a frame; the wall-clock time of each frame in ms.
    """
    ekf = JointEKF(rig, config, sequence.initial_T_world_imu, calibration=calibration)
    T_imu_world, covariance, reports, ms = [], [], [], []
    for k in frames:
        begin = perf_counter()
        if k > 0:
            ekf.predict(sequence.twist[k], sequence.time_s[k] - sequence.time_s[k - 1])
        else:
            ekf.begin(sequence.twist[k])
        reports.append(ekf.update(k, *sequence.observations.at(k)))
        T_imu_world.append(ekf.T_imu_world)
        covariance.append(ekf.P[:6, :6].copy())
        ms.append(1e3 * (perf_counter() - begin))
    return ekf, np.array(T_imu_world), np.array(covariance), reports, np.array(ms)
