"""ekfslam's own HDF5 form of a `Sequence`, and its groups for others (the result archive) to embed.

Data sets are those that the metadata of the records state: in ``/sequence`` with its groups ``observations``, ``noise``
and ``inputs/<i>``, and in ``/truth`` with ``motion``. ``sequence/twist`` has velocities at the stamps of the frames;
``velocity_frame`` is ``none`` without velocities. Other fields are attributes. See `ekfslam.hdf5` for the common part.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ekfslam import files, hdf5
from ekfslam.data.checks import spelled_as_in
from ekfslam.data.inputs import InertialNoise, InertialSamples, Input, Velocities
from ekfslam.data.noise import Noise
from ekfslam.data.observations import Observations, TrueMotion, Truth
from ekfslam.data.readers.fields import checksum, require, require_numbers
from ekfslam.data.readers.registry import Reader, Source
from ekfslam.data.sequence import Sequence
from ekfslam.data.truth_noise import TruthNoise
from ekfslam.errors import ArchiveError, ShapeError, UnknownFormatError
from ekfslam.geometry.camera import StereoCamera
from ekfslam.stored import TEXTS, Item, Layout, fixed_length, layout_of

FORMAT = "ekfslam-sequence"
FORMAT_VERSION = 3  # 2 added coordinates of all dimensions, 3 inputs


def _below(place: str, layout: Layout) -> Layout:
    return tuple(item._replace(name=f"{place}/{item.name}") for item in layout)


_TWIST = Item("twist", "twist", ("T", "u"), "m/s (columns 0-2), rad/s (columns 3-5)", "imu")
NO_VELOCITIES = "none"  # attribute ``velocity_frame`` of a recording without velocities
_UNDRIVEN = _below("sequence", layout_of(Sequence))
_SEQUENCE = (*_UNDRIVEN, *_below("sequence", (_TWIST,)))
OBSERVATIONS_LAYOUT = _below("sequence/observations", layout_of(Observations))
_OF_ONE_CAMERA = tuple(
    item._replace(shape=("K", "left_pixels"), frame="image: u, v") if item.field == "pixels_px" else item
    for item in OBSERVATIONS_LAYOUT
)
_NOISE = _below("sequence/noise", layout_of(Noise))
_TRUTH = _below("truth", layout_of(Truth))
_MOTION = _below("truth/motion", layout_of(TrueMotion))
_INPUTS: dict[str, type[Input]] = {kind.__name__: kind for kind in (Velocities, InertialSamples)}
_NOTES = (Item("sequence/notes", "notes", ("n",), "text", "none", TEXTS),)
LAYOUT = (*_SEQUENCE, *_NOTES, *_NOISE, *_TRUTH)  # of an archive, too
# Noise that older files may state and no model uses any more, with the values that mean none.
OLD_NOISE = {"drift": 0.0, "bearing_drift_rad": 0.0, "misalignment_rad": 0.0, "track_memory": 1.0, "margin": 1.0}
_UNKNOWN_LATERAL = (
    "The file does not say how the sign of the lateral velocity was taken, so it is used as stored; older releases "
    "wrote that of KITTI positive to the right."
)
_TRUTH_NOISE = "noise_"  # before the names of attributes

_PARTS = {"": _SEQUENCE, "observations.": OBSERVATIONS_LAYOUT, "noise.": _NOISE, "truth.": _TRUTH}
SPELLING = {part + item.field: item.name for part, layout in _PARTS.items() for item in layout} | {
    "K": "sequence/camera@fu_px, fv_px",
    "baseline": "sequence/camera@baseline_m",
    "observations": "sequence/observations",
}


def write_sequence(sequence: Sequence, path: str | Path) -> None:
    """Write a sequence to a new HDF5 file (or over an old one), so that `read_sequence` restores it bit for bit."""
    files.write(path, sequence_image(sequence))


def sequence_image(sequence: Sequence) -> bytes:
    """Return the bytes that `write_sequence` writes."""
    return hdf5.image(FORMAT, FORMAT_VERSION, lambda h5file: write_sequence_group(h5file, sequence, whole=True))


def is_recording_of(path: str | Path, sequence: Sequence) -> bool:
    """Return whether a file of `write_sequence` holds a recording with the same name and attributes."""
    try:
        with hdf5.opened(path, FORMAT, FORMAT_VERSION) as h5file:
            name = hdf5.attribute(hdf5.subgroup(h5file, "sequence"), "name")
            facts = hdf5.facts(hdf5.subgroup(h5file, "sequence/attributes"))
    except ArchiveError:
        return False
    return (name, facts) == (sequence.name, dict(sequence.attributes))


def read_sequence(path: str | Path) -> Sequence:
    """Read a file of `write_sequence`, as it was written except for ``source``, which is the file.

    Raises:
        UnknownFormatError: The file is missing, damaged, or HDF5 of another format.
        ArchiveError: A newer release wrote the file.
        DataError: A field is missing or malformed.
    """
    with (
        hdf5.opened(path, FORMAT, FORMAT_VERSION, error=UnknownFormatError) as h5file,
        spelled_as_in(str(path), SPELLING),
    ):
        found = read_sequence_fields(h5file, str(path))
        found["observations"] = Observations(**_read(h5file, _layout_of_tracks(h5file)))
        if "sequence/inputs" in h5file:
            found |= _read_inputs(h5file["sequence/inputs"], found)
        return Sequence(**found)


def write_sequence_group(h5file: h5py.Group, sequence: Any, whole: bool = False) -> None:
    """Write ``/sequence`` and ``/truth`` of a record below a group; observations and inputs only if ``whole``."""
    has_twist = sequence.velocities is not None if isinstance(sequence, Sequence) else sequence.twist is not None
    hdf5.write_fields(h5file, _SEQUENCE if has_twist else _UNDRIVEN, sequence)
    hdf5.write_fields(h5file, _NOTES, {"notes": hdf5.fixed_texts(sequence.notes)})
    group = h5file["sequence"]
    names = {"name": sequence.name, "velocity_frame": sequence.velocity_frame if has_twist else NO_VELOCITIES}
    hdf5.write_attributes(group, names)
    hdf5.write_attributes(group.create_group("camera"), vars(sequence.camera))
    hdf5.write_attributes(group.create_group("attributes"), sequence.attributes)
    if sequence.noise is not None:
        hdf5.write_fields(h5file, _NOISE, sequence.noise)
        in_data_sets = {item.field for item in _NOISE}
        further = {name: value for name, value in vars(sequence.noise).items() if name not in in_data_sets}
        hdf5.write_attributes(group["noise"], further)
    if whole:
        layout = _OF_ONE_CAMERA if sequence.camera.is_monocular else OBSERVATIONS_LAYOUT
        hdf5.write_fields(h5file, layout, sequence.observations)
        _write_inputs(group.create_group("inputs"), sequence)
    truth = sequence.truth
    if truth is not None:
        hdf5.write_fields(h5file, _TRUTH, truth)
        if truth.motion is not None:
            hdf5.write_fields(h5file, _MOTION, truth.motion)
        if truth.noise is not None:
            hdf5.write_attributes(h5file["truth"], vars(truth.noise), _TRUTH_NOISE)


def read_sequence_fields(h5file: h5py.Group, source: str) -> dict[str, Any]:
    """Return the arguments of `Sequence` below an open file or group, except observations and inputs."""
    with spelled_as_in(source, SPELLING):
        attributes, names = hdf5.facts(_group(h5file, "sequence/attributes")), _attributes(h5file, "sequence")
        camera = StereoCamera(**_numbers(h5file, "sequence/camera", StereoCamera))
        frame = str(names.get("velocity_frame", "imu"))
        found: dict[str, Any] = {
            "name": str(names.get("name", "")),
            "source": source,
            "twist": None,
            **_read(h5file, _UNDRIVEN if frame == NO_VELOCITIES else _SEQUENCE),
            "camera": camera,
            "velocity_frame": None if frame == NO_VELOCITIES else frame,
            "truth": _read_truth(h5file) if "truth" in h5file else None,
            "notes": hdf5.texts(require(h5file, "sequence/notes")),
            "attributes": attributes,
        }
        if "sequence/noise" in h5file:
            further = _attributes(h5file, "sequence/noise")
            found["noise"] = Noise(**{**noise_of_attributes(further), **_read(h5file, _NOISE)})
            found["notes"] += tuple(
                f"The noise states {name} {further[name]}, which no model uses any more."
                for name, nothing in OLD_NOISE.items()
                if further.get(name, nothing) != nothing
            )
        return found


def _layout_of_tracks(h5file: h5py.Group) -> Layout:
    """Return the layout of observations by two cameras, or by one if their pixels have two columns."""
    pixels = h5file.get("sequence/observations/pixels")
    is_of_one = isinstance(pixels, h5py.Dataset) and pixels.shape[-1:] == (2,)
    return _OF_ONE_CAMERA if is_of_one else OBSERVATIONS_LAYOUT


def _write_inputs(group: h5py.Group, sequence: Sequence) -> None:
    for i, samples in enumerate(sequence.inputs):
        if samples is sequence.velocities and samples.is_twist_of(sequence.time_s):
            hdf5.write_attributes(group, {"twist": i})
            continue
        part = group.create_group(str(i))
        hdf5.write_record(part, samples, {})
        hdf5.write_attributes(part, {"kind": type(samples).__name__})
        if isinstance(samples, InertialSamples) and samples.noise is not None:
            hdf5.write_attributes(part, vars(samples.noise))


def _read_inputs(group: h5py.Group, found: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments ``inputs``, ``twist`` and ``velocity_frame`` of a `Sequence`."""
    twist_at = hdf5.attributes(group).get("twist")
    inputs: list[Input] = []
    for i in range(len(group) + (twist_at is not None)):
        if i == twist_at:
            inputs.append(Velocities(found["time_s"], found["twist"], found["velocity_frame"]))
            continue
        stated = _attributes(group, str(i))
        kind = _INPUTS.get(str(stated.get("kind")))
        if kind is None:
            raise ShapeError(f"inputs of kind {stated.get('kind')!r} are unknown", field=f"sequence/inputs/{i}@kind")
        arguments = hdf5.read_record(group[str(i)], kind, {})
        if kind is InertialSamples and "gyro" in stated:
            arguments["noise"] = InertialNoise(**_numbers(group, str(i), InertialNoise))
        inputs.append(kind(**arguments))
    return {"inputs": tuple(inputs), "twist": None, "velocity_frame": None}


def _read_truth(h5file: h5py.Group) -> Truth:
    found = _read(h5file, _TRUTH)
    if "truth/motion" in h5file:
        found["motion"] = TrueMotion(**_read(h5file, _MOTION))
    if any(name.startswith(_TRUTH_NOISE) for name in _attributes(h5file, "truth")):
        found["noise"] = TruthNoise(**_numbers(h5file, "truth", TruthNoise, _TRUTH_NOISE))
    return Truth(**found)


def noise_of_attributes(attributes: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the arguments of `Noise` among attributes; fields that an older file lacks keep their default."""
    stored = {f.name: attributes.get(prefix + f.name) for f in fields(Noise)}
    return {name: float(value) if np.ndim(value) == 0 else value for name, value in stored.items() if value is not None}


def _read(h5file: h5py.Group, layout: Layout) -> dict[str, Any]:
    """Return the data sets of a layout by field, as finite numbers; the record itself checks that lengths agree."""
    found = {
        item.field: require_numbers(
            h5file,
            item.name,
            tuple(fixed_length(axis) for axis in item.shape),
            np.int64 if item.check.kinds == "i" else np.float64,
        )
        for item in layout
    }
    hdf5.require_coordinates(h5file, layout)
    return found


def _numbers(h5file: h5py.Group, name: str, record: type, prefix: str = "") -> dict[str, float]:
    """Return the fields of a record of numbers among the attributes of a group, ``<prefix><field>``."""
    stated = _attributes(h5file, name)
    found = {field.name: stated.get(prefix + field.name, field.default) for field in fields(record)}
    for key, value in found.items():
        if not isinstance(value, int | float):
            raise ShapeError("this attribute is missing or no number", field=f"{name}@{prefix}{key}")
    return found


def _attributes(h5file: h5py.Group, name: str) -> dict[str, Any]:
    """Return the attributes of a group that must be there."""
    return hdf5.attributes(_group(h5file, name))


def _group(h5file: h5py.Group, name: str) -> h5py.Group:
    if not isinstance(h5file.get(name), h5py.Group):
        raise ShapeError("this group is missing", field=name)
    return h5file[name]


def _tracks(source: Source) -> Sequence:
    sequence = read_sequence(source.path)
    own = {"checksum_sha256": checksum(source.path), "reader": READER.name}
    is_unknown = sequence.velocity_frame == "level" and "lateral" not in sequence.attributes
    notes = (*sequence.notes, _UNKNOWN_LATERAL) if is_unknown else sequence.notes
    return replace(sequence, attributes={**sequence.attributes, **own}, notes=notes)


READER = Reader("hdf5", "an ekfslam HDF5 file", lambda source: source.head.startswith(b"\x89HDF\r\n\x1a\n"), _tracks)
