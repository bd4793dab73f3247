"""Recordings put together: from plain arrays, cropped, and with velocities from elsewhere."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import ekfslam
from ekfslam import Observations, Sequence, StereoCamera, Truth, attach_velocities, open_sequence
from ekfslam.cli import main
from ekfslam.data.images import ImageRecording, PairCalibration
from ekfslam.data.readers import write_sequence
from ekfslam.data.sequence import stretch
from ekfslam.data.simulate import builtin
from ekfslam.errors import (
    ConfigError,
    DuplicateObservationError,
    EkfslamError,
    EmptyTracksError,
    ExtrinsicsError,
    LineError,
    LostDataError,
    NonFiniteError,
    ShapeError,
    StampError,
    TruthError,
    UnknownFormatError,
)
from ekfslam.geometry import se3
from ekfslam.storage.archive import read_archive

FRAMES, TRACKS = 6, 5
CAMERA = StereoCamera(fu_px=700.0, fv_px=700.0, cu_px=600.0, cv_px=180.0, baseline_m=0.5)
STAMPS = 0.1 * np.arange(FRAMES)


def dense() -> np.ndarray:
    rng = np.random.default_rng(3)
    left = rng.uniform([100, 50], [1000, 300], (FRAMES, TRACKS, 2))
    pixels = np.concatenate([left, left - [20.0, 0.0]], axis=-1)
    pixels[2, 1] = pixels[:, 4] = np.nan
    return pixels


def test_from_dense_tracks():
    built = Sequence.from_tracks(STAMPS, dense(), CAMERA)
    assert len(built.observations) == FRAMES * 4 - 1
    assert built.notes == ("1 of 5 tracks are never seen and are left out.",)
    ids, pixels = built.observations.at(2)
    np.testing.assert_array_equal(ids, [0, 2, 3])
    np.testing.assert_array_equal(pixels, dense()[2, [0, 2, 3]])
    assert not built.twist.any() and built.attributes["velocities"] == "none"


def test_from_flat_tracks_is_the_recording_itself():
    world = builtin("loop?frames=20")
    o, truth = world.observations, np.full((20, 4, 4), np.nan)
    truth[1:] = world.truth.T_world_imu[1:]
    built = Sequence.from_tracks(
        world.time_s,
        o.pixels_px,
        world.camera,
        frame=o.frame,
        landmark=o.landmark,
        twist=world.twist,
        T_cam_imu=world.T_cam_imu,
        T_world_imu=truth,
        noise=world.noise,
        name="mine",
    )
    for name in ("time_s", "twist", "T_cam_imu"):
        np.testing.assert_array_equal(getattr(built, name), getattr(world, name))
    np.testing.assert_array_equal(built.observations.pixels_px, o.pixels_px)
    np.testing.assert_array_equal(built.truth.frame, np.arange(1, 20))
    assert built.name == "mine" and built.attributes == {}


@pytest.mark.parametrize(
    ("changes", "error", "field"),
    [
        ({"time_s": STAMPS[::-1]}, StampError, "time_s"),
        ({"time_s": "now"}, ShapeError, "time_s"),
        ({"time_s": []}, ShapeError, "time_s"),
        ({"pixels_px": dense()[:-1]}, ShapeError, "pixels_px"),
        ({"pixels_px": np.full((FRAMES, 2, 4), np.nan)}, EmptyTracksError, "pixels_px"),
        ({"pixels_px": [["a"]]}, ShapeError, "pixels_px"),
        ({"twist": np.zeros((FRAMES, 6))}, ExtrinsicsError, "T_cam_imu"),
        ({"twist": np.zeros((FRAMES, 3)), "T_cam_imu": np.eye(4)}, ShapeError, "twist"),
        ({"twist": np.full((FRAMES, 6), np.nan), "T_cam_imu": np.eye(4)}, NonFiniteError, "twist"),
        ({"T_cam_imu": 2 * np.eye(4)}, ExtrinsicsError, "T_cam_imu"),
        ({"T_world_imu": np.tile(np.eye(4), (3, 1, 1))}, ShapeError, "T_world_imu"),
        ({"T_world_imu": np.tile(2 * np.eye(4), (FRAMES, 1, 1))}, TruthError, "truth.T_world_imu"),
        ({"frame": [0]}, ShapeError, "landmark"),
        ({"pixels_px": dense()[0, :2], "frame": [0], "landmark": [1, 2]}, ShapeError, "frame"),
        ({"pixels_px": dense()[0, :2], "frame": [0, 0.5], "landmark": [1, 2]}, ShapeError, "frame"),
        ({"pixels_px": dense()[0, :2], "frame": [0, FRAMES], "landmark": [1, 2]}, ShapeError, "observations.frame"),
        ({"pixels_px": dense()[0, :2], "frame": [0, 0], "landmark": [1, 1]}, DuplicateObservationError, "observations"),
    ],
)
def test_arrays_that_do_not_fit_are_named(changes, error, field):
    given = {"time_s": STAMPS, "pixels_px": dense(), "camera": CAMERA, **changes}
    with pytest.raises(error) as caught:
        Sequence.from_tracks(**given)
    assert caught.value.field == field


def test_built_of_public_names_alone():
    world = builtin("loop?frames=30")
    built = ekfslam.Sequence(
        name="mine",
        source="arrays",
        time_s=world.time_s,
        twist=world.twist,
        camera=ekfslam.StereoCamera(**vars(world.camera)),
        T_cam_imu=world.T_cam_imu,
        observations=Observations(
            **{name: getattr(world.observations, name) for name in ("frame", "landmark", "pixels_px")}
        ),
        truth=Truth(world.truth.frame, world.truth.T_world_imu),
        noise=ekfslam.Noise.isotropic(0.5, 0.05, 1.0),
    )
    np.testing.assert_array_equal(ekfslam.run(built).T_world_imu, ekfslam.run(world).T_world_imu)


def test_frames_on_the_command_line(tmp_path, capsys):
    out = tmp_path / "a.h5"
    assert main(["run", "builtin:loop", "--frames", "10:40", "--mode", "dead-reckoning", "--out", str(out)]) == 0
    archive = read_archive(out)
    assert len(archive.time_s) == 30 and archive.attributes["first_frame"] == 10
    capsys.readouterr()
    assert main(["info", "builtin:loop", "--frames", "40:10"]) == 2
    assert "no frames 40:10" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["info", "builtin:loop", "--frames", "10"])
    assert (stretch(":5"), stretch("-5:"), stretch("2:8")) == (slice(None, 5), slice(-5, None), slice(2, 8))


# Velocities


def velocities_text(world: Sequence, separator: str, head: str = "") -> str:
    rows = np.column_stack([world.time_s, world.twist])
    return head + "".join(separator.join(f"{x:.17g}" for x in row) + "\n" for row in rows)


@pytest.fixture(scope="module")
def world() -> Sequence:
    return builtin("loop?frames=30")


@pytest.fixture
def still(world) -> Sequence:
    return dataclasses.replace(world, twist=np.zeros_like(world.twist), attributes={"velocities": "none"})


@pytest.mark.parametrize(
    ("separator", "head"),
    [
        (" ", ""),
        (",", "time,vx,vy,vz,wx,wy,wz\n"),
        (", ", "# frame: imu\n# time, vx, vy, vz, wx, wy, wz\n"),
        ("\t", "# TUM-like\n"),
    ],
)
def test_velocities_of_text(tmp_path, world, still, separator, head):
    path = tmp_path / "velocities.txt"
    path.write_text(velocities_text(world, separator, head))
    found = attach_velocities(still, path)
    np.testing.assert_array_equal(found.twist, world.twist)
    assert found.velocity_frame == "imu" and "velocities" not in found.attributes
    assert any("does not say in which frame" in note for note in found.notes) == ("frame" not in head)
    np.testing.assert_array_equal(found.T_cam_imu, world.T_cam_imu)


def test_the_frame_of_velocities_is_stated(tmp_path, world, still):
    path = tmp_path / "velocities.csv"
    path.write_text(velocities_text(world, ",", "# frame: level\n"))
    assert attach_velocities(still, path).velocity_frame == "level"
    assert attach_velocities(still, path, velocity_frame="imu").velocity_frame == "imu"
    path.write_text(velocities_text(world, ",", "# frame: camera\n"))
    with pytest.raises(ConfigError, match="imu or level, found 'camera'"):
        attach_velocities(still, path)
    with pytest.raises(ConfigError, match="imu or level"):
        attach_velocities(still, path, velocity_frame="world")


def smooth_samples(path: Path, step_s: float, begin_s: float = -0.5, end_s: float = 4.0) -> None:
    """Samples of a velocity that changes linearly, 3 + 2 t in vx and t in wz."""
    t = np.arange(begin_s, end_s, step_s)
    rows = np.zeros((len(t), 7))
    rows[:, 0], rows[:, 1], rows[:, 6] = t, 3 + 2 * t, t
    np.savetxt(path, rows, header="frame: imu")


def test_velocities_between_samples_are_linear(tmp_path, still):
    path = tmp_path / "velocities.txt"
    smooth_samples(path, 0.13)
    found = attach_velocities(still, path)
    np.testing.assert_allclose(found.twist[:, 0], 3 + 2 * still.time_s, atol=1e-9)
    np.testing.assert_allclose(found.twist[:, 5], still.time_s, atol=1e-9)


@pytest.mark.parametrize(("step_s", "is_dense"), [(0.007, True), (0.05, True), (0.06, False)])
def test_two_samples_an_interval_become_means_over_it(tmp_path, still, step_s, is_dense):
    path = tmp_path / "velocities.txt"
    smooth_samples(path, step_s, begin_s=-0.513)
    found = attach_velocities(still, path)
    middle = 0.5 * (still.time_s[1:] + still.time_s[:-1])
    np.testing.assert_allclose(found.twist[1:, 0], 3 + 2 * (middle if is_dense else still.time_s[1:]), atol=1e-9)


def test_samples_across_a_gap_of_less_than_a_second_are_linear(tmp_path, world, still):
    path = tmp_path / "velocities.txt"
    lines = velocities_text(world, " ").splitlines(keepends=True)
    assert 0.8 < world.time_s[13] - world.time_s[4] < 1.0
    path.write_text("".join([*lines[:5], *lines[13:]]))
    found = attach_velocities(still, path)
    share = (world.time_s[8] - world.time_s[4]) / (world.time_s[13] - world.time_s[4])
    np.testing.assert_allclose(found.twist[8], world.twist[4] + share * (world.twist[13] - world.twist[4]), atol=1e-9)


def test_velocities_of_another_recording_bring_its_extrinsics(tmp_path, world):
    path = tmp_path / "other.h5"
    write_sequence(world, path)
    turned = se3.exp(np.array([0.3, 0.1, -0.2, 0.1, 0.2, 0.3]))  # another body on the same camera
    mine = dataclasses.replace(
        world,
        twist=np.zeros_like(world.twist),
        T_cam_imu=world.T_cam_imu @ turned,
        truth=Truth(world.truth.frame, world.truth.T_world_imu @ turned),
        notes=("There are no velocities: the body is the left camera.",),
    )
    found = attach_velocities(mine, path)
    np.testing.assert_array_equal(found.twist, world.twist)
    np.testing.assert_allclose(found.T_cam_imu, world.T_cam_imu, atol=1e-12)
    np.testing.assert_allclose(found.truth.T_world_imu, world.truth.T_world_imu, atol=1e-12)
    assert not any(note.startswith("There are no velocities") for note in found.notes)


def test_velocities_of_a_recording_on_another_clock(tmp_path, world, still):
    path = tmp_path / "other.h5"
    write_sequence(dataclasses.replace(world, time_s=world.time_s + 1.3e9, twist=world.twist), path)
    found = attach_velocities(still, path)
    np.testing.assert_allclose(found.twist, world.twist, atol=1e-5)
    assert any("another clock" in note for note in found.notes)
    late = dataclasses.replace(still, time_s=still.time_s + 500.0)
    with pytest.raises(LostDataError, match="no time in common"):
        attach_velocities(late, path)


def test_gaps_of_another_recording_stay_known(tmp_path, world, still):
    marked = dataclasses.replace(world, attributes={"interpolated": "3-7"})
    write_sequence(marked, tmp_path / "other.h5")
    found = attach_velocities(still, tmp_path / "other.h5")
    np.testing.assert_array_equal(np.flatnonzero(found.interpolated), [3, 4, 5, 6, 7])


def test_velocities_of_images(tmp_path, world):
    calibration = PairCalibration(
        np.diag([700.0, 700.0, 1.0]), np.diag([700.0, 700.0, 1.0]), (20, 10), se3.transform(np.eye(3), [-0.5, 0, 0])
    )
    images = ImageRecording(
        "a", "tests", world.time_s, calibration, lambda k: (np.zeros((10, 20), np.uint8),) * 2, world.T_cam_imu
    )
    path = tmp_path / "velocities.txt"
    path.write_text(velocities_text(world, " "))
    np.testing.assert_array_equal(attach_velocities(images, path).twist, world.twist)


def gap(text: str) -> str:
    lines = text.splitlines(keepends=True)
    return "".join([*lines[:5], *lines[25:]])


@pytest.mark.parametrize(
    ("alter", "error", "words"),
    [
        (lambda text: "", UnknownFormatError, "no velocities"),
        (lambda text: "time,vx,vy,vz,wx,wy,wz\n", UnknownFormatError, "holds no velocities"),
        (lambda text: text.replace(" ", " x", 1), LineError, "line[1]"),
        (lambda text: text + "1 2 3\n", LineError, "3 columns, expected 7"),
        (lambda text: text + "1e9 nan 0 0 0 0 0\n", NonFiniteError, "line[31]"),
        (lambda text: text + text.split()[-7] + " 9" * 6, StampError, "line[31]"),
        (lambda text: "".join(text.splitlines(keepends=True)[:10]), LostDataError, "outside of the samples"),
        (lambda text: text.splitlines()[0] + "\n", LostDataError, "two are needed"),
        (gap, LostDataError, "a gap of"),
        (lambda text: "1 2 3 4\n", UnknownFormatError, "no velocities"),
    ],
)
def test_broken_velocities_are_named(tmp_path, world, still, alter, error, words):
    path = tmp_path / "velocities.txt"
    path.write_text(alter(velocities_text(world, " ")))
    with pytest.raises(error) as caught:
        attach_velocities(still, path)
    assert str(path) in str(caught.value) and words in str(caught.value)


def test_recordings_without_velocities_give_none(tmp_path, still):
    write_sequence(still, tmp_path / "other.h5")
    with pytest.raises(UnknownFormatError, match="has no velocities"):
        attach_velocities(still, tmp_path / "other.h5")
    with pytest.raises(EkfslamError, match=r"none\.txt"):
        attach_velocities(still, tmp_path / "none.txt")


@pytest.mark.slow
def test_velocities_on_the_command_line(tmp_path, world, still, capsys):
    recording, path, out = tmp_path / "a.h5", tmp_path / "velocities.csv", tmp_path / "run.h5"
    write_sequence(still, recording)
    path.write_text(velocities_text(world, ","))
    call = ["run", str(recording), "--velocities", str(path), "--mode", "dead-reckoning", "--out", str(out)]
    assert main([*call, "--velocity-frame", "level"]) == 0
    found = read_archive(out)
    np.testing.assert_array_equal(found.twist, world.twist)
    assert found.velocity_frame == "level"
    capsys.readouterr()
    assert main(["info", str(recording), "--velocity-frame", "imu"]) == 2
    assert "--velocities" in capsys.readouterr().err
    assert open_sequence(recording).attributes["velocities"] == "none"
