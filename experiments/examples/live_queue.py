"""Live use from a queue: odometry and a tracker send at 10 Hz with different delays, and the map grows meanwhile.

It shows how `LiveEKF` takes messages out of order, gives the pose at any time, and reports late messages. Replace
`send` by the source of your queue.
"""

from __future__ import annotations

import threading
import time
from queue import Queue
from typing import Any

import numpy as np

from ekfslam import LiveEKF
from ekfslam.config import FilterConfig
from ekfslam.data.noise import Noise
from ekfslam.data.simulate import CAMERA, T_CAM_IMU, Loop, simulate
from ekfslam.filters import JointEKF
from ekfslam.filters.loop import one_thread
from ekfslam.models.sensors.stereo import Rig

RECORDED = simulate(Loop(frames=40))  # 10 Hz
DELAY_S = 0.3  # no message takes longer on its way


def send(queue: Queue[tuple[Any, ...] | None]) -> None:
    """Stands for two drivers: every message leaves at its stamp and arrives some tenths of a second later."""
    rng = np.random.default_rng(0)
    messages: list[tuple[Any, ...]] = []
    for k, t in enumerate(RECORDED.time_s.tolist()):
        messages.append((t + rng.uniform(0.0, 0.02), "velocities", t, RECORDED.twist[k]))
        messages.append((t + rng.uniform(0.05, 0.25), "tracks", t, *RECORDED.observations.at(k)))
    begin = time.monotonic()
    for arrival, *message in sorted(messages, key=lambda message: message[0]):
        time.sleep(max(0.0, begin + arrival - time.monotonic()))
        queue.put(tuple(message))
    queue.put(None)


def main() -> None:
    noise = Noise.isotropic(sigma_v_m_s=0.5, sigma_w_rad_s=0.05, sigma_px=1.0)
    ekf = JointEKF(Rig(CAMERA, T_CAM_IMU, noise), FilterConfig(retire="unseen", retire_after=10), np.eye(4))
    live = LiveEKF(ekf, delay_s=DELAY_S, gap_s=0.25, late="count")
    queue: Queue[tuple[Any, ...] | None] = Queue()
    threading.Thread(target=send, args=(queue,), daemon=True).start()
    with one_thread():  # matrices are small: a second BLAS thread costs more than it saves
        while (message := queue.get()) is not None:
            kind, t, *values = message
            if kind == "velocities":
                live.predict(values[0], t)
            else:
                live.update(values[0], values[1], t)
            if kind == "velocities" and live.time_s is not None and live.counts.velocities % 10 == 0:
                now = live.pose()  # of this moment: images of the last tenths are not in it yet
                (x, y), std_m = now.T_world_imu[:2, 3], np.sqrt(np.trace(now.covariance[:3, :3]))
                print(f"at {now.time_s:.2f} s: ({x:.2f}, {y:.2f}) +- {std_m:.3f} m")
        live.flush()

    counts, truth = live.counts, RECORDED.truth
    assert truth is not None
    error_m = np.linalg.norm(live.pose().T_world_imu[:3, 3] - truth.T_world_imu[-1, :3, 3])
    print(f"messages out of order: {counts.out_of_order}, late {counts.late_images + counts.late_velocities}")
    print(f"images in the map: {counts.taken_in}, landmarks {len(live.ekf.ids)}")
    print(f"error of the last position: {error_m:.3f} m")


if __name__ == "__main__":
    main()
