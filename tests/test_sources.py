"""Folders of stereo images, made here: what each source makes of them, and how each is refused when it is broken."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as Pillow
from support.images import (
    FRAMES,
    LEFT_IN_BODY,
    LEFT_RIGHT,
    SIZE,
    STAMPS_NS,
    TOML,
    opened,
    picture,
    write_course,
    write_euroc,
    write_picture,
    write_plain,
    write_raw_images,
)
from support.kitti_raw import K as KITTI_K
from support.kitti_raw import write_drive
from support.npy import Runs, write_npy
from support.recordings import HEADER

from ekfslam import attach_truth, open_images, open_kitti_raw, open_sequence
from ekfslam.data.images import ImageRecording
from ekfslam.data.simulate import builtin
from ekfslam.errors import (
    CalibrationError,
    DataError,
    EkfslamError,
    ExtrinsicsError,
    LineError,
    LostDataError,
    NonFiniteError,
    ShapeError,
    StampError,
    UnknownFormatError,
)
from ekfslam.geometry import se3
from ekfslam.geometry.camera import R_CAM_BODY


def assert_pictures(recording: ImageRecording, first: int = 0) -> None:
    for frame in (len(recording) - 1, 0):
        for side, image in enumerate(recording.load(frame)):
            np.testing.assert_array_equal(image, picture(frame + first, side))


# KITTI raw


@pytest.fixture
def raw(tmp_path) -> Path:
    return write_raw_images(write_drive(tmp_path))


def test_kitti_raw_has_velocities_truth_and_calibration_of_its_packets(raw):
    found, plain = opened(raw), open_kitti_raw(raw).sequence()[:FRAMES]
    assert_pictures(found)
    for name in ("time_s", "twist", "T_cam_imu"):
        np.testing.assert_array_equal(getattr(found, name), getattr(plain, name))
    np.testing.assert_array_equal(found.truth.T_world_imu, plain.truth.T_world_imu)
    assert found.calibration.is_rectified and found.calibration.size == SIZE
    np.testing.assert_array_equal(found.calibration.K_left, KITTI_K)
    assert found.calibration.T_right_left[0, 3] == pytest.approx(-plain.camera.baseline_m)
    assert found.attributes["reader"] == "kitti_raw_images" and "tracks" not in found.attributes
    assert f"The folder has images 0 to {FRAMES - 1} of 70 packets." in found.notes


def test_kitti_raw_images_may_begin_later_and_be_coloured(raw):
    for side in (0, 1):
        (raw / f"image_0{side}").rename(raw / f"image_0{side + 2}")
        (raw / f"image_0{side + 2}/data/{0:010d}.png").unlink()
    found = opened(raw)
    assert_pictures(found, first=1)
    assert found.attributes["stereo_pair"] == "color" and len(found) == FRAMES - 1
    np.testing.assert_array_equal(found.time_s, open_kitti_raw(raw).oxts.time_s[1:FRAMES])


RAW_IMAGE = "image_00/data/{:010d}.png"
BROKEN_RAW: list[tuple[Callable[[Path], Any], type[EkfslamError], str]] = [
    (lambda raw: (raw / RAW_IMAGE.format(3)).unlink(), LostDataError, "0000000003 is missing"),
    (lambda raw: [path.unlink() for path in (raw / "image_01/data").iterdir()], UnknownFormatError, "no images"),
    (lambda raw: (raw / RAW_IMAGE.format(0)).rename(raw / "image_00/data/a.png"), UnknownFormatError, "a.png"),
    (lambda raw: (raw / RAW_IMAGE.format(0)).write_text("no image"), UnknownFormatError, "not a readable image"),
    (lambda raw: write_picture(raw / RAW_IMAGE.format(70), 0, 0), LostDataError, "has no packet"),
    (lambda raw: (raw.parent / "calib_cam_to_cam.txt").unlink(), UnknownFormatError, "calib_cam_to_cam.txt"),
    (lambda raw: (raw / "oxts/timestamps.txt").write_text("now\n"), EkfslamError, "timestamps.txt"),
]


@pytest.mark.parametrize(("damage", "error", "words"), BROKEN_RAW, ids=[row[2] for row in BROKEN_RAW])
def test_broken_kitti_raw(raw, damage, error, words):
    damage(raw)
    with pytest.raises(error, match=words.replace(".", r"\.")):
        open_images(raw)


def test_extract_drives_are_not_rectified(raw):
    with pytest.raises(UnknownFormatError, match="not rectified"):
        open_images(raw.rename(raw.with_name(raw.name.replace("_sync", "_extract"))))


def test_images_of_another_size_are_named_when_they_are_loaded(raw):
    found = opened(raw)
    Pillow.fromarray(np.zeros((5, 5), np.uint8)).save(raw / RAW_IMAGE.format(2))
    with pytest.raises(CalibrationError, match="5 x 5 pixels"):
        found.load(2)


# EuRoC and TUM-VI


@pytest.fixture
def euroc(tmp_path) -> Path:
    return write_euroc(tmp_path)


def test_euroc(euroc):
    for place in (euroc, euroc / "mav0"):
        found = opened(place)
        assert_pictures(found)
        assert found.name == "MH_01_easy" and found.twist is None and found.truth is None
        np.testing.assert_array_equal(found.time_s, STAMPS_NS / 1e9)
        np.testing.assert_allclose(found.T_cam_imu, se3.inverse(LEFT_IN_BODY), atol=1e-12)
        calibration = found.calibration
        np.testing.assert_allclose(calibration.T_right_left, se3.inverse(LEFT_RIGHT), atol=1e-12)
        np.testing.assert_array_equal(calibration.K_left, [[458.654, 0, 367.215], [0, 457.296, 248.375], [0, 0, 1]])
        assert calibration.K_right[0, 0] == 459.654 and calibration.size == SIZE
        assert calibration.distortion_right.model == "radtan"
        assert calibration.distortion_left.coefficients == (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)


@pytest.mark.parametrize("place", ["state_groundtruth_estimate0", "mocap0"])
def test_truth_of_euroc_and_tum_vi_comes_along(euroc, place):
    header = ", ".join(HEADER.split(", ")[:8])
    rows = [f"{stamp + 1_000_000},{k}.5,2,3,1,0,0,0" for k, stamp in enumerate(STAMPS_NS)][2:]
    (euroc / "mav0" / place).mkdir()
    (euroc / "mav0" / place / "data.csv").write_text("\n".join([header, *rows]) + "\n")
    found = opened(euroc)
    np.testing.assert_array_equal(found.truth.frame, np.arange(2, FRAMES))
    np.testing.assert_array_equal(found.truth.T_world_imu[0, :3, 3], [2.5, 2, 3])
    assert f"Truth of 4 of 6 frames from {place}/data.csv." in found.notes


KALIBR = """cam0:
  T_cam_imu:
  - [{}]
  - [{}]
  - [{}]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [0.0034, 0.0007, -0.002, 0.0002]
  distortion_model: equidistant
  intrinsics: [190.97, 190.97, 254.93, 256.89]
  resolution: [12, 8]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [{}]
  - [{}]
  - [{}]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [0.0034, 0.0017, -0.0026, 0.0004]
  distortion_model: equidistant
  intrinsics: [190.44, 190.43, 252.59, 254.94]
  resolution: [12, 8]
"""


def test_tum_vi_with_the_calibration_of_kalibr(euroc):
    for side in (0, 1):
        (euroc / f"mav0/cam{side}/sensor.yaml").unlink()
    T_cam_imu, T_right_left = se3.inverse(LEFT_IN_BODY), se3.inverse(LEFT_RIGHT)
    rows = [", ".join(repr(float(x)) for x in row) for row in (*T_cam_imu[:3], *T_right_left[:3])]
    (euroc / "dso").mkdir()
    (euroc / "dso/camchain.yaml").write_text(KALIBR.format(*rows))
    found = opened(euroc)
    np.testing.assert_allclose(found.T_cam_imu, T_cam_imu, atol=1e-12)
    np.testing.assert_allclose(found.calibration.T_right_left, T_right_left, atol=1e-12)
    assert found.calibration.distortion_left.model == "equidistant"
    assert found.calibration.K_right[1, 1] == 190.43


def test_images_without_a_partner_are_left_out_with_a_note(euroc):
    for side in (0, 1):
        stamps = STAMPS_NS[0] + 50_000_000 * np.arange(30)
        for frame, stamp in enumerate(stamps):
            write_picture(euroc / f"mav0/cam{side}/data/{stamp}.png", frame % 25, side)
        kept = np.delete(stamps, 3 + side)
        (euroc / f"mav0/cam{side}/data.csv").write_text("".join(f"{stamp},{stamp}.png\n" for stamp in kept))
    found = opened(euroc)
    assert len(found) == 28 and "2 images without a partner are left out." in found.notes
    np.testing.assert_array_equal(found.load(3)[1], picture(5, 1))


def replace(name: str, old: str, new: str) -> Callable[[Path], Any]:
    def change(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1))

    return change


CSV, YAML = "mav0/cam1/data.csv", "mav0/cam1/sensor.yaml"
STAMP = str(STAMPS_NS[2])
BROKEN_EUROC: list[tuple[Callable[[Path], Any], type[EkfslamError], str]] = [
    (lambda folder: (folder / CSV).unlink(), UnknownFormatError, "cam1/data.csv"),
    (lambda folder: (folder / CSV).write_text("#timestamp [ns],filename\n"), LineError, "there are no images"),
    (lambda folder: shutil.rmtree(folder / "mav0/cam1/data"), LostDataError, "none of its 6 images is in"),
    (replace(CSV, f"{STAMP},{STAMP}.png", f"{STAMP},../../cam0/data/{STAMP}.png"), LostDataError, "is missing in"),
    (replace(CSV, f"{STAMP},", "now,"), LineError, "line[4]"),
    (replace(CSV, f"{STAMP},", f"9{STAMP},"), LineError, "line[4]"),
    (lambda folder: (folder / YAML).unlink(), UnknownFormatError, "cam1/sensor.yaml"),
    (replace(YAML, "camera_model: pinhole", "camera_model: omni"), CalibrationError, "camera_model"),
    (replace(YAML, "camera_model: pinhole", ""), CalibrationError, "camera_model"),
    (replace(YAML, "resolution: [12", "resolution: [1e999"), CalibrationError, "whole numbers of pixels, found inf"),
    (replace(YAML, "intrinsics: [", "intrinsics: [1, "), CalibrationError, "intrinsics: expected 4 numbers, found 5"),
    (replace(YAML, "radial-tangential", "fov"), CalibrationError, "distortion_model"),
    (replace(YAML, "[-0.28340811, ", "["), CalibrationError, "distortion_coefficients"),
    (replace(YAML, "resolution: [12", "resolution: [13"), CalibrationError, "resolution"),
    (replace(YAML, "rows: 4\n  data: [", "rows: 4\n  data: [7.0, "), CalibrationError, "T_BS.data"),
    (replace(YAML, "rows: 4\n  data: [", "rows: 4\n  data: [7"), ExtrinsicsError, "T_BS.data"),
    (replace("mav0/cam0/sensor.yaml", "[458.654", "[-458.654"), CalibrationError, "K_left"),
]


@pytest.mark.parametrize(("damage", "error", "words"), BROKEN_EUROC, ids=range(len(BROKEN_EUROC)))
def test_broken_euroc(euroc, damage, error, words):
    damage(euroc)
    with pytest.raises(error) as caught:
        open_images(euroc)
    assert words in str(caught.value) and str(euroc) in str(caught.value)


# A plain pair of folders


@pytest.fixture
def plain(tmp_path) -> Path:
    return write_plain(tmp_path)


def test_plain_folders(plain):
    for place in (plain, plain / "calibration.toml"):
        found = opened(place)
        assert_pictures(found)
        assert found.name == "garden" and found.twist is None
        np.testing.assert_array_equal(found.T_cam_imu, se3.transform(R_CAM_BODY, np.zeros(3)))
        assert found.calibration.K_right[0, 0] == 708.0 and found.calibration.distortion_left.model == "radtan"
        assert found.calibration.T_right_left[0, 3] == -0.54


def test_plain_folders_with_a_rate_a_baseline_and_velocities(plain):
    lines = ['times = "times.txt"', TOML.splitlines()[3]]
    text = TOML.replace(lines[0], "rate_hz = 20.0").replace(lines[1], 'baseline_m = 0.3\nvelocities = "v.csv"')
    (plain / "calibration.toml").write_text(text.split("[right_camera]")[0])
    (plain / "v.csv").write_text("# frame: imu\n" + "".join(f"{0.1 * k},{k},0,0,0,0,1\n" for k in range(5)))
    found = opened(plain)
    np.testing.assert_allclose(found.time_s, 0.05 * np.arange(FRAMES))
    np.testing.assert_allclose(found.twist[:, 0], 0.5 * np.arange(FRAMES), atol=1e-12)
    np.testing.assert_array_equal(found.calibration.K_left, found.calibration.K_right)
    assert found.calibration.distortion_right.model == "radtan"


FILE = "calibration.toml"
BROKEN_PLAIN: list[tuple[Callable[[Path], Any], type[EkfslamError], str]] = [
    (replace(FILE, "left =", "left"), UnknownFormatError, "not a TOML file"),
    (replace(FILE, "left =", "lefd ="), CalibrationError, "lefd: unknown key"),
    (replace(FILE, '"left"', "7"), CalibrationError, "left: expected the name"),
    (replace(FILE, '"left"', '"nowhere"'), UnknownFormatError, "nowhere"),
    (replace(FILE, "times =", "#"), CalibrationError, "either times or rate_hz"),
    (replace(FILE, "times =", "rate_hz = -1.0 #"), CalibrationError, "rate_hz"),
    (replace(FILE, "T_right_left =", "#"), CalibrationError, "either T_right_left or baseline_m"),
    (replace(FILE, "T_right_left =", "baseline_m = 'far' #"), CalibrationError, "baseline_m"),
    (replace(FILE, "T_right_left =", f"baseline_m = 1{'0' * 400} #"), CalibrationError, "baseline_m"),
    (replace(FILE, "T_right_left =", f"T_right_left = [[1{'0' * 400}]] #"), CalibrationError, "T_right_left"),
    (replace(FILE, "[[1,", "[[2,"), ExtrinsicsError, "T_right_left"),
    (replace(FILE, "-0.54", "'a'"), CalibrationError, "T_right_left: expected 4 x 4 numbers"),
    (replace(FILE, "-0.54", "nan"), CalibrationError, "T_right_left"),
    (replace(FILE, "[left_camera]", "[right_cam]"), CalibrationError, "right_cam: unknown key"),
    (replace(FILE, "intrinsics", "focal"), CalibrationError, "left_camera.focal: unknown key"),
    (replace(FILE, "[707.0, ", "["), CalibrationError, "left_camera.intrinsics"),
    (replace(FILE, "[707.0, ", "[0.0, "), CalibrationError, "K_left"),
    (replace(FILE, '"radtan"', '"fov"'), CalibrationError, "left_camera.distortion"),
    (replace(FILE, "[-0.28, ", "["), CalibrationError, "left_camera.distortion"),
    (lambda folder: (folder / "left/0003.png").unlink(), LostDataError, "the first is 0003"),
    (lambda folder: (folder / "times.txt").unlink(), UnknownFormatError, "times.txt"),
    (lambda folder: (folder / "times.txt").write_text("0\n1\n"), LostDataError, "2 stamps for 6 images"),
    (lambda folder: (folder / "times.txt").write_text("0\n" * FRAMES), StampError, "time_s[1]"),
    (lambda folder: (folder / "times.txt").write_text("0\nnan\n"), NonFiniteError, "line[2]"),
    (replace(FILE, 'right = "right"', 'right = "right"\nvelocities = "no.csv"'), UnknownFormatError, "no.csv"),
]


@pytest.mark.parametrize(("damage", "error", "words"), BROKEN_PLAIN, ids=range(len(BROKEN_PLAIN)))
def test_broken_plain_folders(plain, damage, error, words):
    damage(plain)
    with pytest.raises(error) as caught:
        open_images(plain)
    assert words in str(caught.value) and str(plain) in str(caught.value)


def test_other_folders_and_files_are_no_images(tmp_path):
    (tmp_path / "a.toml").write_bytes(b"\x00\x01")
    (tmp_path / "folder").mkdir()
    for place in (tmp_path, tmp_path / "folder", tmp_path / "a.toml", tmp_path / "nothing"):
        assert open_images(place) is None


# Images of the course data


@pytest.fixture
def course(tmp_path) -> Path:
    return write_course(tmp_path)


def test_images_of_the_course_data(course):
    world = builtin(f"loop?frames={FRAMES}")
    for place in (course, course.with_name("dataset02_imgs.npy")):
        found = opened(place)
        assert_pictures(found)
        np.testing.assert_allclose(found.T_cam_imu, world.T_cam_imu, atol=1e-12)
        np.testing.assert_allclose(found.calibration.T_right_left[:3, 3], [-world.camera.baseline_m, 0, 0], atol=1e-12)
        np.testing.assert_array_equal(found.twist, world.twist)
        assert found.velocity_frame == "level" and found.calibration.K_left[0, 0] == world.camera.fu_px


@pytest.mark.parametrize(
    ("pictures", "error", "words"),
    [
        ({"cam_imgs_L": [picture(0, 0)] * FRAMES}, ShapeError, "cam_imgs_R: this field is missing"),
        ({"cam_imgs_L": [picture(0, 0)] * 2, "cam_imgs_R": [picture(0, 0)] * FRAMES}, LostDataError, "2 images for 6"),
        ({"cam_imgs_L": 7, "cam_imgs_R": 7}, LostDataError, "0 images for 6"),
        ({"cam_imgs_L": ["a"] * FRAMES, "cam_imgs_R": ["a"] * FRAMES}, ShapeError, "cam_imgs_L[0]"),
        (
            {"cam_imgs_L": [picture(0, 0)] * FRAMES, "cam_imgs_R": [picture(0, 0).astype(float)] * FRAMES},
            ShapeError,
            "cam_imgs_R[0]: expected gray images of uint8",
        ),
    ],
)
def test_broken_images_of_the_course_data(course, pictures, error, words):
    path = write_npy(course.with_name("dataset02_imgs.npy"), pictures)
    with pytest.raises(error) as caught:
        open_images(course)
    assert isinstance(caught.value, DataError) and caught.value.source == str(path) and words in str(caught.value)


def test_images_of_the_course_data_run_nothing(course, tmp_path):
    write_npy(course.with_name("dataset02_imgs.npy"), {"cam_imgs_L": [Runs(tmp_path / "ran")]})
    with pytest.raises(UnknownFormatError, match="neither array nor container"):
        open_images(course)
    assert not (tmp_path / "ran").exists()


def test_an_unknown_source_says_what_is_there(tmp_path):
    (tmp_path / "sequences").mkdir()
    with pytest.raises(UnknownFormatError, match="it is a directory with sequences"):
        open_sequence(tmp_path)
    (tmp_path / "06.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3, encoding="utf-8")
    with pytest.raises(UnknownFormatError, match="holds poses alone, which --truth"):
        open_sequence(tmp_path / "06.txt")


def test_truth_is_attached_from_a_name(tmp_path):
    (tmp_path / "06.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3, encoding="utf-8")
    sequence = open_sequence("builtin:city?frames=3")
    assert len(attach_truth(sequence, str(tmp_path / "06.txt")).truth.frame) == 3
