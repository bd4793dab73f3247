"""Whitened innovations: of each observation by itself, and apart from the motion of the camera they agree on.

With S the joint innovation covariance of a frame's accepted rows r, and J their derivative by the pose's error
(difference rows of eq. (10) included), the motion xi of the camera on which the frame's innovations agree best has

    score c = J^T S^-1 r,  cov c = C = J^T S^-1 J,  xi = C^-1 c,  cov xi = C^-1

If the model is true, c is white over frames with covariance C, and ``r^T S^-1 r - c^T C^-1 c`` is chi-square and
independent of it. The score needs no S: ``S^-1 r = V^-1 e`` with e what the correction (6) leaves of r.
"""

from __future__ import annotations

from collections.abc import Sequence as SequenceType
from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.filters.gates import LEAST_SHARE
from ekfslam.filters.gaussian import Rows, Solution
from ekfslam.filters.result import WhitenedInnovations


@dataclass(frozen=True)
class FrameInnovations:
    """`WhitenedInnovations` of one frame's k accepted observations, with rows of the log (k,) for their landmarks."""

    landmark: IntArray
    alone: Array
    apart: Array
    score: Array
    information: Array

    @staticmethod
    def none(dimension: int) -> FrameInnovations:
        """Return the innovations of a frame without any."""
        rows = np.empty((0, dimension))
        return FrameInnovations(np.empty(0, dtype=np.int64), rows, rows, np.zeros(6), np.zeros((6, 6)))


def innovations_of(solution: Solution, landmark: IntArray, rows: Rows, S: Array, left: Array) -> FrameInnovations:
    """Return the innovations of a frame: rows of landmarks (k,), S (k, d, d), and residuals ``left`` (k, d)."""
    if not len(landmark):
        return FrameInnovations.none(rows.residual.shape[1])
    k, d = rows.residual.shape
    J = rows.H_x[..., :6]
    information = solution.information(J)
    score = J.reshape(k * d, 6).T @ (left / rows.variance).ravel()
    shared = _inverse(information)
    S_apart, apart = S - J @ shared @ J.swapaxes(1, 2), rows.residual - J @ (shared @ score)
    both = whitened(np.concatenate([S, S_apart]), np.concatenate([rows.residual, apart]))
    return FrameInnovations(landmark, both[:k], both[k:], score, information)


def whitened(S: Array, residual: Array) -> Array:
    """Return ``L_i^-1 r_i`` with ``S_i = L_i L_i^T``: (k, d, d) and (k, d) to (k, d); NaN where S_i is singular.

    Rows of S that are (uL, v, uR) and those that are (u, v, disparity) come out alike: u, v, and what the last row adds
    to u, which is the disparity.
    """
    std = np.sqrt(np.maximum(np.diagonal(S, axis1=1, axis2=2), np.finfo(float).tiny))
    with np.errstate(over="ignore"):
        correlation = S / (std[:, :, None] * std[:, None, :])
    finite = np.isfinite(correlation).all(axis=(1, 2))
    correlation = np.where(finite[:, None, None], correlation, 0.0)
    definite = np.linalg.eigvalsh(correlation)[:, 0] > LEAST_SHARE
    L = np.linalg.cholesky(np.where(definite[:, None, None], correlation, np.eye(S.shape[1])))
    solved = np.linalg.solve(L, (residual / std)[..., None])[..., 0]
    return np.where(definite[:, None], solved, np.nan)


def _inverse(information: Array) -> Array:
    """Return the inverse of an information matrix (6, 6); NaN if it leaves a direction undetermined."""
    std = np.sqrt(np.maximum(np.diagonal(information), np.finfo(float).tiny))
    values, axes = np.linalg.eigh(information / np.outer(std, std))
    if not values[0] > 1e-12:
        return np.full((6, 6), np.nan)
    return (axes / values) @ axes.T / np.outer(std, std)


def collect_innovations(frames: SequenceType[FrameInnovations]) -> WhitenedInnovations:
    """Return the innovations of a run as flat arrays."""
    return WhitenedInnovations(
        frame=np.repeat(np.arange(len(frames)), [len(frame.landmark) for frame in frames]),
        landmark=np.concatenate([frame.landmark for frame in frames]),
        alone=np.concatenate([frame.alone for frame in frames]),
        apart=np.concatenate([frame.apart for frame in frames]),
        score=np.array([frame.score for frame in frames]),
        information=np.array([frame.information for frame in frames]),
    )
