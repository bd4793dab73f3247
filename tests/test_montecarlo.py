"""Monte Carlo studies: the same bits wherever they run, however often killed, and numbers that mean something."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import h5py
import numpy as np
import pytest
from PIL import Image
from support.running import WHOLE
from support.studies import short

from ekfslam.cli import main
from ekfslam.config import Config, FilterConfig
from ekfslam.data.simulate import simulate
from ekfslam.errors import ArchiveError, ConfigError, InnovationError
from ekfslam.evaluation.consistency import (
    average_over_runs,
    chi2_bounds,
    nanmean,
    nees,
    pose_error,
    pose_nees,
)
from ekfslam.filters import JointEKF
from ekfslam.filters.loop import run_filter
from ekfslam.filters.variants import VARIANTS
from ekfslam.geometry import se3
from ekfslam.models.sensors.stereo import Rig
from ekfslam.runner import run
from ekfslam.stored import AXES
from ekfslam.studies import study as montecarlo
from ekfslam.studies.executors import SerialExecutor, open_executor
from ekfslam.studies.study import (
    LEVELS,
    VARIANT_LAYOUT,
    Study,
    filter_config,
    read_study,
    realisation,
    run_one,
    run_study,
)
from ekfslam.studies.summary import study_table, summarise_study

SMALL = Study({**short("mid"), **short("low")}, ("invariant", "standard"), runs=3, seed=5)


def datasets(path) -> dict[str, np.ndarray]:
    found: dict[str, np.ndarray] = {}
    with h5py.File(path) as h5file:
        h5file.visititems(lambda name, item: found.update({name: item[()]}) if isinstance(item, h5py.Dataset) else None)
    return found


def assert_same_bits(path, other):
    a, b = datasets(path), datasets(other)
    assert list(a) == list(b)
    for name in a:
        assert a[name].dtype == b[name].dtype
        assert a[name].tobytes() == b[name].tobytes(), name


@pytest.fixture(scope="module")
def serial(tmp_path_factory):
    path = tmp_path_factory.mktemp("study") / "serial.h5"
    run_study(SMALL, path, SerialExecutor())
    return path


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2] if WHOLE else [2])
def test_processes_give_the_same_bits_as_one_thread(tmp_path, serial, workers):
    with open_executor("processes", workers) as executor:
        run_study(SMALL, tmp_path / "s.h5", executor)
    assert_same_bits(tmp_path / "s.h5", serial)


@pytest.mark.slow
def test_dask_workers_give_the_same_bits(tmp_path, serial):
    distributed = pytest.importorskip(
        "distributed", reason="distributed is not installed: pip install ekfslam[cluster]"
    )
    with (
        distributed.LocalCluster(n_workers=2 if WHOLE else 1, threads_per_worker=1, dashboard_address=None) as cluster,
        open_executor(cluster.scheduler_address.replace("tcp://", "dask://")) as executor,
    ):
        run_study(SMALL, tmp_path / "s.h5", executor)
    assert_same_bits(tmp_path / "s.h5", serial)


@pytest.mark.slow
def test_threads_of_one_process_take_turns_and_give_the_same_bits(tmp_path, serial):
    with ThreadPoolExecutor(3) as executor:
        run_study(SMALL, tmp_path / "s.h5", executor)
    assert_same_bits(tmp_path / "s.h5", serial)


# All runs but the first are held up for a while, in which the test kills it: no run needs that long to compute.
KILLED = """
import sys
import time
from test_montecarlo import LONG
from ekfslam.studies import study as montecarlo
from ekfslam.studies.executors import open_executor

plain = montecarlo.run_one
def run_one(study, level, run):
    if run >= 6:
        time.sleep(1.0)
    return plain(study, level, run)

montecarlo.run_one = run_one
if __name__ == "__main__":
    with open_executor("processes", 2) as executor:
        montecarlo.run_study(LONG, sys.argv[1], executor)
"""
LONG = Study(short("mid", 8), ("invariant", "standard"), runs=10, seed=2)


@pytest.mark.slow
def test_a_study_killed_with_its_workers_resumes_and_ends_as_if_undisturbed(tmp_path, monkeypatch):
    script, path = tmp_path / "killed.py", tmp_path / "study.h5"
    journal = tmp_path / ".study.h5.journal"
    script.write_text(KILLED)
    tests = Path(__file__).parent
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join((str(tests.parent), str(tests))))
    of_one = sum(value.nbytes for fields in run_one(LONG, "mid", 0).values() for value in fields.values())
    process = subprocess.Popen([sys.executable, script, path], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and not (journal.exists() and journal.stat().st_size > 5 * of_one):
        assert process.poll() is None, process.stderr.read().decode()
        time.sleep(0.1)
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=30)  # ends only when no worker holds the pipes any more
    assert not path.exists()

    again = []
    plain = montecarlo.run_one
    monkeypatch.setattr(montecarlo, "run_one", lambda *task: (again.append(task[2]), plain(*task))[1])
    run_study(LONG, path, SerialExecutor())
    assert 1 <= len(again) <= 5
    run_study(LONG, path, SerialExecutor())
    assert len(again) <= 5, "nothing was left to do"
    run_study(LONG, tmp_path / "undisturbed.h5", SerialExecutor())
    assert_same_bits(path, tmp_path / "undisturbed.h5")
    assert {p.name for p in tmp_path.iterdir()} == {"killed.py", "study.h5", "undisturbed.h5"}


@pytest.mark.slow
def test_an_interrupted_study_has_an_archive_of_what_is_finished(tmp_path, monkeypatch):
    plain = montecarlo.run_one

    def interrupted(study, level, run):
        if run == 2:
            raise KeyboardInterrupt
        return plain(study, level, run)

    with monkeypatch.context() as patch:
        patch.setattr(montecarlo, "run_one", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run_study(LONG, tmp_path / "s.h5", SerialExecutor())
    found = read_study(tmp_path / "s.h5")
    assert found.done["mid"].tolist() == [True] * 2 + [False] * 8
    assert np.isnan(found.data["mid"]["standard"]["pose_nees"][2:]).all()
    assert not (tmp_path / ".s.h5.journal").exists()


@pytest.mark.slow
def test_more_runs_extend_a_study_and_leave_the_old_ones_alone(tmp_path, serial):
    path = tmp_path / "s.h5"
    path.write_bytes(serial.read_bytes())
    more = dataclasses.replace(SMALL, runs=4)
    run_study(more, path, SerialExecutor())
    run_study(more, tmp_path / "at_once.h5", SerialExecutor())
    assert_same_bits(path, tmp_path / "at_once.h5")
    old, new = datasets(serial), datasets(path)
    for name in old:
        if not name.endswith("/time"):  # of a run; what is no run's, as stamps, stays as it is
            kept = new[name] if new[name].shape == old[name].shape else new[name][:3]
            np.testing.assert_array_equal(kept, old[name])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"seed": 6}, ("seed is 5", "asked for 6")),
        ({"runs": 2}, ("runs is 3", "asked for 2")),
        ({"variants": ("invariant", "fej")}, ("variants is ('invariant', 'standard')", "'fej'")),
        ({"levels": {**short("mid"), **short("low", sigma_px=0.6)}}, ("levels.low.sigma_px is 0.5", "0.6")),
        ({"levels": short("mid")}, ("levels.low.name is low, asked for None",)),
    ],
)
def test_another_study_is_refused_by_name(serial, change, words):
    before = serial.read_bytes()
    with pytest.raises(ArchiveError) as error:
        run_study(dataclasses.replace(SMALL, **change), serial, SerialExecutor())
    for word in (str(serial), *words):
        assert word in str(error.value)
    assert serial.read_bytes() == before


def test_runs_of_another_version_are_not_mixed_in(tmp_path, serial):
    path = tmp_path / "s.h5"
    path.write_bytes(serial.read_bytes())
    with h5py.File(path, "r+") as h5file:
        h5file.attrs["version_numpy"] = "1.0"
    run_study(SMALL, path, SerialExecutor())  # finished: nothing to mix
    with pytest.raises(ArchiveError, match=r"version_numpy is 1\.0"):
        run_study(dataclasses.replace(SMALL, runs=4), path, SerialExecutor())


@pytest.mark.parametrize(
    "kind", ["missing", "text", "truncated", "foreign", "newer", "other JSON", "no levels", "no runs"]
)
def test_what_is_no_archive_of_a_study(tmp_path, serial, kind):
    path = tmp_path / "thing.h5"
    if kind == "text":
        path.write_text("no study\n")
    elif kind == "truncated":
        path.write_bytes(serial.read_bytes()[:3000])
    elif kind == "foreign":
        h5py.File(path, "w").close()
    elif kind == "newer":
        path.write_bytes(serial.read_bytes())
        with h5py.File(path, "r+") as h5file:
            h5file.attrs["format_version"] = 99
    elif kind != "missing":
        path.write_bytes(serial.read_bytes())
        changed = {**SMALL.parameters, **{"no levels": {"levels": []}, "no runs": {"runs": 0}}.get(kind, {})}
        with h5py.File(path, "r+") as h5file:
            h5file.attrs["study"] = "[]" if kind == "other JSON" else json.dumps(changed)
    with pytest.raises(ArchiveError, match=r"thing\.h5.*"):
        read_study(path)


def test_every_data_set_has_units_and_frame_and_the_shape_it_promises(serial):
    with h5py.File(serial) as h5file:
        assert h5file.attrs["format"] == b"ekfslam-study"
        assert json.loads(h5file.attrs["study"])["seed"] == 5
        for item in VARIANT_LAYOUT:
            dataset = h5file["levels/mid/invariant"][item.name]
            lengths = {"T": 8, "J": 4, **{name: len(axis.labels) for name, axis in AXES.items() if axis.labels}}
            assert dataset.shape == (3, *(lengths.get(n, n) for n in item.shape[1:]))
            assert (dataset.attrs["units"].decode(), dataset.attrs["frame"].decode()) == (item.units, item.frame)


def test_realisations_are_distinct_and_independent_of_what_else_the_study_holds():
    seeds = {realisation(SMALL, level, i).seed for level in ("mid", "low") for i in range(50)}
    assert len(seeds) == 100
    alone = Study(short("low"), ("standard",), runs=1, seed=5)
    assert realisation(alone, "low", 2) == realisation(SMALL, "low", 2)
    assert realisation(dataclasses.replace(alone, seed=6), "low", 2) != realisation(alone, "low", 2)
    together, single = run_one(SMALL, "low", 2)["standard"], run_one(alone, "low", 2)["standard"]
    for item in VARIANT_LAYOUT:
        np.testing.assert_array_equal(together[item.name], single[item.name])


@pytest.mark.parametrize("variant", ["invariant", "standard"])
def test_a_record_is_what_an_ordinary_run_gives(variant):
    """The study drives the filter itself; `runner.run` on the same recording must agree, and so must every error."""
    study = Study(short("large-heading", 30), (variant,), runs=1)
    world = realisation(study, "large-heading", 0)
    record = run_one(study, "large-heading", 0)[variant]
    sequence = simulate(world)
    settings = FilterConfig(
        variant=variant,
        retire="never",
        gate_probability=1.0,
        split_after=0,
        initial_position_std_m=0.5,
        initial_rotation_std_rad=np.deg2rad(15.0),
    )
    result = run(sequence, config=Config(filter=settings))
    frames, values = pose_nees(result, sequence.truth)
    assert np.isnan(record["pose_nees"][0])  # the first pose is drawn, and not part of the recording
    np.testing.assert_allclose(record["pose_nees"][frames], values, rtol=1e-9)
    np.testing.assert_allclose(record["nis"], result.innovation.nis, rtol=1e-9)
    np.testing.assert_array_equal(record["nis_dof"], result.innovation.dof)
    T, T_true = result.T_world_imu[-1], sequence.truth.T_world_imu[-1]
    np.testing.assert_allclose(record["position_error"][-1], T[:3, 3] - T_true[:3, 3], atol=1e-12)
    np.testing.assert_allclose(se3.so3_exp(record["rotation_error"][-1]) @ T_true[:3, :3], T[:3, :3], atol=1e-12)
    xi, P = pose_error(T, T_true), result.covariance[-1]
    assert record["position_nees"][-1] == pytest.approx(xi[:3] @ np.linalg.solve(P[:3, :3], xi[:3]))
    assert record["orientation_nees"][-1] == pytest.approx(xi[3:] @ np.linalg.solve(P[3:, 3:], xi[3:]))
    np.testing.assert_allclose(
        record["three_sigma"][-1, 3:], 3 * np.sqrt(np.diag(T[:3, :3] @ P[3:, 3:] @ T[:3, :3].T)), rtol=1e-9
    )
    landmarks = result.landmarks
    m_true = sequence.truth.position_m[np.searchsorted(sequence.truth.landmark, landmarks.id)]
    error = m_true - landmarks.position_m
    if variant == "invariant":
        error = VARIANTS["invariant"].landmark_error(landmarks.position_m, m_true, T, T_true)
    assert record["landmark_nees"][-1] == pytest.approx(nees(error, landmarks.covariance).mean())
    assert not record["diverged"]


def test_the_joint_nees_at_the_first_instant_is_that_of_the_whole_state():
    study = Study(short("mid", 9), ("invariant",), runs=1)
    record = run_one(study, "mid", 0)["invariant"]
    world = realisation(study, "mid", 0)
    sequence = simulate(world)
    ekf = JointEKF(
        Rig(sequence.camera, sequence.T_cam_imu, sequence.noise),
        filter_config(world, "invariant"),
        np.eye(4),
    )
    for _ in run_filter(ekf, sequence, range(3)):  # the first of four instants in 9 frames is frame 2
        pass
    T_true = sequence.truth.T_world_imu[1]
    m_true = sequence.truth.position_m[np.searchsorted(sequence.truth.landmark, ekf.ids)]
    d = VARIANTS["invariant"].landmark_error(ekf.positions_m, m_true, ekf.T_world_imu, T_true)
    e = np.concatenate([pose_error(ekf.T_world_imu, T_true), d.ravel()])
    views = ekf.model.layout.columns(ekf.model.layout.views)
    P = np.delete(np.delete(ekf.P, views, 0), views, 1)
    expected = e @ np.linalg.solve(P, e) / len(e)
    assert record["joint_nees_per_dof"][0] == pytest.approx(expected, rel=1e-6)


def test_nothing_that_was_simulated_is_censored(monkeypatch):
    reasons = []
    plain = JointEKF.update

    def watched(self, *arguments):
        report = plain(self, *arguments)
        reasons.append(report.reason)
        return report

    monkeypatch.setattr(JointEKF, "update", watched)
    run_one(Study(short("high", 60), ("invariant",), runs=1), "high", 0)
    assert len(reasons) == 60
    assert (np.concatenate(reasons) == -1).all()


def test_a_filter_that_stops_or_goes_astray_is_counted_not_raised(tmp_path, monkeypatch):
    plain = JointEKF.update

    def failing(self, frame, *arguments):
        if self.config.variant == "standard" and frame == 4:
            raise InnovationError(frame, [1])
        if self.config.variant == "fej" and frame == 6:
            self.P[0, 0] = np.nan
        report = plain(self, frame, *arguments)
        if self.config.variant == "invariant" and frame == 7:  # the last one, after which nothing can mend it
            self.values["pose"] = se3.exp(np.array([41.0, 0, 0, 0, 0, 0])) @ self.T_imu_world
        return report

    monkeypatch.setattr(JointEKF, "update", failing)
    study = Study(short("mid"), ("invariant", "standard", "fej", "standard-iterated"), runs=2)
    archive = run_study(study, tmp_path / "s.h5", SerialExecutor())
    summary = summarise_study(archive)["levels"]["mid"]
    assert [summary[v]["diverged"] for v in study.variants] == [2, 2, 2, 2]
    standard = archive.data["mid"]["standard"]
    assert np.isfinite(standard["pose_nees"][:, 1:4]).all()
    assert np.isnan(standard["pose_nees"][:, 4:]).all()
    assert summary["standard"]["pose_nees"]["runs"] == 2
    json.dumps(summary, allow_nan=False)
    assert "2 of 2" in study_table(summarise_study(archive))


def test_averages_take_runs_as_the_samples_and_nan_as_absent():
    values = np.array([[1.0, 3.0, np.nan], [4.0, 4.0, np.nan], [np.nan, 9.0, np.nan]])
    np.testing.assert_allclose(nanmean(values, axis=1), [2.0, 4.0, 9.0])
    np.testing.assert_allclose(nanmean(values, axis=0), [2.5, 16 / 3, np.nan])
    average = average_over_runs(np.array([2.0, 4.0, 9.0, np.nan]))
    assert average["mean"] == pytest.approx(5.0)
    assert average["half_width"] == pytest.approx(3 * np.sqrt(13.0) / np.sqrt(3))
    assert (average["median"], average["runs"]) == (4.0, 3)
    assert average_over_runs(np.full(2, np.nan))["mean"] is None
    assert average_over_runs(np.array([1.0]))["half_width"] is None


def test_bounds_are_the_published_ones():
    for dof, probability, runs, low, high in (
        (6, 0.95, 20, 4.58, 7.61),
        (6, 0.95, 50, 5.08, 7.00),
        (6, 0.999, 20, 3.77, 8.88),
        (6, 0.999, 50, 4.52, 7.74),
        (3, 0.999, 20, 1.52, 5.13),
        (3, 0.999, 100, 2.26, 3.87),
    ):
        np.testing.assert_allclose(chi2_bounds(dof, probability, runs), (low, high), atol=0.005)


def test_mistakes_in_a_study_are_named(capsys, tmp_path):
    for changes, word in (
        ({"variants": ("best",)}, "best"),
        ({"variants": ("fej", "fej")}, "twice"),
        ({"runs": 0}, "run"),
        ({"levels": {}}, "level"),
        ({"levels": short("mid", initial_rotation_std_rad=0.0)}, "prior"),
    ):
        with pytest.raises(ConfigError, match=word):
            dataclasses.replace(SMALL, **changes)
    for spec, workers, word in (("cloud", None, "cloud"), ("processes", 0, "workers")):
        with pytest.raises(ConfigError, match=word), open_executor(spec, workers):
            pass


@pytest.mark.parametrize(("spec", "package"), [("mpi", "mpi4py.futures"), ("dask://host:1", "distributed")])
def test_an_executor_that_is_not_installed_says_what_to_install(monkeypatch, spec, package):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ConfigError, match=r"pip install 'ekfslam\[cluster\]'"), open_executor(spec):
        pass


@pytest.mark.slow
def test_the_command_writes_everything_and_goes_on_where_it_was(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("ekfslam.cli.commands.consistency.LEVELS", short("mid"))
    call = ["consistency", "--runs", "2", "--level", "mid", "--executor", "serial", "--out", str(tmp_path)]
    assert main(call) == 0
    printed = capsys.readouterr()
    assert "| pose NEES (6)" in printed.out
    assert printed.out.startswith((tmp_path / "table.md").read_text())
    assert printed.err == ""
    figures = {f"{kind}_mid.png" for kind in ("nees", "errors")} | {"boxes.png"}
    assert {p.name for p in tmp_path.iterdir()} == {"study.h5", "summary.json", "table.md", *figures}
    assert all(min(Image.open(tmp_path / name).size) > 400 for name in figures)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["levels"]["mid"]["invariant"]["pose_nees"]["expected"] == 6
    before = (tmp_path / "study.h5").read_bytes()
    assert main(call) == 0
    assert (tmp_path / "study.h5").read_bytes() == before
    capsys.readouterr()
    assert main([*call, "--seed", "1"]) == 2
    assert "seed is 0, asked for 1" in capsys.readouterr().err


@pytest.mark.slow
def test_invariant_is_consistent_over_twenty_runs_and_standard_is_not(tmp_path):
    """The whole point: pose ANEES of 20 runs at three instants within its two-sided 99.9 % bounds, or far outside."""
    frames = 160 if WHOLE else 36
    level = dataclasses.replace(LEVELS["large-heading"], frames=frames)
    study = Study({"large-heading": level}, ("invariant", "standard"), runs=20, seed=0)
    values = run_study(study, tmp_path / "s.h5", SerialExecutor()).data["large-heading"]
    instants = [frames // 3, 2 * frames // 3, frames - 1]
    low, high = chi2_bounds(6, 0.999, 20)
    np.testing.assert_allclose((low, high), (3.77, 8.88), atol=0.005)
    invariant, standard = (nanmean(values[v]["pose_nees"], axis=0)[instants] for v in ("invariant", "standard"))
    assert ((low < invariant) & (invariant < high)).all(), invariant
    assert (standard > 5 * high).all(), standard
    landmark_low, landmark_high = chi2_bounds(3, 0.999, 20)
    landmark = nanmean(values["invariant"]["landmark_nees"], axis=0)[instants]
    assert ((landmark_low < landmark) & (landmark < landmark_high)).all(), landmark
    for k in instants:
        dof = values["invariant"]["nis_dof"][:, k].sum()
        nis_low, nis_high = chi2_bounds(dof, 0.999)
        assert nis_low < values["invariant"]["nis"][:, k].sum() < nis_high
    assert not values["invariant"]["diverged"].any()


def test_the_textbook_filter_is_the_standard_variant_with_landmarks_in_xyz():
    config = filter_config(LEVELS["mid"], "textbook")
    assert (config.variant, config.landmark_coordinates) == ("standard", "xyz")
    assert filter_config(LEVELS["mid"], "standard").landmark_coordinates == "image"


def test_the_table_names_the_textbook_filter(tmp_path):
    study = Study(short("mid"), ("standard", "textbook"), runs=1)
    table = study_table(summarise_study(run_study(study, tmp_path / "s.h5", SerialExecutor())))
    assert "| textbook (standard, xyz) |" in table
    assert "All variants but the textbook one keep landmarks in image coordinates." in table


def test_the_nis_of_a_study_is_per_degree_of_freedom_of_a_whole_run(serial):
    archive = read_study(serial)
    values = archive.data["mid"]["invariant"]
    expected = np.mean([np.nansum(nis) / dof.sum() for nis, dof in zip(values["nis"], values["nis_dof"], strict=True)])
    found = summarise_study(archive)["levels"]["mid"]["invariant"]["nis_per_dof"]
    assert found["mean"] == pytest.approx(expected, rel=1e-12)


@pytest.mark.slow
def test_the_pose_nees_that_the_first_page_quotes_is_that_of_the_program(tmp_path):
    """Six drives of 50, full length: within three standard errors of the quoted means."""
    page = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
    row = r"^\| {} .*?\| (\S+) ± (\S+) \|"
    quoted = [re.search(row.format(name), page, re.MULTILINE).groups() for name in ("invariant", "textbook")]
    (ours, ours_width), (textbook, textbook_width) = np.array(quoted, dtype=float)
    runs = 6
    study = Study({"mid": LEVELS["mid"]}, ("invariant", "textbook"), runs=runs)
    values = run_study(study, tmp_path / "s.h5", SerialExecutor()).data["mid"]
    means = [nanmean(values[variant]["pose_nees"], axis=1).mean() for variant in study.variants]
    allowed = np.array([ours_width, textbook_width]) * np.sqrt(50 / runs)
    assert (np.abs(means - np.array([ours, textbook])) < allowed).all(), means
    assert means[1] > 2 * means[0]
