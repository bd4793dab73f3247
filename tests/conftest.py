"""Fixtures for all tests: where the recordings are."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# How long an example takes says nothing on a machine that has other work to do.
settings.register_profile("untimed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("untimed")

# The whole form of the slow tests; by default they are reduced: fewer seeds, shorter drives.
WHOLE = os.environ.get("EKFSLAM_TESTS") == "whole"
DATA = Path(os.environ.get("EKFSLAM_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")


def seeds(whole: int, reduced: int) -> range:
    """Seeds of a study: so many in the whole form of the tests, fewer in the reduced one."""
    return range(whole if WHOLE else reduced)


def forked(work: Callable[[], object]) -> int:
    """Exit code of a process that begins as a copy of this one and only works; negative: the signal that ended it.

    For what happens to processes. A new interpreter takes a second to import what is there already.
    """
    process = os.fork()
    if process == 0:
        code = 1
        try:
            with Path(os.devnull).open("w") as nowhere:
                sys.stdout = sys.stderr = nowhere
                work()
            code = 0
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])


@pytest.fixture
def data_path() -> Callable[[str], Path]:
    """A function from the name of a recording (``ece276a/0027.npz``) to its path; skips the test where it is absent.

    Where tests decide (``CI`` in the environment), an absent recording is a failure.
    """

    return recording


def recording(name: str) -> Path:
    """The path of a recording, as of `data_path`."""
    path = DATA / name
    if not path.exists():
        missing = f"recording {path} is absent; set $EKFSLAM_DATA to the folder of the recordings"
        pytest.fail(missing) if os.environ.get("CI") else pytest.skip(missing)
    return path
