"""Errors of a map and of trajectories ``T_world_imu`` (n, 4, 4) against truth at the same n instants."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.data.sequence import Truth
from ekfslam.filters.result import Landmarks
from ekfslam.geometry import se3

KITTI_SEGMENT_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
KITTI_START_STEP = 10  # frames between the starts of segments
LEAST_PART = 0.1  # of the squared error, from which a part of it is named
LEAST_LEVER = 0.2  # of the distances from the first pose, of a rotation that is named
PATH_TOLERANCE = 0.1  # largest relative difference of the path of a pair from the wanted one; the default of evo_rpe


def align_se3(points: Array, reference: Array) -> Array:
    """Return the rigid transform (4, 4) of points (n, 3) with least squared distances to others (Umeyama)."""
    centre, reference_centre = points.mean(axis=0), reference.mean(axis=0)
    U, _, Vt = np.linalg.svd((reference - reference_centre).T @ (points - centre))
    # The optimal orthogonal matrix may be a reflection; flipping the weakest direction gives the optimal rotation.
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = (U * signs) @ Vt
    return se3.transform(R, reference_centre - R @ centre)


def align_yaw(points: Array, reference: Array) -> Array:
    """Return the transform (4, 4) of points (n, 3) with least squared distances that turns about z alone."""
    centre, reference_centre = points.mean(axis=0), reference.mean(axis=0)
    p, q = (points - centre)[:, :2], (reference - reference_centre)[:, :2]
    yaw = np.arctan2((p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum(), (p * q).sum())
    R = se3.so3_exp(np.array([0.0, 0.0, yaw]))
    return se3.transform(R, reference_centre - R @ centre)


def absolute_trajectory_error(T_est: Array, T_true: Array, align: bool, by: Callable[..., Array] = align_se3) -> float:
    """Return the ATE, root mean square of position errors, m, aligned or not, never scaled (Sturm, IROS 2012)."""
    estimate, truth = T_est[:, :3, 3], T_true[:, :3, 3]
    if align:
        estimate = se3.apply(by(estimate, truth), estimate)
    return float(np.sqrt(np.mean(np.sum((estimate - truth) ** 2, axis=1))))


class Part(NamedTuple):
    """A part of the squared trajectory error that one number explains."""

    name: str  # roll, pitch or yaw of the first pose, x, y or z of a shift in world, or scale
    value: float  # error of that number: rad, m, or a ratio
    share: float  # share of the squared error that it removes after the parts before it


PARTS = ("roll", "pitch", "yaw", "x", "y", "z", "scale")


def error_parts(T_est: Array, T_true: Array) -> tuple[Part, ...]:
    """Return the parts of an unaligned ATE, the largest first; what is left over is the shape of the trajectory.

    To first order, errors of the positions p, from the first one, are ``phi x p + shift + scale p``, with phi along the
    axes of the first IMU. Parts are chosen one by one, each for the least squares that all together leave. A rotation
    about the way itself is none of them: its lever is short, so that a small error would make it large.
    """
    error, p = T_est[:, :3, 3] - T_true[:, :3, 3], T_true[:, :3, 3] - T_true[0, :3, 3]
    turns = [np.cross(axis, p) for axis in T_true[0, :3, :3].T]
    shifts = [np.broadcast_to(axis, p.shape) for axis in np.eye(3)]
    columns, b, total = np.stack([*turns, *shifts, p]).reshape(len(PARTS), -1), error.ravel(), float((error**2).sum())
    levers = np.linalg.norm(columns, axis=1) / max(float(np.linalg.norm(p)), np.finfo(float).tiny)
    open_parts = [i for i in range(len(PARTS)) if PARTS[i] in ("x", "y", "z") or levers[i] >= LEAST_LEVER]
    chosen, shares, left = list[int](), list[float](), total
    found: Array = np.zeros(0)
    while open_parts and total > 0:
        fits = {i: np.linalg.lstsq(columns[[*chosen, i]].T, b, rcond=None)[0].astype(float) for i in open_parts}
        rests = {i: float(((b - fit @ columns[[*chosen, i]]) ** 2).sum()) for i, fit in fits.items()}
        best = min(rests, key=rests.__getitem__)
        if left - rests[best] < LEAST_PART * total:
            break
        open_parts.remove(best)
        chosen, found = [*chosen, best], fits[best]
        shares, left = [*shares, (left - rests[best]) / total], rests[best]
    return tuple(Part(PARTS[i], float(value), share) for i, value, share in zip(chosen, found, shares, strict=True))


def final_position_error(T_est: Array, T_true: Array) -> float:
    """Return the distance in metres of the last estimated position from the true one, without alignment."""
    return float(np.linalg.norm(T_est[-1, :3, 3] - T_true[-1, :3, 3]))


def relative_pose_error_over_frames(T_est: Array, T_true: Array, frames: int = 1) -> tuple[float, float] | None:
    """Return the RPE over a number of frames: root mean squares of translation error, m, and rotation angle, deg.

    The error of the motion from pose i to pose j = i + frames is ``E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j)`` with Q the true
    and P the estimated poses (Sturm et al. 2012). Every pair counts, also across a gap in the truth. None without any.
    """
    start = np.arange(len(T_true) - frames)
    return _rms_relative_error(T_est, T_true, start, start + frames)


def relative_pose_error_over_path(T_est: Array, T_true: Array, path_m: float) -> tuple[float, float] | None:
    """Return the RPE over a length of true path: root mean squares of translation error, m, and rotation angle, deg.

    Each pose is paired with the first later one whose distance along the true path is nearest to ``path_m``, within
    `PATH_TOLERANCE`. These are the pairs of ``evo_rpe -d PATH -u m --all_pairs --pairs_from_reference``.
    """
    distance = distance_along(T_true)
    after = np.minimum(np.searchsorted(distance, distance + path_m), len(distance) - 1)
    before = np.maximum(after - 1, 0)
    off_after, off_before = (np.abs(distance[end] - distance - path_m) for end in (after, before))
    # Several poses lie at one distance while the vehicle stands still; a search finds the first.
    end = np.searchsorted(distance, distance[np.where(off_before <= off_after, before, after)])
    fits = np.minimum(off_before, off_after) <= PATH_TOLERANCE * path_m
    return _rms_relative_error(T_est, T_true, np.flatnonzero(fits), end[fits])


def distance_along(T: Array) -> Array:
    """Return the distance driven in metres (n,) from the first pose to each of (n, 4, 4)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1))])


def _relative_errors(T_est: Array, T_true: Array, start: IntArray, end: IntArray) -> tuple[Array, Array]:
    """Return length, m, and angle, rad, (pairs,) of the errors of the motions from ``start`` to ``end`` (pairs,)."""
    step_est = se3.inverse(T_est[start]) @ T_est[end]
    step_true = se3.inverse(T_true[start]) @ T_true[end]
    error = se3.inverse(step_true) @ step_est
    return np.linalg.norm(error[:, :3, 3], axis=1), np.linalg.norm(se3.so3_log(error[:, :3, :3]), axis=1)


def _rms_relative_error(T_est: Array, T_true: Array, start: IntArray, end: IntArray) -> tuple[float, float] | None:
    if not len(start):
        return None
    length, angle = _relative_errors(T_est, T_true, start, end)
    return float(np.sqrt(np.mean(length**2))), float(np.degrees(np.sqrt(np.mean(angle**2))))


def kitti_segment_errors(T_est: Array, T_true: Array) -> tuple[float, float] | None:
    """Return the relative errors of the KITTI odometry benchmark: ``(t_rel_percent, r_rel_deg_per_100m)``.

    Mean over all segments of 100, 200, ..., 800 m of true path from every tenth pose, of errors divided by the nominal
    length (Geiger et al., *Are we ready for autonomous driving?*, CVPR 2012, and its devkit). None if no segment fits.
    """
    distance = distance_along(T_true)
    start, length = np.meshgrid(np.arange(0, len(T_true), KITTI_START_STEP), KITTI_SEGMENT_LENGTHS_M, indexing="ij")
    # The devkit ends a segment at the first pose that lies strictly further than the nominal length.
    end = np.searchsorted(distance, distance[start] + length, side="right")
    fits = end < len(T_true)
    if not fits.any():
        return None
    start, end, length = start[fits], end[fits], length[fits]
    translation, rotation = _relative_errors(T_est, T_true, start, end)
    return 100.0 * float(np.mean(translation / length)), 100.0 * float(np.degrees(np.mean(rotation / length)))


def match_landmarks(landmarks: Landmarks, truth: Truth) -> tuple[IntArray, IntArray]:
    """Return the rows of estimated landmarks with known true position, and their rows in the truth: (n,), (n,)."""
    order = np.argsort(truth.landmark)
    place = np.searchsorted(truth.landmark, landmarks.id, sorter=order)
    known = np.isin(landmarks.id, truth.landmark)
    return np.flatnonzero(known), order[place[known]]


def landmark_rmse(landmarks: Landmarks, truth: Truth) -> float | None:
    """Return the root mean square distance (m) of landmarks from their true positions, unaligned; None without any."""
    rows, truth_rows = match_landmarks(landmarks, truth)
    if not len(rows):
        return None
    error = landmarks.position_m[rows] - truth.position_m[truth_rows]
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))
