"""Inertial samples of a bag: one stream of ``sensor_msgs/Imu``, or one of a gyroscope and one of an accelerometer."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from itertools import islice, takewhile
from pathlib import Path
from typing import Any

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.inertial import InertialRows, in_order
from ekfslam.data.inputs import VelocitySamples, linear
from ekfslam.data.readers.imu_yaml import beside, calibrated, read_imu_yaml
from ekfslam.data.readers.messages import IMU, Bag, frame_of
from ekfslam.data.sequence import TWIST_STD
from ekfslam.errors import LostDataError
from ekfslam.names import printable

_LOOKED_AT = 50  # messages that tell what a stream measures


@dataclass(frozen=True)
class _Stream:
    """A stream of `IMU`, and which of gyroscope and accelerometer it holds."""

    connection: Any
    has_gyro: bool
    has_accel: bool

    @property
    def topic(self) -> str:
        return str(self.connection.topic)


def inertial_of(bag: Bag, near: str = "") -> tuple[InertialRows | None, str, tuple[str, ...]]:
    """Return the inertial samples of a bag, the name of their frame, and notes; None and no name if it has none.

    Forces of a stream of their own are interpolated linearly to the stamps of the gyroscope. A stream that shares more
    of its name with ``near``, a topic of images, is preferred, then one with more messages.
    """
    streams = [_looked_at(bag, connection) for connection in bag.connections(IMU)]
    topics = [stream.topic for stream in streams]

    def rank(stream: _Stream) -> tuple[bool, int, int, str]:
        return not stream.has_accel, -_shared(stream.topic, near), -int(stream.connection.msgcount), stream.topic

    gyros = sorted((stream for stream in streams if stream.has_gyro), key=rank)
    gyro = next(iter(gyros), None)
    accels = [stream for stream in streams if stream.has_accel and not stream.has_gyro]
    if gyro is None or not (gyro.has_accel or accels):
        lacks = "angular rates" if gyro is None else "specific forces"
        return None, "", tuple(f"Not used: {printable(each)}, since no topic has {lacks}." for each in topics)
    accel = gyro
    if not gyro.has_accel:
        accel = max(accels, key=lambda stream: (_shared(stream.topic, str(gyro.topic)), stream.topic))
    used = list(dict.fromkeys((gyro.topic, accel.topic)))
    notes = [f"Inertial samples are those of {printable(' and '.join(used))}."]
    notes += [f"Not used: inertial samples of {printable(name)}." for name in topics if name not in used]
    rows, frame = _samples(bag, gyro, accel)
    return rows, frame, tuple(notes)


def _shared(one: str, other: str) -> int:
    """Return the number of first parts that two topics share."""
    pairs = zip(one.strip("/").split("/"), other.strip("/").split("/"), strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))


def _looked_at(bag: Bag, connection: Any) -> _Stream:
    """Return a stream; what it does not measure is 0, or has -1 for its first covariance."""
    found = list(islice(bag.messages(connection), _LOOKED_AT))

    def measures(name: str) -> bool:
        values = [getattr(message, name) for message in found]
        unknown = any(float(getattr(message, f"{name}_covariance")[0]) == -1.0 for message in found)
        return not unknown and any(value.x or value.y or value.z for value in values)

    return _Stream(connection, measures("angular_velocity"), measures("linear_acceleration"))


def _samples(bag: Bag, gyro: _Stream, accel: _Stream) -> tuple[InertialRows, str]:
    """Return the samples of one stream or two with the densities beside the bag, and the name of their frame."""
    rows, frame = _rows(bag, gyro)
    if accel is not gyro:
        rows = _paired(rows, _rows(bag, accel)[0])
    calibration = beside(*([bag.path] if bag.path.is_dir() else []), bag.path.parent)
    if calibration is not None:
        rows = calibrated(rows, read_imu_yaml(calibration))
    return rows, frame


def _rows(bag: Bag, stream: _Stream) -> tuple[InertialRows, str]:
    stamps, times, table, frame = list[int](), list[int](), list[list[float]](), ""
    for written_ns, content in bag.raw(stream.connection):
        message = bag.message(stream.connection, content)
        w, f = message.angular_velocity, message.linear_acceleration
        frame = frame or frame_of(message.header.frame_id)
        stamps.append(bag.stamp_ns(content))
        times.append(written_ns)
        table.append([w.x, w.y, w.z, f.x, f.y, f.z])
    values, topic = np.array(table, dtype=float).reshape(-1, 6), printable(stream.topic)
    known = np.isfinite(values).all(axis=1)
    lost = f"{int((~known).sum())} samples of {topic} are NaN or infinite: they are dropped."
    notes = () if known.all() else (lost,)
    if not any(stamps):
        stamps, notes = times, (*notes, f"Messages of {topic} have no stamps: the times of writing are taken.")
    time_ns, values = np.array(stamps, dtype=np.int64)[known], values[known]
    rows = InertialRows(f"{bag.path}: {topic}", time_ns, values[:, :3], values[:, 3:], sorts=True, notes=notes)
    return rows, frame


def _paired(gyro: InertialRows, accel: InertialRows) -> InertialRows:
    """Return the samples of a gyroscope with forces of another stream at its stamps, as far as these reach."""
    (gyro, of_gyro), (accel, of_accel) = in_order(gyro), in_order(accel)
    notes = (*gyro.notes, *of_gyro, *accel.notes, *of_accel)
    fewest = min(len(gyro.time_ns), len(accel.time_ns))
    if fewest < 2:
        raise LostDataError(f"{fewest} samples; two are needed", source=accel.source)
    inside = (gyro.time_ns >= accel.time_ns[0]) & (gyro.time_ns <= accel.time_ns[-1])
    time_ns, first = gyro.time_ns[inside], accel.time_ns[0]
    since = [(stamps - first) / 1e9 for stamps in (accel.time_ns, time_ns)]
    steps = np.diff(since[0])
    rates = 1.0 / np.median(steps), 1e9 / np.median(np.diff(gyro.time_ns))
    notes += (f"Forces at {rates[0]:.4g} Hz are interpolated to the stamps of the gyroscope, {rates[1]:.4g} Hz.",)
    if count := int((steps > 3.0 * np.median(steps)).sum()):
        notes += (f"The forces have {count} gaps of more than three steps; the longest is {steps.max():.3g} s.",)
    forces = linear(since[0], accel.accel_m_s2, since[1])
    return replace(gyro, time_ns=time_ns, gyro_rad_s=gyro.gyro_rad_s[inside], accel_m_s2=forces, notes=notes)


def imu_of_bag(path: Path) -> InertialRows | None:
    """Return the inertial samples of a bag; None if it has none."""
    with contextlib.closing(Bag(path)) as bag:
        rows, _, notes = inertial_of(bag)
        return None if rows is None else replace(rows, notes=(*notes, *rows.notes))


def velocities_of_unit(
    velocities: VelocitySamples, T_imu_base: Array | None, frame: str
) -> tuple[VelocitySamples | None, str]:
    """Return velocities of a body such as wheels as the unit's, ``R v + t x R w`` with ``T_imu_base``, and a note."""
    if T_imu_base is None:
        return None, f"Velocities are not used: /tf_static does not connect their frame and {printable(frame)}."
    R, t = T_imu_base[:3, :3], T_imu_base[:3, 3]
    v, w = velocities.twist[:, :3] @ R.T, velocities.twist[:, 3:] @ R.T
    turned = np.hstack([v + np.cross(t, w), w])
    # What was not measured stays exactly 0.
    turned[:, np.abs(turned).max(axis=0, initial=0.0) < 1e-9] = 0.0
    attributes = dict(velocities.attributes)
    if (stated := attributes.get(TWIST_STD)) is not None:
        square = np.array(str(stated).split(), dtype=float).reshape(2, 3) ** 2
        shares = np.where(R**2 > 1e-6, R**2, np.nan)
        std = np.sqrt(np.nansum(shares * square[:, None, :], axis=2)).ravel()
        attributes[TWIST_STD] = " ".join(map(repr, std.tolist()))
    note = f"Velocities are turned into the frame of the inertial unit, {printable(frame)}."
    return replace(velocities, twist=turned, attributes=attributes), note
