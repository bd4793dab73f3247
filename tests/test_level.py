"""Velocities of a level frame, with all else that may stand in the state: Jacobians, assembly, recovery, the gauge.

`Literal` is a textbook EKF of the whole state. Its Jacobians are differences of the model functions above it, which
share no formula with the package beyond `se3`.
"""

import dataclasses

import numpy as np
import pytest
from support.helpers import run_joint
from support.jacobians import POSES, TWISTS
from support.literal import (
    EVERYTHING,
    OPEN,
    P0,
    TILTED,
    TRACKS,
    Literal,
    X,
    Y,
    Z,
    difference,
    filter_of,
    gravity,
    in_imu,
    in_level_frame,
    level_axes,
    moved,
    recorded,
    rotated,
    side_by_side,
    stencil,
    with_noise,
)
from support.reference import CAMERA, T_CAM_IMU, small_world
from support.running import WHOLE

from ekfslam.config import CalibrationConfig, Config
from ekfslam.data.interval import Interval
from ekfslam.data.sequence import Noise
from ekfslam.data.simulate import builtin
from ekfslam.errors import DataError
from ekfslam.geometry import motion, se3
from ekfslam.models.blocks import TwistBias
from ekfslam.models.build import model_of
from ekfslam.models.sensors.stereo import Rig
from ekfslam.resolve import noise_of
from ekfslam.runner import run

SOME = CalibrationConfig(rotation_deg=0.5, disparity_px=0.5, time_s=0.02)
WALK = np.repeat([0.2, 0.02], 3)
BIAS = TwistBias(sigma_v_m_s=0.1, sigma_w_rad_s=0.01, time_v_s=3.0, time_w_s=7.0)
RNG = np.random.default_rng(11)
UPS = {
    "level": Z,
    "hardly tilted": se3.so3_exp(np.array([1e-9, -2e-9, 0])) @ Z,
    "roll 1 rad": se3.so3_exp(X) @ Z,
    "pitch 1 rad": se3.so3_exp(Y) @ Z,
    "pitch -1 rad": se3.so3_exp(-Y) @ Z,
    **{f"random {i}": se3.so3_exp(np.append(RNG.uniform(-0.7, 0.7, 2), 0)) @ Z for i in range(3)},
}
ups = pytest.mark.parametrize("up", UPS.values(), ids=UPS.keys())


@ups
def test_level_frame(up):
    R, Z_ = motion.level_frame(up)
    np.testing.assert_allclose(R, level_axes(up), atol=1e-14)
    turned = stencil(lambda phi: se3.so3_log(level_axes(se3.so3_exp(phi) @ up) @ R.T), 3)
    np.testing.assert_allclose(Z_, turned, atol=1e-10)
    np.testing.assert_allclose(Z_ @ up, 0, atol=1e-14)


@pytest.mark.parametrize("twist", TWISTS)
@ups
def test_level_velocities_in_the_frame_of_the_imu(up, twist):
    u, by_level, by_up = motion.imu_twist(twist, up)
    np.testing.assert_allclose(u, in_imu(twist, up), atol=1e-13)
    np.testing.assert_allclose(by_level, stencil(lambda d: in_imu(twist + d, up), 6), atol=1e-9)
    by_phi = stencil(lambda phi: in_imu(twist, se3.so3_exp(phi) @ up), 3)
    np.testing.assert_allclose(by_up, by_phi, atol=1e-8)


def test_turned_velocities():
    turned = stencil(lambda d: rotated(se3.so3_exp(d), TWISTS[2]), 3)
    np.testing.assert_allclose(motion.turned_by(TWISTS[2]), -turned, atol=1e-9)
    stack = np.array(TWISTS)
    np.testing.assert_array_equal(motion.turned_by(stack)[2], motion.turned_by(TWISTS[2]))


@pytest.mark.parametrize("walks", [True, False])
@pytest.mark.parametrize(("name", "T"), POSES.items(), ids=POSES.keys())
def test_transition_and_noise_of_everything(name, T, walks):
    """Phi and Q of pose, pose before, calibration, velocities, up and bias, from the one model of a step."""
    noise = Noise(
        np.repeat([0.3, 0.05], 3),
        np.ones(4),
        twist_walk_std=WALK if walks else None,
        motion_std=np.array([0.1, 0.2, 0.3, 0.04, 0.05, 0.06]) if walks else np.zeros(6),
        tilt_rad=0.1,
        **TRACKS,
    )
    number = list(POSES).index(name)
    up, twist, tau = list(UPS.values())[number % len(UPS)], TWISTS[2 + number % 3], 0.13
    model = model_of(Rig(CAMERA, T_CAM_IMU, noise), noise, T, P0, EVERYTHING, [BIAS])
    b, W = 0.1 * TWISTS[3], T[:3, :3].T @ level_axes(up)
    values = {**model.initial_values(), "twist_bias": b, "up": W @ Z}
    if walks:
        values["twist"] = twist
    step = model.step(values, Interval.of_one(twist + b, tau), T, False)
    T_next, u = moved(T, W, twist, tau)
    np.testing.assert_allclose(step.values["pose"], T_next, atol=1e-12)
    np.testing.assert_allclose(step.imu_twist, u, atol=1e-13)
    names = ["pose", "view", "previous_view", "calibration", *(["twist"] if walks else []), "up", "twist_bias"]
    ends = np.cumsum([block.size for block in model.layout.blocks])
    assert list(model.layout) == names
    assert [at.stop for at in model.layout.values()] == ends.tolist()

    def after(e):
        v = twist + e[..., 27:33] if walks else twist - e[..., -6:]
        W_e = se3.so3_exp(e[..., -9:-6]) @ W
        return difference(moved(se3.exp(e[..., :6]) @ T, W_e, v, tau)[0], T_next)

    size = 42 if walks else 36
    Phi, G = np.eye(size), np.zeros((size, 6))
    Phi[:6] = stencil(after, size)
    G[:6] = stencil(lambda errors: difference(moved(T, W, twist, tau, errors)[0], T_next), 6)
    np.testing.assert_allclose(step.Phi, Phi, atol=1e-9)
    std = noise.motion_std if walks else noise.twist_std
    np.testing.assert_allclose(step.Q, G @ np.diag(std**2) @ G.T, atol=1e-11)
    assert np.abs(step.Phi[:6, -9:-6]).max() > 1e-3


ERRORS = {"walk": TRACKS, "white": {}}
CASES = {
    f"{variant}-{coordinates}-{calibration}-{walks}-{tracks}": (variant, coordinates, calibration, walks, tracks)
    for variant in ("standard", "invariant")
    for coordinates in ("xyz", "image")
    for calibration in ("all", "some")
    for walks in (True, False)
    for tracks in ERRORS
}
QUICK = ("standard-xyz-all-True-walk", "invariant-xyz-some-False-walk")
# In the reduced form: all pairs.
SOME_CASES = [
    "standard-xyz-all-True-walk",
    "standard-image-some-True-walk",
    "invariant-xyz-some-False-walk",
    "invariant-image-all-False-walk",
    "standard-xyz-all-False-white",
    "standard-image-some-True-white",
    "invariant-xyz-some-True-white",
    "invariant-image-all-False-white",
]


@pytest.mark.parametrize(
    "case", [pytest.param(c, marks=() if c in QUICK else pytest.mark.slow) for c in (CASES if WHOLE else SOME_CASES)]
)
def test_filter_of_everything_equals_the_literal_one(case):
    variant, coordinates, calibrated, walks, errors = CASES[case]
    calibration, tracks = {"all": EVERYTHING, "some": SOME}[calibrated], ERRORS[errors]
    world = in_level_frame(
        small_world(frames=12, landmarks=20),
        TILTED,
        twist_walk_std=WALK if walks else None,
        motion_std=np.repeat([0.05, 0.01], 3),
        tilt_rad=0.05,
        **tracks,
    )
    bias = BIAS if calibration is EVERYTHING else None
    blocks = [] if bias is None else [bias]
    # Landmarks that are not seen for some frames stay awake.
    config = dataclasses.replace(OPEN, variant=variant, landmark_coordinates=coordinates, retire_after=100)
    ekf = filter_of(world, config, calibration, up=TILTED @ Z, blocks=blocks)
    std = np.array([0.1] * 3 + [np.deg2rad(0.5)] * 3 + [0.02, 0.5, 0.02])
    free = np.arange(9) if calibration is EVERYTHING else np.array([3, 4, 5, 7, 8])
    literal = Literal(world, variant, free, std[free], TILTED @ Z, bias, coordinates == "image")
    # Differences of images near the rim of what counts by its image are good for fewer digits.
    accuracy = 1e-9 if coordinates == "xyz" else 2e-8
    follow, again = side_by_side(ekf, literal, world, accuracy, shuffle=True)
    assert len(ekf.ids) > 6
    assert follow > 20 and again > 5
    assert (literal.by_position > 0) == (coordinates == "image")
    assert (np.abs(ekf.values["calibration"][free]) > 1e-6).all()
    assert not np.delete(ekf.values["calibration"], free).any()


DRIVE = "city?frames=120&outlier_fraction=0&max_tracks=6&sigma_v_m_s=0.02&sigma_w_rad_s=0.001&seed={}"
TILT = se3.so3_exp(np.deg2rad([3.0, -2.0, 0.0]))
TILT_STD = np.deg2rad(3.0)


def position_error(result, world):
    error = result.T_world_imu[:, :3, 3] - world.truth.T_world_imu[:, :3, 3]
    return np.sqrt((error**2).sum(axis=1).mean())


def end_of(world):
    """The filter after the last frame."""
    rig = Rig(world.camera, world.T_cam_imu, world.noise)
    return run_joint(world, rig, dataclasses.replace(OPEN, retire="unseen"))[0]


def up_in_imu(ekf):
    """Up in the frame of the IMU, and the covariance (3, 3) of its angles."""
    up, R, at = ekf.values["up"], ekf.T_imu_world[:3, :3], ekf.model.layout["up"]
    by = np.zeros((3, ekf.gaussian.body))
    by[:, 3:6], by[:, at] = np.eye(3), R
    return R @ up, by @ ekf.gaussian.body_covariance @ by.T


@pytest.mark.slow
@pytest.mark.parametrize(("walk", "seeds"), [(None, [0]), (WALK, [1])], ids=["white", "walk"])
def test_up_is_found_and_the_trajectory_is_better_for_it(walk, seeds):
    squares, ratio = [], []
    for seed in seeds:
        world = recorded(builtin(DRIVE.format(seed)), np.zeros(9), np.random.default_rng(seed))
        world = in_level_frame(world, TILT, tilt_rad=TILT_STD, twist_walk_std=walk)
        ekf, truth = end_of(world), gravity(world, TILT)[-1]
        up, covariance = up_in_imu(ekf)
        across = level_axes(up)[:, :2]
        P_across = across.T @ covariance @ across
        error = across.T @ np.cross(up, truth)
        squares.append(error @ np.linalg.solve(P_across, error))
        assert np.sqrt(np.linalg.eigvalsh(P_across)).max() < TILT_STD / 3
        assert abs(np.linalg.norm(up) - 1) < 1e-12
        ratio.append(position_error(run(with_noise(world, tilt_rad=0.0)), world) / position_error(run(world), world))
    assert max(squares) < 11.8  # 3 sigma, two degrees of freedom
    assert min(ratio) > 3


@pytest.mark.slow
def test_a_rig_that_stays_level_loses_nothing():
    level, plain = [], []
    for seed in range(1):
        world = builtin(DRIVE.format(seed))
        path = world.truth.T_world_imu.copy()
        yaw = np.unwrap(np.arctan2(path[:, 1, 0], path[:, 0, 0]))
        path[:, :3, :3], path[:, 2, 3] = se3.so3_exp(yaw[:, None] * Z), 0.0
        world = dataclasses.replace(world, truth=dataclasses.replace(world.truth, T_world_imu=path))
        world = recorded(world, np.zeros(9), np.random.default_rng(seed))
        np.testing.assert_allclose(in_level_frame(world, np.eye(3)).twist, world.twist, atol=1e-12)
        level.append(position_error(run(in_level_frame(world, np.eye(3), tilt_rad=TILT_STD)), world))
        plain.append(position_error(run(world), world))
    assert np.mean(level) < 1.3 * np.mean(plain)


def test_velocities_are_those_of_the_imu_unless_a_tilt_is_assumed():
    world = small_world(frames=5)
    assert list(filter_of(world, OPEN).values) == ["pose"]
    unstated = dataclasses.replace(world, noise=None)
    assert noise_of(unstated, Config()).tilt_rad == 0
    assert noise_of(dataclasses.replace(unstated, velocity_frame="level"), Config()).tilt_rad > 0


def test_unknown_velocity_frames_are_refused():
    with pytest.raises(DataError, match="expected imu or level, found 'body'"):
        dataclasses.replace(small_world(frames=5), velocity_frame="body")


def test_the_log_and_all_that_is_known_of_up_give_the_velocities_of_the_imu():
    world = recorded(builtin(DRIVE.format(0)), np.zeros(9), np.random.default_rng(0))
    level = in_level_frame(world, TILT, tilt_rad=TILT_STD)
    assert np.abs(level.twist - world.twist).max() > 0.2
    ekf = end_of(level)
    log = ekf.log()
    np.testing.assert_array_equal(log.inputs, level.twist[1:])
    up = (log.T_departed[1:, :3, :3] @ log.curved[1:, :, None])[..., 0]
    driven = se3.log(log.T_departed[1:] @ se3.inverse(log.T_predicted[1:])) / log.tau_s[1:, None]
    np.testing.assert_allclose(driven, in_imu(log.inputs, up), atol=1e-12)
    values = {"pose": log.T_updated[:-1], "up": np.broadcast_to(ekf.values["up"], (len(world) - 1, 3))}
    turned, _ = ekf.model.process.imu_velocities(values, log.inputs, log.T_updated[:-1, :3, :3])
    np.testing.assert_allclose(turned, world.twist[1:], atol=0.03)
