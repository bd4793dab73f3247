"""Cumulative cubic B-splines through poses: a smooth motion with exact velocities and accelerations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array
from ekfslam.geometry import se3

# Rows: coefficients of 1, u, u^2, u^3 of the cumulative basis functions 1 to 3.
_BASIS = np.array([[5.0, 3.0, -3.0, 1.0], [1.0, 3.0, 3.0, -2.0], [0.0, 0.0, 0.0, 1.0]]) / 6.0


@dataclass(frozen=True)
class Motion:
    """A motion at some times."""

    T_world_imu: Array  # (n, 4, 4) poses
    velocity_m_s: Array  # velocity_m_s, acceleration_m_s2: (n, 3) in world
    acceleration_m_s2: Array
    rate_rad_s: Array  # (n, 3) in the body

    def specific_force(self, gravity_m_s2: float) -> Array:
        """Return what an accelerometer in the body measures (n, 3), m/s^2."""
        up = np.array([0.0, 0.0, gravity_m_s2])
        return (np.swapaxes(self.T_world_imu[:, :3, :3], 1, 2) @ (self.acceleration_m_s2 + up)[..., None])[..., 0]


@dataclass(frozen=True)
class PoseSpline:
    """Uniform cumulative cubic B-spline, separate for position and rotation."""

    begin_s: float  # time of the second control pose, where the spline begins; it ends at the last but one
    step_s: float  # time between control poses
    T: Array  # (k, 4, 4) control poses T_world_imu, which the spline passes closely

    @property
    def end_s(self) -> float:
        """Last time at which the spline is defined."""
        return self.begin_s + (len(self.T) - 3) * self.step_s

    def at(self, time_s: Array) -> Motion:
        """Return the motion at times (n,) between ``begin_s`` and ``end_s``."""
        x = (np.asarray(time_s) - self.begin_s) / self.step_s
        first = np.clip(np.floor(x).astype(int), 0, len(self.T) - 4)
        u = x - first
        zero, one = np.zeros_like(u), np.ones_like(u)
        b = _BASIS @ np.array([one, u, u**2, u**3])
        db = _BASIS @ np.array([zero, one, 2 * u, 3 * u**2]) / self.step_s
        ddb = _BASIS @ np.array([zero, zero, 2 * one, 6 * u]) / self.step_s**2
        R, p = self.T[:, :3, :3], self.T[:, :3, 3]
        steps, turns = np.diff(p, axis=0), se3.so3_log(np.swapaxes(R[:-1], 1, 2) @ R[1:])
        position, velocity, acceleration = p[first], np.zeros((len(u), 3)), np.zeros((len(u), 3))
        rotation, rate = R[first], np.zeros((len(u), 3))
        for j in range(3):
            d, turn = steps[first + j], turns[first + j]
            position = position + b[j][:, None] * d
            velocity = velocity + db[j][:, None] * d
            acceleration = acceleration + ddb[j][:, None] * d
            E = se3.so3_exp(b[j][:, None] * turn)
            rotation = rotation @ E
            rate = (np.swapaxes(E, 1, 2) @ rate[..., None])[..., 0] + db[j][:, None] * turn
        return Motion(se3.transform(rotation, position), velocity, acceleration, rate)


def resampled(time_s: Array, T: Array, wanted_s: Array) -> Array:
    """Return poses (m, 4, 4) at some times, linear in position and rotation between stamps (n,)."""
    k = np.clip(np.searchsorted(time_s, wanted_s) - 1, 0, len(time_s) - 2)
    share = ((wanted_s - time_s[k]) / (time_s[k + 1] - time_s[k]))[:, None]
    R, p = T[:, :3, :3], T[:, :3, 3]
    turn = se3.so3_log(np.swapaxes(R[k], 1, 2) @ R[k + 1])
    return se3.transform(R[k] @ se3.so3_exp(share * turn), p[k] + share * (p[k + 1] - p[k]))
