"""Factorisations of matrices by their blocks."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from ekfslam.smoother.sparse.cholmod import BlockPattern, SparseCholesky


def block_cholesky(A, sizes, like=None):
    """Factorise a symmetric matrix, of which the lower triangle of blocks is read; blocks of zeros are not in it."""
    A, sizes = sp.coo_array(A), np.asarray(sizes)
    n, start, of = len(sizes), np.cumsum(sizes) - sizes, np.repeat(np.arange(len(sizes)), sizes)
    lower = of[A.row] >= of[A.col]
    row, column, value = A.row[lower], A.col[lower], A.data[lower]
    own = np.arange(n) * (n + 1)
    keys, index = np.unique(np.concatenate([own, of[row] * n + of[column]]), return_inverse=True)
    pairs = np.stack(np.divmod(keys, n), axis=-1)
    wide = np.zeros((len(pairs), sizes.max(), sizes.max()))
    wide[index[n:], row - start[of[row]], column - start[of[column]]] = value
    places, values = [], []
    for shape in np.unique(sizes[pairs], axis=0):
        chosen = (sizes[pairs] == shape).all(axis=1)
        places.append((pairs[chosen], tuple(shape.tolist())))
        values.append(wide[chosen, : shape[0], : shape[1]])
    pattern = like.pattern if like else BlockPattern(sizes, places)
    return SparseCholesky(pattern, pattern.assemble(values), like)
