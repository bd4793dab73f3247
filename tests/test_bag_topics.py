"""Bags as drivers write them: which topics are a pair, stamps out of order, encodings, calibrations in files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.bags import (
    FIRST_NS,
    FRAMES,
    HEIGHT,
    STEP_NS,
    WIDTH,
    P,
    Written,
    camera_info,
    image,
    imu,
    odometry,
    picture,
    stereo,
    write,
)

import ekfslam
from ekfslam import open_images
from ekfslam.cli import main
from ekfslam.data.images import LensCalibration
from ekfslam.errors import CalibrationError, ConfigError, LostDataError, StampError, UnknownFormatError

IMAGE, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
STAMPS = [FIRST_NS + k * STEP_NS for k in range(FRAMES)]


def add(bag: Written, topic: str, side: int, shift: float | None, **info: Any) -> None:
    """A camera of a bag: images, and CameraInfo with a baseline unless that is None."""
    for frame, stamp in enumerate(STAMPS):
        bag.add(topic, IMAGE, stamp, image(stamp, side, picture(frame, side)))
        if shift is not None:
            projection = P.copy()
            projection[0, 3] = -shift * P[0, 0]
            made = camera_info(stamp, side, p=projection.ravel(), d=np.zeros(5), r=np.eye(3).ravel(), **info)
            bag.add(f"{topic.removesuffix('/compressed').rpartition('/')[0]}/camera_info", INFO, stamp, made)


def zed() -> Written:
    bag = Written()
    for name, side, shift in (("left", 0, 0.0), ("right", 1, 0.12)):
        add(bag, f"/zed/{name}/image_rect_color", side, shift)
        add(bag, f"/zed/{name}_raw/image_raw_color", side, shift)
    add(bag, "/zed/rgb/image_rect_color", 0, 0.0)
    add(bag, "/zed/depth/depth_registered", 0, 0.0)
    return bag


def zed_of_ros2() -> Written:
    bag = Written()
    for name, side, shift in (("left", 0, 0.0), ("right", 1, 0.12)):
        for colour in ("color", "gray"):
            for kind in ("raw", "rect"):
                add(bag, f"/zed/zed_node/{name}/{colour}/{kind}/image", side, shift)
    add(bag, "/zed/zed_node/rgb/color/rect/image", 0, 0.0)
    add(bag, "/zed/zed_node/disparity/image", 1, 0.12)
    return bag


def realsense() -> Written:
    bag = Written()
    add(bag, "/camera/camera/infra1/image_rect_raw", 0, 0.0)
    add(bag, "/camera/camera/infra2/image_rect_raw", 1, 0.05)
    add(bag, "/camera/camera/color/image_raw", 0, 0.0, width=99)
    add(bag, "/camera/camera/depth/image_rect_raw", 0, 0.0)
    add(bag, "/camera/camera/aligned_depth_to_color/image_raw", 0, 0.0, width=99)
    return bag


@pytest.mark.parametrize(
    ("bag", "topics", "baseline"),
    [
        (zed, "/zed/left/image_rect_color /zed/right/image_rect_color", 0.12),
        (zed_of_ros2, "/zed/zed_node/left/color/rect/image /zed/zed_node/right/color/rect/image", 0.12),
        (realsense, "/camera/camera/infra1/image_rect_raw /camera/camera/infra2/image_rect_raw", 0.05),
    ],
)
def test_the_rectified_pair_of_usual_drivers_is_chosen(tmp_path, bag, topics, baseline):
    found = open_images(write(tmp_path, bag()))
    assert found.attributes["topics"] == topics
    assert found.calibration.T_right_left[0, 3] == pytest.approx(-baseline) and found.calibration.is_rectified
    np.testing.assert_array_equal(found.load(2)[1], picture(2, 1))


def test_named_topics_take_precedence_and_need_no_slash(tmp_path):
    path = write(tmp_path, zed())
    topics = ("zed/left_raw/image_raw_color", "/zed/right_raw/image_raw_color")
    found = open_images(path, topics=topics)
    assert found.attributes["topics"] == "/zed/left_raw/image_raw_color /zed/right_raw/image_raw_color"
    assert not open_images(path).attributes["topics"].startswith("/zed/left_raw")


@pytest.mark.parametrize("order", [slice(None), slice(None, None, -1)])
def test_a_named_odometry_is_that_used_whatever_its_place(tmp_path, order):
    bag = stereo(velocities="odometry")
    for k in range(-1, 12):
        stamp = FIRST_NS + k * STEP_NS // 2
        bag.add("/wheels", "nav_msgs/msg/Odometry", stamp, odometry(stamp, [7.0, 0, 0, 0, 0, 0]))
    path = write(tmp_path, bag)
    assert open_images(path).twist[2, 0] != 7.0
    found = open_images(path, topics=["/stereo/left/image_raw", "/stereo/right/image_raw", "/wheels"])
    np.testing.assert_allclose(found.twist[:, 0], 7.0)
    np.testing.assert_allclose(open_images(path, topics=["/wheels"]).twist[:, 0], 7.0)


def test_topics_that_are_not_there_are_named_with_all_that_are(tmp_path, capsys):
    path = write(tmp_path, zed())
    with pytest.raises(
        LostDataError, match=r"there is no topic /left; the bag has .*/zed/depth/depth_registered \(sensor"
    ):
        open_images(path, topics=["/left", "/right"])
    assert main(["info", str(path), "--topics", "/left", "/right"]) == 2
    assert "there is no topic /left" in capsys.readouterr().err
    with pytest.raises(ConfigError, match="topics must be a list of names"):
        open_images(path, topics="/left")
    with pytest.raises(ConfigError, match=r"topics \(--topics\) mean nothing for this format"):
        ekfslam.open_sequence("builtin:loop?frames=5", topics=["/left", "/right"])


# Without CameraInfo

CHAIN = """cam{left}:
  T_cam_imu:
  - [0.0, -1.0, 0.0, 0.1]
  - [0.0, 0.0, -1.0, 0.2]
  - [1.0, 0.0, 0.0, 0.3]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0, 0.0]
  distortion_model: radtan
  intrinsics: [400.0, 401.0, 5.0, 3.0]
  resolution: [10, 6]
  rostopic: {topics[0]}
cam{right}:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.11]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0, 0.0]
  distortion_model: radtan
  intrinsics: [400.0, 401.0, 5.0, 3.0]
  resolution: [10, 6]
  rostopic: {topics[1]}
"""


def bare(topics: tuple[str, str] = ("/cam0/image_raw", "/cam1/image_raw"), *further: str) -> Written:
    bag = Written()
    for side, topic in enumerate(topics):
        add(bag, topic, side, None)
    for topic in further:
        add(bag, topic, 1, None)
    return bag


def test_a_bag_without_camera_info_says_what_it_has_and_which_flags_help(tmp_path):
    words = r"found 0: none; --topics LEFT RIGHT .*--calibration FILE .*the bag has /cam0/image_raw \(sensor_msgs"
    with pytest.raises(CalibrationError, match=words):
        open_images(write(tmp_path, bare()))


def test_the_calibration_of_a_file_serves_a_bag_without_camera_info(tmp_path):
    path = write(tmp_path / "bags", bare())
    chain = tmp_path / "my_rig.yaml"
    chain.write_text(CHAIN.format(left=0, right=1, topics=("/x", "/y")))
    found = open_images(path, calibration=chain)
    assert found.calibration.K_left[0, 0] == 400.0 and found.calibration.distortion_left.model == "radtan"
    np.testing.assert_allclose(found.calibration.T_right_left[:3, 3], [-0.11, 0, 0])
    np.testing.assert_allclose(found.T_cam_imu[:3, 3], [0.1, 0.2, 0.3])
    assert "The calibration is that of my_rig.yaml." in found.notes
    assert "which states T_cam_imu" in " ".join(found.notes)
    np.testing.assert_array_equal(found.load(3)[1], picture(3, 1))


def test_a_chain_beside_the_bag_is_found_and_its_topics_name_the_sides(tmp_path):
    topics = ("/head/a/image", "/head/b/image")
    path = write(tmp_path, bare(topics, "/tail/left", "/tail/right"))
    (tmp_path / "camchain-head.yaml").write_text(CHAIN.format(left=0, right=1, topics=topics[::-1]))
    found = open_images(path)
    assert found.attributes["topics"] == "/head/b/image /head/a/image"


def test_a_calibration_for_other_sizes_is_refused(tmp_path):
    chain = tmp_path / "chain.yaml"
    chain.write_text(CHAIN.format(left=0, right=1, topics=("", "")).replace("[10, 6]", "[752, 480]"))
    with pytest.raises(CalibrationError, match=r"chain\.yaml: size: .*\(752, 480\).*\(10, 6\)"):
        open_images(write(tmp_path, bare()), calibration=chain)


# One camera


def alone(topic: str, **info: Any) -> Written:
    """A colour camera beside its depth, as RealSense has them by default."""
    bag = Written()
    add(bag, topic, 0, 0.0, **info)
    add(bag, "/camera/camera/aligned_depth_to_color/image_raw", 0, 0.0)
    for k in range(-2, 30):
        stamp = FIRST_NS + k * STEP_NS // 4
        bag.add("/camera/camera/imu", "sensor_msgs/msg/Imu", stamp, imu(stamp, [0.1, 0, 0.2], [0, 0, 9.8], "optical_0"))
    return bag


COLOUR = "/camera/camera/color/image_raw"


@pytest.mark.parametrize("topics", [(), (COLOUR,), (COLOUR, "/camera/camera/imu")])
def test_one_camera_with_a_unit_is_read(tmp_path, topics):
    found = open_images(write(tmp_path, alone(COLOUR)), topics=topics)
    assert isinstance(found.calibration, LensCalibration) and found.attributes["topics"] == COLOUR
    assert f"There is one camera: {COLOUR}." in found.notes and found.inertial is not None
    (image_4,) = found.load(4)
    np.testing.assert_array_equal(image_4, picture(4, 0))


def test_the_right_camera_of_a_pair_can_be_named_alone(tmp_path):
    bag = stereo()
    path = write(tmp_path, bag)
    found = open_images(path, topics=["/stereo/right/image_raw", "/velocity"])
    assert found.baseline_m == 0.0 and found.twist is not None
    np.testing.assert_array_equal(found.load(1)[0], picture(1, 1))
    bag.topics.pop("/stereo/left/image_raw")
    notes = open_images(write(tmp_path / "b", bag)).notes
    assert "/stereo/left/camera_info is without images." in notes


def test_a_chain_gives_the_camera_of_each_named_topic(tmp_path):
    topics = ("/cam0/image_raw", "/cam1/image_raw")
    path, chain = write(tmp_path, bare(topics)), tmp_path / "four.yaml"
    further = (
        CHAIN.format(left=2, right=3, topics=("/x", "/y")).replace("T_cam_imu", "T_cn_cnm1").replace("400.", "300.")
    )
    chain.write_text(CHAIN.format(left=0, right=1, topics=("/p", "/q")) + further.replace("/x", "/cam0/image_raw"))
    one = open_images(path, topics=topics[:1], calibration=chain)
    assert one.calibration.K[0, 0] == 300.0
    step = np.array([[0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, 0.3], [0, 0, 0, 1.0]])
    right = np.eye(4)
    right[0, 3] = -0.11
    np.testing.assert_allclose(one.T_cam_imu, step @ right @ step, atol=1e-12)
    chain.write_text(CHAIN.format(left=0, right=1, topics=topics))
    np.testing.assert_allclose(open_images(path, topics=topics[1:], calibration=chain).T_cam_imu, right @ step)


def test_camera_info_in_another_namespace_is_found_by_its_frame(tmp_path):
    bag = Written()
    for side, name in enumerate(("left", "right")):
        add(bag, f"/rgb_{name}", side, None)
        add(bag, f"/info_{name}/image_raw", side, 0.1 * side)
        del bag.topics[f"/info_{name}/image_raw"]
    found = open_images(write(tmp_path, bag))
    assert found.attributes["topics"] == "/rgb_left /rgb_right" and found.baseline_m == pytest.approx(0.1)


def test_a_topic_of_another_type_is_refused(tmp_path):
    with pytest.raises(UnknownFormatError, match=r"/stereo/left/camera_info is of .*CameraInfo, which is not read"):
        open_images(write(tmp_path, stereo()), topics=["/stereo/left/camera_info"])


def test_one_camera_without_camera_info_is_named(tmp_path):
    with pytest.raises(CalibrationError, match=r"one camera, /cam0/image_raw, without CameraInfo; --calibration FILE"):
        bag = bare()
        del bag.topics["/cam1/image_raw"]
        open_images(write(tmp_path, bag))


def test_a_camera_without_calibration_is_named(tmp_path):
    path = write(tmp_path, alone(COLOUR, k=np.zeros(9)))
    with pytest.raises(CalibrationError, match=r"CameraInfo of .*color/image_raw: K is 0: .*--calibration FILE"):
        open_images(path)


# Stamps


def changed(topic: str, change: Callable[[list[Any]], None]) -> Written:
    bag = stereo(velocities="odometry")
    change(bag.topics[topic])
    return bag


def stamped(messages: list[Any], k: int, stamp: int, make: Callable[[int], Any]) -> None:
    """Let message k be written when it was, with another stamp."""
    messages[k] = (messages[k][0], messages[k][1], make(stamp))


def test_a_repeated_stamp_of_images_is_left_out_and_counted(tmp_path):
    def change(messages: list[Any]) -> None:
        stamped(messages, 2, STAMPS[1], lambda stamp: image(stamp, 0, picture(9, 0)))

    found = open_images(write(tmp_path, changed("/stereo/left/image_raw", change)))
    assert len(found) == FRAMES - 1
    np.testing.assert_array_equal(found.load(1)[0], picture(1, 0))
    assert any(
        note.startswith("1 images of /stereo/left/image_raw have the stamp of an earlier") for note in found.notes
    )


def test_swapped_images_and_odometry_are_sorted_and_counted(tmp_path):
    def change(messages: list[Any]) -> None:
        (a, at, first), (b, later, second) = messages[1:3]
        messages[1:3] = [(a, at, second), (b, later, first)]

    found = open_images(write(tmp_path, changed("/stereo/left/image_raw", change)))
    assert [int(found.load(k)[0][0, 0]) for k in range(FRAMES)] == [20 * k for k in range(FRAMES)]
    assert any("1 images of /stereo/left/image_raw are before their pred" in note for note in found.notes)
    plain = open_images(write(tmp_path / "b", stereo(velocities="odometry")))
    found = open_images(write(tmp_path / "c", changed("/odom", change)))
    np.testing.assert_allclose(found.twist, plain.twist)
    assert any("1 messages of /odom are before their pred" in note for note in found.notes)


def test_images_without_stamps_have_those_of_writing(tmp_path):
    bag = Written()
    add(bag, "/left/image_raw", 0, 0.0)
    add(bag, "/right/image_raw", 1, 0.1)
    for side, topic in enumerate(("/left/image_raw", "/right/image_raw")):
        messages = bag.topics[topic]
        messages[:] = [(kind, s, image(0, side, picture(k, side))) for k, (kind, s, _) in enumerate(messages)]
    found = open_images(write(tmp_path, bag))
    np.testing.assert_allclose(np.diff(found.time_s), STEP_NS / 1e9, atol=1e-6)
    np.testing.assert_array_equal(found.load(3)[1], picture(3, 1))
    assert "Images of /left/image_raw have no stamps: the times of writing are taken." in found.notes


def test_more_than_two_named_cameras_are_refused(tmp_path):
    names = ["/zed/left/image_rect_color", "/zed/right/image_rect_color", "/zed/rgb/image_rect_color"]
    with pytest.raises(CalibrationError, match="expected one or two topics of images"):
        open_images(write(tmp_path, zed()), topics=names)


def test_a_repeated_odometry_message_is_left_out_and_counted(tmp_path):
    def change(messages: list[Any]) -> None:
        kind, at, make = messages[4]
        messages.insert(5, (kind, at + 1000, make))

    found = open_images(write(tmp_path, changed("/odom", change)))
    plain = open_images(write(tmp_path / "b", stereo(velocities="odometry")))
    np.testing.assert_allclose(found.twist, plain.twist)
    assert any(note.startswith("1 messages of /odom have the stamp of an earlier one") for note in found.notes)


def test_odometry_of_one_stamp_is_a_named_error(tmp_path):
    def change(messages: list[Any]) -> None:
        for k in range(len(messages)):
            stamped(messages, k, FIRST_NS, lambda stamp: odometry(stamp, np.ones(6)))

    with pytest.raises(StampError, match=r"/odom: all messages have the same stamp"):
        open_images(write(tmp_path, changed("/odom", change)))


@pytest.mark.parametrize(("apart_ms", "is_pair"), [(0.4, True), (3.0, True), (4.9, True), (8.0, False)])
def test_pairs_some_milliseconds_apart_are_paired_within_a_named_tolerance(tmp_path, apart_ms, is_pair):
    bag = stereo()
    late = round(apart_ms * 1e6)
    for k, stamp in enumerate(STAMPS):
        stamped(bag.topics["/stereo/right/image_raw"], k, stamp + late, lambda s, k=k: image(s, 1, picture(k, 1)))
    path = write(tmp_path, bag)
    if not is_pair:
        with pytest.raises(LostDataError, match=r"same stamp within 5 ms; nearest stamps are 8 ms apart"):
            open_images(path)
        return
    found = open_images(path)
    assert len(found) == FRAMES
    said = [note for note in found.notes if "ms apart (tolerance 5 ms)" in note]
    assert len(said) == (apart_ms > 1) and all(f"up to {apart_ms:g} ms" in note for note in said)


# Encodings


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_16_bits_are_scaled_by_the_largest_value_of_both_cameras(tmp_path, bits):
    bag = stereo()
    for side, name in enumerate(("left", "right")):
        for k, stamp in enumerate(STAMPS):
            deep = np.full((HEIGHT, WIDTH), 2 ** (bits - 2) + k, np.uint16)
            deep[0, 0] = 2**bits - 1 if (side, k) == (1, 3) else 0
            made = image(stamp, side, deep, "mono16")
            bag.topics[f"/stereo/{name}/image_raw"][k] = (IMAGE, stamp, made)
    found = open_images(write(tmp_path, bag))
    for side in (0, 1):
        assert found.load(1)[side][1, 1] == (2 ** (bits - 2) + 1) >> (bits - 8)
    assert f"use {bits}, by the largest value" in " ".join(found.notes)


def with_first(tmp_path: Path, pixels: np.ndarray, encoding: str, **changes: Any) -> np.ndarray:
    """The gray image that is read of some pixels."""
    bag = stereo()
    made = image(FIRST_NS, 0, pixels, encoding, **{"height": HEIGHT, "width": WIDTH, **changes})
    bag.topics["/stereo/left/image_raw"][0] = (IMAGE, FIRST_NS, made)
    return open_images(write(tmp_path, bag)).load(0)[0]


@pytest.mark.parametrize(("encoding", "at"), [("yuv422", 1), ("uyvy", 1), ("yuv422_yuy2", 0), ("yuyv", 0)])
def test_luma_of_yuv_is_read(tmp_path, encoding, at):
    luma = np.arange(HEIGHT * WIDTH, dtype=np.uint8).reshape(HEIGHT, WIDTH)
    pixels = np.full((HEIGHT, WIDTH, 2), 128, np.uint8)
    pixels[..., at] = luma
    np.testing.assert_array_equal(with_first(tmp_path, pixels, encoding), luma)


def test_luma_of_planes_is_read(tmp_path):
    luma = np.arange(HEIGHT * WIDTH, dtype=np.uint8).reshape(HEIGHT, WIDTH)
    planes = np.vstack([luma, np.full((HEIGHT // 2, WIDTH), 128, np.uint8)])
    np.testing.assert_array_equal(with_first(tmp_path, planes, "nv21"), luma)


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("bits", [8, 16])
def test_a_bayer_mosaic_of_one_colour_has_its_luma_everywhere(tmp_path, pattern, bits):
    colour = dict(zip("rgb", (200, 100, 30), strict=True))
    mosaic = np.array([[colour[pattern[2 * (i % 2) + j % 2]] for j in range(WIDTH)] for i in range(HEIGHT)])
    pixels = (mosaic << (bits - 8)).astype(f"u{bits // 8}")
    found = with_first(tmp_path, pixels, f"bayer_{pattern}{bits}")
    np.testing.assert_allclose(found, 0.299 * 200 + 0.587 * 100 + 0.114 * 30, atol=1)


@pytest.mark.parametrize(("encoding", "order"), [("rgb8", (0, 1, 2)), ("bgr8", (2, 1, 0)), ("bgra8", (2, 1, 0))])
def test_colours_become_luma(tmp_path, encoding, order):
    pixels = np.zeros((HEIGHT, WIDTH, len(encoding) - 1), np.uint8)
    for channel, value in zip(order, (200, 100, 30), strict=True):
        pixels[..., channel] = value
    np.testing.assert_allclose(with_first(tmp_path, pixels, encoding), 122, atol=1)
