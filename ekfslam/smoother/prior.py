"""Prior of a window: a Gaussian over the blocks of its first frame and over landmarks, seen from there.

Landmarks count by their images (x/z, y/z, 1/z) in the camera of the first frame, where their errors are Gaussian, as in
eq. (7'). So a motion of the whole world changes the pose alone: however often the prior is linearised, it says nothing
about directions that no measurement observes.

    y = (xi, blocks, landmarks) = mean + B zeta,    zeta ~ N(0, I)
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.filters.coordinates import is_in_image
from ekfslam.geometry import se3
from ekfslam.models.model import Model
from ekfslam.smoother.sparse.factors import Factor, LinearSystem
from ekfslam.smoother.unknowns import State, root


@dataclass(frozen=True)
class First:
    """Unknowns of the first frame: pose, shared blocks (w-6,), further blocks (a,), the drive (g,), and landmarks."""

    T_imu_world: Array
    shared: Array
    aux: Array
    drive: Array
    positions_m: Array


@dataclass(frozen=True)
class Prior:
    """A Gaussian over the first frame and landmarks, see the module."""

    T_reference: Array  # (4, 4) pose T_imu_world from which xi counts
    T_cam_imu: Array  # (4, 4) extrinsics of the camera of the images
    mean: Array  # (p,)
    B: Array  # (p, p)
    landmarks: IntArray  # (n,) rows of the landmarks in the log of the filter, ascending
    in_image: BoolArray  # (n,) whether a landmark counts by its image, or by (x, y, z)
    sizes: tuple[int, int, int]  # columns of frame, further blocks and drive

    @staticmethod
    def at_state(
        model: Model,
        state: State,
        frame: int,
        rows: IntArray,
        landmarks: IntArray,
        delta: Array,
        P: Array,
        min_depth_m: float,
    ) -> tuple[Prior, Array]:
        """Return the prior ``N(delta, P)`` of errors at a frame of a state, and the zeta of that state.

        Errors (p,) are those of (frame, further blocks, drive, landmarks in world). ``rows`` and ``landmarks`` (n,) are
        the rows of its landmarks in the filter's log and in the state.
        """
        T, shared, aux = state.T_imu_world[frame], state.shared[frame], state.aux[frame]
        T_cam_imu = model.sensor.T_cam_imu
        q = se3.apply(T_cam_imu @ T, state.positions_m[landmarks])
        in_image = is_in_image(model.sensor, q, min_depth_m)
        sizes = 6 + len(shared), len(aux), len(state.drive)
        n, start = len(rows), sum(sizes)
        by_q = np.linalg.inv(_point_by_image(_image(q, in_image), in_image))
        D = np.eye(len(P))
        D[start:, start:] = 0.0
        own = start + 3 * np.arange(n)[:, None] + np.arange(3)
        D[own[:, :, None], own[:, None, :]] = by_q @ (T_cam_imu @ T)[:3, :3]
        D[start:, :6] = (by_q @ _by_pose(q, T_cam_imu)).reshape(3 * n, 6)
        here = np.concatenate([np.zeros(6), shared, aux, state.drive, _image(q, in_image).ravel()])
        C = D @ P @ D.T
        B, shift = _root(0.5 * (C + C.T)), D @ delta
        zeta = -_solved(B, shift)
        return Prior(T, T_cam_imu, here + shift, B, rows, in_image, sizes), zeta

    def at(self, zeta: Array) -> First:
        """Return the unknowns at zeta (p,)."""
        y, ends = self.mean + self.B @ zeta, np.cumsum(self.sizes).tolist()
        T = se3.exp(y[:6]) @ self.T_reference
        q = _point(y[ends[2] :].reshape(-1, 3), self.in_image)
        positions = se3.apply(se3.inverse(self.T_cam_imu @ T), q)
        return First(T, y[6 : ends[0]], y[ends[0] : ends[1]], y[ends[1] : ends[2]], positions)

    def derivative(self, zeta: Array) -> Array:
        """Return the derivative (p, p) of the errors of (frame, further blocks, drive, landmarks in world) by zeta."""
        y, start = self.mean + self.B @ zeta, sum(self.sizes)
        A = self.B.copy()
        A[:6] = se3.left_jacobian(y[:6]) @ A[:6]
        images = y[start:].reshape(-1, 3)
        q, R = _point(images, self.in_image), (self.T_cam_imu @ se3.exp(y[:6]) @ self.T_reference)[:3, :3]
        moved = _point_by_image(images, self.in_image) @ A[start:].reshape(len(q), 3, len(A))
        A[start:] = (R.T @ (moved - _by_pose(q, self.T_cam_imu) @ A[:6])).reshape(len(A) - start, len(A))
        return A


def _by_pose(q: Array, T_cam_imu: Array) -> Array:
    """Return the derivative (n, 3, 6) of points in the camera by the error of the pose."""
    wide = np.concatenate([np.broadcast_to(np.eye(3), (len(q), 3, 3)), -se3.skew(q)], axis=-1)
    return wide @ se3.adjoint(T_cam_imu)


def _image(q: Array, in_image: BoolArray) -> Array:
    z = np.where(in_image, q[:, 2], 1.0)[:, None]
    return np.where(in_image[:, None], np.concatenate([q[:, :2], np.ones_like(z)], axis=1) / z, q)


_point = _image  # (x/z, y/z, 1/z) is its own inverse


def _point_by_image(image: Array, in_image: BoolArray) -> Array:
    """Return the derivative (n, 3, 3) of points by their images."""
    w = np.where(in_image, image[:, 2], 1.0)
    J = np.zeros((len(image), 3, 3))
    J[:, 0, 0] = J[:, 1, 1] = 1.0 / w
    J[:, :, 2] = np.where(
        in_image[:, None], -np.concatenate([image[:, :2], np.ones((len(w), 1))], axis=1) / w[:, None] ** 2, (0, 0, 1)
    )
    return J


def _solved(B: Array, shift: Array) -> Array:
    """Return x with ``B x = shift`` (p,) for B of `_root`; directions known for certain do not shift."""
    if np.triu(B, 1).any() or not B.diagonal().all():
        return np.asarray(np.linalg.lstsq(B, shift, rcond=None)[0], dtype=float)
    return np.asarray(solve_triangular(B, shift, lower=True), dtype=float)


def _root(C: Array) -> Array:
    """Return B with ``B B^T = C`` (p, p), which may be singular."""
    try:
        return np.asarray(np.linalg.cholesky(C), dtype=float)
    except np.linalg.LinAlgError:
        return root(C, len(C))


def first_of(system: LinearSystem, landmarks: IntArray) -> LinearSystem:
    """Return the part of a system over its first two frames and some landmarks (n,), ascending."""
    place = np.full(system.counts["landmarks"], -1)
    place[landmarks] = np.arange(len(landmarks))
    factors = []
    for factor in system.factors:
        early = np.ones(len(factor.r), dtype=bool)
        for term in factor.terms:
            last = 1 if system.views is None or term.group != "views" else system.views.shape[1] // 3 - 1
            early &= place[term.index] >= 0 if term.group == "landmarks" else term.index <= last
        if early.any():
            part = factor.only(early)
            terms = tuple(
                dataclasses.replace(term, index=place[term.index]) if term.group == "landmarks" else term
                for term in part.terms
            )
            factors.append(Factor(part.r, terms, part.observation))
    counts: Mapping[str, int] = {
        **{group: min(count, 2) for group, count in system.counts.items()},
        "landmarks": len(landmarks),
    }
    return dataclasses.replace(system, factors=tuple(factors), counts=counts, ids=system.ids[landmarks])
