"""The compiled module: it takes SciPy's LAPACK, and its stub names what it has."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import ekfslam.engine

engine = pytest.importorskip("ekfslam.engine._engine", reason="the engine is not built", exc_type=ImportError)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("del routines['dtrmm']", "needs scipy.linalg.cython_blas.dtrmm, which this SciPy lacks"),
        ("routines['dsyrk'] = routines['dgemm']", "cannot call scipy.linalg.cython_blas.dsyrk of this SciPy"),
    ],
)
def test_a_scipy_that_does_not_fit_is_named_at_import(change, message):
    code = f"from scipy.linalg.cython_blas import __pyx_capi__ as routines; {change}; import ekfslam.engine._engine"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 1
    assert f"ImportError: the engine {message}" in done.stderr


def names(body: list[ast.stmt]) -> set[str]:
    """Return the public names that the statements of a stub define."""
    found = {node.name for node in body if isinstance(node, (ast.FunctionDef, ast.ClassDef))}
    found |= {node.target.id for node in body if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)}
    return {name for name in found if not name.startswith("_")}


def test_the_stub_names_what_the_module_has():
    stub = ast.parse(Path(ekfslam.engine.__file__).with_name("_engine.pyi").read_text(encoding="utf-8"))
    public = {name for name in vars(engine) if not name.startswith("_")}
    assert names(stub.body) == public
    for node in stub.body:
        if isinstance(node, ast.ClassDef):
            members = {name for name in vars(getattr(engine, node.name)) if not name.startswith("_")}
            assert names(node.body) == members, node.name
