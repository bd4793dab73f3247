"""Velocities that move the pose, eq. (1) and (2): as inputs, or as a walk in the state that inputs measure.

An input is ``[v; w]`` (6,), m/s and rad/s. Several inputs in one interval act as one: the constant velocity that leads
to the same pose. The noise is that of one input, however many there are. Biases are subtracted from inputs, and level
velocities are turned into the IMU frame, by the blocks that say so (`StateBlock.velocity_offset`, `turn_velocities`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.interval import Interval, Intervals
from ekfslam.data.noise import Noise, ProcessNoise
from ekfslam.geometry import motion, se3
from ekfslam.models.blocks.base import Layout, StateBlock, Values
from ekfslam.models.blocks.twist import Twist
from ekfslam.models.process.base import Measured, Process, Residual, Step


def velocities(layout: Layout, noise: Noise) -> Process:
    """Return the process of measured velocities: a walk if the block `Twist` is in the state, else plain inputs."""
    process = VelocityWalk if Twist.name in layout else VelocityInputs
    return process(layout, noise.process)


@dataclass(frozen=True)
class VelocityInputs(Process):
    """Measured velocities move the pose."""

    layout: Layout
    noise: ProcessNoise

    def step(self, values: Values, interval: Interval | Intervals, T_linear: Array, first_estimates: bool) -> Step:
        """Return eq. (1) and (2)."""
        tau_s, T = interval.tau_s, values["pose"]
        twist, by = self.imu_velocities(values, mean_velocity(interval), T_linear[..., :3, :3])
        E, G = motion.increment(twist, tau_s), motion.twist_jacobian(twist, tau_s)
        T_next = E @ T
        Phi = -G @ by
        by_pose = motion.error_jacobian(T_next @ se3.inverse(T_linear) if first_estimates else E)
        Phi[..., self.layout["pose"]] += by_pose
        Q = motion.process_noise_by(G, self.noise.pose_std_during(interval.is_gap, interval.doubt))
        return Step({"pose": T_next}, twist, Phi, Q)

    def residual(self, before: Values, after: Values, intervals: Intervals) -> Residual:
        """Return ``log(T_after T_before^-1 E^-1)`` (m, 6) with its derivatives."""
        pose, T, tau_s = self.layout["pose"], before["pose"], intervals.tau_s
        twist, by = self.imu_velocities({**after, "pose": T}, mean_velocity(intervals), T[..., :3, :3])
        E = motion.increment(twist, tau_s)
        error = se3.log(after["pose"] @ se3.inverse(E @ T))
        # d log(exp(e^) exp(a^)) and d log(exp(a^) exp(e^)) by a, at a = 0.
        by_after, by_before = np.zeros((2, *by.shape))
        to_last = se3.left_jacobian_inverse(-error)
        by_all = to_last @ (motion.twist_jacobian(twist, tau_s) @ by)
        by_before[..., pose] = by_all[..., pose] - to_last @ motion.error_jacobian(E)
        by_after[:] = by_all
        by_after[..., pose] = se3.left_jacobian_inverse(error)
        return Residual(error, by_before, by_after)

    def begin(self, values: Values, inputs: Array) -> Array:
        return self.imu_velocities(values, inputs, values["pose"][:3, :3])[0]

    def imu_twist(self, before: Values, after: Values, interval: Interval | Intervals) -> Array:
        """Return the velocity that leads from one pose to the next."""
        moved = se3.log(after["pose"] @ se3.inverse(before["pose"]))
        return -moved / np.asarray(interval.tau_s)[..., None]

    def way_m(self, values: Values, interval: Interval | Intervals) -> Array:
        """Return the way driven, by the measured velocities."""
        speed = np.linalg.norm(mean_velocity(interval)[..., :3], axis=-1)
        return np.asarray(speed * np.asarray(interval.tau_s))

    # --- blocks that velocities depend on -----------------------------------------------------------------------------

    @cached_property
    def _offsets(self) -> tuple[tuple[StateBlock, Array], ...]:
        """Blocks that are added to the inputs, with their derivatives (6, size)."""
        pairs = ((block, block.velocity_offset()) for block in self.layout.coupled("velocity"))
        return tuple((block, J) for block, J in pairs if J is not None)

    def unbiased(self, inputs: Array, values: Values) -> Array:
        """Return inputs (..., 6) less the biases in the state."""
        for block, J in self._offsets:
            inputs = inputs - (J @ values[block.name][..., None])[..., 0]
        return inputs

    def _driving(self, values: Values, inputs: Array) -> tuple[Array, Array]:
        """Return the velocities (..., 6) before they are turned, and their derivative (..., 6, body)."""
        by = np.zeros((*np.shape(inputs), self.layout.body))
        for block, J in self._offsets:
            by[..., self.layout[block.name]] = -J
        return self.unbiased(inputs, values), by

    def imu_velocities(self, values: Values, inputs: Array, R_linear: Array) -> tuple[Array, Array]:
        """Return the velocities (..., 6) of the IMU in an interval, and their derivative (..., 6, body).

        Values of the pose are those before the interval; its error is linearised at a rotation (..., 3, 3).
        """
        twist, by = self._driving(values, inputs)
        for block in self.layout.coupled("level"):
            twist, by = block.turn_velocities(twist, by, values, R_linear, self.layout)
        return twist, by


@dataclass(frozen=True)
class VelocityWalk(VelocityInputs):
    """The velocity is the block `Twist`, which walks; the inputs measure it, or only start it."""

    started = (Twist.name,)
    velocity = Twist.name
    estimates_velocity = True

    @cached_property
    def _is_measured(self) -> bool:
        """Whether inputs measure the velocity in every interval, and not only start it."""
        return cast(Twist, self.layout.block(Twist.name)).is_measured

    def _driving(self, values: Values, inputs: Array) -> tuple[Array, Array]:
        by = np.zeros((*np.shape(inputs), self.layout.body))
        by[..., self.layout[Twist.name]] = np.eye(6)
        return values[Twist.name], by

    def begin(self, values: Values, inputs: Array) -> Array:
        return super().begin({**values, Twist.name: inputs}, inputs)

    def start(self, values: Values, interval: Interval) -> Step:
        """Return the step in which the first input becomes the velocity."""
        twist = self.unbiased(mean_velocity(interval), values)
        Phi = np.zeros((6, self.layout.body))
        for block, J in self._offsets:
            Phi[:, self.layout[block.name]] = -J
        return Step({Twist.name: twist}, twist, Phi, np.diag(self.noise.twist_std**2))

    def measured(self, interval: Interval, is_first: bool) -> Measured | None:
        if not (is_first or self._is_measured):
            return None
        everything = np.ones(6, dtype=bool)
        return Measured(np.arange(6), mean_velocity(interval), self.noise.twist_std, everything)


def mean_velocity(interval: Interval | Intervals) -> Array:
    """Return the constant velocity (..., 6) that leads to the same pose as the inputs of an interval."""
    if isinstance(interval, Intervals):
        if interval.have_one_piece:
            return interval.inputs
        return np.array([mean_velocity(interval[k]) for k in range(len(interval))]).reshape(len(interval), 6)
    if len(interval.dt_s) == 1:
        return interval.inputs[0]
    E = np.eye(4)
    for step in motion.increment(interval.inputs, interval.dt_s):
        E = step @ E
    return np.asarray(-se3.log(E) / interval.tau_s)
