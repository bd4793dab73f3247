"""Opening of recordings and of ground truth, of any format that a reader of `ekfslam.data.readers` knows."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike

from ekfslam.arrays import Array
from ekfslam.data.images import ImageRecording
from ekfslam.data.readers.fields import checksum
from ekfslam.data.readers.poses import FIRST_IMAGE, Poses, truth_of_frames
from ekfslam.data.readers.registry import CALIBRATION, Extrinsics, Lateral, Source, expected, read_as, readers
from ekfslam.data.readers.text import read_lines, rows_of
from ekfslam.data.sequence import Sequence
from ekfslam.data.trajectory import Moving
from ekfslam.errors import ConfigError, TruthError, UnknownFormatError
from ekfslam.geometry import se3

MIN_COVERAGE = 0.9  # a file that knows fewer of the frames belongs to another recording
MOST_LISTED = 8  # names of a folder in a message


def open_recording(
    source: str | Path,
    *,
    extrinsics: Extrinsics = "corrected",
    lateral: Lateral = "corrected",
    topics: Iterable[str] = (),
    calibration: str | Path | None = None,
) -> Sequence | ImageRecording:
    """Open a recording as images if it has any, otherwise as tracks; for arguments see `ekfslam.open_sequence`."""
    choices = {"extrinsics": (extrinsics, Extrinsics), "lateral": (lateral, Lateral)}
    for name, (choice, known) in choices.items():
        if choice not in get_args(known):
            raise ConfigError(f"{name} must be one of {', '.join(get_args(known))}, found {choice!r}")
    place = _placed(Source.at(source, extrinsics, lateral), topics, calibration)
    images = _images(place)
    if images is not None:
        return images
    sequence: Sequence | None = read_as(place, "tracks")
    if sequence is None:
        raise UnknownFormatError(f"{place.place}: {_why_unknown(place)}")
    for name, (choice, _) in choices.items():
        # A file of our own has been read before: it keeps the choice made then.
        if choice != "corrected" and choice != sequence.attributes.get(name):
            raise ConfigError(f"{source}: {name} {choice!r} mean nothing for this format")
    return sequence


def _why_unknown(place: Source) -> str:
    """Return why a source is no recording, and what could be meant."""
    path, formats = Path(place.place), expected("tracks", "images")
    if path.is_dir():
        names = sorted(entry.name for entry in path.iterdir())
        content = ", ".join(names[:MOST_LISTED]) + (", ..." if len(names) > MOST_LISTED else "") if names else "nothing"
        return f"cannot be read (it is a directory with {content}); {formats}"
    if place.problem:
        return f"cannot be read ({place.problem}); {formats}"
    if any(reader.recognises(place) for reader in readers("truth")):
        return f"holds poses alone, which --truth and `ekfslam covariance --trajectory` read; {formats}"
    return f"{'unknown content' if place.head else 'empty file'}; {formats}"


def open_images(
    source: str | Path,
    *,
    lateral: Lateral = "corrected",
    topics: Iterable[str] = (),
    calibration: str | Path | None = None,
) -> ImageRecording | None:
    """Open a recording of stereo images; None: no reader finds images there. See `ekfslam.open_sequence`."""
    return _images(_placed(Source.at(source, lateral=lateral), topics, calibration))


def _placed(place: Source, topics: Iterable[str], calibration: str | Path | None) -> Source:
    """Return a source with what its reader needs to know."""
    if isinstance(topics, str):
        raise ConfigError(f"topics must be a list of names, found {topics!r}")
    given = None if calibration is None else str(calibration)
    return dataclasses.replace(place, topics=tuple(map(str, topics)), calibration=given)


def _images(place: Source) -> ImageRecording | None:
    """Return the images of a source, None without any; refuse what is given in vain."""
    images: ImageRecording | None = read_as(place, "images")
    attributes = {} if images is None else images.attributes
    if place.topics and "topics" not in attributes:
        raise ConfigError(f"{place.place}: topics (--topics) mean nothing for this format; bags have topics")
    if place.calibration is not None and CALIBRATION not in attributes:
        raise ConfigError(f"{place.place}: calibration (--calibration) means nothing here; bags and folders take one")
    return images


def attach_truth(sequence: Sequence, path: str | Path) -> Sequence:
    """Replace the truth of a sequence by the poses of a file or folder.

    The content decides the format: KITTI odometry or KITTI-360, TUM, the csv of EuRoC or a folder with it, or a drive
    folder of KITTI raw. A pose with a stamp is given to the frame with the nearest stamp, if that is within half the
    median time step. Without stamps, row i is the pose of frame i. If a recording begins at a later image n of a drive
    (KITTI), row n is that of its first frame, unless the file of poses was cut there, too (see `truth_of_frames`).

    Stamps are compared in seconds as they are stored; if both clocks have different origins, the error names both
    spans. Text after ``#`` is a comment. Extra rows are cut, and missing ones leave frames without truth, with a note.
    Poses of KITTI come with their noise (`ekfslam.data.truth_noise`); TUM and EuRoC state none.

    Raises:
        UnknownFormatError: The file is missing, is not text, or has no known format.
        TruthError: A line is malformed or not a rigid transform, or less than 90 % of the frames are covered.
        DataError: A line holds NaN, the stamps do not increase, or a drive folder is malformed.
    """
    path = Path(path)
    poses: Poses | None = read_as(Source.at(path), "truth", sequence)
    if poses is None:
        formats = expected("truth")
        number, content = next(iter(rows_of(read_lines(path, formats))), (0, ""))
        found = f"line {number} has {len(content.split())} columns" if content else "holds no poses"
        raise UnknownFormatError(f"{path}: {found}; {formats}")
    truth = truth_of_frames(sequence.time_s, poses, int(sequence.attributes.get(FIRST_IMAGE, 0)))
    frames, known, count = len(sequence), len(truth.frame), len(poses.T_world_imu)
    if known < MIN_COVERAGE * frames:
        message = f"{count} poses give truth to {known} of the {frames} frames of {sequence.source}"
        message += f"; at least {MIN_COVERAGE:.0%} are needed"
        if poses.time_s is not None:
            message += f"; its stamps are {_span(poses.time_s)}, the sequence's {_span(sequence.time_s)}"
        raise TruthError(message, source=str(path))
    note = f"Truth of {known} of {frames} frames from {path.name}"
    note += f"; {count - known} of its {count} poses are not used." if known < count else "."
    return dataclasses.replace(
        sequence,
        truth=truth,
        notes=(*sequence.notes, note, *poses.notes),
        attributes={**sequence.attributes, "truth_checksum_sha256": checksum(*poses.files)},
    )


def with_truth_frame(sequence: Sequence, frame: Moving | ArrayLike) -> Sequence:
    """Return a recording whose truth was that of another frame, with the true poses of its body.

    Args:
        frame: ``camera`` for poses of the left camera, or the pose of the moving frame in that of the body: translation
            (m), or translation and quaternion x y z w. ``body`` changes nothing.

    Raises:
        ConfigError: It is none of these, or there is no truth.
    """
    if isinstance(frame, str) and frame == "body":
        return sequence
    truth = sequence.truth
    if truth is None:
        raise ConfigError(f"{sequence.name}: there is no truth whose frame could be another one (--truth-frame)")
    T_body_frame = se3.inverse(sequence.T_cam_imu) if isinstance(frame, str) and frame == "camera" else _pose(frame)
    T_world_imu, note = truth.T_world_imu @ se3.inverse(T_body_frame), "Truth is moved to the body of the recording."
    moved = dataclasses.replace(truth, T_world_imu=T_world_imu, motion=None)
    return dataclasses.replace(sequence, truth=moved, notes=(*sequence.notes, note))


def _pose(numbers: ArrayLike) -> Array:
    from scipy.spatial.transform import Rotation  # imported late: it takes long

    values = np.empty(0) if isinstance(numbers, str) else np.asarray(numbers, dtype=float)
    if values.shape not in ((3,), (7,)) or not np.isfinite(values).all() or (len(values) == 7 and not values[3:].any()):
        raise ConfigError("a frame of truth is body, camera, 3 numbers x y z, or 7 numbers x y z qx qy qz qw")
    quaternion = values[3:] if len(values) == 7 else [0.0, 0.0, 0.0, 1.0]
    return se3.transform(Rotation.from_quat(quaternion).as_matrix(), values[:3])


def _span(time_s: Array) -> str:
    return f"{time_s[0]:.3f} to {time_s[-1]:.3f} s"
