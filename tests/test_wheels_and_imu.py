"""Velocities, such as those of wheels, beside inertial samples: both are used together."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from inertial import FILTER, Prior, model_from_prior, true_values
from support.frozen import assert_equal_to_frozen_rows

import ekfslam
from ekfslam.data.inputs import InertialSamples
from ekfslam.data.room import Room, simulate_room
from ekfslam.errors import ConfigError
from ekfslam.evaluation.consistency import nees, pose_error
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import run_filter
from ekfslam.geometry import se3
from ekfslam.models.process import Measured
from ekfslam.models.sensors.velocities import VelocitySource
from ekfslam.resolve import resolve

STD_M_S, STD_RAD_S = 0.03, 0.01
ENGINES = ("auto", "reference")


@functools.cache
def room(frames: int = 60, seed: int = 2) -> ekfslam.Sequence:
    return simulate_room(Room(frames=frames, seed=seed))


def with_wheels(sequence: ekfslam.Sequence, seed: int = 0, noise_free: bool = False) -> ekfslam.Sequence:
    """The recording with the mean velocities of its true motion over each interval, with noise."""
    T = sequence.truth.T_world_imu
    twist = np.zeros((len(T), 6))
    twist[1:] = se3.log(se3.inverse(T[:-1]) @ T[1:]) / np.diff(sequence.time_s)[:, None]
    std = np.repeat([STD_M_S, STD_RAD_S], 3)
    twist += (not noise_free) * std * np.random.default_rng(seed).normal(size=twist.shape)
    attributes = {name: value for name, value in sequence.attributes.items() if name != "velocities"}
    noise = dataclasses.replace(sequence.noise, twist_std=std)
    return dataclasses.replace(sequence, twist=twist, attributes=attributes, noise=noise)


def source_of(sequence: ekfslam.Sequence) -> VelocitySource:
    return VelocitySource(sequence.time_s[1:], ("v_x", "v_y", "v_z"), sequence.twist[1:, :3], np.full(3, STD_M_S))


def test_a_mean_velocity_less_its_change_is_the_velocity_before():
    world = simulate_room(Room(frames=40, seed=4, gyro=0.0, accel=0.0, gyro_walk=0.0, accel_walk=0.0))
    exact = with_wheels(world, noise_free=True)
    process = resolve(world).model.process
    for frame in (25, 30, 35):
        before = dict(zip(process.own, true_values(world, frame - 1), strict=True))
        measured = source_of(exact).during(world.time_s[frame - 1], world.time_s[frame])
        found = process.referred(measured, before, world.interval(frame, InertialSamples))
        np.testing.assert_allclose(found.value, before["velocity"], atol=5e-3)
        assert np.abs(measured.value - before["velocity"]).max() > 2e-2


def test_angular_velocities_beside_a_gyroscope_are_refused():
    world = room(20)
    one = Measured(np.array([5]), np.zeros(1), np.ones(1), np.zeros(1, dtype=bool))
    process = resolve(world).model.process
    before = dict(zip(process.own, true_values(world, 0), strict=True))
    with pytest.raises(ConfigError, match="only linear velocities"):
        process.referred(one, before, world.interval(1, InertialSamples))


def test_frozen_steps_with_velocities_have_the_state_of_the_filter_as_solution():
    config = dataclasses.replace(FILTER, variant="standard", landmark_coordinates="xyz", retire="never")
    prior = Prior(position_m=0.004, tilt_rad=0.02, yaw_rad=0.02, rest_s=0.0)
    ekf = JointEKF(model_from_prior(room(), prior, np.random.default_rng(0)), config)
    for _ in run_filter(ekf, room(), range(30), source_of(with_wheels(room()))):
        pass
    frame = ekf.log().measured_frame  # three rows a frame, and those of a rest
    assert set(frame) == set(range(1, 30)) and len(frame) >= 3 * 29
    assert_equal_to_frozen_rows(ekf)


@pytest.mark.slow
def test_engine_and_reference_filter_agree_with_velocities():
    world = with_wheels(room(30))
    runs = [ekfslam.run(world, "full", ekfslam.Config().with_overrides({"filter": {"engine": e}})) for e in ENGINES]
    np.testing.assert_allclose(runs[0].T_world_imu, runs[1].T_world_imu, atol=1e-8)
    np.testing.assert_allclose(runs[0].covariance, runs[1].covariance, rtol=1e-5, atol=1e-12)


def test_velocities_of_a_recording_measure_the_velocity_of_the_state():
    alone, both = (ekfslam.run(world, "full") for world in (room(40), with_wheels(room(40))))
    assert both.attributes["beside"] == (
        "velocities are measured beside inertial samples: v_x 0.03, v_y 0.03, v_z 0.03 m/s"
    )
    variances = [np.trace(run.inertial.covariance[-1, 6:9, 6:9]) for run in (alone, both)]
    assert variances[1] < 0.97 * variances[0]


def test_axes_that_are_not_measured_are_not_used():
    world = with_wheels(room(20))
    twist = world.twist * [1, 0, 0, 0, 0, 1]
    found = resolve(dataclasses.replace(world, twist=twist))
    assert found.beside.axes == ("v_x",) and found.beside.value.shape == (19, 1)


def test_level_velocities_take_precedence_over_samples_and_a_remark_says_so():
    result = ekfslam.run(dataclasses.replace(with_wheels(room(20)), velocity_frame="level"), "full")
    assert result.inertial is None and any("inertial samples are not used" in each for each in result.remarks)


def test_angular_velocities_alone_are_left_to_the_gyroscope():
    world = with_wheels(room(20))
    result = ekfslam.run(dataclasses.replace(world, twist=world.twist * [0, 0, 0, 1, 1, 1]), "full")
    np.testing.assert_array_equal(result.T_world_imu, ekfslam.run(room(20), "full").T_world_imu)


def test_noise_and_slow_bias_of_velocities_are_found_if_nothing_states_them():
    world = dataclasses.replace(with_wheels(room(60)), noise=None)
    found = resolve(world)
    assert found.beside.is_biased and "twist_bias" in found.model.layout
    assert all(0.5 * STD_M_S < std < 3.0 * STD_M_S for std in found.beside.std)


def test_dead_reckoning_goes_by_the_velocities():
    result = ekfslam.run(with_wheels(room(20)), "dead-reckoning")
    assert np.isfinite(result.T_world_imu).all()


@pytest.mark.slow
def test_errors_are_what_the_covariance_says_and_no_larger_than_of_either_alone():
    """Four runs of 8 s; ten runs of `builtin:room` give the figures in docs/own_data.md."""
    pose, ates = [], []
    for seed in range(4):
        world = room(80, seed)
        both = with_wheels(world, seed)
        wheels = dataclasses.replace(both, inputs=(both.velocities,))
        runs = [ekfslam.run(each, "full") for each in (both, world, wheels)]
        truth = world.truth.T_world_imu
        pose.append(nees(pose_error(runs[0].T_world_imu, truth), runs[0].covariance)[1:].mean())
        ates.append([np.linalg.norm(run.T_world_imu[:, :3, 3] - truth[:, :3, 3], axis=1).mean() for run in runs])
    assert 3.0 < np.mean(pose) < 10.0
    both, alone, wheels = np.mean(ates, axis=0)
    assert both < 1.1 * min(alone, wheels)
