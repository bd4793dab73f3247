"""Run the missing runs of a study or sweep, and save each finished run to the disk at once.

An archive is written as a whole, which a large study cannot afford after every run. So finished runs are appended to a
journal next to the archive, each with its length and digest. An entry that a kill left incomplete is not read.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ekfslam import files
from ekfslam.errors import ArchiveError, WriteError
from ekfslam.names import printable
from ekfslam.progress import progress
from ekfslam.studies.executors import completed

_LENGTH, _DIGEST = 8, 32  # bytes before an entry
_LONGEST = 1 << 30

Record = Mapping[str, Mapping[str, NDArray]]  # variant, field, value of one run
Key = tuple[str, int]  # of a run: level and number in a study; digest and 0 in a sweep


def run_missing(
    journal: Journal,
    earlier: Callable[[], Iterable[tuple[Key, Record]]],
    missing: Callable[[], Mapping[Key, Any]],
    submit: Callable[..., Future[Any]],
    keep: Callable[[Key, Record], None],
    save: Callable[[], None],
    label: str,
) -> None:
    """Run what archive and journal do not hold, and save the archive at the end or when an exception interrupts.

    ``keep`` takes in the records of the runs that the archive holds (``earlier``), of those in the journal, which a
    kill has left, and of new ones. Then ``missing`` are arguments of ``submit`` by key. Without a ``label`` there is no
    progress bar. Raise an `ArchiveError` if archive or journal are of another study or damaged; nothing is changed
    then. Raise a `WriteError` if another study writes there.
    """
    with files.held(journal.path):
        for key, record in chain(earlier() if journal.archive.exists() else (), journal.entries()):
            keep(key, record)
        tasks = missing()
        finished: Iterable[tuple[Key, Record]] = completed(tasks, lambda key: submit(*tasks[key]))
        if label:
            finished = progress(finished, label, "run", total=len(tasks))
        try:
            for key, record in finished:
                journal.append(key, record)
                keep(key, record)
        finally:
            save()
            journal.remove()


class Journal:
    """File of finished runs that an archive does not hold yet.

    It begins with everything that decides the numbers of the ``study``. ``blank`` makes an empty record of a level.
    """

    def __init__(self, archive: Path, study: Any, blank: Callable[[str], Record]) -> None:
        self.archive, self.path, self.blank = archive, archive.with_name(f".{archive.name}.journal"), blank
        self._heading = json.dumps(study, sort_keys=True).encode()

    def entries(self) -> Iterator[tuple[Key, Record]]:
        """Yield key and record of each complete run; raise `ArchiveError` if one is of another study."""
        found, seen = _read(self.path), dict[Key, bytes]()
        if next(found, self._heading) != self._heading:
            raise ArchiveError(f"{self.path} holds runs of another study; move it away or choose another folder")
        for entry in found:
            try:
                heading, _, content = entry.partition(b"\n")
                level, run = json.loads(heading)
                if not (type(level) is str and type(run) is int and run >= 0):
                    raise ValueError(f"{printable(repr([level, run]))} is no run")
                if seen.setdefault((level, run), content) != content:
                    raise ValueError(f"run {run} of {printable(level)} is there twice")
                yield (level, run), self._filled(level, content)
            except (ValueError, TypeError, LookupError, RecursionError) as error:
                raise ArchiveError(f"{self.path}: damaged ({error})") from None

    def _filled(self, level: str, content: bytes) -> Record:
        record, at = self.blank(level), 0
        for fields in record.values():
            for value in fields.values():
                part = np.frombuffer(content, value.dtype, value.size, at)
                if value.dtype == bool and (part.view(np.uint8) > 1).any():
                    raise ValueError("a truth value is neither 0 nor 1")
                value[...] = part.reshape(value.shape)
                at += part.nbytes
        if at != len(content):
            raise ValueError(f"a run of {len(content)} bytes, expected {at}")
        return record

    def append(self, key: Key, record: Record) -> None:
        """Append a run and wait until it is on the disk; `WriteError` if that is full."""
        blank = self.blank(key[0])
        parts = [np.asarray(record[v][f], x.dtype).tobytes() for v, fields in blank.items() for f, x in fields.items()]
        before = self.path.stat().st_size if self.path.is_file() else 0
        content = b"" if before else framed(self._heading)
        content += framed(json.dumps(key).encode() + b"\n" + b"".join(parts))
        try:
            with self.path.open("ab") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            if self.path.is_file():  # without the part that a full disk has taken
                os.truncate(self.path, before)
            raise WriteError(f"{self.path}: cannot be written: {error.strerror or error}") from None

    def remove(self) -> None:
        """Delete the file: the archive holds everything."""
        self.path.unlink(missing_ok=True)


def flat(values: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield the values of nested mappings under dotted names."""
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from ((f"{key}.{name}", inner) for name, inner in flat(value))
        else:
            yield key, value


def framed(content: bytes) -> bytes:
    """Return an entry as it is stored: length, digest, content."""
    return len(content).to_bytes(_LENGTH, "big") + hashlib.sha256(content).digest() + content


def _read(path: Path) -> Iterator[bytes]:
    """Yield the entries of a file up to the first incomplete one, and drop the rest of the file."""
    if not path.is_file():
        return
    end = 0
    with path.open("rb") as file:
        while len(head := file.read(_LENGTH + _DIGEST)) == _LENGTH + _DIGEST:
            length = int.from_bytes(head[:_LENGTH], "big")
            content = file.read(length) if length <= _LONGEST else b""
            if len(content) != length or hashlib.sha256(content).digest() != head[_LENGTH:]:
                break
            end = file.tell()
            yield content
    if end < path.stat().st_size:
        os.truncate(path, end)  # or entries that are appended would never be read
