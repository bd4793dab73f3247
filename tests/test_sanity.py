"""What looks wrong is named: every mistake by itself, on worlds and recordings, and nothing where nothing is wrong."""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Callable

import numpy as np
import pytest

from ekfslam import attach_truth, open_sequence
from ekfslam.cli import main
from ekfslam.data.readers import write_sequence
from ekfslam.data.sequence import Sequence
from ekfslam.data.simulate import builtin
from ekfslam.errors import NonFiniteError
from ekfslam.evaluation.sanity import inspect_result, inspect_sequence
from ekfslam.geometry import se3
from ekfslam.geometry.camera import R_CAM_BODY
from ekfslam.reports import compare
from ekfslam.runner import run
from ekfslam.storage.archive import read_archive, write_archive

NPZ = [f"ece276a/{name}.npz" for name in ("0020", "0022_dense_noisy", "0027", "0027_dense_noisy", "0042")]
MAT = [f"utias/2011_09_{name}_sync_KLT.mat" for name in ("26_drive_0001", "26_drive_0009", "26_drive_0027")]
MAT += [f"utias/2011_09_{name}_sync_KLT.mat" for name in ("26_drive_0036", "30_drive_0020", "30_drive_0027")]
MAT += ["utias/2011_10_03_drive_0042_sync_KLT.mat", "utias/dataset3.mat"]
WORLDS = ["builtin:city?frames=200", "builtin:loop?frames=200"]


def changed(**fields: Callable[[Sequence], object]) -> Callable[[Sequence], Sequence]:
    return lambda world: dataclasses.replace(world, **{name: change(world) for name, change in fields.items()})


def swapped(world: Sequence) -> object:
    return dataclasses.replace(world.observations, pixels_px=world.observations.pixels_px[:, [2, 3, 0, 1]])


def times(*factors: float) -> Callable[[Sequence], Sequence]:
    return changed(twist=lambda world: world.twist * np.array(factors))


def since_start(unit: float) -> Callable[[Sequence], Sequence]:
    return changed(time_s=lambda world: unit * (world.time_s - world.time_s[0]), twist=lambda world: world.twist)


BODY_CAM = se3.transform(R_CAM_BODY.T, np.zeros(3))
DEG = 180.0 / np.pi
MISTAKES = {
    "T_cam_imu looks inverted": changed(T_cam_imu=lambda world: se3.inverse(world.T_cam_imu)),
    r"optical axes \(right, down, forward\) are forgotten": changed(T_cam_imu=lambda world: BODY_CAM @ world.T_cam_imu),
    "look like deg/s": times(1, 1, 1, DEG, DEG, DEG),
    "stamps look like milliseconds": since_start(1e3),
    "stamps look like nanoseconds": since_start(1e9),
    "images look swapped": changed(observations=swapped),
    "linear velocities look as if they had the wrong sign": times(-1, -1, -1, 1, 1, 1),
    "angular velocities look as if they had the wrong sign": times(1, 1, 1, -1, -1, -1),
}


opened = functools.cache(open_sequence)


def named(data: str, mistake: str, data_path: Callable[[str], str]) -> tuple[str, ...]:
    world = opened(data if data.startswith("builtin:") else data_path(data))
    assert inspect_sequence(world).warnings == ()
    return inspect_sequence(MISTAKES[mistake](world)).warnings


@pytest.mark.parametrize("data", WORLDS)
@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named_in_one_line(data, mistake):
    (line,) = named(data, mistake, str)
    assert re.match(f".*{mistake}", line) and "\n" not in line


@pytest.mark.data
@pytest.mark.parametrize("data", ["ece276a/0027.npz", MAT[0], "utias/dataset3.mat"])
@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named_on_recordings(data, mistake, data_path):
    (line,) = named(data, mistake, data_path)
    assert re.match(f".*{mistake}", line)


@pytest.mark.data
@pytest.mark.parametrize("data", NPZ + MAT)
def test_no_false_alarm_on_recordings(data, data_path):
    found = inspect_sequence(opened(data_path(data)))
    assert found.warnings == () and len(found.figures) == 5


@pytest.mark.parametrize("data", ["builtin:city", "builtin:loop"])
def test_no_false_alarm_on_worlds(data):
    assert inspect_sequence(open_sequence(data)).warnings == ()


@pytest.mark.parametrize("noise", ["", "&sigma_px=0.01", "&sigma_v_m_s=2&sigma_w_rad_s=0.3"])
@pytest.mark.parametrize("name", ["city", "loop"])
def test_noise_and_few_frames_are_no_mistakes(name, noise):
    for frames in (3, 20, 40):
        for seed in range(3):
            assert inspect_sequence(builtin(f"{name}?frames={frames}&seed={seed}{noise}")).warnings == ()


@pytest.mark.data
@pytest.mark.parametrize(
    ("data", "right"), [("0020", "06"), ("0027", "07"), ("0027_dense_noisy", "07"), ("0042", "01")]
)
def test_the_truth_of_another_recording_is_named(data, right, data_path):
    sequence = opened(data_path(f"ece276a/{data}.npz"))
    for other in ("01", "06", "07"):
        given = attach_truth(sequence, data_path(f"kitti_odometry_poses/{other}.txt"))
        warnings = inspect_sequence(given).warnings
        assert len(warnings) == (other != right)
        assert not warnings or warnings[0].startswith("the truth looks like that of another recording")


def test_the_truth_of_another_world_is_named():
    world, other = builtin("city?frames=200"), builtin("city?frames=200&seed=7")
    (line,) = inspect_sequence(dataclasses.replace(world, truth=other.truth)).warnings
    assert line.startswith("the truth looks like that of another recording")
    turned = dataclasses.replace(world.truth, T_world_imu=world.truth.T_world_imu @ BODY_CAM)
    (line,) = inspect_sequence(dataclasses.replace(world, truth=turned)).warnings
    assert line.startswith("the truth looks like poses of another body")


def test_stamps_since_1970_in_other_units_are_named():
    world = builtin("loop?frames=20")
    for unit, name in ((1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")):
        with pytest.raises(NonFiniteError, match=name):
            dataclasses.replace(world, time_s=unit * (1.3e9 + world.time_s), twist=world.twist)


def test_without_velocities_only_tracks_are_looked_at():
    world = builtin("loop?frames=50")
    still = dataclasses.replace(world, twist=np.zeros((50, 6)), attributes={"velocities": "none"})
    found = inspect_sequence(still)
    assert found.warnings == () and not any("speed" in line for line in found.figures)
    assert inspect_sequence(world[:1]).warnings == ()


@pytest.fixture(scope="module")
def inverted() -> Sequence:
    return MISTAKES["T_cam_imu looks inverted"](builtin("loop?frames=60"))


@pytest.mark.slow
def test_lines_are_kept_in_the_archive_and_said(tmp_path, inverted, capsys):
    result = run(inverted)
    before, after = result.remarks
    assert before.startswith("T_cam_imu looks inverted")
    assert after.endswith(f"of the velocities were rejected: {before}") and int(after[:2]) > 40
    write_archive(tmp_path / "a.h5", inverted, {"full": result})
    assert read_archive(tmp_path / "a.h5").results["full"].remarks == result.remarks
    assert main(["info", str(tmp_path / "a.h5")]) == 0
    assert f"full: note: {before}" in capsys.readouterr().out


def test_info_and_run_say_it_first(tmp_path, inverted, capsys):
    write_sequence(inverted, tmp_path / "a.h5")
    assert main(["info", str(tmp_path / "a.h5")]) == 0
    out = capsys.readouterr().out
    assert "warning       T_cam_imu looks inverted" in out and "sanity        tracks move by" in out
    call = ["run", str(tmp_path / "a.h5"), "--mode", "dead-reckoning", "--out", str(tmp_path / "out.h5")]
    assert main(call) == 0
    assert capsys.readouterr().out.startswith("loop: warning: T_cam_imu looks inverted")


def test_a_comparison_says_a_line_once(inverted):
    table = compare(inverted, ["dead-reckoning", "mapping-only"]).table
    assert table.count("Note on dead-reckoning, mapping-only: T_cam_imu looks inverted") == 1


def test_a_right_run_says_nothing():
    assert run(builtin("loop?frames=60")).remarks == ()


def test_a_truth_that_only_a_run_can_judge_is_named():
    """Without velocities the truth is compared with what vision finds."""
    world, other = builtin("loop?frames=60"), builtin("city?frames=60")
    result = run(world)
    wrong = dataclasses.replace(world, truth=other.truth)
    (line,) = inspect_result(wrong, result, ())
    assert line.startswith("the truth looks like that of another recording: the estimate fits the tracks")
    assert inspect_result(world, result, ()) == ()


@pytest.mark.slow
def test_drift_of_dead_reckoning_is_no_mistake():
    """Mapping-only rejects most of what it sees where dead reckoning has drifted."""
    result = run(open_sequence("builtin:city?frames=300"), "mapping-only")
    assert result.innovation.rejected.sum() > 0.4 * result.innovation.accepted.sum()
    assert not any("rejected" in remark for remark in result.remarks)
