"""Result archives: one HDF5 file holds what every mode made of one sequence.

    /                       attributes format, format_version, source, error_convention
    /sequence, /truth       as in `ekfslam.data.readers.hdf5`, without the observations
    /runs/<mode>            attributes config (JSON), counts (JSON), noise_<field of `Noise`>, sequence_name; and
                            format_version if an older release wrote it
        attributes          seed, input checksum, versions of the software, as attributes
        trajectory          time, T_world_imu, covariance
        landmarks           id, position, covariance, initial_position, first_frame, last_frame, observations
        innovation          nis, dof, accepted, rejected
        whitened            frame, landmark, alone, apart, score, information: see
                            `ekfslam.filters.result.WhitenedInnovations` (mode full only, not in older archives)
        rejections          frame, landmark, reason (index into its attribute ``names``)
        parameters          value, std, prior_std; attributes name, unit; see `ekfslam.filters.result.Parameters`
        pairs               first, second, cross: see `ekfslam.filters.result.PosePairs` (where truth is known)
        hygiene             rule (index into its attribute ``names``), frame, landmark, continuation: see
                            `ekfslam.data.hygiene.HygieneReport`; attribute observations (not in dead reckoning)
        timing              ms_per_frame
        log                 what `ekfslam.smoother.posterior` needs: see `ekfslam.filters.log.Log` (mode full only)

Reading gives back every number bit for bit. See `ekfslam.hdf5` for what all files have in common.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import h5py
import numpy as np

from ekfslam import files, hdf5
from ekfslam.arrays import Array, BoolArray
from ekfslam.config import HygieneConfig, check_stored
from ekfslam.data.hygiene import RULES, HygieneReport
from ekfslam.data.interpolation import known_intervals
from ekfslam.data.readers.fields import spelled_as_in
from ekfslam.data.readers.hdf5 import (
    SPELLING,
    noise_attributes,
    noise_of_attributes,
    read_sequence_fields,
    write_sequence_group,
    write_truth_group,
)
from ekfslam.data.sequence import (
    WITHOUT_TRACKS,
    Noise,
    Observations,
    Sequence,
    Truth,
    VelocityFrame,
    validate_noise,
)
from ekfslam.errors import ArchiveError, ConfigError, DataError, WriteError
from ekfslam.filters.log import Log
from ekfslam.filters.result import (
    ERROR_CONVENTION,
    REASONS,
    Innovation,
    Landmarks,
    Parameters,
    PosePairs,
    Rejections,
    Result,
    WhitenedInnovations,
)
from ekfslam.geometry.camera import StereoCamera
from ekfslam.names import printable
from ekfslam.shown import Card, Shown, count
from ekfslam.storage.checks import COVARIANCES, RIGID, require_agreement

FORMAT = "ekfslam-archive"
# 2 added log, 3 hygiene and parameters, 4 state blocks and track errors in the log, 5 coordinates of all dimensions
FORMAT_VERSION = 5

# Data sets below /runs/<mode>, fields of `Result` (T frames, M landmarks, R rejections), and what their values must be.
LAYOUT = hdf5.layout(
    ("trajectory/time", "time_s", ("T",), "s", "clock of the recording", hdf5.ASCENDING),
    ("trajectory/T_world_imu", "T_world_imu", ("T", "row", "column"), "m (translation)", "world from imu", RIGID),
    (
        "trajectory/covariance",
        "covariance",
        ("T", "xi", "xi"),
        "m^2, m rad, rad^2 (rho 0-2, theta 3-5)",
        "imu",
        COVARIANCES,
    ),
    ("landmarks/id", "landmarks.id", ("M",), "landmark id", "none", hdf5.COUNTS),
    ("landmarks/position", "landmarks.position_m", ("M", "xyz"), "m", "world"),
    ("landmarks/covariance", "landmarks.covariance", ("M", "xyz", "xyz"), "m^2", "world", COVARIANCES),
    ("landmarks/initial_position", "landmarks.initial_position_m", ("M", "xyz"), "m", "world"),
    ("landmarks/first_frame", "landmarks.first_frame", ("M",), "frame index", "none", hdf5.index_of("T")),
    ("landmarks/last_frame", "landmarks.last_frame", ("M",), "frame index", "none", hdf5.index_of("T")),
    ("landmarks/observations", "landmarks.observations", ("M",), "count", "none", hdf5.COUNTS),
    ("innovation/nis", "innovation.nis", ("T",), "1", "none"),
    ("innovation/dof", "innovation.dof", ("T",), "count", "none", hdf5.COUNTS),
    ("innovation/accepted", "innovation.accepted", ("T",), "count", "none", hdf5.COUNTS),
    ("innovation/rejected", "innovation.rejected", ("T",), "count", "none", hdf5.COUNTS),
    ("rejections/frame", "rejections.frame", ("R",), "frame index", "none", hdf5.index_of("T")),
    ("rejections/landmark", "rejections.landmark", ("R",), "landmark id", "none", hdf5.COUNTS),
    ("rejections/reason", "rejections.reason", ("R",), "code, see names", "none", hdf5.whole(0, len(REASONS) - 1)),
    ("timing/ms_per_frame", "ms_per_frame", ("T",), "ms", "none", hdf5.NOT_NEGATIVE),
)


# The same below /runs/<mode>/log, fields of `Log` (K observations of d rows, N velocity measurements, B body columns).
_POSE = "m (translation)"
_COORDINATES = "see ekfslam.filters.log"
_NAMES_IN_LOG = {"M": "landmark_id", "N": "velocity"}
_LOG_LAYOUT = hdf5.layout(
    (
        "initial_covariance",
        "initial_covariance",
        ("xi", "xi"),
        "m^2, m rad, rad^2 (rho 0-2, theta 3-5)",
        "imu",
        COVARIANCES,
    ),
    ("twist", "twist", ("T", "u"), "m/s (0-2), rad/s (3-5)", "that of the velocities"),
    ("tau", "tau_s", ("T",), "s", "none", hdf5.NOT_NEGATIVE),
    ("T_imu_world_predicted", "T_predicted", ("T", "row", "column"), _POSE, "imu from world", RIGID),
    ("T_imu_world_linear", "T_linear", ("T", "row", "column"), _POSE, "imu from world", RIGID),
    ("T_imu_world_updated", "T_updated", ("T", "row", "column"), _POSE, "imu from world", RIGID),
    ("landmark_id", "id", ("M",), "landmark id", "none", hdf5.COUNTS),
    ("first_position", "first_position_m", ("M", "xyz"), "m", "world"),
    ("frame", "frame", ("K",), "frame index", "none", hdf5.index_of("T")),
    ("landmark", "landmark", ("K",), "row of landmark_id", "none", hdf5.index_of("M")),
    ("rows", "rows", ("K", "d"), "px, (uL, v, uR) or (u, v, disparity)", "image"),
    ("variance", "variance", ("K", "d"), "px^2", "image", hdf5.POSITIVE),
    ("linear_position", "position_m", ("K", "xyz"), "m", "world"),
    **_NAMES_IN_LOG,
)
_LOG_LAYOUT_4 = hdf5.layout(
    ("imu_twist", "imu_twist", ("T", "u"), "m/s (0-2), rad/s (3-5)", "imu"),
    ("seen_twist", "seen_twist", ("T", "u"), "m/s (0-2), rad/s (3-5)", "imu"),
    ("T_imu_world_departed", "T_departed", ("T", "row", "column"), _POSE, "imu from world", RIGID),
    ("T_imu_world_linear_before", "T_linear_before", ("T", "row", "column"), _POSE, "imu from world", RIGID),
    ("departed", "departed", ("T", "B"), _COORDINATES, "imu"),
    ("linear", "linear", ("T", "B"), _COORDINATES, "imu"),
    ("updated", "updated", ("T", "B"), _COORDINATES, "imu"),
    ("up", "up", ("T", "U"), "1", "world"),
    ("previous", "previous", ("K",), "observation, -1: none", "none", hdf5.index_of("K", least=-1)),
    ("velocity_frame", "velocity_frame", ("N",), "frame index", "none", hdf5.index_of("T")),
    ("velocity_axis", "velocity_axis", ("N",), "axis, 0 to 5", "none", hdf5.whole(0, 5)),
    ("velocity_value", "velocity_value", ("N",), "m/s or rad/s", "that of the velocities"),
    ("velocity_std", "velocity_std", ("N",), "m/s or rad/s", "that of the velocities", hdf5.NOT_NEGATIVE),
    ("velocity_is_biased", "velocity_is_biased", ("N",), "truth value", "none", hdf5.FLAGS),
    **_NAMES_IN_LOG,
)


# The same, of logs since there are interpolated intervals; without it none is.
_LOG_GAPS = hdf5.layout(("is_gap", "is_gap", ("T",), "truth value", "none", hdf5.FLAGS))

# The same below /runs/<mode>/whitened, fields of `WhitenedInnovations` (N observations of d rows).
_WHITENED_LAYOUT = hdf5.layout(
    ("frame", "frame", ("N",), "frame index", "none", hdf5.index_of("T")),
    ("landmark", "landmark", ("N",), "row of log/landmark_id", "none", hdf5.index_of("M")),
    ("alone", "alone", ("N", "d"), "1", "image"),
    ("apart", "apart", ("N", "d"), "1", "image", hdf5.NUMBERS_OR_NONE),
    ("score", "score", ("T", "xi"), "1/m (rho 0-2), 1/rad (theta 3-5)", "imu"),
    (
        "information",
        "information",
        ("T", "xi", "xi"),
        "1/m^2, 1/(m rad), 1/rad^2 (rho 0-2, theta 3-5)",
        "imu",
        COVARIANCES,
    ),
    N="innovation",
)

# The same below /runs/<mode>/parameters, fields of `Parameters` (P of them).
_PARAMETERS_LAYOUT = hdf5.layout(
    ("value", "value", ("T", "P"), "see attribute unit of the group", "imu"),
    ("std", "std", ("T", "P"), "see attribute unit of the group", "imu", hdf5.NOT_NEGATIVE),
    ("prior_std", "prior_std", ("P",), "see attribute unit of the group", "imu", hdf5.NOT_NEGATIVE),
)

# The same below /runs/<mode>/pairs, fields of `PosePairs` (N of them).
_PAIRS_LAYOUT = hdf5.layout(
    ("first", "first", ("N",), "frame index", "none", hdf5.index_of("T")),
    ("second", "second", ("N",), "frame index", "none", hdf5.index_of("T")),
    ("cross", "cross", ("N", "xi", "xi"), "m^2, m rad, rad^2 (rho 0-2, theta 3-5)", "imu of first, imu of second"),
    N="pair",
)

# The same below /runs/<mode>/hygiene, fields of `HygieneReport` (N findings).
_HYGIENE_LAYOUT = hdf5.layout(
    ("rule", "rule", ("N",), "code, see names", "none", hdf5.whole(0, len(RULES) - 1)),
    ("frame", "frame", ("N",), "frame index", "none", hdf5.index_of("T")),
    ("landmark", "landmark", ("N",), "landmark id", "none", hdf5.COUNTS),
    ("continuation", "continuation", ("N",), "landmark id, -1 where dropped", "none", hdf5.whole(-1)),
    N="finding",
)


# Everything below /runs/<mode>, by the group that a layout begins at.
LAYOUTS: Mapping[str, hdf5.Layout] = MappingProxyType(
    {
        "": LAYOUT,
        "log": (*_LOG_LAYOUT, *_LOG_LAYOUT_4, *_LOG_GAPS),
        "whitened": _WHITENED_LAYOUT,
        "parameters": _PARAMETERS_LAYOUT,
        "pairs": _PAIRS_LAYOUT,
        "hygiene": _HYGIENE_LAYOUT,
    }
)


@dataclass(frozen=True, repr=False)
class Archive(Shown):
    """What an archive holds: the sequence without its observations, and the results of its modes.

    Args:
        name, source, time_s, twist, camera, T_cam_imu, truth, noise, velocity_frame, notes, attributes: As in
            `Sequence`.
        results: Mode to result, in the order of writing.
        interpolated: As in `Sequence`.
    """

    name: str
    source: str
    time_s: Array
    twist: Array
    camera: StereoCamera
    T_cam_imu: Array
    truth: Truth | None
    noise: Noise | None
    velocity_frame: VelocityFrame
    notes: tuple[str, ...]
    attributes: Mapping[str, str | int | float]
    results: Mapping[str, Result]

    def card(self) -> Card:
        """What ``repr`` and a notebook show."""
        facts = {mode: count(len(result.landmarks), "landmark") for mode, result in self.results.items()}
        title = f"{self.name}, {count(len(self.time_s), 'frame')}, {count(len(facts), 'run')}"
        return Card(title, facts, tuple(f"archive.results[{mode!r}]" for mode in list(facts)[:1]))

    @cached_property
    def interpolated(self) -> BoolArray:
        return known_intervals(self.attributes, self.twist)


def write_archive(path: str | Path, sequence: Sequence | Archive, results: Mapping[str, Result]) -> None:
    """Write the results (mode to `Result`) of one sequence to an HDF5 file, replacing an old one.

    The file appears under its name only when it is complete: a run that is killed leaves the old archive or none.

    Raises:
        ArchiveError: The file cannot be written, or would hold what cannot be read again (NaN, say).
    """
    files.write(path, archive_image(sequence, results))


def archive_image(sequence: Sequence | Archive, results: Mapping[str, Result]) -> bytes:
    """What `write_archive` writes.

    Raises:
        ArchiveError: It would hold what cannot be read again (NaN, say).
    """

    def fill(h5file: h5py.File) -> None:
        hdf5.write_attributes(h5file, {"source": sequence.source, "error_convention": ERROR_CONVENTION})
        write_sequence_group(h5file, sequence)
        if sequence.truth is not None:
            write_truth_group(h5file, sequence.truth)
        runs = h5file.create_group("runs", track_order=True)
        for mode, result in results.items():
            _write_result(runs.create_group(mode), result, len(sequence.time_s))

    return hdf5.image(FORMAT, FORMAT_VERSION, fill)


def require_same_origin(path: str | Path, sequence: Sequence) -> None:
    """Raise a `WriteError` unless a path is free, or holds an archive of the same recording: of its content, or place.

    Raises:
        WriteError: It holds something else, or what cannot be read.
    """
    if files.is_free(path):
        return
    try:
        with hdf5.opened(path, FORMAT, FORMAT_VERSION) as h5file:
            found = hdf5.attributes(hdf5.subgroup(h5file, "sequence/attributes"))
            source = str(hdf5.attribute(h5file, "source"))
    except ArchiveError as error:
        raise WriteError(f"{path}: exists, and is no archive to be replaced ({error}); --force replaces it") from None
    key = "checksum_sha256"
    same_content = (
        found[key] == sequence.attributes[key] if {key} <= found.keys() & sequence.attributes.keys() else None
    )
    if same_content is None:
        same_content = source == sequence.source and found == dict(sequence.attributes)
    if not same_content:
        raise WriteError(f"{path}: exists, and is a result of another recording ({source}); --force replaces it")


def add_result(
    path: str | Path,
    result: Result,
    of: Result | None = None,
    beside: Mapping[Path, str | bytes] = MappingProxyType({}),
) -> None:
    """Add the result of one more mode to an archive, replacing an older one of that mode.

    The archive is read again and rewritten as a whole: it is never seen half written, and of two who add to it at the
    same time none loses what the other adds.

    Args:
        path: The archive.
        result: To be added.
        of: A run of the archive that the result was made from, which must still be there.
        beside: Further files that are written with it, see `ekfslam.files.write_all`.

    Raises:
        ArchiveError: The archive cannot be read or written, or no longer holds the run.
    """
    with files.alone(path):
        archive = read_archive(path)
        if of is not None and not _is_same_run(archive.results.get(of.mode), of):
            raise ArchiveError(f"{path}: its run {of.mode!r} was replaced meanwhile; start again")
        others = {mode: other for mode, other in archive.results.items() if mode != result.mode}
        files.write_all({**beside, Path(path): archive_image(archive, {**others, result.mode: result})})


def _is_same_run(found: Result | None, run: Result) -> bool:
    return found is not None and all(
        np.array_equal(getattr(found, name), getattr(run, name))
        for name in ("time_s", "T_world_imu", "covariance", "ms_per_frame")
    )


def read_archive(path: str | Path) -> Archive:
    """Everything an archive holds.

    Raises:
        ArchiveError: The file is missing, truncated, no ekfslam archive or of a newer format version, or something
            in it is missing or malformed; the message names file and item.
    """
    with hdf5.opened(path, FORMAT, FORMAT_VERSION) as h5file:
        sequence = {"noise": None, **_sequence_fields(h5file), "source": str(hdf5.attribute(h5file, "source"))}
        modes = hdf5.subgroup(h5file, "runs")
        return Archive(**sequence, results={mode: _read_result(h5file, mode, sequence) for mode in modes})


def open_result(path: str | Path, mode: str) -> Result:
    """The result of one mode, read without the rest of the archive.

    Raises:
        ArchiveError: As `read_archive`, or the archive has no such mode.
    """
    with hdf5.opened(path, FORMAT, FORMAT_VERSION) as h5file:
        modes = tuple(hdf5.subgroup(h5file, "runs"))
        if mode not in modes:
            raise ArchiveError(f"{path}: runs/{mode} is missing; this archive holds {', '.join(modes) or 'no run'}")
        return _read_result(h5file, mode, _sequence_fields(h5file))


def _write_result(group: h5py.Group, result: Result, frames: int) -> None:
    sizes, stamps = {"T": frames, "M": len(result.landmarks)}, {"time": result.time_s}
    hdf5.write_attributes(
        group,
        {
            "sequence_name": result.sequence_name,
            "config": json.dumps(result.config),
            "counts": json.dumps(dict(result.counts)),
            **noise_attributes(result.noise, "noise_"),
        },
    )
    hdf5.write_attributes(group.create_group("attributes"), result.attributes)
    hdf5.write_fields(group, LAYOUT, result, sizes, stamps)
    hdf5.write_attributes(group["rejections/reason"], {"names": REASONS})
    if result.parameters is not None:
        parameters = group.create_group("parameters")
        hdf5.write_attributes(parameters, {"name": result.parameters.name, "unit": result.parameters.unit})
        names = {"parameter": hdf5.fixed_texts(result.parameters.name)}
        hdf5.write_fields(parameters, _PARAMETERS_LAYOUT, result.parameters, sizes, {**stamps, **names})
    if result.pairs is not None:
        hdf5.write_fields(group.create_group("pairs"), _PAIRS_LAYOUT, result.pairs, sizes)
    if result.hygiene is not None:
        hygiene = group.create_group("hygiene")
        hdf5.write_attributes(hygiene, {"observations": result.hygiene.observations})
        hdf5.write_fields(hygiene, _HYGIENE_LAYOUT, result.hygiene, sizes)
        hdf5.write_attributes(hygiene["rule"], {"names": RULES})
    if result.whitened is not None:
        hdf5.write_fields(group.create_group("whitened"), _WHITENED_LAYOUT, result.whitened, sizes, stamps)
    if result.log is not None:
        log = group.create_group("log")
        hdf5.write_attributes(log, {"first_estimates": result.log.first_estimates})
        hdf5.write_fields(log, LAYOUTS["log"], result.log, sizes, stamps)


def _sequence_fields(h5file: h5py.File) -> dict[str, Any]:
    """Arguments of `Archive` but the results, validated as those of `Sequence` are."""
    try:
        found = read_sequence_fields(h5file, h5file.filename)
        found.pop("observations", None)
        found["name"] = printable(found["name"])
        no_index = np.empty(0, dtype=np.int64)
        none = Observations(no_index, no_index, np.empty((0, 4)))
        with spelled_as_in(h5file.filename, SPELLING):
            Sequence(**{**found, "observations": none, "attributes": {**found["attributes"], **WITHOUT_TRACKS}})
        return found
    except DataError as error:
        raise ArchiveError(str(error)) from None


def _read_result(h5file: h5py.File, mode: str, sequence: Mapping[str, Any]) -> Result:
    group = hdf5.subgroup(h5file, f"runs/{mode}")
    version = hdf5.version_of(group if "format_version" in group.attrs else h5file)
    fields: dict[str, dict[str, Any]] = {"": {}, "landmarks": {}, "innovation": {}, "rejections": {}}
    sizes, stamps = {"T": len(sequence["time_s"])}, _stamps(group)
    for field, value in hdf5.read_fields(group, LAYOUT, sizes, stamps).items():
        part, _, leaf = field.rpartition(".")
        fields[part][leaf] = value
    sizes["M"] = len(fields["landmarks"]["id"])
    noise = _read_noise(group)
    return Result(
        mode=mode,
        sequence_name=printable(str(hdf5.attribute(group, "sequence_name"))),
        **fields[""],
        landmarks=Landmarks(**fields["landmarks"]),
        innovation=Innovation(**fields["innovation"]),
        rejections=Rejections(**fields["rejections"]),
        counts=_read_counts(group),
        config=_read_config(group, noise, version),
        noise=noise,
        camera=sequence["camera"],
        T_cam_imu=sequence["T_cam_imu"],
        log=_read_log(hdf5.subgroup(group, "log"), sizes, stamps, version) if "log" in group else None,
        hygiene=_read_hygiene(hdf5.subgroup(group, "hygiene"), sizes) if "hygiene" in group else None,
        parameters=_read_parameters(hdf5.subgroup(group, "parameters"), sizes, stamps)
        if "parameters" in group
        else None,
        pairs=_read_pairs(hdf5.subgroup(group, "pairs"), sizes) if "pairs" in group else None,
        whitened=_read_whitened(hdf5.subgroup(group, "whitened"), sizes, stamps) if "whitened" in group else None,
        attributes=hdf5.facts(hdf5.subgroup(group, "attributes")),
    )


def _read_noise(group: h5py.Group) -> Noise:
    # These two have no default, and no result is without.
    for name in ("noise_twist_std", "noise_pixel_std_px"):
        hdf5.attribute(group, name)
    noise = Noise(**noise_of_attributes(group.attrs, "noise_"))
    try:
        validate_noise(noise)
    except DataError as error:
        raise ArchiveError(f"{group.file.filename}: {group.name.strip('/')}: {error}") from None
    return noise


def _read_counts(group: h5py.Group) -> dict[str, int]:
    counts = hdf5.json_table(group, "counts")
    if not all(type(count) is int and 0 <= count < 1 << 62 for count in counts.values()):
        raise ArchiveError(f"{group.file.filename}: attribute counts of {group.name.strip('/')} holds what is no count")
    return counts


def _read_config(group: h5py.Group, noise: Noise, version: int) -> dict[str, Any]:
    config = hdf5.json_table(group, "config")
    try:
        check_stored(config)
        config = _in_todays_terms(config, noise, version)
        check_stored(config)
    except ConfigError as error:
        raise ArchiveError(f"{group.file.filename}: attribute config of {group.name.strip('/')}: {error}") from None
    return config


def _stamps(group: h5py.Group) -> dict[str, Array]:
    """What other groups of a run have along their dimension ``time``."""
    time = group.get("trajectory/time")
    return {"time": time[()]} if isinstance(time, h5py.Dataset) else {}


def _read_log(group: h5py.Group, sizes: Mapping[str, int], stamps: Mapping[str, Array], version: int) -> Log:
    is_old = version < 4
    place = f"{group.file.filename}: {group.name.strip('/')}"
    found = hdf5.read_fields(group, _LOG_LAYOUT if is_old else (*_LOG_LAYOUT, *_LOG_LAYOUT_4), sizes, stamps)
    if not is_old:
        gaps = hdf5.read_fields(group, _LOG_GAPS, sizes, stamps) if "is_gap" in group else {}
        found["is_gap"] = gaps.get("is_gap", np.zeros(sizes["T"], dtype=bool))
    found["first_estimates"] = bool(hdf5.attribute(group, "first_estimates"))
    log = Log.of_poses_alone(**found) if is_old else Log(**found)
    require_agreement(vars(log), place)
    return log


def _read_parameters(group: h5py.Group, sizes: Mapping[str, int], stamps: Mapping[str, Array]) -> Parameters:
    names, units = (hdf5.texts(group.attrs.get(key, ())) for key in ("name", "unit"))
    found = hdf5.read_fields(group, _PARAMETERS_LAYOUT, sizes, {**stamps, "parameter": hdf5.fixed_texts(names)})
    if not len(names) == len(units) == len(found["prior_std"]):
        raise ArchiveError(
            f"{group.file.filename}: the attributes name and unit of {group.name.strip('/')} do not fit "
            f"{len(found['prior_std'])} parameters"
        )
    return Parameters(names, units, **found)


def _read_pairs(group: h5py.Group, sizes: Mapping[str, int]) -> PosePairs:
    pairs = PosePairs(**hdf5.read_fields(group, _PAIRS_LAYOUT, sizes))
    if not (pairs.first < pairs.second).all():
        raise ArchiveError(f"{group.file.filename}: {group.name.strip('/')} holds frames that are no pair")
    return pairs


def _read_whitened(group: h5py.Group, sizes: Mapping[str, int], stamps: Mapping[str, Array]) -> WhitenedInnovations:
    return WhitenedInnovations(**hdf5.read_fields(group, _WHITENED_LAYOUT, sizes, stamps))


def _read_hygiene(group: h5py.Group, sizes: Mapping[str, int]) -> HygieneReport:
    findings = hdf5.read_fields(group, _HYGIENE_LAYOUT, sizes)
    return HygieneReport(observations=int(hdf5.attribute(group, "observations")), **findings)


def _in_todays_terms(config: dict[str, Any], noise: Noise, version: int) -> dict[str, Any]:
    """A configuration of an older version.

    Before there was a choice, landmarks counted by their positions in world.
    Before version 4, drift was a share of the distance driven: today's drift, in px, says nothing of it. Before version
    3, the filter had the rules that hygiene has now.
    """
    if version < 4 and "noise" in config:
        config = {**config, "noise": {**config["noise"], "drift": None}}
    config = {**config, "filter": {"landmark_coordinates": "xyz", **config.get("filter", {})}}
    if "hygiene" in config:
        return config
    rest = dict(config.get("filter", {}))
    std = noise.pixel_std_px
    rules = {
        "restart_at_repeats": rest.pop("restart_at_repeats", False),
        "min_disparity_sigma": rest.pop("min_disparity_px", 0.0) / float(np.hypot(std[0], std[2])),
        "max_row_mismatch_sigma": rest.pop("max_row_mismatch_px", 0.0) / float(np.hypot(std[1], std[3])),
        "reused_id_sigma": 0.0,
    }
    return {**config, "filter": rest, "hygiene": {**dataclasses.asdict(HygieneConfig()), **rules}}
