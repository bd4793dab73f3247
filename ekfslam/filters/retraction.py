"""Equations (7) and (7'): the effect of a correction on blocks, landmarks and their covariance; `retract` writes."""

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
    """The mean after a correction.

    Args:
        mean: The mean after the correction.
        awake, asleep: Slots of landmarks corrected in the camera, eq. (7'), and in world, eq. (7).
        in_image: (k,) which of the former count by their images.
        before: View of the former before the correction; None: no camera.
    """

    mean: Mean
    awake: IntArray
    asleep: IntArray
    in_image: BoolArray
    before: View | None


def retract(e: Estimate, correction: Array) -> None:
    """Correct the mean by (b+3n,), and re-express the covariance in the errors after it, eq. (7) and (7')."""
    moved = retracted(e, correction)
    e.variant.transport(e.gaussian, e.model, e.values, moved.mean.values, _changes(e, moved, e.variant.turned))
    e.values, e.table.position_m = moved.mean.values, moved.mean.position_m
    e.coordinates = e.coordinates + correction[: len(e.coordinates)]


def retracted(e: Estimate, correction: Array) -> Moved:
    """Return the mean after a correction (b+3n,), which leaves the estimate unchanged.

    Correct active landmarks in the last updated camera, eq. (7'), and dormant ones in the world frame: far from the
    camera, image coordinates lose precision.
    """
    x, d = parts(e, correction)
    after, positions = e.model.retract(e.values, correction), e.table.position_m.copy()
    camera, asleep = _camera(e), e.table.asleep.astype(bool)
    awake, others = np.flatnonzero(~asleep), np.flatnonzero(asleep)
    if camera is None:
        awake, others = others[:0], np.arange(len(positions))
    before, in_image = None, np.empty(0, dtype=bool)
    if len(others):  # eq. (7)
        positions[others] = e.variant.retract_landmarks(e.T_imu_world, positions[others], correction[:6], d[others])
    if camera is not None:  # eq. (7')
        before = camera.view(e.values, positions[awake], e.values[camera.pose], positions[awake])
        positions[awake], in_image = camera.retract(before, after, x, d[awake])
    return Moved(Mean(after, positions, e.imu_twist), awake, others, in_image, before)


def carried_back(e: Estimate, rows: Rows, moved: Moved) -> Rows:
    """Return rows that were taken after a correction, in the errors before it."""
    change = _changes(e, moved, e.variant.derivative)[0].only(rows.slot)
    return e.variant.carry_back(rows, e.model, e.values, moved.mean.values, change)


def parts(e: Estimate, correction: Array) -> tuple[Array, Array]:
    """Return the parts of a correction for the leading blocks (seen,) and for the landmarks (n, 3)."""
    return correction[: e.gaussian.seen], correction[e.gaussian.body :].reshape(-1, 3)


def _camera(e: Estimate) -> CameraCoordinates | None:
    """Return the image coordinates of the last updated camera; None: landmarks count by their positions in world."""
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
