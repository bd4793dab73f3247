"""Velocities from elsewhere: samples of a file, or of another recording, brought to the stamps of a recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar, get_args

import numpy as np

from ekfslam.arrays import Array, BoolArray
from ekfslam.data.images import ImageRecording
from ekfslam.data.inputs import VelocitySamples, linear, means_between
from ekfslam.data.interpolation import attributes_of_part, interpolation_attributes, known_intervals
from ekfslam.data.readers.registry import Lateral, Source, expected, read_as
from ekfslam.data.sequence import TWIST_STD, WITHOUT_VELOCITIES, Sequence, VelocityFrame
from ekfslam.errors import ConfigError, LostDataError, UnknownFormatError
from ekfslam.geometry import se3

Recording = TypeVar("Recording", Sequence, ImageRecording)

MAX_GAP_S = 1.0  # over longer, a velocity is not linear in time
NO_VELOCITIES = "There are no velocities"  # beginning of a note of a recording without any
_SAME = 1e-3  # of a step, by which stamps of the same instants may differ
_DENSE = 2.0  # samples an interval from which their mean over it is taken


def attach_velocities(
    recording: Recording,
    path: str | Path,
    *,
    velocity_frame: VelocityFrame | None = None,
    lateral: Lateral = "corrected",
) -> Recording:
    """Return a recording, of tracks or of images, with the velocities of a file in place of its own.

    Each frame gets the velocity at its stamp, linear between samples. If samples come at least twice as often as
    frames, it gets the mean over the interval that ends at the frame. A frame may be one step outside of the samples.

    Another recording (any that `ekfslam.open_sequence` knows, or one of images) also brings ``T_cam_imu``: its
    velocities are those of its own IMU. The truth then becomes that of this IMU. If the stamps have nothing in common
    and one clock counts from 0, first frame and first sample are taken as simultaneous, and a note says so.

    Args:
        recording: Recording without velocities, or with others.
        path: Text file (see `readers.velocity_text`) or another recording.
        velocity_frame: Frame of the velocities; by default that of the file, or ``imu`` if it states none.
        lateral: Reading of the lateral velocity of KITTI, see `ekfslam.open_sequence`.

    Raises:
        UnknownFormatError: The file is missing or of unknown content.
        LostDataError: Frames lie outside of the samples, or in a gap between them.
        DataError: The file is malformed.
    """
    if velocity_frame is not None and velocity_frame not in get_args(VelocityFrame):
        raise ConfigError(f"the frame of velocities must be imu or level, found {velocity_frame!r}")
    samples = read_velocities(Path(path), lateral)
    if velocity_frame is not None:
        samples = replace(samples, velocity_frame=velocity_frame)
    found: VelocitySamples = _on_clock_of(samples, recording.time_s, recording.source)
    twist, how = resample(found, recording.time_s)
    others = (*WITHOUT_VELOCITIES, TWIST_STD, "lateral")
    own = {name: value for name, value in recording.attributes.items() if name not in others}
    gaps = _interpolated_attributes(found, recording.time_s, twist)
    notes = [note for note in recording.notes if not note.startswith(NO_VELOCITIES)]
    notes += [*found.notes, f"Velocities ({found.velocity_frame} frame) from {path}: {how}."]
    changes: dict[str, Any] = {"twist": twist, "velocity_frame": found.velocity_frame}
    if found.T_cam_imu is not None:
        changes |= of_body(recording, found.T_cam_imu)
        notes.append("The body is the IMU of the recording that the velocities are from, and T_cam_imu is its own.")
    attributes = {**own, **found.attributes, **stated_at(found, recording.time_s), **gaps}
    return replace(recording, notes=tuple(notes), attributes=attributes, **changes)


def of_body(recording: Sequence | ImageRecording, T_cam_imu: Array) -> dict[str, Any]:
    """Return the extrinsics of another body, and the truth of a recording for it."""
    changes: dict[str, Any] = {"T_cam_imu": T_cam_imu}
    moved = se3.inverse(recording.T_cam_imu) @ T_cam_imu
    if recording.truth is not None and np.abs(moved - np.eye(4)).max() > 1e-6:
        T_world_imu = recording.truth.T_world_imu @ moved
        changes["truth"] = replace(recording.truth, T_world_imu=T_world_imu, motion=None)
    return changes


def read_velocities(path: Path, lateral: Lateral = "corrected") -> VelocitySamples:
    """Return the samples of a text file or of a recording; see `attach_velocities` for arguments and errors."""
    source = Source.at(path, lateral=lateral)
    samples: VelocitySamples | None = read_as(source, "inputs")
    if samples is not None:
        return samples
    recording: Sequence | ImageRecording | None = read_as(source, "tracks")
    if recording is None:
        recording = read_as(source, "images")
    if recording is None:
        problem = source.problem or "unknown content"
        raise UnknownFormatError(f"{path}: no velocities ({problem}); {expected('inputs', 'tracks', 'images')}")
    return _of_recording(recording, str(path))


def _of_recording(recording: Sequence | ImageRecording, path: str) -> VelocitySamples:
    twist = recording.twist
    if twist is None or WITHOUT_VELOCITIES.items() <= recording.attributes.items():
        raise UnknownFormatError(f"{path}: this recording has no velocities")
    gaps = known_intervals(recording.attributes, twist)
    attributes = attributes_of_part({}, gaps)
    attributes |= {name: value for name, value in recording.attributes.items() if name in ("lateral", TWIST_STD)}
    if "checksum_sha256" in recording.attributes:
        attributes["velocities_sha256"] = recording.attributes["checksum_sha256"]
    notes = tuple(f"{recording.name}: {note}" for note in recording.notes if "velocit" in note)
    frame, T_cam_imu = recording.velocity_frame, recording.T_cam_imu
    return VelocitySamples(path, recording.time_s, twist, frame, T_cam_imu, dict(attributes), notes)


def _on_clock_of(found: VelocitySamples, time_s: Array, source: str) -> VelocitySamples:
    """Return the samples with their stamps on the clock of the frames."""
    if time_s[0] <= found.time_s[-1] and found.time_s[0] <= time_s[-1]:
        return found
    step = _step(time_s)
    if min(abs(time_s[0]), abs(found.time_s[0])) > step:
        spans = [f"{stamps[0]:.3f} to {stamps[-1]:.3f} s" for stamps in (found.time_s, time_s)]
        message = f"samples from {spans[0]} have no time in common with {source}, {spans[1]}"
        raise LostDataError(message, source=found.source)
    note = f"Stamps of {found.source} are on another clock: its first sample is taken as that of the first frame."
    shifted = found.time_s - (found.time_s[0] - time_s[0])
    return replace(found, time_s=shifted, notes=(*found.notes, note))


def resample(found: VelocitySamples, time_s: Array) -> tuple[Array, str]:
    """Return velocities (T, 6) at the stamps of frames (T,), see `attach_velocities`, and their origin in words."""
    stamps, twist = found.time_s, found.twist
    if len(stamps) < 2 or len(time_s) < 2:
        raise LostDataError(f"{len(stamps)} samples for {len(time_s)} frames; two are needed", source=found.source)
    sample_s = _step(stamps)
    _require_cover(found, time_s)
    if _is_dense(stamps, time_s):
        return _means(stamps, twist, time_s), "means of the samples over each interval"
    nearest = np.clip(np.searchsorted(stamps, time_s - 0.5 * sample_s), 0, len(stamps) - 1)
    if (np.abs(stamps[nearest] - time_s) <= _SAME * sample_s).all():
        return twist[nearest], "frames and samples have the same stamps"
    return linear(stamps, twist, time_s), "linear between samples"


def stated_at(found: VelocitySamples, time_s: Array) -> dict[str, str]:
    """Return the attribute `TWIST_STD` of samples at the stamps of frames (T,): means of n have 1 / sqrt(n) of it."""
    if TWIST_STD not in found.attributes:
        return {}
    count = _step(time_s) / _step(found.time_s) if _is_dense(found.time_s, time_s) else 1.0
    std = np.array(str(found.attributes[TWIST_STD]).split(), dtype=float) / np.sqrt(count)
    return {TWIST_STD: " ".join(map(repr, std.tolist()))}


def _is_dense(stamps: Array, time_s: Array) -> bool:
    return _step(stamps) * _DENSE <= _step(time_s) * (1.0 + _SAME)


def is_covered(stamps: Array, time_s: Array) -> BoolArray:
    """Return which frames (T,) lie within samples (N,), or at most one step outside."""
    reach_s = _step(stamps, time_s) * (1.0 + _SAME)
    return (time_s >= stamps[0] - reach_s) & (time_s <= stamps[-1] + reach_s)


def _step(*stamps: Array) -> float:
    """Return the longest of the median steps."""
    return max((float(np.median(np.diff(each))) for each in stamps if len(each) > 1), default=0.0)


def _require_cover(found: VelocitySamples, time_s: Array) -> None:
    stamps = found.time_s
    outside = ~is_covered(stamps, time_s)
    if outside.any():
        first, span = int(np.argmax(outside)), f"{stamps[0]:.3f} to {stamps[-1]:.3f} s"
        message = f"{int(outside.sum())} of {len(time_s)} frames lie outside of the samples from {span}; the first is"
        raise LostDataError(f"{message} frame {first} at {time_s[first]:.3f} s", source=found.source)
    reach_s = _step(stamps, time_s)
    for k in np.flatnonzero(np.diff(stamps) > max(MAX_GAP_S, 2.0 * reach_s)):
        within = (time_s > stamps[k]) & (time_s < stamps[k + 1])
        if within.any():
            gap = f"samples have a gap of {stamps[k + 1] - stamps[k]:.3f} s, with {int(within.sum())} frames in it"
            raise LostDataError(gap, source=found.source, field="time", index=int(k) + 1)


def _means(stamps: Array, twist: Array, time_s: Array) -> Array:
    """Return the mean over each interval of the line through the samples; for the first frame, its value there."""
    grid = np.union1d(stamps, time_s)
    values = linear(stamps, twist, grid)
    area = 0.5 * (values[1:] + values[:-1]) * np.diff(grid)[:, None]
    means = means_between(time_s, grid, np.vstack([np.zeros(6), area]))
    return np.vstack([values[np.searchsorted(grid, time_s[0])], means])


def _interpolated_attributes(found: VelocitySamples, time_s: Array, twist: Array) -> dict[str, str | int | float]:
    """Return the attributes that state which intervals of frames have interpolated samples."""
    if "interpolated" not in found.attributes:
        return dict(interpolation_attributes(twist))
    gaps = known_intervals(found.attributes, found.twist)
    sample = np.clip(np.searchsorted(found.time_s, time_s - _SAME), 0, len(found.time_s) - 1)
    return attributes_of_part({"interpolated": "0-0"}, gaps[sample])
