"""One csv of tracks of one camera with an inertial unit: the export of EqVIO, which GTSAM distributes.

Rows are of a kind, ``row_type``: ``meta`` (``key``, ``value``: camera_fx ... camera_cy, T_ci_*, the pose of the camera
in the IMU frame), ``imu`` (``t_abs`` s, ``gx gy gz`` rad/s, ``ax ay az`` m/s^2) and ``vision_feature`` (``t_abs``,
``frame_idx``, ``landmark_id``, and undistorted ``u_norm v_norm``, tangents of the angles from the axis). Densities are
not stated: those of the file belong to another filter.
"""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.data.checks import spelled_as_in
from ekfslam.data.inertial import InertialRows, covered_frames, samples_of
from ekfslam.data.readers.fields import checksum
from ekfslam.data.readers.registry import Reader
from ekfslam.data.readers.text import Where, line_of, parse_numbers, read_lines
from ekfslam.data.sequence import Sequence
from ekfslam.data.tracks import inspect_tracks
from ekfslam.errors import CalibrationError, DataError, LineError, StampError
from ekfslam.geometry import se3
from ekfslam.geometry.camera import StereoCamera

_BEGIN = b"row_type,"
_CAMERA = tuple(f"camera_{name}" for name in ("fx", "fy", "cx", "cy"))
_POSE = tuple(f"T_ci_{name}" for name in ("tx", "ty", "tz", "qx", "qy", "qz", "qw"))
_IMU = ("t_abs", "gx", "gy", "gz", "ax", "ay", "az")
Meta = dict[str, tuple[str, Where]]
_OFF = 1e-3  # of the norm of a quaternion
_SEEN = ("t_abs", "frame_idx", "landmark_id", "u_norm", "v_norm")


def read_eqvio(path: Path) -> Sequence:
    """Read tracks, inertial samples and calibration.

    Raises:
        UnknownFormatError: The file is missing, or no text.
        DataError: A line is malformed, a key is missing, or stamps and frames do not fit; the subclass says how.
    """
    from scipy.spatial.transform import Rotation  # heavy to import

    meta, parts = _rows_by_kind(path)
    if (space := meta.get("measurement_space", ("normalized",))[0]) != "normalized":
        raise DataError(f"{space!r} is unknown, expected normalized", source=str(path), field="measurement_space")
    fx, fy, cx, cy, *pose = (_value(path, meta, key) for key in (*_CAMERA, *_POSE))
    if abs(np.linalg.norm(pose[3:]) - 1.0) > _OFF:
        raise CalibrationError("T_ci_q is no unit quaternion", source=str(path), field="T_ci_qw")
    samples, notes = samples_of(_samples(path, *map(np.array, parts["imu"])))
    table, frame, time_s = _seen(path, *map(np.array, parts["vision_feature"]))
    with spelled_as_in(str(path), {"K": "camera_fx", "T_cam_imu": "T_ci"}):
        sequence = Sequence.from_tracks(
            time_s,
            np.array([cx, cy]) + np.array([fx, fy]) * table[:, 3:],
            StereoCamera(fx, fy, cx, cy),
            frame=frame,
            landmark=table[:, 2],
            imu=samples,
            T_cam_imu=se3.inverse(se3.transform(Rotation.from_quat(pose[3:]).as_matrix(), np.array(pose[:3]))),
            name=path.stem,
        )
    notes = (*notes, *inspect_tracks(sequence.observations, sequence.twist).notes)
    attributes = {**sequence.attributes, "checksum_sha256": checksum(path), "reader": READER.name}
    sequence = replace(sequence, source=str(path), notes=notes, attributes=attributes)
    begin, end = covered_frames(samples, time_s, str(path))
    return sequence if (begin, end) == (0, len(time_s)) else sequence[begin:end]


def _rows_by_kind(path: Path) -> tuple[Meta, dict[str, tuple[list[list[float]], list[int]]]]:
    """Return values of keys with their lines, and the wanted columns and lines of the rows of the two other kinds."""
    lines = read_lines(path, f"expected {READER.expected}")
    names = [name.strip() for name in lines[0].split(",")]
    if missing := {"row_type", "key", "value", *_IMU, *_SEEN} - set(names):
        raise LineError(f"the columns {', '.join(sorted(missing))} are missing", **line_of(path, 1))
    meta: Meta = {}
    parts: dict[str, tuple[list[list[float]], list[int]]] = {"imu": ([], []), "vision_feature": ([], [])}
    for number, words in enumerate(csv.reader(lines[1:]), start=2):
        where, kind = line_of(path, number), words[0].strip() if words else ""
        if not kind:
            continue
        if len(words) != len(names):
            raise LineError(f"{len(words)} columns, expected {len(names)}", **where)
        row = dict(zip(names, words, strict=True))
        if kind == "meta":
            meta[row["key"].strip()] = row["value"].strip(), where
        elif kind in parts:
            wanted = _IMU if kind == "imu" else _SEEN
            parts[kind][0].append(parse_numbers([row[name] for name in wanted], len(wanted), where))
            parts[kind][1].append(number)
    return meta, parts


def _samples(path: Path, table: Array, line: IntArray) -> InertialRows:
    if not len(table):
        raise DataError("there are no rows of this kind", source=str(path), field="imu")
    return InertialRows(str(path), np.round(table[:, 0] * 1e9).astype(np.int64), table[:, 1:4], table[:, 4:], line=line)


def _value(path: Path, meta: Meta, key: str) -> float:
    if key not in meta:
        raise CalibrationError("this key is missing", source=str(path), field=key)
    text, where = meta[key]
    return parse_numbers([text], 1, where)[0]


def _seen(path: Path, table: Array, line: IntArray) -> tuple[Array, IntArray, Array]:
    """Return the rows of features (K, 5), the index (K,) of their frames, and the stamps (T,) of these."""
    if not len(table):
        raise DataError("there are no rows of this kind", source=str(path), field="vision_feature")
    _, first, frame = np.unique(table[:, 1], return_index=True, return_inverse=True)
    time_s = table[first, 0]
    goes_back = np.concatenate([[False], np.diff(time_s) <= 0])
    for wrong, what in (
        (table[:, 0] != time_s[frame], "the stamp differs from that of the same frame before"),
        (goes_back[frame], "the stamp does not increase"),
    ):
        if wrong.any():
            raise StampError(what, **line_of(path, int(line[np.argmax(wrong)])))
    return table, frame.astype(np.int64), time_s


READER = Reader(
    "eqvio",
    "a csv of EqVIO (row_type, t_abs, ...)",
    lambda source: source.head.startswith(_BEGIN),
    lambda source: read_eqvio(source.path),
)
