"""A figure is one file that registers itself, wherever it lies."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.helpers import synthetic_result, synthetic_sequence

from ekfslam.figures.registry import FIGURES
from ekfslam.figures.run import draw_figures, save_figures

FIGURE = """
from matplotlib.figure import Figure

from ekfslam.figures.registry import Runs, figure


@figure("counts_{mode}", needs={"landmarks"})
def counts(runs: Runs) -> Figure:
    drawn = Figure(figsize=(4.0, 3.0))
    ax = drawn.subplots()
    ax.hist(runs.result.landmarks.observations)
    ax.set(xlabel="observations [-]", ylabel="landmarks [-]", title=runs.result.mode)
    return drawn
"""


@pytest.fixture
def registered():
    """Return a function that runs a file from outside of the package; its entries go after the test."""
    figures = dict(FIGURES)

    def load(folder: Path, text: str) -> None:
        path = folder / "own.py"
        path.write_text(text)
        exec(compile(path.read_text(), path, "exec"), {})

    yield load
    FIGURES.clear()
    FIGURES.update(figures)


@pytest.fixture(scope="module")
def runs():
    sequence = synthetic_sequence(frames=40, landmarks=30)
    return sequence, {mode: synthetic_result(sequence, mode) for mode in ("dead-reckoning", "full")}


def test_a_figure_from_outside_is_drawn_of_each_run_that_offers_what_it_needs(registered, tmp_path, runs):
    registered(tmp_path, FIGURE)
    drawn = draw_figures(runs[1], runs[0].truth)
    assert [name for name in drawn if "counts" in name] == ["counts_full"]


def test_a_figure_from_outside_has_a_file_as_all_others(registered, tmp_path, runs):
    registered(tmp_path, FIGURE)
    assert tmp_path / "counts_full.png" in save_figures(tmp_path, {"full": runs[1]["full"]})
