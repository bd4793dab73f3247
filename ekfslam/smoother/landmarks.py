"""Landmarks alone: how a correction moves them, and where each of them fits best, given all cameras."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ekfslam.arrays import Array, BoolArray
from ekfslam.filters.coordinates import LARGEST_FACTOR, is_in_image
from ekfslam.geometry import se3
from ekfslam.models.sensors.base import Sensor
from ekfslam.smoother.observations import ObservationFactors
from ekfslam.smoother.sparse.normal_equations import sum_by
from ekfslam.smoother.unknowns import State
from ekfslam.smoother.views import Sight

_ROUNDS = 5

Robust = Callable[[Array], tuple[Array, Array]]


def moved_in_image(sensor: Sensor, before: Array, after: Array, positions_m: Array, by: Array) -> Array:
    """Return landmarks (n, 3) moved ``by`` (n, 3), linearly in the image of a moving camera, eq. (7'), if any."""
    q = se3.apply(before, positions_m)
    w = 1.0 / np.where(is_in_image(sensor, q, 0.0), q[:, 2], 1.0)
    ratio = 1.0 - w * by[:, 2]
    in_image = is_in_image(sensor, q, 0.0) & (ratio > 1.0 / LARGEST_FACTOR) & (ratio < LARGEST_FACTOR)
    change, ratio = by - q * (w * by[:, 2])[:, None], np.where(in_image, ratio, 1.0)[:, None]
    moved = np.concatenate([(q[:, :2] + change[:, :2]) / ratio, q[:, 2:] / ratio], axis=1)
    return se3.apply(se3.inverse(after), np.where(in_image[:, None], moved, q + by))


def settled(
    observations: ObservationFactors, state: State, robust: Robust, min_depth_m: float, least_gain: float
) -> State:
    """Return a state with every landmark moved to where it fits best, given all cameras.

    Steps are those of Gauss and Newton, reweighted (``robust``: cost and weight of whitened residuals), for each
    landmark; only those that lower its cost are taken, and none that promises less than ``least_gain``. With landmarks
    settled, steps of the whole problem are far longer. Source: Jeong, Nister, Steedly, Szeliski, Kweon, "Pushing the
    envelope of modern methods for bundle adjustment", PAMI 2012.
    """
    sight = part = observations.at(state)
    if not sight.in_view(min_depth_m).all():
        return state
    cameras, positions = observations.first_cameras(sight.views), state.positions_m.copy()
    cost = _costs(observations, part, positions, robust, min_depth_m)
    active, moved = np.ones(len(positions), dtype=bool), np.zeros(len(positions), dtype=bool)
    for _ in range(_ROUNDS):
        step, gain = _steps(observations, part, active, positions, robust)
        active &= gain > least_gain
        if not active.any():
            break
        own, trial = cameras[active], positions.copy()
        by = np.einsum("nij,nj->ni", own[:, :3, :3], step[active])
        trial[active] = moved_in_image(sight.views.sensor, own, own, positions[active], by)
        part = sight.only(active, trial)
        there = _costs(observations, part, trial, robust, min_depth_m)
        active &= there < cost
        positions[active], cost[active] = trial[active], there[active]
        moved |= active
    if not moved.any():
        return state
    found = replace(state, positions_m=positions)
    sight.take(moved, sight.only(moved, positions))
    observations.remember(found, sight)
    return found


def _costs(o: ObservationFactors, sight: Sight, positions_m: Array, robust: Robust, min_depth_m: float) -> Array:
    """Return the cost (M,) of each landmark; infinite if it is behind a camera that sees it."""
    cost = 0.5 * np.square(o.prior_weight * (o.first_position_m - positions_m)).sum(axis=1)
    for kind, observed in enumerate(sight.batches):
        own = np.where(sight.can_see(kind, min_depth_m), robust(sight.norms_of(kind))[0], np.inf)
        cost += np.bincount(observed.landmark, weights=own, minlength=len(cost))
    return cost


def _steps(
    o: ObservationFactors, sight: Sight, active: BoolArray, positions_m: Array, robust: Robust
) -> tuple[Array, Array]:
    """Return the step (M, 3) of each active landmark by its own normal equations, and the decrease (M,) it promises."""
    equations = np.zeros((len(active), 3, 4))
    equations[..., :3] = (o.prior_weight**2 + 1e-12) * np.eye(3)
    equations[..., 3] = o.prior_weight**2 * (o.first_position_m - positions_m)
    for kind, observed in enumerate(sight.batches):
        J, r = sight.by_landmark[kind], sight.residuals[kind]
        weighted = robust(sight.norms_of(kind))[1][:, None, None] * J
        both = weighted.swapaxes(1, 2) @ np.concatenate([J, r[..., None]], axis=2)
        equations += sum_by(observed.landmark, len(active), both)
    step, gain = np.zeros((len(active), 3)), np.zeros(len(active))
    own = equations[active]
    step[active] = np.linalg.solve(own[..., :3], own[..., 3:])[..., 0]
    gain[active] = 0.5 * (step[active] * own[..., 3]).sum(axis=1)
    return step, gain
