"""Sources of stereo images: every one becomes a validated `ImageRecording`, whatever it comes in.

Each source is one file of this folder, which `ekfslam.data.images.registry` finds by itself. What is shared:
`pairs` (the recording and its calibration) and `pixels` (one image file as gray pixels).
"""

from __future__ import annotations

from pathlib import Path

from ekfslam.data.images.pairs import Distortion, Image, ImageRecording, PairCalibration
from ekfslam.data.images.registry import ImageReader, image_readers
from ekfslam.data.readers.registry import Lateral, Source

__all__ = ["Distortion", "Image", "ImageReader", "ImageRecording", "PairCalibration", "open_images"]


def open_images(source: str | Path, *, lateral: Lateral = "corrected") -> ImageRecording | None:
    """The recording of stereo images at a place; None where there are no images that a source knows.

    Args:
        source: File or folder.
        lateral: How to take the lateral velocity of KITTI, see `ekfslam.open_sequence`.

    Raises:
        UnknownFormatError: A file that belongs to it is missing or damaged.
        DataError: A field is missing or malformed; the subclass says how.
    """
    place = Source.at(source, "corrected", lateral)
    reader = next((reader for reader in image_readers() if reader.recognises(place)), None)
    return None if reader is None else reader.open(place)
