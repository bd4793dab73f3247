"""How the joint filter keeps its `Log`: frame by frame, from its estimate and its corrections."""

from __future__ import annotations

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

# Arrays over observations, pieces of inputs and measurements; the first one holds their frames.
_OF_FRAMES = {
    "observed": ("frame", "landmark", "previous", "numbers"),
    "driven": ("input_frame", "input_dt_s", "inputs"),
    "measured": ("measured_frame", *(f"measured_{field.name}" for field in fields(Measured))),
}
_NUMBERS = ("rows", "variance", "position_m")  # of observations, side by side
_OF_LANDMARKS = ("id", "first_position_m")
_ONE = np.eye(4)


@dataclass(frozen=True)
class Accepted:
    """Accepted observations (k).

    Args:
        landmark, previous: (k,) rows of the log; places of the observations in the frame before, or -1.
        numbers: (k, 2d+3) measured rows (d), their variances or those of their differences (d), and the landmark at the
            linearisation (3).
    """

    landmark: IntArray
    previous: IntArray
    numbers: Array

    def __getitem__(self, some: slice) -> Accepted:
        return Accepted(self.landmark[some], self.previous[some], self.numbers[some])


class LogBook:
    """Grows a `Log` frame by frame, from a filter before its first frame; arrays are joined when the log is read."""

    def __init__(self, start: Estimate) -> None:
        self._first_estimates = start.variant.first_estimates
        self._initial_covariance = start.gaussian.body_covariance
        self._frames: list[dict] = []
        # Parts of the arrays over frames, each with its frame; and of those over landmarks.
        self._parts: dict[str, list[tuple]] = {name: [] for name in _OF_FRAMES}
        self._begun: list[tuple[IntArray, Array]] = []
        self._landmarks = self._observations = 0
        self._is_dropped = False
        # Empty parts, for a log to which nothing is added.
        none, no_index, no_rows = np.empty(0), np.empty(0, dtype=np.int64), np.empty((0, start.sensor.dimension))
        self.started(no_index, np.empty((0, 3)), (0, no_rows, no_rows))
        self._measured(Measured(no_index, none, none, np.empty(0, dtype=bool)))
        self._parts["driven"].append((0, none, np.empty((0, 6))))
        self._add_frame(start, start.coordinates)

    def mark(self) -> tuple[int, dict, dict[str, int], int, int, int]:
        """Return a mark of this moment for `restore`."""
        lengths = {name: len(parts) for name, parts in self._parts.items()}
        last = dict(self._frames[-1])
        return len(self._frames), last, lengths, len(self._begun), self._landmarks, self._observations

    def restore(self, mark: tuple[int, dict, dict[str, int], int, int, int]) -> None:
        """Forget everything since a mark."""
        frames, last, lengths, begun, self._landmarks, self._observations = mark
        del self._frames[frames:]
        self._frames[-1] = last
        for name, length in lengths.items():
            del self._parts[name][length:]
        if len(self._begun) < begun:  # joined since then
            ids, positions_m = self._all_begun()
            self._begun = [(ids[: self._landmarks], positions_m[: self._landmarks])]
        del self._begun[begun:]

    def predicted(self, now: Estimate, interval: Interval, found: Prediction) -> None:
        """Add a frame, reached by a prediction over an interval."""
        if found.measured is not None:
            self._measured(found.measured)
        self._parts["driven"].append((now.step, interval.dt_s, interval.inputs))
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
                "T_linear_before": (_ONE, motion.T_departed),  # T_cam_imu and T_cam_world
                "T_updated": T,
                "departed": departed,
                "linear": coordinates,
                "updated": coordinates,
                "curved": now.curved,
            }
        )

    def amend(self, **values: Array | float | tuple[Array, Array]) -> None:
        """Replace fields of the frame that is being written, by their names in `Log`."""
        self._frames[-1].update(values)

    def _measured(self, rows: Measured) -> None:
        """Add measurements of blocks during the interval to the next frame."""
        self._parts["measured"].append((len(self._frames), *(getattr(rows, field.name) for field in fields(rows))))

    def corrected(
        self, now: Estimate, accepted: Accepted, values: Values, imu_twist: Array, coordinates: Array
    ) -> None:
        """Add the correction of this frame, with the values at which it was linearised."""
        before = _ONE, now.motion.T_departed
        if (view := values.get(PreviousView.name)) is not None and now.step:
            before = now.motion.T_cam_imu_before, view
        self.observed(now.step, accepted)
        self.amend(
            doubt=now.motion.interval.doubt,
            seen_twist=imu_twist,
            linear=coordinates.copy(),
            T_linear=values["pose"],
            T_linear_before=before,
        )

    def started(
        self, ids: IntArray, positions_m: Array, *views: tuple[int, Array, Array], follows: bool = False
    ) -> IntArray:
        """Add landmarks (n,) with views (frame, rows, variances) that initialised them; return rows of the log.

        If ``follows``, a second view counts by its difference from the first.
        """
        at, previous = self.entered(ids, positions_m), np.full(len(ids), -1)
        for step, rows, variance in views:
            self.observed(step, Accepted(at, previous, np.hstack([rows, variance, positions_m])))
            previous = self.last(len(ids)) if follows else previous
        return at

    def entered(self, ids: IntArray, positions_m: Array) -> IntArray:
        """Add landmarks (n,) without their observations, and return their rows in the log."""
        self._begun.append((ids, positions_m))
        self._landmarks += len(ids)
        return np.arange(self._landmarks - len(ids), self._landmarks)

    def observed(self, step: int, accepted: Accepted) -> None:
        """Add observations at a frame."""
        self._parts["observed"].append((step, accepted.landmark, accepted.previous, accepted.numbers))
        self._observations += len(accepted.landmark)

    def last(self, count: int) -> IntArray:
        """Return the places of the last observations."""
        return np.arange(self._observations - count, self._observations)

    def drop(self) -> None:
        """Drop all but the present frame; there is no log from then on."""
        self._is_dropped = True
        del self._frames[:-1], self._begun[1:]
        for parts in self._parts.values():
            del parts[1:]

    def log(self) -> Log:
        """Return the log so far; raise `PosteriorError` if a part was dropped."""
        if self._is_dropped:
            raise PosteriorError("the log of a long live run was dropped: see log_frames of LiveEKF")
        arrays = {name: value for group, parts in self._parts.items() for name, value in _joined(group, parts).items()}
        return self._log(0, arrays | dict(zip(_OF_LANDMARKS, self._all_begun(), strict=True)))

    def _all_begun(self) -> tuple[IntArray, Array]:
        """Return ids and first positions of all landmarks."""
        ids, positions_m = map(np.concatenate, zip(*self._begun, strict=True))
        self._begun = [(ids, positions_m)]
        return ids, positions_m

    def _log(self, first: int, arrays: dict[str, NDArray]) -> Log:
        frames = self._frames[first:]
        columns = {name: np.array([frame[name] for frame in frames]) for name in self._frames[0]}
        T_cam_imu, T_cam_world = np.moveaxis(columns["T_linear_before"], 1, 0)
        columns["T_linear_before"] = se3.inverse(T_cam_imu) @ T_cam_world
        return Log(
            first_estimates=self._first_estimates,
            has_views=True,
            initial_covariance=self._initial_covariance,
            **columns,
            **arrays,
        )

    def since(self, first: int, observed: int, landmarks: IntArray) -> tuple[Log, IntArray]:
        """Return the log since a frame, which becomes frame 0, and the rows (m,) of its landmarks in the whole log.

        Its cost does not grow with the log. Before the frame ``observed``, only observations of some landmarks are
        wanted: their rows (n,) are included even if they are not observed.
        """
        arrays: dict[str, NDArray] = {}
        for group, parts in self._parts.items():
            begin = first if group == "observed" else first + 1
            count = next((n for n, part in enumerate(reversed(parts)) if len(part[1]) and part[0] < begin), len(parts))
            found = _joined(group, [(0, *(array[:0] for array in parts[0][1:])), *parts[len(parts) - count :]])
            found[_OF_FRAMES[group][0]] -= first
            arrays |= found
        before = self._observations - len(arrays["frame"])
        wanted = (arrays["frame"] >= observed - first) | np.isin(arrays["landmark"], landmarks)
        place = np.append(np.where(wanted, np.cumsum(wanted) - 1, -1), -1)
        arrays["previous"] = place[np.maximum(arrays["previous"] - before, -1)]
        arrays |= {name: arrays[name][wanted] for name in ("frame", "landmark", "previous", *_NUMBERS)}
        rows, place = np.unique(np.concatenate([arrays["landmark"], landmarks]), return_inverse=True)
        arrays["landmark"] = place[: len(arrays["landmark"])]
        arrays |= {name: value[rows] for name, value in zip(_OF_LANDMARKS, self._all_begun(), strict=True)}
        return self._log(first, arrays), rows


def _joined(group: str, parts: list[tuple]) -> dict[str, NDArray]:
    """Return the arrays over frames of a group, by name, from its parts."""
    frame, *columns = zip(*parts, strict=True)
    arrays = np.repeat(frame, [len(part) for part in columns[0]]), *map(np.concatenate, columns)
    found: dict[str, NDArray] = dict(zip(_OF_FRAMES[group], arrays, strict=True))
    if group == "observed":
        numbers = found.pop("numbers")
        d = (numbers.shape[1] - 3) // 2
        found |= zip(_NUMBERS, map(np.ascontiguousarray, np.split(numbers, [d, 2 * d], axis=1)), strict=True)
    return found
