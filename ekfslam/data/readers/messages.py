"""Messages of ROS 1 and ROS 2 bags, and MCAP, by rosbags; only known types: it makes code of others."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ekfslam.arrays import Array
from ekfslam.data.images import Image
from ekfslam.data.readers.compressed import require_room
from ekfslam.data.readers.pictures import decode_gray, size_of_image, upper_eight
from ekfslam.data.readers.registry import Source
from ekfslam.errors import CalibrationError, EkfslamError, LostDataError, MissingPackageError, UnknownFormatError
from ekfslam.geometry import se3
from ekfslam.names import printable

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO, TRANSFORMS = "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage"
ODOMETRY, IMU = "nav_msgs/msg/Odometry", "sensor_msgs/msg/Imu"
VELOCITIES = ("geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/TwistWithCovarianceStamped", ODOMETRY)
READ = (IMAGE, COMPRESSED, IMU, *VELOCITIES)  # types that may be named

ROS1_MAGIC = b"#ROSBAG V2.0"
MAGICS = (ROS1_MAGIC, b"\x89MCAP0\r\n", b"SQLite format 3\x00")
# Bytes of a pixel. Of two chroma samples and two luma samples in four bytes (yuv), luma alone is read.
_BYTES = {"mono8": 1, "8UC1": 1, "rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4, "8UC4": 4}
_BYTES |= {"mono16": 2, "16UC1": 2, "rgb16": 6, "bgr16": 6, "rgba16": 8, "bgra16": 8}
_BYTES |= {"yuv422": 2, "uyvy": 2, "yuv422_yuy2": 2, "yuyv": 2, "nv21": 1, "nv24": 1}
_BYTES |= {f"bayer_{pattern}{bits}": bits // 8 for pattern in ("rggb", "bggr", "gbrg", "grbg") for bits in (8, 16)}
_LUMA_AT = {"yuv422": 1, "uyvy": 1, "yuv422_yuy2": 0, "yuyv": 0}
_FURTHER_ROWS = {"nv21": 0.5, "nv24": 2.0}  # of chroma, as a share of the height, below those of luma
DEEP = tuple(name for name, size in _BYTES.items() if size in (2, 6, 8) and name not in _LUMA_AT)
# Variances (m^2/s^2, rad^2/s^2) that drivers write for an axis without a value, and for one that is not measured.
_UNSET, _UNKNOWN = 1e-10, 1e3
_LUMA = np.array([0.299, 0.587, 0.114])


class Bag:
    """An open bag: a file, or a folder with ``metadata.yaml``; ``named`` topics are preferred, in this order."""

    def __init__(self, path: Path, named: tuple[str, ...] = ()) -> None:
        try:
            from rosbags import rosbag1, rosbag2
        except ImportError as error:
            raise MissingPackageError("rosbags", "ros", f"{path}: reading a bag ({error})") from None
        self.path = path
        with self.named_errors():
            require_room(path)
            self.is_ros1 = Source.at(path).head.startswith(ROS1_MAGIC)
            self._reader: Any = rosbag1.Reader(path) if self.is_ros1 else rosbag2.Reader(path)
            self._reader.open()
            self._types = message_types(self.is_ros1)
            for connection in self._reader.connections:
                if not (isinstance(connection.topic, str) and isinstance(connection.msgtype, str)):
                    raise ValueError(f"a stream named {connection.topic!r} of the type {connection.msgtype!r}")
        self.named = tuple(name if name in self.topics else f"/{name}" for name in named)
        for name, full in zip(named, self.named, strict=True):
            if full not in self.topics:
                found = ", ".join(f"{topic} ({kind})" for topic, kind in self.topics.items())
                message = f"{path}: there is no topic {printable(name)}; the bag has {printable(found)}"
                raise LostDataError(message, field="topics")

            if (kind := self.topics[full]) not in READ:
                text = f"{printable(full)} is of {printable(kind)}, which is not read; known: {', '.join(READ)}"
                raise UnknownFormatError(f"{path}: topics: {text}")

    @contextlib.contextmanager
    def named_errors(self) -> Iterator[None]:
        """Turn any exception of the package for a damaged bag into an error that names it."""
        try:
            yield
        except EkfslamError:
            raise
        except Exception as error:  # a damaged bag makes its decoders raise almost anything
            text = printable(str(error))[:200] or type(error).__name__
            if isinstance(error.__context__ or error, AttributeError | TypeError):
                text = "an entry is of a wrong type"  # their words are about Python's objects, not the file
            raise UnknownFormatError(f"{self.path}: damaged or unknown bag ({text})") from None

    @property
    def topics(self) -> dict[str, str]:
        """Types of messages by topic."""
        found = {connection.topic: connection.msgtype for connection in self._reader.connections}
        return dict(sorted(found.items()))

    def connections(self, *kinds: str) -> list[Any]:
        """Return one stream a topic of messages of some types: the named ones, or else all by topic."""
        found = sorted(self._of(*kinds), key=lambda connection: (connection.topic, connection.id))
        by_topic = {connection.topic: connection for connection in reversed(found)}
        return [by_topic[name] for name in self.named if name in by_topic] or list(by_topic.values())[::-1]

    def _of(self, *kinds: str) -> list[Any]:
        return [connection for connection in self._reader.connections if connection.msgtype in kinds]

    def raw(self, connection: Any, begin_ns: int | None = None, end_ns: int | None = None) -> Iterator[Any]:
        """Yield the time of writing (ns) and the bytes of each message of a topic, of all its publishers."""
        same = [each for each in self._of(connection.msgtype) if each.topic == connection.topic]
        with self.named_errors():
            for _, written_ns, content in self._reader.messages(same, begin_ns, end_ns):
                yield written_ns, content

    def message(self, connection: Any, content: bytes) -> Any:
        """Return the message that bytes encode."""
        with self.named_errors():
            decode = self._types.deserialize_ros1 if self.is_ros1 else self._types.deserialize_cdr
            return decode(content, connection.msgtype)

    def messages(self, connection: Any) -> Iterator[Any]:
        """Yield all messages of a stream."""
        for _, content in self.raw(connection):
            yield self.message(connection, content)

    def stamp_ns(self, content: bytes) -> int:
        """Return the stamp of a message that begins with a header, without decoding the rest."""
        with self.named_errors():
            if self.is_ros1:
                seconds, nanoseconds = struct.unpack_from("<II", content, 4)
            else:
                order = "<" if content[1] & 1 else ">"
                seconds, nanoseconds = struct.unpack_from(f"{order}iI", content, 4)
            return int(seconds) * 1_000_000_000 + int(nanoseconds)

    def close(self) -> None:
        """Close the file."""
        with contextlib.suppress(Exception):
            self._reader.close()


def message_types(is_ros1: bool) -> Any:
    """Return the types of messages of a distribution, as rosbags knows them."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    if TRANSFORMS not in types.types:
        types.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TRANSFORMS))
    return types


def stamp_of(message: Any) -> float:
    """Return the stamp in the header of a message, s."""
    stamp = message.header.stamp
    return float(stamp.sec) + float(stamp.nanosec) / 1e9


def frame_of(name: object) -> str:
    """Return the name of a frame without the leading slash of ROS 1."""
    return str(name).lstrip("/")


def matrix_of(info: Any, name: str, rows: int) -> Array:
    """Return a matrix of a CameraInfo by its name in ROS 2 (``k``, ``r``, ``p``), which is a capital in ROS 1."""
    return np.asarray(field_of(info, name), dtype=float).reshape(rows, -1)


def field_of(info: Any, name: str) -> Any:
    """Return a field of a CameraInfo, see `matrix_of`."""
    return getattr(info, name) if hasattr(info, name) else getattr(info, name.upper())


def gray_of(message: Any, source: str, size: tuple[int, int], bits: int = 16) -> Image:
    """Return the gray pixels (height, width) of an Image or CompressedImage; see `read_gray` for ``bits``."""
    if hasattr(message, "format"):
        return decode_gray(bytes(message.data), source, size, bits)
    if (width_height := size_of(message, source)) != size:
        width, height = width_height
        text = f"the image has {width} x {height} pixels, its CameraInfo {size[0]} x {size[1]}"
        raise CalibrationError(text, source=source)
    values, encoding = _values(message, source), str(message.encoding)
    values = values if values.dtype == np.uint8 else upper_eight(values, bits)
    if encoding in _LUMA_AT:
        return np.ascontiguousarray(values[..., _LUMA_AT[encoding]])
    if encoding.startswith("bayer"):
        return _debayered(values[..., 0], encoding[6:10])
    if values.shape[-1] == 1:
        return np.ascontiguousarray(values[..., 0])
    luma = _LUMA if encoding.startswith("rgb") else _LUMA[::-1]
    return np.round(values[..., :3] @ luma).astype(np.uint8)


def size_of(message: Any, source: str) -> tuple[int, int]:
    """Return width and height of an Image or CompressedImage."""
    if hasattr(message, "format"):
        return size_of_image(bytes(message.data), source)
    return int(message.width), int(message.height)


def largest_value(message: Any) -> int:
    """Return the largest value in an Image."""
    return int(_values(message, "").max(initial=0))


def _values(message: Any, source: str) -> NDArray[Any]:
    """Return the pixels (height, width, channels) of an Image as 8 or 16 bits; two channels of yuv."""
    height, width, encoding = int(message.height), int(message.width), printable(str(message.encoding))
    if encoding not in _BYTES:
        raise UnknownFormatError(f"{source}: images encoded as {encoding!r} are not read; known: {', '.join(_BYTES)}")
    size_of_pixel = _BYTES[encoding]
    step, data = int(message.step), np.asarray(message.data, dtype=np.uint8)
    rows = height + int(_FURTHER_ROWS.get(encoding, 0.0) * height)
    if step < width * size_of_pixel or len(data) != rows * step:
        found = f"{len(data)} bytes and steps of {step}"
        raise UnknownFormatError(f"{source}: {found} are no {width} x {height} {encoding}")
    pixels = np.ascontiguousarray(data.reshape(rows, step)[:height, : width * size_of_pixel])
    if encoding in DEEP:
        pixels = pixels.view(">u2" if message.is_bigendian else "<u2")
    return pixels.reshape(height, width, -1)


def _debayered(mosaic: Image, pattern: str) -> Image:
    """Return the luma of a Bayer mosaic, whose colours are interpolated linearly."""
    padded = np.pad(mosaic.astype(np.float32), 1, mode="reflect")
    height, width = mosaic.shape
    colour = np.array([["rgb".index(c) for c in pattern[:2]], ["rgb".index(c) for c in pattern[2:]]])
    place = np.tile(colour, (height // 2 + 2, width // 2 + 2))[1 : height + 3, 1 : width + 3]  # padded by one
    luma, weights = np.zeros(mosaic.shape, np.float32), np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]], np.float32)
    for channel, share in enumerate(_LUMA):
        is_there = (place == channel).astype(np.float32)
        total, known = np.zeros_like(luma), np.zeros_like(luma)
        for (i, j), weight in np.ndenumerate(weights):
            part = np.s_[i : i + height, j : j + width]
            total += weight * (padded * is_there)[part]
            known += weight * is_there[part]
        luma += np.float32(share) * total / known
    return np.round(luma).astype(np.uint8)


def stated_std(covariances: Array) -> tuple[Array, str]:
    """Return the noise (6,) that covariances (n, 36) of a twist state, and a note if there is something to say.

    It is 0 for an axis that states nothing, and inf for one that is not measured: drivers write 1e6 or more. Some write
    1e-12 while the robot stands still.
    """
    full = covariances.reshape(-1, 6, 6)
    variance = np.diagonal(full, axis1=1, axis2=2)
    filled = (variance > _UNSET) & (variance < _UNKNOWN)
    states = filled.any(axis=0)
    among = np.ix_(filled[:, states].all(axis=1), states, states)
    together = full[among].mean(axis=0) if states.any() else np.eye(0)
    if not np.isfinite(together).all() or (np.linalg.eigvalsh(together) <= 0).any():
        return np.zeros(6), "Covariances of the velocities are not used: they are not positive definite."
    std = np.where((variance >= _UNKNOWN).all(axis=0), np.inf, 0.0)
    std[states] = np.sqrt(np.diag(together))
    if not std.any():
        return std, ""
    texts = ", ".join("not measured" if np.isinf(value) else f"{value:.3g}" if value else "-" for value in std)
    return std, f"Noise that covariances of the velocities state (m/s, rad/s): {texts}."


def transform_of(transform: Any) -> Array:
    """Return the pose (4, 4) of the child frame of a Transform in its parent."""
    return _rigid(transform.translation, transform.rotation, "tf_static")


def pose_of(pose: Any) -> Array:
    """Return a Pose (4, 4)."""
    return _rigid(pose.position, pose.orientation, "odometry")


def _rigid(t: Any, q: Any, field: str) -> Array:
    from scipy.spatial.transform import Rotation

    quaternion = np.array([q.x, q.y, q.z, q.w], dtype=float)
    if not quaternion.any() and field == "odometry":
        quaternion[3] = 1.0  # never filled in
    if not abs(np.linalg.norm(quaternion) - 1.0) < 1e-3:
        raise CalibrationError("a transform without a unit quaternion", field=field)
    return se3.transform(Rotation.from_quat(quaternion).as_matrix(), np.array([t.x, t.y, t.z], dtype=float))
