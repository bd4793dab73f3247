"""The log: everything the joint filter conditioned on, and where it linearised it.

With the log the posterior over *all* poses and landmarks can be rebuilt at any time (`ekfslam.smoother.posterior`),
though the filter itself carries only what is in view. It is flat arrays, a few numbers an observation.

*Coordinates* (body,) of the state blocks are sums of corrections, in the columns of the layout. Those of a pose count
from where it was predicted; those of blocks that are vectors are their values.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.geometry import se3
from ekfslam.models.model import VelocityRows


@dataclass(frozen=True)
class Log:
    """Motion and accepted observations of the joint filter over T frames, M landmarks and K observations.

    Args:
        first_estimates: Whether the filter took the landmark's place in H at its first estimate (FEJ).
        initial_covariance: (6, 6) of the first pose's error ``xi``.
        twist: (T, 6) measured velocities, m/s and rad/s.
        tau_s: (T,) length of the interval that each twist drove; 0 for the first frame.
        imu_twist: (T, 6) velocities of the IMU that moved the pose, as estimated at the prediction.
        seen_twist: (T, 6) velocities of the IMU by which a time offset counted in the update.
        T_departed: (T, 4, 4) ``T_imu_world`` of the frame before from which the prediction to this frame led.
        T_predicted: (T, 4, 4) ``T_imu_world`` before the update of each frame.
        T_linear: (T, 4, 4) ``T_imu_world`` at which the update was linearised: the predicted one, unless it was
            iterated or a landmark came back.
        T_linear_before: (T, 4, 4) the same of the clone of the frame before.
        T_updated: (T, 4, 4) ``T_imu_world`` after the update.
        departed: (T, body) coordinates of the blocks before the pose moved to this frame: those of the pose are of the
            frame before, those of all other blocks of this frame.
        linear: (T, body) coordinates at which the update was linearised.
        updated: (T, body) coordinates after the update.
        up: (T, 3) direction against gravity in world, where it is estimated, at the prediction; else (T, 0).
        id: (M,) landmark ids in the order of landmark initialisation; an id occurs again where a track was split.
        first_position_m: (M, 3) position at landmark initialisation, in world.
        frame: (K,) frame of each accepted observation, ascending.
        landmark: (K,) row of the landmark in ``id``. Its first observation is the one that initialised it.
        previous: (K,) observation of the same landmark in the frame before, from which this one is a difference; -1
            where it stands alone.
        rows: (K, d) what was measured: the sensor's rows.
        variance: (K, d) variances of the rows, or of their differences.
        position_m: (K, 3) where the landmark was linearised, in world.
        velocity_frame: (N,) frame of each scalar measurement of velocities, where these are estimated.
        velocity_axis, velocity_value, velocity_std, velocity_is_biased: (N,) see `ekfslam.models.model.VelocityRows`.
    """

    first_estimates: bool
    initial_covariance: Array
    twist: Array
    tau_s: Array
    imu_twist: Array
    seen_twist: Array
    T_departed: Array
    T_predicted: Array
    T_linear: Array
    T_linear_before: Array
    T_updated: Array
    departed: Array
    linear: Array
    updated: Array
    up: Array
    id: IntArray
    first_position_m: Array
    frame: IntArray
    landmark: IntArray
    previous: IntArray
    rows: Array
    variance: Array
    position_m: Array
    velocity_frame: IntArray
    velocity_axis: IntArray
    velocity_value: Array
    velocity_std: Array
    velocity_is_biased: Array

    @staticmethod
    def of_poses_alone(**known: Any) -> Log:
        """A log with the fields that archives had before format version 4: of a filter whose one block is the pose."""
        predicted, frames = known["T_predicted"], len(known["tau_s"])

        def coordinates(T: Array, reference: Array) -> Array:
            return se3.log(T @ se3.inverse(reference))

        departed = np.concatenate([predicted[:1], known["T_updated"][:-1]])
        updated = coordinates(known["T_updated"], predicted)
        no_index, none = np.empty(0, dtype=np.int64), np.empty(0)
        return Log(
            **known,
            imu_twist=known["twist"],
            seen_twist=known["twist"],
            T_departed=departed,
            T_linear_before=departed,
            departed=np.concatenate([np.zeros((1, 6)), updated[:-1]]),
            linear=coordinates(known["T_linear"], predicted),
            updated=updated,
            up=np.empty((frames, 0)),
            previous=np.full(len(known["frame"]), -1),
            velocity_frame=no_index,
            velocity_axis=no_index,
            velocity_value=none,
            velocity_std=none,
            velocity_is_biased=np.empty(0, dtype=bool),
        )

    @property
    def frames(self) -> int:
        """Number of frames T."""
        return len(self.tau_s)

    @property
    def landmarks(self) -> int:
        """Number of landmarks M."""
        return len(self.id)

    @property
    def observations(self) -> int:
        """Number of accepted observations K."""
        return len(self.frame)


_PER_FRAME = (
    "twist",
    "tau_s",
    "imu_twist",
    "seen_twist",
    "T_departed",
    "T_predicted",
    "T_linear",
    "T_linear_before",
    "T_updated",
    "departed",
    "linear",
    "updated",
    "up",
)


class LogBook:
    """Grows a `Log` frame by frame; arrays are joined when the log is asked for.

    Args:
        first_estimates, initial_covariance: As in `Log`.
        T_imu_world: (4, 4) estimate of the first pose.
        coordinates: (body,) of all blocks before the first frame.
        up: (3,) direction against gravity, or (0,).
        dimension: Rows of an observation.
    """

    def __init__(
        self,
        first_estimates: bool,
        initial_covariance: Array,
        T_imu_world: Array,
        coordinates: Array,
        up: Array,
        dimension: int = 3,
    ) -> None:
        self._first_estimates, self._initial_covariance = first_estimates, initial_covariance
        self._frames: dict[str, list] = {name: [] for name in _PER_FRAME}
        no_index, none = np.empty(0, dtype=np.int64), np.empty(0)
        self._lists: dict[str, list] = {
            "id": [no_index],
            "first_position_m": [np.empty((0, 3))],
            "frame": [no_index],
            "landmark": [no_index],
            "previous": [no_index],
            "rows": [np.empty((0, dimension))],
            "variance": [np.empty((0, dimension))],
            "position_m": [np.empty((0, 3))],
            "velocity_frame": [no_index],
            "velocity_axis": [no_index],
            "velocity_value": [none],
            "velocity_std": [none],
            "velocity_is_biased": [np.empty(0, dtype=bool)],
        }
        self.landmarks = self.observations = 0
        zero = np.zeros(6)
        self.predicted(zero, 0.0, zero, T_imu_world, T_imu_world, coordinates, coordinates, up)

    @property
    def step(self) -> int:
        """Number of the frame that is being written."""
        return len(self._frames["tau_s"]) - 1

    def predicted(
        self,
        twist: Array,
        tau_s: float,
        imu_twist: Array,
        T_departed: Array,
        T_imu_world: Array,
        departed: Array,
        coordinates: Array,
        up: Array,
    ) -> None:
        """A new frame, reached by a prediction; fields as in `Log`."""
        values = {
            "twist": np.asarray(twist, dtype=float),
            "tau_s": tau_s,
            "imu_twist": imu_twist,
            "seen_twist": imu_twist,
            "T_departed": T_departed,
            "T_predicted": T_imu_world,
            "T_linear": T_imu_world,
            "T_linear_before": T_departed,
            "T_updated": T_imu_world,
            "departed": departed,
            "linear": coordinates,
            "updated": coordinates,
            "up": up,
        }
        for name, value in values.items():
            self._frames[name].append(value)

    def amend(self, **values: Array) -> None:
        """Replace fields of the frame that is being written, by their names in `Log`."""
        for name, value in values.items():
            self._frames[name][-1] = value

    def measured(self, rows: VelocityRows) -> None:
        """Measurements of the velocities that lead to the next frame."""
        self._lists["velocity_frame"].append(np.full(len(rows.axis), self.step + 1))
        for field in fields(rows):
            self._lists[f"velocity_{field.name}"].append(getattr(rows, field.name))

    def started(self, ids: IntArray, positions_m: Array) -> IntArray:
        """New landmarks; returns their rows in the log."""
        self._lists["id"].append(ids)
        self._lists["first_position_m"].append(positions_m)
        self.landmarks += len(ids)
        return np.arange(self.landmarks - len(ids), self.landmarks)

    def observed(
        self, landmark: IntArray, rows: Array, variance: Array, position_m: Array, previous: IntArray
    ) -> IntArray:
        """Accepted observations of this frame; returns their places in the log."""
        values = {
            "frame": np.full(len(landmark), self.step),
            "landmark": landmark,
            "previous": previous,
            "rows": rows,
            "variance": variance,
            "position_m": position_m,
        }
        for name, value in values.items():
            self._lists[name].append(value)
        self.observations += len(landmark)
        return np.arange(self.observations - len(landmark), self.observations)

    def log(self) -> Log:
        """The log so far."""
        return Log(
            first_estimates=self._first_estimates,
            initial_covariance=self._initial_covariance,
            **{name: np.array(values) for name, values in self._frames.items()},
            **{name: np.concatenate(values) for name, values in self._lists.items()},
        )
