"""The conditional form of the joint covariance: exact, and linear in the number of landmarks.

Landmarks that are initialised from the body and observed from the body are independent of each other given X: the body,
what its columns were some frames ago (the *window*), and a few *promoted* landmarks. So the joint Gaussian factors:

    N(x_X; 0, P_X) prod_i N(d_i; K_i x_X, S_i)

P_X (n_X, n_X) is dense, K_i is (3, n_X), S_i (3, 3). A promoted landmark is part of X; its K_i has ones at its own
columns and its S_i is zero, so that what follows holds for it, too. With rows ``r_i = H_x x + H_m d_i + v``, eq. (6) is

    R_i = H_m S_i H_m^T + V = L_i L_i^T        B_i = L_i^-1 (H_x + H_m K_i)        w_i = L_i^-1 r_i
    P_X = F F^T        T = B F        M = I + T^T T = U^T U        W = F U^-1        u = U^-T T^T w
    P_X+ = W W^T       x+ = W u       d_i+ = K_i x+ + G_i (w_i - B_i x+)           G_i = S_i H_m^T L_i^-T
    K_i+ = K_i - G_i B_i              S_i+ = S_i - G_i G_i^T

and ``S^-1 = L^-T (I - Z Z^T) L^-1`` with ``Z = T U^-1``. Kin: Guivant and Nebot, "Optimization of the simultaneous
localization and map-building algorithm for real-time implementation", T-RA 2001 (compressed filter).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import blas, lapack

from ekfslam import kernels
from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.errors import InnovationError
from ekfslam.filters.dense import transform, transform_part
from ekfslam.filters.dormant import Dormant
from ekfslam.filters.gaussian import Conditioned, Gaussian, Projection, Rows, Solution
from ekfslam.filters.window import Push, Window


@dataclass(frozen=True)
class ConditionalProjection(Projection):
    """Whitened rows (k) over X: L (k, d, d), B (k, d, n_X), T (k, d, f) and G (k, 3, d) of the module."""

    rows: Rows
    L: Array
    B: Array
    T: Array
    G: Array

    @cached_property
    def variances(self) -> Array:
        return kernels.own_variances(self.L, self.T, self.rows.variance)

    @property
    def S(self) -> Array:
        k, d = self.rows.residual.shape
        root, S = (self.L @ self.T).reshape(k * d, -1), np.zeros((k, d, k, d))
        S[np.arange(k), :, np.arange(k), :] = self.L @ self.L.swapaxes(1, 2)
        return S.reshape(k * d, k * d) + root @ root.T

    def only(self, which: IntArray) -> ConditionalProjection:
        return ConditionalProjection(self.rows.only(which), self.L[which], self.B[which], self.T[which], self.G[which])


@dataclass(frozen=True)
class ConditionalSolution(Solution):
    """Eq. (6) solved over X for landmarks ``left`` (k,): w (k, d) and U (f, f) of the module."""

    gaussian: ConditionalGaussian
    at: ConditionalProjection
    w: Array
    U: Array
    left: BoolArray

    @cached_property
    def T(self) -> Array:
        """(j d, f) of the rows that are left."""
        T = self.at.T if self.left.all() else self.at.T[self.left]
        return T.reshape(T.shape[0] * T.shape[1], T.shape[2])  # there may be no column

    @cached_property
    def u(self) -> Array:
        """(f,) ``U^-T T^T w``."""
        along = self.T.T @ self.w[self.left].ravel()
        return blas.dtrsm(1.0, self.U, along[:, None], lower=0, trans_a=1)[:, 0]

    @cached_property
    def W(self) -> Array:
        """(n_X, f) ``F U^-1``, the root of the covariance afterwards."""
        return blas.dtrsm(1.0, self.U, self.gaussian.root, side=1, lower=0)

    @cached_property
    def x(self) -> Array:
        """(n_X,) correction of X."""
        return self.W @ self.u

    @cached_property
    def residual(self) -> Array:
        """(k, d) ``w - B x``."""
        return self.w - self.at.B @ self.x

    @cached_property
    def done(self) -> Conditioned:
        w, L = self.w[self.left], self.at.L[self.left]
        log_det = 2.0 * float(np.log(self.U.diagonal()).sum() + np.log(np.diagonal(L, axis1=1, axis2=2)).sum())
        nis = float((w**2).sum() - self.u @ self.u)
        return Conditioned(self.gaussian.correction(self), nis, log_det)

    def given_others(self, which: IntArray) -> Array:
        T = self.at.T[which]
        # A row-major T is LAPACK's T^T, and Z^T = U^-T T^T.
        Z = blas.dtrsm(1.0, self.U, T.reshape(-1, T.shape[2]).T, lower=0, trans_a=1).T
        return kernels.given_others(self.at.L[which], Z.reshape(T.shape), self.at.rows.variance[which])

    def without(self, out: BoolArray) -> ConditionalSolution:
        return self.gaussian.solve_left(replace(self, left=self.left & ~out))

    def information(self, J: Array) -> Array:
        k, d, c = J.shape
        A = np.linalg.solve(self.at.L[self.left], J).reshape(k * d, c)
        along = blas.dtrsm(1.0, self.U, self.T.T @ A, lower=0, trans_a=1)
        return A.T @ A - along.T @ along


class ConditionalGaussian(Gaussian):
    """Covariance in the conditional form, before there are landmarks that of the ``body`` (body, body)."""

    def __init__(self, body: Array, seen: int) -> None:
        self.body, self.seen, self.considered = len(body), seen, 0
        self._P = np.array(body, dtype=float)
        # Of awake landmarks: K_i, S_i, and their slots; of all landmarks, which of these they are, or -1.
        self._K, self._S = np.empty((0, 3, len(body))), np.empty((0, 3, 3))
        self._slot = self._row = np.empty(0, dtype=np.int64)
        self._P_c, self._P_cc = np.empty((0, len(body))), np.empty((0, 0))
        self._window, self._dormant = Window(len(body)), Dormant(len(body))
        self._root: Array | None = None

    @property
    def landmarks(self) -> int:
        return len(self._row)

    @property
    def width(self) -> int:
        """Number n_X of columns of X."""
        return len(self._P)

    @property
    def P(self) -> Array:
        return self.covariance_of(np.arange(self.landmarks))

    @property
    def body_covariance(self) -> Array:
        b = self.body - self.considered
        P = np.empty((self.body, self.body))
        P[:b, :b], P[b:, :b], P[b:, b:] = self._P[:b, :b], self._P_c[:, :b], self._P_cc
        P[:b, b:] = P[b:, :b].T
        return P

    def _conditional(self, slot: IntArray) -> tuple[Array, IntArray, IntArray]:
        """Return K (k, 3, n_X) of landmarks at slots (k,); the dormant ones as indices of ``slot`` and in `Dormant`."""
        K, row = np.empty((len(slot), 3, self.width)), self._row[slot]
        awake, asleep = np.flatnonzero(row >= 0), np.flatnonzero(row < 0)
        K[awake] = self._K[row[awake]]
        which = np.empty(0, dtype=np.int64)
        if len(asleep):
            order = np.argsort(self._dormant.slot)
            which = order[np.searchsorted(self._dormant.slot, slot[asleep], sorter=order)]
            K[asleep] = self._dormant.K.reshape(-1, 3, self.width)[which]
        return K, asleep, which

    def landmark_blocks(self, slot: IntArray | None = None) -> Array:
        slot = np.arange(self.landmarks) if slot is None else slot
        K, asleep, which = self._conditional(slot)
        k = len(slot)
        S = np.empty((k, 3, 3))
        awake = np.delete(np.arange(k), asleep)
        S[awake], S[asleep] = self._S[self._row[slot[awake]]], self._dormant.blocks(which)
        return (K.reshape(3 * k, self.width) @ self._P).reshape(k, 3, self.width) @ K.swapaxes(1, 2) + S

    def covariance_of(self, slot: IntArray) -> Array:
        b, k = self.body, len(slot)
        conditional, asleep, which = self._conditional(slot)
        K = conditional.reshape(3 * k, self.width)
        P = np.empty((b + 3 * k, b + 3 * k))
        P[:b, :b] = self.body_covariance
        KP = K @ self._P
        P[b:, : b - self.considered] = KP[:, : b - self.considered]
        P[b:, b - self.considered : b] = K @ self._P_c.T
        at, own = _columns(3 * asleep), _columns(3 * which)
        P[b + at, b - self.considered : b] += self._dormant.cross[:, own].T
        P[:b, b:] = P[b:, :b].T
        P_mm = _symmetric(KP @ K.T)
        awake = np.delete(np.arange(k), asleep)
        P_mm.reshape(k, 3, k, 3)[awake, :, awake, :] += self._S[self._row[slot[awake]]]
        P_mm[np.ix_(at, at)] += _symmetric(self._dormant.covariance(own)[:, own])
        P[b:, b:] = P_mm
        return P

    @property
    def root(self) -> Array:
        """(n_X, f) F of ``P_X = F F^T``."""
        if self._root is None:
            F, failed = lapack.dpotrf(self._P.T, lower=1, clean=1)
            self._root = _pivoted_root(self._P) if failed else F
        return self._root

    def consider(self, columns: int) -> int:
        start = self.body
        self._P_c = np.concatenate([self._P_c, np.zeros((columns, self.width))])
        self._P_cc = np.pad(self._P_cc, (0, columns))
        self._dormant.cross = np.pad(self._dormant.cross, ((0, columns), (0, 0)))
        self.body, self.considered = start + columns, self.considered + columns
        return start

    def clone(self, source: slice, to: slice) -> None:
        first = self.body - self.considered
        at = slice(to.start - first, to.stop - first)
        self._P_cc[at] = self._P_c[:, source].T
        self._P_c[at], self._dormant.cross[at] = self._P[source], 0.0
        self._P_cc[:, at] = self._P_cc[at].T
        self._P_cc[at, at] = self._P[source, source]

    def propagate(self, Phi: Array, Q: Array) -> None:
        joined, leaving = self._window.cut()
        if len(joined):
            self._promote(joined)
        if len(leaving):
            self._drop(leaving)
        push = self._window.push(Phi, Q)
        b, kept = len(Phi), np.concatenate([push.pushed, np.arange(len(Phi), self.width)])
        A = np.concatenate([Phi @ self._P[:b], self._P[kept]])
        P = np.concatenate([A[:, :b] @ Phi.T, A[:, kept]], axis=1)
        P[:b, :b] += Q
        self._P, self._root = _symmetric(P), None
        self._P_c = np.concatenate([self._P_c[:, :b] @ Phi.T, self._P_c[:, kept]], axis=1)
        self._K, self._dormant.K = (_pushed(K, push, kept, b) for K in (self._K, self._dormant.K))

    def _promote(self, rows: IntArray) -> None:
        """Make some awake landmarks columns of X."""
        self._window.promote(rows)
        self._join(self._K[rows].reshape(-1, self.width), np.zeros((3 * len(rows),) * 2))
        _add_blocks(self._P, self.width - 3 * len(rows), self._S[rows])
        _promote(self._K, rows, self._window.promoted[rows])
        self._S[rows] = 0.0
        self._dormant.K = np.pad(self._dormant.K, ((0, 0), (0, 3 * len(rows))))

    def _join(self, K: Array, S: Array, cross: Array | float = 0.0) -> None:
        """Append ``K x + eps`` (m,) to X, given S (m, m) of eps, and its covariance (c, m) with considered columns."""
        KP = K @ self._P
        self._P = np.block([[self._P, KP.T], [KP, _symmetric(KP @ K.T + S)]])
        self._P_c = np.concatenate([self._P_c, self._P_c @ K.T + cross], axis=1)
        self._K = np.pad(self._K, ((0, 0), (0, 0), (0, len(K))))
        self._root = None

    def _drop(self, leaving: IntArray) -> None:
        """Drop columns of X on which no awake landmark depends."""
        if self._dormant.columns_leave(self._P, self._P_c, leaving):
            self._window.refer(slice(0, self.body - self.considered))
        kept = np.delete(np.arange(self.width), leaving)
        self._window.keep(kept)
        self._K, self._P_c = self._K.take(kept, axis=2), self._P_c[:, kept]
        self._P, self._root = self._P[np.ix_(kept, kept)], None

    def transform_body(self, at: slice, A: Array) -> None:
        transform(self._P, at, A)
        inverse = np.linalg.inv(A)
        self._P_c[:, at] = self._P_c[:, at] @ A.T
        self._K[..., at] = self._K[..., at] @ inverse
        self._dormant.K[:, at] = self._dormant.K[:, at] @ inverse
        self._root = None

    def project(self, rows: Rows, frame: int, ids: IntArray) -> ConditionalProjection:
        k, d = rows.residual.shape
        try:
            L, B, G = kernels.whiten(self._K, self._S, self._row[rows.slot], rows.H_x, rows.H_m, rows.variance)
        except np.linalg.LinAlgError:
            raise InnovationError(frame, ids) from None
        F = self.root
        T = (B.reshape(k * d, self.width) @ F).reshape(k, d, F.shape[1])
        return ConditionalProjection(rows, L, B, T, G)

    def solve(self, projection: Projection, frame: int, ids: IntArray) -> ConditionalSolution:
        assert isinstance(projection, ConditionalProjection)
        w = np.asarray(np.linalg.solve(projection.L, projection.rows.residual[..., None])[..., 0], dtype=float)
        everything = np.ones(len(w), dtype=bool)
        blank = ConditionalSolution(self, projection, w, np.empty((0, 0)), everything)
        try:
            return self.solve_left(blank)
        except np.linalg.LinAlgError:
            raise InnovationError(frame, ids) from None

    def solve_body(self, H: Array, residual: Array, variance: Array, frame: int) -> ConditionalSolution:
        k, std = len(H), np.sqrt(variance)
        B = np.zeros((k, 1, self.width))
        B[:, 0, : H.shape[1]] = H / std[:, None]
        none = np.empty((k, 1, 0))
        rows = Rows(np.empty(0, dtype=np.int64), none, none, residual[:, None], variance[:, None])
        T = (B[:, 0] @ self.root)[:, None]
        projection = ConditionalProjection(rows, std[:, None, None], B, T, np.empty((k, 0, 1)))
        return self.solve(projection, frame, np.empty(0, dtype=np.int64))

    def solve_left(self, solution: ConditionalSolution) -> ConditionalSolution:
        """Factorise ``M = I + T^T T`` for the rows that are left; raise LinAlgError if it is not finite."""
        M = np.eye(solution.T.shape[1], order="F")
        if len(solution.T):
            # A row-major T is LAPACK's T^T.
            M = blas.dsyrk(1.0, solution.T.T, beta=1.0, c=M, overwrite_c=1)
        U, failed = lapack.dpotrf(M, lower=0, clean=1, overwrite_a=1)
        if failed or not np.isfinite(U.diagonal()).all():
            raise np.linalg.LinAlgError("M is not positive definite")
        return ConditionalSolution(self, solution.at, solution.w, U, solution.left)

    def correction(self, solution: ConditionalSolution) -> Array:
        """Return the correction (body+3n,) of the mean."""
        x, at = solution.x, solution.at
        b = self.body - self.considered
        d = np.empty((self.landmarks, 3))
        d[self._slot] = (self._K.reshape(-1, self.width) @ x).reshape(-1, 3)
        d[self._dormant.slot] = (self._dormant.K @ x).reshape(-1, 3)
        left = solution.left
        if at.G.shape[1]:
            d[at.rows.slot[left]] += (at.G[left] @ solution.residual[left][..., None])[..., 0]
        return np.concatenate([x[:b], np.zeros(self.considered), d.ravel()])

    def apply(self, solution: Solution) -> None:
        assert isinstance(solution, ConditionalSolution)
        at, left, W, _ = solution.at, solution.left, solution.W, solution.done
        if self.considered:
            along = self._P_c @ at.B[left].reshape(-1, self.width).T
            self._P_c = self._P_c - blas.dtrsm(1.0, solution.U, along @ solution.T, side=1, lower=0) @ W.T
        self._P, self._root = W @ W.T, None
        if at.G.shape[1]:
            kernels.correct(self._K, self._S, self._row[at.rows.slot], at.B, at.G, np.flatnonzero(left))
            self._window.refer(np.flatnonzero(at.rows.H_x[left].any(axis=(0, 1))))

    def augment(self, G: Array, covariance: Array) -> None:
        K = np.zeros((len(G), 3, self.width))
        K[..., : self.seen] = G
        self._append(self.landmarks + np.arange(len(G)), K, covariance)
        self._window.augment(len(G))
        self._window.refer(np.flatnonzero(G.any(axis=(0, 1))))

    def _append(self, slot: IntArray, K: Array, S: Array) -> None:
        """Add awake landmarks (n,) at the slots."""
        before = len(self._slot)
        self._K, self._S = np.concatenate([self._K, K]), np.concatenate([self._S, S])
        self._slot = np.concatenate([self._slot, slot])
        new = int((slot >= self.landmarks).sum())
        self._row = np.concatenate([self._row, np.full(new, -1)])
        self._row[slot] = before + np.arange(len(slot))

    def rest(self, asleep: BoolArray) -> None:
        if (wakes := ~asleep & (self._row < 0)).any():
            self._wake(wakes[self._dormant.slot])
        if (tires := asleep & (self._row >= 0)).any():
            rows = np.sort(self._row[tires])
            self._dormant.append(self._slot[rows], self._K[rows], self._S[rows])
            self._forget(rows)

    def _wake(self, which: BoolArray) -> None:
        slot = self._dormant.slot[which]
        self._join(*self._dormant.wake(which))
        self._append(slot, np.zeros((len(slot), 3, self.width)), np.zeros((len(slot), 3, 3)))
        self._window.augment(len(slot), promoted=True)
        rows = self._row[slot]
        _promote(self._K, rows, self._window.promoted[rows])

    def _forget(self, rows: IntArray) -> None:
        """Remove awake landmarks."""
        gone = np.zeros(len(self._slot), dtype=bool)
        gone[rows] = True
        leaving = self._window.forget(gone)
        self._K, self._S, self._slot = self._K[~gone], self._S[~gone], self._slot[~gone]
        self._row[:] = -1
        self._row[self._slot] = np.arange(len(self._slot))
        if len(leaving):
            self._drop(leaving)

    def marginalise(self, stay: BoolArray) -> None:
        self._dormant.leave(stay[self._dormant.slot])
        self._forget(np.flatnonzero(~stay[self._slot]))
        new = np.cumsum(stay) - 1
        self._slot, self._dormant.slot = new[self._slot], new[self._dormant.slot]
        self._row = self._row[stay]

    def transform_landmarks(self, slot: IntArray, M: Array | None, B: Array, columns: IntArray) -> None:
        row = self._row[slot]
        awake = np.flatnonzero(row >= 0)
        if len(awake):
            M_awake = None if M is None else M[awake]
            self._transform_awake(row[awake], M_awake, B[awake], columns)
        if len(awake) < len(slot):
            asleep = np.flatnonzero(row < 0)
            which = self._conditional(slot[asleep])[2]
            self._dormant.transform(_columns(3 * which), None if M is None else M[asleep], B[asleep], columns)
        self._window.refer(columns)

    def _transform_awake(self, row: IntArray, M: Array | None, B: Array, columns: IntArray) -> None:
        """Transform awake landmarks."""
        first = self._window.promoted[row]
        is_promoted = first >= 0
        if is_promoted.any():
            own = _columns(first[is_promoted])
            M_own, B_own = None if M is None else M[is_promoted], B[is_promoted]
            transform_part(self._P, own, M_own, B_own, columns)
            self._root = None
            P_c, flat = self._P_c[:, own], B_own.reshape(len(own), -1)
            if M_own is not None:
                P_c = (M_own @ P_c.T.reshape(len(B_own), 3, len(P_c))).reshape(len(own), len(P_c)).T
            self._P_c[:, own] = P_c + self._P_c[:, columns] @ flat.T
            self._dormant.transform_promoted(own, M_own, flat, columns)
        kernels.change(self._K, self._S, row, M, B, columns)
        _promote(self._K, row[is_promoted], first[is_promoted])

    def replace(self, P: Array) -> None:
        b = self.body - self.considered
        kept = np.delete(np.arange(len(P)), slice(b, self.body))
        n = (len(kept) - b) // 3
        self._P, self._P_c = P[np.ix_(kept, kept)], P[b : self.body, kept]
        self._P_cc, self._root = P[b : self.body, b : self.body].copy(), None
        self._K, self._S = np.zeros((n, 3, len(kept))), np.zeros((n, 3, 3))
        self._slot, self._row = np.arange(n), np.arange(n)
        self._window, self._dormant = Window(b, n), Dormant(len(kept), self.considered)
        _promote(self._K, self._row, self._window.promoted)


def _pushed(K: Array, push: Push, kept: IntArray, body: int) -> Array:
    """Return K (..., n_X) after a propagation."""
    new = np.zeros((*K.shape[:-1], body + len(kept)))
    new[..., push.carried_to] = K[..., push.carried_from]
    new[..., body:] = K[..., kept]
    return new


def _symmetric(blocks: Array) -> Array:
    return 0.5 * (blocks + blocks.swapaxes(-1, -2))


def _columns(first: IntArray) -> IntArray:
    """Return the columns (3n,) of landmarks from their first ones."""
    return (first[:, None] + np.arange(3)).ravel()


def _promote(K: Array, slot: IntArray, first: IntArray) -> None:
    """Set ``K_i`` of landmarks that are columns of X."""
    K[slot] = 0.0
    axis = np.arange(3)
    K[slot[:, None], axis, first[:, None] + axis] = 1.0


def _add_blocks(P: Array, start: int, blocks: Array) -> None:
    """Add blocks (k, 3, 3) to the diagonal of P from a column on."""
    at = start + 3 * np.arange(len(blocks))[:, None] + np.arange(3)
    P[at[:, :, None], at[:, None, :]] += blocks


def _pivoted_root(P: Array) -> Array:
    """Return F (n, f) of ``P = F F^T`` for singular P; at least one column, because BLAS knows no empty matrices."""
    std = np.sqrt(np.maximum(P.diagonal(), 0.0))
    scale = np.divide(1.0, std, out=np.zeros_like(std), where=std > 0)
    L, pivots, rank, _ = lapack.dpstrf(P * np.outer(scale, scale), lower=1)
    F = np.zeros((len(P), max(rank, 1)), order="F")
    F[pivots - 1, :rank] = np.tril(L)[:, :rank]
    return F * std[:, None]
