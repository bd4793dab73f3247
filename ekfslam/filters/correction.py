"""The correction of one frame: gates, eq. (6), and the iterated update."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.errors import InnovationError
from ekfslam.filters import gates
from ekfslam.filters.estimate import Estimate
from ekfslam.filters.gaussian import Conditioned, Rows
from ekfslam.filters.innovations import FrameInnovations, innovations_of
from ekfslam.geometry import se3
from ekfslam.models.model import Seen
from ekfslam.models.sensors.base import ACCEPTED, BEHIND_CAMERA, GATE, MOVING

# Largest variance of an innovation, in those of the measurement, at which linearising still means anything.
_MOST_BLURRED = 1e8


@dataclass(frozen=True)
class Correction:
    """What a frame's known landmarks say.

    Args:
        done: Correction of the mean, NIS and ``log det S`` of what was accepted.
        dof: Its degrees of freedom.
        verdict: (k,) on each landmark: `ACCEPTED` or a reason code.
        slot, measured, variance: (j,), (j, d), (j, d) of the accepted ones.
        position_m: (j, 3) where they were linearised.
        linear: (body,) coordinates at which the update was linearised.
        T_linear, T_linear_before: (4, 4) poses there, of this frame and of the one before.
        innovations: Those of the accepted ones, of the first iteration.
    """

    done: Conditioned
    dof: int
    verdict: IntArray
    slot: IntArray
    measured: Array
    variance: Array
    position_m: Array
    linear: Array
    T_linear: Array
    T_linear_before: Array
    innovations: FrameInnovations


def correct(e: Estimate, frame: int, slot: IntArray, measured: Array) -> Correction:
    """Eq. (6) with its gates, for landmarks at ``slot`` (k,) with rows (k, d). The covariance is conditioned.

    A landmark must agree with the prediction, and with the prediction as corrected by all *other* landmarks of the
    frame: the first gate is weak while the pose itself is uncertain, the second is not. What the second rejects has
    been used already, and is taken out again. The mean is left to the caller.

    Raises:
        InnovationError: The innovation covariance is not positive definite.
    """
    gate = gates.threshold(e.config.gate_probability, e.sensor.dimension)
    verdict = np.full(len(slot), ACCEPTED)
    seen, rows = e.observe(slot, measured)
    verdict[~e.sensor.in_view(seen.q, e.config.min_depth_m)] = BEHIND_CAMERA
    some, S = _gate_alone(e, frame, rows, seen, verdict, gate)
    innovations = FrameInnovations.none(e.sensor.dimension)
    done = Conditioned(np.zeros(len(e.P)), 0.0, 0.0)
    P_prior = e.P.copy() if e.config.iterations > 1 and len(some) else None
    if len(some):
        if e.model.has_time_offset and e.tau_s:
            e.imu_twist = _seen_twist(e, frame, rows.only(some))
            _, rows = e.observe(slot, measured)
        tried = rows if len(some) == len(verdict) else rows.only(some)
        done = e.gaussian.condition(tried, frame, e.ids[tried.slot])
        left = tried.corrected(*e.parts(done.correction))
        verdict[some] = _gate_by_others(e, left, seen, some, gate)
        inside = verdict[some] == ACCEPTED
        if not inside.all():
            done = _without(e, frame, done, tried, left, inside)
            tried, S = tried.only(inside), S[inside]
            left = tried.corrected(*e.parts(done.correction))
        innovations = innovations_of(e.gaussian, e.table.log_row[tried.slot], tried, S, left.residual)
    taken = verdict == ACCEPTED
    if not taken.all():
        rows, measured = rows.only(taken), measured[taken]
    clone = e.values.get("previous_pose", e.T_departed)
    linear = e.coordinates, e.T_imu_world, clone
    position = e.table.position_m[rows.slot]
    if P_prior is not None and taken.any():
        done, position, linear = _iterate(e, frame, P_prior, done, rows.slot, measured)
    return Correction(
        done, rows.residual.size, verdict, rows.slot, measured, rows.variance, position, *linear, innovations
    )


def _without(e: Estimate, frame: int, done: Conditioned, tried: Rows, left: Rows, inside: BoolArray) -> Conditioned:
    """Take the rows outside out of the conditioning ``done``; ``left`` are the rows ``tried`` with what it leaves."""
    out = left.only(~inside)
    try:
        return done - e.gaussian.condition(out, frame, e.ids[out.slot], sign=-1.0)
    except InnovationError:
        # Together the other rows say nothing about these, so that the difference is all rounding: once more without.
        e.gaussian.undo(done)
        kept = tried.only(inside)
        if not inside.any():
            return Conditioned(np.zeros(len(e.P)), 0.0, 0.0)
        return e.gaussian.condition(kept, frame, e.ids[kept.slot])


def _gate_alone(
    e: Estimate, frame: int, rows: Rows, seen: Seen, verdict: IntArray, gate: float
) -> tuple[IntArray, Array]:
    """Which landmarks (j,) of the rows pass the gate by themselves, and the covariances (j, d, d) of their innovations.

    The verdict (k,) on the others is written.
    """
    some = np.flatnonzero(verdict == ACCEPTED)
    rows = rows if len(some) == len(verdict) else rows.only(some)
    S = e.gaussian.variances(rows) + gates.diagonal(rows.variance)
    # So near to the camera plane that its image may be anywhere: linearised, it would spoil the whole frame.
    blurred = np.any(np.diagonal(S, axis1=1, axis2=2) > _MOST_BLURRED * rows.variance, axis=1)
    if blurred.any():
        verdict[some[blurred]] = BEHIND_CAMERA
        some, S, rows = some[~blurred], S[~blurred], rows.only(~blurred)
    squares = gates.normalised_squares(S, rows.residual, frame, e.ids[rows.slot])
    inside = squares <= gate
    verdict[some[~inside]] = GATE
    if _judges_motion(e) and not e.model.has_twist:
        evidence = gates.evidence_alone(rows, S, _motion(e, seen, some))
        moving = _moving(e, rows.slot, evidence, squares, gate)
        verdict[some[moving]] = MOVING
        inside &= ~moving
    return some[inside], S[inside]


def _gate_by_others(e: Estimate, left: Rows, seen: Seen, some: IntArray, gate: float) -> IntArray:
    """Verdicts (j,) on landmarks by what all others of the frame say.

    Args:
        left: Rows (j) on which P was conditioned, with the residuals that the correction leaves.
        seen: What all landmarks (k,) look like, of which these are ``some`` (j,).
    """
    verdict, judges_motion = np.full(len(some), ACCEPTED), _judges_motion(e) and e.model.has_twist
    if np.isfinite(gate) or judges_motion:
        C = gates.given_others(e.gaussian, left)
        squares, judged = gates.agrees_with_others(left, C)
        verdict[squares > gate] = GATE
        if judges_motion:
            # Noisy velocities would accuse all tracks of a frame alike: only what others leave counts.
            evidence = gates.evidence_given_others(left, C, _motion(e, seen, some))
            verdict[_moving(e, left.slot, evidence, squares, gate) & judged] = MOVING
    return verdict


def _judges_motion(e: Estimate) -> bool:
    """Whether tracks are tested for moving along: where they may err at all, from the second frame on."""
    return e.model.track_error is not None and e.tau_s > 0


def _motion(e: Estimate, seen: Seen, some: IntArray) -> Array:
    """Derivative (j, d) of the rows by a motion of their landmarks along the last step of the rig."""
    return seen.H_m[some] @ (e.T_imu_world[:3, :3].T @ (e.imu_twist[:3] * e.tau_s))


def _moving(e: Estimate, slot: IntArray, evidence: tuple[Array, Array], squares: Array, gate: float) -> BoolArray:
    sigma = e.config.moving_sigma / e.model.noise.margin
    return gates.moves_along(e.table, slot, *evidence, squares, gate, sigma, e.config.moving_share)


def _seen_twist(e: Estimate, frame: int, rows: Rows) -> Array:
    """The velocities (6,) that led to this frame, as corrected by its observations.

    A time offset counts in proportion to them. With the measured ones, whose noise the innovations show, too, it would
    come out far too small.
    """
    xi = e.gaussian.correction(rows, frame, e.ids[rows.slot])[:6]
    return -se3.log(se3.exp(xi) @ e.T_imu_world @ se3.inverse(e.T_departed)) / e.tau_s


def _iterate(
    e: Estimate, frame: int, P_prior: Array, done: Conditioned, slot: IntArray, measured: Array
) -> tuple[Conditioned, Array, tuple[Array, Array, Array]]:
    """Gauss-Newton on eq. (6): linearise again at the corrected state, always from the same prior.

    Rows taken at the corrected state are carried back into the prior's coordinates by the variant's derivative D,
    ``H_k D_k``, and the residual becomes ``r_k + H_k D_k (xi, d)_k``. Source: Bell and Cathey, "The iterated Kalman
    filter update as a Gauss-Newton method", IEEE TAC 1993.

    Returns:
        The last correction; the landmarks (j, 3), coordinates and poses at which it was linearised.
    """
    values, positions, first = e.values, e.positions_m, done
    for _ in range(e.config.iterations - 1):
        x, d = e.parts(done.correction)
        moved = e.retracted(done.correction)
        after = moved.values
        linear = (
            e.coordinates + done.correction[: len(e.coordinates)],
            after["pose"],
            after.get("previous_pose", e.T_departed),
        )
        e.values, e.table.position_m = after, moved.position_m
        _, rows = e.observe(slot, measured)
        e.values, e.table.position_m = values, positions
        rows = e.carried_back(rows, moved)
        e.P = P_prior.copy()
        done = e.gaussian.condition(rows.corrected(-x, -d), frame, e.ids[slot])
    return Conditioned(done.correction, first.nis, first.log_det), moved.position_m[slot], linear
