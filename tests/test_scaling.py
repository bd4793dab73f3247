"""What the size of the map must not cost, counted as work; seconds are `experiments/scaling.py`'s business."""

from __future__ import annotations

import importlib.util
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ekfslam import run
from ekfslam.config import Config, FilterConfig
from ekfslam.data.sequence import Sequence
from ekfslam.data.simulate import City, simulate
from ekfslam.filters import JointEKF
from ekfslam.filters.loop import run_filter
from ekfslam.models.sensors.stereo import Rig
from ekfslam.resolve import noise_of, settings_of
from ekfslam.smoother.posterior import posterior

EXPERIMENT = Path(__file__).parents[1] / "experiments" / "scaling.py"
SHORT_TRACKS = City(landmarks_per_m=8.0, max_tracks=77, loss_probability=0.09)


def state_sizes(sequence: Sequence) -> list[int]:
    config = settings_of(sequence, Config(filter=FilterConfig(retire="unseen")))
    rig = Rig(sequence.camera, sequence.T_cam_imu, noise_of(sequence, config))
    ekf = JointEKF(rig, config.filter, sequence.initial_T_world_imu)
    return [len(ekf.P) for _ in run_filter(ekf, sequence)]


def test_the_state_is_as_large_as_what_is_in_view_however_long_the_drive() -> None:
    sequence = simulate(replace(SHORT_TRACKS, frames=180))
    in_view = np.bincount(sequence.observations.frame, minlength=len(sequence))
    sizes = np.array(state_sizes(sequence))
    assert len(sequence.observations.ids) > 20 * in_view.max()
    assert (sizes <= 18 + 3 * in_view).all()  # rejected observations start nothing


@pytest.mark.slow
def test_entries_of_the_factor_grow_in_proportion_to_the_landmarks() -> None:
    entries = []
    for frames in (50, 100, 200):
        information = posterior(run(simulate(replace(SHORT_TRACKS, frames=frames)), "full")).information
        entries.append(information.factor.factor().nnz / len(information.d))
    assert max(entries) < 1.5 * min(entries)


@pytest.mark.slow
def test_the_experiment_writes_table_numbers_and_figure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = importlib.util.spec_from_file_location("scaling", EXPERIMENT)
    assert spec is not None
    assert spec.loader is not None
    scaling = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(scaling)
    monkeypatch.setattr(scaling, "SIZES", (60, 90, 120, 180))
    monkeypatch.setattr(scaling, "DENSE_SIZES", (60, 90, 120, 180))
    monkeypatch.setattr(scaling, "IN_TURN_WITH", 180)
    monkeypatch.setattr(scaling, "POOLED", 0)
    monkeypatch.setattr(scaling, "LOOP_FRAMES", 40)
    monkeypatch.setattr(
        scaling, "in_own_process", lambda worker, landmarks: scaling.WORKERS[worker](min(landmarks, 300))
    )
    monkeypatch.setattr(sys, "argv", ["scaling.py", "--quick", "--out", str(tmp_path)])
    scaling.main()
    found = json.loads((tmp_path / "scaling.json").read_text(encoding="utf-8"))
    assert [row["landmarks"] > 0 for row in found["sizes"]] == [True] * 4
    assert max(row["map"]["against_solves"] for row in found["sizes"]) < 1e-9
    assert (tmp_path / "scaling.png").stat().st_size > 10_000
    assert "| M |" in (tmp_path / "scaling.md").read_text(encoding="utf-8")
