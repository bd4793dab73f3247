"""Preintegration of a gyroscope and an accelerometer: motion, error transition and noise of short pieces, composed.

Errors are left-invariant, ``T_world_imu = T_hat exp(z^)`` with ``z = (phi, nu, r, bg, ba)``: rotation, velocity,
position, biases. All results are exact for samples that are constant during a piece. Source: Barrau and Bonnabel, "The
invariant extended Kalman filter as a stable observer", IEEE TAC 2017.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array
from ekfslam.geometry import se3

LONGEST_S, WIDEST_RAD = 0.05, 0.1  # of a piece, so that the rest of the series below is rounding
_TERMS = 10
PHI, NU, R, BG, BA = (slice(3 * i, 3 * i + 3) for i in range(5))  # of z
_EYE = np.eye(3)


@dataclass(frozen=True)
class Increment:
    """Preintegrated samples: motion from (I, 0, 0) without gravity; leading dimensions are free."""

    R: Array  # R, v, p: (..., 3, 3), (..., 3) m/s, (..., 3) m at the end, in the IMU frame at the start
    v: Array
    p: Array
    tau_s: Array
    Phi: Array  # Phi, Q: (..., 15, 15) transition and noise of z
    Q: Array

    def __getitem__(self, index: slice | int) -> Increment:
        return Increment(*(part[index] for part in vars(self).values()))

    def then(self, later: Increment) -> Increment:
        """Return the composition with a later increment; it is associative."""
        tau, Phi = later.tau_s[..., None], later.Phi
        return Increment(
            self.R @ later.R,
            self.v + times(self.R, later.v),
            self.p + self.v * tau + times(self.R, later.p),
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


def gammas(phi: Array) -> tuple[Array, Array, Array]:
    """Return ``Gamma_n(phi) = sum_k (phi^)^k / (k+n)!`` for n = 0, 1, 2: (..., 3) rad to (..., 3, 3) each."""
    _, phi_1, phi_2, phi_3, phi_4, _ = se3.phis(np.sum(phi * phi, axis=-1)[..., None, None])
    W = se3.skew(phi)
    WW = W @ W
    return _EYE + phi_1 * W + phi_2 * WW, _EYE + phi_2 * W + phi_3 * WW, 0.5 * _EYE + phi_3 * W + phi_4 * WW


def increments(dt_s: Array, gyro: Array, accel: Array, density: Array) -> Increment:
    """Return the increments (n, ...) of pieces, exact for samples that are constant during each.

    Args:
        dt_s: (n,) durations, at most `LONGEST_S`.
        gyro, accel: (n, 3) angular rates and specific forces without biases, rad/s and m/s^2.
        density: (15,) square roots of the spectral densities of the noise that drives ``z``.
    """
    dt = dt_s[:, None]
    G_0, G_1, G_2 = gammas(gyro * dt)
    A = np.zeros((len(dt), 15, 15))
    A[:, PHI, PHI] = A[:, NU, NU] = A[:, R, R] = -se3.skew(gyro)
    A[:, NU, PHI], A[:, R, NU] = -se3.skew(accel), _EYE
    A[:, PHI, BG] = A[:, NU, BA] = -_EYE
    A *= dt[..., None]
    Phi, Q = np.eye(15), dt[..., None] * np.diag(density**2)
    term = Q
    for k in range(2, _TERMS + 1):
        half = A @ term
        term = (half + np.swapaxes(half, 1, 2)) / k
        Q = Q + term
    for k in range(_TERMS, 0, -1):
        Phi = np.eye(15) + A @ Phi / k
    return Increment(G_0, times(G_1, accel * dt), times(G_2, accel * dt**2), dt_s, Phi, Q)


def times(M: Array, v: Array) -> Array:
    """Return products (..., 3) of matrices (..., 3, 3) and vectors (..., 3)."""
    return np.asarray((M @ v[..., None])[..., 0])
