"""The sparse Cholesky wrapper, whichever release of scikit-sparse is installed."""

import numpy as np
import pytest
import scipy.sparse as sp

from ekfslam.cholmod import NotPositiveDefiniteError, SparseCholesky


@pytest.fixture
def matrix():
    rng = np.random.default_rng(4)
    rows = sp.random_array((90, 60), density=0.06, rng=rng)
    return sp.csc_array(rows.T @ rows + 0.5 * sp.eye_array(60))


def test_solve_factor_permutation_and_determinant(matrix):
    factor, dense = SparseCholesky(matrix), matrix.toarray()
    b = np.random.default_rng(5).normal(size=(60, 3))
    np.testing.assert_allclose(dense @ factor.solve(b), b, atol=1e-12)
    np.testing.assert_allclose(dense @ factor.solve(b[:, 0]), b[:, 0], atol=1e-12)
    L, p = factor.factor().toarray(), factor.permutation
    np.testing.assert_array_equal(np.triu(L, 1), 0)
    np.testing.assert_allclose(L @ L.T, dense[np.ix_(p, p)], atol=1e-12)
    np.testing.assert_allclose(factor.log_determinant, np.linalg.slogdet(dense)[1], rtol=1e-13)


def test_indefinite_matrix_is_a_named_error(matrix):
    with pytest.raises(NotPositiveDefiniteError, match="60 x 60"):
        SparseCholesky(sp.csc_array(matrix - 5.0 * sp.eye_array(60)))
