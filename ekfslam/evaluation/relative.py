"""Consistency of relative poses, which needs no first pose, and shows how a covariance grows."""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.data.sequence import Truth
from ekfslam.evaluation.consistency import (
    drift_covariance,
    interpolated_frames,
    nees,
    pose_noise_covariance,
    scale_covariance,
    turned_body_covariance,
)
from ekfslam.evaluation.trajectory import PATH_TOLERANCE, distance_along
from ekfslam.filters.result import PosePairs, Result
from ekfslam.geometry import se3
from ekfslam.stored import empty

FRAMES = (10, 50, 100)
PATHS_M = (50.0, 100.0)


def relative_pairs(truth: Truth, reach: int) -> tuple[IntArray, IntArray]:
    """Return pairs of frames (n,), (n,) with known true poses, whose relative pose is to be judged.

    First frames are every quarter of ``reach``. Second frames come `FRAMES` later, or nearest to `PATHS_M` of true path
    later, within `PATH_TOLERANCE` and ``reach``.
    """
    frame, found = truth.frame, set[tuple[int, int]]()
    distance = distance_along(truth.T_world_imu)
    for place in np.flatnonzero(frame % max(reach // 4, 1) == 0) if reach else ():
        later = slice(place + 1, int(np.searchsorted(frame, frame[place] + reach, side="right")))
        wanted = [int(k) for k in frame[later] if k - frame[place] in FRAMES]
        way = distance[later] - distance[place]
        for path_m in PATHS_M if len(way) else ():
            off = np.abs(way - path_m)
            if off.min() <= PATH_TOLERANCE * path_m:
                wanted.append(int(frame[later][off.argmin()]))
        found.update((int(frame[place]), k) for k in wanted)
    pairs = np.array(sorted(found), dtype=np.int64).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


def dead_reckoned_pairs(first: IntArray, second: IntArray, T_world_imu: Array, covariance: Array) -> PosePairs:
    """Return cross-covariances of poses j, k (n,) without updates: ``cov(xi_k, xi_j) = Ad(T_k T_j^-1) P_jj``, eq. (2).

    Poses (T, 4, 4) and covariances (T, 6, 6) are of all frames.
    """
    A = se3.adjoint(se3.inverse(T_world_imu[second]) @ T_world_imu[first])
    return PosePairs(first, second, covariance[first] @ np.swapaxes(A, -1, -2))


def relative_covariance(result: Result, pairs: PosePairs) -> tuple[Array, Array]:
    """Return the motions ``T_hat_k T_hat_j^-1`` (n, 4, 4) of pairs j, k, and the covariances (n, 6, 6) of their errors.

    The error of the motion ``T_k T_j^-1`` is, to first order in the stored errors,

        e = xi_k - A xi_j,    A = Ad(T_hat_k T_hat_j^-1),    cov(e) = P_kk + A P_jj A^T - P_kj A^T - A P_jk.
    """
    motion = se3.inverse(result.T_world_imu[pairs.second]) @ result.T_world_imu[pairs.first]
    A, P = se3.adjoint(motion), result.covariance
    A_cross = A @ pairs.cross
    own = P[pairs.second] + A @ P[pairs.first] @ np.swapaxes(A, -1, -2)
    return motion, own - A_cross - np.swapaxes(A_cross, -1, -2)


def relative_pose_nees(result: Result, truth: Truth, interpolated: BoolArray) -> tuple[PosePairs, Array]:
    """Return pairs with true poses and the NEES (n,) of their relative pose, 6 degrees of freedom; NaN if singular.

    Truth noise adds ``N_k + A N_j A^T`` to `relative_covariance`, with N that of single true poses, and the covariances
    of drift, scale and turned body; errors of the first pose and of the world cancel. Pairs with an ``interpolated``
    interval (T,) between them are left out.
    """
    pairs, place = result.pairs or empty(PosePairs), np.full(len(result.time_s), -1)
    place[truth.frame] = np.arange(len(truth.frame))
    invented = np.cumsum(interpolated | interpolated_frames(truth, len(place)))
    is_measured = invented[pairs.first] == invented[pairs.second]
    pairs = pairs.only((place[pairs.first] >= 0) & (place[pairs.second] >= 0) & is_measured)
    j, k = place[pairs.first], place[pairs.second]
    motion, covariance = relative_covariance(result, pairs)
    error = se3.log(se3.inverse(truth.T_world_imu[k]) @ truth.T_world_imu[j] @ se3.inverse(motion))
    if truth.noise is not None:
        N, A = pose_noise_covariance(truth.noise, truth.T_world_imu, result.time_s[truth.frame]), se3.adjoint(motion)
        covariance = covariance + N[k] + A @ N[j] @ np.swapaxes(A, -1, -2) + turned_body_covariance(truth.noise, A)
        lapse_s = result.time_s[pairs.second] - result.time_s[pairs.first]
        covariance = covariance + drift_covariance(truth.noise, lapse_s) + scale_covariance(truth.noise, motion)
    return pairs, nees(error, covariance)


def over_frames(pairs: PosePairs, frames: int) -> BoolArray:
    """Return a mask (n,) of the pairs that are ``frames`` apart."""
    return pairs.second - pairs.first == frames


def over_path(pairs: PosePairs, truth: Truth, path_m: float) -> BoolArray:
    """Return a mask (n,) of the pairs nearest to ``path_m`` of true path, at most one for each first frame."""
    distance = np.full(truth.frame[-1] + 1 if len(truth.frame) else 0, np.nan)
    distance[truth.frame] = distance_along(truth.T_world_imu)
    off = np.abs(distance[pairs.second] - distance[pairs.first] - path_m)
    order = np.lexsort((pairs.second, off, pairs.first))
    nearest = order[np.diff(pairs.first[order], prepend=-1) != 0]
    chosen = np.zeros(len(off), dtype=bool)
    chosen[nearest[off[nearest] <= PATH_TOLERANCE * path_m]] = True
    return chosen
