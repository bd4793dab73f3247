"""Calibration in the joint filter's state: Jacobians, recovery in simulation, what no motion shows, bad input."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from support.helpers import run_joint
from support.jacobians import POSES, TWISTS, see, visible_points
from support.literal import OPEN, recorded, seen_rows, sighted, stencil
from support.reference import CAMERA, T_CAM_IMU, small_world
from support.same import assert_same

from ekfslam.cli import main
from ekfslam.config import CalibrationConfig, Config, PosteriorConfig
from ekfslam.data.sequence import Noise, Observations
from ekfslam.data.simulate import builtin
from ekfslam.errors import ConfigError
from ekfslam.filters.joint import JointEKF
from ekfslam.geometry import se3
from ekfslam.models.blocks import Pose
from ekfslam.models.blocks import calibration as cal
from ekfslam.models.build import model_of
from ekfslam.models.model import Model
from ekfslam.models.observation import linearise
from ekfslam.models.observer import Moment
from ekfslam.models.sensors.stereo import Rig
from ekfslam.runner import run
from ekfslam.smoother.posterior import posterior, posterior_of_log, smooth
from ekfslam.storage.archive import open_result, write_archive

RIG = Rig(CAMERA, T_CAM_IMU, Noise(np.full(6, 0.1), np.array([0.7, 0.9, 1.1, 0.9])))
ALL = cal.Calibration(np.ones(9))
SOME = CalibrationConfig(rotation_deg=0.5, lever_arm_m=0.2, baseline=0.02, disparity_px=0.5)
C = np.array([0.1, -0.2, 0.15, 0.05, -0.08, 0.06, 0.1, 0.7, 0.15])
TWIST = TWISTS[3]
poses = pytest.mark.parametrize("T", POSES.values(), ids=POSES.keys())
parameters = pytest.mark.parametrize("c", [np.zeros(9), C, -C], ids=["none", "some", "others"])


def linearised(T, c, m, linear):
    """Points, rows by pose and parameters (n, 3, 15), rows by landmarks."""
    seen = see(observer_of(T, ALL), Moment(T, T, c, TWIST), m, linear)
    return seen.q, seen.H_x, seen.H_m


def observer_of(T, block):
    return Model(RIG, RIG.noise, (Pose(T, np.eye(6)), block)).observer


def points(T, c):
    """World points in front of the camera as it is with parameters c."""
    before = se3.exp(-c[8] * TWIST) @ T
    return visible_points(se3.inverse(T_CAM_IMU) @ se3.exp(c[:6]) @ T_CAM_IMU @ before)


@poses
def test_without_parameters_it_is_the_sensor_as_given(T):
    m = visible_points(T)
    q, H, H_m = linearised(T, np.zeros(9), m, m)
    for ours, theirs in zip((q, H[..., :6], H_m), linearise(RIG, T, m, T, m), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-10)


@parameters
@poses
def test_new_landmarks_with_parameters(T, c):
    z = seen_rows(T, c, TWIST, points(T, c)) + np.array([0.5, -0.2, 0.3])
    observer = observer_of(T, ALL)
    camera, q = observer.camera(Moment(T, T, c, TWIST)), observer.inverted(c, z)[0]
    W = camera.T_cam_imu @ T
    positions, G, covariance = observer.initialise(c, W, W, camera.by, q, RIG.variance(z))
    np.testing.assert_allclose(positions, sighted(T, c, TWIST, z), rtol=1e-9, atol=1e-9)
    _, H, H_m = linearised(T, c, positions, positions)
    V = np.diag(RIG.variance_px2)
    root = np.random.default_rng(2).normal(size=(15, 15)) * np.repeat([0.1, 0.01, 0.1, 0.01, 0.02], [3, 3, 3, 3, 3])
    P = root.T @ root + 1e-6 * np.eye(15)
    for i, row in enumerate(z):
        by_both = stencil(lambda e, row=row: sighted(se3.exp(e[..., :6]) @ T, c + e[..., 6:], TWIST, row), 15)
        np.testing.assert_allclose(G[i], by_both, rtol=1e-6, atol=1e-5 * np.abs(by_both).max())
        by_row = stencil(lambda d, row=row: sighted(T, c, TWIST, row + d), 3)
        np.testing.assert_allclose(covariance[i], by_row @ V @ by_row.T, rtol=1e-6, atol=1e-9)
        # Conditioning on the same rows a landmark of which nothing is known, in information form.
        wide = np.hstack([H[i], H_m[i]])
        information = wide.T @ np.linalg.solve(V, wide)
        information[:15, :15] += np.linalg.inv(P)
        diffuse = np.linalg.inv(information)
        GP = G[i] @ P
        expected = np.block([[P, GP.T], [GP, GP @ G[i].T + covariance[i]]])
        np.testing.assert_allclose(diffuse, expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max())


@poses
def test_a_camera_and_its_first_estimates_moved_as_one_look_the_same(T):
    """While the rig stands its extrinsics cannot be seen, wherever landmarks have moved since their first estimates."""
    first = visible_points(T)
    m = first + np.array([0.2, -0.1, 0.3])
    _, H_first, H_m_first = linearised(T, np.zeros(9), first, first)
    along = -np.linalg.solve(H_m_first, H_first[..., 6:12])
    _, H, H_m = linearised(T, np.zeros(9), m, first)
    np.testing.assert_allclose(H[..., 6:12] + H_m @ along, 0, atol=1e-8 * np.abs(H).max())


def test_priors_are_in_the_order_of_the_names():
    config = CalibrationConfig(rotation_deg=180 / np.pi, lever_arm_m=2.0, baseline=3.0, disparity_px=4.0, time_s=5.0)
    np.testing.assert_allclose(cal.prior_std(config), [2, 2, 2, 1, 1, 1, 3, 4, 5])
    assert len(cal.NAMES) == len(cal.UNITS) == 9
    by_name = dict(zip(cal.NAMES, cal.prior_std(config), strict=True))
    assert by_name["ln baseline"] == 3
    assert by_name["disparity offset"] == 4
    assert by_name["time offset"] == 5
    assert not cal.prior_std(CalibrationConfig()).any()


# --- recovery -------------------------------------------------------------------------------------------------------


def estimated(world, calibration, variant="invariant"):
    """Free parameters and their covariance after the last frame."""
    config = dataclasses.replace(OPEN, variant=variant, retire="unseen", retire_after=1)
    ekf, _, _ = run_joint(world, Rig(world.camera, world.T_cam_imu, world.noise), config, calibration)
    at = ekf.model.layout["calibration"]
    return ekf.values["calibration"][ekf.model.observer.calibration.free], ekf.P[at, at]


DRIVE = "city?frames={}&outlier_fraction=0&max_tracks=12&sigma_v_m_s={}&sigma_w_rad_s={}"
HALF_DEGREE = np.deg2rad(0.5)
TURNED = HALF_DEGREE * np.array([1, -1, 1])
CASES = {
    # What is estimated, where it stands, the truth, and which of it a drive through a town must show.
    "baseline": (CalibrationConfig(baseline=0.02), [6], [0.02], [True]),
    "rotation": (CalibrationConfig(rotation_deg=0.5), [3, 4, 5], TURNED, [True, True, False]),
    "lever arm": (CalibrationConfig(lever_arm_m=1.0), [0, 1, 2], [0.3, -0.3, 0.3], [True, False, True]),
    "disparity": (CalibrationConfig(disparity_px=0.5), [7], [0.3], [True]),
    "time": (CalibrationConfig(time_s=0.02), [8], [0.02], [True]),
}


@pytest.mark.parametrize(
    ("case", "variant"), [*((case, "invariant") for case in CASES), ("rotation", "fej")], ids=lambda value: value
)
def test_each_error_of_the_calibration_is_found(case, variant):
    """Velocities are precise: a time offset is seen in their changes, which noise must not hide."""
    calibration, at, values, is_seen = CASES[case]
    c = np.zeros(9)
    c[at] = values
    world = recorded(builtin(DRIVE.format(80, 0.01, 0.0005)), c, np.random.default_rng(1))
    found, covariance = estimated(world, calibration, variant)
    std = np.sqrt(np.diag(covariance))
    share = std / cal.prior_std(calibration)[at]
    assert (np.abs(found - values) < 3 * std).all()
    assert (share[np.array(is_seen)] < 1 / 3).all()
    assert (share <= 1 + 1e-9).all()


@pytest.mark.slow
def test_deviations_of_the_calibration_are_what_they_say():
    """Normalised errors of ten drives, the truth drawn from the prior, velocities of ordinary noise."""
    calibration = CalibrationConfig(rotation_deg=0.5, lever_arm_m=0.2, baseline=0.02, disparity_px=0.5)
    squares = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        c = cal.prior_std(calibration) * rng.normal(size=9)
        world = recorded(builtin(DRIVE.format(40, 0.1, 0.005) + f"&seed={seed}"), c, rng)
        found, covariance = estimated(world, calibration)
        error = found - c[:8]
        squares.append([error @ np.linalg.solve(covariance, error) / 8, *(error**2 / np.diag(covariance))])
    # 10 drives of 8 parameters: 1 +- 0.16; single parameters 1 +- 0.45.
    assert 0.5 < np.mean(squares, axis=0)[0] < 1.6
    assert (np.mean(squares, axis=0) < 3).all()


def test_a_time_offset_counts_by_the_corrected_velocity():
    """The measured one is wrong by 1 m/s; the images correct most of that before they tell of the offset."""
    world = small_world(frames=2)
    ekf = JointEKF(
        Rig(world.camera, world.T_cam_imu, Noise(np.ones(6), np.full(4, 0.3))),
        OPEN,
        world.initial_T_world_imu,
        calibration=CalibrationConfig(time_s=0.02),
    )
    ekf.begin(world.twist[0])
    ekf.update(0, *world.observations.at(0))
    ekf.predict(world.twist[1] + [1, 0, 0, 0, 0, 0], float(np.diff(world.time_s)[0]))
    assert np.abs(ekf.imu_twist - world.twist[1]).max() > 0.9
    ekf.update(1, *world.observations.at(1))
    assert np.abs(ekf.log().seen_twist[1] - world.twist[1]).max() < 0.5


@pytest.mark.slow
def test_noise_of_the_velocities_does_not_hide_a_time_offset():
    """With measured velocities in its Jacobian the offset comes out 14 deviations too small here."""
    calibration, error = CalibrationConfig(time_s=0.02), []
    for seed in range(4):
        c = np.zeros(9)
        c[8] = 0.02
        world = recorded(builtin(DRIVE.format(80, 0.1, 0.005) + f"&seed={seed}"), c, np.random.default_rng(seed))
        found, covariance = estimated(world, calibration)
        error.append((found[0] - 0.02) / np.sqrt(covariance[0, 0]))
    assert np.sqrt(np.mean(np.square(error))) < 2


def test_only_a_stereo_rig_can_be_calibrated():
    world = small_world()
    sensor, T = SimpleNamespace(noise=world.noise), world.initial_T_world_imu
    with pytest.raises(ConfigError, match="only a stereo rig"):
        JointEKF(sensor, OPEN, T, calibration=CalibrationConfig(time_s=0.02))


@pytest.mark.slow
def test_straight_driving_shows_neither_lever_arm_nor_time_offset():
    """The whole map moves along with either; also a camera's roll about the way is no different from the world's."""
    world = small_world(frames=40, sigma_v=0.0, sigma_w=0.0)
    time_s = world.time_s
    path = np.tile(np.eye(4), (len(time_s), 1, 1))
    path[:, 0, 3] = 6.0 * (time_s - time_s[0])
    rng = np.random.default_rng(5)
    place = np.column_stack([rng.uniform(8, 20, 30), rng.uniform(-5, 5, 30), rng.uniform(-2, 3, 30)])
    frame, landmark = (part.ravel() for part in np.indices((len(time_s), len(place))))
    truth = dataclasses.replace(world.truth, T_world_imu=path, landmark=np.arange(len(place)), position_m=place)
    q = se3.apply((world.T_cam_imu @ se3.inverse(path))[frame], place[landmark])
    ahead = q[:, 2] > 2
    observations = Observations(frame[ahead], landmark[ahead], np.ones((ahead.sum(), 4)))
    noise = Noise(np.repeat([0.1, 1e-7], 3), np.full(4, 0.8))
    world = dataclasses.replace(world, truth=truth, observations=observations, noise=noise)
    world = recorded(world, np.zeros(9), rng)
    world = dataclasses.replace(world, twist=np.tile([6.0, 0, 0, 0, 0, 0], (len(time_s), 1)))
    found, covariance = estimated(world, CalibrationConfig(lever_arm_m=0.1))
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), 0.1, rtol=1e-3)
    assert (np.abs(found) < 1e-3).all()
    # A time offset counts by velocities as seen, which are not even where the true ones are: that tells a little.
    found, covariance = estimated(world, CalibrationConfig(time_s=0.02))
    assert 0.75 * 0.02 < np.sqrt(covariance[0, 0]) <= 0.02
    assert np.abs(found[0]) < np.sqrt(covariance[0, 0])
    calibration = CalibrationConfig(rotation_deg=0.5)
    _, covariance = estimated(world, calibration)
    along = world.T_cam_imu[:3, :3] @ np.array([1.0, 0, 0])
    assert along @ covariance @ along > 0.99 * HALF_DEGREE**2
    assert np.sort(np.linalg.eigvalsh(covariance))[1] < 0.2 * HALF_DEGREE**2


# --- the rest -------------------------------------------------------------------------------------------------------


def test_nothing_free_is_the_filter_without_calibration():
    world = small_world(frames=20)
    rig = Rig(world.camera, world.T_cam_imu, world.noise)
    ekf, _, _ = run_joint(world, rig, OPEN, CalibrationConfig())
    assert len(ekf.P) == 6 + 3 * len(ekf.ids)
    assert list(ekf.values) == ["pose"]
    assert ekf.parameters() is None
    np.testing.assert_array_equal(ekf.P, run_joint(world, rig, OPEN)[0].P)


@pytest.mark.parametrize("calibrated", [SOME, CalibrationConfig(time_s=0.02)], ids=["all but time", "time"])
def test_parameters_that_are_not_free_stay_as_given(calibrated):
    """The free ones are the columns, in the order of the names; the value is always all nine."""
    free = np.flatnonzero(cal.prior_std(calibrated))
    block, m = cal.Calibration(cal.prior_std(calibrated)), points(np.eye(4), np.zeros(9))
    assert block.size == len(free)
    np.testing.assert_allclose(block.retract(C, np.ones(len(free))) - C, np.isin(np.arange(9), free), atol=1e-15)
    moment = Moment(np.eye(4), np.eye(4), C, TWIST)
    ours, theirs = (see(observer_of(np.eye(4), own), moment, m, m).H_x for own in (block, ALL))
    np.testing.assert_array_equal(ours, theirs[..., np.concatenate([np.arange(6), 6 + free])])


@pytest.mark.parametrize("name", ["rotation_deg", "lever_arm_m", "baseline", "disparity_px", "time_s"])
@pytest.mark.parametrize("value", [-0.1, np.nan, np.inf])
def test_bad_priors_are_refused(name, value):
    with pytest.raises(ConfigError, match=rf"calibration\.{name} must be finite and not negative"):
        Config().with_overrides({"calibration": {name: value}})


def test_velocities_of_the_first_frame_count_for_its_exposure():
    """Without them landmarks of the first frame would say that there is no time offset."""
    world = small_world(frames=2)
    rig = Rig(world.camera, world.T_cam_imu, world.noise)
    ekf = JointEKF(rig, OPEN, world.initial_T_world_imu, calibration=CalibrationConfig(time_s=0.02))
    ekf.begin(world.twist[0])
    ekf.update(0, *world.observations.at(0))
    cross = ekf.P[7:, 6].reshape(-1, 3) / 0.02**2
    expected = (
        world.initial_T_world_imu[:3, :3]
        @ (world.twist[0, :3] + np.cross(world.twist[0, 3:], se3.apply(ekf.T_imu_world, ekf.positions_m)))[..., None]
    )
    np.testing.assert_allclose(cross, expected[..., 0], rtol=1e-9)


@pytest.mark.slow
def test_what_was_found_is_kept_printed_and_used_by_the_posterior(tmp_path, capsys):
    world = recorded(
        builtin(DRIVE.format(60, 0.02, 0.001)), np.array([0, 0, 0, 0, 0, 0, 0.05, 0, 0]), np.random.default_rng(2)
    )
    config = Config(calibration=CalibrationConfig(baseline=0.1, disparity_px=0.3))
    result = run(world, "full", config)
    found = result.parameters
    assert (found.name, found.unit) == (("ln baseline", "disparity offset"), ("1", "px"))
    np.testing.assert_array_equal(found.prior_std, [0.1, 0.3])
    assert found.value.shape == found.std.shape == (60, 2)
    assert (found.std[0] <= found.prior_std).all()
    assert found.is_observed[0]
    write_archive(tmp_path / "a.h5", world, {"full": result})
    assert_same(open_result(tmp_path / "a.h5", "full").parameters, found)
    assert main(["info", str(tmp_path / "a.h5")]) == 0
    assert (
        f"full: ln baseline: {found.value[-1, 0]:.3g} +- {found.std[-1, 0]:.2g} (before: 0 +- 0.1)"
        in capsys.readouterr().out
    )
    # The posterior estimates it, too: with the calibration as given all would fit far worse.
    smoothed = posterior(result)
    noise, log = result.noise, result.log
    rig = Rig(world.camera, world.T_cam_imu, noise)
    as_given = model_of(rig, noise, log.T_predicted[0], log.initial_covariance[:6, :6])
    of_pose = dataclasses.replace(log, initial_covariance=log.initial_covariance[:6, :6])
    assert smoothed.cost < 0.9 * posterior_of_log(of_pose, as_given, result.landmarks.position_m).cost
    std = np.sqrt(np.diag(smoothed.block_covariance("calibration")))
    assert abs(smoothed.values["calibration"][6] - 0.05) < 3 * std[0]
    assert (std < 1.1 * found.std[-1]).all()


@pytest.mark.parametrize("variant", ["standard", "fej"])
def test_as_filtered_is_the_filter_also_with_a_time_offset(variant):
    c = np.array([0.05, -0.05, 0.05, *TURNED, 0.01, 0.3, 0.02])
    world = recorded(builtin(DRIVE.format(40, 0.02, 0.001)), c, np.random.default_rng(2))
    calibration = dataclasses.replace(SOME, time_s=0.02)
    settings = dataclasses.replace(OPEN, variant=variant)
    result = run(world, "full", Config(filter=settings, calibration=calibration))
    found = posterior(result, PosteriorConfig(linearisation="filtered"))
    np.testing.assert_allclose(found.T_world_imu[-1], result.T_world_imu[-1], atol=1e-8)
    np.testing.assert_allclose(found.position_m, result.landmarks.position_m, atol=1e-8)
    np.testing.assert_allclose(found.values["calibration"], result.parameters.value[-1], atol=1e-8)
    std = np.sqrt(np.diag(found.block_covariance("calibration")))
    np.testing.assert_allclose(std, result.parameters.std[-1], rtol=1e-8)
    assert smooth(result, PosteriorConfig(linearisation="filtered"), found).mode == "as filtered"
    # There is a maximum a posteriori, too, and the truth is within its deviations.
    best = posterior(result)
    error = best.values["calibration"] - c
    std = np.sqrt(np.diag(best.block_covariance("calibration")))
    assert (np.abs(error) < 4 * std).all()
    assert std[8] < 0.02 / 2
