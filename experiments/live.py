"""Play a recording of stereo images into `ekfslam.LiveStereo` at its own pace, and measure how long poses take.

The latency of a pair is the time from its arrival until the filter has processed it. The first frames configure the
filter: latencies are counted once it has caught up, and the time until then is printed. Velocities or inertial samples
of the recording arrive with their images. ``--rate`` plays faster or slower than the stamps say.

    python experiments/live.py BAG_OR_FOLDER --rate 20
"""

from __future__ import annotations

import argparse
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from ekfslam import LiveStereo, open_images
from ekfslam.arrays import Array
from ekfslam.data.images import ImageRecording, PairCalibration


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", help="bag, or folder of EuRoC, KITTI or a pair of image folders")
    parser.add_argument("--rate", type=float, help="pairs a second (default: by the stamps)")
    parser.add_argument("--learn", type=int, default=40, help="first frames that configure the filter")
    parser.add_argument("--delay", type=float, default=0.0, help="delay_s of LiveStereo")
    options = parser.parse_args()
    recording = open_images(options.data)
    if recording is None or not isinstance(recording.calibration, PairCalibration):
        parser.error(f"{options.data} has no stereo images")
    with threadpool_limits(1):
        arrived, done, stereo = played(recording, options.rate, learn=options.learn, delay_s=options.delay)
    width, height = recording.calibration.size
    print(f"pairs: {len(recording.time_s)} of {width} x {height}, dropped {stereo.skipped}")
    usual_s = np.nanmedian((done - arrived)[-len(done) // 4 :])
    caught_up = int(np.argmax(done - arrived < 1.5 * usual_s))
    print(f"first pose after pair {options.learn}: {done[options.learn - 1] - arrived[options.learn - 1]:.2f} s")
    print(f"caught up at pair {caught_up}")
    latency_s = (done - arrived)[caught_up:]
    latency_s = latency_s[np.isfinite(latency_s)]
    median, p95 = np.percentile(1e3 * latency_s, [50, 95])
    print(f"latency: median {median:.0f} ms, 95 % {p95:.0f} ms, largest {1e3 * latency_s.max():.0f} ms")


def played(recording: ImageRecording, rate_hz: float | None = None, **settings: Any) -> tuple[Array, Array, LiveStereo]:
    """Return when each pair arrived and was processed (T,), s, NaN if it never was, and the filter."""
    noise = None if recording.inertial is None else recording.inertial.noise
    assert isinstance(recording.calibration, PairCalibration)
    stereo = LiveStereo(recording.calibration, recording.T_cam_imu, imu_noise=noise, **settings)
    stamps = recording.time_s
    arrived, done = np.full(len(stamps), np.nan), np.full(len(stamps), np.nan)
    over = threading.Event()

    def watch() -> None:
        while not over.is_set():
            now, last = time.monotonic(), None if stereo.live is None else stereo.live.time_s
            if last is not None:
                done[(stamps <= last + 1e-9) & np.isnan(done)] = now
            time.sleep(0.001)

    pairs = [recording.load(k) for k in range(len(stamps))]  # no reading of files while it is timed
    watcher, begin = threading.Thread(target=watch), time.monotonic()
    watcher.start()
    with stereo:
        for k, messages in enumerate(between(recording)):
            due_s = (stamps[k] - stamps[0]) if rate_hz is None else k / rate_hz
            time.sleep(max(0.0, begin + due_s - time.monotonic()))
            for call, *values in messages:
                getattr(stereo, call)(*values)
            arrived[k] = time.monotonic()
            left, right = pairs[k]
            stereo.images(left, right, stamps[k])
        stereo.flush()
        time.sleep(0.01)
        over.set()
        watcher.join()
    return arrived, done, stereo


def between(recording: ImageRecording) -> Iterator[list[tuple[Any, ...]]]:
    """Yield, for each pair, the calls of `LiveStereo` for the inputs up to the first one at its stamp or later."""
    samples = recording.inertial
    k = 0
    for frame, t in enumerate(recording.time_s):
        calls: list[tuple[Any, ...]] = []
        if samples is not None:
            while k < len(samples.time_s) and (k == 0 or samples.time_s[k - 1] < t):
                calls.append(("imu", samples.gyro_rad_s[k], samples.accel_m_s2[k], float(samples.time_s[k])))
                k += 1
        elif recording.twist is not None:
            calls.append(("velocities", recording.twist[frame], float(t)))
        yield calls


if __name__ == "__main__":
    main()
