"""The journal of a study: every finished run at once on the disk, until the archive holds it.

An archive is rewritten as a whole, which a large study cannot do after every run. The journal is a file beside it to
which entries are appended, each with its length and digest: whatever a kill leaves of the last one is not read. Its
first entry says which study it belongs to.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ekfslam.errors import ArchiveError, WriteError

_LENGTH, _DIGEST = 8, 32  # bytes before an entry
_LONGEST = 1 << 30

Record = Mapping[str, Mapping[str, NDArray]]  # variant, field, value of one run


class Journal:
    """Finished runs of a study that its archive does not hold yet.

    Args:
        archive: Path of the archive.
        study: What decides the numbers of its runs, ready for JSON: entries of another study are not read.
        blank: From a level to a record of it in which to put values: it says fields, shapes and types.
    """

    def __init__(self, archive: Path, study: Any, blank: Callable[[str], Record]) -> None:
        self.path, self.blank = archive.with_name(f".{archive.name}.journal"), blank
        self._heading = json.dumps(study, sort_keys=True).encode()

    def entries(self) -> Iterator[tuple[str, int, Record]]:
        """Level, number and record of the runs in it, up to the first that is not whole.

        Raises:
            ArchiveError: It belongs to another study, or holds what is no run of this one.
        """
        found = _read(self.path)
        if next(found, self._heading) != self._heading:
            raise ArchiveError(f"{self.path} holds runs of another study; move it away or choose another folder")
        for entry in found:
            try:
                heading, _, content = entry.partition(b"\n")
                level, run = json.loads(heading)
                yield str(level), int(run), self._filled(level, content)
            except (ValueError, TypeError, LookupError, RecursionError) as error:
                raise ArchiveError(f"{self.path}: damaged ({error})") from None

    def _filled(self, level: str, content: bytes) -> Record:
        record, at = self.blank(level), 0
        for fields in record.values():
            for value in fields.values():
                part = np.frombuffer(content, value.dtype, value.size, at)
                value[...] = part.reshape(value.shape)
                at += part.nbytes
        if at != len(content):
            raise ValueError(f"a run of {len(content)} bytes, expected {at}")
        return record

    def append(self, level: str, run: int, record: Record) -> None:
        """Add a run; on return it is on the disk.

        Raises:
            WriteError: The disk is full.
        """
        blank = self.blank(level)
        parts = [
            np.asarray(record[variant][name], dtype=value.dtype).tobytes()
            for variant, fields in blank.items()
            for name, value in fields.items()
        ]
        heading = b"" if self.path.exists() else _framed(self._heading)
        self._write(heading + _framed(json.dumps([level, run]).encode() + b"\n" + b"".join(parts)))

    def _write(self, content: bytes) -> None:
        """Append on the disk; what a full disk took of it is cut off again."""
        before = self.path.stat().st_size if self.path.is_file() else 0
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("ab") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            if before:
                os.truncate(self.path, before)
            elif self.path.is_file():
                self.remove()
            raise WriteError(f"{self.path}: cannot be written: {error.strerror or error}") from None

    def remove(self) -> None:
        """The archive holds everything."""
        self.path.unlink(missing_ok=True)


def _framed(content: bytes) -> bytes:
    return len(content).to_bytes(_LENGTH, "big") + hashlib.sha256(content).digest() + content


def _read(path: Path) -> Iterator[bytes]:
    """The entries of a file up to the first that is not whole."""
    if not path.is_file():
        return
    with path.open("rb") as file:
        while len(head := file.read(_LENGTH + _DIGEST)) == _LENGTH + _DIGEST:
            length = int.from_bytes(head[:_LENGTH], "big")
            content = file.read(length) if length <= _LONGEST else b""
            if len(content) != length or hashlib.sha256(content).digest() != head[_LENGTH:]:
                return
            yield content
