"""Sparse block Cholesky factorisation, by CHOLMOD or SuperLU (see `ekfslam.smoother.sparse.solvers`).

The fill-reducing order is sought on the graph of blocks: it has a thirtieth of the edges of the graph of scalars, and
every block stays contiguous in the factor, so that whole blocks of the inverse can be read off it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import scipy.sparse as sp

from ekfslam.arrays import Array, IntArray
from ekfslam.errors import EkfslamError
from ekfslam.smoother.sparse import solvers


class NotPositiveDefiniteError(EkfslamError):
    """The matrix is singular or indefinite: the pivot of a block and row (of the matrix) is not positive."""

    def __init__(self, shape: tuple[int, int], block: int, row: int) -> None:
        self.block, self.row = block, row
        super().__init__(
            f"{shape[0]} x {shape[1]} matrix is not positive definite: the pivot in block {block}, row {row}, "
            "is not positive"
        )


class BlockPattern:
    """Pattern of a symmetric matrix A of blocks (columns of each: ``sizes``), laid out in a fill-reducing order.

    Sets of blocks in the lower triangle have ``places`` (n, 2), row and column of each, and one shape. A place may
    occur several times. Every diagonal block occurs. ``order`` (b,) are the blocks in the fill-reducing order,
    ``permutation`` (n,) the rows of A in it: those of each block in turn.
    """

    def __init__(self, sizes: IntArray, places: Sequence[tuple[IntArray, tuple[int, int]]]) -> None:
        b, self.sizes = len(sizes), sizes
        row, column = np.concatenate([blocks for blocks, _ in places]).T
        self.order = _fill_reducing_order(row, column, b)
        self.permutation = concatenated_ranges((np.cumsum(sizes) - sizes)[self.order], sizes[self.order])
        rank = np.empty(b, dtype=np.int64)
        rank[self.order] = np.arange(b)
        row, column = rank[row], rank[column]
        is_turned = row < column
        pairs, place = np.unique(np.minimum(row, column) * b + np.maximum(row, column), return_inverse=True)
        column, row = np.divmod(pairs, b)

        size = sizes[self.order]
        height = np.bincount(column, weights=size[row]).astype(np.int64)
        first = np.cumsum(height) - height
        above = np.cumsum(size[row]) - size[row] - first[column]
        rows = concatenated_ranges((np.cumsum(size) - size)[row], size[row])
        indices = rows[concatenated_ranges(np.repeat(first, size), np.repeat(height, size))]
        indptr = np.concatenate([[0], np.cumsum(np.repeat(height, size))])
        origin, stride = indptr[(np.cumsum(size) - size)[column]] + above, height[column]
        # CHOLMOD works with 32 bit indices if they suffice; converted once, they need not be at every factorisation.
        index_type = np.int32 if len(indices) <= np.iinfo(np.int32).max else np.int64
        self._indices, self._indptr = indices.astype(index_type), indptr.astype(index_type)
        targets, start = [], 0
        for blocks, (high, wide) in places:
            own = slice(start, start := start + len(blocks))
            at, turned = place[own, None, None], is_turned[own, None, None]
            down, right = np.where(turned, stride[at], 1), np.where(turned, 1, stride[at])
            target = origin[at] + down * np.arange(high)[:, None] + right * np.arange(wide)
            targets.append(target.ravel())
        self._targets = np.concatenate(targets)

    def assemble(self, values: Iterable[Array]) -> sp.csc_matrix:
        """Return the permuted lower triangle from blocks (n, high, wide) of each set; blocks of a place add up."""
        blocks = np.concatenate([np.ravel(blocks) for blocks in values])
        data = np.bincount(self._targets, weights=blocks, minlength=len(self._indices))
        return sp.csc_matrix((data, self._indices, self._indptr), shape=(len(self.permutation),) * 2)

    def not_positive_definite(self, column: int) -> NotPositiveDefiniteError:
        """Return the error for a pivot in a column of the permuted matrix."""
        row = int(self.permutation[column])
        block = int(np.searchsorted(np.cumsum(self.sizes), row, side="right"))
        return NotPositiveDefiniteError((len(self.permutation),) * 2, block, row)


class SparseCholesky:
    """``A[permutation][:, permutation] = L L^T`` of a symmetric positive definite matrix A (n, n) made of blocks.

    ``matrix`` is its permuted lower triangle, from `BlockPattern.assemble`. The symbolic analysis of ``like`` is used
    again. Raise `NotPositiveDefiniteError` if A is singular or indefinite.
    """

    def __init__(self, pattern: BlockPattern, matrix: sp.csc_matrix, like: SparseCholesky | None = None) -> None:
        self.pattern = pattern
        self._analysis: solvers.Analysis = like._analysis if like else solvers.solver(matrix)
        undefined = np.flatnonzero(~np.isfinite(matrix.data))
        if len(undefined):  # not every BLAS stops at NaN
            raise pattern.not_positive_definite(int(np.searchsorted(matrix.indptr, undefined[0], side="right")) - 1)
        try:
            self._factor = self._analysis.factorise(matrix)
        except solvers.PivotError as error:
            raise pattern.not_positive_definite(error.column) from None

    def solve(self, b: Array) -> Array:
        """Return ``A^-1 b`` for b (n,) or (n, k)."""
        return self._unpermuted(self._factor.solve(b[self.pattern.permutation]))

    def half_solve(self, b: Array) -> Array:
        """Return ``X = L^-1 P b`` for b (n,) or (n, k): ``b^T A^-1 b = X^T X`` at half the work of `solve`."""
        return self._factor.solve_lower(b[self.pattern.permutation])

    def sample_transform(self, z: Array) -> Array:
        """Return ``W z = P^T L^-T z`` for z (n,) or (n, k): white noise z gets the covariance ``W W^T = A^-1``."""
        return self._unpermuted(self._factor.solve_transposed(z))

    def _unpermuted(self, x: Array) -> Array:
        result = np.empty_like(x)
        result[self.pattern.permutation] = x
        return result

    def factor(self) -> sp.csc_array:
        """Return L (n, n), its row indices sorted; CHOLMOD may store zeros where this joins small supernodes."""
        return self._factor.lower()

    @property
    def log_determinant(self) -> float:
        """Natural logarithm of det(A)."""
        return float(self._factor.log_determinant())


def _fill_reducing_order(row: IntArray, column: IntArray, blocks: int) -> IntArray:
    """Return the fill-reducing order of the blocks of a lower triangle, postordered."""
    graph = sp.csc_array(sp.coo_array((np.ones(len(row), dtype=bool), (row, column)), shape=(blocks, blocks)))
    return solvers.solver.order(graph.astype(float))


def concatenated_ranges(start: IntArray, length: IntArray) -> IntArray:
    """Return ``start[k], start[k] + 1, ..., start[k] + length[k] - 1`` for every k, one after the other."""
    offset = np.cumsum(length) - length
    return np.repeat(start - offset, length) + np.arange(length.sum())
