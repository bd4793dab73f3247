"""Where results come from: versions, commit, build of the engine and platform, as attributes of every archive."""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
from collections.abc import Mapping
from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import scipy

from ekfslam.engine.choice import MISSING
from ekfslam.smoother.sparse import solvers

_GIT = ("git", "describe", "--always", "--tags", "--dirty", "--abbrev=12")
_FACTS = ("commit", "engine_build", "smoother_library", "platform")


def versions() -> dict[str, str]:
    """Return the versions of the software that computes results, as attributes ``version_<name>``."""
    return {
        "version_ekfslam": version("ekfslam"),
        "version_python": platform.python_version(),
        "version_numpy": np.__version__,
        "version_scipy": scipy.__version__,
        "version_h5py": version("h5py"),
    }


@cache
def provenance() -> Mapping[str, str]:
    """Return `versions`, commit (of a checkout), build of the engine, library of the smoother, and platform."""
    facts = (commit(), _engine_build(), solvers.describe(), platform.platform())
    return versions() | {name: value for name, value in zip(_FACTS, facts, strict=True) if value}


def commit() -> str:
    """Return the commit of the checkout that the package lies in, ``-dirty`` if files differ; empty without one."""
    root = Path(__file__).parents[1]
    if not ((root / ".git").exists() and (root / "pyproject.toml").is_file()):
        return ""
    try:  # without locks: describing must not write into the repository
        environment = {**os.environ, "GIT_OPTIONAL_LOCKS": "0"}
        done = subprocess.run(_GIT, cwd=root, capture_output=True, text=True, timeout=5, env=environment, check=True)
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.strip()


def _engine_build() -> str:
    """Return the beginning of the digest of the compiled engine."""
    found = None if MISSING else find_spec("ekfslam.engine._engine")
    if found is None or found.origin is None:
        return f"none: {MISSING or 'not found'}"
    with Path(found.origin).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:12]


def in_words(attributes: Mapping[str, object]) -> str:
    """Return the facts that the attributes of a result state, on one line; empty if there are none."""
    numbers = {
        name.removeprefix("version_"): value for name, value in attributes.items() if name.startswith("version_")
    }
    said = [f"{name} {value}" for name, value in numbers.items()]
    facts = {name.replace("_", " "): attributes[name] for name in _FACTS if name in attributes}
    return ", ".join([*said[:1], *(f"{name} {value}" for name, value in facts.items()), *said[1:]])


def bibtex() -> str:
    """Return the entry of this version for BibTeX."""
    at = f", commit {commit()}" if commit() else ""
    return f"""@misc{{ekfslam,
  title = {{{{ekfslam: visual-inertial EKF-SLAM with a joint map-and-pose covariance you can trust}}}},
  author = {{{{ekfslam developers}}}},
  howpublished = {{Software, version {version("ekfslam")}{at}}},
}}
"""
