"""Equations (7) and (7'): the effect of a correction on blocks, landmarks and their covariance; `retract` writes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.filters.coordinates import CameraPoints, Change, change_in_view, points_in
from ekfslam.filters.estimate import Estimate, Mean
from ekfslam.filters.gaussian import Rows
from ekfslam.filters.observing import camera_of, present
from ekfslam.models.blocks import View


@dataclass(frozen=True)
class Moved:
    """The mean after a correction."""

    mean: Mean  # the mean after the correction
    awake: IntArray  # awake, asleep: slots of landmarks corrected in the view, eq. (7'), and in world, eq. (7).
    asleep: IntArray
    in_image: BoolArray  # (k,) which of the former count by their images
    before: CameraPoints | None  # the former in the view before the correction; None: no view


def retract(e: Estimate, correction: Array) -> None:
    """Correct the mean by (b+3n,), and re-express the covariance in the errors after it, eq. (7) and (7')."""
    moved = retracted(e, correction)
    e.variant.transport(e.gaussian, e.model, e.values, moved.mean.values, _changes(e, moved, e.variant.turned))
    e.values, e.table.position_m = moved.mean.values, moved.mean.position_m
    e.coordinates = e.coordinates + correction[: len(e.coordinates)]


def retracted(e: Estimate, correction: Array) -> Moved:
    """Return the mean after a correction (b+3n,), which leaves the estimate unchanged.

    Correct active landmarks in the last updated view, eq. (7'), and dormant ones in the world frame: far from the
    camera, image coordinates lose precision. The view of the present frame stays that of its blocks.
    """
    x, d = parts(e, correction)
    after, positions = e.model.retract(e.values, correction), e.table.position_m.copy()
    if View.name in after:
        after[View.name] = camera_of(e, Mean(after, positions, e.imu_twist))
    view, asleep = _view(e), e.table.asleep.astype(bool)
    awake, others = np.flatnonzero(~asleep), np.flatnonzero(asleep)
    if view is None:
        awake, others = awake[:0], np.arange(len(positions))
    before, in_image = None, np.empty(0, dtype=bool)
    if len(others):  # eq. (7)
        now = present(e)
        e_theta = -now.T_cam_world[:3, :3].T @ (now.by @ x)[3:]
        positions[others] = e.variant.retract_landmarks(positions[others], e_theta, d[others])
    if view is not None and e.images is not None:  # eq. (7')
        W = e.values[view]
        before = points_in(W, positions[awake], W, positions[awake])
        z = correction[e.model.layout[view]]
        positions[awake], in_image = e.images.retract(before, after[view], z, d[awake])
    return Moved(Mean(after, positions, e.imu_twist), awake, others, in_image, before)


def carried_back(e: Estimate, rows: Rows, moved: Moved) -> Rows:
    """Return rows with the landmarks' errors before a correction, in place of those after it."""
    change = _changes(e, moved, e.variant.derivative)[0].only(rows.slot)
    H_x = rows.H_x.copy()
    H_x[..., change.columns] += rows.H_m @ change.B
    H_m = rows.H_m if change.M is None else rows.H_m @ change.M
    return Rows(rows.slot, H_x, H_m, rows.residual, rows.variance)


def parts(e: Estimate, correction: Array) -> tuple[Array, Array]:
    """Return the parts of a correction for the leading blocks (seen,) and for the landmarks (n, 3)."""
    return correction[: e.gaussian.seen], correction[e.gaussian.body :].reshape(-1, 3)


def _view(e: Estimate) -> str | None:
    """Return the view in which landmarks count by their images; None: they count by their positions in world."""
    return None if e.images is None else e.updated_view


def _changes(e: Estimate, moved: Moved, turned: Callable[[Array, Array], Array]) -> tuple[Change, ...]:
    """Return how a correction changes landmark errors, active landmarks first."""
    positions, after, view = e.table.position_m, moved.mean.values, _view(e)
    others, awake = moved.asleep, moved.awake
    now = present(e)
    in_world = e.variant.change(now.T_cam_world, now.by, others, moved.mean.position_m[others] - positions[others])
    if view is None or moved.before is None:
        return (in_world,)
    W, W_after, before = e.values[view], after[view], moved.before
    positions_after = moved.mean.position_m[awake]
    if e.variant.first_estimates:
        T_first = e.motion.W_predicted if view == View.name else e.motion.W_predicted_before
        initial = e.table.initial_m[awake]
        before = points_in(W, positions[awake], T_first, initial)
        then = points_in(W_after, positions_after, T_first, initial)
    else:
        then = points_in(W_after, positions_after, W_after, positions_after)
    columns = e.model.layout.columns([view])
    return change_in_view(awake, columns, before, then, moved.in_image, turned(W, W_after)), in_world
