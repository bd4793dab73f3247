"""Recordings as a pickled .npy, as the course distributes them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from ekfslam.data.observations import UNSEEN
from ekfslam.data.sequence import Sequence
from ekfslam.geometry import se3
from ekfslam.geometry.camera import R_CAM_BODY


def dense_of(sequence: Sequence) -> np.ndarray:
    """Features 4 x M x T."""
    o = sequence.observations
    features = np.full((4, int(o.ids.max()) + 1, len(sequence)), UNSEEN)
    features[:, o.landmark, o.frame] = o.pixels_px.T
    return features


def npy_fields(sequence: Sequence) -> dict[str, Any]:
    """A recording in the form of 2025: poses of the cameras with axes forward, left, up in the IMU frame."""
    camera = sequence.camera
    T_regular_imu = se3.transform(R_CAM_BODY.T, np.zeros(3)) @ sequence.T_cam_imu
    left = se3.inverse(T_regular_imu)
    right = left @ se3.transform(np.eye(3), np.array([0.0, -camera.baseline_m, 0.0]))
    matrix = np.array([[camera.fu_px, 0, camera.cu_px], [0, camera.fv_px, camera.cv_px], [0, 0, 1]])
    return {
        "v_t": sequence.twist[:, :3].copy(),
        "w_t": sequence.twist[:, 3:].copy(),
        "timestamps": sequence.time_s.copy(),
        "features": dense_of(sequence),
        "K_l": matrix,
        "K_r": matrix.copy(),
        "extL_T_imu": left,
        "extR_T_imu": right,
    }


def write_npy(path: Path, fields: Any) -> Path:
    np.save(path, fields, allow_pickle=True)
    return path


class Runs:
    """What a pickle may hold that runs a command when it is loaded."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return os.system, (f"touch {self.path}",)
