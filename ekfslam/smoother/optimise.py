"""Maximum a posteriori over all poses and landmarks of a log.

Robust kernels act on the norm s of each observation's whitened residual. With width c: Huber ``s^2/2`` up to c and
``c (s - c/2)`` beyond, Cauchy ``c^2/2 log(1 + s^2/c^2)``. Process and prior are not weighted.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ekfslam.arrays import Array
from ekfslam.config import PosteriorConfig
from ekfslam.errors import IllPosedError
from ekfslam.smoother.landmarks import settled
from ekfslam.smoother.problem import BatchProblem, State
from ekfslam.smoother.sparse.factors import LinearSystem
from ekfslam.smoother.sparse.information import JointInformation

MOST_ITERATIONS = 50
# Landmarks settle until a step lowers their cost by less than this share of what ends the iterations.
_SETTLED = 0.01
_LEAST_DAMPING = 1e-8


def robust(config: PosteriorConfig, s: Array) -> tuple[Array, Array]:
    """Return cost and weight of whitened residuals of norm s; the weight is the slope of the cost divided by s."""
    width = config.kernel_width
    if config.kernel == "huber":
        return np.where(s <= width, 0.5 * s**2, width * (s - 0.5 * width)), width / np.maximum(s, width)
    if config.kernel == "cauchy":
        return 0.5 * width**2 * np.log1p((s / width) ** 2), 1.0 / (1.0 + (s / width) ** 2)
    return 0.5 * s**2, np.ones_like(s)


@dataclass(frozen=True)
class Evaluation:
    """A problem at a state."""

    state: State
    cost: float  # half the sum of squares, under the kernel
    weight: Array  # (K,) robust weight of each observation
    system: LinearSystem  # all factors, linearised and weighted there


@dataclass(frozen=True)
class Maximum:
    """The maximum a posteriori."""

    state: State  # all unknowns there
    costs: tuple[float, ...]  # costs at the start and after each step
    linearised: Evaluation  # the state and the weights of information, at most one last step away
    information: JointInformation  # the factorised system


def evaluate(problem: BatchProblem, state: State, config: PosteriorConfig, min_depth_m: float) -> Evaluation | None:
    """Return cost and system at a state; None if a landmark is behind a camera that saw it."""
    sight = problem.observations.at(state)
    if not sight.in_view(min_depth_m).all():
        return None
    system, s = problem.relinearised(state), sight.norms()
    problem.observations.forget()
    costs, weight = robust(config, s)
    cost = float(costs.sum() + system.half_square - 0.5 * (s**2).sum())
    return Evaluation(state, cost, weight, system if config.kernel == "none" else system.weighted(weight))


def maximise(
    problem: BatchProblem, start: State, config: PosteriorConfig, min_depth_m: float, iterations: Iterable[int]
) -> Maximum:
    """Find the maximum a posteriori of all factors, by Levenberg-Marquardt with iteratively reweighted factors.

    A landmark that fits better at its first triangulation starts from there. An `IllPosedError` names what is
    undetermined, or landmarks behind a camera that saw them. Source: Triggs, McLauchlan, Hartley, Fitzgibbon, "Bundle
    adjustment - a modern synthesis", 2000, section 4.
    """
    here = evaluate(problem, better_start(problem, start, config, min_depth_m), config, min_depth_m)
    assert here is not None
    costs, damping, growth, step = [here.cost], 1e-7, 2.0, None
    for _ in iterations:
        step = JointInformation(here.system, damping, like=step)
        moved = settled(
            problem.observations,
            problem.moved(here.state, step),
            partial(robust, config),
            min_depth_m,
            _SETTLED * config.tolerance * here.cost,
        )
        there = evaluate(problem, moved, config, min_depth_m)
        gain = here.cost - there.cost if there else -np.inf
        if there is None or not gain >= 0:
            damping, growth = max(damping, _LEAST_DAMPING) * growth, 2.0 * growth
            if step.gain <= config.tolerance * here.cost:
                break
            continue
        # Nielsen, "Damping parameter in Marquardt's method", 1999: by how much of what was promised has come.
        share = gain / max(step.gain, np.finfo(float).tiny)
        costs.append(there.cost)
        if gain <= config.tolerance * there.cost and not damping:
            return Maximum(there.state, tuple(costs), here, step)
        here = there
        if gain <= config.tolerance * here.cost:
            break
        damping, growth = damping * max(1 / 3, 1 - (2 * min(share, 1.0) - 1) ** 3), 2.0
        damping = damping if damping > _LEAST_DAMPING else 0.0
    return Maximum(here.state, tuple(costs), here, JointInformation(here.system, like=step))


def better_start(problem: BatchProblem, state: State, config: PosteriorConfig, min_depth_m: float) -> State:
    """Return the state with landmarks where they fit better, position or initialisation, or an `IllPosedError`."""
    log = problem.log

    def costs(positions_m: Array) -> Array:
        sight = problem.observations.at(replace(state, positions_m=positions_m))
        visible, s = sight.in_view(min_depth_m), sight.norms()
        cost = np.where(visible & ~np.isnan(s), robust(config, s)[0], np.inf)
        return np.asarray(np.bincount(log.landmark, weights=cost, minlength=log.landmarks), dtype=float)

    here, first = costs(state.positions_m), costs(log.first_position_m)
    hidden = np.isinf(np.minimum(here, first))
    if hidden.any():
        raise IllPosedError("landmarks behind a camera that saw them", log.id[hidden])
    return replace(state, positions_m=np.where((first < here)[:, None], log.first_position_m, state.positions_m))
