"""The correction of one frame: gates, eq. (6), and the iterated update."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.filters import gates
from ekfslam.filters.estimate import Estimate, Mean
from ekfslam.filters.gaussian import Conditioned, Projection, Rows, Solution
from ekfslam.filters.innovations import FrameInnovations, innovations_of
from ekfslam.filters.observing import observe
from ekfslam.filters.retraction import carried_back, parts, retracted
from ekfslam.models.observer import Seen
from ekfslam.models.sensors.base import ACCEPTED, BEHIND_CAMERA, GATE, MOVING

# Largest variance of an innovation, in those of the measurement, at which linearising still means anything.
_MOST_BLURRED = 1e8


@dataclass(frozen=True)
class Correction:
    """Correction by a frame's known landmarks.

    Args:
        solution: Eq. (6) solved, to be applied to the covariance; None: nothing was accepted.
        done: Correction of the mean, NIS and ``log det S`` of what was accepted.
        dof: Its degrees of freedom.
        verdict: (k,) on each landmark: `ACCEPTED` or a reason code.
        slot, measured, variance: (j,), (j, d), (j, d) of the accepted ones.
        linear: Where they were linearised.
        coordinates: (body,) coordinates there.
        innovations: Those of the accepted ones, of the first iteration.
    """

    solution: Solution | None
    done: Conditioned
    dof: int
    verdict: IntArray
    slot: IntArray
    measured: Array
    variance: Array
    linear: Mean
    coordinates: Array
    innovations: FrameInnovations


def correct(e: Estimate, frame: int, slot: IntArray, measured: Array) -> Correction:
    """Solve eq. (6) with its gates, for landmarks at ``slot`` (k,) with rows (k, d).

    A landmark must agree with the prediction, and with the prediction as corrected by all *other* landmarks of the
    frame: the first gate is weak while the pose itself is uncertain, the second is not. The second gate rejects
    observations that the joint solution already contains, so they are removed from it.

    The estimate stays, but for the evidence of motion in its table. The caller applies solution and correction.

    Raises:
        InnovationError: The innovation covariance is not positive definite.
    """
    gate = gates.threshold(e.config.gate_probability, e.sensor.dimension)
    verdict = np.full(len(slot), ACCEPTED)
    at, solution, innovations = e.mean, None, FrameInnovations.none(e.sensor.dimension)
    seen, rows = observe(e, at, slot, measured)
    verdict[~e.sensor.in_view(seen.q, e.config.min_depth_m)] = BEHIND_CAMERA
    some, tried = _gate_alone(e, frame, rows, seen, verdict, gate)
    if len(some):
        if e.model.observer.has_time_offset and e.motion.tau_s:
            at = replace(at, imu_twist=_corrected_twist(e, frame, tried))
            _, rows = observe(e, at, slot, measured)
            tried = e.gaussian.project(rows.only(some), frame, e.ids[slot[some]])
        solution, innovations = _gate_jointly(e, frame, tried, seen, some, verdict, gate)
    taken = verdict == ACCEPTED
    if not taken.all():
        rows, measured = rows.only(taken), measured[taken]
    done, coordinates = Conditioned(np.zeros(e.gaussian.body + 3 * e.gaussian.landmarks)), e.coordinates
    if solution is not None:
        done = solution.done
        if e.config.iterations > 1 and taken.any():
            solution, at, coordinates = _iterated(e, at, frame, solution, rows.slot, measured)
            done = replace(done, correction=solution.done.correction)
    return Correction(
        solution, done, rows.residual.size, verdict, rows.slot, measured, rows.variance, at, coordinates, innovations
    )


def _gate_jointly(
    e: Estimate, frame: int, tried: Projection, seen: Seen, some: IntArray, verdict: IntArray, gate: float
) -> tuple[Solution, FrameInnovations]:
    """Solve eq. (6) for rows (j), and remove those that others reject; the verdict (k,) on these is written."""
    S = tried.variances + gates.diagonal(tried.rows.variance)
    solution = e.gaussian.solve(tried, frame, e.ids[tried.rows.slot])
    accepted, left = tried.rows, tried.rows.corrected(*parts(e, solution.done.correction))
    verdict[some] = _gate_by_others(e, solution, left, S, seen, some, gate)
    inside = verdict[some] == ACCEPTED
    if not inside.all():
        solution = solution.without(~inside)
        accepted, S = accepted.only(inside), S[inside]
        left = accepted.corrected(*parts(e, solution.done.correction))
    return solution, innovations_of(solution, e.table.log_row[accepted.slot], accepted, S, left.residual)


def _gate_alone(
    e: Estimate, frame: int, rows: Rows, seen: Seen, verdict: IntArray, gate: float
) -> tuple[IntArray, Projection]:
    """Return which landmarks (j,) of the rows pass the gate by themselves, and their rows seen through the covariance.

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
    """Return the variances (k, d) of the innovations."""
    return np.diagonal(tried.variances, axis1=1, axis2=2) + tried.rows.variance


def _gate_by_others(
    e: Estimate, solution: Solution, left: Rows, S: Array, seen: Seen, some: IntArray, gate: float
) -> IntArray:
    """Return verdicts (j,) on landmarks by all others of the frame.

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
    """Return whether tracks are tested for motion: if they have errors, from the second frame on."""
    return e.model.track_error is not None and e.motion.tau_s > 0


def _motion(e: Estimate, seen: Seen, some: IntArray) -> Array:
    """Return the derivative (j, d) of the rows by a motion of their landmarks along the last step of the rig."""
    return seen.H_m[some] @ (e.T_imu_world[:3, :3].T @ (e.imu_twist[:3] * e.motion.tau_s))


def _moving(e: Estimate, slot: IntArray, evidence: tuple[Array, Array], squares: Array, gate: float) -> BoolArray:
    return gates.moves_along(e.table, slot, *evidence, squares, gate, e.config.moving_sigma, e.config.moving_share)


def _corrected_twist(e: Estimate, frame: int, tried: Projection) -> Array:
    """Return the velocity (6,) at this frame as corrected by its observations.

    A time offset counts in proportion to it. With the measured one, whose noise the innovations show, too, it would
    come out far too small.
    """
    correction = e.gaussian.solve(tried, frame, e.ids[tried.rows.slot]).done.correction
    after = e.model.retract(e.values, correction)
    return e.model.process.imu_twist({"pose": e.motion.T_departed}, after, e.motion.interval)


def _iterated(
    e: Estimate, at: Mean, frame: int, solution: Solution, slot: IntArray, measured: Array
) -> tuple[Solution, Mean, Array]:
    """Iterate eq. (6) by Gauss-Newton: linearise again at the corrected mean, always from the same prior.

    Rows taken at the corrected mean are carried back into the prior's coordinates by the variant's derivative D,
    ``H_k D_k``, and the residual becomes ``r_k + H_k D_k (xi, d)_k``. Source: Bell and Cathey, "The iterated Kalman
    filter update as a Gauss-Newton method", IEEE TAC 1993.

    Returns:
        The last solution; the mean and the coordinates (body,) at which it was linearised.
    """
    linear, coordinates = at, e.coordinates
    for _ in range(e.config.iterations - 1):
        correction = solution.done.correction
        x, d = parts(e, correction)
        moved = retracted(e, correction)
        linear = replace(moved.mean, imu_twist=at.imu_twist)
        coordinates = e.coordinates + correction[: len(e.coordinates)]
        _, rows = observe(e, linear, slot, measured)
        rows = carried_back(e, rows, moved).corrected(-x, -d)
        solution = e.gaussian.solve(e.gaussian.project(rows, frame, e.ids[slot]), frame, e.ids[slot])
    return solution, linear, coordinates
