"""Inputs of a live filter in the order of their stamps: velocities, or inertial samples."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import deque
from statistics import median

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.inputs import GAP_STEPS, linear
from ekfslam.data.interval import Interval
from ekfslam.errors import MissingVelocityError
from ekfslam.geometry import motion, se3

_STEPS = 201  # steps between samples, whose median tells a gap
_MANY = 64  # velocities that are joined at once


class Velocities:
    """Velocities (6,); each holds since the stamp of the one before. Spacing above ``gap_s`` is a gap."""

    def __init__(self, gap_s: float) -> None:
        self.gap_s = gap_s
        self.stamps: list[float] = []
        self._rows: list[Array] = []
        # Motions (4, 4) from `_begin` to the end of each velocity since, from index `_first` on; and gaps until then.
        self._begin: float | None = None
        self._first = 0
        self._joined: list[tuple[Array, bool]] = []

    def has(self, t: float) -> bool:
        """Return whether there are inputs with this stamp."""
        at = bisect_left(self.stamps, t)
        return at < len(self.stamps) and self.stamps[at] == t

    def add(self, row: Array, t: float) -> None:
        """Insert inputs (6,); no others have their stamp."""
        at = bisect_left(self.stamps, t)
        self.stamps.insert(at, t)
        self._rows.insert(at, row)
        del self._joined[max(at - self._first, 0) :]

    def driving(self, t: float) -> float | None:
        """Return the stamp of the inputs that lead to a stamp; None: they have not arrived."""
        at = bisect_left(self.stamps, t)
        return self.stamps[at] if at < len(self.stamps) else None

    def serves(self, t: float, until: float) -> bool:
        """Return whether an image can be processed, since all inputs up to a stamp have arrived."""
        driving = self.driving(t)
        return bool(self.stamps) if driving is None else driving <= until

    def begin_after(self, t: float) -> bool:
        """Return whether the first inputs are too new for a first image with this stamp."""
        return False

    def at(self, t: float) -> tuple[Array, bool]:
        """Return the inputs (6,) at a stamp, and whether they are the last ones, extrapolated."""
        at = min(bisect_left(self.stamps, t), len(self.stamps) - 1)
        return self._rows[at], self.stamps[-1] < t

    def _pieces(self, begin: float, end: float) -> tuple[int, int]:
        """Return the first and the last index of the velocities between two stamps."""
        if not self.stamps:
            raise MissingVelocityError(end)
        stop = min(bisect_left(self.stamps, end), len(self.stamps) - 1)
        return min(bisect_right(self.stamps, begin), stop), stop

    def _step(self, i: int, begin: float) -> tuple[float, bool]:
        """Return the begin of a velocity's piece, and whether it ends a gap."""
        before = self.stamps[i - 1] if i else begin
        return max(begin, before), i > 0 and self.stamps[i] - before > self.gap_s

    def during(self, begin: float, end: float) -> tuple[Interval, bool]:
        """Return the inputs between two stamps, and whether the last ones are extrapolated."""
        first, stop = self._pieces(begin, end)
        is_gap = any(self._step(i, begin)[1] for i in range(first, stop + 1))
        bounds = np.array([begin, *self.stamps[first:stop], end])
        twists = np.array(self._rows[first : stop + 1])
        return Interval(end - begin, np.diff(bounds), twists, is_gap), self.stamps[-1] < end

    def joined(self, begin: float, end: float) -> tuple[Interval, bool]:
        """Return `during` as one velocity that leads to the same pose; the cost is amortised over calls."""
        first, stop = self._pieces(begin, end)
        self.join(begin, stop)
        E, is_gap = self._joined[stop - first - 1] if stop > first else (np.eye(4), False)
        since, ends_gap = self._step(stop, begin)
        twist = self._rows[stop]
        if stop > first:
            twist = -se3.log(motion.increment(twist, end - since) @ E) / (end - begin)
        return Interval.of_one(twist, end - begin, is_gap or ends_gap), self.stamps[-1] < end

    def join(self, begin: float, stop: int | None = None) -> None:
        """Join velocities since a stamp up to an index; None: if many of the complete ones are not joined yet."""
        if begin != self._begin:
            self._begin, self._first, self._joined = begin, bisect_right(self.stamps, begin), []
        known = self._first + len(self._joined)
        least = 1
        if stop is None:
            stop, least = len(self.stamps) - 1, _MANY
        if stop < known + least:
            return
        E, is_gap = self._joined[-1] if self._joined else (np.eye(4), False)
        since, ends_gap = zip(*(self._step(i, begin) for i in range(known, stop)), strict=True)
        steps = motion.increment(np.array(self._rows[known:stop]), np.array(self.stamps[known:stop]) - since)
        for step, ends in zip(steps, ends_gap, strict=True):
            E, is_gap = step @ E, is_gap or ends
            self._joined.append((E, is_gap))

    def forget(self, before: float) -> None:
        """Drop inputs older than a stamp, but keep the newest of them: it marks where the next interval begins."""
        self.drop(max(bisect_right(self.stamps, before) - 1, 0))

    def drop(self, count: int) -> None:
        """Drop some of the oldest inputs, if any."""
        if count > 0:
            del self.stamps[:count], self._rows[:count]
            self._begin = None


class Samples(Velocities):
    """Inertial samples ``[w; f]`` (6,), linear between stamps; gaps exceed ``gap_s``, or three median steps."""

    def __init__(self, gap_s: float) -> None:
        super().__init__(gap_s)
        self._steps: deque[float] = deque(maxlen=_STEPS)

    def add(self, row: Array, t: float) -> None:
        if self.stamps:
            self._steps.append(abs(t - self.stamps[-1]))
        super().add(row, t)

    def serves(self, t: float, until: float) -> bool:
        return self.driving(t) is not None and super().serves(t, until)

    def begin_after(self, t: float) -> bool:
        return bool(self.stamps) and t < self.stamps[0] - self.step_s

    @property
    def step_s(self) -> float:
        """Median of the last steps; 0 before there are two samples."""
        return median(self._steps) if self._steps else 0.0

    def _around(self, begin: float, end: float) -> tuple[Array, Array]:
        """Return stamps (n,) and samples (n, 6) between two stamps, with one more on each side."""
        if not self.stamps:
            raise MissingVelocityError(end)
        part = slice(max(bisect_right(self.stamps, begin) - 1, 0), bisect_left(self.stamps, end) + 1)
        return np.array(self.stamps[part]), np.array(self._rows[part])

    def at(self, t: float) -> tuple[Array, bool]:
        return linear(*self._around(t, t), t), self.stamps[-1] < t

    def during(self, begin: float, end: float) -> tuple[Interval, bool]:
        stamps, rows = self._around(begin, end)
        bounds = np.concatenate([[begin], stamps[(stamps > begin) & (stamps < end)], [end]])
        values = linear(stamps, rows, bounds)
        longest_s = float(np.diff(stamps).max(initial=0.0))
        is_gap = longest_s > min(self.gap_s, GAP_STEPS * self.step_s)
        return Interval(end - begin, np.diff(bounds), 0.5 * (values[1:] + values[:-1]), is_gap), self.stamps[-1] < end
