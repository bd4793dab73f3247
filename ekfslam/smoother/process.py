"""Factors of the process: its steps, walks of the other blocks, and measurements of blocks by inputs."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from ekfslam.arrays import Array
from ekfslam.errors import IllPosedError
from ekfslam.filters.log import Log
from ekfslam.models.blocks import StateBlock
from ekfslam.models.model import Model
from ekfslam.models.process import Step
from ekfslam.smoother.sparse.factors import Factor, Term
from ekfslam.smoother.unknowns import State, Unknowns, split


class ProcessFactors:
    """Factors of a log that do not concern landmarks; ``has_start`` says that its first inputs start blocks."""

    def __init__(self, log: Log, model: Model, unknowns: Unknowns, has_start: bool = True) -> None:
        self._log, self._model, self._unknowns = log, model, unknowns
        self._started = model.process.started if has_start else ()
        self._own = model.process.columns

    def frozen(self) -> list[Factor]:
        """Return the factors where the filter linearised them."""
        log, u, layout = self._log, self._unknowns, self._model.layout
        Phi = self._predicted.Phi
        # Unknowns count from the coordinates before the first frame.
        mean = log.departed[0]
        error = mean[self._own] - (Phi @ (mean - log.departed[1:])[..., None])[..., 0]
        start = 0
        for name in self._model.process.own:
            size = layout[name].stop - layout[name].start
            if name != "pose":  # its coordinates count from the prediction
                error[:, start : start + size] -= self._predicted.values[name]
            start += size
        by_before, by_after = np.zeros((2, *Phi.shape))
        by_before[..., self._own] = -Phi[..., self._own]
        by_after -= Phi
        by_after[..., self._own] = np.eye(len(self._own))
        step = self._step(error, by_before, by_after)
        shared, aux = (np.broadcast_to(part, (log.frames, len(part))) for part in (u.shared_mean, u.aux_mean))
        return [step, *self._of_blocks(shared, aux, np.zeros(len(u.drive_columns)))]

    def factors(self, state: State) -> list[Factor]:
        """Return the factors linearised at a state."""
        process, values = self._model.process, self._unknowns.all_values(state)
        before = {name: values[name][:-1] for name in process.own}
        after = {name: value[1:] for name, value in values.items()}
        found = process.residual(before, after, self._log.intervals)
        step = self._step(found.error, found.by_before, found.by_after)
        return [step, *self._of_blocks(state.shared, state.aux, state.drive)]

    @cached_property
    def _predicted(self) -> Step:
        """The steps (T-1) as the filter took them."""
        log, layout = self._log, self._model.layout
        values = {block.name: log.departed[1:, layout[block.name]] for block in self._model.blocks}
        values |= split(layout.curved, log.curved[1:])
        values["pose"] = log.T_departed[1:]
        T_from = log.T_predicted[:-1] if log.first_estimates else log.T_departed[1:]
        return self._model.process.step(values, log.intervals, T_from, log.first_estimates)

    def _step(self, error: Array, by_before: Array, by_after: Array) -> Factor:
        """Return the steps of the process from errors (T-1, p) and derivatives (T-1, p, body), see `Residual`."""
        u, W, steps = self._unknowns, self._weight, np.arange(self._log.frames - 1)
        by_before, by_after = W @ by_before, W @ by_after
        terms = [
            Term("frames", steps, by_before[..., u.frame_columns]),
            Term("frames", steps + 1, by_after[..., u.frame_columns]),
            Term("aux", steps + 1, by_after[..., u.aux_columns]),
            Term("drive", 0 * steps, by_after[..., u.drive_columns]),
        ]
        if np.isin(u.aux_columns, self._own).any():
            terms.append(Term("aux", steps, by_before[..., u.aux_columns]))
        return Factor(-(W @ error[..., None])[..., 0], tuple(terms))

    @cached_property
    def _weight(self) -> Array:
        """``Q^-1/2`` (T-1, p, p) of the steps."""
        Q = self._predicted.Q
        std = np.sqrt(np.diagonal(Q, axis1=1, axis2=2))
        scale = np.where(std > 0, std, 1.0)
        smallest = np.linalg.eigvalsh(Q / scale[:, :, None] / scale[:, None, :])[:, 0] if len(Q) else np.empty(0)
        if not (smallest > 0).all():
            raise IllPosedError(
                "velocities without noise (sigma_v or sigma_w is 0) before frames", 1 + np.flatnonzero(~(smallest > 0))
            )
        return np.linalg.inv(np.linalg.cholesky(Q))

    def _of_blocks(self, shared: Array, aux: Array, drive: Array) -> list[Factor]:
        """Return the factors over blocks alone, given their coordinates (T, w-6), (T, a) and (g,)."""
        u = self._unknowns
        factors = [
            *self._walks("frames", u.shared, shared, 6),
            *self._walks("aux", u.aux, aux, 0),
            *self._measured(aux),
        ]
        if len(drive):
            prior = np.linalg.inv(np.linalg.cholesky(u.drive_covariance))
            term = Term("drive", np.zeros(1, dtype=np.int64), prior[None])
            factors.append(Factor(-(prior @ drive)[None], (term,)))
        return factors

    def _walks(self, group: str, blocks: Sequence[StateBlock], x: Array, before: int) -> list[Factor]:
        """Return ``x_{k+1} = phi x_k + noise`` of blocks (T, n) that stand after some columns of their group."""
        walking = [block.transition(0.0, 0.0) is not None for block in blocks]
        if not any(walking):
            return []
        at = np.flatnonzero(np.repeat(walking, [block.size for block in blocks]))
        phi, weight = self._moves([block for block, walks in zip(blocks, walking, strict=True) if walks])
        steps, own = np.arange(len(phi)), np.arange(len(at))
        J, last = np.zeros((2, len(phi), len(at), before + x.shape[1]))
        J[:, own, before + at], last[:, own, before + at] = weight, -weight * phi
        terms = Term(group, steps, last), Term(group, steps + 1, J)
        return [Factor(-weight * (x[1:, at] - phi * x[:-1, at]), terms)]

    def _moves(self, blocks: Sequence[StateBlock]) -> tuple[Array, Array]:
        """Return ``phi`` and weights (T-1, n) of walking blocks; those that the first inputs start begin at frame 1."""
        log, parts = self._log, []
        for block in blocks:
            moves = block.transition(log.tau_s[1:], log.way_m[1:])
            assert moves is not None
            if not (moves[1] > 0).all():
                raise IllPosedError(f"{block.name} without noise: it has no weight before frames", [1])
            phi, weight = (np.broadcast_to(part, (log.frames - 1, block.size)) for part in (moves[0], 1.0 / moves[1]))
            starts = (np.arange(log.frames - 1) == 0)[:, None] & (block.name in self._started)
            parts.append((phi, np.where(starts, 0.0, weight)))
        phi, weight = (np.concatenate(part, axis=1) for part in zip(*parts, strict=True))
        return phi, weight

    def _measured(self, aux: Array) -> list[Factor]:
        """Return the scalar measurements of blocks by inputs."""
        measured, frame = self._log.measured, self._log.measured_frame
        if not len(frame):
            return []
        frame = frame - int(self._model.process.measures_departure)
        J = self._model.process.jacobian(measured)[:, self._unknowns.aux_columns] / measured.std[:, None]
        r = measured.value / measured.std - (J * aux[frame]).sum(axis=1)
        return [Factor(r[:, None], (Term("aux", frame, J[:, None]),))]
