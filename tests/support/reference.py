"""Slow, literal implementations that the filters are compared with, and a small world to compare them on.

Nothing here shares a formula with the package beyond `se3`: four pixel rows instead of three, full-width Jacobians,
explicit inverses, loops over landmarks.
"""

from __future__ import annotations

import numpy as np

from ekfslam.data.sequence import Noise, Observations, Sequence, Truth
from ekfslam.geometry import se3
from ekfslam.geometry.camera import StereoCamera

CAMERA = StereoCamera(fu_px=700.0, fv_px=710.0, cu_px=600.0, cv_px=180.0, baseline_m=0.54)
# Optical axes turned out of the nominal directions by some degrees about every axis, and a lever arm.
NOMINAL = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
T_CAM_IMU = se3.transform(se3.so3_exp(np.array([0.05, -0.08, 0.11])) @ NOMINAL, np.array([0.3, -0.2, -0.9]))
D = np.vstack([np.eye(3), np.zeros((1, 3))])


def small_world(
    seed: int = 0,
    frames: int = 60,
    landmarks: int = 45,
    sigma_v: float = 0.3,
    sigma_w: float = 0.03,
    sigma_px: float = 0.8,
) -> Sequence:
    """A curved drive through a cloud of landmarks with shuffled, widely spaced ids that come into view and leave it."""
    rng = np.random.default_rng(seed)
    time = 100.0 + np.cumsum(rng.uniform(0.08, 0.12, frames))
    clean = np.column_stack(
        [rng.normal(m, s, frames) for m, s in ((6, 1), (0, 0.2), (0, 0.1), (0, 0.05), (0, 0.05), (0.5, 0.1))]
    )
    T_imu_world = [se3.exp(rng.normal(size=6))]
    for k in range(1, frames):
        T_imu_world.append(se3.exp(-(time[k] - time[k - 1]) * clean[k]) @ T_imu_world[-1])
    T_world_imu = se3.inverse(np.array(T_imu_world))
    # Around points of the path, so that something is in view all the time.
    anchor = rng.integers(0, frames, landmarks)
    offset = rng.uniform([4, -6, -2], [22, 6, 4], (landmarks, 3))
    position = se3.apply(T_world_imu[anchor], offset)
    ids = rng.permutation(landmarks * 7)[:landmarks]
    q = se3.apply(T_CAM_IMU, se3.apply(np.array(T_imu_world)[:, None], position[None]))
    depth = np.where(q[..., 2] > 1, q[..., 2], np.nan)
    u = CAMERA.fu_px * q[..., 0] / depth + CAMERA.cu_px
    v = CAMERA.fv_px * q[..., 1] / depth + CAMERA.cv_px
    pixels = np.stack([u, v, u - CAMERA.fu_px * CAMERA.baseline_m / depth, v], axis=-1)
    seen = (q[..., 2] > 3) & (q[..., 2] < 25) & (u > 0) & (u < 1240) & (v > -200) & (v < 600)
    seen &= rng.uniform(size=seen.shape) > 0.05
    # One unbroken track a landmark: what is lost stays lost.
    run = np.cumsum(seen, axis=0) > 0
    lost = np.cumsum(run & ~seen, axis=0) > 0
    frame, which = np.nonzero(seen & ~lost)
    noisy = pixels[frame, which] + rng.normal(0, sigma_px, (len(frame), 4))
    twist = clean + rng.normal(size=(frames, 6)) * np.repeat([sigma_v, sigma_w], 3)
    return Sequence(
        name="small",
        source="tests",
        time_s=time,
        twist=twist,
        camera=CAMERA,
        T_cam_imu=T_CAM_IMU,
        observations=Observations(frame, ids[which], noisy),
        truth=Truth(np.arange(frames), T_world_imu, ids, position),
        noise=Noise.isotropic(sigma_v, sigma_w, sigma_px),
    )


def stereo_matrix(camera: StereoCamera) -> np.ndarray:
    """M of the report."""
    f_u, f_v, c_u, c_v, b = camera.fu_px, camera.fv_px, camera.cu_px, camera.cv_px, camera.baseline_m
    return np.array([[f_u, 0, c_u, 0], [0, f_v, c_v, 0], [f_u, 0, c_u, -f_u * b], [0, f_v, c_v, 0]])


def jacobian_of_pi(q: np.ndarray) -> np.ndarray:
    """dpi/dq of the report, q homogeneous."""
    x, y, z, _ = q
    return np.array([[1 / z, 0, -x / z**2, 0], [0, 1 / z, -y / z**2, 0], [0, 0, 0, 0], [0, 0, -1 / z**2, 1 / z]])


def homogeneous(p: np.ndarray) -> np.ndarray:
    return np.append(p, 1.0)


def circle_dot(p: np.ndarray) -> np.ndarray:
    """``p (.)`` with ``xi^ p = p(.) xi``: (4, 6)."""
    return np.vstack([np.hstack([np.eye(3), -se3.skew(p[:3])]), np.zeros((1, 6))])


def triangulate_least_squares(camera: StereoCamera, z: np.ndarray, sigma_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Maximum-likelihood point in the camera frame from four pixels, and its covariance, by Gauss-Newton."""
    M = stereo_matrix(camera)
    depth = camera.fu_px * camera.baseline_m / (z[0] - z[2])
    q = np.array([(z[0] - camera.cu_px) * depth / camera.fu_px, (z[1] - camera.cv_px) * depth / camera.fv_px, depth])
    for _ in range(6):
        J = M @ jacobian_of_pi(homogeneous(q)) @ D
        r = z - M @ (homogeneous(q) / q[2])
        q = q + np.linalg.inv(J.T @ J) @ J.T @ r
    return q, sigma_px**2 * np.linalg.inv(J.T @ J)


def report_mapping(sequence: Sequence, T_imu_world: np.ndarray, sigma_px: float) -> dict[int, tuple]:
    """The report's landmark EKF, one landmark at a time, with its 4x4 innovation covariance and inverse."""
    M, oTi = stereo_matrix(sequence.camera), sequence.T_cam_imu
    V = sigma_px**2 * np.eye(4)
    estimates: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for k in range(len(sequence)):
        T = T_imu_world[k]
        for j, z in zip(*sequence.observations.at(k), strict=True):
            if j not in estimates:
                q, covariance = triangulate_least_squares(sequence.camera, z, sigma_px)
                T_world_cam = np.linalg.inv(oTi @ T)
                R = T_world_cam[:3, :3]
                estimates[j] = (T_world_cam @ homogeneous(q), R @ covariance @ R.T)
                continue
            mu, sigma = estimates[j]
            q = oTi @ T @ mu
            H = M @ jacobian_of_pi(q) @ oTi @ T @ D
            K = sigma @ H.T @ np.linalg.inv(H @ sigma @ H.T + V)
            estimates[j] = (mu + D @ K @ (z - M @ (q / q[2])), (np.eye(3) - K @ H) @ sigma)
    return estimates


class NaiveJointEKF:
    """Dense joint EKF with full-width F, H and explicit inverses; nothing is ever retired, four rows a landmark.

    ``form`` is "standard", "invariant" (textbook right-invariant: errors ``X = exp(e) X_hat`` in world, process
    noise in every landmark) with the pose error translation first.
    """

    def __init__(self, sequence: Sequence, form: str, P0: np.ndarray) -> None:
        self.sequence, self.form = sequence, form
        self.T = np.linalg.inv(sequence.initial_T_world_imu)
        self.m: list[np.ndarray] = []
        self.ids: list[int] = []
        self.P = self._pose_to_form() @ P0 @ self._pose_to_form().T

    def _pose_to_form(self) -> np.ndarray:
        return np.eye(6) if self.form == "standard" else -se3.adjoint(np.linalg.inv(self.T))

    def predict(self, u: np.ndarray, tau: float) -> None:
        n = len(self.P)
        W = np.diag(self.sequence.noise.twist_std**2)
        T_next = se3.exp(-tau * u) @ self.T
        if self.form == "standard":
            F = np.eye(n)
            F[:6, :6] = se3.adjoint(se3.exp(-tau * u))
            G = np.vstack([tau * se3.left_jacobian(-tau * u), np.zeros((n - 6, 6))])
        else:
            F = np.eye(n)
            # T_world_imu+ = exp(e) T exp(tau u) exp(-J_r tau n), and J_r(x) = J_l(-x); landmarks stay where they are.
            pose = -se3.adjoint(np.linalg.inv(T_next)) @ (tau * se3.left_jacobian(-tau * u))
            G = np.vstack([pose, *[se3.skew(m) @ pose[3:] for m in self.m]])
        self.P = F @ self.P @ F.T + G @ W @ G.T
        self.T = T_next

    def update(self, ids: np.ndarray, pixels: np.ndarray) -> None:
        known = [(self.ids.index(j), z) for j, z in zip(ids, pixels, strict=True) if j in self.ids]
        if known:
            self._correct(known)
        for j, z in zip(ids, pixels, strict=True):
            if j not in self.ids:
                self._append(int(j), z)

    def _correct(self, known: list[tuple[int, np.ndarray]]) -> None:
        M, oTi = stereo_matrix(self.sequence.camera), self.sequence.T_cam_imu
        H, r = np.zeros((4 * len(known), len(self.P))), np.zeros(4 * len(known))
        for row, (i, z) in enumerate(known):
            q = oTi @ self.T @ homogeneous(self.m[i])
            here = slice(4 * row, 4 * row + 4)
            r[here] = z - M @ (q / q[2])
            pixel = M @ jacobian_of_pi(q) @ oTi
            own = slice(6 + 3 * i, 9 + 3 * i)
            H[here, own] = pixel @ self.T @ D
            if self.form == "standard":
                H[here, :6] = pixel @ circle_dot(self.T @ homogeneous(self.m[i]))
            else:
                H[here, :3] = -pixel @ self.T @ D
        V = np.diag(np.tile(self.sequence.noise.pixel_std_px**2, len(known)))
        K = self.P @ H.T @ np.linalg.inv(H @ self.P @ H.T + V)
        e = K @ r
        self.P = (np.eye(len(self.P)) - K @ H) @ self.P
        if self.form == "standard":
            self.T = se3.exp(e[:6]) @ self.T
            self.m = [m + e[6 + 3 * i : 9 + 3 * i] for i, m in enumerate(self.m)]
        else:
            # One exponential of the group SE_{1+n}(3): the translation columns of exp are J_l times each tangent.
            R, J = se3.so3_exp(e[3:6]), se3.so3_left_jacobian(e[3:6])
            self.T = self.T @ se3.exp(-e[:6])
            self.m = [R @ m + J @ e[6 + 3 * i : 9 + 3 * i] for i, m in enumerate(self.m)]

    def _append(self, j: int, z: np.ndarray) -> None:
        q, covariance = triangulate_least_squares(self.sequence.camera, z, self.sequence.noise.pixel_std_px[0])
        T_world_cam = np.linalg.inv(self.sequence.T_cam_imu @ self.T)
        m = (T_world_cam @ homogeneous(q))[:3]
        if self.form == "standard":
            s = self.T @ homogeneous(m)
            G = -(np.linalg.inv(self.T) @ circle_dot(s))[:3]
        else:
            G = np.hstack([np.eye(3), np.zeros((3, 3))])
        n = len(self.P)
        wide = np.vstack([np.eye(n), np.hstack([G, np.zeros((3, n - 6))])])
        self.P = wide @ self.P @ wide.T
        self.P[n:, n:] += T_world_cam[:3, :3] @ covariance @ T_world_cam[:3, :3].T
        self.m.append(m)
        self.ids.append(j)

    def stored_covariance(self) -> np.ndarray:
        """P in stored coordinates (xi, d)."""
        if self.form == "standard":
            return self.P
        L = np.eye(len(self.P))
        L[:6, :6] = -se3.adjoint(self.T)
        for i, m in enumerate(self.m):
            L[6 + 3 * i : 9 + 3 * i, 3:6] = -se3.skew(m)
        return L @ self.P @ L.T


def run_naive(sequence: Sequence, form: str, P0: np.ndarray) -> tuple[list[np.ndarray], NaiveJointEKF]:
    """Poses ``T_imu_world`` after each frame, and the filter as it ended."""
    ekf, poses = NaiveJointEKF(sequence, form, P0), []
    for k in range(len(sequence)):
        if k > 0:
            ekf.predict(sequence.twist[k], sequence.time_s[k] - sequence.time_s[k - 1])
        ekf.update(*sequence.observations.at(k))
        poses.append(ekf.T)
    return poses, ekf
