"""The Gaussian of a window in dense form; landmarks without a prior are eliminated by their Schur complements."""

from __future__ import annotations

import copy

import numpy as np
from scipy.linalg import solve_triangular

from ekfslam.arrays import Array, IntArray
from ekfslam.errors import IllPosedError
from ekfslam.smoother.sparse.factors import GROUPS, LinearSystem


class DenseInformation:
    """The Gaussian of a `LinearSystem` whose prior ``first`` is of (frame, aux, drive, landmarks (n,) ``known``)."""

    def __init__(self, system: LinearSystem, known: IntArray) -> None:
        self._start, self._sizes, counts = system.start, system.sizes, system.counts
        self._at = {group: self._columns(group, np.arange(counts[group])) for group in GROUPS}
        of_frame = self._at["frames"][: system.first.width], self._at["aux"][: self._sizes["aux"]]
        first = np.concatenate([*of_frame, self._at["drive"], self._columns("landmarks", known)])
        self.free = np.setdiff1d(np.arange(counts["landmarks"]), known)
        free = self._columns("landmarks", self.free)
        J, r = system.rows_without_prior()
        rest = np.setdiff1d(np.arange(J.shape[1]), np.concatenate([first, free]))
        A, zeta = system.first.B, system.first.zeta
        # All unknowns but free landmarks by the reduced ones: zeta, then the rest.
        self._place = np.full(J.shape[1], -1)
        self._place[np.concatenate([first, rest])] = np.arange(len(first) + len(rest))
        self._basis = np.eye(len(first) + len(rest))
        self._basis[: len(first), : len(first)] = A
        # The prior is over zeta itself; all else is in units of the unknowns.
        H, g = (J.T @ J).toarray(), J.T @ r
        some = np.concatenate([first, rest])
        H_xx, H_mx = H[np.ix_(some, some)], H[np.ix_(free, some)]
        H_mx[:, : len(first)] = H_mx[:, : len(first)] @ A
        H_xx[: len(first)] = A.T @ H_xx[: len(first)]
        H_xx[:, : len(first)] = H_xx[:, : len(first)] @ A
        g_x, g_m = np.concatenate([A.T @ g[first] - zeta, g[rest]]), g[free].reshape(-1, 3)
        H_xx[np.diag_indices(len(first))] += 1.0
        own = free.reshape(-1, 3)
        H_mm = H[own[:, :, None], own[:, None, :]]
        try:
            self._L_inverse = np.linalg.inv(np.linalg.cholesky(H_mm))
            self._Y = self._L_inverse @ H_mx.reshape(len(self.free), 3, len(some))
            flat = self._Y.reshape(3 * len(self.free), len(some))
            self._L = np.linalg.cholesky(H_xx - flat.T @ flat)
        except np.linalg.LinAlgError:
            raise IllPosedError("too little information in a window", []) from None
        white = (self._L_inverse @ g_m[..., None])[..., 0]
        half = solve_triangular(self._L, g_x - flat.T @ white.ravel(), lower=True)
        z = solve_triangular(self._L, half, lower=True, trans=1)
        d = (self._L_inverse.swapaxes(1, 2) @ (white - self._Y @ z)[..., None])[..., 0]
        self.gain = 0.5 * float(z @ g_x + (d * g_m).sum())
        x = np.empty(J.shape[1])
        x[some], x[free], self.zeta = self._basis @ z, d.ravel(), z[: len(first)]
        self.eps = x[self._at["frames"]].reshape(counts["frames"], self._sizes["frames"])
        self.aux = x[self._at["aux"]].reshape(counts["frames"], self._sizes["aux"])
        self.drive, self.d = x[self._at["drive"]], x[self._at["landmarks"]].reshape(-1, 3)

    def shortened(self, share: float) -> DenseInformation:
        """Return the solution with a share of its means."""
        short = copy.copy(self)
        for name in ("zeta", "eps", "aux", "drive", "d"):
            setattr(short, name, share * getattr(self, name))
        return short

    def _columns(self, group: str, index: IntArray) -> IntArray:
        size = self._sizes[group]
        return (self._start[group] + size * index[:, None] + np.arange(size)).ravel()

    def covariance(self, **wanted: IntArray | list[int]) -> Array:
        """Return the joint covariance of unknowns, given in the order of columns: ``frames=[3, 4], landmarks=[0]``."""
        columns = np.concatenate([self._columns(group, np.asarray(index)) for group, index in wanted.items()])
        W = np.zeros((len(columns), len(self._L)))
        is_reduced = self._place[columns] >= 0
        W[is_reduced] = self._basis[self._place[columns[is_reduced]]]
        landmarks = np.asarray(wanted.get("landmarks", []), dtype=np.int64)
        at, place = np.flatnonzero(np.isin(landmarks, self.free)), np.searchsorted(self.free, landmarks)
        own = (len(columns) - 3 * len(landmarks) + 3 * at)[:, None] + np.arange(3)
        L_inverse = self._L_inverse[place[at]]
        W[own] = -L_inverse.swapaxes(1, 2) @ self._Y[place[at]]
        half = solve_triangular(self._L, W.T, lower=True)
        P = half.T @ half
        P[own[:, :, None], own[:, None, :]] += L_inverse.swapaxes(1, 2) @ L_inverse
        return P
