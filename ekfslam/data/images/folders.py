"""What sources of image folders share: images by number or stamp, and pairs of equal stamps."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ekfslam.arrays import IntArray
from ekfslam.errors import LostDataError, UnknownFormatError

SUFFIXES = (".png", ".jpg", ".jpeg", ".pgm", ".ppm", ".tif", ".tiff", ".bmp")
LEAST_PAIRED = 0.9  # of the images, that must have a partner
_TOLERANCE_NS = 5_000_000  # cameras that are not triggered together are no stereo pair


def images_in(folder: Path) -> tuple[Path, ...]:
    """Image files of a folder in the order of their names.

    Raises:
        UnknownFormatError: The folder is missing, or there are none.
    """
    if not folder.is_dir():
        raise UnknownFormatError(f"{folder}: this folder of images is missing")
    found = tuple(sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES))
    if not found:
        raise UnknownFormatError(f"{folder}: there are no images")
    return found


def pair_stamps(left_ns: IntArray, right_ns: IntArray, source: str) -> tuple[IntArray, IntArray, tuple[str, ...]]:
    """Which images of two cameras belong together: indices (n,) into ascending stamps (ns), and a note on the others.

    Raises:
        LostDataError: Less than `LEAST_PAIRED` of the images of either have a partner.
    """
    right = np.searchsorted(right_ns, left_ns)
    right = np.clip(right, 0, len(right_ns) - 1)
    before = np.maximum(right - 1, 0)
    right = np.where(np.abs(right_ns[before] - left_ns) < np.abs(right_ns[right] - left_ns), before, right)
    left = np.flatnonzero(np.abs(right_ns[right] - left_ns) <= _TOLERANCE_NS)
    right, kept = np.unique(right[left], return_index=True)
    left = left[kept]
    most = max(len(left_ns), len(right_ns))
    if len(left) < LEAST_PAIRED * most:
        raise LostDataError(
            f"only {len(left)} of {len(left_ns)} left and {len(right_ns)} right images have the same stamp",
            source=source,
        )
    alone = len(left_ns) + len(right_ns) - 2 * len(left)
    return left, right, (f"{alone} images without a partner are left out.",) if alone else ()
