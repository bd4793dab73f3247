"""Covariance of a trajectory of another program, from the tracks and inputs of the same recording."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

from ekfslam.config import Config
from ekfslam.data.readers.poses import Poses
from ekfslam.data.sequence import Sequence
from ekfslam.data.trajectory import Trajectory, from_left_error
from ekfslam.evaluation.sanity import sanity_attributes
from ekfslam.filters.result import Result
from ekfslam.others import placed_poses
from ekfslam.runner import run
from ekfslam.smoother.given import compared, given_result
from ekfslam.smoother.posterior import posterior

_LENGTH = 0.05  # by which lengths may differ


class Covered(NamedTuple):
    """A trajectory with its covariances."""

    trajectory: Trajectory  # its poses of the body that belong to frames, in its own world, with covariances
    sequence: Sequence  # the frames of the recording from the first of them to the last
    result: Result  # these frames as a result of mode given, aligned with the recording at the first pose


def trajectory_covariance(
    sequence: Sequence, trajectory: Trajectory, config: Config | None = None, name: str = "trajectory"
) -> Covered:
    """Return the covariance of every pose of a trajectory that another program estimated.

    The joint filter and the posterior of the recording give the noise, the covariance P of the best estimate, and the
    difference to the trajectory, see `ekfslam.smoother.given`. The world of the trajectory is arbitrary: it is aligned
    at its first pose, whose error is 0 by definition.

    Args:
        sequence: The recording.
        trajectory: Poses of the body or of the left camera. Poses belong to the frames with the nearest stamps.
        config: Settings of the run.
        name: Name of the trajectory, for messages.

    Raises:
        TruthError: Fewer than three poses belong to frames.
        PosteriorError, IllPosedError: As `ekfslam.posterior`.
    """
    T = trajectory.T_world if trajectory.moving == "body" else trajectory.T_world @ sequence.T_cam_imu
    placed = placed_poses(sequence, Poses(T, trajectory.time_s, ()), name)
    first, last = int(placed.frame[0]), int(placed.frame[-1])
    covered = sequence[first : last + 1]
    full = run(covered, "full", config)
    found = posterior(full)
    given = compared(found, placed.frame - first, placed.T_world_imu)
    result = given_result(full, found, given, name)
    facts: dict[str, int | str] = {"given_poses": len(placed.frame), "given_frames": len(covered)}
    if abs(given.length - 1.0) > _LENGTH:
        line = (
            f"the trajectory is {given.length:.3g} times as long as the estimate from the tracks: its scale is "
            "open, it is in other units, or of another recording"
        )
        facts = {**facts, **sanity_attributes((line,))}
    own = from_left_error(sequence.time_s[placed.frame], placed.T_world_imu, result.covariance[placed.frame - first])
    return Covered(own, covered, dataclasses.replace(result, attributes={**result.attributes, **facts}))
