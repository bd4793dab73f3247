"""A ROS 2 node on images: a rectified pair and an IMU, or velocities, in; odometry with its covariance and TF out.

- ``/left/image_rect``, ``/right/image_rect`` (sensor_msgs/Image): mono8, rgb8 or bgr8; stamps at most 5 ms apart.
- ``/right/camera_info`` (sensor_msgs/CameraInfo): its P has focal length, principal point and baseline.
- ``/imu`` (sensor_msgs/Imu), or ``/velocities`` (geometry_msgs/TwistStamped) or ``/wheels`` (nav_msgs/Odometry) of the
  body. Use one of them, or none.
- ``/pose`` (geometry_msgs/PoseWithCovarianceStamped), ``/odometry`` (nav_msgs/Odometry) and ``/tf`` (map to `BODY`): at
  every pair, with the stamp of the pose; covariances along the axes of the map, position first.

Callbacks may run in several threads (`MultiThreadedExecutor`). If a clock jumps, as when a bag is played again, the
node starts again. It needs `ros2_node.py` beside it.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from ros2_node import filled, placed, seconds, twist_of

from ekfslam import LiveStereo
from ekfslam.data.images import Image, PairCalibration, side_by_side
from ekfslam.data.inputs import InertialNoise
from ekfslam.errors import ClockError, EkfslamError

# Yours instead: IMU to left optical frame, and the densities of the unit (imu.yaml of Kalibr).
T_CAM_IMU = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
IMU_NOISE = InertialNoise(gyro=2e-4, accel=2e-3, gyro_walk=2e-5, accel_walk=3e-3)
BODY = "base_link"  # frame of the body: the IMU, or that of the velocities
PAIR_S = 0.005
UNKNOWN = 1e6  # variance of a twist that is not estimated


def grey(message: Any) -> Image:
    """Return the grey levels (height, width) of an image message."""
    channels = {"mono8": 1, "8UC1": 1, "rgb8": 3, "bgr8": 3}[message.encoding]
    rows = np.frombuffer(bytes(message.data), np.uint8).reshape(message.height, message.step)
    image = rows[:, : message.width * channels].reshape(message.height, message.width, channels)
    if channels == 1:
        return image[..., 0]
    weights = np.array([0.299, 0.587, 0.114])[:: 1 if message.encoding == "rgb8" else -1]
    return np.round(image @ weights).astype(np.uint8)


def calibration_of(info: Any) -> PairCalibration:
    """Return the calibration of a rectified pair by the CameraInfo of its right camera."""
    P = np.array(info.p, dtype=float).reshape(3, 4)
    return PairCalibration(P[:, :3], P[:, :3], (info.width, info.height), side_by_side(-P[0, 3] / P[0, 0]))


class Slam:
    """Connection of a node with the filter.

    Args:
        node: Of rclpy.
        messages: Types ``Image``, ``CameraInfo``, ``Imu``, ``TwistStamped``, ``PoseWithCovarianceStamped``,
            ``Odometry``, ``TFMessage`` and ``TransformStamped``.
        settings: Further arguments of `LiveStereo`.
    """

    def __init__(self, node: Any, messages: Any, **settings: Any) -> None:
        self.stereo: LiveStereo | None = None
        self._settings, self._messages, self._log = settings, messages, node.get_logger()
        outputs = {"pose": messages.PoseWithCovarianceStamped, "odometry": messages.Odometry, "/tf": messages.TFMessage}
        self._publish = {topic: node.create_publisher(kind, topic, 10).publish for topic, kind in outputs.items()}
        self._last: dict[str, tuple[float, Image]] = {}
        node.create_subscription(messages.CameraInfo, "right/camera_info", self.on_info, 10)
        node.create_subscription(messages.Image, "left/image_rect", lambda m: self.on_image("left", m), 10)
        node.create_subscription(messages.Image, "right/image_rect", lambda m: self.on_image("right", m), 10)
        node.create_subscription(messages.Imu, "imu", self.on_imu, 1000)
        node.create_subscription(messages.TwistStamped, "velocities", self.on_velocities, 1000)
        node.create_subscription(messages.Odometry, "wheels", self.on_wheels, 1000)

    def on_info(self, message: Any) -> None:
        """Start when the calibration is known."""
        if self.stereo is None:
            self.stereo = LiveStereo(calibration_of(message), T_CAM_IMU, imu_noise=IMU_NOISE, **self._settings)
            self.stereo.__enter__()

    def on_image(self, side: str, message: Any) -> None:
        """Take an image; when both are there, give the pair to the filter, and publish its last pose."""
        self._last[side] = seconds(message.header.stamp), grey(message)
        if self.stereo is None or len(self._last) < 2:
            return
        (t, left), (t_right, right) = self._last["left"], self._last["right"]
        if abs(t - t_right) > PAIR_S:
            return
        self._last.clear()
        self._take(self.stereo.images, left, right, t)
        if (live := self.stereo.live) is not None and live.time_s is not None:
            self.publish(message)

    def on_imu(self, message: Any) -> None:
        """Take a sample of the inertial unit."""
        if self.stereo is not None:
            w, a = message.angular_velocity, message.linear_acceleration
            self._take(self.stereo.imu, [w.x, w.y, w.z], [a.x, a.y, a.z], seconds(message.header.stamp))

    def on_velocities(self, message: Any) -> None:
        """Take a velocity."""
        if self.stereo is not None:
            self._take(self.stereo.velocities, twist_of(message), seconds(message.header.stamp))

    def on_wheels(self, message: Any) -> None:
        """Take the velocity of an odometry."""
        if self.stereo is not None:
            self._take(self.stereo.velocities, twist_of(message.twist), seconds(message.header.stamp))

    def _take(self, call: Any, *arguments: Any) -> None:
        """Give a message to the filter; start again after a jump of the clock, and log other errors."""
        assert self.stereo is not None
        try:
            call(*arguments)
        except ClockError as error:
            self._log.warning(str(error))
            self.stereo.reset()
        except EkfslamError as error:
            self._log.error(str(error))

    def publish(self, message: Any) -> None:
        """Publish the newest pose."""
        assert self.stereo is not None
        t, T, covariance, _ = self.stereo.pose()
        stamp, own = message.header.stamp, self._messages
        stamp.sec, stamp.nanosec = divmod(round(1e9 * t), 10**9)
        self._publish["pose"](filled(own.PoseWithCovarianceStamped(), stamp, T, covariance))
        odometry = filled(own.Odometry(), stamp, T, covariance)
        odometry.child_frame_id, odometry.twist.covariance = BODY, (UNKNOWN * np.eye(6)).ravel().tolist()
        self._publish["odometry"](odometry)
        transform = own.TransformStamped()
        transform.header.stamp, transform.header.frame_id, transform.child_frame_id = stamp, "map", BODY
        placed(transform.transform.translation, transform.transform.rotation, T)
        self._publish["/tf"](own.TFMessage(transforms=[transform]))


def main() -> None:
    try:
        import rclpy
        from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped, TwistStamped
        from nav_msgs.msg import Odometry
        from rclpy.executors import MultiThreadedExecutor
        from sensor_msgs.msg import CameraInfo, Image, Imu
        from tf2_msgs.msg import TFMessage
    except ImportError as error:
        sys.exit(f"this node needs ROS 2, sourced in this shell: {error}")
    from types import SimpleNamespace

    rclpy.init()
    node = rclpy.create_node("ekfslam")
    types = (Image, CameraInfo, Imu, TwistStamped, PoseWithCovarianceStamped, Odometry, TFMessage, TransformStamped)
    Slam(node, SimpleNamespace(**{kind.__name__: kind for kind in types}))
    rclpy.spin(node, MultiThreadedExecutor())


if __name__ == "__main__":
    main()
