"""The linearisation variants of the joint filter: what happens to mean and covariance once a correction is known.

All variants share the prediction (1)-(2), the measurement rows (4), new landmarks (5) and the update (6), and keep P in
the stored coordinates ``T_imu_world = exp(xi^) T_hat``, ``m = m_hat + d``. They differ in where the Jacobians are taken
and in the retraction; `RULES` says how.

- ``standard``: Jacobians at the estimate, plain retraction. Every textbook's EKF. Known weakness: the directions that
  no measurement observes (where the world's origin is, which way it is turned) are seen from ever new linearisation
  points, and so the filter gains information about them that does not exist; its heading becomes overconfident first.
- ``fej``: first-estimates Jacobians. Poses are linearised where they were predicted, landmarks where they were first
  estimated, so that the unobservable directions stay the same for good. A of eq. (4) does not matter for that and is
  taken at the estimate: with A at first estimates too, the filter turns a little less noisy where noise is moderate
  and diverges where it is large. Known weakness: a poor first estimate is never mended. Source: Huang, Mourikis,
  Roumeliotis, "Observability-based rules for designing consistent EKF SLAM estimators", IJRR 2010.
- ``invariant``: Jacobians at the estimate, but the correction acts on the group: the unobservable directions do not
  depend on the estimate at all. Source: Zhang, Wu, Song, Huang, Dissanayake, "Convergence and Consistency Analysis for
  a 3-D Invariant-EKF SLAM", RA-L 2017. Known weakness: a correction of the heading moves every landmark in the state.

The iterated update (``iterations > 1``) goes with ``standard`` and ``invariant``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ekfslam.arrays import Array
from ekfslam.filters.symmetric import add_product
from ekfslam.geometry import se3


def retract_standard(T_imu_world: Array, positions_m: Array, xi: Array, d: Array) -> tuple[Array, Array]:
    """``T+ = exp(xi^) T``, ``m+ = m + d``; P stays as it is. Shapes as in `retract_invariant`."""
    return se3.exp(xi) @ T_imu_world, positions_m + d


def retract_invariant(T_imu_world: Array, positions_m: Array, xi: Array, d: Array) -> tuple[Array, Array]:
    """Right-invariant EKF-SLAM in stored coordinates, first two lines of eq. (7).

    The correction acts as one rigid motion of the world (e_theta) on all landmarks, plus what remains of each. After
    it, `transport_invariant` re-expresses P in the stored coordinates at the new estimate.

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
        P: (b+3n, b+3n) symmetric covariance, changed in place and kept symmetric to the last bit.
        T_before, T_after, moved_m: The correction, as in `derivative_invariant`.
    """
    Ad, by_rotation, _ = derivative_invariant(T_before, T_after, moved_m)
    # xi+ = Ad xi and d+ = d + B theta, hence P_mm+ = P_mm + B Z^T + Z B^T with Z = P_m,theta + B P_theta,theta / 2.
    # What else stands behind the pose (see `JointEKF`) is in the frame of the rig: nothing changes for it.
    B = np.zeros((len(P) - 6, 3))
    B[len(B) - 3 * len(moved_m) :] = by_rotation.reshape(-1, 3)
    Z = P[6:, 3:6] + 0.5 * B @ P[3:6, 3:6]
    P[6:, :6] = (P[6:, :6] + B @ P[3:6, :6]) @ Ad.T
    P_xx = Ad @ P[:6, :6] @ Ad.T
    P[:6, :6] = 0.5 * (P_xx + P_xx.T)
    no_pose = np.zeros((6, 3))
    add_product(P, np.vstack([no_pose, B]), np.vstack([no_pose, Z]))


def derivative_invariant(T_before: Array, T_after: Array, moved_m: Array) -> tuple[Array, Array, Array]:
    """J of eq. (7), block by block: what the stored errors before a correction are after it.

    This is not the derivative of `retract_invariant` in the parameters (xi, d): it keeps the *invariant* error, which
    is the same before and after. So ``J N(X) = N(X+)`` for the unobservable directions N, and rows carried back through
    J still see nothing along them. The exact derivative turns them by ``J_l(e)``; an iterated update with that one
    gains heading out of nothing.

    Args:
        T_before, T_after: (4, 4) ``T_imu_world`` before and after the correction, ``T_after = exp(xi^) T_before``.
        moved_m: (n, 3) how far the correction moved each landmark, ``m+ - m``.

    Returns:
        (6, 6) new pose error by the old one; new landmark errors (n, 3, 3) by the old rotation error, and (n, 3, 3) by
        the old landmark errors.
    """
    by_rotation = se3.skew(moved_m) @ T_before[:3, :3].T
    return se3.adjoint(T_after @ se3.inverse(T_before)), by_rotation, np.broadcast_to(np.eye(3), by_rotation.shape)


def derivative_standard(T_before: Array, T_after: Array, moved_m: Array) -> tuple[Array, Array, Array]:
    """Derivative of `retract_standard` in (xi, d), exact; arguments and blocks as in `derivative_invariant`."""
    none = np.zeros((len(moved_m), 3, 3))
    return se3.left_jacobian(se3.log(T_after @ se3.inverse(T_before))), none, none + np.eye(3)


class Retract(Protocol):
    def __call__(self, T_imu_world: Array, positions_m: Array, xi: Array, d: Array) -> tuple[Array, Array]: ...


class Transport(Protocol):
    def __call__(self, P: Array, T_before: Array, T_after: Array, moved_m: Array) -> None: ...


class Derivative(Protocol):
    def __call__(self, T_before: Array, T_after: Array, moved_m: Array) -> tuple[Array, Array, Array]: ...


@dataclass(frozen=True)
class Rule:
    """One variant of the joint filter.

    Args:
        retract: How a correction changes the mean.
        transport: How P is re-expressed after it; None if it stays.
        derivative: How errors before a correction become errors after it; carries the rows of an iterated update back.
        first_estimates: Whether Jacobians are taken at first estimates.
    """

    retract: Retract
    transport: Transport | None
    derivative: Derivative
    first_estimates: bool


RULES: dict[str, Rule] = {
    "invariant": Rule(retract_invariant, transport_invariant, derivative_invariant, first_estimates=False),
    "fej": Rule(retract_standard, None, derivative_standard, first_estimates=True),
    "standard": Rule(retract_standard, None, derivative_standard, first_estimates=False),
}
