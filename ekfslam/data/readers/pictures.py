"""Image files: gray pixels, folders of numbered images, and pairs of equal stamps."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ekfslam.arrays import IntArray
from ekfslam.data.images import Image
from ekfslam.data.readers.poses import nearest
from ekfslam.errors import CalibrationError, LostDataError, UnknownFormatError
from ekfslam.limits import Budget, require_file

if TYPE_CHECKING:
    from PIL import Image as Pillow

SUFFIXES = (".png", ".jpg", ".jpeg", ".pgm", ".ppm", ".tif", ".tiff", ".bmp")
LEAST_PAIRED = 0.9  # of the images, that must have a partner
_TOLERANCE_NS = 5_000_000  # cameras that are not triggered together are no stereo pair
_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "PPM")  # PPM includes pgm


def read_gray(path: Path, size: tuple[int, int] | None = None) -> Image:
    """Read an image file as (height, width) uint8. Colours become luma, 16 bits their upper eight.

    ``size`` is the required width and height; any by default.
    """
    require_file(path)
    return decode_gray(path.read_bytes(), str(path), size)


def decode_gray(content: bytes, source: str, size: tuple[int, int] | None = None) -> Image:
    """Return `read_gray` of the bytes of an image file; ``source`` names it in messages."""
    with _opened(io.BytesIO(content), source) as image:
        width, height = image.size
        Budget(source).take(4 * width * height, "the image")
        if size is not None and image.size != size:
            message = f"the image has {width} x {height} pixels, the calibration {size[0]} x {size[1]}"
            raise CalibrationError(message, source=source)
        if image.mode.startswith("I"):
            return np.ascontiguousarray(np.asarray(image, dtype=np.uint32) >> 8, dtype=np.uint8)
        return np.asarray(image if image.mode == "L" else image.convert("L"))


def size_of(path: Path) -> tuple[int, int]:
    """Read width and height of an image file from its header alone."""
    require_file(path)
    with _opened(path, str(path)) as image:
        return image.size


@contextmanager
def _opened(file: Path | io.BytesIO, source: str) -> Iterator[Pillow.Image]:
    from PIL import Image as Pillow

    try:
        with Pillow.open(file, formats=_FORMATS) as image:
            yield image
    except (OSError, ValueError, SyntaxError, Pillow.DecompressionBombError) as error:
        raise UnknownFormatError(f"{source}: not a readable image ({error})") from None


@dataclass(frozen=True)
class PairFiles:
    """Load pairs of images of one width and height from the files of each frame."""

    left: Sequence[Path]
    right: Sequence[Path]
    size: tuple[int, int]

    def __call__(self, frame: int) -> tuple[Image, Image]:
        return read_gray(self.left[frame], self.size), read_gray(self.right[frame], self.size)


def images_in(folder: Path) -> tuple[Path, ...]:
    """Return the image files of a folder in the order of their names."""
    if not folder.is_dir():
        raise UnknownFormatError(f"{folder}: this folder of images is missing")
    found = tuple(sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES))
    if not found:
        raise UnknownFormatError(f"{folder}: there are no images")
    return found


def numbered_images(folder: Path) -> dict[int, Path]:
    """Return the image files of a folder by the number that is their name."""
    found = {}
    for path in images_in(folder):
        if not path.stem.isdigit():
            raise UnknownFormatError(f"{path}: expected a number for a name, such as 000000.png")
        found[int(path.stem)] = path
    return found


def in_order(found: dict[int, Path], numbers: range) -> list[Path]:
    """Return the images of successive numbers."""
    missing = next((number for number in numbers if number not in found), None)
    if missing is None:
        return [found[number] for number in numbers]
    some = next(iter(found.values()))
    message = f"image {missing:0{len(some.stem)}d} is missing"
    raise LostDataError(message, source=str(some.parent), field="images", index=missing)


def pair_stamps(left_ns: IntArray, right_ns: IntArray, source: str) -> tuple[IntArray, IntArray, tuple[str, ...]]:
    """Return indices (n,) of left and right images with equal ascending stamps (ns), and a note on the others."""
    right = nearest(right_ns, left_ns)
    left = np.flatnonzero(np.abs(right_ns[right] - left_ns) <= _TOLERANCE_NS)
    right, kept = np.unique(right[left], return_index=True)
    left = left[kept]
    if len(left) < LEAST_PAIRED * max(len(left_ns), len(right_ns)):
        message = f"only {len(left)} of {len(left_ns)} left and {len(right_ns)} right images have the same stamp"
        raise LostDataError(message, source=source)
    alone = len(left_ns) + len(right_ns) - 2 * len(left)
    return left, right, (f"{alone} images without a partner are left out.",) if alone else ()
