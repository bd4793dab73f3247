"""The maximum a posteriori over all poses and landmarks of a log.

Robust kernels act on the norm s of each observation's whitened residual. With width c: Huber ``s^2/2`` up to c and
``c (s - c/2)`` beyond, Cauchy ``c^2/2 log(1 + s^2/c^2)``. Motion and prior are not weighted.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from ekfslam.arrays import Array
from ekfslam.config import Kernel, PosteriorConfig
from ekfslam.errors import IllPosedError
from ekfslam.smoother.problem import BatchProblem, State
from ekfslam.smoother.sparse.information import Elimination, JointInformation


def kernel_cost(kernel: Kernel, width: float, s: Array) -> Array:
    """Cost of whitened residuals of norm s; see the module."""
    if kernel == "huber":
        return np.where(s <= width, 0.5 * s**2, width * (s - 0.5 * width))
    if kernel == "cauchy":
        return 0.5 * width**2 * np.log1p((s / width) ** 2)
    return 0.5 * s**2


def kernel_weight(kernel: Kernel, width: float, s: Array) -> Array:
    """Weight of an observation with a whitened residual of norm s: derivative of the cost divided by s."""
    if kernel == "huber":
        return width / np.maximum(s, width)
    if kernel == "cauchy":
        return 1.0 / (1.0 + (s / width) ** 2)
    return np.ones_like(s)


@dataclass(frozen=True)
class Maximum:
    """Where `maximise` ended.

    Args:
        state: Trajectory and map.
        weight: (K,) robust weight of each observation.
        costs: Cost (half the sum of squares, under the kernel) at the start and after each step.
        information: All rows, relinearised and weighted there.
    """

    state: State
    weight: Array
    costs: tuple[float, ...]
    information: JointInformation


def maximise(
    problem: BatchProblem,
    elimination: Elimination,
    start: State,
    config: PosteriorConfig,
    min_depth_m: float,
    iterations: Iterable[int],
) -> Maximum:
    """Maximum a posteriori of all rows, by Levenberg-Marquardt with iteratively reweighted rows.

    Source: Triggs, McLauchlan, Hartley, Fitzgibbon, "Bundle adjustment - a modern synthesis", 2000, section 4.

    Args:
        problem: What is known.
        elimination: Its structure.
        start: Where to start from; a landmark that fits better at its first triangulation starts from there.
        config: Kernel and tolerance.
        min_depth_m: What is nearer is not in view.
        iterations: Iterated over at most once (a range, wrapped in a progress bar by the caller).

    Raises:
        IllPosedError: Something is undetermined, or a landmark is behind a camera that saw it; names the ids.
    """
    state = _best_start(problem, start, config, min_depth_m)

    def evaluate(state: State) -> tuple[float, Array]:
        """Cost (infinite if a landmark is behind a camera that saw it) and norms of the residuals (K,)."""
        q = problem.points(state)
        if not problem.model.sensor.in_view(q, min_depth_m).all():
            return np.inf, np.empty(0)
        s = np.linalg.norm(problem.observation_residual(q, state), axis=1)
        pixels = kernel_cost(config.kernel, config.kernel_width, s).sum()
        motion = 0.5 * (problem.motion_residual(state) ** 2).sum()
        return float(pixels + motion + problem.block_cost(state)), s

    cost, s = evaluate(state)
    costs, damping, growth, factor = [cost], 1e-7, 2.0, None
    weight = kernel_weight(config.kernel, config.kernel_width, s)
    system = problem.relinearised(state, weight)
    for _ in iterations:
        step = JointInformation(elimination, system, damping, factor)
        factor = step.factor
        moved = problem.moved(state, step)
        new_cost, new_s = evaluate(moved)
        gain = cost - new_cost
        promised = system.half_square - step.cost + 0.5 * damping * step.square
        if not gain >= 0:
            damping, growth = damping * growth, 2.0 * growth
            if promised <= config.tolerance * cost:
                break
            continue
        # Nielsen, "Damping parameter in Marquardt's method", 1999: by how much of what was promised has come.
        share = gain / max(promised, np.finfo(float).tiny)
        damping, growth = damping * max(1 / 3, 1 - (2 * min(share, 1.0) - 1) ** 3), 2.0
        state, cost, s = moved, new_cost, new_s
        costs.append(cost)
        weight = kernel_weight(config.kernel, config.kernel_width, s)
        system = problem.relinearised(state, weight)
        if gain <= config.tolerance * cost:
            break
    return Maximum(state, weight, tuple(costs), JointInformation(elimination, system, factor=factor))


def _best_start(problem: BatchProblem, state: State, config: PosteriorConfig, min_depth_m: float) -> State:
    """The state with every landmark where it fits its observations better: where it is, or at its initialisation.

    Raises:
        IllPosedError: A landmark is behind a camera that saw it in both places; names the ids.
    """
    log = problem.log

    def costs(positions_m: Array) -> Array:
        q = problem.points(replace(state, positions_m=positions_m))
        visible = problem.model.sensor.in_view(q, min_depth_m)
        s = np.linalg.norm(problem.observation_residual(np.where(visible[:, None], q, 1.0), state), axis=1)
        cost = np.where(visible, kernel_cost(config.kernel, config.kernel_width, s), np.inf)
        return np.asarray(np.bincount(log.landmark, weights=cost, minlength=log.landmarks), dtype=float)

    here, first = costs(state.positions_m), costs(log.first_position_m)
    hidden = np.isinf(np.minimum(here, first))
    if hidden.any():
        raise IllPosedError("landmarks behind a camera that saw them", log.id[hidden])
    return replace(state, positions_m=np.where((first < here)[:, None], log.first_position_m, state.positions_m))
