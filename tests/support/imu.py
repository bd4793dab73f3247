"""Small files of an inertial unit, written for a test."""

from __future__ import annotations

from pathlib import Path

import numpy as np

HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
DENSITIES = {
    "gyroscope_noise_density": 1.7e-4,
    "accelerometer_noise_density": 2e-3,
    "gyroscope_random_walk": 1.9e-5,
    "accelerometer_random_walk": 3e-3,
}
FIRST_NS, STEP_NS = 1_403_636_579_758_555_392, 5_000_000


def motion(count: int, seed: int = 0, rate_rad_s: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Rates (n, 3), rad/s, and forces (n, 3), m/s^2, of a unit that turns slowly and comes to no rest."""
    time_s = STEP_NS / 1e9 * np.arange(count)
    rng = np.random.default_rng(seed)
    gyro = rate_rad_s * np.sin(time_s[:, None] * [1.0, 1.3, 0.7]) + 0.002 * rng.normal(size=(count, 3))
    up = np.array([0.1, -0.2, 1.0]) / np.linalg.norm([0.1, -0.2, 1.0])
    force = []
    for w in gyro:
        force.append(9.81 * up)
        up = up - STEP_NS / 1e9 * np.cross(w, up)
        up /= np.linalg.norm(up)
    return gyro, np.array(force) + 0.02 * rng.normal(size=(count, 3))


def rows(time_ns: np.ndarray, *columns: np.ndarray) -> list[str]:
    """Lines of stamps and columns (n, 3)."""
    return [
        ",".join([str(ns), *(repr(float(x)) for x in row)])
        for ns, row in zip(time_ns.tolist(), np.hstack(columns), strict=True)
    ]


def write_lines(path: Path, lines: list[str]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")
    return path


def yaml_lines(prefix: str = "", **changes: float) -> list[str]:
    return [f"{prefix}{key}: {value}" for key, value in {**DENSITIES, **changes}.items()]


def write_imu0(folder: Path, count: int = 200, first_ns: int = FIRST_NS - 10 * STEP_NS) -> Path:
    """A folder ``imu0`` of EuRoC, with samples and their densities."""
    gyro, accel = motion(count)
    write_lines(folder / "data.csv", [HEADER, *rows(first_ns + STEP_NS * np.arange(count), gyro, accel)])
    identity = ["T_BS:", "  cols: 4", "  rows: 4", f"  data: {np.eye(4).ravel().tolist()}", "rate_hz: 200"]
    write_lines(folder / "sensor.yaml", [*identity, *yaml_lines()])
    return folder
