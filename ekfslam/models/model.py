"""The model: state blocks, process, sensor and noise, shared by filter and smoother."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.interval import Interval
from ekfslam.data.noise import Noise, TrackError
from ekfslam.models.blocks import Layout, StateBlock, Values
from ekfslam.models.observer import Observer
from ekfslam.models.process import MakeProcess, Process, Step
from ekfslam.models.process.velocities import velocities
from ekfslam.models.sensors.base import Sensor


@dataclass(frozen=True)
class Transition:
    """A change of the blocks from one frame towards the next: ``x+ = Phi x + w``."""

    values: dict[str, Array]  # all blocks after it
    Phi: Array  # (body, body)
    Q: Array  # (body, body) covariance of w
    # (6,) velocity of the IMU at its end, if a process moved the pose.
    imu_twist: Array = field(default_factory=lambda: np.zeros(6))

    def after(self, first: Transition) -> Transition:
        """Return this transition with another one before it."""
        Q = self.Phi @ first.Q @ self.Phi.T + self.Q
        return dataclasses.replace(self, Phi=self.Phi @ first.Phi, Q=Q)


@dataclass(frozen=True)
class Model:
    """The blocks of the state, their process, the sensor of landmarks, and all noise."""

    sensor: Sensor
    noise: Noise
    blocks: tuple[StateBlock, ...]  # the pose first
    make_process: MakeProcess = velocities  # maker of the process that moves them
    joint_prior: Array | None = None  # (body, body) covariance before the first frame; None: that of each block

    @cached_property
    def layout(self) -> Layout:
        """Columns of the blocks."""
        return Layout(self.blocks)

    @cached_property
    def process(self) -> Process:
        """The process model."""
        return self.make_process(self.layout, self.noise)

    @cached_property
    def observer(self) -> Observer:
        """The sensor with the blocks that observations of landmarks depend on."""
        return Observer(self.sensor, self.layout)

    @cached_property
    def track_error(self) -> TrackError | None:
        """Error of tracks; None if the sensor's noise is white."""
        error = self.noise.track_error
        return None if error is None else error.of_rows(self.sensor.dimension)

    @cached_property
    def wandering(self) -> tuple[StateBlock, ...]:
        """Blocks that change from frame to frame by themselves, in the order of their columns."""
        return tuple(block for block in self.layout.blocks if block.transition(0.0, 0.0) is not None)

    @cached_property
    def prior_covariance(self) -> Array:
        """(body, body) before the first frame."""
        if self.joint_prior is not None:
            return self.joint_prior
        P = np.zeros((self.layout.body, self.layout.body))
        for block in self.blocks:
            P[self.layout[block.name], self.layout[block.name]] = block.prior_covariance()
        return P

    @cached_property
    def initial_coordinates(self) -> Array:
        """(body,) before the first frame: the values of vectors, and 0 for all other blocks."""
        coordinates = np.zeros(self.layout.body)
        for block in self.layout.blocks:
            if not (block.is_pose or block.is_curved) and (value := block.initial()).shape == (block.size,):
                coordinates[self.layout[block.name]] = value
        return coordinates

    def initial_values(self) -> dict[str, Array]:
        """Return the value of every block before the first frame."""
        return {block.name: block.initial() for block in self.blocks}

    def retract(self, values: Values, correction: Array) -> dict[str, Array]:
        """Return every block after a correction (body,) of all of them."""
        return {
            block.name: block.retract(values[block.name], correction[self.layout[block.name]]) for block in self.blocks
        }

    @cached_property
    def labels(self) -> tuple[tuple[str, ...], tuple[str, ...], Array]:
        """Names, units and prior standard deviations (p,) of reported estimates."""
        blocks = [block for block in self.layout.blocks if block.labels]
        return (
            tuple(label for block in blocks for label in block.labels),
            tuple(unit for block in blocks for unit in block.units),
            np.concatenate([np.empty(0), *(block.reported_prior_std for block in blocks)]),
        )

    def reported(self, values: Values, covariance: Array) -> Array:
        """Return estimates and standard deviations (2, p) by labels; the covariance begins with the body."""
        covariance = covariance[: self.layout.body, : self.layout.body]
        found = [block.reported(values, covariance, self.layout) for block in self.layout.blocks if block.labels]
        return np.array([np.concatenate(part) for part in zip(*found, strict=True)]) if found else np.empty((2, 0))

    # --- from one frame to the next -----------------------------------------------------------------------------------

    def wander(self, values: Values, tau_s: float, way_m: Array) -> Transition | None:
        """Return the transition of walking blocks, and of clones, if there are any."""
        layout, moved = self.layout, dict(values)
        if not layout.clones and not self.wandering:
            return None
        Phi, Q = np.eye(layout.body), np.zeros((layout.body, layout.body))
        for name, clone in layout.clones.items():
            at, of = layout[clone], layout[name]
            Phi[at, at], Phi[at, of] = 0.0, np.eye(at.stop - at.start)
            moved[clone] = values[name]
        for block in self.wandering:
            moves = block.transition(tau_s, way_m)
            assert moves is not None
            at, (phi, std) = layout[block.name], moves
            Phi[at, at], Q[at, at] = np.diag(phi), np.diag(std**2)
            moved[block.name] = phi * values[block.name]
        return Transition(moved, Phi, Q)

    def step(self, values: Values, interval: Interval, T_linear: Array, first_estimates: bool) -> Transition:
        """Return the step of the process; arguments are those of `Process.step`."""
        return self.widened(values, self.process.step(values, interval, T_linear, first_estimates))

    def coordinates_after(self, step: Transition, departed: Array) -> Array:
        """Return coordinates (body,) after a step: 0 for the pose, values for other moved blocks, else as before."""
        coordinates = departed.copy()
        for name in self.process.own:
            coordinates[self.layout[name]] = 0.0 if name == "pose" else step.values[name]
        return coordinates

    def widened(self, values: Values, step: Step) -> Transition:
        """Return a step of some blocks as a transition of all blocks."""
        Phi, Q = np.eye(self.layout.body), np.zeros((self.layout.body, self.layout.body))
        columns = self.layout.columns(step.values)
        Phi[columns], Q[np.ix_(columns, columns)] = step.Phi, step.Q
        return Transition({**values, **step.values}, Phi, Q, step.imu_twist)
