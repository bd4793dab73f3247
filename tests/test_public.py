"""The names at the top of the package: all are there, and none is imported before it is used."""

import subprocess
import sys

import pytest

import ekfslam


def test_every_public_name_is_there():
    assert {"run", "compare", "open_sequence", "Config", "posterior"} <= set(ekfslam.__all__)
    for name in ekfslam.__all__:
        assert getattr(ekfslam, name) is not None
    assert set(ekfslam.__all__) <= set(dir(ekfslam))
    assert ekfslam.__version__.count(".") == 2
    with pytest.raises(AttributeError, match="no_such_name"):
        ekfslam.no_such_name  # noqa: B018


def test_importing_the_package_imports_nothing_heavy():
    code = (
        "import ekfslam, sys; print([name for name in ('numpy', 'scipy', 'matplotlib', 'h5py') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
