"""Coordinates in which a system is solved: those of a frame that observations depend on, and those that they do not.

Errors that move a camera alike (pose, jitter, drift) reach landmarks by the few errors of the views of a frame. With
``x_k = (frames, aux)`` the unknowns of frame k and Y_k the derivative of its views, a shear N_k has

    x_k = N_k u_k,    Y_k N_k = [C_k 0]

The first part of u_k, as many columns as views have, is *seen*; the rest is *hidden* from landmarks, so that couples of
frames that saw the same landmarks have smaller blocks. With S some columns of Y that are regular and H the others,
``N = [I, -Y_S^-1 Y_H; 0, I]``: walks of the blocks H stay as sparse as they are, and lose no digits. The first frame
counts in units of its prior, ``N_0 = B Q`` with a rotation Q.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.smoother.sparse.factors import Factor, LinearSystem, Term

REDUCED = ("seen", "hidden", "drive")
SOLVED = (*REDUCED, "landmarks")


@dataclass(frozen=True)
class Coordinates:
    """Coordinates of a system, see the module."""

    N: Array  # (T, w+a, w+a) unknowns of each frame by its coordinates
    C: Array  # (T, 6 h, s) views of each frame by its seen coordinates
    Q_first: Array  # (w+a, w+a) turn of the first frame
    width: int  # number of columns w of frames

    @staticmethod
    def of(system: LinearSystem) -> Coordinates:
        """Return the coordinates of a linearisation."""
        B, w, frames = system.first.B, system.first.width, system.counts["frames"]
        Y = np.zeros((frames, 0, w)) if system.views is None else system.views
        S = np.arange(w) if system.seen is None else system.seen
        H = np.setdiff1d(np.arange(w), S)
        N, s = np.zeros((frames, len(B), len(B))), len(S)
        N[:, np.concatenate([S, H, np.arange(w, len(B))]), np.arange(len(B))] = 1.0
        if len(H):
            N[:, S[:, None], np.arange(s, w)] = -np.linalg.solve(Y[:, :, S], Y[:, :, H])
        C = Y[:, :, S]
        Q = np.linalg.qr(((Y[0] @ B[:w]) if len(H) else B[:w]).T, mode="complete")[0]
        N[0], C[0] = B @ Q, (Y[0] @ B[:w] @ Q)[:, :s]
        return Coordinates(N, C, Q, w)

    @property
    def seen(self) -> int:
        """Number of seen columns of a frame."""
        return self.C.shape[2]

    def rows_of(self, group: str) -> Array:
        """Return the derivative (T, n, w+a) of ``frames`` or ``aux`` by the coordinates of their frames."""
        return self.N[:, : self.width] if group == "frames" else self.N[:, self.width :]

    def terms(self, term: Term) -> Iterator[Term]:
        """Yield the terms over coordinates that make a term over unknowns; those over views stay."""
        if term.group not in ("frames", "aux"):
            yield term
            return
        J = term.J @ self.rows_of(term.group)[term.index]
        if term.group == "frames" or (term.index == 0).any():
            yield Term("seen", term.index, J[..., : self.seen])
        if term.group == "aux" or self.seen < self.width:
            yield Term("hidden", term.index, J[..., self.seen :])

    def factors(self, system: LinearSystem) -> list[Factor]:
        """Return all factors over coordinates, the prior of the first frame first."""
        first, own = np.zeros(1, dtype=np.int64), np.eye(len(self.Q_first))[None]
        seen, hidden = Term("seen", first, own[..., : self.seen]), Term("hidden", first, own[..., self.seen :])
        prior = Factor(-(self.Q_first.T @ system.first.zeta)[None], (seen, hidden))
        return [prior, *(self._factor(factor) for factor in system.factors)]

    def _factor(self, factor: Factor) -> Factor:
        """Return a factor over coordinates; terms over the same unknowns become one."""
        merged: list[Term] = []
        for term in (part for one in factor.terms for part in self.terms(one)):
            for i, other in enumerate(merged):
                if other.group == term.group and np.array_equal(other.index, term.index):
                    merged[i] = Term(term.group, term.index, other.J + term.J)
                    break
            else:
                merged.append(term)
        return Factor(factor.r, tuple(merged), factor.observation)

    def unknowns(self, u: Array) -> tuple[Array, Array]:
        """Return frames (T, w) and aux (T, a) from coordinates (T, w+a)."""
        x = (self.N @ u[..., None])[..., 0]
        return x[:, : self.width], x[:, self.width :]

    def index_of_views(self, index: IntArray) -> tuple[IntArray, IntArray]:
        """Return the frame (n,) of views (n,), and the number (n,) of each among those of its frame."""
        frame, number = np.divmod(index, self.C.shape[1] // 6)
        return frame, number
