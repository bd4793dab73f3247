"""The kernels in C: arrays checked and results allocated here, numbers made in ``_compiled.c``."""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.kernels import _compiled, plain

MOST_ROWS = 8  # of one landmark; as in the C file


def _of(array: Array | BoolArray, *shape: int) -> Array:
    """Return the numbers of an array with a required shape, in C order."""
    if array.shape != shape:
        raise ValueError(f"an array of shape {array.shape}, expected {shape}")
    return np.ascontiguousarray(array, dtype=np.float64)


def _in_place(array: Array, *shape: int) -> Array:
    if array.shape != shape or array.dtype != np.float64 or not array.flags.c_contiguous:
        raise ValueError(f"an array of shape {array.shape} that is not contiguous, or not of shape {shape}")
    return array


def _places(row: IntArray, below: int) -> IntArray:
    """Return indices after a check of their range, which C does not make."""
    row = np.ascontiguousarray(row, dtype=np.int64)
    if len(row) and not (row.min() >= 0 and row.max() < below):
        raise IndexError(f"a place of {row.min()} to {row.max()} among {below}")
    return row


def _require(failed: int) -> None:
    if failed:
        raise np.linalg.LinAlgError("a block is not positive definite")


def whiten(K: Array, S: Array, row: IntArray, H_x: Array, H_m: Array, variance: Array) -> tuple[Array, Array, Array]:
    k, d, seen = H_x.shape
    if d > MOST_ROWS:
        return plain.whiten(K, S, row, H_x, H_m, variance)
    m, _, n = K.shape
    L, B, G = np.empty((k, d, d)), np.empty((k, d, n)), np.empty((k, 3, d))
    given = _of(K, m, 3, n), _of(S, m, 3, 3), _places(row, m), _of(H_x, k, d, seen), _of(H_m, k, d, 3)
    _require(len(row) != k or _compiled.whiten(*given, _of(variance, k, d), L, B, G, k, d, n, seen))
    return L, B, G


def own_variances(L: Array, T: Array, variance: Array) -> Array:
    k, d, f = T.shape
    if d > MOST_ROWS:
        return plain.own_variances(L, T, variance)
    out = np.empty((k, d, d))
    _compiled.own_variances(_of(L, k, d, d), _of(T, k, d, f), _of(variance, k, d), out, k, d, f)
    return out


def given_others(L: Array, Z: Array, variance: Array) -> Array:
    k, d, f = Z.shape
    if d > MOST_ROWS:
        return plain.given_others(L, Z, variance)
    out = np.empty((k, d, d))
    _compiled.given_others(_of(L, k, d, d), _of(Z, k, d, f), _of(variance, k, d), out, k, d, f)
    return out


def correct(K: Array, S: Array, row: IntArray, B: Array, G: Array, left: IntArray) -> None:
    k, d, n = B.shape
    m, j = len(K), len(left)
    given = _in_place(K, m, 3, n), _in_place(S, m, 3, 3), _places(row, m), _of(B, k, d, n), _of(G, k, 3, d)
    _compiled.correct(*given, _places(left, min(k, len(row))), j, d, n)


def change(K: Array, S: Array, row: IntArray, M: Array | None, B: Array, columns: IntArray) -> None:
    k, _, c = B.shape
    m, _, n = K.shape
    blocks = np.empty((0, 3, 3)) if M is None else _of(M, k, 3, 3)
    given = _in_place(K, m, 3, n), _in_place(S, m, 3, 3), _places(row, m), blocks, _of(B, k, 3, c)
    if len(row) != k or len(columns) != c:
        raise ValueError(f"{k} landmarks and {c} columns, but {len(row)} and {len(columns)} places")
    _compiled.change(*given, _places(columns, n), k, n, c, int(M is not None))


def normalised_squares(S: Array, residual: Array) -> Array:
    k, d = residual.shape
    if d > MOST_ROWS:
        return plain.normalised_squares(S, residual)
    out = np.empty(k)
    _require(_compiled.normalised_squares(_of(S, k, d, d), _of(residual, k, d), out, k, d))
    return out


def squares_given_others(C: Array, residual: Array, variance: Array) -> tuple[Array, BoolArray]:
    k, d = residual.shape
    if d > MOST_ROWS:
        return plain.squares_given_others(C, residual, variance)
    squares, judged = np.empty(k), np.empty(k)
    given = _of(C, k, d, d), _of(residual, k, d), _of(variance, k, d)
    _compiled.squares_given_others(*given, squares, judged, k, d)
    return squares, judged > 0


def whitened(S: Array, residual: Array) -> Array:
    k, d = residual.shape
    if d > MOST_ROWS:
        return plain.whitened(S, residual)
    out = np.empty((k, d))
    _compiled.whitened(_of(S, k, d, d), _of(residual, k, d), out, k, d)
    return out


def moved_by_image(q: Array, step: Array, in_image: BoolArray, factor: float) -> tuple[Array, BoolArray]:
    n = len(q)
    after, flags = np.empty((n, 3)), np.array(in_image, dtype=np.float64)
    _compiled.moved_by_image(_of(q, n, 3), _of(step, n, 3), _of(flags, n), np.array([factor]), after, n)
    return after, flags > 0


def change_by_image(before: plain.View, after: plain.View, in_image: BoolArray) -> tuple[Array, Array]:
    n, c = len(before[0]), before[3].shape[1]
    B, M = np.empty((n, 3, c)), np.empty((n, 3, 3))
    shapes = ((n, 3), (n, 3), (3, 3), (6, c))
    views = [_of(part, *shape) for view in (before, after) for part, shape in zip(view, shapes, strict=True)]
    _compiled.change_by_image(*views, _of(in_image, n), B, M, n, c)
    return B, M
