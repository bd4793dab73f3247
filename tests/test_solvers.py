"""Libraries that factorise sparse matrices agree, and the package works without the faster one."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import scipy.sparse as sp

from ekfslam.smoother.sparse import solvers

needs_both = pytest.mark.skipif(solvers.solver is solvers.SuperLU, reason="scikit-sparse is not installed")


def drive(poses: int, closures: int, seed: int = 0) -> sp.csc_matrix:
    """Return the lower triangle of the information of a drive that comes back, three numbers a pose."""
    rng = np.random.default_rng(seed)
    ends = [(k, k + 1) for k in range(poses - 1)] + [
        tuple(sorted(rng.choice(poses, 2, False))) for _ in range(closures)
    ]
    rows = np.repeat(np.arange(len(ends)), 2)
    graph = sp.csr_array((np.tile([1.0, -0.9], len(ends)), (rows, np.ravel(ends))), shape=(len(ends), poses))
    A = sp.kron((graph.T @ graph + 0.1 * sp.eye_array(poses)), np.eye(3) + 0.2)
    return sp.csc_matrix(sp.tril(A))


@needs_both
def test_both_libraries_agree_to_13_digits():
    A, b = drive(300, 20), np.random.default_rng(1).standard_normal((900, 2))
    first, second = (kind(A).factorise(A) for kind in (solvers.solver, solvers.SuperLU))
    np.testing.assert_allclose(second.log_determinant(), first.log_determinant(), rtol=1e-13)
    for name in ("solve", "solve_lower", "solve_transposed"):
        x = getattr(first, name)(b)
        np.testing.assert_allclose(getattr(second, name)(b), x, atol=1e-13 * abs(x).max())
    L = first.lower().toarray()
    np.testing.assert_allclose(second.lower().toarray(), L, atol=1e-13 * abs(L).max())


@needs_both
@pytest.mark.parametrize("closures", [0, 30, 300])
def test_the_order_of_superlu_fills_as_little(closures):
    graph = sp.csc_array(drive(500, closures)[::3, ::3])
    full = graph + sp.tril(graph, -1).T

    def fill(order: np.ndarray) -> int:
        permuted = sp.csc_matrix(sp.tril(full[order][:, order]))
        return solvers.SuperLU(permuted).factorise(permuted).lower().nnz

    assert fill(solvers.SuperLU.order(graph)) <= 1.25 * fill(solvers.solver.order(graph))


def test_the_order_of_superlu_is_a_postorder():
    graph = sp.csc_array(drive(200, 15)[::3, ::3])
    order = solvers.SuperLU.order(graph)
    np.testing.assert_array_equal(np.sort(order), np.arange(200))
    full = graph + sp.tril(graph, -1).T
    permuted = sp.csc_matrix(sp.tril(full[order][:, order]))
    L = solvers.SuperLU(permuted).factorise(permuted).lower()
    parent = L.indices[np.minimum(L.indptr[:-1] + 1, L.nnz - 1)]
    first = np.arange(200)  # lowest node of the subtree of each
    size = np.ones(200, dtype=int)
    for node in range(200):
        if L.indptr[node + 1] - L.indptr[node] > 1:
            first[parent[node]] = min(first[parent[node]], first[node])
            size[parent[node]] += size[node]
    np.testing.assert_array_equal(np.arange(200) - first + 1, size)  # subtrees are contiguous


def test_superlu_keeps_zeros_that_belong_to_the_pattern():
    A = sp.csc_matrix((np.array([2.0, 0.0, 0.0, 2.0, 2.0]), ([0, 1, 2, 1, 2], [0, 0, 0, 1, 2])))
    assert A.nnz == 5
    assert solvers.SuperLU(A).factorise(A).lower().nnz == 6  # both zeros, and (2, 1) that follows from them


@pytest.mark.parametrize("bad", [0, 7, 29])
@pytest.mark.parametrize("kind", list(dict.fromkeys([solvers.solver, solvers.SuperLU])), ids=lambda kind: kind.__name__)
def test_the_first_pivot_that_is_not_positive_is_named(kind, bad):
    A = np.array(drive(10, 0).todense())
    A = A + np.tril(A, -1).T
    A[bad, bad] -= 10.0 * A[bad, bad]
    A = sp.csc_matrix(np.tril(A))
    with pytest.raises(solvers.PivotError) as caught:
        kind(A).factorise(A)
    assert caught.value.column == bad


def test_superlu_serves_a_long_chain_with_one_loop_closure():
    """The entries that the closure fills would underflow if each step along the chain made them smaller."""
    chain = drive(3000, 0)[::3, ::3].tocoo()
    closed = sp.csc_matrix((np.append(chain.data, -0.1), (np.append(chain.row, 2999), np.append(chain.col, 0))))
    assert solvers.SuperLU(closed).factorise(closed).lower().nnz == 3000 + 2999 + 2998


def test_a_run_without_scikit_sparse_ends_with_superlu(tmp_path):
    code = f"""
import sys
sys.modules["sksparse"] = None
from ekfslam.cli import main
assert main(["info", "--build"]) == 0
sys.exit(main(["compare", "builtin:city?frames=30", "--no-figures", "--out", {str(tmp_path)!r}]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "smoother      SuperLU" in done.stdout
    assert "smoothed" in done.stdout
