"""Poses of another body: a constant pose between the body of a trajectory and that of the truth (hand and eye).

If B moves rigidly with A, motions over stretches of about a second agree through the constant ``X = T_A_B``:
``q = X^-1 p X`` (Shiu, Ahmad, "Calibration of wrist-mounted robotic sensors by solving homogeneous transform equations
of the form AX = XB", 1989). Late stamps and a wrong scale look similar: both are estimated with X.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.data.sequence import Truth
from ekfslam.evaluation.causes import Cause
from ekfslam.evaluation.evidence import TruthAgreement, truth_agreement
from ekfslam.evaluation.sources import first_of_each
from ekfslam.evaluation.trajectory import align_se3, align_yaw
from ekfslam.evaluation.truth import estimated
from ekfslam.filters.result import Result
from ekfslam.geometry import se3

_STRETCH_S, _LEAST_STRETCHES, _MOST_STRETCHES = 1.0, 12, 400
# Standard deviations beforehand: lever (m), turn (rad), lateness (s), scale. They hold what the motion does not show.
_PRIOR = np.array([3.0] * 3 + [3.0] * 3 + [0.1, 0.1])
_STEPS, _ROUNDS, _CUT = 1e-6, 12, 2.5
_SURE = 10.0  # standard deviations from which X is no chance
_NAMED = 3.0  # standard deviations of a direction that is named
_LEAST_M, _LEAST_RAD = 0.01, np.radians(0.5)
_EXPLAINS = 4.0  # times the NEES without it
_NEAR_M, _NEAR_RAD = 0.03, np.radians(1.0)  # from the left camera, within which the body is that
_TURNED = 0.5  # rad, of optical axes that are told from those of the body
_REMOVES = 0.9  # of the median difference of motions, which X must leave at most


class OtherBody(NamedTuple):
    """Pose ``T_A_B`` (4, 4) of the body of a truth in that of an estimate, and standard deviations of its parts."""

    T: Array
    std_m: float
    std_rad: float
    left: float  # share of the differences that it leaves

    @property
    def size(self) -> str:
        """Lever and angle in words."""
        lever, angle = np.linalg.norm(self.T[:3, 3]), np.degrees(np.linalg.norm(se3.so3_log(self.T[:3, :3])))
        words = [f"{lever:.2g} +- {self.std_m:.1g} m away"] if lever else []
        words += [f"turned by {angle:.2g} +- {np.degrees(self.std_rad):.1g} deg"] if angle else []
        return ", ".join(words)

    @property
    def flag(self) -> str:
        """Argument of ``--truth-frame``: translation, m, and quaternion x y z w."""
        from scipy.spatial.transform import Rotation  # imported late: it takes long

        quaternion = Rotation.from_matrix(self.T[:3, :3]).as_quat(canonical=True)
        return " ".join(f"{value:.4g}" for value in (*self.T[:3, 3], *quaternion))


def other_body(time_s: Array, T_est: Array, T_true: Array) -> OtherBody | None:
    """Return the constant pose that explains most of the differences of trajectories (n, 4, 4); None without one."""
    begin, end = _stretches(time_s)
    if len(begin) < _LEAST_STRETCHES:
        return None
    p, q = (se3.inverse(T[begin]) @ T[end] for T in (T_est, T_true))
    rates = [_rate(time_s, T_est, at) for at in (begin, end)]
    x, X = np.zeros(8), _first(p, q)
    before, residual = _difference(p, q, rates, np.eye(4), x), _difference(p, q, rates, X, x)
    for _ in range(_ROUNDS):
        scale = np.repeat([np.median(np.abs(residual[:, part])) / 0.6745 for part in (slice(3), slice(3, 6))], 3)
        scale = np.maximum(scale, 1e-9)
        J = np.stack([_column(p, q, rates, X, x, i) for i in range(8)], axis=-1)
        weight = np.minimum(1.0, _CUT / np.maximum(np.abs(residual) / scale, 1e-12)) / scale**2
        information = np.einsum("nki,nk,nkj->ij", J, weight, J) + np.diag(_PRIOR**-2)
        pull = np.concatenate([se3.log(X), x[6:]]) / _PRIOR**2
        step = np.linalg.solve(information, -np.einsum("nki,nk,nk->i", J, weight, residual) - pull)
        X, x = X @ se3.exp(step[:6]), x + np.concatenate([np.zeros(6), step[6:]])
        residual = _difference(p, q, rates, X, x)
    C, alone = np.linalg.inv(information)[:6, :6], _difference(p, q, rates, np.eye(4), x)
    sigmas = float(np.sqrt(se3.log(X) @ np.linalg.solve(C, se3.log(X))))
    lever, std_m = _shown(X[:3, 3], C[:3, :3])
    turn, std_rad = _shown(se3.so3_log(X[:3, :3]), C[3:, 3:])
    is_large = bool(np.linalg.norm(lever) > _LEAST_M or np.linalg.norm(turn) > _LEAST_RAD)
    left = max(_ratio(residual, before), _ratio(residual, alone))
    is_found = is_large and sigmas > _SURE and left < _REMOVES
    return OtherBody(se3.transform(se3.so3_exp(turn), lever), std_m, std_rad, left) if is_found else None


def _shown(value: Array, covariance: Array) -> tuple[Array, float]:
    """Return the part of a vector (3,) that the motion shows, and its standard deviation."""
    variance, axes = np.linalg.eigh(covariance)
    along = axes.T @ value
    shown = np.abs(along) > _NAMED * np.sqrt(variance)
    return axes @ np.where(shown, along, 0.0), float(np.sqrt(variance[shown].sum()))


def body_causes(
    result: Result, truth: Truth | None, interpolated: BoolArray | None, found: TruthAgreement | None
) -> Iterator[Cause]:
    """Yield a cause if errors are too large by the truth, and most of them vanish with the body of the truth."""
    truth = truth and estimated(result, truth)
    if truth is None or found is None or found.nees <= found.high:
        return
    T_est = result.T_world_imu[truth.frame]
    body = other_body(result.time_s[truth.frame], T_est, truth.T_world_imu)
    if body is None:
        return
    moved = truth_agreement(result, moved_truth(truth, body, T_est, result.knows_vertical), interpolated)
    if moved is not None and moved.nees < found.nees / _EXPLAINS:
        text = f"the truth looks like poses of another body than the recording's: {body.size}"
        flag = "camera" if _is_camera(body, result.T_cam_imu) else body.flag
        remedy = f"--truth-frame {flag} states where it is (or T_cam_imu is wrong by as much)"
        yield Cause("body", (), float(np.sqrt(found.nees / moved.nees)), text, remedy)


def _is_camera(body: OtherBody, T_cam_imu: Array) -> bool:
    """Return whether a body is the left camera, by its axes if they differ from those of the IMU, else by its place."""
    off, own = se3.log(T_cam_imu @ body.T), se3.so3_log(T_cam_imu[:3, :3])
    is_near = np.linalg.norm(off[:3]) < _NEAR_M + _NAMED * body.std_m or np.linalg.norm(own) > _TURNED
    return bool(is_near and np.linalg.norm(off[3:]) < _NEAR_RAD + _NAMED * body.std_rad)


def moved_truth(truth: Truth, found: OtherBody, T_est: Array, is_level: bool) -> Truth:
    """Return the truth as poses of the estimate's body, in the world of the estimate (n, 4, 4).

    Both first poses agree. If accelerations show the vertical, only yaw and position are free: a first tilt may err.
    """
    T = truth.T_world_imu @ se3.inverse(found.T)
    world = align_yaw(T[:, :3, 3], T_est[:, :3, 3]) if is_level else T_est[0] @ se3.inverse(T[0])
    return dataclasses.replace(truth, T_world_imu=world @ T)


def _stretches(time_s: Array) -> tuple[IntArray, IntArray]:
    """Return first and last indices (n,) of stretches that overlap by half, without those across gaps."""
    starts = first_of_each(time_s, 0.5 * _STRETCH_S)
    starts = starts[:: -(-len(starts) // _MOST_STRETCHES)]
    ends = np.searchsorted(time_s, time_s[starts] + _STRETCH_S - 1e-6)
    fits = ends < len(time_s)
    starts, ends = starts[fits], ends[fits]
    fits = time_s[ends] - time_s[starts] < 2.0 * _STRETCH_S
    return starts[fits], ends[fits]


def _rate(time_s: Array, T: Array, at: IntArray) -> Array:
    """Return velocities (n, 6) along the axes of the body at some indices."""
    before, after = np.maximum(at - 1, 0), np.minimum(at + 1, len(time_s) - 1)
    return se3.log(se3.inverse(T[before]) @ T[after]) / (time_s[after] - time_s[before])[:, None]


def _first(p: Array, q: Array) -> Array:
    """Return a rotation (4, 4) that turns axes and ways of ``q`` into those of ``p``."""
    turns, ways = ([f(T) for T in (p, q)] for f in (lambda T: se3.so3_log(T[:, :3, :3]), lambda T: T[:, :3, 3]))
    size = [max(float(np.sqrt((pair[0] ** 2).mean())), 1e-12) for pair in (turns, ways)]
    both = [np.vstack([turns[i] / size[0], ways[i] / size[1]]) for i in (0, 1)]
    both = [np.vstack([rows, -rows]) for rows in both]  # without a shift
    return se3.transform(align_se3(both[1], both[0])[:3, :3], np.zeros(3))


def _difference(p: Array, q: Array, rates: list[Array], X: Array, x: Array) -> Array:
    """Return differences (n, 6) of true motions ``q`` from ``p`` with X, lateness x[6] and scale x[7]."""
    scaled = p.copy()
    scaled[:, :3, 3] *= 1.0 + x[7]
    late = [se3.exp(x[6] * rate) for rate in rates]
    return se3.log(se3.inverse(q) @ se3.inverse(X) @ se3.inverse(late[0]) @ scaled @ late[1] @ X)


def _column(p: Array, q: Array, rates: list[Array], X: Array, x: Array, i: int) -> Array:
    """Return the derivative (n, 6) of `_difference` by the number ``i`` of lever, turn, lateness and scale."""
    step = _STEPS * np.eye(8)[i]
    ahead, behind = (
        _difference(p, q, rates, X @ se3.exp(sign * step[:6]), x + sign * np.concatenate([np.zeros(6), step[6:]]))
        for sign in (1.0, -1.0)
    )
    return (ahead - behind) / (2.0 * _STEPS)


def _ratio(rest: Array, before: Array) -> float:
    """Return the smaller ratio of medians of rest and difference, of positions and rotations."""
    parts = [slice(3), slice(3, 6)]
    sizes = [[np.median(np.linalg.norm(each[:, part], axis=1)) for part in parts] for each in (rest, before)]
    return float(min(after / max(was, 1e-12) for after, was in zip(*sizes, strict=True)))
