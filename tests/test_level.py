"""Velocities of a level frame, with all else that may stand in the state: Jacobians, assembly, recovery, the gauge.

`Literal` is a textbook EKF of the whole state. Its Jacobians are differences of the model functions above it, which
share no formula with the package beyond `se3`.
"""

import copy
import dataclasses

import numpy as np
import pytest
from reference import CAMERA, T_CAM_IMU, small_world
from test_jacobians import POSES, TWISTS
from test_variants import gauge_directions

from ekfslam.config import CalibrationConfig, Config, FilterConfig
from ekfslam.data.sequence import Noise, Observations
from ekfslam.data.simulate import builtin
from ekfslam.errors import DataError
from ekfslam.filters.joint import JointEKF, run_joint
from ekfslam.filters.observing import Rig
from ekfslam.geometry import motion, se3
from ekfslam.models.build import noise_of
from ekfslam.runner import run

OPEN = FilterConfig(gate_probability=1.0, split_after=0, retire="never", moving_sigma=1e9)
P0 = np.diag([0.1, 0.2, 0.3, 0.01, 0.02, 0.03]) ** 2
EVERYTHING = CalibrationConfig(rotation_deg=0.5, lever_arm_m=0.1, baseline=0.02, disparity_px=0.5, time_s=0.02)
SOME = CalibrationConfig(rotation_deg=0.5, disparity_px=0.5, time_s=0.02)
WALK = np.repeat([0.2, 0.02], 3)
RNG = np.random.default_rng(11)
X, Y, Z = np.eye(3)
UPS = {
    "level": Z,
    "hardly tilted": se3.so3_exp(np.array([1e-9, -2e-9, 0])) @ Z,
    "roll 1 rad": se3.so3_exp(X) @ Z,
    "pitch 1 rad": se3.so3_exp(Y) @ Z,
    "pitch -1 rad": se3.so3_exp(-Y) @ Z,
    **{f"random {i}": se3.so3_exp(np.append(RNG.uniform(-0.7, 0.7, 2), 0)) @ Z for i in range(3)},
}
ups = pytest.mark.parametrize("up", UPS.values(), ids=UPS.keys())


def with_noise(sequence, **changes):
    return dataclasses.replace(sequence, noise=dataclasses.replace(sequence.noise, **changes))


def stencil(function, size, step=4e-3):
    """As `central`, but to sixth order, some 12 digits; ``function`` takes a stack (7, size, size) of vectors."""
    h = step * np.arange(-3, 4)[:, None, None] * np.eye(size)
    weights = np.array([-1, 9, -45, 0, 45, -9, 1]) / 60
    return np.tensordot(weights, function(h), 1).T / step


def level_axes(up):
    """The level frame, made of cross products: y is across both up and the IMU's x axis."""
    y = np.cross(up, X)
    y = y / np.linalg.norm(y, axis=-1, keepdims=True)
    return np.stack([np.cross(y, up), y, up], axis=-1)


def rotated(R, twist):
    both = [(R @ part[..., None])[..., 0] for part in (twist[..., :3], twist[..., 3:])]
    return np.concatenate(np.broadcast_arrays(*both), axis=-1)


def in_imu(level_twist, up):
    return rotated(level_axes(up), level_twist)


def moved(T, W, twist, tau, errors=None):
    """Pose, attitude W against gravity (up is its z axis) and IMU velocities after one step at level velocities.

    ``errors`` (9,) are those of the velocities, and the small angles that turn them.
    """
    u = in_imu(twist, W[..., 2])
    if errors is not None:
        u = rotated(se3.so3_exp(errors[..., 6:]), u) + errors[..., :6]
    E = se3.exp(-tau * u)
    return E @ T, E[..., :3, :3] @ W, u


def difference(T, W, T_hat, W_hat):
    """Errors (9,) of pose and attitude."""
    return np.concatenate([se3.log(T @ np.linalg.inv(T_hat)), se3.so3_log(W @ W_hat.T)], axis=-1)


def camera_pose(T, c, u, T_cam_imu):
    return se3.exp(c[..., :6]) @ T_cam_imu @ se3.exp(-c[..., 8:] * u) @ T


def seen_rows(T, c, u, m, camera=CAMERA, T_cam_imu=T_CAM_IMU):
    """Rows (uL, v, uR) that a rig with calibration parameters c (9,) has of points (n, 3)."""
    q = se3.apply(camera_pose(T, c, u, T_cam_imu)[..., None, :, :], m)
    left = camera.fu_px * q[..., 0] / q[..., 2] + camera.cu_px
    v = camera.fv_px * q[..., 1] / q[..., 2] + camera.cv_px
    disparity = camera.fu_px * camera.baseline_m * np.exp(c[..., None, 6]) / q[..., 2] + c[..., None, 7]
    return np.stack([left, v, left - disparity], axis=-1)


def sighted(T, c, u, rows, camera=CAMERA, T_cam_imu=T_CAM_IMU):
    """The point (3,) that `seen_rows` sees so."""
    z = camera.fu_px * camera.baseline_m * np.exp(c[..., 6]) / (rows[..., 0] - rows[..., 2] - c[..., 7])
    x, y = (rows[..., 0] - camera.cu_px) / camera.fu_px * z, (rows[..., 1] - camera.cv_px) / camera.fv_px * z
    return se3.apply(np.linalg.inv(camera_pose(T, c, u, T_cam_imu)), np.stack([x, y, z], axis=-1))


class Literal:
    """Textbook EKF: full-width numeric F, H and G, S^-1, Joseph's form. Nothing is gated or retired.

    The state is pose, free calibration parameters, velocities, attitude against gravity, landmarks, as in `JointEKF`.
    """

    def __init__(self, sequence, variant, free, std, W=None, P=P0):
        self.sequence, self.noise, self.variant, self.free = sequence, sequence.noise, variant, free
        self.T, self.c, self.twist, self.u = np.linalg.inv(sequence.initial_T_world_imu), np.zeros(9), None, np.zeros(6)
        self.updated = [self.T]
        self.W, self.m, self.ids = np.eye(3) if W is None else W, np.empty((0, 3)), []
        f = len(free)
        self.walks = self.noise.twist_walk_std is not None
        self.at_twist = 6 + f
        self.at_up = 6 + f + 6 * self.walks
        self.body = self.at_up + 3
        self.P = np.zeros((self.body, self.body))
        self.P[:6, :6] = P
        self.P[6 : 6 + f, 6 : 6 + f] = np.diag(std**2)
        self.P[self.at_up :, self.at_up :] = self.noise.tilt_rad**2 * np.eye(3)

    def moved_by(self, e):
        """The body with errors e: T, c, twist, W."""
        f = len(self.free)
        c = self.c + e[..., 6 : 6 + f] @ np.eye(9)[self.free]
        twist = self.twist if self.twist is None else self.twist + e[..., self.at_twist : self.at_up]
        W = se3.so3_exp(e[..., self.at_up : self.body]) @ self.W
        return se3.exp(e[..., :6]) @ self.T, c, twist, W

    def predict(self, measured, tau):
        own = np.arange(self.at_twist, self.at_up)
        if self.walks and self.twist is None:
            self.twist = measured.copy()
            self.P[own, own] = self.noise.twist_std**2
        elif self.walks:
            self.P[own, own] += self.noise.twist_walk_std**2
            self.condition(np.eye(len(self.P))[own], measured - self.twist, np.diag(self.noise.twist_std**2))
        twist = self.twist if self.walks else measured
        T, W, u = moved(self.T, self.W, twist, tau)

        def after(e):
            T_e, _, twist_e, W_e = self.moved_by(e)
            return difference(*moved(T_e, W_e, twist_e if self.walks else measured, tau)[:2], T, W)

        rows = np.concatenate([np.arange(6), np.arange(self.at_up, self.body)])
        F, G = np.eye(len(self.P)), np.zeros((len(self.P), 9))
        F[rows, : self.body] = stencil(after, self.body)
        G[rows] = stencil(lambda errors: difference(*moved(self.T, self.W, twist, tau, errors)[:2], T, W), 9)
        std = self.noise.motion_std if self.walks else np.hypot(self.noise.twist_std, self.noise.motion_std)
        variance = np.concatenate([std**2, np.full(3, self.noise.misalignment_rad**2)])
        self.P = F @ self.P @ F.T + G @ np.diag(variance) @ G.T
        self.T, self.W, self.u, self.tau = T, W, u, tau
        step = T[:3, :3].T @ u[:3] * tau
        for j, m in enumerate(self.m):
            own = slice(self.body + 3 * j, self.body + 3 * j + 3)
            distance = np.linalg.norm(T[:3, :3] @ m + T[:3, 3])
            self.P[own, own] += self.noise.drift**2 * np.outer(step, step)
            self.P[own, own] += self.noise.bearing_drift_rad**2 * np.linalg.norm(step) * distance**2 * np.eye(3)

    def update(self, ids, pixels):
        rows = np.column_stack([pixels[:, 0], (pixels[:, 1] + pixels[:, 3]) / 2, pixels[:, 2]])
        variance = self.noise.pixel_std_px[0] ** 2 * np.array([1, 0.5, 1])
        known = np.isin(ids, self.ids)
        if known.any():
            at = [self.ids.index(i) for i in ids[known]]

            def predicted(e):
                m = self.m + e[..., self.body :].reshape(*e.shape[:-1], -1, 3)
                found = seen_rows(*self.moved_by(e)[:2], self.u, m[..., at, :])
                return found.reshape(*e.shape[:-1], -1)

            def corrected():
                residual = rows[known].ravel() - predicted(np.zeros(len(self.P)))
                self.condition(stencil(predicted, len(self.P)), residual, np.diag(np.tile(variance, len(at))))

            # The velocities that a time offset counts by are those that the frame itself corrects.
            trial = copy.deepcopy(vars(self))
            corrected()
            u = -se3.log(self.T @ np.linalg.inv(self.updated[-1])) / self.tau
            vars(self).update(trial)
            self.u = u
            corrected()
        for i, z in zip(ids[~known], rows[~known], strict=True):
            self.start(i, z, variance)
        self.updated.append(self.T)

    def start(self, i, z, variance):
        n = len(self.P)
        G = stencil(lambda e: sighted(*self.moved_by(e)[:2], self.u, z), n)
        by_row = stencil(lambda d: sighted(self.T, self.c, self.u, z + d), 3)
        wide = np.vstack([np.eye(n), G])
        self.P = wide @ self.P @ wide.T
        self.P[n:, n:] += by_row @ np.diag(variance) @ by_row.T
        self.m = np.vstack([self.m, sighted(self.T, self.c, self.u, z)])
        self.ids.append(i)

    def to_stored(self):
        """L, stored errors of pose and landmarks by the right-invariant ones; identity in between."""
        L = np.eye(len(self.P))
        L[:6, :6] = -se3.adjoint(self.T)
        for j, m in enumerate(self.m):
            L[self.body + 3 * j : self.body + 3 * j + 3, 3:6] = -se3.skew(m)
        return L

    def condition(self, H, residual, V):
        K = self.P @ H.T @ np.linalg.inv(H @ self.P @ H.T + V)
        x, rest = K @ residual, np.eye(len(self.P)) - K @ H
        self.P = rest @ self.P @ rest.T + K @ V @ K.T
        T, self.c, self.twist, self.W = self.moved_by(x)
        if self.variant == "standard":
            self.T, self.m = T, self.m + x[self.body :].reshape(-1, 3)
            return
        before = self.to_stored()
        e = np.linalg.inv(before) @ x
        T_before, m_before, c_before = self.T, self.m, self.c - x[6 : 6 + len(self.free)] @ np.eye(9)[self.free]
        self.T = self.T @ se3.exp(-e[:6])
        R, J = se3.so3_exp(e[3:6]), se3.so3_left_jacobian(e[3:6])
        self.m = self.m @ R.T + e[self.body :].reshape(-1, 3) @ J.T
        transport = self.to_stored() @ np.linalg.inv(before)
        R_cam_world = (se3.exp(c_before[:6]) @ T_CAM_IMU @ T_before)[:3, :3]
        for i, place in enumerate(self.free):
            if place in (3, 4, 5):
                axis = R_cam_world.T @ se3.so3_left_jacobian(c_before[3:6])[:, place - 3]
                transport[self.body :, 6 + i] += np.cross(self.m - m_before, axis).ravel()
        self.P = transport @ self.P @ transport.T


def gravity(sequence, W):
    """Up in the frame of the IMU at every stamp, where ``W Z`` is up in that of the first."""
    R = sequence.truth.T_world_imu[:, :3, :3]
    return np.swapaxes(R, 1, 2) @ R[0] @ W @ Z


def in_level_frame(sequence, W, **noise):
    """The sequence with its velocities given in the level frame, as it was at the begin of each interval."""
    up = gravity(sequence, W)
    up = np.concatenate([up[:1], up[:-1]])
    twist = rotated(np.swapaxes(level_axes(up), -1, -2), sequence.twist)
    return with_noise(dataclasses.replace(sequence, twist=twist, velocity_frame="level"), **noise)


def recorded(world, c, rng):
    """The drive of a simulated world, recorded once more by a rig with parameters c; exposed at the poses of then."""
    truth, observations = world.truth, world.observations
    T = se3.inverse(truth.T_world_imu)
    u = -se3.log(T[1:] @ se3.inverse(T[:-1])) / np.diff(world.time_s)[:, None]
    k = observations.frame
    ahead = np.vstack([u, u[-1]])[k]
    place = truth.position_m[np.searchsorted(truth.landmark, observations.landmark)]
    rows = seen_rows(T[k], np.tile(c, (len(k), 1)), ahead, place[:, None], world.camera, world.T_cam_imu)[:, 0]
    pixels = rows[:, [0, 1, 2, 1]] + world.noise.pixel_std_px * rng.normal(size=(len(k), 4))
    twist = np.vstack([u[0], u]) + world.noise.twist_std * rng.normal(size=(len(world), 6))
    return dataclasses.replace(world, twist=twist, observations=Observations(k, observations.landmark, pixels))


def filter_of(world, config, calibration=None, P=P0):
    rig = Rig(world.camera, world.T_cam_imu, world.noise)
    return JointEKF(rig, config, world.initial_T_world_imu, P, calibration)


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
    """Phi and Q of pose, calibration, velocities and up, from the one model of a step."""
    noise = Noise(
        np.repeat([0.3, 0.05], 3),
        np.ones(4),
        twist_walk_std=WALK if walks else None,
        motion_std=np.array([0.1, 0.2, 0.3, 0.04, 0.05, 0.06]) if walks else np.zeros(6),
        misalignment_rad=0.02,
        tilt_rad=0.1,
    )
    number = list(POSES).index(name)
    up, twist, tau = list(UPS.values())[number % len(UPS)], TWISTS[2 + number % 3], 0.13
    ekf = JointEKF(Rig(CAMERA, T_CAM_IMU, noise), FilterConfig(), se3.inverse(T), P0, EVERYTHING)
    ekf.up, ekf.twist = up, twist if walks else None
    W = level_axes(up)
    step = ekf._step(twist, tau)
    T_next, W_next, u = moved(T, W, twist, tau)
    np.testing.assert_allclose(step.T_imu_world, T_next, atol=1e-12)
    np.testing.assert_allclose(step.up, W_next @ Z, atol=1e-13)
    np.testing.assert_allclose(step.twist, u, atol=1e-13)

    def after(e):
        v = twist + e[..., 15:21] if walks else twist
        T_e, W_e, _ = moved(se3.exp(e[..., :6]) @ T, se3.so3_exp(e[..., -3:]) @ W, v, tau)
        return difference(T_e, W_e, T_next, W_next)

    size = 24 if walks else 18
    rows = [*range(6), *range(size - 3, size)]
    Phi, G = np.eye(size), np.zeros((size, 9))
    Phi[rows] = stencil(after, size)
    G[rows] = stencil(lambda errors: difference(*moved(T, W, twist, tau, errors)[:2], T_next, W_next), 9)
    np.testing.assert_allclose(step.Phi, Phi, atol=1e-9)
    std = np.concatenate([noise.motion_std if walks else noise.twist_std, np.full(3, noise.misalignment_rad)])
    np.testing.assert_allclose(step.Q, G @ np.diag(std**2) @ G.T, atol=1e-11)
    assert np.abs(step.Q[-3:, :6]).max() > 1e-6


TILTED = se3.so3_exp(np.array([0.3, -0.2, 0.0]))


@pytest.mark.parametrize("walks", [True, False])
@pytest.mark.parametrize("calibration", [EVERYTHING, SOME], ids=["all", "some"])
@pytest.mark.parametrize("variant", ["standard", "invariant"])
def test_filter_of_everything_equals_the_literal_one(variant, calibration, walks):
    world = in_level_frame(
        small_world(frames=12, landmarks=20),
        TILTED,
        twist_walk_std=WALK if walks else None,
        motion_std=np.repeat([0.05, 0.01], 3),
        misalignment_rad=0.02,
        drift=0.1,
        bearing_drift_rad=1e-3,
        tilt_rad=0.05,
    )
    ekf = filter_of(world, dataclasses.replace(OPEN, variant=variant), calibration)
    std = np.array([0.1] * 3 + [np.deg2rad(0.5)] * 3 + [0.02, 0.5, 0.02])
    free = np.arange(9) if calibration is EVERYTHING else np.array([3, 4, 5, 7, 8])
    literal = Literal(world, variant, free, std[free], TILTED)
    ekf.up = TILTED @ Z
    rng = np.random.default_rng(3)
    for k in range(len(world)):
        if k:
            tau = world.time_s[k] - world.time_s[k - 1]
            ekf.predict(world.twist[k], tau)
            literal.predict(world.twist[k], tau)
        ids, pixels = world.observations.at(k)
        # Of what is there some are left out, the first among them, and the others come in any order.
        some = rng.permutation(len(ids))[: max(3, len(ids) - 2)]
        if k > 1:
            some = some[ids[some] != literal.ids[0]]
        ekf.update(k, ids[some], pixels[some])
        literal.update(ids[some], pixels[some])
        assert literal.ids == ekf.ids.tolist()
        for ours, theirs in (
            (ekf.T_imu_world, literal.T),
            (ekf.parameters, literal.c),
            (ekf.up, literal.W @ Z),
            (ekf.positions_m, literal.m),
            (ekf.P, literal.P),
        ):
            np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9)
        np.testing.assert_array_equal(ekf.P, ekf.P.T)
        if walks and k:
            np.testing.assert_allclose(ekf.twist, literal.twist, atol=1e-9)
    assert len(ekf.ids) > 6
    assert (np.abs(ekf.parameters[free]) > 1e-6).all()
    assert not np.delete(ekf.parameters, free).any()


@pytest.mark.parametrize("variant", ["invariant", "fej", "standard"])
def test_information_about_the_gauge_with_up_and_calibration(variant):
    """Velocities taken as exact: not the least is gained or lost, but by the standard variant."""
    world = in_level_frame(small_world(seed=4), TILTED, twist_std=np.zeros(6), tilt_rad=0.05)
    config = dataclasses.replace(OPEN, variant=variant)
    ekf = filter_of(world, config, EVERYTHING)
    ekf.up = TILTED @ Z
    prior = se3.adjoint(ekf.T_imu_world).T @ np.linalg.solve(P0, se3.adjoint(ekf.T_imu_world))
    for k in range(len(world)):
        if k:
            ekf.predict(world.twist[k], world.time_s[k] - world.time_s[k - 1])
        ekf.update(k, *world.observations.at(k))
    ratio = gauge_ratio(ekf, variant, prior)
    if variant == "standard":
        assert ratio.max() > 10
    else:
        np.testing.assert_allclose(ratio, 1.0, atol=1e-6)


def gauge_ratio(ekf, variant, prior):
    T, m = (ekf._T_predicted, ekf._initial_m) if variant == "fej" else (ekf.T_imu_world, ekf.positions_m)
    N = gauge_directions(T, m)
    N = np.vstack([N[:6], np.zeros((ekf._body - 6, 6)), N[6:]])
    return np.linalg.eigvals(np.linalg.solve(prior, N.T @ np.linalg.solve(ekf.P, N))).real


DRIVE = "city?frames=120&outlier_fraction=0&max_tracks=6&sigma_v_m_s=0.02&sigma_w_rad_s=0.001&seed={}"
TILT = se3.so3_exp(np.deg2rad([3.0, -2.0, 0.0]))
TILT_STD = np.deg2rad(3.0)


def position_error(result, world):
    error = result.T_world_imu[:, :3, 3] - world.truth.T_world_imu[:, :3, 3]
    return np.sqrt((error**2).sum(axis=1).mean())


def end_of(world):
    """The filter after the last frame."""
    rig = Rig(world.camera, world.T_cam_imu, world.noise)
    config = dataclasses.replace(OPEN, retire="unseen")
    return run_joint(world, rig, config, range(len(world)))[0]


@pytest.mark.slow
@pytest.mark.parametrize(("walk", "seeds"), [(None, [0]), (WALK, [1])], ids=["white", "walk"])
def test_up_is_found_and_the_trajectory_is_better_for_it(walk, seeds):
    squares, ratio = [], []
    for seed in seeds:
        world = recorded(builtin(DRIVE.format(seed)), np.zeros(9), np.random.default_rng(seed))
        world = in_level_frame(world, TILT, tilt_rad=TILT_STD, twist_walk_std=walk)
        ekf, truth = end_of(world), gravity(world, TILT)[-1]
        across = level_axes(ekf.up)[:, :2]
        P_across = across.T @ ekf.P[ekf._at_up, ekf._at_up] @ across
        error = across.T @ np.cross(ekf.up, truth)
        squares.append(error @ np.linalg.solve(P_across, error))
        assert np.sqrt(np.linalg.eigvalsh(P_across)).max() < TILT_STD / 3
        assert abs(np.linalg.norm(ekf.up) - 1) < 1e-12
        ratio.append(position_error(run(with_noise(world, tilt_rad=0.0)), world) / position_error(run(world), world))
    assert max(squares) < 11.8  # 3 sigma, two degrees of freedom
    assert min(ratio) > 3


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
    assert filter_of(world, OPEN).up is None
    unstated = dataclasses.replace(world, noise=None)
    assert noise_of(unstated, Config()).tilt_rad == 0
    assert noise_of(dataclasses.replace(unstated, velocity_frame="level"), Config()).tilt_rad > 0


def test_unknown_velocity_frames_are_refused():
    with pytest.raises(DataError, match="expected imu or level, found 'body'"):
        dataclasses.replace(small_world(frames=5), velocity_frame="body")


def test_the_log_holds_velocities_of_the_imu_as_turned_by_all_that_is_known_of_up():
    world = recorded(builtin(DRIVE.format(0)), np.zeros(9), np.random.default_rng(0))
    level = in_level_frame(world, TILT, tilt_rad=TILT_STD)
    assert np.abs(level.twist - world.twist).max() > 0.2
    log = end_of(level).log()
    np.testing.assert_allclose(log.twist[1:], world.twist[1:], atol=0.03)
