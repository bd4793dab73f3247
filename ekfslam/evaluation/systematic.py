"""Systematic errors of velocities or camera, by the motion on which the innovations of frames agree.

Each kind of error is a template: a motion of every frame, up to its size. With score c and information C of the frames
(`ekfslam.filters.innovations`) the size of template x is ``sum x^T c / sum x^T C x``. Templates of moving rigs use the
velocities two frames before and after, as the noise of a velocity is in the innovations of its own frame and the next.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array, BoolArray
from ekfslam.evaluation import whiteness
from ekfslam.evaluation.evidence import AXES, lags_of_sums, measures_velocities
from ekfslam.filters.result import Result, WhitenedInnovations
from ekfslam.geometry import se3

_SURE = 5.0  # standard errors: 12 templates of healthy runs reach 3
_ALIKE = 0.8  # of the significance of the best template
_MOST = 3  # errors of one run
_MOVING = 3.0  # standard deviations of the velocities, root mean square
_CAMERA_AXES = "xyz"
_APART = 2  # frames from one whose innovation has no part of the noise of a velocity
_NEIGHBOURS = (((_APART, 0), slice(None, -_APART)), ((0, _APART), slice(_APART, None)))


@dataclass(frozen=True)
class Systematic:
    """An error that innovations show in all frames."""

    kind: str  # bias of a velocity, scale of the way, direction of the motion, or delay of the velocities
    axis: str  # name of the axis, one of `AXES`, or x, y, z of the IMU about which the motion is turned; else empty
    # Velocities minus camera, in m/s or rad/s, as a share, in rad, or in s. The filter hides a part of it.
    value: float
    sigmas: float  # value divided by its standard error, which allows for correlation over time
    also: tuple[str, ...] = ()  # kinds that explain the innovations almost as well


def systematic_errors(result: Result, examined: BoolArray) -> tuple[tuple[Systematic, ...], WhitenedInnovations]:
    """Return the errors that the frames examined (T,) show beyond doubt, the surest first, and innovations without."""
    whitened = result.whitened
    assert whitened is not None
    if result.log is None or not measures_velocities(result):
        return (), whitened
    score, templates = whitened.score, _templates(result)
    found: list[Systematic] = []
    while len(found) < _MOST:
        c, C = score[examined], whitened.information[examined]
        sizes = {name: _fitted(c, C, x[examined]) for name, x in templates.items()}
        best = max(sizes, key=lambda name: abs(sizes[name][1]))
        value, gain, sigmas = sizes[best]
        if not abs(sigmas) > _SURE:
            break
        alike = (name[0] for name, size in sizes.items() if abs(size[1]) > _ALIKE * abs(gain))
        also = tuple(dict.fromkeys(kind for kind in alike if kind != best[0]))
        found.append(Systematic(*best, value, abs(sigmas), also))
        score = score - value * np.einsum("tab,tb->ta", whitened.information, templates.pop(best))
    return tuple(found), dataclasses.replace(whitened, score=score)


def _templates(result: Result) -> dict[tuple[str, str], Array]:
    """Return motions (T, 6) of unit size by kind and axis."""
    assert result.log is not None
    tau_s, u = result.log.tau_s[:, None], result.log.seen_twist
    templates = {("bias", name): tau_s * axis for name, axis in zip(AXES, np.eye(6), strict=True)}
    before, after = (np.pad(u, [pad, (0, 0)], mode="edge")[at] for pad, at in _NEIGHBOURS)
    around, change = 0.5 * (before + after), (after - before) / (2.0 * _APART)
    std = np.maximum(result.noise.velocity_std, np.finfo(float).tiny)
    if not np.sqrt(np.mean((around / std) ** 2)) > _MOVING:
        return templates
    v, w = around[:, :3], around[:, 3:]
    templates["scale", ""] = tau_s * np.hstack([v, np.zeros_like(w)])
    for name, axis in zip(_CAMERA_AXES, np.eye(3), strict=True):
        templates["direction", name] = tau_s * np.hstack([np.cross(axis, v), np.cross(axis, w)])
    if result.noise.twist_walk_std is None:  # the prediction of velocities that walk is late by itself
        templates["delay", ""] = -change
    return templates


def _fitted(c: Array, C: Array, x: Array) -> tuple[float, float, float]:
    """Return the size of a template (n, 6), its significance in white innovations, and that in correlated ones."""
    along, information = np.einsum("ta,ta->t", x, c), np.einsum("ta,tab,tb->t", x, C, x)
    total = float(information.sum())
    if total <= 0:
        return 0.0, 0.0, 0.0
    value = float(along.sum()) / total
    rest = (along - value * information)[:, None]
    lags = lags_of_sums(len(c))
    variance = len(c) * float(whiteness.long_run_variance(whiteness.autocovariance(rest, lags))[0])
    return value, value * np.sqrt(total), value * total / np.sqrt(max(variance, total))


def grown_by(result: Result, found: tuple[Systematic, ...], vision: Array) -> tuple[Array, Array]:
    """Return factors (6,) of deviations that velocities would need, and the camera, whose share is ``vision``."""
    assert result.log is not None
    if not found:
        return np.ones(6), np.ones(6)
    templates, log = _templates(result), result.log
    step = np.sum([error.value * templates[error.kind, error.axis] for error in found], axis=0)
    A, drift = se3.adjoint(log.T_predicted @ se3.inverse(log.T_departed)), np.zeros((len(log.tau_s), 6))
    for k in range(1, len(drift)):
        drift[k] = A[k] @ drift[k - 1] + step[k]
    variance = np.diagonal(result.covariance, axis1=1, axis2=2)
    known = (variance > 0).all(axis=1)
    mean = (drift[known] ** 2 / variance[known]).mean(axis=0) if known.any() else np.zeros(6)
    return np.sqrt(1.0 + (1.0 - vision) ** 2 * mean), np.sqrt(1.0 + vision**2 * mean)
