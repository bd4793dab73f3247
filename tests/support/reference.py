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
