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
from scipy.spatial.transform import Rotation

from ekfslam.cli import main
from ekfslam.data.sequence import Truth
from ekfslam.data.simulate import builtin
from ekfslam.errors import ArchiveError
from ekfslam.evaluation.summary import summarise
from ekfslam.geometry import se3
from ekfslam.geometry.camera import T_CAM_BODY
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

    def evaluate(command: tuple[str, ...], format: str, archive: Path, *how: str) -> float:
        tool, *options = command
        program = Path(sysconfig.get_path("scripts")) / tool
        if not program.exists():
            pytest.skip(f"{tool} is not installed beside this Python; pip install 'ekfslam[dev]'")
        files = [tmp_path / f"{mode}.txt" for mode in ("truth", "full")]
        for path in files:
            assert (
                main(
                    [
                        "export",
                        str(archive),
                        "--format",
                        format,
                        "--mode",
                        path.stem,
                        "--out",
                        str(path),
                        *how,
                        "--force",
                    ]
                )
                == 0
            )
        saved = tmp_path / "evo.zip"
        saved.unlink(missing_ok=True)  # evo would ask
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
    assert evo(command, format, archive, "--frame", "body") == pytest.approx(stated, rel=0, abs=1e-9)


@pytest.mark.slow
def test_evo_finds_the_errors_of_the_summary_in_the_left_camera_relative_to_its_first_pose(
    evo, world, result, tmp_path
):
    path, T_imu_body = tmp_path / "camera.h5", se3.inverse(world.T_cam_imu) @ T_CAM_BODY
    truth = Truth(world.truth.frame, world.truth.T_world_imu @ T_imu_body)
    moved = dataclasses.replace(world, T_cam_imu=T_CAM_BODY, truth=truth)
    of_camera = dataclasses.replace(result, T_cam_imu=T_CAM_BODY, T_world_imu=result.T_world_imu @ T_imu_body)
    write_archive(path, moved, {"full": of_camera})
    stated = summarise(moved, of_camera)
    # The first pose is known, so it turns nothing: both trajectories start at the same place.
    assert evo(ATE, "kitti", path) == pytest.approx(stated["ate_m"], rel=0, abs=1e-9)
    assert evo((*RPE, *PATH, *DEGREES), "kitti", path) == pytest.approx(stated["rpe_10_m_deg"], rel=0, abs=1e-6)
    assert evo(ATE, "tum", path, "--frame", "camera") == pytest.approx(stated["ate_m"], rel=0, abs=1e-9)


def test_poses_of_kitti_are_of_the_left_camera_in_its_first_frame(archive, result, tmp_path):
    assert main(["export", str(archive), "--format", "kitti", "--out", str(tmp_path / "k.txt")]) == 0
    T = result.T_world_imu @ se3.inverse(result.T_cam_imu)
    rows = np.loadtxt(tmp_path / "k.txt").reshape(-1, 3, 4)
    np.testing.assert_allclose(rows, (np.linalg.inv(T[0]) @ T)[:, :3], rtol=0, atol=1e-12)
    np.testing.assert_allclose(rows[0], np.eye(4)[:3], atol=1e-12)
    # The camera looks along its third axis, which is the way of the vehicle.
    assert np.abs(rows[5, 2, 3]) > 5 * np.abs(rows[5, :2, 3]).max()


@pytest.mark.slow
def test_evo_reads_the_bag_of_a_result_exactly(evo, result, archive, tmp_path):
    bag = tmp_path / "full.mcap"
    assert main(["export", str(archive), "--format", "bag", "--out", str(bag)]) == 0
    program = Path(sysconfig.get_path("scripts")) / "evo_traj"
    if not program.exists():
        pytest.skip("evo_traj is not installed beside this Python; pip install 'ekfslam[dev]'")
    subprocess.run(
        [program, "bag2", bag, "/ekfslam/odometry", "--save_as_tum"],
        env={**os.environ, "HOME": str(tmp_path)},
        cwd=tmp_path,
        capture_output=True,
        check=True,
    )
    rows = np.loadtxt(next(tmp_path.glob("*.tum")))
    np.testing.assert_array_equal(rows[:, 1:4], result.T_world_imu[:, :3, 3])
    np.testing.assert_allclose(rows[:, 0], result.time_s, rtol=0, atol=1e-9)
    R = Rotation.from_quat(rows[:, 4:]).as_matrix()
    np.testing.assert_allclose(R, result.T_world_imu[:, :3, :3], rtol=0, atol=1e-12)


@pytest.mark.slow
def test_evo_finds_the_errors_where_truth_has_gaps(evo, result, with_gaps):
    stated = summarise(read_archive(with_gaps), result)["rpe_10_m_m"]
    assert evo((*RPE, *PATH, *METRES), "tum", with_gaps) == pytest.approx(stated, rel=0, abs=1e-9)


def test_exported_truth_is_that_of_the_recording(world, archive, tmp_path):
    count, text = truth_text(read_archive(archive), "", "tum")
    rows = np.loadtxt(io.StringIO(text))
    assert count == 80
    np.testing.assert_array_equal(rows[:, 1:4], world.truth.T_world_imu[:, :3, 3])


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
