"""A joint filter driven by images and inputs in order, and its predictions from the last image."""

from __future__ import annotations

import copy
import dataclasses
from bisect import bisect_left, bisect_right
from collections import deque

from ekfslam.arrays import Array, IntArray
from ekfslam.data.interval import Interval
from ekfslam.errors import LateError
from ekfslam.filters.admission import LiveCounts
from ekfslam.filters.estimate import Estimate
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.prediction import predict
from ekfslam.filters.reports import FrameReport
from ekfslam.filters.streams import Samples, Velocities
from ekfslam.models.process.velocities import VelocityInputs

_PIECES = 32  # samples after which a prediction is kept


class Driven:
    """A joint filter that processes images in order, and drops inputs that it needs no more.

    ``time_s`` is the stamp of the last image, ``used_s`` that of the inputs that led to it: older ones come too late.
    """

    def __init__(
        self, ekf: JointEKF, inputs: Velocities, history_s: float, log_frames: float, counts: LiveCounts
    ) -> None:
        self.ekf, self._inputs, self._log_frames, self._counts = ekf, inputs, log_frames, counts
        self.time_s: float | None = None
        self.used_s: float | None = None
        self.history = History(inputs, history_s)
        self._frame = 0

    def process(self, t: float, ids: IntArray, measured: Array) -> FrameReport:
        """Predict to an image and update by it; if the update fails, the prediction remains."""
        counts, frame = self._counts, self._frame
        if (begin := self.time_s) is None:
            inputs, is_held = self._inputs.at(t)
            self.ekf.begin(inputs)
        else:
            interval, is_held = self._inputs.during(begin, t)
            self.ekf.predict(_distrusted(interval, is_held))
            counts.gaps += interval.is_gap
        counts.held += is_held
        # From here on the filter is at the new stamp, whatever comes.
        self.time_s, self._frame = t, frame + 1
        self.used_s = t if is_held or (used := self._inputs.driving(t)) is None else used
        try:
            report = self.ekf.update(frame, ids, measured)
        finally:
            self.history.add(t, self.ekf.without_landmarks())
            if self._frame % self._log_frames == 0 and not self.ekf.needs_log:
                self.ekf.drop_log()
                counts.log_drops += 1
        counts.taken_in += 1
        return report


class History:
    """Estimates after the last images, and predictions from them, whose cost is amortised over the inputs.

    Velocities since the last image are joined to one. Predictions by samples go on from those kept after every 32.
    Estimates are kept for ``history_s`` before the last image.
    """

    def __init__(self, inputs: Velocities, history_s: float) -> None:
        self._inputs, self._history_s = inputs, history_s
        self._past: deque[tuple[float, Estimate]] = deque()
        self._kept: list[tuple[float, Estimate]] = []  # the last image, and predictions from it

    def add(self, time_s: float, then: Estimate) -> None:
        """Add the estimate after an image, later than all others."""
        self._past.append((time_s, then))
        while self._past[0][0] < time_s - self._history_s:
            self._past.popleft()
        self._kept = [(time_s, then)]
        self._inputs.forget(self._past[0][0])

    def arrived(self, t: float) -> None:
        """Forget predictions that inputs with this stamp change; predict further if many have arrived."""
        while len(self._kept) > 1 and self._kept[-1][0] > t:
            del self._kept[-1]
        if self._kept and isinstance(self._inputs, Samples):
            self._advanced(self._inputs.stamps[-1])
        elif self._kept:
            self._inputs.join(self._kept[0][0])

    def at(self, t: float) -> tuple[Estimate, bool]:
        """Return the estimate without landmarks at a stamp, and whether it is extrapolated; `LateError` if too old."""
        at = bisect_right(self._past, t, key=lambda past: past[0]) - 1
        if at < 0:
            raise LateError("pose", t, self._past[0][0] if self._past else None)
        begin, then = self._past[at]
        if t == begin:
            return then, False
        during = self._inputs.during
        if at == len(self._past) - 1:
            if isinstance(self._inputs, Samples):
                begin, then = self._advanced(t)
            elif isinstance(then.model.process, VelocityInputs):
                during = self._inputs.joined
        interval, is_held = during(begin, t)
        return _predicted(then, interval, is_held), is_held

    def _advanced(self, t: float) -> tuple[float, Estimate]:
        """Return the last kept prediction before a stamp, and keep more of them until there."""
        stamps = self._inputs.stamps
        last = bisect_left(stamps, t)
        while (i := bisect_right(stamps, self._kept[-1][0]) + _PIECES - 1) < last:
            begin, then = self._kept[-1]
            self._kept.append((stamps[i], _predicted(then, *self._inputs.during(begin, stamps[i]))))
        return self._kept[bisect_right(self._kept, t, key=lambda kept: kept[0]) - 1]


def _predicted(then: Estimate, interval: Interval, is_held: bool) -> Estimate:
    """Return an estimate without landmarks after an interval."""
    after = then.without_landmarks()
    predict(after, _distrusted(interval, is_held), None)
    return after


def _distrusted(interval: Interval, is_held: bool) -> Interval:
    """Return an interval with the noise of a gap if its inputs are extrapolated."""
    return dataclasses.replace(interval, is_gap=True) if is_held else interval


def copied(ekf: JointEKF) -> JointEKF:
    """Return a copy of a new filter, with the same model."""
    return copy.deepcopy(ekf, {id(ekf.model): ekf.model, id(ekf.config): ekf.config})
