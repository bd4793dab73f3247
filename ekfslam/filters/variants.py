"""The linearisation variants of the joint filter: what happens to mean and covariance once a correction is known.

All variants share the prediction (1)-(2), the measurement rows (4), new landmarks (5) and the update (6), and keep P in
the stored coordinates ``T_imu_world = exp(xi^) T_hat``, ``m = m_hat + d``. They differ in the retraction.
"""

from __future__ import annotations

import numpy as np

from ekfslam import se3
from ekfslam.filters.symmetric import add_product
from ekfslam.se3 import Array


def retract_standard(T_imu_world: Array, positions_m: Array, xi: Array, d: Array) -> tuple[Array, Array]:
    """The textbook EKF: ``T+ = exp(xi^) T``, ``m+ = m + d``; P stays as it is.

    Known weakness: it gains information along directions that no measurement observes (the choice of the world frame),
    and so becomes overconfident, in heading first.
    """
    return se3.exp(xi) @ T_imu_world, positions_m + d


def retract_invariant(T_imu_world: Array, positions_m: Array, xi: Array, d: Array) -> tuple[Array, Array]:
    """Right-invariant EKF-SLAM in stored coordinates, first two lines of eq. (7).

    The correction acts as one rigid motion of the world (e_theta) on all landmarks, plus what remains of each. After
    it, `transport_invariant` re-expresses P in the stored coordinates at the new estimate. Source: Zhang, Wu, Song,
    Huang, Dissanayake, "Convergence and Consistency Analysis for a 3-D Invariant-EKF SLAM", RA-L 2017.

    Args:
        T_imu_world: (4, 4) pose before the correction.
        positions_m: (n, 3) landmarks before the correction.
        xi: (6,) correction of the pose.
        d: (n, 3) corrections of the landmarks.
    """
    e_theta = -T_imu_world[:3, :3].T @ xi[3:]
    e = d - positions_m @ se3.skew(e_theta).T
    R, J = se3.so3_exp_and_left_jacobian(e_theta)
    return se3.exp(xi) @ T_imu_world, positions_m @ R.T + e @ J.T


def transport_invariant(P: Array, T_before: Array, T_after: Array, moved_m: Array) -> None:
    """Last line of eq. (7), ``P <- J P J^T`` in place: rank 3 beyond the identity.

    Args:
        P: (6+3n, 6+3n) symmetric covariance, changed in place and kept symmetric to the last bit.
        T_before, T_after: (4, 4) ``T_imu_world`` before and after the correction, ``T_after = exp(xi^) T_before``.
        moved_m: (n, 3) how far the correction moved each landmark, ``m+ - m``.
    """
    Ad = se3.adjoint(T_after @ se3.inverse(T_before))
    # xi+ = Ad xi and d+ = d + B theta, hence P_mm+ = P_mm + B Z^T + Z B^T with Z = P_m,theta + B P_theta,theta / 2.
    B = (se3.skew(moved_m) @ T_before[:3, :3].T).reshape(-1, 3)
    Z = P[6:, 3:6] + 0.5 * B @ P[3:6, 3:6]
    P[6:, :6] = (P[6:, :6] + B @ P[3:6, :6]) @ Ad.T
    P_xx = Ad @ P[:6, :6] @ Ad.T
    P[:6, :6] = 0.5 * (P_xx + P_xx.T)
    no_pose = np.zeros((6, 3))
    add_product(P, np.vstack([no_pose, B]), np.vstack([no_pose, Z]))
