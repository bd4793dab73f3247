"""The process of velocities: its step, and the residual that the smoother uses."""

import dataclasses

import numpy as np
import pytest
from support.frozen import assert_equal_to_frozen_rows
from support.jacobians import central
from support.reference import CAMERA, T_CAM_IMU

from ekfslam.config import FilterConfig
from ekfslam.data.interval import Interval, Intervals
from ekfslam.data.noise import Noise
from ekfslam.data.simulate import builtin
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import run_filter
from ekfslam.geometry import motion, se3
from ekfslam.models.blocks import TwistBias
from ekfslam.models.build import model_of
from ekfslam.models.process.velocities import mean_velocity
from ekfslam.models.sensors.stereo import Rig

NOISE = Noise(np.repeat([0.2, 0.02], 3), np.full(4, 0.5), motion_std=np.full(6, 1e-3), tilt_rad=0.05)
T = se3.exp(np.array([1.0, -2.0, 0.5, 0.3, -0.4, 0.8]))
TWISTS = np.array(
    [[6.0, 0.1, 0.2, 0.02, -0.03, 0.3], [5.0, -0.1, 0.0, 0.1, 0.05, -0.4], [0.5, 0.3, 0.1, 0.0, 0.2, 0.1]]
)
ONE_PIECE = Intervals(np.array([0.1, 0.2, 0.15]), np.array([False, True, False]), np.arange(4), np.full(3, 0.1), TWISTS)


def model_of_velocities(walks):
    noise = dataclasses.replace(NOISE, twist_walk_std=np.full(6, 0.1) if walks else None)
    return model_of(Rig(CAMERA, T_CAM_IMU, noise), noise, T, np.eye(6), None, [TwistBias()])


def values_of(model, rng, frames=3):
    drawn = [model.retract(model.initial_values(), 0.1 * rng.normal(size=model.layout.body)) for _ in range(frames)]
    return {name: np.array([values[name] for values in drawn]) for name in drawn[0]}


@pytest.mark.parametrize("walks", [True, False])
def test_residual_derivatives_equal_central_differences(walks):
    model, rng = model_of_velocities(walks), np.random.default_rng(0)
    before, after = values_of(model, rng), values_of(model, rng)
    found = model.process.residual(before, after, ONE_PIECE)
    own = model.layout["pose"]

    def moved(values, x, columns):
        wide = np.zeros(model.layout.body)
        wide[columns] = x
        return model.retract(values, wide)

    by_before = central(lambda x: model.process.residual(moved(before, x, own), after, ONE_PIECE).error.ravel(), 6)
    np.testing.assert_allclose(found.by_before[..., own].reshape(-1, 6), by_before, atol=1e-7)
    everything = slice(0, model.layout.body)
    by_after = central(
        lambda x: model.process.residual(before, moved(after, x, everything), ONE_PIECE).error.ravel(),
        model.layout.body,
    )
    np.testing.assert_allclose(found.by_after.reshape(-1, model.layout.body), by_after, atol=1e-7)


@pytest.mark.parametrize("walks", [True, False])
def test_the_residual_of_a_step_is_zero_and_has_its_transition(walks):
    model, rng = model_of_velocities(walks), np.random.default_rng(1)
    before = values_of(model, rng)
    step = model.process.step(before, ONE_PIECE, before["pose"], False)
    found = model.process.residual(before, {**before, **step.values}, ONE_PIECE)
    np.testing.assert_allclose(found.error, 0.0, atol=1e-12)
    pose = model.layout["pose"]
    transition = -found.by_before
    transition[..., pose.stop :] -= found.by_after[..., pose.stop :]
    np.testing.assert_allclose(step.Phi, transition, atol=1e-12)


def test_steps_of_many_intervals_equal_those_of_each():
    model = model_of_velocities(walks=False)
    before = values_of(model, np.random.default_rng(2))
    together = model.process.step(before, ONE_PIECE, before["pose"], False)
    for k in range(3):
        values = {name: value[k] for name, value in before.items()}
        alone = model.process.step(values, ONE_PIECE[k], before["pose"][k], False)
        np.testing.assert_allclose(together.Phi[k], alone.Phi, atol=1e-14)
        np.testing.assert_allclose(together.Q[k], alone.Q, atol=1e-18)
        np.testing.assert_allclose(together.values["pose"][k], alone.values["pose"], atol=1e-14)


def test_several_velocities_lead_where_they_lead_one_after_the_other():
    model = model_of(Rig(CAMERA, T_CAM_IMU, NOISE), dataclasses.replace(NOISE, tilt_rad=0.0), T, np.eye(6))
    dt_s = np.array([0.02, 0.05, 0.03])
    interval = Interval(float(dt_s.sum()), dt_s, TWISTS)
    found = model.process.step({"pose": T}, interval, T, False).values["pose"]
    expected = T
    for twist, dt in zip(TWISTS, dt_s, strict=True):
        expected = motion.increment(twist, dt) @ expected
    np.testing.assert_allclose(found, expected, atol=1e-14)


def test_intervals_with_several_pieces_have_the_mean_velocity_of_each():
    intervals = Intervals(
        np.array([0.3, 0.1]), np.zeros(2, dtype=bool), np.array([0, 2, 3]), np.array([0.1, 0.2, 0.1]), TWISTS
    )
    found = mean_velocity(intervals)
    np.testing.assert_array_equal(found[1], TWISTS[2])
    np.testing.assert_array_equal(found[0], mean_velocity(intervals[0]))
    assert np.abs(found[0] - TWISTS[0]).max() > 0.1


def test_a_prior_that_couples_blocks_is_that_of_filter_log_and_smoother():
    world = builtin("city?frames=10&outlier_fraction=0")
    rig = Rig(world.camera, world.T_cam_imu, world.noise)
    model = model_of(
        rig,
        world.noise,
        se3.inverse(world.initial_T_world_imu),
        1e-4 * np.eye(6),
        blocks=[TwistBias()],
        coordinates="xyz",
    )
    at, prior = model.layout["twist_bias"], model.prior_covariance.copy()
    prior[:6, at] = 0.5 * np.sqrt(np.outer(np.diag(prior)[:6], np.diag(prior)[at])) * np.eye(6)
    prior[at, :6] = prior[:6, at].T
    config = FilterConfig(variant="standard", landmark_coordinates="xyz", retire="never", gate_probability=1.0)
    ekf = JointEKF(dataclasses.replace(model, joint_prior=prior), config)
    np.testing.assert_array_equal(ekf.P, prior)
    for _ in run_filter(ekf, world):
        pass
    np.testing.assert_array_equal(ekf.log().initial_covariance, prior)
    assert_equal_to_frozen_rows(ekf)
    apart = JointEKF(model, config)
    for _ in run_filter(apart, world):
        pass
    assert np.abs(apart.coordinates - ekf.coordinates)[at].max() > 1e-5
