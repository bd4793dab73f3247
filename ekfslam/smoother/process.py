"""Factors of the process: steps of the pose by velocities, walks of the other blocks, and measured velocities."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from ekfslam.arrays import Array
from ekfslam.errors import IllPosedError
from ekfslam.filters.log import Log
from ekfslam.geometry import motion, se3
from ekfslam.models.blocks import StateBlock
from ekfslam.models.model import Model
from ekfslam.models.process import Measured
from ekfslam.smoother.sparse.factors import Factor, Term
from ekfslam.smoother.unknowns import State, Unknowns, split


class ProcessFactors:
    """Factors of a log that do not concern landmarks.

    Args:
        log: Record of the filter.
        model: Its blocks and noise.
        unknowns: Groups of the blocks.
    """

    def __init__(self, log: Log, model: Model, unknowns: Unknowns) -> None:
        self._log, self._model, self._unknowns = log, model, unknowns
        self._pose = model.layout["pose"]

    def frozen(self) -> list[Factor]:
        """Return the factors where the filter linearised them."""
        log, u = self._log, self._unknowns
        Phi = self._frozen_transition()
        zeros = np.zeros((log.frames, u.width - 6)), np.zeros((log.frames, len(u.aux_columns)))
        step = self._step((Phi @ log.departed[1:, :, None])[..., 0], Phi)
        return [step, *self._of_blocks(*zeros, np.zeros(len(u.drive_columns)))]

    def factors(self, state: State) -> list[Factor]:
        """Return the factors linearised at a state."""
        log, T = self._log, state.T_imu_world
        twist, by = self._model.imu_velocities(self._values_before(state), log.twist[1:], T[:-1, :3, :3])
        E = motion.increment(twist, log.tau_s[1:])
        e = se3.log(T[1:] @ se3.inverse(E @ T[:-1]))
        Phi = -motion.twist_jacobian(twist, log.tau_s[1:]) @ by
        Phi[..., self._pose] += motion.error_jacobian(E)
        # d log(exp(e^) exp(a^)) and d log(exp(a^) exp(e^)) by a, at a = 0.
        step = self._step(e, se3.left_jacobian_inverse(-e) @ Phi, se3.left_jacobian_inverse(e))
        return [step, *self._of_blocks(state.shared, state.aux, state.drive)]

    def _values_before(self, state: State) -> dict[str, Array]:
        """Return values of all blocks as steps (T-1,) take them: the pose before the step, all others during it."""
        values = {name: value[1:] for name, value in split(self._unknowns.aux, state.aux).items()}
        for name, value in state.drive_values.items():
            values[name] = np.broadcast_to(value, (self._log.frames - 1, *value.shape))
        return {**values, "pose": state.T_imu_world[:-1]}

    def _frozen_transition(self) -> Array:
        """Return Phi (T-1, 6, body) of the steps, where the filter took it."""
        log, layout = self._log, self._model.layout
        T_from = log.T_predicted[:-1] if log.first_estimates else log.T_departed[1:]
        values = {block.name: log.departed[1:, layout[block.name]] for block in self._model.blocks}
        values |= {"pose": log.T_departed[1:], "up": log.up[1:]}
        _, by = self._model.imu_velocities(values, log.twist[1:], T_from[:, :3, :3])
        Phi = -motion.twist_jacobian(log.imu_twist[1:], log.tau_s[1:]) @ by
        Phi[..., self._pose] += motion.error_jacobian(log.T_predicted[1:] @ se3.inverse(T_from))
        return Phi

    def _step(self, e: Array, Phi: Array, by_next: Array | None = None) -> Factor:
        """Return the steps of the pose, eq. (1) and (2).

        Args:
            e: (T-1, 6) errors.
            Phi: (T-1, 6, body) minus their derivatives by the blocks before; of aux by those during the step.
            by_next: (T-1, 6, 6) their derivatives by the pose after; None: the identity.
        """
        u, W, steps = self._unknowns, self._weight, np.arange(self._log.frames - 1)
        WPhi = -W @ Phi
        J_from, J_to = np.zeros((2, len(W), 6, u.width))
        J_from[..., :6], J_to[..., :6] = WPhi[..., self._pose], W if by_next is None else W @ by_next
        terms = (
            Term("frames", steps, J_from),
            Term("frames", steps + 1, J_to),
            Term("aux", steps + 1, WPhi[..., u.aux_columns]),
            Term("drive", 0 * steps, WPhi[..., u.drive_columns]),
        )
        return Factor(-(W @ e[..., None])[..., 0], terms)

    @cached_property
    def _weight(self) -> Array:
        """``Q^-1/2`` (T-1, 6, 6) of eq. (2)."""
        log = self._log
        Q = self._model.process_noise(log.imu_twist[1:], log.tau_s[1:], log.is_gap[1:])
        smallest = np.linalg.eigvalsh(Q)[:, 0] if len(Q) else np.empty(0)
        if not (smallest > 0).all():
            raise IllPosedError(
                "velocities without noise (sigma_v or sigma_w is 0) before frames",
                1 + np.flatnonzero(~(smallest > 0)),
            )
        return np.linalg.inv(np.linalg.cholesky(Q))

    def _of_blocks(self, shared: Array, aux: Array, drive: Array) -> list[Factor]:
        """Return the factors over blocks alone, given their coordinates (T, w-6), (T, a) and (g,)."""
        u = self._unknowns
        factors = [
            *self._walks("frames", u.shared, shared, 6),
            *self._walks("aux", u.aux, aux, 0),
            *self._measured_velocities(aux),
        ]
        if len(drive):
            prior = 1.0 / np.sqrt(np.diag(self._model.prior_covariance)[u.drive_columns])
            term = Term("drive", np.zeros(1, dtype=np.int64), np.diag(prior)[None])
            factors.append(Factor(-(prior * drive)[None], (term,)))
        return factors

    def _walks(self, group: str, blocks: Sequence[StateBlock], x: Array, before: int) -> list[Factor]:
        """Return ``x_{k+1} = phi x_k + noise`` of blocks (T, n) that stand after some columns of their group."""
        if not blocks:
            return []
        phi, weight = self._moves(blocks)
        steps, n = np.arange(len(phi)), x.shape[1]
        J = np.zeros((len(phi), n, before + n))
        J[..., before:] = weight[:, :, None] * np.eye(n)
        last = J.copy()
        last[..., before:] *= -phi[:, :, None]
        terms = Term(group, steps, last), Term(group, steps + 1, J)
        return [Factor(-weight * (x[1:] - phi * x[:-1]), terms)]

    def _moves(self, blocks: Sequence[StateBlock]) -> tuple[Array, Array]:
        """Return ``phi`` and weights (T-1, n) of walking blocks; the twist starts at frame 1."""
        log, way_m = self._log, self._model.way_m(self._log.twist, self._log.tau_s)
        parts = []
        for block in blocks:
            moves = block.transition(log.tau_s[1:], way_m[1:])
            assert moves is not None
            if not (moves[1] > 0).all():
                raise IllPosedError(f"{block.name} without noise: it has no weight before frames", [1])
            phi, weight = (np.broadcast_to(part, (log.frames - 1, block.size)) for part in (moves[0], 1.0 / moves[1]))
            starts = (np.arange(log.frames - 1) == 0)[:, None] & (block.name == "twist")
            parts.append((phi, np.where(starts, 0.0, weight)))
        phi, weight = (np.concatenate(part, axis=1) for part in zip(*parts, strict=True))
        return phi, weight

    def _measured_velocities(self, aux: Array) -> list[Factor]:
        """Return the scalar measurements of velocities, where these are unknowns."""
        log = self._log
        rows = Measured(log.velocity_axis, log.velocity_value, log.velocity_std, log.velocity_is_biased)
        if not len(rows.axis):
            return []
        J = self._model.velocity_jacobian(rows)[:, self._unknowns.aux_columns] / rows.std[:, None]
        r = rows.value / rows.std - (J * aux[log.velocity_frame]).sum(axis=1)
        return [Factor(r[:, None], (Term("aux", log.velocity_frame, J[:, None]),))]
