"""The first state of the inertial process."""

import dataclasses

import numpy as np
import pytest

import ekfslam
from ekfslam.data.inputs import InertialNoise, InertialSamples
from ekfslam.data.room import GRAVITY_M_S2, Room, simulate_room
from ekfslam.geometry import se3
from ekfslam.models.inertial_start import FirstPrior, at_rest, image_motion, rest_of
from ekfslam.resolve import resolve

NOISE = InertialNoise(1.7e-4, 2e-3, 1.9e-5, 3e-3)
RATE_HZ = 200.0


def resting_samples(rng, up, gyro_bias, accel_bias, seconds=1.0, shake=0.0):
    """Samples at rest, given the direction up (3,) in the IMU frame and both biases (3,)."""
    time_s = np.arange(0.0, seconds + 0.5 / RATE_HZ, 1.0 / RATE_HZ)
    white = np.sqrt(RATE_HZ) * rng.standard_normal((2, len(time_s), 3))
    gyro = gyro_bias + NOISE.gyro * white[0]
    accel = GRAVITY_M_S2 * up + accel_bias + np.hypot(NOISE.accel, shake) * white[1]
    return InertialSamples(time_s, gyro, accel, NOISE)


def squared_errors(rng, shake=0.0):
    """Normalised squared error of (tilt, bg, ba) of a start at rest in a random attitude."""
    C = se3.so3_exp(rng.uniform(-3.0, 3.0) * np.array([0.6, -0.64, 0.48]))
    gyro_bias, accel_bias = 0.01 * rng.standard_normal(3), 0.1 * rng.standard_normal(3)
    samples = resting_samples(rng, C[:, 2], gyro_bias, accel_bias, shake=shake)
    T_world_imu = se3.inverse(se3.transform(C, np.array([1.0, 2.0, 3.0])))
    prior = FirstPrior(T_world_imu, 0.0, 0.0, 0.01, 0.1, GRAVITY_M_S2)
    found = at_rest(samples, 0.0, 1.0, prior, NOISE)
    tilt = (C.T @ se3.log(se3.inverse(T_world_imu) @ se3.inverse(found.T_imu_world))[3:])[:2]
    error = np.concatenate([tilt, gyro_bias - found.gyro_bias_rad_s, accel_bias - found.accel_bias_m_s2])
    E = np.zeros((8, 15))
    E[:2, 3:6], E[2:, 9:] = C.T[:2], np.eye(6)
    return error @ np.linalg.solve(E @ found.covariance @ E.T, error)


@pytest.mark.parametrize("shake", [0.0, 0.05])
def test_a_start_at_rest_errs_as_its_covariance_says(shake):
    rng = np.random.default_rng(5)
    assert 7.2 < np.mean([squared_errors(rng, shake) for _ in range(400)]) < 8.8


def test_a_start_at_rest_keeps_position_and_heading_of_the_recording():
    T = se3.transform(se3.so3_exp(np.array([0.0, 0.0, 2.0])), np.array([1.0, 2.0, 3.0]))
    samples = resting_samples(np.random.default_rng(0), np.array([0.0, 0.6, 0.8]), np.zeros(3), np.zeros(3))
    found = at_rest(samples, 0.0, 1.0, FirstPrior(T, 0.0, 0.0, 0.01, 0.1, GRAVITY_M_S2), NOISE)
    T_world_imu = se3.inverse(found.T_imu_world)
    np.testing.assert_allclose(T_world_imu[:3, 3], [1.0, 2.0, 3.0], atol=1e-9)
    np.testing.assert_allclose(T_world_imu[:3, :3] @ [0.0, 0.6, 0.8], [0.0, 0.0, 1.0], atol=2e-3)
    least = se3.log(T_world_imu @ se3.inverse(T))[3:]
    assert np.linalg.norm(least) == pytest.approx(np.arccos(0.8), abs=2e-3) and abs(least[2]) < 1e-9


def test_tilt_and_accelerometer_bias_are_coupled_after_a_rest():
    problem = resolve(simulate_room(Room(frames=8, seed=2)))
    layout, P = problem.model.layout, problem.model.prior_covariance
    tilt, bias = P[layout["pose"], layout["pose"]][3:, 3:], P[layout["accel_bias"], layout["accel_bias"]]
    cross = P[layout["pose"], layout["accel_bias"]][3:]
    assert np.linalg.norm(cross, 2) > 0.99 * np.sqrt(np.linalg.norm(tilt, 2) * np.linalg.norm(bias, 2))
    assert str(problem.account["inertial_start"]).startswith("at rest for 0.4 s: tilt to 0.58 deg")


def test_images_tell_rest_from_motion():
    resting, moving = (simulate_room(Room(frames=40, seed=seed)) for seed in (0, 1))
    assert rest_of(resting) is not None
    assert image_motion(moving, 25, 30) > 5.0
    assert rest_of(moving[25:]) is None


def test_samples_before_the_first_image_are_preferred():
    whole = simulate_room(Room(frames=30, seed=2))
    samples = whole.inertial
    late = dataclasses.replace(whole[4:], inputs=(samples,))
    begin, end = rest_of(late)
    assert end == late.time_s[0] and end - begin == pytest.approx(0.42, abs=0.03)


def test_a_start_from_the_truth_does_not_make_the_tilt_certain():
    sequence = simulate_room(Room(frames=8, seed=2))
    problem = resolve(sequence, ekfslam.Config())
    P = problem.model.prior_covariance[3:6, 3:6]
    assert np.sqrt(np.linalg.eigvalsh(P)[1:]).min() > 0.005
