"""Statistics of series that should be white: autocorrelation, long-run variance, means that allow for correlation.

The long-run variance is that of sums, relative to white noise: ``gamma_0 + 2 sum w_l gamma_l`` with autocovariances
gamma and Bartlett's weights w (Newey and West, "A simple, positive semi-definite, heteroskedasticity and
autocorrelation consistent covariance matrix", Econometrica 55, 1987).
"""

from __future__ import annotations

import numpy as np
from scipy.special import gammainc, gammaincinv

from ekfslam.arrays import Array, IntArray

_LARGEST_SCALE = 100.0  # ratio of variances above which nearly all observations are rejected


def autocovariance(series: Array, lags: int) -> Array:
    """Return second moments about 0 (lags+1, n) of samples (T, n) that are 0 to ``lags`` apart; NaN does not count.

    All are divided by the number of samples, so that the sequence is positive semi-definite; 0 beyond its length.
    """
    known = np.isfinite(series)
    filled, count = np.where(known, series, 0.0), np.maximum(known.sum(axis=0), 1)
    shifted = (filled[: max(len(filled) - lag, 0)] * filled[lag:] for lag in range(lags + 1))
    return np.array([product.sum(axis=0) / count for product in shifted])


def long_run_variance(covariances: Array) -> Array:
    """Return the long-run variance (n,) of autocovariances (lags+1, n)."""
    weight = 1.0 - np.arange(len(covariances)) / len(covariances)
    return 2.0 * (weight @ covariances) - covariances[0]


def relative_error(samples: int, lags: int) -> float:
    """Return the relative standard error of a long-run variance; of a plain variance for ``lags`` 0."""
    return float(np.sqrt(max(4.0 * lags / 3.0, 2.0) / max(samples, 1)))


def along_tracks(frame: IntArray, landmark: IntArray, values: Array, lags: int) -> tuple[Array, IntArray]:
    """Return the autocovariance (lags+1, d) along all tracks of values (K, d), and the number of pairs (lags+1,)."""
    span = (int(frame.max()) if len(frame) else 0) + lags + 1
    key = landmark.astype(np.int64) * span + frame
    order = np.argsort(key)
    key, values = key[order], values[order]
    known = np.isfinite(values).all(axis=1)
    key, values = key[known], values[known]
    products, pairs = np.zeros((lags + 1, values.shape[1])), np.zeros(lags + 1, dtype=np.int64)
    for lag in range(lags + 1):
        later = np.searchsorted(key, key + lag)
        both = np.flatnonzero(key[np.minimum(later, len(key) - 1)] == key + lag) if len(key) else later
        pairs[lag] = len(both)
        if len(both):
            products[lag] = (values[both] * values[later[both]]).mean(axis=0)
    return products, pairs


def ratio_error(values: Array, dof: IntArray, lags: int) -> float:
    """Return the standard error of ``sum values / sum dof``, (T,) each, which allows for correlation over time."""
    total = float(dof.sum())
    if total == 0:
        return float("nan")
    ratio = float(values.sum()) / total
    off = (values - ratio * dof)[:, None]
    variance = len(dof) * float(long_run_variance(autocovariance(off, lags))[0])
    return float(np.sqrt(max(variance, 2.0 * ratio**2 * total)) / total)


def gated_scale(mean: float, dimension: int, probability: float) -> float:
    """Return the ratio s of variances to the stated ones, at most 100, from the squares that passed a gate.

    Squares are s times chi-square of a ``dimension``. The gate cuts off large ones, so their ``mean``, divided by it,
    understates s.
    """
    if probability >= 1.0 or mean <= 0:
        return mean
    gate = 2.0 * float(gammaincinv(dimension / 2.0, probability))

    def accepted_mean(scale: float) -> float:
        x = gate / (2.0 * scale)
        return scale * float(gammainc(dimension / 2.0 + 1.0, x) / gammainc(dimension / 2.0, x))

    if accepted_mean(_LARGEST_SCALE) <= mean:
        return _LARGEST_SCALE
    # Bisection: importing a root finder of SciPy takes longer than a short run.
    low, high = 1e-6 * mean, _LARGEST_SCALE
    while high - low > 1e-12 * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if accepted_mean(middle) < mean else (low, middle)
    return 0.5 * (low + high)
