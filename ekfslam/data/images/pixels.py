"""One image file as gray pixels, whatever it is compressed by."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image as Pillow
from PIL import UnidentifiedImageError

from ekfslam.data.images.pairs import Image
from ekfslam.errors import CalibrationError, UnknownFormatError
from ekfslam.limits import Budget, require_file

_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "PPM")  # PPM: pgm as well


def read_gray(path: Path, size: tuple[int, int] | None = None) -> Image:
    """An image file as (height, width) uint8; colours become luma, 16 bits their upper eight.

    Args:
        path: The file.
        size: Width and height that it must have; any by default.

    Raises:
        UnknownFormatError: It is missing, damaged, too large or no image.
        CalibrationError: It has another size.
    """
    require_file(path)
    return decode_gray(path.read_bytes(), str(path), size)


def decode_gray(content: bytes, source: str, size: tuple[int, int] | None = None) -> Image:
    """`read_gray` of the bytes of an image file; ``source`` names it in messages."""
    try:
        with Pillow.open(io.BytesIO(content), formats=_FORMATS) as image:
            _require_size(image.size, source, size)
            if image.mode.startswith("I"):
                return np.ascontiguousarray(np.asarray(image, dtype=np.uint32) >> 8, dtype=np.uint8)
            return np.asarray(image if image.mode == "L" else image.convert("L"))
    except (OSError, ValueError, SyntaxError, UnidentifiedImageError, Pillow.DecompressionBombError) as error:
        raise UnknownFormatError(f"{source}: not a readable image ({error})") from None


def size_of(path: Path) -> tuple[int, int]:
    """Width and height of an image file from its header alone.

    Raises:
        UnknownFormatError: It is missing, damaged or no image.
    """
    require_file(path)
    try:
        with Pillow.open(path, formats=_FORMATS) as image:
            return image.size
    except (OSError, ValueError, SyntaxError, UnidentifiedImageError, Pillow.DecompressionBombError) as error:
        raise UnknownFormatError(f"{path}: not a readable image ({error})") from None


def _require_size(found: tuple[int, int], source: str, wanted: tuple[int, int] | None) -> None:
    Budget(source).take(4 * found[0] * found[1], "the image")
    if wanted is not None and found != wanted:
        raise CalibrationError(
            f"the image has {found[0]} x {found[1]} pixels, the calibration {wanted[0]} x {wanted[1]}", source=source
        )


@dataclass(frozen=True)
class PairFiles:
    """Files of image pairs: `ImageRecording.load` of what lies in folders.

    Args:
        left, right: Path of each frame's image.
        size: Width and height that all must have.
    """

    left: Sequence[Path]
    right: Sequence[Path]
    size: tuple[int, int]

    def __call__(self, frame: int) -> tuple[Image, Image]:
        return read_gray(self.left[frame], self.size), read_gray(self.right[frame], self.size)
