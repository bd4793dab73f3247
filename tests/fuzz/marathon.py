"""Long drives around a ring: time a frame, memory and covariance, as the frames go on.

    python tests/fuzz/marathon.py [--frames 1000000] [--stay] [--landmarks 60]

Landmarks that leave are dropped, or stay for the next lap. Each hundredth part of the drive prints a line, and fails if
the covariance is not symmetric or not positive semi-definite. With ``--at-once 5000`` so many landmarks are seen in
each of five frames instead.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from test_live_robust import CAMERA, NOISE, T_CAM_IMU

from ekfslam import LiveEKF
from ekfslam.config import FilterConfig
from ekfslam.geometry import se3
from ekfslam.geometry.camera import project

RADIUS_M, SPEED_M_S, STEP_S, SEEN = 10.0, 2.0, 0.1, 8
LEAST, MOST_EIGENVALUES = 1e-9, 4000
TURN = np.array([SPEED_M_S, 0.0, 0.0, 0.0, 0.0, SPEED_M_S / RADIUS_M])


def drive(points_m: np.ndarray, frames: int, seen: int, rng: np.random.Generator) -> Iterator[tuple]:
    """Yield the true pose, a noisy velocity, ids and pixels of each frame."""
    for k in range(frames):
        T = se3.exp(TURN * STEP_S * k)
        q = se3.apply(T_CAM_IMU @ se3.inverse(T), points_m)
        pixels = project(CAMERA, q) + NOISE.pixel_std_px * rng.standard_normal((len(q), 4))
        is_in = (q[:, 2] > 1.0) & (np.abs(pixels[:, 0] - 320.0) < 320.0) & (np.abs(pixels[:, 1] - 240.0) < 240.0)
        ids = np.flatnonzero(is_in)
        ids = np.sort(ids[np.argsort(q[ids, 2])[:seen]])
        yield T, TURN + NOISE.twist_std * rng.standard_normal(6), ids, pixels[ids]


def judged(P: np.ndarray) -> float:
    """Return the smallest eigenvalue of the correlations; raise unless P is symmetric and positive semi-definite.

    Of thousands of landmarks, whose eigenvalues take too long, a bound of it is returned.
    """
    std = np.sqrt(np.diag(P))
    std[std == 0.0] = 1.0  # a pose that is known
    correlations = P / np.outer(std, std)
    if len(P) > MOST_EIGENVALUES:
        correlations[np.diag_indices_from(correlations)] += LEAST
        np.linalg.cholesky(correlations)  # raises if there is one below
        least = -LEAST
    else:
        least = float(np.linalg.eigvalsh(correlations)[0])
    assert np.isfinite(P).all() and np.abs(P - P.T).max() <= 1e-12 * np.abs(P).max() and least >= -LEAST, least
    return least


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--landmarks", type=int, default=60)
    parser.add_argument("--stay", action="store_true", help="landmarks never leave")
    parser.add_argument("--at-once", type=int, default=0, help="landmarks of each of five frames")
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    if options.at_once:
        points_m = rng.uniform([4.0, -3.0, -2.0], [12.0, 3.0, 2.0], (options.at_once, 3))
        options.frames = 5
    else:
        angle = np.linspace(0.0, 2.0 * np.pi, options.landmarks, endpoint=False)
        points_m = np.column_stack([(RADIUS_M + 2.0) * np.sin(angle), RADIUS_M - (RADIUS_M + 2.0) * np.cos(angle)])
        points_m = np.column_stack([points_m, rng.uniform(-1.0, 1.0, options.landmarks)])
    settings = FilterConfig(retire="never" if options.stay else "unseen", retire_after=3)
    live = LiveEKF.from_rig(CAMERA, T_CAM_IMU, NOISE, config=settings, log_frames=1000)
    every, spent, worst = max(options.frames // 100, 1), 0.0, 0.0
    seen = max(SEEN, options.at_once)
    for k, (T, twist, ids, pixels) in enumerate(drive(points_m, options.frames, seen, rng)):
        begin = time.process_time()
        live.predict(twist, k * STEP_S)
        live.update(ids, pixels, k * STEP_S)
        spent += time.process_time() - begin
        if (k + 1) % every == 0:
            worst = min(worst, judged(live.ekf.P))
            error = np.linalg.norm(live.ekf.T_world_imu[:3, 3] - T[:3, 3])
            memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            print(
                f"{k + 1} frames: {1e3 * spent / every:.3f} ms a frame, {memory:.0f} MB, "
                f"{len(live.ekf.ids)} landmarks, {error:.3f} m off, least eigenvalue {worst:.1e}",
                flush=True,
            )
            spent = 0.0
    print(live.counts)


if __name__ == "__main__":
    main()
