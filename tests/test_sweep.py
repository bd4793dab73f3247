"""Sweeps: the table of a product of choices, killed and resumed, extended, on processes and Dask, read back."""

from __future__ import annotations

import dataclasses
import itertools
import os
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.images import write_course, write_plain
from support.kitti_raw import write_drive
from support.running import processes

from ekfslam import open_sequence
from ekfslam.cli import main
from ekfslam.config import Config
from ekfslam.data.readers.hdf5 import write_sequence
from ekfslam.data.simulate import builtin
from ekfslam.errors import ArchiveError, ConfigError, WriteError
from ekfslam.evaluation.summary import KEYS, summarise
from ekfslam.figures.sweep import paper_sweep, plot_sweep
from ekfslam.runner import run
from ekfslam.storage.exports import export
from ekfslam.studies import sweep as sweeps
from ekfslam.studies.executors import SerialExecutor, open_executor
from ekfslam.studies.sweep import Recording, Sweep, Task, run_sweep, run_task
from ekfslam.studies.sweep_table import SweepTable, read_table, table_image

CLOCK = ("ms_per_frame_median", "ms_per_frame_max", "total_s")  # of the wall: never the same twice
STUDY = """
recordings = ["builtin:city?frames=8", { data = "builtin:loop?frames=8", name = "ring" }]
modes = ["dead-reckoning", "full"]
variants = ["invariant", "standard"]
seeds = [3, 4]
[settings.noise]
sigma_px = [1.0, 2.0]
[settings.filter]
gate_probability = 0.99
"""


@pytest.fixture
def study(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(STUDY)
    return path


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> SweepTable:
    folder = tmp_path_factory.mktemp("sweep")
    (folder / "study.toml").write_text(STUDY)
    return run_sweep(Sweep.from_toml(folder / "study.toml"), folder / "sweep.h5", SerialExecutor())


def assert_same(table: SweepTable, other: SweepTable) -> None:
    assert list(table.columns) == list(other.columns)
    assert (table.swept, table.asked) == (other.swept, other.asked)
    for name, values in table.columns.items():
        if name not in CLOCK:
            np.testing.assert_array_equal(values, other.columns[name], name)


@pytest.mark.slow
def test_a_row_is_what_a_run_by_hand_gives(undisturbed):
    assert len(undisturbed) == undisturbed.asked == 2 * 2 * 2 * 2 * 2
    columns = undisturbed.columns
    wanted = itertools.product(
        ["city?frames=8", "ring"], [3, 4], ["invariant", "standard"], [1.0, 2.0], ["dead-reckoning", "full"]
    )
    names = ("recording", "seed", "filter.variant", "noise.sigma_px", "mode")
    assert list(zip(*(columns[name] for name in names), strict=True)) == list(wanted)
    assert (columns["filter.gate_probability"] == 0.99).all()
    row = 13
    config = Config().with_overrides(
        {"filter": {"variant": "standard", "gate_probability": 0.99}, "noise": {"sigma_px": 1.0}}
    )
    assert [columns[name][row] for name in names] == ["city?frames=8", 4, "standard", 1.0, "full"]
    sequence = open_sequence("builtin:city?frames=8&seed=4")
    by_hand = summarise(sequence, run(sequence, "full", config))
    for key in set(KEYS) - set(CLOCK):
        value = np.nan if by_hand[key] is None else by_hand[key]
        np.testing.assert_array_equal(columns[key][row], value, key)
    assert not any(columns["error"])


def killed(study: Path, path: Path, begun: Path, after: int) -> None:
    """A sweep in a process that ends in the midst of a run."""
    true_run = sweeps.run_task

    def counted(task, limit):
        with begun.open("a") as log:
            log.write(f"{task.key}\n")
        if len(begun.read_text().splitlines()) > after:
            os.kill(os.getpid(), signal.SIGKILL)
        return true_run(task, limit)

    sweeps.run_task = counted
    run_sweep(Sweep.from_toml(study), path, SerialExecutor(), False)


@pytest.mark.slow
@pytest.mark.xdist_group("processes")
def test_killed_twice_and_resumed_it_equals_an_undisturbed_one(study, tmp_path, undisturbed):
    path = tmp_path / "sweep.h5"
    begun, log = [], tmp_path / "begun"
    for after in (5, 9):
        assert processes((killed, study, path, log, after)) == [-signal.SIGKILL]
        begun.append(log.read_text().split())
        log.unlink()
    assert not path.exists()
    assert begun[1][0] == begun[0][-1], "the run in whose midst it was killed begins anew, no other does"
    assert not set(begun[0][:-1]) & set(begun[1])
    assert len(begun[1]) == 10
    assert_same(run_sweep(Sweep.from_toml(study), path, SerialExecutor()), undisturbed)
    assert_same(read_table(path), undisturbed)
    assert sorted(p.name for p in tmp_path.iterdir() if p.suffix != ".parquet") == ["study.toml", "sweep.h5"]


@pytest.mark.slow
def test_the_command_killed_with_its_workers_and_resumed_equals_an_undisturbed_one(study, tmp_path, undisturbed):
    """SIGKILL of the whole process group, twice, each time when some more runs are done and others are under way."""
    out, rng = tmp_path / "out", np.random.default_rng(0)
    journal = out / ".sweep.h5.journal"
    call = [sys.executable, "-m", "ekfslam", "sweep", str(study), "--workers", "2", "--out", str(out)]
    environment = {**os.environ, "PYTHONPATH": str(Path(sweeps.__file__).parents[2])}

    def written() -> int:
        return journal.stat().st_size if journal.exists() else 0

    for _ in range(2):
        before = written()
        begun = subprocess.Popen(call, start_new_session=True, stdout=subprocess.DEVNULL, env=environment)
        deadline = time.monotonic() + 120
        while written() < before + 3000 and begun.poll() is None and time.monotonic() < deadline:
            time.sleep(0.01)
        time.sleep(rng.uniform(0.0, 0.05))
        os.killpg(begun.pid, signal.SIGKILL)
        assert begun.wait() == -signal.SIGKILL
        assert written() >= before + 3000
        assert not (out / "sweep.h5").exists()
    assert main(["sweep", str(study), "--executor", "serial", "--out", str(out)]) == 0
    assert_same(read_table(out / "sweep.h5"), undisturbed)


@pytest.mark.slow
def test_two_dask_workers_give_the_same_table(study, tmp_path, undisturbed):
    distributed = pytest.importorskip("distributed", reason="pip install ekfslam[cluster]")
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        open_executor(cluster.scheduler_address.replace("tcp://", "dask://")) as executor,
    ):
        assert_same(run_sweep(Sweep.from_toml(study), tmp_path / "sweep.h5", executor), undisturbed)


@pytest.mark.slow
def test_an_interrupted_sweep_has_a_table_and_an_extended_one_runs_what_is_new(tmp_path, monkeypatch):
    small = Sweep((Recording("builtin:loop?frames=8", "loop"),), modes=("dead-reckoning",), seeds=(1, 2))
    path, ran = tmp_path / "sweep.h5", []

    def interrupted(task, limit):
        if len(ran) == 1:
            raise KeyboardInterrupt
        ran.append(task.seed)
        return true_run(task, limit)

    true_run = sweeps.run_task
    with monkeypatch.context() as patch:
        patch.setattr(sweeps, "run_task", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run_sweep(small, path, SerialExecutor())
    assert (len(read_table(path)), read_table(path).asked) == (1, 2)
    monkeypatch.setattr(sweeps, "run_task", lambda task, limit: (ran.append(task.seed), true_run(task))[1])
    larger = Sweep(small.recordings, modes=("dead-reckoning",), seeds=(1, 2, 3))
    assert len(run_sweep(larger, path, SerialExecutor())) == 3
    assert ran == [1, 2, 3]
    with pytest.raises(ArchiveError, match="another study"):
        run_sweep(small, path, SerialExecutor())


def test_a_run_that_fails_is_a_row_that_says_why(tmp_path):
    """A recording that cannot be opened fails alone; the table says so."""
    (tmp_path / "none.npz").write_bytes(b"nothing")
    study = 'recordings = ["none.npz", "builtin:loop?frames=8"]\nmodes = ["dead-reckoning"]\nseeds = [3, 4]'
    (tmp_path / "s.toml").write_text(study)
    table = run_sweep(Sweep.from_toml(tmp_path / "s.toml"), tmp_path / "sweep.h5", SerialExecutor())
    assert ["none.npz" in text for text in table.columns["error"]] == [True, False, False]
    assert np.isfinite(table.columns["ate_m"]).tolist() == [False, True, True]
    assert "1 without a result" in table.markdown() and "nan" not in table.markdown()  # a recording has no seed


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("recordings = []", "1 to 100000 runs, found 0"),
        ('recordings = ["builtin:city"]\nmode = ["full"]', "unknown key 'mode'"),
        ('recordings = ["builtin:city"]\nmodes = ["fast"]', "unknown mode 'fast'"),
        ('recordings = ["builtin:city"]\nmodes = "full"', "modes must be a list"),
        ('recordings = ["builtin:city"]\nseeds = [-1]', "whole numbers"),
        ('recordings = ["builtin:city", "builtin:city"]', "different names"),
        ('recordings = ["builtin:city"]\nmodes = ["full", "full"]', "same run twice"),
        ('recordings = [{ file = "x" }]', "unknown key 'file'"),
        ('recordings = ["builtin:city"]\n[settings.noise]\nsigma = [1.0]', "unknown key noise.sigma"),
        ('recordings = ["builtin:city"]\n[settings]\nnoise = 1', r"\[settings.noise\] must be a table"),
        ('recordings = ["nowhere.npz"]', "nowhere.npz"),
        ('recordings = [{ data = "builtin:city", frames = "5" }]', "frames of builtin:city: expected A:B, found '5'"),
        ('recordings = [{ data = "builtin:city", velocities = "nowhere.txt" }]', "nowhere.txt"),
        ("recordings = [", "s.toml"),
        ('recordings = ["builtin:city"]\ncases = 1', "cases must be a table, found 1"),
        ('recordings = ["builtin:city"]\n[cases.a]\nnoise = 1', r"\[cases.a\]: \[noise\] must be a table"),
        ('recordings = ["builtin:city"]\n[cases.a]\nmode = "fast"', "unknown mode 'fast'"),
        ('recordings = ["builtin:city"]\n[cases.a.noise]\nsigma = 1.0', "unknown key noise.sigma"),
        ('recordings = ["builtin:city"]\n[cases.a]\n[cases.b]', "same run twice"),
    ],
)
def test_a_study_that_makes_no_sense_is_a_named_error(tmp_path, text, words):
    (tmp_path / "s.toml").write_text(text)
    with pytest.raises(ConfigError, match=words):
        Sweep.from_toml(tmp_path / "s.toml")


def test_settings_of_blocks_are_swept(tmp_path):
    (tmp_path / "s.toml").write_text(
        'recordings = ["builtin:loop?frames=8"]\n[settings.blocks.twist_bias]\nsigma_v_m_s = [0.01, 0.1]'
    )
    sweep = Sweep.from_toml(tmp_path / "s.toml")
    assert [task.config.blocks["twist_bias"]["sigma_v_m_s"] for task in sweep.tasks] == [0.01, 0.1]


def with_noise(sequence, seed, std=0.1):
    drawn = std * np.random.default_rng(seed).standard_normal(sequence.twist.shape)
    return dataclasses.replace(sequence, twist=sequence.twist + drawn)


def heard(sequence, result):
    return float(result.counts["rejected: gate"]) if "rejected: gate" in result.counts else None


def speed(sequence, result):
    return float(sequence.twist[3, 0])


def frames(sequence, result):
    return float(len(sequence))


@pytest.mark.slow
def test_cases_are_settings_that_belong_together_each_in_its_mode(tmp_path):
    (tmp_path / "s.toml").write_text(
        """
        recordings = ["builtin:loop?frames=8"]
        [settings.noise]
        sigma_px = [1.0, 2.0]
        [cases."no test"]
        filter = { moving_sigma = inf, variant = "standard" }
        [cases.default]
        [cases.alone]
        mode = "dead-reckoning"
        """
    )
    path = tmp_path / "sweep.h5"
    table = run_sweep(Sweep.from_toml(tmp_path / "s.toml"), path, SerialExecutor())
    assert_same(read_table(path), table)
    names = ("case", "mode", "filter.variant", "noise.sigma_px", "filter.moving_sigma")
    rows = [tuple(row.values()) for row in table.rows(*names)]
    usual = Config().filter.moving_sigma
    assert rows == [
        *(("no test", "full", "standard", px, np.inf) for px in (1.0, 2.0)),
        *(("default", "full", "invariant", px, usual) for px in (1.0, 2.0)),
        *(("alone", "dead-reckoning", "invariant", px, usual) for px in (1.0, 2.0)),
    ]
    assert table.markdown(["ate_m"]).startswith("| case")
    parts = table.groups("case", "noise.sigma_px")
    assert list(parts) == [(row[0], row[3]) for row in rows]
    assert parts["alone", 2.0].rows("nis_per_dof", "mode") == [{"nis_per_dof": None, "mode": "dead-reckoning"}]
    with pytest.raises(ConfigError, match="no column 'colour'"):
        table.groups("colour")


@pytest.mark.slow
@pytest.mark.parametrize("where", ["serial", "processes"])
def test_columns_of_ones_own_and_prepared_recordings(tmp_path, where):
    world = "builtin:loop?frames=8"
    ring = Recording(world, "ring", prepare=partial(with_noise, std=0.2))
    sweep = Sweep((ring,), ("dead-reckoning", "full"), seeds=(1, 2), columns={"speed": speed, "gate": heard})
    path = tmp_path / "sweep.h5"
    with open_executor(where, 1) as executor:
        table = run_sweep(sweep, path, executor)
    assert not any(table.column("error"))
    wanted = [with_noise(open_sequence(f"{world}&seed={seed}"), seed, 0.2).twist[3, 0] for seed in (1, 2)]
    np.testing.assert_array_equal(table.column("speed"), np.repeat(wanted, 2))
    assert np.isfinite(table.column("gate")).tolist() == [False, True, False, True]
    assert_same(run_sweep(sweep, path, NeverExecutor()), table)
    for other in (
        dataclasses.replace(sweep, columns={"speed": heard, "gate": heard}),
        dataclasses.replace(sweep, recordings=(dataclasses.replace(ring, prepare=partial(with_noise, std=0.3)),)),
    ):
        with pytest.raises(ArchiveError, match="another study"):
            run_sweep(other, path, SerialExecutor())


def test_a_recording_takes_what_the_command_line_takes(tmp_path):
    """Velocities from elsewhere and a stretch of frames; they are part of what a run is known by."""
    world = open_sequence("builtin:loop?frames=12")
    samples = np.column_stack([world.time_s, 2.0 * world.twist])
    np.savetxt(tmp_path / "v.txt", samples, header="frame: imu")
    (tmp_path / "s.toml").write_text(
        """
        recordings = [
            { data = "builtin:loop?frames=12", name = "whole" },
            { data = "builtin:loop?frames=12", name = "part", frames = "2:9" },
            { data = "builtin:loop?frames=12", name = "fast", velocities = "v.txt", velocity_frame = "imu" },
        ]
        modes = ["dead-reckoning"]
        """
    )
    read = Sweep.from_toml(tmp_path / "s.toml")
    sweep = dataclasses.replace(read, columns={"speed": speed, "frames": frames})
    table = run_sweep(sweep, tmp_path / "sweep.h5", SerialExecutor())
    assert not any(table.column("error"))
    assert table.column("frames").tolist() == [12, 7, 12]
    assert table.column("speed")[1] == world.twist[5, 0]
    assert table.column("speed")[2] == pytest.approx(2.0 * table.column("speed")[0], rel=1e-3)
    before = read.recordings[2].content
    np.savetxt(tmp_path / "other.txt", samples * 1.5, header="frame: imu")
    assert dataclasses.replace(read.recordings[2], velocities=str(tmp_path / "other.txt")).content != before


class NeverExecutor(SerialExecutor):
    """Of a sweep that has nothing to run."""

    def submit(self, fn, /, *args, **kwargs):
        raise AssertionError("a run that the table holds is run again")


@pytest.mark.parametrize("name", ["ate_m", "a.b", "a/b", "", "seed"])
def test_a_column_that_hides_another_is_refused(name):
    with pytest.raises(ConfigError, match="a column of a sweep"):
        Sweep((Recording("builtin:loop?frames=8", "ring"),), columns={name: speed})


@pytest.mark.parametrize("prepare", [np.add, partial(with_noise, std=np.ones(6))])
def test_a_function_without_source_is_refused(prepare):
    with pytest.raises(ConfigError, match="a sweep takes functions of a module"):
        Sweep((Recording("builtin:loop?frames=8", "ring", prepare=prepare),))


def test_a_function_bound_to_a_function_is_known_by_the_source_of_both():
    def content(before):
        return Recording("builtin:loop", "ring", prepare=partial(with_noise, std=partial(speed, result=before))).content

    assert content(heard) == content(heard)
    assert content(heard) != content(speed)
    assert " at 0x" not in content(heard)


@pytest.mark.slow
def test_the_table_is_read_as_it_was_written_and_refuses_damage(tmp_path, undisturbed):
    path = tmp_path / "sweep.h5"
    path.write_bytes(table_image(undisturbed))
    assert_same(read_table(path), undisturbed)
    with h5py.File(path, "a") as h5file:
        del h5file["table/ate_m"]
    with pytest.raises(ArchiveError, match="table/ate_m is missing"):
        read_table(path)


def test_parquet_holds_the_same(tmp_path, undisturbed):
    parquet = pytest.importorskip("pyarrow.parquet")
    sweeps.write_table(tmp_path / "sweep.h5", undisturbed)
    found = parquet.read_table(tmp_path / "sweep.parquet").to_pydict()
    assert list(found) == list(undisturbed.columns)
    np.testing.assert_array_equal(found["ate_m"], undisturbed.columns["ate_m"])
    assert found["mode"] == undisturbed.columns["mode"].tolist()


def test_any_figure_against_any_setting_in_a_panel_for_each_recording(undisturbed):
    figure = plot_sweep(undisturbed, "ate_m", "noise.sigma_px")
    assert [ax.get_title() for ax in figure.axes] == ["city?frames=8", "ring"]
    assert [len(ax.lines) for ax in figure.axes] == [3, 3]  # dead reckoning once, two variants of full
    columns = undisturbed.columns
    chosen = (columns["recording"] == "ring") & (columns["mode"] == "full") & (columns["filter.variant"] == "standard")
    mean = [columns["ate_m"][chosen & (columns["noise.sigma_px"] == px)].mean() for px in (1.0, 2.0)]
    line = next(line for line in figure.axes[1].lines if line.get_label() == "full, standard")
    np.testing.assert_allclose(line.get_ydata(), mean)
    assert [text.get_text() for text in plot_sweep(undisturbed, "ate_m", "mode").axes[0].get_xticklabels()] == [
        "dead-reckoning",
        "full",
    ]
    (ax,) = plot_sweep(undisturbed, "ate_m", "recording").axes
    assert [text.get_text() for text in ax.get_xticklabels()] == ["city?frames=8", "ring"]
    with pytest.raises(ConfigError, match="no column 'ate'"):
        plot_sweep(undisturbed, "ate", "mode")
    with pytest.raises(ValueError, match="no number"):
        plot_sweep(undisturbed, "mode", "noise.sigma_px")


def test_a_figure_of_a_paper_has_its_width_and_a_caption(undisturbed):
    drawn = paper_sweep(undisturbed, "ate_m", "noise.sigma_px", 3.5)
    assert drawn.figure.get_figwidth() == 3.5 and not drawn.figure.get_suptitle()
    assert len(drawn.figure.axes) == 2 and "mean over seeds" in drawn.caption


def test_a_figure_has_no_more_lines_than_one_can_tell_apart():
    rows = [{"recording": "drive", "a": f"a{a}", "b": float(b), "y": 1.0} for a in range(25) for b in range(2)]
    table = SweepTable.of_rows(rows, ("recording", "a", "b"), len(rows))
    with pytest.raises(ValueError, match="1 panels with 25 lines of a are more"):
        plot_sweep(table, "y", "b")
    (ax,) = plot_sweep(table.where("a", *(f"a{a}" for a in range(24))), "y", "b").axes
    assert len(ax.lines) == 24


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """The folder of a sweep that the command has run."""
    folder = tmp_path_factory.mktemp("command")
    (folder / "s.toml").write_text('recordings = ["builtin:loop?frames=8"]\nmodes = ["dead-reckoning"]\nseeds = [1, 2]')
    call = ["sweep", str(folder / "s.toml"), "--out", str(folder), "--executor", "serial", "--plot", "ate_m", "seed"]
    assert main(call) == 0
    return folder


def test_the_command_writes_table_and_figures(finished):
    assert {"sweep.h5", "sweep.md", "ate_m-seed.png"} <= {path.name for path in finished.iterdir()}
    assert "2 of 2 runs" in (finished / "sweep.md").read_text()


def test_the_command_shows_a_table_without_running_anything(finished, capsys):
    assert main(["sweep", "--table", "--out", str(finished), "--figures", "ate_m"]) == 0
    shown = capsys.readouterr().out
    assert "| seed |" in shown
    assert "ms_per" not in shown
    assert "sweep.h5" in shown


def test_the_command_shows_chosen_runs_only(finished, capsys):
    call = ["sweep", "--table", "--out", str(finished), "--plot", "ate_m", "seed", "--width", "column"]
    assert main(call) == 0 and (finished / "ate_m-seed.pdf").read_bytes().startswith(b"%PDF")
    assert "ate_m-seed" in (finished / "captions.md").read_text()
    assert main(["sweep", "--table", "--out", str(finished), "--only", "seed=2", "mode=dead-reckoning"]) == 0
    shown = capsys.readouterr().out
    assert "1 of 1 runs" in shown
    assert "chosen from 2 of 2 runs" in shown


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "sweep needs a STUDY.toml, or --table"),
        (["--table", "--figures", "nothing"], "no column 'nothing'"),
        (["--table", "--only", "seed=3"], "the column seed has no '3'; it has 1, 2"),
        (["--table", "--plot", "mode", "seed"], "mode is no number"),
    ],
)
def test_the_command_names_a_mistake(finished, capsys, arguments, words):
    assert main(["sweep", *arguments, "--out", str(finished)]) == 2
    assert words in capsys.readouterr().err


def test_seeds_of_a_prepared_recording_make_different_runs(tmp_path):
    (tmp_path / "a.npz").write_bytes(b"any")
    drive = Recording(str(tmp_path / "a.npz"), "drive", prepare=with_noise)
    assert len({task.key for task in Sweep((drive,), seeds=(1, 2)).tasks}) == 2


@pytest.mark.slow
def test_xarray_opens_the_table(tmp_path, undisturbed):
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    (tmp_path / "sweep.h5").write_bytes(table_image(undisturbed))
    with xarray.open_dataset(tmp_path / "sweep.h5", group="table", engine="h5netcdf") as found:
        assert found["ate_m"].dims == ("run",)
        np.testing.assert_array_equal(found["ate_m"], undisturbed.columns["ate_m"])
        assert set(undisturbed.columns) == set(found.data_vars)


def test_a_second_sweep_into_the_same_table_is_told_and_loses_nothing(tmp_path):
    path, other = tmp_path / "sweep.h5", Sweep((Recording("builtin:loop?frames=5", "loop"),))
    sweep = Sweep((Recording("builtin:city?frames=5", "city"),))

    class Meanwhile:
        """An executor during whose first run another sweep begins."""

        def submit(self, function, *arguments):
            with pytest.raises(WriteError, match="another run is writing there"), open_executor("serial") as executor:
                run_sweep(other, path, executor)
            with open_executor("serial") as executor:
                return executor.submit(function, *arguments)

    table = run_sweep(sweep, path, Meanwhile())
    assert len(table.rows()) == 1 and [p.name for p in tmp_path.iterdir()] == ["sweep.h5"]
    with pytest.raises(ArchiveError, match="holds runs of another study"), open_executor("serial") as executor:
        run_sweep(other, path, executor)
    assert read_table(path).rows() == table.rows()


@pytest.mark.parametrize("kind", ["folder", "description", "links", "above", "beside", "imu"])
def test_every_file_that_opening_reads_decides_a_run(tmp_path, kind):
    folder, more = write_plain(tmp_path), {}
    data, changed = folder, folder / "left" / "0001.png"
    if kind == "description":
        data = folder / "calibration.toml"
    elif kind == "links":
        shutil.move(folder / "left", tmp_path / "elsewhere")
        (folder / "left").symlink_to(tmp_path / "elsewhere")
    elif kind == "above":
        data = write_drive(tmp_path)
        changed = data.parent / "calib_velo_to_cam.txt"
    elif kind == "beside":
        data = write_course(tmp_path)
        changed = tmp_path / "dataset02_imgs.npy"
    elif kind == "imu":
        samples = "\n".join(f"{k * 5_000_000},0,0,0,0,0,9.81" for k in range(400))
        (tmp_path / "imu.csv").write_text(samples)
        changed, more = tmp_path / "imu.yaml", {"imu": str(tmp_path / "imu.csv")}
        changed.write_text("gyroscope_noise_density: 1e-3\n")
    contents = [Recording(str(data), "a", **more).content for _ in range(2)]
    changed.write_bytes(changed.read_bytes() + b" ")
    contents.append(Recording(str(data), "a", **more).content)
    assert contents[0] == contents[1] != contents[2]


def test_a_file_that_changes_between_two_sweeps_of_a_process_is_read_again(tmp_path):
    path, poses = tmp_path / "a.h5", []
    for seed in (1, 2):
        write_sequence(builtin(f"loop?frames=5&seed={seed}"), path)
        with open_executor("serial") as executor:
            table = run_sweep(
                Sweep((Recording(str(path), "a"),), ("dead-reckoning",)), tmp_path / f"{seed}.h5", executor
            )
        poses.append(table.rows()[0]["ate_m"])
    assert poses[0] != poses[1]


def without_noise(sequence, seed):
    return dataclasses.replace(sequence, noise=None)


UNKNOWN = {
    "filter": {"gate_probability": [0.9], "iterations": [2], "retire": ["never"], "variant": ["standard"], "lag": [0]},
    "hygiene": {"min_observations": [3]},
    "posterior": {"linearisation": ["filtered"]},
}


@pytest.mark.parametrize("table", UNKNOWN)
def test_dead_reckoning_depends_on_no_setting_that_it_is_said_not_to_know(table):
    recording = Recording("builtin:city?frames=12", "city", prepare=without_noise)
    base = Task(recording, None, "", "dead-reckoning", {}, {})
    expected = run_task(base)["run"]["figures"]
    counted = [name not in CLOCK for name in KEYS]
    for key, (value,) in UNKNOWN[table].items():
        task = Task(recording, None, "", "dead-reckoning", {table: {key: value}}, {})
        assert task.run_key == base.run_key and task.key != base.key
        found = run_task(task)["run"]["figures"]
        np.testing.assert_array_equal(found[counted], expected[counted])


@pytest.mark.parametrize("known", [{"noise": {"sigma_v_m_s": 0.3}}, {"filter": {"initial_position_std_m": 0.1}}])
def test_dead_reckoning_runs_again_for_settings_that_it_knows(known):
    recording = Recording("builtin:city?frames=12", "city")
    base, task = (Task(recording, None, "", "dead-reckoning", overrides, {}) for overrides in ({}, known))
    assert task.run_key != base.run_key
    assert not np.array_equal(run_task(task)["run"]["figures"], run_task(base)["run"]["figures"], equal_nan=True)


def test_equal_runs_of_dead_reckoning_run_once_and_fill_all_their_rows(tmp_path, monkeypatch):
    ran = []
    monkeypatch.setattr(sweeps, "run", lambda sequence, mode, *rest: ran.append(mode) or run(sequence, mode, *rest))
    recording = Recording("builtin:city?frames=12", "city")
    sweep = Sweep((recording,), ("dead-reckoning", "full"), settings={"filter.gate_probability": (0.9, 0.99, 0.999)})
    with open_executor("serial") as executor:
        table = run_sweep(sweep, tmp_path / "sweep.h5", executor)
        assert sorted(ran) == ["dead-reckoning", "full", "full", "full"]
        ate = table.where("mode", "dead-reckoning").column("ate_m")
        assert len(ate) == 3 and len(set(ate.tolist())) == 1
        assert len(run_sweep(sweep, tmp_path / "sweep.h5", executor)) == 6 and len(ran) == 4


def test_a_trajectory_of_another_program_is_a_row_of_every_recording_and_seed(tmp_path):
    for seed in (0, 1):
        world = open_sequence(f"builtin:city?frames=12&seed={seed}")
        export(run(world), tmp_path / f"city_{seed}.tum", "tum")
    text = 'recordings = [{data = "builtin:city?frames=12", name = "city"}]\nseeds = [0, 1]\n'
    (tmp_path / "study.toml").write_text(text + '[with]\nmine = "{name}_{seed}.tum"\n')
    assert main(["sweep", str(tmp_path / "study.toml"), "--executor", "serial", "--out", str(tmp_path)]) == 0
    table = read_table(tmp_path / "sweep.h5")
    assert table.column("mode").tolist() == ["full", "mine"] * 2
    ours, theirs = (table.where("mode", mode).column("pose_nees_mean") for mode in ("full", "mine"))
    np.testing.assert_allclose(theirs, ours, rtol=1e-9)
    (tmp_path / "study.toml").write_text(text + '[with]\nmine = "{name}.tum"\n')
    with pytest.raises(ConfigError, match="one trajectory for 2 seeds"):
        Sweep.from_toml(tmp_path / "study.toml")
