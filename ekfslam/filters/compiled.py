"""The observation side of a frame in the engine: one call, and what log and books take in of it."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.engine.face import Engine
from ekfslam.engine.report import Gone
from ekfslam.filters.estimate import Estimate
from ekfslam.filters.frame import Outcome
from ekfslam.filters.innovations import FrameInnovations
from ekfslam.filters.landmarks import landmarks_of
from ekfslam.filters.lifecycle import Retired
from ekfslam.filters.logbook import Accepted, LogBook
from ekfslam.filters.observing import corrected_twist


def rest(e: Estimate, engine: Engine, retired: Retired, frame: int, ids: IntArray) -> None:
    """Let landmarks out of view sleep or retire; arguments as of `ekfslam.filters.frame.rest`."""
    e.forget_table()
    if (gone := engine.rest(frame, ids)) is not None:
        _keep(retired, gone)


def update(
    e: Estimate,
    engine: Engine,
    log: LogBook,
    retired: Retired,
    frame: int,
    ids: IntArray,
    measured: Array,
    is_rested: bool,
) -> Outcome:
    """Let landmarks out of view leave, unless `rest` was called; correct with known ones (6), start new ones (5)."""

    needs_twist = e.model.observer.has_time_offset and e.motion.tau_s
    e.forget_table()
    found = engine.update(frame, ids, measured, is_rested, partial(corrected_twist, e) if needs_twist else None)
    for gone in found.retired:
        _keep(retired, gone)
    retired.moving.update(found.moving.tolist())
    if found.doubt != e.motion.interval.doubt:
        e.motion = e.motion.doubted(found.doubt)
    # The log has the rows at their linearisation, then those of new landmarks.
    linear = engine.named(found.linear, ("pose", *e.model.layout.views))
    known, observed = len(found.landmark) - len(found.begun), Accepted(found.landmark, found.previous, found.numbers)
    waited = found.step_before >= 0
    log.corrected(e, observed[:known] if waited else observed, linear, found.linear_twist, found.linear_coordinates)
    log.amend(T_updated=engine.named(found.updated, ("pose",))["pose"], updated=found.updated_coordinates)
    if len(found.begun):
        begun = observed[known:]
        log.entered(found.begun, begun.numbers[:, -3:])
        if waited:
            numbers = np.hstack([found.before, begun.numbers[:, -3:]])
            log.observed(found.step_before, Accepted(begun.landmark, begun.previous, numbers))
            if e.model.track_error is not None:  # the second view counts by its difference from the first
                begun = replace(begun, previous=log.last(len(begun.landmark)))
            log.observed(e.step, begun)
        retired.start_again(found.begun)
    e.values, e.coordinates, e.imu_twist = engine.named(found.values), found.coordinates, found.imu_twist
    innovations = FrameInnovations(*found.innovations)
    return Outcome(found.reason, found.nis, found.log_det, found.dof, found.split, innovations)


def _keep(retired: Retired, gone: Gone) -> None:
    """Keep the last estimates of landmarks that left the state."""
    retired.take(landmarks_of(gone.columns, gone.covariance), gone.columns, gone.may_return)
