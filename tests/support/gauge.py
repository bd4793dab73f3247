"""Directions that no measurement can observe."""

from __future__ import annotations

import dataclasses

import numpy as np

from ekfslam.data.sequence import Noise
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import run_filter
from ekfslam.geometry import se3
from ekfslam.models.sensors.stereo import Rig

P0 = np.diag([0.2, 0.1, 0.3, 0.05, 0.04, 0.08]) ** 2


def exact_motion(sequence):
    """The sequence as seen by a filter that takes its velocities to be exact: W = 0, though they are noisy."""
    return dataclasses.replace(sequence, noise=Noise(np.zeros(6), sequence.noise.pixel_std_px))


def drive(sequence, config, P0=P0, frames=None):
    ekf = JointEKF(Rig(sequence.camera, sequence.T_cam_imu, sequence.noise), config, sequence.initial_T_world_imu, P0)
    for _ in run_filter(ekf, sequence, range(frames or len(sequence))):
        pass
    return ekf


def gauge_directions(T_imu_world, positions):
    """``N = [-Ad_T ; [I, -m_i^]]``: what moving the world by ``[rho; theta]`` does to the stored errors."""
    landmarks = np.concatenate([np.broadcast_to(np.eye(3), (len(positions), 3, 3)), -se3.skew(positions)], axis=-1)
    return np.vstack([-se3.adjoint(T_imu_world), landmarks.reshape(-1, 6)])
