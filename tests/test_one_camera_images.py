"""Images of one camera: read from folders, undistorted, and tracked."""

import shutil
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.images import (
    LEFT_IN_BODY,
    STAMPS_NS,
    TOML,
    picture,
    write_euroc,
    write_picture,
    write_plain,
    write_raw_images,
)
from support.kitti_raw import write_drive
from support.rendered import drive, recording

import ekfslam
from ekfslam.data.images import Image, LensCalibration
from ekfslam.data.opening import open_images
from ekfslam.errors import CalibrationError, EmptyTracksError, ScaleError, UnknownFormatError
from ekfslam.frontend.track import track
from ekfslam.geometry import se3


@cache
def filmed(distorted=True, frames=6):
    return recording(frames, distorted, np.zeros(3)).of_left_camera


@cache
def tracked(distorted=True):
    return track(filmed(distorted))


@pytest.mark.parametrize("distorted", [False, True])
def test_tracks_of_one_camera_see_points_that_rest(distorted):
    sequence, report = tracked(distorted)
    o, camera = sequence.observations, sequence.camera
    assert camera.is_monocular and report.observations > 300
    W = sequence.T_cam_imu @ se3.inverse(sequence.truth.T_world_imu)
    rays = np.column_stack(
        [(o.pixels_px - [camera.cu_px, camera.cv_px]) / [camera.fu_px, camera.fv_px], np.ones(len(o))]
    )
    wrong = []
    for landmark in o.ids:
        at = np.flatnonzero(o.landmark == landmark)
        if len(at) == len(sequence):
            # x_k ~ R_k m + t_k: two rows of a view, linear in the point m.
            views, x = W[o.frame[at]], rays[at]
            A = x[:, :2, None] * views[:, None, 2, :3] - views[:, :2, :3]
            b = views[:, :2, 3] - x[:, :2] * views[:, 2:3, 3]
            m = np.linalg.lstsq(A.reshape(-1, 3), b.ravel(), rcond=None)[0]
            q = se3.apply(views, np.tile(m, (len(at), 1)))
            wrong.append(np.abs(q[:, :2] / q[:, 2:] - x[:, :2]).max() * camera.fu_px)
    assert len(wrong) > 20 and np.median(wrong) < 0.5 and np.mean(np.array(wrong) < 2.0) > 0.8


def test_measured_velocities_give_the_scale_of_images_of_one_camera():
    moving = replace(filmed(frames=12), twist=drive(12))
    result = ekfslam.run(track(moving)[0])
    true = moving.truth.T_world_imu[:, :3, 3]
    assert np.abs(result.T_world_imu[-1, :3, 3] - true[-1]).max() < 0.02 * np.linalg.norm(true[-1] - true[0])


def test_images_of_one_camera_alone_do_not_tell_the_scale():
    with pytest.raises(ScaleError, match="--imu"):
        ekfslam.run(tracked()[0])


def test_the_scale_is_missed_before_the_images_are_tracked(tmp_path):
    folder = write_plain(tmp_path)
    (folder / "calibration.toml").write_text(ONE)
    for image in (folder / "left").glob("*.png"):
        image.write_bytes(image.read_bytes()[:50])  # its header alone: tracking would fail
    with pytest.raises(ScaleError, match="--imu"):
        ekfslam.open_sequence(folder)


def test_empty_images_of_one_camera_are_named():
    def grey(_: int) -> tuple[Image]:
        return (np.full((200, 400), 90, dtype=np.uint8),)

    with pytest.raises(EmptyTracksError, match="two frames"):
        track(replace(filmed(), load=grey))


def test_a_folder_of_euroc_with_one_camera_is_one_of_one_camera(tmp_path):
    folder = write_euroc(tmp_path)
    shutil.rmtree(folder / "mav0/cam1")
    found = open_images(folder)
    assert isinstance(found.calibration, LensCalibration) and found.calibration.K[0, 0] == 458.654
    assert found.calibration.distortion.model == "radtan"
    np.testing.assert_array_equal(found.time_s, STAMPS_NS / 1e9)
    np.testing.assert_allclose(found.T_cam_imu, np.linalg.inv(LEFT_IN_BODY))
    (image,) = found.load(3)
    np.testing.assert_array_equal(image, picture(3, 0))


ONE = "\n".join(line for line in TOML.splitlines() if "right" not in line and "708" not in line)


def test_a_plain_folder_of_one_camera_is_read(tmp_path):
    folder = write_plain(tmp_path)
    (folder / "calibration.toml").write_text(ONE)
    found = open_images(folder)
    (image,) = found.load(2)
    assert isinstance(found.calibration, LensCalibration) and found.calibration.K[1, 1] == 706.0
    np.testing.assert_array_equal(image, picture(2, 0))


def test_a_plain_folder_of_one_camera_without_images_is_named(tmp_path):
    folder = write_plain(tmp_path)
    (folder / "calibration.toml").write_text(ONE)
    shutil.rmtree(folder / "left")
    (folder / "left").mkdir()
    with pytest.raises(UnknownFormatError, match="no images"):
        open_images(folder)


@pytest.mark.parametrize("write", [write_euroc, write_plain])
def test_the_left_camera_of_a_pair_is_tracked_alone(tmp_path, write):
    found = open_images(write(tmp_path)).of_left_camera
    (image,) = found.load(4)
    np.testing.assert_array_equal(image, picture(4, 0))
    assert "left camera alone" in found.notes[-1] and found.of_left_camera is found


@pytest.mark.parametrize("K", [np.zeros((3, 3)), np.diag([400.0, -400.0, 1.0])])
def test_an_impossible_lens_is_refused(K):
    with pytest.raises(CalibrationError, match="K"):
        LensCalibration(K, (640, 480))


@pytest.mark.parametrize("number", [0, 1, 2, 3])
def test_a_folder_of_kitti_odometry_of_one_camera_is_read(tmp_path, number):
    for frame in range(3, 6):
        write_picture(tmp_path / f"image_{number}/{frame:06d}.png", frame, 0)
    P = [f"P{i}: {700 + i} 0 6 {-380.0 * i} 0 {700 + i} 4 0 0 0 1 0" for i in range(4)]
    (tmp_path / "calib.txt").write_text("\n".join(P))
    np.savetxt(tmp_path / "times.txt", 0.1 * np.arange(9))
    found = open_images(tmp_path)
    assert found.calibration.K[0, 0] == 700 + number and found.attributes["images"] == f"image_{number}"
    assert f"There is one camera: image_{number}." in found.notes and len(found) == 3
    np.testing.assert_array_equal(found.load(1)[0], picture(4, 0))


@pytest.mark.parametrize("side", [0, 1])
def test_a_drive_of_kitti_raw_of_one_camera_is_read(tmp_path, side):
    drive = write_raw_images(write_drive(tmp_path))
    both = open_images(drive)
    shutil.rmtree(drive / f"image_0{1 - side}")
    found = open_images(drive)
    assert isinstance(found.calibration, LensCalibration) and found.twist is not None
    T = np.linalg.matrix_power(both.calibration.T_right_left, side) @ both.T_cam_imu
    np.testing.assert_allclose(found.T_cam_imu, T, atol=1e-12)
    np.testing.assert_array_equal(found.load(2)[0], picture(2, side))
