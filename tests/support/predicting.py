"""Filters that predict in the engine, the same ones that predict in Python, and their comparison."""

from __future__ import annotations

import dataclasses

import numpy as np

from ekfslam.config import FilterConfig
from ekfslam.data.inputs import InertialNoise
from ekfslam.filters.joint import JointEKF
from ekfslam.geometry import se3
from ekfslam.models.blocks import AccelBias, GyroBias, Twist, TwistBias, Up, Velocity
from ekfslam.models.build import model_of
from ekfslam.models.process.inertial import Inertial
from ekfslam.models.process.velocities import VelocityWalk
from ekfslam.models.sensors.stereo import Rig
from support.compiled import CAMERA, EXTRINSICS, TRACKS

POSES = {
    "identity": 1e-9 * np.ones(6),
    "pi": np.array([3.0, -1.0, 2.0, 0.1, np.pi - 1e-7, 0.0]),
    "far": np.array([30.0, -10.0, 2.0, 0.4, -0.9, 1.1]),
}
DENSITIES = InertialNoise(2e-3, 3e-2, 1e-3, 5e-3)


class OwnInertial(Inertial):
    """The same process as a class of the user's, which the engine does not know."""


class OwnWalk(VelocityWalk):
    """The same process as a class of the user's, which the engine does not know."""


def unit(rng):
    """Return the blocks of an inertial unit with random first values."""
    u, gyro, accel = rng.normal(size=(3, 3)) * np.array([[2.0], [0.02], [0.2]])
    return Velocity(0.3, u), GyroBias(0.01, gyro), AccelBias(0.1, accel)


def both_of(model, process, own, gate_probability=1.0):
    """Return filters of a model that predict in C++ and in Python."""
    config = FilterConfig(engine="engine", retire="unseen", gate_probability=gate_probability)
    makers = [lambda layout, noise, kind=kind: process(kind, layout, noise) for kind in own]
    return [JointEKF(dataclasses.replace(model, make_process=make), config) for make in makers]


def inertial_filters(pose="far", blocks=(), noise=TRACKS, prior=0.05, calibration=None):
    rng = np.random.default_rng(7)
    # Further blocks come before some of the unit's, so that its columns are not next to each other.
    velocity, *biases = unit(rng)
    parts = (velocity, *blocks, *biases)
    model = model_of(Rig(CAMERA, EXTRINSICS, noise), noise, se3.exp(POSES[pose]), 0.01 * np.eye(6), calibration, parts)
    root = prior * rng.normal(size=(model.layout.body, model.layout.body))
    model = dataclasses.replace(model, joint_prior=root @ root.T + (prior > 0) * model.prior_covariance)
    return both_of(model, lambda kind, layout, _: kind(layout, DENSITIES, 9.8), (Inertial, OwnInertial))


def walking_filters(is_measured, gate_probability=0.99, blocks=()):
    noise = dataclasses.replace(TRACKS, motion_std=np.repeat([0.03, 0.004], 3), gap_std=np.repeat([0.5, 0.1], 3))
    up = se3.so3_exp(np.array([0.7, -0.5, 0.0]))[:, 2]
    blocks = (TwistBias(), Twist(np.repeat([0.3, 0.03], 3), is_measured), Up(up, np.full(3, 0.05), np.eye(3)), *blocks)
    T, rig = se3.exp(POSES["far"]), Rig(CAMERA, EXTRINSICS, noise)
    model = model_of(rig, noise, T, 0.01 * np.eye(6), None, blocks)
    make = lambda kind, layout, noise: kind(layout, noise.process)  # noqa: E731
    return both_of(model, make, (VelocityWalk, OwnWalk), gate_probability)


def see(ekf, frame):
    """Update by four landmarks, in another order each time, whose images stay where they are."""
    rng = np.random.default_rng(3)
    pixels = np.column_stack([rng.uniform(100, 500, 4), rng.uniform(100, 400, 4)])
    measured = np.column_stack([pixels, pixels[:, 0] - rng.uniform(20, 60, 4), pixels[:, 1]])
    order = np.roll(np.arange(4), frame)[: 3 + frame % 2]
    return ekf.update(frame, np.array([7, 3, 9, 5])[order], measured[order])


def assert_close(one, other, what, tolerance):
    size = np.abs(other).max(initial=1.0)
    np.testing.assert_allclose(one, other, atol=tolerance * size, rtol=tolerance, err_msg=what)


def assert_same(one, other, tolerance=1e-13):
    for name, value in other.values.items():
        assert_close(one.values[name], value, name, tolerance)
    for name in ("coordinates", "imu_twist", "P", "step"):
        assert_close(getattr(one, name), getattr(other, name), name, tolerance)
    for name in ("T_departed", "T_predicted", "way_m", "T_cam_imu_before"):
        assert_close(getattr(one.motion, name), getattr(other.motion, name), name, tolerance)
    logs = one.log(), other.log()
    for field in dataclasses.fields(logs[0]):
        assert_close(*(np.asarray(getattr(log, field.name), dtype=float) for log in logs), field.name, tolerance)
