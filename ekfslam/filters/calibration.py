"""The stereo rig's calibration as part of the joint filter's state: which parameters there are, and their Jacobians.

With nine parameters c the rig sees ``q = exp(c_0..5^) T_cam_imu exp(-c_time u^) T_imu_world m``, eq. (9), its
baseline is ``b exp(c_baseline)``, and its disparities come out larger by ``c_disparity``. All are 0 for the calibration
as given and change additively. ``u`` are the velocities of the IMU: images are exposed ``c_time`` later than stamped.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from ekfslam.arrays import Array
from ekfslam.config import CalibrationConfig
from ekfslam.filters.observing import Rig, first_sight, linearise
from ekfslam.geometry import motion, se3
from ekfslam.geometry.camera import StereoCamera

NAMES = (
    "camera x",
    "camera y",
    "camera z",
    "camera rotation x",
    "camera rotation y",
    "camera rotation z",
    "ln baseline",
    "disparity offset",
    "time offset",
)
UNITS = ("m", "m", "m", "rad", "rad", "rad", "1", "px", "s")
_EXTRINSIC, _BASELINE, _DISPARITY, TIME = slice(0, 6), 6, 7, 8
_ROTATION = slice(3, 6)


def prior_std(config: CalibrationConfig) -> Array:
    """(9,) prior deviations of the parameters, in their `UNITS`; 0 where one is taken as given."""
    return np.array(
        [
            *[config.lever_arm_m] * 3,
            *[np.deg2rad(config.rotation_deg)] * 3,
            config.baseline,
            config.disparity_px,
            config.time_s,
        ]
    )


def calibrated(rig: Rig, parameters: Array) -> Rig:
    """The rig with parameters (9,) applied, all but the time offset."""
    camera: StereoCamera = rig.camera
    return dataclasses.replace(
        rig,
        camera=dataclasses.replace(camera, baseline_m=camera.baseline_m * float(np.exp(parameters[_BASELINE]))),
        T_cam_imu=se3.exp(parameters[_EXTRINSIC]) @ rig.T_cam_imu,
        disparity_offset_px=rig.disparity_offset_px + float(parameters[_DISPARITY]),
    )


def time_offset(parameters: Array) -> float:
    """How much later than stamped the images are exposed, s."""
    return float(parameters[TIME])


def to_exposure(parameters: Array, twist: Array) -> Array:
    """(4, 4) motion from the stamp to the exposure, ``T_imu_world`` there is it times that at the stamp."""
    return motion.increment(twist, time_offset(parameters))


def linearise_calibrated(
    rig: Rig, parameters: Array, twist: Array, T_imu_world: Array, positions_m: Array, linear_positions_m: Array
) -> tuple[Array, Array, Array]:
    """`linearise` with parameters.

    Args:
        rig: As given.
        parameters: (9,) at which to linearise.
        twist: (6,) velocities of the IMU, m/s and rad/s.
        T_imu_world, positions_m, linear_positions_m: As for `linearise`.

    Returns:
        The points in the camera frame (n, 3) m; H (n, 3, 15) by the pose error and the parameters; H_m (n, 3, 3).
    """
    now, delay = calibrated(rig, parameters), to_exposure(parameters, twist)
    q, H_x, H_m = linearise(now, delay @ T_imu_world, positions_m, linear_positions_m)
    A = now.jacobian(q)
    H = np.zeros((len(q), 3, 15))
    H[..., :6] = H_x @ se3.adjoint(delay)
    # First estimates here, too: a camera and its landmarks turned about it as one must look the same for good.
    q_linear = se3.apply(now.T_cam_imu @ delay @ T_imu_world, linear_positions_m)
    moved = np.concatenate([np.broadcast_to(np.eye(3), A.shape), -se3.skew(q_linear)], axis=-1)
    H[..., 6:12] = A @ moved @ se3.left_jacobian(parameters[_EXTRINSIC])
    H[:, 2, 6 + _BASELINE] = -now.camera.fu_px * now.camera.baseline_m / q[:, 2]
    H[:, 2, 6 + _DISPARITY] = -1.0
    H[..., 6 + TIME] = -(H_x @ twist)
    return q, H, H_m


def turned_with_camera(rig: Rig, parameters: Array, T_imu_world: Array, moved_m: Array) -> Array:
    """New landmark errors (n, 3, 3) by the camera's rotation, where a correction moves landmarks by ``moved_m`` (n, 3).

    A rig that turns its camera and all landmarks about it sees the same: their errors count in the camera's frame, as
    those of `ekfslam.filters.variants.derivative_invariant` do in that of the IMU. In world they would be seen from
    ever new linearisation points, above all while depths are poor, and the filter would learn the rotation from noise.
    Pose (4, 4) and parameters (9,) are those before the correction.
    """
    R_world_cam = (se3.exp(parameters[_EXTRINSIC]) @ rig.T_cam_imu @ T_imu_world)[:3, :3].T
    return se3.skew(moved_m) @ R_world_cam @ se3.so3_left_jacobian(parameters[_ROTATION])


def first_sight_calibrated(
    rig: Rig, parameters: Array, twist: Array, T_imu_world: Array, rows: Array, T_linear: Array
) -> tuple[Array, Array, Array]:
    """`first_sight` with parameters: positions (n, 3), G (n, 3, 15) by pose error and parameters, covariance."""
    now, delay = calibrated(rig, parameters), to_exposure(parameters, twist)
    positions, G_x, covariance = first_sight(now, delay @ T_imu_world, rows, delay @ T_linear)
    _, H, H_m = linearise_calibrated(rig, parameters, twist, T_imu_world, positions, positions)
    # What is seen stays as it is: H (xi, c) + H_m d = 0.
    G = np.empty(H.shape)
    G[..., :6] = G_x @ se3.adjoint(delay)
    G[..., 6:] = -np.linalg.solve(H_m, H[..., 6:])
    return positions, G, covariance
