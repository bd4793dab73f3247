"""Honesty without truth: whether a covariance holds what it promises, as far as innovations can tell.

A true model has innovations that are white: over frames, along tracks, and between landmarks. What is wrong with them
says what is wrong with the model. Shared innovations (`ekfslam.filters.result.WhitenedInnovations`) that are too large
or that persist are errors of the velocities, or of all tracks alike. What is left of each observation without them is
an error of that track alone.

Innovations never see the gauge, absolute position and heading. Nor do they see what vision and velocities have in
common, or what drifts more slowly than the noise of the velocities lets one tell.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.evaluation import whiteness
from ekfslam.evaluation.consistency import pose_error
from ekfslam.filters.result import REASONS, Innovation, Parameters, Result, WhitenedInnovations
from ekfslam.geometry import se3
from ekfslam.smoother.posterior import Posterior

LAGS = 20  # frames over which autocorrelation is shown
_LAGS_OF_SUMS = 60  # over which it is summed, at most; a tenth of the drive where that is less
AXES = ("forward", "lateral", "vertical", "roll", "pitch", "yaw")  # x, y, z of the IMU
ROWS = ("u", "v", "disparity")
BLIND = (
    "Innovations never see the gauge (absolute position and heading), nor what vision and velocities have in common, "
    "nor what drifts more slowly than the noise of the velocities lets one tell."
)

_SHARED_DOF = 6
LEAST_DOF = 12  # of a frame whose shared innovation is looked at
SURE = 3.0  # standard errors
_LEAST_GAIN = 0.05  # share of its variance that a pose must gain by the smoother to be compared


@dataclass(frozen=True)
class Ratio:
    """A mean per degree of freedom, where 1 is expected, and its standard error that allows for correlation."""

    value: float
    error: float


@dataclass(frozen=True)
class SharedInnovations:
    """Errors on which the landmarks of a frame agree, along `AXES`.

    The axes are taken in the order of ``factor``, and each is judged less what is explained by those before: an error
    in yaw looks like one in lateral position, too.

    Args:
        size: Mean of their squares per degree of freedom.
        std: (6,) standard deviation about 0, each axis by itself; 1 expected.
        correlation: (21, 6) autocorrelation, lags 0 to 20 frames, each axis by itself.
        order: (6,) axes, worst first.
        factor: (6,) square root of the long-run variance: by how much errors outgrow the covariance.
        factor_low: (6,) what it exceeds with near certainty.
        mean, mean_error: (6,) means in standard deviations of a frame, and their standard errors.
        persistence: (6,) long-run variance about the mean, by the variance: 1 is white.
        rate: (6,) mean motion in m/s and rad/s: what a constant bias of measured velocities is at least.
        frames: How many there are.
    """

    size: Ratio
    std: Array
    correlation: Array
    order: IntArray
    factor: Array
    factor_low: Array
    mean: Array
    mean_error: Array
    persistence: Array
    rate: Array
    frames: int


@dataclass(frozen=True)
class TrackInnovations:
    """What is left of each observation without the shared motion, by `ROWS`.

    Args:
        size: NIS per degree of freedom without the shared part.
        scale: By how much variances of single observations exceed those stated; corrected for what the gate cuts off.
        correlation: (21, d) autocorrelation along tracks.
        pairs: (21,) pairs of observations behind it.
        factor: (d,) square root of the long-run variance.
        persistence: (d,) long-run variance by the variance: 1 is white.
    """

    size: Ratio
    scale: float
    correlation: Array
    pairs: IntArray
    factor: Array
    persistence: Array


@dataclass(frozen=True)
class RejectedShares:
    """What was rejected.

    Args:
        reasons: Share of all observations by reason.
        gate: Share of the observations of known landmarks that the gates rejected, in frames that are calm otherwise.
        expected: The same by the model, with the variances that accepted innovations show.
    """

    reasons: Mapping[str, float]
    gate: float
    expected: float


@dataclass(frozen=True)
class PriorAgreement:
    """A reported parameter against its prior.

    Args:
        name: Of the parameter.
        pull: Last estimate less the prior mean 0, by ``sqrt(prior^2 - std^2)``; None where nothing was learnt.
        increment: Root mean square of the changes over tenths of the drive, by ``sqrt(std_before^2 - std_after^2)``;
            None where the deviation does not fall, so that the parameter is not constant.
    """

    name: str
    pull: float | None
    increment: float | None


@dataclass(frozen=True)
class SmootherAgreement:
    """Filtered less smoothed poses: their covariance is ``P_filter - P_smoothed``.

    Args:
        size: Normalised square per degree of freedom, over the directions in which the smoother gained. Its error
            allows for correlation over a fifth of the drive, and is rough.
        std: (6,) each axis by itself; NaN where nothing was gained.
        frames: Frames compared.
    """

    size: Ratio
    std: Array
    frames: int


def partial(whitened: WhitenedInnovations, axis: int, given: IntArray) -> Array:
    """(T,) ``c_a`` less what components ``given`` explain of it, by its standard deviation; NaN where that is 0."""
    c, C = whitened.score, whitened.information
    mean, variance = c[:, axis], C[:, axis, axis]
    if len(given):
        own, cross = C[:, given[:, None], given], C[:, given, axis]
        weight = np.linalg.solve(own + _ridge(own), cross[..., None])[..., 0]
        mean = mean - np.einsum("tg,tg->t", weight, c[:, given])
        variance = variance - np.einsum("tg,tg->t", weight, cross)
    enough = variance > 1e-9 * C[:, axis, axis]
    return np.where(enough, mean / np.sqrt(np.where(enough, variance, 1.0)), np.nan)


def _ridge(own: Array) -> Array:
    """What keeps frames without information from being singular."""
    diagonal = np.diagonal(own, axis1=1, axis2=2)
    return np.where(diagonal > 0, 1e-12 * diagonal, 1.0)[:, :, None] * np.eye(own.shape[1])


def shared_innovations(whitened: WhitenedInnovations, looked_at: BoolArray, tau_s: Array) -> SharedInnovations:
    """What the frames looked at (T,) show of errors that all landmarks share; ``tau_s`` (T,) their intervals."""
    kept = dataclasses.replace(whitened, score=whitened.score[looked_at], information=whitened.information[looked_at])
    frames = int(looked_at.sum())
    lags = max(LAGS, min(_LAGS_OF_SUMS, frames // 10))
    error = whiteness.relative_error(frames, lags)
    own = whiteness.autocovariance(kept.shared, LAGS)
    order: list[int] = []
    factor, mean, mean_error, persistence = (np.full(6, np.nan) for _ in range(4))
    while len(order) < 6:
        given = np.array(order, dtype=np.int64)
        series = {a: partial(kept, a, given) for a in range(6) if a not in order}
        long_run = {a: _long_run(z, lags) for a, z in series.items()}
        worst = max(long_run, key=long_run.__getitem__)
        z = series[worst]
        mean[worst], variance = np.nanmean(z), float(np.nanvar(z))
        about_mean = _long_run(z - mean[worst], lags)
        factor[worst] = np.sqrt(long_run[worst])
        mean_error[worst] = np.sqrt(max(about_mean, variance) / frames)
        persistence[worst] = about_mean / variance
        order.append(worst)
    shared_nis = kept.shared_nis
    motion = kept.score.sum(axis=0) / np.diagonal(kept.information.sum(axis=0))
    return SharedInnovations(
        size=ratio(shared_nis, np.full(frames, _SHARED_DOF)),
        std=np.sqrt(own[0]),
        correlation=own / own[0],
        order=np.array(order),
        factor=factor,
        factor_low=factor / np.sqrt(1.0 + SURE * error),
        mean=mean,
        mean_error=mean_error,
        persistence=persistence,
        rate=motion / np.mean(tau_s[looked_at]),
        frames=frames,
    )


def track_innovations(
    whitened: WhitenedInnovations, innovation: Innovation, looked_at: BoolArray, gate: float
) -> TrackInnovations:
    """What single tracks show in the frames looked at (T,), behind gates of a probability."""
    rest = innovation.nis[looked_at] - whitened.shared_nis[looked_at]
    size = ratio(rest, innovation.dof[looked_at] - _SHARED_DOF)
    dimension = whitened.apart.shape[1]
    scale = whiteness.gated_scale(size.value, dimension, gate)
    products, pairs = whiteness.along_tracks(whitened.frame, whitened.landmark, whitened.apart, LAGS)
    long_run = whiteness.long_run_variance(products)
    persistence = np.maximum(long_run, 0.0) / products[0]
    variance = products[0] * scale / size.value
    return TrackInnovations(size, scale, products / products[0], pairs, np.sqrt(variance * persistence), persistence)


def rejected_shares(result: Result, looked_at: BoolArray, gate: float, own_scale: float) -> RejectedShares:
    """What was rejected, and what the gates (of a probability) should reject.

    ``own_scale`` is that of `TrackInnovations`: the second gate judges without the shared motion.
    """
    assert result.whitened is not None
    whitened = result.whitened
    rejections, innovation, frames = result.rejections, result.innovation, len(result.time_s)
    total = int((innovation.accepted + innovation.rejected).sum())
    reasons = {name: float((rejections.reason == code).sum()) / total for code, name in enumerate(REASONS)}
    # In frames whose shared innovations are large the gates throw out what is right.
    nis = whitened.shared_nis
    calm = looked_at & (nis <= np.median(nis[looked_at]))
    known = np.bincount(whitened.frame, minlength=frames)[calm].sum()
    gated = rejections.frame[rejections.reason == REASONS.index("gate")]
    at_gate = np.bincount(gated, minlength=frames)[calm].sum()
    squares = whitened.alone[calm[whitened.frame]] ** 2
    dimension = squares.shape[1]
    scale = whiteness.gated_scale(float(np.nanmean(squares)), dimension, gate)
    scale = max(scale, own_scale)
    return RejectedShares(
        {name: share for name, share in reasons.items() if share > 0},
        float(at_gate / max(at_gate + known, 1)),
        whiteness.rejected_share(scale, dimension, gate),
    )


def prior_agreement(parameters: Parameters) -> tuple[PriorAgreement, ...]:
    """Every parameter against its prior, and its changes against those of its deviation."""
    at = np.linspace(0, len(parameters.value) - 1, 11).astype(int)
    found = []
    for i, name in enumerate(parameters.name):
        value, std, prior = parameters.value[:, i], parameters.std[:, i], parameters.prior_std[i]
        gained = prior**2 - std[-1] ** 2
        learnt = -np.diff(std[at] ** 2)
        told = learnt > 1e-3 * prior**2
        is_constant = bool((learnt >= -1e-9 * prior**2).all()) and told.any()
        squares = np.diff(value[at])[told] ** 2 / learnt[told]
        found.append(
            PriorAgreement(
                name,
                float(value[-1] / np.sqrt(gained)) if gained > 0.01 * prior**2 else None,
                float(np.sqrt(squares.mean())) if is_constant else None,
            )
        )
    return tuple(found)


def smoother_agreement(result: Result, smoothed: Posterior) -> SmootherAgreement:
    """Filtered against smoothed poses, see `SmootherAgreement`."""
    difference = pose_error(result.T_world_imu, smoothed.T_world_imu)
    turned = se3.adjoint(se3.exp(-difference))
    P, after = result.covariance, turned @ smoothed.pose_covariance @ turned.swapaxes(1, 2)
    known = (np.diagonal(P, axis1=1, axis2=2) > 0).all(axis=1)
    P, difference, gain = P[known], difference[known], P[known] - after[known]
    std = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    correlation = P / (std[:, :, None] * std[:, None, :])
    values, axes = np.linalg.eigh(correlation)
    # W^T P W = I, so that the shares are what the smoother gained of each direction's variance.
    W = axes / np.sqrt(np.maximum(values, 1e-12))[:, None, :] / std[:, :, None]
    shares, directions = np.linalg.eigh(W.swapaxes(1, 2) @ gain @ W)
    along = np.einsum("tba,tcb,tc->ta", directions, W, difference)
    counts = shares > _LEAST_GAIN
    squares = np.where(counts, along**2 / np.where(counts, shares, 1.0), 0.0)
    own = np.diagonal(gain, axis1=1, axis2=2)
    gained = own > _LEAST_GAIN * std**2
    with np.errstate(invalid="ignore", divide="ignore"):
        axis = np.where(gained, difference**2 / own, 0.0).sum(axis=0) / gained.sum(axis=0)
    size = ratio(squares.sum(axis=1), counts.sum(axis=1), max(LAGS, len(counts) // 5))
    return SmootherAgreement(size, np.sqrt(axis), int(counts.any(axis=1).sum()))


def _long_run(series: Array, lags: int) -> float:
    return float(whiteness.long_run_variance(whiteness.autocovariance(series[:, None], lags))[0])


def ratio(values: Array, dof: IntArray, lags: int = LAGS) -> Ratio:
    """Sum of normalised squares (T,) by that of their degrees of freedom (T,)."""
    return Ratio(float(values.sum() / max(dof.sum(), 1)), whiteness.ratio_error(values, dof, lags))
