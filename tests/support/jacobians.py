"""Poses, velocities and points at which derivatives are compared with central differences."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from ekfslam.filters.observing import moment
from ekfslam.geometry import se3
from support.reference import T_CAM_IMU

RNG = np.random.default_rng(7)
HALF_TURNS = [(np.pi - 1e-7) * axis for axis in (*np.eye(3), np.array([0.6, -0.8, 0.0]))]
POSES = {
    "identity": np.eye(4),
    "near identity": se3.exp(np.full(6, 1e-9)),
    **{f"random {i}": se3.exp(RNG.normal(size=6) * [20, 20, 20, 1, 1, 1]) for i in range(4)},
    **{f"near pi {i}": se3.exp(np.concatenate([RNG.normal(size=3) * 5, w])) for i, w in enumerate(HALF_TURNS)},
}
SPIN = np.array([8, 1, 0, 0, 0, 31.0])  # about a half turn in 0.1 s
TWISTS = [np.zeros(6), np.full(6, 1e-9), *RNG.normal(size=(3, 6)) * [10, 2, 1, 1, 1, 1], SPIN]


def central(function, size, step=1e-6):
    """Jacobian of a vector function of a ``size``-vector at zero, exact to second order."""
    columns = [(function(h) - function(-h)) / (2 * step) for h in np.eye(size) * step]
    return np.array(columns).T


def visible_points(T_imu_world, n=5):
    """World points in front of the camera, near and far."""
    q = RNG.uniform([-3, -2, 2], [3, 2, 30], (n, 3))
    return se3.apply(se3.inverse(T_CAM_IMU @ T_imu_world), q)


@dataclass(frozen=True)
class Seen:
    """Points q (n, 3), rows z (n, d), and derivatives H_x (n, d, seen) by blocks and H_m (n, d, 3) by landmarks."""

    q: np.ndarray
    z: np.ndarray
    H_x: np.ndarray
    H_m: np.ndarray


def see(observer, moment, positions, linear, is_difference=False):
    """Landmarks as the sensor sees them at a moment, by the blocks of its frame."""
    camera = observer.cameras(moment).at(np.broadcast_to(np.asarray(is_difference, dtype=int), len(positions)))
    W, W_linear = camera.T_cam_imu @ moment.T_imu_world, camera.T_cam_imu @ moment.T_linear
    found = observer.project(moment.calibration, W, positions, W_linear, linear)
    return Seen(found.q, found.z, observer.by_body(found, camera.by), found.H_m)


def measurement_jacobian(e, ids):
    """Return the full-width H (3k, b+3n) of the sensor's rows of active landmarks ``ids`` (k,)."""
    slot = e.slots(ids)
    seen = see(e.model.observer, moment(e, e.mean), e.positions_m[slot], e.linear_positions_m[slot])
    k, d, width = seen.H_x.shape
    row = np.broadcast_to(np.arange(k * d).reshape(k, d, 1), (k, d, width + 3))
    body = np.broadcast_to(np.arange(width), (k, d, width))
    own = np.broadcast_to((e.gaussian.body + 3 * slot)[:, None, None] + np.arange(3), (k, d, 3))
    columns = np.concatenate([body, own], axis=-1)
    values = np.concatenate([seen.H_x, seen.H_m], axis=-1)
    return sp.csr_array((values.ravel(), (row.ravel(), columns.ravel())), shape=(k * d, len(e.P)))


def hat(xi):
    """Return ``xi^``, the 4x4 Lie-algebra matrix of a tangent vector: (..., 6) to (..., 4, 4)."""
    out = np.zeros((*np.shape(xi)[:-1], 4, 4))
    out[..., :3, :3], out[..., :3, 3] = se3.skew(xi[..., 3:]), xi[..., :3]
    return out
