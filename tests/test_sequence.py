"""Every malformed input raises the error class that names file, field and index, in every file format."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from support.recordings import FRAMES, TRACKS, ece276a_fields, utias_fields, write_mat, write_npz

from ekfslam import errors, open_sequence
from ekfslam.data.readers import write_sequence
from ekfslam.data.sequence import Noise, Observations, Sequence, Truth
from ekfslam.data.simulate import builtin
from ekfslam.errors import (
    CalibrationError,
    DataError,
    DuplicateObservationError,
    EmptyTracksError,
    ExtrinsicsError,
    NonFiniteError,
    ShapeError,
    StampError,
    TruthError,
)

Change = Callable[[Any], Any]


def put(index: Any, value: float) -> Change:
    """Set entries of a field."""

    def change(field: np.ndarray) -> np.ndarray:
        field[index] = value
        return field

    return change


def swap_last(field: np.ndarray) -> np.ndarray:
    """The last two stamps in the wrong order."""
    field[..., [-2, -1]] = field[..., [-1, -2]]
    return field


def repeat_last(field: np.ndarray) -> np.ndarray:
    field[..., -1] = field[..., -2]
    return field


def cut_frame(axis: int) -> Change:
    return lambda field: np.delete(field, -1, axis)


def as_text(field: np.ndarray) -> np.ndarray:
    return np.array(["no", "number"])


REMOVE = None

BROKEN_NPZ: list[tuple[str, Change | None, type[DataError], str, Any]] = [
    ("time_stamps", swap_last, StampError, "time_stamps", FRAMES - 1),
    ("time_stamps", repeat_last, StampError, "time_stamps", FRAMES - 1),
    ("time_stamps", put((0, 2), np.nan), NonFiniteError, "time_stamps", (0, 2)),
    ("time_stamps", lambda field: np.repeat(field, 2, axis=0), ShapeError, "time_stamps", None),
    ("time_stamps", as_text, ShapeError, "time_stamps", None),
    ("linear_velocity", put((1, 4), np.inf), NonFiniteError, "linear_velocity", (1, 4)),
    ("linear_velocity", cut_frame(1), ShapeError, "linear_velocity", None),
    ("rotational_velocity", np.transpose, ShapeError, "rotational_velocity", None),
    ("rotational_velocity", REMOVE, ShapeError, "rotational_velocity", None),
    ("K", put((2, 2), 0.0), CalibrationError, "K", None),
    ("K", put((0, 1), 0.5), CalibrationError, "K", (0, 1)),
    ("K", put((0, 0), np.nan), NonFiniteError, "K", (0, 0)),
    ("K", put((1, 1), -700.0), CalibrationError, "K", None),
    ("K", cut_frame(1), ShapeError, "K", None),
    ("b", put((), 0.0), CalibrationError, "b", None),
    ("b", put((), -0.5), CalibrationError, "b", None),
    ("cam_T_imu", put((0, 0), 0.3), ExtrinsicsError, "cam_T_imu", None),
    ("cam_T_imu", put((1, 3), np.nan), NonFiniteError, "cam_T_imu", (1, 3)),
    ("features", put((2, 1, 5), np.nan), NonFiniteError, "features", (2, 1, 5)),
    ("features", put((3, 2, 4), -1.0), ShapeError, "features", (3, 2, 4)),
    ("features", lambda field: field[:, :0], EmptyTracksError, "observations", None),
    ("features", cut_frame(2), ShapeError, "features", None),
]

BROKEN_MAT: list[tuple[str, Change | None, type[DataError], str, Any]] = [
    ("t", swap_last, StampError, "t", FRAMES - 1),
    ("t", repeat_last, StampError, "t", FRAMES - 1),
    ("t", cut_frame(1), ShapeError, "t", None),
    ("t", put((0, 3), -np.inf), NonFiniteError, "t", (0, 3)),
    ("v_vk_vk_i", put((2, 1), np.nan), NonFiniteError, "v_vk_vk_i", (2, 1)),
    ("w_vk_vk_i", cut_frame(1), ShapeError, "w_vk_vk_i", None),
    ("r_i_vk_i", cut_frame(1), TruthError, "r_i_vk_i", None),
    ("theta_vk_i", cut_frame(1), TruthError, "theta_vk_i", None),
    ("theta_vk_i", put((0, 0), np.nan), NonFiniteError, "theta_vk_i", (0, 0)),
    ("fu", put((0, 0), 0.0), CalibrationError, "fu, fv", None),
    ("b", put((0, 0), -0.5), CalibrationError, "b", None),
    ("cu", REMOVE, ShapeError, "cu", None),
    ("C_c_v", np.negative, ExtrinsicsError, "C_c_v", None),
    ("rho_v_c_v", np.transpose, ShapeError, "rho_v_c_v", None),
    ("y_k_j", put((0, 4, 2), np.inf), NonFiniteError, "y_k_j", (0, 4, 2)),
    ("y_k_j", put((1, 4, 2), -1.0), ShapeError, "y_k_j", (1, 4, 2)),
    ("rho_i_pj_i", cut_frame(1), ShapeError, "rho_i_pj_i", None),
    ("w_var", put((1, 0), -0.1), DataError, "w_var", 1),
    ("y_var", REMOVE, ShapeError, "y_var", None),
]

OBSERVATIONS = "sequence/observations/"
BROKEN_HDF5: list[tuple[str, Change | None, type[DataError], str, Any]] = [
    ("sequence/time", swap_last, StampError, "sequence/time", FRAMES - 1),
    ("sequence/time", repeat_last, StampError, "sequence/time", FRAMES - 1),
    ("sequence/twist", put((3, 1), np.nan), NonFiniteError, "sequence/twist", (3, 1)),
    ("sequence/twist", cut_frame(0), ShapeError, "sequence/twist", None),
    ("sequence/twist", REMOVE, ShapeError, "sequence/twist", None),
    ("sequence/camera@baseline_m", put((), 0.0), CalibrationError, "sequence/camera@baseline_m", None),
    ("sequence/camera@fv_px", put((), 0.0), CalibrationError, "sequence/camera@fu_px, fv_px", None),
    ("sequence/camera@cu_px", REMOVE, ShapeError, "sequence/camera@cu_px", None),
    ("sequence/T_cam_imu", put((2, 2), 0.4), ExtrinsicsError, "sequence/T_cam_imu", None),
    (OBSERVATIONS + "pixels", put((5, 3), np.inf), NonFiniteError, OBSERVATIONS + "pixels", (5, 3)),
    (OBSERVATIONS + "pixels", cut_frame(0), ShapeError, OBSERVATIONS[:-1], None),
    (OBSERVATIONS + "frame", put(-1, FRAMES), ShapeError, OBSERVATIONS + "frame", FRAMES * TRACKS - 4),
    (OBSERVATIONS + "frame", np.float64, ShapeError, OBSERVATIONS + "frame", None),
    (OBSERVATIONS + "landmark", put(1, 0), DuplicateObservationError, OBSERVATIONS[:-1], 1),
    (OBSERVATIONS + "landmark", put(1, -3), ShapeError, OBSERVATIONS + "landmark", 0),
    ("sequence/noise/twist_std", put(2, -1.0), DataError, "sequence/noise/twist_std", None),
    ("truth/frame", swap_last, TruthError, "truth/frame", None),
    ("truth/T_world_imu", cut_frame(0), TruthError, "truth/T_world_imu", None),
    ("truth/T_world_imu", put((4, 0, 0), 3.0), TruthError, "truth/T_world_imu", 4),
    ("truth/landmarks/position", cut_frame(0), TruthError, "truth/landmarks/position", None),
]


def check(path: Path, error: type[DataError], field: str, index: Any) -> None:
    with pytest.raises(DataError) as caught:
        open_sequence(path)
    assert type(caught.value) is error
    assert (caught.value.source, caught.value.field, caught.value.index) == (str(path), field, index)
    assert str(caught.value).startswith(f"{path}: {field}")


def broken(fields: dict[str, Any], name: str, change: Change | None) -> dict[str, Any]:
    if change is None:
        del fields[name]
    else:
        fields[name] = change(fields[name])
    return fields


def names(cases: list) -> list[str]:
    return [f"{case[0]}-{case[2].__name__}-{number}" for number, case in enumerate(cases)]


@pytest.mark.parametrize(("name", "change", "error", "field", "index"), BROKEN_NPZ, ids=names(BROKEN_NPZ))
def test_broken_npz_names_file_field_and_index(tmp_path, name, change, error, field, index):
    check(write_npz(tmp_path / "a.npz", broken(ece276a_fields(), name, change)), error, field, index)


@pytest.mark.parametrize(("name", "change", "error", "field", "index"), BROKEN_MAT, ids=names(BROKEN_MAT))
def test_broken_mat_names_file_field_and_index(tmp_path, name, change, error, field, index):
    fields = broken(utias_fields(starry_night=True), name, change)
    check(write_mat(tmp_path / "a.mat", fields), error, field, index)


@pytest.mark.parametrize(("name", "change", "error", "field", "index"), BROKEN_HDF5, ids=names(BROKEN_HDF5))
def test_broken_hdf5_names_file_field_and_index(tmp_path, name, change, error, field, index):
    path = tmp_path / "a.h5"
    write_sequence(open_sequence(write_mat(tmp_path / "a.mat", utias_fields(starry_night=True))), path)
    with h5py.File(path, "r+") as h5file:
        place, _, attribute = name.partition("@")
        fields, key = (h5file[place].attrs, attribute) if attribute else (h5file, place)
        value = np.array(fields[key])
        del fields[key]
        if change is not None:
            fields[key] = change(value)
    check(path, error, field, index)


@pytest.fixture
def valid(tmp_path) -> Sequence:
    return open_sequence(write_npz(tmp_path / "a.npz", ece276a_fields()))


def test_constructor_names_its_source_in_every_error(valid):
    truth = Truth(np.arange(2), np.stack([np.eye(4)] * 3))
    for change, error, field in (
        ({"time_s": np.empty(0)}, ShapeError, "time_s"),
        ({"time_s": valid.time_s[::-1]}, StampError, "time_s"),
        ({"twist": valid.twist[:, :5]}, ShapeError, "twist"),
        ({"truth": truth}, TruthError, "truth.T_world_imu"),
        ({"truth": Truth(np.array([FRAMES]), np.eye(4)[None])}, TruthError, "truth.frame"),
        ({"noise": Noise(np.ones(5), np.ones(4))}, ShapeError, "noise.twist_std"),
        ({"noise": Noise(np.ones(6), -np.ones(4))}, DataError, "noise.pixel_std_px"),
        ({"observations": Observations([], [], np.empty((0, 4)))}, EmptyTracksError, "observations"),
        ({"camera": replace(valid.camera, cu_px=np.nan)}, NonFiniteError, "camera (fu, fv, cu, cv, baseline)"),
    ):
        with pytest.raises(DataError) as caught:
            replace(valid, **change)
        assert type(caught.value) is error
        assert (caught.value.source, caught.value.field) == (valid.source, field)


def test_observations_sort_themselves_and_slice_by_frame():
    observations = Observations([1, 0, 1], [4, 9, 2], np.arange(12.0).reshape(3, 4))
    np.testing.assert_array_equal(observations.frame, [0, 1, 1])
    np.testing.assert_array_equal(observations.ids, [2, 4, 9])
    ids, seen = observations.at(1)
    np.testing.assert_array_equal(ids, [2, 4])
    np.testing.assert_array_equal(seen, [[8, 9, 10, 11], [0, 1, 2, 3]])


def test_arrays_of_a_sequence_are_read_only(valid):
    for array in (valid.time_s, valid.twist, valid.T_cam_imu, valid.observations.pixels_px):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_initial_pose_is_the_true_one_only_where_frame_zero_is_known(valid):
    T = np.eye(4)
    T[:3, 3] = 1, 2, 3
    assert np.array_equal(replace(valid, truth=Truth([0], T[None])).initial_T_world_imu, T)
    assert np.array_equal(replace(valid, truth=Truth([1], T[None])).initial_T_world_imu, np.eye(4))
    assert np.array_equal(valid.initial_T_world_imu, np.eye(4))


def test_every_data_error_is_an_ekfslam_error():
    assert all(issubclass(kind, errors.EkfslamError) for kind in (DataError, StampError, TruthError, ShapeError))


def test_a_stretch_is_a_recording_of_its_own():
    world = builtin("city?frames=60")
    part = world[20:50]
    assert len(part) == 30 and part.attributes["first_frame"] == 20
    np.testing.assert_array_equal(part.time_s, world.time_s[20:50])
    np.testing.assert_array_equal(part.initial_T_world_imu, world.truth.T_world_imu[20])
    for frame in (0, 7, 29):
        for here, there in zip(part.observations.at(frame), world.observations.at(20 + frame), strict=True):
            np.testing.assert_array_equal(here, there)
    assert part[5:].attributes["first_frame"] == 25 and len(world[-10:]) == 10 and len(world[:200]) == 60
    between = world.between(float(world.time_s[20]), float(world.time_s[50]))
    np.testing.assert_array_equal(between.twist, part.twist)


def test_interpolated_intervals_of_a_stretch_have_other_numbers():
    world = builtin("city?frames=60")
    marked = replace(world, attributes={**world.attributes, "interpolated": "22-30"})
    assert np.flatnonzero(marked[20:50].interpolated).tolist() == list(range(2, 11))
    assert not marked[40:].interpolated.any()


@pytest.mark.parametrize(
    ("frames", "words"),
    [
        (slice(0, 50, 2), "successive"),
        (7, "successive"),
        (slice(30, 20), "no frames 30:20"),
        (slice(70, None), "has 60"),
    ],
)
def test_what_is_no_stretch_is_refused(frames, words):
    with pytest.raises(ShapeError, match=words):
        builtin("city?frames=60")[frames]


def test_what_is_found_once_is_kept_with_its_arguments_and_leaves_with_the_recording():
    sequence, calls = builtin("loop"), []

    def find(recording: Sequence, *arguments: object) -> int:
        calls.append((recording, *arguments))
        return len(calls)

    assert [sequence.once(find), sequence.once(find, np.ones(2)), sequence.once(find, np.ones(2))] == [1, 2, 2]
    assert sequence.once(find, np.zeros(2)) == 3
    assert sequence[:50].once(find) == 4
    assert sequence.once(find) == 1
