"""Gates: which observations a frame may use. One at a time, against all others, and along the track."""

from __future__ import annotations

import numpy as np
from scipy.special import gammaincinv

from ekfslam import kernels
from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.errors import InnovationError
from ekfslam.filters.gaussian import Rows
from ekfslam.filters.landmarks import LandmarkTable

# Observations of a landmark after which it may be found to move.
SEEN_TO_MOVE = 3


def threshold(probability: float, dimension: int) -> float:
    """Chi-square threshold of a gate for d rows; 1 accepts everything."""
    return 2.0 * float(gammaincinv(dimension / 2.0, probability))


def diagonal(variance: Array) -> Array:
    """V as blocks: variances (n, d) to diagonal matrices (n, d, d)."""
    return variance[:, :, None] * np.eye(variance.shape[1])


def normalised_squares(S: Array, residual: Array, frame: int, ids: IntArray) -> Array:
    """``r_i^T S_i^-1 r_i`` of every landmark: S (n, d, d), residual (n, d) to (n,).

    Raises:
        InnovationError: A block of S is not positive definite; names the frame and the landmarks.
    """
    try:
        return kernels.normalised_squares(S, residual)
    except np.linalg.LinAlgError:
        finite = np.isfinite(S).all(axis=(1, 2), keepdims=True)
        smallest = np.linalg.eigvalsh(np.where(finite, S, 0.0))[:, 0]
        raise InnovationError(frame, ids[smallest <= 0]) from None


def most_given_others(left: Rows, S: Array) -> Array:
    """Return an upper bound (k,) of the squares of `agrees_with_others`: ``e_i^T V^-1 S_i V^-1 e_i``.

    The others can only make an innovation more certain: ``((S^-1)_ii)^-1 <= S_i``. What passes the gate by this bound
    needs no solution for all.

    Args:
        left: The rows with the residuals that the correction leaves.
        S: (k, d, d) covariances of the innovations by themselves.
    """
    y = left.residual / left.variance
    return np.einsum("ni,nij,nj->n", y, S, y)


def agrees_with_others(left: Rows, C: Array) -> tuple[Array, BoolArray]:
    """``e_i^T C_i^-1 e_i`` (k,), the normalised square of each landmark's innovation given all others.

    With ``C_i = V (S^-1)_ii V`` and ``e_i = r_i - H_i (xi, d)``, what the correction leaves, the innovation of
    landmark i given all *others* is ``V C_i^-1 e_i`` with covariance ``V C_i^-1 V``: nothing has to be computed once
    for each landmark left out.

    Args:
        left: The rows with the residuals that the correction leaves.
        C: (k, d, d) in units of the rows' standard deviations, from `Solution.given_others`.

    Returns:
        The squares, and whether (k,) a landmark can be judged: where C is nothing but rounding, no other landmark says
        anything about it, and its square counts as 0.
    """
    return kernels.squares_given_others(C, left.residual, left.variance)


def moves_along(
    table: LandmarkTable,
    slot: IntArray,
    along: Array,
    information: Array,
    squares: Array,
    gate: float,
    sigma: float,
    share: float,
) -> BoolArray:
    """Return which landmarks (k,) travel with the rig or against it, by their whole tracks so far.

    A landmark that moves by a share b of the rig's step between two frames has innovations of mean ``b h``, with h the
    derivative of its rows by a motion of the landmark, times that step. Over a track ``N = sum h^T S^-1 r`` and
    ``D = sum h^T S^-1 h`` estimate b as N / D with standard deviation ``D^-1/2``. Per-frame gates never see it: the
    pose gives way first.

    Args:
        table: Keeps the evidence, which grows.
        slot: (k,) the landmarks.
        along, information: (k,) what this frame adds to N and D.
        squares: (k,) normalised innovations squared; gross outliers count as at the gate.
        gate: Its threshold.
        sigma, share: A landmark moves if b exceeds this many standard deviations, and this share.
    """
    clip = np.sqrt(np.minimum(1.0, gate / np.maximum(squares, 1e-12)))
    table.evidence[slot, 0] += clip * along
    table.evidence[slot, 1] += np.maximum(information, 0.0)
    N, D = table.evidence[slot].T
    least = np.maximum(sigma * np.sqrt(D), share * D)
    return (np.abs(N) > least) & (table.observations[slot] >= SEEN_TO_MOVE)


def evidence_alone(rows: Rows, S: Array, h: Array) -> tuple[Array, Array]:
    """``h^T S^-1 r`` and ``h^T S^-1 h`` (k,) of innovations with covariances S (k, d, d)."""
    weighted = np.linalg.solve(S, h[..., None])[..., 0]
    return (weighted * rows.residual).sum(axis=1), (weighted * h).sum(axis=1)


def evidence_given_others(left: Rows, C: Array, h: Array) -> tuple[Array, Array]:
    """Return ``h^T V^-1 e`` and ``h^T V^-1 C V^-1 h`` (k,) of innovations given all others.

    Arguments as of `agrees_with_others`.
    """
    std = np.sqrt(left.variance)
    g = h / std
    return (g * left.residual / std).sum(axis=1), np.einsum("ni,nij,nj->n", g, C, g)
