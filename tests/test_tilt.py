"""Roll and pitch of a vehicle at its first pose, from its level velocities."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from support.reference import small_world

from ekfslam.config import Config
from ekfslam.data.noise import Noise
from ekfslam.data.simulate import builtin
from ekfslam.errors import DataError, NonFiniteError
from ekfslam.geometry import se3
from ekfslam.models.blocks import TwistBias
from ekfslam.models.blocks.up import Up
from ekfslam.models.tilt import MOUNTED_RAD, PASSING_RAD, PASSING_S, first_tilt
from ekfslam.resolve import noise_of, resolve
from ekfslam.runner import run
from ekfslam.smoother.posterior import model_of_result
from ekfslam.storage.archive import open_result, write_archive

BIAS = TwistBias(sigma_v_m_s=0.02, sigma_w_rad_s=np.deg2rad(0.01), time_w_s=20.0)
CLEAN = Noise(np.repeat([0.02, np.deg2rad(0.02)], 3), np.ones(4), tilt_rad=np.deg2rad(3.0))
WORLD = small_world(frames=80)
WALKED = np.diff(WORLD.time_s, prepend=WORLD.time_s[0])


def wandering(rng, std, time_s, walked=WALKED):
    phi, x = np.exp(-walked / time_s), np.empty(len(walked))
    x[0] = std * rng.normal()
    for k in range(1, len(x)):
        x[k] = phi[k] * x[k - 1] + std * np.sqrt(1 - phi[k] ** 2) * rng.normal()
    return x


def drive(rng=None, roll=0.0, pitch=0.0, grade=0.0, noise=CLEAN, speed=10.0):
    """Level velocities (T, 6) of a vehicle with roll and pitch (T,) on a road with a grade (T,), all in rad."""
    twist = np.zeros((len(WALKED), 6))
    twist[:, 0], twist[:, 2] = speed, speed * np.tan(grade)
    for column, angle in ((3, roll), (4, pitch)):
        twist[1:, column] = np.diff(np.broadcast_to(angle, len(twist))) / WALKED[1:]
    if rng is not None:
        bias = [wandering(rng, BIAS.sigma_w_rad_s, BIAS.time_w_s) for _ in range(2)]
        twist[:, 3:5] += np.transpose(bias)
        twist[:, 1:] += noise.twist_std[1:] * rng.normal(size=(len(twist), 5))
    return dataclasses.replace(WORLD, twist=twist, velocity_frame="level", noise=None)


def test_a_nose_that_follows_the_road_is_pitched_by_its_grade():
    hill = np.deg2rad(6.0) * np.sin(WORLD.time_s / 4.0 + 1.0)
    (roll, pitch), (_, std) = first_tilt(drive(pitch=-hill, grade=hill), CLEAN, BIAS)
    share = CLEAN.tilt_rad**2 / (CLEAN.tilt_rad**2 + MOUNTED_RAD[1] ** 2)
    assert pitch == pytest.approx(-hill[0] * share, rel=0.03)
    assert roll == pytest.approx(0.0, abs=1e-12)
    assert np.deg2rad(0.9) < std < MOUNTED_RAD[1]


def test_roll_at_first_is_what_it_loses_later():
    roll = np.deg2rad(4.0) * np.linspace(1.0, -0.5, len(WORLD))
    (first, pitch), _ = first_tilt(drive(roll=roll), CLEAN, BIAS)
    share = CLEAN.tilt_rad**2 / (CLEAN.tilt_rad**2 + MOUNTED_RAD[0] ** 2)
    assert np.deg2rad(1.0) * share < first < np.deg2rad(4.0) * share
    assert pitch == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("factor", [1.0, 25.0])
def test_errors_are_as_large_as_stated(factor):
    rng, noise = np.random.default_rng(3), dataclasses.replace(CLEAN, twist_std=factor * CLEAN.twist_std)
    errors = []
    for _ in range(60):
        mounted, hill = MOUNTED_RAD * rng.normal(size=2), np.deg2rad(4.0) * np.sin(WORLD.time_s / 3.0)
        roll = mounted[0] + wandering(rng, PASSING_RAD[0], PASSING_S[0])
        pitch = mounted[1] - hill + wandering(rng, PASSING_RAD[1], PASSING_S[1])
        sequence = drive(rng, roll, pitch, hill, noise)
        found, std = first_tilt(sequence, dataclasses.replace(noise, tilt_rad=1.0), BIAS)
        errors.append((found - [roll[0], pitch[0]]) / std)
    np.testing.assert_allclose(np.mean(np.square(errors), axis=0), 1.0, atol=0.5)
    np.testing.assert_allclose(np.mean(errors, axis=0), 0.0, atol=0.3)


def test_a_robot_that_moves_sideways_says_nothing_of_its_pitch():
    sequence = drive()
    twist = sequence.twist.copy()
    twist[:, 1] = 0.5 * twist[:, 0]
    assert first_tilt(dataclasses.replace(sequence, twist=twist), CLEAN, BIAS) is None
    assert first_tilt(drive(speed=0.5), CLEAN, BIAS) is None


def test_only_automatic_noise_of_level_velocities_has_a_first_tilt():
    sequence = drive(np.random.default_rng(0), grade=np.deg2rad(2.0))
    assert noise_of(sequence, Config()).first_tilt is not None
    assert noise_of(dataclasses.replace(sequence, velocity_frame="imu"), Config()).first_tilt is None
    assert noise_of(dataclasses.replace(sequence, noise=CLEAN), Config()).first_tilt is None
    assert noise_of(sequence, Config().with_overrides({"noise": {"tilt_deg": 0.0}})).first_tilt is None


def test_up_has_the_roll_and_pitch_of_the_first_pose():
    R = se3.so3_exp(np.array([0.3, -0.5, 1.1]))
    tilt = np.array([[0.04, -0.07], [0.02, 0.01]])
    block = Up.of_first_pose(R, dataclasses.replace(CLEAN, first_tilt=tilt))
    up = R.T @ block.direction
    np.testing.assert_allclose([np.arctan2(up[1], up[2]), -np.arcsin(up[0])], tilt[0], atol=1e-12)
    np.testing.assert_allclose(block.reported_prior_std, tilt[1])
    about_imu = R.T @ block.prior_covariance() @ R
    np.testing.assert_allclose(np.sqrt(np.diag(about_imu))[:2], tilt[1])
    level = Up.of_first_pose(R, CLEAN)
    np.testing.assert_array_equal(level.direction, R[:, 2])
    np.testing.assert_allclose(level.prior_covariance(), CLEAN.tilt_rad**2 * np.eye(3), atol=1e-17)


def test_an_archive_keeps_the_first_tilt_and_its_posterior_starts_there(tmp_path):
    world = dataclasses.replace(builtin("city?frames=15"), noise=None, velocity_frame="level")
    result = run(world, "full", Config())
    write_archive(path := tmp_path / "run.h5", world, {"full": result})
    read = open_result(path, "full")
    np.testing.assert_array_equal(read.noise.first_tilt, result.noise.first_tilt)
    (before,) = (block for block in resolve(world).model.blocks if block.name == "up")
    (after,) = (block for block in model_of_result(read).blocks if block.name == "up")
    np.testing.assert_allclose(after.direction, before.direction, atol=1e-12)
    np.testing.assert_allclose(after.prior_covariance(), before.prior_covariance(), atol=1e-15)


@pytest.mark.parametrize(
    ("tilt", "error"),
    [(np.zeros((2, 2)), DataError), (np.ones(2), DataError), (np.full((2, 2), np.nan), NonFiniteError)],
)
def test_a_first_tilt_without_meaning_is_refused(tilt, error):
    with pytest.raises(error, match="first_tilt"):
        dataclasses.replace(WORLD, noise=dataclasses.replace(CLEAN, first_tilt=tilt))


def test_stamps_that_are_nearly_one_tell_nothing():
    sequence = drive()
    instant = SimpleNamespace(
        twist=sequence.twist, time_s=1e-17 * np.arange(len(sequence)), interpolated=sequence.interpolated
    )
    with np.errstate(all="ignore"):
        assert first_tilt(instant, CLEAN, BIAS) is None
