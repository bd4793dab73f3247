"""The inputs of one interval between two frames, or of many: velocities or inertial samples, one row a piece."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray


@dataclass(frozen=True)
class Interval:
    """Inputs from one frame to the next, in pieces: velocities ``[v; w]`` or mean inertial samples ``[w; f]``."""

    tau_s: float
    dt_s: Array  # (n,) durations of the pieces, in order of time; their sum is tau_s to rounding
    inputs: Array  # (n, c) one row a piece
    is_gap: bool = False  # whether inputs were interpolated across a gap
    doubt: float = 1.0  # factor of the inputs' standard deviations; above 1 where landmarks contradict them

    @staticmethod
    def of_one(inputs: Array, tau_s: float, is_gap: bool = False) -> Interval:
        """Return an interval with one piece, given its inputs (c,)."""
        return Interval(tau_s, np.array([tau_s]), np.asarray(inputs, dtype=float)[None], is_gap)


@dataclass(frozen=True)
class Intervals:
    """Successive intervals as flat arrays: m intervals with N pieces in all."""

    tau_s: Array  # (m,) durations
    is_gap: BoolArray  # is_gap, doubt: (m,) see `Interval`
    start: IntArray  # (m+1,) first piece of each interval, and N
    dt_s: Array  # dt_s, inputs: (N,), (N, c) of the pieces
    inputs: Array
    doubt: Array | float = 1.0

    @property
    def have_one_piece(self) -> bool:
        """Whether each interval has one piece, so that ``inputs`` is (m, c)."""
        return len(self.dt_s) == len(self.tau_s) and bool((np.diff(self.start) == 1).all())

    def __len__(self) -> int:
        return len(self.tau_s)

    def __getitem__(self, index: int) -> Interval:
        pieces = slice(self.start[index], self.start[index + 1])
        doubt = float(np.broadcast_to(self.doubt, self.tau_s.shape)[index])
        is_gap = bool(self.is_gap[index])
        return Interval(float(self.tau_s[index]), self.dt_s[pieces], self.inputs[pieces], is_gap, doubt)
