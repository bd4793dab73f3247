"""Truth, velocities and vision compared over stretches of 2 s: which of the three stands alone, when and in which axis.

Errors of the sources are independent, so their variances follow from the differences of each two (the three-cornered
hat: Gray, Allan, "A Method for Estimating the Frequency Stability of an Individual Oscillator", 1974). A source stands
alone in a stretch if the two others agree with each other, and it with neither.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import ndtri, stdtrit

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.data.interpolation import stretches
from ekfslam.data.sequence import Sequence, Truth
from ekfslam.data.tracks import adjacent
from ekfslam.data.truth_noise import Doubt, doubt_attributes
from ekfslam.evaluation.evidence import AXES
from ekfslam.geometry import motion, se3
from ekfslam.geometry.camera import MOTION_FROM_PX, StereoCamera, rectified_rows
from ekfslam.geometry.stereo_motion import agrees, linearise

STRETCH_S = 2.0
SOURCES = ("truth", "velocities", "vision")
_PAIRS = ((1, 2), (0, 2), (0, 1))  # of the two others, for each source
_HOPS = 4  # stretches begin this often within one
_LEAST_STRETCHES = 5  # disjoint ones
_CORE = 0.7  # quantile that tells a variance: it has one degree of freedom for each disjoint stretch (1.05 to 1.2)
_LEAST_SHARE = 0.02  # of the sum of variances: a difference of large ones says no less
_TAIL = 1e-5  # probability of naming a correct source in one axis of one stretch: 1 % in a drive of 100 s
_SURE_OF_DRIFT = 2.0  # standard errors of its variance
_SURE = 12.0  # twice the log likelihood ratio to the next source
_LEAST_POINTS, _POINTS = 6, 50  # of a frame
_AT_ONCE = 5000  # points
_STD_PX, _AGREE_PX, _AGREE_SHARE = 0.2, 2.0, 0.5
_SCALES = (50.0, 15.0, 5.0, 2.0, 2.0)  # of the robust kernel, from errors of the velocities down to `align`'s


class Alone(NamedTuple):
    """A source that stands alone, index in `SOURCES`: first and last frame, axis, offset (m, rad), standard errors."""

    source: int
    begin: int
    end: int
    axis: int
    offset: float
    sigmas: float


class Comparison(NamedTuple):
    """Result of `compare_sources`."""

    std: Array  # (3, 6) standard deviation of each source over one stretch, m and rad along the axes of the IMU
    alone: tuple[Alone, ...]  # sources that stand alone, the surest first
    drift_m_sqrt_s: float  # random walk of the true position, mean of the axes; 0 within two standard errors


def visual_motion(sequence: Sequence) -> tuple[Array, BoolArray]:
    """Return velocities (T, 6) by robust Gauss-Newton on tracks, and whether each has enough points that agree (T,)."""
    o, C, frames = sequence.observations, sequence.T_cam_imu, len(sequence)
    earlier, later = adjacent(o)
    rows = rectified_rows(o.pixels_px, np.ones(4))[0]
    disparity = rows[:, 0] - rows[:, 2]
    near = np.minimum(disparity[earlier], disparity[later]) >= MOTION_FROM_PX
    earlier, later = earlier[near], later[near]
    some = slice(None, None, max(1, len(later) // (_POINTS * frames)))
    earlier, later = earlier[some], later[some]
    order = np.argsort(o.frame[later], kind="stable")
    earlier, later = earlier[order], later[order]
    at, starts = np.unique(o.frame[later], return_index=True)
    tau_s = np.diff(sequence.time_s, prepend=sequence.time_s[0])
    T = C @ motion.increment(sequence.twist, tau_s) @ se3.inverse(C)
    known = np.zeros(frames, dtype=bool)
    known[at] = np.diff(starts, append=len(later)) >= _LEAST_POINTS
    bounds = np.append(starts, len(later))
    # Some thousand points at once: all of a long drive would take gigabytes.
    for part in np.array_split(np.arange(len(at)), max(1, len(later) // _AT_ONCE)):
        points = slice(bounds[part[0]], bounds[part[-1] + 1]) if len(part) else slice(0)
        own, frame = bounds[part] - bounds[part[:1]], at[part]
        before, now = rows[earlier[points]], rows[later[points]]
        T[frame], agree = _aligned(sequence.camera, before, now, T[frame], own)
        known[frame] &= agree
    twist = sequence.twist.copy()
    twist[1:][known[1:]] = -se3.log(se3.inverse(C) @ T[1:] @ C)[known[1:]] / tau_s[1:, None][known[1:]]
    return twist, known


def _aligned(
    camera: StereoCamera, before_px: Array, now_px: Array, T: Array, starts: IntArray
) -> tuple[Array, BoolArray]:
    """Return the motions (k, 4, 4) of points (n, 3) of frames that begin at ``starts`` (k,), and if enough agree."""
    true_px, counts = before_px, np.diff(starts, append=len(now_px))
    which = np.repeat(np.arange(len(T)), counts)
    for scale in _SCALES if len(T) else ():
        found = linearise(camera, before_px, now_px, T[which], true_px, _STD_PX, scale)
        true_px, HW = found.true_px, np.swapaxes(found.H, 1, 2) @ found.W
        r = np.where(np.isfinite(found.residual_px), found.residual_px, 0.0)
        information, gradient = (np.add.reduceat(sums, starts) for sums in (HW @ found.H, HW @ r[..., None]))
        step: Array = np.linalg.solve(information + 1e-6 * np.eye(6), gradient)[..., 0].astype(float)
        T = se3.exp(step) @ T
    agree = np.add.reduceat(agrees(found, _AGREE_PX), starts, dtype=np.int64) if len(T) else counts
    return T, agree >= _AGREE_SHARE * counts


def compare_sources(sequence: Sequence) -> Comparison | None:
    """Compare truth, velocities and stereo vision; None if one is missing, or has too few stretches."""
    truth = sequence.truth
    if truth is None or len(truth.frame) < 3 or not sequence.has_velocities or sequence.camera.is_monocular:
        return None
    begin, end = _stretches(sequence.time_s, truth.frame)
    visual, known = visual_motion(sequence)
    unknown = np.cumsum(~known | sequence.interpolated)
    seen = unknown[end] - unknown[begin] <= 0.1 * (end - begin)
    begin, end = begin[seen], end[seen]
    if len(begin) < _HOPS * _LEAST_STRETCHES:
        return None
    tau_s, place = np.diff(sequence.time_s), np.searchsorted(truth.frame, (begin, end))
    T = [se3.inverse(motion.integrate(np.eye(4), twist, tau_s)) for twist in (_imu_twist(sequence, truth), visual)]
    steps = [se3.inverse(truth.T_world_imu[place[0]]) @ truth.T_world_imu[place[1]]]
    steps += [se3.inverse(poses[begin]) @ poses[end] for poses in T]
    apart = np.stack([_apart(steps[a], steps[b], steps[0]) for a, b in _PAIRS])
    variance = (np.quantile(np.abs(apart), _CORE, axis=1) / ndtri(0.5 + 0.5 * _CORE)) ** 2
    total, dof = 0.5 * variance.sum(axis=0), len(begin) / _HOPS
    own = total - variance
    std = np.sqrt(np.maximum(own, _LEAST_SHARE * total))
    drift, error = own[0, :3].mean(), np.linalg.norm(total[:3]) / 3.0 * np.sqrt(2.0 / dof)
    walk = float(np.sqrt(drift / STRETCH_S)) if drift > _SURE_OF_DRIFT * error else 0.0
    return Comparison(std, tuple(_alone(begin, end, apart, std, dof)), walk)


def _imu_twist(sequence: Sequence, truth: Truth) -> Array:
    """Return the velocities along the axes of the IMU; level ones are tilted by the true attitude."""
    if sequence.velocity_frame != "level":
        return sequence.twist
    nearest = np.clip(np.searchsorted(truth.frame, np.arange(len(sequence))), 0, len(truth.frame) - 1)
    return motion.imu_twist(sequence.twist, truth.T_world_imu[nearest, 2, :3])[0]


def first_of_each(time_s: Array, step_s: float) -> IntArray:
    """Return the index of the first of ascending times (n,) in each step since the first one."""
    return np.unique(np.floor((time_s - time_s[0]) / step_s), return_index=True)[1]


def _stretches(time_s: Array, frame: IntArray) -> tuple[IntArray, IntArray]:
    """Return first and last frames (n,) of overlapping stretches between frames of the truth."""
    stamps = time_s[frame]
    starts = first_of_each(stamps, STRETCH_S / _HOPS)
    starts = starts[stamps[starts] < stamps[-1] - STRETCH_S]
    ends = np.searchsorted(stamps, stamps[starts] + STRETCH_S - 1e-6)
    fits = ends < len(frame)
    starts, ends = frame[starts[fits]], frame[ends[fits]]
    fits = time_s[ends] - time_s[starts] < 1.5 * STRETCH_S
    return starts[fits], ends[fits]


def _apart(one: Array, other: Array, true: Array) -> Array:
    """Return the difference of motions (n, 4, 4) as (n, 6), without its part in proportion to the way."""
    turn = se3.so3_log(np.swapaxes(other[:, :3, :3], 1, 2) @ one[:, :3, :3])
    apart = np.hstack([one[:, :3, 3] - other[:, :3, 3], turn])
    way = np.linalg.norm(true[:, :3, 3], axis=1, keepdims=True)
    far = way[:, 0] > 0.5 * np.max(way)
    if far.any() and way.max() > 0:
        apart[:, :3] -= way * np.median(apart[far, :3] / way[far], axis=0)
    apart[:, 3:] -= np.median(apart[:, 3:], axis=0)
    return apart


def _alone(begin: IntArray, end: IntArray, apart: Array, std: Array, dof: float) -> list[Alone]:
    """Return the sources that stand alone, the surest first; of stretches that overlap, the surest is kept."""
    limit = float(stdtrit(dof, 1.0 - 0.5 * _TAIL))
    squares = _evidence(apart, std**2)
    ordered = np.sort(squares, axis=0)
    named = (ordered[2] > limit**2) & (ordered[2] - ordered[1] > _SURE)
    found: list[Alone] = []
    for source in range(3):
        mine = np.where(named & (squares.argmax(axis=0) == source), squares[source], 0.0)
        for first, last in stretches(np.asarray((mine > 0).any(axis=1))):
            row, axis = np.unravel_index(int(mine[first : last + 1].argmax()), (last + 1 - first, 6))
            worst, others = first + int(row), [k for k in range(3) if k != source]
            offsets = [_signed(apart[:, worst, axis], source, other) for other in others]
            offset = float(np.average(offsets, weights=std[others, axis] ** -2.0))
            sigmas = float(np.sqrt(mine[worst, axis]))
            found.append(Alone(source, int(begin[first]), int(end[last]), int(axis), offset, sigmas))
    kept: list[Alone] = []
    for one in sorted(found, key=lambda one: -one.sigmas):
        if all(one.begin >= other.end or one.end <= other.begin for other in kept):
            kept.append(one)
    return kept


def _evidence(apart: Array, variance: Array) -> Array:
    """Return twice the log likelihood (3, n, 6) that one source has an offset, relative to none, for each source."""
    rest = np.stack([apart[i] ** 2 / (variance[a] + variance[b]) for i, (a, b) in enumerate(_PAIRS)])
    # d^T C^-1 d of two differences; the third is their sum.
    s0, s1, s2 = variance
    products = s0 * s1 + s0 * s2 + s1 * s2
    full = (s1 * apart[1] ** 2 + s2 * apart[2] ** 2 + s0 * (apart[1] - apart[2]) ** 2) / products
    return np.maximum(full - rest, 0.0)


def _signed(apart: Array, source: int, other: int) -> float:
    """Return the difference ``source - other``, given those of all pairs (3,)."""
    pair = 3 - source - other
    return float(apart[pair] if _PAIRS[pair] == (source, other) else -apart[pair])


def in_words(compared: Comparison | None, time_s: Array) -> tuple[str, ...]:
    """Return one line for each source that stands alone, the surest first, and one for a drift of the truth."""
    if compared is None:
        return ()
    lines = []
    for one in compared.alone:
        begin_s, end_s = time_s[[one.begin, one.end]] - time_s[0]
        offset = f"{one.offset:+.2g} m" if one.axis < 3 else f"{np.degrees(one.offset):+.2g} deg"
        others = " and ".join(name for i, name in enumerate(SOURCES) if i != one.source)
        against = f"{AXES[one.axis]} {offset} in {STRETCH_S:g} s against {others}, {one.sigmas:.0f} standard errors"
        lines.append(f"{SOURCES[one.source]} alone from {begin_s:.1f} to {end_s:.1f} s: {against}")
    if compared.drift_m_sqrt_s:
        found = f"the truth drifts by about {compared.drift_m_sqrt_s:.2g} m/sqrt(s) against velocities and vision"
        lines.append(f"{found}: see drift_m_sqrt_s of [truth]")
    return tuple(lines)


def doubt_in_truth(compared: Comparison | None, time_s: Array) -> dict[str, str | float]:
    """Return the stretches in which the truth stands alone, and its drift, as attributes of a result."""
    if compared is None:
        return {}
    doubts = []
    for one in compared.alone:
        # All stretches that overlap an offset show it: as long as they last beyond one, it grows.
        grown = max(1.0, (time_s[one.end] - time_s[one.begin] - STRETCH_S) / STRETCH_S)
        if one.source == 0:
            doubts.append(Doubt(one.begin, one.end, one.axis, abs(one.offset) * float(grown)))
    return doubt_attributes(doubts, compared.drift_m_sqrt_s)
