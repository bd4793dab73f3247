"""How new landmarks enter the state: at once, or after waiting for a second view."""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.filters.estimate import Estimate
from ekfslam.filters.logbook import LogBook
from ekfslam.filters.observing import moment
from ekfslam.filters.retraction import retract
from ekfslam.filters.waiting import Waiting


def start(e: Estimate, log: LogBook, waiting: Waiting | None, frame: int, ids: IntArray, rows: Array) -> BoolArray:
    """Append new landmarks with their full cross-covariance, eq. (5).

    Args:
        e: Grows.
        log: Keeps what initialised them.
        waiting: Those that wait, for a sensor that needs two views.
        frame: Frame index.
        ids, rows: (n,), (n, d) new tracks, distinct from all in the state.

    Returns:
        Which (n,) have a landmark now; the others wait, or see nothing that is in front of the sensor.
    """
    if waiting is not None:
        return _start_after_waiting(e, log, waiting, frame, ids, rows)
    error, now = e.model.track_error, moment(e, e.mean)
    q, has_depth = e.model.observer.inverted(now, rows)
    ids, rows, q = ids[has_depth], rows[has_depth], q[has_depth]
    if len(ids):
        none = np.zeros(len(ids), dtype=np.int64)
        variance = e.sensor.variance(rows) if error is None else error.absolute_variance(none)
        linear = now.linearised_at(e.variant.linear(now.T_imu_world, e.motion.T_predicted))
        positions, G, covariance = e.model.observer.initialise(linear, q, variance)
        e.gaussian.augment(G, covariance)
        _append(e, log, frame, ids, positions, rows, (e.step, rows, variance))
    return has_depth


def _start_after_waiting(
    e: Estimate, log: LogBook, waiting: Waiting, frame: int, ids: IntArray, rows: Array
) -> BoolArray:
    """Append landmarks that two views initialise; their remaining rows are a measurement of the blocks."""
    found = waiting.start(e, ids, rows)
    if found.which.any():
        now, variance = rows[found.which], e.sensor.variance(rows[found.which])
        e.gaussian.augment(found.G, found.covariance)
        views = (found.step, found.rows, variance), (e.step, now, variance)
        _append(e, log, frame, ids[found.which], found.position_m, now, *views)
        solution = e.gaussian.solve_body(found.H, found.residual, np.ones(len(found.residual)), e.step)
        e.gaussian.apply(solution)
        retract(e, solution.done.correction)
    waiting.move_on(e, ids[~found.which], rows[~found.which])
    return found.which


def _append(
    e: Estimate,
    log: LogBook,
    frame: int,
    ids: IntArray,
    positions: Array,
    rows: Array,
    *views: tuple[int, Array, Array],
) -> None:
    """Write new landmarks, whose covariance is there already, into table and log."""
    fresh = np.zeros(len(ids), dtype=np.int64)
    e.table.append(
        id=ids,
        first_frame=fresh + frame,
        last_frame=fresh + frame,
        observations=fresh + len(views),
        log_row=log.started(ids, positions, *views),
        first_step=fresh + e.step,
        position_m=positions,
        initial_m=positions,
    )
    slot = np.arange(len(e.table) - len(ids), len(e.table))
    e.table.observed(slot, e.step, rows, log.last(len(ids)))
