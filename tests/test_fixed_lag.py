"""The relinearised window between filter and smoother: exact at its ends, and honest in the middle."""

import dataclasses
import functools

import numpy as np
import pytest
from support.everything import with_everything
from support.helpers import run_joint
from support.jacobians import POSES, central
from support.reference import T_CAM_IMU, small_world
from support.running import seeds

import ekfslam
from ekfslam.config import Config, FilterConfig, PosteriorConfig
from ekfslam.data.sequence import Observations
from ekfslam.errors import ConfigError
from ekfslam.evaluation.consistency import pose_nees
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import run_filter
from ekfslam.geometry import se3
from ekfslam.models.sensors.monocular import Monocular
from ekfslam.models.sensors.stereo import Rig
from ekfslam.resolve import resolve, settings_of
from ekfslam.runner import run
from ekfslam.smoother.fixed_lag import FixedLag
from ekfslam.smoother.posterior import posterior_of_log
from ekfslam.smoother.prior import Prior
from ekfslam.smoother.revival import MapRevival

MAXIMUM = PosteriorConfig(kernel="none", tolerance=1e-12)


def without_velocities(sequence):
    return dataclasses.replace(sequence, inputs=())


def with_lag(lag, **settings):
    return Config().with_overrides({"filter": {"lag": lag, **settings}})


def recordings(frames=10, scale=1.0):
    """A recording of each process, and one with every block in the state; noise is multiplied by a scale."""
    city = small_world(frames=frames, sigma_v=0.3 * scale, sigma_w=0.03 * scale, sigma_px=0.8 * scale)
    biases = f"gyro_bias_std_rad_s={0.005 * scale}&accel_bias_std_m_s2={0.05 * scale}"
    room = ekfslam.open_sequence(f"builtin:room?frames={frames}&sigma_px={0.5 * scale}&{biases}")
    return {
        "velocities": city,
        "no velocities": without_velocities(room),
        "inertial": room,
        "every block": with_everything(city),
    }


PROCESSES = ["velocities", "no velocities", "inertial", "every block"]


def assert_equal_at_the_end(sequence, lag, share, scale=1.0, **settings):
    """The last poses of filter and smoother differ by a small share of a standard deviation, their covariances too.

    The first standard deviations of an inertial state are multiplied by ``scale``.
    """
    problem = resolve(sequence, with_lag(lag, **settings))
    if problem.model.joint_prior is not None:
        model = dataclasses.replace(problem.model, joint_prior=scale**2 * problem.model.joint_prior)
        problem = dataclasses.replace(problem, model=model)
    revival = MapRevival(problem.model, problem.config.filter)
    window = functools.partial(FixedLag, gain=1e-10)
    ekf = JointEKF(problem.model, problem.config.filter, revival=revival, window=window)
    list(run_filter(ekf, problem.sequence))
    assert ekf.counts["windows given up"] == 0
    smoothed = posterior_of_log(ekf.log(), ekf.model, ekf.landmarks().position_m, MAXIMUM)
    P = smoothed.pose_covariance[-1]
    std = np.sqrt(np.diag(P))
    error = se3.log(ekf.T_imu_world @ smoothed.T_world_imu[-1])
    assert (np.abs(error) < share * std).all(), error / std
    outer = np.outer(std, std)
    np.testing.assert_allclose(ekf.gaussian.body_covariance[:6, :6] / outer, P / outer, atol=share)
    return ekf


@pytest.mark.parametrize("name", PROCESSES)
def test_a_window_of_the_whole_log_ends_at_the_maximum_of_the_smoother(name):
    assert_equal_at_the_end(recordings()[name], 1000, share=1e-4)


@pytest.mark.parametrize(("name", "lag"), list(zip(PROCESSES, (1, 3, 1, 3), strict=True)))
def test_a_short_window_ends_there_too_if_no_row_is_curved(name, lag):
    """With a thousandth of the noise, each frame leaves the window linearised at the truth: nothing is lost."""
    assert_equal_at_the_end(recordings(12, scale=4e-3)[name], lag, share=2e-2, scale=4e-3)


def test_poses_that_have_left_the_window_have_no_covariance_with_the_last_one():
    problem = resolve(recordings()["velocities"], with_lag(3))
    ekf = JointEKF(problem.model, problem.config.filter, window=FixedLag)
    assert ekf.window.cross(0) is None
    last = max(frame.number for frame in run_filter(ekf, problem.sequence))
    assert [ekf.window.cross(last - j) is None for j in range(6)] == [False, False, False, False, True, True]
    np.testing.assert_allclose(ekf.window.cross(last), ekf.gaussian.body_covariance[:6, :6], rtol=1e-6)


def test_without_a_lag_nothing_is_linearised_again():
    world = small_world(frames=12, landmarks=30)
    ekf, _, _ = run_joint(world, Rig(world.camera, world.T_cam_imu, world.noise), FilterConfig(), window=FixedLag)
    assert ekf.window is None


@pytest.mark.parametrize("T", POSES.values(), ids=POSES.keys())
def test_derivative_of_the_prior(T):
    """Against central differences of pose, blocks and landmarks; some landmarks count by their images, some do not."""
    rng = np.random.default_rng(3)
    n, sizes = 5, (8, 3, 2)
    in_image = np.array([True, False, True, True, False])
    q = rng.uniform([-3, -2, 2], [3, 2, 30], (n, 3))
    y = np.where(in_image[:, None], np.concatenate([q[:, :2], np.ones((n, 1))], axis=1) / q[:, 2:], q)
    p = sum(sizes) + 3 * n
    mean = np.concatenate([np.zeros(6), rng.normal(size=7), y.ravel()])
    B = np.eye(p) + 0.1 * rng.normal(size=(p, p))
    B[sum(sizes) :] *= 0.02
    prior = Prior(T, T_CAM_IMU, mean, B, np.arange(n), in_image, sizes)
    zeta = 0.1 * rng.normal(size=p)
    here = prior.at(zeta)

    def errors(h):
        there = prior.at(zeta + h)
        xi = se3.log(there.T_imu_world @ se3.inverse(here.T_imu_world))
        return np.concatenate(
            [xi, there.shared, there.aux, there.drive, (there.positions_m - here.positions_m).ravel()]
        )

    np.testing.assert_allclose(prior.derivative(zeta), central(errors, p), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("first", [0, 1, 5])
def test_the_log_since_a_frame_is_the_end_of_the_log(first):
    world = with_everything(small_world(frames=12, landmarks=30))
    problem = resolve(world)
    ekf = JointEKF(problem.model, problem.config.filter)
    books = []

    class Spy(FixedLag):
        def marginal(self, e, log, rows):
            books.append((self.first, log, rows))
            return super().marginal(e, log, rows)

    config = dataclasses.replace(problem.config.filter, lag=12 - first)
    ekf = JointEKF(problem.model, config, window=Spy)
    list(run_filter(ekf, problem.sequence))
    start, end, rows = books[-1]
    log = ekf.log()
    assert start == max(first - 1, 0) and end.frames == log.frames - start
    kept = np.flatnonzero((log.frame > start) | ((log.frame == start) & np.isin(log.landmark, rows)))
    np.testing.assert_array_equal(end.frame, log.frame[kept] - start)
    np.testing.assert_array_equal(rows[end.landmark], log.landmark[kept])
    for name in ("rows", "variance", "position_m"):
        np.testing.assert_array_equal(getattr(end, name), getattr(log, name)[kept])
    follows = end.previous >= 0
    np.testing.assert_array_equal(kept[end.previous[follows]], log.previous[kept][follows])
    np.testing.assert_array_equal(follows[end.frame > 0], log.previous[kept][end.frame > 0] >= 0)
    np.testing.assert_array_equal(end.id, log.id[rows])
    np.testing.assert_array_equal(end.inputs, log.inputs[log.input_frame > start])
    np.testing.assert_array_equal(end.measured_value, log.measured_value[log.measured_frame > start])


def test_a_lag_excludes_first_estimates_and_landmarks_that_wait():
    with pytest.raises(ConfigError, match="contradicts first estimates"):
        with_lag(3, variant="fej")
    world = small_world(frames=3)
    camera = Monocular(world.camera, world.T_cam_imu, world.noise, parallax_rad=0.2)
    with pytest.raises(ConfigError, match="not with landmarks that wait"):
        JointEKF(camera, FilterConfig(lag=3), world.initial_T_world_imu, window=FixedLag)


def test_a_lag_without_a_window_is_an_error():
    world = small_world(frames=3)
    with pytest.raises(ConfigError, match="lag needs a window"):
        JointEKF(Rig(world.camera, world.T_cam_imu, world.noise), FilterConfig(lag=3), world.initial_T_world_imu)


def test_a_landmark_that_comes_back_begins_a_new_window():
    """Its mean and covariance come from the whole log, and the window goes on from there."""
    world = recordings(12, scale=4e-3)["velocities"]
    frame, landmark, pixels = (getattr(world.observations, name) for name in ("frame", "landmark", "pixels_px"))
    kept = np.ones(len(frame), dtype=bool)
    kept[np.flatnonzero(landmark == np.bincount(landmark).argmax())[3:5]] = False
    gapped = dataclasses.replace(world, observations=Observations(frame[kept], landmark[kept], pixels[kept]))
    ekf = assert_equal_at_the_end(gapped, 3, share=2e-2, retire_after=1)
    assert ekf.counts["revived"] == 1


def test_reported_poses_have_the_cross_covariance_that_clones_have():
    """In a filter whose rows are not curved, a clone of the reported pose gives the same."""
    sequence = recordings(12, scale=4e-3)["velocities"]
    settings = {"relative_frames": 4, "retire": "never"}
    by_clones, by_window = (run(sequence, "full", with_lag(lag, **settings)).pairs for lag in (0, 5))
    std = np.sqrt(np.diagonal(run(sequence, "full", with_lag(0)).covariance, axis1=1, axis2=2))
    kept = by_clones.first > 0  # the first pose is certain
    for name in ("first", "second"):
        np.testing.assert_array_equal(getattr(by_window, name), getattr(by_clones, name))
    scale = std[by_clones.first][kept][:, :, None] * std[by_clones.second][kept][:, None, :]
    np.testing.assert_allclose(by_window.cross[kept] / scale, by_clones.cross[kept] / scale, atol=2e-2)


def test_fast_recordings_without_velocities_have_a_window_unless_landmarks_come_back_often():
    room = ekfslam.open_sequence("builtin:room?frames=50")
    assert resolve(room).config.filter.lag == 0
    blind = without_velocities(room)
    found = resolve(blind).config.filter
    assert (found.lag, found.retire, found.revive) == (10, "unseen", -1)
    assert resolve(blind, with_lag(3)).config.filter.lag == 3
    assert resolve(blind, with_lag(None, variant="fej")).config.filter.lag == 0
    slow = without_velocities(ekfslam.open_sequence("builtin:city?frames=20"))
    assert resolve(slow).config.filter.lag == 0
    ids, first = np.arange(20), np.arange(20) % 5
    pixels = np.tile([100.0, 50.0, 80.0, 50.0], (40, 1))
    returning = Observations(np.concatenate([first, first + 20]), np.tile(ids, 2), pixels)
    assert settings_of(dataclasses.replace(blind, observations=returning), Config()).filter.lag == 0


@pytest.mark.slow
def test_covariances_hold_what_they_promise_without_velocities():
    """Pose NEES of hand-held motion at 1 px, in the mean over frames and seeds, where 6 is expected."""
    found = []
    for seed in seeds(12, 3):
        sequence = without_velocities(ekfslam.open_sequence(f"builtin:room?frames=60&sigma_px=1&seed={seed}"))
        found.append(pose_nees(run(sequence, "full"), sequence.truth)[1][1:].mean())
    assert 3.5 < np.mean(found) < 9.0, found
