"""Recordings without velocities: the twist walks unmeasured, and covariances hold what they promise."""

import dataclasses

import numpy as np
import pytest
from scipy.stats import chi2
from support.reference import CAMERA, T_CAM_IMU
from support.running import seeds

import ekfslam
from ekfslam.config import Config
from ekfslam.data.interval import Interval
from ekfslam.data.noise import Noise
from ekfslam.data.sequence import CHECKED_TRACKS, WITHOUT_VELOCITIES, YAW_STD_PX, Observations
from ekfslam.errors import NoVelocitiesError
from ekfslam.evaluation.consistency import pose_nees
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import run_filter
from ekfslam.geometry import motion, se3
from ekfslam.geometry.camera import project
from ekfslam.models.odometry import stereo_odometry, vision_noise
from ekfslam.models.sensors.velocities import VelocitySource
from ekfslam.resolve import resolve
from ekfslam.runner import run
from ekfslam.smoother.posterior import smooth


def with_observations(sequence, kept):
    parts = (getattr(sequence.observations, name)[kept] for name in ("frame", "landmark", "pixels_px"))
    return dataclasses.replace(sequence, observations=Observations(*parts))


def without_velocities(sequence):
    return dataclasses.replace(
        sequence, twist=np.zeros_like(sequence.twist), attributes={**sequence.attributes, **WITHOUT_VELOCITIES}
    )


@pytest.mark.slow
def test_covariances_hold_what_they_promise():
    """Pose NEES in the middle and at the end of 40 frames, averaged over seeds, against chi-square bounds of 99.8 %.

    The truth's velocities change as a vehicle's do; that they walk is only the model.
    """
    runs = seeds(12, 4)
    per_run = []
    for seed in runs:
        sequence = ekfslam.open_sequence(f"builtin:city?seed={seed}&frames=40&outlier_fraction=0")
        full = run(without_velocities(sequence), "full")
        found = [pose_nees(result, sequence.truth)[1] for result in (full, smooth(full))]
        per_run.append([[nees[20], nees[39]] for nees in found])
    low, high = (chi2.ppf(p, 6 * len(runs)) / len(runs) for p in (0.001, 0.999))
    mean = np.mean(per_run, axis=0)
    assert (mean > low).all() and (mean < high).all(), (low, mean, high)


@pytest.mark.slow
def test_odometry_follows_the_truth_and_survives_frames_without_tracks():
    sequence = ekfslam.open_sequence("builtin:city?frames=40")
    twist = stereo_odometry(sequence)
    T = se3.inverse(motion.integrate(np.eye(4), twist, np.diff(sequence.time_s)))
    assert np.linalg.norm(T[-1][:3, 3] - sequence.truth.T_world_imu[-1][:3, 3]) < 0.5
    seen = ~np.isin(sequence.observations.frame, (10, 11))
    gappy = dataclasses.replace(
        sequence,
        observations=Observations(
            sequence.observations.frame[seen],
            sequence.observations.landmark[seen],
            sequence.observations.pixels_px[seen],
        ),
    )
    found = stereo_odometry(gappy)
    np.testing.assert_array_equal(found[10:13], np.tile(found[9], (3, 1)))
    np.testing.assert_array_equal(found[:10], twist[:10])


def test_one_motion_that_no_vehicle_has_is_left_out():
    """A first frame whose tracks are of other points must not start the twist."""
    sequence = ekfslam.open_sequence("builtin:city?frames=20&outlier_fraction=0")
    observations, rng = sequence.observations, np.random.default_rng(0)
    pixels = observations.pixels_px.copy()
    wrong = observations.frame == 0
    pixels[wrong, 2] = pixels[wrong, 0] - rng.uniform(2.0, 3.0, wrong.sum())
    spoiled = dataclasses.replace(sequence, observations=dataclasses.replace(observations, pixels_px=pixels))
    found, true = stereo_odometry(spoiled), sequence.twist
    assert np.abs(found[1, :3] - true[1, :3]).max() < 2.0
    # An alignment stops at steps below 1e-4 m, in .1 s: it ends elsewhere by up to 1e-3 m/s from other starts.
    np.testing.assert_allclose(found[3:], stereo_odometry(sequence)[3:], atol=1e-3)


def moved(twist, step_s=0.1):
    """Recording of a rig that moves with velocities (T, 6) among points ahead, seen without noise."""
    T_imu_world = motion.integrate(np.eye(4), twist, np.full(len(twist) - 1, step_s))
    points = np.random.default_rng(0).uniform([8.0, -6.0, -2.0], [25.0, 6.0, 3.0], (40, 3))
    pixels = project(CAMERA, se3.apply(T_CAM_IMU @ T_imu_world[:, None], points))
    stamps = step_s * np.arange(len(twist))
    return ekfslam.Sequence.from_tracks(stamps, pixels, CAMERA, T_cam_imu=T_CAM_IMU)


@pytest.mark.parametrize(
    ("column", "size", "frames", "stays"),
    [
        (0, 0.4, 1, True),
        (0, 0.6, 1, False),
        (2, -0.6, 2, False),
        (2, -0.6, 3, True),
        (5, 0.04, 1, True),
        (5, 0.06, 1, False),
    ],
)
def test_odometry_drops_jumps_of_ten_times_the_walk_for_at_most_two_frames(column, size, frames, stays):
    steady = np.tile([1.0, 0.0, 0.0, 0.0, 0.0, 0.0], (14, 1))
    jumping = steady.copy()
    jumping[6 : 6 + frames, column] += size
    np.testing.assert_allclose(stereo_odometry(moved(jumping)), jumping if stays else steady, atol=1e-4)


def test_odometry_says_how_far_velocities_walk():
    twist = np.zeros((8, 6))
    twist[1:, 0] = np.cumsum([0.0, 0.1, 0.1, 0.2, -0.2, 0.1, 0.1])
    twist[1:, 1] = twist[1:, 2] = twist[1:, 0]
    noise = vision_noise(dataclasses.replace(Noise.isotropic(0.3, 0.03, 0.7), tilt_rad=0.1), twist)
    walk = np.repeat([3.0 * 1.4826 * 0.1, 0.005], 3)
    np.testing.assert_allclose(noise.twist_walk_std, walk)
    np.testing.assert_allclose(noise.twist_std, 10.0 * walk)
    np.testing.assert_array_equal(noise.pixel_std_px, 0.7)
    assert noise.tilt_rad == 0.0 and not noise.gap_std.any()
    assert (noise.motion_std < 1e-5).all()


def test_velocities_are_started_once_and_never_measured():
    sequence = without_velocities(ekfslam.open_sequence("builtin:city?frames=12&outlier_fraction=0"))
    problem = resolve(sequence)
    assert problem.model.process.measured(Interval.of_one(np.ones(6), 0.1), is_first=False) is None
    assert "twist (6)" in problem.lines[0]
    ekf = JointEKF(problem.model, problem.config.filter)
    list(run_filter(ekf, problem.sequence))
    log = ekf.log()
    assert set(log.measured_frame.tolist()) == {1} and len(log.measured_axis) == 6
    # What is said of the first velocities is next to nothing beside what the observations say.
    at = problem.model.layout["twist"]
    assert (np.sqrt(np.diag(ekf.gaussian.body_covariance)[at]) < 0.2 * problem.model.noise.twist_std).all()


@pytest.mark.slow
def test_wheels_are_measured_where_nothing_else_is():
    world = ekfslam.open_sequence("builtin:city?frames=30&outlier_fraction=0")
    sequence = without_velocities(with_observations(world, world.observations.frame < 15))
    speed = world.twist[:, :1]
    wheels = VelocitySource(world.time_s, ("v_x",), speed, np.array([0.05]))
    with_wheels, without = run(sequence, "full", further=wheels), run(sequence, "full")
    # They measure the speed ahead, and little of the other two.
    gain = np.diag(with_wheels.covariance[-1])[:3] / np.diag(without.covariance[-1])[:3]
    assert gain[0] < 0.1 and (gain[1:] > 0.5).all(), gain


@pytest.mark.slow
def test_dead_reckoning_is_left_out_of_a_comparison(tmp_path):
    sequence = without_velocities(ekfslam.open_sequence("builtin:city?frames=8"))
    found = ekfslam.compare(sequence)
    assert set(found.results) == {"mapping-only", "full", "smoothed"}
    assert "no measured velocities" in found.skipped["dead-reckoning"]
    assert "No dead-reckoning: " in found.table
    with pytest.raises(NoVelocitiesError):
        run(sequence, "dead-reckoning")
    ekfslam.write_archive(tmp_path / "archive.h5", sequence, found.results)
    again = ekfslam.read_archive(tmp_path / "archive.h5").results["full"]
    queried = ekfslam.posterior(again)
    direct = ekfslam.posterior(found.results["full"])
    np.testing.assert_allclose(queried.T_world_imu, direct.T_world_imu, atol=1e-9)


@pytest.mark.slow
def test_without_stated_noise_tracks_decide_what_is_believed():
    sequence = dataclasses.replace(ekfslam.open_sequence("builtin:city?frames=20"), noise=None)
    walking = resolve(without_velocities(sequence), Config().with_overrides({"noise": {"track_scale": 1.0}}))
    names = set(walking.model.layout)
    assert {"twist", "vision_drift", "camera_jitter"} <= names
    assert not {"twist_bias", "up", "calibration"} & names
    checked = without_velocities(dataclasses.replace(sequence, attributes={**sequence.attributes, **CHECKED_TRACKS}))
    problem = resolve(checked)
    assert problem.model.track_error.parallax < 1 and problem.config.noise.track_scale is None
    assert problem.config.filter.split_after == 3 and walking.config.filter.split_after is None
    assert not {"camera_jitter", "vision_drift", "calibration"} & set(problem.model.layout)
    given = resolve(checked, Config().with_overrides({"noise": {"sigma_px": 0.6}}))
    assert given.model.track_error is None and given.model.noise.pixel_std_px[0] == 0.6


def test_the_disparity_offset_is_as_uncertain_as_the_yaw_that_the_front_end_states():
    sequence = dataclasses.replace(ekfslam.open_sequence("builtin:city?frames=5"), noise=None)
    attributes = {**sequence.attributes, **CHECKED_TRACKS, YAW_STD_PX: 0.17}
    checked = without_velocities(dataclasses.replace(sequence, attributes=attributes))
    free = resolve(checked).model.layout.block("calibration")
    assert free.labels == ("disparity offset",) and free.std[7] == 0.17
    given = resolve(checked, Config().with_overrides({"calibration": {"disparity_px": 0.0}}))
    assert "calibration" not in given.model.layout
