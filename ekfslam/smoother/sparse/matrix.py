"""The information matrix of a `LinearSystem` as one sparse matrix, for those who want to solve with it themselves."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from ekfslam.arrays import Array, IntArray
from ekfslam.errors import PosteriorError
from ekfslam.smoother.sparse.information import LinearSystem

_SINGULAR = 1e-12


class _Rows:
    """Whitened rows J, block by block."""

    def __init__(self) -> None:
        self._count = 0
        self._row: list[IntArray] = []
        self._column: list[IntArray] = []
        self._value: list[Array] = []

    def add(self, *blocks: tuple[IntArray | int, Array]) -> None:
        """Rows of n steps: each of the blocks (n, height, width) begins at its columns (n,)."""
        n, height = blocks[0][1].shape[:2]
        first = self._count + height * np.arange(n)
        for start, block in blocks:
            at = first[:, None, None] + np.arange(height)[:, None]
            column = np.broadcast_to(start, (n,))[:, None, None] + np.arange(block.shape[2])
            self._row.append(np.broadcast_to(at, block.shape).ravel())
            self._column.append(np.broadcast_to(column, block.shape).ravel())
            self._value.append(block.ravel())
        self._count += n * height

    def matrix(self, width: int) -> sp.csr_array:
        """J, as many columns wide."""
        entries = np.concatenate(self._row), np.concatenate(self._column)
        return sp.csr_array((np.concatenate(self._value), entries), shape=(self._count, width))


def whitened_rows(system: LinearSystem, frames: int) -> sp.csr_array:
    """J over zeta, eps_1, ..., aux_0, ..., drive, d_0, ...: ``J^T J`` is their information."""
    w, a, g = len(system.B), len(system.aux_prior), len(system.drive_prior)
    at_aux, at_drive = w * frames, (w + a) * frames
    at_landmarks, step = at_drive + g, np.arange(frames - 1)
    rows = _Rows()
    rows.add((0, np.eye(w)[None]))
    rows.add(
        (w * step, system.J_from),
        (w * (step + 1), system.J_to),
        (at_aux + a * (step + 1), system.J_motion_aux),
        (at_drive, system.J_motion_drive),
    )
    seen = (w * system.frame, system.J_x), (at_landmarks + 3 * system.landmark, system.J_m), (at_drive, system.J_g)
    if system.J_p is None:
        rows.add(*seen)
    else:
        follows = system.previous >= 0
        J_p = np.where(follows[:, None, None], system.J_p, 0.0)
        rows.add(*seen, (w * np.maximum(system.frame - 1, 0), J_p))
    rows.add(
        (
            at_landmarks + 3 * np.arange(system.landmarks),
            _diagonal(np.full((system.landmarks, 3), system.landmark_weight)),
        )
    )
    if a:
        rows.add((at_aux, np.diag(system.aux_prior)[None]))
        by_last = (at_aux + a * step, _diagonal(-system.aux_weight * system.phi))
        rows.add(by_last, (at_aux + a * (step + 1), _diagonal(system.aux_weight)))
        rows.add((at_aux + a * system.at, system.J_at[:, None]))
    if g:
        rows.add((at_drive, np.diag(system.drive_prior)[None]))
    return rows.matrix(at_landmarks + 3 * system.landmarks)


def information_matrix(system: LinearSystem, frames: int) -> tuple[sp.csc_array, IntArray]:
    """Information of ``eps_0, eps_1, ..., aux, drive, d``, and which of these (n,) are its columns.

    What is known for certain of the first frame (a zero row of B) has no finite information, and no column.

    Raises:
        PosteriorError: What is known for certain of it is no axis.
    """
    J, w = whitened_rows(system, frames), len(system.B)
    known = np.flatnonzero(np.abs(system.B).max(axis=1) > 0)
    B = system.B[known]
    scales = np.linalg.svd(B, compute_uv=False)
    if len(known) and scales[-1] <= _SINGULAR * scales[0]:
        raise PosteriorError(
            "the first pose is known for certain in a direction that is no axis: no information matrix"
        )
    # eps_0 = B zeta, and of zeta nothing else is seen.
    of_zeta = np.linalg.pinv(B) if len(known) else np.empty((w, 0))
    J = sp.hstack([J[:, :w] @ sp.csr_array(of_zeta), J[:, w:]])
    return sp.csc_array(J.T @ J), np.concatenate([known, np.arange(w, w - len(known) + J.shape[1])])


def _diagonal(values: Array) -> Array:
    """Diagonal matrices (n, k, k) of (n, k)."""
    return values[:, :, None] * np.eye(values.shape[1])
