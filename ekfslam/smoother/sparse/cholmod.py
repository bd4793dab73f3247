"""Sparse block Cholesky factorisation by CHOLMOD; the only module that imports scikit-sparse.

The information matrix of SLAM consists of blocks: six rows a pose, three a landmark. The fill-reducing order is sought
on the graph of blocks, one node each: it has a thirtieth of the edges of the graph of scalars, and its order leaves
every block contiguous in the factor, so that whole blocks of the inverse can be read off it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike
from sksparse import cholmod

from ekfslam.arrays import Array, IntArray
from ekfslam.errors import EkfslamError


class NotPositiveDefiniteError(EkfslamError):
    """The matrix to be factorised is singular or indefinite.

    Args:
        shape: Shape of the matrix.
        block: The block, in the order of the matrix, at whose pivot the factorisation broke off.
        row: The row of the matrix where that pivot stands.
    """

    def __init__(self, shape: tuple[int, int], block: int, row: int) -> None:
        self.block, self.row = block, row
        super().__init__(
            f"{shape[0]} x {shape[1]} matrix is not positive definite: the pivot in block {block}, row {row}, "
            "is not positive"
        )


class PatternError(EkfslamError):
    """A sparse matrix does not have the shape or the pattern of stored entries that it must have."""


class SparseCholesky:
    """``A[permutation][:, permutation] = L L^T`` of a sparse symmetric positive definite matrix A (n, n).

    L is made of whole blocks: entries missing from a block of A that has others count as stored zeros.

    Args:
        A: The lower triangle of A. Entries above the diagonal are not read; those given twice are summed.
        block_sizes: (nb,) numbers of rows of the consecutive blocks of A; they sum to n.

    Attributes:
        block_sizes: (nb,) as given.
        block_order: (nb,) the blocks of A in the order of L.
        permutation: (n,) the rows of A in the order of L: those of each block in turn.

    Raises:
        PatternError: A is not square, or `block_sizes` are not positive or do not sum to its size.
        NotPositiveDefiniteError: A is singular or indefinite.
    """

    def __init__(self, A: sp.sparray | sp.spmatrix, block_sizes: ArrayLike) -> None:
        A = sp.csc_array(A)
        self._layout = _lay_out(A, np.asarray(block_sizes, dtype=np.int64))
        # Supernodal: a true L L^T, where the simplicial L D L^T would let indefinite matrices pass.
        self._symbolic = cholmod.analyze(self._layout.arrange(A), mode="supernodal", ordering_method="natural")
        self._factorise(A)

    def with_values(self, A: sp.sparray | sp.spmatrix) -> SparseCholesky:
        """Factorisation of another matrix with the pattern of this one; the symbolic analysis is shared.

        Raises:
            PatternError: The stored entries of `A` are not those of the matrix that was analysed.
            NotPositiveDefiniteError: A is singular or indefinite.
        """
        A = sp.csc_array(A)
        self._layout.check(A)
        other = object.__new__(SparseCholesky)
        other._layout, other._symbolic = self._layout, self._symbolic
        other._factorise(A)
        return other

    def _factorise(self, A: sp.csc_array) -> None:
        layout = self._layout
        self.block_sizes, self.block_order, self.permutation = layout.sizes, layout.order, layout.permutation
        arranged = layout.arrange(A)
        undefined = np.flatnonzero(~np.isfinite(arranged.data))
        if len(undefined):  # not every BLAS stops at NaN
            column = int(np.searchsorted(arranged.indptr, undefined[0], side="right")) - 1
            raise layout.not_positive_definite(column)
        try:
            self._factor = self._symbolic.cholesky(arranged)
        except cholmod.CholmodNotPositiveDefiniteError as error:
            raise layout.not_positive_definite(error.column) from None

    def solve(self, b: Array) -> Array:
        """``A^-1 b`` for b (n,) or (n, k)."""
        return self._unpermuted(self._factor.solve_A(b[self.permutation]))

    def half_solve(self, b: Array) -> Array:
        """``X = L^-1 P b`` for b (n,) or (n, k), with which ``b^T A^-1 b = X^T X``: half the work of `solve`."""
        return self._factor.solve_L(b[self.permutation], use_LDLt_decomposition=False)

    def sample_transform(self, z: Array) -> Array:
        """``W z`` with ``W W^T = A^-1``, for z (n,) or (n, k): covariance A^-1 from white noise z, ``P^T L^-T z``."""
        return self._unpermuted(self._factor.solve_Lt(z, use_LDLt_decomposition=False))

    def _unpermuted(self, x: Array) -> Array:
        result = np.empty_like(x)
        result[self.permutation] = x
        return result

    def factor(self) -> sp.csc_array:
        """L (n, n), its row indices sorted; a copy at every call.

        The pattern may exceed that of the exact factor: CHOLMOD stores zeros where this joins small supernodes.
        """
        return sp.csc_array(self._factor.L())

    @property
    def log_determinant(self) -> float:
        """Natural logarithm of det(A)."""
        return float(self._factor.logdet())


@dataclass(frozen=True)
class _Layout:
    """Where the entries of A go in the permuted matrix of full blocks that CHOLMOD gets.

    Args:
        sizes: (nb,) rows of each block of A.
        order: (nb,) blocks of A in the order of the permuted matrix.
        permutation: (n,) rows of A in that order.
        source_indices: Row indices of A as analysed, CSC.
        source_indptr: (n+1,) its column pointers.
        indices: Row indices of the permuted matrix, CSC. Diagonal blocks are whole, the upper half unread.
        indptr: (n+1,) its column pointers.
        target: (nnz(A),) place of every entry of A in the data of the permuted matrix; one past the end if not read.
    """

    sizes: IntArray
    order: IntArray
    permutation: IntArray
    source_indices: IntArray
    source_indptr: IntArray
    indices: IntArray
    indptr: IntArray
    target: IntArray

    def arrange(self, A: sp.csc_array) -> sp.csc_matrix:
        values = np.bincount(self.target, weights=A.data, minlength=len(self.indices) + 1)[:-1]
        return sp.csc_matrix((values, self.indices, self.indptr), shape=A.shape)

    def not_positive_definite(self, column: int) -> NotPositiveDefiniteError:
        """The error for a pivot in a column of the permuted matrix."""
        row = int(self.permutation[column])
        block = int(np.searchsorted(np.cumsum(self.sizes), row, side="right"))
        return NotPositiveDefiniteError((len(self.permutation),) * 2, block, row)

    def check(self, A: sp.csc_array) -> None:
        if not np.array_equal(A.indptr, self.source_indptr) or not np.array_equal(A.indices, self.source_indices):
            n = len(self.permutation)
            raise PatternError(
                f"{A.shape[0]} x {A.shape[1]} matrix with {A.nnz} stored entries: not the pattern that was analysed, "
                f"{n} x {n} with {len(self.source_indices)}"
            )


def _lay_out(A: sp.csc_array, sizes: IntArray) -> _Layout:
    n, nb = A.shape[0], len(sizes)
    if A.shape != (n, n) or nb == 0 or np.any(sizes <= 0) or sizes.sum() != n:
        raise PatternError(f"{n} x {A.shape[1]} matrix, but {nb} blocks with {sizes.sum()} rows in all")
    row, column = A.indices.astype(np.int64), np.repeat(np.arange(n), np.diff(A.indptr))
    is_read = row >= column
    row, column = row[is_read], column[is_read]
    block_of = np.repeat(np.arange(nb), sizes)
    edges = sp.coo_array((np.ones(len(row), dtype=bool), (block_of[row], block_of[column])), shape=(nb, nb))
    graph = sp.csc_array(edges + sp.eye_array(nb, dtype=bool))
    order = _fill_reducing_order(graph)
    permutation = concatenated_ranges((np.cumsum(sizes) - sizes)[order], sizes[order])

    # In the permuted order: the pairs of blocks (pair_row, pair_column) on and below the diagonal, column by column.
    edges = graph.tocoo()
    rank = _inverse_permutation(order)
    pair_row, pair_column = _lower(rank[edges.row], rank[edges.col])
    pairs = np.sort(pair_column * nb + pair_row)
    pair_column, pair_row = np.divmod(pairs, nb)
    size = sizes[order]
    start = np.cumsum(size) - size
    height = np.bincount(pair_column, weights=size[pair_row]).astype(np.int64)
    first = np.cumsum(height) - height
    above = np.cumsum(size[pair_row]) - size[pair_row] - first[pair_column]
    rows = concatenated_ranges(start[pair_row], size[pair_row])
    indices = rows[concatenated_ranges(np.repeat(first, size), np.repeat(height, size))]
    indptr = np.concatenate([[0], np.cumsum(np.repeat(height, size))])

    position = _inverse_permutation(permutation)
    row, column = _lower(position[row], position[column])
    block_of = np.repeat(np.arange(nb), size)
    pair = np.searchsorted(pairs, block_of[column] * nb + block_of[row])
    target = np.full(A.nnz, len(indices))
    target[is_read] = indptr[column] + above[pair] + row - start[block_of[row]]
    # CHOLMOD works with 32 bit indices where they suffice; converted once, they need not be at every factorisation.
    index_type = np.int32 if len(indices) <= np.iinfo(np.int32).max else np.int64
    return _Layout(
        sizes, order, permutation, A.indices, A.indptr, indices.astype(index_type), indptr.astype(index_type), target
    )


def _fill_reducing_order(graph: sp.csc_array) -> IntArray:
    """Postordered fill-reducing order of a graph, the lower triangle of its adjacency matrix with the diagonal.

    CHOLMOD's default: approximate minimum degree, and nested dissection where that leaves much fill.
    """
    symbolic = cholmod.analyze(graph.astype(float), mode="simplicial", ordering_method="default")
    return np.asarray(symbolic.P(), dtype=np.int64)


def _lower(a: IntArray, b: IntArray) -> tuple[IntArray, IntArray]:
    """Row and column of the entries (a, b), mirrored into the lower triangle."""
    return np.maximum(a, b), np.minimum(a, b)


def _inverse_permutation(permutation: IntArray) -> IntArray:
    inverse = np.empty_like(permutation)
    inverse[permutation] = np.arange(len(permutation))
    return inverse


def concatenated_ranges(start: IntArray, length: IntArray) -> IntArray:
    """``start[k], start[k] + 1, ..., start[k] + length[k] - 1`` for every k, one after the other."""
    offset = np.cumsum(length) - length
    return np.repeat(start - offset, length) + np.arange(length.sum())
