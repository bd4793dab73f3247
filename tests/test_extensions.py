"""What was added to the house to show that it can be: a bias of velocities, wheels beside the IMU, one camera alone."""

import dataclasses

import numpy as np
import pytest
from support.jacobians import central
from support.reference import CAMERA, T_CAM_IMU
from support.running import WHOLE, seeds

from ekfslam.config import FilterConfig, PosteriorConfig
from ekfslam.data.noise import Noise
from ekfslam.data.sequence import Observations, Sequence, Truth
from ekfslam.data.simulate import builtin
from ekfslam.errors import ConfigError, PosteriorError
from ekfslam.evaluation.consistency import chi2_bounds, nees, pose_error
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import one_thread, run_filter
from ekfslam.geometry import camera, motion, se3
from ekfslam.models.blocks import TwistBias, VisionDrift
from ekfslam.models.build import model_of
from ekfslam.models.sensors.monocular import Monocular
from ekfslam.models.sensors.stereo import Rig
from ekfslam.models.sensors.velocities import VelocitySource
from ekfslam.runner import run
from ekfslam.smoother.posterior import posterior_of_log

OPEN = FilterConfig(landmark_coordinates="xyz", gate_probability=1.0, split_after=0, retire="never")
SMOOTHED = PosteriorConfig(kernel="none")
NOISE = Noise(np.repeat([0.2, 0.02], 3), np.full(4, 0.5), motion_std=np.full(6, 1e-3))
WALK = np.array([0.2, 0.05, 0.05, 0.01, 0.01, 0.02])
BIAS = TwistBias(sigma_v_m_s=0.3, sigma_w_rad_s=0.02, time_v_s=5.0, time_w_s=8.0)


def walking_world(rng, bias=None, frames=100 if WHOLE else 50):
    """A drive whose true velocities walk, past landmarks about its path; also the true velocities and biases (T, 6)."""
    twist = np.array([6.0, 0, 0, 0, 0, 0.3]) + np.cumsum(WALK * rng.standard_normal((frames, 6)), axis=0)
    time_s, offset = 0.1 * np.arange(frames), np.zeros((frames, 6))
    if bias is not None:
        phi, std = bias.transition(0.1, 0.0)
        offset[0] = np.sqrt(np.diag(bias.prior_covariance())) * rng.standard_normal(6)
        for k in range(1, frames):
            offset[k] = phi * offset[k - 1] + std * rng.standard_normal(6)
    T_imu_world = motion.integrate(np.eye(4), twist, np.diff(time_s))
    T_world_imu = se3.inverse(T_imu_world)
    many = 3 * frames // 2
    anchor = rng.integers(0, frames, many)
    points = se3.apply(T_world_imu[anchor], rng.uniform([6, -6, -2], [25, 6, 4], (many, 3)))
    q = se3.apply((T_CAM_IMU @ T_imu_world)[:, None], points)
    pixels = camera.project(CAMERA, np.where(q[..., 2:] > 1, q, 1.0))
    inside = (q[..., 2] > 3) & (q[..., 2] < 30) & (np.abs(pixels[..., :2] - [600, 180]) < [600, 300]).all(axis=-1)
    frame, landmark = np.nonzero(inside)
    seen = pixels[frame, landmark] + NOISE.pixel_std_px * rng.standard_normal((len(frame), 4))
    sequence = Sequence(
        name="walking",
        source="tests",
        time_s=time_s,
        twist=twist + offset + NOISE.twist_std * rng.standard_normal((frames, 6)),
        camera=CAMERA,
        T_cam_imu=T_CAM_IMU,
        observations=Observations(frame, landmark, seen),
        truth=Truth(np.arange(frames), T_world_imu),
        noise=dataclasses.replace(NOISE, twist_walk_std=WALK),
    )
    return sequence, twist, offset


def filtered(sequence, sensor, config=OPEN, further=None, **options):
    """The filter as it ended, and its pose NEES (T-1,)."""
    ekf = JointEKF(sensor, config, sequence.initial_T_world_imu, **options)
    T, P = [], []
    with one_thread():
        for _ in run_filter(ekf, sequence, further=further):
            T.append(ekf.T_world_imu)
            P.append(ekf.P[:6, :6].copy())
    return ekf, nees(pose_error(np.array(T), sequence.truth.T_world_imu)[1:], np.array(P)[1:])


def drive(sequence, sensor, config=OPEN, further=None, **options):
    """As `filtered`, and the smoothed posterior with its pose NEES."""
    ekf, of_filter = filtered(sequence, sensor, config, further, **options)
    with one_thread():
        smoothed = posterior_of_log(ekf.log(), ekf.model, ekf.landmarks().position_m, SMOOTHED)
    behind = nees(pose_error(smoothed.T_world_imu, sequence.truth.T_world_imu)[1:], smoothed.pose_covariance[1:])
    return ekf, of_filter, smoothed, behind


@pytest.mark.slow
@pytest.mark.parametrize("with_twist", [True, False], ids=["twist in the state", "white"])
def test_a_bias_of_the_velocities_is_found_consistently(with_twist):
    """20 drives: NEES of the pose and of the bias, by filter and smoother; expected is 6 each."""
    found = {name: [] for name in ("filter", "smoother", "bias", "smoothed bias")}
    for seed in (drives := seeds(20, 6)):
        sequence, _, offset = walking_world(np.random.default_rng(seed), BIAS)
        noise = sequence.noise if with_twist else NOISE
        ekf, of_filter, smoothed, behind = drive(sequence, Rig(CAMERA, T_CAM_IMU, noise), blocks=[BIAS])
        at = ekf.model.layout["twist_bias"]
        found["filter"].append(of_filter.mean())
        found["smoother"].append(behind.mean())
        found["bias"].append(nees(offset[-1:] - ekf.values["twist_bias"], ekf.P[at, at][None])[0])
        middle = len(sequence) // 2
        error = offset[middle] - smoothed.values["twist_bias"][middle]
        found["smoothed bias"].append(nees(error[None], smoothed.block_covariance("twist_bias")[middle][None])[0])
        # It says more than its prior did.
        std = np.sqrt(np.diag(smoothed.block_covariance("twist_bias")[middle]))
        assert (std < 0.8 * np.sqrt(np.diag(BIAS.prior_covariance()))).all()
    means = {name: np.mean(values) for name, values in found.items()}
    # Four means at once, each over as many samples as drives: along a drive NEES hardly averages out.
    low, high = chi2_bounds(6, 0.999, len(drives))
    assert all(low < value < high for value in means.values()), means


@pytest.mark.slow
def test_without_its_block_a_bias_spoils_the_covariance():
    with_block, without = [], []
    bias = TwistBias(0.6, 0.05, 50.0, 50.0)
    for seed in range(4):
        sequence, _, _ = walking_world(np.random.default_rng(seed), bias, frames=100)
        rig = Rig(CAMERA, T_CAM_IMU, NOISE)
        with_block.append(filtered(sequence, rig, blocks=[bias])[1].mean())
        without.append(filtered(sequence, rig)[1].mean())
    assert np.mean(without) > 2 * np.mean(with_block)


def wheels_of(sequence, twist, rng, period_s=0.04):
    """Forward speed and yaw rate at a rate of their own, with the noise that they state."""
    time_s = np.arange(0.01, sequence.time_s[-1], period_s)
    interval = np.searchsorted(sequence.time_s, time_s)  # (t[k-1], t[k]] has number k
    std = np.array([0.05, 0.005])
    value = twist[interval][:, [0, 5]] + std * rng.standard_normal((len(time_s), 2))
    return VelocitySource(time_s, ("v_x", "w_z"), value, std)


@pytest.mark.slow
def test_wheels_beside_an_imu_help_and_stay_consistent():
    before, behind, variance = [], [], {"with": [], "without": []}
    for seed in (drives := seeds(20, 6)):
        rng = np.random.default_rng(seed)
        sequence, twist, _ = walking_world(rng)
        sequence = dataclasses.replace(
            sequence,
            observations=Observations(*(part[::3] for part in vars(sequence.observations).values())),
        )
        rig = Rig(CAMERA, T_CAM_IMU, sequence.noise)
        ekf, of_filter, _, of_smoother = drive(sequence, rig, further=wheels_of(sequence, twist, rng))
        assert np.unique(ekf.log().measured_axis[~ekf.log().measured_is_biased]).tolist() == [0, 5]
        before.append(of_filter.mean())
        behind.append(of_smoother.mean())
        variance["with"].append(np.trace(ekf.P[:6, :6]))
        variance["without"].append(np.trace(filtered(sequence, rig)[0].P[:6, :6]))
    low, high = chi2_bounds(6, 0.95, len(drives))
    assert low < np.mean(before) < high
    assert low < np.mean(behind) < high
    assert np.mean(variance["with"]) < 0.8 * np.mean(variance["without"])


def test_wheels_belong_to_a_filter_that_estimates_velocities():
    rng = np.random.default_rng(0)
    sequence, twist, _ = walking_world(rng, frames=20)
    wheels = wheels_of(sequence, twist, rng)
    white = dataclasses.replace(sequence, noise=NOISE)
    with pytest.raises(ConfigError, match="need the twist in the state"):
        run(white, "full", further=wheels)
    assert wheels.during(0.0, 0.009) is None
    rows = wheels.during(0.0, 0.1)
    assert rows.axis.tolist() == [0, 5] * 3
    # A stamp at the end of an interval belongs to it, one at its beginning to the interval before.
    assert wheels.during(wheels.time_s[0], wheels.time_s[2]).value.tolist() == wheels.value[1:3].ravel().tolist()
    for change, words in (
        ({"axes": ("v_x", "yaw")}, "must be among"),
        ({"std": np.array([0.05, 0.0])}, "must be positive"),
        ({"time_s": wheels.time_s[::-1]}, "ascending"),
        ({"value": wheels.value[:, :1]}, "shape"),
    ):
        with pytest.raises(ConfigError, match=words):
            dataclasses.replace(wheels, **change)


@pytest.mark.slow
def test_one_camera_maps_consistently():
    """12 drives through the city with the left camera alone: scale comes from the velocities."""
    before, behind, error = [], [], {"camera": [], "reckoned": []}
    for seed in (drives := seeds(12, 5)):
        world = builtin(f"city?frames={100 if WHOLE else 60}&seed={seed}&outlier_fraction=0")
        sensor = Monocular(world.camera, world.T_cam_imu, world.noise, parallax_rad=0.2)
        ekf, of_filter, smoothed, of_smoother = drive(world, sensor, FilterConfig(retire="unseen", retire_after=1))
        assert len(ekf.landmarks()) > 20
        before.append(of_filter.mean())
        behind.append(of_smoother.mean())
        truth = world.truth.T_world_imu[:, :3, 3]
        reckoned = run(world, "dead-reckoning").T_world_imu
        error["camera"].append(np.linalg.norm(smoothed.T_world_imu[:, :3, 3] - truth, axis=1).mean())
        error["reckoned"].append(np.linalg.norm(reckoned[:, :3, 3] - truth, axis=1).mean())
    low, high = chi2_bounds(6, 0.95, len(drives))
    assert low < np.mean(before) < high
    assert low < np.mean(behind) < high
    assert np.median(error["camera"]) < 0.5 * np.median(error["reckoned"])


def test_tracks_that_wait_are_listed_and_start_with_both_views():
    world = builtin("city?frames=60&outlier_fraction=0")
    sensor = Monocular(world.camera, world.T_cam_imu, world.noise, parallax_rad=0.2)
    ekf = JointEKF(sensor, OPEN, world.initial_T_world_imu)
    reasons = np.concatenate([frame.report.reason for frame in run_filter(ekf, world)])
    log = ekf.log()
    assert (reasons == 5).sum() > 100
    assert (reasons == -1).sum() == log.observations - log.landmarks  # the view from the anchor was reported as waiting
    with pytest.raises(PosteriorError, match="waited"):
        posterior_of_log(log, ekf.model, ekf.landmarks().position_m, PosteriorConfig(linearisation="filtered"))


def test_one_camera_with_tracks_that_wait_may_have_a_bias_of_its_velocities_but_no_drift_of_its_views():
    world = builtin("city?frames=2")
    sensor = Monocular(world.camera, world.T_cam_imu, world.noise, parallax_rad=0.2)
    first = se3.inverse(world.initial_T_world_imu), np.eye(6)
    assert "twist_bias" in model_of(sensor, world.noise, *first, blocks=[TwistBias()]).layout
    with pytest.raises(ConfigError, match="vision_drift: not with landmarks that wait"):
        model_of(sensor, world.noise, *first, blocks=[VisionDrift()])


def test_a_bias_keeps_its_size():
    phi, std = BIAS.transition(np.array([0.1, 3.0]), np.zeros(2))
    variance = np.diag(BIAS.prior_covariance())
    np.testing.assert_allclose(phi**2 * variance + std**2, np.broadcast_to(variance, (2, 6)))
    np.testing.assert_allclose(phi[1], np.exp(-3.0 / np.repeat([5.0, 8.0], 3)))


@pytest.mark.parametrize("with_twist", [True, False])
def test_velocities_by_every_block_against_central_differences(with_twist):
    noise = dataclasses.replace(NOISE, twist_walk_std=WALK if with_twist else None, tilt_rad=0.05)
    T = se3.exp(np.array([1.0, -2.0, 0.5, 0.3, -0.4, 0.8]))
    model = model_of(Rig(CAMERA, T_CAM_IMU, noise), noise, T, np.eye(6), None, [BIAS])
    rng, measured = np.random.default_rng(0), np.array([6.0, 0.1, 0.2, 0.02, -0.03, 0.3])
    values = model.retract(model.initial_values(), 0.1 * rng.normal(size=model.layout.body))
    _, by = model.process.imu_velocities(values, measured, values["pose"][:3, :3])
    numeric = central(
        lambda x: model.process.imu_velocities(model.retract(values, x), measured, T[:3, :3])[0], model.layout.body
    )
    np.testing.assert_allclose(by, numeric, atol=1e-8)
    assert np.abs(by[:, model.layout["twist_bias"]]).max() > 0.5 or with_twist


@pytest.mark.parametrize("tracks_err", [True, False])
def test_rows_by_an_error_of_the_disparity(tracks_err):
    noise = dataclasses.replace(NOISE, track_first_px=np.ones(3), track_walk_px=np.ones(3)) if tracks_err else NOISE
    rig, q = Rig(CAMERA, T_CAM_IMU, noise), np.array([[1.0, -0.5, 8.0], [-3.0, 1.0, 20.0]])
    moved = dataclasses.replace(rig, disparity_offset_px=0.3)
    np.testing.assert_allclose(moved.predict(q) - rig.predict(q), 0.3 * rig.by_disparity(q), atol=1e-12)
    np.testing.assert_allclose(moved.invert(moved.predict(q)), q, atol=1e-9)
