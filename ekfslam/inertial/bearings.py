"""First velocity and gravity of one camera with an inertial unit, from the tracks of a window.

Given the rotations of the gyroscope, landmarks m, first velocity v and gravity g (in the first IMU frame) are linear in
every observation: at time t, with integrated samples (R, p) and the camera at c in the IMU frame,

    q = R_cam_imu (R^T (m - v t - g t^2 / 2 - p) - c),    f (q_x, q_y) - (u - u_0, v - v_0) q_z = 0.

Landmarks are eliminated, g has its known magnitude, rows are weighted by depth and robustly, and the bias of the
gyroscope is that with the least residual. Source: Dong-Si and Mourikis, "Estimator initialization in vision-aided
inertial navigation with unknown camera-IMU calibration", IROS 2012.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.data.inputs import InertialSamples
from ekfslam.data.sequence import Sequence
from ekfslam.geometry.preintegration import LONGEST_S, Increment, increments
from ekfslam.models.inertial_start import FirstPrior

_LEAST_SEEN, _LEAST_TRACKS = 4, 8  # observations of a track, tracks
_ROUNDS, _PASSES, _STEP_RAD_S, _SMALL_RAD_S = 8, 3, 1e-4, 1e-5
_KERNEL, _LEAST_DEPTH_M = 3.0, 0.1  # standard deviations


class RefusedWindowError(Exception):
    """A window does not serve."""


@dataclass(frozen=True)
class Guess:
    """First velocity, direction up and gyroscope bias in the first IMU frame."""

    velocity_m_s: Array
    up: Array
    gyro_bias_rad_s: Array
    text: str  # what else was found


def integrated(dt_s: Array, inputs: Array, gyro_bias: Array) -> Increment:
    """Return the samples of an interval as one increment."""
    parts = np.ceil(dt_s / LONGEST_S).astype(int)
    inputs, dt_s = np.repeat(inputs, parts, axis=0), np.repeat(dt_s / parts, parts)
    return increments(dt_s, inputs[:, :3] - gyro_bias, inputs[:, 3:], np.zeros(15)).total()


def by_bearings(sequence: Sequence, end: int, std_px: float, prior: FirstPrior) -> Guess:
    """Return the guess from the frames before ``end``; a `RefusedWindowError` says why there is none."""
    window = _Window.of(sequence, end, std_px, prior)
    bias, at = np.zeros(3), window.solved(np.zeros(3), None)
    for _ in range(_ROUNDS):
        here = window.solved(bias, at)  # with the same weights as the shifted ones
        shifted = [window.solved(bias + _STEP_RAD_S * axis, at).residual for axis in np.eye(3)]
        J = (np.stack(shifted, axis=1) - here.residual[:, None]) / _STEP_RAD_S
        by_prior = np.eye(3) / prior.gyro_bias_std_rad_s
        r = np.append(here.residual, by_prior @ bias)
        step = -np.linalg.lstsq(np.vstack([J, by_prior]), r, rcond=None)[0]
        bias, at = bias + step, here
        if np.abs(step).max() < _SMALL_RAD_S:
            break
    at = window.solved(bias, at)
    return Guess(at.v, -at.g / np.linalg.norm(at.g), bias, "")


@dataclass(frozen=True)
class _Solution:
    v: Array
    g: Array
    weight: Array  # (n,) of each observation: robust weight over depth
    residual: Array  # (2n,) without what the landmarks take


@dataclass(frozen=True)
class _Window:
    """Observations (n,) of tracks that are seen often enough."""

    intervals: list
    since_s: Array  # (frames,)
    T_cam_imu: Array
    frame: IntArray
    track: IntArray  # number of the track, ascending
    rows: Array  # (n, 2, 3) coefficients of q, px over std
    gravity_m_s2: float
    accel_bias_std_m_s2: float

    @staticmethod
    def of(sequence: Sequence, end: int, std_px: float, prior: FirstPrior) -> _Window:
        """Return the frames before ``end``."""
        o, camera = sequence.observations, sequence.camera
        inside = np.flatnonzero(o.frame < end)
        _, which, count = np.unique(o.landmark[inside], return_inverse=True, return_counts=True)
        inside = inside[count[which] >= _LEAST_SEEN]
        inside = inside[np.argsort(o.landmark[inside], kind="stable")]
        ids, track = np.unique(o.landmark[inside], return_inverse=True)
        if len(ids) < _LEAST_TRACKS:
            raise RefusedWindowError(f"only {len(ids)} tracks of at least {_LEAST_SEEN} observations")
        rows = np.zeros((len(inside), 2, 3))
        rows[:, 0, 0], rows[:, 1, 1] = camera.fu_px, camera.fv_px
        rows[:, :, 2] = [camera.cu_px, camera.cv_px] - o.pixels_px[inside, :2]
        intervals = [sequence.interval(k, InertialSamples) for k in range(1, end)]
        since = sequence.time_s[:end] - sequence.time_s[0]
        return _Window(
            intervals,
            since,
            sequence.T_cam_imu,
            o.frame[inside],
            track,
            rows / std_px,
            prior.gravity_m_s2,
            prior.accel_bias_std_m_s2,
        )

    def solved(self, bias: Array, last: _Solution | None) -> _Solution:
        """Return velocity and gravity for a gyroscope bias, with the weights of the last solution."""
        R, p, by_accel = self._integrated(bias)
        t, k = self.since_s, self.frame
        C, c = self.T_cam_imu[:3, :3], self.T_cam_imu[:3, 3]
        H = self.rows @ (C @ R[k].swapaxes(1, 2))
        b = np.einsum("nij,nj->ni", H, p[k]) - self.rows @ c
        by = np.stack([t[:, None, None] * np.eye(3), 0.5 * t[:, None, None] ** 2 * np.eye(3), by_accel], axis=1)
        by = np.concatenate(list(np.moveaxis(by, 1, 0)), axis=2)  # (frames, 3, 9) of the position of the IMU
        A = -H @ by[k]
        weight, g = (np.ones(len(k)), None) if last is None else (last.weight, last.g)
        for _ in range(_PASSES if last is None else 1):
            x, m, residual, g = self._eliminated(weight, A, H, b, g)
            ahead = (C @ R[k].swapaxes(1, 2))[:, 2]
            q_z = np.einsum("nj,nj->n", ahead, m[self.track] - by[k] @ x - p[k]) + c[2]
            r = np.linalg.norm(A @ x + np.einsum("nij,nj->ni", H, m[self.track]) - b, axis=1)
            depth = np.maximum(q_z, _LEAST_DEPTH_M)
            new = 1.0 / depth / np.sqrt(1.0 + (r / depth / _KERNEL) ** 2)
            if last is None:
                weight = new
        return _Solution(x[:3], x[3:6], new, residual)

    def _integrated(self, bias: Array) -> tuple[Array, Array, Array]:
        """Return rotations (frames, 3, 3) to the first IMU frame and displacements (frames, 3) by samples alone.

        The last result (frames, 3, 3) is their derivative by the bias of the accelerometer.
        """
        R, p, V, J, J_v = [np.eye(3)], [np.zeros(3)], np.zeros(3), [np.zeros((3, 3))], np.zeros((3, 3))
        for interval in self.intervals:
            part = integrated(interval.dt_s, interval.inputs, bias)
            tau = float(part.tau_s)
            p.append(p[-1] + V * tau + R[-1] @ part.p)
            J.append(J[-1] + tau * J_v - 0.5 * tau**2 * R[-1])
            V, J_v, R = V + R[-1] @ part.v, J_v - tau * R[-1], [*R, R[-1] @ part.R]
        return np.array(R), np.array(p), np.array(J)

    def _eliminated(
        self, weight: Array, A: Array, H: Array, b: Array, g: Array | None
    ) -> tuple[Array, Array, Array, Array]:
        """Return velocity, gravity and bias of the accelerometer (9,), landmarks (M, 3), the residual (2n,), and g."""
        A, H, b = weight[:, None, None] * A, weight[:, None, None] * H, weight[:, None] * b
        begins = np.searchsorted(self.track, np.arange(self.track[-1] + 2))
        left, values, solvers = np.empty_like(A), np.empty_like(b), []
        for i, j in zip(begins[:-1].tolist(), begins[1:].tolist(), strict=True):
            Q, S = np.linalg.qr(H[i:j].reshape(-1, 3))
            solvers.append((np.linalg.pinv(S) @ Q.T, A[i:j].reshape(-1, 9), b[i:j].ravel()))
            left[i:j] = (solvers[-1][1] - Q @ (Q.T @ solvers[-1][1])).reshape(-1, 2, 9)
            values[i:j] = (solvers[-1][2] - Q @ (Q.T @ solvers[-1][2])).reshape(-1, 2)
        prior = np.hstack([np.zeros((3, 6)), np.eye(3) / self.accel_bias_std_m_s2])
        rows, y = np.vstack([left.reshape(-1, 9), prior]), np.append(values.ravel(), np.zeros(3))
        if g is None:
            g = np.linalg.lstsq(rows, y, rcond=None)[0][3:6]
        for _ in range(4):
            g = self.gravity_m_s2 * g / np.linalg.norm(g)
            tangent = np.linalg.svd(g[None])[2][1:].T
            free = np.hstack([rows[:, :3], rows[:, 3:6] @ tangent, rows[:, 6:]])
            x = np.linalg.lstsq(free, y - rows[:, 3:6] @ g, rcond=None)[0]
            g = g + tangent @ x[3:5]
        both = np.concatenate([x[:3], g, x[5:]])
        m = np.array([solver @ (value - by @ both) for solver, by, value in solvers])
        return both, m, rows @ both - y, g
