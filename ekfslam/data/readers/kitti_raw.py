"""Drive folders of KITTI raw: velocities, calibration and 6-DoF truth. Stereo tracks they have none.

Geiger, Lenz, Stiller, Urtasun, *Vision meets Robotics: The KITTI Dataset* (IJRR 2013), and the readme of its
development kit. A drive is laid out as::

    2011_09_30/
      calib_imu_to_velo.txt  calib_velo_to_cam.txt  calib_cam_to_cam.txt     (may also be in the drive folder)
      2011_09_30_drive_0027_sync/
        oxts/timestamps.txt                      a line for each packet; where the recorder lost the stamp, an empty one
        oxts/data/0000000000.txt ...             packets of 30 numbers from the GPS/INS unit
        image_00/timestamps.txt                  of the left gray camera
"""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.data.interpolation import interpolation_attributes, interpolation_notes
from ekfslam.data.readers.fields import LATERAL_NOTES, checksum, spelled_as_in, with_lateral
from ekfslam.data.readers.registry import Lateral, Poses, Reader, TruthReader
from ekfslam.data.readers.text import line_of, parse_numbers, parse_table, read_lines
from ekfslam.data.sequence import WITHOUT_TRACKS, Observations, Sequence, Truth, require_rigid, validate_camera
from ekfslam.data.tracks import inspect_tracks
from ekfslam.data.truth_noise import KITTI_TRUTH_NOISE
from ekfslam.errors import (
    CalibrationError,
    ConfigError,
    ExtrinsicsError,
    LineError,
    LostDataError,
    ShapeError,
    StampError,
    UnknownFormatError,
)
from ekfslam.geometry import se3
from ekfslam.geometry.camera import StereoCamera

Pair = Literal["gray", "color"]
CAMERAS: dict[Pair, tuple[str, str]] = {"gray": ("00", "01"), "color": ("02", "03")}

PACKET_FIELDS = (
    *("lat", "lon", "alt", "roll", "pitch", "yaw", "vn", "ve", "vf", "vl", "vu"),
    *("ax", "ay", "az", "af", "al", "au", "wx", "wy", "wz", "wf", "wl", "wu"),
    *("pos_accuracy", "vel_accuracy", "navstat", "numsats", "posmode", "velmode", "orimode"),
)
_POSE = ("lat", "lon", "alt", "roll", "pitch", "yaw")
_TWIST = ("vf", "vl", "vu", "wf", "wl", "wu")

EARTH_RADIUS_M = 6378137.0  # the sphere of the development kit's Mercator projection
MAX_EMPTY_RUN = 5  # half a second at 10 Hz; over longer a vehicle's velocity is not linear in time
MAX_EMPTY_SHARE = 0.1
MAX_GAP_S = 1.0
_NOTED_GAP = 2.5  # in median steps
_RECTIFIED_M = 0.01  # the color pair of KITTI itself is off by 3 mm

_FOLDER_NAME = re.compile(r"\d{4}_\d\d_\d\d_drive_\d{4}_(sync|extract)")
_PACKET_NAME = re.compile(r"\d{10}\.txt")
_STAMP = re.compile(r"((?:19|20)\d\d-\d\d-\d\d) (\d\d:\d\d:\d\d(?:\.\d{1,9})?)")
_EXPECTED = (
    "expected a drive folder of KITTI raw with oxts/timestamps.txt and oxts/data/0000000000.txt ..., and "
    "calib_imu_to_velo.txt, calib_velo_to_cam.txt and calib_cam_to_cam.txt in it or in the folder above"
)


@dataclass(frozen=True)
class Oxts:
    """What the GPS/INS unit of a drive recorded.

    Args:
        time_s: (T,) stamps of the packets, seconds since 1970 on the recorder's clock.
        twist: (T, 6) velocities ``[v; w]`` in the IMU frame.
        truth: ``T_world_imu`` of every frame that has a packet; the world is the IMU frame of the first.
        notes: What was repaired, one sentence each.
        attributes: Which intervals are interpolated, where any are.
        files: The files that were read.
    """

    time_s: Array
    twist: Array
    truth: Truth
    notes: tuple[str, ...]
    attributes: dict[str, str]
    files: tuple[Path, ...]


@dataclass(frozen=True)
class KittiRaw:
    """A drive: all that a `Sequence` needs but tracks.

    Args:
        folder: The drive folder.
        oxts: Stamps, velocities and truth.
        camera: Intrinsics of the rectified stereo pair.
        T_cam_imu: (4, 4) IMU to rectified left camera of the pair.
        notes: What the reader found and did about it, one sentence each.
        attributes: Checksum, reader, stereo pair, and how the lateral velocity was taken.
    """

    folder: Path
    oxts: Oxts
    camera: StereoCamera
    T_cam_imu: Array
    notes: tuple[str, ...]
    attributes: dict[str, str]

    def sequence(self, observations: Observations | None = None) -> Sequence:
        """The drive as a `Sequence`, with tracks from elsewhere or none, which is enough for dead reckoning.

        Args:
            observations: Tracks in the rectified images of the stereo pair; their frame is the number of the packet.

        Raises:
            DataError: The observations do not fit the drive; the subclass says how.
        """
        none = Observations(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 4)))
        sequence = Sequence(
            name=self.folder.resolve().name,
            source=str(self.folder),
            time_s=self.oxts.time_s,
            twist=self.oxts.twist,
            camera=self.camera,
            T_cam_imu=self.T_cam_imu,
            observations=none if observations is None else observations,
            truth=self.oxts.truth,
            attributes={**self.attributes, **(WITHOUT_TRACKS if observations is None else {})},
        )
        # Only a valid sequence's tracks can be inspected.
        tracks = (
            ("KITTI raw has no tracks; they must come from elsewhere.",)
            if observations is None
            else inspect_tracks(sequence.observations, sequence.twist).notes
        )
        return dataclasses.replace(sequence, notes=(*self.notes, *tracks))


def is_kitti_raw(folder: Path) -> bool:
    """Whether a folder is laid out, or at least named, as a drive of KITTI raw."""
    return folder.is_dir() and ((folder / "oxts").is_dir() or bool(_FOLDER_NAME.fullmatch(folder.resolve().name)))


def open_kitti_raw(folder: str | Path, pair: Pair = "gray", lateral: Lateral = "corrected") -> KittiRaw:
    """Read a drive folder and its calibration.

    Args:
        folder: The drive folder, such as ``2011_09_30/2011_09_30_drive_0027_sync``.
        pair: Which stereo pair is the camera: ``gray`` (image_00, image_01) or ``color`` (image_02, image_03).
        lateral: Sign of the lateral velocity, see `with_lateral`.

    Raises:
        ConfigError: There is no such pair.
        UnknownFormatError: A file or folder is missing or is not text.
        DataError: A line or what the lines say is malformed; see `read_oxts` and `read_calibration`.
    """
    if pair not in CAMERAS:
        raise ConfigError(f"pair must be one of {', '.join(CAMERAS)}, found {pair!r}")
    folder = Path(folder)
    oxts = read_oxts(folder, lateral)
    camera, T_cam_imu, files = read_calibration(folder, pair)
    return KittiRaw(
        folder=folder,
        oxts=oxts,
        camera=camera,
        T_cam_imu=T_cam_imu,
        notes=(*oxts.notes, *_image_notes(folder / f"image_{CAMERAS[pair][0]}" / "timestamps.txt", oxts.time_s)),
        attributes={
            "checksum_sha256": checksum(*oxts.files, *files),
            "reader": READER.name,
            "stereo_pair": pair,
            "lateral": lateral,
            **oxts.attributes,
        },
    )


def read_oxts(folder: Path, lateral: Lateral = "corrected") -> Oxts:
    """Stamps, velocities and poses of a drive folder.

    Velocities: ``vf vl vu`` and ``wf wl wu`` are *level*, along forward, left and up of a vehicle without roll and
    pitch (``vu`` is the rate of ``alt``, and ``wx wy wz`` turned by roll and pitch are ``wf wl wu``). They are turned
    into the IMU frame, ``v_imu = (R_y(pitch) R_x(roll))^T v_level``, after ``vl``, which is stored positive to the
    right, has been negated (``lateral`` = ``as-stored`` leaves it, see `with_lateral`).

    Poses: east and north are the Mercator projection of the sphere, scaled by the cosine of the first latitude, up is
    ``alt``; the rotation is ``R_z(yaw) R_y(pitch) R_x(roll)``. World is the first pose. Their noise is
    `KITTI_TRUTH_NOISE`.

    An empty line of ``timestamps.txt`` is a stamp that the recorder lost: it is interpolated between its neighbours.
    Where its packet is missing too, so are the velocities, and the frame is without truth. A note says so.

    Raises:
        UnknownFormatError: A file or folder is missing or is not text.
        LineError: A line is malformed, or ``dataformat.txt`` puts the fields in another order.
        NonFiniteError: A packet holds NaN or infinity.
        ShapeError: The numbers of stamps and packets differ.
        LostDataError: A packet is missing, or stamps at either end, or more than `MAX_EMPTY_RUN` in a row, or more than
            `MAX_EMPTY_SHARE` of all.
        StampError: The stamps do not increase, or are more than `MAX_GAP_S` apart.
    """
    stamps_file, data = folder / "oxts" / "timestamps.txt", folder / "oxts" / "data"
    format_files = _check_format(folder / "oxts" / "dataformat.txt")
    if not data.is_dir():
        raise UnknownFormatError(f"{data}: this folder is missing; {_EXPECTED}")
    files = {int(path.stem): path for path in sorted(data.iterdir()) if _PACKET_NAME.fullmatch(path.name)}
    if not files:
        raise UnknownFormatError(f"{data}: holds no packets; {_EXPECTED}")
    stamp_ns, stamped = _read_stamps(stamps_file)
    frames = max(files) + 1
    if not stamped[frames:].any():  # empty lines behind the last packet are the end of the file
        stamp_ns, stamped = stamp_ns[:frames], stamped[:frames]
    if len(stamped) != frames:
        raise ShapeError(
            f"{len(stamped)} lines, but the packets run to {files[frames - 1].name}, which needs {frames}",
            source=str(stamps_file),
        )
    present = np.isin(np.arange(frames), list(files))
    lost = np.flatnonzero(stamped & ~present)
    if len(lost):
        raise LostDataError(
            f"{len(lost)} packets are missing although {stamps_file.name} has their stamps; "
            f"the first is {lost[0]:010d}.txt, line {lost[0] + 1}",
            source=str(data),
            index=int(lost[0]),
        )
    _require_repairable(stamped, stamps_file)
    time_s = _interpolated(stamp_ns[:, None] / 1e9, stamped)[:, 0]
    gaps = _check_steps(time_s, stamp_ns, stamped, stamps_file)
    packets = np.array([_read_packet(path) for path in files.values()])
    level, twist = np.zeros((2, frames, 6))
    # Turned by roll and pitch, a line is one no more.
    level[present] = _columns(packets, _TWIST)
    level = _interpolated(level, present)
    twist[present] = _body_twist(packets, lateral)
    return Oxts(
        time_s=time_s,
        twist=_interpolated(twist, present),
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


def read_calibration(folder: Path, pair: Pair = "gray") -> tuple[StereoCamera, Array, tuple[Path, ...]]:
    """Intrinsics of a rectified stereo pair, ``T_cam_imu`` (4, 4) of its left camera, and the files they are from.

    ``P_rect = K [I, t]`` of the left camera moves its origin by t from that of the rectified camera 00, so

        T_cam_imu = [I, t] R_rect_00 T_cam00_velo T_velo_imu,   baseline = t_x(left) - t_x(right).

    Raises:
        UnknownFormatError: A calibration file is missing or is not text.
        LineError: A value has another length, or is no number.
        NonFiniteError: A value is NaN or infinite.
        CalibrationError: A key is missing, or the pair is not rectified.
        ExtrinsicsError: A rotation is not one.
    """
    left, right = (f"P_rect_{number}" for number in CAMERAS[pair])
    files = tuple(
        _find_calibration(folder, f"calib_{name}.txt") for name in ("imu_to_velo", "velo_to_cam", "cam_to_cam")
    )
    T_velo_imu, T_cam00_velo = (_rigid(_read_calibration_file(path, {"R": 9, "T": 3}), path) for path in files[:2])
    cam_to_cam = files[2]
    values = _read_calibration_file(cam_to_cam, {"R_rect_00": 9, left: 12, right: 12})
    with spelled_as_in(str(cam_to_cam), {"K": left, "baseline": f"{left}, {right}"}):
        rectify = se3.transform(values["R_rect_00"].reshape(3, 3), np.zeros(3))
        require_rigid(rectify, "R_rect_00", ExtrinsicsError)
        K, t_left = _split_projection(values[left], left)
        K_right, t_right = _split_projection(values[right], right)
        if not np.allclose(K, K_right, rtol=1e-6) or np.abs(t_left - t_right)[1:].max() > _RECTIFIED_M:
            raise CalibrationError(f"not a rectified pair with {left}", field=right)
        camera = StereoCamera(*(float(x) for x in (K[0, 0], K[1, 1], K[0, 2], K[1, 2], t_left[0] - t_right[0])))
        validate_camera(camera)
    return camera, se3.transform(np.eye(3), t_left) @ rectify @ T_cam00_velo @ T_velo_imu, files


def _check_format(path: Path) -> tuple[Path, ...]:
    """The optional description of the packets, if it is there and agrees on the fields that are used."""
    if not path.exists():
        return ()
    names = [line.split(":")[0].strip() for line in read_lines(path, _EXPECTED)]
    for number, name in enumerate(PACKET_FIELDS, start=1):
        if name in _POSE + _TWIST and names[number - 1 : number] != [name]:
            raise LineError(f"field {name} is not described here", **line_of(path, number))
    return (path,)


def _read_stamps(path: Path) -> tuple[IntArray, BoolArray]:
    """Stamps (ns since 1970, 0 where the line is empty) and which lines have one."""
    lines = read_lines(path, _EXPECTED)
    stamp_ns = np.zeros(len(lines), dtype=np.int64)
    stamped = np.array([bool(line.strip()) for line in lines], dtype=bool)
    for k in np.flatnonzero(stamped):
        match = _STAMP.fullmatch(lines[k].strip())
        try:
            stamp_ns[k] = np.datetime64("T".join(match.groups()) if match else "", "ns").astype(np.int64)
            valid = match is not None
        except ValueError:
            valid = False
        if not valid:
            message = f"{lines[k]!r} is no stamp like 2011-09-30 12:00:00.123456789"
            raise LineError(message, **line_of(path, int(k) + 1))
    return stamp_ns, stamped


def _require_repairable(stamped: BoolArray, path: Path) -> None:
    """Raise `LostDataError` unless stamps are lost only here and there within the recording."""
    if stamped.all():
        return
    for k in (0, len(stamped) - 1):
        if not stamped[k]:
            message = "the line is empty, and a stamp at either end cannot be interpolated"
            raise LostDataError(message, **line_of(path, k + 1))
    known = np.flatnonzero(stamped)
    longest = int(np.argmax(np.diff(known)))
    run, empty = int(known[longest + 1] - known[longest] - 1), int((~stamped).sum())
    if run > MAX_EMPTY_RUN or empty > max(1, MAX_EMPTY_SHARE * len(stamped)):
        raise LostDataError(
            f"{empty} of {len(stamped)} lines are empty, {run} in a row from here; at most {MAX_EMPTY_RUN} in a row "
            f"and {MAX_EMPTY_SHARE:.0%} of all can be interpolated",
            **line_of(path, int(known[longest]) + 2),
        )


def _interpolated(values: Array, known: BoolArray) -> Array:
    """The columns of (T, n) values, linear over the rows that are not known."""
    if known.all():
        return values
    row = np.arange(len(values))
    return np.column_stack([np.interp(row, row[known], column[known]) for column in values.T])


def _check_steps(time_s: Array, stamp_ns: IntArray, stamped: BoolArray, path: Path) -> tuple[str, ...]:
    """A note on gaps between stamps, if there are any; raises `StampError` where they are too long or negative."""
    known = np.flatnonzero(stamped)
    step_s = np.diff(stamp_ns[known]) / 1e9
    for bad, what in ((step_s <= 0, "does not increase"), (step_s / np.diff(known) > MAX_GAP_S, "leaves a gap")):
        if bad.any():
            first = int(np.argmax(bad))
            raise StampError(
                f"the stamp {what}: {step_s[first]:.6f} s after the one before",
                **line_of(path, int(known[first + 1]) + 1),
            )
    step_s = np.diff(time_s)
    gaps = np.flatnonzero(step_s > _NOTED_GAP * np.median(step_s)) if len(step_s) else np.empty(0, np.int64)
    if not len(gaps):
        return ()
    return (
        f"{path.name}: {len(gaps)} steps are longer than {_NOTED_GAP} times the median, the longest is "
        f"{step_s.max():.3f} s before line {int(np.argmax(step_s)) + 2}.",
    )


def _repair_notes(stamped: BoolArray, present: BoolArray) -> tuple[str, ...]:
    notes = []
    empty, lost = np.flatnonzero(~stamped), np.flatnonzero(~present)
    if len(empty):
        notes.append(
            f"oxts/timestamps.txt: {len(empty)} of {len(stamped)} lines are empty, the first is line {empty[0] + 1}; "
            "their stamps are interpolated."
        )
    if len(lost):
        notes.append(
            f"oxts/data: {len(lost)} packets are missing, the first is {lost[0]:010d}.txt; their velocities are "
            "interpolated, their frames have no truth."
        )
    return tuple(notes)


def _image_notes(path: Path, time_s: Array) -> tuple[str, ...]:
    """How the stamps of the left images compare with those of the packets, where there are any."""
    if not path.exists():
        return ()
    stamp_ns, stamped = _read_stamps(path)
    if len(stamped) != len(time_s):
        return (f"{path.parent.name} has {len(stamped)} stamps for {len(time_s)} packets; frames are packets.",)
    offset_s = np.abs(stamp_ns / 1e9 - time_s)[stamped].max(initial=0.0)
    return (f"Stamps are those of the packets; {path.parent.name} differs by at most {1e3 * offset_s:.1f} ms.",)


def _read_packet(path: Path) -> Array:
    table = parse_table(read_lines(path, _EXPECTED), path, columns=len(PACKET_FIELDS), comment=None)
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
    """(n, 6) velocities in the IMU frame, see `read_oxts`."""
    roll, pitch = _columns(packets, ("roll", "pitch")).T
    R_level_imu = Rotation.from_euler("YX", np.column_stack([pitch, roll]))
    level = with_lateral(_columns(packets, _TWIST), lateral)
    return np.hstack([R_level_imu.apply(level[:, i : i + 3], inverse=True) for i in (0, 3)])


def _poses(packets: Array) -> Array:
    """(n, 4, 4) ``T_world_imu``, see `read_oxts`."""
    lat, lon, alt, roll, pitch, yaw = _columns(packets, _POSE).T
    lat, lon = np.radians(lat), np.radians(lon)
    scale_m = EARTH_RADIUS_M * np.cos(lat[0])
    east, north = scale_m * lon, scale_m * np.log(np.tan(np.pi / 4 + lat / 2))
    R = Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll])).as_matrix()
    T_enu_imu = se3.transform(R, np.column_stack([east, north, alt]))
    return se3.inverse(T_enu_imu[0]) @ T_enu_imu


def _find_calibration(folder: Path, name: str) -> Path:
    for place in (folder, folder.resolve().parent):
        if (place / name).is_file():
            return place / name
    raise UnknownFormatError(f"{folder}: {name} is neither here nor in the folder above; {_EXPECTED}")


def _read_calibration_file(path: Path, counts: dict[str, int]) -> dict[str, Array]:
    """The wanted ones of the lines ``KEY: numbers``; the others hold dates and unrectified cameras."""
    values: dict[str, Array] = {}
    for number, line in enumerate(read_lines(path, _EXPECTED), start=1):
        key, _, rest = line.partition(":")
        if key.strip() in counts:
            count = counts[key.strip()]
            values[key.strip()] = np.array(parse_numbers(rest.split(), count, line_of(path, number)))
    for key in counts:
        if key not in values:
            raise CalibrationError("this key is missing", source=str(path), field=key)
    return values


def _rigid(values: dict[str, Array], path: Path) -> Array:
    T = se3.transform(values["R"].reshape(3, 3), values["T"])
    with spelled_as_in(str(path)):
        require_rigid(T, "R", ExtrinsicsError)
    return T


def _split_projection(values: Array, name: str) -> tuple[Array, Array]:
    """K (3, 3) and t (3,) of a projection matrix ``K [I, t]``."""
    P = values.reshape(3, 4)
    K = P[:, :3]
    pinhole = np.array([[K[0, 0], 0, K[0, 2]], [0, K[1, 1], K[1, 2]], [0, 0, 1]])
    if (pinhole != K).any() or K[0, 0] * K[1, 1] == 0:
        raise CalibrationError("not of the form [fu 0 cu . ; 0 fv cv . ; 0 0 1 .]", field=name)
    return K, (np.linalg.inv(K) @ P[:, 3]).astype(float)


def _poses_of_drive(folder: Path, sequence: Sequence) -> Poses:
    oxts = read_oxts(folder)
    return Poses(oxts.truth.T_world_imu, oxts.time_s[oxts.truth.frame], oxts.files, KITTI_TRUTH_NOISE)


READER = Reader(
    "kitti_raw",
    "a drive folder of KITTI raw",
    lambda source: is_kitti_raw(source.path),
    lambda source: open_kitti_raw(source.path, lateral=source.lateral).sequence(),
)
TRUTH_READER = TruthReader("KITTI raw", READER.expected, is_kitti_raw, _poses_of_drive)
