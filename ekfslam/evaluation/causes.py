"""Causes of a covariance that is too small or too large, by the innovations of a run, each with the next step.

Variances of the pose are ``w t^2 + (1 - w) s^2`` times too small if vision, which decides the share w of the pose, errs
t times more than stated, and the velocities s times. Innovations that landmarks share are ``w s^2 + (1 - w) t^2`` times
too large: large where vision is better than the velocities, and those are wrong.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.evaluation.evidence import (
    AXES,
    POSE_DOF,
    ROWS,
    SURE,
    Ratio,
    SharedInnovations,
    SmootherAgreement,
    TrackInnovations,
    TruthAgreement,
    measures_velocities,
)
from ekfslam.evaluation.systematic import Systematic, grown_by
from ekfslam.evaluation.tables import number
from ekfslam.filters.result import Result
from ekfslam.smoother.posterior import is_inertial

_NOTABLE = 1.3  # factor from which a deviation is reported
_LEAST_LOW = 1.15  # of the factor, minus three standard errors
_PERSISTS, _LEAST_SLOW = 2.0, 1.5  # persistence from which errors of tracks, and shared errors, are called slow
_COUNTS = 1.5  # factor from which a systematic error counts
_STILL = 5.0  # standard deviations of the last position
_MANY = 0.05  # share of the velocities that cannot all be wild samples
# Errors of which innovations do not tell how much of them is the camera's.
_UNSURE = frozenset({"bias", "scale", "delay", "shared drift", "motion"})
_LEAST_OUTLIERS, _LEAST_MOVING = 0.013, 0.2  # shares of the observations
_SMOOTHER = 5.0  # filter minus smoother: healthy runs have up to 3, failed linearisation has 10 and more
_FAR = 10.0  # errors by the truth per error by innovations, from which the truth is doubted
_SYSTEMATIC = {
    "bias": "velocities and camera disagree by {size} in {axis}: a bias of the velocities",
    "scale": "the way by velocities is {size} than by the camera: scale of the velocities, baseline, focal length, or "
    "disparity",
    "direction": "the camera sees the motion turned by {size} about {axis}: T_cam_imu, or the axes of the velocities",
    "delay": "the velocities are {size}: a time offset",
}
_REMEDY = {
    "bias": "calibrate the velocities, or let [blocks.twist_bias] estimate it",
    "scale": "calibrate, or let [calibration] baseline and disparity_px estimate it",
    "direction": "calibrate T_cam_imu, or let [calibration] rotation_deg estimate it",
    "delay": "correct the stamps, or let [calibration] time_s estimate it",
    "shared drift": "use [blocks.twist_bias] for velocities, [blocks.vision_drift] for tracks",
    "inertial drift": "let [calibration] rotation_deg and time_s estimate T_cam_imu and a time offset",
    "tracks": "leave out [noise] sigma_px, so that the errors of tracks are found",
    "motion": "mask what moves",
    "white": ", or leave out [noise] sigma_px, so that tracks are tested for motion",
    "smoother": "use the mode 'smoothed', or filter.lag = 10",
}


@dataclass(frozen=True)
class Cause:
    """A defect of the model."""

    # Bias, scale, direction, delay, shared drift, shared noise, pixel noise, tracks, motion, smoother, nis, outliers,
    # moving, velocities or body (of the truth).
    kind: str
    where: tuple[str, ...]  # axes, or rows of the image
    factor: float  # ratio of these errors to the stated ones, in standard deviations; NaN if it does not apply
    text: str  # description
    remedy: str = ""  # the next step; empty if there is none


class Causes(NamedTuple):
    """Factors (6,) of the pose's standard deviations, None if unknown; their causes, worst first; other defects."""

    factors: Array | None
    causes: tuple[Cause, ...]
    findings: tuple[Cause, ...]


def causes_of(
    result: Result,
    shared: SharedInnovations,
    tracks: TrackInnovations,
    rejected: Mapping[str, float],
    systematic: tuple[Systematic, ...],
    vision: Array | None,
) -> Causes:
    """Return the causes that innovations show, and what they mean for the pose."""
    single = tuple(_track_causes(result, tracks, rejected))
    t = max((cause.factor for cause in single), default=1.0)
    common = tuple(_shared_causes(result, shared, t))
    velocities, camera = grown_by(result, systematic, np.full(6, 0.5) if vision is None else vision)
    lasting = tuple(map(_systematic_cause, systematic))
    counts = max(_mean(velocities), _mean(camera)) > _COUNTS
    causes, findings = (lasting, ()) if counts else ((), lasting)
    if vision is None:
        return Causes(None, causes, (*findings, *common))
    causes = (*causes, *(cause for cause in common if cause.kind == "shared drift"), *single)
    fast = tuple(cause for cause in common if cause.kind == "shared noise")
    causes = (*causes, *fast)
    if not causes or not _UNSURE.isdisjoint(cause.kind for cause in causes):
        return Causes(None, causes, findings)
    s2 = np.ones(6)
    for axis in (AXES.index(name) for cause in fast for name in cause.where):
        s2[axis] = max(shared.factor[axis] ** 2 - (1.0 - vision[axis]) * t**2, 0.0) / max(vision[axis], 0.5)
    grown = camera**2 - 1.0 if counts else 0.0
    return Causes(np.sqrt(vision * t**2 + (1.0 - vision) * s2 + grown), causes, findings)


def _shared_causes(result: Result, shared: SharedInnovations, t: float) -> Iterator[Cause]:
    """Yield causes of shared errors that errors of single observations, ``t`` times too large, do not explain."""
    explained = max(1.0, t)
    order, factor = shared.order, shared.factor / explained
    large = order[((factor > _NOTABLE) & (shared.factor_low > _LEAST_LOW * explained))[order]]
    if len(large):
        # An error that is independent in each frame is large at once, a slow one only in sums.
        slow = np.log(shared.persistence[large])
        fast = 2.0 * np.log(factor[large]) - slow
        where, size = tuple(AXES[a] for a in large), float(factor[large[0]])
        text = f"innovations agree across landmarks in {_axes(where)}"
        if slow.mean() > max(np.log(_LEAST_SLOW), fast.mean()):
            text += f" and persist: a slow error of all tracks or of the {_movers(result)[0]}"
            remedy = _REMEDY["inertial drift" if is_inertial(result) else "shared drift"]
            yield Cause("shared drift", where, size, text, remedy)
        else:
            movers, known = _movers(result)
            text += f" in each frame: {movers} are up to {size:.1f}x noisier than {known}, or all tracks jitter"
            yield Cause("shared noise", where, size, text, _velocity_remedy(result, large, size))
    size, low = _mean(shared.factor), shared.factor_low / shared.factor
    if (shared.factor < _NOTABLE * low).all() and size < 1.0 / _NOTABLE and measures_velocities(result):
        text = f"shared innovations are {1 / size:.1f}x smaller than expected"
        if _is_found(result):  # the steps of the motion and the noise of the velocities explain it alike
            yield Cause(
                "shared noise", AXES, size, text + "the motion is smoother than the noise found from the data", ""
            )
        else:
            text += "velocities are better than stated"
            yield Cause("shared noise", AXES, size, text, _velocity_remedy(result, order, size))


def _movers(result: Result) -> tuple[str, str]:
    """Return what moves the poses of a run, and the origin of its noise, in words."""
    if measures_velocities(result):
        return "velocities", "found" if _is_found(result) else "stated"
    return ("inertial samples" if is_inertial(result) else "steps of the motion"), "assumed"


def _is_found(result: Result) -> bool:
    """Return whether the velocities walk and their noise was found from the data."""
    noise = result.config.get("noise", {})
    is_stated = noise.get("sigma_v_m_s") is not None or noise.get("sigma_w_rad_s") is not None
    return result.noise.twist_walk_std is not None and not is_stated


def _velocity_remedy(result: Result, axes: IntArray, size: float) -> str:
    std, given = size * result.noise.velocity_std, []
    for name, of in (("sigma_v_m_s", axes[axes < 3]), ("sigma_w_rad_s", axes[axes >= 3])):
        if len(of) and std[of].max() > 0:
            given.append(f"{name} = {std[of].max():.2g}")
    return f"give [noise] {_listed(given)}" if given and measures_velocities(result) else ""


def _track_causes(result: Result, tracks: TrackInnovations, rejected: Mapping[str, float]) -> Iterator[Cause]:
    size, names = float(np.sqrt(tracks.scale)), ROWS[: len(tracks.factor)]
    slow = np.flatnonzero(tracks.persistence > _PERSISTS)
    grown, where = float(tracks.factor[slow].max(initial=0.0)), tuple(names[i] for i in slow)
    is_white = result.noise.track_first_px is None
    remedy = _REMEDY["tracks"] if is_white else ""
    if grown > max(_NOTABLE, _LEAST_SLOW * size):
        text = f"errors persist along tracks in {_listed(where)}, where the model expects independent ones"
        # Things move along the ground, and tracks err in all rows alike.
        is_uneven = float(tracks.persistence.min()) < 0.5 * float(tracks.persistence.max())
        if rejected.get("gate", 0.0) > _LEAST_OUTLIERS and is_uneven:
            text += ", and many are rejected: things move, or tracks slip"
            yield Cause("motion", where, grown, text, _REMEDY["motion"] + (_REMEDY["white"] if is_white else ""))
        else:
            yield Cause("tracks", where, grown, text, remedy)
        return
    if not abs(np.log(size)) > np.log(_NOTABLE) or abs(tracks.size.value - 1.0) <= SURE * tracks.size.error:
        return
    if size < 1 and _stands_still(result):
        return  # the errors of tracks grow with their motion
    word = "larger" if size > 1 else "smaller"
    text = f"errors of single observations are about {max(size, 1 / size):.1f}x {word} than stated"
    if size < 1 and len(slow):
        yield Cause("tracks", where, grown, f"{text}, yet persist along tracks", remedy)
    else:
        found_px = size * float(result.noise.pixel_std_px.mean())
        yield Cause("pixel noise", names, size, text, f"give [noise] sigma_px = {found_px:.2g}" if is_white else "")


def _stands_still(result: Result) -> bool:
    way = np.linalg.norm(result.T_world_imu[:, :3, 3] - result.T_world_imu[0, :3, 3], axis=1).max()
    return bool(way < _STILL * np.sqrt(np.trace(result.covariance[-1, :3, :3])))


def _systematic_cause(found: Systematic) -> Cause:
    size = {
        "bias": f"{found.value:+.2g} m/s" if found.axis in AXES[:3] else f"{np.degrees(found.value):+.2g} deg/s",
        "scale": f"{100 * abs(found.value):.2g} % {'longer' if found.value > 0 else 'shorter'}",
        "direction": f"{abs(np.degrees(found.value)):.2g} deg",
        "delay": f"{abs(found.value):.2g} s {'late' if found.value > 0 else 'early'}",
    }[found.kind]
    text = _SYSTEMATIC[found.kind].format(size=size, axis=found.axis)
    if found.also:
        text += f" (or nearly as well: {_listed(found.also)})"
    return Cause(found.kind, (found.axis,) if found.axis else (), np.nan, text, _REMEDY[found.kind])


def nis_causes(nis: Ratio | None) -> Iterator[Cause]:
    """Yield a cause if the size of the NIS alone is wrong; runs without whitened innovations have no other evidence."""
    if nis is None:
        return
    factor = float(np.sqrt(max(nis.value, 1e-6)))
    if abs(nis.value - 1.0) > SURE * nis.error and not 1 / _NOTABLE <= factor <= _NOTABLE:
        size = f"{factor:.1f}x larger" if factor > 1 else f"{1 / factor:.1f}x smaller"
        yield Cause("nis", (), factor, f"innovations are about {size} than expected (NIS {nis} per degree of freedom)")


def rejection_causes(result: Result, rejected: Mapping[str, float], causes: Sequence[Cause]) -> Iterator[Cause]:
    """Yield what rejected observations and velocities show beyond other causes."""
    known, gate, moving = {cause.kind for cause in causes}, rejected.get("gate", 0.0), rejected.get("moving", 0.0)
    doubted, frames = int(result.counts.get("rejected: velocities", 0)), len(result.time_s)
    is_noise = bool(known & {"shared noise", "pixel noise", "tracks"})  # it explains what gates reject
    text = f"landmarks contradict {doubted} of {frames} velocities"
    if doubted > _MANY * frames and not is_noise:
        is_noise = True
        yield Cause("shared noise", (), np.nan, f"{text}: they are noisier than stated")
    elif doubted and not is_noise:
        yield Cause("velocities", (), np.nan, f"{text}: wild samples, which the filter does not use")
    if gate > _LEAST_OUTLIERS and not is_noise:
        yield Cause("outliers", (), np.nan, f"the gates reject {percent(gate)} of the observations as outliers")
    if moving > _LEAST_MOVING:
        text = f"{percent(moving)} of the observations are rejected as moving: traffic, or another noise than stated"
        yield Cause("moving", (), np.nan, text, "compare with the noise that `ekfslam info` finds")


def truth_causes(truth: TruthAgreement | None, factors: Array | None) -> Iterator[Cause]:
    """Yield that errors by the truth are far from those that innovations show: the truth may be the cause."""
    if truth is not None and factors is not None:
        size = float(np.sqrt(truth.nees / POSE_DOF) / max(np.sqrt((factors**2).mean()), 1.0))
        if size > _FAR:
            text = (
                f"errors by the truth are {size:.0f}x larger than innovations say: it may be of another body or clock"
            )
            yield Cause("truth", (), np.nan, text, "for a truth of `base_link` state its place with --truth-frame")


def smoother_causes(smoother: SmootherAgreement | None) -> Iterator[Cause]:
    """Yield the alarm of failed linearisation."""
    if smoother is not None and smoother.size > _SMOOTHER:
        text = f"filter and smoother differ {smoother.size:.1f}x more than their covariances allow"
        yield Cause("smoother", (), smoother.size, f"{text}: failed linearisation", _REMEDY["smoother"])


def _mean(factors: Array) -> float:
    return float(np.sqrt((factors**2).mean()))


def _axes(names: Sequence[str]) -> str:
    return "all axes" if len(names) == len(AXES) else _listed(names)


def _listed(names: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(names[:-1]), *names[-1:])))


def percent(share: float | None) -> str:
    """Return a share in percent, or a dash."""
    return number(None if share is None else 100 * share, ".2g") + " %"
