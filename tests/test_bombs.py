"""Small files that would become large: shared lists, texts encoded again and again, compressed bags, ragged lists."""

from __future__ import annotations

import bz2
import contextlib
import os
import pickle
import re
import sqlite3
import struct
import time
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.bags import stereo, write
from support.images import write_plain
from support.npy import npy_fields, write_npy

from ekfslam import hdf5, open_images, open_sequence
from ekfslam.cli import main
from ekfslam.config import Config
from ekfslam.data.readers.calibrations import read_pair
from ekfslam.data.simulate import builtin
from ekfslam.errors import ArchiveError, EkfslamError, UnknownFormatError
from ekfslam.figures.older import archives_in, older_figures
from ekfslam.limits import reading_up_to
from ekfslam.reports import compared_table
from ekfslam.studies.sweep import Sweep


def npy_of(path: Path, pickled: bytes) -> Path:
    """An .npy file of an array of one object that some bytes pickle."""
    head = b"{'descr': '|O', 'fortran_order': False, 'shape': (), }"
    head += b" " * (63 - (len(head) + 10) % 64) + b"\n"
    path.write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + pickled)
    return path


def test_shared_lists_are_counted_wherever_they_occur(tmp_path):
    value: object = [1.0] * 10
    for _ in range(30):
        value = [value] * 10
    path = npy_of(tmp_path / "a.npy", pickle.dumps({"timestamps": value}, 2))
    assert path.stat().st_size < 3000
    with pytest.raises(UnknownFormatError, match=r"a\.npy: the dictionary with all its lists claims .* --read-limit"):
        open_sequence(path)


def test_a_list_that_contains_itself_is_refused(tmp_path):
    value: list[object] = [1.0]
    value.append(value)
    with pytest.raises(UnknownFormatError, match="a list that contains itself"):
        open_sequence(npy_of(tmp_path / "a.npy", pickle.dumps({"timestamps": value}, 2)))


def test_a_text_that_is_encoded_again_and_again_is_counted(tmp_path):
    text = "x" * 1_000_000
    encode = b"c_codecs\nencode\n"
    body = b"\x80\x02}X" + struct.pack("<I", 1) + b"a]("
    first = encode + b"X" + struct.pack("<I", len(text)) + text.encode() + b"q\x01X\x06\x00\x00\x00latin1\x86R"
    again = encode + b"h\x01X\x06\x00\x00\x00latin1\x86R"
    path = npy_of(tmp_path / "a.npy", body + first + again * 400 + b"es.")
    with reading_up_to(0.05), pytest.raises(UnknownFormatError, match=r"a\.npy: the text in it claims"):
        open_sequence(path)


FIELDS = ("features", "timestamps", "v_t", "w_t", "K_l", "K_r", "extL_T_imu", "extR_T_imu")


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("ragged", [[[1.0, 2.0], [3.0]], [[1.0], 2.0], [[], [[1.0]]]], ids=["rows", "mixed", "deep"])
def test_ragged_lists_are_a_named_error(tmp_path, field, ragged):
    path = write_npy(tmp_path / "a.npy", {**npy_fields(builtin("loop?frames=5")), field: ragged})
    with pytest.raises(EkfslamError, match=field):
        open_sequence(path)


def test_a_bag_that_is_compressed_as_a_whole_is_counted_before_it_is_written(tmp_path):
    zstd = pytest.importorskip("rosbags.rosbag2.reader").zstd
    path = write(tmp_path, stereo())
    file = next(path.glob("*.db3"))
    file.with_name(f"{file.name}.zstd").write_bytes(zstd.compress(bytes(80_000_000)))
    file.unlink()
    with (
        reading_up_to(0.01),
        pytest.raises(UnknownFormatError, match="the file, decompressed, claims"),
    ):
        open_images(path)


def test_messages_that_are_compressed_one_by_one_are_counted(tmp_path):
    zstd = pytest.importorskip("rosbags.rosbag2.reader").zstd
    path = write(tmp_path, stereo())
    metadata = path / "metadata.yaml"
    text = re.sub(r"compression_format: .*", "compression_format: zstd", metadata.read_text())
    metadata.write_text(re.sub(r"compression_mode: .*", "compression_mode: MESSAGE", text))
    with contextlib.closing(sqlite3.connect(next(path.glob("*.db3")))) as database:
        database.execute("UPDATE messages SET data = ?", (zstd.compress(bytes(80_000_000)),))
        database.commit()
    with reading_up_to(0.01), pytest.raises(UnknownFormatError, match="decompressed, claims"):
        open_images(path)


@pytest.mark.parametrize("claims", [80_000_000, 100])
@pytest.mark.parametrize("frames", [1, 40])
def test_a_chunk_of_mcap_is_counted_whatever_it_claims(tmp_path, claims, frames):
    zstd = pytest.importorskip("rosbags.rosbag2.reader").zstd
    data = zstd.compress(bytes(80_000_000 // frames)) * frames
    chunk = struct.pack("<QQQII", 0, 1, claims, 0, 4) + b"zstd" + struct.pack("<Q", len(data)) + data
    path = tmp_path / "a.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + b"\x06" + struct.pack("<Q", len(chunk)) + chunk)
    with reading_up_to(0.01), pytest.raises(UnknownFormatError, match=r"a\.mcap: a chunk.* claims .* --read-limit"):
        open_images(path)


@pytest.mark.parametrize("claims", [80_000_000, 100])
def test_a_chunk_of_ros1_is_counted_whatever_it_claims(tmp_path, claims):
    def record(fields: dict[bytes, bytes], data: bytes) -> bytes:
        header = b"".join(struct.pack("<I", len(k) + len(v) + 1) + k + b"=" + v for k, v in fields.items())
        return struct.pack("<I", len(header)) + header + struct.pack("<I", len(data)) + data

    fields = {b"op": b"\x05", b"compression": b"bz2", b"size": struct.pack("<I", claims)}
    path = tmp_path / "a.bag"
    path.write_bytes(b"#ROSBAG V2.0\n" + record(fields, bz2.compress(bytes(80_000_000))))
    with reading_up_to(0.01), pytest.raises(UnknownFormatError, match=r"a\.bag: a chunk.* claims .* --read-limit"):
        open_images(path)


@pytest.mark.parametrize("kind", ["ros1", "mcap", "ros2"])
def test_bags_of_usual_sizes_are_read_within_a_small_limit(tmp_path, kind):
    path = write(tmp_path, stereo(), kind)
    with reading_up_to(0.01):
        assert open_images(path) is not None


def test_a_jpeg_of_thousands_of_scans_is_refused_before_they_are_decoded(tmp_path):
    from PIL import Image as Pillow

    from ekfslam.data.readers.pictures import read_gray

    path = tmp_path / "a.jpg"
    Pillow.fromarray(np.zeros((500, 500), np.uint8)).save(path, progressive=True)
    assert read_gray(path).shape == (500, 500)
    content = path.read_bytes()
    last = content.rindex(b"\xff\xda")
    path.write_bytes(content[:last] + content[last:-2] * 3000 + b"\xff\xd9")  # 28 s at 2000 x 2000 pixels
    with pytest.raises(UnknownFormatError, match=r"a\.jpg: the image with all its scans claims .* --read-limit"):
        read_gray(path)


@pytest.mark.parametrize("comment", [b"#" + b"x" * 3_000_000, b"# x\n" * 500_000])
def test_comments_of_a_pgm_without_an_end_are_not_read(tmp_path, comment):
    from ekfslam.data.readers.pictures import pair_files, read_gray

    path = tmp_path / "a.pgm"
    path.write_bytes(b"P5 " + comment + b"\n1 1 255\n0")  # 1.2 us a byte
    before = time.process_time()
    for read in (read_gray, lambda path: pair_files([path], [path])):
        with pytest.raises(UnknownFormatError, match=r"a\.pgm: not a readable image"):
            read(path)
    assert time.process_time() - before < 1.0


@pytest.mark.parametrize("key", ["T_right_left", "T_cam_imu", "intrinsics", "distortion"])
@pytest.mark.parametrize(
    "value", ["[[1], [2, 3]]", "[1, [2]]", "[true, 1, 1, 1]", "['1', '1', '1', '1']", "[[], 1]", "{ a = 1 }", "nan"]
)
def test_lists_in_a_calibration_that_are_no_numbers_are_a_named_error(tmp_path, key, value):
    folder = write_plain(tmp_path)
    calibration = folder / "calibration.toml"
    lines = [line for line in calibration.read_text().splitlines() if not line.startswith(f"{key} ")]
    at = lines.index("[left_camera]") + 1 if key in ("intrinsics", "distortion") else 0
    calibration.write_text("\n".join([*lines[:at], f"{key} = {value}", *lines[at:]]))
    with pytest.raises(EkfslamError, match=rf"calibration\.toml: .*{key}"):
        open_images(folder)


@pytest.mark.parametrize("suffix", ["png", "tiff", "pgm"])
def test_images_that_claim_huge_sizes_are_refused_by_their_header(tmp_path, suffix):
    from PIL import Image as Pillow

    from ekfslam.data.readers.pictures import read_gray

    path = tmp_path / f"a.{suffix}"
    Pillow.fromarray(np.zeros((4000, 4000), np.uint8)).save(path)
    with reading_up_to(0.02), pytest.raises(UnknownFormatError, match=r"the image claims .* --read-limit"):
        read_gray(path)


def test_a_matrix_of_millions_of_empty_elements_is_refused_at_once(tmp_path):
    element = struct.pack("<II", 14, 1 << 24) + bytes(1 << 24)  # eight bytes of zeros are an empty element
    data = zlib.compress(element, 9)
    path = tmp_path / "a.mat"
    head = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM"
    path.write_bytes(head + struct.pack("<II", 15, len(data)) + data)
    begin = time.process_time()
    with pytest.raises(UnknownFormatError, match=r"damaged \.mat file"):
        open_sequence(path)
    assert time.process_time() - begin < 1.0


ENDLESS = "WITH RECURSIVE r(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM r)"
ROWS = {
    "view": f"DROP TABLE schema; CREATE VIEW schema AS {ENDLESS} SELECT max(n) AS schema_version FROM r",
    "column": "ALTER TABLE messages ADD COLUMN more BLOB GENERATED ALWAYS AS (zeroblob(900000000)) VIRTUAL",
    "default": f"ALTER TABLE messages ADD COLUMN more TEXT DEFAULT '{'x' * 20_000}'",
    "virtual": "CREATE VIRTUAL TABLE more USING rtree(id, a, b)",
}


@pytest.mark.parametrize("kind", ROWS)
def test_a_bag_whose_rows_are_computed_is_refused(tmp_path, kind):
    path = write(tmp_path, stereo(), "ros2")
    with contextlib.closing(sqlite3.connect(next(path.rglob("*.db3")))) as database:
        database.executescript(ROWS[kind])
    with pytest.raises(UnknownFormatError, match="is a view, trigger or computed column, which no bag has"):
        open_sequence(path)


@pytest.mark.parametrize("kind", ["metadata", "database", "mcap"])
def test_descriptions_of_a_bag_that_would_take_minutes_are_refused(tmp_path, kind):
    path, long = write(tmp_path, stereo(), "mcap" if kind == "mcap" else "ros2"), b"1, " * 400_000
    if kind == "metadata":
        (path / "metadata.yaml").write_bytes((path / "metadata.yaml").read_bytes() + b"more: [" + long + b"1]")
    elif kind == "database":
        with contextlib.closing(sqlite3.connect(next(path.rglob("*.db3")))) as database:
            database.execute("UPDATE topics SET offered_qos_profiles = ?", (long.decode(),))
            database.commit()
    else:
        file = path if path.is_file() else next(path.rglob("*.mcap"))
        content = file.read_bytes()
        file.write_bytes(content[:8] + b"\x04" + struct.pack("<Q", len(long)) + long + content[8:])
    with pytest.raises(UnknownFormatError, match=r"descriptions of .* bytes, which no bag has"):
        open_sequence(path)


def test_keys_and_numbers_of_a_calibration_take_time_in_proportion_to_their_length(tmp_path):
    path, begin = tmp_path / "a.yaml", time.process_time()
    path.write_text("K" * 1_000_000 + ":\n" + "".join(f" a{i}: 1\n" for i in range(100_000)))
    with pytest.raises(UnknownFormatError, match="a key with those above it claims"):
        read_pair(path)
    path.write_text("cam0:\n  intrinsics: [" + "1" * 100_000 + "a]\n  camera_model: pinhole\n")
    with pytest.raises(EkfslamError, match="expected numbers"):
        read_pair(path)
    (tmp_path / "c.toml").write_text("a" + ".a" * 100_000 + " = 1")
    for read in (Config.from_toml, read_pair, Sweep.from_toml):
        with pytest.raises(EkfslamError, match="too many dots"):
            read(tmp_path / "c.toml")
    assert time.process_time() - begin < 2.0


@pytest.mark.parametrize("header", ["time,a_x," + "(" * 50_000, "time,v" + " " * 50_000 + "x"], ids=["(", "blanks"])
def test_a_header_takes_time_in_proportion_to_its_length(tmp_path, header):
    path, begin = tmp_path / "a.csv", time.process_time()
    path.write_text(header + "\n0,0,0\n")
    for kind in ("velocities", "imu"):
        with pytest.raises(EkfslamError):
            open_sequence("builtin:loop?frames=5", **{kind: path})
    assert time.process_time() - begin < 2.0


def test_a_directory_of_a_zip_file_with_too_many_entries_is_refused(tmp_path):
    path = tmp_path / "a.npz"
    path.write_bytes(b"PK\x03\x04" + (b"PK\x01\x02" + bytes(42)) * 20_000)
    with pytest.raises(UnknownFormatError, match="a zip file of 20000 entries"):
        open_sequence(path)


@pytest.mark.parametrize("where", ["attribute", "data set"])
def test_texts_that_are_one_and_the_same_in_the_file_are_counted(tmp_path, where):
    path, texts = tmp_path / "a.h5", ["x" * 10_000] + ["y"] * 3000
    with h5py.File(path, "w") as h5file:
        if where == "attribute":
            h5file.attrs.create("more", texts, dtype=h5py.string_dtype())
        else:
            h5file.create_dataset("more", data=texts, dtype=h5py.string_dtype())
    content = path.read_bytes()
    place = re.search(struct.pack("<I", 10_000) + b".{12}" + struct.pack("<I", 1), content, re.S).start()
    path.write_bytes(content[:place] + content[place : place + 16] * 3001 + content[place + 16 * 3001 :])
    assert path.stat().st_size < 150_000
    with reading_up_to(0.02), pytest.raises(ArchiveError, match=r"more.* claims .* --read-limit"):
        hdf5.opened(path, "any", 1).__enter__()


def test_pipes_beside_and_in_place_of_a_file_are_not_read(tmp_path, capsys, monkeypatch):
    for name in ("a.h5", "figure.png", "summary.json"):
        os.mkfifo(tmp_path / name)
    assert main(["info", str(tmp_path / "a.h5")]) == 2
    assert "it is no regular file" in capsys.readouterr().err
    with pytest.raises(ArchiveError, match="no summary of compare"):
        compared_table([tmp_path])
    assert older_figures(tmp_path / "a.h5") == []


def test_the_marks_of_a_picture_take_time_in_proportion_to_their_length(tmp_path):
    path, begin = tmp_path / "a.png", time.process_time()
    path.write_bytes(b"ekfslam_shows:" * 100_000)
    assert archives_in(path) == set() and time.process_time() - begin < 0.5
