"""Files of an inertial unit: columns, units, stamps and densities; each mistake is named."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from support.helpers import synthetic_sequence
from support.images import STAMPS_NS, write_euroc, write_plain
from support.imu import FIRST_NS, HEADER, STEP_NS, motion, rows, write_imu0, write_lines, yaml_lines

import ekfslam
from ekfslam import attach_inertial
from ekfslam.data.imu import attach_inertial_noise
from ekfslam.data.inertial import NOT_STATED
from ekfslam.data.readers.imu_text import read_imu
from ekfslam.errors import (
    CalibrationError,
    DataError,
    ExtrinsicsError,
    LineError,
    LostDataError,
    NonFiniteError,
    StampError,
    UnknownFormatError,
)
from ekfslam.geometry import se3
from ekfslam.geometry.camera import T_CAM_BODY

COUNT = 500
TIME_NS = FIRST_NS + STEP_NS * np.arange(COUNT)
GYRO, ACCEL = motion(COUNT)


def recording() -> ekfslam.Sequence:
    sequence = synthetic_sequence(frames=20)
    time_s = FIRST_NS / 1e9 + 0.1 + 0.1 * np.arange(20)
    return dataclasses.replace(sequence, time_s=time_s, twist=sequence.twist, inputs=())


def written(place: Path, header: str = HEADER, time_ns=TIME_NS, gyro=GYRO, accel=ACCEL) -> Path:
    return write_lines(place / "imu.csv", [*([header] if header else []), *rows(time_ns, gyro, accel)])


def attached(path: Path, **changes) -> ekfslam.Sequence:
    return attach_inertial(recording(), path, **changes)


def assert_samples(sequence: ekfslam.Sequence, gyro=GYRO, accel=ACCEL) -> None:
    np.testing.assert_allclose(sequence.inertial.time_s, TIME_NS / 1e9, rtol=0, atol=3e-7)
    np.testing.assert_allclose(sequence.inertial.gyro_rad_s, gyro, atol=1e-9)
    np.testing.assert_allclose(sequence.inertial.accel_m_s2, accel, atol=1e-9)


def test_a_csv_of_euroc_becomes_samples_with_the_densities_beside_it(tmp_path):
    write_lines(tmp_path / "sensor.yaml", yaml_lines())
    sequence = attached(written(tmp_path))
    assert_samples(sequence)
    assert sequence.inertial.noise == ekfslam.InertialNoise(1.7e-4, 2e-3, 1.9e-5, 3e-3)
    assert len(sequence.attributes["imu_sha256"]) == 64


def test_a_file_without_a_header_has_the_order_of_euroc(tmp_path):
    assert_samples(attached(written(tmp_path, header="")))


def test_a_header_decides_order_and_units(tmp_path):
    header = "seq,time [s],acc_x (g),acc_y (g),acc_z (g),gyro_x (deg/s),gyro_y (deg/s),gyro_z (deg/s),temperature"
    lines = [
        f"{k},{ns // 10**9}.{ns % 10**9:09d},{','.join(map(repr, (f / 9.80665).tolist()))},"
        f"{','.join(map(repr, np.rad2deg(w).tolist()))},21.5"
        for k, (ns, w, f) in enumerate(zip(TIME_NS.tolist(), GYRO, ACCEL, strict=True))
    ]
    sequence = attached(write_lines(tmp_path / "phone.csv", [header, *lines]))
    assert_samples(sequence)
    assert [note for note in sequence.notes if "are converted" in note] == [
        "The header states deg/s for gyro columns: they are converted.",
        "The header states g for accel columns: they are converted.",
    ]


def test_messages_printed_by_rostopic_are_read_with_their_own_stamps(tmp_path):
    names = ("angular_velocity", "linear_acceleration")
    header = ["%time", "field.header.seq", "field.header.stamp", "field.header.frame_id"]
    header += [f"field.orientation.{axis}" for axis in "xyzw"]
    header += [f"field.{name}.{axis}" for name in names for axis in "xyz"] + ["field.angular_velocity_covariance0"]
    lines = [
        ",".join([str(ns + 4_000_123), str(k), str(ns), "imu", "0", "0", "0", "1", *map(repr, row), "0.0"])
        for k, (ns, row) in enumerate(zip(TIME_NS.tolist(), np.hstack([GYRO, ACCEL]).tolist(), strict=True))
    ]
    assert_samples(attached(write_lines(tmp_path / "echo.csv", [",".join(header), *lines])))


@pytest.mark.parametrize(("unit", "scale"), [("us", 1_000), ("ms", 1_000_000)])
def test_the_unit_of_stamps_follows_from_their_steps(tmp_path, unit, scale):
    sequence = attached(written(tmp_path, header="", time_ns=TIME_NS // scale))
    np.testing.assert_allclose(sequence.inertial.time_s, TIME_NS // scale * (scale / 1e9), rtol=0, atol=3e-7)
    assert f"Stamps of imu.csv are taken as {unit}, by their steps." in sequence.notes


@pytest.mark.parametrize(("factor", "count", "unit"), [(1_000, 400, "us"), (1, 1, "ns")])
def test_the_unit_of_stamps_follows_from_their_steps_before_their_size(tmp_path, factor, count, unit):
    """Stamps in us since a start are too small for a date; the step of a single one is unknown."""
    stamps = (TIME_NS[:count] - (TIME_NS[0] if count > 1 else 0)) // factor
    lines = rows(stamps, GYRO[:count], ACCEL[:count])
    found = read_imu(write_lines(tmp_path / "imu.csv", lines))
    np.testing.assert_array_equal(found.time_ns, stamps * factor)
    assert any(f"taken as {unit}" in note for note in found.notes) == (unit != "ns")


def test_a_unit_of_stamps_that_cannot_be_right_is_named(tmp_path):
    with pytest.raises(StampError, match=r"stamps in ns .* would be 2e\+08 Hz: they look like ms"):
        attached(written(tmp_path, time_ns=TIME_NS // 1_000_000))


def test_stamps_in_ns_lose_no_digits_between_samples(tmp_path):
    odd = TIME_NS + np.arange(COUNT) % 7
    found = attached(written(tmp_path, time_ns=odd)).inertial.time_s
    assert np.abs(np.diff(found) - np.diff(odd) / 1e9).max() < 2.5e-7


def test_folder_and_npz_are_read(tmp_path):
    sequence = attached(write_imu0(tmp_path / "imu0", 500))
    assert len(sequence.inertial.time_s) == 500 and sequence.inertial.noise is not None
    np.savez(tmp_path / "sim.npz", imu_time_s=TIME_NS / 1e9, gyro_rad_s=GYRO, accel_m_s2=ACCEL)
    assert_samples(attached(tmp_path / "sim.npz"))


def test_densities_are_those_of_a_file_that_is_named(tmp_path):
    lines = ["imu0:", "  rostopic: /imu", "  update_rate: 200.0", *yaml_lines("  ", gyroscope_noise_density=3e-4)]
    noise = write_lines(tmp_path / "other/imu.yaml", lines)
    write_lines(tmp_path / "sensor.yaml", yaml_lines())
    assert attached(written(tmp_path), noise=noise).inertial.noise.gyro == 3e-4
    assert attached(written(tmp_path)).inertial.noise.gyro == 1.7e-4


def test_other_densities_are_given_to_samples_that_a_recording_has(tmp_path):
    images = write_euroc(tmp_path)
    write_imu0(images / "mav0/imu0", 300, STAMPS_NS[0] - 20 * STEP_NS)
    noise = write_lines(tmp_path / "a.yaml", yaml_lines(gyroscope_noise_density=5e-4))
    found = attach_inertial_noise(ekfslam.open_images(images), noise)
    assert found.inertial.noise.gyro == 5e-4 and found.notes[-1].startswith("Noise densities from")
    with pytest.raises(LostDataError, match="no inertial samples"):
        attach_inertial_noise(recording(), noise)


def test_a_stated_rate_that_is_not_that_of_the_stamps_and_a_time_offset_are_notes(tmp_path):
    write_lines(tmp_path / "imu.yaml", [*yaml_lines(), "update_rate: 400.0", "time_offset: 0.02"])
    notes = attached(written(tmp_path)).notes
    assert "The inertial unit is stated to have 400 Hz, but its stamps have 200 Hz." in notes
    assert any("time_offset 0.02 s against another unit, which is not applied" in note for note in notes)


def test_missing_densities_are_a_note(tmp_path):
    write_lines(tmp_path / "imu.yaml", yaml_lines()[:3])
    sequence = attached(written(tmp_path))
    assert sequence.inertial.noise is None
    unused = "imu.yaml does not state accelerometer_random_walk: its densities are not used."
    assert unused in sequence.notes and NOT_STATED in sequence.notes
    given = attach_inertial_noise(sequence, write_lines(tmp_path / "a.yaml", yaml_lines()))
    assert set(sequence.notes) - set(given.notes) == {unused, NOT_STATED}


def test_a_named_file_must_state_all_densities(tmp_path):
    with pytest.raises(CalibrationError, match="does not state accelerometer_random_walk"):
        attached(written(tmp_path), noise=write_lines(tmp_path / "some.yaml", yaml_lines()[:3]))


@pytest.mark.parametrize("text", ["abc", "-1.0"])
def test_a_density_that_is_no_positive_number_names_its_key(tmp_path, text):
    write_lines(tmp_path / "imu.yaml", [*yaml_lines()[1:], f"gyroscope_noise_density: {text}"])
    with pytest.raises(DataError, match="gyroscope_noise_density") as caught:
        attached(written(tmp_path))
    assert caught.value.source.endswith("imu.yaml")


REFUSED = {
    "g": (GYRO, ACCEL / 9.80665, r"specific forces look like g: .*multiply by 9.80665"),
    "cm/s^2": (GYRO, ACCEL * 100, "specific forces look like cm/s"),
    "gravity removed": (GYRO, ACCEL - ACCEL.mean(axis=0), "gravity removed"),
    "deg/s": (np.rad2deg(GYRO) * 3, ACCEL, "angular rates look like deg/s"),
    "swapped": (ACCEL, GYRO, "columns are swapped"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_units_that_cannot_be_right_are_refused(tmp_path, name):
    gyro, accel, words = REFUSED[name]
    if name == "gravity removed":
        accel = 0.02 * np.random.default_rng(0).normal(size=(COUNT, 3))
    with pytest.raises(DataError, match=words) as caught:
        attached(written(tmp_path, gyro=gyro, accel=accel))
    assert caught.value.source.endswith("imu.csv")


def test_units_that_are_doubtful_become_notes(tmp_path):
    assert any("expected 9.81" in note for note in attached(written(tmp_path, accel=1.3 * ACCEL)).notes)
    gyro = GYRO.copy()
    gyro[100] = 40.0
    assert any("1 angular rates exceed 35" in note for note in attached(written(tmp_path, gyro=gyro)).notes)


def test_slow_motion_in_deg_s_shows_by_the_turns_of_gravity(tmp_path):
    gyro, accel = motion(4000, rate_rad_s=0.2)
    time_ns = FIRST_NS + STEP_NS * np.arange(4000)
    for rates, is_named in ((np.rad2deg(gyro), True), (gyro, False)):
        notes = attached(written(tmp_path, time_ns=time_ns, gyro=rates, accel=accel)).notes
        assert any("look like deg/s" in note for note in notes) == is_named


def test_gaps_are_counted_with_the_longest(tmp_path):
    kept = np.r_[0:100, 110:200, 240:COUNT]
    sequence = attached(written(tmp_path, time_ns=TIME_NS[kept], gyro=GYRO[kept], accel=ACCEL[kept]))
    assert "The inertial samples have 2 gaps of more than three steps; the longest is 0.205 s." in sequence.notes
    assert "2 gaps, the longest 0.205 s" in sequence.inertial.text


def test_repeated_stamps_are_dropped_and_counted(tmp_path):
    kept = np.sort(np.r_[0:COUNT, 5, 70, 71])
    sequence = attached(written(tmp_path, time_ns=TIME_NS[kept], gyro=GYRO[kept], accel=ACCEL[kept]))
    assert_samples(sequence)
    assert "3 inertial samples repeat a stamp, the first at line 8: they are dropped." in sequence.notes


def test_a_stamp_that_goes_back_names_its_line(tmp_path):
    time_ns = TIME_NS.copy()
    time_ns[9] -= 12_000_000
    with pytest.raises(StampError) as caught:
        attached(written(tmp_path, time_ns=time_ns))
    assert caught.value.index == 11


BROKEN = [
    (20, "nan", NonFiniteError, 22),
    (20, "x", LineError, 22),
    (20, "1.0,2.0", LineError, 22),
]


@pytest.mark.parametrize(("row", "text", "error", "number"), BROKEN)
def test_a_broken_line_names_file_and_line(tmp_path, row, text, error, number):
    lines = rows(TIME_NS, GYRO, ACCEL)
    words = lines[row].split(",")
    lines[row] = ",".join([*words[:2], text, *words[3:]])
    path = write_lines(tmp_path / "imu.csv", [HEADER, *lines])
    with pytest.raises(error) as caught:
        attached(path)
    assert (caught.value.source, caught.value.field, caught.value.index) == (str(path), "line", number)


def test_unknown_columns_and_units_are_named(tmp_path):
    with pytest.raises(UnknownFormatError, match="names no column of gyro x"):
        attached(written(tmp_path, header="t,roll,pitch,yaw,ax,ay,az"))
    with pytest.raises(UnknownFormatError, match="the unit 'furlong/s' of gyro x"):
        attached(written(tmp_path, header="t,wx [furlong/s],wy,wz,ax,ay,az"))


def test_frames_outside_of_the_samples_are_left_out(tmp_path):
    part = slice(0, 300)  # 1.5 s of 2
    sequence = attached(written(tmp_path, time_ns=TIME_NS[part], gyro=GYRO[part], accel=ACCEL[part]))
    assert len(sequence) == 15
    assert "5 frames before or after all inertial samples are left out." in sequence.notes


def test_samples_of_another_clock_are_refused_with_both_spans(tmp_path):
    with pytest.raises(LostDataError, match=r"inertial samples, 0.000 to 2.495 s, do not cover the images, 1403636579"):
        attached(written(tmp_path, time_ns=TIME_NS - FIRST_NS))


def image_folder(place: Path) -> Path:
    """A pair of image folders whose calibration does not state where the inertial unit is."""
    folder = write_plain(place)
    np.savetxt(folder / "times.txt", FIRST_NS / 1e9 + 0.1 + 0.1 * np.arange(6), fmt="%.9f")
    return folder


def test_images_without_extrinsics_need_a_chain_of_kalibr_beside_the_samples(tmp_path):
    images, path = ekfslam.open_images(image_folder(tmp_path)), written(tmp_path / "imu")
    with pytest.raises(ExtrinsicsError, match="no file states T_cam_imu"):
        attach_inertial(images, path)
    T = se3.exp(np.array([0.1, 0.2, 0.3, 1.0, -1.0, 0.5]))
    lines = [f"  - [{', '.join(map(repr, row))}]" for row in T.tolist()]
    write_lines(tmp_path / "imu/camchain-imucam.yaml", ["cam0:", "  T_cam_imu:", *lines, "  timeshift_cam_imu: -0.01"])
    found = attach_inertial(images, path)
    np.testing.assert_allclose(found.T_cam_imu, T, atol=1e-9)
    np.testing.assert_allclose(found.inertial.time_s, TIME_NS / 1e9 + 0.01, rtol=0, atol=3e-7)
    assert found.attributes["imu_late_s"] == -0.01
    assert "T_cam_imu is that of cam0 in camchain-imucam.yaml." in found.notes
    assert not any("The body is the left camera" in note for note in found.notes)


def test_only_an_inertial_unit_that_nothing_places_is_said_to_be_the_left_camera(tmp_path):
    path, placed = written(tmp_path), dataclasses.replace(recording(), T_cam_imu=se3.exp(np.full(6, 0.3)))
    for sequence, is_told in ((dataclasses.replace(placed, T_cam_imu=T_CAM_BODY), True), (placed, False)):
        notes = attach_inertial(sequence, path).notes
        assert any("the inertial unit is taken to be the left camera" in note for note in notes) is is_told


def test_samples_given_as_arrays_are_looked_at_too():
    samples = ekfslam.InertialSamples(TIME_NS / 1e9, GYRO, ACCEL / 9.80665)
    sequence = recording()
    with pytest.raises(DataError, match="look like g"):
        ekfslam.Sequence.from_tracks(
            sequence.time_s,
            np.tile([20.0, 5.0, 10.0, 5.0], (20, 1, 1)),
            sequence.camera,
            imu=samples,
            T_cam_imu=sequence.T_cam_imu,
        )


def test_the_samples_of_a_recording_can_be_left_out():
    room = "builtin:room?frames=5"
    sequence = ekfslam.open_sequence(room, imu="none")
    assert ekfslam.open_sequence(room).inertial is not None
    assert sequence.inertial is None and sequence.notes[-1] == "The inertial samples of the recording are left out."
