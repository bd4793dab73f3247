"""Small files that claim to be large: refused by name before anything is allocated or decompressed."""

from __future__ import annotations

import io
import os
import struct
import tracemalloc
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.recordings import ece276a_fields, write_npz

from ekfslam import limits, open_sequence
from ekfslam.cli import main
from ekfslam.config import Config
from ekfslam.data.readers import write_sequence
from ekfslam.data.readers.matfile import parse_mat
from ekfslam.data.simulate import builtin
from ekfslam.errors import ConfigError, EkfslamError, UnknownFormatError

LARGE = 200_000_000  # entries, 1.6 GB


@contextmanager
def little_memory() -> Iterator[None]:
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < 50e6
    finally:
        tracemalloc.stop()


def header(shape: tuple[int, ...]) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return stream.getvalue()


def npz_of(path: Path, member: bytes, method: int = zipfile.ZIP_DEFLATED) -> Path:
    write_npz(path, {name: value for name, value in ece276a_fields().items() if name != "features"})
    with zipfile.ZipFile(path, "a", method) as archive:
        archive.writestr("features.npy", member)
    return path


def test_an_array_that_claims_more_than_its_file_is_refused(tmp_path):
    path = npz_of(tmp_path / "a.npz", header((4, 10, LARGE // 40)))
    with little_memory(), pytest.raises(UnknownFormatError, match=r"features\.npy claims the shape"):
        open_sequence(path)


@pytest.mark.slow
def test_zeros_that_deflate_to_nothing_are_refused_unread(tmp_path):
    path = tmp_path / "a.npz"
    path = npz_of(path, header((4, 10, LARGE // 40)) + bytes(8 * LARGE // 16))
    content = bytearray(path.read_bytes())
    directory = content.rindex(b"PK\x01\x02")
    content[directory + 24 : directory + 28] = struct.pack("<I", 8 * LARGE + 128)  # uncompressed size as claimed
    path.write_bytes(content)
    with little_memory(), pytest.raises(UnknownFormatError, match=r"claims 1\.6 GB.*--read-limit"):
        open_sequence(path)


def test_methods_that_no_npz_uses_are_refused(tmp_path):
    path = npz_of(tmp_path / "a.npz", header((4, 10, 7)) + bytes(8 * 280), zipfile.ZIP_LZMA)
    with pytest.raises(UnknownFormatError, match="compressed in a way"):
        open_sequence(path)


def mat_of(size: int, content: bytes) -> bytes:
    packed = zlib.compress(struct.pack("<II", 14, size) + content, 9)
    return bytes(126) + b"IM" + struct.pack("<II", 15, len(packed)) + packed


def test_a_variable_that_claims_gigabytes_is_refused_unread():
    budget = limits.Budget("a.mat")
    with little_memory(), pytest.raises(UnknownFormatError, match=r"a\.mat: a compressed variable claims 4\.29 GB"):
        parse_mat(mat_of((1 << 32) - 8, bytes(1_000)), budget)
    with little_memory(), pytest.raises(ValueError, match="compressed ones cannot hold"):
        parse_mat(mat_of(400_000_000, bytes(1_000)), limits.Budget("a.mat"))


@pytest.mark.slow
def test_what_a_variable_has_beyond_its_claim_is_not_decompressed():
    zeros = bytes(100_000_000)
    content = mat_of(1_000, zeros)
    del zeros
    with little_memory(), pytest.raises(struct.error):
        parse_mat(content, limits.Budget("a.mat"))


@pytest.fixture
def recording(tmp_path) -> Path:
    write_sequence(builtin("city?frames=20"), tmp_path / "a.h5")
    return tmp_path / "a.h5"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["unwritten", "unwritten chunks", "chunk", "crumbs", "bomb", "filter"])
def test_hdf5_that_claims_more_than_it_has_is_refused_unread(recording, kind):
    name = "sequence/observations/pixels"
    with h5py.File(recording, "a") as h5file:
        count = len(h5file["sequence/observations/frame"])
        del h5file[name]
        if kind == "unwritten":
            h5file.create_dataset(name, (LARGE // 40, 4), "f8")
        elif kind == "unwritten chunks":
            h5file.create_dataset(name, (LARGE // 40, 4), "f8", chunks=(1000, 4), compression="gzip")
        elif kind == "chunk":
            h5file.create_dataset(name, (count, 4), "f8", chunks=(LARGE // 4, 4), maxshape=(None, 4))
        elif kind == "crumbs":
            h5file.create_dataset(name, (LARGE // 40, 4), "f8", chunks=(1, 1))
        elif kind == "bomb":
            dataset = h5file.create_dataset(name, (count, 4), "f8", chunks=(count, 4), compression="gzip")
            dataset.id.write_direct_chunk((0, 0), zlib.compress(bytes(300_000_000), 9))
        else:
            h5file.create_dataset(name, data=np.ones((count, 4)), compression="lzf")
    words = {
        "unwritten": "of which the file has 0",
        "unwritten chunks": "damaged",
        "filter": "compressed in a way",
        "bomb": "become larger",
    }
    words |= {"chunk": "a part of .* claims 1.6 GB", "crumbs": "too many parts"}
    with little_memory(), pytest.raises(EkfslamError, match=words[kind]):
        open_sequence(recording)


def test_the_limit_is_one_of_all_arrays_together_and_an_option_raises_it(recording, capsys):
    with limits.reading_up_to(1e-5), pytest.raises(EkfslamError, match="--read-limit raises this"):
        open_sequence(recording)
    assert main(["info", str(recording), "--read-limit", "1e-5"]) == 2
    assert "--read-limit raises this" in capsys.readouterr().err
    assert main(["info", str(recording), "--read-limit", "0.001"]) == 0
    for wrong in (0, -1, float("nan"), float("inf")):
        with pytest.raises(ConfigError, match="limit of reading"), limits.reading_up_to(wrong):
            pass


def test_text_has_a_limit_too(tmp_path):
    path = tmp_path / "poses.txt"
    path.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 20)
    with limits.reading_up_to(1e-6), pytest.raises(EkfslamError, match=r"poses\.txt"):
        open_sequence("builtin:city?frames=20", truth=path)


@pytest.mark.parametrize("place", ["fifo", "/dev/zero"])
def test_what_never_ends_is_refused(tmp_path, place):
    path = Path(place) if place.startswith("/") else tmp_path / place
    if not path.exists():
        os.mkfifo(path)
    with pytest.raises(UnknownFormatError, match="no regular file"):
        open_sequence(path)
    with pytest.raises(EkfslamError):
        open_sequence("builtin:city?frames=20", truth=path)
    with pytest.raises(ConfigError, match="no regular file"):
        Config.from_toml(path)


@pytest.mark.parametrize(
    "text", ["a = " + "[" * 100_000, "a = 1" + "0" * 10_000, "[noise]\nsigma_px = " + "{a=" * 9_999]
)
def test_toml_that_is_deep_or_long_is_a_named_error(tmp_path, text):
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(ConfigError, match=r"a\.toml"):
        Config.from_toml(tmp_path / "a.toml")
