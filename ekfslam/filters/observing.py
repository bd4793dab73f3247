"""Equations (3), (4), (9), (10) and (11): the rows of a frame's observations, linearised at a given mean."""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.filters.estimate import Estimate, Mean
from ekfslam.filters.gaussian import Rows
from ekfslam.models.observer import Moment, Seen


def moment(e: Estimate, at: Mean) -> Moment:
    """Return the moment of the present frame."""
    shared = {block.name: at.values[block.name] for block in e.model.observer.shared}
    T = at.values["pose"]
    T_linear = e.variant.linear(T, e.motion.T_predicted)
    return Moment(T, T_linear, e.model.observer.parameters(at.values), at.imu_twist, shared, e.motion.way_m)


def moment_before(e: Estimate, at: Mean) -> Moment:
    """Return the moment of the frame before, from the clones."""
    clones = e.model.layout.clones
    T = at.values[clones["pose"]]
    T_linear = e.variant.linear(T, e.motion.T_predicted_before)
    shared = {block.name: at.values[clones.get(block.name, block.name)] for block in e.model.observer.shared}
    return Moment(T, T_linear, e.model.observer.parameters(at.values), e.motion.imu_twist_before, shared)


def observe(e: Estimate, at: Mean, slot: IntArray, measured: Array) -> tuple[Seen, Rows]:
    """Return the predicted view, eq. (3) and (4), of landmarks at slots (k,), and the rows of measurements (k, d).

    If tracks have errors, eq. (10), an observation that follows another one becomes its difference from it.
    """
    model, table = e.model, e.table
    positions = at.position_m[slot]
    linear = e.variant.linear(positions, table.initial_m[slot])
    error = model.track_error
    is_difference = (table.last_step[slot] == e.step - 1) & (error is not None)
    seen = model.observer.see(moment(e, at), positions, linear, is_difference=is_difference)
    H_x, H_m, residual = seen.H_x, seen.H_m, measured - seen.z
    if error is None:
        return seen, Rows(slot, H_x, H_m, residual, e.sensor.variance(measured))
    variance = error.absolute_variance(e.step - table.first_step[slot])
    follows = np.flatnonzero(is_difference)
    if len(follows):
        before = model.observer.see(
            moment_before(e, at), positions[follows], linear[follows], model.layout.clones["pose"]
        )
        rows_before = table.seen_rows[slot[follows]]
        H_x, H_m = H_x.copy(), H_m.copy()
        residual[follows] -= rows_before - before.z
        H_x[follows] -= before.H_x
        H_m[follows] -= before.H_m
        parallax = e.motion.way_m / np.maximum(seen.q[follows, 2], e.config.min_depth_m)
        variance[follows] = error.step_variance(measured[follows] - rows_before, parallax)
    return seen, Rows(slot, H_x, H_m, residual, variance)
