"""Calibrations of a pair in the files of Kalibr, OpenVINS, ROS, OpenCV and ORB-SLAM, read back as one known rig."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.images import FRAMES, TOML, picture, write_euroc, write_picture

from ekfslam import open_images
from ekfslam.data.readers.calibrations import read_pair, shift_of
from ekfslam.data.readers.yaml import read_yaml
from ekfslam.errors import CalibrationError, DataError, ExtrinsicsError, NonFiniteError, UnknownFormatError
from ekfslam.geometry import se3

T_CAM_IMU = se3.exp(np.array([0.1, -0.2, 0.3, 0.4, 1.5, -0.2]))
T_RIGHT_LEFT = se3.exp(np.array([-0.11, 0.001, 0.002, 0.01, -0.02, 0.005]))
D, FISHEYE = (-0.28, 0.07, 0.0002, 1.8e-05), (0.0034, 0.0007, -0.002, 0.0002)
RATIONAL = (0.1, -0.2, 0.001, 0.002, 0.03, 0.04, 0.05, 0.06)
LEFT, RIGHT = (458.654, 457.296, 367.215, 248.375), (457.587, 456.134, 379.999, 255.238)
SIZE = (752, 480)


def numbers(values: object) -> str:
    return ", ".join(repr(float(value)) for value in np.ravel(values))


def rows(T: np.ndarray, indent: str = "  ") -> str:
    return "".join(f"{indent}- [{numbers(row)}]\n" for row in T)


def K(intrinsics: tuple[float, ...]) -> np.ndarray:
    fu, fv, cu, cv = intrinsics
    return np.array([[fu, 0, cu], [0, fv, cv], [0, 0, 1.0]])


def chain(poses: dict[int, str], model: str = "radtan", coefficients: tuple[float, ...] = D) -> str:
    text = "%YAML:1.0 # as OpenCV wants it\n\n"
    for side, intrinsics in enumerate((LEFT, RIGHT)):
        text += f"cam{side}:\n{poses[side]}  cam_overlaps: [{1 - side}]\n  camera_model: pinhole\n"
        text += f"  distortion_coeffs: [{numbers(coefficients)}]\n  distortion_model: {model}\n"
        text += f"  intrinsics: [{numbers(intrinsics)}] #fu, fv, cu, cv\n  resolution: [{SIZE[0]}, {SIZE[1]}]\n"
        text += f"  rostopic: /cam{side}/image_raw\n  timeshift_cam_imu: 0.005\n"
    return text


RIGHT_IMU = T_RIGHT_LEFT @ T_CAM_IMU
FORWARD = {0: f"  T_cam_imu:\n{rows(T_CAM_IMU)}", 1: f"  T_cam_imu:\n{rows(RIGHT_IMU)}"}
INVERTED = {
    side: f"  T_imu_cam: #rotation from camera to IMU R_CtoI\n{rows(se3.inverse(T), '    ')}"
    for side, T in enumerate((T_CAM_IMU, RIGHT_IMU))
}
RELATIVE = {0: "", 1: f"  T_cn_cnm1:\n{rows(T_RIGHT_LEFT)}"}
BOTH = {0: FORWARD[0], 1: RELATIVE[1]}


def check(path: Path, has_body: bool = True, model: str = "radtan", coefficients: tuple[float, ...] = D) -> None:
    found = read_pair(path)
    pair = found.pair(SIZE)
    np.testing.assert_allclose(pair.T_right_left, T_RIGHT_LEFT, atol=1e-9)
    np.testing.assert_allclose(pair.K_left, K(LEFT), rtol=1e-12)
    np.testing.assert_allclose(pair.K_right, K(RIGHT), rtol=1e-12)
    for lens in (pair.distortion_left, pair.distortion_right):
        assert lens.model == model
        np.testing.assert_allclose(lens.coefficients, coefficients, atol=1e-12)
    if has_body:
        np.testing.assert_allclose(found.T_cam_imu, T_CAM_IMU, atol=1e-9)
    else:
        assert found.T_cam_imu is None


@pytest.mark.parametrize("poses", [FORWARD, INVERTED, RELATIVE, BOTH], ids=["cam_imu", "imu_cam", "relative", "both"])
def test_a_chain_of_kalibr_or_openvins(tmp_path, poses):
    path = tmp_path / "kalibr_imucam_chain.yaml"
    path.write_text(chain(poses))
    check(path, has_body=poses is not RELATIVE)
    assert read_pair(path).topics == ("/cam0/image_raw", "/cam1/image_raw") and read_pair(path).late_s == 0.005
    assert ("cam0.T_imu_cam: it is inverted" in " ".join(read_pair(path).notes)) == (poses is INVERTED)


@pytest.mark.parametrize("model", ["equidistant", "fisheye"])
def test_a_chain_of_fisheyes(tmp_path, model):
    (tmp_path / "c.yaml").write_text(chain(FORWARD, model, FISHEYE))
    check(tmp_path / "c.yaml", model="equidistant", coefficients=FISHEYE)


def test_the_configuration_of_openvins_leads_to_its_chain(tmp_path):
    (tmp_path / "kalibr_imucam_chain.yaml").write_text(chain(INVERTED))
    text = '%YAML:1.0\n\nuse_stereo: true\nrelative_config_imu: "kalibr_imu_chain.yaml"\n'
    (tmp_path / "estimator_config.yaml").write_text(text + 'relative_config_imucam: "kalibr_imucam_chain.yaml"\n')
    check(tmp_path / "estimator_config.yaml")


@pytest.mark.parametrize(
    "name",
    ["camchain.yaml", "camchain-imucam.yaml", "camchain-rig_2024.yaml", "kalibr_imucam_chain.yaml", "my-camchain.yml"],
)
@pytest.mark.parametrize("place", ["mav0", "dso", "."])
def test_a_chain_in_a_euroc_folder_is_found_under_any_usual_name(tmp_path, name, place):
    folder = write_euroc(tmp_path)
    for side in (0, 1):
        (folder / f"mav0/cam{side}/sensor.yaml").unlink()
    (folder / place).mkdir(exist_ok=True)
    (folder / place / name).write_text(chain(INVERTED).replace("[752, 480]", "[12, 8]"))
    found = open_images(folder)
    np.testing.assert_allclose(found.T_cam_imu, T_CAM_IMU, atol=1e-9)
    np.testing.assert_allclose(found.calibration.T_right_left, T_RIGHT_LEFT, atol=1e-9)


def test_a_given_calibration_takes_precedence_in_a_euroc_folder(tmp_path):
    folder = write_euroc(tmp_path)
    (tmp_path / "c.yaml").write_text(chain(RELATIVE).replace("[752, 480]", "[12, 8]"))
    found = open_images(folder, calibration=tmp_path / "c.yaml")
    np.testing.assert_allclose(found.calibration.K_left, K(LEFT))
    assert any("c.yaml states no T_cam_imu" in note for note in found.notes)


@pytest.mark.parametrize("given", ["mav0/cam0/sensor.yaml", "mav0/cam1/sensor.yaml", "mav0", "."])
def test_sensor_files_of_euroc_serve_other_recordings(tmp_path, given):
    folder = write_euroc(tmp_path)
    found, own = read_pair(folder / given), open_images(folder)
    np.testing.assert_allclose(found.pair().T_right_left, own.calibration.T_right_left, atol=1e-12)
    np.testing.assert_allclose(found.T_cam_imu, own.T_cam_imu, atol=1e-12)
    np.testing.assert_array_equal(found.pair().K_right, own.calibration.K_right)


# ROS

R1, R2 = (se3.so3_exp(np.array(w)) for w in ([0.01, -0.02, 0.005], [-0.01, 0.01, 0.02]))


def ros(side: int, model: str, coefficients: tuple[float, ...], baseline: float = 0.11) -> str:
    P = np.hstack([K(LEFT), np.zeros((3, 1))])
    P[0, 3] = -side * LEFT[0] * baseline
    matrix = "{}:\n  rows: {}\n  cols: {}\n  data: [{}]\n"
    text = f"image_width: {SIZE[0]}\nimage_height: {SIZE[1]}\ncamera_name: narrow_stereo/{side}\n"
    text += matrix.format("camera_matrix", 3, 3, numbers(K((LEFT, RIGHT)[side])))
    text += f"distortion_model: {model}\n"
    text += matrix.format("distortion_coefficients", 1, len(coefficients), numbers(coefficients))
    text += matrix.format("rectification_matrix", 3, 3, numbers((R1, R2)[side]))
    return text + matrix.format("projection_matrix", 3, 4, numbers(P))


@pytest.mark.parametrize(
    ("model", "coefficients", "read"),
    [
        ("plumb_bob", (*D, 0.01), "radtan"),
        ("rational_polynomial", RATIONAL, "radtan"),
        ("equidistant", FISHEYE, "equidistant"),
        ("fisheye", FISHEYE, "equidistant"),
    ],
)
@pytest.mark.parametrize("given", ["left.yaml", "right.yaml", ""])
def test_left_and_right_yaml_of_ros(tmp_path, given, model, coefficients, read):
    for side, name in enumerate(("left", "right")):
        (tmp_path / f"{name}.yaml").write_text(ros(side, model, coefficients))
    pair = read_pair(tmp_path / given).pair()
    assert pair.size == SIZE and pair.distortion_right.model == read
    np.testing.assert_allclose(pair.distortion_left.coefficients, coefficients)
    np.testing.assert_allclose(pair.K_right, K(RIGHT))
    q = np.array([0.3, 0.2, 2.0])
    np.testing.assert_allclose(R1 @ q - R2 @ se3.apply(pair.T_right_left, q), [0.11, 0, 0], atol=1e-12)


def test_camera_info_in_folders_of_both_sides(tmp_path):
    for side, name in enumerate(("left", "right")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "camera_info.yaml").write_text(ros(side, "plumb_bob", D))
    for name in ("left", "right"):
        np.testing.assert_allclose(read_pair(tmp_path / name / "camera_info.yaml").pair().K_right, K(RIGHT))


def test_files_of_one_camera_serve_one_camera(tmp_path):
    (tmp_path / "ost.yaml").write_text(ros(0, "plumb_bob", D))
    text = "%YAML:1.0\n" + orb_camera("Camera1", LEFT, ("k1", "k2", "p1", "p2"), D)
    (tmp_path / "mono.yaml").write_text(f"{text}Camera.width: {SIZE[0]}\nCamera.height: {SIZE[1]}\n")
    (tmp_path / "chain.yaml").write_text(chain(FORWARD).split("cam1:")[0])
    for name in ("ost.yaml", "mono.yaml", "chain.yaml"):
        lens = read_pair(tmp_path / name, ("/camera/image_raw",)).pair()
        np.testing.assert_allclose(lens.K, K(LEFT))
        np.testing.assert_allclose(lens.distortion.coefficients, D)


def test_one_camera_of_ros_alone_is_a_named_error(tmp_path):
    (tmp_path / "left.yaml").write_text(ros(0, "plumb_bob", D))
    with pytest.raises(UnknownFormatError, match=r"left\.yaml: it has one camera, and no file beside it"):
        read_pair(tmp_path / "left.yaml")
    (tmp_path / "right.yaml").write_text(ros(0, "plumb_bob", D))
    with pytest.raises(CalibrationError, match=r"right\.yaml: projection_matrix: expected a baseline on the right"):
        read_pair(tmp_path / "left.yaml")


def test_a_projection_without_a_focal_length_states_no_baseline():
    with pytest.raises(CalibrationError, match="P2: P has no positive focal length"):
        shift_of(np.array([[0.0, 0.0, 1.0, -5.0]]), "P2")


# OpenCV and ORB-SLAM


def opencv(key: str, value: object) -> str:
    value = np.atleast_2d(value)
    text = f"{key}: !!opencv-matrix\n   rows: {value.shape[0]}\n   cols: {value.shape[1]}\n   dt: d\n"
    return text + f"   data: [ {numbers(value)} ]\n"


@pytest.mark.parametrize("letter", ["K", "M"])
@pytest.mark.parametrize("files", [1, 2])
def test_a_stereo_calibration_of_opencv(tmp_path, letter, files):
    inner = "".join(
        opencv(f"{letter}{i}", K(intrinsics)) + opencv(f"D{i}", D) for i, intrinsics in ((1, LEFT), (2, RIGHT))
    )
    outer = opencv("R", T_RIGHT_LEFT[:3, :3]) + opencv("T", T_RIGHT_LEFT[:3, 3:])
    contents = {"intrinsics.yml": inner, "extrinsics.yml": outer} if files == 2 else {"stereo.yml": inner + outer}
    for name, text in contents.items():
        (tmp_path / name).write_text(f"%YAML:1.0\n---\n{text}")
    check(tmp_path / next(iter(contents)), has_body=False)


def orb_camera(prefix: str, intrinsics: tuple[float, ...], names: tuple[str, ...], values: tuple[float, ...]) -> str:
    text = "".join(f"{prefix}.{n}: {v}\n" for n, v in zip(("fx", "fy", "cx", "cy"), intrinsics, strict=True))
    return text + "".join(f"{prefix}.{n}: {v!r}\n" for n, v in zip(names, values, strict=True))


@pytest.mark.parametrize("kind", ["PinHole", "KannalaBrandt8"])
def test_settings_of_orb_slam3_for_two_cameras(tmp_path, kind):
    is_fisheye = kind != "PinHole"
    names, values = (("k1", "k2", "k3", "k4"), FISHEYE) if is_fisheye else (("k1", "k2", "p1", "p2"), D)
    text = f'%YAML:1.0\nFile.version: "1.0"\nCamera.type: "{kind}"\n'
    text += orb_camera("Camera1", LEFT, names, values) + orb_camera("Camera2", RIGHT, names, values)
    text += f"Camera.width: {SIZE[0]}\nCamera.height: {SIZE[1]}\nCamera.fps: 20\n"
    text += opencv("Stereo.T_c1_c2", se3.inverse(T_RIGHT_LEFT)) + opencv("IMU.T_b_c1", se3.inverse(T_CAM_IMU))
    (tmp_path / "EuRoC.yaml").write_text(text)
    check(tmp_path / "EuRoC.yaml", model="equidistant" if is_fisheye else "radtan", coefficients=values)


@pytest.mark.parametrize("form", ["Camera", "Camera1"])
def test_settings_of_orb_slam_for_rectified_images(tmp_path, form):
    text = "%YAML:1.0\n" + orb_camera(form, LEFT, ("k1", "k2", "p1", "p2"), (0.0,) * 4)
    text += "Camera.width: 1241\nCamera.height: 376\n"
    text += "Camera.bf: 50.0\n" if form == "Camera" else 'Camera.type: "Rectified"\nStereo.b: 0.5\n'
    (tmp_path / "KITTI.yaml").write_text(text)
    pair = read_pair(tmp_path / "KITTI.yaml").pair()
    assert pair.is_rectified and pair.size == (1241, 376)
    np.testing.assert_allclose(pair.T_right_left[0, 3], -0.5 if form == "Camera1" else -50.0 / LEFT[0])


def test_settings_of_orb_slam2_that_rectify(tmp_path):
    text = "%YAML:1.0\n" + orb_camera("Camera", LEFT, (), ()) + "Camera.bf: 47.9\n"
    for side, intrinsics, R in (("LEFT", LEFT, R1), ("RIGHT", RIGHT, R2)):
        P = np.hstack([K(LEFT), [[-(side == "RIGHT") * 0.11 * LEFT[0]], [0.0], [0.0]]])
        text += f"{side}.height: 480\n{side}.width: 752\n"
        text += "".join(opencv(f"{side}.{n}", v) for n, v in (("D", (*D, 0)), ("K", K(intrinsics)), ("R", R), ("P", P)))
    path = tmp_path / "EuRoC.yaml"
    path.write_text(text)
    pair = read_pair(path).pair()
    q = np.array([0.3, 0.2, 2.0])
    np.testing.assert_allclose(R1 @ q - R2 @ se3.apply(pair.T_right_left, q), [0.11, 0, 0], atol=1e-12)
    np.testing.assert_allclose(pair.K_right, K(RIGHT))
    path.write_text(text.replace("data: [", "data:["))
    np.testing.assert_allclose(read_pair(path).pair().K_right, K(RIGHT))


# Folders, and what is wrong


def test_a_pair_of_folders_takes_a_calibration_of_another_program(tmp_path):
    for frame in range(FRAMES):
        for side, name in enumerate(("image_l", "image_r")):
            write_picture(tmp_path / "drive" / name / f"{frame}.png", frame, side)
    np.savetxt(tmp_path / "drive/times.txt", 0.1 * np.arange(FRAMES))
    (tmp_path / "c.yaml").write_text(chain(FORWARD).replace("[752, 480]", "[12, 8]"))
    found = open_images(tmp_path / "drive", calibration=tmp_path / "c.yaml")
    np.testing.assert_allclose(found.calibration.T_right_left, T_RIGHT_LEFT, atol=1e-9)
    np.testing.assert_allclose(found.T_cam_imu, T_CAM_IMU, atol=1e-9)
    np.testing.assert_array_equal(found.load(2)[1], picture(2, 1))
    (tmp_path / "drive/calibration.toml").write_text('times = "times.txt"\ncalibration = "../c.yaml"\n')
    np.testing.assert_allclose(open_images(tmp_path / "drive").T_cam_imu, T_CAM_IMU, atol=1e-9)


def test_calibration_toml_serves_as_a_file_too(tmp_path):
    (tmp_path / "calibration.toml").write_text(TOML)
    assert read_pair(tmp_path / "calibration.toml").pair((12, 8)).T_right_left[0, 3] == -0.54


def test_many_lines_of_one_value_are_read_in_time(tmp_path):
    path = tmp_path / "c.yaml"
    path.write_text("a:\n" + "  1.0,\n" * 400_000)
    begin = time.process_time()
    assert len(read_yaml(path).numbers("a")) == 400_000
    assert time.process_time() - begin < 5.0


WRONG: list[tuple[Callable[[str], str], type[DataError] | type[UnknownFormatError], str]] = [
    (
        lambda text: text.replace("pinhole", "omni"),
        CalibrationError,
        "cam0.camera_model: expected pinhole, found 'omni'",
    ),
    (lambda text: text.replace("radtan", "fov"), CalibrationError, "cam0.distortion_model: expected"),
    (lambda text: text.replace("T_cam_imu", "T_x"), CalibrationError, "cam1: neither T_cn_cnm1 nor T_cam_imu"),
    (lambda text: text.split("cam1:")[0], UnknownFormatError, "it has one camera"),
    (lambda text: text.replace("0.0, 0.0, 0.0, 1.0]", "0.0, 0.0, 0.5, 1.0]"), ExtrinsicsError, "not a rigid transform"),
    (
        lambda text: "hello: 3\n",
        UnknownFormatError,
        "no calibration of a pair that is known; expected a chain of Kalibr",
    ),
    (lambda text: text.replace("[458.654", "[.nan, 458.654"), CalibrationError, "cam0.intrinsics: expected numbers"),
    (lambda text: text.replace("[458.654", "[1e-320"), CalibrationError, "K_left: not an intrinsic matrix"),
    (lambda text: text.replace("[458.654", "[1e320"), NonFiniteError, "K_left"),
]


@pytest.mark.parametrize(("change", "error", "words"), WRONG, ids=range(len(WRONG)))
def test_wrong_calibrations_are_named_with_file_and_key(tmp_path, change, error, words):
    path = tmp_path / "c.yaml"
    path.write_text(change(chain(FORWARD)))
    with pytest.raises(error) as caught:
        read_pair(path).pair()
    assert words in str(caught.value) and str(path) in str(caught.value)
