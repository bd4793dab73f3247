"""The joint Gaussian of body and landmarks, and the verbs that change it: nothing else writes the covariance.

Here it is one matrix P; the engine has the verbs that are used outside of a frame. Body columns come first (see
`ekfslam.models.blocks.Layout`), then three a landmark. ``frame`` and ``ids`` serve error messages alone.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.errors import InnovationError


@dataclass(frozen=True)
class Rows:
    """Linearised measurements of k landmarks, d rows each."""

    slot: IntArray  # (k,) place of each landmark in the state
    # H_x, H_m: (k, d, seen), (k, d, 3) derivatives by the leading body columns and by the landmark, eq. (4).
    H_x: Array
    H_m: Array
    residual: Array  # residual, variance: (k, d)
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


@dataclass(frozen=True)
class Projection:
    """``H P`` (k d, body+3n) and ``H P H^T`` (k d, k d) of rows."""

    rows: Rows
    HP: Array
    HPH: Array

    @property
    def variances(self) -> Array:
        """``H_i P H_i^T`` (k, d, d) of each landmark's own rows."""
        k, d = self.rows.residual.shape
        own = np.arange(k)
        return self.HPH.reshape(k, d, k, d)[own, :, own, :]

    @property
    def S(self) -> Array:
        """``H P H^T + V`` (k d, k d), the joint covariance of all innovations."""
        return self.HPH + np.diag(self.rows.variance.ravel())

    def only(self, which: IntArray) -> Projection:
        """Return the projection of some of the landmarks."""
        row = _columns(which, self.rows.residual.shape[1])
        return Projection(self.rows.only(which), self.HP[row], self.HPH[np.ix_(row, row)])


@dataclass(frozen=True)
class Solution:
    """Eq. (6) with ``S = L L^T``."""

    Y: Array  # (body+3n, m) (L^-1 H P)^T, with P - Y Y^T the covariance afterwards
    L: Array  # (m, m), lower triangular
    white: Array  # (m,) L^-1 r
    std: Array  # (k, d) of the rows; d is 1 for rows of the body alone
    considered: slice  # columns of the mean that stay

    @cached_property
    def done(self) -> Conditioned:
        """The effect on the mean, NIS and ``log det S``."""
        correction = self.Y @ self.white
        correction[self.considered] = 0.0
        return Conditioned(correction, float(self.white @ self.white), 2.0 * float(np.log(self.L.diagonal()).sum()))

    def given_others(self) -> Array:
        """Return ``V^1/2 (S^-1)_ii V^1/2`` (k, d, d): ``((S^-1)_ii)^-1`` is the covariance given *others*."""
        columns = np.linalg.inv(self.L).T.reshape(*self.std.shape, len(self.L))
        return (columns @ columns.swapaxes(1, 2)) * (self.std[:, :, None] * self.std[:, None, :])

    def information(self, J: Array) -> Array:
        """Return ``J^T S^-1 J`` (c, c) for J (k, d, c)."""
        A = np.linalg.solve(self.L, J.reshape(len(self.L), J.shape[-1]))
        return A.T @ A


class Gaussian:
    """Covariance of body columns and landmarks, before there are landmarks that of the ``body`` (body, body).

    Attributes:
        body: Number of body columns.
        seen: Number of leading body columns that observations depend on.
        considered: Number of *considered* columns at the end of the body, see `consider`.
    """

    def __init__(self, body: Array, seen: int) -> None:
        self._P, self.body, self.seen = np.array(body, dtype=float), len(body), seen
        self.considered = 0

    @property
    def P(self) -> Array:
        """(body+3n, body+3n), read only."""
        return self._P

    @property
    def landmarks(self) -> int:
        """Number n of landmarks."""
        return (len(self._P) - self.body) // 3

    @property
    def is_finite(self) -> bool:
        """Whether no number on the diagonal blocks is NaN or infinite."""
        return bool(np.isfinite(self.body_covariance).all() and np.isfinite(self.landmark_blocks()).all())

    @property
    def body_covariance(self) -> Array:
        """(body, body), a copy."""
        return self._P[: self.body, : self.body].copy()

    @property
    def _considered(self) -> slice:
        return slice(self.body - self.considered, self.body)

    def landmark_blocks(self, slot: IntArray | None = None) -> Array:
        """Return the landmarks' own covariances (k, 3, 3), of all or at slots (k,)."""
        at = self._columns(np.arange(self.landmarks) if slot is None else slot).reshape(-1, 3)
        return self._P[at[:, :, None], at[:, None, :]]

    def covariance_of(self, slot: IntArray) -> Array:
        """Return the covariance (body+3k, body+3k) of the body and of the landmarks at the slots (k,)."""
        columns = np.concatenate([np.arange(self.body), self._columns(slot)])
        return self._P[np.ix_(columns, columns)]

    def _columns(self, slot: IntArray) -> IntArray:
        return self.body + _columns(slot, 3)

    def consider(self, columns: int) -> int:
        """Add columns to the end of the body that are considered but not estimated, zero at first; return the first.

        Conditioning changes only their cross-covariances, not their own covariance and mean (Schmidt, "Application of
        state-space methods to navigation problems", 1966).
        """
        start = self.body
        self._P = np.insert(np.insert(self._P, [start] * columns, 0.0, axis=0), [start] * columns, 0.0, axis=1)
        self.body, self.considered = start + columns, self.considered + columns
        return start

    def clone(self, source: slice, to: slice) -> None:
        """Copy body columns into considered ones."""
        P = self._P
        P[to] = P[source]
        P[:, to] = P[to].T
        P[to, to] = P[source, source]

    def propagate(self, Phi: Array, Q: Array) -> None:
        """Propagate, eq. (2): ``P <- F P F^T + Q``, F = Phi (b, b) on estimated body columns and I on all others."""
        b, P = len(Phi), self._P
        P_b = Phi @ P[:b]
        P_bb = P_b[:, :b] @ Phi.T + Q
        P[:b, b:] = P_b[:, b:]
        P[b:, :b] = P_b[:, b:].T
        P[:b, :b] = 0.5 * (P_bb + P_bb.T)

    def project(self, rows: Rows, frame: int, ids: IntArray) -> Projection:
        """Return the rows projected through P."""
        k, d, size = *rows.residual.shape, len(self._P)
        H_x, seen = rows.H_x.reshape(k * d, self.seen), self.seen
        HP = (H_x @ self._P[:seen]).reshape(k, d, size)
        HP += rows.H_m @ self._P[self.body :].reshape(self.landmarks, 3, size)[rows.slot]
        HP = HP.reshape(k * d, size)
        HPH = (rows.H_m @ HP.T[self._columns(rows.slot)].reshape(k, 3, k * d)).reshape(k * d, k * d)
        HPH += H_x @ HP[:, :seen].T
        return Projection(rows, HP, HPH)

    def solve(self, projection: Projection, frame: int, ids: IntArray) -> Solution:
        """Solve eq. (6) for projected rows; raise `InnovationError` if S is not positive definite."""
        rows = projection.rows
        return self._solve(projection.HP, projection.HPH, rows.residual, rows.variance, frame, ids)

    def solve_body(self, H: Array, residual: Array, variance: Array, frame: int) -> Solution:
        """Solve eq. (6) for rows H (k, b) of the body alone, with residuals and variances (k,)."""
        HP = H @ self._P[: H.shape[1]]
        HPH, nobody = HP[:, : H.shape[1]] @ H.T, np.empty(0, dtype=np.int64)
        return self._solve(HP, HPH, residual[:, None], variance[:, None], frame, nobody)

    def _solve(self, HP: Array, HPH: Array, residual: Array, variance: Array, frame: int, ids: IntArray) -> Solution:
        try:
            L = np.asarray(np.linalg.cholesky(HPH + np.diag(variance.ravel())), dtype=float)
        except np.linalg.LinAlgError:
            raise InnovationError(frame, ids) from None
        if not np.isfinite(L.diagonal()).all():
            raise InnovationError(frame, ids)
        white = np.linalg.solve(L, residual.ravel())
        return Solution(np.linalg.solve(L, HP).T, L, white, np.sqrt(variance), self._considered)

    def apply(self, solution: Solution) -> None:
        """Condition on the rows of a solution of the present covariance."""
        at = self._considered
        own = self._P[at, at]
        self._P = self._P - solution.Y @ solution.Y.T
        self._P[at, at] = own

    def augment(self, G: Array, covariance: Array) -> None:
        """Append landmarks with ``d = G x + w``, eq. (5): G (n, 3, seen), covariance (n, 3, 3) of w."""
        n = len(G)
        G = G.reshape(3 * n, self.seen)
        size, grown = len(self._P), len(self._P) + 3 * n
        P = np.empty((grown, grown))
        P[:size, :size] = self._P
        P[size:, :size] = G @ self._P[: self.seen]
        P[:size, size:] = P[size:, :size].T
        P_new = P[size:, : self.seen] @ G.T
        P[size:, size:] = 0.5 * (P_new + P_new.T)
        block = np.arange(n)
        P[size:, size:].reshape(n, 3, n, 3)[block, :, block, :] += covariance
        self._P = P

    def transform_landmarks(self, slot: IntArray, M: Array | None, B: Array, columns: IntArray) -> None:
        """Re-express errors of landmarks at slots (n,), ascending: ``d_i <- M_i d_i + B_i x``.

        M is (n, 3, 3), None is the identity; B is (n, 3, c) for the body columns (c,) of x.
        """
        n, own, P = len(slot), self._columns(slot), self._P
        B = B.reshape(3 * n, len(columns))

        def turned(A: Array) -> Array:
            return A if M is None else (M @ A.reshape(n, 3, A.shape[1])).reshape(A.shape)

        rows = turned(P[own]) + B @ P[columns]
        block = turned(rows[:, own].T) + B @ rows[:, columns].T
        P[own] = rows
        P[:, own] = rows.T
        P[np.ix_(own, own)] = 0.5 * (block + block.T)

    def transform_body(self, at: slice, A: Array) -> None:
        """Re-express some body columns, ``x_at <- A x_at`` with invertible A."""
        P = self._P
        P[at] = A @ P[at]
        P[:, at] = P[at].T
        block = A @ P[at, at]
        P[at, at] = 0.5 * (block + block.T)

    def marginalise(self, stay: BoolArray) -> None:
        """Drop the rows and columns of landmarks that do not stay (n,): exact marginalisation."""
        kept = np.flatnonzero(np.concatenate([np.ones(self.body, dtype=bool), np.repeat(stay, 3)]))
        self._P = self._P[kept].take(kept, axis=1)

    def replace(self, P: Array) -> None:
        """Replace P by one of the same body and of other landmarks."""
        self._P = np.ascontiguousarray(P, dtype=float)

    def start_over(self, P: Array) -> None:
        """Replace P, at a map revival, by one without considered columns: these become zero."""
        columns, self.body = self.considered, self.body - self.considered
        self.considered = 0
        self.replace(P)
        self.consider(columns)


def _columns(which: IntArray, size: int) -> IntArray:
    """Return the columns (n size,) of blocks (n,) of one size."""
    return (size * which[:, None] + np.arange(size)).ravel()
