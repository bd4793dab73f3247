"""The correction of one frame by its known landmarks: gates, eq. (6), and the iterated update."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.filters import gates
from ekfslam.filters.estimate import Estimate, Mean
from ekfslam.filters.gaussian import Conditioned, Gaussian, Projection, Rows, Solution
from ekfslam.filters.innovations import FrameInnovations, innovations_of
from ekfslam.filters.observing import corrected_twist, observe
from ekfslam.filters.retraction import carried_back, parts, retracted
from ekfslam.models.observer import Projected
from ekfslam.models.sensors.base import ACCEPTED, BEHIND_CAMERA, GATE, MOVING, DelayedSensor

# Largest variance of an innovation, in those of the measurement, at which linearising still means anything.
_MOST_BLURRED = 1e8

_MOST_AVERAGED = 250  # landmarks


@dataclass(frozen=True)
class Correction:
    """Correction by a frame's known landmarks."""

    solution: Solution | None  # eq. (6) solved, to be applied to the covariance; None: nothing was accepted.
    done: Conditioned  # correction of the mean, NIS and log det S of the accepted rows
    dof: int  # degrees of freedom of the NIS
    verdict: IntArray  # (k,) `ACCEPTED` or a reason code for each landmark
    slot: IntArray  # slot, measured, variance: (j,), (j, d), (j, d) of the accepted landmarks
    measured: Array
    variance: Array
    linear: Mean  # mean at which the accepted rows were linearised
    coordinates: Array  # (body,) coordinates there
    innovations: FrameInnovations  # innovations of the accepted rows in the first iteration
    outside: int = 0  # number of landmarks outside of the gate, whether or not they seem to move, too
    is_wide: bool = False  # whether the prediction is too uncertain to linearise at, see `_is_wide`
    gaussian: Gaussian | None = None  # covariance that solution belongs to, if it is not that of the prediction
    doubt: float = 1.0  # factor of the noise of the inputs in it


def correct(e: Estimate, frame: int, slot: IntArray, measured: Array) -> Correction:
    """Solve eq. (6) behind its gates, for landmarks at ``slot`` (k,) with rows (k, d).

    A landmark must agree with the prediction, and with the prediction as corrected by all *other* landmarks of the
    frame: the first gate is weak while the pose itself is uncertain, the second is not. The second gate rejects
    observations that the joint solution already contains, so they are removed from it.

    Of the estimate, only the evidence of motion in its table changes. The caller applies the correction.

    Raises:
        InnovationError: The innovation covariance is not positive definite.
    """
    gate = gates.threshold(e.config.gate_probability, e.sensor.dimension)
    verdict = np.full(len(slot), ACCEPTED)
    at, solution, innovations = e.mean, None, FrameInnovations.none(e.sensor.dimension)
    seen, rows = observe(e, at, slot, measured)
    verdict[~e.sensor.in_view(seen.q, e.config.min_depth_m)] = BEHIND_CAMERA
    some, tried, outside = _gate_alone(e, frame, rows, seen, verdict, gate)
    if len(some):
        if e.model.observer.has_time_offset and e.motion.tau_s:
            correction = e.gaussian.solve(tried, frame, e.ids[tried.rows.slot]).done.correction
            at = replace(at, imu_twist=corrected_twist(e, e.model.retract(e.values, correction)))
            _, rows = observe(e, at, slot, measured)
            tried = e.gaussian.project(rows.only(some), frame, e.ids[slot[some]])
        solution, innovations = _gate_jointly(e, frame, tried, seen, some, verdict, gate)
        outside += int((verdict[some] == GATE).sum())
    taken = verdict == ACCEPTED
    if not taken.all():
        rows, measured = rows.only(taken), measured[taken]
    coordinates = e.coordinates
    done = Conditioned(np.zeros(e.gaussian.body + 3 * e.gaussian.landmarks)) if solution is None else solution.done
    if solution is not None and e.config.iterations > 1 and taken.any():
        solution, at, coordinates = _iterated(e, at, frame, solution, rows.slot, measured)
        done = replace(done, correction=solution.done.correction)
    return Correction(
        solution,
        done,
        rows.residual.size,
        verdict,
        rows.slot,
        measured,
        rows.variance,
        at,
        coordinates,
        innovations,
        outside,
        _is_wide(tried),
    )


def _is_wide(tried: Projection) -> bool:
    """Return whether the prior spreads rows so far that linearising them once costs more than their noise.

    A rotation that moves a row by s px has a term of second order of ``s^2 / (2 f)`` there, f being the row's
    derivative by the rotation (the focal length, or more). All landmarks of a frame share most of it, and their noise
    averages out: wide means that in the median the term exceeds half of ``sigma / sqrt(k)``. Of more than 250 landmarks
    the errors that they share are larger than what averages out.
    """
    rows, k = tried.rows, len(tried.rows.residual)
    if not k:
        return False
    spread = np.diagonal(tried.variances, axis1=1, axis2=2).max(axis=1)
    return bool(
        np.median(spread / (focal_lengths(rows) * np.sqrt(rows.variance.min(axis=1))))
        > 1.0 / np.sqrt(min(k, _MOST_AVERAGED))
    )


def focal_lengths(rows: Rows) -> Array:
    """Return the largest derivative (k,) of each landmark's rows by a rotation, px/rad."""
    return np.sqrt((rows.H_x[..., 3:6] ** 2).sum(axis=2).max(axis=1))


def _gate_jointly(
    e: Estimate, frame: int, tried: Projection, seen: Projected, some: IntArray, verdict: IntArray, gate: float
) -> tuple[Solution, FrameInnovations]:
    """Solve eq. (6) for rows (j), and remove those that others reject; write their verdicts (k,)."""
    S = tried.variances + gates.diagonal(tried.rows.variance)
    solution = e.gaussian.solve(tried, frame, e.ids[tried.rows.slot])
    accepted, left = tried.rows, tried.rows.corrected(*parts(e, solution.done.correction))
    verdict[some] = _gate_by_others(e, solution, left, seen, some, gate)
    inside = verdict[some] == ACCEPTED
    if not inside.all():
        tried, S = tried.only(np.flatnonzero(inside)), S[inside]
        solution, accepted = e.gaussian.solve(tried, frame, e.ids[tried.rows.slot]), tried.rows
        left = accepted.corrected(*parts(e, solution.done.correction))
    return solution, innovations_of(solution, e.table.log_row[accepted.slot], accepted, S, left.residual)


def _gate_alone(
    e: Estimate, frame: int, rows: Rows, seen: Projected, verdict: IntArray, gate: float
) -> tuple[IntArray, Projection, int]:
    """Return the landmarks (j,) that pass the gate by themselves, ``H P H^T``, and the number of the others."""
    some = np.flatnonzero(verdict == ACCEPTED)
    rows = rows if len(some) == len(verdict) else rows.only(some)
    tried = e.gaussian.project(rows, frame, e.ids[rows.slot])
    # So near to the camera plane that its image may be anywhere: linearised, it would spoil the whole frame.
    own = np.diagonal(tried.variances, axis1=1, axis2=2) + tried.rows.variance
    blurred = np.any(own > _MOST_BLURRED * tried.rows.variance, axis=1)
    if blurred.any():
        verdict[some[blurred]] = BEHIND_CAMERA
        some, tried = some[~blurred], tried.only(np.flatnonzero(~blurred))
    S = tried.variances + gates.diagonal(tried.rows.variance)
    squares = gates.normalised_squares(S, tried.rows.residual, frame, e.ids[tried.rows.slot])
    inside = squares <= gate
    verdict[some[~inside]] = GATE
    outside = len(inside) - int(inside.sum())
    if _judges_motion(e) and not e.model.process.estimates_velocity:
        evidence = gates.evidence_alone(tried.rows, S, _motion(e, seen, some))
        moving = gates.moves_along(e.table, tried.rows.slot, evidence, squares, gate, e.config)
        verdict[some[moving]] = MOVING
        inside &= ~moving
    if not inside.all():
        some, tried = some[inside], tried.only(np.flatnonzero(inside))
    return some, tried, outside


def _gate_by_others(
    e: Estimate, solution: Solution, left: Rows, seen: Projected, some: IntArray, gate: float
) -> IntArray:
    """Return verdicts (j,) on ``some`` landmarks by all others, given the residuals ``left`` by all."""
    verdict, judges_motion = np.full(len(some), ACCEPTED), _judges_motion(e) and e.model.process.estimates_velocity
    if not (np.isfinite(gate) or judges_motion):
        return verdict
    C = solution.given_others()
    squares, judged = gates.agrees_with_others(left, C)
    verdict[squares > gate] = GATE
    if judges_motion:
        # Noisy velocities would accuse all tracks of a frame alike: only what others leave counts.
        evidence = gates.evidence_given_others(left, C, _motion(e, seen, some))
        verdict[gates.moves_along(e.table, left.slot, evidence, squares, gate, e.config) & judged] = MOVING
    return verdict


def _judges_motion(e: Estimate) -> bool:
    """Return whether tracks are tested for motion: if they have errors, from the second frame on.

    For one camera a wrong depth looks like a motion along the way.
    """
    return e.model.track_error is not None and e.motion.tau_s > 0 and not isinstance(e.sensor, DelayedSensor)


def _motion(e: Estimate, seen: Projected, some: IntArray) -> Array:
    """Return the derivative (j, d) of the rows by a motion of their landmarks along the last step of the rig."""
    return seen.H_m[some] @ (e.T_imu_world[:3, :3].T @ (e.imu_twist[:3] * e.motion.tau_s))


def _iterated(
    e: Estimate, at: Mean, frame: int, solution: Solution, slot: IntArray, measured: Array
) -> tuple[Solution, Mean, Array]:
    """Iterate eq. (6) by Gauss-Newton; return the last solution, with the mean and the coordinates of its rows.

    Rows are linearised again at the corrected mean, and carried back into the prior's coordinates by the variant's
    derivative D: ``H_k D_k`` with the residual ``r_k + H_k D_k (xi, d)_k``. Source: Bell and Cathey, "The iterated
    Kalman filter update as a Gauss-Newton method", IEEE TAC 1993.
    """
    linear, coordinates = at, e.coordinates
    for _ in range(e.config.iterations - 1):
        linear, coordinates, _, rows = relinearised(e, at, solution, slot, measured)
        solution = e.gaussian.solve(e.gaussian.project(rows, frame, e.ids[slot]), frame, e.ids[slot])
    return solution, linear, coordinates


def relinearised(
    e: Estimate, at: Mean, solution: Solution, slot: IntArray, measured: Array
) -> tuple[Mean, Array, Projected, Rows]:
    """Return the mean and coordinates after a solution, and views and rows there in the prior's coordinates."""
    correction = solution.done.correction
    x, d = parts(e, correction)
    moved = retracted(e, correction)
    linear = replace(moved.mean, imu_twist=at.imu_twist)
    seen, rows = observe(e, linear, slot, measured, at)
    coordinates = e.coordinates + correction[: len(e.coordinates)]
    return linear, coordinates, seen, carried_back(e, rows, moved).corrected(-x, -d)
