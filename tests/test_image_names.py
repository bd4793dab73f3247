"""Names, numbers, depths and sizes of image files as cameras and tutorials leave them."""

from __future__ import annotations

import dataclasses
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow
from support.images import FRAMES, STAMPS_NS, opened, picture, write_euroc, write_plain

from ekfslam import attach_truth, open_sequence
from ekfslam.data.images import ImageRecording
from ekfslam.data.sequence import Observations, Sequence
from ekfslam.errors import CalibrationError, EmptyTracksError, LostDataError, UnknownFormatError
from ekfslam.evaluation.sanity import inspect_sequence
from ekfslam.geometry.camera import StereoCamera


def first_values(found: ImageRecording, side: int = 0) -> list[int]:
    return [int(found.load(k)[side][0, 0]) for k in range(len(found))]


def save(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Pillow.fromarray(pixels).save(path)


def renamed(folder: Path, name: Callable[[str, int], str]) -> Path:
    """A plain pair whose files have other names: a function of side and frame."""
    for side in ("left", "right"):
        for frame in range(FRAMES):
            source = folder / side / f"{frame:04d}.png"
            target = folder / name(side, frame)
            target.parent.mkdir(parents=True, exist_ok=True)
            source.rename(target)
        if not any((folder / side).iterdir()):
            (folder / side).rmdir()
    return folder


# Names


@pytest.mark.parametrize("step", [3, 25, 400])
def test_names_without_leading_zeros_are_in_natural_order(tmp_path, step):
    found = opened(renamed(write_plain(tmp_path), lambda side, frame: f"{side}/frame{frame * step}.png"))
    assert first_values(found) == [10 * k for k in range(FRAMES)]


@pytest.mark.parametrize("names", [("left_images", "right_images"), ("L", "R"), ("Left", "Right"), ("cam_l", "cam_r")])
def test_folders_whose_names_differ_in_the_side_alone_are_a_pair(tmp_path, names):
    folder = write_plain(tmp_path)
    for side, name in zip(("left", "right"), names, strict=True):
        (folder / side).rename(folder / name)
    text = (folder / "calibration.toml").read_text()
    (folder / "calibration.toml").write_text(text.split("\n", 2)[2])
    (folder / names[0] / "._0001.png").write_bytes(b"of macOS")
    assert first_values(opened(folder)) == [10 * k for k in range(FRAMES)]
    assert first_values(opened(folder), 1) == [10 * k + 1 for k in range(FRAMES)]


def test_names_that_are_seconds_are_in_the_order_of_time(tmp_path):
    names = ["9.5", "10.25", "10.3", "10.305", "11.0", "100.0"]
    found = opened(renamed(write_plain(tmp_path), lambda side, frame: f"{side}/{names[frame]}.png"))
    assert first_values(found) == [10 * k for k in range(FRAMES)]


@pytest.mark.parametrize(
    "pattern",
    [
        "{side}/{side}_{frame:04d}.png",
        "all/{side}_{frame:04d}.png",
        "all/{frame}_{side}.png",
        "all/img{frame}-{letter}.png",
    ],
)
def test_sides_may_be_in_names_in_one_folder_or_two(tmp_path, pattern):
    def name(side: str, frame: int) -> str:
        return pattern.format(side=side, frame=frame, letter=side[0].upper())

    folder = renamed(write_plain(tmp_path), name)
    file = folder / "calibration.toml"
    if pattern.startswith("all"):
        file.write_text(re.sub(r'(?m)^(left|right) = ".*"', r'\1 = "all"', file.read_text()))
    found = opened(folder)
    assert [first_values(found, side) for side in (0, 1)] == [[10 * k + side for k in range(FRAMES)] for side in (0, 1)]


@pytest.mark.parametrize("names", [("image_l", "image_r"), ("cam0", "cam1"), (".", ".")])
def test_folders_with_usual_names_need_not_be_named(tmp_path, names):
    folder = renamed(write_plain(tmp_path), lambda side, k: f"{names[side == 'right']}/{side}_{k}.png")
    file = folder / "calibration.toml"
    file.write_text(re.sub(r'(?m)^(left|right) = ".*"\n', "", file.read_text()))
    assert first_values(opened(folder), 1) == [10 * k + 1 for k in range(FRAMES)]


def test_one_folder_without_sides_in_its_names_is_a_named_error(tmp_path):
    folder = renamed(write_plain(tmp_path), lambda side, frame: f"all/{frame + (side == 'right') * 9}.png")
    file = folder / "calibration.toml"
    file.write_text(re.sub(r'(?m)^(left|right) = ".*"', r'\1 = "all"', file.read_text()))
    with pytest.raises(UnknownFormatError, match="all: no name of an image says that it is of the left camera"):
        opened(folder)


# KITTI odometry

PROJECTION = "707.1 0 601.9 {} 0 707.1 183.1 0 0 0 1 0"


def write_kitti(place: Path, first: int = 0, names: tuple[str, str] = ("image_0", "image_1"), frames: int = 3) -> Path:
    folder = place / "06"
    for side, name in enumerate(names):
        for frame in range(first, first + frames):
            save(folder / name / f"{frame:06d}.png", picture(frame, side))
    (folder / "calib.txt").write_text(f"P0: {PROJECTION.format(0)}\nP1: {PROJECTION.format(-379.8)}\n")
    (folder / "times.txt").write_text("".join(f"{0.1 * k:.6e}\n" for k in range(20)))
    return folder


@pytest.mark.parametrize(
    ("first", "lines"), [(0, (0, 20)), (10, (0, 20)), (10, (10, 13)), (10, (10, 15)), (4, (4, 20))]
)
def test_any_run_of_images_has_its_own_lines_of_times_and_poses(tmp_path, first, lines):
    folder = write_kitti(tmp_path, first)
    (folder / "times.txt").write_text("".join(f"{0.1 * k:.6e}\n" for k in range(*lines)))
    found = opened(folder)
    np.testing.assert_allclose(found.time_s, 0.1 * np.arange(first, first + 3), atol=1e-12)
    assert first_values(found) == [10 * k for k in range(first, first + 3)]
    if first:
        assert any(f"images {first} to {first + 2}" in note for note in found.notes)
    poses = tmp_path / "poses.txt"
    for rows in ((0, 20), lines):
        poses.write_text("".join(f"1 0 0 0 0 1 0 0 0 0 1 {k}\n" for k in range(*rows)))
        true = attach_truth(as_sequence(found), poses).truth
        np.testing.assert_array_equal(true.T_world_imu[:, 0, 3], np.arange(first, first + 3))


def as_sequence(found: ImageRecording) -> Sequence:
    """A recording of tracks with the frames of one of images."""
    count = len(found)
    none = Observations(np.arange(count), np.zeros(count, np.int64), np.tile([5.0, 4.0, 3.0, 4.0], (count, 1)))
    return Sequence(
        name=found.name,
        source=found.source,
        time_s=found.time_s,
        twist=np.zeros((count, 6)),
        camera=StereoCamera(700.0, 700.0, 600.0, 180.0, 0.5),
        T_cam_imu=found.T_cam_imu,
        observations=none,
        attributes=found.attributes,
    )


def test_stamps_that_end_before_the_images_are_a_named_error(tmp_path):
    folder = write_kitti(tmp_path, 18)
    with pytest.raises(LostDataError, match=r"times\.txt: images 18 to 20, but 20 stamps"):
        opened(folder)


@pytest.mark.parametrize("names", [("image_l", "image_r"), ("image_left", "image_right"), ("left", "right")])
def test_folders_of_a_kitti_sequence_may_have_other_usual_names(tmp_path, names):
    assert first_values(opened(write_kitti(tmp_path, names=names)), 1) == [1, 11, 21]


def test_missing_parts_of_a_kitti_sequence_are_all_named(tmp_path):
    folder = write_kitti(tmp_path)
    calib = folder / "calib.txt"
    calib.write_text(calib.read_text().replace("P0: ", "").replace("P1: ", ""))
    with pytest.raises(UnknownFormatError, match=r"lacks labels in calib\.txt \(P0: and P1: .* 2 lines have none"):
        opened(folder)
    (folder / "times.txt").unlink()
    with pytest.raises(UnknownFormatError, match=r"lacks times\.txt .* and labels in calib\.txt"):
        opened(folder)
    for name in ("image_0", "image_1"):
        shutil.rmtree(folder / name)
    with pytest.raises(UnknownFormatError, match=r"lacks folders of images .*times\.txt.*labels"):
        opened(folder)


# EuRoC


def test_lines_without_an_image_are_left_out_and_counted(tmp_path):
    folder = write_euroc(tmp_path)
    for side, keep in ((0, STAMPS_NS[2:]), (1, STAMPS_NS[2:5])):
        for stamp in set(STAMPS_NS.tolist()) - set(keep.tolist()):
            (folder / f"mav0/cam{side}/data/{stamp}.png").unlink()
    save(folder / "mav0/cam1/data/7.png", picture(0, 1))
    # Of four left images, the last has no right one.
    for side in (0, 1):
        extra = "".join(f"{stamp},{stamp}.png\n" for stamp in STAMPS_NS[-1] + 50_000_000 * np.arange(1, 60))
        path = folder / f"mav0/cam{side}/data.csv"
        path.write_text(path.read_text() + extra)
        for frame, stamp in enumerate(STAMPS_NS[-1] + 50_000_000 * np.arange(1, 30)):
            save(folder / f"mav0/cam{side}/data/{stamp}.png", picture(frame % 20, side))
    found = opened(folder)
    assert len(found) == 3 + 29
    assert any(note.startswith("cam0: 32 images of data.csv are missing, the first at") for note in found.notes)
    assert any(note.startswith("cam1: 33 images of data.csv are missing") for note in found.notes)
    assert "cam1: 1 images have no line in data.csv and are left out." in found.notes


def test_repeated_and_swapped_lines_of_images_are_sorted_and_counted(tmp_path):
    folder = write_euroc(tmp_path)
    path = folder / "mav0/cam0/data.csv"
    head, *lines = path.read_text().splitlines()
    lines[1], lines[2] = lines[2], lines[1]
    path.write_text("\n".join([head, *lines, lines[0], lines[0]]))
    found = opened(folder)
    assert first_values(found) == [10 * k for k in range(FRAMES)]
    assert "cam0: 2 lines of data.csv repeat a stamp and are left out." in found.notes
    assert any("lines of data.csv are before their predecessors; all are sorted." in note for note in found.notes)


# Depths and sizes


@pytest.mark.parametrize(("largest", "bits"), [(200, 8), (1000, 10), (4095, 12), (16383, 14), (65535, 16)])
def test_16_bits_are_scaled_by_the_largest_value_of_the_sequence(tmp_path, largest, bits):
    folder = write_plain(tmp_path)
    for frame in range(FRAMES):
        for side in ("left", "right"):
            deep = np.full((8, 12), largest // 4, np.uint16)
            deep[0, 0] = largest if (frame, side) == (4, "right") else 0
            save(folder / side / f"{frame:04d}.png", deep)
    found = opened(folder)
    shift = bits - 8
    assert found.load(0)[0][1, 1] == (largest // 4) >> shift and found.load(4)[1][0, 0] == largest >> shift
    assert f"Images of 16 bits use {bits}, by the largest value in all images" in " ".join(found.notes)


def test_a_stated_depth_takes_precedence_and_saturates(tmp_path):
    folder = write_plain(tmp_path)
    for frame in range(FRAMES):
        for side in ("left", "right"):
            save(folder / side / f"{frame:04d}.png", np.full((8, 12), 1000 + 3000 * (frame == 5), np.uint16))
    file = folder / "calibration.toml"
    file.write_text("bit_depth = 10\n" + file.read_text())
    found = opened(folder)
    assert first_values(found) == [250] * 5 + [255]
    assert "Images of 16 bits use 10, as stated" in " ".join(found.notes)
    file.write_text(file.read_text().replace("bit_depth = 10", "bit_depth = 20"))
    with pytest.raises(CalibrationError, match="bit_depth: expected 8 to 16, found 20"):
        opened(folder)


@pytest.mark.parametrize("file", ["right/0000.png", "left/0003.png", "right/0005.png"])
def test_images_of_another_size_are_named_with_their_file(tmp_path, file):
    folder = write_plain(tmp_path)
    save(folder / file, np.zeros((16, 24), np.uint8))
    with pytest.raises(CalibrationError, match=rf"{file}: the image has 24 x 16 pixels, .*left/0000\.png 12 x 8"):
        opened(folder)


# Baselines


@pytest.mark.parametrize(
    ("baseline", "words"), [(120.0, "120 m: .*in mm (0.12 m)"), (0.0005, "0.5 mm: .* not in metres")]
)
def test_a_baseline_that_is_hardly_in_metres_is_named(tmp_path, baseline, words):
    folder = write_plain(tmp_path)
    file = folder / "calibration.toml"
    file.write_text(file.read_text().replace("-0.54", str(-baseline)))
    found = opened(folder)
    pattern = words.replace("(", r"\(").replace(")", r"\)")
    assert re.search(pattern, found.notes[0])
    with pytest.raises(EmptyTracksError, match=pattern):
        open_sequence(folder)
    sequence = as_sequence(opened(write_kitti(tmp_path)))
    assert not inspect_sequence(sequence).warnings
    changed = dataclasses.replace(sequence, camera=StereoCamera(700.0, 700.0, 600.0, 180.0, baseline))
    assert re.search(pattern, inspect_sequence(changed).warnings[0])
