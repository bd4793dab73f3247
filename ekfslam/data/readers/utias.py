"""The .mat recordings of UTIAS: KITTI drives with dense stereo tracks, and the indoor "Starry Night" data set."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ekfslam.arrays import Array
from ekfslam.data.checks import spelled_as_in
from ekfslam.data.inputs import VelocityFrame
from ekfslam.data.observations import flat_observations
from ekfslam.data.readers.fields import LATERAL_NOTES, recorded_tracks, require_numbers, with_lateral
from ekfslam.data.readers.matfile import parse_mat
from ekfslam.data.readers.registry import Lateral, Reader, Source
from ekfslam.data.sequence import LEVEL_VELOCITIES_NOTE, Noise, Sequence, Truth
from ekfslam.data.truth_noise import KITTI_TRUTH_NOISE
from ekfslam.errors import DataError, ShapeError, TruthError, UnknownFormatError
from ekfslam.geometry import se3
from ekfslam.geometry.camera import StereoCamera
from ekfslam.limits import Budget, require_file

COLUMN_FIELDS = ("t", "v_vk_vk_i", "w_vk_vk_i", "r_i_vk_i", "theta_vk_i")
CAMERA_FIELDS = ("fu", "fv", "cu", "cv", "b")
FIELDS = ("y_k_j", *COLUMN_FIELDS, *CAMERA_FIELDS, "C_c_v", "rho_v_c_v")

_SPELLING = {"time_s": "t", "T_cam_imu": "C_c_v", "K": "fu, fv", "baseline": "b", "truth.T_world_imu": "theta_vk_i"}


def read_utias(path: Path, lateral: Lateral = "corrected") -> Sequence:
    """Read tracks ``y_k_j`` (4 x T x M, -1 where unseen), stamps, velocities, calibration and 6-DoF truth.

    The vehicle frame ``v`` is the IMU frame, the inertial frame ``i`` the world; ``T_world_imu`` has the rotation
    ``exp(theta_vk_i^)`` and ``T_cam_imu = [C_c_v, -C_c_v rho_v_c_v]``. What runs longer than the tracks is cut, with a
    note. Starry Night adds landmarks ``rho_i_pj_i`` and noise variances, and has no level velocities, hence no
    ``lateral`` (see `with_lateral`). The truth of a KITTI drive has the noise `KITTI_TRUTH_NOISE`.
    """
    fields = _load(path)
    with spelled_as_in(str(path), _SPELLING):
        pixels = require_numbers(fields, "y_k_j", (4, None, None), finite=False)
        frames = pixels.shape[1]
        (t, v, w, r, theta), cut = _columns(fields, frames)
        twist = np.concatenate([v, w], axis=1)
        fu, fv, cu, cv, b = (float(require_numbers(fields, name, (1, 1))[0, 0]) for name in CAMERA_FIELDS)
        C, rho = require_numbers(fields, "C_c_v", (3, 3)), require_numbers(fields, "rho_v_c_v", (3, 1))[:, 0]
        observations, notes = flat_observations(pixels, frame_axis=1, field="y_k_j")
        if cut:
            notes = (f"Cut to the {frames} frames of y_k_j: {', '.join(cut)}.", *notes)
        attributes: dict[str, str] = {}
        noise = _noise(fields)  # stated by Starry Night alone, whose velocities are those of its IMU
        if noise is None:
            twist = with_lateral(twist, lateral)
            notes = (*notes, LEVEL_VELOCITIES_NOTE, LATERAL_NOTES[lateral])
            attributes["lateral"] = lateral
        rig = StereoCamera(fu, fv, cu, cv, b), se3.transform(C, -C @ rho)
        truth = _truth(fields, se3.transform(se3.so3_exp(theta), r), tracks=pixels.shape[2])
        frame: VelocityFrame = "level" if noise is None else "imu"
        given = (*rig, observations, notes, attributes, frame)
        return recorded_tracks(path, READER.name, t[:, 0], twist, *given, truth=truth, noise=noise)


def _load(path: Path) -> dict[str, NDArray]:
    expected = f"expected a .mat file with the fields {', '.join(FIELDS)}"
    require_file(path)
    try:
        fields = parse_mat(path.read_bytes(), Budget(str(path)))
    except (ValueError, struct.error, zlib.error) as error:
        raise UnknownFormatError(f"{path}: damaged .mat file ({error}); {expected}") from None
    if "y_k_j" not in fields:
        raise UnknownFormatError(f"{path}: a .mat file with the fields [{', '.join(fields)}]; {expected}")
    return fields


def _columns(fields: dict[str, NDArray], frames: int) -> tuple[list[Array], list[str]]:
    """Return the first ``frames`` columns of each of `COLUMN_FIELDS` as rows (T, n), and the names of longer ones."""
    columns = {name: require_numbers(fields, name, (1 if name == "t" else 3, None)) for name in COLUMN_FIELDS}
    for name, value in columns.items():
        if value.shape[1] < frames:
            error = TruthError if name in ("r_i_vk_i", "theta_vk_i") else ShapeError
            raise error(f"{value.shape[1]} columns do not cover the {frames} frames of y_k_j", field=name)
    cut = [f"{name} ({value.shape[1]})" for name, value in columns.items() if value.shape[1] > frames]
    return [value[:, :frames].T for value in columns.values()], cut


def _truth(fields: dict[str, NDArray], T_world_imu: Array, tracks: int) -> Truth:
    frame = np.arange(len(T_world_imu))
    if "rho_i_pj_i" not in fields:
        return Truth(frame, T_world_imu, noise=KITTI_TRUTH_NOISE)
    position_m = require_numbers(fields, "rho_i_pj_i", (3, tracks)).T
    return Truth(frame, T_world_imu, np.arange(tracks), position_m)


def _noise(fields: dict[str, NDArray]) -> Noise | None:
    if "v_var" not in fields:
        return None
    variances = []
    for name, size in (("v_var", 3), ("w_var", 3), ("y_var", 4)):
        variance = require_numbers(fields, name, (size, 1))[:, 0]
        if (variance < 0).any():
            raise DataError("a variance must not be negative", field=name, index=int(np.argmax(variance < 0)))
        variances.append(variance)
    v, w, y = variances
    return Noise(np.sqrt(np.concatenate([v, w])), np.sqrt(y))


def _tracks(source: Source) -> Sequence:
    if source.head.startswith(b"MATLAB 7.3"):
        raise UnknownFormatError(f"{source.place}: a MATLAB 7.3 file, save it with -v7; expected {READER.expected}")
    return read_utias(source.path, source.lateral)


READER = Reader(
    "utias", "a .mat recording (UTIAS)", lambda source: source.head.startswith((b"MATLAB 5.0", b"MATLAB 7.3")), _tracks
)
