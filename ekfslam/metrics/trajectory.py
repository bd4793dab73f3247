"""Errors of a trajectory and of a map against ground truth.

Trajectories are stacks of poses ``T_world_imu`` (n, 4, 4), estimate and truth at the same n instants.
"""

from __future__ import annotations

import numpy as np

from ekfslam import se3
from ekfslam.result import Landmarks
from ekfslam.se3 import Array
from ekfslam.sequence import IntArray, Truth

KITTI_SEGMENT_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
KITTI_START_STEP = 10  # frames between the starts of segments


def align_se3(points: Array, reference: Array) -> Array:
    """Rigid transform (4, 4) that brings points (n, 3) closest to their reference (n, 3) in the least-squares sense.

    Umeyama's method without scale. Points on a line leave the rotation about it undetermined; any optimum is returned.
    """
    centre, reference_centre = points.mean(axis=0), reference.mean(axis=0)
    U, _, Vt = np.linalg.svd((reference - reference_centre).T @ (points - centre))
    # The optimal orthogonal matrix may be a reflection; flipping the weakest direction gives the optimal rotation.
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = (U * signs) @ Vt
    return se3.transform(R, reference_centre - R @ centre)


def absolute_trajectory_error(T_est: Array, T_true: Array, align: bool) -> float:
    """Root mean square of the position errors in metres: as they are, or after `align_se3` of the positions."""
    estimate, truth = T_est[:, :3, 3], T_true[:, :3, 3]
    if align:
        estimate = se3.apply(align_se3(estimate, truth), estimate)
    return float(np.sqrt(np.mean(np.sum((estimate - truth) ** 2, axis=1))))


def final_position_error(T_est: Array, T_true: Array) -> float:
    """Distance in metres between the last estimated and the last true position, no alignment."""
    return float(np.linalg.norm(T_est[-1, :3, 3] - T_true[-1, :3, 3]))


def kitti_segment_errors(T_est: Array, T_true: Array) -> tuple[float, float] | None:
    """Relative errors of the KITTI odometry benchmark: ``(t_rel_percent, r_rel_deg_per_100m)``.

    Mean over all segments of 100, 200, ..., 800 m of true path that start at every tenth pose, of the segment's
    translation and rotation error divided by its nominal length. None if no segment fits, i.e. the path is not longer
    than 100 m.
    """
    distance = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(T_true[:, :3, 3], axis=0), axis=1))])
    start, length = np.meshgrid(np.arange(0, len(T_true), KITTI_START_STEP), KITTI_SEGMENT_LENGTHS_M, indexing="ij")
    # The devkit ends a segment at the first pose that lies strictly further than the nominal length.
    end = np.searchsorted(distance, distance[start] + length, side="right")
    fits = end < len(T_true)
    if not fits.any():
        return None
    start, end, length = start[fits], end[fits], length[fits]
    step_est = se3.inverse(T_est[start]) @ T_est[end]
    step_true = se3.inverse(T_true[start]) @ T_true[end]
    error = se3.inverse(step_est) @ step_true
    translation = np.linalg.norm(error[:, :3, 3], axis=1)
    rotation = np.linalg.norm(se3.so3_log(error[:, :3, :3]), axis=1)
    return 100.0 * float(np.mean(translation / length)), 100.0 * float(np.degrees(np.mean(rotation / length)))


def match_landmarks(landmarks: Landmarks, truth: Truth) -> tuple[IntArray, IntArray]:
    """Rows of the estimated landmarks that have a known true position, and the rows of that truth: (n,), (n,).

    An id that occurs several times in the estimate is matched every time.
    """
    order = np.argsort(truth.landmark)
    place = np.searchsorted(truth.landmark, landmarks.id, sorter=order)
    known = np.isin(landmarks.id, truth.landmark)
    return np.flatnonzero(known), order[place[known]]


def landmark_rmse(landmarks: Landmarks, truth: Truth) -> float | None:
    """Root mean square distance in metres of estimated landmarks from their true positions, no alignment.

    None if no estimated landmark has a known true position.
    """
    rows, truth_rows = match_landmarks(landmarks, truth)
    if not len(rows):
        return None
    error = landmarks.position_m[rows] - truth.position_m[truth_rows]
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))
