"""Predictions by inertial samples and by velocities that walk: those of the engine are those of Python."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from support.compiled import CALIBRATION, NOISE, assert_same_covariance
from support.predicting import POSES, assert_same, inertial_filters, see, walking_filters

from ekfslam.data.interval import Interval
from ekfslam.data.room import Room, simulate_room
from ekfslam.engine import choice
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import run_filter
from ekfslam.models.blocks import CameraJitter, VisionDrift
from ekfslam.resolve import resolve

pytestmark = pytest.mark.skipif(bool(choice.MISSING), reason=f"engine: {choice.MISSING}")


def samples(pieces, dt_s, rate, force=9.81, is_gap=False, doubt=1.0, seed=2):
    rng = np.random.default_rng(seed)
    dt = dt_s * rng.uniform(0.5, 1.0, pieces)
    inputs = np.hstack([rate * rng.normal(size=(pieces, 3)), force * rng.normal(size=(pieces, 3))])
    return Interval(float(dt.sum()), dt, inputs, is_gap, doubt)


INTERVALS = {
    "twenty": samples(20, 0.005, 1.0),
    "one": samples(1, 0.05, 1.0),
    "half_a_turn": Interval(0.05, np.array([0.05]), np.array([[0.0, 0.0, np.pi / 0.05, 1.0, 2.0, 9.0]])),
    "near_a_turn": samples(20, 0.02, 8.0),
    "at_rest": Interval(0.1, np.full(20, 0.005), np.tile([0, 0, 0, 0, 0, 9.81], (20, 1))),
    "nothing": Interval(0.1, np.full(2, 0.05), np.zeros((2, 6))),
    "gap": samples(3, 0.4, 1.0, is_gap=True),
    "doubted": samples(10, 0.005, 1.0, doubt=3.0),
    "empty_piece": Interval(0.02, np.array([0.01, 0.0, 0.01]), np.ones((3, 6))),
    "long": samples(4, 3.0, 0.3),
}


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("name", INTERVALS)
def test_a_step_by_samples_is_that_of_python(name, pose):
    for prior in (0.05, 0.0):  # Phi and Q; Q alone
        both = inertial_filters(pose, prior=prior)
        for ekf in both:
            ekf.begin(np.ones(6))
            ekf.predict(INTERVALS[name])
        tolerance = 1e-10 if name == "long" else 1e-12  # Python's composes 250 parts
        assert_same(*both, tolerance)
        if prior:
            assert_same_covariance(*(ekf.P for ekf in both), tolerance)
        else:
            own = both[0].model.process.columns
            P = [ekf.P[np.ix_(own, own)] for ekf in both]
            std = np.sqrt(np.diag(P[1]))
            assert (np.abs(P[0] - P[1]) <= tolerance * np.outer(std, std)).all() and std.min() > 0


def test_samples_move_every_block_and_walks_go_on_beside_them():
    both = inertial_filters(blocks=(CameraJitter(), VisionDrift()), calibration=CALIBRATION)
    for ekf in both:
        ekf.begin(np.ones(6))
        see(ekf, 0)
    for k, name in enumerate(("twenty", "gap", "doubted"), start=1):
        for ekf in both:
            ekf.predict(INTERVALS[name])
        assert_same(*both, 1e-9)
        for ekf in both:
            see(ekf, k)


def test_predictions_by_samples_are_made_in_the_engine():
    ekf, own = inertial_filters()
    assert ekf.engine.predicts and not own.engine.predicts


@pytest.mark.parametrize("is_measured", [True, False])
@pytest.mark.parametrize("gate_probability", [0.99, 1.0])
def test_velocities_that_walk_are_those_of_python(is_measured, gate_probability):
    both, rng = walking_filters(is_measured, gate_probability), np.random.default_rng(4)
    for ekf in both:
        ekf.begin(np.ones(6))
        see(ekf, 0)
    for k in range(1, 6):
        dt_s = rng.uniform(0.02, 0.1, 1 + k % 2)
        twist = 0.1 * rng.normal(size=(len(dt_s), 6)) + (5.0 if k == 4 else 0.0)  # a wild one
        for ekf in both:
            ekf.predict(Interval(float(dt_s.sum()), dt_s, twist, k == 3))
        assert_same(*both, 1e-10)
        assert_same_covariance(*(ekf.P for ekf in both), 1e-9)
        likelihoods = [see(ekf, k).log_likelihood for ekf in both]
        assert likelihoods[0] == pytest.approx(likelihoods[1], rel=1e-9)
    logs = [ekf.log() for ekf in both]
    np.testing.assert_allclose(logs[0].measured_std, logs[1].measured_std, rtol=1e-10)
    is_doubted = is_measured and gate_probability < 1
    assert (logs[0].measured_std.max() > 2 * logs[0].measured_std[:3].max()) == is_doubted
    assert both[0].engine.predicts and not both[1].engine.predicts


def test_a_landmark_moves_on_by_the_motion_of_the_frame_before():
    """Consensus and motion tests use the last motion; it is there from the second prediction on."""
    both = inertial_filters(noise=NOISE)
    for ekf in both:
        ekf.begin(np.ones(6))
        see(ekf, 0)
    for k in range(1, 4):
        for ekf in both:
            ekf.predict(INTERVALS["twenty"])
        reports = [see(ekf, k) for ekf in both]
        np.testing.assert_array_equal(reports[0].reason, reports[1].reason)


def test_a_whole_run_by_samples_is_that_of_the_reference_filter():
    problem = resolve(simulate_room(Room(frames=25, seed=2)))
    both = [
        JointEKF(problem.model, dataclasses.replace(problem.config.filter, engine=e)) for e in ("engine", "reference")
    ]
    for frames in zip(*(run_filter(ekf, problem.sequence) for ekf in both), strict=True):
        np.testing.assert_array_equal(*(frame.report.reason for frame in frames))
    for name, value in both[1].values.items():
        np.testing.assert_allclose(both[0].values[name], value, atol=1e-9)
    assert_same_covariance(*(ekf.P for ekf in both), 1e-9)
