"""Normal equations of a list of factors: blocks of ``J^T J`` and ``J^T r``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from ekfslam.arrays import Array, IntArray
from ekfslam.smoother.sparse.factors import GROUPS, Factor
from ekfslam.smoother.sparse.structure import AT_ONCE, REDUCED, Product, Structure


@dataclass(frozen=True)
class NormalEquations:
    """Blocks of ``J^T J`` and ``J^T r``.

    Args:
        own: For each group, diagonal blocks (count, size, size).
        pairs: For each reduced group, blocks (p, 3, size) of its pairs with landmarks.
        products: For each product of the structure with places in the reduced matrix, blocks (p, high, wide).
        gradient: For each group, ``J^T r`` (count, size).
    """

    own: dict[str, Array]
    pairs: dict[str, Array]
    products: list[Array]
    gradient: dict[str, Array]


def normal_equations(structure: Structure, factors: Sequence[Factor]) -> NormalEquations:
    """Return the normal equations of factors over zeta (`LinearSystem.over_zeta`)."""
    counts, sizes = structure.counts, structure.sizes
    own = {group: np.zeros((counts[group], sizes[group], sizes[group])) for group in GROUPS}
    pairs = {group: np.zeros((len(structure.pairs[group]), 3, sizes[group])) for group in REDUCED}
    products = []
    for product in structure.products:
        row, column = (factors[product.factor].terms[i] for i in (product.row, product.column))
        if product.pairs:
            into = pairs[product.pairs]
        elif product.places is None:
            into = own[row.group]
        else:
            into = np.zeros((len(product.places), sizes[row.group], sizes[column.group]))
            products.append(into)
        _add_products(into, product, row.J[product.rows], column.J[product.rows])
    gradient = {group: np.zeros((counts[group], sizes[group])) for group in GROUPS}
    for factor in factors:
        for term in factor.terms:
            values = (term.J.swapaxes(1, 2) @ factor.r[..., None])[..., 0]
            gradient[term.group] += sum_by(term.index, counts[term.group], values)
    return NormalEquations(own, pairs, products, gradient)


def _add_products(into: Array, product: Product, A: Array, B: Array) -> None:
    """Add ``A_k^T B_k`` to the block of each constraint, for A (n, c, a), B (n, c, b), never all products at once."""
    if len(into) == 1:
        into[0] += A.reshape(-1, A.shape[2]).T @ B.reshape(-1, B.shape[2])
        return
    for begin in range(0, len(A), AT_ONCE):
        part = slice(begin, min(begin + AT_ONCE, len(A)))
        blocks = A[part].swapaxes(1, 2) @ B[part]
        if product.is_sum:
            into += sum_by(product.index[part], len(into), blocks)
        else:
            into[product.index[part]] += blocks


def sum_by(index: IntArray, groups: int, values: Array) -> Array:
    """Return the sums (groups, ...) of the values (n, ...) of each index (n,)."""
    n = len(index)
    if not values.size:
        return np.zeros((groups, *values.shape[1:]))
    summation = sp.csc_array((np.ones(n), index, np.arange(n + 1)), shape=(groups, n))
    return (summation @ values.reshape(n, -1)).reshape(groups, *values.shape[1:])
