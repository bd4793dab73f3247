"""Fixtures for all tests: where the recordings are."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

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


@pytest.hookimpl(tryfirst=True)  # before xdist looks at the groups
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests that share what their module has made run in one process, so that it is made once."""
    for item in items:
        if isinstance(item, pytest.Function) and item.get_closest_marker("xdist_group") is None:
            made = [d for name in item.fixturenames for d in item._fixtureinfo.name2fixturedefs.get(name, ())]
            if any(definition.scope == "module" for definition in made):
                item.add_marker(pytest.mark.xdist_group(item.module.__name__))


# Copies of a process that has imported the package and has no threads: a new one takes a second to import it.
FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload(["ekfslam.reports", "ekfslam.cli.commands.run", "ekfslam.cli.commands.posterior"])


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


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files of figures are all one small picture: drawing takes longer than most runs, and `test_plotting` tests it."""
    from matplotlib.figure import Figure

    from ekfslam.figures.style import png

    picture = png(Figure(figsize=(1, 1)))
    for place in ("figures.style", "reports"):
        monkeypatch.setattr(f"ekfslam.{place}.png", lambda *_: picture)


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
