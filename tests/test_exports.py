"""What other programs read: every export is read back by a reader of its own, and holds what the result holds."""

from __future__ import annotations

import io
import shutil
import sys

import h5py
import numpy as np
import pytest
import scipy.sparse as sp
from scipy.spatial.transform import Rotation
from support.bags import stereo, write
from support.same import assert_same

import ekfslam
from ekfslam.cli import main
from ekfslam.config import Config
from ekfslam.data.readers import read_sequence, write_sequence
from ekfslam.data.readers.messages import message_types
from ekfslam.data.simulate import builtin
from ekfslam.errors import ArchiveError, MissingPackageError, PosteriorError, ShapeError
from ekfslam.files import write_all
from ekfslam.geometry import se3
from ekfslam.runner import run
from ekfslam.smoother.posterior import posterior, smooth
from ekfslam.storage import tables
from ekfslam.storage.archive import open_result, read_archive, write_archive
from ekfslam.storage.exports import (
    EXPORTS,
    contents,
    csv_text,
    g2o_text,
    information_bytes,
    is_export,
    ply_bytes,
    trajectory_of,
)


@pytest.fixture(scope="module")
def world():
    return builtin("city?frames=30")


@pytest.fixture(scope="module")
def full(world):
    return run(world, "full")


@pytest.fixture(scope="module")
def archive(world, full, tmp_path_factory):
    path = tmp_path_factory.mktemp("exports") / "city.h5"
    write_archive(path, world, {"full": full})
    return path


@pytest.mark.parametrize("name", sorted(set(EXPORTS) - {"bag", "euroc"}))
def test_a_written_export_is_known_again_and_another_file_is_not(full, tmp_path, name):
    path = tmp_path / "out"
    if EXPORTS[name].poses is None:
        found = contents(full, path, name)
    else:
        found = contents(trajectory_of(full), path, name, "body")
    write_all(found)
    assert is_export(path, name)
    path.write_text("mine\n")
    assert not is_export(path, name)


@pytest.mark.parametrize("table", [name for name in tables.TABLES if name != "inertial"])
def test_pandas_reads_every_table_bit_for_bit(full, table):
    pandas = pytest.importorskip("pandas")
    read = pandas.read_csv(io.StringIO(csv_text(full, table)))
    frame = full.to_dataframe(table)
    assert len(read) > 20 and list(read.columns) == list(frame.columns)
    for name, values in tables.columns(full, table).items():
        np.testing.assert_array_equal(read[name].to_numpy(), values, err_msg=name)
        np.testing.assert_array_equal(frame[name].to_numpy(), values, err_msg=name)


def test_tables_hold_what_the_result_holds(full):
    found = tables.columns(full, "trajectory")
    T = full.T_world_imu[7]
    P = T[:3, :3] @ full.covariance[7, :3, :3] @ T[:3, :3].T
    np.testing.assert_allclose([found[f"cov_{name}_m2"][7] for name in ("xx", "xy", "zz")], [P[0, 0], P[0, 1], P[2, 2]])
    quaternion = [found[name][7] for name in ("qx", "qy", "qz", "qw")]
    np.testing.assert_allclose(Rotation.from_quat(quaternion).as_matrix(), T[:3, :3], atol=1e-12)
    assert set(tables.columns(full, "rejections")["reason"]) <= {"gate", "disparity", "moving", "waiting"}
    with pytest.raises(ArchiveError, match="no table 'poses'; known: trajectory, landmarks"):
        full.to_dataframe("poses")


@pytest.mark.parametrize("group", ["trajectory", "landmarks", "innovation", "rejections", "timing"])
def test_to_xarray_is_what_xarray_reads_of_the_archive(archive, full, group):
    xarray = pytest.importorskip("xarray")
    read = xarray.open_dataset(archive, group=f"runs/full/{group}", engine="h5netcdf").load()
    xarray.testing.assert_equal(full.to_xarray(group), read)
    assert set(full.to_xarray(group).coords) == set(read.coords)


def test_a_missing_package_is_named_with_what_installs_it(full, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingPackageError, match=r"to_dataframe needs the package pandas.*ekfslam\[paper\]"):
        full.to_dataframe()


def read_ply(content: bytes) -> np.ndarray:
    head, _, body = content.partition(b"end_header\n")
    lines = head.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    kinds = {"double": "<f8", "int": "<i4", "uchar": "u1"}
    fields = [(line.split()[2], kinds[line.split()[1]]) for line in lines if line.startswith("property")]
    return np.frombuffer(body, np.dtype(fields), count)


def test_ply_holds_the_map_and_its_covariances(full):
    vertex, landmarks = read_ply(ply_bytes(full)), full.landmarks
    assert len(vertex) == len(landmarks) > 50
    np.testing.assert_array_equal(np.stack([vertex[axis] for axis in "xyz"], axis=-1), landmarks.position_m)
    np.testing.assert_array_equal(vertex["id"], landmarks.id)
    np.testing.assert_array_equal(vertex["cov_xy"], landmarks.covariance[:, 0, 1])
    largest = np.linalg.eigvalsh(landmarks.covariance)[:, -1]
    assert vertex["red"][largest.argmax()] > vertex["red"][largest.argmin()]


def read_g2o(text: str) -> dict[str, np.ndarray]:
    found: dict[str, list[list[float]]] = {}
    for line in text.splitlines():
        tag, *values = line.split()
        if tag != "#":
            found.setdefault(tag, []).append([float(value) for value in values])
    return {tag: np.array(rows) for tag, rows in found.items()}


def transforms(rows: np.ndarray) -> np.ndarray:
    T = np.broadcast_to(np.eye(4), (len(rows), 4, 4)).copy()
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_quat(rows[:, 3:7]).as_matrix(), rows[:, :3]
    return T


def squares(error: np.ndarray, upper: np.ndarray) -> np.ndarray:
    n = error.shape[1]
    information = np.zeros((len(error), n, n))
    i, j = np.triu_indices(n)
    information[:, i, j] = information[:, j, i] = upper
    return np.einsum("ki,kij,kj->k", error, information, error)


def test_errors_of_the_g2o_graph_at_the_truth_are_what_their_information_says(world, full):
    """As g2o defines its errors: of a step 6 degrees of freedom each, of a view 3."""
    graph = read_g2o(g2o_text(full))
    frames = len(full.time_s)
    np.testing.assert_allclose(transforms(graph["VERTEX_SE3:QUAT"][:, 1:]), full.T_world_imu, atol=1e-12)
    np.testing.assert_array_equal(graph["VERTEX_TRACKXYZ"][:, 1:], full.landmarks.position_m)
    T = world.truth.T_world_imu
    edges = graph["EDGE_SE3:QUAT"]
    i, j = edges[:, :2].astype(int).T
    E = se3.inverse(transforms(edges[:, 2:9])) @ se3.inverse(T[i]) @ T[j]
    quaternion = Rotation.from_matrix(E[:, :3, :3]).as_quat()
    quaternion *= np.sign(quaternion[:, 3:])
    step = squares(np.hstack([E[:, :3, 3], quaternion[:, :3]]), edges[:, 9:])
    assert len(step) == frames - 1
    assert abs(step.mean() - 6.0) < 4.0 * np.sqrt(12.0 / len(step))
    offset = transforms(graph["PARAMS_SE3OFFSET"][:, 1:])[0]
    views = graph["EDGE_SE3_TRACKXYZ"]
    k, at = views[:, 0].astype(int), views[:, 1].astype(int) - frames
    m = world.truth.position_m[np.searchsorted(world.truth.landmark, full.landmarks.id[at])]
    error = se3.apply(se3.inverse(T[k] @ offset), m) - views[:, 3:6]
    near = views[:, 3] < 25.0  # triangulation of far points is not linear
    view = squares(error[near], views[near, 6:])
    assert len(view) > 400
    assert abs(np.median(view) - 2.37) < 0.4


@pytest.mark.slow
def test_gtsam_reads_the_graph(full, tmp_path):
    gtsam = pytest.importorskip("gtsam")
    (tmp_path / "city.g2o").write_text(g2o_text(full))
    graph, values = gtsam.readG2o(str(tmp_path / "city.g2o"), True)
    assert graph.size() >= len(full.time_s) - 1
    for k in (0, 11, len(full.time_s) - 1):
        np.testing.assert_allclose(values.atPose3(k).matrix(), full.T_world_imu[k], atol=1e-9)


@pytest.mark.parametrize(("prior", "linearisation"), [("known", "filtered"), ("some", "map")])
def test_the_inverse_of_the_information_matrix_is_the_joint_covariance(prior, linearisation):
    settings = {"posterior": {"linearisation": linearisation}}
    settings["calibration"] = {"lever_arm_m": 0.01}
    settings["filter"] = {"variant": "standard", "landmark_coordinates": "xyz"}
    if prior == "some":
        settings["filter"] |= {"initial_position_std_m": 0.1, "initial_rotation_std_rad": 0.05}
    result = run(builtin("city?frames=12"), "full", Config().with_overrides(settings))
    found = posterior(result)
    read = np.load(io.BytesIO(information_bytes(result, found)))
    matrix = sp.load_npz(io.BytesIO(information_bytes(result, found)))
    assert sp.issparse(matrix) and matrix.nnz < 0.5 * matrix.shape[0] ** 2
    kind = read["kind"].astype(str)
    assert {"pose", "landmark", "calibration"} == set(kind) and len(kind) == matrix.shape[0]
    assert set(read["frame"][kind == "pose"]) == set(range(0 if prior == "some" else 1, 12))
    assert (read["frame"][kind != "pose"] == -1).all() and (read["id"][kind != "landmark"] == -1).all()
    np.testing.assert_array_equal(read["id"][kind == "landmark"], np.repeat(found.id, 3))
    frames = np.unique(read["frame"][kind == "pose"])
    wanted = found.joint_covariance(frames, np.arange(len(found.id)))
    own = np.flatnonzero(kind != "calibration")
    P = np.linalg.inv(matrix.toarray())[np.ix_(own, own)]
    std = np.sqrt(np.diag(wanted))
    np.testing.assert_allclose(P / np.outer(std, std), wanted / np.outer(std, std), atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize(
    "format",
    [name if name == "tum" else pytest.param(name, marks=pytest.mark.slow) for name in EXPORTS if name != "euroc"],
)
def test_every_format_is_written_by_the_command_line_and_replaced_only_by_its_like(archive, tmp_path, capsys, format):
    out = tmp_path / f"out.{EXPORTS[format].ending}"
    call = ["export", str(archive), "--format", format, "--out", str(out)]
    assert main(call) == 0 and main(call) == 0
    assert out.stat().st_size > 1000 and f"written to {out}" in capsys.readouterr().out
    out.write_text("something else\n")
    assert main(call) == 2
    assert "not an earlier result of this command" in capsys.readouterr().err


def test_what_has_no_log_has_no_graph(world, archive, capsys):
    dead = run(world, "dead-reckoning")
    with pytest.raises(ArchiveError, match="no log, hence no edges"):
        g2o_text(dead)
    with pytest.raises(PosteriorError, match="has no log"):
        information_bytes(dead)
    assert main(["export", str(archive), "--format", "ply", "--mode", "truth"]) == 2
    assert "the truth is written as tum, kitti or bag" in capsys.readouterr().err


def test_covariances_of_poses_are_beside_them_with_the_same_stamps_and_21_columns(full, tmp_path):
    full.export(tmp_path / "poses.txt", "tum")
    rows, beside = np.loadtxt(tmp_path / "poses.txt"), np.loadtxt(tmp_path / "poses.cov.txt")
    assert rows.shape == (30, 8) and beside.shape == (30, 22)
    np.testing.assert_array_equal(rows[:, 0], beside[:, 0])
    read = ekfslam.read_trajectory(tmp_path / "poses.txt")
    np.testing.assert_array_equal(read.time_s, full.time_s)
    np.testing.assert_allclose(read.covariance[:, :3, :3], full.position_covariance_world, rtol=1e-9, atol=1e-18)
    np.testing.assert_allclose(read.covariance[:, 3:, 3:], full.rotation_covariance_world, rtol=1e-9, atol=1e-18)
    np.testing.assert_array_equal(read.covariance, np.swapaxes(read.covariance, 1, 2))


def test_covariance_of_the_camera_is_that_of_its_errors_drawn_from_those_of_the_body(full, tmp_path):
    rng, k = np.random.default_rng(3), 20
    full.export(tmp_path / "camera.txt", "tum", frame="camera")
    read = ekfslam.read_trajectory(tmp_path / "camera.txt", frame="camera")
    T_imu_cam, small = se3.inverse(full.T_cam_imu), 1e-3
    xi = small * rng.multivariate_normal(np.zeros(6), full.covariance[k], 20_000)
    true = se3.inverse(se3.exp(xi) @ se3.inverse(full.T_world_imu[k])) @ T_imu_cam
    T = read.T_world[k]
    turned = Rotation.from_matrix(true[:, :3, :3] @ T[:3, :3].T).as_rotvec()
    drawn = np.cov(np.hstack([true[:, :3, 3] - T[:3, 3], turned]).T) / small**2
    std = np.sqrt(np.diag(read.covariance[k]))
    np.testing.assert_allclose(drawn / np.outer(std, std), read.covariance[k] / np.outer(std, std), atol=0.05)


def test_covariances_with_other_stamps_are_a_named_error(full, tmp_path):
    full.export(tmp_path / "poses.txt", "tum")
    beside = tmp_path / "poses.cov.txt"
    beside.write_text("".join(beside.read_text().splitlines(keepends=True)[:-1]))
    with pytest.raises(ShapeError, match=r"poses\.cov\.txt: time: the stamps are not those of poses\.txt"):
        ekfslam.read_trajectory(tmp_path / "poses.txt")


@pytest.mark.parametrize(("shift", "is_same"), [(5e-4, True), (0.02, False)])
def test_rounded_stamps_of_covariances_are_those_of_the_poses(full, tmp_path, shift, is_same):
    full.export(tmp_path / "poses.txt", "tum")
    beside = tmp_path / "poses.cov.txt"
    rows = np.loadtxt(beside)
    rows[3, 0] += shift
    np.savetxt(beside, rows, fmt="%.9g")
    if is_same:
        assert ekfslam.read_trajectory(tmp_path / "poses.txt").covariance is not None
    else:
        with pytest.raises(ShapeError, match=r"in line 4, where the pose has"):
            ekfslam.read_trajectory(tmp_path / "poses.txt")


def test_the_truth_leaves_no_covariances_of_an_earlier_export_beside_it(archive, tmp_path):
    call = ["export", str(archive), "--format", "tum", "--out", str(tmp_path / "poses.txt")]
    assert main(call) == 0 and ekfslam.read_trajectory(tmp_path / "poses.txt").covariance is not None
    assert main([*call, "--mode", "truth"]) == 0
    assert ekfslam.read_trajectory(tmp_path / "poses.txt").covariance is None


def test_a_bag_of_a_result_holds_poses_and_covariances_as_ros_means_them(full, tmp_path):
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    path = tmp_path / "full.mcap"
    full.export(path, "bag")
    with rosbag2.Reader(path) as reader:
        (connection,) = reader.connections
        types = message_types(is_ros1=False)
        read = [types.deserialize_cdr(raw, connection.msgtype) for _, _, raw in reader.messages()]
    assert (connection.topic, connection.msgtype) == ("/ekfslam/odometry", "nav_msgs/msg/Odometry")
    assert len(read) == len(full.time_s) and read[7].child_frame_id == "base_link"
    stamps = [message.header.stamp for message in read]
    np.testing.assert_array_equal([10**9 * at.sec + at.nanosec for at in stamps], np.round(1e9 * full.time_s))
    assert max(at.nanosec for at in stamps) < 10**9
    position = read[7].pose.pose.position
    np.testing.assert_array_equal([position.x, position.y, position.z], full.T_world_imu[7, :3, 3])
    P = read[7].pose.covariance.reshape(6, 6)
    np.testing.assert_allclose(P[:3, :3], full.position_covariance_world[7], rtol=1e-9)
    np.testing.assert_allclose(P[3:, 3:], full.rotation_covariance_world[7], rtol=1e-9)
    assert (np.diag(read[7].twist.covariance.reshape(6, 6)) == 1e6).all()


def test_a_recorded_bag_is_not_replaced_by_an_export(archive, tmp_path, capsys):
    path = write(tmp_path, stereo(), "mcap")
    assert main(["export", str(archive), "--format", "bag", "--out", str(path)]) == 2
    assert "not an earlier result of this command" in capsys.readouterr().err


def test_a_format_without_poses_refuses_a_frame(archive, full, tmp_path, capsys):
    assert main(["export", str(archive), "--format", "ply", "--frame", "camera"]) == 2
    assert "the format ply has no frame" in capsys.readouterr().err


# Runs on inertial samples


@pytest.fixture(scope="module")
def inertial(tmp_path_factory):
    """An archive of a run on inertial samples."""
    path = tmp_path_factory.mktemp("inertial") / "room.h5"
    assert main(["run", "builtin:room?frames=25", "--out", str(path)]) == 0
    return path


def test_an_archive_of_inertial_samples_claims_no_velocities(inertial, tmp_path):
    archive = read_archive(inertial)
    assert archive.twist is None and archive.velocity_frame is None
    assert archive.interpolated.shape == (25,) and not archive.interpolated.any()
    write_archive(tmp_path / "again.h5", archive, archive.results)
    assert_same(read_archive(tmp_path / "again.h5").results["full"], archive.results["full"])
    with h5py.File(inertial) as h5file:
        assert "twist" not in h5file["sequence"] and h5file["runs/full/log/inputs"].shape[1] == 6


def test_a_recording_of_inertial_samples_is_written_without_velocities(tmp_path):
    room = builtin("room?frames=25")
    write_sequence(room, tmp_path / "room.h5")
    with h5py.File(tmp_path / "room.h5") as h5file:
        assert "twist" not in h5file["sequence"]
    again = read_sequence(tmp_path / "room.h5")
    assert again.velocities is None
    assert_same(again.inertial, room.inertial)


@pytest.mark.slow
@pytest.mark.parametrize("command", ["posterior", "plot", "check", "report", "info"])
def test_commands_take_archives_of_inertial_samples(inertial, tmp_path, command):
    path = shutil.copy(inertial, tmp_path / "room.h5")
    assert main([command, str(path)]) == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(EXPORTS) - {"g2o"}))
def test_runs_on_inertial_samples_are_exported(inertial, tmp_path, name):
    assert main(["export", str(inertial), "--format", name, "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out").stat().st_size > 0


def test_g2o_refuses_a_run_on_inertial_samples_in_one_line(inertial, tmp_path, capsys):
    assert main(["export", str(inertial), "--format", "g2o", "--out", str(tmp_path / "out")]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1 and "no vertices for velocity and biases; take information" in line


def test_the_posterior_of_an_archive_is_that_of_the_inertial_run(inertial):
    read = smooth(open_result(inertial, "full"))
    made = smooth(run(builtin("room?frames=25"), "full"))
    np.testing.assert_allclose(read.T_world_imu, made.T_world_imu, rtol=0, atol=1e-12)
    np.testing.assert_allclose(read.covariance, made.covariance, rtol=1e-9, atol=1e-15)
