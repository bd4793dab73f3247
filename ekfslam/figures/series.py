"""The table of series: each curve over a run with unit, bounds and expected value, for figures and pages."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.data.sequence import Truth
from ekfslam.evaluation.consistency import chi2_bounds, measured_truth, pose_nees, world_axes_errors, world_axes_std
from ekfslam.evaluation.trajectory import align_se3, distance_along
from ekfslam.evaluation.truth import estimated, without_pose
from ekfslam.figures.style import BAND_ALPHA, BOUNDS, EXPECTED, Style, log_axis
from ekfslam.filters.inertial_states import FIELDS, UNITS
from ekfslam.filters.result import Result
from ekfslam.geometry import se3

BAND_SIGMAS = 3.0
PROBABILITY = 0.95  # of the bounds of NIS and NEES
LOG_RATIO = 20.0  # largest over smallest value from which a logarithmic axis shows more
_AXES = tuple(f"{kind} {axis}" for kind in ("position", "rotation") for axis in "xyz")
_SCALES = np.repeat([1.0, np.degrees(1.0)], 3)  # m and rad to the units below
_UNITS = ("m", "m", "m", "deg", "deg", "deg")
_ABSCISSAE = {"s": "time [s]", "m": "distance driven [m]"}


@dataclass(frozen=True)
class Series:
    """A curve over time or distance."""

    name: str  # name, unit: label of the y axis
    unit: str
    x: Array  # x, y: (n,) the curve
    y: Array
    low: Array | None = None  # low, high: (n,) bounds; None without bounds
    high: Array | None = None
    # Whether the bounds hold values of an honest run; otherwise they are those of the estimate.
    bounds_expectation: bool = False
    levels: tuple[float, ...] = ()  # values to compare with: expected ones, or bounds of the prior
    is_positive: bool = False  # whether large ratios matter, so that the axis may be logarithmic
    mean: float | None = None  # mean by degrees of freedom, for titles
    x_unit: str = "s"  # s over time, m over distance driven

    @property
    def labels(self) -> tuple[str, str]:
        """Labels of the x axis and of the y axis."""
        return _ABSCISSAE[self.x_unit], f"{self.name} [{self.unit or '-'}]"

    @property
    def is_log(self) -> bool:
        """Whether a logarithmic axis shows more."""
        return self.is_positive and len(self.y) > 0 and bool(np.max(self.y) > LOG_RATIO * np.min(self.y))

    @property
    def share_inside(self) -> float:
        """Share of the values within their bounds."""
        assert self.low is not None and self.high is not None
        return float(np.mean((self.y >= self.low) & (self.y <= self.high)))

    def only(self, rows: IntArray) -> Series:
        """Return the points of some rows (n,)."""
        low, high = (None if bound is None else bound[rows] for bound in (self.low, self.high))
        return dataclasses.replace(self, x=self.x[rows], y=self.y[rows], low=low, high=high)


def draw_series(ax: Axes, series: Series, band: str, line: Style, levels: Style = EXPECTED, label: str = "_") -> None:
    """Draw a curve, its bounds (``band`` colours those of an estimate) and levels with labelled axes."""
    if series.low is not None and series.high is not None:
        if series.bounds_expectation:
            words = f"{100 * PROBABILITY:g} % chi-square bounds"
            ax.fill_between(series.x, series.low, series.high, step="mid", **BOUNDS, label=words)
        else:
            look: Style = {"facecolor": (band, BAND_ALPHA), "edgecolor": band, "linewidth": 0.6}
            ax.fill_between(series.x, series.low, series.high, **look)
    for level in series.levels:
        ax.axhline(level, **levels, zorder=1, label="expected mean" if series.bounds_expectation else "_")
    ax.plot(series.x, series.y, **line, label=label)
    if series.is_log:
        log_axis(ax, (1.0, 2.0, 5.0))
    place = ax.get_subplotspec()
    is_last = place is None or place.is_last_row()
    ax.set(ylabel=series.labels[1], xlabel=series.labels[0] if is_last else "")
    ax.margins(x=0.01)


def errors(result: Result, truth: Truth) -> list[Series]:
    """Return estimate minus truth along the axes of world, three positions and three rotations, with 3-sigma bounds."""
    truth = estimated(result, truth)
    T, x = result.T_world_imu[truth.frame], _time(result)[truth.frame]
    error = _SCALES * world_axes_errors(T, truth.T_world_imu)
    bound = BAND_SIGMAS * _SCALES * world_axes_std(T, result.covariance[truth.frame])
    found = [
        Series(name, unit, x, error[:, i], -bound[:, i], bound[:, i], levels=(0.0,))
        for i, (name, unit) in enumerate(zip(_AXES, _UNITS, strict=True))
    ]
    return found if result.has_covariance else [dataclasses.replace(one, low=None, high=None) for one in found]


def error_lengths(result: Result, truth: Truth) -> tuple[Series, Series]:
    """Return the lengths of the position error, m, and of the rotation error, degrees."""
    found = errors(result, truth)
    lengths = [np.linalg.norm([one.y for one in part], axis=0) for part in (found[:3], found[3:])]
    names = ("position", "m"), ("rotation", "deg")
    position, rotation = (
        Series(*name, found[0].x, y, is_positive=True) for name, y in zip(names, lengths, strict=True)
    )
    return position, rotation


def inertial(result: Result, truth: Truth | None = None) -> list[tuple[Series, Series | None]]:
    """Return velocity, biases and tilt of an inertial unit with 3-sigma bounds, three axes each, with true series.

    The velocity is along the axes of world, biases are along those of the IMU. With true motion its error comes next,
    and the tilt is that of the error. Without truth, tilt and heading are standard deviations.
    """
    states, known = result.inertial, None if truth is None else truth.motion
    if states is None:
        return []
    x, frame = _time(result), np.arange(0) if truth is None else truth.frame
    velocity, std = result.velocity_world_m_s, result.velocity_std_world_m_s
    found = _with_bounds("velocity", "m/s", x, velocity, std, frame, None if known is None else known.velocity_m_s)
    if known is not None:
        off = velocity[frame] - known.velocity_m_s
        found += _with_bounds("velocity error", "m/s", x[frame], off, std[frame], around_zero=True)
    for part, words in (("gyro_bias", "gyro bias"), ("accel_bias", "accel bias")):
        true = None if known is None else getattr(known, FIELDS[part])
        found += _with_bounds(words, UNITS[part], x, states.value(part), states.std(part), frame, true)
    names = ("tilt x", "tilt y", "heading")
    if truth is not None and len(frame):
        return found + [
            (dataclasses.replace(e, name=f"{n} error"), None)
            for n, e in zip(names, errors(result, truth)[3:], strict=True)
        ]
    of_rotation = np.degrees(world_axes_std(result.T_world_imu, result.covariance)[:, 3:])
    return found + [(Series(f"{n}, std", "deg", x, of_rotation[:, i]), None) for i, n in enumerate(names)]


def _with_bounds(
    name: str,
    unit: str,
    x: Array,
    y: Array,
    std: Array,
    frame: IntArray | None = None,
    true: Array | None = None,
    around_zero: bool = False,
) -> list[tuple[Series, Series | None]]:
    """Return the components of vectors (n, 3) with 3-sigma bounds, and of their true values at some frames."""
    found: list[tuple[Series, Series | None]] = []
    bound, centre = BAND_SIGMAS * std, 0.0 * y if around_zero else y
    for i, axis in enumerate("xyz"):
        one = Series(f"{name} {axis}", unit, x, y[:, i], (centre - bound)[:, i], (centre + bound)[:, i])
        truth = None if true is None else Series(one.name, unit, x[frame], true[:, i])
        found.append((dataclasses.replace(one, levels=(0.0,)) if around_zero else one, truth))
    return found


def inside_words(series: Iterable[Series]) -> str:
    """Return the share of the values of several series of equal length within their bounds, as words."""
    shares = [one.share_inside for one in series if one.low is not None]
    return f"{100 * np.mean(shares):.1f} % inside {BAND_SIGMAS:g} sigma" if shares else "no covariance"


def nees(result: Result, truth: Truth, interpolated: BoolArray | None = None, with_truth_noise: bool = True) -> Series:
    """Return the pose NEES of the frames that no ``interpolated`` interval (T,) leads to."""
    truth = estimated(result, truth)
    judged = truth if interpolated is None else measured_truth(truth, interpolated, result.time_s)
    frame, values = pose_nees(result, judged, with_truth_noise)
    known = np.isfinite(values)
    low, high = (np.full(known.sum(), bound) for bound in chi2_bounds(6, PROBABILITY))
    x, y = _time(result)[frame[known]], values[known]
    mean = float(y.mean()) if len(y) else None
    return Series("pose NEES", "", x, y, low, high, True, (6.0,), is_positive=True, mean=mean)


def nis(result: Result) -> Series:
    """Return the NIS per degree of freedom of the frames with updates, with the chi-square bounds of each."""
    innovation = result.innovation
    seen = innovation.dof > 0
    dof = innovation.dof[seen]
    low, high = (bound / dof for bound in chi2_bounds(dof, PROBABILITY))
    mean = float(innovation.nis.sum() / dof.sum()) if len(dof) else None
    y = innovation.nis[seen] / dof
    return Series("NIS per dof", "", _time(result)[seen], y, low, high, True, (1.0,), is_positive=True, mean=mean)


def distance_from_truth(result: Result, truth: Truth, align: bool) -> Series:
    """Return the distance of the estimated position from the true one, without or after `align_se3`."""
    truth = estimated(result, truth)
    estimate, true = result.T_world_imu[truth.frame, :3, 3], truth.T_world_imu[:, :3, 3]
    off = (se3.apply(align_se3(estimate, true), estimate) if align else estimate) - true
    x = _time(result)[truth.frame]
    return Series("distance from the truth", "m", x, np.linalg.norm(off, axis=1), is_positive=True)


def height(T_world_imu: Array, covariance: Array | None = None) -> Series:
    """Return z of world over the distance driven, with 3-sigma bounds if there is a covariance (T, 6, 6)."""
    x, z = distance_along(T_world_imu), T_world_imu[:, 2, 3]
    if covariance is None:
        return Series("z", "m", x, z, x_unit="m")
    bound = BAND_SIGMAS * world_axes_std(T_world_imu, covariance)[:, 2]
    return Series("z", "m", x, z, z - bound, z + bound, x_unit="m")


def height_of(result: Result, truth: Truth | None, has_band: bool) -> Series:
    """Return `height` of a result. The first pose of one that begins late is at the true distance there."""
    one = height(result.T_world_imu, result.covariance if has_band and result.has_covariance else None)
    first = int(np.argmin(without_pose(result)))
    if not first:
        return one
    one = one.only(np.arange(first, len(one.x)))
    is_known = truth is not None and len(truth.frame) > 0
    at_m = np.interp(first, truth.frame, distance_along(truth.T_world_imu)) if is_known else 0.0  # type: ignore[union-attr]
    return dataclasses.replace(one, x=one.x - one.x[0] + at_m)


def trajectory(result: Result, truth: Truth | None = None) -> list[tuple[Series, Series | None]]:
    """Return x, y, z, roll, pitch and yaw with 3-sigma bounds, each with its true series."""
    time_s, values = _time(result), _unwrapped(result.T_world_imu)
    attitude = np.degrees(_attitude_std(result.T_world_imu, result.covariance))
    bound = BAND_SIGMAS * np.hstack([result.position_std_world_m, attitude])
    found = []
    for i, (name, unit) in enumerate(zip(("x", "y", "z", "roll", "pitch", "yaw"), _UNITS, strict=True)):
        y, true = values[:, i], None
        if truth is not None and len(truth.frame):
            of_truth = _unwrapped(truth.T_world_imu)[:, i]
            turns = 360.0 * np.round((of_truth[0] - y[truth.frame[0]]) / 360.0) if unit == "deg" else 0.0
            true = Series(name, unit, time_s[truth.frame], of_truth - turns)
        found.append((Series(name, unit, time_s, y, y - bound[:, i], y + bound[:, i]), true))
    return found


def parameters(result: Result) -> list[Series]:
    """Return the estimated parameters with 3-sigma bounds; levels are the 3-sigma bounds of the prior."""
    found, x = result.parameters, _time(result)
    if found is None:
        return []
    series = []
    for i, name in enumerate(found.name):
        unit, factor = ("deg", np.degrees(1.0)) if found.unit[i] == "rad" else (found.unit[i], 1.0)
        y, bound = factor * found.value[:, i], factor * BAND_SIGMAS * found.std[:, i]
        prior = float(factor * BAND_SIGMAS * found.prior_std[i])
        series.append(Series(name, unit.removeprefix("1"), x, y, y - bound, y + bound, levels=(-prior, prior)))
    return series


def _time(result: Result) -> Array:
    return result.time_s - result.time_s[0]


def _unwrapped(T_world_imu: Array) -> Array:
    """Return position (m), roll, pitch and yaw (degrees) of poses (T, 4, 4) as (T, 6), angles without jumps."""
    from scipy.spatial.transform import Rotation

    yaw_pitch_roll = Rotation.from_matrix(np.array(T_world_imu[:, :3, :3])).as_euler("ZYX")
    return np.hstack([T_world_imu[:, :3, 3], np.degrees(np.unwrap(yaw_pitch_roll[:, ::-1], axis=0))])


def _attitude_std(T_world_imu: Array, covariance: Array) -> Array:
    """Return standard deviations (T, 3) of roll, pitch and yaw, rad, to first order: E has their derivatives."""
    from scipy.spatial.transform import Rotation

    _, pitch, roll = Rotation.from_matrix(np.array(T_world_imu[:, :3, :3])).as_euler("ZYX").T
    sin, cos, zero = np.sin(roll), np.cos(roll), np.zeros_like(roll)
    level = np.maximum(np.cos(pitch), 1e-9)
    rows = [zero + 1.0, sin * np.tan(pitch), cos * np.tan(pitch), zero, cos, -sin, zero, sin / level, cos / level]
    E = np.stack(rows, axis=1).reshape(-1, 3, 3)
    return np.sqrt(np.maximum(np.einsum("tij,tjk,tik->ti", E, covariance[:, 3:, 3:], E), 0.0))
