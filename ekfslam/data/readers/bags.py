"""Bags of ROS 1 and ROS 2, and MCAP: a pair or one camera with CameraInfo, and velocities or inertial samples.

The package rosbags reads them; it is an extra: ``pip install 'ekfslam[ros]'``.
"""

from __future__ import annotations

import contextlib
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.data.checks import spelled_as_in
from ekfslam.data.images import Image, ImageRecording
from ekfslam.data.imu import with_rows
from ekfslam.data.inertial import InertialRows
from ekfslam.data.inputs import VelocitySamples
from ekfslam.data.readers import messages
from ekfslam.data.readers.bag_cameras import Camera, cameras_of, in_order_of_stamps, places_of
from ekfslam.data.readers.bag_imu import imu_of_bag, inertial_of, velocities_of_unit
from ekfslam.data.readers.calibrations import PairFile
from ekfslam.data.readers.fields import BODY_IS_CAMERA, checksum
from ekfslam.data.readers.imu_yaml import find_chain, read_chain
from ekfslam.data.readers.messages import COMPRESSED, IMAGE, ODOMETRY, TRANSFORMS, VELOCITIES, Bag, frame_of
from ekfslam.data.readers.pictures import pair_stamps
from ekfslam.data.readers.poses import velocities_of
from ekfslam.data.readers.registry import CALIBRATION, Reader, Source
from ekfslam.data.readers.text import first_row
from ekfslam.data.sequence import TWIST_STD
from ekfslam.data.velocities import is_covered, resample, stated_at
from ekfslam.errors import LostDataError, StampError, UnknownFormatError
from ekfslam.geometry import se3
from ekfslam.geometry.camera import T_CAM_BODY
from ekfslam.names import printable


class BagPairs:
    """Load images of a pair or of one camera from a bag, opened at the first call.

    ``places`` of each camera are (T, 2): time of writing and stamp, ns.
    """

    def __init__(
        self,
        path: Path,
        topics: tuple[str, ...],
        places: tuple[IntArray, ...],
        size: tuple[int, int],
        bits: int = 16,
    ):
        self.path, self.topics, self.places, self.size, self.bits = path, topics, places, size, bits

    @cached_property
    def _bag(self) -> Bag:
        return Bag(self.path)

    def __call__(self, frame: int) -> tuple[Image, ...]:
        return tuple(self._image(side, frame) for side in range(len(self.topics)))

    def _image(self, side: int, frame: int) -> Image:
        written_ns, stamp_ns = self.places[side][frame].tolist()
        bag, topic = self._bag, self.topics[side]
        for connection in bag.connections(IMAGE, COMPRESSED):
            if connection.topic != topic:
                continue
            for _, content in bag.raw(connection, written_ns, written_ns + 1):
                if bag.stamp_ns(content) in (stamp_ns, 0):  # 0: without stamps
                    message, source = bag.message(connection, content), f"{self.path}: {printable(topic)}"
                    return messages.gray_of(message, source, self.size, self.bits)
        raise LostDataError(f"the image at {stamp_ns} ns is gone", source=str(self.path), field=printable(topic))


def open_bag(path: Path, topics: tuple[str, ...] = (), calibration: str | None = None) -> ImageRecording:
    """Open the images of the pair, or the one camera, of a bag, its calibration, inertial samples and velocities.

    The CameraInfo of the right camera has a baseline in P. Topics with ``rect`` in their last part are rectified images
    with the camera P; others are as the lens sees them, with K, D and R. The body is the inertial unit if
    ``/tf_static``, or a chain of Kalibr beside the bag, connects it to the camera; else the frame of the velocities. If
    nothing connects that to the camera either, the body is the left camera. ``topics`` and a ``calibration`` file take
    precedence.
    """
    with contextlib.closing(Bag(path, topics)) as bag, spelled_as_in(str(path)):
        rig = cameras_of(bag, calibration)
        places, bits, said = zip(*map(places_of, rig.cameras), strict=True)
        if len(places) == 2:
            *paired, alone = pair_stamps(places[0][:, 1], places[1][:, 1], str(path))
            places, said = tuple(at[kept] for at, kept in zip(places, paired, strict=True)), (*said, alone)
        time_s = places[0][:, 1] / 1e9
        velocities, T_optical_body, rows, found = _inputs(bag, rig.cameras[0], rig.file)
        notes = (*rig.notes, *(note for some in said for note in some), *found)
        twist, used, stated = None, np.ones(len(time_s), dtype=bool), {}
        if velocities is not None:
            used = is_covered(velocities.time_s, time_s)
            if not used.all():
                notes = (*notes, f"{int((~used).sum())} frames before or after all velocities are left out.")
            twist, how = resample(velocities, time_s[used])
            notes = (*notes, f"Velocities: {how}.")
            stated = stated_at(velocities, time_s[used])
        names = tuple(camera.topic for camera in rig.cameras)
        load = BagPairs(path, names, tuple(at[used] for at in places), rig.calibration.size, max(bits))
        given = {} if rig.file is None else {CALIBRATION: checksum(*rig.file.files)}
        recording = ImageRecording(
            name=path.resolve().stem,
            source=str(path),
            time_s=time_s[used],
            calibration=rig.calibration,
            load=load,
            T_cam_imu=se3.transform(rig.R_cam_optical, np.zeros(3)) @ T_optical_body,
            twist=twist,
            notes=notes,
            attributes={"reader": READER.name, "topics": printable(" ".join(names)), **given, **stated},
        )
        return recording if rows is None else with_rows(recording, rows)


def _inputs(
    bag: Bag, left: Camera, file: PairFile | None
) -> tuple[VelocitySamples | None, Array, InertialRows | None, tuple[str, ...]]:
    """Return velocities of the body, ``T_optical_body`` (4, 4), inertial samples, and notes."""
    rows, imu_frame, said = inertial_of(bag, near=left.topic)
    velocities, frame, found = _velocities(bag)
    if rows is not None:
        T_optical_imu, late_s, where = _unit(bag, left, imu_frame, file)
        said = (*said, *where)
        if T_optical_imu is not None:
            rows = replace(rows, late_s=late_s)
            if velocities is not None and frame != imu_frame:
                T_imu_base = _transform(bag, imu_frame, frame)
                velocities, note = velocities_of_unit(velocities, T_imu_base, imu_frame)
                said = (*said, note)
            return velocities, T_optical_imu, rows, (*found, *said)
    if velocities is None and file is not None and file.T_cam_imu is not None:
        note = f"The body is the inertial unit of {file.files[0].name}, which states T_cam_imu."
        return None, file.T_cam_imu, None, (*found, *said, note)
    T_optical_body, note = _body(bag, left, frame)
    return velocities, T_optical_body, None, (*found, *said, note)


def _unit(bag: Bag, left: Camera, frame: str, file: PairFile | None) -> tuple[Array | None, float, tuple[str, ...]]:
    """Return ``T_optical_imu`` (4, 4), None if nothing states it, the lateness of samples in s, and notes."""
    if file is not None and file.T_cam_imu is not None:
        return file.T_cam_imu, file.late_s, (f"T_cam_imu is that of {file.files[0].name}.",)
    T = np.eye(4) if frame and frame == left.frame else _transform(bag, left.frame, frame) if frame else None
    late, chain = 0.0, find_chain(bag.path if bag.path.is_dir() else bag.path.parent, bag.path.resolve().parent)
    if chain is not None:
        late, T_chain, notes = read_chain(chain, left.topic)
        if T is None and T_chain is not None:
            return T_chain, late, notes
    if T is not None:
        return T, late, (f"T_cam_imu is that of {printable(frame)} to {printable(left.frame)} in /tf_static.",)
    where = f"/tf_static does not connect {printable(frame) or 'it'} and {printable(left.frame)}"
    return None, late, (f"Inertial samples are not used: {where}; put camchain-imucam.yaml of Kalibr beside the bag.",)


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
    rows, frame, covariances, poses = [], "", [], []
    for message in bag.messages(chosen):
        # With covariance a twist is one level further down.
        twist = message.twist if hasattr(message.twist, "linear") else message.twist.twist
        covariances.append(getattr(message.twist, "covariance", np.zeros(36)))
        name = message.child_frame_id if chosen.msgtype == ODOMETRY else message.header.frame_id
        frame = frame or frame_of(name)
        if chosen.msgtype == ODOMETRY:
            poses.append(messages.pose_of(message.pose.pose))
        linear, angular = twist.linear, twist.angular
        rows.append([messages.stamp_of(message), linear.x, linear.y, linear.z, angular.x, angular.y, angular.z])
    table = np.array(rows, dtype=float).reshape(-1, 7)
    if len(table) < 2:
        raise LostDataError(f"{len(table)} messages; two are needed", field=topic)
    if not np.isfinite(table).all():
        raise UnknownFormatError(f"{bag.path}: {topic}: velocities are NaN or infinite")
    if len(np.unique(table[:, 0])) < 2:
        raise StampError("all messages have the same stamp", field=topic)
    order, said = in_order_of_stamps(np.column_stack([table[:, 0], np.arange(len(table))]), 0, f"messages of {topic}")
    kept = order[:, 1].astype(int)
    table, notes = table[kept], (*notes, *said)
    if poses and not table[:, 1:].any() and len(kept) > 2 and not (np.array(poses) == poses[0]).all():
        stamps, twist, note = velocities_of(table[:, 0], np.array(poses)[kept])
        return VelocitySamples(str(bag.path), stamps, twist), frame, (*notes, f"The twist of {topic} is 0. {note}")
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
    images=lambda source: open_bag(source.path, source.topics, source.calibration),
    inertial=lambda source: imu_of_bag(source.path),
)
