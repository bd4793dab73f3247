"""Packets of the GPS/INS unit of KITTI raw: stamps, velocities and true poses of a drive folder.

``vf vl vu`` and ``wf wl wu`` are *level*: along forward, left and up of a vehicle without roll and pitch. After
`with_lateral`, ``v_imu = (R_y(pitch) R_x(roll))^T v_level``. East and north are the Mercator projection of the sphere,
scaled by the cosine of the first latitude; up is ``alt``; the rotation is ``R_z(yaw) R_y(pitch) R_x(roll)``. The world
is the first pose. An empty line of ``timestamps.txt`` is a lost stamp, which is interpolated between its neighbours. If
its packet is missing too, so are its velocities, and the frame has no truth.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.data.inputs import linear
from ekfslam.data.interpolation import interpolation_attributes, interpolation_notes
from ekfslam.data.readers.fields import LATERAL_NOTES, with_lateral
from ekfslam.data.readers.registry import Lateral
from ekfslam.data.readers.text import line_of, parse_table, read_lines
from ekfslam.data.sequence import Truth
from ekfslam.data.truth_noise import KITTI_TRUTH_NOISE
from ekfslam.errors import LineError, LostDataError, ShapeError, StampError, UnknownFormatError
from ekfslam.geometry import se3

PACKET_FIELDS = (
    *("lat", "lon", "alt", "roll", "pitch", "yaw", "vn", "ve", "vf", "vl", "vu"),
    *("ax", "ay", "az", "af", "al", "au", "wx", "wy", "wz", "wf", "wl", "wu"),
    *("pos_accuracy", "vel_accuracy", "navstat", "numsats", "posmode", "velmode", "orimode"),
)
_POSE = ("lat", "lon", "alt", "roll", "pitch", "yaw")
_TWIST = ("vf", "vl", "vu", "wf", "wl", "wu")

EXPECTED = (
    "expected a drive folder of KITTI raw with oxts/timestamps.txt and oxts/data/0000000000.txt ..., and "
    "calib_imu_to_velo.txt, calib_velo_to_cam.txt and calib_cam_to_cam.txt in it or in the folder above"
)
EARTH_RADIUS_M = 6378137.0  # the sphere of the development kit's Mercator projection
MAX_EMPTY_RUN = 5  # half a second at 10 Hz; over longer a vehicle's velocity is not linear in time
MAX_EMPTY_SHARE = 0.1
MAX_GAP_S = 1.0
_NOTED_GAP = 2.5  # in median steps

_PACKET_NAME = re.compile(r"\d{10}\.txt")
_STAMP = re.compile(r"((?:19|20)\d\d-\d\d-\d\d) (\d\d:\d\d:\d\d(?:\.\d{1,9})?)")


@dataclass(frozen=True)
class Oxts:
    """Recording of the GPS/INS unit of a drive."""

    time_s: Array  # (T,) stamps of the packets, seconds since 1970 on the recorder's clock
    twist: Array  # (T, 6) velocities [v; w] in the IMU frame
    truth: Truth  # poses of every frame that has a packet
    notes: tuple[str, ...]  # notes, attributes: repairs, and interpolated intervals
    attributes: dict[str, str]
    files: tuple[Path, ...]  # files that were read


def read_oxts(folder: Path, lateral: Lateral = "corrected") -> Oxts:
    """Read the packets of a drive folder, see this module."""
    stamps_file = folder / "oxts" / "timestamps.txt"
    format_files = _check_format(folder / "oxts" / "dataformat.txt")
    files = _packets_in(folder / "oxts" / "data")
    stamp_ns, stamped = _stamps_of(stamps_file, files)
    present = np.isin(np.arange(len(stamped)), list(files))
    time_s = _interpolated(stamp_ns[:, None] / 1e9, stamped)[:, 0]
    gaps = _check_steps(time_s, stamp_ns, stamped, stamps_file)
    packets = np.array([_read_packet(path) for path in files.values()])
    level, twist = np.zeros((2, len(stamped), 6))
    level[present], twist[present] = _columns(packets, _TWIST), _body_twist(packets, lateral)
    level, twist = _interpolated(level, present), _interpolated(twist, present)
    # Gaps that the unit filled are straight lines of the level velocities only.
    return Oxts(
        time_s=time_s,
        twist=twist,
        truth=Truth(np.flatnonzero(present), _poses(packets), noise=KITTI_TRUTH_NOISE),
        notes=(
            "The level velocities vf vl vu wf wl wu are turned into the IMU frame by each packet's roll and pitch.",
            LATERAL_NOTES[lateral],
            *_repair_notes(stamped, present),
            *interpolation_notes(level),
            *gaps,
        ),
        attributes=interpolation_attributes(level),
        files=(*format_files, stamps_file, *files.values()),
    )


def image_stamp_notes(path: Path, time_s: Array) -> tuple[str, ...]:
    """Return a note that compares the stamps (T,) of the packets with those in a file of the left images."""
    if not path.exists():
        return ()
    stamp_ns, stamped = _read_stamps(path)
    if len(stamped) != len(time_s):
        return (f"{path.parent.name} has {len(stamped)} stamps for {len(time_s)} packets; frames are packets.",)
    offset_s = np.abs(stamp_ns / 1e9 - time_s)[stamped].max(initial=0.0)
    return (f"Stamps are those of the packets; {path.parent.name} differs by at most {1e3 * offset_s:.1f} ms.",)


def _check_format(path: Path) -> tuple[Path, ...]:
    """Return the optional description of the packets; raise `LineError` if it orders them in another way."""
    if not path.exists():
        return ()
    names = [line.split(":")[0].strip() for line in read_lines(path, EXPECTED)]
    for number, name in enumerate(PACKET_FIELDS, start=1):
        if name in _POSE + _TWIST and names[number - 1 : number] != [name]:
            raise LineError(f"field {name} is not described here", **line_of(path, number))
    return (path,)


def _packets_in(data: Path) -> dict[int, Path]:
    """Return the files of packets by their number."""
    if not data.is_dir():
        raise UnknownFormatError(f"{data}: this folder is missing; {EXPECTED}")
    files = {int(path.stem): path for path in sorted(data.iterdir()) if _PACKET_NAME.fullmatch(path.name)}
    if not files:
        raise UnknownFormatError(f"{data}: holds no packets; {EXPECTED}")
    return files


def _stamps_of(path: Path, packets: dict[int, Path]) -> tuple[IntArray, BoolArray]:
    """Return `_read_stamps` of packets; raise a `DataError` if both do not fit, or too many stamps are lost."""
    stamp_ns, stamped = _read_stamps(path)
    frames = max(packets) + 1
    if not stamped[frames:].any():  # empty lines after the last packet are the end of the file
        stamp_ns, stamped = stamp_ns[:frames], stamped[:frames]
    if len(stamped) != frames:
        message = f"{len(stamped)} lines, but the packets run to {packets[frames - 1].name}, which needs {frames}"
        raise ShapeError(message, source=str(path))
    lost = np.setdiff1d(np.flatnonzero(stamped), list(packets))
    if len(lost):
        message = f"{len(lost)} packets are missing although {path.name} has their stamps"
        message += f"; the first is {lost[0]:010d}.txt, line {lost[0] + 1}"
        raise LostDataError(message, source=str(path.parent / "data"), index=int(lost[0]))
    _require_repairable(stamped, path)
    return stamp_ns, stamped


def _read_stamps(path: Path) -> tuple[IntArray, BoolArray]:
    """Return stamps (ns since 1970, 0 if the line is empty), and whether each line has one."""
    lines = [line.strip() for line in read_lines(path, EXPECTED)]
    stamp_ns = np.zeros(len(lines), dtype=np.int64)
    stamped = np.array([bool(line) for line in lines], dtype=bool)
    for k in np.flatnonzero(stamped):
        try:
            match = _STAMP.fullmatch(lines[k])
            # An empty text is no date either.
            stamp_ns[k] = np.datetime64("T".join(match.groups()) if match else "-", "ns").astype(np.int64)
        except ValueError:
            message = f"{lines[k]!r} is no stamp like 2011-09-30 12:00:00.123456789"
            raise LineError(message, **line_of(path, int(k) + 1)) from None
    return stamp_ns, stamped


def _require_repairable(stamped: BoolArray, path: Path) -> None:
    """Raise `LostDataError` unless single stamps within the recording are lost."""
    if stamped.all():
        return
    known = np.flatnonzero(stamped)
    if not (stamped[0] and stamped[-1]):
        message = "the line is empty, and a stamp at either end cannot be interpolated"
        raise LostDataError(message, **line_of(path, len(stamped) if stamped[0] else 1))
    longest = int(np.argmax(np.diff(known)))
    run, empty = int(known[longest + 1] - known[longest] - 1), int((~stamped).sum())
    if run > MAX_EMPTY_RUN or empty > max(1, MAX_EMPTY_SHARE * len(stamped)):
        most = f"at most {MAX_EMPTY_RUN} in a row and {MAX_EMPTY_SHARE:.0%} of all can be interpolated"
        message = f"{empty} of {len(stamped)} lines are empty, {run} in a row from here; {most}"
        raise LostDataError(message, **line_of(path, int(known[longest]) + 2))


def _interpolated(values: Array, known: BoolArray) -> Array:
    """Return the columns of (T, n) values, linear over the rows that are not known."""
    if known.all():
        return values
    return linear(np.flatnonzero(known), values[known], np.arange(len(values)))


def _check_steps(time_s: Array, stamp_ns: IntArray, stamped: BoolArray, path: Path) -> tuple[str, ...]:
    """Return a note on gaps between stamps, if there are any; raise `StampError` if one is too long or negative."""
    known = np.flatnonzero(stamped)
    step_s = np.diff(stamp_ns[known]) / 1e9
    for bad, what in ((step_s <= 0, "does not increase"), (step_s / np.diff(known) > MAX_GAP_S, "leaves a gap")):
        if bad.any():
            first = int(np.argmax(bad))
            message = f"the stamp {what}: {step_s[first]:.6f} s after the one before"
            raise StampError(message, **line_of(path, int(known[first + 1]) + 1))
    step_s = np.diff(time_s)
    gaps = int((step_s > _NOTED_GAP * np.median(step_s)).sum()) if len(step_s) else 0
    longest = f"{step_s.max():.3f} s before line {int(np.argmax(step_s)) + 2}" if gaps else ""
    note = f"{path.name}: {gaps} steps are longer than {_NOTED_GAP} times the median, the longest is {longest}."
    return (note,) if gaps else ()


def _repair_notes(stamped: BoolArray, present: BoolArray) -> Iterator[str]:
    empty, lost = np.flatnonzero(~stamped), np.flatnonzero(~present)
    if len(empty):
        share = f"{len(empty)} of {len(stamped)} lines are empty, the first is line {empty[0] + 1}"
        yield f"oxts/timestamps.txt: {share}; their stamps are interpolated."
    if len(lost):
        what = f"{len(lost)} packets are missing, the first is {lost[0]:010d}.txt; their velocities are interpolated"
        yield f"oxts/data: {what}, their frames have no truth."


def _read_packet(path: Path) -> Array:
    table = parse_table(read_lines(path, EXPECTED), path, columns=len(PACKET_FIELDS), comment=None)
    if len(table.values) == 0:
        raise LineError("the packet is missing", **line_of(path, 1))
    if len(table.values) > 1:
        raise LineError("a packet is one line", **table.where(1))
    lat, lon = table.values[0, :2]
    if abs(lat) >= 90 or abs(lon) > 180:
        raise LineError(f"no place has latitude {lat:g} and longitude {lon:g} deg", **table.where(0))
    return table.values[0]


def _columns(packets: Array, names: tuple[str, ...]) -> Array:
    return packets[:, [PACKET_FIELDS.index(name) for name in names]]


def _body_twist(packets: Array, lateral: Lateral) -> Array:
    """Return (n, 6) velocities in the IMU frame."""
    from scipy.spatial.transform import Rotation

    R_level_imu = Rotation.from_euler("YX", _columns(packets, ("pitch", "roll")))
    level = with_lateral(_columns(packets, _TWIST), lateral)
    return np.hstack([R_level_imu.apply(level[:, i : i + 3], inverse=True) for i in (0, 3)])


def _poses(packets: Array) -> Array:
    """Return (n, 4, 4) ``T_world_imu``."""
    from scipy.spatial.transform import Rotation

    lat, lon = np.radians(_columns(packets, ("lat", "lon")).T)
    scale_m = EARTH_RADIUS_M * np.cos(lat[0])
    east, north = scale_m * lon, scale_m * np.log(np.tan(np.pi / 4 + lat / 2))
    R = Rotation.from_euler("ZYX", _columns(packets, ("yaw", "pitch", "roll"))).as_matrix()
    T_enu_imu = se3.transform(R, np.column_stack([east, north, _columns(packets, ("alt",))]))
    return se3.inverse(T_enu_imu[0]) @ T_enu_imu
