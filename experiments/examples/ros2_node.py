"""A ROS 2 node: velocities and tracks in, the pose with its covariance out. Run it where ROS 2 is sourced.

- ``/velocities`` (geometry_msgs/TwistStamped): of the IMU frame, m/s and rad/s.
- ``/tracks`` (sensor_msgs/PointCloud2): an image each; fields ``id`` (uint32) and ``uL vL uR vR`` (float32).
- ``/pose`` (geometry_msgs/PoseWithCovarianceStamped): at every velocity.

ROS wants covariances along the axes of the map frame, position first: ``diag(R, R) P diag(R, R)^T``, see
`ekfslam.Result.position_covariance_world`.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ekfslam import LiveEKF
from ekfslam.arrays import Array, IntArray
from ekfslam.config import FilterConfig
from ekfslam.data.noise import Noise
from ekfslam.data.simulate import CAMERA, T_CAM_IMU  # yours instead
from ekfslam.filters import JointEKF
from ekfslam.models.sensors.stereo import Rig

TRACK = np.dtype([("id", "<u4"), ("uL", "<f4"), ("vL", "<f4"), ("uR", "<f4"), ("vR", "<f4")])


def seconds(stamp: Any) -> float:
    """Return the seconds of a builtin_interfaces/Time."""
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def twist_of(message: Any) -> Array:
    """Return the velocities (6,) of a TwistStamped."""
    linear, angular = message.twist.linear, message.twist.angular
    return np.array([linear.x, linear.y, linear.z, angular.x, angular.y, angular.z])


def placed(place: Any, turn: Any, T: Array) -> None:
    """Fill a Point or Vector3 and a Quaternion with a pose."""
    place.x, place.y, place.z = T[:3, 3].tolist()
    turn.x, turn.y, turn.z, turn.w = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()


def filled(out: Any, stamp: Any, T_world_imu: Array, covariance: Array) -> Any:
    """Fill a PoseWithCovarianceStamped or Odometry with a pose and the covariance (6, 6) of its ``xi``; return it."""
    out.header.stamp, out.header.frame_id = stamp, "map"
    placed(out.pose.pose.position, out.pose.pose.orientation, T_world_imu)
    R = np.kron(np.eye(2), T_world_imu[:3, :3])
    out.pose.covariance = (R @ covariance @ R.T).ravel().tolist()
    return out


def tracks_of(message: Any) -> tuple[IntArray, Array]:
    """Ids (n,) and pixels (n, 4) of a PointCloud2 whose points are of `TRACK`."""
    points = np.frombuffer(bytes(message.data), TRACK)
    pixels = np.stack([points[name] for name in ("uL", "vL", "uR", "vR")], axis=-1)
    return points["id"].astype(np.int64), pixels.astype(float)


class Slam:
    """What connects a node with a filter.

    Args:
        node: Of rclpy.
        velocities, tracks, pose: Types of the messages.
    """

    def __init__(self, node: Any, velocities: Any, tracks: Any, pose: Any) -> None:
        noise = Noise.isotropic(sigma_v_m_s=0.5, sigma_w_rad_s=0.05, sigma_px=1.0)
        ekf = JointEKF(Rig(CAMERA, T_CAM_IMU, noise), FilterConfig(retire="unseen", retire_after=10), np.eye(4))
        self.live = LiveEKF(ekf, delay_s=0.3, gap_s=0.5, late="count")
        self._message, self._publisher = pose, node.create_publisher(pose, "pose", 10)
        node.create_subscription(velocities, "velocities", self.on_velocities, 100)
        node.create_subscription(tracks, "tracks", self.on_tracks, 10)

    def on_tracks(self, message: Any) -> None:
        """Process a pair of images."""
        self.live.update(*tracks_of(message), seconds(message.header.stamp))

    def on_velocities(self, message: Any) -> None:
        """Take a velocity, and publish the pose at its stamp."""
        self.live.predict(twist_of(message), seconds(message.header.stamp))
        if self.live.time_s is None:
            return
        _, T, covariance, _ = self.live.pose(seconds(message.header.stamp))
        self._publisher.publish(filled(self._message(), message.header.stamp, T, covariance))


def main() -> None:
    try:
        import rclpy
        from geometry_msgs.msg import PoseWithCovarianceStamped, TwistStamped
        from sensor_msgs.msg import PointCloud2
    except ImportError as error:
        sys.exit(f"this node needs ROS 2, sourced in this shell: {error}")
    rclpy.init()
    node = rclpy.create_node("ekfslam")
    Slam(node, TwistStamped, PointCloud2, PoseWithCovarianceStamped)
    rclpy.spin(node)


if __name__ == "__main__":
    main()
