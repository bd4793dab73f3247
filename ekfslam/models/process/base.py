"""The interface of a process model: how the state gets from one frame to the next.

A process moves its *own* blocks: the pose, and a velocity or biases if it has them. Its step may depend on all others,
which are constant, clones, or walk by themselves (`StateBlock.transition`). To add a process, write one file with a
subclass, one file for its new blocks, and hand ``make_process`` to `ekfslam.models.build.model_of`.

- A process is built for one layout: ``make_process(layout, noise)``. It keeps no state.
- ``values`` map block names to estimates. The filter takes one `Interval`; the smoother takes all `Intervals` at once,
  with leading dimensions (m, ...).
- A step starts from its own blocks in the frame before, and from walking blocks in the frame that it leads to.
- Errors are those of the blocks (`StateBlock.retract`). The rows of ``Phi`` and ``Q`` are the columns of the blocks
  that a step moves.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.data.inputs import InertialSamples, Velocities
from ekfslam.data.interval import Interval, Intervals
from ekfslam.data.noise import Noise
from ekfslam.models.blocks.base import Layout, Values


@dataclass(frozen=True)
class Step:
    """A step over one interval, or over m of them (then with a leading dimension)."""

    values: Values  # the blocks that it moves, after it, by name; they have p columns
    imu_twist: Array  # (..., 6) velocity [v; w] of the IMU at the end of the step, m/s and rad/s in the IMU frame
    Phi: Array  # (..., p, body) derivative of the errors of these blocks by all errors before the step
    Q: Array  # (..., p, p) covariance of the noise that the step adds; it grows as the square of `Interval.doubt`


@dataclass(frozen=True)
class Residual:
    """The error of steps between states that are not their solution; m intervals."""

    error: Array  # (m, p) own errors of the state after, as seen from the prediction: 0 if it is the prediction
    by_before: Array  # (m, p, body) derivative by the errors of the process's own blocks in the frame before
    # (m, p, body) derivative by the errors of its own blocks, and of all other blocks, in the frame after.
    by_after: Array


@dataclass(frozen=True)
class Measured:
    """Scalar measurements of blocks by inputs, each of one component of the process (an axis of its velocity)."""

    axis: IntArray  # axis, value, std: (n,) components, measured values, and standard deviations
    value: Array
    std: Array
    is_biased: BoolArray  # (n,) whether they come from the recording's own inputs, whose biases are in the state

    @staticmethod
    def concatenate(parts: Iterable[Measured]) -> Measured:
        """Return all measurements of the parts, in their order."""
        parts = list(parts)
        return Measured(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Measured)))


class Process(ABC):
    """A process model for one layout."""

    # Names of the blocks that it moves, the pose first, in the order of the columns of ``Phi`` and ``Q``.
    own: tuple[str, ...] = ("pose",)
    layout: Layout  # columns of all blocks
    takes: type[Velocities] | type[InertialSamples] = Velocities  # kind of the inputs
    started: tuple[str, ...] = ()  # names of the walking blocks that the first inputs start, see `start`
    estimates_velocity: bool = False  # whether the inputs measure velocities in the state
    velocity: str = ""  # name of the block of the velocity, which further sensors can measure, if it is in the state
    measures_departure: bool = False  # whether these measure the state before the step, see `referred`

    @abstractmethod
    def step(self, values: Values, interval: Interval | Intervals, T_linear: Array, first_estimates: bool) -> Step:
        """Return the step over an interval; the pose's error before it is linearised at ``T_linear`` (..., 4, 4).

        With ``first_estimates`` Phi leads from there (FEJ) and not from the estimate.
        """

    @abstractmethod
    def residual(self, before: Values, after: Values, intervals: Intervals) -> Residual:
        """Return the error of steps between estimates (m, ...) before and after each of m intervals."""

    @abstractmethod
    def begin(self, values: Values, inputs: Array) -> Array:
        """Return ``[v; w]`` (6,) of the IMU at the first frame, given the inputs (c,) there."""

    @abstractmethod
    def imu_twist(self, before: Values, after: Values, interval: Interval | Intervals) -> Array:
        """Return ``[v; w]`` (..., 6) of the IMU at the frame after an interval, by corrected estimates, for eq. (9)."""

    @abstractmethod
    def way_m(self, values: Values, interval: Interval | Intervals) -> Array:
        """Return the way (...) driven during an interval, given the values before it."""

    def start(self, values: Values, interval: Interval) -> Step | None:
        """Return the step with which the first inputs start unknown blocks; None: there are none."""
        return None

    def measured(self, interval: Interval, is_first: bool) -> Measured | None:
        """Return the measurements of blocks by the inputs of an interval; None: they are none, see `start`."""
        return None

    def referred(self, measured: Measured, values: Values, interval: Interval) -> Measured:
        """Return measurements by further sensors during an interval as those of the state that `jacobian` is of."""
        return measured

    def jacobian(self, measured: Measured) -> Array:
        """Return H (n, body) of measurements by all blocks, which are vectors: ``value = H x + noise``."""
        if not self.velocity:
            raise NotImplementedError(f"{type(self).__name__} has nothing that further sensors could measure")
        H = np.zeros((len(measured.axis), self.layout.body))
        H[np.arange(len(H)), self.layout[self.velocity].start + measured.axis] = 1.0
        for block in self.layout.coupled("velocity"):
            if (J := block.velocity_offset()) is not None:
                H[:, self.layout[block.name]] = np.where(measured.is_biased[:, None], J[measured.axis], 0.0)
        return H

    @property
    def columns(self) -> IntArray:
        """Columns (p,) of the process's own blocks in the body."""
        return self.layout.columns(self.own)


MakeProcess = Callable[[Layout, Noise], Process]
