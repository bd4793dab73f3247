"""Fixtures for all tests: where the recordings are."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from support.running import FORKS, recording

from ekfslam.smoother.sparse import solvers

# A shell ignores interrupts of what it runs in the background: tests send them.
signal.signal(signal.SIGINT, signal.default_int_handler)

# How long an example takes says nothing on a machine that has other work to do.
settings.register_profile("untimed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("untimed")


@pytest.hookimpl(tryfirst=True)  # before xdist looks at the groups
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests that share what their module has made run in one process, so that it is made once."""
    for item in items:
        if isinstance(item, pytest.Function) and item.get_closest_marker("xdist_group") is None:
            made = [d for name in item.fixturenames for d in item._fixtureinfo.name2fixturedefs.get(name, ())]
            if any(definition.scope == "module" for definition in made):
                item.add_marker(pytest.mark.xdist_group(item.module.__name__))


FORKS.set_forkserver_preload(["ekfslam.reports", "ekfslam.cli.commands.run", "ekfslam.cli.commands.posterior"])


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files of figures are all one small picture: drawing takes longer than most runs, and `test_plotting` tests it."""
    from matplotlib.figure import Figure

    from ekfslam.figures.style import png

    picture = png(Figure(figsize=(1, 1)))
    monkeypatch.setattr("ekfslam.figures.style.png", lambda *_: picture)


@pytest.fixture(params=sorted({solvers.solver, solvers.SuperLU}, key=lambda kind: kind.__name__))
def each_solver(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sparse matrices are factorised by the library that is chosen here, then by SuperLU."""
    monkeypatch.setattr(solvers, "solver", request.param)


@pytest.fixture
def data_path() -> Callable[[str], Path]:
    """A function from the name of a recording (``ece276a/0027.npz``) to its path; skips the test where it is absent.

    Where tests decide (``CI`` in the environment), an absent recording is a failure.
    """

    return recording
