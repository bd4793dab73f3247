"""OpenCV, imported where it is used: it is an extra."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from ekfslam.errors import MissingPackageError


def opencv() -> Any:
    """The module ``cv2``.

    Raises:
        MissingPackageError: It is not installed.
    """
    try:
        import cv2
    except ImportError as error:
        raise MissingPackageError("opencv-python-headless", "images", f"tracking images ({error})") from None
    return cv2


@contextmanager
def one_thread() -> Iterator[None]:
    """Let OpenCV use one thread meanwhile: images are small, and a frame's time is then its own."""
    cv2 = opencv()
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)
