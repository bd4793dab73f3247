"""The covariance after a correction of the invariant variant, where it estimates the camera's rotation: J P J^T, dense.

The standard variant makes the same correction and leaves the covariance as it is, which is the P to start from: two
filters that have seen one frame are the same but for their variant.
"""

from __future__ import annotations

import numpy as np
import pytest
from support.reference import T_CAM_IMU, small_world

from ekfslam import CalibrationConfig, FilterConfig
from ekfslam.filters.joint import JointEKF
from ekfslam.geometry import se3
from ekfslam.models.sensors.stereo import Rig

P0 = np.diag([0.1, 0.2, 0.3, 0.05, 0.08, 0.1]) ** 2
# What stands behind the pose in the state: other parameters before and behind the rotation must not be taken for it.
CALIBRATIONS = {
    "rotation": (CalibrationConfig(rotation_deg=8.0), 0),
    "rotation among others": (
        CalibrationConfig(rotation_deg=8.0, lever_arm_m=0.1, baseline=0.02, disparity_px=0.5),
        3,
    ),
}


def corrected_once(world, variant, calibration):
    """The filter after a correction by the landmarks of its first frame; pose and landmarks just before it."""
    config = FilterConfig(variant, "xyz", retire="never", gate_probability=1.0, split_after=0)
    rig = Rig(world.camera, world.T_cam_imu, world.noise)
    ekf = JointEKF(rig, config, world.initial_T_world_imu, P0, calibration)
    ekf.update(0, *world.observations.at(0))
    ekf.predict(world.twist[1], world.time_s[1] - world.time_s[0])
    T_before, positions = ekf.T_imu_world.copy(), ekf.positions_m.copy()
    ids, pixels = world.observations.at(1)
    known = np.isin(ids, ekf.ids)
    ekf.update(1, ids[known], pixels[known])
    return ekf, T_before, positions


@pytest.mark.parametrize(("calibration", "before_it"), CALIBRATIONS.values(), ids=CALIBRATIONS.keys())
def test_transport_with_the_rotation_of_the_camera(calibration, before_it):
    world = small_world(frames=2, landmarks=20, sigma_px=3.0)
    standard, *_ = corrected_once(world, "standard", calibration)
    ekf, T_before, positions = corrected_once(world, "invariant", calibration)
    np.testing.assert_array_equal(ekf.ids, standard.ids)
    assert len(ekf.ids) > 5

    moved = ekf.positions_m - positions
    body = len(ekf.P) - 3 * len(moved)
    J = np.eye(len(ekf.P))
    J[:6, :6] = se3.adjoint(ekf.T_imu_world @ np.linalg.inv(T_before))
    # The parameters are 0 before the correction: the camera is where the calibration as given says.
    camera = slice(6 + before_it, 9 + before_it)
    R_world_imu = T_before[:3, :3].T
    R_world_cam = (T_CAM_IMU @ T_before)[:3, :3].T
    for i, m in enumerate(moved):
        own = slice(body + 3 * i, body + 3 * i + 3)
        J[own, 3:6] = se3.skew(m) @ R_world_imu
        J[own, camera] = se3.skew(m) @ R_world_cam
    expected = J @ standard.P @ J.T
    scale = np.sqrt(np.diag(expected))
    assert (np.abs(ekf.P - expected) <= 1e-10 * np.outer(scale, scale)).all()

    # Without the part of second order in the motion of the landmarks it would show.
    B = J[:, camera].copy()
    B[camera] = 0.0
    second = B @ standard.P[camera, camera] @ B.T
    assert np.abs(second / np.outer(scale, scale)).max() > 1e-6
