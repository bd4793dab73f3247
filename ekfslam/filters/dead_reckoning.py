"""Dead reckoning: the report's prediction (1) alone, with the covariance (2) that it carries along."""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.noise import Noise
from ekfslam.data.sequence import Sequence
from ekfslam.geometry import motion, se3


def dead_reckon(sequence: Sequence, noise: Noise, initial_covariance: Array) -> tuple[Array, Array]:
    """Return ``T_imu_world`` (T, 4, 4) and covariances (T, 6, 6) of ``xi`` from the velocities alone, eq. (1) and (2).

    The first pose is `initial_T_world_imu`, its error has ``initial_covariance``. Velocities of visual odometry have
    the standard deviation of the twist's walk.
    """
    tau = np.diff(sequence.time_s)
    T_imu_world = motion.integrate(se3.inverse(sequence.initial_T_world_imu), sequence.twist, tau)
    F = motion.error_jacobian(motion.increment(sequence.twist[1:], tau))
    gap_std = np.where(sequence.interpolated[1:, None], noise.gap_std, 0.0)
    own_std = noise.velocity_std
    if not sequence.has_velocities and noise.twist_walk_std is not None:
        own_std = noise.twist_walk_std
    velocity_std = np.hypot(own_std, gap_std)
    Q = motion.process_noise(sequence.twist[1:], tau, velocity_std)
    covariance = np.empty((len(sequence), 6, 6))
    covariance[0] = initial_covariance
    for k in range(1, len(sequence)):
        P = F[k - 1] @ covariance[k - 1] @ F[k - 1].T + Q[k - 1]
        covariance[k] = 0.5 * (P + P.T)
    return T_imu_world, covariance
