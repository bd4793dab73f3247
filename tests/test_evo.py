"""Exported files, evaluated by evo's command line tools, have the errors that a summary states.

evo (GPL) is called as a program only; it is never imported.
"""

from __future__ import annotations

import dataclasses
import io
import json
import os
import subprocess
import sysconfig
import zipfile
from pathlib import Path

import numpy as np
import pytest

from ekfslam.cli import main
from ekfslam.data.sequence import Truth
from ekfslam.data.simulate import builtin
from ekfslam.errors import ArchiveError
from ekfslam.evaluation.summary import summarise
from ekfslam.runner import run
from ekfslam.storage.archive import read_archive, write_archive
from ekfslam.storage.exports import truth_text

ATE = ("evo_ape", "--pose_relation", "trans_part")
RPE = ("evo_rpe", "--all_pairs", "--pairs_from_reference")
METRES, DEGREES = ("--pose_relation", "trans_part"), ("--pose_relation", "angle_deg")
FRAME, PATH = ("--delta", "1", "--delta_unit", "f"), ("--delta", "10", "--delta_unit", "m")


@pytest.fixture(scope="module")
def world():
    return builtin("loop?frames=80")


@pytest.fixture(scope="module")
def result(world):
    return run(world, "full")


@pytest.fixture(scope="module")
def archive(world, result, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("evo") / "loop.h5"
    write_archive(path, world, {"full": result})
    return path


@pytest.fixture(scope="module")
def with_gaps(world, result, tmp_path_factory) -> Path:
    """An archive whose truth has a pose for two frames out of three."""
    known = np.flatnonzero(np.arange(len(world)) % 3 != 1)
    path = tmp_path_factory.mktemp("evo") / "gaps.h5"
    sparse = dataclasses.replace(world, truth=Truth(known, world.truth.T_world_imu[known]))
    write_archive(path, sparse, {"full": result})
    return path


@pytest.fixture
def evo(tmp_path):
    """A function from a tool with its options, a format and an archive to the root mean square error that evo finds."""

    def evaluate(command: tuple[str, ...], format: str, archive: Path) -> float:
        tool, *options = command
        program = Path(sysconfig.get_path("scripts")) / tool
        if not program.exists():
            pytest.skip(f"{tool} is not installed beside this Python; pip install 'ekfslam[dev]'")
        files = [tmp_path / f"{mode}.txt" for mode in ("truth", "full")]
        for path in files:
            assert main(["export", str(archive), "--format", format, "--mode", path.stem, "--out", str(path)]) == 0
        saved = tmp_path / "evo.zip"
        subprocess.run(
            [program, format, *files, *options, "--save_results", saved],
            env={**os.environ, "HOME": str(tmp_path)},  # evo writes its settings there
            capture_output=True,
            check=True,
        )
        with zipfile.ZipFile(saved) as results:
            return float(json.loads(results.read("stats.json"))["rmse"])

    return evaluate


@pytest.mark.slow
@pytest.mark.parametrize(
    ("format", "command", "key"),
    [
        pytest.param("tum", ATE, "ate_m", marks=pytest.mark.slow),
        pytest.param("tum", (*ATE, "--align"), "ate_aligned_m", marks=pytest.mark.slow),
        ("tum", (*RPE, *FRAME, *METRES), "rpe_1_frame_m"),
        pytest.param("tum", (*RPE, *FRAME, *DEGREES), "rpe_1_frame_deg", marks=pytest.mark.slow),
        pytest.param("kitti", ATE, "ate_m", marks=pytest.mark.slow),
        pytest.param("kitti", (*ATE, "--align"), "ate_aligned_m", marks=pytest.mark.slow),
        pytest.param("kitti", (*RPE, *PATH, *METRES), "rpe_10_m_m", marks=pytest.mark.slow),
        ("kitti", (*RPE, *PATH, *DEGREES), "rpe_10_m_deg"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_evo_finds_the_errors_of_the_summary(evo, world, result, archive, format, command, key):
    stated = summarise(world, result)[key]
    assert stated > 0.01
    assert evo(command, format, archive) == pytest.approx(stated, rel=0, abs=1e-9)


@pytest.mark.slow
def test_evo_finds_the_errors_where_truth_has_gaps(evo, result, with_gaps):
    stated = summarise(read_archive(with_gaps), result)["rpe_10_m_m"]
    assert evo((*RPE, *PATH, *METRES), "tum", with_gaps) == pytest.approx(stated, rel=0, abs=1e-9)


def test_exported_truth_is_that_of_the_recording(world, archive, tmp_path):
    count, text = truth_text(read_archive(archive), "", "kitti")
    rows = np.loadtxt(io.StringIO(text))
    assert count == 80
    np.testing.assert_array_equal(rows.reshape(-1, 3, 4), world.truth.T_world_imu[:, :3])


def test_exported_truth_with_gaps_has_its_own_stamps(world, with_gaps, tmp_path, capsys):
    assert main(["export", str(with_gaps), "--format", "tum", "--mode", "truth"]) == 0
    path = with_gaps.with_name("gaps.truth.tum.txt")
    assert capsys.readouterr().out == f"53 poses written to {path}\n"
    known = read_archive(with_gaps).truth.frame
    rows = np.loadtxt(path)
    np.testing.assert_array_equal(rows[:, 0], world.time_s[known])
    np.testing.assert_array_equal(rows[:, 1:4], world.truth.T_world_imu[known, :3, 3])


@pytest.mark.slow
def test_truth_that_cannot_be_exported_is_a_named_error(world, result, with_gaps, tmp_path, capsys):
    path, out = tmp_path / "blind.h5", tmp_path / "truth.txt"
    with pytest.raises(ArchiveError, match=r"gaps\.h5: holds the true pose of 53 of 80 frames.*take tum"):
        truth_text(read_archive(with_gaps), str(with_gaps), "kitti")
    none = np.empty(0, dtype=np.int64)
    map_only = Truth(none, np.empty((0, 4, 4)), world.truth.landmark, world.truth.position_m)
    for truth in (None, map_only):
        write_archive(path, dataclasses.replace(world, truth=truth), {"full": result})
        with pytest.raises(ArchiveError, match=r"blind\.h5: holds no true pose"):
            truth_text(read_archive(path), str(path), "tum")
    assert main(["export", str(path), "--format", "tum", "--mode", "truth", "--out", str(out)]) == 2
    assert capsys.readouterr().err == f"ekfslam: error: {path}: holds no true pose\n"
    assert not out.exists()


@pytest.mark.slow
def test_export_takes_whatever_the_archive_holds_and_names_it_otherwise(world, result, tmp_path, capsys):
    path = tmp_path / "loop.h5"
    write_archive(path, world, {"as filtered": dataclasses.replace(result, mode="as filtered")})
    assert main(["export", str(path), "--format", "tum", "--mode", "as filtered"]) == 0
    assert main(["export", str(path), "--format", "tum", "--mode", "best"]) == 2
    assert "runs/best is missing; this archive holds as filtered" in capsys.readouterr().err
