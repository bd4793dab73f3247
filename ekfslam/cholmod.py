"""Sparse Cholesky factorisation by CHOLMOD; the only module that imports scikit-sparse.

scikit-sparse 0.4 (builds against SuiteSparse 5 to 7) and 0.5 (SuiteSparse 7.4 or later) have different interfaces; this
module gives both the same one.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from sksparse import cholmod

from ekfslam.errors import EkfslamError
from ekfslam.se3 import Array
from ekfslam.sequence import IntArray


class NotPositiveDefiniteError(EkfslamError):
    """The matrix to be factorised is not positive definite."""


class SparseCholesky:
    """``P A P^T = L L^T`` of a sparse symmetric positive definite matrix A (n, n), with a fill-reducing order P.

    Raises:
        NotPositiveDefiniteError: A is singular or indefinite.
    """

    def __init__(self, A: sp.csc_array | sp.csc_matrix) -> None:
        A = sp.csc_matrix(A)
        try:
            # Supernodal: a true L L^T, where the simplicial L D L^T would let indefinite matrices pass.
            if hasattr(cholmod, "cho_factor"):
                self._factor = cholmod.cho_factor(A, lower=True, supernodal_mode="supernodal")
                self.permutation: IntArray = np.asarray(self._factor.get_perm(), dtype=np.int64)
                self._solve = self._factor.solve
                self._lower = lambda: self._factor.get_factor(kind="LL", lower=True)
            else:
                self._factor = cholmod.cholesky(A, mode="supernodal")
                self.permutation = np.asarray(self._factor.P(), dtype=np.int64)
                self._solve = self._factor.solve_A
                self._lower = self._factor.L
        except cholmod.CholmodNotPositiveDefiniteError as error:
            raise NotPositiveDefiniteError(f"{A.shape[0]} x {A.shape[1]} matrix: {error}") from None

    def solve(self, b: Array) -> Array:
        """``A^-1 b`` for b (n,) or (n, k)."""
        return self._solve(b)

    def factor(self) -> sp.csc_array:
        """L, with ``L L^T = A[permutation][:, permutation]``."""
        return sp.csc_array(self._lower())

    @property
    def log_determinant(self) -> float:
        """Natural logarithm of det(A)."""
        return float(2.0 * np.log(self.factor().diagonal()).sum())
