"""OpenCV, an extra that is imported on first use."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from ekfslam.errors import MissingPackageError


def opencv() -> Any:
    """Return the module ``cv2``."""
    try:
        import cv2
    except ImportError as error:
        raise MissingPackageError("opencv-python-headless", "images", f"tracking images ({error})") from None
    return cv2


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit OpenCV to one thread within the context: images are small, and times of frames stay comparable."""
    cv2 = opencv()
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)
