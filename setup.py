"""Says before anything is built whether SuiteSparse is missing; all else stands in ``pyproject.toml``.

Without its headers, installing stops much later inside of scikit-sparse, with a message that names no package.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import sysconfig

from setuptools import setup

MISSING = """
SuiteSparse is missing: no header cholmod.h was found, and scikit-sparse is compiled against it.
Install it first, then try again:
    Debian, Ubuntu:   sudo apt-get install gcc libsuitesparse-dev libopenblas0 python3-dev
    Fedora:           sudo dnf install gcc suitesparse-devel openblas python3-devel
    macOS, Homebrew:  brew install suite-sparse
    conda:            conda install -c conda-forge scikit-sparse=0.4.16
Where it lies in a folder of its own: CFLAGS=-I/that/include LDFLAGS=-L/that/lib pip install ...
To build without it all the same: EKFSLAM_WITHOUT_SUITESPARSE=1
"""
INSTALLING = {"dist_info", "bdist_wheel", "editable_wheel"}


def has_scikit_sparse() -> bool:
    """Whether it is there already, outside of the environment that pip builds in."""
    return subprocess.run([sys.executable, "-I", "-c", "import sksparse.cholmod"], capture_output=True).returncode == 0


def has_cholmod() -> bool:
    """Whether the compiler finds the header."""
    compiler = shlex.split(os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc")[:1]
    flags = shlex.split(os.environ.get("CFLAGS", "")) + shlex.split(os.environ.get("CPPFLAGS", ""))
    places = [
        "-I/usr/include/suitesparse",
        "-I/opt/homebrew/include",
        "-I/usr/local/include",
        f"-I{sys.prefix}/include",
    ]
    call = [*compiler, *flags, *places, "-E", "-x", "c", "-"]
    try:
        done = subprocess.run(call, input=b"#include <cholmod.h>\n", capture_output=True)
    except OSError:
        return False
    return done.returncode == 0


if __name__ == "__main__":
    asked = INSTALLING & set(sys.argv) and not os.environ.get("EKFSLAM_WITHOUT_SUITESPARSE")
    if asked and not has_cholmod() and not has_scikit_sparse():
        sys.exit(MISSING)
    setup()
