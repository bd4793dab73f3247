"""Sparse block Cholesky factorisation against dense linear algebra, by every library at hand."""

import numpy as np
import pytest
from support.blocks import block_cholesky

from ekfslam.smoother.sparse.cholmod import BlockPattern, NotPositiveDefiniteError, SparseCholesky

pytestmark = pytest.mark.usefixtures("each_solver")

SIZES = np.array([6, 3, 6, 1, 3, 6, 3, 16, 6, 3])
EDGES = [(1, 0), (2, 0), (4, 2), (5, 0), (5, 4), (7, 3), (7, 6), (8, 5), (9, 1), (9, 8)]


def block_matrix(rng, density=0.5):
    """Dense positive definite matrix of the graph EDGES, with holes in its blocks."""
    start = np.concatenate([[0], np.cumsum(SIZES)])
    A = np.zeros((start[-1], start[-1]))
    for i, j in [*EDGES, *((i, i) for i in range(len(SIZES)))]:
        block = rng.normal(size=(SIZES[i], SIZES[j]))
        A[start[i] : start[i + 1], start[j] : start[j + 1]] = block * (rng.random(block.shape) < density)
    A = np.tril(A, -1)
    return A + A.T + np.diag(np.abs(A + A.T).sum(axis=1) + 0.1)


@pytest.fixture
def dense():
    return block_matrix(np.random.default_rng(4))


@pytest.fixture
def cholesky(dense):
    return block_cholesky(np.tril(dense), SIZES)


def test_solve_factor_and_determinant(cholesky, dense):
    b = np.random.default_rng(5).normal(size=(len(dense), 3))
    np.testing.assert_allclose(dense @ cholesky.solve(b), b, atol=1e-13)
    np.testing.assert_allclose(dense @ cholesky.solve(b[:, 0]), b[:, 0], atol=1e-13)
    L, p = cholesky.factor().toarray(), cholesky.pattern.permutation
    np.testing.assert_array_equal(np.triu(L, 1), 0)
    np.testing.assert_allclose(L @ L.T, dense[np.ix_(p, p)], atol=1e-13)
    np.testing.assert_allclose(cholesky.log_determinant, np.linalg.slogdet(dense)[1], rtol=1e-13)


def test_permutation_keeps_blocks_together_and_in_order(cholesky):
    start = np.cumsum(SIZES) - SIZES
    expected = [np.arange(start[block], start[block] + SIZES[block]) for block in cholesky.pattern.order]
    np.testing.assert_array_equal(cholesky.pattern.permutation, np.concatenate(expected))
    np.testing.assert_array_equal(np.sort(cholesky.pattern.order), np.arange(len(SIZES)))
    np.testing.assert_array_equal(cholesky.pattern.sizes, SIZES)


def test_factor_has_whole_blocks_in_spite_of_holes_in_the_matrix(cholesky):
    pattern = cholesky.factor().astype(bool)
    pattern.data[:] = True
    pattern = pattern.toarray()
    place = np.argsort(cholesky.pattern.permutation)
    start = np.cumsum(SIZES) - SIZES
    for i, j in EDGES:
        rows, columns = place[start[i] + np.arange(SIZES[i])], place[start[j] + np.arange(SIZES[j])]
        assert (pattern | pattern.T)[np.ix_(rows, columns)].all()


def test_order_of_an_arrow_puts_the_hub_last():
    """Eliminated first, block 0 would couple all the others: 8000 entries in place of 1000."""
    sizes = np.array([6] + 40 * [3])
    A = np.diag(np.full(sizes.sum(), 100.0))
    A[6:, :6] = 1.0
    factor = block_cholesky(A, sizes).factor()
    assert 981 <= factor.nnz <= 1200  # CHOLMOD may join a few columns


def test_white_noise_is_transformed_to_the_inverse_as_covariance(cholesky, dense):
    W = cholesky.sample_transform(np.eye(len(dense)))
    np.testing.assert_allclose(W @ W.T, np.linalg.inv(dense), atol=1e-14)
    np.testing.assert_allclose(cholesky.sample_transform(np.eye(len(dense))[:, 7]), W[:, 7], atol=1e-15)


def test_entries_above_the_diagonal_are_not_read(cholesky, dense):
    other = block_cholesky(np.tril(dense) + np.triu(np.full_like(dense, 1e3), 1), SIZES)
    np.testing.assert_array_equal(other.solve(np.ones(len(dense))), cholesky.solve(np.ones(len(dense))))


def test_blocks_of_a_place_in_several_sets_are_summed():
    sizes, rng = np.array([2, 3, 2]), np.random.default_rng(1)
    own = [(np.array([[0, 0], [2, 2]]), (2, 2)), (np.array([[1, 1]]), (3, 3))]
    pattern = BlockPattern(sizes, [*own, (np.array([[2, 0], [0, 0]]), (2, 2)), (np.array([[2, 1]]), (2, 3))])
    values = [np.array([5.0 * np.eye(2)] * 2), 5.0 * np.eye(3)[None], rng.normal(size=(2, 2, 2)), np.ones((1, 2, 3))]
    A = np.diag(np.full(7, 5.0))
    A[5:, :2] += values[2][0]
    A[:2, :2] += values[2][1]
    A[5:, 2:5] += 1.0
    A = np.tril(A) + np.tril(A, -1).T
    np.testing.assert_allclose(SparseCholesky(pattern, pattern.assemble(values)).solve(np.eye(7)), np.linalg.inv(A))


def test_new_values_in_the_same_pattern(cholesky, dense):
    other = dense * (1.0 + 0.05 * np.random.default_rng(6).random(dense.shape))
    other = np.tril(other) + np.tril(other, -1).T
    again = block_cholesky(other, SIZES, cholesky)
    np.testing.assert_allclose(again.solve(np.eye(len(dense))), np.linalg.inv(other), atol=1e-14)
    np.testing.assert_allclose(again.log_determinant, np.linalg.slogdet(other)[1], rtol=1e-13)
    np.testing.assert_allclose(cholesky.solve(np.eye(len(dense))), np.linalg.inv(dense), atol=1e-14)


@pytest.mark.parametrize("row", [9, 12, 14])
@pytest.mark.parametrize("value", [-1.0, 0.0, np.nan])
def test_matrix_that_is_not_positive_definite_is_a_named_error_that_names_the_block(dense, row, value):
    dense[row] = dense[:, row] = 0.0
    dense[row, row] = value
    with pytest.raises(NotPositiveDefiniteError, match=rf"53 x 53.*block 2, row {row}") as caught:
        block_cholesky(np.tril(dense), SIZES)
    assert (caught.value.block, caught.value.row) == (2, row)


def test_block_without_any_entry_is_a_named_error(dense):
    dense[9:15] = dense[:, 9:15] = 0.0
    with pytest.raises(NotPositiveDefiniteError, match="block 2, row 9"):
        block_cholesky(np.tril(dense), SIZES)


def test_factorisation_survives_new_values_that_are_not_positive_definite(cholesky, dense):
    expected = cholesky.solve(np.ones(len(dense)))
    with pytest.raises(NotPositiveDefiniteError):
        block_cholesky(-dense, SIZES, cholesky)
    np.testing.assert_array_equal(cholesky.solve(np.ones(len(dense))), expected)
