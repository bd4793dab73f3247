"""How the joint filter keeps its `Log`: frame by frame, from its estimate and its corrections."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.data.interval import Interval
from ekfslam.filters.correction import Correction
from ekfslam.filters.estimate import Estimate
from ekfslam.filters.log import Log
from ekfslam.filters.prediction import Prediction
from ekfslam.models.process import Measured

_PER_FRAME = (
    "tau_s",
    "is_gap",
    "way_m",
    "seen_twist",
    "T_departed",
    "T_predicted",
    "T_linear",
    "T_linear_before",
    "T_updated",
    "departed",
    "linear",
    "updated",
    "curved",
)


class LogBook:
    """Grows a `Log` frame by frame; arrays are joined when the log is asked for.

    Args:
        start: What the filter knows before the first frame.
    """

    def __init__(self, start: Estimate) -> None:
        self._first_estimates = start.variant.first_estimates
        self._initial_covariance = start.gaussian.body_covariance
        self._frames: dict[str, list] = {name: [] for name in _PER_FRAME}
        no_index, none, rows = np.empty(0, dtype=np.int64), np.empty(0), np.empty((0, start.sensor.dimension))
        self._lists: dict[str, list] = {
            "id": [no_index],
            "first_position_m": [np.empty((0, 3))],
            "frame": [no_index],
            "landmark": [no_index],
            "previous": [no_index],
            "rows": [rows],
            "variance": [rows],
            "position_m": [np.empty((0, 3))],
            "input_frame": [no_index],
            "input_dt_s": [none],
            "inputs": [np.empty((0, 6))],
            "measured_frame": [no_index],
            "measured_axis": [no_index],
            "measured_value": [none],
            "measured_std": [none],
            "measured_is_biased": [np.empty(0, dtype=bool)],
        }
        self._landmarks = self._observations = 0
        self._add_frame(start, start.coordinates)

    def predicted(self, now: Estimate, interval: Interval, found: Prediction) -> None:
        """Add a frame, reached by a prediction over an interval."""
        if found.measured is not None:
            self._measured(found.measured)
        self._lists["input_frame"].append(np.full(len(interval.dt_s), now.step))
        self._lists["input_dt_s"].append(interval.dt_s)
        self._lists["inputs"].append(interval.inputs)
        self._add_frame(now, found.departed)

    def _add_frame(self, now: Estimate, departed: Array) -> None:
        T, coordinates = now.T_imu_world, now.coordinates.copy()
        values = {
            "tau_s": now.motion.tau_s,
            "is_gap": now.motion.interval.is_gap,
            "way_m": now.motion.way_m,
            "seen_twist": now.imu_twist,
            "T_departed": now.motion.T_departed,
            "T_predicted": T,
            "T_linear": T,
            "T_linear_before": now.motion.T_departed,
            "T_updated": T,
            "departed": departed,
            "linear": coordinates,
            "updated": coordinates,
            "curved": now.curved,
        }
        for name, value in values.items():
            self._frames[name].append(value)

    def amend(self, **values: Array) -> None:
        """Replace fields of the frame that is being written, by their names in `Log`."""
        for name, value in values.items():
            self._frames[name][-1] = value

    def _measured(self, rows: Measured) -> None:
        """Add measurements of blocks during the interval to the next frame."""
        self._lists["measured_frame"].append(np.full(len(rows.axis), len(self._frames["tau_s"])))
        for field in fields(rows):
            self._lists[f"measured_{field.name}"].append(getattr(rows, field.name))

    def corrected(self, now: Estimate, found: Correction) -> None:
        """Add the correction of this frame, before the estimate takes it."""
        table, slot = now.table, found.slot
        follows = (table.last_step[slot] == now.step - 1) & (now.model.track_error is not None)
        previous = np.where(follows, table.last_observation[slot], -1)
        linear, clone = found.linear, now.model.layout.clones.get("pose")
        position_m = linear.position_m[slot]
        self._observed(now.step, table.log_row[slot], found.measured, found.variance, position_m, previous)
        self.amend(
            seen_twist=linear.imu_twist,
            linear=found.coordinates.copy(),
            T_linear=linear.values["pose"],
            T_linear_before=now.motion.T_departed if clone is None else linear.values[clone],
        )

    def started(self, ids: IntArray, positions_m: Array, *views: tuple[int, Array, Array]) -> IntArray:
        """Add landmarks (n,) and the views that initialised them: frame, rows (n, d), variances (n, d).

        Returns:
            Their rows in the log.
        """
        self._lists["id"].append(ids)
        self._lists["first_position_m"].append(positions_m)
        at = np.arange(self._landmarks, self._landmarks + len(ids))
        self._landmarks += len(ids)
        for step, rows, variance in views:
            self._observed(step, at, rows, variance, positions_m, np.full(len(ids), -1))
        return at

    def last(self, count: int) -> IntArray:
        """Places of the last observations."""
        return np.arange(self._observations - count, self._observations)

    def _observed(
        self, step: int, landmark: IntArray, rows: Array, variance: Array, position_m: Array, previous: IntArray
    ) -> None:
        values = {
            "frame": np.full(len(landmark), step),
            "landmark": landmark,
            "previous": previous,
            "rows": rows,
            "variance": variance,
            "position_m": position_m,
        }
        for name, value in values.items():
            self._lists[name].append(value)
        self._observations += len(landmark)

    def log(self) -> Log:
        """Return the log so far."""
        return Log(
            first_estimates=self._first_estimates,
            initial_covariance=self._initial_covariance,
            **{name: np.array(values) for name, values in self._frames.items()},
            **{name: np.concatenate(values) for name, values in self._lists.items()},
        )
