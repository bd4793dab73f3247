"""Equations (7) and (7'): what a correction makes of blocks and landmarks, and of their covariance.

`retract` alone writes: the mean, its coordinates, and the covariance in the new errors. All else here only reads.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.filters.coordinates import CameraCoordinates, Change, View
from ekfslam.filters.estimate import Estimate, Mean
from ekfslam.filters.gaussian import Rows


@dataclass(frozen=True)
class Moved:
    """The mean that a correction leads to.

    Args:
        mean: The mean after the correction.
        awake, asleep: Slots of landmarks that were moved in the camera, eq. (7'), and of all others, moved in world.
        in_image: Which of the former (k,) by their images.
        before: The camera's view of them before; None: none was moved in it.
    """

    mean: Mean
    awake: IntArray
    asleep: IntArray
    in_image: BoolArray
    before: View | None


def retract(e: Estimate, correction: Array) -> None:
    """Move the mean by a correction (b+3n,), and re-express the covariance where the variant does."""
    moved = retracted(e, correction)
    e.variant.transport(e.gaussian, e.model, e.values, moved.mean.values, _changes(e, moved, e.variant.turned))
    e.values, e.table.position_m = moved.mean.values, moved.mean.position_m
    e.coordinates = e.coordinates + correction[: len(e.coordinates)]


def retracted(e: Estimate, correction: Array) -> Moved:
    """Return the mean after a correction (b+3n,); the estimate stays.

    Active landmarks move in the camera that was updated last, dormant ones in the world frame: far from the camera,
    image coordinates lose precision.
    """
    x, d = parts(e, correction)
    after, positions = e.model.retract(e.values, correction), e.table.position_m.copy()
    camera, asleep = _camera(e), e.table.asleep.astype(bool)
    awake, others = np.flatnonzero(~asleep), np.flatnonzero(asleep)
    if camera is None:
        awake, others = others[:0], np.arange(len(positions))
    before, in_image = None, np.empty(0, dtype=bool)
    if len(others):
        positions[others] = e.variant.retract_landmarks(e.T_imu_world, positions[others], correction[:6], d[others])
    if camera is not None:
        before = camera.view(e.values, positions[awake], e.values[camera.pose], positions[awake])
        positions[awake], in_image = camera.retract(before, after, x, d[awake])
    return Moved(Mean(after, positions, e.imu_twist), awake, others, in_image, before)


def carried_back(e: Estimate, rows: Rows, moved: Moved) -> Rows:
    """Return rows that were taken where a correction leads, in the errors at the estimate."""
    change = _changes(e, moved, e.variant.derivative)[0].only(rows.slot)
    return e.variant.carry_back(rows, e.model, e.values, moved.mean.values, change)


def parts(e: Estimate, correction: Array) -> tuple[Array, Array]:
    """Split a correction into the part that observations depend on (seen,), and that of the landmarks (n, 3)."""
    return correction[: e.gaussian.seen], correction[e.gaussian.body :].reshape(-1, 3)


def _camera(e: Estimate) -> CameraCoordinates | None:
    """Coordinates of landmarks in the last updated camera; None: they count by their positions in world."""
    return None if e.updated_pose is None else e.cameras.get(e.updated_pose)


def _changes(e: Estimate, moved: Moved, turned: Callable[[Array, Array], Array]) -> tuple[Change, ...]:
    """Return how a correction changes landmark errors, active landmarks first."""
    positions, values, after, camera = e.table.position_m, e.values, moved.mean.values, _camera(e)
    others, awake = moved.asleep, moved.awake
    in_world = e.variant.change(e.model, values, others, moved.mean.position_m[others] - positions[others])
    if camera is None or moved.before is None:
        return (in_world,)
    T, T_after, before = values[camera.pose], after[camera.pose], moved.before
    positions_after = moved.mean.position_m[awake]
    if e.variant.first_estimates:
        T_first = e.motion.T_predicted if camera.pose == "pose" else e.motion.T_predicted_before
        initial = e.table.initial_m[awake]
        before = camera.view(values, positions[awake], T_first, initial)
        then = camera.view(after, positions_after, T_first, initial)
    else:
        then = camera.view(after, positions_after, T_after, positions_after)
    return camera.change(awake, before, then, moved.in_image, turned(T, T_after)), in_world
