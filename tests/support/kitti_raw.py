"""A small drive in the raw format of KITTI."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ekfslam.data.readers.oxts import PACKET_FIELDS
from ekfslam.geometry import se3

FRAMES = 70  # so that six lost stamps in a row are too many, but not too large a share
NAME = "2011_09_30_drive_0099_sync"
EARTH_M = 6378137.0
FIRST_DEG = (49.0, 8.4)
R_VELO_IMU = se3.so3_exp(np.array([0.01, -0.02, 0.005]))
T_VELO_IMU_M = np.array([-0.8, 0.3, -0.8])
R_CAM_VELO = se3.so3_exp(np.array([0.01, 0.02, -0.01])) @ np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
T_CAM_VELO_M = np.array([0.01, -0.07, -0.3])
R_RECT = se3.so3_exp(np.array([0.004, -0.007, 0.01]))
K = np.array([[718.0, 0, 607], [0, 719.0, 185], [0, 0, 1]])
# Where the origin of camera 00 is, seen from the rectified cameras 00 to 03, metres.
OFFSETS_M = {
    "00": np.zeros(3),
    "01": np.array([-0.54, 0, 0]),
    "02": np.array([0.06, -0.001, 0.003]),
    "03": np.array([-0.47, 0.001, 0.003]),
}


def trajectory() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stamps (ns), body twists with u[k] over (t[k-1], t[k]], and poses in the local east-north-up frame."""
    rng = np.random.default_rng(11)
    step_ns = 100_000_000 + rng.integers(-3_000_000, 3_000_000, FRAMES)
    stamp_ns = np.datetime64("2011-09-30T12:00:00.123456789", "ns").astype(np.int64) + np.cumsum(step_ns)
    t = 0.1 * np.arange(FRAMES)[:, None]
    twist = np.array([9.0, 0.2, -0.1, 0, 0, 0]) + np.array([2, 0.3, 0.3, 0.1, 0.12, 0.4]) * np.sin(
        t * [1.0, 2, 3, 2.5, 1.5, 0.7]
    )
    R = Rotation.from_euler("ZYX", [2.1, -0.06, 0.09]).as_matrix()
    poses = [se3.transform(R, np.array([0.0, 0, 116.0]))]
    for k in range(1, FRAMES):
        poses.append(poses[-1] @ se3.exp((stamp_ns[k] - stamp_ns[k - 1]) / 1e9 * twist[k]))
    return stamp_ns, twist, np.array(poses)


def packets() -> np.ndarray:
    """What the unit would have written: geographic positions, Euler angles and level velocities."""
    _, twist, T = trajectory()
    lat, lon = np.radians(FIRST_DEG)
    scale_m = EARTH_M * np.cos(lat)
    # Mercator, inverted.
    y = np.arctanh(np.sin(lat)) + T[:, 1, 3] / scale_m
    yaw, pitch, roll = Rotation.from_matrix(T[:, :3, :3]).as_euler("ZYX").T
    R_east_level = Rotation.from_euler("Z", yaw[:, None]).as_matrix()
    R_level_imu = np.swapaxes(R_east_level, 1, 2) @ T[:, :3, :3]
    level = [(R_level_imu @ twist[:, i : i + 3, None])[..., 0].T for i in (0, 3)]
    fields = {name: np.full(FRAMES, 77.0) for name in PACKET_FIELDS}  # the unused ones would be noticed
    fields |= {
        "lat": np.degrees(np.arcsin(np.tanh(y))),
        "lon": np.degrees(lon + T[:, 0, 3] / scale_m),
        "alt": T[:, 2, 3],
    }
    fields |= {"roll": roll, "pitch": pitch, "yaw": yaw}
    forward, left, up = level[0]
    # The unit writes its lateral velocity positive to the right.
    fields |= dict(zip(("vf", "vl", "vu", "wf", "wl", "wu"), (forward, -left, up, *level[1]), strict=True))
    return np.column_stack(list(fields.values()))


def numbers(values: np.ndarray) -> str:
    return " ".join(f"{x:.9e}" for x in np.ravel(values))


def stamp_lines() -> list[str]:
    return [str(np.datetime64(int(ns), "ns")).replace("T", " ") for ns in trajectory()[0]]


def write_drive(place: Path) -> Path:
    folder = place / "2011_09_30" / NAME
    (folder / "oxts" / "data").mkdir(parents=True)
    (folder / "oxts" / "timestamps.txt").write_text("\n".join(stamp_lines()) + "\n")
    for k, packet in enumerate(packets()):
        (folder / f"oxts/data/{k:010d}.txt").write_text(" ".join(repr(float(x)) for x in packet) + "\n")
    calibration = folder.parent
    (calibration / "calib_imu_to_velo.txt").write_text(
        f"calib_time: 25-May-2012 16:47:16\nR: {numbers(R_VELO_IMU)}\nT: {numbers(T_VELO_IMU_M)}\n"
    )
    (calibration / "calib_velo_to_cam.txt").write_text(
        f"calib_time: 15-Mar-2012 11:45:23\nR: {numbers(R_CAM_VELO)}\nT: {numbers(T_CAM_VELO_M)}\ndelta_f: 0 0\n"
    )
    (calibration / "calib_cam_to_cam.txt").write_text(
        f"calib_time: 09-Jan-2012 14:00:15\ncorner_dist: 9.95e-02\nR_rect_00: {numbers(R_RECT)}\nR_rect_02: broken\n"
        + "".join(f"P_rect_{n}: {numbers(np.column_stack([K, K @ t]))}\n" for n, t in OFFSETS_M.items())
    )
    return folder
