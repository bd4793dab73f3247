"""A figure or a metric is one file that registers itself, wherever it lies."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
from support.helpers import synthetic_result, synthetic_sequence

from ekfslam.evaluation.metrics import METRICS
from ekfslam.evaluation.summary import KEYS, merit_rows, summarise
from ekfslam.figures.registry import FIGURES
from ekfslam.figures.run import draw_figures, save_figures

FIGURE = """
from matplotlib.figure import Figure

from ekfslam.figures.registry import figure
from ekfslam.filters.result import Result


@figure("counts_{mode}", needs={"landmarks"})
def counts(result: Result) -> Figure:
    drawn = Figure(figsize=(4.0, 3.0))
    ax = drawn.subplots()
    ax.hist(result.landmarks.observations)
    ax.set(xlabel="observations [-]", ylabel="landmarks [-]", title=result.mode)
    return drawn
"""

METRIC = """
import numpy as np

from ekfslam.data.sequence import Truth
from ekfslam.evaluation.metrics import metric
from ekfslam.filters.result import Result


@metric("longest_step_s", "longest step [s]", ".3f")
def longest_step(result: Result) -> float:
    return float(np.diff(result.time_s).max())


@metric("true_frames", "frames with truth", "d")
def true_frames(truth: Truth) -> int:
    return len(truth.frame)
"""


@pytest.fixture
def registered():
    """Return a function that runs a file from outside of the package; its entries go after the test."""
    before = [(registry, dict(registry)) for registry in (FIGURES, METRICS)]

    def load(folder: Path, text: str) -> None:
        path = folder / "own.py"
        path.write_text(text)
        exec(compile(path.read_text(), path, "exec"), {})

    yield load
    for registry, entries in before:
        registry.clear()
        registry.update(entries)


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


def test_a_metric_from_outside_is_in_summaries_and_tables(registered, tmp_path, runs):
    registered(tmp_path, METRIC)
    sequence, results = runs
    summary = summarise(sequence, results["full"])
    assert summary["longest_step_s"] == pytest.approx(0.1)
    assert list(KEYS)[-2:] == ["longest_step_s", "true_frames"]
    assert ["longest step [s]", "0.100"] in merit_rows([summary])


def test_a_metric_has_no_value_without_what_it_takes(registered, tmp_path, runs):
    registered(tmp_path, METRIC)
    sequence, results = runs
    assert summarise(sequence, results["full"])["true_frames"] == 40
    blind = dataclasses.replace(sequence, truth=None)
    assert summarise(blind, results["full"])["true_frames"] is None
