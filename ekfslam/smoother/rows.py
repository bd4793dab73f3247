"""What the rows of the batch problem have in common, wherever they are linearised."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as SequenceType
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.errors import IllPosedError
from ekfslam.filters.log import Log
from ekfslam.models.blocks import StateBlock
from ekfslam.models.model import Model
from ekfslam.models.process import Measured
from ekfslam.smoother.sparse.information import Elimination


@dataclass(frozen=True)
class State:
    """A trajectory, a map, and the other blocks.

    Args:
        T_imu_world: (T, 4, 4) poses.
        positions_m: (M, 3) landmarks in world.
        zeta: (w,) the first frame in units of its prior: ``T_0 = exp((B zeta)^) T_prior``, and shared blocks likewise.
        shared: (T, w-6) values of the blocks of a frame, besides its pose, that observations depend on.
        aux: (T, a) coordinates of the blocks that each frame has besides; they are vectors, so their values.
        drive: (g,) coordinates of the blocks of the drive: sums of corrections.
        drive_values: Values of the blocks of the drive, by name.
    """

    T_imu_world: Array
    positions_m: Array
    zeta: Array
    shared: Array
    aux: Array
    drive: Array
    drive_values: Mapping[str, Array]


class BatchRows:
    """The structure of a log, and its rows over blocks alone.

    Args:
        log: What the filter conditioned on.
        model: Its blocks, sensor and noise.
    """

    def __init__(self, log: Log, model: Model) -> None:
        self.log, self.model = log, model
        layout = model.layout
        self.shared_blocks = list(model.shared)
        self.aux_blocks = [block for block in layout.blocks if block.per_frame and not block.is_seen]
        of_drive = (block for block in layout.blocks if not block.per_frame and not block.clones)
        self.drive_blocks = [block for block in of_drive if not block.is_pose]
        self.frame_columns = layout.columns(["pose", *(block.name for block in self.shared_blocks)])
        self.width = len(self.frame_columns)
        # Symmetric root of the first frame's covariance, which may be singular.
        self.B = np.zeros((self.width, self.width))
        eigenvalues, vectors = np.linalg.eigh(log.initial_covariance)
        self.B[:6, :6] = (vectors * np.sqrt(np.maximum(eigenvalues, 0.0))) @ vectors.T
        own = np.arange(6, self.width)
        self.B[own, own] = np.sqrt(np.diag(model.prior_covariance)[self.frame_columns[6:]])
        self.aux_columns = layout.columns(block.name for block in self.aux_blocks)
        self.drive_columns = layout.columns(block.name for block in self.drive_blocks)
        self._pose, self._clone = layout["pose"], layout.get("previous_pose")
        self._way_m = model.way_m(log.twist, log.tau_s)
        # Where the clones are, and which of a frame's columns they clone.
        at = dict(zip(self.frame_columns.tolist(), range(self.width), strict=True))
        names = [name for name in layout.clones if name == "pose" or layout[name].start in at]
        self._clone_columns = layout.columns(layout.clones[name] for name in names)
        self._cloned = np.array([at[column] for column in layout.columns(names).tolist()], dtype=np.int64)

    @property
    def cloned(self) -> tuple[IntArray, IntArray]:
        """Which of a frame's columns (c,) the filter has clones of, and in which columns (c,) of the body these are."""
        return self._cloned, self._clone_columns

    def elimination(self) -> Elimination:
        """The structure of the rows."""
        log = self.log
        return Elimination(
            log.frames,
            log.landmarks,
            log.frame,
            log.landmark,
            log.id,
            len(self.aux_columns),
            len(self.drive_columns),
            width=self.width,
        )

    # --- what does not depend on where the rows are linearised --------------------------------------------------------

    @cached_property
    def _weight_motion(self) -> Array:
        """``Q^-1/2`` (T-1, 6, 6) of eq. (2)."""
        log = self.log
        Q = self.model.process_noise(log.imu_twist[1:], log.tau_s[1:], log.is_gap[1:])
        smallest = np.linalg.eigvalsh(Q)[:, 0] if len(Q) else np.empty(0)
        if not (smallest > 0).all():
            raise IllPosedError(
                "velocities without noise (sigma_v or sigma_w is 0) before frames",
                1 + np.flatnonzero(~(smallest > 0)),
            )
        return np.linalg.inv(np.linalg.cholesky(Q))

    @cached_property
    def is_initial(self) -> BoolArray:
        """Whether (K,) an observation is the one that initialised its landmark."""
        _, first = np.unique(self.log.landmark, return_index=True)
        is_first = np.zeros(self.log.observations, dtype=bool)
        is_first[first] = True
        return is_first

    @cached_property
    def _first_frame(self) -> IntArray:
        """(M,) frame of each landmark's first observation."""
        frame = np.empty(self.log.landmarks, dtype=np.int64)
        frame[self.log.landmark[self.is_initial]] = self.log.frame[self.is_initial]
        return frame

    @cached_property
    def _follows(self) -> IntArray:
        """Observations that are differences from the one before."""
        return np.flatnonzero(self.log.previous >= 0)

    @cached_property
    def _velocities(self) -> Measured:
        log = self.log
        return Measured(log.velocity_axis, log.velocity_value, log.velocity_std, log.velocity_is_biased)

    @cached_property
    def _aux_moves(self) -> tuple[Array, Array]:
        return self._moves(self.aux_blocks)

    @cached_property
    def _shared_moves(self) -> tuple[Array, Array]:
        return self._moves(self.shared_blocks)

    def _moves(self, blocks: SequenceType[StateBlock]) -> tuple[Array, Array]:
        """``phi`` and weights (T-1, n) of what blocks of a frame do by themselves; the twist starts at frame 1."""
        phi, weight = np.empty((2, self.log.frames - 1, sum(block.size for block in blocks)))
        start = 0
        for block in blocks:
            moves = block.transition(self.log.tau_s[1:], self._way_m[1:])
            assert moves is not None
            at = slice(start, start + block.size)
            start = at.stop
            if not (moves[1] > 0).all():
                raise IllPosedError(f"{block.name} without noise: it has no weight before frames", [1])
            phi[:, at], weight[:, at] = moves[0], 1.0 / moves[1]
            if block.name == "twist":
                weight[:1, at] = 0.0
        return phi, weight

    def _common(self, aux: Array, drive: Array) -> dict[str, Any]:
        """Rows over aux and drive alone, whose right sides are what coordinates (T, a) and (g,) leave."""
        phi, weight = self._aux_moves
        prior = np.diag(self.model.prior_covariance)
        aux_std = prior[self.aux_columns] ** 0.5
        # What nothing is known of at frame 0 (the twist) is a certain 0 there: nothing depends on it.
        aux_prior = np.where(aux_std > 0, 1.0 / np.where(aux_std > 0, aux_std, 1.0), 1.0)
        drive_prior = 1.0 / np.sqrt(prior[self.drive_columns])
        velocities = self._velocities
        if len(velocities.axis):
            J = self.model.velocity_jacobian(velocities)[:, self.aux_columns] / velocities.std[:, None]
        else:
            J = np.empty((0, len(self.aux_columns)))
        at = self.log.velocity_frame
        return {
            "aux_prior": aux_prior,
            "r_aux_prior": -aux_prior * aux[0],
            "phi": phi,
            "aux_weight": weight,
            "r_aux": -weight * (aux[1:] - phi * aux[:-1]),
            "at": at,
            "J_at": J,
            "r_at": velocities.value / velocities.std - (J * aux[at]).sum(axis=1),
            "drive_prior": drive_prior,
            "r_drive": -drive_prior * drive,
        }

    def _motion_rows(self, Phi: Array, by_last: Array, by_next: Array, B: Array) -> dict[str, Any]:
        """Rows of the steps over poses and shared blocks.

        Args:
            Phi: (T-1, 6, body) transition of the pose.
            by_last, by_next: (T-1, 6, 6) derivatives of the residual.
            B: (w, w) of the first frame.
        """
        W, (phi, weight) = self._weight_motion, self._shared_moves
        WPhi, own = -W @ by_last @ Phi, np.arange(6, self.width)
        J_from, J_to = np.zeros((2, len(W), self.width, self.width))
        J_from[:, :6, :6], J_from[:, own, own] = WPhi[..., self._pose], -weight * phi
        J_to[:, :6, :6], J_to[:, own, own] = W @ by_next, weight
        J_from[:1] = J_from[:1] @ B
        padding = ((0, 0), (0, self.width - 6), (0, 0))
        return {
            "J_from": J_from,
            "J_to": J_to,
            "J_motion_aux": np.pad(WPhi[..., self.aux_columns], padding),
            "J_motion_drive": np.pad(WPhi[..., self.drive_columns], padding),
        }

    def _shared_residual(self, shared: Array) -> Array:
        """Whitened errors (T-1, w-6) of what shared blocks (T, w-6) do by themselves."""
        phi, weight = self._shared_moves
        return weight * (shared[1:] - phi * shared[:-1])

    def _over_previous(self, H_x: Array) -> Array:
        """Rows (n, d, seen) over clones as rows (n, d, w) over the frame before."""
        J = np.zeros((*H_x.shape[:2], self.width))
        J[..., self._cloned] = H_x[..., self._clone_columns]
        return J

    def _observation_rows(
        self, J_x: Array, J_p: Array | None, J_g: Array, J_m: Array, r: Array, scale: Array, B: Array
    ) -> dict[str, Any]:
        """Rows of the observations scaled by (K, d); those over the first pose become rows over zeta."""
        log, wide = self.log, scale[..., None]

        def over_zeta(J: Array, frame: IntArray) -> Array:
            J = wide * J
            which = np.flatnonzero(frame == 0)
            J[which] = J[which] @ B
            return J

        return {
            "landmarks": log.landmarks,
            "B": B,
            "frame": log.frame,
            "landmark": log.landmark,
            "previous": log.previous,
            "J_x": over_zeta(J_x, log.frame),
            "J_p": None if J_p is None else over_zeta(J_p, log.frame - 1),
            "J_g": wide * J_g,
            "J_m": wide * J_m,
            "r": scale * r,
        }

    @property
    def _memory(self) -> float:
        error = self.model.track_error
        return 0.0 if error is None else error.memory
