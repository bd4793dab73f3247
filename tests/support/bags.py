"""Small bags of stereo images and odometry, written for a test."""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as Pillow
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import StoragePlugin
from scipy.spatial.transform import Rotation

from ekfslam.data.readers.messages import message_types
from ekfslam.geometry import se3
from ekfslam.geometry.camera import R_CAM_BODY

FRAMES, WIDTH, HEIGHT, BASELINE_M = 5, 10, 6, 0.3
FIRST_NS, STEP_NS = 1_600_000_000_123_000_000, 100_000_000
R_LEFT, R_RIGHT = (se3.so3_exp(np.array(w)) for w in ([0.01, -0.02, 0.005], [-0.01, 0.01, 0.02]))
K = np.array([[400.0, 0, 5], [0, 401.0, 3], [0, 0, 1]])
P = np.array([[390.0, 0, 5.5, 0], [0, 390.0, 3.5, 0], [0, 0, 1, 0]])
T_BASE_CAM = se3.transform(R_CAM_BODY.T @ se3.so3_exp(np.array([0.1, 0.05, -0.1])), np.array([1.0, 0.2, 0.5]))
KINDS = ("ros1", "ros2", "mcap")
UNFILLED = np.zeros(36)  # covariance of a twist


def picture(frame: int, side: int) -> np.ndarray:
    return np.full((HEIGHT, WIDTH), 20 * frame + side, dtype=np.uint8)


@dataclasses.dataclass
class Written:
    """What a bag is to hold: messages by topic; each a type, a stamp (ns) and how to make it of a store of types."""

    topics: dict[str, list[tuple[str, int, Callable[[Any], Any]]]] = dataclasses.field(default_factory=dict)

    def add(self, topic: str, kind: str, stamp_ns: int, make: Callable[[Any], Any]) -> None:
        self.topics.setdefault(topic, []).append((kind, stamp_ns, make))


def header(types: Any, stamp_ns: int, frame: str) -> Any:
    time = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    kind = types["std_msgs/msg/Header"]
    return kind(stamp=time, frame_id=frame, **({"seq": 0} if "seq" in kind.__dataclass_fields__ else {}))


def vector(types: Any, values: Any) -> Any:
    x, y, z = (float(value) for value in values)
    return types["geometry_msgs/msg/Vector3"](x=x, y=y, z=z)


def image(
    stamp_ns: int, side: int, pixels: np.ndarray, encoding: str = "mono8", **changes: Any
) -> Callable[[Any], Any]:
    def make(types: Any) -> Any:
        fields = {
            "height": pixels.shape[0],
            "width": pixels.shape[1],
            "encoding": encoding,
            "is_bigendian": 0,
            "step": pixels[0].nbytes,
            "data": np.frombuffer(pixels.tobytes(), np.uint8),
            **changes,
        }
        return types["sensor_msgs/msg/Image"](header=header(types, stamp_ns, f"optical_{side}"), **fields)

    return make


def compressed(stamp_ns: int, side: int, pixels: np.ndarray) -> Callable[[Any], Any]:
    stream = io.BytesIO()
    Pillow.fromarray(pixels).save(stream, "png")

    def make(types: Any) -> Any:
        return types["sensor_msgs/msg/CompressedImage"](
            header=header(types, stamp_ns, f"optical_{side}"),
            format="mono8; png compressed",
            data=np.frombuffer(stream.getvalue(), np.uint8),
        )

    return make


def camera_info(stamp_ns: int, side: int, **changes: Any) -> Callable[[Any], Any]:
    def make(types: Any) -> Any:
        kind = types["sensor_msgs/msg/CameraInfo"]
        projection = P.copy()
        projection[0, 3] = -side * P[0, 0] * BASELINE_M
        fields = {
            "d": np.array([-0.1, 0.01, 0.001, -0.001, 0.0]),
            "k": K.ravel(),
            "r": (R_LEFT, R_RIGHT)[side].ravel(),
            "p": projection.ravel(),
            **changes,
        }
        plain = {"height": HEIGHT, "width": WIDTH, "distortion_model": "plumb_bob", "binning_x": 0, "binning_y": 0}
        plain |= {name: fields.pop(name) for name in list(fields) if name not in "dkrp"}
        if "K" in kind.__dataclass_fields__:
            fields = {name.upper(): value for name, value in fields.items()}
        roi = types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        return kind(header=header(types, stamp_ns, f"optical_{side}"), roi=roi, **plain, **fields)

    return make


def twist(stamp_ns: int, values: Any, frame: str = "base") -> Callable[[Any], Any]:
    def make(types: Any) -> Any:
        inner = types["geometry_msgs/msg/Twist"](linear=vector(types, values[:3]), angular=vector(types, values[3:]))
        return types["geometry_msgs/msg/TwistStamped"](header=header(types, stamp_ns, frame), twist=inner)

    return make


def odometry(
    stamp_ns: int, values: Any, covariance: Any = UNFILLED, pose: np.ndarray | None = None
) -> Callable[[Any], Any]:
    T_odom_base = np.eye(4) if pose is None else pose

    def make(types: Any) -> Any:
        inner = types["geometry_msgs/msg/Twist"](linear=vector(types, values[:3]), angular=vector(types, values[3:]))
        point = types["geometry_msgs/msg/Point"](**dict(zip("xyz", T_odom_base[:3, 3].tolist(), strict=True)))
        quaternion = Rotation.from_matrix(T_odom_base[:3, :3]).as_quat().tolist()
        turn = types["geometry_msgs/msg/Quaternion"](**dict(zip("xyzw", quaternion, strict=True)))
        pose = types["geometry_msgs/msg/Pose"](position=point, orientation=turn)
        return types["nav_msgs/msg/Odometry"](
            header=header(types, stamp_ns, "odom"),
            child_frame_id="base",
            pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36)),
            twist=types["geometry_msgs/msg/TwistWithCovariance"](twist=inner, covariance=covariance),
        )

    return make


def transforms(*edges: tuple[str, str, np.ndarray], norm: float = 1.0) -> Callable[[Any], Any]:
    def make(types: Any) -> Any:
        entries = []
        for parent, child, T in edges:
            x, y, z, w = norm * Rotation.from_matrix(T[:3, :3]).as_quat()
            turn = types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)
            pose = types["geometry_msgs/msg/Transform"](translation=vector(types, T[:3, 3]), rotation=turn)
            entries.append(
                types["geometry_msgs/msg/TransformStamped"](
                    header=header(types, FIRST_NS, parent), child_frame_id=child, transform=pose
                )
            )
        return types["tf2_msgs/msg/TFMessage"](transforms=entries)

    return make


def stereo(raw: str = "image_raw", velocities: str = "twist", covariance: Any = UNFILLED) -> Written:
    """A pair of five images, velocities that grow linearly, and where the camera is."""
    bag = Written()
    for frame in range(FRAMES):
        stamp = FIRST_NS + frame * STEP_NS
        for side, name in enumerate(("left", "right")):
            if raw.endswith("compressed"):
                message, kind = compressed(stamp, side, picture(frame, side)), "CompressedImage"
            else:
                message, kind = image(stamp, side, picture(frame, side)), "Image"
            bag.add(f"/stereo/{name}/{raw}", f"sensor_msgs/msg/{kind}", stamp, message)
            bag.add(f"/stereo/{name}/camera_info", "sensor_msgs/msg/CameraInfo", stamp, camera_info(stamp, side))
    for k in range(-1, 12):
        stamp = FIRST_NS + k * STEP_NS // 2
        values = [1.0 + k, 0.0, 0.1, 0.0, 0.0, 0.2 * k]
        if velocities == "twist":
            bag.add("/velocity", "geometry_msgs/msg/TwistStamped", stamp, twist(stamp, values))
        elif velocities == "odometry":
            bag.add("/odom", "nav_msgs/msg/Odometry", stamp, odometry(stamp, values, covariance))
    half = se3.exp(np.array([0.3, 0.1, 0.0, 0.2, 0.0, 0.1]))
    edges = (("base", "mast", half), ("mast", "optical_0", se3.inverse(half) @ T_BASE_CAM))
    bag.add("/tf_static", "tf2_msgs/msg/TFMessage", FIRST_NS, transforms(*edges))
    return bag


def write(folder: Path, bag: Written, kind: str = "ros2") -> Path:
    """A bag of a kind; the path that a user would give."""
    is_ros1 = kind == "ros1"
    store = message_types(is_ros1)
    path = folder / ("a.bag" if is_ros1 else "bag")
    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    writer = rosbag1.Writer(path) if is_ros1 else rosbag2.Writer(path, version=9, storage_plugin=plugin)
    with writer:
        streams = {}
        queue = []
        for topic, messages in bag.topics.items():
            streams[topic] = writer.add_connection(topic, messages[0][0], typestore=store)
            queue += [(stamp, topic, name, make) for name, stamp, make in messages]
        for stamp, topic, name, make in sorted(queue, key=lambda entry: entry[:2]):
            content = make(store.types)
            data = store.serialize_ros1(content, name) if is_ros1 else store.serialize_cdr(content, name)
            writer.write(streams[topic], stamp + 7_000_000, data)  # written later than stamped
    return next(path.glob("*.mcap")) if kind == "mcap" else path


def imu(
    stamp_ns: int, rate: Any, force: Any, frame: str = "imu", is_known: tuple[bool, bool] = (True, True)
) -> Callable[[Any], Any]:
    """A message of an inertial unit; what it does not know is 0, with -1 for its first covariance."""

    def make(types: Any) -> Any:
        covariances = [np.zeros(9) if known else np.array([-1.0, *[0.0] * 8]) for known in is_known]
        turn = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
        return types["sensor_msgs/msg/Imu"](
            header=header(types, stamp_ns, frame),
            orientation=turn,
            orientation_covariance=np.array([-1.0, *[0.0] * 8]),
            angular_velocity=vector(types, np.asarray(rate) * is_known[0]),
            angular_velocity_covariance=covariances[0],
            linear_acceleration=vector(types, np.asarray(force) * is_known[1]),
            linear_acceleration_covariance=covariances[1],
        )

    return make
