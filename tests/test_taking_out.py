"""Rows that are taken out of an update leave the covariance as if they had never been in, however little is left."""

import dataclasses

import numpy as np
from reference import CAMERA, T_CAM_IMU, small_world
from test_variants import OPEN, P0

from ekfslam.filters.gaussian import Gaussian, Rows
from ekfslam.filters.joint import JointEKF
from ekfslam.models.sensors.stereo import Rig


def test_undone_conditioning_leaves_what_was_there():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(12, 12))
    gaussian = Gaussian(np.eye(6), 6)
    gaussian.replace(root @ root.T)
    before = gaussian.P.copy()
    rows = Rows(
        np.array([1, 0]),
        rng.normal(size=(2, 3, 6)),
        rng.normal(size=(2, 3, 3)),
        rng.normal(size=(2, 3)),
        np.ones((2, 3)),
    )
    done = gaussian.condition(rows, 0, np.array([7, 8]))
    assert np.abs(gaussian.P - before).max() > 0.1
    gaussian.undo(done)
    np.testing.assert_allclose(gaussian.P, before, atol=1e-12 * np.abs(before).max())


def test_landmarks_whose_rows_leave_nothing_to_judge_by_are_taken_out_by_starting_over():
    """Exact motion and huge priors: what three landmarks leave of each other is rounding; the frame goes on."""
    world = small_world(seed=10, frames=12)
    noise = dataclasses.replace(world.noise, pixel_std_px=np.full(4, 1e-6))
    config = dataclasses.replace(OPEN, gate_probability=0.999)
    ekf = JointEKF(Rig(CAMERA, T_CAM_IMU, noise), config, world.initial_T_world_imu, 1e6 * P0)
    for k in range(len(world)):
        if k:
            ekf.predict(world.twist[k], world.time_s[k] - world.time_s[k - 1])
        ekf.update(k, *world.observations.at(k))
        assert np.isfinite(ekf.P).all()
