"""Bags of ROS 1 and ROS 2, and MCAP: a stereo pair with CameraInfo, and velocities by Odometry or a stamped twist.

The package rosbags reads them; it is an extra: ``pip install 'ekfslam[bags]'``.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.data.checks import spelled_as_in
from ekfslam.data.images import Distortion, DistortionModel, Image, ImageRecording, PairCalibration, side_by_side
from ekfslam.data.imu import with_rows
from ekfslam.data.inertial import InertialRows
from ekfslam.data.inputs import VelocitySamples
from ekfslam.data.readers import messages
from ekfslam.data.readers.bag_imu import imu_of_bag, inertial_of, velocities_of_unit
from ekfslam.data.readers.fields import BODY_IS_CAMERA
from ekfslam.data.readers.imu_yaml import CHAINS, beside, chain_of, late_s
from ekfslam.data.readers.messages import (
    CAMERA_INFO,
    COMPRESSED,
    IMAGE,
    ODOMETRY,
    TRANSFORMS,
    VELOCITIES,
    Bag,
    frame_of,
)
from ekfslam.data.readers.pictures import pair_stamps
from ekfslam.data.readers.registry import Reader, Source
from ekfslam.data.readers.text import first_row
from ekfslam.data.readers.yaml import read_yaml
from ekfslam.data.sequence import TWIST_STD
from ekfslam.data.velocities import is_covered, resample, stated_at
from ekfslam.errors import CalibrationError, LostDataError, StampError, UnknownFormatError
from ekfslam.geometry import se3
from ekfslam.geometry.camera import T_CAM_BODY
from ekfslam.names import printable

_MODELS: dict[str, DistortionModel] = {
    "plumb_bob": "radtan",
    "rational_polynomial": "radtan",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
}


@dataclass(frozen=True)
class Camera:
    """Images of a camera of a bag (their connection), and its first CameraInfo."""

    stream: Any
    info: Any

    @property
    def topic(self) -> str:
        return str(self.stream.topic)

    @property
    def frame(self) -> str:
        """Name of the optical frame."""
        return frame_of(self.info.header.frame_id)

    @property
    def is_rectified(self) -> bool:
        """Whether the images are rectified, by the last part of their topic."""
        return "rect" in _parts(self.topic)[1]

    @property
    def projection(self) -> Array:
        """P (3, 4)."""
        return messages.matrix_of(self.info, "p", 3)


def _parts(topic: str) -> tuple[str, str]:
    """Return space and last part: ``/left`` and ``image_raw`` of ``/left/image_raw/compressed``."""
    space, _, last = topic.removesuffix("/compressed").rpartition("/")
    return space, last


class BagPairs:
    """Load pairs of images from a bag, which is opened at the first call.

    Args:
        path: Path of the bag.
        topics: Topics of the left and the right images.
        places: (T, 2) time of writing and stamp, ns, of the left and the right images.
        size: Required width and height of all images.
    """

    def __init__(self, path: Path, topics: tuple[str, str], places: tuple[IntArray, IntArray], size: tuple[int, int]):
        self.path, self.topics, self.places, self.size = path, topics, places, size

    @cached_property
    def _bag(self) -> Bag:
        return Bag(self.path)

    def __call__(self, frame: int) -> tuple[Image, Image]:
        return self._image(0, frame), self._image(1, frame)

    def _image(self, side: int, frame: int) -> Image:
        written_ns, stamp_ns = self.places[side][frame].tolist()
        bag, topic = self._bag, self.topics[side]
        for connection in bag.connections(IMAGE, COMPRESSED):
            if connection.topic != topic:
                continue
            for _, content in bag.raw(connection, written_ns, written_ns + 1):
                if bag.stamp_ns(content) == stamp_ns:
                    return messages.gray_of(
                        bag.message(connection, content), f"{self.path}: {printable(topic)}", self.size
                    )
        raise LostDataError(f"the image at {stamp_ns} ns is gone", source=str(self.path), field=printable(topic))


def open_bag(path: Path) -> ImageRecording:
    """Open the images of the stereo pair of a bag, its calibration, inertial samples and velocities if it has any.

    The CameraInfo of the right camera has a baseline in P. Topics with ``rect`` in their last part are rectified
    images with the camera P; others are as the lens sees them, with K, D and R. The body is the inertial unit if
    ``/tf_static``, or a chain of Kalibr beside the bag, connects it to the camera; else the frame of the velocities.
    If nothing connects that to the camera either, the body is the left camera.

    Raises:
        MissingPackageError: rosbags is not installed.
    """
    with contextlib.closing(Bag(path)) as bag, spelled_as_in(str(path)):
        left, right = _pair(bag)
        places = [_places(bag, camera) for camera in (left, right)]
        in_left, in_right, notes = pair_stamps(places[0][:, 1], places[1][:, 1], str(path))
        calibration, R_cam_optical = _calibration(left, right)
        time_s = places[0][in_left, 1] / 1e9
        velocities, T_optical_body, rows, found = _inputs(bag, left)
        notes = (*notes, *found)
        twist, used, stated = None, np.ones(len(time_s), dtype=bool), {}
        if velocities is not None:
            used = is_covered(velocities.time_s, time_s)
            if not used.all():
                notes = (*notes, f"{int((~used).sum())} frames before or after all velocities are left out.")
            twist, how = resample(velocities, time_s[used])
            notes = (*notes, f"Velocities: {how}.")
            stated = stated_at(velocities, time_s[used])
        chosen = (places[0][in_left[used]], places[1][in_right[used]])
        recording = ImageRecording(
            name=path.resolve().stem,
            source=str(path),
            time_s=time_s[used],
            calibration=calibration,
            load=BagPairs(path, (left.topic, right.topic), chosen, calibration.size),
            T_cam_imu=se3.transform(R_cam_optical, np.zeros(3)) @ T_optical_body,
            twist=twist,
            notes=notes,
            attributes={"reader": READER.name, "topics": printable(f"{left.topic} {right.topic}"), **stated},
        )
        return recording if rows is None else with_rows(recording, rows)


def _inputs(bag: Bag, left: Camera) -> tuple[VelocitySamples | None, Array, InertialRows | None, tuple[str, ...]]:
    """Return velocities of the body, ``T_optical_body`` (4, 4), inertial samples, and notes."""
    rows, imu_frame, said = inertial_of(bag, near=left.topic)
    velocities, frame, found = _velocities(bag)
    if rows is not None:
        T_optical_imu, late_s, where = _unit(bag, left, imu_frame)
        said = (*said, *where)
        if T_optical_imu is not None:
            rows = replace(rows, late_s=late_s)
            if velocities is not None and frame != imu_frame:
                T_imu_base = _transform(bag, imu_frame, frame)
                velocities, note = velocities_of_unit(velocities, T_imu_base, imu_frame)
                said = (*said, note)
            return velocities, T_optical_imu, rows, (*found, *said)
    T_optical_body, note = _body(bag, left, frame)
    return velocities, T_optical_body, None, (*found, *said, note)


def _unit(bag: Bag, left: Camera, frame: str) -> tuple[Array | None, float, tuple[str, ...]]:
    """Return ``T_optical_imu`` (4, 4), None if nothing states it, the lateness of samples in s, and notes."""
    T = np.eye(4) if frame and frame == left.frame else _transform(bag, left.frame, frame) if frame else None
    late, notes = 0.0, tuple[str, ...]()
    chain = beside(bag.path.parent, CHAINS)
    if chain is not None:
        read = read_yaml(chain)
        late = late_s(read, "cam0")
        if T is None and (found := chain_of(read, "cam0")) is not None:
            T, notes = found[0], (f"T_cam_imu is that of cam0 in {chain.name}.", *found[1])
            return T, late, notes
    if T is not None:
        return T, late, (f"T_cam_imu is that of {printable(frame)} to {printable(left.frame)} in /tf_static.",)
    where = f"/tf_static does not connect {printable(frame) or 'it'} and {printable(left.frame)}"
    return None, late, (f"Inertial samples are not used: {where}; put camchain-imucam.yaml of Kalibr beside the bag.",)


def _pair(bag: Bag) -> tuple[Camera, Camera]:
    infos = {_parts(connection.topic)[0]: connection for connection in bag.connections(CAMERA_INFO)}
    streams: dict[str, Any] = {}
    for connection in bag.connections(IMAGE, COMPRESSED):
        space = _parts(connection.topic)[0]
        # Rectified before raw, uncompressed before compressed.
        if space in infos and (space not in streams or _rank(connection) < _rank(streams[space])):
            streams[space] = connection
    if len(streams) > 2:
        sides = {space: connection for space, connection in streams.items() if "left" in space or "right" in space}
        streams = sides if len(sides) == 2 else streams
    if len(streams) != 2:
        found = printable(", ".join(connection.topic for connection in streams.values())) or "none"
        message = f"expected two cameras with images and CameraInfo, found {len(streams)}: {found}"
        raise CalibrationError(message, field="topics")
    cameras = [Camera(streams[space], _first(bag, infos[space])) for space in sorted(streams)]
    shifts = [camera.projection[0, 3] for camera in cameras]
    rights = [i for i, shift in enumerate(shifts) if shift < 0]
    if len(rights) != 1 or shifts[1 - rights[0]] != 0:
        found = f"{shifts[0]:g} and {shifts[1]:g}"
        message = f"expected P[0, 3] to be 0 for the left camera and negative for the right one, found {found}"
        raise CalibrationError(message, field="CameraInfo")
    return cameras[1 - rights[0]], cameras[rights[0]]


def _rank(connection: Any) -> tuple[bool, bool]:
    return "rect" not in _parts(connection.topic)[1], connection.msgtype == COMPRESSED


def _first(bag: Bag, connection: Any) -> Any:
    first = next(bag.messages(connection), None)
    if first is None:
        raise LostDataError("there is no message", field=printable(connection.topic))
    return first


def _places(bag: Bag, camera: Camera) -> IntArray:
    """Return time of writing and stamp (T, 2) of each image, ns, in the order of stamps."""
    found = np.array([(written, bag.stamp_ns(content)) for written, content in bag.raw(camera.stream)])
    if not len(found):
        raise LostDataError("there is no message", field=printable(camera.topic))
    found = found[np.argsort(found[:, 1], kind="stable")].astype(np.int64)
    twice = np.diff(found[:, 1]) == 0
    if twice.any():
        index = int(np.argmax(twice)) + 1
        raise StampError(f"two images have the stamp {found[index, 1]} ns", field=printable(camera.topic), index=index)
    return found


def _calibration(left: Camera, right: Camera) -> tuple[PairCalibration, Array]:
    """Return the calibration, and the rotation (3, 3) from the optical frame of the left camera to its images."""
    size = (int(left.info.width), int(left.info.height))
    if size != (int(right.info.width), int(right.info.height)):
        raise CalibrationError("the cameras have different sizes", field="CameraInfo")
    if left.is_rectified != right.is_rectified:
        raise CalibrationError("images of one camera are rectified, of the other not", field="topics")
    P_left, P_right = left.projection, right.projection
    if not P_right[0, 0] > 0:
        raise CalibrationError("P has no positive focal length", field="CameraInfo")
    shift = side_by_side(-P_right[0, 3] / P_right[0, 0])
    R_left, R_right = (_rotation(camera) for camera in (left, right))
    if left.is_rectified:
        return PairCalibration(P_left[:, :3], P_right[:, :3], size, shift), R_left
    turn_left, turn_right = (se3.transform(R, np.zeros(3)) for R in (R_left, R_right))
    T_right_left = se3.inverse(turn_right) @ shift @ turn_left
    K_left, K_right = (messages.matrix_of(camera.info, "k", 3) for camera in (left, right))
    return PairCalibration(K_left, K_right, size, T_right_left, _lens(left), _lens(right)), np.eye(3)


def _rotation(camera: Camera) -> Array:
    """Return the rotation from the optical frame to rectified images; all zeros stand for the identity."""
    from scipy.spatial.transform import Rotation

    R = messages.matrix_of(camera.info, "r", 3)
    if not R.any():
        return np.eye(3)
    if not np.abs(R @ R.T - np.eye(3)).max() < 1e-4 or np.linalg.det(R) < 0:
        raise CalibrationError("R is no rotation", field=f"CameraInfo of {printable(camera.topic)}")
    return Rotation.from_matrix(R).as_matrix()


def _lens(camera: Camera) -> Distortion:
    coefficients = tuple(float(value) for value in messages.field_of(camera.info, "d"))
    name = str(camera.info.distortion_model)
    if not any(coefficients):
        return Distortion()
    if name not in _MODELS:
        message = f"expected the distortion {', '.join(_MODELS)}, found {printable(name)!r}"
        raise CalibrationError(message, field=f"CameraInfo of {printable(camera.topic)}")
    return Distortion(_MODELS[name], coefficients)


def _velocities(bag: Bag) -> tuple[VelocitySamples | None, str, tuple[str, ...]]:
    """Return velocities, the name of their frame, and notes."""
    streams = bag.connections(*VELOCITIES)
    if not streams:
        return None, "", ("There are no velocities.",)
    # A single twist is more likely to be measured than that of an estimate.
    chosen = min(streams, key=lambda connection: (VELOCITIES.index(connection.msgtype), connection.topic))
    others = [connection.topic for connection in streams if connection.topic != chosen.topic]
    topic = printable(chosen.topic)
    notes = (f"Velocities are those of {topic}.", *(f"Not used: velocities of {printable(name)}." for name in others))
    rows, frame, covariances = [], "", []
    for message in bag.messages(chosen):
        # With covariance a twist is one level further down.
        twist = message.twist if hasattr(message.twist, "linear") else message.twist.twist
        covariances.append(getattr(message.twist, "covariance", np.zeros(36)))
        name = message.child_frame_id if chosen.msgtype == ODOMETRY else message.header.frame_id
        frame = frame or frame_of(name)
        linear, angular = twist.linear, twist.angular
        rows.append([messages.stamp_of(message), linear.x, linear.y, linear.z, angular.x, angular.y, angular.z])
    table = np.array(rows, dtype=float).reshape(-1, 7)
    if len(table) < 2:
        raise LostDataError(f"{len(table)} messages; two are needed", field=topic)
    if not np.isfinite(table).all():
        raise UnknownFormatError(f"{bag.path}: {topic}: velocities are NaN or infinite")
    if (np.diff(table[:, 0]) <= 0).any():
        index = int(np.argmax(np.diff(table[:, 0]) <= 0)) + 1
        raise StampError("the stamp does not increase", field=topic, index=index)
    std, note = messages.stated_std(np.array(covariances, dtype=float))
    attributes = {TWIST_STD: " ".join(map(repr, std.tolist()))} if std.any() else {}
    notes += (note,) if note else ()
    return VelocitySamples(str(bag.path), table[:, 0], table[:, 1:], attributes=attributes), frame, notes


def _body(bag: Bag, left: Camera, frame: str) -> tuple[Array, str]:
    """Return the transform (4, 4) from the body to the optical frame of the left camera, and a note on the body."""
    if frame and frame == left.frame:
        return np.eye(4), "The velocities are those of the left optical frame, which is the body."
    T = _transform(bag, left.frame, frame) if frame else None
    if T is not None:
        return T, f"T_cam_imu is that of {printable(frame)} to {printable(left.frame)} in /tf_static."
    missing = f"/tf_static does not connect {printable(frame)} and {printable(left.frame)}. " if frame else ""
    return T_CAM_BODY, missing + BODY_IS_CAMERA


def _transform(bag: Bag, target: str, source: str) -> Array | None:
    """Return ``T_target_source`` (4, 4) through the tree of static transforms; None if they are not connected."""
    edges: dict[str, list[tuple[str, Array]]] = {}
    static = [stream for stream in bag.connections(TRANSFORMS) if stream.topic.lstrip("/") == "tf_static"]
    for entry in (entry for stream in static for message in bag.messages(stream) for entry in message.transforms):
        parent, child = frame_of(entry.header.frame_id), frame_of(entry.child_frame_id)
        T_parent_child = messages.transform_of(entry.transform)
        edges.setdefault(parent, []).append((child, T_parent_child))
        edges.setdefault(child, []).append((parent, se3.inverse(T_parent_child)))
    reached = {target: np.eye(4)}
    waiting = [target]
    while waiting:
        here = waiting.pop()
        for there, T_here_there in edges.get(here, ()):
            if there not in reached:
                reached[there] = reached[here] @ T_here_there
                waiting.append(there)
    return reached.get(source)


def _recognises(source: Source) -> bool:
    if source.head.startswith(messages.MAGICS):
        return True
    return source.path.is_dir() and first_row(source.path / "metadata.yaml", comment=None).startswith(
        "rosbag2_bagfile_information"
    )


READER = Reader(
    "bag",
    "a bag of ROS 1 or ROS 2, or MCAP",
    _recognises,
    images=lambda source: open_bag(source.path),
    inertial=lambda source: imu_of_bag(source.path),
)
