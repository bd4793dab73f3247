"""The same data as a peer: measurements of OpenVINS's simulator, and its own estimates of them.

    python experiments/openvins_sim.py rect_s0_fej.npz

The recording starts in motion. First state, camera rotation, lever arm and time offset are estimated; the baseline too.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import ekfslam
from ekfslam.arrays import Array, IntArray
from ekfslam.data.inputs import InertialNoise, InertialSamples
from ekfslam.data.noise import Noise
from ekfslam.data.observations import Observations, TrueMotion, Truth
from ekfslam.data.sequence import Sequence
from ekfslam.data.worlds import track_ids
from ekfslam.evaluation.consistency import nees, pose_error
from ekfslam.geometry import se3
from ekfslam.geometry.camera import StereoCamera

NOISE = InertialNoise(1.6968e-4, 2.0e-3, 1.9393e-5, 3.0e-3)
# Prior standard deviations of the calibration, those of OpenVINS's estimator_config.yaml: 1 cm, 10 ms, 0.01 rad.
CALIBRATION = {"rotation_deg": 0.573, "lever_arm_m": 0.01, "time_s": 0.01, "baseline": 0.01}


def recording(path: Path, white_seed: int | None = None) -> Sequence:
    """Return a file of the simulator as a recording; ids are split at gaps, as its estimator forgets lost features.

    Args:
        path: File.
        white_seed: Seed of independent noise in place of the simulator's, whose noise is correlated between the cameras
            (0.15 over the recording, 0.35 in its first five seconds).
    """
    d = dict(np.load(path))
    if white_seed is not None:
        d["obs_px"] = exact_pixels(d) + np.random.default_rng(white_seed).standard_normal(d["obs_px"].shape)
    frames = len(d["true_time_s"])
    frame, point, pixels = matched(d["obs_frame"], d["obs_camera"], d["obs_id"], d["obs_px"])
    inside = frame < frames
    frame, point, pixels = frame[inside], point[inside], pixels[inside]
    T = se3.transform(Rotation.from_quat(d["true_q_world_imu_xyzw"]).as_matrix(), d["true_p_imu_world_m"])
    fu, fv, cu, cv = d["cam0_fu_fv_cu_cv"]
    baseline_m = np.linalg.norm(d["cam1_T_imu_cam"][:3, 3] - d["cam0_T_imu_cam"][:3, 3])
    camera = StereoCamera(fu_px=fu, fv_px=fv, cu_px=cu, cv_px=cv, baseline_m=float(baseline_m))
    velocity = (T[:, :3, :3] @ d["true_v_body_m_s"][..., None])[..., 0]
    return Sequence(
        name=path.stem,
        source=str(path),
        time_s=d["true_time_s"] - d["true_time_s"][0],
        camera=camera,
        T_cam_imu=se3.inverse(se3.nearest_rigid(d["cam0_T_imu_cam"])),
        observations=Observations(frame, track_ids(frame, point), pixels),
        inputs=(InertialSamples(d["imu_time_s"] - d["true_time_s"][0], d["gyro_rad_s"], d["accel_m_s2"], NOISE),),
        truth=Truth(np.arange(frames), T, motion=TrueMotion(velocity, d["true_bias_gyro"], d["true_bias_accel"])),
        noise=Noise.isotropic(0.0, 0.0, 1.0),
    )


def exact_pixels(d: dict[str, Array]) -> Array:
    """Return the pixels (K, 2) of all observations without noise; those of the last frame, without truth, are NaN."""
    T = se3.transform(Rotation.from_quat(d["true_q_world_imu_xyzw"]).as_matrix(), d["true_p_imu_world_m"])
    order = np.argsort(d["map_id"])
    points, found = d["map_p_world_m"][order], np.full(d["obs_px"].shape, np.nan)
    for camera in (0, 1):
        own = np.flatnonzero((d["obs_camera"] == camera) & (d["obs_frame"] < len(T)))
        T_cam_world = se3.inverse(T @ d[f"cam{camera}_T_imu_cam"])[d["obs_frame"][own]]
        q = se3.apply(T_cam_world, points[np.searchsorted(d["map_id"][order], d["obs_id"][own])])
        intrinsics = d[f"cam{camera}_fu_fv_cu_cv"]
        found[own] = intrinsics[:2] * q[:, :2] / q[:, 2:] + intrinsics[2:]
    return found


def matched(frame: IntArray, camera: IntArray, point: IntArray, px: Array) -> tuple[IntArray, IntArray, Array]:
    """Return frame, id (K,) and pixels (K, 4) of the points that both cameras see in a frame."""
    frame, point = frame.astype(np.int64), point.astype(np.int64)
    key = frame * (point.max() + 1) + point
    left, right = np.flatnonzero(camera == 0), np.flatnonzero(camera == 1)
    _, i, j = np.intersect1d(key[left], key[right], return_indices=True)
    left, right = left[i], right[j]
    pixels = np.hstack([px[left], px[right]]).astype(float)
    ahead = pixels[:, 0] - pixels[:, 2] > 0
    return frame[left][ahead], point[left][ahead], pixels[ahead]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", type=Path, nargs="+")
    parser.add_argument("--fixed", action="store_true", help="take the calibration as given")
    parser.add_argument("--white", type=int, metavar="SEED", help="independent pixel noise in both cameras")
    parser.add_argument("--frames", type=int, default=100_000)
    options = parser.parse_args()
    config = ekfslam.Config()
    if not options.fixed:
        config = config.with_overrides({"calibration": CALIBRATION})
    for path in options.files:
        whole = recording(path, options.white)
        sequence = whole[: options.frames]
        result = ekfslam.run(sequence, "full", config)
        assert sequence.truth is not None
        true, count = sequence.truth.T_world_imu, len(sequence)
        squared = nees(pose_error(result.T_world_imu, true), result.covariance + 1e-14 * np.eye(6))
        ours = np.sqrt(np.mean(np.sum((result.T_world_imu - true)[:, :3, 3] ** 2, axis=1)))
        peer = np.load(path)["openvins_p_m"][:count]
        theirs = np.sqrt(np.mean(np.sum((peer - true[:, :3, 3]) ** 2, axis=1)))
        late = sequence.time_s > 5.0
        print(f"start: {result.attributes['inertial_start']}")
        print(f"noise: {result.attributes['inertial_noise']}")
        if result.parameters is not None:
            last = result.parameters.value[-1], result.parameters.std[-1]
            for name, value, std in zip(result.parameters.name, *last, strict=True):
                print(f"  {name}: {value:.5f} +- {std:.5f}")
        print(
            f"{path.stem}: ATE {1e3 * ours:.1f} mm, OpenVINS {1e3 * theirs:.1f}; pose NEES after 5 s: mean "
            f"{squared[late].mean():.2f}, worst {squared[late].max():.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
