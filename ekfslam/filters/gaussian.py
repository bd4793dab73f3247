"""The joint Gaussian of body and landmarks, and the verbs that change it: nothing else writes the covariance.

Two forms have these verbs, and equal each other to rounding: `ekfslam.filters.dense` keeps P as one matrix and is the
readable one, `ekfslam.filters.conditional` keeps landmarks given what they depend on and is linear in their number.
Body columns come first (see `ekfslam.models.blocks.Layout`), then three columns a landmark.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, replace

from ekfslam.arrays import Array, BoolArray, IntArray


@dataclass(frozen=True)
class Rows:
    """Linearised measurements of k landmarks, d rows each.

    Args:
        slot: (k,) place of each landmark in the state.
        H_x: (k, d, seen) by the leading body columns.
        H_m: (k, d, 3) by the landmark.
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
    """Effect of conditioning on rows.

    Args:
        correction: (body+3n,) of the mean.
        nis: Normalised innovation squared.
        log_det: ``log det S``.
    """

    correction: Array
    nis: float = 0.0
    log_det: float = 0.0


class Projection(ABC):
    """Rows seen through the covariance: ``H P H^T`` and what its form needs besides.

    Attributes:
        rows: The k rows.
    """

    rows: Rows

    @property
    @abstractmethod
    def variances(self) -> Array:
        """``H_i P H_i^T`` (k, d, d) of each landmark's own rows."""

    @abstractmethod
    def only(self, which: IntArray) -> Projection:
        """Return the projection of some of the landmarks."""


class Solution(ABC):
    """Eq. (6) solved for some rows: what conditioning on them would do. The covariance has not changed yet."""

    @property
    @abstractmethod
    def done(self) -> Conditioned:
        """Effect of conditioning on the rows."""

    @abstractmethod
    def given_others(self, which: IntArray) -> Array:
        """``V^1/2 (S^-1)_ii V^1/2`` (j, d, d) of the rows of some landmarks (j,), in their standard deviations.

        The innovation of landmark i given those of all *others* has covariance ``((S^-1)_ii)^-1``.
        """

    @abstractmethod
    def without(self, out: BoolArray) -> Solution:
        """Return the solution without the rows of the landmarks ``out`` (k,)."""

    @abstractmethod
    def information(self, J: Array) -> Array:
        """``J^T S^-1 J`` (c, c) for J (j, d, c) of the j landmarks that are left."""


class Gaussian(ABC):
    """Covariance of body columns and landmarks.

    Attributes:
        body: Number of columns before those of landmarks.
        seen: Leading body columns that observations depend on.
        considered: How many body columns, at their end, are *considered*: see `consider`.
    """

    body: int
    seen: int
    considered: int

    @property
    @abstractmethod
    def P(self) -> Array:
        """(body+3n, body+3n). Not to be written to."""

    @property
    @abstractmethod
    def landmarks(self) -> int:
        """Number n of landmarks."""

    @property
    @abstractmethod
    def is_finite(self) -> bool:
        """Whether no number is NaN or infinite."""

    @property
    @abstractmethod
    def body_covariance(self) -> Array:
        """(body, body), a copy."""

    @abstractmethod
    def landmark_blocks(self, slot: IntArray | None = None) -> Array:
        """Return the landmarks' own covariances (k, 3, 3), of all or at slots (k,). Read only."""

    @abstractmethod
    def covariance_of(self, slot: IntArray) -> Array:
        """(body+3k, body+3k) of the body and of the landmarks at the slots (k,)."""

    @abstractmethod
    def consider(self, columns: int) -> int:
        """Add columns to the end of the body, certain zeros at first, of what is considered but not estimated.

        Conditioning changes their cross-covariances, and leaves their own covariance and their mean as they are
        (Schmidt, "Application of state-space methods to navigation problems", 1966).

        Returns:
            The first of them.
        """

    @abstractmethod
    def clone(self, source: slice, to: slice) -> None:
        """Considered columns take the place of body columns: from now on they are what these are now."""

    @abstractmethod
    def propagate(self, Phi: Array, Q: Array) -> None:
        """``P <- F P F^T + Q`` with F = Phi (b, b) on the body and identity on what is considered and on landmarks."""

    @abstractmethod
    def project(self, rows: Rows, frame: int, ids: IntArray) -> Projection:
        """Return the rows seen through P; frame and ids (k,) are for the error message.

        Raises:
            InnovationError: The variance of some landmark's rows is not positive definite.
        """

    @abstractmethod
    def solve(self, projection: Projection, frame: int, ids: IntArray) -> Solution:
        """Eq. (6) for projected rows; frame and ids (k,) are for the error message.

        Raises:
            InnovationError: The innovation covariance is not positive definite.
        """

    @abstractmethod
    def solve_body(self, H: Array, residual: Array, variance: Array, frame: int) -> Solution:
        """Eq. (6) for rows H (k, b) of the body alone, with residuals and variances (k,)."""

    @abstractmethod
    def apply(self, solution: Solution) -> None:
        """Condition on the rows of a solution, which must be of the covariance as it is."""

    @abstractmethod
    def augment(self, G: Array, covariance: Array) -> None:
        """Append landmarks with ``d = G x + w``, eq. (5): G (n, 3, seen), covariance (n, 3, 3) of w."""

    @abstractmethod
    def transform_landmarks(self, slot: IntArray, M: Array | None, B: Array, columns: IntArray) -> None:
        """``d_i <- M_i d_i + B_i x``: errors of some landmarks (n,) in other coordinates.

        Args:
            slot: (n,) ascending.
            M: (n, 3, 3); None is the identity.
            B: (n, 3, c) by some of the body, x.
            columns: (c,) of x.
        """

    @abstractmethod
    def transform_body(self, at: slice, A: Array) -> None:
        """``x_at <- A x_at`` for some body columns, with invertible A."""

    @abstractmethod
    def rest(self, asleep: BoolArray) -> None:
        """Set which landmarks (n,) are dormant: they are not observed before they wake. P stays unchanged."""

    @abstractmethod
    def marginalise(self, stay: BoolArray) -> None:
        """Drop the rows and columns of landmarks that do not stay (n,): exact marginalisation."""

    @abstractmethod
    def replace(self, P: Array) -> None:
        """Another covariance of the same body and of other landmarks: when P is put back."""

    def start_over(self, P: Array) -> None:
        """Replace P at a map revival: it has no considered columns, whose covariance is lost."""
        columns, self.body = self.considered, self.body - self.considered
        self.considered = 0
        self.replace(P)
        self.consider(columns)
