"""Evidence on the covariance of a run, from its innovations, its smoother and its truth.

A correct model has innovations that are white over frames, along tracks and between landmarks. Each deviation points at
a part of the model: large or persistent shared innovations (`ekfslam.filters.result.WhitenedInnovations`) at the
velocities or at errors common to all tracks, the remainder of an observation at its track alone.
`ekfslam.evaluation.honesty` judges the evidence.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.data.sequence import WITHOUT_VELOCITIES, Truth
from ekfslam.evaluation import whiteness
from ekfslam.evaluation.consistency import (
    above_rounding,
    chi2_bounds,
    measured_truth,
    pose_error,
    pose_nees,
    pose_nees_apart,
)
from ekfslam.evaluation.tables import plus_minus
from ekfslam.evaluation.truth import estimated
from ekfslam.filters.result import REASONS, Result, WhitenedInnovations
from ekfslam.geometry import motion, se3
from ekfslam.models.blocks import OPTIONAL_BLOCKS
from ekfslam.smoother.posterior import Posterior, is_inertial

LAGS = 20  # frames over which autocorrelation is shown
_LAGS_OF_SUMS = 60  # frames over which it is summed: a tenth of the drive, at most this
AXES = ("forward", "lateral", "vertical", "roll", "pitch", "yaw")  # x, y, z of the IMU
ROWS = ("u", "v", "disparity")
BLIND = (
    "Innovations never see the gauge (absolute position and heading), nor errors common to vision and velocities, "
    "nor drifts that are slower than the noise of the velocities reveals."
)
POSE_DOF = 6
_LEAST_DOF = 12  # of a frame whose shared innovation is examined
SURE = 3.0  # standard errors
_LEAST_GAIN = 0.05  # share of its variance that the smoother must remove from a pose, for a comparison
_TRUTH_PROBABILITY = 0.95  # of the bounds of the pose NEES


@dataclass(frozen=True)
class Ratio:
    """A mean per degree of freedom, 1 expected, and its standard error, which allows for correlation over time."""

    value: float
    error: float

    def __str__(self) -> str:
        return plus_minus(f"{self.value:.3g}", f"{self.error:.2g}")


@dataclass(frozen=True)
class Whiteness:
    """Deviation of n series of innovations from white noise of the stated size."""

    size: Ratio  # mean square per degree of freedom
    correlation: Array  # (21, n) autocorrelation, lags 0 to 20 frames
    factor: Array  # (n,) square root of the long-run variance: ratio of errors to covariance
    persistence: Array  # (n,) long-run variance about the mean, divided by the variance; 1 if white


@dataclass(frozen=True)
class SharedInnovations(Whiteness):
    """Errors common to the landmarks of a frame, along `AXES`.

    Axes are examined by falling ``factor``, each corrected for the axes before it, because an error in yaw resembles
    one in lateral position. ``std`` and ``correlation`` are of each axis alone.
    """

    std: Array  # (6,) standard deviation about 0; 1 expected
    order: IntArray  # (6,) axes, worst first
    factor_low: Array  # (6,) factor minus three standard errors
    frames: int  # number of frames examined


@dataclass(frozen=True)
class TrackInnovations(Whiteness):
    """Errors of single observations, without the shared motion, along tracks, by `ROWS`."""

    scale: float  # ratio of the variances to the stated ones, corrected for the cut of the gate
    pairs: IntArray  # (21,) number of pairs of observations behind correlation


@dataclass(frozen=True)
class SmootherAgreement:
    """Filtered minus smoothed poses, whose covariance is ``P_filter - P_smoothed``."""

    std: Array  # (6,) root mean square of each axis in expected deviations; NaN if the smoother gained nothing there
    frames: int  # number of frames compared

    @property
    def size(self) -> float:
        """Root mean square of all axes; NaN if the smoother gained nothing."""
        return float(np.sqrt(np.nanmean(self.std**2))) if np.isfinite(self.std).any() else np.nan


@dataclass(frozen=True)
class TruthAgreement:
    """Mean pose NEES, truth noise included, and the 95 % bounds of a single pose: errors persist over a drive."""

    nees: float
    low: float
    high: float


def ratio(values: Array, dof: IntArray, lags: int = LAGS) -> Ratio:
    """Return the sum of normalised squares (T,) divided by the sum of their degrees of freedom (T,)."""
    return Ratio(float(values.sum() / max(dof.sum(), 1)), whiteness.ratio_error(values, dof, lags))


def examined_frames(result: Result) -> BoolArray:
    """Return the frames (T,) with enough observations to separate shared innovations from single ones."""
    assert result.whitened is not None
    return np.isfinite(result.whitened.shared_nis) & (result.innovation.dof > _LEAST_DOF)


def partial(whitened: WhitenedInnovations, axis: int, given: IntArray) -> Array:
    """Return score ``axis`` (T,) minus its regression on the scores ``given``, in deviations; NaN if that is 0."""
    c, C = whitened.score, whitened.information
    mean, variance = c[:, axis], C[:, axis, axis]
    if len(given):
        own, cross = C[:, given[:, None], given], C[:, given, axis]
        # The ridge keeps frames without information from being singular.
        diagonal = np.diagonal(own, axis1=1, axis2=2)
        ridge = np.where(diagonal > 0, 1e-12 * diagonal, 1.0)[:, :, None] * np.eye(len(given))
        weight = np.linalg.solve(own + ridge, cross[..., None])[..., 0]
        mean = mean - np.einsum("tg,tg->t", weight, c[:, given])
        variance = variance - np.einsum("tg,tg->t", weight, cross)
    enough = variance > 1e-9 * C[:, axis, axis]
    return np.where(enough, mean / np.sqrt(np.where(enough, variance, 1.0)), np.nan)


def lags_of_sums(frames: int) -> int:
    """Return the lags over which the autocovariance of some frames is summed."""
    return max(LAGS, min(_LAGS_OF_SUMS, frames // 10))


def shared_innovations(whitened: WhitenedInnovations, examined: BoolArray) -> SharedInnovations:
    """Return the errors common to all landmarks in the frames examined (T,)."""
    kept = dataclasses.replace(whitened, score=whitened.score[examined], information=whitened.information[examined])
    frames = int(examined.sum())
    lags = lags_of_sums(frames)
    own = whiteness.autocovariance(kept.shared, LAGS)

    def long_run(series: Array) -> float:
        return float(whiteness.long_run_variance(whiteness.autocovariance(series[:, None], lags))[0])

    order: list[int] = []
    factor, persistence = np.full(6, np.nan), np.full(6, np.nan)
    while len(order) < 6:
        series = {a: partial(kept, a, np.array(order, dtype=np.int64)) for a in range(6) if a not in order}
        variances = {a: long_run(z) for a, z in series.items()}
        worst = max(variances, key=variances.__getitem__)
        z = series[worst]
        factor[worst] = np.sqrt(variances[worst])
        persistence[worst] = long_run(z - np.nanmean(z)) / np.nanvar(z)
        order.append(worst)
    return SharedInnovations(
        size=ratio(kept.shared_nis, np.full(frames, POSE_DOF)),
        std=np.sqrt(own[0]),
        correlation=own / own[0],
        order=np.array(order),
        factor=factor,
        factor_low=factor / np.sqrt(1.0 + SURE * whiteness.relative_error(frames, lags)),
        persistence=persistence,
        frames=frames,
    )


def track_innovations(result: Result, examined: BoolArray, gate: float) -> TrackInnovations:
    """Return the errors of single tracks in the frames examined (T,), which passed gates of probability ``gate``."""
    assert result.whitened is not None
    whitened, innovation = result.whitened, result.innovation
    rest = innovation.nis[examined] - whitened.shared_nis[examined]
    size = ratio(rest, innovation.dof[examined] - POSE_DOF)
    scale = whiteness.gated_scale(size.value, whitened.apart.shape[1], gate)
    products, pairs = whiteness.along_tracks(whitened.frame, whitened.landmark, whitened.apart, LAGS)
    persistence = np.maximum(whiteness.long_run_variance(products), 0.0) / products[0]
    variance = products[0] * scale / size.value
    return TrackInnovations(size, products / products[0], np.sqrt(variance * persistence), persistence, scale, pairs)


def rejected_shares(result: Result) -> dict[str, float]:
    """Return the share of all observations rejected for each reason that occurs."""
    total = max(int((result.innovation.accepted + result.innovation.rejected).sum()), 1)
    counts = np.bincount(result.rejections.reason, minlength=len(REASONS)).tolist()
    return {name: number / total for name, number in zip(REASONS, counts, strict=True) if number}


def measures_velocities(result: Result) -> bool:
    """Return whether measured velocities moved the poses of a run."""
    return not is_inertial(result) and result.attributes.get("velocities") != WITHOUT_VELOCITIES["velocities"]


def vision_share(result: Result) -> Array | None:
    """Return the share (6,) of the pose's variance by velocities that vision removes; None: unknown."""
    log = result.log
    seen = (
        name for name, block in OPTIONAL_BLOCKS.items() if block.is_seen and name in result.config.get("blocks", {})
    )
    if log is None or any(seen):
        return None
    if not measures_velocities(result):
        return np.ones(6)
    A = se3.adjoint(log.T_predicted @ se3.inverse(log.T_departed))
    std = np.hypot(result.noise.velocity_std, np.where(log.is_gap[:, None], result.noise.gap_std, 0.0))
    Q = motion.process_noise(log.seen_twist, log.tau_s, std)
    alone = result.covariance.copy()
    for k in range(1, len(alone)):
        alone[k] = A[k] @ alone[k - 1] @ A[k].T + Q[k]
    own, grown = (np.diagonal(P - P[0], axis1=1, axis2=2).sum(axis=0) for P in (result.covariance, alone))
    return np.clip(1.0 - own / np.maximum(grown, np.finfo(float).tiny), 0.0, 1.0)


def smoother_agreement(result: Result, smoothed: Posterior) -> SmootherAgreement:
    """Compare filtered with smoothed poses."""
    difference = pose_error(result.T_world_imu, smoothed.T_world_imu)
    turned = se3.adjoint(se3.exp(-difference))
    after = turned @ smoothed.pose_covariance @ turned.swapaxes(1, 2)
    variance, gain = (np.diagonal(P, axis1=1, axis2=2) for P in (result.covariance, result.covariance - after))
    gained = above_rounding(variance) & (gain > _LEAST_GAIN * variance)
    with np.errstate(invalid="ignore", divide="ignore"):
        std = np.sqrt(np.where(gained, difference**2 / gain, 0.0).sum(axis=0) / gained.sum(axis=0))
    return SmootherAgreement(std, int(gained.any(axis=1).sum()))


def truth_agreement(result: Result, truth: Truth | None, interpolated: BoolArray | None) -> TruthAgreement | None:
    """Compare a run with the truth, but for interpolated frames and stretches in which it stands alone."""
    truth = truth and estimated(result, truth)
    if truth is None:
        return None
    measured = truth if interpolated is None else measured_truth(truth, interpolated, result.time_s)
    _, nees = pose_nees_apart(result, measured) or pose_nees(result, measured, with_truth_noise=True)
    low, high = chi2_bounds(POSE_DOF, _TRUTH_PROBABILITY)
    return TruthAgreement(float(np.nanmean(nees)), float(low), float(high)) if np.isfinite(nees).any() else None
