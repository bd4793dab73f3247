"""What one file can add from outside of the package: here a state block, and a process with a block of its own."""

from dataclasses import dataclass

import numpy as np
import pytest

import ekfslam
from ekfslam.config import Config, FilterConfig, PosteriorConfig
from ekfslam.evaluation.consistency import nees, pose_error
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import one_thread, run_filter
from ekfslam.geometry import motion, se3
from ekfslam.models.blocks import OPTIONAL_BLOCKS, StateBlock, optional_block
from ekfslam.models.blocks.gauss_markov import GaussMarkov
from ekfslam.models.build import model_of
from ekfslam.models.process import Process, Residual, Step
from ekfslam.models.sensors.stereo import Rig
from ekfslam.runner import run
from ekfslam.smoother.posterior import posterior_of_log

# --- a block ------------------------------------------------------------------------------------------


@pytest.fixture
def slip():
    """The block: an error of the forward velocity that slowly changes."""

    @optional_block
    @dataclass(frozen=True)
    class Slip(GaussMarkov):
        sigma_m_s: float = 0.3
        time_s: float = 5.0

        name = "slip"
        labels = ("slip",)
        units = ("m/s",)

        @property
        def stationary_std(self):
            return np.array([self.sigma_m_s])

        def lengths(self, tau_s, way_m):
            return np.asarray(tau_s)[..., None] / self.time_s

        def velocity_offset(self):
            return np.eye(6)[:, :1]

    yield Slip
    del OPTIONAL_BLOCKS[Slip.name]


@pytest.mark.slow
def test_a_block_from_outside_is_estimated_by_filter_and_smoother(slip):
    world = ekfslam.open_sequence("builtin:city?frames=40&outlier_fraction=0")
    slipping = world.with_velocities(world.twist + 0.5 * np.eye(6)[0], "imu")
    config = Config(filter=FilterConfig(gate_probability=1.0), blocks={"slip": {"sigma_m_s": 0.5}})
    filtered = run(slipping, "full", config)
    smoothed = run(slipping, "smoothed", config)
    for result in (filtered, smoothed):
        found = result.parameters
        assert found.name == ("slip",)
        assert np.abs(found.value[-1, 0] - 0.5) < 3 * found.std[-1, 0] < 0.9
    np.testing.assert_allclose(smoothed.T_world_imu[-1], filtered.T_world_imu[-1], atol=0.02)
    assert slip.coupling == "velocity"


# --- a process ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Speed(StateBlock):
    """Velocity ``[v; w]`` (6,) of the IMU, m/s and rad/s."""

    prior_std: np.ndarray

    name = "speed"
    per_frame = True
    size = 6

    def prior_covariance(self):
        return np.diag(self.prior_std**2)


@dataclass(frozen=True)
class ConstantSpeed(Process):
    """A velocity that nothing measures moves the pose, and white accelerations change it."""

    layout: object
    acceleration: np.ndarray

    own = ("pose", "speed")

    def step(self, values, interval, T_linear, first_estimates):
        u, tau = values["speed"], np.asarray(interval.tau_s)[..., None, None]
        E = motion.increment(u, interval.tau_s)
        Phi = np.zeros((*u.shape[:-1], 12, self.layout.body))
        T_next = E @ values["pose"]
        Phi[..., :6, self.layout["pose"]] = motion.error_jacobian(
            T_next @ se3.inverse(T_linear) if first_estimates else E
        )
        Phi[..., :6, self.layout["speed"]] = -motion.twist_jacobian(u, interval.tau_s)
        Phi[..., 6:, self.layout["speed"]] = np.eye(6)
        Q = np.zeros((*u.shape[:-1], 12, 12))
        # The acceleration is constant during the interval.
        G = np.concatenate([Phi[..., :6, self.layout["speed"]] / 2, np.broadcast_to(np.eye(6), (*u.shape, 6))], axis=-2)
        Q[:] = tau * (G * self.acceleration**2) @ np.swapaxes(G, -1, -2)
        Q[..., :6, :6] += 1e-8 * np.eye(6)
        return Step({"pose": T_next, "speed": u}, u, Phi, Q)

    def residual(self, before, after, intervals):
        step = self.step(before, intervals, before["pose"], False)
        moved = se3.log(after["pose"] @ se3.inverse(step.values["pose"]))
        error = np.concatenate([moved, after["speed"] - before["speed"]], axis=-1)
        by_before, by_after = -step.Phi, np.zeros_like(step.Phi)
        by_before[..., :6, :] = se3.left_jacobian_inverse(-moved) @ by_before[..., :6, :]
        by_after[..., :6, self.layout["pose"]] = se3.left_jacobian_inverse(moved)
        by_after[..., 6:, self.layout["speed"]] = np.eye(6)
        return Residual(error, by_before, by_after)

    def begin(self, values, inputs):
        return values["speed"]

    def imu_twist(self, before, after, interval):
        return after["speed"]

    def way_m(self, values, interval):
        return np.linalg.norm(values["speed"][..., :3], axis=-1) * np.asarray(interval.tau_s)


ACCELERATION = np.repeat([3.0, 1.0], 3)


def test_a_process_from_outside_finds_the_velocity_in_filter_and_smoother():
    world = ekfslam.open_sequence("builtin:city?frames=40&outlier_fraction=0&seed=3")
    speed = Speed(np.repeat([10.0, 1.0], 3))
    model = model_of(
        Rig(world.camera, world.T_cam_imu, world.noise),
        world.noise,
        se3.inverse(world.initial_T_world_imu),
        1e-6 * np.eye(6),
        blocks=[speed],
        make_process=lambda layout, noise: ConstantSpeed(layout, ACCELERATION),
    )
    ekf = JointEKF(model, FilterConfig(retire="unseen", gate_probability=1.0))
    T, P = [], []
    with one_thread():
        for _ in run_filter(ekf, world):
            T.append(ekf.T_world_imu)
            P.append(ekf.P[:6, :6].copy())
    error = nees(pose_error(np.array(T), world.truth.T_world_imu)[1:], np.array(P)[1:])
    assert 2.0 < error.mean() < 12.0  # 6, were its 39 values of one drive independent
    T_before, T_last = se3.inverse(world.truth.T_world_imu[-2:])
    true = -se3.log(T_last @ se3.inverse(T_before)) / (world.time_s[-1] - world.time_s[-2])
    assert (np.abs(ekf.values["speed"] - true) < 4 * np.sqrt(np.diag(ekf.P)[model.layout["speed"]])).all()
    found = np.sqrt(np.diag(ekf.P)[model.layout["speed"]])
    assert (found < 0.2 * speed.prior_std).all()
    smoothed = posterior_of_log(ekf.log(), model, ekf.landmarks().position_m, PosteriorConfig(kernel="none"))
    behind = nees(pose_error(smoothed.T_world_imu, world.truth.T_world_imu)[1:], smoothed.pose_covariance[1:])
    assert behind.mean() < 12.0  # the world accelerates less than this process allows
    assert np.trace(smoothed.pose_covariance[20]) < 0.9 * np.trace(P[20])
