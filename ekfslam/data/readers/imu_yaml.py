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

# Names of files beside samples that may state densities.
_NAMES = ("sensor.yaml", "imu.yaml", "imu-*.yaml", "imu0.yaml", "imu_config.yaml", "kalibr_imu_chain.yaml")
# Patterns of the usual names of chains, the likelier first.
_CHAINS = (
    *("camchain-imucam*.yaml", "kalibr_imucam_chain.yaml", "camchain.yaml"),
    *("*camchain*.yaml", "*imucam*chain*.yaml", "*camchain*.yml"),
)
_KEYS = {
    "gyro": "gyroscope_noise_density",
    "accel": "accelerometer_noise_density",
    "gyro_walk": "gyroscope_random_walk",
    "accel_walk": "accelerometer_random_walk",
}


@dataclass(frozen=True)
class InertialCalibration:
    """What a file says of an inertial unit."""

    path: Path  # file that was read
    noise: InertialNoise | None  # densities; None if some are missing
    T_body_imu: Array | None  # (4, 4) T_BS; None if it is not stated
    rate_hz: float  # rate_hz or update_rate; 0 if it is not stated
    notes: tuple[str, ...]  # missing densities, and a time offset that is not applied


def read_imu_yaml(path: Path) -> InertialCalibration:
    """Read densities at the top or below a key such as ``imu0``, and ``T_BS``."""
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
        further = (f"{prefix}{name}" for name in ("time_offset", "rate_hz", "update_rate"))
        offset, *rates = (_number(read, name) if name in read else 0.0 for name in further)
        if offset:
            notes += (f"{path.name} states time_offset {offset:g} s against another unit, which is not applied.",)
    key = read.place(f"{prefix}T_BS")
    return InertialCalibration(path, noise, pose_of(read, key) if read.values.get(key) else None, max(rates), notes)


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
    pose = read.matrix(key, 4, 4)
    with spelled_as_in(str(read.path)):
        require_rigid(pose, read.place(key), ExtrinsicsError)
    return se3.nearest_rigid(pose)


def _first_of(names: tuple[str, ...], folders: tuple[Path, ...]) -> Path | None:
    return next((file for folder in folders for name in names for file in sorted(folder.glob(name))), None)


def beside(*folders: Path) -> Path | None:
    """Return the first file with densities of an inertial unit in some folders, under any of the usual names."""
    return _first_of(_NAMES, folders)


def find_chain(*folders: Path) -> Path | None:
    """Return the first chain of Kalibr in some folders, under any of the usual names."""
    return _first_of(_CHAINS, folders)


def read_chain(path: Path) -> tuple[float, Array | None, tuple[str, ...]]:
    """Return `late_s` and ``T_cam_imu`` of ``cam0`` in a chain, None if it is not stated, and notes."""
    read = read_yaml(path)
    T_cam_imu, notes = chain_of(read, "cam0")
    notes = () if T_cam_imu is None else (f"T_cam_imu is that of cam0 in {path.name}.", *notes)
    return late_s(read, "cam0"), T_cam_imu, notes


def chain_of(read: Calibration, camera: str) -> tuple[Array | None, tuple[str, ...]]:
    """Return ``T_cam_imu`` (4, 4) of a camera in a chain of Kalibr or OpenVINS, None if it is not stated, and notes."""
    if (key := f"{camera}.T_cam_imu") in read:
        return pose_of(read, key), ()
    if (key := f"{camera}.T_imu_cam") in read:
        return se3.inverse(pose_of(read, key)), (f"{read.path.name} states {key}: it is inverted.",)
    return None, ()


def late_s(read: Calibration, camera: str) -> float:
    """Return the stamp of a sample less that of an image of the same instant, ``timeshift_cam_imu``; 0: not stated."""
    key = f"{camera}.timeshift_cam_imu"
    if key not in read:
        return 0.0
    value = _number(read, key)
    if not (np.isfinite(value) and abs(value) < 10.0):
        raise CalibrationError(f"expected seconds, found {value:g}", source=str(read.path), field=key)
    return value
