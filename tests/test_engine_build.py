"""The compiled module: it is built with the package and computes with SciPy's LAPACK."""

from __future__ import annotations

import numpy as np
import pytest

engine = pytest.importorskip("ekfslam.engine._engine", reason="the engine is not built", exc_type=ImportError)


def test_a_factor_is_that_of_numpy():
    A = np.random.default_rng(0).standard_normal((40, 40))
    P = A @ A.T + np.eye(40)
    np.testing.assert_allclose(engine.cholesky(P), np.linalg.cholesky(P), rtol=1e-12, atol=1e-12)


def test_what_has_no_factor_is_refused():
    with pytest.raises(ValueError, match="not positive definite"):
        engine.cholesky(np.diag([1.0, -1.0]))
    with pytest.raises(ValueError, match="square"):
        engine.cholesky(np.ones((2, 3)))
    with pytest.raises(TypeError):
        engine.cholesky("no matrix")
