"""KITTI raw drives: a folder written from a known trajectory is read back, and every way it can be broken is named."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.kitti_raw import (
    EARTH_M,
    FRAMES,
    NAME,
    OFFSETS_M,
    R_CAM_VELO,
    R_RECT,
    R_VELO_IMU,
    T_CAM_VELO_M,
    T_VELO_IMU_M,
    K,
    numbers,
    packets,
    trajectory,
    write_drive,
)
from support.recordings import ece276a_fields, stamps, write_npz

from ekfslam import open_kitti_raw, open_sequence
from ekfslam.cli import main
from ekfslam.data.readers import read_sequence, write_sequence
from ekfslam.data.readers.oxts import PACKET_FIELDS
from ekfslam.data.sequence import Observations
from ekfslam.errors import (
    CalibrationError,
    ConfigError,
    DataError,
    DuplicateObservationError,
    EkfslamError,
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
from ekfslam.geometry.camera import project
from ekfslam.runner import run


@pytest.fixture
def drive(tmp_path) -> Path:
    return write_drive(tmp_path)


# What the reader makes of a drive


# From the first packet of 2011_09_26_drive_0001: yaw counts from east, leftward to the north.
PUBLISHED = {
    "yaw": -1.2219096732051,
    "vn": -3.3256321640686,
    "ve": 1.1384311814592,
    "vf": 3.5147680214713,
    "vl": 0.037625160413037,
}


def test_the_published_packet_goes_to_the_right_as_its_north_and_east_velocities_say(drive):
    packet = packets()[0]
    for name, value in {**PUBLISHED, "roll": 0.0, "pitch": 0.0}.items():
        packet[PACKET_FIELDS.index(name)] = value
    (drive / "oxts/data/0000000000.txt").write_text(" ".join(repr(float(x)) for x in packet) + "\n")
    sine, cosine = np.sin(PUBLISHED["yaw"]), np.cos(PUBLISHED["yaw"])
    forward = cosine * PUBLISHED["ve"] + sine * PUBLISHED["vn"]
    left = -sine * PUBLISHED["ve"] + cosine * PUBLISHED["vn"]
    corrected, stored = (open_sequence(drive, lateral=how).twist[0] for how in ("corrected", "as-stored"))
    assert corrected[0] == pytest.approx(forward, abs=1e-3)
    assert left == pytest.approx(-0.067, abs=5e-4)
    assert abs(corrected[1] - left) < 0.04 < 0.1 < abs(stored[1] - left)
    np.testing.assert_array_equal(corrected, stored * [1, -1, 1, 1, 1, 1])


def test_dead_reckoning_on_the_read_velocities_reproduces_the_read_truth(drive):
    sequence = open_sequence(drive)
    stamp_ns, twist, T = trajectory()
    np.testing.assert_allclose(sequence.time_s, stamp_ns / 1e9, rtol=0, atol=3e-7)
    np.testing.assert_allclose(sequence.twist, twist, atol=1e-12)
    np.testing.assert_array_equal(sequence.truth.frame, np.arange(FRAMES))
    np.testing.assert_allclose(sequence.truth.T_world_imu, se3.inverse(T[0]) @ T, atol=1e-8)
    # Stamps in seconds since 1970 are exact to 2e-7 s, that is 2 um of a vehicle at 10 m/s in each step.
    result = run(sequence, "dead-reckoning")
    np.testing.assert_allclose(result.T_world_imu, sequence.truth.T_world_imu, atol=5e-5)
    assert (sequence.name, sequence.source) == (NAME, str(drive))


def hand_made(drive: Path, k: int, **values: float) -> None:
    path = drive / f"oxts/data/{k:010d}.txt"
    fields = dict.fromkeys(PACKET_FIELDS, 0.0) | {"lat": 49.0, "lon": 8.4} | values
    path.write_text(" ".join(map(repr, fields.values())))


def test_level_velocities_are_turned_by_roll_and_pitch_with_the_signs_of_the_format(drive):
    # Positive pitch is front down, so a vehicle that moves level moves towards its own up axis.
    hand_made(drive, 1, pitch=0.1, vf=10.0, wu=1.0)
    # Positive roll is left side up, so what rises moves towards its own left.
    hand_made(drive, 2, roll=0.1, vu=2.0, wf=0.3)
    hand_made(drive, 3, yaw=1.0, vf=10.0, vl=-1.0)  # stored to the right
    twist = open_sequence(drive).twist
    s, c = np.sin(0.1), np.cos(0.1)
    np.testing.assert_allclose(twist[1], [10 * c, 0, 10 * s, -s, 0, c], atol=1e-12)
    np.testing.assert_allclose(twist[2], [0, 2 * s, 2 * c, 0.3, 0, 0], atol=1e-12)
    np.testing.assert_allclose(twist[3], [10, 1, 0, 0, 0, 0], atol=1e-12)


def test_a_line_that_the_unit_drew_across_a_gap_is_named_although_roll_and_pitch_turn_it(drive):
    whole = packets()
    share = np.linspace(0, 1, 13)[:, None]
    whole[20:33] = (1 - share) * whole[20] + share * whole[32]
    for k in range(20, 33):
        (drive / f"oxts/data/{k:010d}.txt").write_text(" ".join(repr(float(x)) for x in whole[k]) + "\n")
    sequence = open_sequence(drive)
    assert sequence.attributes["interpolated"] == "21-32"
    np.testing.assert_array_equal(np.flatnonzero(sequence.interpolated), np.arange(21, 33))
    assert sum("intervals 21 to 32 are interpolated" in note for note in sequence.notes) == 1


def test_position_is_metric_east_north_up_and_yaw_counts_from_east(drive):
    hand_made(drive, 0, yaw=np.pi / 2, alt=100.0)
    hand_made(drive, 1, yaw=np.pi / 2, alt=101.0, lat=49.0 + 1e-5, lon=8.4 + 2e-5)
    hand_made(drive, 2, yaw=np.pi, alt=100.0)
    T = open_sequence(drive).truth.T_world_imu
    np.testing.assert_array_equal(T[0], np.eye(4))
    # Facing north at first: forward is north, left is west.
    degree_m = EARTH_M * np.pi / 180
    north_m, east_m = 1e-5 * degree_m, 2e-5 * degree_m * np.cos(np.radians(49.0))
    np.testing.assert_allclose(T[1, :3, 3], [north_m, -east_m, 1.0], atol=1e-6)
    np.testing.assert_allclose(T[2, :3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)


@pytest.mark.parametrize(("pair", "left", "right"), [("gray", "00", "01"), ("color", "02", "03")])
def test_calibration_projects_as_the_files_say(drive, pair, left, right):
    raw = open_kitti_raw(drive, pair)
    p_imu = np.array([[12.0, 1, -0.5], [30, -6, 2]])
    p_velo = p_imu @ R_VELO_IMU.T + T_VELO_IMU_M
    p_rect = (p_velo @ R_CAM_VELO.T + T_CAM_VELO_M) @ R_RECT.T
    pixels = []
    for number in (left, right):
        x = np.column_stack([p_rect, np.ones(2)]) @ np.column_stack([K, K @ OFFSETS_M[number]]).T
        pixels.append(x[:, :2] / x[:, 2:])
    # The color pair is off rectification by 2 mm in y, up to 0.15 px at 9 m in the right image.
    z = project(raw.camera, se3.apply(raw.T_cam_imu, p_imu))
    np.testing.assert_allclose(z[:, :2], pixels[0], atol=1e-4)
    np.testing.assert_allclose(z[:, 2:], pixels[1], atol=1e-4 if pair == "gray" else 0.15)
    assert raw.camera.baseline_m == pytest.approx(0.54 if pair == "gray" else 0.53, abs=1e-8)
    assert raw.attributes["stereo_pair"] == pair
    with pytest.raises(ConfigError, match="gray, color"):
        open_kitti_raw(drive, "infrared")


def test_calibration_in_the_drive_folder_goes_before_the_one_above(drive):
    above = drive.parent / "calib_cam_to_cam.txt"
    (drive / above.name).write_text(above.read_text().replace("P_rect_01: 7.18", "P_rect_01: 7.19"))
    with pytest.raises(CalibrationError, match=re.escape(str(drive / above.name))):
        open_sequence(drive)


def test_drive_takes_tracks_from_elsewhere_or_none(drive, tmp_path):
    raw = open_kitti_raw(str(drive))
    without = raw.sequence()
    assert (len(without.observations), without.attributes["tracks"]) == (0, "none")
    assert without.notes[-1] == "KITTI raw has no tracks; they must come from elsewhere."
    write_sequence(without, tmp_path / "own.h5")
    assert len(read_sequence(tmp_path / "own.h5").observations) == 0

    pixels = np.array([[700.0, 200, 680, 200], [701, 201, 681, 201]])
    tracked = raw.sequence(Observations([0, 1], [5, 5], pixels))
    assert "tracks" not in tracked.attributes
    assert any("1 tracks, 2 observations" in note for note in tracked.notes)
    with pytest.raises(ShapeError, match=f"frame {FRAMES} does not exist"):
        raw.sequence(Observations([0, FRAMES], [5, 5], pixels))
    twice = Observations([1, 1], [5, 5], pixels)
    with pytest.raises(DuplicateObservationError):
        raw.sequence(twice)
    with pytest.raises(DuplicateObservationError):
        dataclasses.replace(without, observations=twice)


def test_command_line_opens_a_drive(drive, tmp_path, capsys):
    assert main(["info", str(drive)]) == 0
    assert "KITTI raw has no tracks" in capsys.readouterr().out
    assert main(["run", str(drive), "--mode", "dead-reckoning", "--out", str(tmp_path / "o.h5")]) == 0


def test_drive_is_known_by_its_oxts_whatever_its_name(drive):
    renamed = drive.rename(drive.with_name("drive"))
    assert len(open_sequence(renamed)) == FRAMES
    with pytest.raises(ConfigError, match="extrinsics"):
        open_sequence(renamed, extrinsics="as-stored")


def test_checksum_changes_with_any_file(drive):
    before = open_sequence(drive).attributes["checksum_sha256"]
    path = drive.parent / "calib_velo_to_cam.txt"
    path.write_text(path.read_text() + "\n")
    assert open_sequence(drive).attributes["checksum_sha256"] != before


# What is repaired, with a note


def rewrite(path: Path, change: Callable[[list[str]], None]) -> None:
    lines = path.read_text().splitlines()
    change(lines)
    path.write_text("\n".join(lines) + "\n")


def test_empty_lines_of_the_stamps_are_interpolated_with_a_note(drive):
    def lose(lines):
        lines[10] = lines[11] = lines[20] = ""

    rewrite(drive / "oxts/timestamps.txt", lose)
    sequence, whole = open_sequence(drive), trajectory()[0] / 1e9
    step_s = (whole[12] - whole[9]) / 3
    np.testing.assert_allclose(sequence.time_s[10:12], whole[9] + step_s * np.array([1, 2]), atol=1e-6)
    assert sequence.time_s[20] == pytest.approx((whole[19] + whole[21]) / 2, abs=1e-6)
    kept = np.delete(np.arange(FRAMES), [10, 11, 20])
    np.testing.assert_allclose(sequence.time_s[kept], whole[kept], atol=3e-7)
    assert "oxts/timestamps.txt: 3 of 70 lines are empty, the first is line 11; their stamps are interpolated." in (
        sequence.notes
    )
    np.testing.assert_array_equal(sequence.truth.frame, np.arange(FRAMES))


def test_packets_lost_with_their_stamps_leave_frames_without_truth(drive):
    def lose(lines):
        lines[10] = " "

    rewrite(drive / "oxts/timestamps.txt", lose)
    (drive / "oxts/data/0000000010.txt").unlink()
    sequence, twist = open_sequence(drive), trajectory()[1]
    np.testing.assert_array_equal(sequence.truth.frame, np.delete(np.arange(FRAMES), 10))
    np.testing.assert_allclose(sequence.twist[10], (twist[9] + twist[11]) / 2, atol=1e-12)
    np.testing.assert_allclose(sequence.twist[11], twist[11], atol=1e-12)
    assert any(
        note.startswith("oxts/data: 1 packets are missing, the first is 0000000010.txt;") for note in sequence.notes
    )


def test_empty_lines_behind_the_last_packet_are_the_end_of_the_file(drive):
    rewrite(drive / "oxts/timestamps.txt", lambda lines: lines.extend(["", " "]))
    sequence = open_sequence(drive)
    assert len(sequence) == FRAMES and not any("empty" in note for note in sequence.notes)


def test_short_gaps_are_noted(drive):
    stamp_ns = trajectory()[0].copy()
    stamp_ns[30:] += 400_000_000
    text = [str(np.datetime64(int(ns), "ns")).replace("T", " ") for ns in stamp_ns]
    (drive / "oxts/timestamps.txt").write_text("\n".join(text))
    (note,) = [note for note in open_sequence(drive).notes if "longer" in note]
    assert note == (
        "timestamps.txt: 1 steps are longer than 2.5 times the median, the longest is 0.499 s before line 31."
    )


def test_stamps_of_the_images_are_compared(drive):
    images = drive / "image_00" / "timestamps.txt"
    images.parent.mkdir()
    lines = [str(np.datetime64(int(ns) + 4_000_000, "ns")).replace("T", " ") for ns in trajectory()[0]]
    images.write_text("\n".join(["", *lines[1:]]) + "\n")
    assert "Stamps are those of the packets; image_00 differs by at most 4.0 ms." in open_sequence(drive).notes
    images.write_text("\n".join(lines[1:]) + "\n")
    assert "image_00 has 69 stamps for 70 packets; frames are packets." in open_sequence(drive).notes


# What is refused, naming file and line


def put(k: int, text: str) -> Callable[[list[str]], None]:
    def change(lines: list[str]) -> None:
        lines[k] = text

    return change


def put_word(k: int, text: str) -> Callable[[list[str]], None]:
    def change(lines: list[str]) -> None:
        words = lines[0].split()
        lines[0] = " ".join([*words[:k], text, *words[k + 1 :]])

    return change


def empty(*numbers: int) -> Callable[[list[str]], None]:
    def change(lines: list[str]) -> None:
        for k in numbers:
            lines[k] = ""

    return change


def swap(lines: list[str]) -> None:
    lines[5], lines[6] = lines[6], lines[5]


def repeat(lines: list[str]) -> None:
    lines[7] = lines[6]


def drop_last(lines: list[str]) -> None:
    lines.pop()


def drop_all(lines: list[str]) -> None:
    lines.clear()


def drop_empty(lines: list[str]) -> None:
    """As if somebody had cleaned the file of its empty lines."""
    del lines[12:15]


def late(lines: list[str]) -> None:
    lines[-1] = lines[-1].replace("2011-09-30 12:00", "2011-09-30 12:01")


def without(key: str) -> Callable[[list[str]], None]:
    def change(lines: list[str]) -> None:
        lines[:] = [line for line in lines if not line.startswith(key + ":")]

    return change


def value(key: str, text: str) -> Callable[[list[str]], None]:
    def change(lines: list[str]) -> None:
        lines[:] = [f"{key}: {text}" if line.startswith(key + ":") else line for line in lines]

    return change


STAMPS, PACKET = "oxts/timestamps.txt", "oxts/data/0000000003.txt"
IMU_VELO, VELO_CAM, CAM_CAM = (f"../calib_{name}.txt" for name in ("imu_to_velo", "velo_to_cam", "cam_to_cam"))
MIRROR = numbers(np.diag([1.0, 1, -1]))
SWAPPED = numbers(np.column_stack([K, K @ [0.54, 0, 0]]))
UNLIKE = numbers(np.column_stack([K + np.diag([1.0, 0, 0]), K @ OFFSETS_M["01"]]))
SLANTED = numbers(np.column_stack([K, K @ [-0.54, 0.02, 0]]))
SKEWED = numbers(np.column_stack([K + np.array([[0, 1, 0], [0, 0, 0], [0, 0, 0]]), K @ OFFSETS_M["01"]]))
SINGULAR = numbers(np.column_stack([np.diag([0.0, 719, 1]), np.zeros(3)]))

BROKEN: list[tuple[str, Callable, type[DataError], str, int | None]] = [
    (STAMPS, swap, StampError, "line", 7),
    (STAMPS, repeat, StampError, "line", 8),
    (STAMPS, late, StampError, "line", FRAMES),
    (STAMPS, put(4, "2011-09-30T12:00:00"), LineError, "line", 5),
    (STAMPS, put(4, "2011-13-30 12:00:00.5"), LineError, "line", 5),
    (STAMPS, put(4, "1317384506.4"), LineError, "line", 5),
    (STAMPS, empty(0), LostDataError, "line", 1),
    (STAMPS, empty(FRAMES - 1), LostDataError, "line", FRAMES),
    (STAMPS, empty(*range(8, 14)), LostDataError, "line", 9),
    (STAMPS, empty(*range(3, 43, 5)), LostDataError, "line", 4),
    (STAMPS, empty(*range(FRAMES)), LostDataError, "line", 1),
    (STAMPS, drop_last, ShapeError, "", None),
    (STAMPS, drop_empty, ShapeError, "", None),
    (STAMPS, drop_all, ShapeError, "", None),
    (STAMPS, lambda lines: lines.append(lines[-1]), ShapeError, "", None),
    (PACKET, put_word(29, ""), LineError, "line", 1),
    (PACKET, put_word(29, "1 2"), LineError, "line", 1),
    (PACKET, put_word(8, "1,5"), LineError, "line", 1),
    (PACKET, put_word(8, "nan"), NonFiniteError, "line", 1),
    (PACKET, put_word(0, "4901.5"), LineError, "line", 1),
    (PACKET, lambda lines: lines.append(lines[0]), LineError, "line", 2),
    (PACKET, drop_all, LineError, "line", 1),
    (IMU_VELO, without("R"), CalibrationError, "R", None),
    (IMU_VELO, value("T", "1 2"), LineError, "line", 3),
    (IMU_VELO, value("R", MIRROR), ExtrinsicsError, "R", None),
    (VELO_CAM, without("T"), CalibrationError, "T", None),
    (VELO_CAM, value("R", numbers(0.5 * np.eye(3))), ExtrinsicsError, "R", None),
    (VELO_CAM, value("T", "1 2 x"), LineError, "line", 3),
    (CAM_CAM, without("R_rect_00"), CalibrationError, "R_rect_00", None),
    (CAM_CAM, without("P_rect_00"), CalibrationError, "P_rect_00", None),
    (CAM_CAM, without("P_rect_01"), CalibrationError, "P_rect_01", None),
    (CAM_CAM, value("R_rect_00", MIRROR), ExtrinsicsError, "R_rect_00", None),
    (CAM_CAM, value("P_rect_00", "1 2 3"), LineError, "line", 5),
    (CAM_CAM, value("P_rect_00", "inf " * 12), NonFiniteError, "line", 5),
    (CAM_CAM, value("P_rect_00", SINGULAR), CalibrationError, "P_rect_00", None),
    (CAM_CAM, value("P_rect_01", SWAPPED), CalibrationError, "P_rect_00, P_rect_01", None),
    (CAM_CAM, value("P_rect_01", UNLIKE), CalibrationError, "P_rect_01", None),
    (CAM_CAM, value("P_rect_01", SLANTED), CalibrationError, "P_rect_01", None),
    (CAM_CAM, value("P_rect_01", SKEWED), CalibrationError, "P_rect_01", None),
]


@pytest.mark.parametrize(
    ("name", "change", "error", "field", "index"), BROKEN, ids=lambda x: getattr(x, "__name__", None)
)
def test_broken_drive_names_file_and_line(drive, name, change, error, field, index):
    path = drive / name if not name.startswith("..") else drive.parent / name[3:]
    rewrite(path, change)
    with pytest.raises(DataError) as caught:
        open_sequence(drive)
    assert type(caught.value) is error, caught.value
    assert (caught.value.source, caught.value.field, caught.value.index) == (str(path), field, index), caught.value
    assert str(caught.value).startswith(str(path))


@pytest.mark.parametrize("name", ["oxts", "oxts/data", STAMPS, IMU_VELO, VELO_CAM, CAM_CAM])
def test_missing_files_are_named_with_what_was_expected(drive, name):
    path = drive / name if not name.startswith("..") else drive.parent / name[3:]
    path.rename(drive.parent / "elsewhere")
    with pytest.raises(UnknownFormatError, match="expected a drive folder of KITTI raw") as caught:
        open_sequence(drive)
    assert path.name in str(caught.value) and str(drive) in str(caught.value)


def test_missing_packet_with_a_stamp_is_named(drive):
    (drive / "oxts/data/0000000017.txt").unlink()
    with pytest.raises(LostDataError, match=r"oxts.data\[17\]|0000000017\.txt, line 18") as caught:
        open_sequence(drive)
    assert caught.value.source == str(drive / "oxts" / "data")


def test_folder_without_packets_and_binary_stamps_are_refused(drive):
    (drive / STAMPS).write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UnknownFormatError, match=r"timestamps\.txt: not a readable text file"):
        open_sequence(drive)
    for path in (drive / "oxts/data").iterdir():
        path.unlink()
    with pytest.raises(UnknownFormatError, match="holds no packets"):
        open_sequence(drive)


def test_description_of_the_packets_is_checked_where_there_is_one(drive):
    path = drive / "oxts/dataformat.txt"
    lines = [f"{name}:   something ({name})" for name in PACKET_FIELDS]
    path.write_text("\n".join(lines))
    assert len(open_sequence(drive)) == FRAMES
    lines[8], lines[9] = lines[9], lines[8]
    path.write_text("\n".join(lines))
    with pytest.raises(LineError, match="field vf") as caught:
        open_sequence(drive)
    assert (caught.value.source, caught.value.index) == (str(path), 9)


@pytest.mark.slow
def test_scrambled_files_never_raise_anything_but_named_errors(drive):
    rng = np.random.default_rng(3)
    files = [drive / STAMPS, drive / PACKET, *drive.parent.glob("calib_*.txt")]
    for trial in range(60):
        path = files[trial % len(files)]
        whole = path.read_bytes()
        content = bytearray(whole)
        for place in rng.integers(0, len(content), 4):
            content[place] = rng.integers(0, 256)
        path.write_bytes(content)
        try:
            open_sequence(drive)
        except EkfslamError as error:
            assert path.name in str(error) or str(drive) in str(error)
        path.write_bytes(whole)


# A drive as truth of another recording


def test_drive_is_truth_for_a_recording_with_its_stamps(drive, tmp_path):
    stamp_ns, _, T = trajectory()
    fields = ece276a_fields()
    frames = fields["time_stamps"].shape[1]
    fields["time_stamps"] = stamp_ns[None, 5 : 5 + frames] / 1e9 + 0.01
    npz = write_npz(tmp_path / "a.npz", fields)
    sequence = open_sequence(npz, truth=drive)
    np.testing.assert_array_equal(sequence.truth.frame, np.arange(frames))
    np.testing.assert_allclose(sequence.truth.T_world_imu, (se3.inverse(T[0]) @ T)[5 : 5 + frames], atol=1e-8)
    assert sequence.notes[-1] == f"Truth of 7 of 7 frames from {NAME}; 63 of its 70 poses are not used."
    # Truth asks for no calibration.
    for path in drive.parent.glob("calib_*.txt"):
        path.unlink()
    assert open_sequence(npz, truth=drive).truth is not None
    fields["time_stamps"] = stamps()[None] - stamps()[0]
    with pytest.raises(
        TruthError, match=r"0 of the 7 frames .* its stamps are 1317384000\.\d+ to .* the sequence's 0\.000"
    ):
        open_sequence(write_npz(npz, fields), truth=drive)
