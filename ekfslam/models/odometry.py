"""Stereo odometry: velocities of a recording without any, from its tracks.

They are no measurements: the filter conditions on the same observations. They start the block `twist`, set its walk,
and stand in where poses are needed before there is a filter (hygiene, mapping-only).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from ekfslam.arrays import Array, BoolArray
from ekfslam.data.noise import Noise
from ekfslam.data.sequence import MEASURED_KINDS, Sequence
from ekfslam.geometry import se3
from ekfslam.geometry.camera import MOTION_FROM_PX, rectified_rows
from ekfslam.geometry.stereo_motion import Alignment, agrees, align, sampled_motion

_LEAST_POINTS, _AGREE_SHARE, _AGREE_PX = 6, 0.5, 2.0
_SAMPLES = 200
_NEIGHBOURS = 5
_WALK_FACTOR = 3.0
_LEAST_WALK = np.repeat([0.05, 0.005], 3)
# Motion (m/s, rad/s) that odometry without any velocities of its kind cannot have overlooked.
_MOVES = np.array([0.1, np.deg2rad(2.0)])
# Prior of the first velocities, in steps of the walk: nearly nothing is known.
_START_FACTOR = 10.0


def stereo_odometry(sequence: Sequence) -> Array:
    """Return velocities (T, 6) between successive frames from common tracks; the last ones if there are too few."""
    C, twist, is_known = sequence.T_cam_imu, np.zeros((len(sequence), 6)), np.zeros(len(sequence), dtype=bool)
    for k, found in stereo_motions(sequence, len(sequence)):
        tau_s = float(sequence.time_s[k] - sequence.time_s[k - 1])
        twist[k], is_known[k] = -se3.log(se3.inverse(C) @ found.T_now_before @ C) / tau_s, True
    if not is_known.any():
        return twist
    last = np.maximum.accumulate(np.where(is_known, np.arange(len(twist)), 0))
    return _without_jumps(twist[np.where(last > 0, last, np.argmax(is_known))])


def stereo_motions(sequence: Sequence, frames: int, std_px: float = 0.2) -> Iterator[tuple[int, Alignment]]:
    """Yield frames before ``frames`` and their motions from the frame before, by common tracks if there are enough.

    Robust Gauss-Newton over the three rows of every point starts at the previous motion, or at the best of random
    three-point motions if most points disagree.
    """
    camera, observations = sequence.camera, sequence.observations
    generator, guess = np.random.default_rng(0), None
    for k in range(1, frames):
        (ids, before), (ids_now, now) = observations.at(k - 1), observations.at(k)
        _, i, j = np.intersect1d(ids, ids_now, assume_unique=True, return_indices=True)
        rows, rows_now = (rectified_rows(pixels, np.ones(4))[0] for pixels in (before[i], now[j]))
        disparity = np.minimum(rows[:, 0] - rows[:, 2], rows_now[:, 0] - rows_now[:, 2])
        rows, rows_now = (some[disparity >= MOTION_FROM_PX] for some in (rows, rows_now))
        if len(rows) < _LEAST_POINTS:
            continue
        found = None if guess is None else align(camera, rows, rows_now, guess, std_px)
        if found is None or agrees(found, _AGREE_PX).mean() < _AGREE_SHARE:
            start = sampled_motion(camera, rows, rows_now, generator, _SAMPLES, _AGREE_PX)
            found = align(camera, rows, rows_now, start, std_px)
        guess = found.T_now_before
        yield k, found


def missing_velocities(sequence: Sequence, odometry: Array | None = None) -> tuple[str, ...]:
    """Return the kind of velocities, ``linear`` or ``angular``, that were never filled in: 0, while images move."""
    zero = ~sequence.measured_axes.reshape(2, 3).any(axis=1)
    if not zero.any():
        return ()
    moved = stereo_odometry(sequence) if odometry is None else odometry
    rms = np.sqrt((moved.reshape(-1, 2, 3) ** 2).sum(axis=2).mean(axis=0))
    return tuple(kind for kind, is_missing in zip(MEASURED_KINDS, zero & (rms > _MOVES), strict=True) if is_missing)


def _without_jumps(twist: Array) -> Array:
    """Return velocities (T, 6) with those that are too far from their neighbours replaced by a median."""
    from scipy.ndimage import median_filter  # takes 30 ms to import

    middle = median_filter(twist[1:], (_NEIGHBOURS, 1), mode="mirror")
    jumps = (np.abs(twist[1:] - middle) > _START_FACTOR * _walk(twist)).any(axis=1)
    found = np.where(jumps[:, None], middle, twist[1:])
    return np.concatenate([found[:1], found])


def _walk(twist: Array) -> Array:
    """Return the typical change (6,) of velocities (T, 6) between intervals, times `_WALK_FACTOR`."""
    steps = np.abs(np.diff(twist[1:], axis=0)).reshape(-1, 2, 3)
    typical = 1.4826 * np.median(steps, axis=(0, 2)) if len(steps) else np.zeros(2)
    return np.maximum(_WALK_FACTOR * np.repeat(typical, 3), _LEAST_WALK)


def vision_noise(noise: Noise, twist: Array) -> Noise:
    """Return the noise with its velocities replaced by a walk as the odometry (T, 6) has it."""
    walk = _walk(twist)
    return dataclasses.replace(
        noise,
        twist_std=_START_FACTOR * walk,
        twist_walk_std=walk,
        motion_std=np.full(6, 1e-6),
        tilt_rad=0.0,
        gap_std=np.zeros(6),
    )


def with_vision(noise: Noise, twist: Array, axes: BoolArray) -> Noise:
    """Return the noise with that of odometry on some axes (6,) of velocities (T, 6), as measured or as a walk."""
    walk = _walk(twist)
    if noise.twist_walk_std is None:
        return dataclasses.replace(noise, twist_std=np.where(axes, walk, noise.twist_std))
    found = vision_noise(noise, twist)
    names = ("twist_std", "twist_walk_std", "motion_std")
    changes = {name: np.where(axes, getattr(found, name), getattr(noise, name)) for name in names}
    return dataclasses.replace(noise, **changes)
