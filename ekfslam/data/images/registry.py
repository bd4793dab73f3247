"""How sources of images are found: a file of this folder that reads one holds an `ImageReader`.

To add a source is to add a file; nothing else names the sources. See `ekfslam.data.readers.registry`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ekfslam.data.images.pairs import ImageRecording
from ekfslam.data.readers.registry import Source, discovered


@dataclass(frozen=True)
class ImageReader:
    """A kind of image recordings.

    Args:
        name: The attribute ``reader`` of its sequences.
        expected: What a file or folder of it is called in messages, with its article.
        recognises: Whether a source is of this kind, by its content rather than by its name; never raises.
        open: The recording; raises `UnknownFormatError` or `DataError`.
    """

    name: str
    expected: str
    recognises: Callable[[Source], bool]
    open: Callable[[Source], ImageRecording]


def image_readers() -> tuple[ImageReader, ...]:
    """All of them, in the order of the files' names."""
    return discovered(ImageReader, __package__)
