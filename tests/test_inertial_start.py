"""The first state of the inertial process."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from inertial import nees as inertial_nees
from inertial import true_values

import ekfslam
from ekfslam.config import FilterConfig
from ekfslam.data.inputs import InertialNoise, InertialSamples
from ekfslam.data.room import GRAVITY_M_S2, Room, simulate_room
from ekfslam.data.sequence import of_left_camera
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import run_filter
from ekfslam.filters.stretches import thinned
from ekfslam.geometry import se3
from ekfslam.inertial.noise import from_differences, likeliest_densities, white_densities
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


def moving(seed, begin=30, frames=20):
    """A stretch of the room in motion."""
    return simulate_room(Room(frames=begin + frames, seed=seed))[begin:]


def first_errors(sequence, model):
    """Errors (15,) of the first state, and their covariance."""
    values, own, P = model.initial_values(), model.process.own, model.prior_covariance
    truth = true_values(sequence, 0)
    error = [true - values[name] for true, name in zip(truth[1:], own[1:], strict=True)]
    columns = model.process.columns
    return np.concatenate([se3.log(truth[0] @ se3.inverse(values["pose"])), *error]), P[np.ix_(columns, columns)]


@pytest.mark.slow
def test_a_start_in_motion_finds_tilt_velocity_and_gyroscope_bias():
    for seed in range(3):
        sequence = moving(seed)
        problem = resolve(sequence)
        assert str(problem.account["inertial_start"]).startswith("in motion, from stereo over 0.0 to 1.0 s")
        error, P = first_errors(sequence, problem.model)
        assert np.linalg.norm(error[3:6]) < np.deg2rad(2.5)
        assert np.linalg.norm(error[6:9]) < 0.05 and np.linalg.norm(error[9:12]) < 0.01
        assert error[3:] @ np.linalg.solve(P[3:, 3:], error[3:]) < 25.0


@pytest.mark.slow
def test_without_noise_gravity_in_motion_has_its_magnitude_to_a_centimetre_a_second_squared():
    exact = Room(frames=50, seed=1, sigma_px=0.02, gyro=1e-6, accel=1e-5, accel_bias_std_m_s2=1e-4)
    problem = resolve(simulate_room(exact)[30:])
    assert "|g| 9.81 m/s^2 if free" in problem.account["inertial_start"]


@pytest.mark.slow
def test_a_filter_that_starts_in_motion_is_honest_from_the_first_frames_on():
    squared = []
    for seed in range(5):
        sequence = moving(seed, frames=40)
        problem, found = resolve(sequence), []
        ekf = JointEKF(problem.model, problem.config.filter)
        for frame in run_filter(ekf, sequence):
            if frame.number:
                found.append(inertial_nees(ekf, true_values(sequence, frame.number))["all"])
        squared.append(found)
    assert np.mean(squared, axis=0).max() < 25.0 and 8.0 < np.mean(squared) < 20.0


def test_a_start_in_motion_among_samples_without_sense_says_so():
    with np.errstate(all="ignore"):
        problem = resolve(ekfslam.open_sequence("builtin:room?frames=8&gyro=1e3&start_s=0.1"))
    assert "its motions fix no velocity and no gravity" in str(problem.account["inertial_start"])


def test_a_start_in_motion_without_enough_points_says_so():
    sequence = moving(0)
    few = thinned(sequence, [range(len(sequence))], 4)
    problem = resolve(few)
    assert "only 0 motions of at least 10 points" in problem.account["inertial_start"]
    tilt = np.sqrt(np.linalg.eigvalsh(problem.model.prior_covariance[3:6, 3:6])[-1])
    assert tilt == pytest.approx(0.3, rel=0.01)


@pytest.mark.slow
def test_densities_of_flight_are_found_from_innovations():
    """Samples with 5 and 10 times the stated noise of gyroscope and accelerometer."""
    sequence = simulate_room(Room(frames=300, seed=1, gyro=8.5e-4, accel=2e-2))
    sequence = dataclasses.replace(sequence, inputs=(dataclasses.replace(sequence.inertial, noise=NOISE),))
    problem = resolve(sequence)
    found = problem.config.inertial
    assert 0.9 < found.gyro / 8.5e-4 < 1.5 and 0.9 < found.accel / 2e-2 < 1.5
    assert str(problem.account["inertial_noise"]).startswith("found from ")


def test_right_densities_stay_as_stated():
    problem = resolve(simulate_room(Room(frames=30, seed=1)))
    assert problem.account["inertial_noise"] == "as stated"
    assert problem.config.inertial.accel == 2e-3


def likeliest(sequence, at, monkeypatch):
    """Densities found if the log-likelihood of a stretch is a parabola about some of gyroscope and accelerometer."""

    def run(noise, config, part, stretches):
        off = np.log2([noise.gyro / at[0], noise.accel / at[1]])
        return [SimpleNamespace(log_likelihood=-200.0 * float(off @ off))]

    monkeypatch.setattr("ekfslam.inertial.noise.run_stretches", run)
    return likeliest_densities(sequence, FilterConfig(), lambda part, noise: lambda densities: densities)


@pytest.mark.parametrize("factors", [(1.2, 1.9), (3.1, 1.4)])
def test_the_likeliest_densities_are_found_between_steps(factors, monkeypatch):
    sequence = simulate_room(Room(frames=60, seed=1))
    at = np.array(factors) * [sequence.inertial.noise.gyro, sequence.inertial.noise.accel]
    found = likeliest(sequence, at, monkeypatch).noise
    np.testing.assert_allclose([found.gyro, found.accel], at, rtol=0.02)


def shaken(vibration, rate_hz=200.0):
    """Samples of slow motion with white noise of densities 1e-3 and 1e-2; the first two seconds do not vibrate."""
    t, rng = np.arange(0.0, 20.0, 1.0 / rate_hz), np.random.default_rng(0)
    slow, white = np.sin(t)[:, None] * [0.3, -0.2, 0.1], rng.standard_normal((2, len(t), 3)) * np.sqrt(rate_hz)
    shakes = vibration * ((t > 2.0) * np.sin(2.0 * np.pi * 80.0 * t))[:, None]
    return InertialSamples(t, slow + 1e-3 * white[0] + shakes, 3.0 * slow + 1e-2 * white[1] + shakes)


@pytest.mark.parametrize("vibration", [0.0, 1.0])
def test_white_noise_is_found_in_the_quietest_second(vibration):
    np.testing.assert_allclose(white_densities(shaken(vibration)), [1e-3, 1e-2], rtol=0.15)


def test_vibration_and_fast_motion_are_no_white_noise():
    flight = shaken(1.0)
    flight = InertialSamples(flight.time_s[600:], flight.gyro_rad_s[600:], flight.accel_m_s2[600:])
    assert white_densities(flight) == (0.0, 0.0)
    t = np.arange(0.0, 20.0, 0.02)
    fast = np.sin(20.0 * t)[:, None] * [1.0, 0.5, -0.3]
    assert white_densities(InertialSamples(t, fast, 10.0 * fast)) == (0.0, 0.0)


def test_white_noise_is_not_undercut(monkeypatch):
    sequence = simulate_room(Room(frames=60, seed=1))
    found = likeliest(sequence, (1e-6, 1.0), monkeypatch).noise
    assert found.gyro == pytest.approx(white_densities(sequence.inertial)[0], rel=1e-3) and found.accel > 0.1


@pytest.mark.parametrize(("factor", "is_found"), [(1.3, True), (1.7, False)])
def test_densities_of_one_camera_that_exceed_what_samples_show_are_of_a_wrong_start(factor, is_found, monkeypatch):
    sequence = of_left_camera(simulate_room(Room(frames=60, seed=1)))
    upper = from_differences(sequence.inertial)
    found = likeliest(sequence, (upper.gyro, factor * upper.accel), monkeypatch)
    assert (found is not None) == is_found
