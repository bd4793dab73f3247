"""Noise from the data: the noise of a recording's velocities, found without truth.

Measured velocities are a slowly changing signal plus white noise. First differences of white noise of variance s^2 have
autocovariance -s^2 at lag 1, those of a slow signal none below 0: ``s^2 = -cov(d_k, d_k+1)``. (Higher differences see
the vehicle shake.) If the velocity walks between samples, second differences d have variance ``q tau / 2``, and the
integral by samples misses the path between them (a Brownian bridge) by ``q tau / 12`` a sample: the *sampling noise*,
half of ``d / sqrt(1.5)``. No difference sees slow errors that all samples or tracks share: see `shared_errors`.

The axes of a kind share the median of their noise, unless their own differs by more than three standard errors. Axes
that are exactly 0 throughout are not measured: `ekfslam.models.vehicle` has their standard deviations.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence as SequenceType
from dataclasses import dataclass, field

import numpy as np

from ekfslam.arrays import Array, BoolArray
from ekfslam.data.inputs import is_measured
from ekfslam.data.noise import Noise
from ekfslam.data.sequence import VelocityFrame
from ekfslam.models.blocks import OPTIONAL_BLOCKS
from ekfslam.models.vehicle import AXES

# Velocities of an automotive GNSS/INS unit: the data sheets of OXTS's RT3000 family state 0.05 to 0.1 km/h (0.014 to
# 0.028 m/s) and 0.01 deg/s. White errors of a sample are at least of that order.
VELOCITY_STD = np.repeat([0.02, np.deg2rad(0.02)], 3)
# Noise of an interpolated sample: a car changes its speed by 1 m/s and turns by 2 deg/s in a second or so.
GAP_STD = np.array([1.0, 0.1, 0.1, *np.deg2rad([2.0, 2.0, 2.0])])

# Roll and pitch of a road vehicle, and how well the rotation of a camera against a unit elsewhere in a car is known.
TILT_RAD = np.deg2rad(3.0)
CAMERA_ROTATION_DEG = 0.4

# Errors of KLT tracks (u, v, disparity) at landmark initialisation and their walk from frame to frame, which
# `track_scale` multiplies (`ekfslam.data.noise.TrackError`). White pixel noise only sets the limits of hygiene.
PIXEL_STD_PX = 0.7
TRACK_FIRST_PX = np.array([0.1, 0.1, 1.0])
TRACK_WALK_PX = np.array([0.08, 0.08, 0.06])
TRACK_FLOW_PX = 3.0
# Errors of the tracks of `ekfslam.frontend`, which are compared with their first sight in every frame. The patch is
# deformed by the slant of its surface as the depth changes, and moves by about this share of its width: measured on
# rendered rooms and streets against true points, and on KITTI 06 against smoothed poses, at whole and half image size
# and frame rate (docs/images.md). The error of the first disparity stays.
CHECKED_PIXEL_STD_PX = 0.3
CHECKED_FIRST_PX = np.array([0.1, 0.1, 0.4])
CHECKED_WALK_PX = np.full(3, 0.07)
CHECKED_PARALLAX = 0.02
# Disparity below which the constant error of a track leaves no depth, in standard deviations of a measured disparity.
MIN_DISPARITY_SIGMA = 3.0

# White noise from which velocities count as noisy, and are smoothed as a random walk.
NOISY_FROM = np.repeat([0.15, 0.0025], 3)

_BLOCKS = 20  # of the jackknife
_ONE_SIDED_95 = 1.645  # deviations
_SPAN = 10  # samples over which the slow walk of the velocities is measured
_DIFFERS = 3.0  # standard errors by which an axis must differ from the others for a noise of its own


@dataclass(frozen=True)
class VelocityNoise:
    """Noise of velocities as their differences show it, linear (m/s) and angular (rad/s)."""

    sigma: Array  # (2,) white noise per sample: the median of the axes that are measured
    sigma_error: Array  # (2,) standard errors (jackknife over 20 stretches); 0 if no noise is seen
    limit: Array  # (2,) upper limits of sigma with a confidence of 95 %
    walk: Array  # (2,) change of the true velocities per sample, root mean square
    # (6,) noise of taking a sample for the mean over its interval, each axis.
    sampling: Array = field(default_factory=lambda: np.zeros(6))
    measured: BoolArray = field(default_factory=lambda: np.ones(6, dtype=bool))  # (6,) whether an axis is measured
    # (6,) white noise of each axis, 0 if it is not measured; by default ``sigma``, filled in.
    axes: Array = field(default=None)  # type: ignore[arg-type]

    def __post_init__(self) -> None:
        if self.axes is None:
            object.__setattr__(self, "axes", np.repeat(self.sigma, 3))

    @property
    def is_clean(self) -> bool:
        """Whether no axis shows more white noise than a good unit has."""
        return bool((self.axes <= NOISY_FROM).all())

    @property
    def carries_motion(self) -> bool:
        """Whether the velocities know slow motions better than vision: they are clean, and all six are measured."""
        return self.is_clean and bool(self.measured.all())

    def scaled(self, factors: SequenceType[float]) -> VelocityNoise:
        """Return it with factors on the sampling noise of both kinds; those below 1 also act on unsure white noise."""
        white = np.where(self.sigma > _DIFFERS * self.sigma_error, 1.0, np.minimum(factors, 1.0))
        own = self.axes != np.repeat(self.sigma, 3)
        axes = self.axes * np.where(own, 1.0, np.repeat(white, 3))
        return dataclasses.replace(
            self, sigma=white * self.sigma, sampling=np.repeat(factors, 3) * self.sampling, axes=axes
        )

    @property
    def texts(self) -> tuple[str, str]:
        """Noise of the linear and of the angular velocities in words: with its error, or its limit."""
        v, w = (self._text(kind) for kind in range(2))
        return v, w

    def _text(self, kind: int) -> str:
        sigma, error, limit = self.sigma[kind], self.sigma_error[kind], self.limit[kind]
        axes = np.flatnonzero(self.measured[3 * kind : 3 * kind + 3]) + 3 * kind
        if not len(axes):
            return "not measured:"
        if np.ptp(self.axes[axes]) > 0:
            return ", ".join(f"{AXES[axis]} {self.axes[axis]:.3g}" for axis in axes)
        return with_error(sigma, error) if sigma > 0 else f"below {limit:.2g} (95 %)"


def velocity_noise(twist: Array, measured: BoolArray | None = None, stated_std: Array | None = None) -> VelocityNoise:
    """Return white noise and walk of velocities (T, 6), m/s and rad/s, of which ``stated_std`` (6,) is the least noise.

    ``measured`` (6,) axes are by default those that are not exactly 0 throughout, or all if none is.
    """
    twist = np.asarray(twist, dtype=float)
    measured = is_measured(twist) if measured is None else measured
    measured = measured if measured.any() else np.ones(6, dtype=bool)
    stated = np.where(measured, 0.0 if stated_std is None else stated_std, 0.0)
    d = np.diff(twist, axis=0)
    if len(d) < 2:
        unknown = np.full(2, np.inf)
        return VelocityNoise(_median(stated, measured), unknown, unknown, np.zeros(2), measured=measured, axes=stated)
    product = d[1:] * d[:-1]
    lag_1, left_out = product.mean(axis=0), _left_out(product)
    error = _jackknife(_white(left_out, measured))
    limit = _white(np.minimum(lag_1, 0.0) - _ONE_SIDED_95 * _jackknife(left_out), measured)
    axes = np.maximum(_white_axes(lag_1, left_out, measured), stated)
    sigma = np.maximum(_white(lag_1, measured), _median(stated, measured))
    # Second differences of white noise have 6 times its variance; the rest is the motion between samples.
    bent = np.maximum(((d[1:] - d[:-1]) ** 2).mean(axis=0) / 6.0 - axes**2, 0.0)
    walk = _walk(twist, np.minimum(lag_1, 0.0), measured)
    return VelocityNoise(sigma, error, np.maximum(limit, sigma), walk, 0.5 * np.sqrt(bent), measured, axes)


def _walk(twist: Array, lag_1: Array, measured: BoolArray) -> Array:
    """Return the walk (2,): the rest of the differences without white noise, or that of slow means if larger."""
    fast = np.maximum((np.diff(twist, axis=0) ** 2).mean(axis=0) + 2.0 * lag_1, 0.0)
    whole = len(twist) // _SPAN * _SPAN
    slow = np.zeros(6)
    if whole >= 2 * _SPAN:
        means = twist[:whole].reshape(-1, _SPAN, 6).mean(axis=1)
        # Means of n samples of a walk differ by n - (n^2 - 1) / (3 n) steps' variance, those of white noise by 2 / n.
        steps = _SPAN - (_SPAN**2 - 1) / (3 * _SPAN)
        slow = np.maximum((np.diff(means, axis=0) ** 2).mean(axis=0) + 2.0 / _SPAN * lag_1, 0.0) / steps
    share = measured.reshape(2, 3)
    variances = ((np.where(share, variance.reshape(2, 3), 0.0)).sum(axis=1) for variance in (fast, slow))
    return np.maximum(*(np.sqrt(variance / np.maximum(share.sum(axis=1), 1)) for variance in variances))


def _left_out(product: Array) -> Array:
    """Return the means (n, 6) of products (T, 6) with one of n stretches left out."""
    parts, total = np.array_split(product, min(_BLOCKS, len(product))), product.sum(axis=0)
    return np.array([(total - part.sum(axis=0)) / max(len(product) - len(part), 1) for part in parts])


def _jackknife(left_out: Array) -> Array:
    """Return standard errors of estimates, given those (n, ...) with one of n parts left out."""
    return np.sqrt((len(left_out) - 1) * left_out.var(axis=0))


def _white(lag_1: Array, measured: BoolArray) -> Array:
    """Return the noise (..., 2) of linear and angular velocities from lag-1 covariances (..., 6)."""
    return _median(np.sqrt(np.maximum(-lag_1, 0.0)), measured)


def _median(std: Array, measured: BoolArray) -> Array:
    """Return the median (..., 2) of standard deviations (..., 6) over the measured axes of each kind, 0 without any."""
    kinds = [std[..., kind][..., measured[kind]] for kind in (slice(3), slice(3, 6))]
    return np.stack([np.median(each, axis=-1) if each.shape[-1] else std[..., 0] * 0.0 for each in kinds], axis=-1)


def _white_axes(lag_1: Array, left_out: Array, measured: BoolArray) -> Array:
    """Return the noise (6,) of each axis, pooled unless an axis differs, from lag-1 covariances (6,), also (n, 6)."""

    def off(lag_1: Array) -> Array:
        return np.asarray(np.maximum(-lag_1, 0.0) - np.repeat(_white(lag_1, measured) ** 2, 3, axis=-1))

    differs = np.abs(off(lag_1)) > _DIFFERS * _jackknife(off(left_out))
    own = np.sqrt(np.maximum(-lag_1, 0.0))
    return np.where(measured, np.where(differs, own, np.repeat(_white(lag_1, measured), 3)), 0.0)


def automatic_noise(found: VelocityNoise, velocity_frame: VelocityFrame = "imu", checked: bool = False) -> Noise:
    """Return the noise for a recording that states none, from the noise of its velocities.

    Axes that are not measured have the least noise, see `ekfslam.models.vehicle.with_vehicle`. ``checked`` tracks are
    those of `ekfslam.frontend`, whose errors are known.
    """
    own = np.hypot(found.sampling, VELOCITY_STD)
    return Noise(
        twist_std=np.hypot(own, found.axes) if found.is_clean else np.maximum(found.axes, VELOCITY_STD),
        pixel_std_px=np.full(4, CHECKED_PIXEL_STD_PX if checked else PIXEL_STD_PX),
        twist_walk_std=None if found.is_clean else np.repeat(found.walk, 3),
        motion_std=np.zeros(6) if found.is_clean else own,
        track_first_px=CHECKED_FIRST_PX if checked else TRACK_FIRST_PX,
        track_walk_px=CHECKED_WALK_PX if checked else TRACK_WALK_PX,
        track_flow_px=np.inf if checked else TRACK_FLOW_PX,
        track_parallax=CHECKED_PARALLAX if checked else np.inf,
        tilt_rad=TILT_RAD if velocity_frame == "level" else 0.0,
        gap_std=GAP_STD,
    )


def shared_errors(found: VelocityNoise | None, checked: bool = False) -> dict[str, dict[str, float]]:
    """Return tables ``[blocks.<name>]`` of errors that all samples or tracks share, by `StateBlock.automatic`."""
    white_std, is_clean = (None, False) if found is None else (found.sigma, found.carries_motion)
    tables = {name: block.automatic(white_std, is_clean, checked) for name, block in OPTIONAL_BLOCKS.items()}
    return {name: table for name, table in tables.items() if table is not None}


def with_drift(noise: Noise, drift_px: float) -> Noise:
    """Return the noise with track errors that walk by ``drift_px`` a frame in u and v, in the usual proportions."""
    if not drift_px:
        return dataclasses.replace(noise, track_first_px=None, track_walk_px=None)
    first = TRACK_FIRST_PX if noise.track_first_px is None else noise.track_first_px
    return dataclasses.replace(noise, track_first_px=first, track_walk_px=TRACK_WALK_PX * (drift_px / TRACK_WALK_PX[0]))


def with_error(value: float, error: float | None) -> str:
    """Return a value and its standard error, if it has one, as text."""
    return f"{value:.3g}" if error is None else f"{value:.3g} +- {error:.2g}"
