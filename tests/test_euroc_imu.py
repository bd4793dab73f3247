"""Inertial samples of folders of EuRoC and TUM-VI, with the calibration of the unit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.images import LEFT_IN_BODY, STAMPS_NS, write_euroc
from support.imu import STEP_NS, motion, rows, write_imu0, write_lines, yaml_lines

from ekfslam import open_images
from ekfslam.data.images import ImageRecording
from ekfslam.geometry import se3

CHAIN = """cam0:
  {key}:
  - [{r0}]
  - [{r1}]
  - [{r2}]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]
  distortion_model: radtan
  intrinsics: [50.0, 50.0, 6.0, 4.0]
  resolution: [12, 8]
  timeshift_cam_imu: {shift}
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.1]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]
  distortion_model: radtan
  intrinsics: [50.0, 50.0, 6.0, 4.0]
  resolution: [12, 8]
"""
TRUTH = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
    "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], "
    "b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]"
)


@pytest.fixture
def euroc(tmp_path) -> Path:
    folder = write_euroc(tmp_path)
    write_imu0(folder / "mav0/imu0", 300, STAMPS_NS[0] - 20 * STEP_NS)
    return folder


def opened(folder: Path) -> ImageRecording:
    found = open_images(folder)
    assert found is not None and found.inertial is not None
    return found


def write_chain(folder: Path, key: str = "T_cam_imu", shift: float = 0.0) -> np.ndarray:
    """A chain of Kalibr in place of ``sensor.yaml``; return ``T_cam_imu``."""
    T_cam_imu = se3.inverse(LEFT_IN_BODY)
    stored = T_cam_imu if key == "T_cam_imu" else LEFT_IN_BODY
    lines = {f"r{i}": ", ".join(map(repr, row)) for i, row in enumerate(stored[:3].tolist())}
    (folder / "mav0/camchain-imucam-room.yaml").write_text(CHAIN.format(key=key, shift=shift, **lines))
    for side in (0, 1):
        (folder / f"mav0/cam{side}/sensor.yaml").unlink()
    return T_cam_imu


def test_samples_are_on_the_clock_of_the_images(euroc):
    found = opened(euroc)
    gyro, accel = motion(300)
    samples = found.inertial
    np.testing.assert_allclose(samples.time_s, (STAMPS_NS[0] + STEP_NS * np.arange(-20, 280)) / 1e9, rtol=0, atol=3e-7)
    np.testing.assert_allclose(np.hstack([samples.gyro_rad_s, samples.accel_m_s2]), np.hstack([gyro, accel]), atol=1e-9)
    assert samples.noise.accel == 2e-3 and samples.time_s[20] == found.time_s[0]
    np.testing.assert_allclose(found.T_cam_imu, se3.inverse(LEFT_IN_BODY), atol=1e-12)
    assert not any("no velocities" in note for note in found.notes)


def test_a_unit_that_is_not_the_body_moves_the_body(euroc):
    T_body_imu = se3.exp(np.array([0.1, 0.2, -0.3, 0.5, 0.4, -0.2]))
    lines = ["T_BS:", "  cols: 4", "  rows: 4", f"  data: {T_body_imu.ravel().tolist()}", *yaml_lines()]
    write_lines(euroc / "mav0/imu0/sensor.yaml", lines)
    np.testing.assert_allclose(opened(euroc).T_cam_imu, se3.inverse(LEFT_IN_BODY) @ T_body_imu, atol=1e-9)


def test_samples_without_a_file_of_densities_have_none(euroc):
    (euroc / "mav0/imu0/sensor.yaml").unlink()
    found = opened(euroc)
    assert found.inertial.noise is None
    assert "Noise densities of the inertial unit are not stated." in found.notes


def test_densities_of_tum_vi_are_beside_the_calibration_of_kalibr(euroc):
    (euroc / "mav0/imu0/sensor.yaml").unlink()
    lines = ["rostopic: /imu0", "update_rate: 200.0", *yaml_lines(gyroscope_noise_density=1.6e-4)]
    write_lines(euroc / "dso/imu_config.yaml", lines)
    assert opened(euroc).inertial.noise.gyro == 1.6e-4


@pytest.mark.parametrize("key", ["T_cam_imu", "T_imu_cam"])
def test_a_chain_of_kalibr_is_read_in_both_directions(euroc, key):
    T_cam_imu = write_chain(euroc, key)
    found = opened(euroc)
    np.testing.assert_allclose(found.T_cam_imu, T_cam_imu, atol=1e-9)
    np.testing.assert_allclose(found.calibration.T_right_left[:3, 3], [-0.1, 0, 0], atol=1e-9)
    inverted = "camchain-imucam-room.yaml states cam0.T_imu_cam: it is inverted."
    assert (inverted in found.notes) == (key == "T_imu_cam")


def test_a_time_shift_of_kalibr_is_applied(euroc):
    """``t_imu = t_cam + shift``."""
    before = opened(euroc).inertial.time_s
    write_chain(euroc, shift=0.0125)
    found = opened(euroc)
    np.testing.assert_allclose(found.inertial.time_s, before - 0.0125, rtol=0, atol=3e-7)
    assert any("+0.012500 s against the images" in note for note in found.notes)


def test_images_that_are_missing_give_a_note(euroc):
    for side, frame in ((0, 1), (1, 1), (1, 4)):
        (euroc / f"mav0/cam{side}/data/{STAMPS_NS[frame]}.png").unlink()
    found = opened(euroc)
    np.testing.assert_allclose(found.time_s, np.delete(STAMPS_NS, [1, 4]) / 1e9, rtol=0, atol=3e-7)
    assert f"cam1: 2 images of data.csv are missing, the first at {STAMPS_NS[1]} ns." in found.notes
    assert not any("without a partner" in note for note in found.notes)


def test_images_after_the_last_sample_are_left_out(euroc):
    gyro, accel = motion(300)
    end = int((STAMPS_NS[3] - STAMPS_NS[0]) // STEP_NS) + 21
    time_ns = STAMPS_NS[0] + STEP_NS * np.arange(-20, 280)
    write_lines(euroc / "mav0/imu0/data.csv", rows(time_ns[:end], gyro[:end], accel[:end]))
    found = opened(euroc)
    assert len(found) == 4 and any("2 frames before or after" in note for note in found.notes)
    np.testing.assert_array_equal(found.load(3)[0], opened(euroc).load(3)[0])


def test_truth_has_velocities_and_biases(euroc):
    columns = np.random.default_rng(0).normal(size=(len(STAMPS_NS), 16))
    columns[:, 3:7] = [1.0, 0, 0, 0]
    time_ns = np.array(STAMPS_NS)
    write_lines(euroc / "mav0/state_groundtruth_estimate0/data.csv", [TRUTH, *rows(time_ns, columns)])
    found = opened(euroc).truth
    np.testing.assert_allclose(found.motion.velocity_m_s, columns[:, 7:10])
    np.testing.assert_allclose(found.motion.gyro_bias_rad_s, columns[:, 10:13])
    np.testing.assert_allclose(found.motion.accel_bias_m_s2, columns[:, 13:])
