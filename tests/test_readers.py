"""Readers: what they make of each format, how they recognise it, and the conventions, checked by dead reckoning."""

from __future__ import annotations

import dataclasses
import hashlib
import struct
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
from scipy.spatial.transform import Rotation
from support.recordings import (
    CAMERA_IN_IMU_M,
    FRAMES,
    R_CAM_IMU,
    TRACKS,
    ece276a_fields,
    pixels,
    stamps,
    utias_fields,
    velocities,
    write_mat,
    write_npz,
)
from support.same import assert_same

from ekfslam import open_sequence
from ekfslam.data import readers
from ekfslam.data.readers import read_sequence, write_sequence
from ekfslam.data.readers.hdf5 import read_sequence_fields, write_sequence_group
from ekfslam.data.readers.matfile import parse_mat
from ekfslam.data.readers.text import parse_table
from ekfslam.data.sequence import Observations, Sequence
from ekfslam.data.tracks import inspect_tracks, repeated_frames
from ekfslam.errors import (
    ArchiveError,
    ConfigError,
    DataError,
    EkfslamError,
    LineError,
    NonFiniteError,
    StampError,
    TruthError,
    UnknownFormatError,
)
from ekfslam.geometry import motion, se3
from ekfslam.geometry.camera import project
from ekfslam.limits import Budget


@pytest.fixture
def npz(tmp_path):
    return write_npz(tmp_path / "0099.npz", ece276a_fields())


@pytest.fixture
def starry_night(tmp_path):
    return write_mat(tmp_path / "night.mat", utias_fields(starry_night=True))


# What the readers make of the files


def test_npz_becomes_a_sequence(npz):
    sequence = open_sequence(npz)
    v, w = velocities()
    np.testing.assert_array_equal(sequence.time_s, stamps())
    np.testing.assert_array_equal(sequence.twist, np.vstack([v * [[1], [-1], [1]], w]).T)
    assert dataclasses.astuple(sequence.camera) == (700, 710, 600, 180, 0.54)
    assert sequence.name == "0099" and sequence.source == str(npz) and sequence.truth is None and sequence.noise is None
    dense = np.full((4, FRAMES, TRACKS), -1.0)
    observations = sequence.observations
    dense[:, observations.frame, observations.landmark] = observations.pixels_px.T
    np.testing.assert_array_equal(dense, pixels())
    assert len(observations) == FRAMES * TRACKS - 3
    assert sequence.attributes == {
        "checksum_sha256": hashlib.sha256(npz.read_bytes()).hexdigest(),
        "reader": "ece276a",
        "extrinsics": "corrected",
        "lateral": "corrected",
    }


def test_npz_extrinsics_are_corrected_or_as_stored(npz):
    corrected, stored = open_sequence(npz), open_sequence(npz, extrinsics="as-stored")
    # The camera sits at its stored position: its own origin comes from there.
    np.testing.assert_allclose(se3.apply(corrected.T_cam_imu, CAMERA_IN_IMU_M), 0, atol=1e-15)
    np.testing.assert_array_equal(corrected.T_cam_imu[:3, :3], R_CAM_IMU)
    np.testing.assert_array_equal(stored.T_cam_imu, ece276a_fields()["cam_T_imu"])
    assert stored.attributes["extrinsics"] == "as-stored"
    assert "-R t" in corrected.notes[0] and "as in the report" in stored.notes[0]


def test_as_stored_is_refused_where_it_means_nothing(starry_night):
    with pytest.raises(ConfigError, match=r"night\.mat.*as-stored"):
        open_sequence(starry_night, extrinsics="as-stored")
    with pytest.raises(ConfigError, match="extrinsics must be one of"):
        open_sequence(starry_night, extrinsics="wrong")


def test_lateral_velocity_is_negated_or_as_stored(tmp_path, npz):
    mat = write_mat(tmp_path / "drive.mat", utias_fields())
    stored = np.vstack(velocities()).T
    for file in (npz, mat):
        for lateral, sign, words in (("corrected", -1.0, "it is negated"), ("as-stored", 1.0, "is used as stored")):
            sequence = open_sequence(file, lateral=lateral)
            np.testing.assert_array_equal(sequence.twist, stored * [1, sign, 1, 1, 1, 1])
            assert sequence.attributes["lateral"] == lateral
            assert sum("lateral velocity" in note and words in note for note in sequence.notes) == 1


def test_lateral_velocity_as_stored_is_refused_where_it_means_nothing(starry_night):
    assert "lateral" not in open_sequence(starry_night).attributes
    for source in (starry_night, "builtin:loop"):
        with pytest.raises(ConfigError, match=r"lateral 'as-stored' mean nothing"):
            open_sequence(source, lateral="as-stored")
    with pytest.raises(ConfigError, match="lateral must be one of"):
        open_sequence(starry_night, lateral="right")


def test_what_a_reader_was_told_stays_with_a_file_of_our_own(tmp_path, npz):
    path = tmp_path / "own.h5"
    sequence = open_sequence(npz, extrinsics="as-stored", lateral="as-stored")
    write_sequence(sequence, path)
    for again in (open_sequence(path), open_sequence(path, extrinsics="as-stored", lateral="as-stored")):
        np.testing.assert_array_equal(again.twist, sequence.twist)
        assert again.notes == sequence.notes
    attributes = {key: value for key, value in sequence.attributes.items() if key != "lateral"}
    write_sequence(dataclasses.replace(sequence, attributes=attributes), path)
    assert "does not say how the sign of the lateral velocity" in open_sequence(path).notes[-1]


def test_mat_becomes_a_sequence(starry_night):
    sequence, fields = open_sequence(starry_night), utias_fields(starry_night=True)
    np.testing.assert_array_equal(sequence.time_s, stamps())
    np.testing.assert_array_equal(sequence.twist, np.vstack(velocities()).T)
    np.testing.assert_allclose(se3.apply(sequence.T_cam_imu, CAMERA_IN_IMU_M), 0, atol=1e-15)
    truth, noise = sequence.truth, sequence.noise
    rotation = Rotation.from_rotvec(fields["theta_vk_i"].T).as_matrix()
    np.testing.assert_allclose(truth.T_world_imu[:, :3, :3], rotation, atol=1e-14)
    np.testing.assert_array_equal(truth.T_world_imu[:, :3, 3], fields["r_i_vk_i"].T)
    np.testing.assert_array_equal(truth.landmark, np.arange(TRACKS))
    np.testing.assert_array_equal(truth.position_m, fields["rho_i_pj_i"].T)
    np.testing.assert_allclose(noise.twist_std, [0.1, 0.2, 0.3, 0.4, 0.5, 0.6], rtol=1e-15)
    np.testing.assert_allclose(noise.pixel_std_px, [6, 11, 7, 12], rtol=1e-15)
    ids, seen = sequence.observations.at(3)
    np.testing.assert_array_equal(ids, [0, 2, 3])
    np.testing.assert_array_equal(seen, pixels()[:, 3, ids].T)


def test_mat_arrays_beyond_the_tracks_are_cut_with_a_note(tmp_path):
    exact = open_sequence(write_mat(tmp_path / "exact.mat", utias_fields()))
    longer = open_sequence(write_mat(tmp_path / "longer.mat", utias_fields(extra=3)))
    assert len(longer) == FRAMES
    np.testing.assert_array_equal(longer.twist, exact.twist)
    np.testing.assert_array_equal(longer.truth.T_world_imu, exact.truth.T_world_imu)
    assert longer.noise is None
    assert longer.notes[0] == (
        "Cut to the 7 frames of y_k_j: t (10), v_vk_vk_i (10), w_vk_vk_i (10), r_i_vk_i (10), theta_vk_i (10)."
    )
    assert longer.notes[1:] == exact.notes


def test_builtin_worlds_open_by_name():
    assert len(open_sequence("builtin:loop").observations)
    with pytest.raises(UnknownFormatError, match="no_such_world"):
        open_sequence("builtin:no_such_world")


# Which reader, and files that are none of ours


def test_reader_is_picked_by_content_not_by_name(tmp_path, npz, starry_night):
    own = tmp_path / "own"
    write_sequence(open_sequence(npz), own)
    for original, reader in ((npz, "ece276a"), (starry_night, "utias"), (own, "hdf5")):
        disguised = tmp_path / "disguised.txt"
        disguised.write_bytes(original.read_bytes())
        assert open_sequence(disguised).attributes["reader"] == reader


def foreign_files(folder):
    """Files that no reader knows, and a word that the message must hold."""
    (folder / "empty").write_bytes(b"")
    (folder / "text.npz").write_text("features: none\n")
    np.savez(folder / "other.npz", poses=np.eye(4), scale=np.ones(2))
    np.savez(folder / "pickled.npz", features=np.array([{"code": 1}], dtype=object))
    np.save(folder / "single.npy", np.eye(4))
    scipy.io.savemat(folder / "other.mat", {"poses": np.eye(4)})
    with h5py.File(folder / "other.h5", "w") as h5file:
        h5file["poses"] = np.eye(4)
    (folder / "matlab73.mat").write_bytes(b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n\x1a\n")
    return {
        "missing.npz": "No such file",
        ".": "directory",
        "empty": "empty file",
        "text.npz": "unknown content",
        "other.npz": "poses, scale",
        "pickled.npz": "allow_pickle",
        "single.npy": "instead of a dictionary",
        "other.mat": "poses",
        "other.h5": "poses",
        "matlab73.mat": "-v7;",
    }


def test_foreign_files_are_refused_naming_file_and_expectation(tmp_path):
    for name, word in foreign_files(tmp_path).items():
        with pytest.raises(UnknownFormatError) as caught:
            open_sequence(tmp_path / name)
        message = str(caught.value)
        assert str(tmp_path / name) in message and word in message and "expected" in message, message


@pytest.mark.parametrize("kind", ["npz", "mat", "h5"])
def test_truncated_and_scrambled_files_are_refused(tmp_path, npz, starry_night, kind):
    own = tmp_path / "own.h5"
    write_sequence(open_sequence(npz), own)
    content = {"npz": npz, "mat": starry_night, "h5": own}[kind].read_bytes()
    path = tmp_path / "a_file"
    for length in np.linspace(1, len(content) - 1, 25).astype(int):
        path.write_bytes(content[:length])
        with pytest.raises(UnknownFormatError, match=r"a_file: (damaged|unknown content).*expected"):
            open_sequence(path)
    path.write_bytes(content[:140] + bytes(reversed(content[140:])))
    with pytest.raises(UnknownFormatError, match=r"a_file: damaged .*expected"):
        open_sequence(path)


@pytest.mark.filterwarnings("ignore:overflow")
@pytest.mark.parametrize("kind", ["npz", "mat", "compressed mat", "h5"])
def test_flipped_bytes_never_raise_anything_but_named_errors(tmp_path, npz, starry_night, kind):
    own, compressed = tmp_path / "own.h5", tmp_path / "compressed.mat"
    write_sequence(open_sequence(npz), own)
    scipy.io.savemat(compressed, utias_fields(), do_compression=True)
    content = {"npz": npz, "mat": starry_night, "compressed mat": compressed, "h5": own}[kind].read_bytes()
    rng, path, refused = np.random.default_rng(11), tmp_path / "a_file", 0
    for _ in range(60):
        damaged = np.frombuffer(content, np.uint8).copy()
        damaged[rng.integers(0, len(damaged), 4)] = rng.integers(0, 256, 4)
        path.write_bytes(damaged.tobytes())
        try:
            open_sequence(path)
        except EkfslamError:
            refused += 1
    assert refused


def test_mat_files_of_either_byte_order_and_every_number_type_are_parsed():
    def element(order, kind, data):
        return struct.pack(order + "II", kind, len(data)) + data + bytes(-len(data) % 8)

    for order, mark in (("<", b"IM"), (">", b"MI")):
        content = bytes(126) + mark
        for kind, dtype in ((2, "u1"), (3, "i2"), (7, "f4"), (9, "f8")):
            values = np.arange(6).astype(order + dtype).tobytes()
            content += element(
                order,
                14,
                element(order, 6, struct.pack(order + "II", 6, 0))
                + element(order, 5, struct.pack(order + "ii", 2, 3))
                + struct.pack(order + "I2s2x", 2 << 16 | 1, dtype.encode())
                + element(order, kind, values),
            )
        variables = parse_mat(content, Budget("a.mat"))
        assert list(variables) == ["u1", "i2", "f4", "f8"]
        for value in variables.values():
            np.testing.assert_array_equal(value, [[0, 2, 4], [1, 3, 5]])


# Adding a format, and the parser of text

FORMAT = """
from ekfslam.data.readers.poses import Poses
from ekfslam.data.readers.registry import Reader
from ekfslam.data.readers.text import first_row, parse_table, read_lines
from ekfslam.data.simulate import builtin

READER = Reader("mine", "a .mine file", lambda source: source.head.startswith(b"MINE"), lambda source: builtin("loop"))


def truth(source, sequence):
    table = parse_table(read_lines(source.path, ""), source.path, columns=2)
    return Poses(sequence.truth.T_world_imu[: len(table.values)], table.values[:, 0], (source.path,))


def is_truth(source):
    return len(first_row(source.path).split()) == 2


TRUTH = Reader("mine", "2 numbers a line (mine)", is_truth, truth=truth)
"""


def test_a_format_is_added_by_one_file_alone(tmp_path, monkeypatch):
    recording, truth = tmp_path / "recording", tmp_path / "truth"
    recording.write_text("MINE")
    sequence = open_sequence("builtin:loop")
    truth.write_text("".join(f"{time!r} 0\n" for time in sequence.time_s.tolist()))
    for arguments in ({"source": recording}, {"source": "builtin:loop", "truth": truth}):
        with pytest.raises(UnknownFormatError, match="expected"):
            open_sequence(**arguments)

    folder = tmp_path / "more"
    folder.mkdir()
    (folder / "mine.py").write_text(FORMAT)
    monkeypatch.setattr(readers, "__path__", [*readers.__path__, str(folder)])
    monkeypatch.delitem(sys.modules, "ekfslam.data.readers.mine", raising=False)
    assert_same(open_sequence(recording), sequence, apart=("source",))
    assert open_sequence("builtin:loop", truth=truth).notes[-1] == "Truth of 472 of 472 frames from truth."
    (tmp_path / "other").write_text("other")
    with pytest.raises(UnknownFormatError, match=r"a \.mine file"):
        open_sequence(tmp_path / "other")
    monkeypatch.delitem(sys.modules, "ekfslam.data.readers.mine")
    monkeypatch.delattr(readers, "mine")


def test_rows_of_text_skip_comments_and_keep_their_line_numbers():
    path = Path("a.txt")
    table = parse_table(["# head", "", "1, 2,x", "  # more", "3,4 , # and"], path, columns=3, used=2, separator=",")
    np.testing.assert_array_equal(table.values, [[1, 2], [3, 4]])
    np.testing.assert_array_equal(table.line, [3, 5])
    assert table.where(1) == {"source": "a.txt", "field": "line", "index": 5}
    assert parse_table(["#"], path, columns=4).values.shape == (0, 4)


@pytest.mark.parametrize(
    ("line", "error"), [("1 2", LineError), ("1 2 3 4", LineError), ("1 2 x", LineError), ("1 inf 3", NonFiniteError)]
)
def test_malformed_rows_of_text_name_file_and_line(line, error):
    with pytest.raises(DataError) as caught:
        parse_table(["0 0 0", "", line], Path("a.txt"))
    assert type(caught.value) is error
    assert (caught.value.source, caught.value.field, caught.value.index) == ("a.txt", "line", 3)
    with pytest.raises(TruthError if error is LineError else NonFiniteError):
        parse_table([line], Path("a.txt"), columns=3, error=TruthError)


# Own HDF5 form


@pytest.mark.parametrize("kind", ["npz", "starry night", "builtin"])
def test_own_form_round_trips_bit_for_bit(tmp_path, npz, starry_night, kind):
    sequence = open_sequence({"npz": npz, "starry night": starry_night, "builtin": "builtin:loop"}[kind])
    facts = {**sequence.attributes, "seed": 7, "sigma": 0.1 + 0.2, "word": "é", "none": ""}
    sequence = dataclasses.replace(sequence, attributes=facts, notes=sequence.notes if kind == "npz" else ())
    write_sequence(sequence, tmp_path / "a.h5")
    again = read_sequence(tmp_path / "a.h5")
    assert_same(sequence, again, apart=("source",))
    assert again.source == str(tmp_path / "a.h5")


def test_every_dataset_of_the_own_form_says_units_and_frame(tmp_path, starry_night):
    write_sequence(open_sequence(starry_night), tmp_path / "a.h5")
    datasets = []
    with h5py.File(tmp_path / "a.h5") as h5file:
        h5file.visititems(lambda _, item: datasets.append(dict(item.attrs)) if isinstance(item, h5py.Dataset) else None)
    assert len(datasets) == 13 + 11  # the fields, and the coordinates of their dimensions
    assert all(attributes["units"] and attributes["frame"] for attributes in datasets)


def test_own_form_of_a_newer_version_is_refused_with_both_versions(tmp_path, npz):
    path = tmp_path / "a.h5"
    write_sequence(open_sequence(npz), path)
    with h5py.File(path, "r+") as h5file:
        h5file.attrs["format_version"] = 4
    with pytest.raises(ArchiveError, match=r"a\.h5: has format version 4, this release reads up to version 3"):
        open_sequence(path)


def test_sequence_group_without_observations_keeps_the_rest(tmp_path, starry_night):
    sequence = open_sequence(starry_night)
    with h5py.File(tmp_path / "archive.h5", "w") as h5file:
        write_sequence_group(h5file, sequence)
        fields = read_sequence_fields(h5file, "archive.h5")
        assert_same(sequence, Sequence(**fields, observations=sequence.observations), apart=("source",))


def test_writing_where_nothing_can_be_written_is_an_archive_error(tmp_path, npz):
    with pytest.raises(ArchiveError, match="cannot be written"):
        write_sequence(open_sequence(npz), tmp_path / "no folder" / "a.h5")


# Truth files


@pytest.fixture
def T_cam0_cam():
    rng = np.random.default_rng(8)
    T = se3.exp(np.cumsum(rng.normal(0, [0.1, 0.1, 1, 0.02, 0.05, 0.02], (FRAMES, 6)), axis=0))
    return se3.inverse(T[0]) @ T


def kitti_text(T):
    return "\n".join(" ".join(f"{x:.9e}" for x in row) for row in T[:, :3].reshape(-1, 12)) + "\n"


def tum_rows(time_s, T):
    return np.column_stack([time_s, T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_quat()])


def tum_text(rows):
    return "\n".join(" ".join(f"{x:.9f}" for x in row) for row in rows) + "\n"


def test_kitti_truth_is_the_left_camera_in_its_first_frame(npz, tmp_path, T_cam0_cam):
    truth_file = tmp_path / "00.txt"
    truth_file.write_text(kitti_text(T_cam0_cam))
    sequence = open_sequence(npz, truth=truth_file)
    T_world_imu = sequence.truth.T_world_imu
    np.testing.assert_allclose(T_world_imu[0], np.eye(4), atol=1e-8)
    # A point that stays put at p in the first camera is seen by every camera where its pose says.
    p_cam0 = np.array([1.0, -2.0, 30.0])
    p_world = se3.apply(se3.inverse(sequence.T_cam_imu), p_cam0)
    seen = se3.apply(sequence.T_cam_imu @ se3.inverse(T_world_imu), p_world)
    np.testing.assert_allclose(seen, se3.apply(se3.inverse(T_cam0_cam), p_cam0), atol=1e-6)
    assert sequence.notes[-1] == "Truth of 7 of 7 frames from 00.txt."
    assert len(sequence.attributes["truth_checksum_sha256"]) == 64


def test_kitti_truth_is_cut_or_left_short_with_a_note(npz, starry_night, tmp_path, T_cam0_cam):
    truth_file = tmp_path / "00.txt"
    truth_file.write_text("# poses\n\n" + kitti_text(np.concatenate([T_cam0_cam, T_cam0_cam])))
    sequence = open_sequence(starry_night, truth=truth_file)
    np.testing.assert_array_equal(sequence.truth.frame, np.arange(FRAMES))
    assert len(sequence.truth.landmark) == 0
    assert sequence.notes[-1] == "Truth of 7 of 7 frames from 00.txt; 7 of its 14 poses are not used."
    truth_file.write_text(kitti_text(T_cam0_cam[:6]))
    with pytest.raises(TruthError, match=r"00\.txt: 6 poses give truth to 6 of the 7 frames .*0099\.npz"):
        open_sequence(npz, truth=truth_file)


def test_tum_truth_is_matched_by_stamp(npz, tmp_path, T_cam0_cam):
    truth_file = tmp_path / "tum.txt"
    # 0.04 s late is within half the median step of 0.1 s.
    rows = tum_rows(stamps() + 0.04, T_cam0_cam)
    extra = np.array([[stamps()[-1] + 5.0, 0, 0, 0, 0, 0, 0, 1]])
    truth_file.write_text("# time tx ty tz qx qy qz qw\n" + tum_text(np.vstack([rows, extra])))
    sequence = open_sequence(npz, truth=truth_file)
    np.testing.assert_array_equal(sequence.truth.frame, np.arange(FRAMES))
    np.testing.assert_allclose(sequence.truth.T_world_imu, T_cam0_cam, atol=1e-8)
    assert sequence.notes[-1] == "Truth of 7 of 7 frames from tum.txt; 1 of its 8 poses are not used."
    truth_file.write_text(tum_text(tum_rows(stamps() - 0.06 * (np.arange(FRAMES) == 0), T_cam0_cam)))
    with pytest.raises(TruthError, match="7 poses give truth to 6 of the 7 frames"):
        open_sequence(npz, truth=truth_file)
    # Between frames 2 and 3, 0.09 s apart, one pose is left, near enough to both: it serves the nearer one only.
    between = np.delete(stamps(), 3)
    between[2] += 0.042
    truth_file.write_text(tum_text(tum_rows(between, np.delete(T_cam0_cam, 3, axis=0))))
    with pytest.raises(TruthError, match="6 poses give truth to 6 of the 7 frames"):
        open_sequence(npz, truth=truth_file)


def test_malformed_truth_files_name_file_and_line(npz, tmp_path, T_cam0_cam):
    kitti = kitti_text(T_cam0_cam).splitlines()
    tum = tum_text(tum_rows(stamps(), T_cam0_cam)).splitlines()
    cases = [
        (kitti, " ".join(kitti[3].split()[:11]), TruthError),
        (kitti, "nan " + kitti[3].split(" ", 1)[1], NonFiniteError),
        (kitti, "1.2x " + kitti[3].split(" ", 1)[1], TruthError),
        (kitti, "2.5 " + kitti[3].split(" ", 1)[1], TruthError),
        (tum, tum[3].rsplit(" ", 1)[0] + " 3.0", TruthError),
        (tum, f"{tum[2].split()[0]} {tum[3].split(' ', 1)[1]}", StampError),
    ]
    for lines, replacement, error in cases:
        path = tmp_path / "truth.txt"
        path.write_text("\n".join(["# comment", *lines[:3], replacement, *lines[4:]]))
        with pytest.raises(error) as caught:
            open_sequence(npz, truth=path)
        assert type(caught.value) is error
        assert (caught.value.source, caught.value.field, caught.value.index) == (str(path), "line", 5)


@pytest.mark.parametrize("content", [b"", b"# only a comment\n", b"1 2 3\n4 5 6\n", b"\xff\xfe\x00\x01", None])
def test_files_that_hold_no_truth_are_refused(npz, tmp_path, content):
    path = tmp_path / "truth.txt"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(UnknownFormatError, match=r"truth\.txt: .*expected .*12 numbers a line"):
        open_sequence(npz, truth=path)


# Tracks


def test_inspection_counts_what_was_put_in():
    rng = np.random.default_rng(9)
    seen = np.ones((6, 4), dtype=bool)
    seen[2:4, 1] = seen[4] = False
    frame, landmark = np.nonzero(seen)
    z = rng.uniform(0, 1000, (len(frame), 4))
    z[:, 2] = z[:, 0] - 1.0
    z[:, 3] = z[:, 1]
    z[[3, 7], 2] = z[[3, 7], 0] + [0.0, 2.0]
    z[5, 3] = z[5, 1] - 0.75
    z[11, 3] = z[11, 1] + 0.5
    report = inspect_tracks(Observations(frame, landmark, z), np.ones((6, 6)))
    assert report.tracks == 4
    np.testing.assert_array_equal(report.observations_per_frame, [4, 4, 3, 3, 0, 4])
    assert report.returning_tracks == 4
    assert report.nonpositive_disparities == 2
    assert report.max_row_mismatch_px == 0.75
    assert len(report.repeated_frames) == 0
    assert report.notes[0] == "4 tracks, 18 observations, 3.0 a frame; 1 of 6 frames see nothing."
    assert len(report.notes) == 4 and not any(note.startswith("0 ") for note in report.notes)


def test_repeated_frames_need_every_common_track_and_motion():
    rng = np.random.default_rng(10)
    z = rng.uniform(0, 1000, (8, 3, 4))
    z[2] = z[1]  # repeated
    z[4, :2] = z[3, :2]  # only two of three tracks
    z[6] = z[5]  # repeated, but standing still
    z[7, 0] = z[6, 0]  # one common track, repeated: see below
    frame, landmark = np.divmod(np.arange(24), 3)
    landmark[22:] += 5  # the last frame has one track in common with the frame before
    twist = np.zeros((8, 6))
    twist[:, 0] = 5.0
    twist[6, 0] = 0.01
    observations = Observations(frame, landmark, z.reshape(-1, 4))
    np.testing.assert_array_equal(repeated_frames(observations, twist), [2, 7])
    twist[6, 5] = 0.3  # turning on the spot is motion
    np.testing.assert_array_equal(repeated_frames(observations, twist), [2, 6, 7])


# Conventions, on the recordings themselves


def dead_reckoning_error(sequence: Sequence) -> float:
    """RMS position error (m) of the IMU, no alignment, with twist[k] driving (t[k-1], t[k]]."""
    E = motion.increment(sequence.twist[1:], np.diff(sequence.time_s))
    T_imu_world = [se3.inverse(sequence.initial_T_world_imu)]
    for step in E:
        T_imu_world.append(step @ T_imu_world[-1])
    position = se3.inverse(np.array(T_imu_world))[sequence.truth.frame, :3, 3]
    return float(np.sqrt(np.mean(np.sum((position - sequence.truth.T_world_imu[:, :3, 3]) ** 2, axis=1))))


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "poses", "stored_m", "corrected_m", "known", "repeated"),
    [("0027", "07", 3.97, 3.91, 1101, 91), ("0020", "06", 8.71, 8.30, 1101, 152), ("0042", "01", 4.30, 3.03, 500, 0)],
)
def test_dead_reckoning_on_the_reports_recordings(data_path, name, poses, stored_m, corrected_m, known, repeated):
    truth = data_path(f"kitti_odometry_poses/{poses}.txt")
    stored = open_sequence(data_path(f"ece276a/{name}.npz"), truth=truth, lateral="as-stored")
    assert dead_reckoning_error(stored) == pytest.approx(stored_m, rel=0.01)
    sequence = open_sequence(data_path(f"ece276a/{name}.npz"), truth=truth)
    assert dead_reckoning_error(sequence) == pytest.approx(corrected_m, rel=0.002)
    assert len(sequence.truth.frame) == known
    report = inspect_tracks(sequence.observations, sequence.twist)
    assert len(report.repeated_frames) == repeated
    assert report.returning_tracks == 0


@pytest.mark.data
def test_dense_noisy_edition_is_read(data_path):
    sequence = open_sequence(data_path("ece276a/0022_dense_noisy.npz"))
    assert (len(sequence), len(sequence.observations.ids)) == (800, 3220)


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "frames", "stored_m", "corrected_m"),
    [("2011_09_26_drive_0009_sync_KLT", 446, 4.73, 2.152), ("2011_10_03_drive_0042_sync_KLT", 500, 4.218, 3.013)],
)
def test_dead_reckoning_on_utias_drives(data_path, name, frames, stored_m, corrected_m):
    stored = open_sequence(data_path(f"utias/{name}.mat"), lateral="as-stored")
    assert dead_reckoning_error(stored) == pytest.approx(stored_m, rel=0.002)
    sequence = open_sequence(data_path(f"utias/{name}.mat"))
    assert len(sequence) == frames
    assert dead_reckoning_error(sequence) == pytest.approx(corrected_m, rel=0.002)
    assert inspect_tracks(sequence.observations, sequence.twist).repeated_frames.size == 0


@pytest.mark.data
def test_starry_night_landmarks_reproject_with_the_stated_noise(data_path):
    sequence = open_sequence(data_path("utias/dataset3.mat"))
    observations, truth = sequence.observations, sequence.truth
    T_cam_world = sequence.T_cam_imu @ se3.inverse(truth.T_world_imu)
    q = se3.apply(T_cam_world[observations.frame], truth.position_m[observations.landmark])
    residual = observations.pixels_px - project(sequence.camera, q)
    np.testing.assert_allclose(residual.std(axis=0), sequence.noise.pixel_std_px, rtol=1e-3)
    np.testing.assert_allclose(residual.std(axis=0), [6.2, 11.4, 6.5, 11.5], atol=0.05)
    assert inspect_tracks(observations, sequence.twist).returning_tracks == 20


@pytest.mark.parametrize(
    "change", [lambda values: values + 1j, lambda values: np.array(["text"])], ids=["complex", "text"]
)
def test_variables_that_are_no_real_numbers_are_refused(tmp_path, change):
    fields = utias_fields()
    fields["v_vk_vk_i"] = change(fields["v_vk_vk_i"])
    path = write_mat(tmp_path / "drive.mat", fields)
    with pytest.raises(EkfslamError, match="v_vk_vk_i"):
        open_sequence(path)
