"""The registry of formats: each file of this folder that reads a format holds a `Reader` of it.

To add a format, add a file; no other file names the formats. This is a complete one::

    READER = Reader("mine", "a .mine file", lambda source: source.head.startswith(b"MINE"), read_tracks)
"""

from __future__ import annotations

import importlib
import pkgutil
import stat
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ekfslam.data.images import ImageRecording
from ekfslam.data.inertial import InertialRows
from ekfslam.data.inputs import VelocitySamples
from ekfslam.data.readers.poses import Poses
from ekfslam.data.sequence import Sequence

Extrinsics = Literal["corrected", "as-stored"]
Lateral = Literal["corrected", "as-stored"]
Kind = Literal["tracks", "images", "truth", "inputs", "inertial"]

_HEAD_BYTES = 128
CALIBRATION = "calibration_sha256"  # attribute of recordings of images that were opened with `Source.calibration`


@dataclass(frozen=True)
class Source:
    """A file, folder or built-in world to be opened.

    Args:
        place: Path of a file or folder, or name of a built-in world.
        extrinsics: Reading of extrinsics that a format stores ambiguously.
        lateral: Reading of the lateral velocity of KITTI.
        head: First 128 bytes of a file; empty otherwise.
        problem: Reason why there is no ``head``; empty if there is one.
        topics: Topics of a bag to use, see `bags.open_bag`.
        calibration: File with the calibration of the pair, in place of that of the recording.
    """

    place: str
    extrinsics: Extrinsics
    lateral: Lateral
    head: bytes
    problem: str
    topics: tuple[str, ...] = ()
    calibration: str | None = None

    @property
    def path(self) -> Path:
        return Path(self.place)

    @staticmethod
    def at(place: str | Path, extrinsics: Extrinsics = "corrected", lateral: Lateral = "corrected") -> Source:
        """Return the source at a place, which need not exist."""
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
    """A format: how it is recognised, and what it gives.

    The functions raise `UnknownFormatError` or `DataError` for a damaged source. They return None if this source does
    not hold their kind of data.

    Args:
        name: Attribute ``reader`` of its recordings.
        expected: Description of such a source in messages, with its article.
        recognises: Test of the content of a source, not of its name; it never raises.
        tracks: Reader of stereo tracks.
        images: Reader of stereo images.
        truth: Reader of true poses, for a sequence whose extrinsics it may need.
        inputs: Reader of velocities for another recording.
        inertial: Reader of inertial samples for another recording.
    """

    name: str
    expected: str
    recognises: Callable[[Source], bool]
    tracks: Callable[[Source], Sequence | None] | None = None
    images: Callable[[Source], ImageRecording | None] | None = None
    truth: Callable[[Source, Sequence], Poses | None] | None = None
    inputs: Callable[[Source], VelocitySamples | None] | None = None
    inertial: Callable[[Source], InertialRows | None] | None = None


def readers(*kinds: Kind) -> tuple[Reader, ...]:
    """Return the readers that give at least one of some kinds, in the order of the names of their files."""
    package = importlib.import_module(__package__)
    modules = [importlib.import_module(f"{__package__}.{file.name}") for file in pkgutil.iter_modules(package.__path__)]
    found = dict.fromkeys(value for module in modules for value in vars(module).values() if isinstance(value, Reader))
    return tuple(reader for reader in found if any(getattr(reader, kind) is not None for kind in kinds))


def read_as(source: Source, kind: Kind, *arguments: Any) -> Any:
    """Return what the first suitable reader finds in a source, given its further arguments; None: no such data."""
    for reader in readers(kind):
        if reader.recognises(source):
            found = getattr(reader, kind)(source, *arguments)
            if found is not None:
                return found
    return None


def expected(*kinds: Kind) -> str:
    """Return the descriptions of all readers of some kinds, as a clause that begins with "expected"."""
    *others, last = (reader.expected for reader in readers(*kinds))
    return f"expected {', '.join(others)} or {last}" if others else f"expected {last}"
