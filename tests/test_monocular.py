"""Recordings of one camera: their tracks, their scale, and the velocity of a rig that stands."""

import functools
from dataclasses import replace

import numpy as np
import pytest
from support.frozen import assert_equal_to_frozen_rows

import ekfslam
from ekfslam.config import FilterConfig
from ekfslam.data.room import CAMERA, Room, simulate_room
from ekfslam.data.sequence import Observations, of_left_camera
from ekfslam.errors import CalibrationError, ConfigError, ScaleError, ShapeError
from ekfslam.evaluation.inertial import inertial_nees
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import run_filter
from ekfslam.filters.standing import STILL_PX, moved_px
from ekfslam.geometry import se3
from ekfslam.geometry.camera import T_CAM_BODY, StereoCamera
from ekfslam.inertial.bearings import by_bearings
from ekfslam.models.blocks import AccelBias, GyroBias, Velocity
from ekfslam.models.build import model_of
from ekfslam.models.inertial_start import FirstPrior
from ekfslam.models.process.inertial import inertial
from ekfslam.models.sensors.monocular import Monocular
from ekfslam.resolve import resolve

ONE = StereoCamera(400.0, 410.0, 320.0, 240.0)


@functools.cache
def room(frames=40, seed=2, **changes):
    return simulate_room(Room(frames=frames, seed=seed, cameras=1, **changes))


def tracks(columns=2, **inputs):
    """A recording from dense arrays: 5 frames, 9 tracks."""
    pixels = np.random.default_rng(0).uniform(10.0, 400.0, (5, 9, columns))
    pixels[2, 3] = np.nan
    return ekfslam.Sequence.from_tracks(np.arange(5.0), pixels, ONE, **inputs)


def test_tracks_of_one_camera_have_two_columns():
    sequence = tracks()
    ids, pixels = sequence.observations.at(2)
    assert sequence.camera.is_monocular and pixels.shape == (8, 2) and 3 not in ids


def test_tracks_with_three_columns_are_refused():
    with pytest.raises(ShapeError, match="pixels_px"):
        tracks(columns=3)


def test_tracks_of_two_cameras_need_a_baseline():
    with pytest.raises(CalibrationError, match="baseline"):
        tracks(columns=4)


def test_one_camera_is_written_and_read_to_the_same_bits(tmp_path):
    ekfslam.write_sequence(room(), tmp_path / "one.h5")
    found = ekfslam.open_sequence(tmp_path / "one.h5")
    assert found.camera.is_monocular and found.camera == room().camera
    np.testing.assert_array_equal(found.observations.pixels_px, room().observations.pixels_px)


def test_the_left_camera_of_a_rig_is_a_recording_of_one_camera():
    rig = simulate_room(Room(frames=20))
    left = of_left_camera(rig)
    np.testing.assert_array_equal(left.observations.pixels_px, rig.observations.pixels_px[:, :2])
    assert left.camera == replace(CAMERA, baseline_m=0.0) and left.inertial is rig.inertial


@pytest.mark.parametrize("inputs", [{}, {"twist": np.zeros((5, 6)), "T_cam_imu": np.eye(4)}])
def test_one_camera_alone_does_not_tell_the_scale(inputs):
    with pytest.raises(ScaleError, match="scale"):
        ekfslam.run(tracks(**inputs))


def test_a_run_of_one_camera_from_rest_finds_the_scale_in_both_filters():
    results = []
    for engine in ("engine", "reference"):
        config = ekfslam.Config().with_overrides({"filter": {"engine": engine}})
        results.append(ekfslam.run(room(100), config=config))
    found, true = (
        T[:, :3, 3] - T[:, :3, 3].mean(axis=0) for T in (results[0].T_world_imu, room(100).truth.T_world_imu)
    )
    assert np.linalg.norm(found) / np.linalg.norm(true) == pytest.approx(1.0, abs=0.01)
    assert results[0].counts["frames at rest"] >= 2
    np.testing.assert_allclose(results[0].T_world_imu, results[1].T_world_imu, atol=1e-8)


def test_one_camera_has_no_map_without_its_poses():
    with pytest.raises(ConfigError, match="depths"):
        ekfslam.run(room(), "mapping-only")


def test_a_recording_is_opened_as_its_left_camera_sees_it():
    assert ekfslam.open_sequence("builtin:room?frames=20", camera="left").camera.is_monocular
    with pytest.raises(ConfigError, match="--camera"):
        ekfslam.open_sequence("builtin:room", camera="right")


def test_a_room_has_one_camera_or_two():
    with pytest.raises(ConfigError, match="cameras"):
        Room(cameras=3)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_one_camera_in_motion_from_the_first_frame_on_is_honest(seed):
    sequence = room(160, seed, max_range_m=10.0)[60:]
    result = ekfslam.run(sequence, config=ekfslam.Config().with_overrides({"filter": {"engine": "auto"}}))
    assert "in motion, from one camera" in result.attributes["inertial_start"]
    found = inertial_nees(result, sequence.truth)["all"]
    assert np.nanmedian(found[20:]) < 30.0 and np.nanmax(found[1:]) < 60.0
    p, q = (T[:, :3, 3] - T[:, :3, 3].mean(axis=0) for T in (result.T_world_imu, sequence.truth.T_world_imu))
    assert np.linalg.norm(p) / np.linalg.norm(q) == pytest.approx(1.0, abs=0.03)


@pytest.mark.slow
def test_velocity_gravity_and_gyroscope_bias_follow_from_tracks_of_one_camera_though_some_err():
    sequence = simulate_room(Room(frames=90, seed=7, cameras=1, max_range_m=10.0, sigma_px=0.2))[60:]
    o, rng = sequence.observations, np.random.default_rng(0)
    error_px = 5.0 * rng.standard_normal(o.pixels_px.shape) * (rng.random((len(o.frame), 1)) < 0.02)
    sequence = replace(sequence, observations=replace(o, pixels_px=o.pixels_px + error_px))
    truth = sequence.truth
    R = truth.T_world_imu[0, :3, :3]
    found = by_bearings(sequence, 30, 0.2, FirstPrior(np.eye(4), 0.0, 0.0, 0.05, 0.1, 9.81))
    np.testing.assert_allclose(found.velocity_m_s, R.T @ truth.motion.velocity_m_s[0], atol=0.05)
    np.testing.assert_allclose(found.gyro_bias_rad_s, truth.motion.gyro_bias_rad_s[0], atol=2e-3)
    assert found.up @ R[2] > np.cos(np.deg2rad(1.0))


def test_one_camera_in_motion_with_few_tracks_is_refused():
    sequence = room(100)[60:]
    o = sequence.observations
    few = np.isin(o.landmark, o.at(0)[0][:5])
    few = Observations(o.frame[few], o.landmark[few], o.pixels_px[few])
    with pytest.raises(ScaleError, match=r"only \d tracks .* begin at rest"):
        ekfslam.run(replace(sequence, observations=few))


@pytest.mark.slow
def test_a_start_in_motion_whose_tracks_the_filter_does_not_accept_is_refused():
    """Two axes of the accelerometer point backwards: the few observations that are left fit a wrong start well."""
    sequence = room(100, 1, max_range_m=10.0)[60:84]
    wrong = replace(sequence.inertial, accel_m_s2=sequence.inertial.accel_m_s2 * [-1.0, -1.0, 1.0])
    config = ekfslam.Config().with_overrides({"inertial": vars(wrong.noise)})
    with pytest.raises(ScaleError, match="of the last observations fit"):
        ekfslam.run(replace(sequence, inputs=(wrong,)), config=config)


# --- errors of tracks that walk ---------------------------------------------------------------------------------------


def walking(sequence, step_px=0.2, seed=0):
    """The recording with errors of tracks that walk, and without a statement of its noise."""
    o, rng = sequence.observations, np.random.default_rng(seed)
    steps = step_px * rng.normal(size=(len(sequence), len(o.ids), 2))
    error = np.cumsum(steps, axis=0)[o.frame, np.searchsorted(o.ids, o.landmark)]
    return replace(sequence, observations=replace(o, pixels_px=o.pixels_px + error), noise=None)


def test_errors_of_tracks_that_walk_are_the_same_in_both_filters():
    results = []
    for engine in ("engine", "reference"):
        config = ekfslam.Config().with_overrides({"filter": {"engine": engine}, "noise": {"drift": 0.2}})
        config = config.with_overrides({"inertial": vars(DENSITIES)})
        results.append(ekfslam.run(walking(room(60, sigma_px=0.05)), config=config))
    one, other = results
    assert one.noise.track_walk_px is not None and one.counts["accepted"] > 100
    np.testing.assert_allclose(one.T_world_imu, other.T_world_imu, atol=1e-8)
    np.testing.assert_allclose(one.covariance, other.covariance, atol=1e-10)


@pytest.mark.parametrize("engine", ["engine", "reference"])
def test_a_first_depth_has_the_error_that_both_views_of_a_track_share(engine):
    noise = replace(
        ekfslam.Noise.isotropic(1e-7, 1e-7, 1.0),
        track_first_px=np.full(3, 0.3),
        track_walk_px=np.full(3, 0.5),
        track_flow_px=20.0,
    )
    sensor = Monocular(ONE, T_CAM_BODY, noise)
    config = FilterConfig(gate_probability=1.0, engine=engine)
    ekf = JointEKF(model_of(sensor, noise, np.eye(4), 1e-14 * np.eye(6)), config)
    points = np.array([[4.0, 0.3, 0.2], [5.0, -0.8, 0.1], [4.5, 0.5, -0.4]])  # ahead, left, up
    cameras = [T_CAM_BODY @ se3.inverse(se3.transform(np.eye(3), np.array([0.0, 0.1 * k, 0.0]))) for k in range(4)]
    views = [sensor.predict(se3.apply(W, points)) for W in cameras]
    for k, rows in enumerate(views):
        if k:
            ekf.predict(np.array([0.0, 0.1, 0.0, 0.0, 0.0, 0.0]), 1.0)
        ekf.update(k, np.arange(3), rows)
        if len(ekf.ids):
            break
    assert k > 1 and len(ekf.ids) == 3
    found = ekf.landmarks()
    for i, at in zip(ekf.ids, found.position_m, strict=True):
        J = np.vstack([sensor.jacobian(se3.apply(W, at[None]))[0] @ W[:3, :3] for W in (cameras[0], cameras[k])])
        square = ((views[k] - views[0])[i] / k) ** 2
        step = k * 0.25 * (1.0 + (0.65 * square + 0.35 * square.sum()) / 400.0)
        V = np.block([[0.09 * np.eye(2), 0.09 * np.eye(2)], [0.09 * np.eye(2), 0.09 * np.eye(2) + np.diag(step)]])
        expected = np.linalg.inv(J.T @ np.linalg.inv(V) @ J)
        np.testing.assert_allclose(found.covariance[list(ekf.ids).index(i)], expected, rtol=1e-3, atol=1e-9)


# --- standing still ---------------------------------------------------------------------------------------------------


def spread(count=40, seed=0):
    return np.random.default_rng(seed).uniform((0.0, 0.0), (752.0, 480.0), (count, 2))


def test_noise_of_tracks_is_no_motion():
    found = [moved_px(spread(), spread() + np.random.default_rng(k).normal(size=(40, 2))) for k in range(50)]
    assert np.mean(np.array(found) < STILL_PX) > 0.8


@pytest.mark.parametrize("grows", [np.eye(2), np.array([[0.0, -1.0], [1.0, 0.0]])])
def test_driving_ahead_and_rolling_are_motions_though_shifts_cancel(grows):
    before = spread()
    assert moved_px(before, before + 0.005 * (before - before.mean(axis=0)) @ grows) > STILL_PX


def test_traffic_before_resting_tracks_is_no_motion():
    before = spread()
    now = before + np.where(np.arange(40)[:, None] < 14, [6.0, 1.0], 0.0)
    assert moved_px(before, now) < STILL_PX


DENSITIES = ekfslam.InertialNoise(1.7e-4, 2e-3, 2e-5, 3e-3)


def filmed(speed_m_s=0.0, depth_m=5.0, turning_rad_s=0.0, traffic=0, frames=40, panned=False):
    """A recording of a level camera that moves to its right, at 20 Hz, before points at a depth of 90 to 110 %.

    The gyroscope turns to the left, and the images if they are panned. Points of the traffic drive by.
    """
    rng, time_s = np.random.default_rng(0), 0.05 * np.arange(frames)
    y, x = rng.uniform(-0.4, 0.4, (2, 40)) * depth_m
    z = depth_m * rng.uniform(0.9, 1.1, 40)
    x = x - speed_m_s * time_s[:, None] + np.where(np.arange(40) < traffic, 2.0 * time_s[:, None], 0.0)
    angle = panned * turning_rad_s * time_s[:, None]
    x, z = np.cos(angle) * x + np.sin(angle) * z, np.cos(angle) * z - np.sin(angle) * x
    pixels = np.stack([320.0 + 400.0 * x / z, 240.0 + 410.0 * y / z], axis=-1)
    stamps = 0.005 * np.arange(-4, 10 * frames + 4)
    turn, up = (np.tile([0.0, 0.0, rate], (len(stamps), 1)) for rate in (turning_rad_s, 9.81))
    imu = ekfslam.InertialSamples(stamps, turn, up, DENSITIES)
    return ekfslam.Sequence.from_tracks(
        time_s, pixels + 0.3 * rng.normal(size=pixels.shape), ONE, imu=imu, T_cam_imu=T_CAM_BODY
    )


def outcome(sequence, first_m_s=(0.0, 0.0, 0.0), gyro_bias_std=1e-3):
    """Numbers of frames at rest and of contradicted ones, and the last velocity with its standard deviation."""
    noise = ekfslam.Noise.isotropic(0.1, 0.1, 0.5)
    sensor = Monocular(sequence.camera, sequence.T_cam_imu, noise)
    blocks = Velocity(first_m_s=np.array(first_m_s)), GyroBias(std_rad_s=gyro_bias_std), AccelBias()
    first = np.eye(4), np.diag([1e-6] * 3 + [1e-4] * 3)
    ekf = JointEKF(model_of(sensor, noise, *first, None, blocks, make_process=inertial(DENSITIES)), FilterConfig())
    standing = [frame.report.standing for frame in run_filter(ekf, sequence)]
    at = ekf.model.layout["velocity"]
    std = np.sqrt(np.diag(ekf.gaussian.body_covariance)[at])
    return standing.count(True), standing.count(False), ekf.values["velocity"], std


def test_a_camera_at_rest_has_no_velocity():
    at_rest, contradicted, velocity, std = outcome(filmed())
    assert at_rest > 25 and contradicted == 0
    assert np.abs(velocity).max() < 0.01 and std.max() < 0.05


def test_traffic_does_not_hide_that_a_camera_rests():
    assert outcome(filmed(traffic=14))[0] > 15


@pytest.mark.parametrize(("speed_m_s", "depth_m"), [(0.05, 2.0), (0.05, 8.0), (0.05, 20.0), (0.2, 30.0)])
def test_a_slow_camera_is_not_taken_for_one_at_rest(speed_m_s, depth_m):
    at_rest, _, velocity, std = outcome(filmed(speed_m_s, depth_m, frames=60))
    assert at_rest == 0 or np.abs(velocity[1] + speed_m_s) < 3.0 * std[1]


def test_a_gyroscope_that_turns_contradicts_images_at_rest():
    assert outcome(filmed(turning_rad_s=0.05))[0] == 0


@pytest.mark.parametrize("turning_rad_s", [0.02, -0.02])
def test_a_camera_that_pans_as_its_gyroscope_says_is_at_rest(turning_rad_s):
    at_rest, contradicted, velocity, _ = outcome(filmed(turning_rad_s=turning_rad_s, panned=True), gyro_bias_std=1e-5)
    assert at_rest > 25 and contradicted == 0 and np.abs(velocity).max() < 0.01


def test_a_camera_that_surely_moves_is_not_stopped_by_a_scene_that_moves_along():
    at_rest, contradicted, velocity, _ = outcome(filmed(), (3.0, 0.0, 0.0))
    assert at_rest == 0 and contradicted > 25 and velocity[0] > 2.5


def test_rows_of_a_rest_are_those_of_the_posterior():
    config = FilterConfig(retire="never", landmark_coordinates="xyz", variant="standard")
    sequence = simulate_room(Room(frames=60, seed=2, sigma_px=0.3))[:30]
    ekf = JointEKF(resolve(sequence, ekfslam.Config(filter=config)).model, config)
    standing = [frame.report.standing for frame in run_filter(ekf, sequence)]
    assert standing.count(True) > 2 and len(ekf.ids) > 10
    assert_equal_to_frozen_rows(ekf)
