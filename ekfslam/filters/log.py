"""The log: everything the joint filter conditioned on, and where it linearised it.

From it `ekfslam.smoother.posterior` rebuilds the posterior over *all* poses and landmarks. *Coordinates* (body,) of the
state blocks are sums of corrections, in the columns of the layout: of a pose since its prediction; of a vector, its
value; of a view, ``Y`` times those of its frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.data.interval import Intervals
from ekfslam.models.process.base import Measured
from ekfslam.stored import (
    COUNTS,
    COVARIANCES,
    FLAGS,
    FRAMES,
    NOT_NEGATIVE,
    POSITIVE,
    RIGID,
    attribute,
    index_of,
    stored,
)

_COORDINATES = "see ekfslam.filters.log"
_VELOCITIES = "m/s (0-2), rad/s (3-5)"


def _poses(name: str) -> dict[str, Any]:
    """Return the metadata of poses, a data set of this name."""
    return stored("T row column", "m (translation)", "imu from world", RIGID, name)


@dataclass(frozen=True)
class Log:
    """Motion and accepted observations of the joint filter over T frames, M landmarks and K observations.

    Args:
        first_estimates: Whether the filter took H at first estimates (FEJ).
        initial_covariance: (body, body) of all blocks before the first frame; (6, 6) of the pose in older archives.
        tau_s: (T,) length of the interval that led to each frame; 0 for the first one.
        is_gap: (T,) whether the inputs were interpolated across a gap.
        doubt: (T,) factor of the inputs' standard deviations; above 1 where landmarks contradicted them.
        input_frame: (N,) frame to which each piece of the inputs led, ascending; none led to the first one.
        input_dt_s, inputs: (N,), (N, c) durations and inputs of the pieces, see `ekfslam.data.interval.Interval`.
        way_m: (T,) way driven during the interval.
        seen_twist: (T, 6) velocity of the IMU for a time offset in the update, eq. (9).
        T_departed, T_predicted, T_updated: (T, 4, 4) ``T_imu_world`` before and after the prediction, and after the
            update.
        T_linear, T_linear_before: (T, 4, 4) ``T_imu_world`` of this frame and of the one before (as its view has it) at
            which the update was linearised. They differ from the prediction if the update was iterated or a landmark
            came back.
        departed: (T, body) coordinates before the process moved its own blocks; all others are of this frame.
        linear, updated: (T, body) coordinates at which the update was linearised, and after it.
        curved: (T, v) values at the prediction of blocks whose value is no sum of corrections.
        id: (M,) landmark ids in the order of landmark initialisation; an id occurs again where a track was split.
        first_position_m: (M, 3) position at landmark initialisation, in world.
        frame: (K,) frame of each accepted observation; ascending but for views that waited for a second one.
        landmark: (K,) row of the landmark in ``id``. Its first observation is the one that initialised it.
        previous: (K,) observation in the frame before from which this one is a difference, eq. (10); -1: none.
        rows: (K, d) the sensor's rows.
        variance: (K, d) variances of the rows, or of their differences.
        position_m: (K, 3) landmark position of the linearisation, in world.
        measured_frame: (S,) frame of each scalar measurement of blocks by inputs.
        measured_axis, measured_value, measured_std, measured_is_biased: (S,) see `ekfslam.models.process.Measured`.
        has_views: Whether coordinates have columns of views; older releases cloned pose and jitter instead.
    """

    first_estimates: bool = field(metadata=attribute(bool))
    initial_covariance: Array = field(
        metadata=stored("prior_coordinate prior_coordinate", "squares of the units of the blocks", "imu", COVARIANCES)
    )
    tau_s: Array = field(metadata=stored("T", "s", check=NOT_NEGATIVE, name="tau"))
    is_gap: BoolArray = field(metadata=stored("T", "truth value", check=FLAGS))
    doubt: Array = field(metadata=stored("T", "1", check=POSITIVE))
    input_frame: IntArray = field(metadata=stored("piece", "frame index", check=FRAMES))
    input_dt_s: Array = field(metadata=stored("piece", "s", check=NOT_NEGATIVE, name="input_dt"))
    inputs: Array = field(metadata=stored("piece input", "of the process: m/s and rad/s, or rad/s and m/s^2", "inputs"))
    way_m: Array = field(metadata=stored("T", "m", check=NOT_NEGATIVE, name="way"))
    seen_twist: Array = field(metadata=stored("T u", _VELOCITIES, "imu"))
    T_departed: Array = field(metadata=_poses("T_imu_world_departed"))
    T_predicted: Array = field(metadata=_poses("T_imu_world_predicted"))
    T_linear: Array = field(metadata=_poses("T_imu_world_linear"))
    T_linear_before: Array = field(metadata=_poses("T_imu_world_linear_before"))
    T_updated: Array = field(metadata=_poses("T_imu_world_updated"))
    departed: Array = field(metadata=stored("T B", _COORDINATES, "imu"))
    linear: Array = field(metadata=stored("T B", _COORDINATES, "imu"))
    updated: Array = field(metadata=stored("T B", _COORDINATES, "imu"))
    curved: Array = field(metadata=stored("T U", "those of the blocks", "world"))
    id: IntArray = field(metadata=stored("L", "landmark id", check=COUNTS, name="landmark_id"))
    first_position_m: Array = field(metadata=stored("L xyz", "m", "world", name="first_position"))
    frame: IntArray = field(metadata=stored("K", "frame index", check=FRAMES))
    landmark: IntArray = field(metadata=stored("K", "row of landmark_id", check=index_of("L")))
    previous: IntArray = field(metadata=stored("K", "observation, -1: none", check=index_of("K", least=-1)))
    rows: Array = field(metadata=stored("K d", "px, (uL, v, uR) or (u, v, disparity)", "image"))
    variance: Array = field(metadata=stored("K d", "px^2", "image", POSITIVE))
    position_m: Array = field(metadata=stored("K xyz", "m", "world", name="linear_position"))
    measured_frame: IntArray = field(metadata=stored("measured", "frame index", check=FRAMES))
    measured_axis: IntArray = field(metadata=stored("measured", "component of the process", check=COUNTS))
    measured_value: Array = field(metadata=stored("measured", "of the component", "inputs"))
    measured_std: Array = field(metadata=stored("measured", "of the component", "inputs", NOT_NEGATIVE))
    measured_is_biased: BoolArray = field(metadata=stored("measured", "truth value", check=FLAGS))
    has_views: bool = field(default=False, metadata=attribute(bool))

    @property
    def frames(self) -> int:
        """Number of frames T."""
        return len(self.tau_s)

    @property
    def intervals(self) -> Intervals:
        """The T-1 intervals between frames."""
        start = np.searchsorted(self.input_frame, np.arange(1, self.frames + 1))
        return Intervals(self.tau_s[1:], self.is_gap[1:], start, self.input_dt_s, self.inputs, self.doubt[1:])

    @property
    def measured(self) -> Measured:
        """Measurements of blocks by inputs."""
        return Measured(self.measured_axis, self.measured_value, self.measured_std, self.measured_is_biased)

    @property
    def landmarks(self) -> int:
        """Number of landmarks M."""
        return len(self.id)

    @property
    def observations(self) -> int:
        """Number of accepted observations K."""
        return len(self.frame)
