"""The linearisation variants of the joint filter: where Jacobians are taken, and how a correction acts.

Equations (1) to (6) and the errors of P are the same for all. With landmarks in image coordinates, eq. (7'), all
variants move landmarks alike. Then they differ in the errors of poses after a correction, and (FEJ) in M and B.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.config import FilterConfig
from ekfslam.filters.coordinates import Change
from ekfslam.filters.gaussian import Gaussian
from ekfslam.geometry import se3
from ekfslam.models.blocks import Values
from ekfslam.models.model import Model


class Standard:
    """Jacobians at the estimate, plain retraction: every textbook's EKF.

    Known weakness: Jacobians at changing linearisation points give information about directions that no measurement
    observes (origin and rotation of the world). The heading becomes overconfident first.
    """

    name = "standard"
    first_estimates = False  # whether Jacobians are taken at first estimates
    is_frozen_exactly = True  # for landmarks in xyz, see the function of this name

    def linear(self, estimate: Array, first: Array) -> Array:
        """Return the linearisation point of a pose or of landmarks, given estimate and first estimate."""
        return first if self.first_estimates else estimate

    def retract_landmarks(self, positions_m: Array, e_theta: Array, d: Array) -> Array:
        """Return ``m+ = m + d`` (n, 3), given landmarks before the correction and its rotation (3,) of the world."""
        return positions_m + d

    def turned(self, before: Array, after: Array) -> Array:
        """Return the matrix (6, 6) from the error of a pose or view before a correction to that after it: here I."""
        return np.eye(6)

    def derivative(self, before: Array, after: Array) -> Array:
        """Return the matrix (6, 6) for rows of an iterated update: the derivative of ``exp(xi^) T``."""
        return np.asarray(se3.left_jacobian(se3.log(after @ se3.inverse(before))), dtype=float)

    def change(self, T_cam_world: Array, by: Array, slot: IntArray, moved_m: Array) -> Change:
        """Return the change of landmark errors in xyz by ``moved_m`` (n, 3), ``by`` (6, seen) of the camera: none."""
        return Change(slot, np.empty(0, dtype=np.int64), np.empty((len(moved_m), 3, 0)))

    def transport(
        self, gaussian: Gaussian, model: Model, before: Values, after: Values, changes: Iterable[Change]
    ) -> None:
        """Re-express the covariance by ``P <- G P G^T``: G has the changes, and `turned` of pose and views."""
        for change in changes:
            if len(change.columns) and len(change.slot):
                gaussian.transform_landmarks(change.slot, change.M, change.B, change.columns)

    def landmark_error(self, m_hat: Array, m_true: Array, T_world_imu_hat: Array, T_world_imu_true: Array) -> Array:
        """Return the landmark errors d (..., 3) that P is about, given poses at the time of P; shapes broadcast."""
        return m_true - m_hat


class FirstEstimates(Standard):
    """First-estimates Jacobians: poses are linearised where they were predicted, landmarks where they were first seen.

    So the unobservable directions never change. A of eq. (4) does not matter for that and is taken at the estimate: at
    first estimates the filter diverges when noise is large. Known weakness: a poor first estimate is never mended.
    Source: Huang, Mourikis, Roumeliotis, "Observability-based rules for designing consistent EKF SLAM estimators",
    IJRR 2010.
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

    def retract_landmarks(self, positions_m: Array, e_theta: Array, d: Array) -> Array:
        """Return ``m+`` (n, 3) of eq. (7): a rigid rotation of all landmarks, plus the remainder of each."""
        e = d - positions_m @ se3.skew(e_theta).T
        R, J = se3.so3_exp_and_left_jacobian(e_theta)
        return positions_m @ R.T + e @ J.T

    def turned(self, before: Array, after: Array) -> Array:
        """Return ``Ad(T+ T^-1)``, J of eq. (7) for a pose or a view.

        It is not the derivative of the retraction: it keeps the *invariant* error. So ``G N(X) = N(X+)`` for the
        unobservable directions N, and rows carried back through G contain no information along them. The exact
        derivative turns N by ``J_l(e)``; an iterated update with it gains heading from nothing.
        """
        return np.asarray(se3.adjoint(after @ se3.inverse(before)), dtype=float)

    derivative = turned

    def change(self, T_cam_world: Array, by: Array, slot: IntArray, moved_m: Array) -> Change:
        """Return the change of landmark errors in xyz, ``d+ = d - moved^ e_theta`` with ``e_theta = -R_W^T z_theta``.

        If camera and landmarks turn about it as one, images stay the same. So errors count with the camera's rotation;
        in world the filter would learn that of its calibration from noise.
        """
        columns = np.flatnonzero(by[3:].any(axis=0))
        return Change(slot, columns, se3.skew(moved_m) @ (T_cam_world[:3, :3].T @ by[3:, columns]))

    def transport(
        self, gaussian: Gaussian, model: Model, before: Values, after: Values, changes: Iterable[Change]
    ) -> None:
        super().transport(gaussian, model, before, after, changes)
        for name in ("pose", *model.layout.views):
            gaussian.transform_body(model.layout[name], self.turned(before[name], after[name]))

    def landmark_error(self, m_hat: Array, m_true: Array, T_world_imu_hat: Array, T_world_imu_true: Array) -> Array:
        """Return ``d_i = e_i - m_hat^ e_theta`` (..., 3) of eq. (7); it is ``m_true - m_hat`` to first order.

        ``R_true = exp(e_theta) R_hat`` and ``m_true = exp(e_theta) m_hat + J_l(e_theta) e_i``, with the pose's e_theta.
        """
        R_error = T_world_imu_true[..., :3, :3] @ np.swapaxes(T_world_imu_hat[..., :3, :3], -1, -2)
        e_theta = se3.so3_log(R_error)
        offset = m_true - (R_error @ m_hat[..., None])[..., 0]
        e_i = (se3.so3_left_jacobian_inverse(e_theta) @ offset[..., None])[..., 0]
        return e_i - np.cross(m_hat, e_theta)


VARIANTS: dict[str, Standard] = {variant.name: variant for variant in (Invariant(), FirstEstimates(), Standard())}


def is_frozen_exactly(config: FilterConfig) -> bool:
    """Return whether rows at the filter's linearisation points reproduce the filter, so that revivals can keep them."""
    return config.landmark_coordinates == "xyz" and not config.lag and VARIANTS[config.variant].is_frozen_exactly
