"""The linearisation variants of the joint filter, one class each: everything that is a variant's own.

All variants share the prediction (1)-(2), the measurement rows (4), new landmarks (5) and the update (6), and keep P in
the stored coordinates ``T_imu_world = exp(xi^) T_hat``, ``m = m_hat + d``. They differ in where Jacobians are taken and
in how a correction acts. With landmarks in image coordinates, eq. (7'), all variants move them alike. Then they differ
in how the errors of poses before a correction become those after it, and (FEJ) in where M and B are taken.

The iterated update (``iterations > 1``) goes with ``standard`` and ``invariant``, in image coordinates.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.config import FilterConfig
from ekfslam.filters.coordinates import Change
from ekfslam.filters.gaussian import Gaussian, Rows
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
        is_frozen_exactly: Whether, with landmarks in xyz, rows frozen where the filter linearised them are the filter;
            see the function of this name.
    """

    name = "standard"
    first_estimates = False
    is_frozen_exactly = True

    def linear(self, estimate: Array, first: Array) -> Array:
        """Return the linearisation point of a pose or of landmarks, given estimate and first estimate."""
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

    def turned(self, before: Array, after: Array) -> Array:
        """Return the matrix (6, 6) from the stored error of a pose before a correction to that after it: here I."""
        return np.eye(6)

    def derivative(self, before: Array, after: Array) -> Array:
        """Return the matrix (6, 6) for rows of an iterated update: the derivative of ``exp(xi^) T``."""
        return np.asarray(se3.left_jacobian(se3.log(after @ se3.inverse(before))), dtype=float)

    def change(self, model: Model, before: Values, slot: IntArray, moved_m: Array) -> Change:
        """Errors of landmarks (n,) in xyz after a correction that moved them by ``moved_m`` (n, 3): here they stay."""
        return Change(slot, np.empty(0, dtype=np.int64), np.empty((len(moved_m), 3, 0)))

    def transport(
        self, gaussian: Gaussian, model: Model, before: Values, after: Values, changes: Iterable[Change]
    ) -> None:
        """Re-express the covariance after a correction that changed errors of landmarks: ``P <- G P G^T``.

        G has M and B of the changes, and `turned` of each pose: 3x3 blocks, and a rank beyond them which is the number
        of the changes' columns.
        """
        for change in changes:
            if len(change.columns) and len(change.slot):
                gaussian.transform_landmarks(change.slot, change.M, change.B, change.columns)

    def carry_back(self, rows: Rows, model: Model, before: Values, after: Values, change: Change) -> Rows:
        """Rows taken at a corrected state in the errors before the correction, for an iterated update: the chain rule.

        The change (k) is of the landmarks of the rows, with `derivative` for its pose.
        """
        H_x = rows.H_x.copy()
        for name in model.layout.poses:
            at = model.layout[name]
            H_x[..., at] = H_x[..., at] @ self.derivative(before[name], after[name])
        H_x[..., change.columns] += rows.H_m @ change.B
        H_m = rows.H_m if change.M is None else rows.H_m @ change.M
        return Rows(rows.slot, H_x, H_m, rows.residual, rows.variance)

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

    def turned(self, before: Array, after: Array) -> Array:
        """Third line of eq. (7), ``Ad(T+ T^-1)``.

        It is not the derivative of the retraction: it keeps the *invariant* error, which is the same before and after.
        So ``G N(X) = N(X+)`` for the unobservable directions N, and rows carried back through G still see nothing along
        them. The exact derivative turns them by ``J_l(e)``; an iterated update with it gains heading from nothing.
        """
        return np.asarray(se3.adjoint(after @ se3.inverse(before)), dtype=float)

    derivative = turned

    def change(self, model: Model, before: Values, slot: IntArray, moved_m: Array) -> Change:
        """Return the change of landmark errors in xyz by rotations: of the pose, and of the camera if estimated."""
        start = model.layout["pose"].start + 3
        columns, by = np.arange(start, start + 3), se3.skew(moved_m) @ before["pose"][:3, :3].T
        calibration = model.observer.calibration
        if calibration is None or not len(calibration.turns_camera):
            return Change(slot, columns, by)
        by_camera = calibration.landmarks_by_rotation(
            model.observer.rig, before[calibration.name], before["pose"], moved_m
        )
        columns = np.concatenate([columns, model.layout[calibration.name].start + calibration.turns_camera])
        return Change(slot, columns, np.concatenate([by, by_camera], axis=-1))

    def transport(
        self, gaussian: Gaussian, model: Model, before: Values, after: Values, changes: Iterable[Change]
    ) -> None:
        super().transport(gaussian, model, before, after, changes)
        for name in model.layout.poses:
            gaussian.transform_body(model.layout[name], self.turned(before[name], after[name]))

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


def is_frozen_exactly(config: FilterConfig) -> bool:
    """Return whether rows frozen at the filter's linearisation points have the filter as solution.

    A landmark that comes back then takes its place among them, otherwise all rows are linearised again.
    """
    return config.landmark_coordinates == "xyz" and VARIANTS[config.variant].is_frozen_exactly
