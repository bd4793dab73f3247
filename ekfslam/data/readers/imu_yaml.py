"""Noise densities of an inertial unit: ``sensor.yaml`` of EuRoC, ``imu.yaml`` of Kalibr, and chains of OpenVINS."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.checks import require_rigid, spelled_as_in
from ekfslam.data.inertial import InertialRows
from ekfslam.data.inputs import InertialNoise
from ekfslam.data.readers.yaml import Calibration, read_yaml
from ekfslam.errors import CalibrationError, ExtrinsicsError
from ekfslam.geometry import se3

# Names of files beside samples that may state densities, and places of these.
NAMES = ("sensor.yaml", "imu.yaml", "imu0.yaml", "imu_config.yaml", "kalibr_imu_chain.yaml")
CHAINS = ("camchain-imucam.yaml", "kalibr_imucam_chain.yaml", "camchain.yaml")
_KEYS = {
    "gyro": "gyroscope_noise_density",
    "accel": "accelerometer_noise_density",
    "gyro_walk": "gyroscope_random_walk",
    "accel_walk": "accelerometer_random_walk",
}

_FURTHER = ("time_offset", "rate_hz", "update_rate")


@dataclass(frozen=True)
class InertialCalibration:
    """What a file says of an inertial unit."""

    path: Path  # file that was read
    noise: InertialNoise | None  # densities; None if some are missing
    T_body_imu: Array | None  # (4, 4) T_BS; None if it is not stated
    rate_hz: float  # rate_hz or update_rate; 0 if it is not stated
    notes: tuple[str, ...]  # missing densities, and a time offset that is not applied


def read_imu_yaml(path: Path) -> InertialCalibration:
    """Read densities at the top or below a key such as ``imu0``, and ``T_BS``.

    Raises:
        CalibrationError: A density is not one number; or `DataError` if it is negative or not finite.
    """
    read = read_yaml(path)
    block = next((key.rpartition(".")[0] for key in read.values if key.rpartition(".")[2] in _KEYS.values()), "")
    prefix = f"{block}." if block else ""
    found = {name: prefix + key for name, key in _KEYS.items() if prefix + key in read}
    missing = [key for name, key in _KEYS.items() if name not in found]
    noise: InertialNoise | None = None
    notes: tuple[str, ...] = ()
    with spelled_as_in(str(path), {f"inertial noise {name}": key for name, key in found.items()}):
        values = {name: _number(read, key) for name, key in found.items()}
        if not missing:
            noise = InertialNoise(**values)
        else:
            notes = (f"{path.name} does not state {', '.join(missing)}: its densities are not used.",)
        further = [prefix + name for name in _FURTHER]
        offset, *rates = (_number(read, name) if name in read else 0.0 for name in further)
        if offset:
            notes += (f"{path.name} states time_offset {offset:g} s against another unit, which is not applied.",)
    key = next((key for key in (f"{prefix}T_BS.data", f"{prefix}T_BS") if read.values.get(key)), None)
    return InertialCalibration(path, noise, None if key is None else pose_of(read, key), max(rates), notes)


def calibrated(rows: InertialRows, read: InertialCalibration) -> InertialRows:
    """Return samples with the densities of a file."""
    return replace(rows, noise=read.noise, stated_hz=read.rate_hz, notes=(*rows.notes, *read.notes))


def _number(read: Calibration, key: str) -> float:
    try:
        return float(read.word(key))
    except ValueError:
        raise CalibrationError(f"expected a number, found {read.word(key)!r}", field=key) from None


def pose_of(read: Calibration, key: str) -> Array:
    """Return a transform (4, 4) of a file."""
    pose = read.numbers(key, 16).reshape(4, 4)
    with spelled_as_in(str(read.path)):
        require_rigid(pose, key, ExtrinsicsError)
    return se3.nearest_rigid(pose)


def beside(place: Path, names: tuple[str, ...] = NAMES) -> Path | None:
    """Return the first file with one of some names in a folder; names of Kalibr may go on, as ``imu-NAME.yaml``."""
    for name in names:
        stem, _, ending = name.rpartition(".")
        if (place / name).is_file():
            return place / name
        if stem in ("imu", "camchain-imucam") and (found := sorted(place.glob(f"{stem}-*.{ending}"))):
            return found[0]
    return None


def chain_of(read: Calibration, camera: str) -> tuple[Array, tuple[str, ...]] | None:
    """Return ``T_cam_imu`` (4, 4) of a camera in a chain of Kalibr or OpenVINS, and notes; None: it is not stated."""
    if (key := f"{camera}.T_cam_imu") in read:
        return pose_of(read, key), ()
    if (key := f"{camera}.T_imu_cam") in read:
        return se3.inverse(pose_of(read, key)), (f"{read.path.name} states {key}: it is inverted.",)
    return None


def late_s(read: Calibration, camera: str) -> float:
    """Return the stamp of a sample less that of an image of the same instant, ``timeshift_cam_imu``; 0: not stated."""
    key = f"{camera}.timeshift_cam_imu"
    if key not in read:
        return 0.0
    value = _number(read, key)
    if not (np.isfinite(value) and abs(value) < 10.0):
        raise CalibrationError(f"expected seconds, found {value:g}", source=str(read.path), field=key)
    return value
