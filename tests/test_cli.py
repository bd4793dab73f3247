"""The command line as a user meets it: what it writes, and one clear line with exit code 2 for every mistake."""

import argparse
import json
import shutil
import subprocess
import sys
from importlib.metadata import PackageNotFoundError

import h5py
import numpy as np
import pytest
from support.helpers import SUMMARY_KEYS
from support.recordings import ece276a_fields, utias_fields, write_mat, write_npz

from ekfslam import open_sequence, reports
from ekfslam.cli import main
from ekfslam.cli.commands import doctor
from ekfslam.cli.modes import Names
from ekfslam.data.trajectory import Trajectory
from ekfslam.errors import FilterError
from ekfslam.storage.archive import read_archive
from ekfslam.storage.exports import Poses, contents

CITY = "builtin:city?frames=20"


def failure(capsys, *arguments):
    """The one line that a mistaken call prints; exit code 2 and no traceback asserted."""
    try:
        code = main([str(a) for a in arguments])
    except SystemExit as stop:  # argparse's own errors
        code = stop.code
    captured = capsys.readouterr()
    assert code == 2
    assert "Traceback" not in captured.err
    return captured.err.strip().splitlines()[-1]


@pytest.mark.slow
def test_compare_writes_archive_summaries_and_figures(tmp_path, capsys, undrawn):
    assert main(["compare", CITY, "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "| ATE (aligned)" in printed and "verdict: " in printed and "\nnext: " in printed
    folder = tmp_path / "city"
    names = {path.name for path in folder.iterdir()}
    assert {"archive.h5", "summary.json", "summary.md", "map.png", "errors.png", "nis.png"} <= names
    summary = json.loads((folder / "summary.json").read_text())
    assert {"sequence", "frames", "landmarks", "modes", "errors"} == set(summary)
    assert summary["frames"] == 20
    assert list(summary["modes"]) == ["dead-reckoning", "mapping-only", "full", "smoothed"]
    assert all(set(values) == SUMMARY_KEYS for values in summary["modes"].values())
    assert list(read_archive(folder / "archive.h5").results) == list(summary["modes"])


@pytest.mark.slow
def test_recordings_of_one_name_do_not_overwrite_each_other(tmp_path):
    quick = ["--modes", "dead-reckoning", "--no-figures", "--executor", "serial"]
    assert main(["compare", CITY, CITY, *quick, "--out", str(tmp_path)]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"city", "city-2"}


@pytest.mark.slow
def test_simulate_run_info_plot_export_go_hand_in_hand(tmp_path, capsys):
    recording, archive = tmp_path / "city.h5", tmp_path / "deep" / "run.h5"
    assert main(["simulate", CITY, "--out", str(recording)]) == 0
    assert main(["run", str(recording), "--mode", "full", "--variant", "standard", "--out", str(archive)]) == 0
    with h5py.File(archive) as h5file:
        assert json.loads(h5file["runs/full"].attrs["config"])["filter"]["variant"] == "standard"
    capsys.readouterr()
    assert main(["info", str(recording)]) == 0
    assert "20 in 1.9 s" in capsys.readouterr().out
    assert main(["info", str(archive)]) == 0
    assert "accepted" in capsys.readouterr().out
    assert main(["plot", str(archive), "--out", str(tmp_path / "figures")]) == 0
    assert (tmp_path / "figures" / "map.png").stat().st_size > 5000
    assert main(["export", str(archive), "--format", "tum"]) == 0
    tum = np.loadtxt(tmp_path / "deep" / "run.full.tum.txt")
    assert tum.shape == (20, 8)
    assert main(["export", str(archive), "--format", "kitti", "--frame", "body", "--out", str(tmp_path / "k.txt")]) == 0
    np.testing.assert_allclose(np.loadtxt(tmp_path / "k.txt")[:, 3::4], tum[:, 1:4], atol=1e-12)


@pytest.mark.slow
def test_the_simulated_file_gives_the_builtin_s_result_to_the_last_bit(tmp_path):
    recording = tmp_path / "city.h5"
    main(["simulate", CITY, "--out", str(recording)])
    for source, out in ((str(recording), "a.h5"), (CITY, "b.h5")):
        main(["run", source, "--out", str(tmp_path / out)])
    a, b = (read_archive(tmp_path / name).results["full"] for name in ("a.h5", "b.h5"))
    np.testing.assert_array_equal(a.T_world_imu, b.T_world_imu)
    np.testing.assert_array_equal(a.covariance, b.covariance)


@pytest.mark.slow
def test_flags_override_the_file_and_the_file_the_defaults(tmp_path):
    config = tmp_path / "config.toml"
    config.write_text('[noise]\nsigma_px = 2.0\n[filter]\nvariant = "standard"\n')
    out = tmp_path / "run.h5"
    assert main(["run", CITY, "--config", str(config), "--sigma-px", "3", "--out", str(out)]) == 0
    result = read_archive(out).results["full"]
    np.testing.assert_array_equal(result.noise.pixel_std_px, 3.0)
    assert result.config["filter"]["variant"] == "standard"
    assert result.config["filter"]["gate_probability"] == 0.999


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"time_stamps": lambda a: a[:, ::-1]}, ("time_stamps", "before")),
        ({"time_stamps": lambda a: np.where(np.arange(a.size) == 3, a[0, 2], a)}, ("time_stamps[3]", "duplicates")),
        ({"linear_velocity": lambda a: np.where(np.arange(a.shape[1]) == 2, np.nan, a)}, ("linear_velocity", "NaN")),
        ({"features": lambda a: np.where(a > 900, np.inf, a)}, ("features", "infinite")),
        ({"features": lambda a: a[:3]}, ("features", "shape")),
        ({"features": lambda a: np.full_like(a, -1.0)}, ("features", "never seen")),
        ({"K": lambda a: np.diag([0.0, 1, 1])}, ("K", "singular")),
        ({"b": lambda a: -a}, ("b", "positive")),
        ({"cam_T_imu": lambda a: 2 * a}, ("cam_T_imu", "rigid")),
        ({"rotational_velocity": lambda a: a[:, :-1]}, ("rotational_velocity", "shape")),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else "",
)
def test_malformed_recordings_are_one_line_with_file_and_field(tmp_path, capsys, change, words):
    fields = ece276a_fields()
    for name, alter in change.items():
        fields[name] = alter(fields[name])
    line = failure(capsys, "info", write_npz(tmp_path / "broken.npz", fields))
    assert "broken.npz" in line
    for word in words:
        assert word in line


@pytest.mark.slow
def test_truth_of_another_length(tmp_path, capsys):
    npz = write_npz(tmp_path / "a.npz", ece276a_fields())
    poses = tmp_path / "poses.txt"
    np.savetxt(poses, np.tile(np.eye(4)[:3].ravel(), (3, 1)))
    line = failure(capsys, "compare", npz, "--truth", poses, "--out", tmp_path)
    assert "poses.txt" in line
    assert "3" in line
    assert "7" in line
    fields = utias_fields()
    fields["theta_vk_i"] = fields["theta_vk_i"][:, :-2]
    assert "theta_vk_i" in failure(capsys, "info", write_mat(tmp_path / "a.mat", fields))


@pytest.mark.parametrize("command", ["info", "compare", "run", "plot", "export"])
@pytest.mark.parametrize("kind", ["missing", "folder", "empty", "text", "truncated", "foreign"])
def test_files_that_are_none_of_ours(tmp_path, capsys, command, kind):
    path = tmp_path / "thing"
    if kind == "folder":
        path.mkdir()
    elif kind == "empty":
        path.touch()
    elif kind == "text":
        path.write_text("no recording\n")
    elif kind == "truncated":
        main(["simulate", CITY, "--out", str(path)])
        path.write_bytes(path.read_bytes()[:2000])
    elif kind == "foreign":
        with h5py.File(path, "w") as h5file:
            h5file["x"] = 1.0
    extra = {"run": ["--out", tmp_path / "o.h5"], "compare": ["--out", tmp_path], "export": ["--format", "tum"]}
    line = failure(capsys, command, path, *extra.get(command, []))
    assert "thing" in line


def test_mistakes_in_the_call(tmp_path, capsys):
    assert "atlantis" in failure(capsys, "compare", "builtin:atlantis", "--out", tmp_path)
    assert "no.toml" in failure(capsys, "run", CITY, "--config", tmp_path / "no.toml", "--out", tmp_path / "o.h5")
    assert "sigma_px" in failure(capsys, "run", CITY, "--sigma-px", "0", "--out", tmp_path / "o.h5")
    assert "unknown mode 'best'" in failure(capsys, "run", CITY, "--mode", "best", "--out", tmp_path / "o.h5")
    assert "write {name}" in failure(capsys, "compare", CITY, CITY, "--truth", tmp_path / "t.txt", "--out", tmp_path)
    assert "one by one" in failure(capsys, "compare", CITY, CITY, "--timings", "--out", tmp_path)
    (tmp_path / "file").touch()
    assert "file" in failure(capsys, "run", CITY, "--out", tmp_path / "file" / "o.h5")
    main(["run", CITY, "--mode", "dead-reckoning", "--out", str(tmp_path / "o.h5")])
    capsys.readouterr()
    assert "full" in failure(capsys, "export", tmp_path / "o.h5", "--format", "tum", "--mode", "full")
    # A result archive holds no observations to run on.
    assert "ekfslam-archive" in failure(capsys, "run", tmp_path / "o.h5", "--out", tmp_path / "p.h5")


@pytest.mark.slow
def test_posterior_writes_into_the_archive_and_draws(tmp_path, capsys, undrawn):
    archive = tmp_path / "o.h5"
    assert main(["run", CITY, "--out", str(archive)]) == 0
    assert main(["posterior", str(archive)]) == 0
    assert main(["posterior", str(archive), "--linearisation", "filtered", "--out", str(tmp_path / "figures")]) == 0
    printed = capsys.readouterr().out
    assert "| smoothed" in printed
    assert "| as filtered" in printed
    results = read_archive(archive).results
    assert list(results) == ["full", "smoothed", "as filtered"]
    assert results["full"].log is not None
    assert np.abs(results["smoothed"].T_world_imu - results["full"].T_world_imu).max() > 1e-4
    # Once more replaces, with another kernel.
    assert main(["posterior", str(archive), "--kernel", "cauchy"]) == 0
    again = read_archive(archive).results
    assert sorted(again) == sorted(results)
    assert again["smoothed"].config["posterior"]["kernel"] == "cauchy"
    for folder in (tmp_path, tmp_path / "figures"):
        assert {"map_before_and_after.png", "sparsity.png"} <= {path.name for path in folder.iterdir()}


@pytest.mark.slow
def test_posterior_of_what_has_none(tmp_path, capsys):
    main(["run", CITY, "--mode", "mapping-only", "--out", str(tmp_path / "o.h5")])
    capsys.readouterr()
    assert "runs/full is missing" in failure(capsys, "posterior", tmp_path / "o.h5")
    main(["run", CITY, "--out", str(tmp_path / "old.h5")])
    with h5py.File(tmp_path / "old.h5", "a") as h5file:
        del h5file["runs/full/log"]  # as written by the first version of the format
        h5file.attrs["format_version"] = 1
    capsys.readouterr()
    assert "has no log" in failure(capsys, "posterior", tmp_path / "old.h5")


@pytest.mark.slow
def test_check_writes_verdict_evidence_and_figure(tmp_path, capsys, undrawn):
    archive = tmp_path / "city.h5"
    assert main(["run", "builtin:city?frames=25", "--out", str(archive)]) == 0
    assert main(["check", str(archive), "--out", str(tmp_path / "checked")]) == 0
    assert "Verdict:" in capsys.readouterr().out
    assert {path.name for path in (tmp_path / "checked").iterdir()} == {"check.json", "check.md", "check.png"}
    assert "axes" in json.loads((tmp_path / "checked" / "check.json").read_text())
    assert "is missing" in failure(capsys, "check", archive, "--mode", "smoothed")
    with h5py.File(archive, "r+") as h5file:
        del h5file["runs/full/whitened"]
    assert "was made before innovations were kept: run again" in failure(capsys, "check", archive)


@pytest.mark.slow
def test_as_an_installed_command(tmp_path):
    """A real process: exit code, silence of the progress bar off a terminal, and output that survives `head`."""
    program = [sys.executable, "-m", "ekfslam.cli"]
    done = subprocess.run([*program, "info", "nowhere.npz"], capture_output=True, text=True, cwd=tmp_path, check=False)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert done.stdout == ""
    done = subprocess.run([*program, "run", CITY, "--out", "o.h5"], capture_output=True, text=True, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    helped = subprocess.run([*program, "compare", "--help"], capture_output=True, text=True, check=True).stdout
    assert "examples:" in helped
    piped = subprocess.run(
        f"{sys.executable} -m ekfslam.cli info {CITY!r} | head -n 1", shell=True, capture_output=True, text=True
    )
    assert piped.stderr == ""


def test_info_of_a_recording_lists_what_the_reader_noticed(tmp_path, capsys):
    npz = write_npz(tmp_path / "a.npz", ece276a_fields())
    assert main(["info", str(npz)]) == 0
    printed = capsys.readouterr().out
    for note in open_sequence(npz).notes:
        assert note in printed
    assert "noise         not stated; white noise of the velocities, from the data: " in printed


def test_the_sign_of_the_lateral_velocity_is_a_flag(tmp_path, capsys):
    npz = write_npz(tmp_path / "a.npz", ece276a_fields())
    for flags, found in (([], "corrected"), (["--lateral", "as-stored"], "as-stored")):
        assert main(["info", str(npz), *flags]) == 0
        assert f"lateral       {found}" in capsys.readouterr().out
    assert "lateral" in failure(capsys, "info", CITY, "--lateral", "as-stored")


@pytest.mark.slow
def test_many_recordings_are_compared_in_processes_as_one_by_one(tmp_path, capsys):
    worlds = [f"builtin:loop?frames=8&seed={seed}" for seed in (1, 2)]
    quick = ["--modes", "dead-reckoning", "full", "--no-figures"]
    assert main(["compare", *worlds, *quick, "--workers", "2", "--out", str(tmp_path / "all")]) == 0
    assert capsys.readouterr().out.count("written to") == 2
    for i, world in enumerate(worlds):
        assert main(["compare", world, *quick, "--out", str(tmp_path / "one")]) == 0
        alone = next((tmp_path / "one").glob("*/archive.h5"))
        together = sorted((tmp_path / "all").glob("*/archive.h5"))[i]
        runs = [read_archive(path).results["full"] for path in (alone, together)]
        np.testing.assert_array_equal(runs[0].T_world_imu, runs[1].T_world_imu)
        assert not list(together.parent.glob("*.png"))
        shutil.rmtree(tmp_path / "one")


def test_each_of_many_recordings_has_the_truth_of_its_name(tmp_path):
    names, mode = ("loop", "city"), ("--modes", "dead-reckoning", "--no-figures")
    for name in names:
        sequence = open_sequence(f"builtin:{name}?frames=8")
        poses = Poses(Trajectory(sequence.time_s, sequence.truth.T_world_imu), sequence.T_cam_imu)
        (tmp_path / f"{sequence.name}.tum").write_text(contents(poses, tmp_path / "x.txt", "tum")[tmp_path / "x.txt"])
    data = [f"builtin:{name}?frames=8" for name in names]
    call = ["compare", *data, *mode, "--truth", str(tmp_path / "{name}.tum"), "--out", str(tmp_path), "--workers", "1"]
    assert main(call) == 0
    for path in tmp_path.glob("*/archive.h5"):
        assert any(".tum" in note for note in read_archive(path).notes)


def test_one_recording_that_fails_does_not_keep_the_others(tmp_path, capsys, monkeypatch):
    true_compare = reports.compare_into

    def failing(sequence, folder, *arguments, **options):
        if sequence.attributes["seed"] == 1:
            raise FilterError("lost its way")
        return true_compare(sequence, folder, *arguments, **options)

    monkeypatch.setattr(reports, "compare_into", failing)
    worlds = [f"builtin:loop?frames=8&seed={seed}" for seed in (1, 2)]
    call = ["compare", *worlds, "--modes", "dead-reckoning", "--no-figures", "--executor", "serial"]
    assert main([*call, "--out", str(tmp_path)]) == 2
    said = capsys.readouterr()
    assert said.out.count("written to") == 1
    assert said.err == "ekfslam: error: loop: lost its way\n"


@pytest.mark.slow
def test_compare_goes_on_without_a_posterior_that_is_ill_posed(tmp_path, capsys):
    """Without angular velocity noise the motion rows have no weight; the filter does not mind."""
    assert main(["compare", CITY, "--sigma-w", "0", "--no-figures", "--out", str(tmp_path)]) == 0
    assert "No smoothed: the posterior is ill-posed: velocities without noise" in capsys.readouterr().out
    assert "No smoothed" in (tmp_path / "city" / "summary.md").read_text()
    assert list(read_archive(tmp_path / "city" / "archive.h5").results) == ["dead-reckoning", "mapping-only", "full"]


def test_info_says_whether_the_engine_is_built(capsys):
    assert main(["info", "--build"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split()[0] == "engine"
    assert lines[1].split()[:2] in (["smoother", "CHOLMOD"], ["smoother", "SuperLU"])
    assert any(line.split()[0] == "BLAS" for line in lines)


def test_doctor_names_what_is_missing_and_what_installs_it(capsys, monkeypatch):
    def version(name):
        if name != "rosbags":
            raise PackageNotFoundError(name)
        return "1.2"

    monkeypatch.setattr(doctor, "requires", lambda _: ['rosbags>=0.10; extra == "ros"', "opencv; extra == 'images'"])
    monkeypatch.setattr(doctor, "version", version)
    assert main(["doctor"]) == 0
    out = capsys.readouterr().out
    assert "engine" in out and "ros           ROS 1, ROS 2 and MCAP bags: rosbags 1.2\n" in out
    assert "lacks opencv: pip install 'ekfslam[images]'" in out


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (["comapre"], "did you mean compare?"),
        (["compare", "--sigmav", "3"], "did you mean --sigma-v?"),
        (["compare", "--mode", "ful"], "did you mean full?"),
        (["export", "a.h5", "--format", "tumm"], "did you mean tum?"),
        (["report"], "required: ARCHIVE (ekfslam report --help shows all)"),
    ],
)
def test_a_typing_error_is_one_line_with_the_nearest_known_name(arguments, meant, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    said = capsys.readouterr().err
    assert stopped.value.code == 2 and said.count("\n") == 1 and meant in said


def test_names_of_variants_are_separated_by_blanks_or_commas():
    parser = argparse.ArgumentParser()
    parser.add_argument("--variants", action=Names, known=("fej", "standard"))
    for given in (["fej", "standard"], ["fej,standard"], ["fej,", "standard"]):
        assert parser.parse_args(["--variants", *given]).variants == ["fej", "standard"]


def test_an_unknown_variant_among_several_is_named(capsys):
    assert "invalid choice: 'standrd'" in failure(capsys, "consistency", "--variants", "fej,standrd")
