"""True poses and velocities in text as other programs write them: headers, repeats, marks of Windows, planar robots."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.bags import FIRST_NS, STEP_NS, odometry, stereo, write
from support.recordings import FRAMES, HEADER, ece276a_fields, stamps, write_npz

from ekfslam import attach_truth, open_images, open_sequence
from ekfslam.data.readers.euroc import read_euroc
from ekfslam.data.sequence import Truth
from ekfslam.data.simulate import builtin
from ekfslam.errors import NonFiniteError, StampError, TruthError
from ekfslam.evaluation.sanity import inspect_sequence
from ekfslam.geometry import se3

NS = np.round(stamps() * 1e9).astype(np.int64)


def poses() -> np.ndarray:
    xi = np.array([2.0, -1, 0.5, 0.9, -0.4, 0.2]) + 0.1 * np.arange(FRAMES)[:, None] * np.array([1.0, 0, 2, 1, -2, 0.5])
    return se3.exp(xi)


def columns(T: np.ndarray) -> dict[str, np.ndarray]:
    names = dict(zip(("x", "y", "z"), T[:, :3, 3].T, strict=True))
    quaternion = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    return {**names, **dict(zip(("qx", "qy", "qz", "qw"), quaternion.T, strict=True))}


def text(header: str, order: str, stamp: str = "s", separator: str = ",", further: int = 0) -> str:
    """Lines of some columns in an order, with a header and further columns of 7."""
    found = columns(poses())
    lines = [header] if header else []
    for k in range(FRAMES):
        time = str(NS[k]) if stamp == "ns" else f"{stamps()[k]:.9f}"
        values = [repr(float(found[name][k])) for name in order.split()]
        lines.append(separator.join([time, *values, *["7"] * further]))
    return "\n".join(lines) + "\n"


POSE, W_FIRST = "x y z qx qy qz qw", "x y z qw qx qy qz"
FILES = {
    "euroc": text(HEADER, W_FIRST, "ns", further=9),
    "euroc without mark": text(HEADER.lstrip("#"), W_FIRST, "ns", further=9),
    "euroc in another order": text(
        HEADER.replace("q_RS_w [], q_RS_x", "q_RS_x [], q_RS_w"), "x y z qx qw qy qz", "ns", further=9
    ),
    "openvins truth": text("#time(ns),px,py,pz,qw,qx,qy,qz,vx,vy,vz,bwx,bwy,bwz,bax,bay,baz", W_FIRST, "ns", further=9),
    "openvins estimate": text(
        "# timestamp(s) tx ty tz qx qy qz qw Pr11 Pr12 Pr13 Pr22 Pr23 Pr33 Pt11 Pt12 Pt13 Pt22 Pt23 Pt33",
        POSE, separator=" ", further=12,
    ),
    "tum": text("# timestamp tx ty tz qx qy qz qw", POSE, separator=" "),
    "tum with w first": text("# timestamp tx ty tz qw qx qy qz", W_FIRST, separator=" "),
    "tum with a covariance": text("", POSE, separator=" ", further=36),
    "tum with a triangle": text("", POSE, separator=" ", further=21),
    "header without mark": text("timestamp tx ty tz qx qy qz qw", POSE, separator=" "),
    "csv": text("timestamp,x,y,z,qx,qy,qz,qw", POSE),
    "csv of ours": text("time_s,x_m,y_m,z_m,qx,qy,qz,qw,cov_xx_m2", POSE, further=1),
    "csv of ros": text(
        "%time,field.pose.pose.position.x,field.pose.pose.position.y,field.pose.pose.position.z,"
        "field.pose.pose.orientation.x,field.pose.pose.orientation.y,field.pose.pose.orientation.z,"
        "field.pose.pose.orientation.w,field.other",
        POSE, "ns", further=1,
    ),
    "semicolons": text("time;x;y;z;qx;qy;qz;qw", POSE, separator=";"),
    "semicolons and decimal commas": text("time;x;y;z;qx;qy;qz;qw", POSE, separator=";").replace(".", ","),
    "quaternion first": text("time,qw,qx,qy,qz,px,py,pz", "qw qx qy qz x y z"),
}  # fmt: skip


@pytest.fixture
def npz(tmp_path) -> Path:
    return write_npz(tmp_path / "0099.npz", ece276a_fields())


@pytest.mark.parametrize("name", list(FILES))
@pytest.mark.parametrize("ends", ["\n", "\r\n", "BOM"])
def test_columns_are_those_that_the_header_names(npz, tmp_path, name, ends):
    path = tmp_path / "truth.txt"
    content = FILES[name].replace("\n", "\r\n" if ends != "\n" else "\n").encode()
    path.write_bytes(b"\xef\xbb\xbf" + content if ends == "BOM" else content)
    truth = open_sequence(npz, truth=path).truth
    np.testing.assert_array_equal(truth.frame, np.arange(FRAMES))
    np.testing.assert_allclose(truth.T_world_imu, poses(), atol=1e-9)


def test_repeated_lines_are_left_out_and_counted(npz, tmp_path):
    path = tmp_path / "truth.txt"
    first, *lines = FILES["tum"].splitlines()
    path.write_text("\n".join([first, *lines[:3], lines[2], lines[2], *lines[3:]]))
    sequence = open_sequence(npz, truth=path)
    np.testing.assert_allclose(sequence.truth.T_world_imu, poses(), atol=1e-9)
    assert "2 lines of truth.txt repeat their predecessor and are left out." in sequence.notes
    other = lines[2].replace(" ", " 1", 1)
    path.write_text("\n".join([first, *lines[:3], other, *lines[3:]]))
    with pytest.raises(StampError, match=r"truth\.txt: line\[5\]: the stamp does not increase"):
        open_sequence(npz, truth=path)


@pytest.mark.parametrize("kind", ["imu", "camera"])
def test_poses_of_kitti_360_belong_to_the_images_that_they_number(npz, tmp_path, kind):
    sequence, path = open_sequence(npz), tmp_path / "poses.txt"
    T = poses() if kind == "imu" else poses() @ se3.inverse(sequence.T_cam_imu)
    rows = [(k + 0, pose[:3].ravel() if kind == "imu" else pose.ravel()) for k, pose in enumerate(T)]
    path.write_text("".join(f"{k} {' '.join(map(repr, row.tolist()))}\n" for k, row in rows if k != 99))
    truth = attach_truth(sequence, path).truth
    np.testing.assert_allclose(truth.T_world_imu, poses(), atol=1e-9)
    path.write_text("".join(f"{k + 0.5} {' '.join(map(repr, row.tolist()))}\n" for k, row in rows))
    with pytest.raises(TruthError, match="no increasing number of an image"):
        attach_truth(sequence, path)


def test_poses_of_another_body_are_named_without_velocities():
    world = builtin("city?frames=120")
    from ekfslam.data.sequence import WITHOUT_VELOCITIES

    still = {"twist": np.zeros((120, 6)), "attributes": {**world.attributes, **WITHOUT_VELOCITIES}}
    blind = type(world)(**{**recorded(world), **still})
    assert not blind.has_velocities and not inspect_sequence(blind).warnings
    T_camera = world.truth.T_world_imu @ se3.inverse(world.T_cam_imu)
    other = type(world)(**{**recorded(world), **still, "truth": Truth(world.truth.frame, T_camera)})
    assert any("poses of another body than the IMU" in line for line in inspect_sequence(other).warnings)


def recorded(world) -> dict:
    names = ("name", "source", "time_s", "camera", "T_cam_imu", "observations", "truth", "noise")
    return {name: getattr(world, name) for name in names}


# Velocities


@pytest.fixture
def plain(tmp_path):
    return open_sequence(write_npz(tmp_path / "v.npz", ece276a_fields()))


def with_velocities(tmp_path: Path, content: str):
    path = tmp_path / "v.txt"
    path.write_bytes(content.encode())
    return open_sequence(tmp_path / "0099.npz", velocities=path)


PLANAR: dict[str, Callable[[float], str]] = {
    "": lambda t: f"{t:.6f} 2.0 0.1",
    "t v_x w_z\n": lambda t: f"{t:.6f} 2.0 0.1",
    "# time,w_z,v_x\n": lambda t: f"{t:.6f},0.1,2.0",
    "# frame: imu\n# time [s], v_x [m/s], note, w_z [rad/s]\n": lambda t: f"{t:.6f}, 2.0, 9, 0.1",
    "time;v_x;w_z\n": lambda t: f"{t:.6f};2.0;0.1".replace(".", ","),
    "time,vx,vy,vz,wx,wy,wz\n": lambda t: f"{t:.6f},2.0,0,0,0,0,0.1",
}


@pytest.mark.parametrize("header", list(PLANAR))
def test_two_velocities_of_a_planar_robot_are_enough(npz, tmp_path, header):
    times = np.arange(stamps()[0] - 0.5, stamps()[-1] + 0.5, 0.05)
    found = with_velocities(tmp_path, header + "".join(f"{PLANAR[header](t)}\r\n" for t in times))
    np.testing.assert_allclose(found.twist, np.tile([2.0, 0, 0, 0, 0, 0.1], (FRAMES, 1)), atol=1e-12)
    assert found.measured_axes.tolist() == [True, False, False, False, False, True]


@pytest.mark.parametrize(("unit", "second"), [("milli", 1e3), ("micro", 1e6), ("nano", 1e9)])
def test_stamps_of_velocities_in_another_unit_are_named(npz, tmp_path, unit, second):
    lines = "".join(f"{int((1.7e9 + 0.05 * k) * second)} 2.0 0.1\n" for k in range(200))
    with pytest.raises(NonFiniteError, match=f"{unit}seconds"):
        with_velocities(tmp_path, lines)


def test_stamps_in_ns_may_count_from_0(npz, tmp_path):
    first = NS[0]
    content = FILES["euroc"]
    for stamp in NS:
        content = content.replace(str(stamp), str(stamp - first))
    (tmp_path / "data.csv").write_text(content)
    found = read_euroc(tmp_path / "data.csv")
    np.testing.assert_allclose(found.time_s, (NS - first) / 1e9)


def test_repeated_velocities_are_left_out_and_counted(npz, tmp_path):
    times = np.arange(stamps()[0] - 0.5, stamps()[-1] + 0.5, 0.05)
    lines = [f"{t:.6f} 2.0 0.1\n" for t in times]
    found = with_velocities(tmp_path, "".join([*lines[:4], lines[3], *lines[4:]]))
    assert "1 lines of v.txt repeat their predecessor and are left out." in found.notes


def test_poses_of_an_odometry_become_velocities_of_the_body(npz, tmp_path):
    twist = np.array([3.0, 0.2, -0.1, 0.05, -0.1, 0.4])
    times = np.arange(stamps()[0] - 0.5, stamps()[-1] + 0.5, 0.02)
    T = se3.exp(np.array([5.0, 2, 1, 0.3, 0.2, 1.0])) @ se3.exp((times - times[0])[:, None] * twist)
    rows = np.column_stack([times, T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_quat()])
    found = with_velocities(tmp_path, "".join(" ".join(f"{x:.12f}" for x in row) + "\n" for row in rows))
    np.testing.assert_allclose(found.twist, np.tile(twist, (FRAMES, 1)), atol=1e-6)
    assert any("Velocities are differences of" in note and "noise" in note for note in found.notes)


def test_an_odometry_of_a_bag_with_poses_and_no_twist_becomes_velocities(tmp_path):
    bag, twist = stereo(velocities="none"), np.array([1.0, 0, 0, 0, 0, 0.3])
    for k in range(-3, 14):
        stamp = FIRST_NS + k * STEP_NS // 2
        T = se3.exp(0.5e-9 * STEP_NS * k * twist)
        bag.add("/odom", "nav_msgs/msg/Odometry", stamp, odometry(stamp, np.zeros(6), pose=T))
    found = open_images(write(tmp_path, bag))
    np.testing.assert_allclose(found.twist, np.tile(twist, (len(found), 1)), atol=1e-5)
    assert any("The twist of /odom is 0. Velocities are differences of 17 poses." in note for note in found.notes)
