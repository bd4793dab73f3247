"""A gyroscope and an accelerometer move pose and velocity, eq. (12); their biases walk.

Inputs are the mean samples ``[w; f]`` of short pieces, rad/s and m/s^2, see `ekfslam.geometry.preintegration`. Errors
of the state are those of its blocks: ``T_imu_world = exp(xi^) T_hat``, and additive ones of body velocity and biases.
This is the imperfect invariant EKF (Hartley et al., "Contact-aided invariant extended Kalman filtering for robot state
estimation", IJRR 2020) with the velocity in the body. If `ImuScale` is in the state, its matrices are applied to the
samples first.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.data.inputs import InertialNoise, InertialSamples
from ekfslam.data.interval import Interval, Intervals
from ekfslam.data.noise import Noise
from ekfslam.errors import ConfigError
from ekfslam.geometry import se3
from ekfslam.geometry.preintegration import BG, LONGEST_S, NU, PHI, WIDEST_RAD, Increment, R, increments
from ekfslam.models.blocks import AccelBias, GyroBias, ImuScale, Velocity
from ekfslam.models.blocks.base import Layout, StateBlock, Values
from ekfslam.models.blocks.imu_scale import applied, by_value
from ekfslam.models.process.base import MakeProcess, Measured, Process, Residual, Step

GRAVITY_M_S2 = 9.81
_GAP_FACTOR = 10.0  # by which densities of white noise grow in an interval with a gap between its samples
_RHO, _THETA, _U = (slice(3 * i, 3 * i + 3) for i in range(3))  # of the blocks
_EYE = np.eye(3)
INERTIAL_BLOCKS: dict[str, type[StateBlock]] = {block.name: block for block in (Velocity, GyroBias, AccelBias)}


def inertial(noise: InertialNoise, gravity_m_s2: float = GRAVITY_M_S2) -> MakeProcess:
    """Return a maker of inertial processes with these densities and this magnitude of gravity."""

    def make(layout: Layout, _: Noise) -> Process:
        return Inertial(layout, noise, gravity_m_s2)

    return make


@dataclass(frozen=True)
class Inertial(Process):
    """Inertial samples move pose and body velocity; gravity is along -z of world."""

    layout: Layout
    noise: InertialNoise
    gravity_m_s2: float = GRAVITY_M_S2

    own = ("pose", Velocity.name, GyroBias.name, AccelBias.name)
    takes = InertialSamples
    velocity = Velocity.name
    measures_departure = True

    @cached_property
    def _g(self) -> Array:
        return np.array([0.0, 0.0, -self.gravity_m_s2])

    def step(self, values: Values, interval: Interval | Intervals, T_linear: Array, first_estimates: bool) -> Step:
        """Return the step over an interval; it loops over many."""
        if isinstance(interval, Intervals):
            of_one = [
                self.step(_at(values, k), interval[k], T_linear[k], first_estimates) for k in range(len(interval))
            ]
            moved = {name: np.array([step.values[name] for step in of_one]) for name in self.own}
            return Step(moved, *(np.array([getattr(s, name) for s in of_one]) for name in ("imu_twist", "Phi", "Q")))
        moved, F, G, Q = self._moved(values, interval)
        if first_estimates:
            F[:9, :9] = F[:9, :9] @ np.linalg.solve(_to_world(values["pose"]), _to_world(T_linear))
        Phi = np.zeros((15, self.layout.body))
        Phi[:, self.columns] = F
        Phi[:, self._scale] = G
        return Step(moved, self.imu_twist(values, {**values, **moved}, interval), Phi, Q)

    @cached_property
    def has_scale(self) -> bool:
        """Whether matrices of the unit are in the state."""
        return ImuScale.name in self.layout

    @cached_property
    def _scale(self) -> IntArray:
        return self.layout.columns([ImuScale.name] if self.has_scale else [])

    def _scaled(self, values: Values, interval: Interval) -> Interval:
        """Return an interval with the matrices of the unit applied to its samples."""
        return replace(interval, inputs=applied(values[ImuScale.name], interval.inputs)) if self.has_scale else interval

    def _increments(self, interval: Interval, gyro_bias: Array, accel_bias: Array) -> tuple[Increment, IntArray]:
        """Return the increments of the pieces of an interval; long ones and wide turns are divided, into so many."""
        turn_rad = interval.dt_s * np.linalg.norm(interval.inputs[:, :3] - gyro_bias, axis=1)
        parts = np.ceil(np.maximum(interval.dt_s / LONGEST_S, turn_rad / WIDEST_RAD)).astype(int).clip(1)
        inputs = np.repeat(interval.inputs, parts, axis=0)
        white = _GAP_FACTOR if interval.is_gap else 1.0
        noise = self.noise
        density = np.repeat([white * noise.gyro, white * noise.accel, 0.0, noise.gyro_walk, noise.accel_walk], 3)
        density *= interval.doubt
        dt_s = np.repeat(interval.dt_s / parts, parts)
        return increments(dt_s, inputs[:, :3] - gyro_bias, inputs[:, 3:] - accel_bias, density), parts

    def _moved(self, values: Values, interval: Interval) -> tuple[dict[str, Array], Array, Array, Array]:
        """Return the blocks after an interval; F (15, 15), G (15, s) by the matrices of the unit, and Q."""
        T, u_0, gyro_bias, accel_bias = (values[name] for name in self.own)
        pieces, parts = self._increments(self._scaled(values, interval), gyro_bias, accel_bias)
        found = pieces.total()
        tau, g, back = found.tau_s, T[:3, :3] @ self._g, found.R.T
        u_1 = back @ (u_0 + g * tau + found.v)
        C = back @ T[:3, :3]
        t = back @ (T[:3, 3] - u_0 * tau - 0.5 * g * tau**2 - found.p)
        from_z = _from_invariant(u_1)
        moved = dict(zip(self.own, (se3.transform(C, t), u_1, gyro_bias, accel_bias), strict=True))
        G = np.empty((15, 0))
        if self.has_scale:
            G = from_z @ _by_scale(pieces, np.repeat(interval.inputs, parts, axis=0))
        return moved, from_z @ found.Phi @ _to_invariant(u_0), G, from_z @ found.Q @ from_z.T

    def residual(self, before: Values, after: Values, intervals: Intervals) -> Residual:
        """Return ``[log(T_1 f(T_0)^-1); u_1 - f_u; b_1 - b_0]`` (m, 15), eq. (14), with its derivatives."""
        m = len(intervals)
        error, by_before, by_after = np.zeros((m, 15)), *np.zeros((2, m, 15, self.layout.body))
        for k in range(m):
            moved, F, G, _ = self._moved(_at({**after, **before}, k), intervals[k])
            T = after["pose"][k] @ se3.inverse(moved["pose"])
            others = [after[name][k] - moved[name] for name in self.own[1:]]
            error[k] = np.concatenate([se3.log(T), *others])
            turn = se3.left_jacobian_inverse(-error[k, :6])
            F[:6], G[:6] = turn @ F[:6], turn @ G[:6]
            by_before[k][:, self.columns], by_after[k][:, self._scale] = -F, -G
        by_after[:, np.arange(15), self.columns] = 1.0
        by_after[:, :6, self.layout["pose"]] = se3.left_jacobian_inverse(error[:, :6])
        return Residual(error, by_before, by_after)

    def begin(self, values: Values, inputs: Array) -> Array:
        inputs = applied(values[ImuScale.name], inputs) if self.has_scale else inputs
        return np.concatenate([values[Velocity.name], inputs[:3] - values[GyroBias.name]])

    def imu_twist(self, before: Values, after: Values, interval: Interval | Intervals) -> Array:
        """Return ``[u; w]`` (..., 6); w is extrapolated to the end of the interval from its last two pieces."""
        if isinstance(interval, Intervals):
            each = [self.imu_twist({}, _at(after, k), interval[k]) for k in range(len(interval))]
            return np.array(each).reshape(len(interval), 6)
        ends = _rate_at_end(self._scaled(after, interval))
        return np.concatenate([after[Velocity.name], ends - after[GyroBias.name]], axis=-1)

    def referred(self, measured: Measured, values: Values, interval: Interval) -> Measured:
        """Return means of linear velocities over an interval as velocities before it: less the change by the samples.

        That change depends on the state by the length of the interval only, which is left out.
        """
        if (measured.axis > 2).any():
            raise ConfigError("beside inertial samples, only linear velocities can be measured: v_x, v_y, v_z")
        T, first, gyro_bias, accel_bias = (values[name] for name in self.own)
        interval = self._scaled(values, interval)
        u, g, change = first, T[:3, :3] @ self._g, np.zeros(3)
        for dt, sample in zip(interval.dt_s, interval.inputs, strict=True):
            back = se3.so3_exp(-dt * (sample[:3] - gyro_bias))
            after, g = back @ (u + dt * (sample[3:] - accel_bias + g)), back @ g
            change, u = change + 0.5 * dt * (u + after - 2.0 * first), after
        return replace(measured, value=measured.value - (change / interval.tau_s)[measured.axis])

    def way_m(self, values: Values, interval: Interval | Intervals) -> Array:
        """Return the way at the speed before the interval."""
        return np.asarray(np.linalg.norm(values[Velocity.name], axis=-1) * np.asarray(interval.tau_s))


def _at(values: Values, k: int) -> dict[str, Array]:
    return {name: value[k] for name, value in values.items()}


def _rate_at_end(interval: Interval) -> Array:
    dt, w = interval.dt_s, interval.inputs[:, :3]
    return w[-1] if len(w) < 2 else w[-1] + (w[-1] - w[-2]) * dt[-1] / (dt[-1] + dt[-2])


def _by_scale(pieces: Increment, inputs: Array) -> Array:
    """Return the derivative (15, 15) of ``z`` after all pieces by the matrices of the unit; its samples are (n, 6)."""
    # A change of the samples of a piece is one of the biases that ends with it, with the other sign.
    of_piece = pieces.Phi[:, :, BG.start :].copy()
    of_piece[:, BG.start :] = 0.0
    by, later = np.zeros((15, 15)), np.eye(15)
    for Phi, J in zip(pieces.Phi[::-1], (of_piece @ by_value(inputs))[::-1], strict=True):
        by, later = by - later @ J, later @ Phi
    return by


def _to_invariant(u: Array) -> Array:
    """S (15, 15): ``phi = -theta``, ``nu = du + u^ theta``, ``r = -rho``."""
    S = np.eye(15)
    S[:9, :9] = 0.0
    S[PHI, _THETA], S[NU, _THETA], S[NU, _U], S[R, _RHO] = -_EYE, se3.skew(u), _EYE, -_EYE
    return S


def _from_invariant(u: Array) -> Array:
    """Return the inverse of `_to_invariant`: ``theta = -phi``, ``du = nu + u^ phi``, ``rho = -r``."""
    S = np.eye(15)
    S[:9, :9] = 0.0
    S[_THETA, PHI], S[_U, PHI], S[_U, NU], S[_RHO, R] = -_EYE, se3.skew(u), _EYE, -_EYE
    return S


def _to_world(T_imu_world: Array) -> Array:
    """L (9, 9) from pose and velocity errors to right-invariant errors of SE_2(3) in world, (rho, theta, nu)."""
    L, R = np.zeros((9, 9)), T_imu_world[:3, :3].T
    p = -R @ T_imu_world[:3, 3]
    L[:3, :3] = L[3:6, 3:6] = -R
    L[:3, 3:6], L[6:, 6:] = -se3.skew(p) @ R, R
    return L
