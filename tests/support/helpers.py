"""Synthetic recordings and results with known statistics, made without any filter.

The vehicle drives a winding road among random landmarks. Dead reckoning is genuine (it integrates noisy velocities),
the error of "full" is a scaled copy of it with equally scaled covariance: every NEES and NIS is honest by construction.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from ekfslam.config import Config
from ekfslam.data.sequence import Noise, Observations, Sequence, Truth
from ekfslam.evaluation.relative import dead_reckoned_pairs, relative_pairs
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import run_filter
from ekfslam.filters.result import REASONS, Innovation, Landmarks, Rejections, Result
from ekfslam.geometry import camera, motion, se3
from ekfslam.geometry.camera import StereoCamera, project
from ekfslam.smoother.fixed_lag import FixedLag
from ekfslam.smoother.revival import MapRevival
from ekfslam.stored import empty

CAMERA = StereoCamera(fu_px=700.0, fv_px=700.0, cu_px=600.0, cv_px=180.0, baseline_m=0.54)
# IMU axes forward, left, up; camera axes right, down, forward.
T_CAM_IMU = se3.transform(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.array([0.05, 0.3, -0.2]))
NOISE = Noise.isotropic(0.3, 0.01, 1.0)
STEP_S = 0.1
FULL_SCALE = 0.1  # error of "full" over error of "dead-reckoning"


def synthetic_sequence(frames: int = 200, landmarks: int = 300, seed: int = 0) -> Sequence:
    """A recording with noisy velocities and true pixels; truth of all poses and landmarks."""
    rng = np.random.default_rng(seed)
    time_s = STEP_S * np.arange(frames)
    twist = np.zeros((frames, 6))
    twist[:, 0], twist[:, 5] = 8.0, 0.25 * np.sin(0.3 * time_s)
    T_world_imu = np.stack(_integrate(twist))
    frame = rng.integers(0, frames, landmarks)
    offset = rng.uniform([5, -15, -1], [30, 15, 4], (landmarks, 3))
    points = se3.apply(T_world_imu[frame], offset)
    q = se3.apply(T_CAM_IMU @ se3.inverse(T_world_imu)[:, None], points)
    seen_frame, seen_id = np.nonzero((q[..., 2] > 3) & (q[..., 2] < 40) & (np.abs(q[..., 0]) < 0.8 * q[..., 2]))
    return Sequence(
        name="winding road",
        source="tests",
        time_s=time_s,
        twist=twist + NOISE.twist_std * rng.standard_normal((frames, 6)),
        camera=CAMERA,
        T_cam_imu=T_CAM_IMU,
        observations=Observations(seen_frame, seen_id, camera.project(CAMERA, q[seen_frame, seen_id])),
        truth=Truth(np.arange(frames), T_world_imu, np.arange(landmarks), points),
        noise=NOISE,
        notes=("made for a test",),
        attributes={"seed": seed, "input_sha256": "0" * 64},
    )


def synthetic_result(sequence: Sequence, mode: str = "full", seed: int = 1) -> Result:
    """A result as `mode` would leave it on a `synthetic_sequence`, its errors drawn from the covariances it states."""
    rng = np.random.default_rng(seed)
    frames, truth = len(sequence), sequence.truth
    assert truth is not None
    T_est, covariance = _integrate(sequence.twist), np.zeros((frames, 6, 6))
    for k in range(1, frames):
        F = motion.error_jacobian(motion.increment(sequence.twist[k], STEP_S))
        covariance[k] = F @ covariance[k - 1] @ F.T + motion.process_noise(sequence.twist[k], STEP_S, NOISE.twist_std)
    scale = FULL_SCALE if mode == "full" else 1.0
    pairs = dead_reckoned_pairs(*relative_pairs(truth, 100), truth.T_world_imu, scale**2 * covariance)
    xi = scale * se3.log(se3.inverse(truth.T_world_imu) @ T_est)
    zeros = np.zeros(frames, dtype=np.int64)
    blank = Innovation(np.zeros(frames), zeros, zeros, zeros)
    none = np.empty(0, dtype=np.int64)
    result = Result(
        mode=mode,
        sequence_name=sequence.name,
        time_s=sequence.time_s,
        T_world_imu=truth.T_world_imu @ se3.exp(xi),
        covariance=scale**2 * covariance,
        landmarks=empty(Landmarks),
        innovation=blank,
        rejections=Rejections(none, none, none),
        ms_per_frame=rng.gamma(4.0, 0.5, frames),
        counts={"accepted": 0},
        config=dataclasses.asdict(Config()),
        noise=NOISE,
        camera=sequence.camera,
        T_cam_imu=sequence.T_cam_imu,
        pairs=pairs,
        attributes={**sequence.attributes, "version_ekfslam": "0.1.0"},
    )
    if mode == "dead-reckoning":
        return result
    accepted = np.bincount(sequence.observations.frame, minlength=frames)
    rejected = rng.poisson(1.0, frames)
    rejected_frame = np.repeat(np.arange(frames), rejected)
    return dataclasses.replace(
        result,
        landmarks=_landmarks(sequence, truth, rng),
        innovation=Innovation(
            np.where(accepted > 0, rng.chisquare(np.maximum(3 * accepted, 1)), 0.0), 3 * accepted, accepted, rejected
        ),
        rejections=Rejections(
            rejected_frame,
            rng.choice(sequence.observations.ids, len(rejected_frame)),
            rng.integers(0, len(REASONS), len(rejected_frame)),
        ),
        counts={"accepted": int(accepted.sum()), "rejected": int(rejected.sum())},
    )


def _integrate(twist: np.ndarray) -> np.ndarray:
    poses = [np.eye(4)]
    for u in twist[1:]:
        poses.append(poses[-1] @ se3.exp(STEP_S * u))
    return np.stack(poses)


def _landmarks(sequence: Sequence, truth: Truth, rng: np.random.Generator) -> Landmarks:
    """Landmarks scattered about their truth as stereo does it: long along the line of sight of the first view."""
    ids, first, count = np.unique(sequence.observations.landmark, return_index=True, return_counts=True)
    first_frame = sequence.observations.frame[first]
    last_frame = np.array([sequence.observations.frame[sequence.observations.landmark == i].max() for i in ids])
    T_cam_world = T_CAM_IMU @ se3.inverse(truth.T_world_imu[first_frame])
    q = se3.apply(T_cam_world, truth.position_m[ids])
    C = np.swapaxes(T_cam_world[:, :3, :3], 1, 2)
    spread = C @ np.linalg.inv(camera.rectified_jacobian(CAMERA, q))
    initial = spread @ np.swapaxes(spread, 1, 2)
    covariance = initial / count[:, None, None]

    def scatter(P: np.ndarray) -> np.ndarray:
        return truth.position_m[ids] + (np.linalg.cholesky(P) @ rng.standard_normal((len(ids), 3, 1)))[..., 0]

    return Landmarks(ids, scatter(covariance), covariance, scatter(initial), first_frame, last_frame, count)


def run_joint(sequence, rig, config, calibration=None, revives=False, **options):
    """The joint filter over a sequence as one call.

    Returns:
        The filter as it ended; ``T_imu_world`` (T, 4, 4) after each frame; the report of each frame.
    """
    ekf = JointEKF(rig, config, sequence.initial_T_world_imu, calibration=calibration, **options)
    if revives:
        ekf.revival = MapRevival(ekf.model, config)
    poses, reports = [], []
    for frame in run_filter(ekf, sequence):
        poses.append(ekf.T_imu_world)
        reports.append(frame.report)
    return ekf, np.array(poses), reports


def filter_of(problem, engine=None):
    """A new filter of a resolved problem, by one of both implementations."""
    config = problem.config.filter if engine is None else dataclasses.replace(problem.config.filter, engine=engine)
    revival = MapRevival(problem.model, config) if config.revive >= 0 else None
    return JointEKF(problem.model, config, revival=revival, window=FixedLag)


def truth_error(sequence, result):
    """Distance (T,) of the estimated positions from the true ones, m."""
    truth = sequence.truth
    return np.linalg.norm(result.T_world_imu[truth.frame, :3, 3] - truth.T_world_imu[:, :3, 3], axis=1)


INERTIAL_KEYS = {
    "ate_aligned_4dof_m",
    "pose_nees_free_mean",
    "velocity_nees_mean",
    "gyro_bias_nees_mean",
    "accel_bias_nees_mean",
    "inertial_nees_mean",
}
SUMMARY_KEYS = INERTIAL_KEYS | {
    "ate_m",
    "ate_aligned_m",
    "final_error_m",
    "rpe_1_frame_m",
    "rpe_1_frame_deg",
    "rpe_10_m_m",
    "rpe_10_m_deg",
    "t_rel_percent",
    "r_rel_deg_per_100m",
    "ms_per_frame_median",
    "ms_per_frame_max",
    "total_s",
    "accepted",
    "rejected",
    "nis_per_dof",
    "pose_nees_mean",
    "pose_nees_with_truth_noise_mean",
    "pose_nees_apart_mean",
    *(f"pose_nees_{axis}_mean" for axis in ("x", "y", "z", "roll", "pitch", "yaw")),
    *(f"pose_nees_relative_{stretch}_mean" for stretch in ("10", "50", "100", "50_m", "100_m")),
    "landmark_rmse_m",
}


def erring_truth(truth, time_s, noise, rng):
    """Another truth, as far from the given one as the noise says: world and body are moved, then each pose errs."""
    first = np.array([noise.first_roll_rad, noise.first_pitch_rad, noise.first_yaw_rad])
    e0 = np.concatenate([noise.first_position_m * rng.standard_normal(3), first * rng.standard_normal(3)])
    T = se3.inverse(truth.T_world_imu)
    e0[3:] += T[0, :3, :2] @ (noise.world_tilt_rad * rng.standard_normal(2))
    turn = se3.exp(np.concatenate([np.zeros(3), noise.turn_rad * rng.standard_normal(3)]))
    step = se3.log(se3.inverse(truth.T_world_imu[:-1]) @ truth.T_world_imu[1:]) / np.diff(time_s)[:, None]
    own = np.repeat([noise.position_m, noise.attitude_rad], 3) * rng.standard_normal((len(T), 6))
    own[1:] -= noise.stamp_s * rng.standard_normal((len(step), 1)) * step
    moved = T @ se3.inverse(T[0]) @ se3.exp(e0) @ T[0]
    erring = se3.inverse(se3.exp(own) @ turn @ moved @ se3.inverse(T[0]) @ se3.inverse(turn) @ T[0])
    walk = noise.drift_m_sqrt_s * np.sqrt(np.diff(time_s))[:, None] * rng.standard_normal((len(T) - 1, 3))
    erring[1:, :3, 3] += np.cumsum(walk, axis=0)
    erring[1:, :3, 3] += noise.scale * rng.standard_normal() * (erring[1:, :3, 3] - erring[0, :3, 3])
    return dataclasses.replace(truth, T_world_imu=erring, noise=noise)


def grown(motion, flow_px):
    """By what the variances of a walk have grown (3,) where u, v and disparity have moved by ``motion`` (3,)."""
    u, v, d = motion**2
    return 1 + np.array([u + 0.35 * (v + d), v + 0.35 * (u + d), d + 0.35 * (u + v)]) / flow_px**2


def tracked(world, error, seed=1, movers=(), speed=0.3):
    """A small world recorded once more with errors of tracks; some landmarks travel along with the rig."""
    rng = np.random.default_rng(seed)
    observations, truth = world.observations, world.truth
    pixels, last = np.empty_like(observations.pixels_px), {}
    place = dict(zip(truth.landmark.tolist(), truth.position_m, strict=True))
    first = {}
    for i, (k, j) in enumerate(zip(observations.frame.tolist(), observations.landmark.tolist(), strict=True)):
        k0 = first.setdefault(j, k)
        travelled = truth.T_world_imu[k, :3, 3] - truth.T_world_imu[k0, :3, 3]
        m = place[j] + (speed * travelled if j in movers else 0.0)
        seen = project(world.camera, se3.apply(world.T_cam_imu @ se3.inverse(truth.T_world_imu[k]), m))
        if j not in last:
            e = error.first_std * rng.normal(size=3)
        else:
            k_last, e, seen_last = last[j]
            u, v, right, _ = seen - seen_last
            depth = world.camera.fu_px * world.camera.baseline_m / (seen[0] - seen[2])
            way = np.linalg.norm(truth.T_world_imu[k, :3, 3] - truth.T_world_imu[k - 1, :3, 3])
            growth = np.sqrt(grown(np.array([u, v, u - right]), error.flow_px) + (way / depth / error.parallax) ** 2)
            for _ in range(k_last, k):
                e = e + error.walk_std * growth * rng.normal(size=3)
        last[j] = k, e, seen
        pixels[i] = seen + np.array([e[0], e[1], e[0] - e[2], e[1]])
    moved = Observations(observations.frame, observations.landmark, pixels)
    return dataclasses.replace(world, observations=moved)
