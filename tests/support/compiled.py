"""The engine's filter and the reference filter of one model, and frames that both are driven by."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from unittest.mock import patch

import numpy as np
import pytest

from ekfslam.config import CalibrationConfig, FilterConfig
from ekfslam.data.interval import Interval
from ekfslam.data.noise import Noise
from ekfslam.engine.face import Engine
from ekfslam.filters.joint import JointEKF
from ekfslam.geometry import motion, se3
from ekfslam.geometry.camera import StereoCamera, project
from ekfslam.models.blocks import CameraJitter, StateBlock, VisionDrift
from ekfslam.models.build import model_of
from ekfslam.models.sensors.monocular import Monocular
from ekfslam.models.sensors.stereo import Rig
from support.reference import T_CAM_IMU

CAMERA = StereoCamera(fu_px=400.0, fv_px=410.0, cu_px=320.0, cv_px=240.0, baseline_m=0.5)
CALIBRATION = CalibrationConfig(lever_arm_m=0.1, rotation_deg=2.0, baseline=0.02, disparity_px=1.0, time_s=0.05)
NOISE = dataclasses.replace(Noise.isotropic(0.1, 0.01, 0.7), pixel_std_px=np.array([0.6, 0.7, 0.8, 0.9]))
TRACKS = dataclasses.replace(
    NOISE,
    track_first_px=np.array([0.5, 0.6, 0.7]),
    track_walk_px=np.array([0.2, 0.3, 0.1]),
    track_flow_px=20.0,
    track_parallax=0.3,
)
EXTRINSICS = se3.exp(np.array([0.3, -0.2, 0.5, 0.3, -0.2, 0.1])) @ T_CAM_IMU
LANDMARKS = 9


class Sway(StateBlock):
    """A block that moves the camera, in differences otherwise than in single observations."""

    name, size = "sway", 6
    is_seen = per_frame = True

    def initial(self):
        return np.array([0.06, -0.04, 0.05, 0.03, -0.05, 0.04])

    def transition(self, tau_s, way_m):
        return np.full((*np.shape(tau_s), 6), 0.9), np.full((*np.shape(tau_s), 6), 0.01)

    def camera_share(self, way_m, is_difference):
        return np.where(is_difference, way_m, 0.3)


@dataclass(frozen=True)
class Case:
    """Settings and parts of a model; all is there by default."""

    variant: str = "invariant"
    coordinates: str = "image"
    tracks: bool = True
    calibration: bool = True
    blocks: bool = True
    monocular: bool = False
    dormant: int = 0

    def filters(self, T_imu_world, engines=("engine", "reference")):
        """Return new filters with a random joint covariance of the blocks."""
        noise, rng = TRACKS if self.tracks else NOISE, np.random.default_rng(3)
        sensor = (Monocular if self.monocular else Rig)(CAMERA, EXTRINSICS, noise)
        if self.monocular:
            sensor = dataclasses.replace(sensor, parallax_rad=0.05, patience=3)
        blocks = (CameraJitter(), Sway(), VisionDrift()) if self.blocks else ()
        calibration = CALIBRATION if self.calibration else None
        model = model_of(sensor, noise, T_imu_world, np.eye(6) * 1e-4, calibration, blocks, self.coordinates)
        root = rng.normal(size=(model.layout.body, model.layout.body)) * 0.02
        model = dataclasses.replace(model, joint_prior=root @ root.T + 1e-4 * np.eye(len(root)))
        config = FilterConfig(
            variant=self.variant,
            landmark_coordinates=self.coordinates,
            gate_probability=1.0,
            retire="unseen",
            retire_after=1 if self.dormant else 3,
            dormant=self.dormant,
        )
        return [JointEKF(model, dataclasses.replace(config, engine=kind)) for kind in engines]


def frames(filters, count, rng):
    """Drive new filters sideways past a far, a near and other landmarks; yield the reports, and None if predicted.

    After the first frame a shuffled part of the landmarks is seen.
    """
    is_monocular, moved = isinstance(filters[0].sensor, Monocular), np.eye(4)
    q = rng.uniform([-4, -3, 8], [4, 3, 25], (LANDMARKS, 3))
    q[0], q[1] = [30.0, 4.0, 300.0], [0.2, 0.1, 1.2]
    for ekf in filters:
        ekf.begin(np.array([0.5, 0.2, 0.1, 0.02, -0.03, 0.05]))
    for k in range(count):
        seen = rng.permutation(LANDMARKS)[: 6 if k else LANDMARKS]
        u, v, right = project(CAMERA, se3.apply(moved, q[seen]))[:, :3].T
        pixels = np.column_stack([u, v, right, v]) + rng.normal(size=(len(seen), 4))
        yield [ekf.update(k, seen + 10, pixels[:, : 2 if is_monocular else 4]) for ekf in filters]
        twist, dt_s = rng.normal(size=(2, 6)) * [1, 1, 1, 0.1, 0.1, 0.1] + [0, 4, 0, 0, 0, 0], np.array([0.04, 0.06])
        for step in motion.increment(twist, dt_s):
            moved = EXTRINSICS @ step @ se3.inverse(EXTRINSICS) @ moved
        for ekf in filters:
            ekf.predict(Interval(0.1, dt_s, twist))
        yield None


def driven(case, count=3):
    """Return a filter of the engine after some frames, before the update of the next."""
    (ekf,) = case.filters(np.eye(4), ("engine",))
    for _ in frames([ekf], count, np.random.default_rng(2)):
        pass
    return ekf


def arguments(model, config):
    """Return the arguments with which `Engine` makes a `Filter` of the module."""
    with patch("ekfslam.engine._engine.Filter") as made:
        Engine(model, config)
    return list(made.call_args.args)


def assert_same_covariance(found, known, tolerance=1e-9, floor=1e-300):
    """Errors count in standard deviations."""
    std = np.sqrt(np.maximum(np.diag(known), 0.0))
    assert (np.abs(found - known) <= tolerance * np.outer(std, std) + floor).all()


def assert_same_state(found, known, tolerance=1e-9, floor=1e-300):
    """Compare mean and covariance of two filters; a view before any motion is known to rounding, hence ``floor``."""
    np.testing.assert_array_equal(found.ids, known.ids)
    for name, value in known.values.items():
        np.testing.assert_allclose(found.values[name], value, rtol=tolerance, atol=tolerance, err_msg=name)
    np.testing.assert_allclose(found.positions_m, known.positions_m, rtol=tolerance, atol=tolerance)
    assert_same_covariance(found.P, known.P, tolerance, floor)


def assert_same_report(found, known, rtol=1e-9):
    np.testing.assert_array_equal(found.reason, known.reason)
    np.testing.assert_array_equal(found.split, known.split)
    assert (found.dof, found.doubt) == (known.dof, pytest.approx(known.doubt))
    figures = [[report.nis, report.log_likelihood] for report in (found, known)]
    np.testing.assert_allclose(*figures, rtol=rtol, atol=1e-9)
    one, other = found.innovations, known.innovations
    np.testing.assert_array_equal(one.landmark, other.landmark)
    size = np.abs(other.information).max(initial=1.0)
    np.testing.assert_allclose(one.information, other.information, atol=1e-8 * size)
