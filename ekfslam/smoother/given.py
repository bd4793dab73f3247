"""Covariance of a trajectory that another program estimated from the same recording.

The maximum a posteriori of the recording is efficient: to first order its error is uncorrelated with its difference to
any other estimate of the same data (Hausman, "Specification tests in econometrics", Econometrica 1978). So the errors
of a given trajectory, with difference ``d_k`` to the maximum a posteriori, whose marginals are ``P_k``, have

    E[xi_k xi_k^T] = P_k + E[d_k d_k^T].

One trajectory shows one draw of d. Its size is taken in units of the marginals, ``P_k = L_k L_k^T``, over all frames:

    P_given = G P G^T,    G_k = L_k (I + M)^(1/2) L_k^-1,    M = mean_k(y_k y_k^T),    y_k = L_k^-1 d_k.

A trajectory as good as the maximum a posteriori has its covariance. One that is better, through loops that the tracks
do not close, gets too large a covariance, never too small a one.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.errors import PosteriorError
from ekfslam.filters.result import Result
from ekfslam.geometry import se3
from ekfslam.smoother.posterior import Posterior, smooth

GIVEN = "given"  # mode of the result
_LEAST = 3  # poses


@dataclass(frozen=True)
class Given:
    """A given trajectory, aligned at its first pose with a posterior."""

    T_world_imu: Array  # (T, 4, 4) poses; of frames without one, from the one before and the motion of the posterior
    G: Array  # (T, 6, 6) see the module
    length: float  # its length over that of the posterior


def compared(found: Posterior, frame: IntArray, T_world_imu: Array) -> Given:
    """Compare a trajectory (n, 4, 4), in a world of its own, at increasing frames from 0 on with the posterior."""
    if len(frame) < _LEAST or frame[0] != 0:
        raise PosteriorError(f"expected {_LEAST} poses or more from the first frame on, found {len(frame)}")
    ours = found.T_world_imu
    aligned = ours[0] @ se3.inverse(T_world_imu[0]) @ T_world_imu
    before = np.searchsorted(frame, np.arange(len(ours)), side="right") - 1
    T = aligned[before] @ se3.inverse(ours[frame[before]]) @ ours
    later = frame[1:]
    d = se3.log(se3.inverse(ours[later]) @ T[later])
    L, G = np.linalg.cholesky(found.pose_covariance[later]), np.broadcast_to(np.eye(6), (len(T), 6, 6)).copy()
    y = np.linalg.solve(L, d[..., None])[..., 0]
    root = np.linalg.cholesky(np.eye(6) + y.T @ y / len(y))
    L = np.linalg.cholesky(found.pose_covariance[1:])
    G[1:] = L @ root @ np.linalg.inv(L)
    way = [np.linalg.norm(np.diff(poses[frame, :3, 3], axis=0), axis=1).sum() for poses in (T, ours)]
    return Given(T, G, float(way[0] / way[1]) if way[1] else 1.0)


def given_result(full: Result, found: Posterior, given: Given, name: str) -> Result:
    """Return a given trajectory as a result of mode ``given``, with the covariances of its poses and of their pairs."""
    smoothed, G = smooth(full, found=found), given.G
    covariance, pairs = G @ smoothed.covariance @ np.swapaxes(G, 1, 2), smoothed.pairs
    if pairs is not None:
        cross = G[pairs.first] @ pairs.cross @ np.swapaxes(G[pairs.second], 1, 2)
        pairs = dataclasses.replace(pairs, cross=cross)
    variances = (
        np.diagonal(P, axis1=1, axis2=2)[1:].reshape(-1, 2, 3).sum(axis=2) for P in (covariance, found.pose_covariance)
    )
    position, rotation = np.sqrt(np.median(np.divide(*variances), axis=0)).tolist()
    facts = {"given_scale_position": position, "given_scale_rotation": rotation, "given_length": given.length}
    return dataclasses.replace(
        smoothed,
        mode=GIVEN,
        T_world_imu=given.T_world_imu,
        covariance=covariance,
        pairs=pairs,
        inertial=None,
        attributes={**smoothed.attributes, "given_trajectory": name, **facts},
    )
