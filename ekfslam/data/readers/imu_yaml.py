"""Noise densities of an inertial unit: ``sensor.yaml`` of EuRoC, ``imu.yaml`` of Kalibr, and chains of OpenVINS."""

from __future__ import annotations

import re
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


def read_chain(path: Path, topic: str = "") -> tuple[float, Array | None, tuple[str, ...]]:
    """Return `late_s` and ``T_cam_imu`` of a topic's camera in a chain, or of ``cam0``, None if unknown; and notes."""
    read = read_yaml(path)
    camera = next((name for name, of in topics_of(read).items() if topic and of == topic), "cam0")
    T_cam_imu, notes = chain_of(read, camera)
    notes = () if T_cam_imu is None else (f"T_cam_imu is that of {camera} in {path.name}.", *notes)
    return late_s(read, camera), T_cam_imu, notes


def topics_of(read: Calibration) -> dict[str, str]:
    """Return the cameras of a chain in their order, with their topics; an empty one is not stated."""
    known = dict.fromkeys(key.split(".")[0] for key in read.values if re.match(r"cam\d+\.", key))
    topics = {name: read.values.get(f"{name}.rostopic", "").strip().strip("\"'") for name in known}
    return topics or {"cam0": ""}


def between_cameras(read: Calibration, first: str, last: str) -> Array | None:
    """Return ``T_last_first`` (4, 4) by the ``T_cn_cnm1`` of a chain; None if one of them is not stated."""
    begin, end = sorted(int(name[3:]) for name in (first, last))
    T = np.eye(4)
    for key in (f"cam{number}.T_cn_cnm1" for number in range(begin + 1, end + 1)):
        if read.place(key) not in read:
            return None
        T = pose_of(read, key) @ T
    return T if first == f"cam{begin}" else se3.inverse(T)


def chain_of(read: Calibration, camera: str) -> tuple[Array | None, tuple[str, ...]]:
    """Return ``T_cam_imu`` (4, 4) of a camera in a chain of Kalibr or OpenVINS, None if it is unknown, and notes.

    If it is not stated, it is that of another camera and the transforms between both.
    """
    for other in dict.fromkeys((camera, *topics_of(read))):
        T_camera_other = between_cameras(read, other, camera)
        for key in (f"{other}.T_cam_imu", f"{other}.T_imu_cam"):
            if T_camera_other is not None and read.place(key) in read:
                is_inverse, T = key.endswith("T_imu_cam"), pose_of(read, key)
                notes = (f"{read.path.name} states {key}: it is inverted.",) if is_inverse else ()
                return T_camera_other @ (se3.inverse(T) if is_inverse else T), notes
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
