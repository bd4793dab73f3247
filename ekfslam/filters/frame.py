"""The observation side of a frame in the reference filter: eq. (3) to (7) and (10), on one page."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.filters import consensus, lifecycle
from ekfslam.filters.correction import Correction
from ekfslam.filters.estimate import Estimate
from ekfslam.filters.innovations import FrameInnovations
from ekfslam.filters.lifecycle import Retired
from ekfslam.filters.logbook import Accepted, LogBook
from ekfslam.filters.observing import look_again
from ekfslam.filters.reports import missed
from ekfslam.filters.retraction import retract
from ekfslam.filters.starting import Waiting, start
from ekfslam.models.blocks import View
from ekfslam.models.sensors.base import ACCEPTED, DISPARITY, MOVING, WAITING


@dataclass(frozen=True)
class Outcome:
    """Outcome of a frame's observations; arguments are those of `ekfslam.filters.reports.FrameReport`."""

    reason: IntArray
    nis: float
    log_det: float  # log det S of the accepted rows
    dof: int
    split: IntArray
    innovations: FrameInnovations


def rest(e: Estimate, retired: Retired, frame: int, ids: IntArray) -> None:
    """Let landmarks out of view sleep or retire."""
    out = lifecycle.out_of_view(e.table, ids, frame, e.config.retire_after or 1)
    limit = None if e.config.retire == "never" else e.config.dormant or 0
    asleep = lifecycle.at_rest(out, e.table, limit)
    stay = ~out | asleep
    _retire(e, retired, ~stay, may_return=True)
    e.table.asleep[:] = asleep[stay]


def update(
    e: Estimate, log: LogBook, retired: Retired, waiting: Waiting | None, frame: int, ids: IntArray, measured: Array
) -> Outcome:
    """Correct with known landmarks (6), start new ones (5); landmarks out of view have left, see `rest`.

    ``waiting`` are tracks that wait for a second view, if the sensor needs two. Further arguments are those of
    `ekfslam.filters.joint.JointEKF.update`.
    """
    # 1. Screen observations that cannot be used at all.
    rows = e.sensor.rows(measured)
    reason = e.sensor.screen(measured, e.config.min_depth_m)
    if known_to_move := retired.moving.intersection(ids.tolist()):
        reason[np.isin(ids, list(known_to_move))] = MOVING
    # 2. Correct with known landmarks: solve eq. (6) for rows (3), (4), (10), then apply (6), (7) and (7').
    slot, is_known = e.table.lookup(ids)
    known = np.flatnonzero(is_known & (reason == ACCEPTED))
    found = consensus.correct(e, frame, slot[known], rows[known])
    _take(e, log, found, frame)
    reason[known] = found.verdict
    e.table.misses[slot[known[missed(found.verdict)]]] += 1
    # 3. Retire tracks that move for good, and start tracks that jumped again.
    split = _split(e, retired, slot[known[found.verdict == MOVING]])
    new = (~is_known & (reason == ACCEPTED)) | np.isin(ids, split)
    reason[new] = ACCEPTED
    log.amend(T_updated=e.T_imu_world, updated=e.coordinates)
    # 4. Start new landmarks, eq. (5), or let them wait.
    enter = start if waiting is None else waiting.start
    started = enter(e, log, frame, ids[new], rows[new])
    if not found.dof:  # no update; but if every active landmark is new, its image coordinates refer to this view
        first_step = e.table.first_step[e.table.asleep == 0]
        e.updated_view = View.name if len(first_step) and (first_step == e.step).all() else None
    retired.start_again(ids[new][started])
    reason[np.flatnonzero(new)[~started]] = DISPARITY if waiting is None else WAITING
    return Outcome(reason, found.done.nis, found.done.log_det, found.dof, split, found.innovations)


def _take(e: Estimate, log: LogBook, found: Correction, frame: int) -> None:
    """Condition the covariance, eq. (6), and the mean, eq. (7), on a correction; count its observations."""
    if found.gaussian is not None:
        e.gaussian = found.gaussian
        e.motion = e.motion.doubted(found.doubt)
    slot, linear = found.slot, found.linear
    follows = (e.table.last_step[slot] == e.step - 1) & (e.model.track_error is not None)
    previous = np.where(follows, e.table.last_observation[slot], -1)
    numbers = np.hstack([found.measured, found.variance, linear.position_m[slot]])
    accepted = Accepted(e.table.log_row[slot], previous, numbers)
    log.corrected(e, accepted, linear.values, linear.imu_twist, found.coordinates)
    e.table.observed(found.slot, e.step, found.measured, log.last(len(found.slot)))
    correction = found.done.correction
    if found.solution is not None:
        e.gaussian.apply(found.solution)
    if e.model.observer.has_time_offset:  # the view as the corrected velocity has it
        e.imu_twist = found.linear.imu_twist
        if (E := look_again(e)) is not None:
            correction = np.concatenate([E @ correction[: len(E)], correction[len(E) :]])
    retract(e, correction)
    e.updated_view = View.name if found.dof else e.updated_view
    e.table.accepted(found.slot, frame)


def _retire(e: Estimate, retired: Retired, gone: BoolArray, may_return: bool = False) -> None:
    """Marginalise landmarks (n,): drop their rows and columns, keep their last estimate."""
    if gone.any():
        retired.add(e.table, e.gaussian.landmark_blocks(np.flatnonzero(gone)), gone, may_return)
        e.gaussian.marginalise(~gone)
        e.table.keep(~gone)


def _split(e: Estimate, retired: Retired, moving: IntArray) -> IntArray:
    """Retire landmarks at slots that move, for good, and those that missed too often; return ids of the latter."""
    moves = np.zeros(len(e.ids), dtype=bool)
    moves[moving] = True
    split_after = e.config.misses_to_split(e.model.track_error is not None)
    jumped = (e.table.misses >= split_after) & (split_after > 0) & ~moves
    ids = e.ids[jumped]
    retired.moving.update(e.ids[moves].tolist())
    _retire(e, retired, jumped | moves)
    return ids
