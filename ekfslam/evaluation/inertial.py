"""Consistency of the state of an inertial unit: pose, velocity and biases.

Yaw and position of the world are free for an inertial unit. So the truth is moved by the four degrees of freedom with
which position and yaw of its first pose are those of the estimate, and the covariance loses what the start of the
estimate contributes by these four. If the truth begins later than the estimate, errors count from there, but
covariances from the start: the NEES is too small.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.sequence import Truth
from ekfslam.evaluation.consistency import nees, pose_errors
from ekfslam.filters.inertial_states import PARTS
from ekfslam.filters.result import Result
from ekfslam.geometry import se3

ALL = slice(0, 15)
_GAUGE = np.array([0, 1, 2, 5])  # position and yaw, of a motion of the world
_TILT = np.diag([1.0, 1.0, 0.0])


def aligned_at_first(truth: Truth, T_world_imu: Array) -> Truth:
    """Return the truth moved so that position and yaw of its first pose are those of the estimates (T, 4, 4)."""
    first, true = T_world_imu[truth.frame[0]], truth.T_world_imu[0]
    turn = first[:3, :3] @ true[:3, :3].T
    yaw = np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
    R = se3.so3_exp(np.array([0.0, 0.0, yaw]))
    moved, motion = se3.transform(R, first[:3, 3] - R @ true[:3, 3]), truth.motion
    if motion is not None:
        motion = dataclasses.replace(motion, velocity_m_s=motion.velocity_m_s @ R.T)
    return dataclasses.replace(truth, T_world_imu=moved @ truth.T_world_imu, motion=motion)


def gauge_covariance(result: Result, truth: Truth) -> Array:
    """Return the covariance (n, 6, 6) that position and yaw of the first estimate give to the errors of judged poses.

    A motion of the world by ``delta`` gives every pose the error ``xi = -Ad(T_imu_world) delta``. That of the first
    estimate takes its position and yaw; a tilt about its own position stays.
    """
    T = result.T_world_imu[truth.frame]
    R, p = result.T_world_imu[0, :3, :3], result.T_world_imu[0, :3, 3]
    # Errors of position and rotation along world from xi, then the motion of the world that explains position and yaw.
    by_error = np.zeros((6, 6))
    by_error[:3, :3] = by_error[3:, 3:] = -R
    turn = np.eye(3) - _TILT
    motion = np.zeros((6, 6))
    motion[:3, :3], motion[:3, 3:], motion[3:, 3:] = np.eye(3), se3.skew(p) @ turn, turn
    B = (motion @ by_error)[_GAUGE]
    J = -se3.adjoint(se3.inverse(T))[..., _GAUGE]
    return J @ (B @ result.covariance[0] @ B.T) @ J.swapaxes(1, 2)


def free_pose_errors(result: Result, truth: Truth) -> tuple[Array, Array]:
    """Return the errors ``xi`` (n, 6) of poses from the truth aligned at its first pose, and their covariance."""
    aligned = aligned_at_first(truth, result.T_world_imu)
    error, covariance = pose_errors(result, aligned, with_truth_noise=True)
    return error, covariance - gauge_covariance(result, truth)


def inertial_errors(result: Result, truth: Truth) -> tuple[Array, Array] | None:
    """Return errors (n, 15) of pose, velocity (IMU axes) and biases, and their covariance, if truth has them."""
    states, motion, frame = result.inertial, truth.motion, truth.frame
    if states is None or motion is None or not len(frame):
        return None
    error, of_pose = free_pose_errors(result, truth)
    velocity = (truth.T_world_imu[:, :3, :3].swapaxes(1, 2) @ motion.velocity_m_s[..., None])[..., 0]
    true = (velocity, motion.gyro_bias_rad_s, motion.accel_bias_m_s2)
    found = (states.velocity_m_s, states.gyro_bias_rad_s, states.accel_bias_m_s2)
    covariance = states.covariance[frame].copy()
    covariance[:, :6, :6] = of_pose
    return np.hstack([error, *(t - f[frame] for t, f in zip(true, found, strict=True))]), covariance


def inertial_nees(result: Result, truth: Truth) -> dict[str, Array] | None:
    """Return the NEES (n,) of the ``pose`` (6), ``velocity``, ``gyro_bias``, ``accel_bias`` (3) and of ``all`` (15).

    Without true motion there is the pose alone; None without an inertial unit or a true pose.
    """
    if result.inertial is None or not len(truth.frame):
        return None
    found = inertial_errors(result, truth)
    if found is None:
        return {"pose": nees(*free_pose_errors(result, truth))}
    error, P = found
    return {name: nees(error[:, at], P[:, at, at]) for name, at in {**PARTS, "all": ALL}.items()}
