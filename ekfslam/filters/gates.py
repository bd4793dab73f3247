"""Gates: which observations a frame may use. One at a time, against all others, and along the track."""

from __future__ import annotations

import numpy as np
from scipy.special import gammaincinv

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.errors import InnovationError
from ekfslam.filters.gaussian import Gaussian, Rows
from ekfslam.filters.landmarks import LandmarkTable

# Observations of a landmark after which it may be found to move.
SEEN_TO_MOVE = 3

# Smallest share of an observation's variance that must be left after the update for the second gate to mean anything.
_LEAST_SHARE = 1e-6


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
        L = np.linalg.cholesky(S)
    except np.linalg.LinAlgError:
        finite = np.isfinite(S).all(axis=(1, 2), keepdims=True)
        smallest = np.linalg.eigvalsh(np.where(finite, S, 0.0))[:, 0]
        raise InnovationError(frame, ids[smallest <= 0]) from None
    whitened = np.linalg.solve(L, residual[..., None])[..., 0]
    return np.einsum("ni,ni->n", whitened, whitened)


def agrees_with_others(gaussian: Gaussian, left: Rows, gate: float) -> BoolArray:
    """Whether (k,) each landmark agrees with the prediction as corrected by all *other* landmarks of the frame.

    With ``e_i = r_i - H_i (xi, d)`` and ``C_i = V - H_i P H_i^T`` after conditioning on all of them,
    ``e_i^T C_i^-1 e_i`` is the normalised square of landmark i's innovation given all others.

    Args:
        gaussian: Conditioned on all of the rows.
        left: The rows with the residuals that the correction leaves.
        gate: Chi-square threshold.
    """
    std = np.sqrt(left.variance)
    C = np.eye(std.shape[1]) - gaussian.variances(left) / (std[:, :, None] * std[:, None, :])
    share, axes = np.linalg.eigh(C)
    # Where C is nothing but rounding, no other landmark says anything about this one: it cannot be judged.
    judged = share[:, 0] > _LEAST_SHARE
    along = np.einsum("nji,nj->ni", axes, left.residual / std)
    squares = np.divide(along**2, share, out=np.zeros_like(along), where=judged[:, None]).sum(axis=1)
    return ~judged | (squares <= gate)


def moves_along(
    table: LandmarkTable, rows: Rows, h: Array, S: Array, squares: Array, gate: float, sigma: float, share: float
) -> BoolArray:
    """Which landmarks (k,) travel with the rig or against it, by all that their tracks have shown so far.

    A landmark that moves by a share b of the rig's step between two frames has innovations of mean ``b h``. Over a
    track ``N = sum h^T S^-1 r`` and ``D = sum h^T S^-1 h`` estimate b as N / D with standard deviation ``D^-1/2``.
    Per-frame gates never see it: the pose gives way first.

    Args:
        table: Keeps the evidence, which grows.
        rows: Measurement rows.
        h: (k, d) derivative of the rows by a motion of their landmarks, times the last step of the rig.
        S: (k, d, d) innovation covariances.
        squares: (k,) normalised innovations squared; gross outliers count as at the gate.
        gate: Its threshold.
        sigma, share: A landmark moves if b exceeds this many standard deviations, and this share.
    """
    weighted = np.linalg.solve(S, h[..., None])[..., 0]
    clip = np.sqrt(np.minimum(1.0, gate / np.maximum(squares, np.finfo(float).tiny)))
    table.evidence[rows.slot, 0] += clip * (weighted * rows.residual).sum(axis=1)
    table.evidence[rows.slot, 1] += (weighted * h).sum(axis=1)
    N, D = table.evidence[rows.slot].T
    least = np.maximum(sigma * np.sqrt(D), share * D)
    return (np.abs(N) > least) & (table.observations[rows.slot] >= SEEN_TO_MOVE)
