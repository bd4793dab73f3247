"""The simulated worlds: exact truth, stated noise, and tracks that look like a tracker's."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial import cKDTree
from support.jacobians import hat

from ekfslam.data.sequence import Sequence
from ekfslam.data.simulate import BUILTIN, CAMERA, GROUND_M, IMAGE_SIZE_PX, T_CAM_IMU, builtin, simulate
from ekfslam.data.worlds import BORDER_PX, OUTLIER_SHIFT_PX, View, outlier_shifts
from ekfslam.errors import ConfigError, UnknownFormatError
from ekfslam.geometry import motion, se3
from ekfslam.geometry.camera import project

CITY, LOOP = BUILTIN["city"], BUILTIN["loop"]


@pytest.fixture(scope="module")
def city() -> Sequence:
    return builtin("city")


@pytest.fixture(scope="module")
def loop() -> Sequence:
    return builtin("loop")


@pytest.fixture(params=["city", "loop"])
def sequence(request: pytest.FixtureRequest) -> Sequence:
    return request.getfixturevalue(request.param)


def points_in_camera(sequence: Sequence) -> np.ndarray:
    """True position (K, 3) of every observed landmark in the camera that observed it."""
    truth, observations = sequence.truth, sequence.observations
    points = truth.position_m[np.searchsorted(truth.landmark, observations.landmark)]
    T_world_imu = truth.T_world_imu[np.searchsorted(truth.frame, observations.frame)]
    return se3.apply(sequence.T_cam_imu, se3.apply(se3.inverse(T_world_imu), points))


def residuals(sequence: Sequence) -> tuple[np.ndarray, np.ndarray]:
    """Pixel residuals (K, 4) at the truth, and which of them (K,) no white noise could have made."""
    r = sequence.observations.pixels_px - project(sequence.camera, points_in_camera(sequence))
    return r, np.abs(r).max(axis=-1) > 5.5 * sequence.noise.pixel_std_px[0]


def true_twist(sequence: Sequence) -> np.ndarray:
    """The velocity (T-1, 6) that takes each true pose into the next."""
    T = se3.inverse(sequence.truth.T_world_imu)
    return -se3.log(T[1:] @ se3.inverse(T[:-1])) / np.diff(sequence.time_s)[:, None]


def dead_reckoned_positions_m(sequence: Sequence) -> np.ndarray:
    """Positions (T, 3) from the measured velocities alone."""
    T = [se3.inverse(sequence.initial_T_world_imu)]
    for E in motion.increment(sequence.twist[1:], np.diff(sequence.time_s)):
        T.append(E @ T[-1])
    return se3.inverse(np.array(T))[:, :3, 3]


def runs_per_landmark(sequence: Sequence) -> np.ndarray:
    """Number of unbroken runs of frames of each landmark id."""
    o = sequence.observations
    order = np.lexsort((o.frame, o.landmark))
    frame, landmark = o.frame[order], o.landmark[order]
    breaks = (np.diff(landmark) == 0) & (np.diff(frame) > 1)
    return 1 + np.bincount(np.searchsorted(o.ids, landmark[1:][breaks]), minlength=len(o.ids))


def same_bits(a: Sequence, b: Sequence) -> bool:
    return all(
        np.array_equal(x, y)
        for x, y in [
            (a.time_s, b.time_s),
            (a.twist, b.twist),
            (a.observations.frame, b.observations.frame),
            (a.observations.landmark, b.observations.landmark),
            (a.observations.pixels_px, b.observations.pixels_px),
            (a.truth.T_world_imu, b.truth.T_world_imu),
            (a.truth.position_m, b.truth.position_m),
        ]
    )


@pytest.mark.parametrize("name", ["city", "loop"])
def test_same_seed_gives_the_same_bits(name, request):
    assert same_bits(request.getfixturevalue(name), builtin(name))


@pytest.mark.parametrize("name", ["city", "loop"])
def test_another_seed_gives_another_world(name, request):
    other, base = builtin(f"{name}?seed=1"), request.getfixturevalue(name)
    assert other.attributes["seed"] == 1
    assert not np.array_equal(other.truth.T_world_imu, base.truth.T_world_imu)
    assert not same_bits(other, base)


def test_own_generator_changes_the_noise_but_not_the_world(loop):
    a, b, again = (simulate(LOOP, np.random.default_rng(seed)) for seed in (5, 6, 5))
    for other in (b, loop):
        np.testing.assert_array_equal(a.time_s, other.time_s)
        np.testing.assert_array_equal(a.truth.T_world_imu, other.truth.T_world_imu)
        np.testing.assert_array_equal(a.truth.position_m, other.truth.position_m)
        assert not np.array_equal(a.twist, other.twist)
        assert not np.array_equal(a.observations.pixels_px, other.observations.pixels_px)
    assert same_bits(a, again)


@pytest.mark.parametrize("world", [CITY, LOOP], ids=["city", "loop"])
def test_truth_is_the_exact_integral_of_the_noise_free_velocities(world):
    exact = simulate(replace(world, sigma_v_m_s=0.0, sigma_w_rad_s=0.0))
    T = se3.inverse(exact.truth.T_world_imu)
    tau = np.diff(exact.time_s)
    E = expm(-tau[:, None, None] * hat(exact.twist[1:]))
    np.testing.assert_allclose(T[1:], E @ T[:-1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(dead_reckoned_positions_m(exact), exact.truth.T_world_imu[:, :3, 3], rtol=0, atol=1e-12)


def test_stamps_are_a_tenth_of_a_second_apart_with_jitter(sequence):
    tau = np.diff(sequence.time_s)
    assert tau.mean() == pytest.approx(0.1, abs=1e-4)
    assert 1e-3 < tau.std() < 2e-3
    assert tau.min() > 0.09


def test_pixels_at_the_truth_have_the_stated_noise_and_no_bias(sequence):
    r, outlier = residuals(sequence)
    r = r[~outlier]
    sigma = sequence.noise.pixel_std_px
    standard_error = sigma / np.sqrt(len(r))
    assert (np.abs(r.mean(axis=0)) < 4 * standard_error).all()
    assert (np.abs(r.std(axis=0) - sigma) < 4 * standard_error).all()
    correlation = np.corrcoef(r.T) - np.eye(4)
    assert np.abs(correlation).max() < 4 / np.sqrt(len(r))


def test_velocities_have_the_stated_noise(sequence):
    noise = sequence.twist[1:] - true_twist(sequence)
    sigma = sequence.noise.twist_std
    np.testing.assert_array_equal(sigma, [0.5, 0.5, 0.5, 0.05, 0.05, 0.05])
    assert (np.abs(noise.mean(axis=0)) < 4 * sigma / np.sqrt(len(noise))).all()
    assert (np.abs(noise.std(axis=0) - sigma) < 3 * sigma / np.sqrt(len(noise))).all()


def test_outliers_have_the_stated_share_and_stay_in_the_image(city):
    r, outlier = residuals(city)
    share, n = CITY.outlier_fraction, len(outlier)
    # The smallest jumps hide in the noise when they point along a diagonal: allow 2 % of them on top of the sampling.
    assert abs(outlier.mean() - share) < 4 * np.sqrt(share / n) + 0.02 * share
    size = np.hypot(r[outlier, 0], r[outlier, 1])
    assert np.median(size) == pytest.approx(np.mean(OUTLIER_SHIFT_PX), rel=0.1)
    # A jump has no preferred direction, and both rows jump together.
    assert np.abs(r[outlier, :2].mean(axis=0)).max() < 4 * r[outlier].std() / np.sqrt(outlier.sum())
    assert np.abs(r[outlier, 1] - r[outlier, 3]).max() < 6 * np.sqrt(2) * CITY.sigma_px
    z = city.observations.pixels_px[outlier]
    assert (z >= 0).all()
    assert (z <= np.tile(IMAGE_SIZE_PX, 2) - 1).all()
    assert (z[:, 0] > z[:, 2]).all()


def test_a_jump_never_leads_out_of_the_border_of_the_image():
    rng, (width, height) = np.random.default_rng(0), IMAGE_SIZE_PX
    low, high = BORDER_PX, np.array([width, height]) - 1 - BORDER_PX
    u, v = rng.uniform(low, high, (20_000, 2)).T
    pixels = np.stack([u, v, np.maximum(u - rng.uniform(1.0, 30.0, len(u)), low), v], axis=1)
    world = replace(CITY, outlier_fraction=1.0)
    shifted = pixels + outlier_shifts(world, View(CAMERA, IMAGE_SIZE_PX, T_CAM_IMU), pixels, rng)
    assert (shifted >= low).all()
    assert (shifted <= np.tile(high, 2)).all()


def test_loop_has_no_outliers(loop):
    assert not residuals(loop)[1].any()


@pytest.mark.parametrize("name", ["city", "loop"])
def test_landmarks_are_in_front_inside_the_image_and_near_enough(name, request):
    sequence = request.getfixturevalue(name)
    world = BUILTIN[name]
    q = points_in_camera(sequence)
    z = project(sequence.camera, q)
    assert q[:, 2].min() > 1.0
    assert np.linalg.norm(q, axis=-1).max() < world.max_range_m
    assert (z[:, 0] - z[:, 2]).min() > world.min_disparity_px
    assert (z >= 0).all()
    assert (z <= np.tile(IMAGE_SIZE_PX, 2) - 1).all()


def test_disparity_limit_alone_bounds_the_range():
    far = simulate(replace(CITY, frames=100, max_range_m=1000.0, min_disparity_px=10.0))
    z = project(far.camera, points_in_camera(far))
    assert 10.0 < (z[:, 0] - z[:, 2]).min() < 10.1


def test_visibility_finds_every_point_that_a_plain_loop_finds():
    world = replace(LOOP, frames=120)
    sequence = simulate(world)
    truth, seen = sequence.truth, sequence.observations
    for k in range(len(sequence)):
        T_cam_world = sequence.T_cam_imu @ se3.inverse(truth.T_world_imu[k])
        q = se3.apply(T_cam_world, truth.position_m)
        z = project(sequence.camera, q)
        inside = ((z > 5) & (z < np.tile(IMAGE_SIZE_PX, 2) - 6)).all(axis=-1)
        near = (np.linalg.norm(q, axis=-1) < world.max_range_m) & (z[:, 0] - z[:, 2] > world.min_disparity_px)
        np.testing.assert_array_equal(seen.at(k)[0], truth.landmark[inside & near & (q[:, 2] > 0)])


def test_city_shows_about_sixty_landmarks_a_frame(city):
    count = np.bincount(city.observations.frame, minlength=len(city))
    assert 55 <= count.mean() <= 65
    assert count.min() >= 15
    assert count.max() <= CITY.max_tracks


def test_city_tracks_never_come_back_and_have_the_length_of_klt_tracks(city):
    assert (runs_per_landmark(city) == 1).all()
    length = np.bincount(city.observations.landmark)
    assert (length > 0).all()
    assert 10 <= np.median(length) <= 30


def test_losses_cut_tracks(city):
    """Without losses a track ends where the landmark leaves the view: fewer and longer tracks."""
    no_loss = simulate(replace(CITY, loss_probability=0.0))
    assert len(no_loss.observations.ids) < 0.8 * len(city.observations.ids)


def test_loop_landmarks_come_back_with_their_ids(loop):
    assert len(loop.observations.ids) >= 90
    assert np.median(runs_per_landmark(loop)) == 3
    count = np.bincount(loop.observations.frame, minlength=len(loop))
    assert count.min() >= 8


def test_truth_covers_all_frames_and_exactly_the_observed_landmarks(sequence):
    np.testing.assert_array_equal(sequence.truth.frame, np.arange(len(sequence)))
    np.testing.assert_array_equal(sequence.truth.landmark, sequence.observations.ids)
    np.testing.assert_array_equal(sequence.truth.T_world_imu[0], np.eye(4))


def test_city_is_a_drive_with_turns_a_stop_and_no_plane(city):
    u = true_twist(city)
    tau = np.diff(city.time_s)
    assert abs(city.time_s[-1] - 100.0) < 1.0
    assert 600 < np.sum(np.linalg.norm(u[:, :3], axis=-1) * tau) < 800
    assert np.sum(np.abs(u[:, 5]) * tau) > 4 * np.pi / 2  # at least four right angles
    assert np.abs(u[np.abs(u[:, 0]) < 1e-9]).max() < 1e-9  # a vehicle that stands does not rock
    assert 1.0 < np.sum(tau[np.abs(u[:, 0]) < 1e-9]) < 10.0
    assert 9 < u[:, 0].max() < 13
    assert np.quantile(u[:, 0], 0.2) >= 4.9
    lateral_acceleration = np.abs(u[:, 0] * u[:, 5])
    assert lateral_acceleration.max() < 4.0
    assert (u[:, 1:5].std(axis=0) > 1e-3).all()
    assert np.ptp(city.truth.T_world_imu[:, 2, 3]) > 0.1


@pytest.mark.parametrize("seed", range(3))
def test_city_landmarks_line_the_road_and_are_not_on_it(seed):
    city = builtin(f"city?seed={seed}")
    path = city.truth.T_world_imu[:, :2, 3]
    points = np.unique(city.truth.position_m, axis=0)
    distance, _ = cKDTree(path).query(points[:, :2])
    assert distance.min() > 4.0
    assert np.quantile(distance, 0.95) < 20.5
    height = points[:, 2] - GROUND_M
    # The road itself rises and falls by a metre or two.
    assert height.min() > -2.0
    assert height.max() < 10.0


def test_city_ids_count_up_in_order_of_appearance(city):
    np.testing.assert_array_equal(city.observations.ids, np.arange(len(city.observations.ids)))
    _, first = np.unique(city.observations.landmark, return_index=True)
    assert (np.diff(first) > 0).all()


def test_loop_returns_to_its_start(loop):
    position = loop.truth.T_world_imu[:, :3, 3]
    per_loop = round(2 * np.pi * 20.0 / 8.0 / 0.1)
    assert np.linalg.norm(position[per_loop] - position[0]) < 1.0
    radius = np.linalg.norm(position[:, :2] - [0.0, 20.0], axis=-1)
    np.testing.assert_allclose(radius, 20.0, atol=0.5)
    assert position[:, 1].max() == pytest.approx(40.0, abs=0.5)  # turns left


@pytest.mark.parametrize("seed", range(3))
def test_dead_reckoning_drifts_in_city(seed):
    city = builtin(f"city?seed={seed}")
    error = dead_reckoned_positions_m(city) - city.truth.T_world_imu[:, :3, 3]
    assert np.sqrt(np.mean(np.sum(error**2, axis=-1))) > 10.0


def test_prior_moves_the_whole_truth_and_hides_the_first_pose(loop):
    world = replace(LOOP, initial_position_std_m=0.5, initial_rotation_std_rad=np.deg2rad(15.0))
    moved = simulate(world)
    np.testing.assert_array_equal(moved.truth.frame, np.arange(1, len(moved)))
    np.testing.assert_array_equal(moved.initial_T_world_imu, np.eye(4))
    shift = moved.truth.T_world_imu @ se3.inverse(loop.truth.T_world_imu[1:])
    assert np.linalg.norm(shift[0] - np.eye(4)) > 0.05
    np.testing.assert_allclose(shift, np.broadcast_to(shift[0], shift.shape), rtol=0, atol=1e-12)
    np.testing.assert_allclose(moved.truth.position_m, se3.apply(shift[0], loop.truth.position_m), rtol=0, atol=1e-12)
    # No measurement changes: the same generator draws the same noise around the same pixels.
    np.testing.assert_array_equal(moved.observations.landmark, loop.observations.landmark)
    np.testing.assert_allclose(moved.observations.pixels_px, loop.observations.pixels_px, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(moved.twist, loop.twist)


@pytest.mark.slow
def test_prior_has_the_stated_spread():
    world = replace(LOOP, frames=3, initial_position_std_m=0.5, initial_rotation_std_rad=0.1)
    rng = np.random.default_rng(0)
    nominal = simulate(replace(LOOP, frames=3)).truth.T_world_imu[1]
    # T_imu_world[0] = exp(xi^), and the whole truth moves along with it.
    xi = np.array([se3.log(nominal @ se3.inverse(simulate(world, rng).truth.T_world_imu[0])) for _ in range(300)])
    np.testing.assert_allclose(xi.std(axis=0) / np.repeat([0.5, 0.1], 3), 1.0, rtol=0, atol=4 / np.sqrt(2 * 300))


def test_attributes_tell_how_to_repeat_the_recording(sequence):
    attributes = dict(sequence.attributes)
    name = attributes.pop("world")
    assert same_bits(simulate(replace(BUILTIN[name], **attributes)), sequence)


def test_query_changes_parameters():
    short = builtin("city?seed=3&frames=50&sigma_px=0.25")
    assert len(short) == 50
    assert short.attributes["seed"] == 3
    assert short.noise.pixel_std_px[0] == 0.25
    assert same_bits(short, simulate(replace(CITY, seed=3, frames=50, sigma_px=0.25)))


def test_unknown_world_names_the_known_ones():
    with pytest.raises(UnknownFormatError, match=r"'vilage'.*city, loop"):
        builtin("vilage?seed=1")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("city?sed=1", "unknown parameter 'sed'.*seed"),
        ("city?radius_m=3", "unknown parameter 'radius_m'"),
        ("city?name=x", "unknown parameter 'name'"),
        ("city?frames=ten", "frames must be a number"),
        ("city?seed=", "seed must be a number"),
        ("city?frames=1", "frames must be at least 2"),
        ("loop?sigma_px=-1", "sigma_px must be finite and not negative"),
        ("loop?sigma_v_m_s=nan", "sigma_v_m_s must be finite"),
        ("loop?radius_m=0", "radius_m must be positive"),
        ("loop?radius_m=2&landmark_offset_m=3", "landmark_offset_m leaves no room .* at least 3.6"),
        ("city?outlier_fraction=1.5", r"outlier_fraction must be in \[0, 1\]"),
    ],
)
def test_bad_parameters_are_named(name, message):
    with pytest.raises(ConfigError, match=message):
        builtin(name)


def test_a_noise_realisation_of_a_loop_is_cheap():
    world = replace(LOOP, frames=150)
    best = min(_seconds(lambda: simulate(world, np.random.default_rng(1))) for _ in range(3))
    assert best < 0.15


def _seconds(function) -> float:
    start = time.perf_counter()
    function()
    return time.perf_counter() - start
