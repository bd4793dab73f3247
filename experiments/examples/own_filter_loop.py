"""Live data frame by frame, without a `Sequence`: `JointEKF.predict` and `update`, and queries in between.

It shows how to build a filter with a map revival (landmarks out of view leave the state, and come back exactly when
they are seen again), and how to read pose, covariance, and the joint covariance of any landmarks in view.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.config import FilterConfig
from ekfslam.data.noise import Noise
from ekfslam.data.simulate import CAMERA, T_CAM_IMU, Loop, simulate
from ekfslam.filters import JointEKF
from ekfslam.filters.loop import one_thread
from ekfslam.models.build import model_of
from ekfslam.models.sensors.stereo import Rig
from ekfslam.smoother.revival import MapRevival

RECORDED = simulate(Loop(frames=220))  # a lap has 157 frames


def live() -> Iterator[tuple[float, Array, IntArray, Array]]:
    """Stands for a vehicle: stamp, velocities since the last one, ids (n,) and pixels (n, 4) of what is in view."""
    for k, time_s in enumerate(RECORDED.time_s):
        yield float(time_s), RECORDED.twist[k], *RECORDED.observations.at(k)


def main() -> None:
    noise = Noise.isotropic(sigma_v_m_s=0.5, sigma_w_rad_s=0.05, sigma_px=1.0)
    config = FilterConfig(retire="unseen", retire_after=10, revive=20)
    model = model_of(Rig(CAMERA, T_CAM_IMU, noise), noise, np.eye(4), config.initial_covariance)
    ekf = JointEKF(model, config, revival=MapRevival(model, config))
    last_s, ids = 0.0, np.empty(0, dtype=np.int64)
    with one_thread():  # matrices are small: a second BLAS thread costs more than it saves
        for frame, (time_s, twist, ids, pixels) in enumerate(live()):
            if frame > 0:
                ekf.predict(twist, time_s - last_s)
            report = ekf.update(frame, ids, pixels)
            last_s = time_s
            T_world_imu, P_pose = ekf.T_world_imu, ekf.P[:6, :6]  # of this frame, for whoever steers
            if frame % 50 == 49:
                x, y, z = T_world_imu[:3, 3]
                std_m = np.sqrt(np.trace(P_pose[:3, :3]))
                print(f"frame {frame}: at ({x:.2f}, {y:.2f}, {z:.2f}) +- {std_m:.3f} m, {report.nis:.0f} of NIS")

    truth = RECORDED.truth
    assert truth is not None
    error_m = np.linalg.norm(ekf.T_world_imu[:3, 3] - truth.T_world_imu[-1, :3, 3])
    print(f"landmarks that came back: {ekf.counts['revived']}")
    print(f"error of the last position: {error_m:.3f} m")

    pair = np.intersect1d(ids, ekf.ids)[:2]  # two landmarks in view
    a, b = ekf.positions_m[[int(np.flatnonzero(ekf.ids == i)[0]) for i in pair]]
    P = ekf.covariance_of(pair)[-6:, -6:]  # state blocks come first, then three columns a landmark
    along = np.concatenate([a - b, b - a]) / np.linalg.norm(a - b)  # derivative of the distance by both positions
    true_m = np.linalg.norm(np.subtract(*truth.position_m[np.searchsorted(truth.landmark, pair)]))
    alone = np.sqrt(along[:3] @ P[:3, :3] @ along[:3] + along[3:] @ P[3:, 3:] @ along[3:])
    print(f"distance of two landmarks: {np.linalg.norm(a - b):.3f} m, true {true_m:.3f} m")
    print(f"standard deviation of it: {np.sqrt(along @ P @ along):.4f} m, without the correlation {alone:.4f} m")


if __name__ == "__main__":
    main()
