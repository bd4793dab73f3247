"""Consensus of the landmarks of a frame: which are wrong, these landmarks or the inputs?

A gate tests each landmark against the prediction. One wild velocity makes all landmarks fail, and would be kept. So a
frame in which many fail, or in which those that pass agree on a motion that is not the predicted one, is decided
between two hypotheses: the inputs have their noise Q, or they say next to nothing and have ``doubt^2 Q``. Given the
joint covariance ``S = H P H^T + V`` of the innovations r under a hypothesis, the landmarks A that agree are found from
small samples and by the others of A (MSAC: Torr and Zisserman, "MLESAC", CVIU 2000). A hypothesis costs

    r_A^T S_AA^-1 r_A + gate (k - |A|), and gate_6 more if it rejects the inputs,

so each measurement that is rejected, a landmark or the inputs, costs as much as its gate. If the inputs are doubted, or
the prior is wide, the rows are linearised again at each solution, because the prediction may be far off.

What contradicts the inputs of one interval may be traffic: then the inputs go on as before, and the landmarks jump. So
inputs are rejected only if the corrected motion is nearer to that of the interval before than they are, by Q.

*Trigger*, from the plain correction: more than a third of the landmarks are rejected, or the shared innovation c with
covariance C (`ekfslam.filters.innovations`) explains more than gate_6 by an error e of the inputs of covariance
``Q_e = (doubt^2 - 1) Q``: ``c^T (C + Q_e^-1)^-1 c``.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, replace
from itertools import combinations
from math import comb

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.filters import correction, gates
from ekfslam.filters.correction import Correction, focal_lengths, relinearised
from ekfslam.filters.estimate import Estimate, Mean
from ekfslam.filters.gaussian import Gaussian, Rows, Solution
from ekfslam.filters.innovations import innovations_of
from ekfslam.filters.observing import corrected_twist, observe
from ekfslam.filters.retraction import parts
from ekfslam.geometry import se3
from ekfslam.models.sensors.base import ACCEPTED, GATE, MOVING

# Factor of the noise of rejected inputs: errors up to some 100 standard deviations leave the landmarks in charge.
DOUBT = 30.0
INPUT_GATE = gates.of_inputs(6)
_SHARE = 1.0 / 3.0  # of rejected landmarks, from which a frame is looked at
_SAMPLES = 100
_ROUNDS = 4
_BENT = 0.05  # error of the linearisation, in deviations of a pixel, below which another round would be in vain


@dataclass(frozen=True)
class _Settled:
    """A frame solved under one hypothesis: ``inside`` (k,) of its landmarks agree, and ``rows`` are theirs."""

    solution: Solution
    inside: BoolArray
    rows: Rows
    S: Array
    linear: Mean
    coordinates: Array
    cost: float

    @property
    def is_majority(self) -> bool:
        """Whether most landmarks agree."""
        return bool(2 * self.inside.sum() > len(self.inside))


def correct(e: Estimate, frame: int, slot: IntArray, measured: Array) -> Correction:
    """Solve eq. (6) as `ekfslam.filters.correction.correct` does, and decide doubtful frames by consensus."""
    evidence = e.table.evidence.copy()
    found = correction.correct(e, frame, slot, measured)
    gate = gates.threshold(e.config.gate_probability, e.sensor.dimension)
    if not (len(slot) and e.motion.tau_s and np.isfinite(gate)):
        return found
    if not (found.is_wide or _is_suspect(e, found, gate)):
        return found
    rounds = _ROUNDS if found.is_wide else 1
    begin = None if _is_suspect(e, found, gate) else found.verdict == ACCEPTED

    def settled(gaussian: Gaussian, rounds: int, *verdicts: int) -> tuple[IntArray, _Settled | None]:
        some = np.flatnonzero(np.isin(found.verdict, verdicts))
        first = None if begin is None else begin[some]
        return some, _settled(e, gaussian, frame, slot[some], measured[some], gate, rounds, first)

    some, trusted = settled(e.gaussian, rounds, ACCEPTED, GATE)
    if trusted is not None and trusted.is_majority:
        found = _correction(e, found, trusted, some, measured)
    if e.model.process.estimates_velocity or not _is_suspect(e, found, gate):
        return found
    jump = _jump(e)
    if 4.0 * jump @ jump < INPUT_GATE:
        return found
    # Tracks that seem to move may be made to by the inputs: both hypotheses are judged by all.
    begin = None
    if (found.verdict == MOVING).any():
        some, trusted = settled(e.gaussian, rounds, ACCEPTED, GATE, MOVING)
    wide = doubted(e, DOUBT)
    some, doubtful = settled(wide, _ROUNDS, ACCEPTED, GATE, MOVING)
    cost = gate * len(some) if trusted is None else trusted.cost
    if doubtful is None or not doubtful.is_majority or doubtful.cost + INPUT_GATE >= cost:
        return found
    error = _in_noise(e, doubtful.solution.done.correction[:6])
    if error @ jump < 0.5 * error @ error:
        return found
    e.table.evidence = evidence
    return replace(_correction(e, found, doubtful, some, measured), gaussian=wide, doubt=DOUBT)


def doubted(e: Estimate, doubt: float) -> Gaussian:
    """Return a copy of the covariance in which the last step has had inputs of ``doubt`` times their noise."""
    gaussian = deepcopy(e.gaussian)
    gaussian.propagate(np.eye(len(e.motion.Q)), (doubt**2 - 1.0) * e.motion.Q)
    return gaussian


def _jump(e: Estimate) -> Array:
    """Return the motion (6,) to the pose of a rig that moves as before, in deviations of the inputs; NaN at first."""
    if e.motion.last is None:
        return np.full(6, np.nan)
    moved, tau_s = e.motion.last
    as_before = se3.exp(e.motion.tau_s / tau_s * se3.log(moved)) @ e.motion.T_departed
    return _in_noise(e, se3.log(as_before @ se3.inverse(e.motion.T_predicted)))


def _in_noise(e: Estimate, xi: Array) -> Array:
    """Return a motion (6,) in units of the noise of the inputs; directions without noise count as nothing."""
    variances, axes = np.linalg.eigh(e.motion.Q[:6, :6])
    noisy = variances > 1e-12 * variances[-1]
    return np.where(noisy, axes.T @ xi / np.sqrt(np.where(noisy, variances, 1.0)), 0.0)


def _is_suspect(e: Estimate, found: Correction, gate: float) -> bool:
    """Return whether the trigger of the module holds."""
    c, C = found.innovations.score, found.innovations.information
    Q = (DOUBT**2 - 1.0) * e.motion.Q[:6, :6]
    shared = c @ Q @ np.linalg.solve(np.eye(6) + C @ Q, c)
    return bool(
        shared > INPUT_GATE
        or (found.outside > _SHARE * len(found.verdict) and shared + gate * found.outside > INPUT_GATE)
    )


def _settled(
    e: Estimate,
    gaussian: Gaussian,
    frame: int,
    slot: IntArray,
    measured: Array,
    gate: float,
    rounds: int,
    begin: BoolArray | None,
) -> _Settled | None:
    """Solve eq. (6) for landmarks (k,) with rows (k, d) that agree; None: there are none.

    They are found from samples, seeded by the frame, or are those of ``begin``; ``gate`` is the threshold for one,
    ``rounds`` the number of linearisations at most.
    """
    _, rows = observe(e, e.mean, slot, measured)
    some, found = np.arange(len(slot)), None
    inside = np.zeros(len(slot), dtype=bool) if begin is None else begin.copy()
    linear, coordinates = e.mean, e.coordinates
    for rounds_left in reversed(range(rounds)):
        if not len(some):
            return None
        projection = gaussian.project(rows, frame, e.ids[rows.slot])
        S = projection.S
        if found is None and begin is None:
            inside = agreeing(S, rows, gate, np.random.default_rng(frame))
        agree = refined(S, rows.residual, inside[some], gate)
        if not agree.any():
            return None
        inside[:] = False
        inside[some[agree]] = True
        solution = gaussian.solve(projection.only(np.flatnonzero(agree)), frame, e.ids[rows.slot[agree]])
        own = _blocks(S.reshape(*rows.residual.shape * 2))[agree]
        cost = solution.done.nis + gate * (len(slot) - agree.sum())
        found = _Settled(solution, inside.copy(), rows.only(agree), own, linear, coordinates, cost)
        if not rounds_left:
            break
        linear, coordinates, seen, rows = relinearised(e, _at(e, solution), solution, slot, measured)
        if _is_straight(e, found, rows.only(inside)):
            break
        some = np.flatnonzero(e.sensor.in_view(seen.q, e.config.min_depth_m))
        rows = rows.only(some)
    return found


def _is_straight(e: Estimate, settled: _Settled, rows: Rows) -> bool:
    """Return whether rows that are linearised at a solution agree with those that it was found with."""
    x, d = parts(e, settled.solution.done.correction)
    bent = rows.corrected(x, d).residual - settled.rows.corrected(x, d).residual
    return bool(np.mean(bent**2 / settled.rows.variance) < _BENT**2)


def _correction(e: Estimate, plain: Correction, settled: _Settled, candidates: IntArray, measured: Array) -> Correction:
    """Return a correction by the landmarks that agree among the ``candidates`` (k,) of a frame."""
    verdict, rows, solution = plain.verdict.copy(), settled.rows, settled.solution
    verdict[candidates] = np.where(settled.inside, ACCEPTED, GATE)
    left = rows.corrected(*parts(e, solution.done.correction)).residual
    return replace(
        plain,
        solution=solution,
        done=solution.done,
        dof=rows.residual.size,
        outside=int((~settled.inside).sum()),
        verdict=verdict,
        slot=rows.slot,
        measured=measured[verdict == ACCEPTED],
        variance=rows.variance,
        linear=settled.linear,
        coordinates=settled.coordinates,
        innovations=innovations_of(solution, e.table.log_row[rows.slot], rows, settled.S, left),
    )


def _at(e: Estimate, solution: Solution) -> Mean:
    """Return the mean with the velocity at the image that a solution corrects, if a time offset needs it, eq. (9)."""
    if not e.model.observer.has_time_offset:
        return e.mean
    return replace(e.mean, imu_twist=corrected_twist(e, e.model.retract(e.values, solution.done.correction)))


def agreeing(S: Array, rows: Rows, gate: float, generator: np.random.Generator) -> BoolArray:
    """Return which landmarks (k,) agree with the best of small samples of them, given their covariance S (k d, k d).

    A sample corrects the predictions of all other landmarks. What it moves by s px may be wrong by ``s^2 / f``, as
    linearised. ``generator`` draws samples if there are too many to try them all.
    """
    (k, d), r = rows.residual.shape, rows.residual
    sample = samples_of(k, generator)
    n, size = sample.shape
    S = S.reshape(k, d, k, d)
    S_ka = S[:, :, sample].transpose(2, 0, 1, 3, 4).reshape(n, k * d, size * d)
    S_aa = S_ka.reshape(n, k, d, -1)[np.arange(n)[:, None], sample].reshape(n, size * d, size * d)
    gain = np.linalg.solve(S_aa, S_ka.swapaxes(1, 2)).swapaxes(1, 2)
    r_a = r[sample].reshape(n, size * d, 1)
    moved = (gain @ r_a).reshape(n, k, d)
    own = np.einsum("nkda,nkea->nkde", gain.reshape(n, k, d, -1), S_ka.reshape(n, k, d, -1))
    bend = (moved**2).sum(axis=2) / focal_lengths(rows)
    left = _blocks(S) - own + (bend**2)[..., None, None] * np.eye(d)
    e = r - moved
    left[np.arange(n)[:, None], sample], e[np.arange(n)[:, None], sample] = np.eye(d), 0.0
    squares = (e * np.linalg.solve(left, e[..., None])[..., 0]).sum(axis=2)
    of_sample = (r_a * np.linalg.solve(S_aa, r_a)).sum(axis=(1, 2))
    best = (of_sample + np.minimum(squares, gate).sum(axis=1)).argmin()
    return squares[best] <= gate


def samples_of(k: int, generator: np.random.Generator) -> IntArray:
    """Return samples (n, size) of k landmarks: three each, or one less than there are."""
    size = max(min(3, k - 1), 1)
    if comb(k, size) <= _SAMPLES:
        return np.array(list(combinations(range(k), size)))
    return generator.random((_SAMPLES, k)).argpartition(size, axis=1)[:, :size]


def refined(S: Array, residual: Array, inside: BoolArray, gate: float) -> BoolArray:
    """Return the landmarks (k,) that agree with all others of them, starting from those ``inside`` (k,).

    The innovation of a landmark given those of all others, with joint covariance S (k d, k d), has the square ``y_i^T
    K_ii^-1 y_i`` with ``K = S_AA^-1`` and ``y = K r_A``. The worst one leaves first: with it inside, it may seem that
    others are wrong. ``gate`` is the threshold for one landmark.
    """
    (k, d), some = residual.shape, np.flatnonzero(inside)
    S_kdkd = S.reshape(k, d, k, d)
    K = inverse(S_kdkd[some][:, :, some].reshape(len(some) * d, len(some) * d))
    while len(some):
        own = np.asarray(_blocks(K.reshape(len(some), d, len(some), d)))
        y = (K @ residual[some].ravel()).reshape(len(some), d)
        squares = (y * np.linalg.solve(own, y[..., None])[..., 0]).sum(axis=1)
        if squares.max() <= gate:
            break
        # Without rows i the inverse is K - K_:i K_ii^-1 K_i: .
        worst = int(squares.argmax())
        rows = slice(worst * d, (worst + 1) * d)
        K = K - K[:, rows] @ np.linalg.solve(own[worst], K[rows])
        K = np.delete(np.delete(K, rows, axis=0), rows, axis=1)
        some = np.delete(some, worst)
    agree = np.zeros(k, dtype=bool)
    agree[some] = True
    others = np.flatnonzero(~agree)
    S_ja = S_kdkd[others][:, :, some].reshape(len(others), d, len(some) * d)
    gain = S_ja @ K
    e = residual[others] - gain @ residual[some].ravel()
    C = _blocks(S_kdkd)[others] - gain @ S_ja.swapaxes(1, 2)
    agree[others] = (e * np.linalg.solve(C, e[..., None])[..., 0]).sum(axis=1) <= gate
    return agree


def inverse(S: Array) -> Array:
    """Return the inverse of a covariance, by Cholesky."""
    if not len(S):
        return S
    L, failed = lapack.dpotrf(S, lower=1)
    if failed:
        raise np.linalg.LinAlgError("not positive definite")
    K = lapack.dpotri(L, lower=1)[0]
    return np.asarray(np.tril(K) + np.tril(K, -1).T)


def _blocks(S: NDArray[np.floating]) -> Array:
    """Return the diagonal blocks (k, d, d) of S (k, d, k, d)."""
    own = np.arange(len(S))
    return np.asarray(S[own, :, own, :], dtype=float)
