"""The log: everything the joint filter conditioned on, and where it linearised it.

With the log the posterior over *all* poses and landmarks can be rebuilt at any time (`ekfslam.smoother.posterior`),
though the filter itself carries only what is in view. It is flat arrays, a few numbers an observation.

*Coordinates* (body,) of the state blocks are sums of corrections, in the columns of the layout. Those of a pose count
from where it was predicted; those of blocks that are vectors are their values.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.geometry import se3


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
        frame: (K,) frame of each accepted observation; ascending but for views that waited for a second one.
        landmark: (K,) row of the landmark in ``id``. Its first observation is the one that initialised it.
        previous: (K,) observation of the same landmark in the frame before, from which this one is a difference; -1
            where it stands alone.
        rows: (K, d) what was measured: the sensor's rows.
        variance: (K, d) variances of the rows, or of their differences.
        position_m: (K, 3) where the landmark was linearised, in world.
        is_gap: (T,) whether the velocities that led to a frame were interpolated across a gap.
        velocity_frame: (N,) frame of each scalar measurement of velocities, where these are estimated.
        velocity_axis, velocity_value, velocity_std, velocity_is_biased: (N,) see `ekfslam.models.process.Measured`.
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
    velocity_is_biased: BoolArray
    is_gap: BoolArray

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
            is_gap=np.zeros(frames, dtype=bool),
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
