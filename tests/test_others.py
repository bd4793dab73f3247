"""Trajectories of other programs beside ours: same figures of merit, matched by time, in any frame and world."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import ekfslam
from ekfslam.cli import main
from ekfslam.data.simulate import builtin
from ekfslam.data.trajectory import from_left_error
from ekfslam.errors import ConfigError, ShapeError, TruthError, UnknownFormatError
from ekfslam.evaluation.summary import summarise
from ekfslam.evaluation.truth import estimated
from ekfslam.figures.run import draw_figures
from ekfslam.figures.series import height, height_of
from ekfslam.geometry import se3
from ekfslam.others import Others
from ekfslam.reports import compared_table
from ekfslam.storage.exports import export

WORLD = se3.exp(np.array([3.0, -2.0, 1.0, 0.2, -0.4, 2.0]))
FRAMES = 30


@pytest.fixture(scope="module")
def world():
    return builtin(f"city?frames={FRAMES}")


@pytest.fixture(scope="module")
def full(world):
    return ekfslam.run(world)


@pytest.fixture(scope="module")
def files(full, tmp_path_factory):
    """A folder with our own trajectory as other programs write it."""
    folder = tmp_path_factory.mktemp("theirs")
    export(full, folder / "mine.txt", "tum")
    export(full, folder / "camera.txt", "tum", frame="camera")
    export(full, folder / "kitti.txt", "kitti")
    lines = (folder / "mine.txt").read_text().splitlines(keepends=True)
    (folder / "gaps.tum").write_text("".join(line for k, line in enumerate(lines) if k not in (0, 1, 10, 11, 12, 29)))
    return folder


def figures(recording, full, files, **how):
    """Return the figures of merit of each trajectory and those of our run."""
    found = Others(files, **how).results(recording, full)
    every = {**found, "ours": full}
    return {name: summarise(recording, result) for name, result in every.items()}


TIMES = ("accepted", "rejected", "ms_per_frame_median", "ms_per_frame_max", "total_s", "nis_per_dof", "landmark_rmse_m")


def test_our_own_export_has_our_own_figures_of_merit(world, full, files):
    found = figures(world, full, {"mine": files / "mine.txt"})
    for key in found["ours"].keys() - set(TIMES):
        assert found["mine"][key] == pytest.approx(found["ours"][key], rel=1e-9), key
    assert all(found["mine"][key] is None for key in TIMES)
    assert found["mine"]["pose_nees_mean"] > 1.0


def test_poses_of_the_camera_and_their_covariances_are_turned_to_the_body(world, full, files):
    found = figures(world, full, {"camera": files / "camera.txt"}, frame="camera")
    for key in ("ate_m", "rpe_1_frame_deg", "pose_nees_mean", "pose_nees_y_mean"):
        assert found["camera"][key] == pytest.approx(found["ours"][key], rel=1e-6), key


def test_kitti_poses_are_of_the_camera_unless_said_otherwise(world, full, files, tmp_path):
    export(full, tmp_path / "body.txt", "kitti", frame="body")
    found = figures(world, full, {"kitti": files / "kitti.txt"})
    of_body = figures(world, full, {"kitti": tmp_path / "body.txt"}, frame="body")
    for one in (found, of_body):
        assert one["kitti"]["ate_m"] == pytest.approx(one["ours"]["ate_m"], rel=1e-6)
        assert one["kitti"]["pose_nees_mean"] is None


def test_a_world_of_its_own_is_moved_to_the_first_pose_unless_it_shall_stay(world, full):
    moved = ekfslam.Trajectory(full.time_s, WORLD @ full.T_world_imu)
    found = figures(world, full, {"moved": moved})
    assert found["moved"]["ate_m"] == pytest.approx(found["ours"]["ate_m"], rel=1e-6)
    kept = figures(world, full, {"moved": moved}, world="given")
    assert kept["moved"]["ate_m"] > 1.0
    assert kept["moved"]["ate_aligned_m"] == pytest.approx(found["ours"]["ate_aligned_m"], rel=1e-6)
    assert "moved by" in " ".join(Others({"moved": moved}).results(world, full)["moved"].remarks)


def test_the_first_pose_is_moved_to_the_true_one_from_any_world_to_any_other(world, full):
    truth = dataclasses.replace(world.truth, T_world_imu=WORLD @ world.truth.T_world_imu)
    theirs = ekfslam.Trajectory(full.time_s, se3.exp(np.arange(6.0) / 3.0) @ full.T_world_imu)
    moved = Others({"mine": theirs}).results(dataclasses.replace(world, truth=truth))["mine"]
    np.testing.assert_allclose(moved.T_world_imu, WORLD @ full.T_world_imu, atol=1e-9)


def test_a_first_pose_that_agrees_within_its_covariance_stays_where_it_is():
    """The first tilt of an inertial unit is uncertain: moved to the true heading, its NEES would be another one."""
    room = ekfslam.open_sequence("builtin:room?frames=40")
    ours = ekfslam.run(room)
    poses = from_left_error(ours.time_s, ours.T_world_imu, ours.covariance)
    found = figures(room, ours, {"mine": poses, "alone": dataclasses.replace(poses, covariance=None)})
    for key in ("ate_m", "ate_aligned_4dof_m", "pose_nees_mean"):
        assert found["mine"][key] == pytest.approx(found["ours"][key], rel=1e-6), key
    assert found["alone"]["ate_aligned_4dof_m"] == pytest.approx(found["ours"]["ate_aligned_4dof_m"], rel=1e-6)
    off = dataclasses.replace(poses, T_world=WORLD @ poses.T_world)
    moved = Others({"off": off}).results(room, ours)["off"]
    assert "its tilt kept; its first covariance is not 0" in moved.remarks[1]
    heading, true = (np.arctan2(T[1, 0], T[0, 0]) for T in (moved.T_world_imu[0], room.truth.T_world_imu[0]))
    assert heading == pytest.approx(true, abs=1e-9)


def test_frames_without_a_pose_are_named_and_count_in_no_figure(world, full, files):
    result = Others({"gaps": files / "gaps.tum"}, world="given").results(world, full)["gaps"]
    known = np.setdiff1d(np.arange(FRAMES), [0, 1, 10, 11, 12, 29])
    off = full.T_world_imu[known, :3, 3] - world.truth.T_world_imu[known, :3, 3]
    merit = summarise(world, result)
    assert merit["ate_m"] == pytest.approx(np.sqrt((off**2).sum(axis=1).mean()), rel=1e-9)
    assert merit["pose_nees_mean"] is None
    assert result.remarks == (
        "24 of 24 poses belong to frames, by the nearest stamp within 50.1 ms; no pose for 6 of 30 frames: 0 to 1, "
        "10 to 12, 29",
    )


def test_poses_without_a_frame_are_counted_and_named(world, full):
    k = np.r_[0:10]
    late = ekfslam.Trajectory(np.r_[full.time_s[k], full.time_s[-1] + [1.0, 2.0]], full.T_world_imu[[*k, 9, 9]])
    (said,) = Others({"late": late}).results(world, full)["late"].remarks
    assert said.startswith("10 of 12 poses belong to frames") and "no frame for those at 3.9" in said


def test_without_truth_and_a_run_of_ours_a_trajectory_stays_in_its_own_world(world, full, tmp_path):
    moved = ekfslam.Trajectory(full.time_s, WORLD @ full.T_world_imu)
    ekfslam.write_archive(tmp_path / "a.h5", world, {"full": full})
    recording = dataclasses.replace(ekfslam.read_archive(tmp_path / "a.h5"), truth=None)
    found = Others({"mine": moved}).results(recording)["mine"]
    np.testing.assert_allclose(found.T_world_imu, moved.T_world, atol=1e-9)


def test_compare_saves_them_as_runs_that_figures_and_the_page_show(world, files, tmp_path):
    compared = ekfslam.compare(world, ["full"], others={"mine": files / "mine.txt", "gaps": files / "gaps.tum"})
    assert list(compared.results) == ["full", "mine", "gaps"] == list(compared.summary["modes"])
    assert "Note on gaps: 24 of 24 poses" in compared.table
    compared.save(tmp_path, figures=False)
    (note,) = compared_table([tmp_path]).notes
    assert note.startswith("gaps has no pose in 6 of 30 frames of ")
    assert note in compared_table([tmp_path]).paper(".tex", ["ate_m"])
    read = ekfslam.read_archive(tmp_path / "archive.h5")
    assert not read.results["gaps"].has_covariance and read.results["mine"].has_covariance
    np.testing.assert_array_equal(estimated(read.results["gaps"], read.truth).frame[:3], [2, 3, 4])
    assert {"map", "errors", "side"} <= draw_figures(read.results, read.truth, read.interpolated).keys()
    read.results["gaps"].export(tmp_path / "again.txt", "tum")
    assert not (tmp_path / "again.cov.txt").exists()


def test_the_height_of_a_trajectory_that_begins_late_begins_at_the_true_distance(world, full, files):
    gaps = Others({"gaps": files / "gaps.tum"}, world="given").results(world, full)["gaps"]
    late, true = height_of(gaps, world.truth, has_band=True), height(world.truth.T_world_imu)
    assert len(late.x) == FRAMES - 2 and late.x[0] == pytest.approx(true.x[2])
    assert len(height_of(full, world.truth, has_band=True).x) == FRAMES


def test_the_report_page_takes_a_trajectory_by_name(world, full, files, tmp_path):
    ekfslam.write_archive(tmp_path / "run.h5", world, {"full": full})
    given = ["--with", f"orb={files / 'mine.txt'}", "--out", str(tmp_path / "page.html")]
    assert main(["report", str(tmp_path / "run.h5"), *given]) == 0
    page = (tmp_path / "page.html").read_text()
    assert "<h3>orb</h3>" in page and "30 of 30 poses belong to frames" in page


@pytest.mark.parametrize(
    ("name", "text", "error", "words"),
    [
        ("full", "", ConfigError, "cannot have the name 'full'"),
        ("mine", "missing", UnknownFormatError, "no such file"),
        ("mine", "1 2 3\n", UnknownFormatError, "no poses of a known format"),
        (
            "mine",
            "".join(f"{9e5 + k} 0 0 0 0 0 0 1\n" for k in range(30)),
            TruthError,
            "0 of 30 poses belong to frames",
        ),
    ],
)
def test_a_trajectory_that_cannot_be_compared_is_named(world, tmp_path, name, text, error, words):
    if text != "missing":
        (tmp_path / "t.txt").write_text(text)
    with pytest.raises(error, match=words):
        Others({name: tmp_path / "t.txt"}).results(world)


def test_a_covariance_that_is_none_is_named_by_file_and_line(world, full, tmp_path):
    export(full, tmp_path / "mine.tum", "tum")
    lines = (tmp_path / "mine.tum.cov.txt").read_text().splitlines()
    words = lines[5].split()
    lines[5] = " ".join([words[0], f"-{words[1]}", *words[2:]])
    (tmp_path / "mine.tum.cov.txt").unlink()
    (tmp_path / "mine.cov.txt").write_text("\n".join(lines))
    with pytest.raises(ShapeError, match=r"mine\.cov\.txt: line\[6\].*not positive semi-definite"):
        Others({"mine": tmp_path / "mine.tum"}).results(world)


def test_the_csv_of_euroc_is_read_and_covariances_of_another_file_are_not_taken_for_its_own(tmp_path):
    room = ekfslam.open_sequence("builtin:room?frames=20")
    ours = ekfslam.run(room)
    for name, format in (("room.txt", "tum"), ("room.csv", "euroc")):
        export(ours, tmp_path / name, format)
    found = figures(room, ours, {"csv": tmp_path / "room.csv"}, world="given")
    assert found["csv"]["ate_m"] == pytest.approx(found["ours"]["ate_m"], rel=1e-4)
    assert found["csv"]["pose_nees_mean"] is None


def test_one_trajectory_is_not_compared_with_two_recordings(capsys, files):
    assert main(["compare", "builtin:city?frames=9", "builtin:loop?frames=9", "--with", str(files / "mine.txt")]) == 2
    assert "write {name} for them" in capsys.readouterr().err
    assert Others.parse(["orb_{name}.txt"]).named("loop").files == {"orb": "orb_loop.txt"}
