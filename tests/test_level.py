"""Velocities of a level frame, with all else that may stand in the state: Jacobians, assembly, recovery, the gauge.

`Literal` is a textbook EKF of the whole state. Its Jacobians are differences of the model functions above it, which
share no formula with the package beyond `se3`.
"""

import copy
import dataclasses

import numpy as np
import pytest
from conftest import WHOLE
from helpers import run_joint
from reference import CAMERA, T_CAM_IMU, small_world
from test_jacobians import POSES, TWISTS
from test_variants import gauge_directions

from ekfslam.config import CalibrationConfig, Config, FilterConfig
from ekfslam.data.sequence import Noise, Observations
from ekfslam.data.simulate import builtin
from ekfslam.errors import DataError
from ekfslam.filters.joint import JointEKF
from ekfslam.geometry import motion, se3
from ekfslam.models.blocks import TwistBias
from ekfslam.models.build import model_of, noise_of
from ekfslam.models.sensors.stereo import Rig
from ekfslam.runner import run

OPEN = FilterConfig(landmark_coordinates="xyz", gate_probability=1.0, split_after=0, retire="never", moving_sigma=1e9)
P0 = np.diag([0.1, 0.2, 0.3, 0.01, 0.02, 0.03]) ** 2
EVERYTHING = CalibrationConfig(rotation_deg=0.5, lever_arm_m=0.1, baseline=0.02, disparity_px=0.5, time_s=0.02)
SOME = CalibrationConfig(rotation_deg=0.5, disparity_px=0.5, time_s=0.02)
WALK = np.repeat([0.2, 0.02], 3)
TRACKS = {
    "track_first_px": np.array([0.3, 0.4, 0.8]),
    "track_walk_px": np.array([0.2, 0.25, 0.3]),
    "track_memory": 0.9,
    "track_flow_px": 15.0,
}
BIAS = TwistBias(sigma_v_m_s=0.1, sigma_w_rad_s=0.01, time_v_s=3.0, time_w_s=7.0)
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
    """Pose and IMU velocities after one step at level velocities; up is the z axis of W, in world.

    ``errors`` (9,) are those of the velocities, and the small angles that turn them.
    """
    u = in_imu(twist, (T[..., :3, :3] @ W)[..., 2])
    if errors is not None:
        u = rotated(se3.so3_exp(errors[..., 6:]), u) + errors[..., :6]
    return se3.exp(-tau * u) @ T, u


def difference(T, T_hat):
    """Error (6,) of a pose."""
    return se3.log(T @ np.linalg.inv(T_hat))


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


# From (uL, v, uR) to (u, v, disparity), and back.
BY_DISPARITY = np.array([[1.0, 0, 0], [0, 1, 0], [1, 0, -1]])


class Literal:
    """Textbook EKF: full-width numeric F, H and G, S^-1, Joseph's form. Nothing is gated or retired.

    The state is pose, pose before, free calibration parameters, velocities, up, bias, landmarks, as in `JointEKF`;
    where the noise knows no tracks, velocities or bias, these have no columns. With ``images`` landmarks are corrected
    in pixels (u, v, disparity) of the last updated camera, eq. (7').
    """

    def __init__(self, sequence, variant, free, std, up=Z, bias=None, images=False, P=P0):
        self.sequence, self.noise, self.variant, self.free = sequence, sequence.noise, variant, free
        self.images, self.updated, self.by_position = images, "T", 0
        self.T = self.departed = np.linalg.inv(sequence.initial_T_world_imu)
        self.before, self.c, self.twist, self.b = np.eye(4), np.zeros(9), None, np.zeros(6)
        self.u = self.u_before = np.zeros(6)
        self.W = self.T[:3, :3].T @ level_axes(up)
        self.m, self.ids, self.first, self.last, self.rows = np.empty((0, 3)), [], {}, {}, {}
        self.walks, self.bias, self.tracks = self.noise.twist_walk_std is not None, bias, self.noise.track_error
        self.has_clone = images or self.tracks is not None
        self.k, self.body, self.at = 0, 0, {}
        of_bias = np.zeros(0) if bias is None else np.repeat([bias.sigma_v_m_s, bias.sigma_w_rad_s], 3)
        prior = {
            "pose": P,
            "before": np.zeros((6 * self.has_clone,) * 2),
            "c": np.diag(std**2),
            "twist": np.zeros((6 * self.walks,) * 2),
            "up": self.noise.tilt_rad**2 * np.eye(3),
            "bias": np.diag(of_bias**2),
        }
        for name, block in prior.items():
            self.at[name] = slice(self.body, self.body + len(block))
            self.body += len(block)
        self.P = np.zeros((self.body, self.body))
        for name, block in prior.items():
            self.P[self.at[name], self.at[name]] = block

    def moved_by(self, e):
        """The blocks with errors e."""
        found = {
            "T": se3.exp(e[..., self.at["pose"]]) @ self.T,
            "before": self.before,
            "c": self.c + e[..., self.at["c"]] @ np.eye(9)[self.free],
            "twist": self.twist,
            "W": se3.so3_exp(e[..., self.at["up"]]) @ self.W,
            "b": self.b,
        }
        if self.has_clone:
            found["before"] = se3.exp(e[..., self.at["before"]]) @ self.before
        if self.twist is not None:
            found["twist"] = self.twist + e[..., self.at["twist"]]
        if self.bias is not None:
            found["b"] = self.b + e[..., self.at["bias"]]
        return found

    def begin(self, measured):
        self.u = moved(self.T, self.W, measured, 0.0)[1]

    def predict(self, measured, tau):
        self.wander(tau)
        if self.walks:
            self.measure(measured)

        def driven(x):
            return x["twist"] if self.walks else measured - x["b"]

        nothing = np.zeros(len(self.P))
        twist = driven(self.moved_by(nothing))
        T, u = moved(self.T, self.W, twist, tau)

        def after(e):
            x = self.moved_by(e)
            return difference(moved(x["T"], x["W"], driven(x), tau)[0], T)

        F, G = np.eye(len(self.P)), np.zeros((len(self.P), 9))
        F[:6] = stencil(after, len(self.P))
        G[:6] = stencil(lambda errors: difference(moved(self.T, self.W, twist, tau, errors)[0], T), 9)
        if self.has_clone:
            F[self.at["before"]] = np.eye(len(self.P))[:6]
        std = self.noise.motion_std if self.walks else np.hypot(self.noise.twist_std, self.noise.motion_std)
        variance = np.concatenate([std**2, np.full(3, self.noise.misalignment_rad**2)])
        self.P = F @ self.P @ F.T + G @ np.diag(variance) @ G.T
        self.before, self.departed, self.updated = self.T, self.T, "before"
        self.T, self.u, self.u_before, self.tau, self.k = T, u, self.u, tau, self.k + 1

    def wander(self, tau):
        """Velocities walk once they are known, the bias forgets."""
        own = np.arange(len(self.P))
        if self.twist is not None:
            at = own[self.at["twist"]]
            self.P[at, at] += self.noise.twist_walk_std**2
        if self.bias is not None:
            sigma = np.repeat([self.bias.sigma_v_m_s, self.bias.sigma_w_rad_s], 3)
            kept = np.exp(-tau / np.repeat([self.bias.time_v_s, self.bias.time_w_s], 3))
            F, at = np.eye(len(self.P)), own[self.at["bias"]]
            F[at, at] = kept
            self.P = F @ self.P @ F.T
            self.P[at, at] += sigma**2 - (sigma * kept) ** 2
            self.b = kept * self.b

    def measure(self, measured):
        """The velocities, whose first measurement is the first that is known of them."""
        variance, none = np.diag(self.noise.twist_std**2), np.zeros((6, len(self.P)))
        by_bias = none.copy()
        by_bias[:, self.at["bias"]] = np.eye(6) if self.bias is not None else 0.0
        if self.twist is None:
            F = np.eye(len(self.P))
            F[self.at["twist"]] = -by_bias
            self.P = F @ self.P @ F.T
            self.P[self.at["twist"], self.at["twist"]] += variance
            self.twist = measured - self.b
        else:
            H = none + by_bias
            H[:, self.at["twist"]] = np.eye(6)
            self.condition(H, measured - self.twist - self.b, variance)

    def update(self, ids, pixels):
        rows = np.column_stack([pixels[:, 0], (pixels[:, 1] + pixels[:, 3]) / 2, pixels[:, 2]])
        if self.tracks is not None:
            rows = np.column_stack([rows[:, :2], pixels[:, 0] - pixels[:, 2]])
        seen = [(i, z, self.ids.index(i)) for i, z in zip(ids.tolist(), rows, strict=True) if i in self.ids]
        if seen:
            # The velocities that a time offset counts by are those that the frame itself corrects.
            trial = copy.deepcopy(vars(self))
            self.correct(seen)
            u = -difference(self.T, self.departed) / self.tau
            vars(self).update(trial)
            self.u = u
            self.correct(seen)
        for i, z in zip(ids.tolist(), rows, strict=True):
            if i not in self.ids:
                self.start(i, z)
            self.last[i], self.rows[i] = self.k, z
        self.updated = "T"

    def look(self, x, m, before=False, follows=False):
        """Rows of points (..., n, 3) now, or in the frame before, with disparities where tracks err."""
        T, u = (x["before"], self.u_before) if before else (x["T"], self.u)
        rows = seen_rows(T, x["c"], u, m)
        return rows if self.tracks is None else rows @ BY_DISPARITY.T

    def point(self, x, row):
        """The point (3,) that is seen so now."""
        back = np.eye(3) if self.tracks is None else BY_DISPARITY
        return sighted(x["T"], x["c"], self.u, row @ back.T)

    def correct(self, seen):
        variance = []
        for i, z, _ in seen:
            if self.tracks is None:
                variance.append(self.noise.pixel_std_px[0] ** 2 * np.array([1, 0.5, 1]))
            elif self.last[i] == self.k - 1:
                u, v, d = (z - self.rows[i]) ** 2
                flow = np.array([u + 0.35 * (v + d), v + 0.35 * (u + d), d + 0.35 * (u + v)])
                variance.append(self.noise.track_walk_px**2 * (1 + flow / self.noise.track_flow_px**2))
            else:
                spread = self.noise.track_first_px**2
                for _ in range(self.first[i], self.k):
                    spread = self.noise.track_memory**2 * spread + self.noise.track_walk_px**2
                variance.append(spread)

        def left(e):
            x, parts = self.moved_by(e), []
            m = self.m + e[..., self.body :].reshape(*e.shape[:-1], -1, 3)
            for i, z, place in seen:
                own = m[..., place : place + 1, :]
                follows = self.tracks is not None and self.last[i] == self.k - 1
                residual = z - self.look(x, own, follows=follows)
                if follows:
                    before = self.rows[i] - self.look(x, own, before=True)
                    residual = residual - self.noise.track_memory * before
                parts.append(residual[..., 0, :])
            return np.concatenate(parts, axis=-1)

        H = -stencil(left, len(self.P))
        self.condition(H, left(np.zeros(len(self.P))), np.diag(np.concatenate(variance)))

    def start(self, i, z):
        n = len(self.P)
        here = self.moved_by(np.zeros(n))
        G = stencil(lambda e: self.point(self.moved_by(e), z), n)
        by_row = stencil(lambda d: self.point(here, z + d), 3)
        variance = self.noise.pixel_std_px[0] ** 2 * np.array([1, 0.5, 1])
        if self.tracks is not None:
            variance = self.noise.track_first_px**2
        wide = np.vstack([np.eye(n), G])
        self.P = wide @ self.P @ wide.T
        self.P[n:, n:] += by_row @ np.diag(variance) @ by_row.T
        self.m = np.vstack([self.m, self.point(here, z)])
        self.ids.append(i)
        self.first[i] = self.k

    def to_stored(self):
        """L, stored errors of poses and landmarks by the right-invariant ones; identity in between."""
        L = np.eye(len(self.P))
        L[:6, :6] = -se3.adjoint(self.T)
        if self.has_clone:
            L[self.at["before"], self.at["before"]] = -se3.adjoint(self.before)
        for j, m in enumerate(self.m):
            L[self.body + 3 * j : self.body + 3 * j + 3, 3:6] = -se3.skew(m)
        return L

    def image(self, e, by_position):
        """Landmarks (n, 3) as the last updated camera has them, intrinsics as given; by positions where told so."""
        x, m = self.moved_by(e), self.m + e[..., self.body :].reshape(*e.shape[:-1], -1, 3)
        c = x["c"] * (np.arange(9) < 6)
        q = se3.apply(camera_pose(x[self.updated], c, np.zeros(6), T_CAM_IMU)[..., None, :, :], m)
        y = seen_rows(x[self.updated], c, np.zeros(6), m) @ BY_DISPARITY.T
        return np.where(by_position[:, None], q, y)

    def act_on_images(self, x):
        """Eq. (7') as it stands: move the images, find the landmarks, and carry P along by full-width Jacobians."""
        zero, n = np.zeros(len(self.P)), len(self.m)
        q = self.image(zero, np.ones(n, dtype=bool))
        z, nowhere = q[:, 2], np.zeros(n, dtype=bool)
        away = ~((z > 0.1) & (np.abs(q[:, :2]).max(axis=1) < 3 * z))
        away |= CAMERA.fu_px * CAMERA.baseline_m / z < 0.5
        y = self.image(zero, nowhere)
        step = (stencil(lambda e: self.image(e, nowhere).reshape(*e.shape[:-1], -1), len(x), 2e-3) @ x).reshape(-1, 3)
        factor = (y + step)[:, 2] / y[:, 2]
        away |= ~((factor > 0.25) & (factor < 4))
        self.by_position += away.sum()

        def coordinates(e):
            return self.image(e, away).reshape(*e.shape[:-1], -1)

        H = stencil(coordinates, len(x), 2e-3)
        moved_to = (coordinates(zero) + H @ x).reshape(-1, 3)
        poses = {"pose": self.T, "before": self.before}
        vars(self).update(self.moved_by(x))
        c, camera = self.c * (np.arange(9) < 6), getattr(self, self.updated)
        from_pixels = sighted(camera, c, np.zeros(6), np.where(away[:, None], 1.0, moved_to) @ BY_DISPARITY.T)
        from_positions = se3.apply(np.linalg.inv(camera_pose(camera, c, np.zeros(6), T_CAM_IMU)), moved_to)
        self.m = np.where(away[:, None], from_positions, from_pixels)
        G, H_after = np.eye(len(x)), stencil(coordinates, len(x), 2e-3)
        if self.variant == "invariant":
            for name, T in poses.items():
                T_after = self.T if name == "pose" else self.before
                G[self.at[name], self.at[name]] = se3.adjoint(T_after @ np.linalg.inv(T))
        rest = H.copy()
        rest[:, : self.body] -= H_after[:, : self.body] @ G[: self.body, : self.body]
        G[self.body :] = np.linalg.solve(H_after[:, self.body :], rest)
        self.P = G @ self.P @ G.T

    def condition(self, H, residual, V):
        K = self.P @ H.T @ np.linalg.inv(H @ self.P @ H.T + V)
        x, rest = K @ residual, np.eye(len(self.P)) - K @ H
        self.P = rest @ self.P @ rest.T + K @ V @ K.T
        if self.images:
            self.act_on_images(x)
            return
        stored, T_before, m_before, c_before = self.to_stored(), self.T, self.m, self.c
        after = self.moved_by(x)
        vars(self).update({name: value for name, value in after.items() if name not in ("T", "before")})
        if self.variant == "standard":
            self.T, self.before, self.m = after["T"], after["before"], self.m + x[self.body :].reshape(-1, 3)
            return
        e = np.linalg.inv(stored) @ x
        self.T = self.T @ se3.exp(-e[:6])
        if self.has_clone:
            self.before = self.before @ se3.exp(-e[self.at["before"]])
        R, J = se3.so3_exp(e[3:6]), se3.so3_left_jacobian(e[3:6])
        self.m = self.m @ R.T + e[self.body :].reshape(-1, 3) @ J.T
        transport = self.to_stored() @ np.linalg.inv(stored)
        R_cam_world = (se3.exp(c_before[:6]) @ T_CAM_IMU @ T_before)[:3, :3]
        for i, place in enumerate(self.free):
            if place in (3, 4, 5):
                axis = R_cam_world.T @ se3.so3_left_jacobian(c_before[3:6])[:, place - 3]
                transport[self.body :, self.at["c"].start + i] += np.cross(self.m - m_before, axis).ravel()
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


def filter_of(world, config, calibration=None, P=P0, up=None, blocks=()):
    """The filter of a world, where ``up`` (3,) is what it takes as up in the first frame of the IMU."""
    rig = Rig(world.camera, world.T_cam_imu, world.noise)
    ekf = JointEKF(rig, config, world.initial_T_world_imu, P, calibration, blocks=blocks)
    if up is not None:
        ekf.values["up"] = ekf.T_world_imu[:3, :3] @ up
    return ekf


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
        misalignment_rad=0.02,
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
    step = model.step(values, twist + b, tau, T, False)
    T_next, u = moved(T, W, twist, tau)
    np.testing.assert_allclose(step.T_imu_world, T_next, atol=1e-12)
    np.testing.assert_allclose(step.twist, u, atol=1e-13)
    names = ["pose", "previous_pose", "calibration", *(["twist"] if walks else []), "up", "twist_bias"]
    ends = np.cumsum([block.size for block in model.layout.blocks])
    assert list(model.layout) == names
    assert [at.stop for at in model.layout.values()] == ends.tolist()

    def after(e):
        v = twist + e[..., 21:27] if walks else twist - e[..., -6:]
        W_e = se3.so3_exp(e[..., -9:-6]) @ W
        return difference(moved(se3.exp(e[..., :6]) @ T, W_e, v, tau)[0], T_next)

    size = 36 if walks else 30
    Phi, G = np.eye(size), np.zeros((size, 9))
    Phi[:6] = stencil(after, size)
    Phi[6:12] = np.eye(size)[:6]
    G[:6] = stencil(lambda errors: difference(moved(T, W, twist, tau, errors)[0], T_next), 9)
    np.testing.assert_allclose(step.Phi, Phi, atol=1e-9)
    std = np.concatenate([noise.motion_std if walks else noise.twist_std, np.full(3, noise.misalignment_rad)])
    np.testing.assert_allclose(step.Q, G @ np.diag(std**2) @ G.T, atol=1e-11)
    assert np.abs(step.Phi[:6, -9:-6]).max() > 1e-3


TILTED = se3.so3_exp(np.array([0.3, -0.2, 0.0]))


ERRORS = {"ar": TRACKS, "walk": {**TRACKS, "track_memory": 1.0}, "white": {}}
CASES = {
    f"{variant}-{coordinates}-{calibration}-{walks}-{tracks}": (variant, coordinates, calibration, walks, tracks)
    for variant in ("standard", "invariant")
    for coordinates in ("xyz", "image")
    for calibration in ("all", "some")
    for walks in (True, False)
    for tracks in ERRORS
}
QUICK = ("standard-xyz-all-True-ar", "invariant-xyz-some-False-ar")
# In the reduced form: all pairs.
SOME_CASES = [
    "standard-xyz-all-True-ar",
    "standard-image-some-True-ar",
    "invariant-xyz-some-False-ar",
    "invariant-image-all-False-ar",
    "standard-xyz-all-True-walk",
    "standard-image-some-False-walk",
    "invariant-xyz-some-True-walk",
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
        misalignment_rad=0.02,
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
    rng = np.random.default_rng(3)
    follow = again = 0
    # Differences of images near the rim of what counts by its image are good for fewer digits.
    accuracy = 1e-9 if coordinates == "xyz" else 2e-8
    for k in range(len(world)):
        if k:
            tau = world.time_s[k] - world.time_s[k - 1]
            ekf.predict(world.twist[k], tau)
            literal.predict(world.twist[k], tau)
        else:
            ekf.begin(world.twist[0])
            literal.begin(world.twist[0])
        ids, pixels = world.observations.at(k)
        # Of what is there some are left out, the first among them, and the others come in any order.
        some = rng.permutation(len(ids))[: max(3, len(ids) - 2)]
        if k > 1:
            some = some[ids[some] != literal.ids[0]]
        last = [literal.last[i] for i in ids[some].tolist() if i in literal.ids]
        follow, again = follow + last.count(k - 1), again + sum(seen < k - 1 for seen in last)
        ekf.update(k, ids[some], pixels[some])
        literal.update(ids[some], pixels[some])
        assert literal.ids == ekf.ids.tolist()
        for ours, theirs in (
            (ekf.T_imu_world, literal.T),
            (ekf.values["calibration"], literal.c),
            (ekf.values["up"], literal.W @ Z),
            (ekf.positions_m, literal.m),
            (ekf.P, literal.P),
        ):
            np.testing.assert_allclose(ours, theirs, rtol=accuracy, atol=accuracy)
        np.testing.assert_array_equal(ekf.P, ekf.P.T)
        if bias is not None:
            np.testing.assert_allclose(ekf.values["twist_bias"], literal.b, atol=accuracy)
        if walks and k:
            np.testing.assert_allclose(ekf.values["twist"], literal.twist, atol=accuracy)
        if literal.has_clone and k:
            np.testing.assert_allclose(ekf.values["previous_pose"], literal.before, rtol=accuracy, atol=accuracy)
    assert len(ekf.ids) > 6
    assert follow > 20 and again > 5
    assert (literal.by_position > 0) == (coordinates == "image")
    assert (np.abs(ekf.values["calibration"][free]) > 1e-6).all()
    assert not np.delete(ekf.values["calibration"], free).any()


@pytest.mark.parametrize("tracks", [TRACKS, {}], ids=["tracks", "white"])
@pytest.mark.parametrize("coordinates", ["xyz", "image"])
@pytest.mark.parametrize("variant", ["invariant", "fej", "standard"])
def test_information_about_the_gauge_with_up_and_calibration(variant, coordinates, tracks):
    """Velocities taken as exact: not the least is gained or lost, but by the standard variant."""
    world = in_level_frame(
        small_world(seed=4, frames=60 if WHOLE else 30), TILTED, twist_std=np.zeros(6), tilt_rad=0.05, **tracks
    )
    config = dataclasses.replace(OPEN, variant=variant, landmark_coordinates=coordinates)
    ekf = filter_of(world, config, EVERYTHING, up=TILTED @ Z)
    prior = gauge_information(ekf)
    for k in range(len(world)):
        if k:
            ekf.predict(world.twist[k], world.time_s[k] - world.time_s[k - 1])
        ekf.update(k, *world.observations.at(k))
    ratio = np.linalg.eigvals(np.linalg.solve(prior, gauge_information(ekf))).real
    if variant == "standard":
        assert ratio.max() > 10
    else:
        np.testing.assert_allclose(ratio, 1.0, atol=1e-6)


def gauge_information(ekf):
    """Information (6, 6) about where the world is, from all but clones: exact velocities tell that of the pose."""
    body, layout = np.zeros((ekf.gaussian.body, 6)), ekf.model.layout
    N = gauge_directions(ekf.linear_T_imu_world, ekf.linear_positions_m)
    body[layout["pose"]] = N[:6]
    body[layout["up"], 3:] = np.eye(3)
    clones = layout.columns(layout.clones.values())
    N, P = np.delete(np.vstack([body, N[6:]]), clones, 0), np.delete(np.delete(ekf.P, clones, 0), clones, 1)
    return N.T @ np.linalg.solve(P, N)


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
    np.testing.assert_array_equal(log.twist[1:], level.twist[1:])
    up = (log.T_departed[1:, :3, :3] @ log.up[1:, :, None])[..., 0]
    np.testing.assert_allclose(log.imu_twist[1:], in_imu(log.twist[1:], up), atol=1e-12)
    values = {"pose": log.T_updated[:-1], "up": np.broadcast_to(ekf.values["up"], (len(world) - 1, 3))}
    turned, _ = ekf.model.imu_velocities(values, log.twist[1:], log.T_updated[:-1, :3, :3])
    np.testing.assert_allclose(turned, world.twist[1:], atol=0.03)
