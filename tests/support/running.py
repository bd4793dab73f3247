"""Scale of the slow tests, paths of the recordings, and test processes."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

# The whole form of the slow tests; by default they are reduced: fewer seeds, shorter drives.
WHOLE = os.environ.get("EKFSLAM_TESTS") == "whole"
DATA = Path(os.environ.get("EKFSLAM_DATA") or Path(__file__).resolve().parents[3] / "shared" / "data")


def seeds(whole: int, reduced: int) -> range:
    """Seeds of a study: so many in the whole form of the tests, fewer in the reduced one."""
    return range(whole if WHOLE else reduced)


# Copies of a process that has imported the package and has no threads: a new one takes a second to import it.
FORKS = multiprocessing.get_context("forkserver")


def processes(*calls: tuple[Any, ...]) -> list[int | None]:
    """Exit codes of processes that work at once, each of a function of a module and its arguments.

    Negative is the signal that ended one. For what happens to processes; their tests belong to one group of xdist.
    """
    begun = [FORKS.Process(target=_silently, args=call, daemon=True) for call in calls]
    for process in begun:
        process.start()
    for process in begun:
        process.join(120.0)
    return [process.exitcode for process in begun]


def _silently(work: Callable[..., object], *arguments: object) -> None:
    with Path(os.devnull).open("w") as nowhere:
        sys.stdout = sys.stderr = nowhere
        work(*arguments)


def command(arguments: list[str], cpu_s: float = 0.0) -> None:
    """A command; after so much time of its process, that ends without warning."""
    from ekfslam.cli import main

    signal.setitimer(signal.ITIMER_PROF, cpu_s)  # its signal kills; 0 is never
    assert main(arguments) == 0


def recording(name: str) -> Path:
    """The path of a recording, as of `data_path`."""
    path = DATA / name
    if not path.exists():
        missing = f"recording {path} is absent; set $EKFSLAM_DATA to the folder of the recordings"
        pytest.fail(missing) if os.environ.get("CI") else pytest.skip(missing)
    return path
