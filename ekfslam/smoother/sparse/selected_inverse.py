"""Selected inverse: the entries of ``Z = A^-1`` in the pattern of the Cholesky factor L of A.

They follow from one another, from the last column to the first (Takahashi, Fagan and Chen, PICA 1973). Here one
supernode at a time, a run J of columns that have their rows R below the run in common:

    Y = L_RJ L_JJ^-1        Z_RJ = -Z_RR Y        Z_JJ = L_JJ^-T L_JJ^-1 - Y^T Z_RJ

Z_RR is a submatrix of the dense Z over the parent, the supernode that owns the first of R.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike
from scipy.linalg.lapack import dtrtri

from ekfslam.arrays import Array, IntArray
from ekfslam.errors import EkfslamError
from ekfslam.smoother.sparse.cholmod import SparseCholesky, concatenated_ranges


class PatternError(EkfslamError):
    """A sparse matrix does not have the pattern of a Cholesky factor."""


class MissingBlockError(EkfslamError):
    """A block (i, j) of the inverse lies outside the pattern of the Cholesky factor."""

    def __init__(self, i: int, j: int) -> None:
        self.i, self.j = i, j
        super().__init__(f"block ({i}, {j}) of the inverse lies outside the pattern of the Cholesky factor")


class SelectedInverse:
    """Blocks of ``A^-1`` in the pattern of a factorisation of A: all diagonal ones, and all stored in A."""

    def __init__(self, cholesky: SparseCholesky) -> None:
        inverse = selected_inverse(cholesky.factor())
        self._data, self._indptr = inverse.data, inverse.indptr.astype(np.int64)
        self._sizes = cholesky.pattern.sizes
        nb = len(self._sizes)
        self._rank = np.empty(nb, dtype=np.int64)
        self._rank[cholesky.pattern.order] = np.arange(nb)
        size = self._sizes[cholesky.pattern.order]
        self._start = np.cumsum(size) - size

        # The columns of a block have the same rows below it, so the first column locates every block of that column.
        height = np.diff(self._indptr)[self._start]
        row = inverse.indices[concatenated_ranges(self._indptr[self._start], height)]
        block = np.repeat(np.arange(nb), size)[row]
        leads = row == self._start[block]
        self._pairs = (np.repeat(np.arange(nb), height) * nb + block)[leads]
        self._offset = concatenated_ranges(np.zeros(nb, dtype=np.int64), height)[leads]

    def blocks(self, i: ArrayLike, j: ArrayLike) -> Array:
        """Return blocks (n, s_i, s_j) of the inverse in the pattern, for blocks i and j (n,) of A, each of one size."""
        i, j = np.asarray(i, dtype=np.int64), np.asarray(j, dtype=np.int64)
        s_i, s_j = (int(self._sizes[some[:1]].sum()) for some in (i, j))
        low, high = np.minimum(self._rank[i], self._rank[j]), np.maximum(self._rank[i], self._rank[j])
        wanted = low * len(self._sizes) + high
        place = np.searchsorted(self._pairs, wanted)
        missing = self._pairs[np.minimum(place, len(self._pairs) - 1)] != wanted
        if missing.any():
            first = int(np.argmax(missing))
            raise MissingBlockError(int(i[first]), int(j[first]))

        # The lower triangle holds block (i, j) or its transpose; of a diagonal block, a half.
        a, b = np.arange(s_i)[:, None], np.arange(s_j)
        comes_first = (self._rank[i] < self._rank[j])[:, None, None]
        transposed = comes_first | ((i == j)[:, None, None] & (a < b))
        column, row = np.where(transposed, a, b), np.where(transposed, b, a)
        start = self._indptr[self._start[low][:, None, None] + column]
        return self._data[start + self._offset[place][:, None, None] + row - column]


def selected_inverse(L: sp.csc_array) -> sp.csc_array:
    """Return the entries of ``(L L^T)^-1`` in the pattern of L (n, n), a `SparseCholesky.factor`."""
    tree = _supernodes(L)
    in_factor = np.triu(np.ones((max(tree.width), max(tree.height)), dtype=bool))
    result = np.empty_like(L.data)
    fronts: dict[int, Array] = {}
    waiting = list(tree.children)
    # CHOLMOD's order is a postorder: backwards, a front is soon needed by its children and then never again.
    for node in range(len(tree.first) - 1, -1, -1):
        w, h, parent = tree.width[node], tree.height[node], tree.parent[node]
        stored = slice(L.indptr[tree.first[node]], L.indptr[tree.first[node] + w])
        panel = np.zeros((w, h))  # a row for each column of L
        panel[in_factor[:w, :h]] = L.data[stored]
        inverse_JJ = dtrtri(panel[:, :w])[0]
        front = np.empty((h if waiting[node] else w, h))
        Z_JJ = inverse_JJ @ inverse_JJ.T
        if parent >= 0:
            rows = tree.rows_in_parent[node]
            Z_RR = fronts[parent].take(rows, axis=0).take(rows, axis=1)
            waiting[parent] -= 1
            if not waiting[parent]:
                del fronts[parent]
            Y = inverse_JJ @ panel[:, w:]  # transposed
            Z_JR = -(Y @ Z_RR)
            Z_JJ -= Y @ Z_JR.T
            # Fed with its own asymmetry of rounding, the recursion would amplify it without bound along a long drive.
            Z_JJ = 0.5 * (Z_JJ + Z_JJ.T)
            front[:w, w:] = Z_JR
        front[:w, :w] = Z_JJ
        result[stored] = front[:w][in_factor[:w, :h]]
        if waiting[node]:
            if parent >= 0:
                front[w:, :w], front[w:, w:] = Z_JR.T, Z_RR
            fronts[node] = front
    return sp.csc_array((result, L.indices, L.indptr), shape=L.shape)


@dataclass(frozen=True)
class _Supernodes:
    """The supernodes of a Cholesky factor, in the order of their columns; lists, which Python reads faster."""

    first: list[int]  # first, width: first column of each, and their number
    width: list[int]
    height: list[int]  # number of rows, those of the columns themselves included
    parent: list[int]  # supernode that owns the first row below the columns; -1 of a root
    children: list[int]  # number of children
    # (height - width,) places of the rows below the columns among the rows of the parent.
    rows_in_parent: list[IntArray]


def _supernodes(L: sp.csc_array) -> _Supernodes:
    n, indptr = L.shape[0], L.indptr.astype(np.int64)
    length = np.diff(indptr)
    # Column j + 1 continues the supernode of column j if it is the parent of j and has one row less.
    below_diagonal = np.append(L.indices, n)[indptr[:-1] + 1]
    continues = (below_diagonal[:-1] == np.arange(1, n)) & (length[:-1] == length[1:] + 1)
    first = np.concatenate([[0], np.flatnonzero(~continues) + 1])
    width, height = np.diff(first, append=n), length[first]
    owner = np.repeat(np.arange(len(first)), width)

    rows = L.indices[concatenated_ranges(indptr[first], height)].astype(np.int64)
    start, below = np.cumsum(height) - height, height - width
    parent = np.full(len(first), -1)
    parent[below > 0] = owner[rows[(start + width)[below > 0]]]

    front_rows = np.repeat(np.arange(len(first)), height) * n + rows
    parent_of_row = np.repeat(parent, below)
    wanted = parent_of_row * n + rows[concatenated_ranges(start + width, below)]
    place = np.searchsorted(front_rows, wanted)
    if not np.array_equal(front_rows[np.minimum(place, len(front_rows) - 1)], wanted):
        raise PatternError(f"{n} x {n} matrix with {L.nnz} stored entries is no Cholesky factor: its pattern has gaps")
    return _Supernodes(
        first.tolist(),
        width.tolist(),
        height.tolist(),
        parent.tolist(),
        np.bincount(parent[below > 0], minlength=len(first)).tolist(),
        np.split(place - start[parent_of_row], np.cumsum(below)[:-1]),
    )
