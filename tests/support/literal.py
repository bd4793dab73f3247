"""A second filter, written literally from the equations, on global coordinates."""

from __future__ import annotations

import copy
import dataclasses

import numpy as np

from ekfslam.config import CalibrationConfig, FilterConfig
from ekfslam.data.sequence import Observations
from ekfslam.filters.joint import JointEKF
from ekfslam.geometry import se3
from ekfslam.models.sensors.stereo import Rig
from support.gauge import gauge_directions
from support.reference import CAMERA, T_CAM_IMU

OPEN = FilterConfig(landmark_coordinates="xyz", gate_probability=1.0, split_after=0, retire="never", moving_sigma=1e9)
P0 = np.diag([0.1, 0.2, 0.3, 0.01, 0.02, 0.03]) ** 2
EVERYTHING = CalibrationConfig(rotation_deg=0.5, lever_arm_m=0.1, baseline=0.02, disparity_px=0.5, time_s=0.02)
TRACKS = {
    "track_first_px": np.array([0.3, 0.4, 0.8]),
    "track_walk_px": np.array([0.2, 0.25, 0.3]),
    "track_flow_px": 15.0,
}
X, Y, Z = np.eye(3)


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

    ``errors`` (6,) are those of the velocities. Without W these are those of the IMU.
    """
    u = twist if W is None else in_imu(twist, (T[..., :3, :3] @ W)[..., 2])
    if errors is not None:
        u = u + errors
    return se3.exp(-tau * u) @ T, u


def difference(T, T_hat):
    """Error (6,) of a pose."""
    return se3.log(T @ np.linalg.inv(T_hat))


def camera_pose(T, c, u, T_cam_imu):
    return se3.exp(c[..., :6]) @ T_cam_imu @ se3.exp(-c[..., 8:] * u) @ T


def seen_rows(T, c, u, m, camera=CAMERA, T_cam_imu=T_CAM_IMU):
    """Rows (uL, v, uR) that a rig with calibration parameters c (9,) has of points (n, 3)."""
    return rows_from(camera_pose(T, c, u, T_cam_imu), c, m, camera)


def rows_from(W, c, m, camera=CAMERA):
    """As `seen_rows`, from cameras W in world."""
    q = se3.apply(W[..., None, :, :], m)
    left = camera.fu_px * q[..., 0] / q[..., 2] + camera.cu_px
    v = camera.fv_px * q[..., 1] / q[..., 2] + camera.cv_px
    disparity = camera.fu_px * camera.baseline_m * np.exp(c[..., None, 6]) / q[..., 2] + c[..., None, 7]
    return np.stack([left, v, left - disparity], axis=-1)


def sighted(T, c, u, rows, camera=CAMERA, T_cam_imu=T_CAM_IMU):
    """The point (3,) that `seen_rows` sees so."""
    return sighted_from(camera_pose(T, c, u, T_cam_imu), c, rows, camera)


def sighted_from(W, c, rows, camera=CAMERA):
    """As `sighted`, from cameras W in world."""
    z = camera.fu_px * camera.baseline_m * np.exp(c[..., 6]) / (rows[..., 0] - rows[..., 2] - c[..., 7])
    x, y = (rows[..., 0] - camera.cu_px) / camera.fu_px * z, (rows[..., 1] - camera.cv_px) / camera.fv_px * z
    return se3.apply(np.linalg.inv(W), np.stack([x, y, z], axis=-1))


# From (uL, v, uR) to (u, v, disparity), and back.
BY_DISPARITY = np.array([[1.0, 0, 0], [0, 1, 0], [1, 0, -1]])


class Literal:
    """Textbook EKF: full-width numeric F, H and G, S^-1, Joseph's form. Nothing is gated or retired.

    The state is pose, view, view before, free calibration parameters, velocities, up, bias, landmarks, as in
    `JointEKF`; where the noise knows no tracks, velocities, up or bias, these have no columns. With ``images``
    landmarks are corrected in pixels (u, v, disparity) of the last updated view, eq. (7').
    """

    def __init__(self, sequence, variant, free=(), std=(), up=None, bias=None, images=False, P=P0):
        self.sequence, self.noise, self.variant = sequence, sequence.noise, variant
        self.free = np.array(free, dtype=int)
        self.images, self.updated, self.by_position = images, "view", 0
        self.T = self.departed = np.linalg.inv(sequence.initial_T_world_imu)
        self.view, self.before, self.c, self.twist, self.b = np.eye(4), np.eye(4), np.zeros(9), None, np.zeros(6)
        self.u = np.zeros(6)
        self.W = None if up is None else self.T[:3, :3].T @ level_axes(up)
        self.m, self.ids, self.first, self.last, self.rows = np.empty((0, 3)), [], {}, {}, {}
        self.walks, self.bias, self.tracks = self.noise.twist_walk_std is not None, bias, self.noise.track_error
        self.has_views = images or self.tracks is not None
        self.k, self.body, self.at = 0, 0, {}
        of_bias = np.zeros(0) if bias is None else np.repeat([bias.sigma_v_m_s, bias.sigma_w_rad_s], 3)
        prior = {
            "pose": P,
            "view": np.zeros((6 * self.has_views,) * 2),
            "before": np.zeros((6 * self.has_views,) * 2),
            "c": np.diag(np.square(std)),
            "twist": np.zeros((6 * self.walks,) * 2),
            "up": self.noise.tilt_rad**2 * np.eye(0 if up is None else 3),
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
            "view": self.view,
            "before": self.before,
            "c": self.c + e[..., self.at["c"]] @ np.eye(9)[self.free],
            "twist": self.twist,
            "W": self.W,
            "b": self.b,
        }
        if self.W is not None:
            found["W"] = se3.so3_exp(e[..., self.at["up"]]) @ self.W
        if self.has_views:
            for name in ("view", "before"):
                found[name] = se3.exp(e[..., self.at[name]]) @ getattr(self, name)
        if self.twist is not None:
            found["twist"] = self.twist + e[..., self.at["twist"]]
        if self.bias is not None:
            found["b"] = self.b + e[..., self.at["bias"]]
        return found

    def begin(self, measured):
        self.u = moved(self.T, self.W, measured, 0.0)[1]
        self.set_view()

    def camera(self, x, follows=False):
        """The camera in world with blocks x, as a single observation sees it or a difference."""
        return camera_pose(x["T"], x["c"], self.u, T_CAM_IMU)

    def set_view(self):
        """The view is where the camera is, and its error that of the blocks."""
        if not self.has_views:
            return
        E, here = np.eye(len(self.P)), self.camera(self.moved_by(np.zeros(len(self.P))))
        E[self.at["view"]] = stencil(lambda e: difference(self.camera(self.moved_by(e)), here), len(self.P))
        self.P, self.view = E @ self.P @ E.T, here

    def predict(self, measured, tau):
        self.way_m = tau * np.linalg.norm(measured[:3])
        if self.has_views:
            F = np.eye(len(self.P))
            F[self.at["before"]] = F[self.at["view"]]
            self.P, self.before, self.updated = F @ self.P @ F.T, self.view, "before"
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

        F, G = np.eye(len(self.P)), np.zeros((len(self.P), 6))
        F[:6] = stencil(after, len(self.P))
        G[:6] = stencil(lambda errors: difference(moved(self.T, self.W, twist, tau, errors)[0], T), 6)
        std = self.noise.motion_std if self.walks else np.hypot(self.noise.twist_std, self.noise.motion_std)
        self.P = F @ self.P @ F.T + G @ np.diag(std**2) @ G.T
        self.departed, self.T, self.u, self.tau, self.k = self.T, T, u, tau, self.k + 1
        self.set_view()

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
            self.set_view()
            self.correct(seen)
        for i, z in zip(ids.tolist(), rows, strict=True):
            if i not in self.ids:
                self.start(i, z)
            self.last[i], self.rows[i] = self.k, z
        self.updated = "view"

    def look(self, x, m, before=False, follows=False):
        """Rows of points (..., n, 3) now, or in the frame before, with disparities where tracks err."""
        rows = rows_from(x["before"] if before else self.camera(x, follows), x["c"], m)
        return rows if self.tracks is None else rows @ BY_DISPARITY.T

    def point(self, x, row):
        """The point (3,) that is seen so now."""
        back = np.eye(3) if self.tracks is None else BY_DISPARITY
        return sighted_from(x["view"] if self.has_views else self.camera(x), x["c"], row @ back.T)

    def correct(self, seen):
        variance = []
        for i, z, place in seen:
            if self.tracks is None:
                variance.append(self.noise.pixel_std_px[0] ** 2 * np.array([1, 0.5, 1]))
            elif self.last[i] == self.k - 1:
                u, v, d = (z - self.rows[i]) ** 2
                flow = np.array([u + 0.35 * (v + d), v + 0.35 * (u + d), d + 0.35 * (u + v)])
                parallax = self.way_m / se3.apply(self.view, self.m[place])[2] / self.noise.track_parallax
                growth = 1 + flow / self.noise.track_flow_px**2 + parallax**2
                variance.append(self.noise.track_walk_px**2 * growth)
            else:
                spread = self.noise.track_first_px**2
                for _ in range(self.first[i], self.k):
                    spread = spread + self.noise.track_walk_px**2
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
                    residual = residual - before
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
        """L, stored errors of poses, views and landmarks by the right-invariant ones; identity in between.

        Landmarks turn with the view, or else with the camera.
        """
        n, L = len(self.P), np.eye(len(self.P))
        L[:6, :6] = -se3.adjoint(self.T)
        if self.has_views:
            for name in ("view", "before"):
                L[self.at[name], self.at[name]] = -se3.adjoint(getattr(self, name))
            turned = np.eye(n)[self.at["view"]][3:]
        else:
            here = self.camera(self.moved_by(np.zeros(n)))
            turned = stencil(lambda e: difference(self.camera(self.moved_by(e)), here), n)[3:]
        W = self.view if self.has_views else here
        self.rotation = -W[:3, :3].T @ turned @ L
        self.turn_landmarks(L, self.rotation)
        return L

    def turn_landmarks(self, L, rotation):
        for j, m in enumerate(self.m):
            L[self.body + 3 * j : self.body + 3 * j + 3, : self.body] = -se3.skew(m) @ rotation[:, : self.body]

    def image(self, e, by_position):
        """Landmarks (n, 3) as the last updated camera has them, intrinsics as given; by positions where told so."""
        x, m = self.moved_by(e), self.m + e[..., self.body :].reshape(*e.shape[:-1], -1, 3)
        q = se3.apply(x[self.updated][..., None, :, :], m)
        y = rows_from(x[self.updated], np.zeros_like(x["c"]), m) @ BY_DISPARITY.T
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
        poses = {"pose": self.T, "view": self.view, "before": self.before}
        vars(self).update(self.moved_by(x))
        self.view = self.camera(self.moved_by(zero))
        W = getattr(self, self.updated)
        from_pixels = sighted_from(W, np.zeros(9), np.where(away[:, None], 1.0, moved_to) @ BY_DISPARITY.T)
        from_positions = se3.apply(np.linalg.inv(W), moved_to)
        self.m = np.where(away[:, None], from_positions, from_pixels)
        G, H_after = np.eye(len(x)), stencil(coordinates, len(x), 2e-3)
        if self.variant == "invariant":
            for name, T in poses.items():
                T_after = self.T if name == "pose" else getattr(self, name)
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
        stored = self.to_stored()
        after = self.moved_by(x)
        vars(self).update({name: value for name, value in after.items() if name not in ("T", "before", "view")})
        if self.variant == "standard":
            self.T, self.before, self.m = after["T"], after["before"], self.m + x[self.body :].reshape(-1, 3)
            self.view = self.camera(self.moved_by(np.zeros(len(x))))
            return
        rotation, e = self.rotation, np.linalg.inv(stored) @ x
        self.T = self.T @ se3.exp(-e[:6])
        if self.has_views:
            self.before = self.before @ se3.exp(-e[self.at["before"]])
        R, J = se3.so3_exp(rotation @ e), se3.so3_left_jacobian(rotation @ e)
        self.m = self.m @ R.T + e[self.body :].reshape(-1, 3) @ J.T
        self.view = self.camera(self.moved_by(np.zeros(len(x))))
        after = self.to_stored()
        self.turn_landmarks(after, rotation)
        transport = after @ np.linalg.inv(stored)
        self.P = transport @ self.P @ transport.T


# Blocks of `Literal`, and their names in a layout.
BLOCKS = {
    "pose": "pose",
    "view": "view",
    "before": "previous_view",
    "c": "calibration",
    "twist": "twist",
    "up": "up",
    "bias": "twist_bias",
    "jitter": "camera_jitter",
    "drift": "vision_drift",
}


def assert_same(ekf, literal, accuracy):
    """Compare all that a filter and the literal one hold."""
    layout = ekf.model.layout
    values = {name: getattr(literal, {"pose": "T", "bias": "b"}.get(name, name), None) for name in literal.at}
    values["up"] = None if literal.W is None else literal.W @ Z
    if not literal.k:
        values["before"] = None
    columns = [np.r_[layout[BLOCKS[name]]] for name in literal.at if BLOCKS[name] in layout]
    columns = np.concatenate([*columns, np.arange(layout.body, len(ekf.P))])
    pairs = [(ekf.values[BLOCKS[name]], x) for name, x in values.items() if BLOCKS[name] in layout and x is not None]
    assert literal.ids == ekf.ids.tolist()
    for ours, theirs in (*pairs, (ekf.positions_m, literal.m), (ekf.P[np.ix_(columns, columns)], literal.P)):
        np.testing.assert_allclose(ours, theirs, rtol=accuracy, atol=accuracy)
    np.testing.assert_array_equal(ekf.P, ekf.P.T)


def side_by_side(ekf, literal, world, accuracy, frames=None, shuffle=False):
    """Compare both after every prediction and update; return how often a difference of tracks, or a revisit, counted.

    With ``shuffle`` some of what is there is left out, the first landmark among it, and the rest comes in any order.
    """
    rng, follow, again = np.random.default_rng(3), 0, 0
    for k in range(frames or len(world)):
        if k:
            tau = world.time_s[k] - world.time_s[k - 1]
            ekf.predict(world.twist[k], tau), literal.predict(world.twist[k], tau)
            assert_same(ekf, literal, accuracy)
        else:
            ekf.begin(world.twist[0]), literal.begin(world.twist[0])
        ids, pixels = world.observations.at(k)
        some = rng.permutation(len(ids))[: max(3, len(ids) - 2)] if shuffle else np.arange(len(ids))
        if shuffle and k > 1:
            some = some[ids[some] != literal.ids[0]]
        last = [literal.last[i] for i in ids[some].tolist() if i in literal.ids]
        follow, again = follow + last.count(k - 1), again + sum(seen < k - 1 for seen in last)
        ekf.update(k, ids[some], pixels[some]), literal.update(ids[some], pixels[some])
        assert_same(ekf, literal, accuracy)
    return follow, again


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
    if up is not None:  # the engine takes no values from outside
        config = dataclasses.replace(config, engine="reference")
    ekf = JointEKF(rig, config, world.initial_T_world_imu, P, calibration, blocks=blocks)
    if up is not None:
        ekf.values["up"] = ekf.T_world_imu[:3, :3] @ up
    return ekf


TILTED = se3.so3_exp(np.array([0.3, -0.2, 0.0]))


def gauge_information(ekf):
    """Information (6, 6) about where the world is, from all but views: exact velocities tell those of the pose."""
    body, layout = np.zeros((ekf.gaussian.body, 6)), ekf.model.layout
    N = gauge_directions(ekf.linear_T_imu_world, ekf.linear_positions_m)
    body[layout["pose"]] = N[:6]
    body[layout["up"], 3:] = np.eye(3)
    views = layout.columns(layout.views)
    N, P = np.delete(np.vstack([body, N[6:]]), views, 0), np.delete(np.delete(ekf.P, views, 0), views, 1)
    return N.T @ np.linalg.solve(P, N)
