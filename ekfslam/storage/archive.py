"""Result archives: one HDF5 file holds the results of all modes on one sequence.

    /                       attributes format, format_version, source, error_convention
    /sequence, /truth       as in `ekfslam.data.readers.hdf5`, without the observations
    /runs/<mode>            fields of `Result`; attributes config (JSON), counts (JSON), noise_<field of `Noise`>; and
                            format_version if an older release wrote it
        attributes          seed, input checksum, versions, commit, engine build and platform, as attributes
        <field>             fields of the record in this field of `Result`

docs/archive.md lists all fields, `ekfslam.stored` explains how records declare them, and `ekfslam.hdf5` describes all
files of the package. Reading gives back every number bit for bit.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import h5py
import numpy as np

from ekfslam import files, hdf5
from ekfslam.arrays import Array, BoolArray
from ekfslam.config import check_stored
from ekfslam.data.checks import spelled_as_in
from ekfslam.data.interpolation import known_intervals
from ekfslam.data.noise import Noise, validate_noise
from ekfslam.data.readers.hdf5 import (
    OLD_NOISE,
    SPELLING,
    noise_of_attributes,
    read_sequence_fields,
    write_sequence_group,
)
from ekfslam.data.sequence import WITHOUT_TRACKS, Observations, Sequence, Truth, VelocityFrame
from ekfslam.errors import ArchiveError, ConfigError, DataError, WriteError
from ekfslam.filters.result import ERROR_CONVENTION, Result
from ekfslam.geometry.camera import StereoCamera
from ekfslam.names import printable
from ekfslam.shown import Card, Shown, count
from ekfslam.storage import older

FORMAT = "ekfslam-archive"
# 2 added log, 3 hygiene and parameters, 4 state blocks and track errors in the log, 5 coordinates of all dimensions,
# 6 inputs of any process in the log
FORMAT_VERSION = 6
_MOST_DIFFERENCES = 3  # in a message about another recording
_NOISE = "noise_"  # before the names of attributes


@dataclass(frozen=True, repr=False)
class Archive(Shown):
    """The content of an archive: the sequence without its observations, and the results of its modes."""

    name: str  # name, source, time_s, camera, T_cam_imu, truth, noise, notes, attributes: as in `Sequence`
    source: str
    time_s: Array
    twist: Array | None  # twist, velocity_frame: as in `Sequence`; None if the recording has no velocities
    camera: StereoCamera
    T_cam_imu: Array
    truth: Truth | None
    noise: Noise | None
    velocity_frame: VelocityFrame | None
    notes: tuple[str, ...]
    attributes: Mapping[str, str | int | float]
    results: Mapping[str, Result]  # mode to result, in the order of writing

    def card(self) -> Card:
        facts = {mode: count(len(result.landmarks), "landmark") for mode, result in self.results.items()}
        title = f"{self.name}, {count(len(self.time_s), 'frame')}, {count(len(facts), 'run')}"
        return Card(title, facts, tuple(f"archive.results[{mode!r}]" for mode in list(facts)[:1]))

    @cached_property
    def interpolated(self) -> BoolArray:
        """(T,) whether the velocities of an interval were interpolated."""
        return known_intervals(self.attributes, np.zeros((len(self.time_s), 6)) if self.twist is None else self.twist)


def write_archive(path: str | Path, sequence: Sequence | Archive, results: Mapping[str, Result]) -> None:
    """Write the results (mode to `Result`) of one sequence to an HDF5 file, as a whole, replacing an old one."""
    image = archive_image(sequence, results)
    with files.alone(path):
        files.write(path, image)


def archive_image(sequence: Sequence | Archive, results: Mapping[str, Result]) -> bytes:
    """Return the bytes that `write_archive` writes; it raises an `ArchiveError` if they could not be read again."""

    def fill(h5file: h5py.File) -> None:
        hdf5.write_attributes(h5file, {"source": sequence.source, "error_convention": ERROR_CONVENTION})
        write_sequence_group(h5file, sequence)
        runs = h5file.create_group("runs", track_order=True)
        for mode, result in results.items():
            _write_result(runs.create_group(mode), result, len(sequence.time_s))

    return hdf5.image(FORMAT, FORMAT_VERSION, fill)


def require_same_origin(path: str | Path, sequence: Sequence) -> None:
    """Raise a `WriteError` unless a path is free or has the same recording, by checksum or source."""
    if files.is_free(path):
        return
    try:
        with hdf5.opened(path, FORMAT, FORMAT_VERSION) as h5file:
            found = hdf5.attributes(hdf5.subgroup(h5file, "sequence/attributes"))
            source = str(hdf5.attribute(h5file, "source"))
    except ArchiveError as error:
        raise WriteError(f"{path}: exists, and is no archive to be replaced ({error}); --force replaces it") from None
    wanted, key = dict(sequence.attributes), "checksum_sha256"
    has_checksums = key in found and key in wanted
    if (found[key] != wanted[key]) if has_checksums else (source, found) != (sequence.source, wanted):
        differ = [f"{name} {value}" for name, value in found.items() if value != wanted.get(name) and name != key]
        other = ", ".join([source, *differ[:_MOST_DIFFERENCES]])
        raise WriteError(f"{path}: exists, and is a result of another recording ({other}); --force replaces it")


def add_result(
    path: str | Path,
    result: Result,
    of: Result | None = None,
    beside: Mapping[Path, str | bytes] = MappingProxyType({}),
) -> None:
    """Add the result of one more mode to an archive, replacing an older one of that mode.

    The archive is rewritten as a whole. Two processes that add to it at the same time both succeed. It must still hold
    the run ``of`` that the result was made from. Files ``beside`` are written with it, see `ekfslam.files.write_all`.
    """
    with files.alone(path):
        archive = read_archive(path)
        if of is not None:
            found = archive.results.get(of.mode)
            names = ("time_s", "T_world_imu", "covariance", "ms_per_frame")
            if found is None or not all(np.array_equal(getattr(found, name), getattr(of, name)) for name in names):
                raise ArchiveError(f"{path}: its run {of.mode!r} was replaced meanwhile; start again")
        others = {mode: other for mode, other in archive.results.items() if mode != result.mode}
        files.write_all({**beside, Path(path): archive_image(archive, {**others, result.mode: result})})


def read_archive(path: str | Path) -> Archive:
    """Read an archive; an `ArchiveError` names file and item if it is damaged, malformed, or newer."""
    with hdf5.opened(path, FORMAT, FORMAT_VERSION) as h5file:
        sequence = {"noise": None, **_sequence_fields(h5file), "source": str(hdf5.attribute(h5file, "source"))}
        modes = hdf5.subgroup(h5file, "runs")
        return Archive(**sequence, results={mode: _read_result(h5file, mode, sequence) for mode in modes})


def open_result(path: str | Path, mode: str) -> Result:
    """Read the result of one mode, without the rest of the archive."""
    with hdf5.opened(path, FORMAT, FORMAT_VERSION) as h5file:
        modes = tuple(hdf5.subgroup(h5file, "runs"))
        if mode not in modes:
            raise ArchiveError(f"{path}: runs/{mode} is missing; this archive holds {', '.join(modes) or 'no run'}")
        return _read_result(h5file, mode, _sequence_fields(h5file))


def _write_result(group: h5py.Group, result: Result, frames: int) -> None:
    tables = {"config": json.dumps(result.config), "counts": json.dumps(dict(result.counts))}
    hdf5.write_attributes(group, tables)
    hdf5.write_attributes(group, vars(result.noise), _NOISE)
    hdf5.write_attributes(group.create_group("attributes"), result.attributes)
    hdf5.write_record(group, result, {"T": frames, "M": len(result.landmarks)}, {"time": result.time_s})


def _sequence_fields(h5file: h5py.File) -> dict[str, Any]:
    """Return the arguments of `Archive` except the results, validated as a `Sequence`."""
    try:
        found = read_sequence_fields(h5file, h5file.filename)
        found["name"] = printable(found["name"])
        no_index = np.empty(0, dtype=np.int64)
        columns = 2 if found["camera"].is_monocular else 4
        none = Observations(no_index, no_index, np.empty((0, columns)))
        with spelled_as_in(h5file.filename, SPELLING):
            Sequence(**{**found, "observations": none, "attributes": {**found["attributes"], **WITHOUT_TRACKS}})
        return found
    except DataError as error:
        raise ArchiveError(str(error)) from None


def _read_result(h5file: h5py.File, mode: str, sequence: Mapping[str, Any]) -> Result:
    group = hdf5.subgroup(h5file, f"runs/{mode}")
    version = hdf5.version_of(group if "format_version" in group.attrs else h5file)
    complete, former = partial(older.completed, version=version), older.former(version)
    time = group.get("trajectory/time")
    coordinates = {"time": time[()]} if isinstance(time, h5py.Dataset) else {}
    sizes = {"T": len(sequence["time_s"])}
    found = hdf5.read_record(group, Result, sizes, coordinates, complete=complete, former=former)
    _require_agreement(found, f"{h5file.filename}: {group.name.strip('/')}")
    noise, counts = _read_noise(group), hdf5.json_table(group, "counts")
    if not all(type(count) is int and 0 <= count < 1 << 62 for count in counts.values()):
        raise ArchiveError(f"{h5file.filename}: attribute counts of runs/{mode} holds what is no count")
    return Result(
        mode=mode,
        **found,
        counts=counts,
        config=_read_config(group, noise, version),
        noise=noise,
        camera=sequence["camera"],
        T_cam_imu=sequence["T_cam_imu"],
        attributes={**hdf5.facts(hdf5.subgroup(group, "attributes")), **_retired_noise(group)},
    )


def _retired_noise(group: h5py.Group) -> dict[str, str]:
    """Return the attribute ``retired_noise`` of a result whose noise this version cannot express."""
    old = {name: group.attrs.get(f"noise_{name}", OLD_NOISE[name]) for name in ("misalignment_rad", "track_memory")}
    stated = [f"{name} {value}" for name, value in old.items() if np.any(value != OLD_NOISE[name])]
    return {"retired_noise": ", ".join(stated)} if stated else {}


def _require_agreement(result: Mapping[str, Any], place: str) -> None:
    """Raise an `ArchiveError` if fields of a result that are each valid alone contradict each other."""
    pairs, log, landmarks = result["pairs"], result["log"], len(result["landmarks"])
    if pairs is not None and not (pairs.first < pairs.second).all():
        raise ArchiveError(f"{place}/pairs holds frames that are no pair")
    if log is None:
        return
    if log.landmarks != landmarks:
        raise ArchiveError(
            f"{place}/log/landmark_id has {log.landmarks} entries, but the map has {landmarks} landmarks"
        )
    if (columns := log.curved.shape[1]) not in (0, 3):  # those of the block `up`, if it was in the state
        raise ArchiveError(f"{place}/log/curved has {columns} columns, expected 0 or 3")
    unseen = np.setdiff1d(np.arange(landmarks), log.landmark)
    if len(unseen):
        raise ArchiveError(f"{place}/log/landmark_id[{unseen[0]}] has no observation")
    follows = np.flatnonzero(log.previous >= 0)
    before = log.previous[follows]
    wrong = (log.landmark[before] != log.landmark[follows]) | (log.frame[before] != log.frame[follows] - 1)
    if wrong.any():
        raise ArchiveError(
            f"{place}/log/previous[{follows[np.argmax(wrong)]}] is no observation of the same landmark in the frame "
            "before"
        )


def _read_noise(group: h5py.Group) -> Noise:
    for name in ("twist_std", "pixel_std_px"):  # without a default
        hdf5.attribute(group, _NOISE + name)
    noise = Noise(**noise_of_attributes(group.attrs, _NOISE))
    try:
        validate_noise(noise)
    except DataError as error:
        raise ArchiveError(f"{group.file.filename}: {group.name.strip('/')}: {error}") from None
    return noise


def _read_config(group: h5py.Group, noise: Noise, version: int) -> dict[str, Any]:
    config = hdf5.json_table(group, "config")
    try:
        check_stored(config)
        config = older.config_of(config, noise, version)
        check_stored(config)
    except ConfigError as error:
        raise ArchiveError(f"{group.file.filename}: attribute config of {group.name.strip('/')}: {error}") from None
    return config
