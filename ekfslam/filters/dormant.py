"""Landmarks out of view in the conditional form: exact, and next to free until they are seen again.

Dormant landmarks are ``m_B = K_B x_X + eps_B`` with a *joint* covariance S of eps_B. Conditioning touches neither K_B
nor S. Where columns o leave X, and k stay, ``x_o = C x_k + eps_o`` with ``C = P_ok P_kk^-1`` and ``D = P_oo - C P_ko``:

    K_B <- K_B,k + K_B,o C        S <- S + K_B,o D K_B,o^T

Where landmarks R wake, they join X with ``m_R = K_R x_X + eps_R``, and of the others

    K_B <- [K_B - S_BR S_RR^-1 K_R,  S_BR S_RR^-1]        S <- S_BB - S_BR S_RR^-1 S_RB
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import blas, lapack

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.filters.dense import add_square

# Columns of squares that wait until S is written to: once for all of them is much cheaper.
WAITING = 192


class Dormant:
    """Dormant landmarks at slots (n,): K (3n, n_X), and cross (c, 3n) of the considered columns with eps_B."""

    def __init__(self, width: int, considered: int = 0) -> None:
        self.slot = np.empty(0, dtype=np.int64)
        self.K, self.cross = np.empty((0, width)), np.empty((considered, 0))
        self._S = np.empty((0, 0))
        self._squares = np.empty((0, 0))  # S is this much more, or less, than _S: U diag(sign) U^T
        self._sign = np.empty(0)

    def __len__(self) -> int:
        return len(self.slot)

    def append(self, slot: IntArray, K: Array, S: Array) -> None:
        """Add landmarks (n,) with K (n, 3, n_X) and S (n, 3, 3), independent given X."""
        before, n = 3 * len(self), 3 * len(slot)
        self.slot = np.concatenate([self.slot, slot])
        self.K = np.concatenate([self.K, K.reshape(n, -1)])
        self.cross = np.pad(self.cross, ((0, 0), (0, n)))
        grown = np.zeros((before + n, before + n))
        grown[:before, :before] = self._S
        at = before + 3 * np.arange(len(slot))[:, None] + np.arange(3)
        grown[at[:, :, None], at[:, None, :]] = S
        self._S = grown
        self._squares = np.concatenate([self._squares, np.zeros((n, self._squares.shape[1]))])

    def columns_leave(self, P: Array, P_c: Array, leaving: IntArray) -> bool:
        """Drop columns (o,) of X with covariance P (n_X, n_X); P_c (c, n_X) is that of considered columns with X.

        Return whether some landmark depended on them, and so depends on all columns that stay.
        """
        kept = np.delete(np.arange(len(P)), leaving)
        K_kept, K_leaving = self.K[:, kept], self.K[:, leaving]
        depends = bool(len(self)) and bool(K_leaving.any())
        if depends:
            C, root = _given(P, kept, leaving)
            K_kept += K_leaving @ C
            self._add(K_leaving @ root, 1.0)
            self.cross = self.cross + (P_c[:, leaving] - P_c[:, kept] @ C.T) @ K_leaving.T
        self.K = K_kept
        return depends

    def wake(self, which: BoolArray) -> tuple[Array, Array, Array]:
        """Wake landmarks as the last columns of X; return their K (3r, n_X), S (3r, 3r) and cross (c, 3r)."""
        own, rest = (np.flatnonzero(np.repeat(part, 3)) for part in (which, ~which))
        S_own = self.covariance(own)
        K_own, S_rr, S_rb = self.K[own], S_own[:, own], S_own[:, rest]
        L, failed = lapack.dpotrf(S_rr, lower=1, clean=1)
        if failed:
            L = _root(S_rr)
        V = np.linalg.lstsq(L, S_rb, rcond=None)[0] if failed else blas.dtrsm(1.0, L, S_rb, lower=1)
        gain = np.linalg.lstsq(L.T, V, rcond=None)[0] if failed else blas.dtrsm(1.0, L, V, lower=1, trans_a=1)
        cross = self.cross[:, own]
        self.cross = self.cross[:, rest] - cross @ gain
        self.slot = self.slot[~which]
        self.K = np.hstack([self.K[rest] - gain.T @ K_own, gain.T])
        self._S, self._squares = self._S[np.ix_(rest, rest)], self._squares[rest]
        self._add(V.T, -1.0)
        return K_own, S_rr, cross

    def leave(self, stay: BoolArray) -> None:
        """Marginalise the landmarks that do not stay (n,)."""
        rows = np.flatnonzero(np.repeat(stay, 3))
        self.slot, self.K, self.cross = self.slot[stay], self.K[rows], self.cross[:, rows]
        self._S, self._squares = self._S[np.ix_(rows, rows)], self._squares[rows]

    def transform(self, own: IntArray, M: Array | None, B: Array, columns: IntArray) -> None:
        """Re-express landmarks with the rows ``own`` (3n,): ``d_i <- M_i d_i + B_i x``."""
        if M is not None:
            wide = np.eye(3 * len(self))
            at = own.reshape(-1, 3)
            wide[at[:, :, None], at[:, None, :]] = M
            self._fold()
            self.K, self.cross, self._S = wide @ self.K, self.cross @ wide.T, wide @ self._S @ wide.T
            self._S = 0.5 * (self._S + self._S.T)
        self.K[own[:, None], columns] += B.reshape(len(own), -1)

    def transform_promoted(self, own: IntArray, M: Array | None, B: Array, columns: IntArray) -> None:
        """Keep m_B while columns ``own`` (3n,) of X become ``x_own <- M x_own + B x_columns``, B (3n, c)."""
        K = self.K[:, own]
        if M is not None:
            K = (K.reshape(len(K), len(M), 1, 3) @ np.linalg.inv(M)).reshape(K.shape)
            self.K[:, own] = K
        self.K[:, columns] -= K @ B

    def covariance(self, own: IntArray) -> Array:
        """Return rows (r, 3n) of S."""
        return self._S[own] + (self._squares[own] * self._sign) @ self._squares.T

    def blocks(self, which: IntArray) -> Array:
        """Return the diagonal blocks (k, 3, 3) of S of landmarks (k,)."""
        at = 3 * which[:, None] + np.arange(3)
        squares = self._squares[at]
        return self._S[at[:, :, None], at[:, None, :]] + (squares * self._sign) @ squares.swapaxes(1, 2)

    def _add(self, A: Array, sign: float) -> None:
        """Add ``sign A A^T`` to S."""
        self._squares = np.hstack([self._squares, A])
        self._sign = np.concatenate([self._sign, np.full(A.shape[1], sign)])
        if len(self._sign) > WAITING:
            self._fold()

    def _fold(self) -> None:
        for sign in (1.0, -1.0):
            if (which := self._sign == sign).any() and len(self._S):
                add_square(self._S, self._squares[:, which], sign)
        self._squares, self._sign = np.empty((len(self._S), 0)), np.empty(0)


def _given(P: Array, kept: IntArray, leaving: IntArray) -> tuple[Array, Array]:
    """Return C (o, k) of ``x_o = C x_k + eps``, and a root of the covariance of eps."""
    order = np.concatenate([kept, leaving])
    std = np.sqrt(np.maximum(P.diagonal()[order], 0.0))
    std[std == 0.0] = 1.0
    L, failed = lapack.dpotrf(P[np.ix_(order, order)] / np.outer(std, std), lower=1, clean=1)
    k = len(kept)
    if not failed:
        C = blas.dtrsm(1.0, L[:k, :k], L[k:, :k], side=1, lower=1)
        return C * (std[k:, None] / std[:k]), L[k:, k:] * std[k:, None]
    # Something is known for certain, or twice.
    scaled = P[np.ix_(order, order)] / np.outer(std, std)
    C = np.linalg.lstsq(scaled[:k, :k], scaled[:k, k:], rcond=1e-13)[0].T
    D = scaled[k:, k:] - C @ scaled[:k, k:]
    return C * (std[k:, None] / std[:k]), _root(D) * std[k:, None]


def _root(S: Array) -> Array:
    """Return a root of a symmetric matrix that is positive semi-definite but for rounding."""
    values, axes = np.linalg.eigh(0.5 * (S + S.T))
    return axes * np.sqrt(np.maximum(values, 0.0))
