"""The kernels in NumPy."""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray

# Smallest share of its variance that an innovation must have besides what all others of the frame say of it.
LEAST_SHARE = 1e-6

# Stands for points whose image is not asked for.
_AHEAD = np.array([0.0, 0.0, 1.0])

# Points q and q_linear (n, 3), R_linear (3, 3) and by_columns (6, c), as in `ekfslam.filters.coordinates.View`.
View = tuple[Array, Array, Array, Array]


def whiten(K: Array, S: Array, row: IntArray, H_x: Array, H_m: Array, variance: Array) -> tuple[Array, Array, Array]:
    """Rows of landmarks over X, whitened by what the landmarks are unsure of given X.

    With ``R = H_m S H_m^T + V = L L^T``: ``B = L^-1 (H_x + H_m K)`` and ``G = S H_m^T L^-T``.

    Args:
        K, S: (n, 3, n_X) and (n, 3, 3), see `ekfslam.filters.conditional`.
        row: (k,) which landmarks.
        H_x: (k, d, seen) by the first columns of X.
        H_m: (k, d, 3) by the landmarks.
        variance: (k, d).

    Returns:
        L (k, d, d), B (k, d, n_X), G (k, 3, d).

    Raises:
        numpy.linalg.LinAlgError: Some R is not positive definite.
    """
    d = variance.shape[1]
    S_H = S[row] @ H_m.swapaxes(1, 2)
    R = H_m @ S_H
    R[:, np.arange(d), np.arange(d)] += variance
    L = np.asarray(np.linalg.cholesky(R), dtype=float)
    L_inverse = np.linalg.inv(L)
    B = (L_inverse @ H_m) @ K[row]
    B[..., : H_x.shape[2]] += L_inverse @ H_x
    return L, B, S_H @ L_inverse.swapaxes(1, 2)


def own_variances(L: Array, T: Array, variance: Array) -> Array:
    """``L (T T^T + I) L^T - V`` (k, d, d) with L (k, d, d), T (k, d, f), variances (k, d)."""
    d = variance.shape[1]
    square = L @ (T @ T.swapaxes(1, 2) + np.eye(d)) @ L.swapaxes(1, 2)
    square[:, np.arange(d), np.arange(d)] -= variance
    return np.asarray(square, dtype=float)


def given_others(L: Array, Z: Array, variance: Array) -> Array:
    """``V^1/2 L^-T (I - Z Z^T) L^-1 V^1/2`` (k, d, d) with L (k, d, d), Z (k, d, f), variances (k, d)."""
    L_inverse, std = np.linalg.inv(L), np.sqrt(variance)
    blocks = L_inverse.swapaxes(1, 2) @ (np.eye(L.shape[1]) - Z @ Z.swapaxes(1, 2)) @ L_inverse
    return np.asarray(blocks * (std[:, :, None] * std[:, None, :]), dtype=float)


def correct(K: Array, S: Array, row: IntArray, B: Array, G: Array, left: IntArray) -> None:
    """``K_i -= G_i B_i`` and ``S_i -= G_i G_i^T`` in place.

    Args:
        K, S: (n, 3, n_X) and (n, 3, 3).
        row: (k,) the landmarks.
        B, G: (k, d, n_X) and (k, 3, d), from `whiten`.
        left: (j,) which of them are corrected.
    """
    row, G = row[left], G[left]
    K[row] -= G @ B[left]
    S[row] = _symmetric(S[row] - G @ G.swapaxes(1, 2))


def change(K: Array, S: Array, row: IntArray, M: Array | None, B: Array, columns: IntArray) -> None:
    """``K_i <- M_i K_i + B_i`` at some columns, ``S_i <- M_i S_i M_i^T``, in place.

    Args:
        K, S: (n, 3, n_X) and (n, 3, 3).
        row: (k,) the landmarks.
        M: (k, 3, 3); None is the identity.
        B: (k, 3, c).
        columns: (c,) distinct.
    """
    if M is not None:
        K[row] = M @ K[row]
        S[row] = _symmetric(M @ S[row] @ M.swapaxes(1, 2))
    K[row[:, None, None], np.arange(3)[:, None], columns] += B


def normalised_squares(S: Array, residual: Array) -> Array:
    """``r_i^T S_i^-1 r_i`` (k,) with S (k, d, d), residual (k, d).

    Raises:
        numpy.linalg.LinAlgError: Some S is not positive definite.
    """
    whitened = np.linalg.solve(np.linalg.cholesky(S), residual[..., None])[..., 0]
    return np.einsum("ni,ni->n", whitened, whitened)


def squares_given_others(C: Array, residual: Array, variance: Array) -> tuple[Array, BoolArray]:
    """``e_i^T C_i^-1 e_i`` (k,) with C (k, d, d), ``e = V^-1/2 r``; 0 where C has an eigenvalue that is but rounding.

    Returns:
        The squares, and (k,) where C has none such.
    """
    share, axes = np.linalg.eigh(C)
    judged = share[:, 0] > LEAST_SHARE
    along = np.einsum("nji,nj->ni", axes, residual / np.sqrt(variance))
    with np.errstate(over="ignore"):
        squares = np.divide(along**2, share, out=np.zeros_like(along), where=judged[:, None]).sum(axis=1)
    return squares, judged


def whitened(S: Array, residual: Array) -> Array:
    """``L_i^-1 r_i`` with ``S_i = L_i L_i^T``: (k, d, d) and (k, d) to (k, d); NaN where S_i is singular.

    Rows of S that are (uL, v, uR) and those that are (u, v, disparity) come out alike: u, v, and what the last row adds
    to u, which is the disparity.
    """
    std = np.sqrt(np.maximum(np.diagonal(S, axis1=1, axis2=2), np.finfo(float).tiny))
    with np.errstate(over="ignore"):
        correlation = S / (std[:, :, None] * std[:, None, :])
    finite = np.isfinite(correlation).all(axis=(1, 2))
    correlation = np.where(finite[:, None, None], correlation, 0.0)
    definite = np.linalg.eigvalsh(correlation)[:, 0] > LEAST_SHARE
    L = np.linalg.cholesky(np.where(definite[:, None, None], correlation, np.eye(S.shape[1])))
    solved = np.linalg.solve(L, (residual / std)[..., None])[..., 0]
    return np.where(definite[:, None], solved, np.nan)


def moved_by_image(q: Array, step: Array, in_image: BoolArray, factor: float) -> tuple[Array, BoolArray]:
    """Points that a correction moves linearly in the image, ``y+ = y + J dq``, and the others by dq itself.

    Args:
        q, step: (n, 3) points in the camera frame, and dq.
        in_image: (n,) which points have an image.
        factor: Points whose disparity changes by a larger one count by themselves, too.

    Returns:
        The points after it, and which of them (n,) moved in the image.
    """
    front = np.where(in_image[:, None], q, _AHEAD)
    y = image(front)
    y_after = y + (image_jacobian(front) @ step[..., None])[..., 0]
    in_image = in_image & (y_after[:, 2] > y[:, 2] / factor) & (y_after[:, 2] < y[:, 2] * factor)
    return np.where(in_image[:, None], image(np.where(in_image[:, None], y_after, _AHEAD)), q + step), in_image


def change_by_image(before: View, after: View, in_image: BoolArray) -> tuple[Array, Array]:
    """``B`` (n, 3, c) and ``M`` (n, 3, 3) of eq. (7') between two views of n points.

    With J the derivative of the image after by the image before, ``d+ = R+^T J R d + R+^T [J, -J q^, -I, q+^] x``.
    """
    (q, q_linear, R, by), (q_after, q_linear_after, R_after, by_after) = before, after
    # The image is its own inverse: its derivative at an image is the inverse of that at the point.
    J = image_jacobian(np.where(in_image[:, None], q, _AHEAD))
    J_inverse_after = image_jacobian(image(np.where(in_image[:, None], q_after, _AHEAD)))
    J = np.where(in_image[:, None, None], J_inverse_after @ J, np.eye(3))
    minus_one = np.broadcast_to(-np.eye(3), J.shape)
    # Rows a of A q^ are a x q.
    by_turn, by_turn_after = np.cross(J, q_linear[:, None]), np.cross(np.eye(3), q_linear_after[:, None])
    by_camera = [J, -by_turn, minus_one, by_turn_after]
    B = np.concatenate(by_camera, axis=-1) @ np.concatenate([by, by_after])
    return R_after.T @ B, R_after.T @ J @ R


def image(q: Array) -> Array:
    """``(x/z, y/z, 1/z)`` of points (..., 3); its own inverse."""
    return np.concatenate([q[..., :2], np.ones_like(q[..., 2:])], axis=-1) / q[..., 2:]


def image_jacobian(q: Array) -> Array:
    """Return the derivative (..., 3, 3) of `image` by the points."""
    y = image(q)
    J = np.zeros((*q.shape, 3))
    J[..., 0, 0] = J[..., 1, 1] = y[..., 2]
    J[..., 2] = -y * y[..., 2:]
    return J


def _symmetric(blocks: Array) -> Array:
    return 0.5 * (blocks + blocks.swapaxes(-1, -2))
