"""How the joint filter keeps its `Log`: frame by frame, from its estimate and its corrections."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from ekfslam.arrays import Array, IntArray
from ekfslam.data.interval import Interval
from ekfslam.errors import PosteriorError
from ekfslam.filters.estimate import Estimate
from ekfslam.filters.log import Log
from ekfslam.filters.prediction import Prediction
from ekfslam.geometry import se3
from ekfslam.models.blocks import PreviousView, Values
from ekfslam.models.process import Measured

# Arrays over observations, pieces of inputs and measurements, by the one that holds their frames.
_OF_FRAMES = {
    "frame": ("frame", "landmark", "previous", "rows", "variance", "position_m"),
    "input_frame": ("input_frame", "input_dt_s", "inputs"),
    "measured_frame": ("measured_frame", *(f"measured_{field.name}" for field in fields(Measured))),
}


@dataclass(frozen=True)
class Accepted:
    """Accepted observations (k) of known landmarks.

    Args:
        landmark, previous: (k,) rows of the log; places of the observations in the frame before, or -1.
        rows, variance: (k, d) measured rows; variances of these or of their differences.
        position_m: (k, 3) landmarks at the linearisation.
    """

    landmark: IntArray
    previous: IntArray
    rows: Array
    variance: Array
    position_m: Array


class LogBook:
    """Grows a `Log` frame by frame; arrays are joined when the log is read.

    Args:
        start: Filter before the first frame.
    """

    def __init__(self, start: Estimate) -> None:
        self._first_estimates = start.variant.first_estimates
        self._initial_covariance = start.gaussian.body_covariance
        self._frames: list[dict] = []
        self._parts: defaultdict[str, list] = defaultdict(list)
        self._landmarks = self._observations = 0
        self._is_dropped = False
        # Empty parts, for a log to which nothing is added.
        none, no_index, no_rows = np.empty(0), np.empty(0, dtype=np.int64), np.empty((0, start.sensor.dimension))
        self.started(no_index, np.empty((0, 3)), (0, no_rows, no_rows))
        self._measured(Measured(no_index, none, none, np.empty(0, dtype=bool)))
        self._add(input_frame=no_index, input_dt_s=none, inputs=np.empty((0, 6)))
        self._add_frame(start, start.coordinates)

    def _add(self, **arrays: NDArray) -> None:
        for name, value in arrays.items():
            self._parts[name].append(value)

    def mark(self) -> tuple[int, dict, dict[str, int], int, int]:
        """Return a mark of this moment for `restore`."""
        lengths = {name: len(parts) for name, parts in self._parts.items()}
        return len(self._frames), dict(self._frames[-1]), lengths, self._landmarks, self._observations

    def restore(self, mark: tuple[int, dict, dict[str, int], int, int]) -> None:
        """Forget everything since a mark."""
        frames, last, lengths, self._landmarks, self._observations = mark
        del self._frames[frames:]
        self._frames[-1] = last
        for name, length in lengths.items():
            parts = self._parts[name]
            if len(parts) < length:  # joined since then, see `since`
                parts[:] = [np.concatenate(parts)[: self._landmarks]]
            del parts[length:]

    def predicted(self, now: Estimate, interval: Interval, found: Prediction) -> None:
        """Add a frame, reached by a prediction over an interval."""
        if found.measured is not None:
            self._measured(found.measured)
        frame = np.full(len(interval.dt_s), now.step)
        self._add(input_frame=frame, input_dt_s=interval.dt_s, inputs=interval.inputs)
        self._add_frame(now, found.departed)

    def _add_frame(self, now: Estimate, departed: Array) -> None:
        T, coordinates, motion = now.T_imu_world, now.coordinates.copy(), now.motion
        self._frames.append(
            {
                "tau_s": motion.tau_s,
                "is_gap": motion.interval.is_gap,
                "doubt": motion.interval.doubt,
                "way_m": motion.way_m,
                "seen_twist": now.imu_twist,
                "T_departed": motion.T_departed,
                "T_predicted": T,
                "T_linear": T,
                "T_linear_before": motion.T_departed,
                "T_updated": T,
                "departed": departed,
                "linear": coordinates,
                "updated": coordinates,
                "curved": now.curved,
            }
        )

    def amend(self, **values: Array | float) -> None:
        """Replace fields of the frame that is being written, by their names in `Log`."""
        self._frames[-1].update(values)

    def _measured(self, rows: Measured) -> None:
        """Add measurements of blocks during the interval to the next frame."""
        self._add(measured_frame=np.full(len(rows.axis), len(self._frames)))
        self._add(**{f"measured_{field.name}": getattr(rows, field.name) for field in fields(rows)})

    def corrected(
        self, now: Estimate, accepted: Accepted, values: Values, imu_twist: Array, coordinates: Array
    ) -> None:
        """Add the correction of this frame, with the values at which it was linearised."""
        T_before = now.motion.T_departed
        if (view := values.get(PreviousView.name)) is not None and now.step:
            T_before = se3.inverse(now.motion.T_cam_imu_before) @ view
        self._observed(
            now.step, accepted.landmark, accepted.rows, accepted.variance, accepted.position_m, accepted.previous
        )
        self.amend(
            doubt=now.motion.interval.doubt,
            seen_twist=imu_twist,
            linear=coordinates.copy(),
            T_linear=values["pose"],
            T_linear_before=T_before,
        )

    def started(self, ids: IntArray, positions_m: Array, *views: tuple[int, Array, Array]) -> IntArray:
        """Add landmarks (n,) and the views that initialised them, and return their rows in the log.

        Each view is a frame, rows (n, d) and variances (n, d).
        """
        self._add(id=ids, first_position_m=positions_m)
        at = np.arange(self._landmarks, self._landmarks + len(ids))
        self._landmarks += len(ids)
        for step, rows, variance in views:
            self._observed(step, at, rows, variance, positions_m, np.full(len(ids), -1))
        return at

    def last(self, count: int) -> IntArray:
        """Return the places of the last observations."""
        return np.arange(self._observations - count, self._observations)

    def _observed(
        self, step: int, landmark: IntArray, rows: Array, variance: Array, position_m: Array, previous: IntArray
    ) -> None:
        frame = np.full(len(landmark), step)
        self._add(frame=frame, landmark=landmark, previous=previous)
        self._add(rows=rows, variance=variance, position_m=position_m)
        self._observations += len(landmark)

    def drop(self) -> None:
        """Drop all but the present frame; there is no log from then on."""
        self._is_dropped = True
        del self._frames[:-1]
        for parts in self._parts.values():
            del parts[1:]

    def log(self) -> Log:
        """Return the log so far; raise `PosteriorError` if a part was dropped."""
        if self._is_dropped:
            raise PosteriorError("the log of a long live run was dropped: see log_frames of LiveEKF")
        return self._log(0, {name: np.concatenate(parts) for name, parts in self._parts.items()})

    def _log(self, first: int, arrays: dict[str, NDArray]) -> Log:
        return Log(
            first_estimates=self._first_estimates,
            has_views=True,
            initial_covariance=self._initial_covariance,
            **{name: np.array([frame[name] for frame in self._frames[first:]]) for name in self._frames[0]},
            **arrays,
        )

    def since(self, first: int, observed: int, landmarks: IntArray) -> tuple[Log, IntArray]:
        """Return the log since a frame, which becomes frame 0, at a cost that does not grow with the log.

        Args:
            first: That frame.
            observed: Frame before which only observations of some landmarks are wanted.
            landmarks: Rows (n,) of these; they are included even if they are not observed.

        Returns:
            The log, and the rows (m,) of its landmarks in the whole log, ascending.
        """
        arrays = {}
        for key, names in _OF_FRAMES.items():
            parts, begin = self._parts[key], first if key == "frame" else first + 1
            count = next((n for n, part in enumerate(reversed(parts)) if len(part) and part[0] < begin), len(parts))
            for name in names:
                arrays[name] = np.concatenate([self._parts[name][0][:0], *self._parts[name][len(parts) - count :]])
            arrays[key] = arrays[key] - first
        before = self._observations - len(arrays["frame"])
        wanted = (arrays["frame"] >= observed - first) | np.isin(arrays["landmark"], landmarks)
        place = np.append(np.where(wanted, np.cumsum(wanted) - 1, -1), -1)
        arrays["previous"] = place[np.maximum(arrays["previous"] - before, -1)]
        arrays |= {name: arrays[name][wanted] for name in _OF_FRAMES["frame"]}
        rows, place = np.unique(np.concatenate([arrays["landmark"], landmarks]), return_inverse=True)
        arrays["landmark"] = place[: len(arrays["landmark"])]
        for name in ("id", "first_position_m"):
            self._parts[name] = [np.concatenate(self._parts[name])]
            arrays[name] = self._parts[name][0][rows]
        return self._log(first, arrays), rows
