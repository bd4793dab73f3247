"""Sizes of compressed parts of bags, found piece by piece within the budget before anything is kept."""

from __future__ import annotations

import bz2
import contextlib
import re
import sqlite3
import struct
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from ekfslam.data.readers.text import read_lines
from ekfslam.errors import UnknownFormatError
from ekfslam.limits import Budget
from ekfslam.names import printable

_PIECE = 1 << 20
_MOST_LZ4 = 255  # times its size that lz4 may become
_GENEROUS = 20  # times its own size that a compressed file may become, beyond the limit of reading
_MCAP, _ROS1 = b"\x89MCAP0\r\n", b"#ROSBAG V2.0"
_CHANNEL, _CHUNK = 4, 6  # MCAP
_MOST_YAML = 1_000_000  # bytes of descriptions in a bag; the package parses a hundred thousand a second
_ODD_ENTRY = "type NOT IN ('table', 'index') OR sql LIKE 'create virtual%' OR length(sql) > 10000"  # long defaults


def require_room(path: Path) -> None:
    """Raise an `UnknownFormatError` if a bag claims more memory, or temporary disk, than may be read of a file."""
    metadata = path / "metadata.yaml"
    if metadata.is_file():
        _require_short_yaml(metadata.stat().st_size, metadata)
    lines = read_lines(metadata, "") if metadata.is_file() else []
    by_message = any(re.fullmatch(r"\s*compression_mode:\s*[\"']?message[\"']?\s*", line, re.I) for line in lines)
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        if not file.is_file():
            continue
        if file.suffix == ".db3":
            _require_plain_tables(file)
        if by_message and file.suffix == ".db3":
            for data in _messages(file):
                _require_small("zstd", data, str(file))
        elif file.suffix in (".zstd", ".zst"):
            budget = Budget(str(file))
            budget.left = max(budget.left, _GENEROUS * file.stat().st_size)
            with _zstd().open(file, "rb") as stream:
                while piece := stream.read(_PIECE):
                    budget.take(len(piece), "the file, decompressed,")
        else:
            _require_small_chunks(file)


def _require_short_yaml(size: int, file: Path | str) -> None:
    """Refuse descriptions that the parser of the package would take minutes for."""
    if size > _MOST_YAML:
        raise UnknownFormatError(f"{file}: descriptions of {size} bytes, which no bag has")


def _require_plain_tables(file: Path) -> None:
    """Refuse a database whose rows are computed rather than stored: they may have no end. Damaged ones pass."""
    with contextlib.suppress(sqlite3.Error), contextlib.closing(_database(file)) as database:
        odd = list(database.execute(f"SELECT name FROM sqlite_master WHERE {_ODD_ENTRY}"))
        tables = [] if odd else list(database.execute("SELECT name FROM sqlite_master WHERE type = 'table'"))
        for table in tables:
            odd += database.execute("SELECT name FROM pragma_table_xinfo(?) WHERE hidden", table)
        if odd:
            name = printable(str(odd[0][0]))
            raise UnknownFormatError(f"{file}: {name} is a view, trigger or computed column, which no bag has")
        for (size,) in database.execute("SELECT sum(length(offered_qos_profiles)) FROM topics"):
            _require_short_yaml(size or 0, file)


def _database(file: Path) -> sqlite3.Connection:
    return sqlite3.connect(f"{file.resolve().as_uri()}?immutable=1", uri=True)


def _messages(file: Path) -> Iterator[bytes]:
    """Yield the messages of a bag in SQLite; none if it is damaged, which its reader names."""
    with contextlib.suppress(sqlite3.Error), contextlib.closing(_database(file)) as database:
        for (data,) in database.execute("SELECT data FROM messages"):
            if isinstance(data, bytes):
                yield data


def _require_small_chunks(file: Path) -> None:
    with file.open("rb") as stream:
        head = stream.read(len(_ROS1) + 1)
        if head.startswith(_MCAP):
            stream.seek(len(_MCAP))
            _walk_mcap(stream, str(file))
        elif head.startswith(_ROS1):
            _walk_ros1(stream, str(file))


def _walk_mcap(stream: Any, source: str) -> None:
    described = 0
    while len(head := stream.read(9)) == 9:
        code, size = head[0], int.from_bytes(head[1:], "little")
        end = stream.tell() + size
        if code == _CHANNEL:
            described += size
            _require_short_yaml(described, source)
        if code == _CHUNK:
            claimed, length = struct.unpack("<Q4xI", stream.read(32)[16:])
            name = stream.read(min(length, 32)).decode("ascii", "replace")
            Budget(source).take(claimed, "a chunk")
            stored = int.from_bytes(stream.read(8), "little")
            _require_small(name, stream.read(min(stored, size)), source)
        stream.seek(end)


def _walk_ros1(stream: Any, source: str) -> None:
    while len(head := stream.read(4)) == 4:
        header = stream.read(int.from_bytes(head, "little"))
        fields = _fields(header)
        size = int.from_bytes(stream.read(4), "little")
        end = stream.tell() + size
        if fields.get(b"op") == b"\x05":
            Budget(source).take(int.from_bytes(fields.get(b"size", b""), "little"), "a chunk")
            _require_small(fields.get(b"compression", b"").decode("ascii", "replace"), stream.read(size), source)
        stream.seek(end)


def _fields(header: bytes) -> dict[bytes, bytes]:
    """Return the fields of a record of ROS 1 by name."""
    found, at = {}, 0
    while at + 4 <= len(header):
        size = int.from_bytes(header[at : at + 4], "little")
        name, _, value = header[at + 4 : at + 4 + size].partition(b"=")
        found[name] = value
        at += 4 + size
    return found


def _require_small(name: str, data: bytes, source: str) -> None:
    """Raise unless data of a compression fits into the budget; unknown and damaged data are left to their reader."""
    budget = Budget(source)
    if name == "zstd":
        _count(data, _zstd().ZstdDecompressor, budget)
    elif name == "bz2":
        _count(data, bz2.BZ2Decompressor, budget)
    elif name == "lz4" and len(data) * _MOST_LZ4 > budget.left:
        from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]

        _count(data, LZ4FrameDecompressor, budget)


def _count(data: bytes, make: Callable[[], Any], budget: Budget) -> None:
    """Take the sizes of all frames of some data from a budget."""
    while data:
        decompressor = make()
        piece, rest = b"", data
        while not decompressor.eof:
            try:
                piece = decompressor.decompress(rest, max_length=_PIECE)
            except (OSError, EOFError, RuntimeError, ValueError, _zstd().ZstdError):
                return
            budget.take(len(piece), "a chunk, decompressed,")
            if not piece and decompressor.needs_input:
                return
            rest = b""
        data = decompressor.unused_data or b""


def _zstd() -> Any:
    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd
    return zstd
