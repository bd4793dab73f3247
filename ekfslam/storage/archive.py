"""Result archives: one HDF5 file holds what every mode made of one sequence.

    /                       attributes format, format_version, source, error_convention
    /sequence, /truth       as in `ekfslam.data.readers.hdf5`, without the observations
    /runs/<mode>            attributes config (JSON), counts (JSON), noise_<field of `Noise`>, sequence_name
        attributes          seed, input checksum, versions of the software, as attributes
        trajectory          time, T_world_imu, covariance
        landmarks           id, position, covariance, initial_position, first_frame, last_frame, observations
        innovation          nis, dof, accepted, rejected
        rejections          frame, landmark, reason (index into its attribute ``names``)
        parameters          value, std, prior_std; attributes name, unit; see `ekfslam.filters.result.Parameters`
        hygiene             rule (index into its attribute ``names``), frame, landmark, continuation: see
                            `ekfslam.filters.result.HygieneReport`; attribute observations (not in dead reckoning)
        timing              ms_per_frame
        log                 what `ekfslam.smoother.posterior` needs: see `ekfslam.filters.log.Log` (mode full only)

Every data set has the attributes ``units`` and ``frame`` (of reference). Reading gives back every number bit for bit.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
from scipy.spatial.transform import Rotation

from ekfslam.arrays import Array
from ekfslam.config import HygieneConfig
from ekfslam.data.hygiene import RULES, HygieneReport
from ekfslam.data.readers.hdf5 import read_sequence_fields, write_sequence_group, write_truth_group
from ekfslam.data.sequence import Noise, Sequence, Truth, VelocityFrame
from ekfslam.errors import ArchiveError, DataError
from ekfslam.filters.log import Log
from ekfslam.filters.result import (
    ERROR_CONVENTION,
    REASONS,
    Innovation,
    Landmarks,
    Parameters,
    Rejections,
    Result,
)
from ekfslam.geometry.camera import StereoCamera

FORMAT = "ekfslam-archive"
FORMAT_VERSION = 4  # 2 added log, 3 hygiene and parameters, 4 state blocks and track errors in the log

# Data set below /runs/<mode>, field of `Result`, shape (T frames, M landmarks, R rejections), units, frame.
_Layout = tuple[tuple[str, str, tuple[str | int, ...], str, str], ...]
_LAYOUT: _Layout = (
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
_LOG_LAYOUT: _Layout = (
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
_LOG_LAYOUT_4: _Layout = (
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


# The same below /runs/<mode>/parameters, fields of `Parameters` (P of them).
_PARAMETERS_LAYOUT: _Layout = (
    ("value", "value", ("T", "P"), "see attribute unit of the group", "imu"),
    ("std", "std", ("T", "P"), "see attribute unit of the group", "imu"),
    ("prior_std", "prior_std", ("P",), "see attribute unit of the group", "imu"),
)

# The same below /runs/<mode>/hygiene, fields of `HygieneReport` (N findings).
_HYGIENE_LAYOUT: _Layout = (
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


def write_archive(path: str | Path, sequence: Sequence, results: Mapping[str, Result]) -> None:
    """Write the results (mode to `Result`) of one sequence to an HDF5 file, replacing an old one.

    The file appears under its name only when it is complete: a run that is killed leaves the old archive or none.

    Raises:
        ArchiveError: The file cannot be written.
    """
    with _replacing(Path(path)) as unfinished, h5py.File(str(unfinished), "w") as h5file:
        h5file.attrs.update(
            format=FORMAT, format_version=FORMAT_VERSION, source=sequence.source, error_convention=ERROR_CONVENTION
        )
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
    path = Path(path)
    with _opened(path), _replacing(path) as unfinished:
        shutil.copyfile(path, unfinished)
        with h5py.File(str(unfinished), "r+") as h5file:
            h5file.attrs["format_version"] = FORMAT_VERSION
            if result.mode in h5file["runs"]:
                del h5file["runs"][result.mode]
            _write_result(h5file["runs"].create_group(result.mode), result)


@contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    """A name to write a file under that takes the place of ``path`` when it is complete."""
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        yield unfinished
        unfinished.replace(path)
    except OSError as error:
        raise ArchiveError(f"{path}: cannot be written: {error}") from None
    finally:
        unfinished.unlink(missing_ok=True)


def read_archive(path: str | Path) -> Archive:
    """Everything an archive holds.

    Raises:
        ArchiveError: The file is missing, truncated, no ekfslam archive or of a newer format version, or something
            in it is missing or malformed; the message names file and item.
    """
    with _opened(path) as h5file:
        fields = {"noise": None, **read_sequence_fields(h5file, str(path))}
        fields["source"] = str(h5file.attrs["source"])
        calibration = fields["camera"], fields["T_cam_imu"]
        results = {mode: _read_result(path, h5file, mode, *calibration) for mode in _modes(path, h5file)}
        return Archive(**fields, results=results)


def open_result(path: str | Path, mode: str) -> Result:
    """The result of one mode, read without the rest of the archive.

    Raises:
        ArchiveError: As `read_archive`, or the archive has no such mode.
    """
    with _opened(path) as h5file:
        modes = _modes(path, h5file)
        if mode not in modes:
            raise ArchiveError(f"{path}: runs/{mode} is missing; this archive holds {', '.join(modes) or 'no run'}")
        fields = read_sequence_fields(h5file, str(path))
        return _read_result(path, h5file, mode, fields["camera"], fields["T_cam_imu"])


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
    group.attrs.update(
        sequence_name=result.sequence_name,
        config=json.dumps(result.config),
        counts=json.dumps(dict(result.counts)),
        **{f"noise_{name}": value for name, value in vars(result.noise).items() if value is not None},
    )
    group.create_group("attributes").attrs.update(result.attributes)
    _write_fields(group, _LAYOUT, result)
    group["rejections/reason"].attrs["names"] = REASONS
    if result.parameters is not None:
        parameters = group.create_group("parameters")
        parameters.attrs.update(name=result.parameters.name, unit=result.parameters.unit)
        _write_fields(parameters, _PARAMETERS_LAYOUT, result.parameters)
    if result.hygiene is not None:
        hygiene = group.create_group("hygiene")
        hygiene.attrs["observations"] = result.hygiene.observations
        _write_fields(hygiene, _HYGIENE_LAYOUT, result.hygiene)
        hygiene["rule"].attrs["names"] = RULES
    if result.log is not None:
        log = group.create_group("log")
        log.attrs["first_estimates"] = result.log.first_estimates
        _write_fields(log, (*_LOG_LAYOUT, *_LOG_LAYOUT_4), result.log)


def _write_fields(group: h5py.Group, layout: _Layout, source: Result | Log | Parameters | HygieneReport) -> None:
    for name, field, _, units, frame in layout:
        dataset = group.create_dataset(name, data=attrgetter(field)(source))
        dataset.attrs["units"], dataset.attrs["frame"] = units, frame


def _read_fields(where: str, group: h5py.Group, layout: _Layout, sizes: dict[str, int]) -> dict[str, Any]:
    """The data sets of a layout by field; the first one along a dimension decides its length, unless it is given."""
    fields: dict[str, Any] = {}
    for name, field, shape, _, _ in layout:
        if not isinstance(group.get(name), h5py.Dataset):
            raise ArchiveError(f"{where}/{name} is missing")
        value = group[name][()]
        if value.ndim == len(shape):
            for n, length in zip(shape, value.shape, strict=True):
                if isinstance(n, str):
                    sizes.setdefault(n, length)
        wanted = tuple(sizes.get(n, n) if isinstance(n, str) else n for n in shape)
        if value.shape != wanted:
            raise ArchiveError(f"{where}/{name} has shape {value.shape}, expected {wanted}")
        fields[field] = value
    return fields


def _read_result(path: str | Path, h5file: h5py.File, mode: str, camera: StereoCamera, T_cam_imu: Array) -> Result:
    group = h5file["runs"][mode]
    sizes: dict[str, int] = {}
    fields: dict[str, dict[str, Any]] = {"": {}, "landmarks": {}, "innovation": {}, "rejections": {}}
    for field, value in _read_fields(f"{path}: runs/{mode}", group, _LAYOUT, sizes).items():
        part, _, leaf = field.rpartition(".")
        fields[part][leaf] = value
    log = None
    if isinstance(group.get("log"), h5py.Group):
        where = f"{path}: runs/{mode}/log"
        is_old = h5file.attrs["format_version"] < 4
        layout = _LOG_LAYOUT if is_old else (*_LOG_LAYOUT, *_LOG_LAYOUT_4)
        log_fields = _read_fields(where, group["log"], layout, {key: sizes[key] for key in ("T", "M")})
        if "first_estimates" not in group["log"].attrs:
            raise ArchiveError(f"{where}: attribute first_estimates is missing")
        log_fields["first_estimates"] = bool(group["log"].attrs["first_estimates"])
        log = Log.of_poses_alone(**log_fields) if is_old else Log(**log_fields)
    parameters = None
    if isinstance(group.get("parameters"), h5py.Group):
        where, stored = f"{path}: runs/{mode}/parameters", group["parameters"]
        found = _read_fields(where, stored, _PARAMETERS_LAYOUT, {"T": sizes["T"]})
        names = {key: tuple(str(text) for text in np.ravel(stored.attrs.get(key, ()))) for key in ("name", "unit")}
        if any(len(texts) != len(found["prior_std"]) for texts in names.values()):
            raise ArchiveError(f"{where}: the attributes name and unit do not fit {len(found['prior_std'])} parameters")
        parameters = Parameters(names["name"], names["unit"], **found)
    hygiene = None
    if isinstance(group.get("hygiene"), h5py.Group):
        where = f"{path}: runs/{mode}/hygiene"
        findings = _read_fields(where, group["hygiene"], _HYGIENE_LAYOUT, {})
        if "observations" not in group["hygiene"].attrs:
            raise ArchiveError(f"{where}: attribute observations is missing")
        hygiene = HygieneReport(observations=int(group["hygiene"].attrs["observations"]), **findings)
    for name in ("sequence_name", "config", "counts", "noise_twist_std", "noise_pixel_std_px"):
        if name not in group.attrs:
            raise ArchiveError(f"{path}: attribute {name} of runs/{mode} is missing")
    if not isinstance(group.get("attributes"), h5py.Group):
        raise ArchiveError(f"{path}: runs/{mode}/attributes is missing")
    noise = _read_noise(group)
    return Result(
        mode=mode,
        sequence_name=str(group.attrs["sequence_name"]),
        **fields[""],
        landmarks=Landmarks(**fields["landmarks"]),
        innovation=Innovation(**fields["innovation"]),
        rejections=Rejections(**fields["rejections"]),
        counts=json.loads(group.attrs["counts"]),
        config=_renamed(json.loads(group.attrs["config"]), noise),
        noise=noise,
        camera=camera,
        T_cam_imu=T_cam_imu,
        log=log,
        hygiene=hygiene,
        parameters=parameters,
        attributes={
            key: value.item() if isinstance(value, np.generic) else value
            for key, value in group["attributes"].attrs.items()
        },
    )


def _renamed(config: dict[str, Any], noise: Noise) -> dict[str, Any]:
    """A configuration from before version 3, whose filter had the rules that hygiene has now, in today's terms."""
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


def _read_noise(group: h5py.Group) -> Noise:
    """The noise of a run; what an older version of the format did not know yet has its default."""
    stored = {f.name: group.attrs.get(f"noise_{f.name}") for f in fields(Noise)}
    given: dict[str, Any] = {
        name: float(value) if np.ndim(value) == 0 else value for name, value in stored.items() if value is not None
    }
    return Noise(**given)


def _modes(path: str | Path, h5file: h5py.File) -> tuple[str, ...]:
    if not isinstance(h5file.get("runs"), h5py.Group):
        raise ArchiveError(f"{path}: the group runs is missing")
    return tuple(h5file["runs"])


@contextmanager
def _opened(path: str | Path) -> Iterator[h5py.File]:
    """The archive, open for reading and of a known version; whatever damage shows meanwhile is an `ArchiveError`."""
    try:
        with h5py.File(str(path), "r") as h5file:
            if h5file.attrs.get("format") != FORMAT:
                raise ArchiveError(
                    f"{path}: no ekfslam archive: format is {h5file.attrs.get('format')!r}, expected {FORMAT!r}"
                )
            version = h5file.attrs.get("format_version")
            if not isinstance(version, np.integer) or version > FORMAT_VERSION:
                raise ArchiveError(
                    f"{path}: has format version {version}, this release reads up to version {FORMAT_VERSION}"
                )
            yield h5file
    except DataError as error:
        raise ArchiveError(str(error)) from None
    except (OSError, RuntimeError, KeyError, ValueError) as error:  # what h5py and json raise at damaged files
        raise ArchiveError(f"{path}: missing, truncated or no HDF5 file ({error})") from None
