"""The covariance of body and landmarks, and the verbs that change it: nothing else writes it (a transport excepted).

Body columns come first (see `ekfslam.models.blocks.Layout`), then three columns a landmark. Every verb works in place
on half of the symmetric matrix, and equals its naive form ``F P F^T + Q``, ``P - K S K^T`` and so on to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.linalg import blas, lapack

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.errors import InnovationError


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
        """The rows of some of the landmarks."""
        return Rows(*(getattr(self, field.name)[which] for field in fields(self)))

    def corrected(self, x: Array, d: Array) -> Rows:
        """The rows with the residuals ``r - H (x, d)`` that corrections (seen,) and (n, 3) leave."""
        residual = self.residual - self.H_x @ x - (self.H_m @ d[self.slot, :, None])[..., 0]
        return replace(self, residual=residual)


@dataclass(frozen=True)
class Conditioned:
    """What conditioning on rows did.

    Args:
        correction: (body+3n,) of the mean.
        nis: Normalised innovation squared.
        log_det: ``log det S``.
        Y: (body+3n, k) ``Y^T`` of eq. (6), by whose square P has shrunk; None of a difference.
    """

    correction: Array
    nis: float
    log_det: float
    Y: Array | None = None

    def __sub__(self, other: Conditioned) -> Conditioned:
        return Conditioned(self.correction - other.correction, self.nis - other.nis, self.log_det - other.log_det)


class Gaussian:
    """Dense covariance ``P`` (body+3n, body+3n).

    Args:
        body: (body, body) covariance before there are landmarks.
        seen: Leading body columns that observations depend on.

    Attributes:
        body: Number of columns before those of landmarks.
        considered: How many of these, at their end, are *considered*: see `consider`.
    """

    def __init__(self, body: Array, seen: int) -> None:
        self.P, self.body, self.seen = np.array(body, dtype=float), len(body), seen
        self.considered = 0

    @property
    def body_covariance(self) -> Array:
        """(body, body), a copy."""
        return self.P[: self.body, : self.body].copy()

    def consider(self, columns: int) -> int:
        """Add columns to the end of the body, certain zeros at first, of what is considered but not estimated.

        Conditioning changes their cross-covariances, and leaves their own covariance and their mean as they are
        (Schmidt, "Application of state-space methods to navigation problems", 1966).

        Returns:
            The first of them.
        """
        start = self.body
        self.P = np.insert(np.insert(self.P, [start] * columns, 0.0, axis=0), [start] * columns, 0.0, axis=1)
        self.body, self.considered = start + columns, self.considered + columns
        return start

    def clone(self, source: slice, to: slice) -> None:
        """Considered columns take the place of body columns: from now on they are what these are now."""
        self.P[to] = self.P[source]
        self.P[:, to] = self.P[to].T
        self.P[to, to] = self.P[source, source]

    def propagate(self, Phi: Array, Q: Array) -> None:
        """``P <- F P F^T + Q`` with F = Phi (b, b) on the body and identity on what is considered and on landmarks."""
        b, P = len(Phi), self.P
        P_b = Phi @ P[:b]
        P_bb = P_b[:, :b] @ Phi.T + Q
        P[:b, b:] = P_b[:, b:]
        P[b:, :b] = P_b[:, b:].T
        P[:b, :b] = 0.5 * (P_bb + P_bb.T)

    def wander(self, at: slice, phi: Array, std: Array) -> None:
        """``x+ = phi x + w`` for some body columns (n,), element by element."""
        self.P[at] *= phi[:, None]
        self.P[:, at] *= phi
        own = np.arange(at.start, at.stop)
        self.P[own, own] += std**2

    def copy(self, at: slice, of: slice) -> None:
        """Some body columns (n,) become a clone of others: ``x_at+ = x_of``."""
        self.P[at] = self.P[of]
        self.P[:, at] = self.P[:, of]

    def variances(self, rows: Rows) -> Array:
        """``H_i P H_i^T`` (k, d, d) of each landmark's own rows, without what is between landmarks."""
        seen = self.seen
        cross = self.P[self.body :, :seen].reshape(-1, 3, seen)[rows.slot]
        cross = rows.H_m @ cross @ rows.H_x.swapaxes(1, 2)
        own = rows.H_m @ self.landmark_blocks()[rows.slot] @ rows.H_m.swapaxes(1, 2)
        return rows.H_x @ self.P[:seen, :seen] @ rows.H_x.swapaxes(1, 2) + cross + cross.swapaxes(1, 2) + own

    def project(self, rows: Rows) -> tuple[Array, Array]:
        """``H P`` (kd, body+3n) and ``H P H^T`` (kd, kd)."""
        k, d, size = *rows.residual.shape, len(self.P)
        H_x, seen = rows.H_x.reshape(k * d, -1), self.seen
        HP = (H_x @ self.P[:seen]).reshape(k, d, size)
        HP += rows.H_m @ self.P[self.body :].reshape(-1, 3, size)[rows.slot]
        HP = HP.reshape(k * d, size)
        own_columns = (self.body + 3 * rows.slot[:, None] + np.arange(3)).ravel()
        HPH = (rows.H_m @ HP.T[own_columns].reshape(k, 3, k * d)).reshape(k * d, k * d)
        HPH += H_x @ HP[:, :seen].T
        return HP, HPH

    def condition(self, rows: Rows, frame: int, ids: IntArray, sign: float = 1.0) -> Conditioned:
        """Eq. (6): condition on the rows (sign 1), or take rows out that P was conditioned on (sign -1).

        Args:
            rows: The measurements.
            frame, ids: Frame, and (k,) landmark ids, for the error message.
            sign: See above. Taking out is an update with noise -V: ``P + P H^T (V - H P H^T)^-1 H P``.

        Returns:
            The correction to add (subtract), and the NIS and ``log det S`` that the rows contribute.

        Raises:
            InnovationError: The innovation covariance is not positive definite.
        """
        HP, S = self.project(rows)
        S *= sign
        S.ravel()[:: len(S) + 1] += rows.variance.ravel()
        done = self._condition(HP, S, rows.residual.ravel(), sign, frame, ids)
        if sign < 0:
            # Here V - H P H^T = V S^-1 V, where S is the innovation covariance of these rows given the other ones.
            return replace(done, log_det=2.0 * float(np.log(rows.variance).sum()) - done.log_det)
        return done

    def condition_body(self, H: Array, residual: Array, variance: Array, frame: int) -> Conditioned:
        """Eq. (6) for rows H (k, b) of the body alone, with residuals and variances (k,)."""
        HP = H @ self.P[: H.shape[1]]
        S = HP[:, : H.shape[1]] @ H.T + np.diag(variance)
        return self._condition(HP, S, residual, 1.0, frame, np.empty(0, dtype=np.int64))

    def correction(self, rows: Rows, frame: int, ids: IntArray) -> Array:
        """The correction (body+3n,) that `condition` would make; P stays."""
        HP, S = self.project(rows)
        S.ravel()[:: len(S) + 1] += rows.variance.ravel()
        Y_transposed, whitened, _ = _whiten(S, HP, rows.residual.ravel(), frame, ids)
        return Y_transposed @ whitened

    def _condition(self, HP: Array, S: Array, residual: Array, sign: float, frame: int, ids: IntArray) -> Conditioned:
        Y_transposed, whitened, log_det = _whiten(S, HP, residual, frame, ids)
        self._add_square(Y_transposed, -sign)
        correction = Y_transposed @ whitened
        correction[self.body - self.considered : self.body] = 0.0
        return Conditioned(correction, float(whitened @ whitened), log_det, Y_transposed)

    def _add_square(self, A: Array, sign: float) -> None:
        """`add_square` on all but the own covariance of what is considered."""
        at = slice(self.body - self.considered, self.body)
        own = self.P[at, at].copy()
        add_square(self.P, A, sign)
        self.P[at, at] = own

    def undo(self, done: Conditioned) -> None:
        """Take back the last conditioning, to rounding."""
        assert done.Y is not None
        self._add_square(done.Y, 1.0)

    def augment(self, G: Array, covariance: Array) -> None:
        """Append landmarks with ``d = G x + w``, eq. (5): G (n, 3, seen), covariance (n, 3, 3) of w."""
        n = len(G)
        G = G.reshape(3 * n, self.seen)
        size, grown = len(self.P), len(self.P) + 3 * n
        P = np.empty((grown, grown))
        P[:size, :size] = self.P
        P[size:, :size] = G @ self.P[: self.seen]
        P[:size, size:] = P[size:, :size].T
        P_new = P[size:, : self.seen] @ G.T
        P[size:, size:] = 0.5 * (P_new + P_new.T)
        block = np.arange(n)
        P[size:, size:].reshape(n, 3, n, 3)[block, :, block, :] += covariance
        self.P = P

    def transform_landmarks(self, M: Array, B: Array, columns: IntArray) -> None:
        """``d_i <- M_i d_i + B_i x``: landmark errors in other coordinates.

        Args:
            M: (n, 3, 3).
            B: (n, 3, c) by some of the body, x.
            columns: (c,) of x.
        """
        b, P, n = self.body, self.P, len(M)
        B = B.reshape(3 * n, len(columns))
        rows = (M @ P[b:].reshape(n, 3, len(P))).reshape(3 * n, len(P))
        rows += B @ P[columns]
        P_mm = (M @ rows[:, b:].T.reshape(n, 3, 3 * n)).reshape(3 * n, 3 * n)
        P_mm += B @ rows[:, columns].T
        P[b:, :b] = rows[:, :b]
        P[:b, b:] = P[b:, :b].T
        np.multiply(P_mm + P_mm.T, 0.5, out=P[b:, b:])

    def marginalise(self, stay: BoolArray) -> None:
        """Drop the rows and columns of landmarks that do not stay (n,): exact marginalisation."""
        kept = np.flatnonzero(np.concatenate([np.ones(self.body, dtype=bool), np.repeat(stay, 3)]))
        self.P = self.P[kept].take(kept, axis=1)

    def replace(self, P: Array) -> None:
        """Another covariance of the same body and of other landmarks: when P is put back."""
        self.P = P

    def start_over(self, P: Array) -> None:
        """The same at a map revival: P has no columns of what is considered, whose covariance is lost."""
        columns, self.body, self.P = self.considered, self.body - self.considered, np.ascontiguousarray(P, dtype=float)
        self.considered = 0
        self.consider(columns)

    def landmark_blocks(self) -> Array:
        """The landmarks' own covariances (n, 3, 3), a view of P that must not be written to."""
        b, (row, column) = self.body, self.P.strides
        n = (len(self.P) - b) // 3
        return np.lib.stride_tricks.as_strided(
            self.P[b:, b:], (n, 3, 3), (3 * (row + column), row, column), writeable=False
        )


def add_square(P: Array, A: Array, sign: float) -> None:
    """``P += sign A A^T`` in place, for symmetric C-ordered P (n, n) and A (n, k); symmetric to the last bit."""
    _require_order(P)
    # NumPy's row-major P is LAPACK's column-major P^T: the upper triangle there is the lower one here.
    blas.dsyrk(sign, A, beta=1.0, c=P.T, lower=0, overwrite_c=1)
    _mirror(P)


def add_product(P: Array, A: Array, B: Array) -> None:
    """``P += A B^T + B A^T`` in place, for symmetric C-ordered P (n, n), A and B (n, k)."""
    _require_order(P)
    blas.dsyr2k(1.0, A, B, beta=1.0, c=P.T, lower=0, overwrite_c=1)
    _mirror(P)


def _require_order(P: Array) -> None:
    if not P.flags.c_contiguous:
        raise ValueError("P must be C-contiguous, or BLAS would update a copy of it")


def _mirror(P: Array) -> None:
    np.copyto(P, P.T, where=~np.tri(len(P), dtype=bool))


def _whiten(S: Array, HP: Array, residual: Array, frame: int, ids: IntArray) -> tuple[Array, Array, float]:
    """``Y^T = (L^-1 H P)^T`` and ``L^-1 r`` of eq. (6), with ``S = L L^T``, and ``log det S``.

    Raises:
        InnovationError: S is not positive definite.
    """
    # LAPACK sees row-major arrays as their transposes: S is symmetric, and (H P)^T is what dtrsm wants.
    L, failed = lapack.dpotrf(S.T, lower=1, clean=0, overwrite_a=1)
    if failed:
        raise InnovationError(frame, ids)
    Y_transposed = blas.dtrsm(1.0, L, HP.T, side=1, lower=1, trans_a=1, overwrite_b=1)
    log_det = 2.0 * float(np.log(L.diagonal()).sum())
    return Y_transposed, blas.dtrsm(1.0, L, residual.reshape(-1, 1), lower=1)[:, 0], log_det
