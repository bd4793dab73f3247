"""Inertial samples of bags: one stream or two, their order, their frame, and wheels beside them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from support.bags import FIRST_NS, FRAMES, KINDS, STEP_NS, T_BASE_CAM, Written, imu, stereo, transforms, write
from support.helpers import synthetic_sequence
from support.images import opened
from support.imu import motion, write_lines, yaml_lines

from ekfslam import attach_inertial, open_images
from ekfslam.data.images import ImageRecording
from ekfslam.data.inputs import VelocitySamples
from ekfslam.data.readers.bag_imu import velocities_of_unit
from ekfslam.data.sequence import TWIST_STD
from ekfslam.geometry import se3

COUNT, IMU_NS = 120, 5_000_000
TIME_NS = FIRST_NS - 20 * IMU_NS + IMU_NS * np.arange(COUNT)
GYRO, ACCEL = motion(COUNT)
T_BASE_IMU = se3.transform(se3.so3_exp(np.array([0.0, 0.0, np.pi / 2])), np.array([0.5, 0.2, 0.1]))
KIND = "sensor_msgs/msg/Imu"


def with_imu(bag: Written, topic: str = "/imu/data", rows=range(COUNT), **changes) -> Written:
    for k in rows:
        bag.add(topic, KIND, int(TIME_NS[k]), imu(int(TIME_NS[k]), GYRO[k], ACCEL[k], **changes))
    return bag


def pair(velocities: str = "none", edge: np.ndarray | None = T_BASE_IMU) -> Written:
    bag = stereo(velocities=velocities)
    if edge is not None:
        bag.add("/tf_static", "tf2_msgs/msg/TFMessage", FIRST_NS, transforms(("base", "imu", edge)))
    return bag


def assert_samples(found: ImageRecording) -> None:
    samples = found.inertial
    np.testing.assert_allclose(samples.time_s, TIME_NS / 1e9, rtol=0, atol=3e-7)
    np.testing.assert_allclose(samples.gyro_rad_s, GYRO)
    np.testing.assert_allclose(samples.accel_m_s2, ACCEL)


@pytest.mark.parametrize("kind", KINDS)
def test_samples_of_one_stream_are_of_the_body(tmp_path, kind):
    write_lines(tmp_path / "imu.yaml", yaml_lines())
    found = opened(write(tmp_path, with_imu(pair()), kind))
    assert_samples(found)
    np.testing.assert_allclose(found.T_cam_imu, se3.inverse(T_BASE_CAM) @ T_BASE_IMU, atol=1e-9)
    assert "Inertial samples are those of /imu/data." in found.notes
    if kind != "mcap":  # it lies in a folder of its own
        assert found.inertial.noise.gyro == 1.7e-4


def test_forces_of_their_own_stream_are_interpolated_to_the_gyroscope(tmp_path):
    bag = pair()
    line = np.array([0.1, 9.7, 0.3]) + 0.5 * np.arange(40)[:, None] * [0.01, 0.02, -0.01]
    for k in range(COUNT):
        stamp = int(TIME_NS[k])
        bag.add("/camera/gyro/sample", KIND, stamp, imu(stamp, GYRO[k], [0, 0, 0], is_known=(True, False)))
    for k in range(40):
        stamp = int(TIME_NS[0]) + 7_000_000 + 16_000_000 * k
        bag.add("/camera/accel/sample", KIND, stamp, imu(stamp, [0, 0, 0], line[k], is_known=(False, True)))
    samples = opened(write(tmp_path, bag)).inertial
    inside = (TIME_NS[0] + 7_000_000 <= TIME_NS) & (TIME_NS[0] + 7_000_000 + 39 * 16_000_000 >= TIME_NS)
    np.testing.assert_allclose(samples.time_s, TIME_NS[inside] / 1e9, rtol=0, atol=3e-7)
    place = (TIME_NS[inside] - TIME_NS[0] - 7_000_000) / 16e6
    expected = np.array([0.1, 9.7, 0.3]) + 0.5 * place[:, None] * [0.01, 0.02, -0.01]
    np.testing.assert_allclose(samples.accel_m_s2, expected, atol=1e-9)
    np.testing.assert_allclose(samples.gyro_rad_s, GYRO[inside])


def test_disorder_is_sorted_and_repeats_are_dropped(tmp_path):
    order = [*range(30), 31, 30, *range(32, 60), 59, *range(60, COUNT)]
    bag = pair()
    for place, k in enumerate(order):  # in the order of writing
        message = imu(int(TIME_NS[k]), GYRO[k], ACCEL[k])
        bag.add("/imu/data", KIND, int(TIME_NS[0]) + IMU_NS * place, message)
    found = opened(write(tmp_path, bag))
    assert_samples(found)
    assert "1 inertial samples are stamped before their predecessors: they are sorted." in found.notes
    assert any(note.startswith("1 inertial samples repeat a stamp") for note in found.notes)


def test_samples_that_are_no_numbers_are_dropped_and_counted(tmp_path):
    bag = with_imu(pair(), rows=[k for k in range(COUNT) if k not in (40, 41, 42)])
    for k in (40, 41, 42):
        bag.add("/imu/data", KIND, int(TIME_NS[k]), imu(int(TIME_NS[k]), [np.nan, 0, 0], ACCEL[k]))
    notes = opened(write(tmp_path, bag)).notes
    assert "3 samples of /imu/data are NaN or infinite: they are dropped." in notes
    assert any("1 gaps of more than three steps; the longest is 0.02 s" in note for note in notes)


def test_other_topics_are_named_and_a_topic_can_be_chosen(tmp_path):
    bag = with_imu(with_imu(pair(), "/mavros/imu/data"), "/stereo/imu", rows=range(0, COUNT, 2))
    path = write(tmp_path, bag)
    notes = opened(path).notes
    assert "Inertial samples are those of /stereo/imu." in notes  # near the images
    assert "Not used: inertial samples of /mavros/imu/data." in notes
    assert len(open_images(path, topics=["/mavros/imu/data"]).inertial.time_s) == COUNT


def test_a_unit_without_a_known_place_is_not_used_with_a_note(tmp_path):
    found = opened(write(tmp_path, with_imu(pair(edge=None))))
    assert found.inertial is None
    assert any("/tf_static does not connect imu and optical_0; put camchain" in note for note in found.notes)


def test_a_chain_of_kalibr_beside_the_bag_places_the_unit(tmp_path):
    T = se3.exp(np.array([0.1, 0.2, 0.3, 1.0, -1.0, 0.5]))
    rows = [f"  - [{', '.join(map(repr, row))}]" for row in T.tolist()]
    write_lines(tmp_path / "camchain-imucam-x.yaml", ["cam0:", "  T_cam_imu:", *rows, "  timeshift_cam_imu: 0.01"])
    found = opened(write(tmp_path, with_imu(pair(edge=None))))
    np.testing.assert_allclose(found.T_cam_imu, T, atol=1e-9)
    np.testing.assert_allclose(found.inertial.time_s, TIME_NS / 1e9 - 0.01, rtol=0, atol=3e-7)


def test_velocities_of_wheels_are_turned_into_the_frame_of_the_unit(tmp_path):
    found = opened(write(tmp_path, with_imu(pair("twist"))))
    assert found.inertial is not None and len(found) == FRAMES
    # The mean of `stereo` over the second interval: 4 m/s forward, 0.6 rad/s to the left.
    R, t = T_BASE_IMU[:3, :3], T_BASE_IMU[:3, 3]
    v, w = np.array([4.0, 0.0, 0.1]), np.array([0.0, 0.0, 0.6])
    np.testing.assert_allclose(found.twist[2], np.concatenate([R.T @ (v + np.cross(w, t)), R.T @ w]), atol=1e-6)


def test_stated_errors_of_velocities_are_turned_with_them():
    """By 30 degrees about z and onto axes of which the last has no stated error."""
    std = np.array([0.3, 0.1, 0.0, 0.01, 0.02, 0.05])
    samples = VelocitySamples("a", np.arange(3.0), np.ones((3, 6)), attributes={TWIST_STD: " ".join(map(str, std))})
    T = se3.transform(se3.so3_exp(np.array([0.0, 0.0, np.pi / 6])), np.zeros(3))
    found, _ = velocities_of_unit(samples, T, "imu")
    R = T[:3, :3]
    expected = np.sqrt(np.concatenate([np.diag(R @ np.diag(part**2) @ R.T) for part in (std[:3], std[3:])]))
    np.testing.assert_allclose(np.array(found.attributes[TWIST_STD].split(), dtype=float), expected, atol=1e-12)


def test_another_recording_takes_the_samples_of_a_bag(tmp_path):
    path = write(tmp_path, with_imu(pair()))
    sequence = synthetic_sequence(frames=5)
    sequence = dataclasses.replace(sequence, time_s=(FIRST_NS + STEP_NS * np.arange(5)) / 1e9, inputs=())
    assert len(attach_inertial(sequence, path).inertial.time_s) == COUNT


def test_messages_without_stamps_have_the_time_of_writing(tmp_path):
    bag = pair()
    for k in range(COUNT):
        bag.add("/imu/data", KIND, int(TIME_NS[k]), imu(0, GYRO[k], ACCEL[k]))
    found = opened(write(tmp_path, bag))
    np.testing.assert_allclose(
        found.inertial.time_s, (TIME_NS + 7_000_000) / 1e9, rtol=0, atol=3e-7
    )  # see `support.bags`
    assert "Messages of /imu/data have no stamps: the times of writing are taken." in found.notes
