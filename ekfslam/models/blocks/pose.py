"""The pose, and the clone of the pose before it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array
from ekfslam.geometry import se3
from ekfslam.models.blocks.base import StateBlock


class _PoseBlock(StateBlock):
    size = 6
    is_seen = True
    is_pose = True
    retraction = "pose"

    def retract(self, value: Array, correction: Array) -> Array:
        return se3.exp(correction) @ value


@dataclass(frozen=True)
class Pose(_PoseBlock):
    """``T_imu_world = exp(xi^) T_hat``, moved by the process.

    Args:
        T_imu_world: (4, 4) first pose.
        covariance: (6, 6) covariance of its error.
    """

    T_imu_world: Array
    covariance: Array

    name = "pose"
    per_frame = True

    def initial(self) -> Array:
        return self.T_imu_world

    def prior_covariance(self) -> Array:
        return self.covariance


@dataclass(frozen=True)
class Clone(_PoseBlock):
    """Clone of a pose: it begins as a certain identity, until it takes the pose's place."""

    def initial(self) -> Array:
        return np.eye(4)


@dataclass(frozen=True)
class PreviousPose(Clone):
    """A clone of the pose of the frame before: errors of tracks are differences over two frames, eq. (10).

    It takes the pose's place at every prediction. Source: Roumeliotis and Burdick, "Stochastic cloning", ICRA 2002.
    """

    name = "previous_pose"
    clones = "pose"


@dataclass(frozen=True)
class Anchor(Clone):
    """A clone of the pose from which tracks wait for parallax, see `ekfslam.filters.starting`."""

    name = "anchor"
