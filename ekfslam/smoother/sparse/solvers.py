"""Libraries that factorise sparse matrices, behind one interface; the only module that imports scikit-sparse.

CHOLMOD if scikit-sparse is installed, in release 0.4.16 or 0.5 (with other names). Otherwise SuperLU of SciPy, which
returns the same to rounding and is slower.

A symmetric matrix is given as its lower triangle, in columns, and factorised without permutation: ``A = L L^T``. Stored
zeros belong to its pattern. Entries above the diagonal are ignored.
"""

from __future__ import annotations

import re
import warnings
from importlib import metadata
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from ekfslam.arrays import Array, IntArray

try:
    from sksparse import cholmod
except ImportError:
    cholmod = None


class PivotError(Exception):
    """The pivot of a column is not positive."""

    def __init__(self, column: int) -> None:
        self.column = column
        super().__init__(f"the pivot in column {column} is not positive")


class Factor(Protocol):
    """Factorisation of a matrix. Right-hand sides are (n,) or (n, k)."""

    def solve(self, b: Array) -> Array:
        """Return ``A^-1 b``."""

    def solve_lower(self, b: Array) -> Array:
        """Return ``L^-1 b``."""

    def solve_transposed(self, b: Array) -> Array:
        """Return ``L^-T b``."""

    def lower(self) -> sp.csc_array:
        """Return L (n, n) with all entries that the pattern of A allows, zeros too; rows are sorted."""

    def log_determinant(self) -> float:
        """Return the natural logarithm of det(A)."""


class Analysis(Protocol):
    """Symbolic analysis of a pattern; it serves all matrices with this pattern."""

    def __init__(self, matrix: sp.csc_matrix) -> None: ...

    @staticmethod
    def order(graph: sp.csc_array) -> IntArray:
        """Return a fill-reducing, postordered permutation (n,) of a pattern, given as its lower triangle."""

    def factorise(self, matrix: sp.csc_matrix) -> Factor:
        """Factorise a matrix; raise `PivotError` if it is singular or indefinite."""


class Cholmod04:
    """CHOLMOD through scikit-sparse 0.4.16."""

    def __init__(self, matrix: sp.csc_matrix) -> None:
        # Supernodal: a true L L^T; the simplicial L D L^T would accept indefinite matrices.
        self._symbolic = cholmod.analyze(sp.csc_matrix(matrix), mode="supernodal", ordering_method="natural")

    @staticmethod
    def order(graph: sp.csc_array) -> IntArray:
        symbolic = cholmod.analyze(sp.csc_matrix(graph), mode="simplicial", ordering_method="default")
        return np.asarray(symbolic.P(), dtype=np.int64)

    def factorise(self, matrix: sp.csc_matrix) -> Factor:
        try:
            return _Factor04(self._symbolic.cholesky(matrix))
        except cholmod.CholmodNotPositiveDefiniteError as error:
            raise PivotError(error.column) from None


class _Factor04:
    def __init__(self, factor: Any) -> None:
        self._factor = factor
        self.solve, self.log_determinant = factor.solve_A, factor.logdet

    def solve_lower(self, b: Array) -> Array:
        return self._factor.solve_L(b, use_LDLt_decomposition=False)

    def solve_transposed(self, b: Array) -> Array:
        return self._factor.solve_Lt(b, use_LDLt_decomposition=False)

    def lower(self) -> sp.csc_array:
        return sp.csc_array(self._factor.L())


class Cholmod05:
    """CHOLMOD through scikit-sparse 0.5."""

    def __init__(self, matrix: sp.csc_matrix) -> None:
        self._symbolic = cholmod.CholeskyFactor(sp.csc_array(matrix), order="natural", supernodal_mode="supernodal")

    @staticmethod
    def order(graph: sp.csc_array) -> IntArray:
        symbolic = cholmod.CholeskyFactor(graph, order="default", supernodal_mode="simplicial")
        return symbolic.get_perm().astype(np.int64)

    def factorise(self, matrix: sp.csc_matrix) -> Factor:
        try:  # of a copy: the factorisation turns a supernodal analysis into a simplicial one
            return _Factor05(self._symbolic.copy().factorize(sp.csc_array(matrix)))
        except cholmod.CholmodNotPositiveDefiniteError as error:
            column = re.search(r"column (\d+)", str(error))
            raise PivotError(int(column[1]) if column else 0) from None


class _Factor05:
    def __init__(self, factor: Any) -> None:
        self._factor = factor

    def solve(self, b: Array, system: str = "A") -> Array:
        with warnings.catch_warnings():  # its bound on the condition number ignores that units differ
            warnings.simplefilter("ignore", cholmod.CholmodWarning)
            return self._factor.solve(b, system)

    def solve_lower(self, b: Array) -> Array:
        return self.solve(b, "L")

    def solve_transposed(self, b: Array) -> Array:
        return self.solve(b, "Lt")

    def lower(self) -> sp.csc_array:
        return self._factor.factor.copy()  # get_factor() drops zeros

    def log_determinant(self) -> float:
        return float(2.0 * np.log(self._factor.factor.diagonal()).sum())


class SuperLU:
    """SuperLU of SciPy: an LU factorisation without pivoting is ``L D L^T``."""

    def __init__(self, matrix: sp.csc_matrix) -> None:
        n = matrix.shape[0]
        column = np.repeat(np.arange(n), np.diff(matrix.indptr))
        lower = np.flatnonzero(matrix.indices >= column)
        below = lower[matrix.indices[lower] > column[lower]]
        row, column = (
            np.concatenate([a[lower], b[below]]) for a, b in ((matrix.indices, column), (column, matrix.indices))
        )
        # Sums of SciPy's matrices drop stored zeros, so both triangles are joined by the places of their entries.
        order = np.lexsort((row, column))
        self._entries = np.concatenate([lower, below])[order]
        self._indices = row[order].astype(np.int32)
        self._indptr = np.searchsorted(column[order], np.arange(n + 1)).astype(np.int32)
        self._pattern: tuple[IntArray, IntArray] | None = None

    @staticmethod
    def order(graph: sp.csc_array) -> IntArray:
        entries = SuperLU(graph)
        order = np.argsort(_lu(entries._connected(), "MMD_AT_PLUS_A").perm_c)
        place = np.argsort(order)
        column = np.repeat(np.arange(len(order)), np.diff(entries._indptr))
        row, column = place[entries._indices], place[column]
        permuted = sp.csc_matrix((np.ones(len(row)), (row, column)))
        indices, indptr = SuperLU(permuted)._pattern_of_factor()
        parent = np.append(indices, -1)[np.where(np.diff(indptr) > 1, indptr[:-1] + 1, -1)]
        return order[_postorder(parent)]

    def factorise(self, matrix: sp.csc_matrix) -> Factor:
        full = self._matrix(matrix.data[self._entries])
        lu = _positive_definite(full)
        if lu is None:
            raise PivotError(_first_bad_pivot(full))
        return _SuperLUFactor(lu, self)

    def _matrix(self, data: Array) -> sp.csc_matrix:
        return sp.csc_matrix((data, self._indices, self._indptr), shape=(len(self._indptr) - 1,) * 2)

    def _connected(self) -> sp.csc_matrix:
        """Return the Laplacian of the graph, plus a little: no entry of its factor vanishes by cancellation."""
        degree = np.diff(self._indptr) - 1.0
        column = np.repeat(np.arange(len(degree)), np.diff(self._indptr))
        is_own = self._indices == column
        return self._matrix(np.where(is_own, (degree[column] + 1e-8) * (1 + 1e-8), -1.0))

    def _pattern_of_factor(self) -> tuple[IntArray, IntArray]:
        """Return indices and indptr of L. SuperLU itself drops entries that happen to be zero."""
        if self._pattern is None:
            L = sp.csc_array(_lu(self._connected()).L)
            L.sort_indices()
            self._pattern = L.indices, L.indptr
        return self._pattern


class _SuperLUFactor:
    def __init__(self, lu: Any, analysis: SuperLU) -> None:
        self._lu, self._analysis = lu, analysis
        self._pivot = lu.U.diagonal()
        self._unit: Any = None

    def _solve_unit(self, b: Array, trans: str) -> Array:
        """Solve with the unit triangle L, or its transpose; L is its own LU factorisation."""
        self._unit = self._unit or _lu(self._lu.L)
        return self._unit.solve(b, trans)

    def _scaled(self, b: Array) -> Array:
        return (b.T / np.sqrt(self._pivot)).T

    def solve(self, b: Array) -> Array:
        return self.solve_transposed(self.solve_lower(b))  # not by U, which is D L^T only to rounding

    def solve_lower(self, b: Array) -> Array:
        return self._scaled(self._solve_unit(b, "N"))

    def solve_transposed(self, b: Array) -> Array:
        return self._solve_unit(self._scaled(b), "T")

    def lower(self) -> sp.csc_array:
        L, (indices, indptr) = sp.csc_array(self._lu.L), self._analysis._pattern_of_factor()
        L.sort_indices()
        n = np.int64(len(indptr) - 1)
        wanted, found = (
            np.repeat(np.arange(n), np.diff(p)) * n + i for i, p in ((indices, indptr), (L.indices, L.indptr))
        )
        data = np.zeros(len(indices))
        data[np.searchsorted(wanted, found)] = L.data
        return sp.csc_array((data * np.repeat(np.sqrt(self._pivot), np.diff(indptr)), indices, indptr), shape=L.shape)

    def log_determinant(self) -> float:
        return float(np.log(self._pivot).sum())


def _lu(matrix: sp.csc_matrix, order: str = "NATURAL") -> Any:
    return splu(matrix, permc_spec=order, diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def _positive_definite(matrix: sp.csc_matrix) -> Any:
    """Return the LU factorisation of a symmetric matrix, or None if it is not positive definite."""
    try:
        lu = _lu(matrix)
    except RuntimeError:  # exactly singular
        return None
    is_pivoted = np.any(lu.perm_r != np.arange(len(lu.perm_r)))
    return None if is_pivoted or not np.all(lu.U.diagonal() > 0.0) else lu


def _first_bad_pivot(matrix: sp.csc_matrix) -> int:
    """Return the column of the first pivot that is not positive, by bisection: SuperLU does not name it."""
    good, bad = 0, matrix.shape[0]
    while bad - good > 1:
        middle = (good + bad) // 2
        if _positive_definite(matrix[:middle, :middle]) is None:
            bad = middle
        else:
            good = middle
    return bad - 1


def _postorder(parent: IntArray) -> IntArray:
    """Return a postorder of a forest. Parents have higher numbers than their children; that of a root is -1."""
    size = np.ones(len(parent), dtype=np.int64)
    for node, above in enumerate(parent.tolist()):
        if above >= 0:
            size[above] += size[node]
    # From the roots down: a node takes the last free place of its parent's part; its own subtree lies before it.
    place, free = np.empty(len(parent), dtype=np.int64), np.empty(len(parent) + 1, dtype=np.int64)
    free[-1] = len(parent)
    for node in range(len(parent) - 1, -1, -1):
        place[node] = free[parent[node]] - 1
        free[parent[node]] -= size[node]
        free[node] = place[node]
    return np.argsort(place)


def _chosen() -> type[Analysis]:
    if cholmod is None:
        return SuperLU
    return Cholmod05 if hasattr(cholmod, "CholeskyFactor") else Cholmod04


solver: type[Analysis] = _chosen()


def describe() -> str:
    """Return the library in use and its version."""
    if solver is SuperLU:
        return f"SuperLU of SciPy {metadata.version('scipy')}; CHOLMOD (extra cholmod) is faster"
    return f"CHOLMOD of scikit-sparse {metadata.version('scikit-sparse')}"
