"""Small valid recordings in every file format, for tests to read or to break."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

from ekfslam.geometry import se3

FRAMES, TRACKS = 7, 4
R_CAM_IMU = se3.so3_exp(np.array([0.02, -0.01, 0.03])) @ np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
CAMERA_IN_IMU_M = np.array([1.1, -0.3, 0.7])
K = np.array([[700.0, 0, 600], [0, 710.0, 180], [0, 0, 1]])


def pixels() -> np.ndarray:
    """Dense tracks (4, FRAMES, TRACKS) with fractional pixels; track 1 has a gap, track 3 starts late."""
    rng = np.random.default_rng(5)
    u, v = rng.uniform(100, 1000, (FRAMES, TRACKS)), rng.uniform(50, 300, (FRAMES, TRACKS))
    dense = np.stack([u, v, u - rng.uniform(5, 50, u.shape), v + rng.uniform(-0.5, 0.5, v.shape)])
    dense[:, 3, 1] = dense[:, :2, 3] = -1
    return dense


def velocities() -> tuple[np.ndarray, np.ndarray]:
    """Linear and angular velocity, (3, FRAMES) each."""
    rng = np.random.default_rng(6)
    return rng.normal([[8.0], [0.1], [0.0]], 0.3, (3, FRAMES)), rng.normal(0, 0.2, (3, FRAMES))


def stamps() -> np.ndarray:
    return 1317384506.4 + np.cumsum([0.1, 0.11, 0.1, 0.09, 0.1, 0.12, 0.1])


def ece276a_fields() -> dict[str, Any]:
    v, w = velocities()
    return {
        "features": pixels().transpose(0, 2, 1).copy(),
        "time_stamps": stamps()[None],
        "linear_velocity": v,
        "rotational_velocity": w,
        "K": K.copy(),
        "b": np.array(0.54),
        "cam_T_imu": se3.transform(R_CAM_IMU, CAMERA_IN_IMU_M),
    }


def utias_fields(starry_night: bool = False, extra: int = 0) -> dict[str, Any]:
    """A .mat recording; stamps, velocities and truth run ``extra`` columns longer than the tracks."""
    v, w = velocities()
    rng = np.random.default_rng(7)
    position, rotation = rng.normal(0, 3, (3, FRAMES)), rng.normal(0, 0.7, (3, FRAMES))
    more = np.full((3, extra), 9.0)
    fields: dict[str, Any] = {
        "y_k_j": pixels(),
        "t": np.append(stamps(), stamps()[-1] + 0.1 * np.arange(1, extra + 1))[None],
        "v_vk_vk_i": np.hstack([v, more]),
        "w_vk_vk_i": np.hstack([w, more]),
        "r_i_vk_i": np.hstack([position, more]),
        "theta_vk_i": np.hstack([rotation, more]),
        "C_c_v": R_CAM_IMU.copy(),
        "rho_v_c_v": CAMERA_IN_IMU_M[:, None].copy(),
        **{
            name: np.array([[value]])
            for name, value in zip(["fu", "fv", "cu", "cv", "b"], (700.0, 710, 600, 180, 0.54), strict=True)
        },
    }
    if starry_night:
        fields |= {
            "rho_i_pj_i": rng.normal(0, 5, (3, TRACKS)),
            "v_var": np.array([[0.01], [0.04], [0.09]]),
            "w_var": np.array([[0.16], [0.25], [0.36]]),
            "y_var": np.array([[36.0], [121], [49], [144]]),
        }
    return fields


def write_npz(path: Path, fields: dict[str, Any]) -> Path:
    with path.open("wb") as file:  # a file object, so that numpy does not append .npz
        np.savez(file, **fields)
    return path


def write_mat(path: Path, fields: dict[str, Any]) -> Path:
    scipy.io.savemat(path, fields, appendmat=False)
    return path


HEADER = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
    "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], "
    "b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]"
)
