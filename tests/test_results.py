"""Figures under ``results/`` are those of this program: reduced runs with the seeds of the experiments.

Pages quote figures of these files (`test_docs`). Means over seeds agree within three standard errors of the reduced
runs. A single run has no standard error, so its figures are equal apart from rounding.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import ekfslam
from ekfslam.evaluation.consistency import nanmean
from ekfslam.studies.executors import SerialExecutor
from ekfslam.studies.study import LEVELS, Study, run_study
from ekfslam.studies.sweep import Sweep, run_sweep

RESULTS = Path(__file__).parents[1] / "results"
RUNS = 3
EQUAL = 1e-5  # relative: rounding of a whole drive
DRIVE = "2011_09_26_drive_0001_sync_KLT"

pytestmark = pytest.mark.slow


def stored(name):
    return json.loads((RESULTS / name).read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    ("level", "variant"),
    [("low", "invariant"), ("mid", "fej"), ("mid", "standard"), ("high", "invariant"), ("large-heading", "invariant")],
)
def test_the_study_gives_the_pose_nees_of_its_table(level, variant, tmp_path):
    quoted = stored("consistency/summary.json")["levels"][level][variant]["pose_nees"]
    study = Study({level: LEVELS[level]}, (variant,), runs=RUNS)
    values = run_study(study, tmp_path / "s.h5", SerialExecutor()).data[level][variant]["pose_nees"]
    assert quoted["runs"] == 50
    assert abs(nanmean(values, 1).mean() - quoted["mean"]) < quoted["half_width"] * np.sqrt(50 / RUNS)


@pytest.mark.parametrize("variant", ["invariant"])
def test_the_published_experiment_gives_the_nees_of_its_table(variant):
    from published_results import box_world, drive

    found = stored("published/summary.json")
    mean, half_width = found["mean_and_3_standard_errors"]["RA-L 2017, 1 %"][variant]["pose_nees_per_dof"]
    tracks = [
        drive(box_world(0.01, 0.01, 500, seed), np.random.default_rng([seed, 1]), [variant]) for seed in range(RUNS)
    ]
    nees = [track[variant].figures(planar=False)["pose_nees_per_dof"] for track in tracks]
    assert abs(np.mean(nees) - mean) < half_width * np.sqrt(found["runs"] / RUNS)


def test_the_city_gives_the_figures_of_its_summary():
    quoted = stored("demo/city/summary.json")["modes"]
    found = ekfslam.compare(ekfslam.open_sequence("builtin:city"), ["dead-reckoning", "full"]).summary["modes"]
    for mode, figures in found.items():
        for name in ("ate_m", "ate_aligned_m", "pose_nees_mean", "landmark_rmse_m"):
            assert figures[name] == pytest.approx(quoted[mode][name], rel=EQUAL), (mode, name)


@pytest.mark.data
@pytest.mark.parametrize("case", ["dead reckoning", "full", "smoothed"])
def test_a_drive_gives_the_errors_of_the_table_of_real_data(case, tmp_path, data_path):
    from common import DATA, recording
    from real_data import CASES, COLUMNS, SMOOTHED

    data_path(f"utias/{DRIVE}.mat")
    cases = {case: {**CASES, **SMOOTHED}[case]}
    sweep = Sweep((recording(DATA, f"utias/{DRIVE}.mat"),), cases=cases, columns=COLUMNS)
    found = run_sweep(sweep, tmp_path / "s.h5", SerialExecutor()).rows("ate_m", "pose_nees_with_truth_noise_mean")[0]
    rows = stored("real_data/table.json")["clean"]
    quoted = next(row for row in rows if (row["recording"], row["case"]) == (DRIVE, case))
    assert found == pytest.approx({name: quoted[name] for name in found}, rel=EQUAL)


@pytest.mark.data
def test_a_drive_without_a_part_gives_the_error_of_the_ablation(tmp_path, data_path):
    from ablation import CASES
    from common import DATA, recording

    data_path(f"utias/{DRIVE}.mat")
    case = "no tilt"
    sweep = Sweep((recording(DATA, f"utias/{DRIVE}.mat"),), cases={case: CASES[case]})
    found = run_sweep(sweep, tmp_path / "s.h5", SerialExecutor()).rows("ate_m")[0]["ate_m"]
    assert found == pytest.approx(stored("real_data/ablation.json")["ate_m"][DRIVE][case], rel=EQUAL)


@pytest.mark.data
def test_the_recording_of_the_report_gives_the_errors_of_its_summary(data_path):
    from common import DATA, open_recording, with_aligned

    data_path("ece276a/0027.npz")
    sequence = open_recording(DATA, "ece276a/0027.npz", lateral="as-stored")
    modes = ekfslam.compare(sequence, ["dead-reckoning", "full"]).summary["modes"]
    page = (RESULTS / "report/summary.md").read_text(encoding="utf-8")
    cells = next(line for line in page.splitlines() if line.startswith("| 0027 ")).strip("| ").split(" | ")
    assert cells[1] == with_aligned(modes["dead-reckoning"])
    assert cells[3] == with_aligned(modes["full"])


@pytest.mark.data
def test_images_give_the_errors_of_the_table_of_the_front_end(data_path):
    pytest.importorskip("cv2")
    import front_end
    from common import DATA

    data_path(front_end.TRUTH)
    sequence, _, _ = front_end.track_images(DATA, velocities=False)
    found = front_end.figures_of(sequence, ekfslam.run(sequence, "full", front_end.CONFIG))
    quoted = stored("front_end/front_end.json")["poses"]["front end, vision alone"]
    assert found["ate_m"] == pytest.approx(quoted["ate_m"], rel=0.02)  # versions of OpenCV differ
    assert found["ate_aligned_m"] == pytest.approx(quoted["ate_aligned_m"], rel=0.1)


@pytest.mark.data
def test_starry_night_gives_the_nees_of_its_table(data_path):
    import starry_night as night
    from common import DATA, STARRY_NIGHT

    data_path(STARRY_NIGHT)
    sequence, length = ekfslam.open_sequence(DATA / STARRY_NIGHT), night.WINDOW_FRAMES
    starts = range(0, len(sequence) - length + 1, length)
    windows = [
        night.run_window(sequence, "invariant", k, k + length, sequence.noise, np.random.default_rng(k)) for k in starts
    ]
    quoted = stored("starry_night/summary.json")["consistency"]["invariant"]["pose_nees_end_mean"]
    assert np.mean([window.pose_nees[-1] for window in windows]) == pytest.approx(quoted, rel=EQUAL)
