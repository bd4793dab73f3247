"""Editions of the course data: conventions by reprojection, odd shapes, and pickles that ask for more than arrays."""

from __future__ import annotations

import dataclasses
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from reprojection import reprojection_errors
from support.npy import Runs, npy_fields, write_npy
from support.recordings import (
    CAMERA_IN_IMU_M,
    FRAMES,
    R_CAM_IMU,
    K,
    ece276a_fields,
    pixels,
    utias_fields,
    write_mat,
    write_npz,
)

from ekfslam import open_sequence
from ekfslam.data.observations import UNSEEN
from ekfslam.data.sequence import Sequence
from ekfslam.data.simulate import builtin
from ekfslam.errors import (
    CalibrationError,
    ConfigError,
    DataError,
    ExtrinsicsError,
    NonFiniteError,
    ShapeError,
    UnknownFormatError,
)
from ekfslam.geometry import se3
from ekfslam.limits import reading_up_to

WORLD = "loop?frames=40&sigma_px=0.5"
T_CAM_IMU = se3.transform(R_CAM_IMU, -R_CAM_IMU @ CAMERA_IN_IMU_M)


@pytest.fixture(scope="module")
def world() -> Sequence:
    return builtin(WORLD)


@pytest.fixture
def npy(tmp_path, world) -> Path:
    return write_npy(tmp_path / "dataset00.npy", npy_fields(world))


def median_error_px(read: Sequence, world: Sequence) -> float:
    return float(np.nanmedian(reprojection_errors(dataclasses.replace(read, truth=world.truth))))


def test_npy_fits_its_truth_by_reprojection(npy, world):
    read = open_sequence(npy)
    np.testing.assert_allclose(read.T_cam_imu, world.T_cam_imu, atol=1e-12)
    np.testing.assert_array_equal(read.twist, world.twist)
    assert read.camera == dataclasses.replace(world.camera, baseline_m=read.camera.baseline_m)
    assert read.camera.baseline_m == pytest.approx(world.camera.baseline_m, rel=1e-12)
    assert median_error_px(read, world) < 1.0  # of pixels with a noise of 0.5 px
    inverted = dataclasses.replace(read, T_cam_imu=se3.inverse(read.T_cam_imu))
    assert median_error_px(inverted, world) > 10.0
    assert read.attributes["reader"] == "ece276a_npy" and read.velocity_frame == "level"


@pytest.mark.parametrize("protocol", range(2, 6))
def test_npy_of_every_protocol(tmp_path, world, protocol):
    path = tmp_path / "a.npy"
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": ()})
        pickle.dump(np.array(npy_fields(world), dtype=object), file, protocol=protocol)
    np.testing.assert_array_equal(open_sequence(path).observations.pixels_px, world.observations.pixels_px)


def test_odd_shapes_of_an_npy_mean_the_same(tmp_path, world, npy):
    fields = npy_fields(world)
    fields["features"] = np.where(fields["features"] == UNSEEN, np.nan, fields["features"])
    fields["timestamps"] = fields["timestamps"][:, None]
    fields["v_t"], fields["w_t"] = fields["v_t"].T, np.asfortranarray(fields["w_t"])
    odd, plain = open_sequence(write_npy(tmp_path / "odd.npy", fields)), open_sequence(npy)
    np.testing.assert_array_equal(odd.time_s, plain.time_s)
    np.testing.assert_array_equal(odd.twist, plain.twist)
    for name in ("frame", "landmark", "pixels_px"):
        np.testing.assert_array_equal(getattr(odd.observations, name), getattr(plain.observations, name))


def without(name: str) -> Any:
    return lambda fields: fields.pop(name)


def changed(name: str, change: Any) -> Any:
    return lambda fields: fields.update({name: change(fields[name])})


@pytest.mark.parametrize(
    ("alter", "error", "field"),
    [
        (without("K_l"), ShapeError, "K_l"),
        (without("features"), ShapeError, "features"),
        (changed("features", lambda a: None), ShapeError, "features"),
        (changed("features", lambda a: a[:2]), ShapeError, "features"),
        (changed("v_t", lambda a: a[:-1]), ShapeError, "v_t"),
        (changed("w_t", lambda a: np.where(a == a[3], np.nan, a)), NonFiniteError, "w_t"),
        (changed("timestamps", lambda a: np.tile(a[:, None], 2)), ShapeError, "timestamps"),
        (changed("extL_T_imu", lambda a: 2.0 * a), ExtrinsicsError, "extL_T_imu"),
        (changed("extR_T_imu", lambda a: a[:3]), ShapeError, "extR_T_imu"),
        (changed("K_r", lambda a: a * np.array([[1.2], [1.0], [1.0]])), CalibrationError, "K_r"),
    ],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_broken_npy_names_file_and_field(tmp_path, world, alter, error, field):
    fields = npy_fields(world)
    alter(fields)
    path = write_npy(tmp_path / "broken.npy", fields)
    with pytest.raises(error) as caught:
        open_sequence(path)
    assert (caught.value.source, caught.value.field) == (str(path), field)


def test_cameras_at_one_place(tmp_path, world):
    fields = npy_fields(world)
    fields["extR_T_imu"] = fields["extL_T_imu"]
    with pytest.raises(CalibrationError, match="extR_T_imu"):
        open_sequence(write_npy(tmp_path / "a.npy", fields))


def raw_npy(path: Path, pickled: bytes) -> Path:
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": ()})
        file.write(pickled)
    return path


def test_an_npy_runs_nothing(tmp_path):
    witness = tmp_path / "ran"
    with pytest.raises(UnknownFormatError, match="system, which is neither array nor container"):
        open_sequence(write_npy(tmp_path / "a.npy", {"v_t": Runs(witness)}))
    assert not witness.exists()
    np.load(tmp_path / "a.npy", allow_pickle=True)
    assert witness.exists()  # so the file was one that runs


HOSTILE = {
    "eval": (b"cbuiltins\neval\n(V1+1\ntR.", "builtins.eval"),
    "submodule": (b"cnumpy\nload\n(V/etc/passwd\ntR.", "numpy.load"),
    "attribute by dots": (b"\x80\x04\x8c\x05numpy\x8c\x0cndarray.dump\x93.", "ndarray.dump"),
    "calls the class": (b"cnumpy\nndarray\n(I3\ntR.", "calls numpy.ndarray"),
    "changes a function": (b"cnumpy\ndtype\n}b.", "changes a function"),
    "new object": (b"\x80\x02cnumpy\nndarray\n)\x81.", "NEWOBJ"),
    "extension registry": (b"\x80\x02\x82\x01.", "EXT1"),
    "persistent": (b"P1\n.", "PERSID"),
    "memo of gigabytes": (b"\x80\x02}r\xff\xff\xff\x7f.", "a memo of 2147483647 entries"),
    "bytes of gigabytes": (b"\x80\x04\x8e\x00\x00\x00\x00\x10\x00\x00\x00abc.", "damaged"),
    "array of gigabytes": (
        b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\ntC\x01btR"
        b"(I1\n(I1000000000\ntcnumpy\ndtype\n(Vf8\nI0\nI1\ntRI0\nC\x08\x00\x00\x00\x00\x00\x00\x00\x00tb.",
        "damaged",
    ),
    "objects in an array": (
        b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\ntC\x01btR"
        b"(I1\n(I1\ntcnumpy\ndtype\n(VV8\nI0\nI1\ntRI0\nC\x08\x00\x00\x00\x00\x00\x00\x00\x00tb.",
        "instead of numbers",
    ),
    "no dictionary": (b"]\x85.", "holds no dictionary"),
    "appends to a dictionary": (b"\x80\x04}K\x01a.", "operations do not fit together"),
    "truncated": (b"\x80\x04}(", "damaged"),
    "nothing": (b"", "damaged"),
    "empty stack": (b"0.", "underflow"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_pickles_are_refused(tmp_path, name):
    pickled, word = HOSTILE[name]
    path = raw_npy(tmp_path / "hostile.npy", pickled)
    with pytest.raises(UnknownFormatError, match=word) as caught:
        open_sequence(path)
    assert str(path) in str(caught.value) and "expected an .npy file with a dictionary" in str(caught.value)


def test_every_damaged_byte_is_a_named_error(tmp_path):
    """A byte that is changed gives other numbers or a named error, never anything else."""
    short = builtin("loop?frames=3&landmarks=40")
    content = bytearray(write_npy(tmp_path / "a.npy", npy_fields(short)).read_bytes())
    path = tmp_path / "damaged.npy"
    refused = 0
    rng = np.random.default_rng(1)
    for _ in range(100):
        damaged = bytearray(content)
        damaged[rng.integers(0, len(content))] = rng.integers(0, 256)
        path.write_bytes(damaged)
        try:
            open_sequence(path)
        except (UnknownFormatError, DataError):
            refused += 1
    assert refused > 10


@pytest.mark.parametrize("old", [b"} ", b"False,"])
def test_a_header_that_is_no_python_is_refused(npy, old):
    """NumPy parses the words of such headers once more, as those of Python 2, and fails in other ways."""
    content = npy.read_bytes()
    assert old in content[:128]
    npy.write_bytes(content.replace(old, old[:-1] + b"(", 1))
    with pytest.raises(UnknownFormatError, match=r"damaged \.npy file \(no header"):
        open_sequence(npy)


def test_npy_beyond_the_limit_is_refused_unread(npy):
    with reading_up_to(1e-6), pytest.raises(UnknownFormatError, match="--read-limit"):
        open_sequence(npy)


def later_fields() -> dict[str, Any]:
    """The .npz edition with a true camera pose in an IMU frame forward, right, down."""
    fields = ece276a_fields()
    del fields["cam_T_imu"]
    fields["angular_velocity"] = fields.pop("rotational_velocity")
    fields["imu_T_cam"] = se3.inverse(T_CAM_IMU @ np.diag([1.0, -1.0, -1.0, 1.0]))
    return fields


def test_later_npz_has_a_true_pose_in_another_imu_frame(tmp_path):
    fields = later_fields()
    read = open_sequence(write_npz(tmp_path / "03.npz", fields))
    np.testing.assert_allclose(read.T_cam_imu, T_CAM_IMU, atol=1e-12)
    np.testing.assert_array_equal(read.twist[:, 3:], fields["angular_velocity"].T)
    np.testing.assert_array_equal(read.twist[:, :3], fields["linear_velocity"].T)
    assert any("diag(1, -1, -1, 1)" in note for note in read.notes)
    with pytest.raises(ConfigError, match="extrinsics"):
        open_sequence(tmp_path / "03.npz", extrinsics="as-stored")


@pytest.mark.parametrize(
    ("alter", "error", "field"),
    [
        (without("angular_velocity"), ShapeError, "angular_velocity"),
        (changed("imu_T_cam", lambda a: a * 1.5), ExtrinsicsError, "imu_T_cam"),
        (changed("imu_T_cam", lambda a: a[:3]), ShapeError, "imu_T_cam"),
        (without("imu_T_cam"), ShapeError, "imu_T_cam"),
    ],
)
def test_broken_later_npz(tmp_path, alter, error, field):
    fields = later_fields()
    alter(fields)
    with pytest.raises(error) as caught:
        open_sequence(write_npz(tmp_path / "03.npz", fields))
    assert caught.value.field == field


def test_nan_and_column_stamps_in_an_npz(tmp_path):
    fields = ece276a_fields()
    plain = open_sequence(write_npz(tmp_path / "plain.npz", fields))
    fields["features"] = np.where(fields["features"] == UNSEEN, np.nan, fields["features"])
    fields["time_stamps"] = fields["time_stamps"].T
    odd = open_sequence(write_npz(tmp_path / "odd.npz", fields))
    np.testing.assert_array_equal(odd.time_s, plain.time_s)
    np.testing.assert_array_equal(odd.observations.pixels_px, plain.observations.pixels_px)


def test_a_crop_of_a_file_is_read_with_a_note(tmp_path):
    fields = ece276a_fields()
    fields["features"][:, 2] = UNSEEN
    read = open_sequence(write_npz(tmp_path / "a.npz", fields))
    assert 2 not in read.observations.ids and len(read.observations.ids) == 3
    assert "1 of 4 tracks are never seen and are left out." in read.notes
    mat = utias_fields()
    mat["y_k_j"][:, :, 0] = np.nan
    read = open_sequence(write_mat(tmp_path / "a.mat", mat))
    assert list(read.observations.ids) == [1, 2, 3]
    assert "1 of 4 tracks are never seen and are left out." in read.notes


def test_observations_without_right_pixels_are_left_out_with_a_note(tmp_path):
    fields = ece276a_fields()
    fields["features"][2:, 0, 3] = UNSEEN
    fields["features"][2:, 0, 4] = np.nan
    read = open_sequence(write_npz(tmp_path / "a.npz", fields))
    seen = (pixels()[0] != UNSEEN).sum()
    assert len(read.observations) == seen - 2
    assert "2 observations have no right pixels and are left out." in read.notes
    assert len(read) == FRAMES and read.camera.fu_px == K[0, 0]
