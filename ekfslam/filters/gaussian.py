"""The joint Gaussian of body and landmarks, and the verbs that change it: nothing else writes the covariance.

Two forms have these verbs, and equal each other to rounding: `ekfslam.filters.dense` keeps P as one matrix and is the
readable one, `ekfslam.filters.conditional` is linear in the number of landmarks. Body columns come first (see
`ekfslam.models.blocks.Layout`), then three columns a landmark. ``frame`` and ``ids`` serve error messages alone.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, replace

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray


@dataclass(frozen=True)
class Rows:
    """Linearised measurements of k landmarks, d rows each.

    Args:
        slot: (k,) place of each landmark in the state.
        H_x, H_m: (k, d, seen), (k, d, 3) derivatives by the leading body columns and by the landmark, eq. (4).
        residual, variance: (k, d).
    """

    slot: IntArray
    H_x: Array
    H_m: Array
    residual: Array
    variance: Array

    def only(self, which: BoolArray | IntArray) -> Rows:
        """Return the rows of some of the landmarks."""
        return Rows(*(getattr(self, field.name)[which] for field in fields(self)))

    def corrected(self, x: Array, d: Array) -> Rows:
        """Return the rows with the residuals ``r - H (x, d)`` that corrections (seen,) and (n, 3) leave."""
        residual = self.residual - self.H_x @ x - (self.H_m @ d[self.slot, :, None])[..., 0]
        return replace(self, residual=residual)


@dataclass(frozen=True)
class Conditioned:
    """Effect of conditioning on rows: correction (body+3n,) of the mean, NIS and ``log det S``."""

    correction: Array
    nis: float = 0.0
    log_det: float = 0.0


class Projection(ABC):
    """Rows of k landmarks, projected through the covariance: ``H P H^T``, in the form of the Gaussian."""

    rows: Rows

    @property
    @abstractmethod
    def variances(self) -> Array:
        """``H_i P H_i^T`` (k, d, d) of each landmark's own rows."""

    @property
    @abstractmethod
    def S(self) -> Array:
        """``H P H^T + V`` (k d, k d), the joint covariance of all innovations."""

    @abstractmethod
    def only(self, which: IntArray) -> Projection:
        """Return the projection of some of the landmarks."""


class Solution(ABC):
    """Eq. (6) solved for some rows: what conditioning on them would do. The covariance has not changed yet."""

    @property
    @abstractmethod
    def done(self) -> Conditioned: ...

    @abstractmethod
    def given_others(self, which: IntArray) -> Array:
        """Return ``V^1/2 (S^-1)_ii V^1/2`` (j, d, d) for some landmarks (j,).

        The innovation of landmark i given those of all *others* has covariance ``((S^-1)_ii)^-1``.
        """

    @abstractmethod
    def without(self, out: BoolArray) -> Solution:
        """Return the solution without the rows of the landmarks ``out`` (k,)."""

    @abstractmethod
    def information(self, J: Array) -> Array:
        """Return ``J^T S^-1 J`` (c, c) for J (j, d, c) of the j landmarks that are left."""


class Gaussian(ABC):
    """Covariance of body columns and landmarks.

    Attributes:
        body: Number of body columns.
        seen: Number of leading body columns that observations depend on.
        considered: Number of *considered* columns at the end of the body, see `consider`.
    """

    body: int
    seen: int
    considered: int

    @property
    @abstractmethod
    def P(self) -> Array:
        """(body+3n, body+3n), read only."""

    @property
    @abstractmethod
    def landmarks(self) -> int:
        """Number n of landmarks."""

    @property
    def is_finite(self) -> bool:
        """Whether no number on the diagonal blocks is NaN or infinite."""
        return bool(np.isfinite(self.body_covariance).all() and np.isfinite(self.landmark_blocks()).all())

    @property
    @abstractmethod
    def body_covariance(self) -> Array:
        """(body, body), a copy."""

    @abstractmethod
    def landmark_blocks(self, slot: IntArray | None = None) -> Array:
        """Return the landmarks' own covariances (k, 3, 3), of all or at slots (k,). Read only."""

    @abstractmethod
    def covariance_of(self, slot: IntArray) -> Array:
        """Return the covariance (body+3k, body+3k) of the body and of the landmarks at the slots (k,)."""

    @abstractmethod
    def consider(self, columns: int) -> int:
        """Add columns to the end of the body that are considered but not estimated, zero at first; return the first.

        Conditioning changes only their cross-covariances, not their own covariance and mean (Schmidt, "Application of
        state-space methods to navigation problems", 1966).
        """

    @abstractmethod
    def clone(self, source: slice, to: slice) -> None:
        """Copy body columns into considered ones."""

    @abstractmethod
    def propagate(self, Phi: Array, Q: Array) -> None:
        """Propagate, eq. (2): ``P <- F P F^T + Q``, F = Phi (b, b) on estimated body columns and I on all others."""

    @abstractmethod
    def project(self, rows: Rows, frame: int, ids: IntArray) -> Projection:
        """Return the rows projected through P.

        Raises:
            InnovationError: The variance of some landmark's rows is not positive definite.
        """

    @abstractmethod
    def solve(self, projection: Projection, frame: int, ids: IntArray) -> Solution:
        """Solve eq. (6) for projected rows.

        Raises:
            InnovationError: The innovation covariance is not positive definite.
        """

    @abstractmethod
    def solve_body(self, H: Array, residual: Array, variance: Array, frame: int) -> Solution:
        """Solve eq. (6) for rows H (k, b) of the body alone, with residuals and variances (k,)."""

    @abstractmethod
    def apply(self, solution: Solution) -> None:
        """Condition on the rows of a solution of the present covariance."""

    @abstractmethod
    def augment(self, G: Array, covariance: Array) -> None:
        """Append landmarks with ``d = G x + w``, eq. (5): G (n, 3, seen), covariance (n, 3, 3) of w."""

    @abstractmethod
    def transform_landmarks(self, slot: IntArray, M: Array | None, B: Array, columns: IntArray) -> None:
        """Re-express errors of landmarks at slots (n,), ascending: ``d_i <- M_i d_i + B_i x``.

        M is (n, 3, 3), None is the identity; B is (n, 3, c) for the body columns (c,) of x.
        """

    @abstractmethod
    def transform_body(self, at: slice, A: Array) -> None:
        """Re-express some body columns, ``x_at <- A x_at`` with invertible A."""

    @abstractmethod
    def rest(self, asleep: BoolArray) -> None:
        """Set which landmarks (n,) are dormant, that is not observed before they wake; P stays unchanged."""

    @abstractmethod
    def marginalise(self, stay: BoolArray) -> None:
        """Drop the rows and columns of landmarks that do not stay (n,): exact marginalisation."""

    @abstractmethod
    def replace(self, P: Array) -> None:
        """Replace P by one of the same body and of other landmarks."""

    def start_over(self, P: Array) -> None:
        """Replace P, at a map revival, by one without considered columns: these become zero."""
        columns, self.body = self.considered, self.body - self.considered
        self.considered = 0
        self.replace(P)
        self.consider(columns)
