"""A gyroscope and an accelerometer move pose and velocity; their biases walk.

Inputs are the mean samples ``[w; f]`` of short pieces, rad/s and m/s^2. The means are exact for inputs that are
constant during a piece, and so are the error transition and the noise: in the left-invariant error
``z = (phi, nu, r, bg, ba)``, ``T_world_imu = T_hat exp(z^)``, the generator depends on w and f alone. Errors of the
state are those of its blocks: ``T_imu_world = exp(xi^) T_hat``, and additive ones of body velocity and biases. This is
the imperfect invariant EKF of Barrau and Bonnabel (2017) and Hartley et al. (IJRR 2020), with the velocity in the body.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.inputs import InertialNoise, InertialSamples
from ekfslam.data.interval import Interval, Intervals
from ekfslam.data.noise import Noise
from ekfslam.geometry import se3
from ekfslam.models.blocks import AccelBias, GyroBias, Velocity
from ekfslam.models.blocks.base import Layout, StateBlock, Values
from ekfslam.models.process.base import MakeProcess, Process, Residual, Step

GRAVITY_M_S2 = 9.81
_TERMS, _LONGEST_S = 10, 0.05  # of the series in the duration; longer pieces are divided, so the rest is rounding
_GAP_FACTOR = 10.0  # by which densities of white noise grow in an interval with a gap between its samples
_PHI, _NU, _R, _BG, _BA = (slice(3 * i, 3 * i + 3) for i in range(5))  # of z
_RHO, _THETA, _U = _PHI, _NU, _R  # of the blocks
_EYE = np.eye(3)
INERTIAL_BLOCKS: dict[str, type[StateBlock]] = {block.name: block for block in (Velocity, GyroBias, AccelBias)}


def inertial(noise: InertialNoise, gravity_m_s2: float = GRAVITY_M_S2) -> MakeProcess:
    """Return a maker of inertial processes with these densities and this magnitude of gravity."""

    def make(layout: Layout, _: Noise) -> Process:
        return Inertial(layout, noise, gravity_m_s2)

    return make


@dataclass(frozen=True)
class Increment:
    """Preintegrated samples: motion from (I, 0, 0) without gravity; leading dimensions are free.

    Args:
        R, v, p: (..., 3, 3), (..., 3) m/s, (..., 3) m at the end, in the IMU frame at the start.
        tau_s: (...) duration.
        Phi, Q: (..., 15, 15) transition and noise of ``z``.
    """

    R: Array
    v: Array
    p: Array
    tau_s: Array
    Phi: Array
    Q: Array

    def __getitem__(self, index: slice | int) -> Increment:
        return Increment(*(part[index] for part in vars(self).values()))

    def then(self, later: Increment) -> Increment:
        """Return the composition with a later increment; it is associative."""
        tau, Phi = later.tau_s[..., None], later.Phi
        return Increment(
            self.R @ later.R,
            self.v + _times(self.R, later.v),
            self.p + self.v * tau + _times(self.R, later.p),
            self.tau_s + later.tau_s,
            Phi @ self.Phi,
            Phi @ self.Q @ np.swapaxes(Phi, -1, -2) + later.Q,
        )

    def total(self) -> Increment:
        """Return the composition of all increments (n, ...), as a tree of batched products."""
        parts = self
        while (n := len(parts.tau_s)) > 1:
            pairs = parts[0 : n - 1 : 2].then(parts[1:n:2])
            both = zip(vars(pairs).values(), vars(parts[n - n % 2 :]).values(), strict=True)
            parts = Increment(*(np.concatenate(pair) for pair in both))
        return parts[0]


def increments(interval: Interval, noise: InertialNoise, gyro_bias: Array, accel_bias: Array) -> Increment:
    """Return the increments (n, ...) of the pieces of an interval, exact for inputs constant during each piece."""
    parts = np.ceil(interval.dt_s / _LONGEST_S).astype(int)
    dt = np.repeat(interval.dt_s / parts, parts)[:, None]
    inputs = np.repeat(interval.inputs, parts, axis=0)
    w, f = inputs[:, :3] - gyro_bias, inputs[:, 3:] - accel_bias
    G_0, G_1, G_2 = gammas(w * dt)
    A = np.zeros((len(dt), 15, 15))
    A[:, _PHI, _PHI] = A[:, _NU, _NU] = A[:, _R, _R] = -se3.skew(w)
    A[:, _NU, _PHI], A[:, _R, _NU] = -se3.skew(f), _EYE
    A[:, _PHI, _BG] = A[:, _NU, _BA] = -_EYE
    A *= dt[..., None]
    white = _GAP_FACTOR if interval.is_gap else 1.0
    density = np.repeat([white * noise.gyro, white * noise.accel, 0.0, noise.gyro_walk, noise.accel_walk], 3)
    Phi, Q = np.eye(15), dt[..., None] * np.diag(density**2)
    term = Q
    for k in range(2, _TERMS + 1):
        half = A @ term
        term = (half + np.swapaxes(half, 1, 2)) / k
        Q = Q + term
    for k in range(_TERMS, 0, -1):
        Phi = np.eye(15) + A @ Phi / k
    return Increment(G_0, _times(G_1, f * dt), _times(G_2, f * dt**2), dt[:, 0], Phi, Q)


def gammas(phi: Array) -> tuple[Array, Array, Array]:
    """Return ``Gamma_n(phi) = sum_k (phi^)^k / (k+n)!`` for n = 0, 1, 2: (..., 3) rad to (..., 3, 3) each."""
    _, phi_1, phi_2, phi_3, phi_4, _ = se3.phis(np.sum(phi * phi, axis=-1)[..., None, None])
    W = se3.skew(phi)
    WW = W @ W
    return _EYE + phi_1 * W + phi_2 * WW, _EYE + phi_2 * W + phi_3 * WW, 0.5 * _EYE + phi_3 * W + phi_4 * WW


@dataclass(frozen=True)
class Inertial(Process):
    """Inertial samples move pose and body velocity.

    Args:
        layout: Columns of all blocks.
        noise: Densities of the samples.
        gravity_m_s2: Magnitude of gravity; its direction is -z of world.
    """

    layout: Layout
    noise: InertialNoise
    gravity_m_s2: float = GRAVITY_M_S2

    own = ("pose", Velocity.name, GyroBias.name, AccelBias.name)
    takes = InertialSamples

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
        moved, F, Q = self._moved(values, interval)
        if first_estimates:
            F[:9, :9] = F[:9, :9] @ np.linalg.solve(_to_world(values["pose"]), _to_world(T_linear))
        Phi = np.zeros((15, self.layout.body))
        Phi[:, self.columns] = F
        return Step(moved, self.imu_twist(values, moved, interval), Phi, Q)

    def _moved(self, values: Values, interval: Interval) -> tuple[dict[str, Array], Array, Array]:
        """Return the blocks after an interval, F and Q (15, 15) of their errors."""
        T, u_0, gyro_bias, accel_bias = (values[name] for name in self.own)
        found = increments(interval, self.noise, gyro_bias, accel_bias).total()
        tau, g, back = found.tau_s, T[:3, :3] @ self._g, found.R.T
        u_1 = back @ (u_0 + g * tau + found.v)
        C = back @ T[:3, :3]
        t = back @ (T[:3, 3] - u_0 * tau - 0.5 * g * tau**2 - found.p)
        from_z = _from_invariant(u_1)
        moved = dict(zip(self.own, (se3.transform(C, t), u_1, gyro_bias, accel_bias), strict=True))
        return moved, from_z @ found.Phi @ _to_invariant(u_0), from_z @ found.Q @ from_z.T

    def residual(self, before: Values, after: Values, intervals: Intervals) -> Residual:
        """Return ``[log(T_1 f(T_0)^-1); u_1 - f_u; b_1 - b_0]`` (m, 15) with its derivatives."""
        m = len(intervals)
        error, by_before, by_after = np.zeros((m, 15)), *np.zeros((2, m, 15, self.layout.body))
        for k in range(m):
            moved, F, _ = self._moved(_at(before, k), intervals[k])
            T = after["pose"][k] @ se3.inverse(moved["pose"])
            others = [after[name][k] - moved[name] for name in self.own[1:]]
            error[k] = np.concatenate([se3.log(T), *others])
            F[:6] = se3.left_jacobian_inverse(-error[k, :6]) @ F[:6]
            by_before[k][:, self.columns] = -F
        by_after[:, np.arange(15), self.columns] = 1.0
        by_after[:, :6, self.layout["pose"]] = se3.left_jacobian_inverse(error[:, :6])
        return Residual(error, by_before, by_after)

    def begin(self, values: Values, inputs: Array) -> Array:
        return np.concatenate([values[Velocity.name], inputs[:3] - values[GyroBias.name]])

    def imu_twist(self, before: Values, after: Values, interval: Interval | Intervals) -> Array:
        """Return ``[u; w]`` (..., 6); w is extrapolated to the end of the interval from its last two pieces."""
        if isinstance(interval, Intervals):
            ends = np.array([_rate_at_end(interval[k]) for k in range(len(interval))]).reshape(len(interval), 3)
        else:
            ends = _rate_at_end(interval)
        return np.concatenate([after[Velocity.name], ends - after[GyroBias.name]], axis=-1)

    def way_m(self, values: Values, interval: Interval | Intervals) -> Array:
        """Return the way at the speed before the interval."""
        return np.asarray(np.linalg.norm(values[Velocity.name], axis=-1) * np.asarray(interval.tau_s))


def _times(M: Array, v: Array) -> Array:
    return (M @ v[..., None])[..., 0]


def _at(values: Values, k: int) -> dict[str, Array]:
    return {name: value[k] for name, value in values.items()}


def _rate_at_end(interval: Interval) -> Array:
    dt, w = interval.dt_s, interval.inputs[:, :3]
    return w[-1] if len(w) < 2 else w[-1] + (w[-1] - w[-2]) * dt[-1] / (dt[-1] + dt[-2])


def _to_invariant(u: Array) -> Array:
    """S (15, 15): ``phi = -theta``, ``nu = du + u^ theta``, ``r = -rho``."""
    S = np.eye(15)
    S[:9, :9] = 0.0
    S[_PHI, _THETA], S[_NU, _THETA], S[_NU, _U], S[_R, _RHO] = -_EYE, se3.skew(u), _EYE, -_EYE
    return S


def _from_invariant(u: Array) -> Array:
    """Return the inverse of `_to_invariant`: ``theta = -phi``, ``du = nu + u^ phi``, ``rho = -r``."""
    S = np.eye(15)
    S[:9, :9] = 0.0
    S[_THETA, _PHI], S[_U, _PHI], S[_U, _NU], S[_RHO, _R] = -_EYE, se3.skew(u), _EYE, -_EYE
    return S


def _to_world(T_imu_world: Array) -> Array:
    """L (9, 9) from pose and velocity errors to right-invariant errors of SE_2(3) in world, (rho, theta, nu)."""
    L, R = np.zeros((9, 9)), T_imu_world[:3, :3].T
    p = -R @ T_imu_world[:3, 3]
    L[:3, :3] = L[3:6, 3:6] = -R
    L[:3, 3:6], L[6:, 6:] = -se3.skew(p) @ R, R
    return L
