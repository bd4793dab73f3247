"""White errors of tracks, their walk, and mixtures of both are found from residuals along tracks."""

import dataclasses

import numpy as np
import pytest

from ekfslam.config import Config
from ekfslam.data.room import Room, simulate_room
from ekfslam.data.sequence import Observations, Sequence, of_left_camera
from ekfslam.data.simulate import builtin
from ekfslam.evaluation.sanity import inspect_result
from ekfslam.evaluation.trajectory import absolute_trajectory_error
from ekfslam.filters.stretches import run_stretches
from ekfslam.geometry import motion, se3
from ekfslam.geometry.camera import T_CAM_BODY, StereoCamera, project
from ekfslam.models.noise import velocity_noise
from ekfslam.models.track_noise import track_noise
from ekfslam.resolve import resolve
from ekfslam.runner import run

CAMERA = StereoCamera(fu_px=707.0, fv_px=707.0, cu_px=602.0, cv_px=183.0, baseline_m=0.537)
SMALL = StereoCamera(fu_px=230.0, fv_px=230.0, cu_px=188.0, cv_px=120.0, baseline_m=0.2)


def seen(camera, white_px, walk_px, *, moves=True, tracks=60, frames=60, seed=0, persists=0.0):
    """Points seen by a rig at rest, or by one that drives and turns; errors are white, walk, or both."""
    rng = np.random.default_rng(seed)
    width, height = 2.0 * camera.cu_px, 2.0 * camera.cv_px
    z = rng.uniform(0.3, 1.0, tracks) * camera.fu_px * camera.baseline_m / 8.0
    u, v = rng.uniform(0.05, 0.95, (2, tracks)) * np.array([[width], [height]])
    points = np.stack([(u - camera.cu_px) / camera.fu_px * z, (v - camera.cv_px) / camera.fv_px * z, z], axis=-1)
    time_s = 0.1 * np.arange(frames)
    step = np.array([0.0, 0.0, 0.002 * z.mean(), 0.0, 0.002, 0.0]) if moves else np.zeros(6)
    T_cam_world = se3.exp(-np.arange(frames)[:, None] * step)
    pixels = project(camera, se3.apply(T_cam_world[:, None], points))
    steps = rng.standard_normal(pixels.shape)
    for k in range(1, frames):
        steps[k] += persists * steps[k - 1]
    pixels = pixels + white_px * rng.standard_normal(pixels.shape) + walk_px * np.cumsum(steps, axis=0)
    return Sequence.from_tracks(time_s, pixels, camera)


@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("camera", [CAMERA, SMALL])
@pytest.mark.parametrize("sigma_px", [0.1, 0.6])
def test_white_errors_are_found_with_any_camera(camera, sigma_px, moves):
    found = track_noise(seen(camera, sigma_px, 0.0, moves=moves))
    assert found.is_white
    assert found.sigma_px == pytest.approx(sigma_px, rel=0.08)
    assert "white" in found.text


def test_few_tracks_do_not_bias_white_errors():
    """A motion that is fitted to eight tracks takes a quarter of their errors with it."""
    sigma = [track_noise(seen(CAMERA, 0.3, 0.0, tracks=8, seed=seed)).sigma_px for seed in range(3)]
    assert np.mean(sigma) == pytest.approx(0.3, rel=0.08)


def test_errors_that_walk_are_not_white():
    assert not track_noise(seen(CAMERA, 0.0, 0.1)).is_white
    found = track_noise(seen(CAMERA, 0.0, 0.1, moves=False))
    assert not found.is_white and "walk" in found.text
    np.testing.assert_allclose(np.sqrt(found.step), [0.1, 0.1 / np.sqrt(2.0), 0.1], rtol=0.1)


def test_walks_whose_steps_persist_have_negative_white_errors():
    found = track_noise(seen(CAMERA, 0.0, 0.1, persists=0.6))
    assert (found.white < 0).all() and not found.is_white
    assert found.persists


def test_errors_that_persist_are_told_by_every_second_stretch_and_white_ones_by_all():
    persisting, white = (seen(CAMERA, *std, frames=121, persists=0.6) for std in ((0.0, 0.1), (0.3, 0.0)))
    asked = {}
    for name, sequence in (("persisting", persisting), ("white", white)):
        frames = asked[name] = set()
        at = sequence.observations.at
        object.__setattr__(sequence.observations, "at", lambda k, at=at, frames=frames: (frames.add(k), at(k))[1])
        track_noise(sequence)
    assert len(asked["persisting"]) <= 0.6 * len(asked["white"])


def test_both_parts_of_a_mixture_are_found_and_the_walk_decides():
    found = track_noise(seen(CAMERA, 0.1, 0.1, moves=False))
    np.testing.assert_allclose(np.sqrt(found.white), [0.1, 0.1 / np.sqrt(2.0), 0.1], rtol=0.15)
    np.testing.assert_allclose(np.sqrt(found.step), [0.1, 0.1 / np.sqrt(2.0), 0.1], rtol=0.15)
    assert not found.is_white


def test_wrong_matches_do_not_count():
    sequence = seen(CAMERA, 0.3, 0.0)
    o, rng = sequence.observations, np.random.default_rng(1)
    wrong = np.where(rng.random((len(o), 1)) < 0.03, rng.uniform(-30.0, 30.0, (len(o), 4)), 0.0)
    found = track_noise(
        dataclasses.replace(sequence, observations=Observations(o.frame, o.landmark, o.pixels_px + wrong))
    )
    assert found.is_white and found.sigma_px == pytest.approx(0.3, rel=0.1)


def test_too_few_tracks_show_nothing():
    assert track_noise(seen(CAMERA, 0.3, 0.0, tracks=5)) is None
    assert track_noise(seen(CAMERA, 0.3, 0.0, frames=2)) is None


def test_points_that_fix_no_motion_show_nothing():
    pixels = np.tile([518.67099021, 169.08936163, 494.92801121, 165.78577944], (2, 27, 1))
    camera = StereoCamera(707.0, 707.0, 602.0, 183.0, 0.537)
    assert track_noise(Sequence.from_tracks(np.array([0.0, 0.1]), pixels, camera)) is None


def test_white_errors_replace_the_walk_and_are_said():
    unstated = dataclasses.replace(builtin("city?frames=60"), noise=None)
    problem = resolve(unstated, Config())
    assert problem.model.track_error is None
    np.testing.assert_allclose(problem.model.noise.pixel_std_px, 0.7, rtol=0.08)
    assert "white" in problem.account["found_tracks"]
    assert resolve(unstated, problem.config).config == problem.config
    given = resolve(unstated, Config().with_overrides({"noise": {"track_scale": 1.0}}))
    assert given.model.track_error is not None and "found_tracks" not in given.account


def hand_held(noise_std, seed=0, frames=60):
    """A hand-held rig, whose motion changes from frame to frame; white velocity noise (2,) is added to exact means."""
    rng, tau_s = np.random.default_rng(seed), 0.1
    twist, step = np.zeros((frames, 6)), np.repeat([0.3, 0.2], 3)
    for k in range(1, frames):
        twist[k] = 0.9 * twist[k - 1] + step * rng.standard_normal(6)
    T_imu_world = motion.integrate(np.eye(4), twist, np.full(frames - 1, tau_s))
    points = rng.standard_normal((600, 3))
    points *= rng.uniform(5.0, 12.0, (600, 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    q = se3.apply(T_CAM_BODY @ T_imu_world[:, None], points)
    pixels = project(CAMERA, np.where(q[..., 2:] > 0.5, q, 1.0))
    inside = (q[..., 2] > 0.5) & (np.abs(pixels[..., 0] - 602.0) < 600.0) & (np.abs(pixels[..., 1] - 183.0) < 180.0)
    pixels = pixels + 0.7 * rng.standard_normal(pixels.shape)
    frame, landmark = np.nonzero(inside)
    measured = twist + np.repeat(noise_std, 3) * rng.standard_normal(twist.shape)
    rig = {"T_cam_imu": T_CAM_BODY, "twist": measured, "T_world_imu": se3.inverse(T_imu_world)}
    return Sequence.from_tracks(
        tau_s * np.arange(frames), pixels[inside], CAMERA, frame=frame, landmark=landmark, **rig
    )


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("noise_std", [(0.0, 0.0), (0.15, 0.0)])
def test_means_over_intervals_have_no_sampling_noise(noise_std, seed):
    """Velocities that change as much as these are not sampled: by the likelihood of innovations they are means."""
    sequence = hand_held(noise_std, seed)
    assert velocity_noise(sequence.twist).sampling[3:].max() > 0.04
    problem = resolve(sequence)
    assert problem.config.noise.sampling_w == 0.0
    assert problem.model.noise.twist_std[3:].max() < 0.001
    assert resolve(sequence, problem.config).config == problem.config


def test_sampled_velocities_keep_their_sampling_noise():
    found = resolve(hand_held((0.15, 0.15))).model.noise
    assert (found.twist_std[3:] > 0.05).all() and (found.twist_std[:3] > 0.05).all()


def test_rejecting_more_makes_no_noise_likelier():
    """A pixel noise that is ten times too small rejects nearly everything; its likelihood must be the smaller one."""
    world = builtin("city?frames=10&outlier_fraction=0")
    scores = []
    for sigma_px in (0.7, 0.1):
        problem = resolve(world, Config().with_overrides({"noise": {"sigma_px": sigma_px}}))
        (stretch,) = run_stretches(problem.model, problem.config.filter, world, [range(10)])
        scores.append(stretch.log_likelihood)
    assert scores[0] > scores[1] + 100.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_the_city_without_stated_noise_is_as_good_as_with_it(seed):
    stated = builtin(f"city?frames=80&seed={seed}")
    errors = [
        absolute_trajectory_error(run(each).T_world_imu, stated.truth.T_world_imu, align=False)
        for each in (stated, dataclasses.replace(stated, noise=None))
    ]
    assert errors[1] < 1.3 * errors[0] + 0.01


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("velocities", [False, True])
def test_a_rig_at_rest_stays_where_it_is(seed, velocities):
    sequence = seen(CAMERA, 0.3, 0.0, moves=False, frames=100, seed=seed)
    if velocities:
        twist = np.repeat([0.05, 0.005], 3) * np.random.default_rng(seed).standard_normal((100, 6))
        sequence = dataclasses.replace(sequence, attributes={}).with_velocities(twist, "imu")
    result = run(sequence)
    assert np.linalg.norm(result.T_world_imu[-1, :3, 3]) < 0.02
    assert result.counts["rejected: moving"] == 0


def test_a_large_share_of_moving_tracks_is_a_symptom():
    sequence = seen(CAMERA, 0.3, 0.0, moves=False, frames=10)
    result = run(sequence)
    moving = {**result.counts, "rejected: moving": len(sequence.observations) // 3}
    (line,) = inspect_result(sequence, dataclasses.replace(result, counts=moving), ())
    assert "dropped as moving" in line and "traffic, or" in line


# --- one camera -------------------------------------------------------------------------------------------------------


def of_one_camera(*errors, **changes):
    return of_left_camera(seen(CAMERA, *errors, frames=120, **changes))


@pytest.mark.parametrize("moves", [False, True])
def test_white_errors_of_one_camera_are_found(moves):
    found = track_noise(of_one_camera(0.5, 0.0, moves=moves))
    assert found.is_white and found.sigma_px == pytest.approx(0.5, rel=0.1)


def test_white_errors_of_one_camera_are_found_beside_motion_that_changes():
    sigma = [track_noise(simulate_room(Room(frames=100, cameras=1, seed=seed))).sigma_px for seed in range(2)]
    assert np.mean(sigma) == pytest.approx(1.0, rel=0.12)


@pytest.mark.parametrize("persists", [0.0, 0.6])
def test_errors_of_one_camera_that_walk_are_not_white(persists):
    found = track_noise(of_one_camera(0.0, 0.1, persists=persists))
    assert not found.is_white and "walk" in found.text


def test_few_tracks_of_one_camera_tell_nothing():
    assert track_noise(of_one_camera(0.5, 0.0, tracks=6)) is None
