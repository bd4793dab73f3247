"""Bags of ROS 1 and ROS 2, and MCAP, written here by rosbags."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from rosbags import rosbag2
from rosbags.rosbag2 import StoragePlugin
from support.bags import (
    BASELINE_M,
    FIRST_NS,
    FRAMES,
    HEIGHT,
    KINDS,
    R_LEFT,
    R_RIGHT,
    STEP_NS,
    T_BASE_CAM,
    WIDTH,
    K,
    P,
    Written,
    camera_info,
    image,
    picture,
    stereo,
    transforms,
    twist,
    write,
)
from support.images import opened

from ekfslam import open_images
from ekfslam.data.images import ImageRecording
from ekfslam.data.readers.messages import message_types
from ekfslam.data.sequence import TWIST_STD
from ekfslam.errors import (
    CalibrationError,
    EkfslamError,
    LostDataError,
    MissingPackageError,
    UnknownFormatError,
)
from ekfslam.geometry import se3
from ekfslam.geometry.camera import R_CAM_BODY


def assert_pictures(found: ImageRecording) -> None:
    for frame in (3, 0, len(found) - 1):
        for side, pixels in enumerate(found.load(frame)):
            np.testing.assert_array_equal(pixels, picture(frame, side))


@pytest.mark.parametrize("kind", KINDS)
def test_a_raw_pair_with_velocities_and_static_transforms(tmp_path, kind):
    found = opened(write(tmp_path, stereo(), kind))
    assert_pictures(found)
    np.testing.assert_allclose(found.time_s, (FIRST_NS + STEP_NS * np.arange(FRAMES)) / 1e9, atol=1e-9)
    np.testing.assert_allclose(found.T_cam_imu, se3.inverse(T_BASE_CAM), atol=1e-9)
    # Two samples an interval: the mean of a line is its value in the middle.
    np.testing.assert_allclose(found.twist[1:, 0], 2.0 * np.arange(1, FRAMES), atol=1e-6)
    np.testing.assert_allclose(found.twist[:, 2], 0.1)
    calibration = found.calibration
    assert not calibration.is_rectified and calibration.size == (WIDTH, HEIGHT)
    np.testing.assert_array_equal(calibration.K_left, K)
    assert calibration.distortion_left.coefficients == (-0.1, 0.01, 0.001, -0.001, 0.0)
    # A point on the left axis is at the same row of both rectified images, and disparity is fu b / z.
    q = np.array([0.3, 0.2, 2.0])
    left = R_LEFT @ q
    right = R_RIGHT @ se3.apply(calibration.T_right_left, q)
    np.testing.assert_allclose(left - right, [BASELINE_M, 0, 0], atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_rectified_and_compressed_images(tmp_path, kind):
    bag = stereo("image_rect/compressed", velocities="odometry")
    found = opened(write(tmp_path, bag, kind))
    assert_pictures(found)
    assert found.calibration.is_rectified
    np.testing.assert_array_equal(found.calibration.K_left, P[:, :3])
    np.testing.assert_allclose(found.calibration.T_right_left[:3, 3], [-BASELINE_M, 0, 0])
    np.testing.assert_allclose(found.T_cam_imu[:3, :3], R_LEFT @ T_BASE_CAM[:3, :3].T, atol=1e-9)
    assert any("/odom" in note for note in found.notes)


@pytest.mark.parametrize(
    ("variance", "expected"),
    [
        ([0.04, 0, 0, 0, 0, 0.0009], "0.2 0 0 0 0 0.03"),
        ([0.04, 1e-12, 1e6, np.finfo(float).max, np.inf, 0.0009], "0.2 0 inf inf inf 0.03"),
        ([0.04] * 6, "0.2 0.2 0.2 0.2 0.2 0.2"),
        ([0] * 6, None),
        ([1e-12] * 6, None),
    ],
)
def test_noise_of_velocities_is_that_of_their_covariance_where_it_is_filled(tmp_path, variance, expected):
    found = opened(write(tmp_path, stereo(velocities="odometry", covariance=np.diag(variance).ravel())))
    stated = found.attributes.get(TWIST_STD)
    assert (stated is None) == (expected is None) == (not any("Noise that covariances" in note for note in found.notes))
    if expected is not None:  # two samples an interval, and their mean
        np.testing.assert_allclose(np.array(stated.split(), float), np.array(expected.split(), float) / np.sqrt(2))


def test_a_covariance_that_is_not_positive_definite_is_refused_with_a_note(tmp_path):
    wrong = np.diag([0.04, 0, 0, 0, 0, 0.0009])
    wrong[0, 5] = wrong[5, 0] = 0.1
    found = opened(write(tmp_path, stereo(velocities="odometry", covariance=wrong.ravel())))
    assert TWIST_STD not in found.attributes and any("not positive definite" in note for note in found.notes)


def test_rectified_images_go_before_raw_ones(tmp_path):
    bag = stereo()
    for topic, messages in stereo("image_rect").topics.items():
        bag.topics.setdefault(topic, messages)
    assert opened(write(tmp_path, bag)).attributes["topics"] == "/stereo/left/image_rect /stereo/right/image_rect"


def test_without_velocities_and_transforms_the_body_is_the_camera(tmp_path):
    bag = stereo(velocities="none")
    del bag.topics["/tf_static"]
    found = opened(write(tmp_path, bag))
    assert found.twist is None and "There are no velocities." in found.notes
    np.testing.assert_array_equal(found.T_cam_imu, se3.transform(R_CAM_BODY, np.zeros(3)))
    with_velocities = stereo()
    del with_velocities.topics["/tf_static"]
    (tmp_path / "more").mkdir()
    assert any(
        "does not connect base and optical_0" in n for n in opened(write(tmp_path / "more", with_velocities)).notes
    )


def test_velocities_of_the_optical_frame_need_no_transform(tmp_path):
    bag = stereo()
    bag.topics["/velocity"] = [
        (name, stamp, twist(stamp, np.arange(6.0), "optical_0")) for name, stamp, _ in bag.topics["/velocity"]
    ]
    found = opened(write(tmp_path, bag))
    np.testing.assert_array_equal(found.T_cam_imu, np.eye(4))
    np.testing.assert_array_equal(found.twist[2], np.arange(6.0))


@pytest.mark.parametrize(
    ("encoding", "make", "expected"),
    [
        ("rgb8", lambda g: np.stack([g, 0 * g, 0 * g], axis=-1), 0.299),
        ("bgr8", lambda g: np.stack([g, 0 * g, 0 * g], axis=-1), 0.114),
        ("rgba8", lambda g: np.stack([0 * g, g, 0 * g, g], axis=-1), 0.587),
        ("mono16", lambda g: g.astype("<u2") * 256 + 9, 1.0),
    ],
)
def test_encodings(tmp_path, encoding, make, expected):
    bag = stereo()
    gray = np.full((HEIGHT, WIDTH), 200, np.uint8)
    name, stamp, _ = bag.topics["/stereo/left/image_raw"][1]
    bag.topics["/stereo/left/image_raw"][1] = (name, stamp, image(stamp, 0, make(gray), encoding))
    np.testing.assert_array_equal(opened(write(tmp_path, bag)).load(1)[0], np.round(expected * gray))


def test_rows_may_be_padded(tmp_path):
    bag = stereo()
    padded = np.zeros((HEIGHT, WIDTH + 6), np.uint8)
    padded[:, :WIDTH] = 77
    name, stamp, _ = bag.topics["/stereo/left/image_raw"][1]
    bag.topics["/stereo/left/image_raw"][1] = (name, stamp, image(stamp, 0, padded, width=WIDTH))
    np.testing.assert_array_equal(opened(write(tmp_path, bag)).load(1)[0], np.full((HEIGHT, WIDTH), 77))


def test_frames_outside_of_all_velocities_are_left_out_with_a_note(tmp_path):
    bag = stereo()
    bag.topics["/velocity"] = bag.topics["/velocity"][:6]  # up to the second frame
    found = opened(write(tmp_path, bag))
    assert len(found) == 4 and "1 frames before or after all velocities are left out." in found.notes


def drop(topic: str) -> Callable[[Written], None]:
    return lambda bag: bag.topics.pop(topic)


def altered(topic: str, number: int, make: Callable[[int], Callable[[Any], Any]]) -> Callable[[Written], None]:
    def change(bag: Written) -> None:
        for k in range(len(bag.topics[topic])) if number < 0 else [number]:
            name, stamp, _ = bag.topics[topic][k]
            bag.topics[topic][k] = (name, stamp, make(stamp))

    return change


INFO = "/stereo/right/camera_info"
TURN = np.eye(3)[[1, 0, 2]].ravel()
BROKEN: list[tuple[Callable[[Written], Any], type[EkfslamError], str]] = [
    (drop(INFO), CalibrationError, "expected two cameras with images and CameraInfo, found 1: /stereo/left/image_raw"),
    (altered(INFO, -1, lambda stamp: camera_info(stamp, 0)), CalibrationError, "P[0, 3]"),
    (altered(INFO, -1, lambda stamp: camera_info(stamp, 1, width=11)), CalibrationError, "different sizes"),
    (altered(INFO, -1, lambda stamp: camera_info(stamp, 1, r=TURN)), CalibrationError, "R is no rotation"),
    (altered(INFO, -1, lambda stamp: camera_info(stamp, 1, k=0 * K.ravel())), CalibrationError, "K_right"),
    (altered(INFO, -1, lambda stamp: camera_info(stamp, 1, d=np.ones(3))), CalibrationError, "coefficients, found 3"),
    (altered(INFO, -1, lambda stamp: camera_info(stamp, 1, distortion_model="fov")), CalibrationError, "'fov'"),
    (altered("/stereo/left/image_raw", -1, lambda s: image(s + 30_000_000, 0, picture(0, 0))), LostDataError, "0 of 5"),
    (altered("/velocity", 3, lambda s: twist(s, np.full(6, np.nan))), UnknownFormatError, "/velocity"),
    (lambda bag: bag.topics.update({"/velocity": bag.topics["/velocity"][:1]}), LostDataError, "two are needed"),
    (
        altered("/tf_static", 0, lambda s: transforms(("base", "optical_0", T_BASE_CAM), norm=2.0)),
        CalibrationError,
        "unit quaternion",
    ),
]


@pytest.mark.parametrize(("damage", "error", "words"), BROKEN, ids=range(len(BROKEN)))
def test_broken_messages_are_named(tmp_path, damage, error, words):
    bag = stereo()
    damage(bag)
    path = write(tmp_path, bag)
    with pytest.raises(error) as caught:
        open_images(path)
    assert words in str(caught.value) and str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("message", "error", "words"),
    [
        (image(FIRST_NS, 0, picture(0, 0), "yuv444"), UnknownFormatError, "'yuv444' are not read"),
        (image(FIRST_NS, 0, picture(0, 0)[:4]), CalibrationError, "10 x 4 pixels"),
        (image(FIRST_NS, 0, picture(0, 0), step=3), UnknownFormatError, "steps of 3"),
        (image(FIRST_NS, 0, picture(0, 0), step=99), UnknownFormatError, "steps of 99"),
    ],
)
def test_broken_images_are_named_when_they_are_loaded(tmp_path, message, error, words):
    bag = stereo()
    bag.topics["/stereo/left/image_raw"][0] = ("sensor_msgs/msg/Image", FIRST_NS, message)
    path = write(tmp_path, bag)
    found = opened(path)
    with pytest.raises(error) as caught:
        found.load(0)
    assert words in str(caught.value) and str(path) in str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_damaged_bags_are_named_whatever_byte_is_wrong(tmp_path, kind):
    path = write(tmp_path, stereo(), kind)
    file = next(path.glob("*.db3")) if path.is_dir() else path
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2])
    with pytest.raises(EkfslamError, match=str(path)):
        opened(path).load(FRAMES - 1)
    rng = np.random.default_rng(4)
    for _ in range(10):
        damaged = bytearray(content)
        damaged[rng.integers(16, len(content))] = rng.integers(0, 256)
        file.write_bytes(damaged)
        try:
            opened(path).load(0)
        except EkfslamError as error:
            assert str(path) in str(error)


@pytest.mark.parametrize("key", ["name", "type"])
def test_streams_that_are_numbers_are_refused(tmp_path, key):
    path = write(tmp_path, stereo())
    metadata = path / "metadata.yaml"
    text, changed = re.subn(rf"\b{key}: .*tf.*", f"{key}: 1.5", metadata.read_text(), flags=re.IGNORECASE)
    assert changed == 1
    metadata.write_text(text)
    with pytest.raises(UnknownFormatError, match=r"damaged or unknown bag.*1\.5"):
        opened(path)


def test_a_way_of_storing_that_is_a_number_is_refused(tmp_path):
    path = write(tmp_path, stereo())
    metadata = path / "metadata.yaml"
    metadata.write_text(re.sub(r"compression_mode: .*", "compression_mode: 1.5", metadata.read_text()))
    with pytest.raises(UnknownFormatError, match=r"damaged or unknown bag \(an entry is of a wrong type\)"):
        opened(path)


def test_a_definition_that_a_bag_brings_is_not_used(tmp_path):
    """Its types are those that rosbags knows; what a bag says of them is not even parsed."""
    bag, store = stereo(), message_types(is_ros1=False)
    path = tmp_path / "bag"
    with rosbag2.Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, messages in bag.topics.items():
            definition = "this is [ no definition\n"
            stream = writer.add_connection(topic, messages[0][0], msgdef=definition, rihs01="RIHS01_" + 64 * "0")
            for name, stamp, make in messages:
                writer.write(stream, stamp, store.serialize_cdr(make(store.types), name))
    assert_pictures(opened(path))


def test_without_rosbags_the_extra_is_named(tmp_path, monkeypatch):
    path = write(tmp_path, stereo())
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(MissingPackageError, match=r"pip install 'ekfslam\[ros\]'"):
        open_images(path)
