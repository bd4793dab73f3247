"""Rows that are taken out of an update leave the covariance as if they had never been in, however little is left."""

import dataclasses

import numpy as np
from reference import CAMERA, T_CAM_IMU, small_world
from test_variants import OPEN, P0

from ekfslam.errors import InnovationError
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


def test_starting_the_update_over_equals_taking_rows_out(monkeypatch):
    """Where the downdate breaks down, the update is made once more without the rows: the same to rounding."""
    world = small_world(seed=10, sigma_v=1.0, sigma_w=0.15)
    config = dataclasses.replace(OPEN, gate_probability=0.999)

    def after_outliers():
        ekf = JointEKF(Rig(CAMERA, T_CAM_IMU, world.noise), config, world.initial_T_world_imu, 1e-2 * P0)
        for k in range(7):
            ids, pixels = world.observations.at(k)
            if k:
                ekf.predict(world.twist[k], world.time_s[k] - world.time_s[k - 1])
            if k == 6:
                known = np.flatnonzero(np.isin(ids, ekf.ids))[1:4]
                pixels = pixels.copy()
                pixels[known] += 9.0 * np.array([[1, 1, 1, 1], [1, -1, 1, -1], [-1, 1, -1, 1]])
            report = ekf.update(k, ids, pixels)
        assert 0 < (report.reason == 0).sum() < len(report.reason)
        return ekf

    downdated, condition, failed = after_outliers(), Gaussian.condition, []

    def failing(self, rows, frame, ids, sign=1.0):
        if sign < 0:
            failed.append(frame)
            raise InnovationError(frame, ids)
        return condition(self, rows, frame, ids, sign)

    monkeypatch.setattr(Gaussian, "condition", failing)
    again = after_outliers()
    assert 6 in failed
    np.testing.assert_allclose(again.T_imu_world, downdated.T_imu_world, atol=1e-9)
    np.testing.assert_allclose(again.P, downdated.P, atol=1e-9)
