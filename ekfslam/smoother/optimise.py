"""Maximum a posteriori over all poses and landmarks of a log.

Robust kernels act on the norm s of each observation's whitened residual. With width c: Huber ``s^2/2`` up to c and
``c (s - c/2)`` beyond, Cauchy ``c^2/2 log(1 + s^2/c^2)``. Process and prior are not weighted.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from ekfslam.arrays import Array
from ekfslam.config import Kernel, PosteriorConfig
from ekfslam.errors import IllPosedError
from ekfslam.smoother.problem import BatchProblem, State
from ekfslam.smoother.sparse.factors import LinearSystem
from ekfslam.smoother.sparse.information import JointInformation

MOST_ITERATIONS = 50


def kernel_cost(kernel: Kernel, width: float, s: Array) -> Array:
    """Return the cost of whitened residuals of norm s; see the module."""
    if kernel == "huber":
        return np.where(s <= width, 0.5 * s**2, width * (s - 0.5 * width))
    if kernel == "cauchy":
        return 0.5 * width**2 * np.log1p((s / width) ** 2)
    return 0.5 * s**2


def kernel_weight(kernel: Kernel, width: float, s: Array) -> Array:
    """Return the weight of an observation with a whitened residual of norm s: derivative of the cost divided by s."""
    if kernel == "huber":
        return width / np.maximum(s, width)
    if kernel == "cauchy":
        return 1.0 / (1.0 + (s / width) ** 2)
    return np.ones_like(s)


@dataclass(frozen=True)
class Evaluation:
    """A problem at a state.

    Args:
        state: Trajectory and map.
        cost: Half the sum of squares, under the kernel.
        weight: (K,) robust weight of each observation.
        system: All factors, linearised and weighted there.
    """

    state: State
    cost: float
    weight: Array
    system: LinearSystem


@dataclass(frozen=True)
class Maximum:
    """Result of `maximise`.

    Args:
        state: Trajectory and map.
        weight: (K,) robust weight of each observation.
        costs: Cost (half the sum of squares, under the kernel) at the start and after each step.
        information: All factors, relinearised and weighted there.
    """

    state: State
    weight: Array
    costs: tuple[float, ...]
    information: JointInformation


def evaluate(problem: BatchProblem, state: State, config: PosteriorConfig, min_depth_m: float) -> Evaluation | None:
    """Return cost and system at a state; None if a landmark is behind a camera that saw it."""
    if not problem.model.sensor.in_view(problem.observations.points(state), min_depth_m).all():
        return None
    system = problem.relinearised(state)
    s = system.norms(problem.log.observations)
    of_observations = kernel_cost(config.kernel, config.kernel_width, s).sum()
    cost = float(of_observations + system.half_square - 0.5 * (s**2).sum())
    if config.kernel == "none":
        return Evaluation(state, cost, np.ones_like(s), system)
    weight = kernel_weight(config.kernel, config.kernel_width, s)
    return Evaluation(state, cost, weight, system.weighted(weight))


def maximise(
    problem: BatchProblem,
    start: State,
    config: PosteriorConfig,
    min_depth_m: float,
    iterations: Iterable[int],
) -> Maximum:
    """Find the maximum a posteriori of all factors, by Levenberg-Marquardt with iteratively reweighted factors.

    Source: Triggs, McLauchlan, Hartley, Fitzgibbon, "Bundle adjustment - a modern synthesis", 2000, section 4.

    Args:
        problem: Everything known.
        start: State to start from; a landmark that fits better at its first triangulation starts from there.
        config: Kernel and tolerance.
        min_depth_m: Least depth of a landmark in view.
        iterations: Iterated over at most once (a range, wrapped in a progress bar by the caller).

    Raises:
        IllPosedError: Something is undetermined, or a landmark is behind a camera that saw it; names the ids.
    """
    here = evaluate(problem, better_start(problem, start, config, min_depth_m), config, min_depth_m)
    assert here is not None
    costs, damping, growth, step = [here.cost], 1e-7, 2.0, None
    for _ in iterations:
        step = JointInformation(here.system, damping, like=step)
        there = evaluate(problem, problem.moved(here.state, step), config, min_depth_m)
        gain = here.cost - there.cost if there else -np.inf
        if there is None or not gain >= 0:
            damping, growth = damping * growth, 2.0 * growth
            if step.gain <= config.tolerance * here.cost:
                break
            continue
        # Nielsen, "Damping parameter in Marquardt's method", 1999: by how much of what was promised has come.
        share = gain / max(step.gain, np.finfo(float).tiny)
        damping, growth = damping * max(1 / 3, 1 - (2 * min(share, 1.0) - 1) ** 3), 2.0
        here = there
        costs.append(here.cost)
        if gain <= config.tolerance * here.cost:
            break
    return Maximum(here.state, here.weight, tuple(costs), JointInformation(here.system, like=step))


def better_start(problem: BatchProblem, state: State, config: PosteriorConfig, min_depth_m: float) -> State:
    """Return the state with every landmark where it fits its observations better: as it is, or at its initialisation.

    Raises:
        IllPosedError: A landmark is behind a camera that saw it in both places; names the ids.
    """
    log = problem.log

    def costs(positions_m: Array) -> Array:
        moved = replace(state, positions_m=positions_m)
        visible = problem.model.sensor.in_view(problem.observations.points(moved), min_depth_m)
        with np.errstate(all="ignore"):
            s = problem.observations.norms(moved)
        cost = np.where(visible & ~np.isnan(s), kernel_cost(config.kernel, config.kernel_width, s), np.inf)
        return np.asarray(np.bincount(log.landmark, weights=cost, minlength=log.landmarks), dtype=float)

    here, first = costs(state.positions_m), costs(log.first_position_m)
    hidden = np.isinf(np.minimum(here, first))
    if hidden.any():
        raise IllPosedError("landmarks behind a camera that saw them", log.id[hidden])
    return replace(state, positions_m=np.where((first < here)[:, None], log.first_position_m, state.positions_m))
