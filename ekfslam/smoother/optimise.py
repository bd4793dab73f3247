"""The maximum a posteriori over all poses and landmarks of a log.

Robust kernels act on the norm s of each observation's whitened residual. With width c: Huber ``s^2/2`` up to c and
``c (s - c/2)`` beyond, Cauchy ``c^2/2 log(1 + s^2/c^2)``. Motion and prior are not weighted.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from ekfslam.arrays import Array
from ekfslam.config import FilterConfig, Kernel, PosteriorConfig
from ekfslam.errors import IllPosedError
from ekfslam.smoother.problem import Rows, State
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
    rows: Rows,
    elimination: Elimination,
    start: State,
    config: PosteriorConfig,
    filter_config: FilterConfig,
    iterations: Iterable[int],
) -> Maximum:
    """Maximum a posteriori of all rows, by Levenberg-Marquardt with iteratively reweighted rows.

    Source: Triggs, McLauchlan, Hartley, Fitzgibbon, "Bundle adjustment - a modern synthesis", 2000, section 4.

    Args:
        rows: What is known.
        elimination: Its structure.
        start: Where to start from; a landmark that fits better at its first triangulation starts from there.
        config: Kernel and tolerance.
        filter_config: Says what is in view.
        iterations: Iterated over at most once (a range, wrapped in a progress bar by the caller).

    Raises:
        IllPosedError: Something is undetermined, or a landmark is behind a camera that saw it; names the ids.
    """
    state = _best_start(rows, start, config, filter_config)

    def evaluate(state: State) -> tuple[float, Array]:
        """Cost (infinite if a landmark is behind a camera that saw it) and norms of the residuals (K,)."""
        q = rows.points(state)
        if not rows.sensor.in_view(q, filter_config).all():
            return np.inf, np.empty(0)
        s = np.linalg.norm(rows.observation_residual(q), axis=1)
        pixels = kernel_cost(config.kernel, config.kernel_width, s).sum()
        return float(pixels + 0.5 * (rows.motion_residual(state) ** 2).sum() + 0.5 * (state.zeta**2).sum()), s

    cost, s = evaluate(state)
    costs, damping, growth, factor = [cost], 1e-7, 2.0, None
    weight = kernel_weight(config.kernel, config.kernel_width, s)
    system = rows.relinearised(state, weight)
    for _ in iterations:
        step = JointInformation(elimination, system, damping, factor)
        factor = step.factor
        moved = rows.moved(state, step.eps, step.d, step.zeta)
        new_cost, new_s = evaluate(moved)
        gain = cost - new_cost
        promised = system.half_square - step.cost + 0.5 * damping * float((step.eps**2).sum() + (step.d**2).sum())
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
        system = rows.relinearised(state, weight)
        if gain <= config.tolerance * cost:
            break
    return Maximum(state, weight, tuple(costs), JointInformation(elimination, system, factor=factor))


def _best_start(rows: Rows, state: State, config: PosteriorConfig, filter_config: FilterConfig) -> State:
    """The state with every landmark where it fits its observations better: where it is, or at its first triangulation.

    Raises:
        IllPosedError: A landmark is behind a camera that saw it in both places; names the ids.
    """
    log = rows.log

    def costs(positions_m: Array) -> Array:
        q = rows.points(replace(state, positions_m=positions_m))
        visible = rows.sensor.in_view(q, filter_config)
        s = np.linalg.norm(rows.observation_residual(np.where(visible[:, None], q, 1.0)), axis=1)
        cost = np.where(visible, kernel_cost(config.kernel, config.kernel_width, s), np.inf)
        return np.asarray(np.bincount(log.landmark, weights=cost, minlength=log.landmarks), dtype=float)

    here, first = costs(state.positions_m), costs(log.first_position_m)
    hidden = np.isinf(np.minimum(here, first))
    if hidden.any():
        raise IllPosedError("landmarks behind a camera that saw them", log.id[hidden])
    return replace(state, positions_m=np.where((first < here)[:, None], log.first_position_m, state.positions_m))
