"""Trajectories as files of other programs: TUM with covariances beside it, KITTI, and bags of ROS 2."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.readers.messages import ODOMETRY, Bag, message_types
from ekfslam.data.readers.tum import COVARIANCE, UPPER
from ekfslam.data.trajectory import Trajectory
from ekfslam.errors import EkfslamError, MissingPackageError
from ekfslam.geometry import se3

NAMESPACE = "/ekfslam/"  # beginning of our topics
_UNKNOWN = 1e6  # variance of an axis that is not measured, as drivers write it
_FRAMES = {"body": "base_link", "camera": "left_camera_optical"}


def numbers(values: Array) -> str:
    """Return numbers with a blank between them, in 17 digits, which is every number exactly."""
    return " ".join(f"{value:.17g}" for value in values.tolist())


def position_and_quaternion(T: Array) -> Array:
    """Return ``x y z qx qy qz qw`` (..., 7) of transforms (..., 4, 4)."""
    from scipy.spatial.transform import Rotation

    R = np.array(T[..., :3, :3])  # a copy: SciPy 1.12 refuses what is read-only
    return np.concatenate([T[..., :3, 3], Rotation.from_matrix(R).as_quat()], axis=-1)


def tum_text(trajectory: Trajectory) -> str:
    """Return lines ``time tx ty tz qx qy qz qw``: eight columns, as evo requires."""
    return _lines(np.column_stack([trajectory.time_s, position_and_quaternion(trajectory.T_world)]))


def covariance_text(trajectory: Trajectory) -> str | None:
    """Return lines of a stamp and 21 columns, the upper triangle of the covariance by rows; None without one."""
    if trajectory.covariance is None:
        return None
    head = f"# time {' '.join(COVARIANCE)} (m, rad; axes of world; {_FRAMES[trajectory.moving]})\n"
    return head + _lines(np.column_stack([trajectory.time_s, trajectory.covariance[(slice(None), *UPPER)]]))


def kitti_text(trajectory: Trajectory) -> str:
    """Return lines of the upper 3x4 part of each pose, by rows; of the camera, relative to the first one."""
    T = trajectory.T_world
    if trajectory.moving == "camera" and len(T):
        T = se3.inverse(T[0]) @ T
    return _lines(T[:, :3].reshape(-1, 12))


def bag_bytes(trajectory: Trajectory) -> bytes:
    """Return a bag (MCAP, ROS 2) of ``nav_msgs/Odometry`` with covariances, topic ``/ekfslam/odometry``.

    Positions are in the frame ``map``. The twist is unknown: its variances are 1e6.
    """
    try:
        from rosbags import rosbag2
    except ImportError as error:
        raise MissingPackageError("rosbags", "ros", f"writing a bag ({error})") from None
    store = message_types(is_ros1=False)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bag"
        with rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer:
            stream = writer.add_connection(f"{NAMESPACE}odometry", ODOMETRY, typestore=store)
            for k in range(len(trajectory.time_s)):
                stamp_ns, message = _odometry(store.types, trajectory, k)
                writer.write(stream, max(stamp_ns, 0), bytes(store.serialize_cdr(message, ODOMETRY)))
        return next(path.glob("*.mcap")).read_bytes()


def is_our_bag(path: Path) -> bool:
    """Return whether a file is a bag with topics of this module alone."""
    try:
        bag = Bag(path)
    except EkfslamError:
        return False
    try:
        return bool(bag.topics) and all(topic.startswith(NAMESPACE) for topic in bag.topics)
    finally:
        bag.close()


def _odometry(types: Any, trajectory: Trajectory, k: int) -> tuple[int, Any]:
    """Return the stamp (ns) and the message of a frame."""
    stamp_ns = round(trajectory.time_s[k] * 1e9)
    x, y, z, *turn = position_and_quaternion(trajectory.T_world[k]).tolist()
    P = np.diag(np.full(6, _UNKNOWN)) if trajectory.covariance is None else trajectory.covariance[k]
    kind = {name.rpartition("/")[2]: value for name, value in types.items()}
    none = dict.fromkeys("xyz", 0.0)
    twist = kind["Twist"](linear=kind["Vector3"](**none), angular=kind["Vector3"](**none))
    pose = kind["Pose"](
        position=kind["Point"](x=x, y=y, z=z), orientation=kind["Quaternion"](**dict(zip("xyzw", turn, strict=True)))
    )
    stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return stamp_ns, kind["Odometry"](
        header=kind["Header"](stamp=stamp, frame_id="map"),
        child_frame_id=_FRAMES[trajectory.moving],
        pose=kind["PoseWithCovariance"](pose=pose, covariance=P.ravel()),
        twist=kind["TwistWithCovariance"](twist=twist, covariance=np.diag(np.full(6, _UNKNOWN)).ravel()),
    )


def _lines(rows: Array) -> str:
    return "".join(f"{numbers(row)}\n" for row in rows)
