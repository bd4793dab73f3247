"""The linearisation variants of the joint filter, one class each: everything that is a variant's own.

All variants share the prediction (1)-(2), the measurement rows (4), new landmarks (5) and the update (6), and keep P in
the stored coordinates ``T_imu_world = exp(xi^) T_hat``, ``m = m_hat + d``. They differ in where Jacobians are taken and
in how a correction acts.

The iterated update (``iterations > 1``) goes with ``standard`` and ``invariant``.
"""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array
from ekfslam.filters.gaussian import Gaussian, Rows, add_product
from ekfslam.geometry import se3
from ekfslam.models.blocks import Values
from ekfslam.models.model import Model


class Standard:
    """Jacobians at the estimate, plain retraction: every textbook's EKF.

    Known weakness: the directions that no measurement observes (where the world's origin is, which way it is turned)
    are seen from ever new linearisation points. So the filter gains information about them that does not exist; its
    heading becomes overconfident first.

    Attributes:
        first_estimates: Whether Jacobians are taken at first estimates.
        is_frozen_exactly: Whether rows frozen where the filter linearised them are the filter: a landmark that comes
            back then takes its place among them, otherwise all rows are linearised again.
    """

    name = "standard"
    first_estimates = False
    is_frozen_exactly = True

    def linear(self, estimate: Array, first: Array) -> Array:
        """Where the Jacobian of a pose or of landmarks is taken, of the estimate and the first estimate."""
        return first if self.first_estimates else estimate

    def retract_landmarks(self, T_imu_world: Array, positions_m: Array, xi: Array, d: Array) -> Array:
        """``m+ = m + d`` (n, 3), where ``T+ = exp(xi^) T``.

        Args:
            T_imu_world: (4, 4) pose before the correction.
            positions_m: (n, 3) landmarks before the correction.
            xi: (6,) correction of the pose.
            d: (n, 3) corrections of the landmarks.
        """
        return positions_m + d

    def transport(self, gaussian: Gaussian, model: Model, before: Values, after: Values, moved_m: Array) -> None:
        """Re-express the covariance after a correction that moved landmarks by ``moved_m`` (n, 3); here it stays."""

    def carry_back(self, rows: Rows, model: Model, before: Values, after: Values, moved_m: Array) -> Rows:
        """Rows taken at a corrected state in the errors before the correction, for an iterated update.

        The chain rule with the derivative of the retraction; ``moved_m`` (k, 3) is of the landmarks of the rows.
        """
        H_x = rows.H_x.copy()
        for name in model.layout.poses:
            at = model.layout[name]
            H_x[..., at] = H_x[..., at] @ se3.left_jacobian(se3.log(after[name] @ se3.inverse(before[name])))
        return Rows(rows.slot, H_x, rows.H_m, rows.residual, rows.variance)

    def landmark_error(self, m_hat: Array, m_true: Array, T_world_imu_hat: Array, T_world_imu_true: Array) -> Array:
        """Errors d (..., 3) of landmarks that the covariance is about; shapes broadcast.

        Args:
            m_hat, m_true: (..., 3) estimated and true positions in world.
            T_world_imu_hat, T_world_imu_true: (..., 4, 4) poses at the time at which the covariances hold.
        """
        return m_true - m_hat


class FirstEstimates(Standard):
    """First-estimates Jacobians: poses are linearised where they were predicted, landmarks where they were first seen.

    So the unobservable directions stay the same for good. A of eq. (4) does not matter for that and is taken at the
    estimate: with A at first estimates too, the filter turns a little less noisy where noise is moderate and diverges
    where it is large. Known weakness: a poor first estimate is never mended. Source: Huang, Mourikis, Roumeliotis,
    "Observability-based rules for designing consistent EKF SLAM estimators", IJRR 2010.
    """

    name = "fej"
    first_estimates = True


class Invariant(Standard):
    """Jacobians at the estimate, but the correction acts on the group: eq. (7).

    The unobservable directions do not depend on the estimate at all. Source: Zhang, Wu, Song, Huang, Dissanayake,
    "Convergence and Consistency Analysis for a 3-D Invariant-EKF SLAM", RA-L 2017. Known weakness: a correction of the
    heading moves every landmark in the state.
    """

    name = "invariant"
    is_frozen_exactly = False

    def retract_landmarks(self, T_imu_world: Array, positions_m: Array, xi: Array, d: Array) -> Array:
        """Second line of eq. (7); arguments as in `Standard.retract_landmarks`.

        The correction acts as one rigid motion of the world (e_theta) on all landmarks, plus what remains of each.
        """
        e_theta = -T_imu_world[:3, :3].T @ xi[3:]
        e = d - positions_m @ se3.skew(e_theta).T
        R, J = se3.so3_exp_and_left_jacobian(e_theta)
        return positions_m @ R.T + e @ J.T

    def transport(self, gaussian: Gaussian, model: Model, before: Values, after: Values, moved_m: Array) -> None:
        """Last line of eq. (7), ``P <- J P J^T``: rank 3 beyond the identity and the adjoints of the poses.

        J is not the derivative of `retract`: it keeps the *invariant* error, which is the same before and after. So
        ``J N(X) = N(X+)`` for the unobservable directions N, and rows carried back through J still see nothing along
        them. The exact derivative turns them by ``J_l(e)``; an iterated update with it gains heading from nothing.
        """
        P = gaussian.P
        columns, by = self._landmarks_by_rotations(model, before, moved_m)
        # d+ = d + B a for the rotations a, hence P+ = P + B Z^T + Z B^T with Z = P_a + B P_aa / 2.
        B = np.zeros((len(P), by.shape[-1]))
        B[gaussian.body :] = by.reshape(-1, by.shape[-1])
        add_product(P, B, P[:, columns] + 0.5 * B @ P[np.ix_(columns, columns)])
        for name in model.layout.poses:
            at, Ad = model.layout[name], se3.adjoint(after[name] @ se3.inverse(before[name]))
            P[at] = Ad @ P[at]
            P[:, at] = P[at].T
            P_xx = Ad @ P[at, at]
            P[at, at] = 0.5 * (P_xx + P_xx.T)

    def carry_back(self, rows: Rows, model: Model, before: Values, after: Values, moved_m: Array) -> Rows:
        """The chain rule with J of eq. (7)."""
        H_x = rows.H_x.copy()
        for name in model.layout.poses:
            at = model.layout[name]
            H_x[..., at] = H_x[..., at] @ se3.adjoint(after[name] @ se3.inverse(before[name]))
        columns, by = self._landmarks_by_rotations(model, before, moved_m)
        H_x[..., columns] += rows.H_m @ by
        return Rows(rows.slot, H_x, rows.H_m, rows.residual, rows.variance)

    @staticmethod
    def _landmarks_by_rotations(model: Model, before: Values, moved_m: Array) -> tuple[Array, Array]:
        """Columns (a,) of rotations, and new landmark errors (n, 3, a) by them: of the pose, and of the camera."""
        start = model.layout["pose"].start + 3
        columns, by = np.arange(start, start + 3), se3.skew(moved_m) @ before["pose"][:3, :3].T
        calibration = model.calibration
        if calibration is None or not len(calibration.turns_camera):
            return columns, by
        by_camera = calibration.landmarks_by_rotation(model.rig, before["calibration"], before["pose"], moved_m)
        columns = np.concatenate([columns, model.layout["calibration"].start + calibration.turns_camera])
        return columns, np.concatenate([by, by_camera], axis=-1)

    def landmark_error(self, m_hat: Array, m_true: Array, T_world_imu_hat: Array, T_world_imu_true: Array) -> Array:
        """Errors (..., 3) as eq. (7) has them: what a rigid motion of the world does to pose and landmarks is no error.

        The right-invariant error couples a landmark to the rotation error ``e_theta`` of the pose of the same time,

            R_true = exp(e_theta) R_hat,    m_true = exp(e_theta) m_hat + J_l(e_theta) e_i,

        and eq. (7) stores it as ``d_i = e_i - m_hat^ e_theta``, which is ``m_true - m_hat`` to first order.
        """
        R_error = T_world_imu_true[..., :3, :3] @ np.swapaxes(T_world_imu_hat[..., :3, :3], -1, -2)
        e_theta = se3.so3_log(R_error)
        offset = m_true - (R_error @ m_hat[..., None])[..., 0]
        e_i = (se3.so3_left_jacobian_inverse(e_theta) @ offset[..., None])[..., 0]
        return e_i - np.cross(m_hat, e_theta)


VARIANTS: dict[str, Standard] = {variant.name: variant for variant in (Invariant(), FirstEstimates(), Standard())}
