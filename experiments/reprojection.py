"""Measure how well tracks fit the true poses: the criterion of track hygiene, independent of any filter."""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.data.sequence import Observations, Sequence
from ekfslam.errors import TruthError
from ekfslam.geometry import camera as cam
from ekfslam.geometry import se3

HUBER_PX = 3.0  # where the robust fit of a track's point turns linear, of the norm of all four pixels
NEAREST_M = 0.1

_ITERATIONS = 15


def reprojection_errors(sequence: Sequence, observations: Observations | None = None) -> Array:
    """Return the distance of each observation from its track's point in the left image, at the true poses.

    The point of a track fits all its stereo observations best: least squares of the four pixels with a Huber kernel
    (Levenberg-Marquardt from the observation of largest disparity). A track that has shown several points fits at most
    one of them.

    Args:
        sequence: A recording with true poses.
        observations: Its tracks, if not those of the sequence, for instance after hygiene.

    Returns:
        (K,) px, in the order of the observations; NaN in frames without a true pose, and for tracks that never have a
        positive disparity in the others.

    Raises:
        TruthError: No pose is known.
    """
    truth = sequence.truth
    if truth is None or not len(truth.frame):
        raise TruthError(f"{sequence.name}: reprojection errors need true poses")
    observations = sequence.observations if observations is None else observations
    place = np.full(len(sequence), -1)
    place[truth.frame] = np.arange(len(truth.frame))
    order = np.lexsort((observations.frame, observations.landmark))
    order = order[place[observations.frame[order]] >= 0]
    _, track = np.unique(observations.landmark[order], return_inverse=True)
    largest = np.zeros(len(order))
    pixels = observations.pixels_px[order]
    np.maximum.at(largest, track, pixels[:, 0] - pixels[:, 2])
    located = largest[track] > 0
    order, pixels, track = order[located], pixels[located], track[located]

    errors = np.full(len(observations), np.nan)
    if len(order):
        T_cam_world = (sequence.T_cam_imu @ se3.inverse(truth.T_world_imu))[place[observations.frame[order]]]
        q = _points_seen(sequence.camera, T_cam_world, pixels, track)
        errors[order] = np.linalg.norm((pixels - cam.project(sequence.camera, q))[:, :2], axis=1)
    return errors


def _points_seen(camera: cam.StereoCamera, T_cam_world: Array, pixels: Array, track: IntArray) -> Array:
    """Return the point of its track in the camera frame of each of k observations, sorted by ``track`` (k,): (k, 3)."""
    _, starts, track = np.unique(track, return_index=True, return_inverse=True)
    disparity = pixels[:, 0] - pixels[:, 2]
    first = np.lexsort((-disparity, track))[starts]
    rows = np.stack([pixels[:, 0], 0.5 * (pixels[:, 1] + pixels[:, 3]), pixels[:, 2]], axis=-1)[first]
    points = se3.apply(se3.inverse(T_cam_world[first]), cam.triangulate(camera, rows))

    def cost(points: Array) -> tuple[Array, Array, Array, Array]:
        """Return points in the camera frame, residuals, their norms, and the cost of each track."""
        q = se3.apply(T_cam_world, points[track])
        residual = pixels - cam.project(camera, q)
        norm = np.linalg.norm(residual, axis=1)
        huber = np.where(norm < HUBER_PX, 0.5 * norm**2, HUBER_PX * (norm - 0.5 * HUBER_PX))
        return q, residual, norm, np.add.reduceat(np.where(q[:, 2] > NEAREST_M, huber, np.inf), starts)

    damping = np.full(len(points), 1e-3)
    q, residual, norm, now = cost(points)
    for _ in range(_ITERATIONS):
        weight = np.minimum(1.0, HUBER_PX / np.maximum(norm, HUBER_PX))[:, None, None]
        J = cam.projection_jacobian(camera, q) @ T_cam_world[:, :3, :3]
        H = np.add.reduceat(np.swapaxes(J, -1, -2) @ (weight * J), starts)
        g = np.add.reduceat(np.swapaxes(J, -1, -2) @ (weight * residual[..., None]), starts)
        H += damping[:, None, None] * H * np.eye(3)
        trial = points + np.linalg.solve(H, g)[..., 0]
        better = cost(trial)[3] <= now
        points = np.where(better[:, None], trial, points)
        damping = np.where(better, damping / 5.0, damping * 5.0)
        q, residual, norm, now = cost(points)
    return q
