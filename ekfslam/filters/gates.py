"""Gates: which observations a frame may use. One at a time, against all others, and along the track."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.special import gammaincinv

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.config import FilterConfig
from ekfslam.errors import InnovationError
from ekfslam.filters.gaussian import Rows
from ekfslam.filters.landmarks import LandmarkTable

# Smallest share of its variance that an innovation must have besides what all others of the frame say of it.
LEAST_SHARE = 1e-6
# Observations of a landmark after which it may be found to move.
SEEN_TO_MOVE = 3


def threshold(probability: float, dimension: int) -> float:
    """Return the chi-square threshold of a gate for d rows; probability 1 accepts everything."""
    return 2.0 * float(gammaincinv(dimension / 2.0, probability))


@lru_cache
def of_inputs(dimension: int) -> float:
    """Return the chi-square threshold of inputs with so many components: one in 10 000 is doubted wrongly."""
    return threshold(1.0 - 1e-4, dimension)


def diagonal(variance: Array) -> Array:
    """Return variances (n, d) as diagonal matrices (n, d, d)."""
    return variance[:, :, None] * np.eye(variance.shape[1])


def normalised_squares(S: Array, residual: Array, frame: int, ids: IntArray) -> Array:
    """Return ``r_i^T S_i^-1 r_i`` (n,) for S (n, d, d) and residuals (n, d); S must be positive definite."""
    try:
        whitened = np.linalg.solve(np.linalg.cholesky(S), residual[..., None])[..., 0]
        return np.einsum("ni,ni->n", whitened, whitened)
    except np.linalg.LinAlgError:
        finite = np.isfinite(S).all(axis=(1, 2), keepdims=True)
        smallest = np.linalg.eigvalsh(np.where(finite, S, 0.0))[:, 0]
        raise InnovationError(frame, ids[smallest <= 0]) from None


def agrees_with_others(left: Rows, C: Array) -> tuple[Array, BoolArray]:
    """Return ``e_i^T C_i^-1 e_i`` (k,), the normalised square of each landmark's innovation given all others.

    With ``C_i = V (S^-1)_ii V`` (`Solution.given_others`) and ``e_i = r_i - H_i (xi, d)``, what the correction leaves,
    the innovation of landmark i given all *others* is ``V C_i^-1 e_i`` with covariance ``V C_i^-1 V``: nothing has to
    be computed once for each landmark left out. The second result is whether (k,) a landmark can be judged: if C is
    only rounding, the others say nothing about it.
    """
    share, axes = np.linalg.eigh(C)
    judged = share[:, 0] > LEAST_SHARE
    along = np.einsum("nji,nj->ni", axes, left.residual / np.sqrt(left.variance))
    with np.errstate(over="ignore"):
        squares = np.divide(along**2, share, out=np.zeros_like(along), where=judged[:, None]).sum(axis=1)
    return squares, judged


def moves_along(
    table: LandmarkTable,
    slot: IntArray,
    evidence: tuple[Array, Array],
    squares: Array,
    gate: float,
    config: FilterConfig,
) -> BoolArray:
    """Return which landmarks (k,) travel with the rig or against it, by their whole tracks so far.

    A landmark that moves by a share b of the rig's step between two frames has innovations of mean ``b h``, with h the
    derivative of its rows by a motion of the landmark, times that step. Over a track ``N = sum h^T S^-1 r`` and ``D =
    sum h^T S^-1 h`` estimate b as N / D with standard deviation ``D^-1/2``. Per-frame gates never see it: the pose
    gives way first. It moves if b exceeds ``moving_sigma`` standard deviations, and ``moving_share``. The ``evidence``
    is what this frame adds to N and D; outliers in ``squares`` count as at the gate.
    """
    along, information = evidence
    clip = np.sqrt(np.minimum(1.0, gate / np.maximum(squares, 1e-12)))
    table.evidence[slot, 0] += clip * along
    table.evidence[slot, 1] += np.maximum(information, 0.0)
    N, D = table.evidence[slot].T
    least = np.maximum(config.moving_sigma * np.sqrt(D), config.moving_share * D)
    return (np.abs(N) > least) & (table.observations[slot] >= SEEN_TO_MOVE)


def evidence_alone(rows: Rows, S: Array, h: Array) -> tuple[Array, Array]:
    """Return ``h^T S^-1 r`` and ``h^T S^-1 h`` (k,) of innovations with covariances S (k, d, d)."""
    weighted = np.linalg.solve(S, h[..., None])[..., 0]
    return (weighted * rows.residual).sum(axis=1), (weighted * h).sum(axis=1)


def evidence_given_others(left: Rows, C: Array, h: Array) -> tuple[Array, Array]:
    """Return ``h^T V^-1 e`` and ``h^T V^-1 C V^-1 h`` (k,), for `agrees_with_others`."""
    std = np.sqrt(left.variance)
    g = h / std
    return (g * left.residual / std).sum(axis=1), np.einsum("ni,nij,nj->n", g, C, g)
