"""Selected inversion against the dense inverse, on every shape of graph that SLAM makes."""

import numpy as np
import pytest
import scipy.sparse as sp
from support.blocks import block_cholesky

from ekfslam.smoother.sparse.selected_inverse import (
    MissingBlockError,
    PatternError,
    SelectedInverse,
    selected_inverse,
)


def band(count, width):
    return [(i, j) for i in range(count) for j in range(max(0, i - width), i)]


def random_edges(count, edges):
    pairs = np.random.default_rng(count).integers(0, count, (edges, 2))
    return [(max(p), min(p)) for p in pairs.tolist() if p[0] != p[1]]


# Sizes of the blocks, and which of them are coupled.
GRAPHS = {
    "single block": ([6], []),
    "single number": ([1], []),
    "uncoupled": ([6, 3, 3, 6, 3], []),
    "chain": (40 * [6], band(40, 1)),
    "band": (60 * [6], band(60, 5)),
    "band with loop closures": (60 * [6], [*band(60, 3), *((50 + k, k) for k in range(8)), (40, 20), (59, 0)]),
    "arrow": ([6] + 30 * [3], [(i, 0) for i in range(1, 31)]),
    "poses and landmarks": (
        30 * [6] + 25 * [3],
        [*band(30, 2), *((30 + m, k) for m in range(25) for k in range(m, min(m + 6, 30)))],
    ),
    "two components": (40 * [6], [*band(20, 4), *((20 + i, 20 + j) for i, j in band(20, 2))]),
    "random": (12 * [3, 6, 6, 3], random_edges(48, 70)),
    "dense": ([6, 3, 6, 3, 3], band(5, 5)),
}


@pytest.fixture(params=GRAPHS)
def problem(request):
    """Lower triangle, block sizes, edges and dense inverse of a random matrix of each graph, badly scaled."""
    sizes, edges = np.array(GRAPHS[request.param][0]), GRAPHS[request.param][1]
    rng = np.random.default_rng(7)
    start = np.concatenate([[0], np.cumsum(sizes)])
    A = np.diag(np.full(start[-1], 1e-2))
    for i, j in edges or [(0, 0)]:
        rows = np.zeros((4, start[-1]))
        for k in (i, j):
            rows[:, start[k] : start[k + 1]] = rng.normal(size=(4, sizes[k]))
        A += rows.T @ rows
    scale = 10.0 ** rng.uniform(-1, 1, len(A))
    A *= scale[:, None] * scale
    return sp.csc_array(np.tril(A)), sizes, edges, np.linalg.inv(A)


def cut_out(inverse, sizes, i, j):
    start = np.cumsum(sizes) - sizes
    return inverse[start[i] : start[i] + sizes[i], start[j] : start[j] + sizes[j]]


def correlation_error(actual, expected, sigma_i, sigma_j):
    return np.abs((actual - expected) / (sigma_i[..., :, None] * sigma_j[..., None, :])).max()


def test_every_entry_in_the_pattern_is_that_of_the_dense_inverse(problem):
    A, sizes, _, dense = problem
    cholesky = block_cholesky(A, sizes)
    L = cholesky.factor()
    Z = selected_inverse(L)
    np.testing.assert_array_equal(Z.indices, L.indices)
    np.testing.assert_array_equal(Z.indptr, L.indptr)
    expected = dense[np.ix_(cholesky.pattern.permutation, cholesky.pattern.permutation)]
    row, column = Z.indices, np.repeat(np.arange(A.shape[0]), np.diff(Z.indptr))
    sigma = np.sqrt(np.diagonal(expected))
    assert np.abs((Z.data - expected[row, column]) / (sigma[row] * sigma[column])).max() < 1e-9


def test_blocks_are_those_of_the_dense_inverse_in_the_order_of_the_matrix(problem):
    A, sizes, edges, dense = problem
    inverse = SelectedInverse(block_cholesky(A, sizes))
    start, sigma = np.cumsum(sizes) - sizes, np.sqrt(np.diagonal(dense))
    pairs = np.array([*edges, *((j, i) for i, j in edges), *((i, i) for i in range(len(sizes)))])
    for s_i in np.unique(sizes):
        for s_j in np.unique(sizes):
            i, j = pairs[(sizes[pairs[:, 0]] == s_i) & (sizes[pairs[:, 1]] == s_j)].T
            blocks = inverse.blocks(i, j)
            if not len(i):
                continue
            assert blocks.shape == (len(i), s_i, s_j)
            expected = np.stack([cut_out(dense, sizes, *pair) for pair in zip(i, j, strict=True)])
            sigma_i, sigma_j = sigma[start[i][:, None] + np.arange(s_i)], sigma[start[j][:, None] + np.arange(s_j)]
            assert correlation_error(blocks, expected, sigma_i, sigma_j) < 1e-9
            np.testing.assert_array_equal(blocks, inverse.blocks(j, i).swapaxes(1, 2))


def test_diagonal_blocks_are_exactly_symmetric(problem):
    A, sizes, _, _ = problem
    inverse = SelectedInverse(block_cholesky(A, sizes))
    for size in np.unique(sizes):
        own = np.flatnonzero(sizes == size)
        np.testing.assert_array_equal(inverse.blocks(own, own), inverse.blocks(own, own).swapaxes(1, 2))


def test_many_supernodes_of_a_factor_without_stored_zeros():
    """CHOLMOD joins small supernodes; without that, a tridiagonal matrix is all supernodes of one column."""
    n = 50
    A = sp.diags_array([np.full(n, 2.5), np.full(n - 1, -1.0)], offsets=[0, -1]).toarray()
    full = A + np.tril(A, -1).T
    Z = selected_inverse(sp.csc_array(np.linalg.cholesky(full)))
    assert Z.nnz == 2 * n - 1
    expected = np.linalg.inv(full)
    np.testing.assert_allclose(Z.diagonal(), np.diagonal(expected), rtol=1e-13)
    np.testing.assert_allclose(Z.diagonal(-1), np.diagonal(expected, -1), rtol=1e-13)


def test_pattern_with_gaps_is_an_error():
    L = np.eye(5)
    L[[1, 3, 4], 0] = L[2, 1] = 0.5  # rows 3 and 4 of column 0 are missing in column 1
    with pytest.raises(PatternError, match="5 x 5 matrix with 9"):
        selected_inverse(sp.csc_array(L))


def test_block_outside_the_pattern_is_a_named_error():
    sizes = np.full(200, 6)
    lower = sp.block_diag([np.tril(np.ones((6, 6))) + 5.0 * np.eye(6)] * 200, format="csc")
    inverse = SelectedInverse(block_cholesky(lower, sizes))
    with pytest.raises(MissingBlockError, match=r"\(199, 3\)") as caught:
        inverse.blocks([0, 199], [0, 3])
    assert (caught.value.i, caught.value.j) == (199, 3)


def test_no_blocks():
    none = np.empty(0, dtype=np.int64)
    assert SelectedInverse(block_cholesky(np.eye(9), [6, 3])).blocks(none, none).shape == (0, 0, 0)


@pytest.mark.slow
@pytest.mark.parametrize("window", [8, 20])
def test_rounding_does_not_grow_along_a_long_drive(window):
    """An integrated random walk of 3000 blocks, known well from one to the next and badly over a window."""
    blocks = 3000
    bend = sp.diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(blocks - 2, blocks)) * 1e3
    apart = sp.diags_array([1.0, -1.0], offsets=[0, window], shape=(blocks - window, blocks)) * 10.0
    start = sp.csr_array(([1e3, 1e3], ([0, 1], [0, 1])), shape=(2, blocks))
    rows = sp.vstack([bend, apart, start]).tocsr()
    A = sp.csc_array(sp.kron(rows.T @ rows, np.eye(6) + 0.1 * np.ones((6, 6))))
    cholesky = block_cholesky(A, np.full(blocks, 6))
    some = np.linspace(0, blocks - 1, 10).astype(int)
    unit = np.zeros((6 * blocks, 60))
    unit[(6 * some[:, None] + np.arange(6)).ravel(), np.arange(60)] = 1.0
    expected = (unit.T @ cholesky.solve(unit)).reshape(10, 6, 10, 6)[np.arange(10), :, np.arange(10)]
    found = SelectedInverse(cholesky).blocks(some, some)
    scale = np.abs(expected).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(found / scale, expected / scale, atol=1e-9)
