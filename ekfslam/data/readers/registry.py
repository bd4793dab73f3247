"""How formats are found: a file of this folder that reads a format holds a `Reader`, a `TruthReader`, or both.

To add a format is to add a file; nothing else names the formats. This is a whole one::

    def _open(source: Source) -> Sequence:
        ...

    READER = Reader("mine", "a .mine file", lambda source: source.head.startswith(b"MINE"), _open)
"""

from __future__ import annotations

import importlib
import pkgutil
import stat
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol, TypeVar

from ekfslam.arrays import Array
from ekfslam.data.sequence import Sequence
from ekfslam.data.truth_noise import TruthNoise

Extrinsics = Literal["corrected", "as-stored"]
Lateral = Literal["corrected", "as-stored"]
Entry = TypeVar("Entry")

_HEAD_BYTES = 128


@dataclass(frozen=True)
class Source:
    """What is to be opened.

    Args:
        place: Path of a file or folder, or the name of what is no file.
        extrinsics: How to take the extrinsics of a format that stores them ambiguously.
        lateral: How to take the lateral velocity of a format that stores level velocities.
        head: The first 128 bytes; empty for what is no file.
        problem: Why there is no ``head``; empty where there is one.
    """

    place: str
    extrinsics: Extrinsics
    lateral: Lateral
    head: bytes
    problem: str

    @property
    def path(self) -> Path:
        return Path(self.place)

    @staticmethod
    def at(place: str | Path, extrinsics: Extrinsics, lateral: Lateral) -> Source:
        """The source at a place, whatever is there."""
        problem = ""
        try:
            if stat.S_ISREG(Path(place).stat().st_mode):
                with Path(place).open("rb") as file:
                    return Source(str(place), extrinsics, lateral, file.read(_HEAD_BYTES), "")
            problem = "it is a directory" if Path(place).is_dir() else "it is no regular file"
        except (OSError, ValueError) as error:
            problem = str(getattr(error, "strerror", None) or error)
        return Source(str(place), extrinsics, lateral, b"", problem)


@dataclass(frozen=True)
class Reader:
    """A format of recordings.

    Args:
        name: The attribute ``reader`` of its sequences.
        expected: What a file or folder of it is called in messages, with its article.
        recognises: Whether a source is of this format, by its content rather than by its name.
        open: The recording; raises `UnknownFormatError` or `DataError`.
    """

    name: str
    expected: str
    recognises: Callable[[Source], bool]
    open: Callable[[Source], Sequence]


@dataclass(frozen=True)
class Poses:
    """True poses as a file has them.

    Args:
        T_world_imu: (F, 4, 4).
        time_s: (F,) their stamps, which increase; None where row i is the pose of frame i.
        files: What was read.
        noise: How far they may be wrong; None: the format says nothing of it.
    """

    T_world_imu: Array
    time_s: Array | None
    files: tuple[Path, ...]
    noise: TruthNoise | None = None


@dataclass(frozen=True)
class TruthReader:
    """A format of true poses.

    Args:
        name: Of the format.
        expected: What a file or folder of it is called in messages.
        recognises: Whether a path is of this format, by its content rather than by its name.
        read: The poses in it, for a sequence whose extrinsics it may need; raises `UnknownFormatError` or `DataError`.
    """

    name: str
    expected: str
    recognises: Callable[[Path], bool]
    read: Callable[[Path, Sequence], Poses]


def discovered(kind: type[Entry], folder: str = __package__) -> tuple[Entry, ...]:
    """The entries of a kind in all files of a package, by default this one, in the order of the files' names."""
    package = importlib.import_module(folder)
    modules = [importlib.import_module(f"{folder}.{file.name}") for file in pkgutil.iter_modules(package.__path__)]
    entries = [value for module in modules for value in vars(module).values() if isinstance(value, kind)]
    return tuple(dict.fromkeys(entries))


class Expected(Protocol):
    """What a source can be of."""

    @property
    def expected(self) -> str:
        """What a file or folder of it is called in messages, with its article."""


def listed(entries: Iterable[Expected]) -> str:
    """What the formats of readers are called, as one clause that begins with "expected"."""
    *others, last = (entry.expected for entry in entries)
    return f"expected {', '.join(others)} or {last}" if others else f"expected {last}"
