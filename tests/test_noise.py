"""Noise from the data, and the filter that lives with it: velocities in the state, errors of tracks, moving tracks."""

import dataclasses

import numpy as np
import pytest
from support.gauge import gauge_directions
from support.helpers import grown, run_joint, tracked
from support.jacobians import central
from support.literal import Literal, filter_of, side_by_side
from support.reference import small_world
from support.running import WHOLE, seeds

from ekfslam import open_sequence
from ekfslam.config import Config, FilterConfig, NoiseConfig, PosteriorConfig
from ekfslam.data.interval import Interval
from ekfslam.data.noise import TrackError
from ekfslam.data.readers import write_sequence
from ekfslam.data.sequence import Observations
from ekfslam.data.simulate import builtin
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import run_filter
from ekfslam.filters.result import REASONS
from ekfslam.geometry import motion, se3
from ekfslam.models.noise import (
    TRACK_WALK_PX,
    VELOCITY_STD,
    automatic_noise,
    shared_errors,
    velocity_noise,
    with_drift,
)
from ekfslam.models.sensors.base import MOVING
from ekfslam.models.sensors.stereo import Rig
from ekfslam.resolve import PERSISTENCE, TARGET, noise_of, resolve
from ekfslam.runner import run
from ekfslam.smoother.posterior import posterior, smooth
from ekfslam.smoother.problem import BatchProblem
from ekfslam.storage.archive import open_result, write_archive

OPEN = FilterConfig(landmark_coordinates="xyz", gate_probability=1.0, split_after=0)
STILL = dataclasses.replace(OPEN, moving_sigma=1e9)
WALK = np.repeat([0.2, 0.02], 3)
P0 = np.diag([0.1, 0.2, 0.3, 0.01, 0.02, 0.03]) ** 2
TRACKS = {
    "track_first_px": np.array([0.3, 0.4, 0.8]),
    "track_walk_px": np.array([0.2, 0.25, 0.3]),
    "track_flow_px": 40.0,
    "track_parallax": 0.05,
}
ERROR = TrackError(*TRACKS.values())


def with_noise(sequence, **changes):
    return dataclasses.replace(sequence, noise=dataclasses.replace(sequence.noise, **changes))


def without_noise(sequence):
    return dataclasses.replace(sequence, noise=None)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("world", ["city", "loop"])
def test_velocity_noise_of_simulations_is_recovered(world, seed):
    sequence = builtin(f"{world}?seed={seed}&frames=1000")
    found = velocity_noise(sequence.twist)
    np.testing.assert_allclose(found.sigma, [0.5, 0.05], rtol=0.15)
    assert (np.abs(found.sigma - [0.5, 0.05]) < 5 * found.sigma_error + 0.02 * np.array([0.5, 0.05])).all()
    quiet = builtin(f"{world}?seed={seed}&frames=1000&sigma_v_m_s=0.01&sigma_w_rad_s=0.001")
    assert (velocity_noise(quiet.twist).sigma < [0.03, 0.003]).all()


@pytest.mark.slow
@pytest.mark.data
def test_velocity_noise_of_the_recordings(data_path):
    noisy = velocity_noise(open_sequence(data_path("ece276a/0027_dense_noisy.npz")).twist)
    np.testing.assert_allclose(noisy.sigma, [0.5, 0.05], rtol=0.15)
    for name in ("ece276a/0027.npz", "ece276a/0042.npz", "utias/2011_10_03_drive_0042_sync_KLT.mat"):
        clean = velocity_noise(open_sequence(data_path(name)).twist)
        assert (clean.sigma < [0.05, 0.005]).all()


def test_automatic_noise_is_for_recordings_that_state_none():
    stated = builtin("city?frames=200")
    assert noise_of(stated, Config()).track_error is None
    unstated = without_noise(stated)
    found = noise_of(unstated, Config())
    assert (found.track_error.first_std > 0).all() and (found.track_error.walk_std > 0).all()
    assert found.twist_walk_std is not None
    np.testing.assert_allclose(found.twist_std[[0, 3]], velocity_noise(stated.twist).sigma)
    # Whatever is given by hand is white, and so is everything on request.
    for config in (Config(noise=NoiseConfig(sigma_px=2.0)), Config(noise=NoiseConfig(model="white"))):
        assert noise_of(unstated, config).track_error is None
        assert noise_of(unstated, config).twist_walk_std is None
    # Velocities that are cleaner than what is there anyway are not filtered.
    still = automatic_noise(velocity_noise(np.zeros((100, 6))))
    assert still.twist_walk_std is None
    np.testing.assert_array_equal(still.velocity_std, VELOCITY_STD)


@pytest.mark.parametrize("size", [0.1, 2.0])
def test_sampling_noise_is_what_is_missed_between_samples(size):
    """A fine random walk, sampled: what the trapezoids of its samples miss of its integral, and that alone."""
    rng, fine, frames = np.random.default_rng(0), 64, 4000
    walk = np.cumsum(rng.standard_normal((fine * frames + 1, 6)) * size / np.sqrt(fine), axis=0)
    samples = walk[::fine]
    means = walk[:-1].reshape(frames, fine, 6).mean(axis=1) + (walk[fine::fine] - walk[:-fine:fine]) / (2 * fine)
    missed = (0.5 * (samples[1:] + samples[:-1]) - means).std(axis=0)
    found = velocity_noise(samples)
    np.testing.assert_allclose(found.sampling, missed, rtol=0.08)
    noise = 3.0 * size * rng.standard_normal(samples.shape)
    assert (velocity_noise(samples + noise).sampling < 2.0 * size).all()


def test_shared_errors_follow_what_velocities_are_worth():
    rng = np.random.default_rng(0)
    clean = np.cumsum(0.02 * rng.standard_normal((400, 6)), axis=0) * np.repeat([1.0, 0.02], 3)
    noisy = clean + np.repeat([0.5, 0.05], 3) * rng.standard_normal(clean.shape)
    ours, theirs = shared_errors(velocity_noise(clean)), shared_errors(velocity_noise(noisy))
    assert ours.keys() == theirs.keys() == {"twist_bias", "camera_jitter", "vision_drift"}
    assert theirs["twist_bias"]["sigma_w_rad_s"] == pytest.approx(0.005, rel=0.2)
    assert ours["twist_bias"]["sigma_v_m_s"] < theirs["twist_bias"]["sigma_v_m_s"]
    assert ours["vision_drift"] == theirs["vision_drift"] == {}


def test_blocks_of_the_automatic_model_give_way_to_what_is_configured():
    unstated = drifting_tracks(frames=60)
    names = {"twist_bias", "camera_jitter", "vision_drift"}
    problem = resolve(unstated, Config().with_overrides({"blocks": {"camera_jitter": {"time_s": 2.0}}}))
    assert set(problem.config.blocks) == names and problem.model.observer.calibration is not None
    assert problem.config.blocks["camera_jitter"] == {"time_s": 2.0}
    for settings in ({"noise": {"shared": False}}, {"noise": {"model": "white"}}):
        without = resolve(unstated, Config().with_overrides(settings))
        assert not without.config.blocks and without.model.observer.calibration is None
    assert not resolve(builtin("city?frames=60"), Config()).config.blocks
    # Run again with what was resolved: the same.
    assert resolve(unstated, problem.config).config == problem.config


@pytest.mark.slow
def test_interpolated_velocities_are_trusted_less():
    world = without_noise(builtin("city?frames=40&max_tracks=20"))
    gap = dataclasses.replace(world, attributes={**world.attributes, "interpolated": "10-20"})
    problem = resolve(gap, Config())
    ekf = JointEKF(problem.model, problem.config.filter)
    for _ in run_filter(ekf, problem.sequence):
        pass
    log = ekf.log()
    assert np.flatnonzero(log.is_gap).tolist() == list(range(10, 21))
    plain, wide = (
        problem.model.process.step(ekf.values, Interval.of_one(log.inputs[10], 0.1, is_gap), ekf.T_imu_world, False).Q
        for is_gap in (False, True)
    )
    added = problem.model.noise.gap_std
    np.testing.assert_allclose(np.diag(wide - plain)[0], (0.1 * added[0]) ** 2, rtol=0.05)
    smoother = BatchProblem(log, problem.model)
    step = smoother.process.factors(smoother.filtered_state(ekf.landmarks().position_m))[0]
    weight = np.abs(step.terms[1].J[:, 0, 0])
    assert weight[10:19].max() < 0.5 * np.median(weight[25:])


def drifting_tracks(frames):
    """Return a drive with noisy velocities whose errors of tracks walk."""
    return without_noise(tracked(builtin(f"city?frames={frames}&outlier_fraction=0"), ERROR, 0))


def scale_of(sequence):
    return resolve(sequence).config.noise.track_scale


def walking_tracks(factor):
    """Return a drive with clean velocities whose tracks err `factor` times as much as the automatic model says."""
    walk = dataclasses.replace(automatic_noise(velocity_noise(np.zeros((100, 6)))).track_error, flow_px=np.inf)
    quiet = builtin("city?frames=60&outlier_fraction=0&sigma_v_m_s=0.01&sigma_w_rad_s=0.0002&max_tracks=60&seed=2")
    return without_noise(tracked(quiet, dataclasses.replace(walk, walk_std=factor * walk.walk_std), 0))


def test_the_track_scale_follows_the_errors_of_tracks():
    assert scale_of(walking_tracks(4.0)) / scale_of(walking_tracks(2.0)) == pytest.approx(2.0, rel=0.25)


def test_the_track_scale_brings_the_nis_of_the_run_to_its_target():
    innovation = run(walking_tracks(2.0), "full").innovation
    assert innovation.nis.sum() / innovation.dof.sum() == pytest.approx(TARGET, rel=0.2)


def test_the_track_scale_of_noisy_velocities_is_that_of_the_long_run():
    assert scale_of(drifting_tracks(frames=10)) == PERSISTENCE


def test_a_recording_that_states_its_noise_has_no_track_scale():
    assert scale_of(builtin("city?frames=10")) is None


def test_the_problem_says_what_was_resolved():
    decisions = resolve(drifting_tracks(frames=10)).decisions
    assert "noise: track_scale 3" in decisions
    assert "filter: lag 0, retire unseen, retire_after 1, dormant 0" in decisions


def test_too_few_innovations_leave_the_track_scale_at_one():
    assert scale_of(walking_tracks(4.0)[:1]) == 1.0


def test_twist_jacobian_against_central_differences():
    twist, tau = np.array([8.0, 0.3, -0.1, 0.02, -0.03, 0.4]), 0.13
    numeric = central(
        lambda d: se3.log(motion.increment(twist + d, tau) @ se3.inverse(motion.increment(twist, tau))), 6
    )
    np.testing.assert_allclose(-motion.twist_jacobian(twist, tau), numeric, atol=1e-8)


def with_gaps(world, share=0.1):
    """The world with a share of its observations missing, so that tracks come back after some frames."""
    observations = world.observations
    kept = np.random.default_rng(9).random(len(observations)) > share
    parts = (observations.frame, observations.landmark, observations.pixels_px)
    return dataclasses.replace(world, observations=Observations(*(part[kept] for part in parts)))


@pytest.mark.parametrize("variant", ["standard", "invariant"])
def test_filter_with_velocities_and_errors_of_tracks_equals_the_literal_one(variant):
    world = with_noise(with_gaps(small_world()), twist_walk_std=WALK, motion_std=np.full(6, 0.01), **TRACKS)
    ekf = filter_of(world, dataclasses.replace(STILL, variant=variant, retire="never"), P=P0)
    literal = Literal(world, variant, P=P0)
    follow, again = side_by_side(ekf, literal, world, 1e-9, frames=15)
    assert len(ekf.ids) > 10
    assert follow > 50 and again > 5


def gauge_of_all(ekf):
    """What moving the world does to all errors: of pose and views, and of landmarks."""
    layout, N = ekf.model.layout, gauge_directions(ekf.linear_T_imu_world, ekf.linear_positions_m)
    body = np.zeros((ekf.gaussian.body, 6))
    body[layout["pose"]] = N[:6]
    first = dict(zip(layout.views, (ekf.motion.W_predicted, ekf.motion.W_predicted_before), strict=False))
    for name in layout.views:
        body[layout[name]] = -se3.adjoint(ekf.variant.linear(ekf.values[name], first[name]))
    return np.vstack([body, N[6:]])


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["standard", "invariant", "fej"])
def test_velocities_that_walk_freely_are_white(variant):
    """A walk much larger than the noise says nothing about the next velocity: the state without them, once more."""
    world = small_world()
    free = with_noise(world, twist_walk_std=np.full(6, 1e4))
    config = Config(filter=dataclasses.replace(OPEN, variant=variant))
    a, b = run(world, "full", config), run(free, "full", config)
    np.testing.assert_allclose(b.T_world_imu, a.T_world_imu, atol=2e-3)
    np.testing.assert_allclose(b.covariance[-1], a.covariance[-1], rtol=2e-2, atol=1e-5)


@pytest.mark.slow
def test_knowing_how_velocities_walk_helps_where_little_is_seen():
    error, frames = {"white": [], "walk": []}, 300 if WHOLE else 120
    for seed in seeds(6, 4):
        world = builtin(f"city?frames={frames}&max_tracks=2&seed={seed}")
        for name, walk in (("white", None), ("walk", velocity_noise(world.twist).walk.repeat(3))):
            result = run(with_noise(world, twist_walk_std=walk), "full")
            position = result.T_world_imu[:, :3, 3] - world.truth.T_world_imu[:, :3, 3]
            error[name].append(np.sqrt((position**2).sum(axis=1).mean()))
            assert result.covariance.shape == (frames, 6, 6)
    assert np.mean(error["walk"]) < 0.8 * np.mean(error["white"])


@pytest.mark.parametrize("variant", ["invariant", "fej"])
def test_no_information_about_the_gauge_comes_with_velocities_and_errors_of_tracks(variant):
    world = with_noise(
        small_world(seed=4),
        twist_std=np.full(6, 1e-2),
        twist_walk_std=np.full(6, 1e-2),
        motion_std=np.full(6, 1e-3),
        **TRACKS,
    )
    config = dataclasses.replace(STILL, variant=variant)
    ekf = JointEKF(Rig(world.camera, world.T_cam_imu, world.noise), config, world.initial_T_world_imu, P0)
    prior = se3.adjoint(ekf.T_imu_world).T @ np.linalg.solve(P0, se3.adjoint(ekf.T_imu_world))
    for k, *_ in run_filter(ekf, world):
        if k == 0:
            continue  # nothing is known of the velocities, and P is singular
        view = ekf.model.layout["view"]  # a function of the pose, so that P is singular
        N, P = np.delete(gauge_of_all(ekf), view, 0), np.delete(np.delete(ekf.P, view, 0), view, 1)
        ratio = np.linalg.eigvals(np.linalg.solve(prior, N.T @ np.linalg.solve(P, N))).real
        assert ratio.max() < 1 + 1e-6


def moving_world(share=0.3, speed=0.3, **changes):
    """A small world in which some landmarks travel along with the rig, and errors of tracks walk; also their ids."""
    world = small_world(frames=80, landmarks=120, sigma_v=0.02, sigma_w=0.002)
    ids = world.observations.ids
    movers = np.random.default_rng(1).permutation(ids)[: int(share * len(ids))]
    world = with_noise(world, **{**TRACKS, "motion_std": np.repeat([0.02, 0.002], 3), **changes})
    return tracked(world, world.noise.track_error, 1, movers, speed), movers


@pytest.mark.slow
def test_tracks_that_travel_with_the_rig_are_found_and_listed():
    world, movers = moving_world(speed=0.25)
    rejections = (result := run(world, "full", Config(filter=FilterConfig(moving_share=0.1, split_after=3)))).rejections
    accused = np.unique(rejections.landmark[rejections.reason == REASONS.index("moving")])
    assert result.counts["moving"] == len(accused) > 10
    assert np.isin(accused, movers).mean() > 0.85
    # Of what is seen long enough to be judged most are found so, and the others at the gate.
    seen = np.bincount(np.searchsorted(world.observations.ids, world.observations.landmark))
    long = np.intersect1d(movers, world.observations.ids[seen > 9])
    assert np.isin(long, accused).mean() > 0.5
    assert np.isin(long, rejections.landmark).mean() > 0.9


@pytest.mark.slow
def test_moving_is_for_good_and_never_where_pixels_are_white():
    world, _ = moving_world()
    white = with_noise(world, track_first_px=None, track_walk_px=None)
    assert run(white, "full").counts["moving"] == 0
    ekf = JointEKF(Rig(world.camera, world.T_cam_imu, world.noise), FilterConfig(), world.initial_T_world_imu)
    banned = set()
    for _, report, _ in run_filter(ekf, world):
        assert not banned & set(ekf.ids.tolist())
        banned |= set(report.ids[report.reason == MOVING].tolist())
    assert banned


def test_variances_of_tracks_are_those_of_errors_that_walk():
    error, rng = ERROR, np.random.default_rng(0)
    e = error.first_std * rng.normal(size=(40_000, 3))
    for age in range(12):
        np.testing.assert_allclose(error.absolute_variance(np.array([age]))[0], e.var(axis=0), rtol=0.05)
        e = e + error.walk_std * rng.normal(size=e.shape)
    motion = np.array([[0.0, 0.0, 0.0], [40.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    still, moving, near = error.step_variance(motion, np.array([0.0, 0.0, 0.1]))
    np.testing.assert_allclose(still, error.walk_std**2)
    np.testing.assert_allclose(moving, np.array([2.0, 1.35, 1.35]) * error.walk_std**2)
    np.testing.assert_allclose(near, 5.0 * error.walk_std**2)


@pytest.mark.slow
def test_innovations_of_tracks_are_as_large_as_stated():
    """Errors that walk slowly, taken for white ones of the same size, look too small in every frame."""
    nis = {"tracks": [], "white": []}
    for seed in range(4):
        world = small_world(seed=seed, frames=40, sigma_v=0.02, sigma_w=0.002)
        world = with_noise(world, track_first_px=np.full(3, 0.8), track_walk_px=np.full(3, 0.25))
        world = tracked(world, world.noise.track_error, seed)
        white = with_noise(world, track_first_px=None, track_walk_px=None)
        for name, sequence in (("tracks", world), ("white", white)):
            innovation = run(sequence, "full", Config(filter=STILL)).innovation
            nis[name].append(innovation.nis.sum() / innovation.dof.sum())
    assert 0.95 < np.mean(nis["tracks"]) < 1.05
    assert np.mean(nis["white"]) < 0.6


@pytest.mark.slow
def test_landmarks_whose_tracks_err_are_as_uncertain_as_they_are_wrong():
    """What stays along a track no number of frames averages out; taken for white it makes the map overconfident."""
    squares = {"tracks": [], "white": []}
    for seed in range(6):
        world = small_world(seed=seed, frames=40, sigma_v=0.02, sigma_w=0.002)
        world = with_noise(world, track_first_px=np.full(3, 0.8), track_walk_px=np.full(3, 0.05))
        world = tracked(world, world.noise.track_error, seed)
        white = with_noise(world, track_first_px=None, track_walk_px=None)
        for name, sequence in (("tracks", world), ("white", white)):
            rig = Rig(sequence.camera, sequence.T_cam_imu, sequence.noise)
            ekf, _, _ = run_joint(sequence, rig, dataclasses.replace(STILL, retire="never"), covariance=1e-12 * P0)
            at = np.searchsorted(np.sort(world.truth.landmark), ekf.ids)
            error = world.truth.position_m[np.argsort(world.truth.landmark)][at] - ekf.positions_m
            P = ekf.gaussian.landmark_blocks()
            squares[name].extend(np.einsum("ni,ni->n", error, np.linalg.solve(P, error[..., None])[..., 0]) / 3)
    assert 0.8 < np.mean(squares["tracks"]) < 1.3
    assert np.mean(squares["white"]) > 3


def test_drift_scales_how_errors_of_tracks_walk():
    stated = small_world(frames=5).noise
    assert with_drift(stated, 0.0).track_error is None
    found = with_drift(stated, 0.4)
    np.testing.assert_allclose(found.track_walk_px, 5 * TRACK_WALK_PX)
    assert found.track_first_px is not None
    np.testing.assert_array_equal(found.pixel_std_px, stated.pixel_std_px)
    # What else is known of tracks stays.
    given = dataclasses.replace(stated, **TRACKS)
    np.testing.assert_array_equal(with_drift(given, 0.4).track_first_px, TRACKS["track_first_px"])
    assert with_drift(given, 0.0).track_error is None


@pytest.mark.slow
def test_the_whole_noise_is_stored(tmp_path):
    world = without_noise(builtin("city?frames=20"))
    result = run(world, "full")
    write_archive(tmp_path / "a.h5", world, {"full": result})
    read = open_result(tmp_path / "a.h5", "full").noise
    for name, value in vars(result.noise).items():
        np.testing.assert_array_equal(getattr(read, name), value)
    stated = dataclasses.replace(world, noise=result.noise)
    write_sequence(stated, tmp_path / "s.h5")
    for name, value in vars(open_sequence(tmp_path / "s.h5").noise).items():
        np.testing.assert_array_equal(value, getattr(result.noise, name))


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["standard", "fej"])
def test_the_posterior_of_what_walks_is_the_filter_as_filtered(variant):
    world = without_noise(tracked(builtin(f"city?frames={60 if WHOLE else 20}"), ERROR))
    settings = dataclasses.replace(STILL, variant=variant, retire="never")
    result = run(world, "full", Config(filter=settings))
    assert result.noise.track_error is not None and result.noise.twist_walk_std is not None
    assert smooth(result).mode == "smoothed"
    found = posterior(result, PosteriorConfig(linearisation="filtered"))
    np.testing.assert_allclose(found.T_world_imu[-1], result.T_world_imu[-1], atol=1e-8)
    np.testing.assert_allclose(
        found.pose_covariance[-1], result.covariance[-1], atol=1e-8 * result.covariance[-1].max()
    )
    np.testing.assert_allclose(found.position_m, result.landmarks.position_m, atol=1e-7)
    np.testing.assert_allclose(found.landmark_covariance, result.landmarks.covariance, rtol=1e-6, atol=1e-7)


def test_observations_are_worth_what_is_known_of_the_error_of_their_track():
    world = with_noise(with_gaps(small_world(frames=15)), **{**TRACKS, "track_parallax": np.inf})
    log = run(world, "full", Config(filter=dataclasses.replace(STILL, retire="never"))).log
    first, last, kinds = {}, {}, [0, 0, 0]
    for i, (k, j) in enumerate(zip(log.frame.tolist(), log.landmark.tolist(), strict=True)):
        k0 = first.setdefault(j, k)
        follows = j in last and log.frame[last[j]] == k - 1
        assert log.previous[i] == (last[j] if follows else -1)
        if follows:
            expected = (0.2**2, 0.25**2, 0.3**2) * grown(log.rows[i] - log.rows[last[j]], 40.0)
        else:
            expected = np.array([0.3**2, 0.4**2, 0.8**2])
            for _ in range(k0, k):
                expected = expected + np.array([0.2, 0.25, 0.3]) ** 2
        np.testing.assert_allclose(log.variance[i], expected, rtol=1e-9)
        kinds[0 if k == k0 else 1 + follows] += 1
        last[j] = i
    assert min(kinds) > 10
