"""ekfslam's own HDF5 form of a `Sequence`, and its groups for others (the result archive) to embed.

    /                   attributes format, format_version
    /sequence           attributes name, velocity_frame; time (T,), twist (T, 6), T_cam_imu (4, 4), notes (n,) of text
        camera          attributes fu_px, fv_px, cu_px, cv_px, baseline_m
        attributes      the further facts, as attributes
        observations    frame (K,), landmark (K,), pixels (K, 4)
        noise           twist_std (6,), pixel_std (4,), the rest of `Noise` as attributes; only if noise is stated
    /truth              frame (F,), T_world_imu (F, 4, 4); only if there is truth
        landmarks       id (M,), position (M, 3)

Every dataset has the attributes ``units`` and ``frame`` (of reference). Text is stored with fixed length: libhdf5 hangs
on some damaged files with text of variable length. The newer file layout carries checksums of all but the arrays.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ekfslam.data.readers.fields import require, require_numbers, spelled_as_in
from ekfslam.data.sequence import Noise, Observations, Sequence, Truth
from ekfslam.errors import ArchiveError, ShapeError, UnknownFormatError
from ekfslam.geometry.camera import StereoCamera

FORMAT = "ekfslam-sequence"
FORMAT_VERSION = 1

_CAMERA = ("fu_px", "fv_px", "cu_px", "cv_px", "baseline_m")
_FURTHER_NOISE = (
    "twist_walk_std",
    "motion_std",
    "misalignment_rad",
    "drift",
    "bearing_drift_rad",
    "tilt_rad",
    "margin",
)
_SPELLING = {
    "time_s": "sequence/time",
    "twist": "sequence/twist",
    "T_cam_imu": "sequence/T_cam_imu",
    "K": "sequence/camera@fu_px, fv_px",
    "baseline": "sequence/camera@baseline_m",
    "observations": "sequence/observations",
    "observations.frame": "sequence/observations/frame",
    "observations.landmark": "sequence/observations/landmark",
    "noise.twist_std": "sequence/noise/twist_std",
    "noise.pixel_std_px": "sequence/noise/pixel_std",
    "truth.frame": "truth/frame",
    "truth.T_world_imu": "truth/T_world_imu",
    "truth.position_m": "truth/landmarks/position",
}


def write_sequence(sequence: Sequence, path: str | Path) -> None:
    """Write a sequence to a new HDF5 file (or over an old one), so that `read_sequence` restores it bit for bit.

    Raises:
        ArchiveError: The file cannot be written.
    """
    try:
        with h5py.File(path, "w", libver="v110") as h5file:
            h5file.attrs["format"] = _text(FORMAT)
            h5file.attrs["format_version"] = FORMAT_VERSION
            write_sequence_group(h5file, sequence, include_observations=True)
            if sequence.truth is not None:
                write_truth_group(h5file, sequence.truth)
    except OSError as error:
        raise ArchiveError(f"{path}: cannot be written: {error}") from None


def read_sequence(path: str | Path) -> Sequence:
    """Read a file of `write_sequence`; all but ``source``, which is the file read, is as it was written.

    Raises:
        UnknownFormatError: The file is missing, damaged, or HDF5 of another format.
        ArchiveError: A newer release wrote the file.
        DataError: A field is missing or malformed; the subclass says how.
    """
    try:
        with h5py.File(path, "r") as h5file:
            found, version = _plain(h5file.attrs.get("format")), h5file.attrs.get("format_version")
            if found != FORMAT:
                raise UnknownFormatError(
                    f"{path}: an HDF5 file of format {found!r} with [{', '.join(h5file)}]; expected format {FORMAT!r}"
                )
            if not isinstance(version, np.integer) or version > FORMAT_VERSION:
                raise ArchiveError(
                    f"{path}: has format version {version}, this release reads up to version {FORMAT_VERSION}"
                )
            return read_sequence_group(h5file, str(path))
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:  # what h5py raises at damaged files
        raise UnknownFormatError(f"{path}: damaged HDF5 file ({error}); expected format {FORMAT!r}") from None


def write_sequence_group(h5file: h5py.Group, sequence: Sequence, include_observations: bool) -> None:
    """Write ``/sequence`` below an open file or group; the truth is left to `write_truth_group`."""
    group = h5file.create_group("sequence")
    group.attrs["name"] = _text(sequence.name)
    group.attrs["velocity_frame"] = _text(sequence.velocity_frame)
    _write(group, "time", sequence.time_s, "s", "clock of the recording")
    _write(group, "twist", sequence.twist, "m/s (columns 0-2), rad/s (columns 3-5)", "imu")
    _write(group, "T_cam_imu", sequence.T_cam_imu, "m (translation)", "cam from imu")
    _write(group, "notes", np.array([_text(note) for note in sequence.notes], dtype=np.bytes_), "text", "none")
    group.create_group("camera").attrs.update({name: getattr(sequence.camera, name) for name in _CAMERA})
    facts = {key: _text(value) if isinstance(value, str) else value for key, value in sequence.attributes.items()}
    group.create_group("attributes").attrs.update(facts)
    if sequence.noise is not None:
        noise = group.create_group("noise")
        _write(noise, "twist_std", sequence.noise.twist_std, "m/s (0-2), rad/s (3-5)", "imu")
        _write(noise, "pixel_std", sequence.noise.pixel_std_px, "px", "image: uL, vL, uR, vR")
        further = {name: getattr(sequence.noise, name) for name in _FURTHER_NOISE}
        noise.attrs.update({name: value for name, value in further.items() if value is not None})
    if include_observations:
        observations = group.create_group("observations")
        _write(observations, "frame", sequence.observations.frame, "frame index", "none")
        _write(observations, "landmark", sequence.observations.landmark, "landmark id", "none")
        _write(observations, "pixels", sequence.observations.pixels_px, "px", "image: uL, vL, uR, vR")


def read_sequence_group(h5file: h5py.Group, source: str) -> Sequence:
    """The sequence below an open file or group, with its truth if ``/truth`` exists.

    Raises:
        ArchiveError: The group was written without observations; `read_sequence_fields` reads what there is.
        DataError: A field is missing or malformed; the subclass says how.
    """
    fields = read_sequence_fields(h5file, source)
    if "observations" not in fields:
        raise ArchiveError(f"{source}: holds a sequence without its observations")
    with spelled_as_in(source, _SPELLING):
        return Sequence(**fields)


def read_sequence_fields(h5file: h5py.Group, source: str) -> dict[str, Any]:
    """Arguments of `Sequence` as stored below an open file or group; ``observations`` only if they are stored.

    Raises:
        DataError: A field is missing or malformed; the subclass says how.
    """
    with spelled_as_in(source, _SPELLING):
        attributes, camera = _attributes(h5file, "sequence/attributes"), _attributes(h5file, "sequence/camera")
        for name in _CAMERA:
            if not isinstance(camera.get(name), int | float):
                raise ShapeError("this attribute is missing or no number", field=f"sequence/camera@{name}")
        fields: dict[str, Any] = {
            "name": str(_attributes(h5file, "sequence").get("name", "")),
            "source": source,
            "time_s": require_numbers(h5file, "sequence/time", (None,)),
            "twist": require_numbers(h5file, "sequence/twist", (None, 6)),
            "camera": StereoCamera(**{name: camera[name] for name in _CAMERA}),
            "T_cam_imu": require_numbers(h5file, "sequence/T_cam_imu", (4, 4)),
            "velocity_frame": str(_attributes(h5file, "sequence").get("velocity_frame", "imu")),
            "truth": read_truth_group(h5file, source) if "truth" in h5file else None,
            "notes": tuple(str(_plain(note)) for note in np.ravel(require(h5file, "sequence/notes"))),
            "attributes": attributes,
        }
        if "sequence/noise" in h5file:
            fields["noise"] = Noise(
                require_numbers(h5file, "sequence/noise/twist_std", (6,)),
                require_numbers(h5file, "sequence/noise/pixel_std", (4,)),
                **_further_noise(h5file["sequence/noise"].attrs),
            )
        if "sequence/observations" in h5file:
            fields["observations"] = Observations(
                require_numbers(h5file, "sequence/observations/frame", (None,), np.int64),
                require_numbers(h5file, "sequence/observations/landmark", (None,), np.int64),
                require_numbers(h5file, "sequence/observations/pixels", (None, 4)),
            )
        return fields


def write_truth_group(h5file: h5py.Group, truth: Truth) -> None:
    """Write ``/truth`` below an open file or group."""
    group = h5file.create_group("truth")
    _write(group, "frame", truth.frame, "frame index", "none")
    _write(group, "T_world_imu", truth.T_world_imu, "m (translation)", "world from imu")
    landmarks = group.create_group("landmarks")
    _write(landmarks, "id", truth.landmark, "landmark id", "none")
    _write(landmarks, "position", truth.position_m, "m", "world")


def read_truth_group(h5file: h5py.Group, source: str) -> Truth:
    """The truth below an open file or group.

    Raises:
        DataError: A field is missing or malformed; the subclass says how.
    """
    with spelled_as_in(source):
        return Truth(
            require_numbers(h5file, "truth/frame", (None,), np.int64),
            require_numbers(h5file, "truth/T_world_imu", (None, 4, 4)),
            require_numbers(h5file, "truth/landmarks/id", (None,), np.int64),
            require_numbers(h5file, "truth/landmarks/position", (None, 3)),
        )


def _further_noise(attributes: Mapping[str, Any]) -> dict[str, Any]:
    given = {name: attributes[name] for name in _FURTHER_NOISE if name in attributes}
    return {name: float(value) if np.ndim(value) == 0 else value for name, value in given.items()}


def _write(group: h5py.Group, name: str, value: Any, units: str, frame: str) -> None:
    # Only long arrays are worth compressing; HDF5 cannot chunk an empty one.
    compression = "gzip" if np.size(value) > 10_000 else None
    dataset = group.create_dataset(name, data=value, compression=compression)
    dataset.attrs["units"], dataset.attrs["frame"] = _text(units), _text(frame)


def _attributes(h5file: h5py.Group, name: str) -> dict[str, Any]:
    """HDF5 attributes of a group as plain Python values."""
    if not isinstance(h5file.get(name), h5py.Group):
        raise ShapeError("this group is missing", field=name)
    return {key: _plain(value) for key, value in h5file[name].attrs.items()}


def _text(text: str) -> np.bytes_:
    """Text in HDF5's fixed-length form."""
    return np.bytes_(text.encode())


def _plain(value: Any) -> Any:
    """A stored scalar as a plain Python value."""
    value = value.item() if isinstance(value, np.generic) else value
    return value.decode(errors="replace") if isinstance(value, bytes) else value
