"""In-place updates of a symmetric matrix: half the arithmetic, no temporaries, symmetric to the last bit afterwards.

NumPy's row-major P is LAPACK's column-major P^T, so that the upper triangle there is the lower one here.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import blas

from ekfslam.arrays import Array


def add_square(P: Array, A: Array, sign: float) -> None:
    """``P += sign A A^T`` in place, for symmetric C-ordered P (n, n) and A (n, k)."""
    _require_order(P)
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
