"""The correction of one frame: gates, eq. (6), and the iterated update."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.filters import gates
from ekfslam.filters.estimate import Estimate
from ekfslam.filters.gaussian import Conditioned, Projection, Rows, Solution
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
    some, tried = _gate_alone(e, frame, rows, seen, verdict, gate)
    innovations, solution = FrameInnovations.none(e.sensor.dimension), None
    if len(some):
        if e.model.has_time_offset and e.tau_s:
            e.imu_twist = _seen_twist(e, frame, tried)
            _, rows = e.observe(slot, measured)
            tried = e.gaussian.project(rows.only(some), frame, e.ids[slot[some]])
        S = tried.variances + gates.diagonal(tried.rows.variance)
        solution = e.gaussian.solve(tried, frame, e.ids[slot[some]])
        left = tried.rows.corrected(*e.parts(solution.done.correction))
        verdict[some] = _gate_by_others(e, solution, left, S, seen, some, gate)
        inside = verdict[some] == ACCEPTED
        accepted = tried.rows
        if not inside.all():
            solution = solution.without(~inside)
            accepted, S = accepted.only(inside), S[inside]
            left = accepted.corrected(*e.parts(solution.done.correction))
        innovations = innovations_of(solution, e.table.log_row[accepted.slot], accepted, S, left.residual)
    taken = verdict == ACCEPTED
    if not taken.all():
        rows, measured = rows.only(taken), measured[taken]
    clone = e.values.get("previous_pose", e.T_departed)
    linear = e.coordinates, e.T_imu_world, clone
    position = e.table.position_m[rows.slot]
    done = Conditioned(np.zeros(e.gaussian.body + 3 * e.gaussian.landmarks))
    if solution is not None:
        done = solution.done
        if e.config.iterations > 1 and taken.any():
            solution, position, linear = _iterate(e, frame, solution, rows.slot, measured)
            done = replace(done, correction=solution.done.correction)
        e.gaussian.apply(solution)
    return Correction(
        done, rows.residual.size, verdict, rows.slot, measured, rows.variance, position, *linear, innovations
    )


def _gate_alone(
    e: Estimate, frame: int, rows: Rows, seen: Seen, verdict: IntArray, gate: float
) -> tuple[IntArray, Projection]:
    """Which landmarks (j,) of the rows pass the gate by themselves, and their rows seen through the covariance.

    The verdict (k,) on the others is written.
    """
    some = np.flatnonzero(verdict == ACCEPTED)
    rows = rows if len(some) == len(verdict) else rows.only(some)
    tried = e.gaussian.project(rows, frame, e.ids[rows.slot])
    # So near to the camera plane that its image may be anywhere: linearised, it would spoil the whole frame.
    blurred = np.any(_own_variance(tried) > _MOST_BLURRED * tried.rows.variance, axis=1)
    if blurred.any():
        verdict[some[blurred]] = BEHIND_CAMERA
        some, tried = some[~blurred], tried.only(np.flatnonzero(~blurred))
    S = tried.variances + gates.diagonal(tried.rows.variance)
    squares = gates.normalised_squares(S, tried.rows.residual, frame, e.ids[tried.rows.slot])
    inside = squares <= gate
    verdict[some[~inside]] = GATE
    if _judges_motion(e) and not e.model.process.estimates_velocity:
        evidence = gates.evidence_alone(tried.rows, S, _motion(e, seen, some))
        moving = _moving(e, tried.rows.slot, evidence, squares, gate)
        verdict[some[moving]] = MOVING
        inside &= ~moving
    if not inside.all():
        some, tried = some[inside], tried.only(np.flatnonzero(inside))
    return some, tried


def _own_variance(tried: Projection) -> Array:
    """Variances (k, d) of the innovations."""
    return np.diagonal(tried.variances, axis1=1, axis2=2) + tried.rows.variance


def _gate_by_others(
    e: Estimate, solution: Solution, left: Rows, S: Array, seen: Seen, some: IntArray, gate: float
) -> IntArray:
    """Verdicts (j,) on landmarks by what all others of the frame say.

    Args:
        solution: Of eq. (6) for the rows (j).
        left: The rows with the residuals that the correction leaves.
        S: (j, d, d) of each by itself, before the conditioning.
        seen: What all landmarks (k,) look like, of which these are ``some`` (j,).
    """
    verdict, judges_motion = np.full(len(some), ACCEPTED), _judges_motion(e) and e.model.process.estimates_velocity
    if not (np.isfinite(gate) or judges_motion):
        return verdict
    doubtful = np.arange(len(some))
    if not judges_motion:
        doubtful = np.flatnonzero(~(gates.most_given_others(left, S) <= gate))
        left = left.only(doubtful)
    if len(doubtful):
        C = solution.given_others(doubtful)
        squares, judged = gates.agrees_with_others(left, C)
        verdict[doubtful[squares > gate]] = GATE
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


def _seen_twist(e: Estimate, frame: int, tried: Projection) -> Array:
    """The velocities (6,) that led to this frame, as corrected by its observations.

    A time offset counts in proportion to them. With the measured ones, whose noise the innovations show, too, it would
    come out far too small.
    """
    xi = e.gaussian.solve(tried, frame, e.ids[tried.rows.slot]).done.correction[:6]
    return -se3.log(se3.exp(xi) @ e.T_imu_world @ se3.inverse(e.T_departed)) / e.tau_s


def _iterate(
    e: Estimate, frame: int, solution: Solution, slot: IntArray, measured: Array
) -> tuple[Solution, Array, tuple[Array, Array, Array]]:
    """Gauss-Newton on eq. (6): linearise again at the corrected state, always from the same prior.

    Rows taken at the corrected state are carried back into the prior's coordinates by the variant's derivative D,
    ``H_k D_k``, and the residual becomes ``r_k + H_k D_k (xi, d)_k``. Source: Bell and Cathey, "The iterated Kalman
    filter update as a Gauss-Newton method", IEEE TAC 1993.

    Returns:
        The last solution; the landmarks (j, 3), coordinates and poses at which it was linearised.
    """
    values, positions = e.values, e.positions_m
    for _ in range(e.config.iterations - 1):
        correction = solution.done.correction
        x, d = e.parts(correction)
        moved = e.retracted(correction)
        after = moved.values
        linear = (
            e.coordinates + correction[: len(e.coordinates)],
            after["pose"],
            after.get("previous_pose", e.T_departed),
        )
        e.values, e.table.position_m = after, moved.position_m
        _, rows = e.observe(slot, measured)
        e.values, e.table.position_m = values, positions
        rows = e.carried_back(rows, moved).corrected(-x, -d)
        solution = e.gaussian.solve(e.gaussian.project(rows, frame, e.ids[slot]), frame, e.ids[slot])
    return solution, moved.position_m[slot], linear
