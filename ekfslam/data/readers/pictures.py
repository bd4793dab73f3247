"""Image files: gray pixels, folders of numbered images, and pairs of equal stamps."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ekfslam.arrays import IntArray
from ekfslam.data.images import Image
from ekfslam.data.readers.poses import nearest
from ekfslam.errors import CalibrationError, LostDataError, UnknownFormatError
from ekfslam.limits import Budget, require_file

if TYPE_CHECKING:
    from PIL import Image as Pillow

SUFFIXES = (".png", ".jpg", ".jpeg", ".pgm", ".ppm", ".tif", ".tiff", ".bmp")
LEAST_PAIRED, FEW = 0.9, 2  # share of the images that must have a partner, and number of images that need none
# Folders of the left and the right images, by their usual names.
PAIRS = (
    ("image_0", "image_1"),
    ("image_2", "image_3"),
    ("left", "right"),
    ("image_l", "image_r"),
    ("image_left", "image_right"),
    ("image_00", "image_01"),
    ("image_02", "image_03"),
    ("cam0", "cam1"),
    ("infra1", "infra2"),
)
# Words for the sides in names of images.
_SIDES = tuple(
    re.compile(rf"{word}|(?<![a-z]){letter}(?![a-z])|(?<![a-z])(?:cam|camera)_?{number}(?!\d)|infra{number + 1}", re.I)
    for word, letter, number in (("left", "l", 0), ("right", "r", 1))
)
_TOLERANCE_NS = 5_000_000  # cameras that are not triggered together are no stereo pair
_EXACT_NS = 1_000_000  # rounding of stamps that are the same
_HEAD = 1 << 16  # bytes that hold the header of any PPM
_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "PPM")  # PPM includes pgm


def read_gray(path: Path, size: tuple[int, int] | None = None, bits: int = 16) -> Image:
    """Read an image file as (height, width) uint8, colours as luma; see `decode_gray`."""
    require_file(path)
    return decode_gray(path.read_bytes(), str(path), size, bits)


def decode_gray(content: bytes, source: str, size: tuple[int, int] | None = None, bits: int = 16) -> Image:
    """Return the pixels (height, width) uint8 of an image file; of 16 bits, the upper eight of ``bits``."""
    with _opened(io.BytesIO(content), source) as image:
        width, height = image.size
        # Each scan of a progressive JPEG passes over all pixels.
        scans = content.count(b"\xff\xda") if image.format == "JPEG" else 0
        Budget(source).take(max(4, scans) * width * height, "the image with all its scans" if scans else "the image")
        if size is not None and image.size != size:
            message = f"the image has {width} x {height} pixels, the calibration {size[0]} x {size[1]}"
            raise CalibrationError(message, source=source)
        if _is_deep(image):
            return upper_eight(np.asarray(image, dtype=np.uint32), bits)
        return np.asarray(image if image.mode == "L" else image.convert("L"))


def size_of_image(content: bytes, source: str) -> tuple[int, int]:
    """Return width and height of the bytes of an image file from its header alone."""
    with _opened(io.BytesIO(content), source) as image:
        return image.size


def upper_eight(values: NDArray[np.integer], bits: int) -> Image:
    """Return the upper eight of the used bits of pixels."""
    return np.ascontiguousarray(np.minimum(values >> max(bits - 8, 0), 255), dtype=np.uint8)


def _is_deep(image: Pillow.Image) -> bool:
    return image.mode.startswith("I")


def _head_of(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(_HEAD)


@contextmanager
def _opened(file: Path | io.BytesIO, source: str) -> Iterator[Pillow.Image]:
    from PIL import Image as Pillow

    try:
        head = file.getvalue()[:_HEAD] if isinstance(file, io.BytesIO) else _head_of(file)
        if head.startswith(b"P"):  # Pillow reads comments byte by byte, without an end
            Pillow.open(io.BytesIO(head), formats=_FORMATS).close()
        with Pillow.open(file, formats=_FORMATS) as image:
            yield image
    except Pillow.UnidentifiedImageError:
        raise UnknownFormatError(
            f"{source}: not a readable image (damaged, or none of {', '.join(_FORMATS)})"
        ) from None
    except (OSError, ValueError, SyntaxError, Pillow.DecompressionBombError) as error:
        raise UnknownFormatError(f"{source}: not a readable image ({error})") from None


@dataclass(frozen=True)
class PairFiles:
    """Load images of one width and height from the files of each frame; see `read_gray` for ``bits``."""

    left: Sequence[Path]
    right: Sequence[Path] | None  # None: of one camera
    size: tuple[int, int]
    bits: int = 16

    def __call__(self, frame: int) -> tuple[Image, ...]:
        sides = (self.left,) if self.right is None else (self.left, self.right)
        return tuple(read_gray(files[frame], self.size, self.bits) for files in sides)


def pair_files(
    left: Sequence[Path], right: Sequence[Path] | None, size: tuple[int, int] | None = None, bits: int | None = None
) -> tuple[PairFiles, tuple[str, ...]]:
    """Return the loader of pairs of images, and notes on them. Sizes are read from the headers of all files.

    All must have ``size``, by default that of the first image. ``bits`` are by default those of the largest value.
    """
    whose, deep = ("the calibration" if size else str(left[0])), []
    for path in (*left, *(right or ())):
        require_file(path)
        with _opened(path, str(path)) as image:
            size = size or image.size
            if image.size != size:
                found = f"the image has {image.size[0]} x {image.size[1]} pixels, {whose} {size[0]} x {size[1]}"
                raise CalibrationError(found, source=str(path))
            if _is_deep(image):
                deep.append(path)
    if size is None:
        raise UnknownFormatError("there are no images")
    used = bits or (_bits_of(deep) if deep else 16)
    how = "as stated" if bits else "by the largest value in all images"
    note = f"Images of 16 bits use {used}, {how}: the upper eight of these are kept."
    return PairFiles(left, right, size, used), (note,) if deep else ()


def _bits_of(paths: Sequence[Path]) -> int:
    """Return the number of bits of the largest value in images of 16 bits, at least 8."""
    largest = 0
    for path in paths:
        with _opened(io.BytesIO(path.read_bytes()), str(path)) as image:
            Budget(str(path)).take(4 * image.size[0] * image.size[1], "the image")
            largest = max(largest, int(np.asarray(image, dtype=np.uint32).max()))
        if largest >> 15:
            break
    return max(largest.bit_length(), 8)


def images_in(folder: Path) -> tuple[Path, ...]:
    """Return the image files of a folder in the natural order of their names: 2 before 10."""
    if not folder.is_dir():
        raise UnknownFormatError(f"{folder}: this folder of images is missing")
    found = [path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and not path.name.startswith(".")]
    if not found:
        raise UnknownFormatError(f"{folder}: there are no images")
    is_decimal = all(re.fullmatch(r"\d+\.\d+", path.stem, re.ASCII) for path in found)
    return tuple(sorted(found, key=lambda path: (Decimal(path.stem),) if is_decimal else _natural(path.name)))


def _natural(name: str) -> tuple[Any, ...]:
    """Return a key by which numbers in names count as numbers."""
    parts = re.split(r"(\d+)", name)
    return (*((int(part), "") if part.isdecimal() else (-1, part) for part in parts), (-1, name))


def find_pair(folder: Path) -> tuple[str, str] | None:
    """Return the folders of left and right images in a folder, both ``.`` if it is the folder itself, or None."""
    for pair in PAIRS:
        if all((folder / name).is_dir() for name in pair):
            return pair
    places = sorted(path for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []
    folders = [place.name for place in places if any(path.suffix.lower() in SUFFIXES for path in place.iterdir())]
    for left in folders:
        wanted = without_side(left, 0)
        if wanted is not None and (rights := [name for name in folders if without_side(name, 1) == wanted]):
            return left, rights[0]
    names = [path.stem for path in folder.iterdir() if path.suffix.lower() in SUFFIXES] if folder.is_dir() else []
    return (".", ".") if all(any(side.search(name) for name in names) for side in _SIDES) else None


def find_one(folder: Path) -> str | None:
    """Return the only folder of images with the name of a side in a folder; None if there is none, or several."""
    found = [name for pair in PAIRS for name in pair if (folder / name).is_dir()]
    return found[0] if len(found) == 1 else None


def images_of_sides(left: Path, right: Path) -> tuple[dict[str, Path], dict[str, Path]]:
    """Return the images of two folders, or of one, by the part of their names that both sides share."""
    found = [images_in(folder) for folder in (left, right)]
    if left.resolve() == right.resolve():
        found = [tuple(p for p in images if side_of(p.stem) == side) for side, images in enumerate(found)]
        for side, images in zip(("left", "right"), found, strict=True):
            if not images:
                raise UnknownFormatError(f"{left}: no name of an image says that it is of the {side} camera")
    if {path.stem for path in found[0]} == {path.stem for path in found[1]}:
        in_left, in_right = ({path.stem: path for path in images} for images in found)
    else:
        sides = zip(_SIDES, found, strict=True)
        in_left, in_right = ({side.sub("*", path.stem, count=1): path for path in images} for side, images in sides)
    return in_left, in_right


def side_of(name: str) -> int | None:
    """Return the side that a name states, 0 for left, 1 for right; None unless it is one."""
    sides = [side for side, pattern in enumerate(_SIDES) if pattern.search(name)]
    return sides[0] if len(sides) == 1 else None


def without_side(name: str, side: int) -> str | None:
    """Return a name of a side without it, which is equal for both sides of a pair; None for other names."""
    return _SIDES[side].sub("*", name).lower() if side_of(name) == side else None


def other_side(path: Path) -> Path | None:
    """Return the file beside one of a side whose name differs in the side alone; None if there is none."""
    side = side_of(path.stem)
    if side is None:
        return None
    wanted = without_side(path.stem, side)
    same = (other for other in sorted(path.parent.iterdir()) if other.suffix == path.suffix)
    return next((other for other in same if without_side(other.stem, 1 - side) == wanted), None)


def numbered_images(folder: Path, side: int | None = None) -> dict[int, Path]:
    """Return the image files of a folder, those of a side (0, 1) if it holds both, by the number in their names."""
    found: dict[int, Path] = {}
    for path in images_in(folder):
        if side is not None and side_of(path.stem) != side:
            continue
        # Some names have the side, too: left_000001
        numbers = re.findall(r"\d+", re.sub(f"{_SIDES[0].pattern}|{_SIDES[1].pattern}", "", path.stem, flags=re.I))
        if len(numbers) != 1:
            raise UnknownFormatError(f"{path}: expected a number for a name, such as 000000.png")
        if int(numbers[0]) in found:
            other = found[int(numbers[0])].name
            raise LostDataError(f"it has the number of {other}", source=str(path), field="images")
        found[int(numbers[0])] = path
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
    most = max(len(left_ns), len(right_ns))
    if len(left) < min(LEAST_PAIRED * most, most - FEW):
        apart_ms = np.median(np.abs(right_ns[nearest(right_ns, left_ns)] - left_ns)) / 1e6
        message = f"only {len(left)} of {len(left_ns)} left and {len(right_ns)} right images have the same stamp within"
        message += f" {_TOLERANCE_NS / 1e6:g} ms; nearest stamps are {apart_ms:.3g} ms apart (median)"
        raise LostDataError(message, source=source)
    alone = len(left_ns) + len(right_ns) - 2 * len(left)
    notes = [f"{alone} images without a partner are left out."] if alone else []
    apart_ns = int(np.abs(right_ns[right] - left_ns[left]).max(initial=0))
    if apart_ns > _EXACT_NS:
        apart = f"up to {apart_ns / 1e6:.3g} ms apart (tolerance {_TOLERANCE_NS / 1e6:g} ms)"
        notes.append(f"Stamps of left and right images are {apart}; those of the left camera count.")
    return left, right, tuple(notes)
