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
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
from scipy.spatial.transform import Rotation

from ekfslam import hdf5
from ekfslam.arrays import Array, BoolArray
from ekfslam.config import HygieneConfig
from ekfslam.data.hygiene import RULES, HygieneReport
from ekfslam.data.interpolation import known_intervals
from ekfslam.data.readers.hdf5 import (
    noise_attributes,
    noise_of_attributes,
    read_sequence_fields,
    write_sequence_group,
    write_truth_group,
)
from ekfslam.data.sequence import Noise, Sequence, Truth, VelocityFrame
from ekfslam.errors import ArchiveError, DataError
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

FORMAT = "ekfslam-archive"
FORMAT_VERSION = 4  # 2 added log, 3 hygiene and parameters, 4 state blocks and track errors in the log

# Data sets below /runs/<mode>, fields of `Result` (T frames, M landmarks, R rejections).
_LAYOUT: hdf5.Layout = (
    ("trajectory/time", "time_s", ("T",), "s", "clock of the recording"),
    ("trajectory/T_world_imu", "T_world_imu", ("T", 4, 4), "m (translation)", "world from imu"),
    ("trajectory/covariance", "covariance", ("T", 6, 6), "m^2, m rad, rad^2 (rho 0-2, theta 3-5)", "imu"),
    ("landmarks/id", "landmarks.id", ("M",), "landmark id", "none"),
    ("landmarks/position", "landmarks.position_m", ("M", 3), "m", "world"),
    ("landmarks/covariance", "landmarks.covariance", ("M", 3, 3), "m^2", "world"),
    ("landmarks/initial_position", "landmarks.initial_position_m", ("M", 3), "m", "world"),
    ("landmarks/first_frame", "landmarks.first_frame", ("M",), "frame index", "none"),
    ("landmarks/last_frame", "landmarks.last_frame", ("M",), "frame index", "none"),
    ("landmarks/observations", "landmarks.observations", ("M",), "count", "none"),
    ("innovation/nis", "innovation.nis", ("T",), "1", "none"),
    ("innovation/dof", "innovation.dof", ("T",), "count", "none"),
    ("innovation/accepted", "innovation.accepted", ("T",), "count", "none"),
    ("innovation/rejected", "innovation.rejected", ("T",), "count", "none"),
    ("rejections/frame", "rejections.frame", ("R",), "frame index", "none"),
    ("rejections/landmark", "rejections.landmark", ("R",), "landmark id", "none"),
    ("rejections/reason", "rejections.reason", ("R",), "code, see names", "none"),
    ("timing/ms_per_frame", "ms_per_frame", ("T",), "ms", "none"),
)


# The same below /runs/<mode>/log, fields of `Log` (K observations of d rows, N velocity measurements, B body columns).
_POSE = "m (translation)"
_COORDINATES = "see ekfslam.filters.log"
_LOG_LAYOUT: hdf5.Layout = (
    ("initial_covariance", "initial_covariance", (6, 6), "m^2, m rad, rad^2 (rho 0-2, theta 3-5)", "imu"),
    ("twist", "twist", ("T", 6), "m/s (0-2), rad/s (3-5)", "that of the velocities"),
    ("tau", "tau_s", ("T",), "s", "none"),
    ("T_imu_world_predicted", "T_predicted", ("T", 4, 4), _POSE, "imu from world"),
    ("T_imu_world_linear", "T_linear", ("T", 4, 4), _POSE, "imu from world"),
    ("T_imu_world_updated", "T_updated", ("T", 4, 4), _POSE, "imu from world"),
    ("landmark_id", "id", ("M",), "landmark id", "none"),
    ("first_position", "first_position_m", ("M", 3), "m", "world"),
    ("frame", "frame", ("K",), "frame index", "none"),
    ("landmark", "landmark", ("K",), "row of landmark_id", "none"),
    ("rows", "rows", ("K", "d"), "px, (uL, v, uR) or (u, v, disparity)", "image"),
    ("variance", "variance", ("K", "d"), "px^2", "image"),
    ("linear_position", "position_m", ("K", 3), "m", "world"),
)
_LOG_LAYOUT_4: hdf5.Layout = (
    ("imu_twist", "imu_twist", ("T", 6), "m/s (0-2), rad/s (3-5)", "imu"),
    ("seen_twist", "seen_twist", ("T", 6), "m/s (0-2), rad/s (3-5)", "imu"),
    ("T_imu_world_departed", "T_departed", ("T", 4, 4), _POSE, "imu from world"),
    ("T_imu_world_linear_before", "T_linear_before", ("T", 4, 4), _POSE, "imu from world"),
    ("departed", "departed", ("T", "B"), _COORDINATES, "imu"),
    ("linear", "linear", ("T", "B"), _COORDINATES, "imu"),
    ("updated", "updated", ("T", "B"), _COORDINATES, "imu"),
    ("up", "up", ("T", "U"), "1", "world"),
    ("previous", "previous", ("K",), "observation, -1: none", "none"),
    ("velocity_frame", "velocity_frame", ("N",), "frame index", "none"),
    ("velocity_axis", "velocity_axis", ("N",), "axis, 0 to 5", "none"),
    ("velocity_value", "velocity_value", ("N",), "m/s or rad/s", "that of the velocities"),
    ("velocity_std", "velocity_std", ("N",), "m/s or rad/s", "that of the velocities"),
    ("velocity_is_biased", "velocity_is_biased", ("N",), "truth value", "none"),
)


# The same, of logs since there are interpolated intervals; without it none is.
_LOG_GAPS: hdf5.Layout = (("is_gap", "is_gap", ("T",), "truth value", "none"),)

# The same below /runs/<mode>/whitened, fields of `WhitenedInnovations` (N observations of d rows).
_WHITENED_LAYOUT: hdf5.Layout = (
    ("frame", "frame", ("N",), "frame index", "none"),
    ("landmark", "landmark", ("N",), "row of log/landmark_id", "none"),
    ("alone", "alone", ("N", "d"), "1", "image"),
    ("apart", "apart", ("N", "d"), "1", "image"),
    ("score", "score", ("T", 6), "1/m (rho 0-2), 1/rad (theta 3-5)", "imu"),
    ("information", "information", ("T", 6, 6), "1/m^2, 1/(m rad), 1/rad^2 (rho 0-2, theta 3-5)", "imu"),
)

# The same below /runs/<mode>/parameters, fields of `Parameters` (P of them).
_PARAMETERS_LAYOUT: hdf5.Layout = (
    ("value", "value", ("T", "P"), "see attribute unit of the group", "imu"),
    ("std", "std", ("T", "P"), "see attribute unit of the group", "imu"),
    ("prior_std", "prior_std", ("P",), "see attribute unit of the group", "imu"),
)

# The same below /runs/<mode>/pairs, fields of `PosePairs` (N of them).
_PAIRS_LAYOUT: hdf5.Layout = (
    ("first", "first", ("N",), "frame index", "none"),
    ("second", "second", ("N",), "frame index", "none"),
    ("cross", "cross", ("N", 6, 6), "m^2, m rad, rad^2 (rho 0-2, theta 3-5)", "imu of first, imu of second"),
)

# The same below /runs/<mode>/hygiene, fields of `HygieneReport` (N findings).
_HYGIENE_LAYOUT: hdf5.Layout = (
    ("rule", "rule", ("N",), "code, see names", "none"),
    ("frame", "frame", ("N",), "frame index", "none"),
    ("landmark", "landmark", ("N",), "landmark id", "none"),
    ("continuation", "continuation", ("N",), "landmark id, -1 where dropped", "none"),
)


@dataclass(frozen=True)
class Archive:
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

    @cached_property
    def interpolated(self) -> BoolArray:
        return known_intervals(self.attributes, self.twist)


def write_archive(path: str | Path, sequence: Sequence, results: Mapping[str, Result]) -> None:
    """Write the results (mode to `Result`) of one sequence to an HDF5 file, replacing an old one.

    The file appears under its name only when it is complete: a run that is killed leaves the old archive or none.

    Raises:
        ArchiveError: The file cannot be written.
    """
    with hdf5.creating(path, FORMAT, FORMAT_VERSION) as h5file:
        hdf5.write_attributes(h5file, {"source": sequence.source, "error_convention": ERROR_CONVENTION})
        write_sequence_group(h5file, sequence, include_observations=False)
        if sequence.truth is not None:
            write_truth_group(h5file, sequence.truth)
        runs = h5file.create_group("runs", track_order=True)
        for mode, result in results.items():
            _write_result(runs.create_group(mode), result)


def add_result(path: str | Path, result: Result) -> None:
    """Add the result of one more mode to an archive, replacing an older one of that mode.

    The archive is rewritten beside itself and then renamed: it is never seen half written.

    Raises:
        ArchiveError: The archive cannot be read or written.
    """
    with hdf5.opened(path, FORMAT, FORMAT_VERSION):
        pass
    with hdf5.replacing(path) as unfinished:
        shutil.copyfile(path, unfinished)
        with h5py.File(str(unfinished), "r+") as h5file:
            runs, version = h5file["runs"], h5file.attrs["format_version"]
            if result.mode in runs:
                del runs[result.mode]
            for older in runs.values():
                hdf5.write_attributes(older, {"format_version": older.attrs.get("format_version", version)})
            h5file.attrs["format_version"] = FORMAT_VERSION
            _write_result(runs.create_group(result.mode), result)


def read_archive(path: str | Path) -> Archive:
    """Everything an archive holds.

    Raises:
        ArchiveError: The file is missing, truncated, no ekfslam archive or of a newer format version, or something
            in it is missing or malformed; the message names file and item.
    """
    with hdf5.opened(path, FORMAT, FORMAT_VERSION) as h5file:
        sequence = {"noise": None, **_sequence_fields(h5file), "source": str(hdf5.attribute(h5file, "source"))}
        calibration = sequence["camera"], sequence["T_cam_imu"]
        modes = hdf5.subgroup(h5file, "runs")
        return Archive(**sequence, results={mode: _read_result(h5file, mode, *calibration) for mode in modes})


def open_result(path: str | Path, mode: str) -> Result:
    """The result of one mode, read without the rest of the archive.

    Raises:
        ArchiveError: As `read_archive`, or the archive has no such mode.
    """
    with hdf5.opened(path, FORMAT, FORMAT_VERSION) as h5file:
        modes = tuple(hdf5.subgroup(h5file, "runs"))
        if mode not in modes:
            raise ArchiveError(f"{path}: runs/{mode} is missing; this archive holds {', '.join(modes) or 'no run'}")
        sequence = _sequence_fields(h5file)
        return _read_result(h5file, mode, sequence["camera"], sequence["T_cam_imu"])


def export_trajectory(result: Result, path: str | Path, format: Literal["tum", "kitti"]) -> None:
    """Write the estimated poses ``T_world_imu`` as text, one line a frame, in 17 digits: every number exactly.

    Both formats hold the pose of the *IMU* in *world*; KITTI's own files hold the left camera in its first frame.

    Args:
        result: Run to export.
        path: File to write.
        format: ``tum``: ``time tx ty tz qx qy qz qw`` (s, m, unit quaternion); ``kitti``: the twelve entries of the
            upper 3x4 part row by row.

    Raises:
        ArchiveError: The file cannot be written.
    """
    _write_poses(path, result.time_s, result.T_world_imu, format)


def export_truth(archive: str | Path, path: str | Path, format: Literal["tum", "kitti"]) -> int:
    """Write the true poses that an archive holds, as `export_trajectory` does; one line a frame of known pose.

    Returns:
        The number of lines.

    Raises:
        ArchiveError: As `read_archive`; or there is no true pose, or not of every frame and the format is ``kitti``,
            which has no stamps to say of which; or the file cannot be written.
    """
    found = read_archive(archive)
    truth, frames = found.truth, len(found.time_s)
    if truth is None or not len(truth.frame):
        raise ArchiveError(f"{archive}: holds no true pose")
    if format == "kitti" and len(truth.frame) < frames:
        raise ArchiveError(
            f"{archive}: holds the true pose of {len(truth.frame)} of {frames} frames; kitti has no stamps to say of "
            "which, take tum"
        )
    _write_poses(path, found.time_s[truth.frame], truth.T_world_imu, format)
    return len(truth.frame)


def _write_poses(path: str | Path, time_s: Array, T: Array, format: Literal["tum", "kitti"]) -> None:
    if format == "tum":
        quaternion = Rotation.from_matrix(T[:, :3, :3]).as_quat()  # scalar last, as TUM has it
        rows = np.column_stack([time_s, T[:, :3, 3], quaternion])
    else:
        rows = T[:, :3].reshape(-1, 12)
    try:
        np.savetxt(path, rows, fmt="%.17g")
    except OSError as error:
        raise ArchiveError(f"{path}: cannot be written: {error}") from None


def _write_result(group: h5py.Group, result: Result) -> None:
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
    hdf5.write_fields(group, _LAYOUT, result)
    group["rejections/reason"].attrs["names"] = REASONS
    if result.parameters is not None:
        parameters = group.create_group("parameters")
        hdf5.write_attributes(parameters, {"name": result.parameters.name, "unit": result.parameters.unit})
        hdf5.write_fields(parameters, _PARAMETERS_LAYOUT, result.parameters)
    if result.pairs is not None:
        hdf5.write_fields(group.create_group("pairs"), _PAIRS_LAYOUT, result.pairs)
    if result.hygiene is not None:
        hygiene = group.create_group("hygiene")
        hdf5.write_attributes(hygiene, {"observations": result.hygiene.observations})
        hdf5.write_fields(hygiene, _HYGIENE_LAYOUT, result.hygiene)
        hygiene["rule"].attrs["names"] = RULES
    if result.whitened is not None:
        hdf5.write_fields(group.create_group("whitened"), _WHITENED_LAYOUT, result.whitened)
    if result.log is not None:
        log = group.create_group("log")
        hdf5.write_attributes(log, {"first_estimates": result.log.first_estimates})
        hdf5.write_fields(log, (*_LOG_LAYOUT, *_LOG_LAYOUT_4, *_LOG_GAPS), result.log)


def _sequence_fields(h5file: h5py.File) -> dict[str, Any]:
    """Arguments of `Archive` but the results; what is wrong with them is wrong with the archive."""
    try:
        return read_sequence_fields(h5file, h5file.filename)
    except DataError as error:
        raise ArchiveError(str(error)) from None


def _read_result(h5file: h5py.File, mode: str, camera: StereoCamera, T_cam_imu: Array) -> Result:
    group = hdf5.subgroup(h5file, f"runs/{mode}")
    version = group.attrs.get("format_version", h5file.attrs["format_version"])
    fields: dict[str, dict[str, Any]] = {"": {}, "landmarks": {}, "innovation": {}, "rejections": {}}
    for field, value in hdf5.read_fields(group, _LAYOUT).items():
        part, _, leaf = field.rpartition(".")
        fields[part][leaf] = value
    sizes = {"T": len(fields[""]["time_s"]), "M": len(fields["landmarks"]["id"])}
    # These two have no default, and no result is without.
    for name in ("noise_twist_std", "noise_pixel_std_px"):
        hdf5.attribute(group, name)
    noise = Noise(**noise_of_attributes(group.attrs, "noise_"))
    return Result(
        mode=mode,
        sequence_name=str(hdf5.attribute(group, "sequence_name")),
        **fields[""],
        landmarks=Landmarks(**fields["landmarks"]),
        innovation=Innovation(**fields["innovation"]),
        rejections=Rejections(**fields["rejections"]),
        counts=hdf5.json_table(group, "counts"),
        config=_in_todays_terms(hdf5.json_table(group, "config"), noise, version),
        noise=noise,
        camera=camera,
        T_cam_imu=T_cam_imu,
        log=_read_log(hdf5.subgroup(group, "log"), sizes, version) if "log" in group else None,
        hygiene=_read_hygiene(hdf5.subgroup(group, "hygiene")) if "hygiene" in group else None,
        parameters=_read_parameters(hdf5.subgroup(group, "parameters"), sizes) if "parameters" in group else None,
        pairs=_read_pairs(hdf5.subgroup(group, "pairs"), sizes["T"]) if "pairs" in group else None,
        whitened=_read_whitened(hdf5.subgroup(group, "whitened"), sizes) if "whitened" in group else None,
        attributes=hdf5.attributes(hdf5.subgroup(group, "attributes")),
    )


def _read_log(group: h5py.Group, sizes: Mapping[str, int], version: int) -> Log:
    is_old = version < 4
    found = hdf5.read_fields(group, _LOG_LAYOUT if is_old else (*_LOG_LAYOUT, *_LOG_LAYOUT_4), sizes)
    if not is_old:
        gaps = hdf5.read_fields(group, _LOG_GAPS, {"T": sizes["T"]}) if "is_gap" in group else {}
        found["is_gap"] = gaps.get("is_gap", np.zeros(sizes["T"])).astype(bool)
    found["first_estimates"] = bool(hdf5.attribute(group, "first_estimates"))
    return Log.of_poses_alone(**found) if is_old else Log(**found)


def _read_parameters(group: h5py.Group, sizes: Mapping[str, int]) -> Parameters:
    found = hdf5.read_fields(group, _PARAMETERS_LAYOUT, {"T": sizes["T"]})
    names, units = (hdf5.texts(group.attrs.get(key, ())) for key in ("name", "unit"))
    if not len(names) == len(units) == len(found["prior_std"]):
        raise ArchiveError(
            f"{group.file.filename}: the attributes name and unit of {group.name.strip('/')} do not fit "
            f"{len(found['prior_std'])} parameters"
        )
    return Parameters(names, units, **found)


def _read_pairs(group: h5py.Group, frames: int) -> PosePairs:
    pairs = PosePairs(**hdf5.read_fields(group, _PAIRS_LAYOUT))
    if not ((pairs.first >= 0) & (pairs.first < pairs.second) & (pairs.second < frames)).all():
        raise ArchiveError(f"{group.file.filename}: {group.name.strip('/')} holds frames that are no pair of {frames}")
    return pairs


def _read_whitened(group: h5py.Group, sizes: Mapping[str, int]) -> WhitenedInnovations:
    return WhitenedInnovations(**hdf5.read_fields(group, _WHITENED_LAYOUT, {"T": sizes["T"]}))


def _read_hygiene(group: h5py.Group) -> HygieneReport:
    findings = hdf5.read_fields(group, _HYGIENE_LAYOUT)
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
