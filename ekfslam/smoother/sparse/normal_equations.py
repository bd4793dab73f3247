"""Normal equations of a list of factors: blocks of ``J^T J`` and ``J^T r`` over coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy.sparse as sp

from ekfslam.arrays import Array, IntArray
from ekfslam.smoother.sparse.coordinates import REDUCED, SOLVED, Coordinates
from ekfslam.smoother.sparse.factors import Factor
from ekfslam.smoother.sparse.structure import Batch, Structure


@dataclass(frozen=True)
class NormalEquations:
    """Blocks of ``J^T J`` and ``J^T r``."""

    landmarks: Array  # (M, 3, 3) diagonal blocks of the landmarks
    pairs: dict[str, Array]  # for each reduced group, blocks (p, 3, size) of its pairs with landmarks
    products: list[Array]  # for each product of the structure, blocks (p, high, wide)
    gradient: dict[str, Array]  # for each group, J^T r (count, size)


def normal_equations(structure: Structure, factors: Sequence[Factor], coordinates: Coordinates) -> NormalEquations:
    """Return the normal equations of factors over coordinates (`Coordinates.factors`)."""
    s, C = structure, coordinates.C
    gradient = {group: np.zeros((s.counts[group], s.sizes[group])) for group in SOLVED}
    own = np.zeros((s.counts["landmarks"], 3, 3))
    pairs = {group: np.zeros((len(s.pairs[group]), 3, s.sizes[group])) for group in REDUCED}
    of_views = np.zeros((len(pairs["seen"]) * s.views, 3, 6))
    products, by_batch = [], {}
    for number, (factor, batch) in enumerate(zip(factors, s.batches, strict=True)):
        of_sides = _joined(factor, batch)
        gram, columns = _unfolded(batch, _gram(of_sides, batch.start), factor, C)
        by_batch[number] = gram, columns
        for side, own_columns in zip(batch.sides, columns, strict=True):
            if side.once:
                gradient[side.group][side.index] += gram[:, own_columns, -1]
            else:
                gradient[side.group] += sum_by(side.index, s.counts[side.group], gram[:, own_columns, -1])
        for term in batch.landmarks:
            _add_landmarks(factor, batch, term, of_sides, own, pairs, of_views, gradient["landmarks"])
    if s.views:
        n = len(pairs["seen"])
        by_pair = of_views.reshape(n, s.views, 3, 6).swapaxes(1, 2).reshape(n, 3, 6 * s.views)
        ends = np.searchsorted(s.pairs["seen"][:, 1], np.arange(len(C) + 1)).tolist()
        for k, (a, b) in enumerate(pairwise(ends)):  # one product a frame, far fewer than pairs
            pairs["seen"][a:b] += (by_pair[a:b].reshape(-1, C.shape[1]) @ C[k]).reshape(-1, 3, C.shape[2])
    for product in s.products:
        if product.of_landmarks:
            row, column = (factors[product.batch].terms[i].J[product.which] for i in (product.row, product.column))
            blocks = row.swapaxes(1, 2) @ column
        else:
            gram, columns = by_batch[product.batch]
            blocks = gram[:, columns[product.row], columns[product.column]]
            blocks = blocks if len(product.which) == len(gram) else blocks[product.which]
        products.append(blocks if product.index is None else sum_by(product.index, len(product.places), blocks))
    return NormalEquations(own, pairs, products, gradient)


def _joined(factor: Factor, batch: Batch) -> Array:
    """Return the Jacobians (n, d, c) of all sides of a factor side by side, and its residual, in the batch's order."""
    parts = [*(factor.terms[side.term].J for side in batch.sides), factor.r[..., None]]
    joined = np.concatenate(parts, axis=2)
    return joined if batch.order is None else joined[batch.order]


def _gram(J: Array, start: IntArray) -> Array:
    """Return the sums (s, c, c) of ``J^T J`` (n, d, c) over stretches of constraints."""
    n, d, c = J.shape
    if len(start) == n:
        return np.asarray(J.swapaxes(1, 2) @ J)
    gram, flat, ends = np.empty((len(start), c, c)), J.reshape(n * d, c), [*(d * start).tolist(), n * d]
    for i, (a, b) in enumerate(pairwise(ends)):
        np.matmul(flat[a:b].T, flat[a:b], out=gram[i])
    return gram


def _unfolded(batch: Batch, gram: Array, factor: Factor, C: Array) -> tuple[Array, list[slice]]:
    """Return the sums (s, c, c) over coordinates in place of views, and the columns of each side."""
    widths = [factor.terms[side.term].J.shape[2] for side in batch.sides]
    if all(side.view is None for side in batch.sides):
        return gram, _slices(widths)
    seen = C.shape[2]
    wide = [width if side.view is None else seen for side, width in zip(batch.sides, widths, strict=True)]
    unfold = np.zeros((len(gram), sum(widths) + 1, sum(wide) + 1))
    unfold[:, -1, -1] = 1.0
    for side, rows, columns in zip(batch.sides, _slices(widths), _slices(wide), strict=True):
        if side.view is None:
            unfold[:, rows, columns] = np.eye(columns.stop - columns.start)
        else:
            own = C.reshape(len(C), -1, 6, seen)
            unfold[:, rows, columns] = own[side.index, side.view]
    return unfold.swapaxes(1, 2) @ gram @ unfold, _slices(wide)


def _slices(widths: Sequence[int]) -> list[slice]:
    ends = np.cumsum(widths).tolist()
    return [slice(end - width, end) for end, width in zip(ends, widths, strict=True)]


def _add_landmarks(
    factor: Factor,
    batch: Batch,
    term: int,
    of_sides: Array,
    own: Array,
    pairs: dict[str, Array],
    of_views: Array,
    gradient: Array,
) -> None:
    """Add the products of a factor's Jacobians by landmarks with those of all sides, and with themselves."""
    landmark, J = factor.terms[term].index, factor.terms[term].J
    if batch.order is not None:
        landmark, J = landmark[batch.order], J[batch.order]
    found = J.swapaxes(1, 2) @ np.concatenate([J, of_sides], axis=2)
    summed = sum_by(landmark, len(own), found[..., [0, 1, 2, -1]])
    own += summed[..., :3]
    gradient += summed[..., 3]
    columns = _slices([3, *(factor.terms[side.term].J.shape[2] for side in batch.sides)])
    for i, side in enumerate(batch.sides):
        into = pairs[side.group] if side.view is None else of_views
        into += sum_by(batch.pairs[term, i], len(into), found[..., columns[i + 1]])


def sum_by(index: IntArray, groups: int, values: Array) -> Array:
    """Return the sums (groups, ...) of the values (n, ...) of each index (n,)."""
    n = len(index)
    if not values.size:
        return np.zeros((groups, *values.shape[1:]))
    if groups == 1:
        return np.asarray(values.sum(axis=0)[None])
    summation = sp.csc_array((np.ones(n), index, np.arange(n + 1)), shape=(groups, n))
    return (summation @ values.reshape(n, -1)).reshape(groups, *values.shape[1:])
