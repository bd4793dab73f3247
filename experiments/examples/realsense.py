"""Live use of a RealSense D435i or D455: its two infrared images and its inertial unit in, poses out.

The device gives gyroscope and accelerometer apart; the accelerometer is interpolated to the stamps of the gyroscope.
Intrinsics and extrinsics come from the device. Other cameras with a callback a frame work alike.
"""

from __future__ import annotations

import sys
import threading
import time
from typing import Any

import numpy as np

from ekfslam import LiveStereo
from ekfslam.arrays import Array
from ekfslam.data.images import PairCalibration
from ekfslam.data.inputs import InertialNoise
from ekfslam.errors import LateError
from ekfslam.geometry import se3

NOISE = InertialNoise(gyro=1e-3, accel=1e-2, gyro_walk=2e-5, accel_walk=3e-4)  # yours instead
WIDTH, HEIGHT, RATE_HZ = 640, 480, 30


def transform(extrinsics: Any) -> Array:
    """Return ``T_to_from`` (4, 4) of extrinsics: a rotation by columns and a translation."""
    R = np.array(extrinsics.rotation, dtype=float).reshape(3, 3).T
    return np.asarray(se3.transform(R, np.array(extrinsics.translation, dtype=float)))


def matrix(intrinsics: Any) -> Array:
    """Return the intrinsic matrix (3, 3)."""
    return np.array([[intrinsics.fx, 0, intrinsics.ppx], [0, intrinsics.fy, intrinsics.ppy], [0, 0, 1.0]])


class Unit:
    """Joins accelerometer and gyroscope: a sample at each stamp of the gyroscope, as soon as both are there.

    Args:
        take: Function of (gyro, accel, stamp).
    """

    def __init__(self, take: Any) -> None:
        self._take, self._lock = take, threading.Lock()
        self._gyro: list[tuple[float, Array]] = []
        self._accel: list[tuple[float, Array]] = []

    def add(self, is_gyro: bool, t: float, xyz: Array) -> None:
        """Add a sample (3,) of one of them."""
        with self._lock:
            (self._gyro if is_gyro else self._accel).append((t, xyz))
            while len(self._accel) > 1 and self._gyro and self._gyro[0][0] <= self._accel[-1][0]:
                t, w = self._gyro.pop(0)
                while len(self._accel) > 2 and self._accel[1][0] < t:
                    self._accel.pop(0)
                stamps = [stamp for stamp, _ in self._accel]
                f = [np.interp(t, stamps, column) for column in np.array([xyz for _, xyz in self._accel]).T]
                if t >= stamps[0]:
                    self._take(w, f, t)


class Camera:
    """Connection of a pipeline with the filter.

    Args:
        rs: Module pyrealsense2.
        settings: Further arguments of `LiveStereo`.
    """

    def __init__(self, rs: Any, **settings: Any) -> None:
        self._rs, self._pipeline, wanted = rs, rs.pipeline(), rs.config()
        for index in (1, 2):
            wanted.enable_stream(rs.stream.infrared, index, WIDTH, HEIGHT, rs.format.y8, RATE_HZ)
        for kind in (rs.stream.accel, rs.stream.gyro):
            wanted.enable_stream(kind, rs.format.motion_xyz_f32)
        profile = wanted.resolve(self._pipeline)
        left, right = (profile.get_stream(rs.stream.infrared, i).as_video_stream_profile() for i in (1, 2))
        gyro = profile.get_stream(rs.stream.gyro)
        K_left, K_right = matrix(left.get_intrinsics()), matrix(right.get_intrinsics())
        size = left.get_intrinsics().width, left.get_intrinsics().height
        calibration = PairCalibration(K_left, K_right, size, transform(left.get_extrinsics_to(right)))
        T_cam_imu = transform(gyro.get_extrinsics_to(left))
        self.stereo = LiveStereo(calibration, T_cam_imu, imu_noise=NOISE, **settings)
        self._unit, self._wanted = Unit(self.stereo.imu), wanted

    def start(self) -> None:
        """Start threads and device."""
        self.stereo.__enter__()
        self._pipeline.start(self._wanted, self.on_frame)

    def stop(self) -> None:
        """Stop the device, process what waits, and end the threads."""
        self._pipeline.stop()
        self.stereo.__exit__()

    def on_frame(self, frame: Any) -> None:
        """Take what the device gives: a pair of images, or a sample of gyroscope or accelerometer."""
        t = 1e-3 * frame.get_timestamp()
        if frame.is_frameset():
            pair = (frame.as_frameset().get_infrared_frame(index) for index in (1, 2))
            left, right = (np.array(image.get_data()) for image in pair)  # the device reuses its buffers
            self.stereo.images(left, right, t)
        elif frame.is_motion_frame():
            data = frame.as_motion_frame().get_motion_data()
            is_gyro = frame.get_profile().stream_type() == self._rs.stream.gyro
            self._unit.add(is_gyro, t, np.array([data.x, data.y, data.z]))


def main() -> None:
    try:
        import pyrealsense2
    except ImportError as error:
        sys.exit(f"this example needs pyrealsense2 and a camera: {error}")
    camera = Camera(pyrealsense2)
    camera.start()
    try:
        while True:
            time.sleep(0.5)
            try:
                now = camera.stereo.pose()
            except LateError:
                print("hold still: the first frames are collected")
                continue
            place, std = now.T_world_imu[:3, 3], np.sqrt(np.trace(now.covariance[:3, :3]))
            print(f"({place[0]:.2f}, {place[1]:.2f}, {place[2]:.2f}) m +- {std:.3f} m, skipped {camera.stereo.skipped}")
    except KeyboardInterrupt:
        camera.stop()


if __name__ == "__main__":
    main()
