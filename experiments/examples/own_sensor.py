"""Your own sensor: range, bearing and elevation of landmarks, as of a radar or a laser scanner.

It shows what the filter needs of a sensor (`ekfslam.models.sensors.base.Sensor`): rows with their variances, ``h(q)``,
its Jacobian and its inverse; and how to tell from NEES over some drives whether the covariance is true.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.config import FilterConfig
from ekfslam.data.noise import Noise
from ekfslam.evaluation.consistency import nees, pose_error
from ekfslam.filters import JointEKF
from ekfslam.filters.loop import one_thread
from ekfslam.geometry import se3
from ekfslam.models.sensors.base import ACCEPTED, Sensor


@dataclass(frozen=True)
class Radar:
    """Rows (range m, bearing rad, elevation rad) of points in its own frame: x forward, y left, z up.

    It looks forward. A residual is a plain difference of rows: bearings must keep away from +-pi.
    """

    noise: Noise
    T_cam_imu: Array = field(default_factory=lambda: se3.transform(np.eye(3), np.array([-2.0, 0.0, -0.5])))
    std: tuple[float, float, float] = (0.1, 0.01, 0.01)

    dimension = 3

    def screen(self, measured: Array, min_depth_m: float) -> IntArray:
        return np.full(len(measured), ACCEPTED)

    def in_view(self, q: Array, min_depth_m: float) -> BoolArray:
        return q[..., 0] > min_depth_m

    def rows(self, measured: Array) -> Array:
        return measured

    def variance(self, rows: Array) -> Array:
        return np.broadcast_to(np.square(self.std), rows.shape)

    def predict(self, q: Array) -> Array:
        x, y, z = np.moveaxis(q, -1, 0)
        return np.stack([np.linalg.norm(q, axis=-1), np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))], axis=-1)

    def jacobian(self, q: Array) -> Array:
        x, y, z = np.moveaxis(q, -1, 0)
        r, ground, zero = np.linalg.norm(q, axis=-1), np.hypot(x, y), np.zeros_like(x)
        by_range = np.stack([x, y, z], axis=-1) / r[..., None]
        by_bearing = np.stack([-y, x, zero], axis=-1) / (ground**2)[..., None]
        by_elevation = np.stack([-x * z / ground, -y * z / ground, ground], axis=-1) / (r**2)[..., None]
        return np.stack([by_range, by_bearing, by_elevation], axis=-2)

    def invert(self, rows: Array) -> Array:
        r, bearing, elevation = np.moveaxis(rows, -1, 0)
        ground = r * np.cos(elevation)
        return np.stack([ground * np.cos(bearing), ground * np.sin(bearing), r * np.sin(elevation)], axis=-1)


def drive(sensor: Radar, rng: np.random.Generator, frames: int = 30) -> tuple[float, float]:
    """One lap of a ring; the last pose's NEES (6 degrees of freedom) and its error in m."""
    twist, tau_s = np.array([8.0, 0, 0, 0, 0, 0.8]), 2 * np.pi / 0.8 / frames
    landmarks = np.array([0.0, 10.0, 1.0]) + rng.uniform(-1, 1, (60, 3)) * [25, 25, 2]
    a_sensor: Sensor = sensor  # the type checker says what a sensor lacks
    config = FilterConfig(retire="never", gate_probability=1.0, split_after=0)  # nothing is censored: NEES is exact
    ekf, T_world_imu = JointEKF(a_sensor, config, np.eye(4)), np.eye(4)
    for frame in range(frames):
        if frame > 0:
            T_world_imu = T_world_imu @ se3.exp(tau_s * twist)
            ekf.predict(twist + sensor.noise.twist_std * rng.standard_normal(6), tau_s)
        q = se3.apply(sensor.T_cam_imu @ se3.inverse(T_world_imu), landmarks)
        ids = np.flatnonzero((q[:, 0] > 2.0) & (np.linalg.norm(q, axis=1) < 25.0))
        ekf.update(frame, ids, sensor.predict(q[ids]) + sensor.std * rng.standard_normal((len(ids), 3)))
    xi = pose_error(ekf.T_world_imu, T_world_imu)
    return float(nees(xi, ekf.P[:6, :6])), float(np.linalg.norm(xi[:3]))


def main() -> None:
    sensor, rng = Radar(Noise.isotropic(0.3, 0.03, 0.0)), np.random.default_rng(0)  # no pixels: their noise is unused
    q, step = rng.uniform(2.0, 20.0, (50, 3)), 1e-6
    by_differences = [(sensor.predict(q + h) - sensor.predict(q - h)) / (2 * step) for h in step * np.eye(3)]
    wrong = np.abs(np.stack(by_differences, axis=-1) - sensor.jacobian(q)).max()
    print(f"Jacobian against differences: {wrong:.1e}")
    with one_thread():
        values, errors_m = np.transpose([drive(sensor, rng) for _ in range(40)])
    print(f"mean error of the last position: {errors_m.mean():.3f} m")
    spread = np.sqrt(12 / len(values))  # standard deviation of such a mean, were the covariance true
    print(f"mean pose NEES of {len(values)} drives: {values.mean():.2f} (6 +- {spread:.2f} expected)")


if __name__ == "__main__":
    main()
