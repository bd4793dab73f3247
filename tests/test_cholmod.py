"""Sparse block Cholesky factorisation against dense linear algebra."""

import numpy as np
import pytest
import scipy.sparse as sp

from ekfslam.smoother.sparse.cholmod import NotPositiveDefiniteError, PatternError, SparseCholesky

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
    return SparseCholesky(sp.csc_array(np.tril(dense)), SIZES)


def test_solve_factor_and_determinant(cholesky, dense):
    b = np.random.default_rng(5).normal(size=(len(dense), 3))
    np.testing.assert_allclose(dense @ cholesky.solve(b), b, atol=1e-13)
    np.testing.assert_allclose(dense @ cholesky.solve(b[:, 0]), b[:, 0], atol=1e-13)
    L, p = cholesky.factor().toarray(), cholesky.permutation
    np.testing.assert_array_equal(np.triu(L, 1), 0)
    np.testing.assert_allclose(L @ L.T, dense[np.ix_(p, p)], atol=1e-13)
    np.testing.assert_allclose(cholesky.log_determinant, np.linalg.slogdet(dense)[1], rtol=1e-13)


def test_permutation_keeps_blocks_together_and_in_order(cholesky):
    start = np.cumsum(SIZES) - SIZES
    expected = [np.arange(start[block], start[block] + SIZES[block]) for block in cholesky.block_order]
    np.testing.assert_array_equal(cholesky.permutation, np.concatenate(expected))
    np.testing.assert_array_equal(np.sort(cholesky.block_order), np.arange(len(SIZES)))
    np.testing.assert_array_equal(cholesky.block_sizes, SIZES)


def test_factor_has_whole_blocks_in_spite_of_holes_in_the_matrix(cholesky):
    pattern = cholesky.factor().astype(bool)
    pattern.data[:] = True
    pattern = pattern.toarray()
    place = np.argsort(cholesky.permutation)
    start = np.cumsum(SIZES) - SIZES
    for i, j in EDGES:
        rows, columns = place[start[i] + np.arange(SIZES[i])], place[start[j] + np.arange(SIZES[j])]
        assert (pattern | pattern.T)[np.ix_(rows, columns)].all()


def test_order_of_an_arrow_puts_the_hub_last():
    """Eliminated first, block 0 would couple all the others: 8000 entries in place of 1000."""
    sizes = np.array([6] + 40 * [3])
    A = np.diag(np.full(sizes.sum(), 100.0))
    A[6:, :6] = 1.0
    factor = SparseCholesky(sp.csc_array(A), sizes).factor()
    assert 981 <= factor.nnz <= 1200  # CHOLMOD may join a few columns


def test_white_noise_is_transformed_to_the_inverse_as_covariance(cholesky, dense):
    W = cholesky.sample_transform(np.eye(len(dense)))
    np.testing.assert_allclose(W @ W.T, np.linalg.inv(dense), atol=1e-14)
    np.testing.assert_allclose(cholesky.sample_transform(np.eye(len(dense))[:, 7]), W[:, 7], atol=1e-15)


def test_entries_above_the_diagonal_are_not_read(cholesky, dense):
    """In particular not those between blocks that no entry below the diagonal couples."""
    other = SparseCholesky(sp.csc_array(np.tril(dense) + np.triu(np.full_like(dense, 1e3), 1)), SIZES)
    np.testing.assert_array_equal(other.solve(np.ones(len(dense))), cholesky.solve(np.ones(len(dense))))


def test_entries_given_twice_in_any_order_are_summed(cholesky, dense):
    A = sp.csc_array(np.tril(dense))
    twice = sp.csc_array((np.repeat(A.data, 2) * np.tile([0.25, 0.75], A.nnz), np.repeat(A.indices, 2), 2 * A.indptr))
    for k in range(len(dense)):
        column = slice(twice.indptr[k], twice.indptr[k + 1])
        twice.indices[column] = twice.indices[column][::-1]
        twice.data[column] = twice.data[column][::-1]
    np.testing.assert_allclose(SparseCholesky(twice, SIZES).solve(np.eye(len(dense))), np.linalg.inv(dense), atol=1e-14)


def test_new_values_in_the_same_pattern(cholesky, dense):
    A = sp.csc_array(np.tril(dense))
    other = A.copy()
    other.data = A.data * (1.0 + 0.05 * np.random.default_rng(6).random(A.nnz))
    full = other.toarray() + np.tril(other.toarray(), -1).T
    again = cholesky.with_values(other)
    np.testing.assert_allclose(again.solve(np.eye(len(dense))), np.linalg.inv(full), atol=1e-14)
    np.testing.assert_allclose(again.log_determinant, np.linalg.slogdet(full)[1], rtol=1e-13)
    np.testing.assert_array_equal(again.permutation, cholesky.permutation)
    np.testing.assert_allclose(cholesky.solve(np.eye(len(dense))), np.linalg.inv(dense), atol=1e-14)


def test_new_values_must_have_the_same_pattern(cholesky, dense):
    A = np.tril(dense)
    A[-1, 0] = 1e-3
    with pytest.raises(PatternError, match="53 x 53"):
        cholesky.with_values(sp.csc_array(A))
    moved = sp.csc_array(np.tril(dense))
    moved.indices[moved.indptr[1] - 1] = len(dense) - 1  # as many entries in every column as before
    with pytest.raises(PatternError):
        cholesky.with_values(moved)


def test_block_sizes_must_fit_the_matrix(dense):
    A = sp.csc_array(np.tril(dense))
    for sizes in (SIZES[1:], [*SIZES, 0], [*SIZES[:-1], -3, 6], []):
        with pytest.raises(PatternError, match=f"{len(sizes)} blocks"):
            SparseCholesky(A, sizes)
    with pytest.raises(PatternError):
        SparseCholesky(A[:, :-1], SIZES)


@pytest.mark.parametrize("row", [9, 12, 14])
@pytest.mark.parametrize("value", [-1.0, 0.0, np.nan])
def test_matrix_that_is_not_positive_definite_is_a_named_error_that_names_the_block(dense, row, value):
    dense[row] = dense[:, row] = 0.0
    dense[row, row] = value
    with pytest.raises(NotPositiveDefiniteError, match=rf"53 x 53.*block 2, row {row}") as caught:
        SparseCholesky(sp.csc_array(np.tril(dense)), SIZES)
    assert (caught.value.block, caught.value.row) == (2, row)


def test_block_without_any_entry_is_a_named_error(dense):
    dense[9:15] = dense[:, 9:15] = 0.0
    with pytest.raises(NotPositiveDefiniteError, match="block 2, row 9"):
        SparseCholesky(sp.csc_array(np.tril(dense)), SIZES)
    with pytest.raises(NotPositiveDefiniteError, match="9 x 9"):
        SparseCholesky(sp.csc_array((9, 9)), [6, 3])


def test_factorisation_survives_new_values_that_are_not_positive_definite(cholesky, dense):
    A = sp.csc_array(np.tril(dense))
    expected = cholesky.solve(np.ones(len(dense)))
    with pytest.raises(NotPositiveDefiniteError):
        cholesky.with_values(-A)
    np.testing.assert_array_equal(cholesky.solve(np.ones(len(dense))), expected)
