"""A second source of velocities, such as wheels beside an IMU: other rate, other noise, some axes only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array
from ekfslam.errors import ConfigError
from ekfslam.models.process import Measured
from ekfslam.models.vehicle import AXES


@dataclass(frozen=True)
class VelocitySource:
    """Measurements of a velocity in the state: ``z = twist[axes] + noise``, at stamps of their own.

    Each measures the mean velocity of the interval between frames that its stamp lies in, ``(t[k-1], t[k]]``. The state
    holds it in the block `Twist`, or in the block `Velocity` of inertial samples, which takes linear axes only.
    """

    time_s: Array  # (n,) ascending stamps, on the clock of the recording
    axes: tuple[str, ...]  # which of `AXES` are measured, a of them
    value: Array  # (n, a) measurements, m/s or rad/s, in the frame of the recording's velocities
    std: Array  # (a,) their standard deviations
    is_biased: bool = False  # whether blocks of biases, such as `TwistBias`, are in them

    def __post_init__(self) -> None:
        unknown = [axis for axis in self.axes if axis not in AXES]
        if unknown or not self.axes:
            raise ConfigError(f"axes of a velocity source must be among {', '.join(AXES)}, found {self.axes}")
        n, a = len(self.time_s), len(self.axes)
        if np.shape(self.value) != (n, a) or np.shape(self.std) != (a,):
            raise ConfigError(
                f"{n} stamps, {a} axes, but values of shape {np.shape(self.value)}, std of {np.shape(self.std)}"
            )
        if not np.isfinite(self.value).all() or not (np.diff(self.time_s) > 0).all():
            raise ConfigError("a velocity source needs finite values and ascending stamps")
        if not (np.asarray(self.std) > 0).all():
            raise ConfigError(f"standard deviations of a velocity source must be positive, found {self.std}")

    def during(self, begin_s: float, end_s: float) -> Measured | None:
        """Return its measurements with stamps in ``(begin_s, end_s]``; None if there are none."""
        first, last = np.searchsorted(self.time_s, (begin_s, end_s), side="right")
        if first == last:
            return None
        axis = np.tile([AXES.index(name) for name in self.axes], last - first)
        std = np.tile(np.asarray(self.std, dtype=float), last - first)
        return Measured(axis, np.ravel(self.value[first:last]), std, np.full(len(axis), self.is_biased))

    def along(self, other: VelocitySource | None) -> VelocitySource | Both:
        """Return both sources as one."""
        return self if other is None else Both(self, other)


@dataclass(frozen=True)
class Both:
    """Two sources of velocities as one."""

    first: VelocitySource
    second: VelocitySource

    def during(self, begin_s: float, end_s: float) -> Measured | None:
        """Return the measurements of both, see `VelocitySource.during`."""
        found = (source.during(begin_s, end_s) for source in (self.first, self.second))
        parts = [part for part in found if part is not None]
        return Measured.concatenate(parts) if parts else None
