"""Predictions by velocities: those of the engine in C++ are those of Python."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import pytest
from support.compiled import CALIBRATION, CAMERA, EXTRINSICS, NOISE, TRACKS
from support.predicting import POSES, assert_same, see

from ekfslam.config import FilterConfig
from ekfslam.data.interval import Interval
from ekfslam.engine import choice
from ekfslam.filters.joint import JointEKF
from ekfslam.geometry import se3
from ekfslam.models.blocks import CameraJitter, TwistBias, Up, VisionDrift
from ekfslam.models.build import model_of
from ekfslam.models.process.velocities import VelocityInputs
from ekfslam.models.sensors.stereo import Rig

pytestmark = pytest.mark.skipif(bool(choice.MISSING), reason=f"engine: {choice.MISSING}")


class OwnInputs(VelocityInputs):
    """The same process as a class of the user's, which the engine does not know."""


@dataclass(frozen=True)
class OwnBias(TwistBias):
    """The same block with lengths of the user's."""

    name = "twist_bias"

    def lengths(self, tau_s, way_m):
        return super().lengths(tau_s, way_m)


class Begun(TwistBias):
    """The same block with a first value."""

    name = "twist_bias"

    def initial(self):
        return np.array([0.2, -0.1, 0.3, 0.02, -0.01, 0.03])


def up_of(rng):
    tilt = np.array([0.7, -0.5, 0.0]) + 0.1 * rng.normal(size=3)
    return Up(se3.so3_exp(tilt)[:, 2], np.full(3, 0.05), np.eye(3))


BLOCKS = {
    "bias": lambda rng: (Begun(),),
    "up": lambda rng: (up_of(rng),),
    "camera": lambda rng: (CameraJitter(), VisionDrift()),
    "all": lambda rng: (Begun(slip_y_m_s=0.3), up_of(rng), CameraJitter(), VisionDrift()),
    "none": lambda rng: (),
}


def filters_of(blocks, pose, noise=TRACKS, calibration=None):
    """Return filters that predict in C++ and in Python, with a random joint covariance, biases and jitter."""
    rng = np.random.default_rng(7)
    noise = dataclasses.replace(noise, motion_std=np.repeat([0.03, 0.004], 3), gap_std=np.repeat([0.5, 0.1], 3))
    model = model_of(Rig(CAMERA, EXTRINSICS, noise), noise, se3.exp(POSES[pose]), 0.01 * np.eye(6), calibration, blocks)
    root = 0.05 * rng.normal(size=(model.layout.body, model.layout.body))
    model = dataclasses.replace(model, joint_prior=root @ root.T + model.prior_covariance)
    config = FilterConfig(engine="engine", retire="unseen", gate_probability=1.0)
    own = dataclasses.replace(model, make_process=lambda layout, noise: OwnInputs(layout, noise.process))
    return [JointEKF(one, config) for one in (model, own)]


def intervals(rng):
    """Return intervals with one and with several pieces, across gaps, doubted, long, and while the rig stands."""
    kinds = [(1, 0, 1, 1), (4, 0, 1, 1), (1, 1, 1, 0), (3, 0, 5, 2), (1, 1, 2, 1), (2, 0, 1, 20)]
    for pieces, is_gap, doubt, size in kinds:
        dt_s = rng.uniform(0.02, 0.1, pieces)
        yield Interval(float(dt_s.sum()), dt_s, size * rng.normal(size=(pieces, 6)), bool(is_gap), float(doubt))


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("blocks", BLOCKS)
def test_predictions_are_those_of_python(blocks, pose):
    both = filters_of(BLOCKS[blocks](np.random.default_rng(1)), pose)
    for ekf in both:
        ekf.begin(np.ones(6))
    for interval in intervals(np.random.default_rng(2)):
        for ekf in both:
            ekf.predict(interval)
        assert_same(*both)


@pytest.mark.parametrize("noise", [NOISE, TRACKS], ids=["white", "tracks"])
def test_predictions_between_updates_are_those_of_python(noise):
    both = filters_of(BLOCKS["all"](np.random.default_rng(1)), "far", noise, CALIBRATION)
    for ekf in both:
        ekf.begin(np.ones(6))
        see(ekf, 0)
    for k in range(1, 4):
        for ekf in both:
            ekf.predict(Interval.of_one(0.05 * np.arange(1, 7), 0.1))
        assert_same(*both, 1e-9)  # an update enlarges what rounding leaves
        reports = [see(ekf, k) for ekf in both]
        assert reports[0].dof == reports[1].dof > 0
    assert all(np.abs(both[0].values[name]).min() > 0 for name in ("twist_bias", "camera_jitter"))


def test_a_block_with_a_method_of_the_user_is_no_data():
    assert TwistBias().as_data() is not None
    assert OwnBias().as_data() is None


def test_a_block_of_the_user_gives_its_scales_as_data():
    @dataclass(frozen=True)
    class Slow(TwistBias):
        name = "twist_bias"

        @property
        def scales(self):
            return 3.0, 50.0

    both = filters_of((Slow(),), "far")
    for ekf in both:
        ekf.predict(Interval.of_one(np.arange(6) / 3.0, 0.1))
    assert_same(*both)
    assert Slow().as_data()["length_m"].tolist() == [50.0] * 6
