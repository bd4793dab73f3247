"""Cameras of a bag: choice of the pair, or of one camera, among its topics, calibration, and stamps of images."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.data.checks import spelled_as_in
from ekfslam.data.images import Distortion, LensCalibration, PairCalibration, side_by_side
from ekfslam.data.readers import messages
from ekfslam.data.readers.calibrations import PairFile, lens_of, read_pair, rectified_apart, shift_of
from ekfslam.data.readers.imu_yaml import find_chain
from ekfslam.data.readers.messages import CAMERA_INFO, COMPRESSED, IMAGE, Bag, frame_of
from ekfslam.data.readers.pictures import side_of, without_side
from ekfslam.errors import CalibrationError, LostDataError
from ekfslam.names import printable

_NO_PICTURES = re.compile(r"depth|disparity|confidence|point_?cloud|registered|mask", re.IGNORECASE)


@dataclass(frozen=True)
class Camera:
    """Images of a camera of a bag (their connection), and its first CameraInfo, if it has one."""

    bag: Bag
    stream: Any
    info: Any = None

    @property
    def topic(self) -> str:
        return str(self.stream.topic)

    @cached_property
    def first(self) -> Any:
        """First image."""
        return first_of(self.bag, self.stream)

    @property
    def frame(self) -> str:
        """Name of the optical frame."""
        return frame_of((self.first if self.info is None else self.info).header.frame_id)

    @property
    def is_rectified(self) -> bool:
        """Whether the images are rectified, by the last part of their topic, or a part that says so alone."""
        space, last = parts_of(self.topic)
        return "rect" in last or "rect" in space.split("/")

    @property
    def projection(self) -> Array:
        """P (3, 4)."""
        return messages.matrix_of(self.info, "p", 3)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return int(self.info.width), int(self.info.height)


@dataclass(frozen=True)
class BagCameras:
    """The stereo pair of a bag, or its one camera."""

    cameras: tuple[Camera, ...]  # left and right, or one
    calibration: PairCalibration | LensCalibration
    R_cam_optical: Array  # (3, 3) rotation from the optical frame of the left camera to its images
    file: PairFile | None  # calibration in a file, if it was taken in place of CameraInfo
    notes: tuple[str, ...]  # facts about the choice


def parts_of(topic: str) -> tuple[str, str]:
    """Return space and last part: ``/left`` and ``image_raw`` of ``/left/image_raw/compressed``."""
    space, _, last = topic.removesuffix("/compressed").rpartition("/")
    return space, last


def first_of(bag: Bag, connection: Any) -> Any:
    """Return the first message of a stream; raise `LostDataError` if there is none."""
    first = next(bag.messages(connection), None)
    if first is None:
        raise LostDataError("there is no message", field=printable(connection.topic))
    return first


def cameras_of(bag: Bag, calibration: str | None = None) -> BagCameras:
    """Choose the stereo pair of a bag: named topics, otherwise by CameraInfo, a calibration file, or the topics' names.

    One named topic of images is one camera, and so is the only one of a bag. Of several pairs a rectified one is
    preferred, then images that are not compressed. A ``calibration`` file for `read_pair` takes precedence over
    CameraInfo. Without either, the chain of Kalibr beside the bag is taken. Raise `CalibrationError`, which lists all
    topics, if there is no such pair.
    """
    cameras = _cameras(bag)
    wanted = min(len(cameras), 2)
    if calibration is None and sum(camera.info is not None for camera in cameras) < wanted:
        beside = find_chain(bag.path if bag.path.is_dir() else bag.path.parent, bag.path.resolve().parent)
        calibration = None if beside is None else str(beside)
    if calibration is None:
        chosen, notes = _by_info(bag, cameras)
        found, R_cam_optical = _calibration(*chosen)
        return BagCameras(chosen, found, R_cam_optical, None, notes)
    images = tuple(camera.topic for camera in cameras) if bag.named or wanted == 1 else ("left", "right")
    file = read_pair(calibration, images)
    chosen, notes = _by_names(bag, cameras, file)
    size = messages.size_of(chosen[0].first, f"{bag.path}: {printable(chosen[0].topic)}")
    said = (f"The calibration is that of {file.files[0].name}.", *file.notes)
    return BagCameras(chosen, file.pair(size), np.eye(3), file, (*notes, *said))


def _cameras(bag: Bag) -> list[Camera]:
    """Return the cameras that may be meant: those named, in that order, or else all that take pictures."""
    infos = {parts_of(connection.topic)[0]: connection for connection in bag.connections(CAMERA_INFO)}
    streams = bag.connections(IMAGE, COMPRESSED)
    named = [stream for stream in streams if stream.topic in bag.named]
    if len(named) > 2:
        found = printable(", ".join(stream.topic for stream in named))
        raise CalibrationError(f"expected one or two topics of images, found {found}", field="topics")
    best: dict[str, Any] = {}
    for stream in named or [stream for stream in streams if not _NO_PICTURES.search(stream.topic)]:
        space, last = parts_of(stream.topic)
        key = stream.topic if named else f"{space} {side_of(last)}"
        if key not in best or _rank(Camera(bag, stream)) < _rank(Camera(bag, best[key])):
            best[key] = stream
    spaces = {parts_of(stream.topic)[0] for stream in best.values()}
    other = [first_of(bag, info) for space, info in infos.items() if space not in spaces] if spaces - {*infos} else []

    def info_of(stream: Any) -> Any:
        if (space := parts_of(stream.topic)[0]) in infos:
            return first_of(bag, infos[space])
        # In another namespace, as of Isaac Sim.
        same = [info for info in other if info.header.frame_id == first_of(bag, stream).header.frame_id]
        return same[0] if len(same) == 1 else None

    return [Camera(bag, stream, info_of(stream)) for stream in best.values()]


def _rank(camera: Camera) -> tuple[bool, bool]:
    return not camera.is_rectified, camera.stream.msgtype == COMPRESSED


def _by_info(bag: Bag, cameras: list[Camera]) -> tuple[tuple[Camera, ...], tuple[str, ...]]:
    """Return left and right camera by the baseline in P, or the only camera, and notes on the choice."""
    known = [camera for camera in cameras if camera.info is not None]
    if bag.named and len(known) < len(cameras):
        lacking = ", ".join(printable(camera.topic) for camera in cameras if camera.info is None)
        raise CalibrationError(f"no CameraInfo in the namespace of {lacking}; {_WAYS}", field="topics")
    if len(cameras) == len(known) == 1:
        return (known[0],), _is_one(known[0])
    if len(known) == 2:
        pairs = [_ordered(*known)]
    else:
        lefts = [camera for camera in known if camera.projection[0, 3] == 0 < camera.projection[0, 0]]
        rights = [camera for camera in known if camera.projection[0, 3] < 0 < camera.projection[0, 0]]
        pairs = [
            (left, right)
            for right in rights
            for left in lefts
            if left.size == right.size and left.is_rectified == right.is_rectified
        ]
    pairs = _best(pairs)
    if len(cameras) == 1:
        topic = printable(cameras[0].topic)
        message = f"there is one camera, {topic}, without CameraInfo; --calibration FILE gives a calibration"
        raise CalibrationError(f"{message}; {listed(bag)}", field="topics")
    if not pairs:
        found = f"found {len(known)}: {printable(', '.join(camera.topic for camera in known)) or 'none'}"
        message = f"expected two cameras with images and CameraInfo, {found}; {_WAYS}; {listed(bag)}"
        raise CalibrationError(message, field="topics")
    return pairs[0], _others(pairs)


_WAYS = "--topics LEFT RIGHT names the pair, --topics CAMERA one camera, --calibration FILE gives a calibration"


def _is_one(camera: Camera) -> tuple[str, ...]:
    bag, space = camera.bag, parts_of(camera.topic)[0]
    alone = [each.topic for each in bag.connections(CAMERA_INFO) if parts_of(each.topic)[0] != space]
    alone = [] if bag.named else [printable(topic) for topic in alone if not _NO_PICTURES.search(topic)]
    return (f"There is one camera: {printable(camera.topic)}.", *(f"{topic} is without images." for topic in alone))


def listed(bag: Bag) -> str:
    """Return the topics of a bag in words."""
    return f"the bag has {printable(', '.join(f'{topic} ({kind})' for topic, kind in bag.topics.items()))}"


def _ordered(first: Camera, second: Camera) -> tuple[Camera, Camera]:
    shifts = [camera.projection[0, 3] for camera in (first, second)]
    rights = [i for i, shift in enumerate(shifts) if shift < 0]
    if len(rights) != 1 or shifts[1 - rights[0]] != 0:
        found = f"{shifts[0]:g} and {shifts[1]:g}"
        message = f"expected P[0, 3] to be 0 for the left camera and negative for the right one, found {found}; {_WAYS}"
        raise CalibrationError(message, field="CameraInfo")
    return ((first, second), (second, first))[1 - rights[0]]


def _best(pairs: list[tuple[Camera, Camera]]) -> list[tuple[Camera, Camera]]:
    """Return the pairs, best first: names that differ in the side alone if there are any, rectified, not compressed."""
    alike = [pair for pair in pairs if _are_sides(*pair)]
    return sorted(alike or pairs, key=lambda pair: (_rank(pair[0]), _rank(pair[1]), pair[0].topic, pair[1].topic))


def _are_sides(left: Camera, right: Camera) -> bool:
    of_left, of_right = without_side(left.topic, 0), without_side(right.topic, 1)
    return of_left is not None and of_left == of_right


def _others(pairs: list[tuple[Camera, Camera]]) -> tuple[str, ...]:
    names = [f"{left.topic} {right.topic}" for left, right in pairs[1:]]
    return tuple(f"Not used: the pair {printable(name)}; --topics chooses it." for name in names)


def _by_names(bag: Bag, cameras: list[Camera], file: PairFile) -> tuple[tuple[Camera, ...], tuple[str, ...]]:
    """Return the cameras of a calibration file: those named, its own topics, or those whose names are of two sides."""
    if len(cameras) == 1:
        return (cameras[0],), _is_one(cameras[0])
    if bag.named and len(cameras) == 2:
        return tuple(cameras), ()
    by_topic = {camera.topic: camera for camera in cameras}
    if file.topics and all(topic in by_topic for topic in file.topics):
        return tuple(by_topic[topic] for topic in file.topics), ()
    pairs = [(left, right) for left in cameras for right in cameras if _are_sides(left, right)]
    if not pairs and len(cameras) == 2:
        pairs = [(cameras[0], cameras[1])]
    is_distorted = file.left.lens.model != "none"
    pairs.sort(key=lambda pair: (pair[0].is_rectified == is_distorted, _rank(pair[0]), pair[0].topic))
    if not pairs:
        message = f"no two topics are of a left and a right camera by name; {_WAYS}; {listed(bag)}"
        raise CalibrationError(message, field="topics")
    return pairs[0], _others(pairs)


def places_of(camera: Camera) -> tuple[IntArray, int, tuple[str, ...]]:
    """Return time of writing and stamp (T, 2) of each image in the order of stamps, ns; used bits; and notes.

    Of images with one stamp the first is kept. Used bits are those of the largest value if images have 16 bits.
    """
    bag, topic = camera.bag, printable(camera.topic)
    is_deep = getattr(camera.first, "encoding", "") in messages.DEEP
    found, largest = [], 0
    for written, content in bag.raw(camera.stream):
        found.append((written, bag.stamp_ns(content)))
        if is_deep and not largest >> 15:
            largest = max(largest, messages.largest_value(bag.message(camera.stream, content)))
    if not found:
        raise LostDataError("there is no message", field=topic)
    table, said = np.array(found, dtype=np.int64), tuple[str, ...]()
    if len(table) > 1 and not table[:, 1].any():
        table[:, 1], said = table[:, 0], (f"Images of {topic} have no stamps: the times of writing are taken.",)
    rows, notes = in_order_of_stamps(table, 1, f"images of {topic}")
    notes += said
    bits = max(largest.bit_length(), 8) if is_deep else 16
    if is_deep:
        notes += (f"Images of 16 bits of {topic} use {bits}, by the largest value: the upper eight of these are kept.",)
    return rows, bits, notes


def in_order_of_stamps(rows: Any, column: int, what: str) -> tuple[Any, tuple[str, ...]]:
    """Return rows sorted by their stamps without those of a repeated stamp, of which the first is kept, and notes."""
    swapped = int((np.diff(rows[:, column]) < 0).sum())
    _, kept = np.unique(rows[:, column], return_index=True)
    counts = {
        f"{what} have the stamp of an earlier one and are left out": len(rows) - len(kept),
        f"{what} are before their predecessors; all are sorted by stamp": swapped,
    }
    return rows[kept], tuple(f"{count} {words}." for words, count in counts.items() if count)


def _calibration(left: Camera, right: Camera | None = None) -> tuple[PairCalibration | LensCalibration, Array]:
    """Return the calibration by CameraInfo, and the rotation (3, 3) from the left optical frame to its images."""
    if right is None:
        if left.is_rectified:
            return LensCalibration(left.projection[:, :3], left.size), _rotation(left)
        K = messages.matrix_of(left.info, "k", 3)
        if not K.any():
            field = f"CameraInfo of {printable(left.topic)}"
            raise CalibrationError("K is 0: the camera is not calibrated; --calibration FILE gives one", field=field)
        return LensCalibration(K, left.size, _lens(left)), np.eye(3)
    if left.size != right.size:
        raise CalibrationError("the cameras have different sizes", field="CameraInfo")
    if left.is_rectified != right.is_rectified:
        raise CalibrationError("images of one camera are rectified, of the other not", field="topics")
    P_left, P_right = left.projection, right.projection
    baseline_m = shift_of(P_right, "CameraInfo")
    R_left, R_right = (_rotation(camera) for camera in (left, right))
    if left.is_rectified:
        return PairCalibration(P_left[:, :3], P_right[:, :3], left.size, side_by_side(baseline_m)), R_left
    T_right_left = rectified_apart(R_left, R_right, baseline_m)
    K_left, K_right = (messages.matrix_of(camera.info, "k", 3) for camera in (left, right))
    return PairCalibration(K_left, K_right, left.size, T_right_left, _lens(left), _lens(right)), np.eye(3)


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
    field = f"CameraInfo of {printable(camera.topic)}"
    coefficients = np.array(messages.field_of(camera.info, "d"), dtype=float)
    with spelled_as_in("", {"distortion": field}):
        return lens_of(printable(str(camera.info.distortion_model)), coefficients, field)
