"""The world ``room``: a hand-held camera with an inertial unit, whose samples, images and truth agree."""

from dataclasses import replace

import numpy as np
import pytest

import ekfslam
from ekfslam.data.room import GRAVITY_M_S2
from ekfslam.data.simulate import BUILTIN, builtin, simulate
from ekfslam.data.spline import PoseSpline
from ekfslam.errors import ConfigError
from ekfslam.geometry import se3
from ekfslam.geometry.camera import project

ROOM = replace(BUILTIN["room"], frames=40, seed=3)
CLEAN = replace(ROOM, sigma_px=0.0, gyro=0.0, accel=0.0, gyro_walk=0.0, accel_walk=0.0)
NO_BIAS = {"gyro_bias_std_rad_s": 0.0, "accel_bias_std_m_s2": 0.0}


@pytest.fixture
def trajectory(tmp_path):
    """A TUM file of 20 s at 20 Hz, without samples from 10 to 11 s; the IMU's y axis is up."""
    time_s = np.arange(0.0, 20.0, 0.05)
    position = np.column_stack([np.sin(time_s), np.cos(0.7 * time_s), 1.0 + 0.1 * np.sin(2 * time_s)])
    half = 0.5 * (np.pi / 2 + 0.1 * np.sin(time_s))
    table = np.column_stack([1.5e9 + time_s, position, np.sin(half), 0 * half, 0 * half, np.cos(half)])
    path = tmp_path / "trajectory.txt"
    np.savetxt(path, table[(time_s < 10.0) | (time_s > 11.0)], fmt="%.9f")
    return path


def spline(seed=0):
    rng = np.random.default_rng(seed)
    return PoseSpline(0.0, 0.1, se3.exp(0.05 * np.cumsum(rng.normal(size=(12, 6)), axis=0)))


def test_velocities_of_a_spline_are_derivatives_of_its_poses():
    path, time_s, step = spline(), np.linspace(0.05, 0.85, 30), 1e-5
    before, now, after = (path.at(time_s + shift) for shift in (-step, 0.0, step))
    velocity = (after.T_world_imu - before.T_world_imu)[:, :3, 3] / (2 * step)
    rate = se3.so3_log(np.swapaxes(before.T_world_imu[:, :3, :3], 1, 2) @ after.T_world_imu[:, :3, :3]) / (2 * step)
    np.testing.assert_allclose(now.velocity_m_s, velocity, atol=1e-7)
    np.testing.assert_allclose(now.rate_rad_s, rate, atol=1e-7)
    acceleration = (after.velocity_m_s - before.velocity_m_s) / (2 * step)
    np.testing.assert_allclose(now.acceleration_m_s2, acceleration, atol=1e-6)


def test_a_spline_continues_smoothly_past_its_control_poses():
    before, after = (spline().at(np.array([0.3 + shift])) for shift in (-1e-9, 1e-9))
    for name, value in vars(before).items():
        np.testing.assert_allclose(value, getattr(after, name), atol=1e-5, err_msg=name)


def test_the_same_seed_gives_the_same_bits():
    a, b = (simulate(ROOM) for _ in range(2))
    assert np.array_equal(a.inertial.accel_m_s2, b.inertial.accel_m_s2)
    assert np.array_equal(a.observations.pixels_px, b.observations.pixels_px)


def test_another_generator_draws_other_noise_on_the_same_motion():
    a, b = simulate(ROOM), simulate(ROOM, np.random.default_rng(5))
    assert np.array_equal(a.truth.T_world_imu, b.truth.T_world_imu)
    assert not np.array_equal(a.inertial.gyro_rad_s, b.inertial.gyro_rad_s)


def test_integrated_samples_lead_along_the_true_poses():
    sequence = simulate(replace(CLEAN, imu_rate_hz=2000.0, **NO_BIAS))
    truth, T = sequence.truth, sequence.truth.T_world_imu[0]
    R, p, v = T[:3, :3], T[:3, 3], truth.motion.velocity_m_s[0]
    for k in range(1, len(sequence)):
        interval = sequence.interval(k, ekfslam.InertialSamples)
        for dt, sample in zip(interval.dt_s, interval.inputs, strict=True):
            a = R @ se3.so3_exp(0.5 * dt * sample[:3]) @ sample[3:] - [0.0, 0.0, GRAVITY_M_S2]
            p, v, R = p + dt * v + 0.5 * dt**2 * a, v + dt * a, R @ se3.so3_exp(dt * sample[:3])
    np.testing.assert_allclose(p, truth.T_world_imu[-1, :3, 3], atol=1e-3)
    np.testing.assert_allclose(R, truth.T_world_imu[-1, :3, :3], atol=1e-4)


def test_images_show_the_landmarks_from_the_true_poses():
    sequence = simulate(CLEAN)
    truth, seen = sequence.truth, sequence.observations
    points = truth.position_m[np.searchsorted(truth.landmark, seen.landmark)]
    q = se3.apply(sequence.T_cam_imu @ se3.inverse(truth.T_world_imu[seen.frame]), points)
    np.testing.assert_allclose(seen.pixels_px, project(sequence.camera, q), atol=1e-9)


def test_forty_landmarks_are_in_view_at_two_to_eight_metres():
    sequence = builtin("room?seed=1")
    assert np.bincount(sequence.observations.frame).min() == 40
    disparity = sequence.observations.pixels_px[:, 0] - sequence.observations.pixels_px[:, 2]
    low, high = np.percentile(435.0 * 0.11 / disparity, [2, 98])
    assert 1.8 < low < high < 8.5


def test_samples_have_the_stated_noise():
    noisy, clean = (simulate(replace(CLEAN, gyro=g, accel=a, **NO_BIAS)).inertial for g, a in ((1e-3, 1e-2), (0, 0)))
    for name, std in (("gyro_rad_s", 1e-3), ("accel_m_s2", 1e-2)):
        found = (getattr(noisy, name) - getattr(clean, name)).std()
        assert found == pytest.approx(std * np.sqrt(200.0), rel=0.06)


def test_biases_walk_with_the_stated_densities():
    sequence = simulate(replace(CLEAN, frames=1000, landmarks=200, gyro_walk=1e-3, accel_walk=1e-2))
    for found, density in (
        (sequence.truth.motion.gyro_bias_rad_s, 1e-3),
        (sequence.truth.motion.accel_bias_m_s2, 1e-2),
    ):
        assert np.diff(found, axis=0).std() == pytest.approx(density * np.sqrt(0.1), rel=0.06)


def test_a_trajectory_file_is_followed_closely(trajectory):
    sequence = builtin(f"room?frames=60&trajectory={trajectory}&start_s=2")
    time_s = sequence.time_s + 2.0
    # The first frame is one knot after the start, the spline within 2 mm of its control poses.
    expected = np.column_stack([np.sin(time_s + 0.2), np.cos(0.7 * (time_s + 0.2))])
    np.testing.assert_allclose(sequence.truth.T_world_imu[:, :2, 3], expected, atol=5e-3)
    assert np.bincount(sequence.observations.frame).min() > 20


def test_a_gap_in_a_trajectory_is_refused(trajectory):
    with pytest.raises(ConfigError, match=r"a gap from 10\.0 to 11\.0 s"):
        builtin(f"room?frames=60&trajectory={trajectory}&start_s=6")


def test_a_trajectory_that_ends_too_early_is_refused(trajectory):
    with pytest.raises(ConfigError, match="ends after 20"):
        builtin(f"room?frames=60&trajectory={trajectory}&start_s=16")


def test_a_stretch_of_a_room_keeps_the_true_motion():
    sequence = simulate(ROOM)
    part = sequence[10:20]
    np.testing.assert_array_equal(part.truth.motion.velocity_m_s, sequence.truth.motion.velocity_m_s[10:20])
    np.testing.assert_array_equal(part.truth.motion.accel_bias_m_s2, sequence.truth.motion.accel_bias_m_s2[10:20])


def test_a_file_keeps_the_true_motion(tmp_path):
    sequence = simulate(ROOM)
    ekfslam.write_sequence(sequence, tmp_path / "a.h5")
    truth = ekfslam.open_sequence(tmp_path / "a.h5").truth
    for name, value in vars(sequence.truth.motion).items():
        np.testing.assert_array_equal(getattr(truth.motion, name), value, err_msg=name)


def test_a_file_that_is_no_trajectory_is_refused(tmp_path):
    (tmp_path / "wrong.txt").write_text("1 2 3\n")
    with pytest.raises(ConfigError, match="not a trajectory"):
        builtin(f"room?trajectory={tmp_path / 'wrong.txt'}")


def test_samples_have_the_true_biases():
    biased, clean = (simulate(replace(CLEAN, **changes)) for changes in ({}, NO_BIAS))
    for samples, bias in (("gyro_rad_s", "gyro_bias_rad_s"), ("accel_m_s2", "accel_bias_m_s2")):
        found = getattr(biased.inertial, samples) - getattr(clean.inertial, samples)
        np.testing.assert_allclose(found[0], getattr(biased.truth.motion, bias)[0], atol=1e-9)
        assert np.abs(found[0]).max() > 1e-3


def test_an_id_is_one_unbroken_run_of_frames():
    seen = builtin("room?seed=1").observations
    order = np.lexsort((seen.frame, seen.landmark))
    same = np.diff(seen.landmark[order]) == 0
    assert (np.diff(seen.frame[order])[same] == 1).all()


def test_the_first_velocity_is_in_the_frame_of_the_imu(trajectory):
    sequence = builtin(f"room?frames=40&trajectory={trajectory}&start_s=2")
    ahead = sequence.truth.T_world_imu[0, :3, :3] @ sequence.initial_velocity_m_s
    np.testing.assert_allclose(ahead, sequence.truth.motion.velocity_m_s[0], atol=1e-12)
    assert np.linalg.norm(ahead) > 0.1
