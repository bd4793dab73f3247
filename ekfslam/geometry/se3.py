"""Rotations and rigid transforms on arrays: exponential, logarithm, adjoint and left Jacobian.

Leading dimensions are free. Tangent vectors of SE(3) are ``xi = [rho; theta]`` (metres, radians). All is accurate to
rounding from angle 0 to pi; the logarithm of a half turn returns one of its two axes. Formulas: Barfoot, *State
Estimation for Robotics*, chapter 7, in the functions ``phi_k = sum_n (-1)^n theta^(2n) / (2n + k)!``, which are smooth
at zero: phi_1 = sin(theta)/theta, phi_2 = (1 - cos(theta))/theta^2, and so on.
"""

from __future__ import annotations

from math import cos, factorial, sin, sqrt
from typing import Any

import numpy as np

from ekfslam.arrays import Array

_SERIES_LIMIT = 2.0  # below this theta^2 the power series is both accurate and cheap
_SERIES_TERMS = 10  # the first one left out is 2^10 / 24! < 1e-20
_SERIES = [np.array([1.0 / factorial(2 * n + k) for k in (4, 5)]) for n in reversed(range(_SERIES_TERMS))]
_SERIES_OF_ONE = [tuple(both.tolist()) for both in _SERIES]
_EYE = np.eye(3)


def phis(theta_squared: Array) -> tuple[Array, ...]:
    """Return ``(phi_0, ..., phi_5)`` at ``theta^2``, by ``phi_k = 1/k! - theta^2 phi_{k+2}`` and series."""
    x = np.asarray(theta_squared, dtype=float)
    if x.shape == (1, 1):
        return _phis_of_one(x.item())
    small = np.minimum(x, _SERIES_LIMIT)
    both = np.zeros((*small.shape, 2))
    for coefficients in _SERIES:
        both = coefficients - small[..., None] * both
    phi_4, phi_5 = both[..., 0], both[..., 1]
    phi_2, phi_3 = 0.5 - small * phi_4, 1.0 / 6.0 - small * phi_5
    series = (1.0 - small * phi_2, 1.0 - small * phi_3, phi_2, phi_3, phi_4, phi_5)
    if (x <= _SERIES_LIMIT).all():
        return series
    large = np.maximum(x, _SERIES_LIMIT)
    theta = np.sqrt(large)
    closed = [np.cos(theta), np.sin(theta) / theta]
    for k in range(4):
        closed.append((1.0 / factorial(k) - closed[k]) / large)
    return tuple(np.where(x <= _SERIES_LIMIT, a, b) for a, b in zip(series, closed, strict=True))


def _phis_of_one(x: float) -> tuple[Any, ...]:
    """Return `phis` of a single vector in plain numbers, which is faster: a filter needs dozens a frame."""
    if x <= _SERIES_LIMIT:
        phi_4 = phi_5 = 0.0
        for c_4, c_5 in _SERIES_OF_ONE:
            phi_4, phi_5 = c_4 - x * phi_4, c_5 - x * phi_5
        phi_2, phi_3 = 0.5 - x * phi_4, 1.0 / 6.0 - x * phi_5
        return 1.0 - x * phi_2, 1.0 - x * phi_3, phi_2, phi_3, phi_4, phi_5
    theta = sqrt(x)
    closed = [cos(theta), sin(theta) / theta]
    for k in range(4):
        closed.append((1.0 / factorial(k) - closed[k]) / x)
    return tuple(closed)


def skew(v: Array) -> Array:
    """Cross-product matrix ``v^`` with ``v^ w = v x w``: (..., 3) to (..., 3, 3)."""
    v = np.asarray(v, dtype=float)
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def _angle_squared(theta: Array) -> Array:
    """Return ``|theta|^2`` of (..., 3) as (..., 1, 1)."""
    return np.sum(theta * theta, axis=-1)[..., None, None]


def so3_exp(theta: Array) -> Array:
    """Rotation matrix of a rotation vector (Rodrigues): (..., 3) rad to (..., 3, 3)."""
    return so3_exp_and_left_jacobian(theta)[0]


def so3_left_jacobian(theta: Array) -> Array:
    """``J_l`` with ``exp((theta + d)^) ~ exp((J_l d)^) exp(theta^)``: (..., 3) to (..., 3, 3)."""
    return so3_exp_and_left_jacobian(theta)[1]


def so3_exp_and_left_jacobian(theta: Array) -> tuple[Array, Array]:
    """Return `so3_exp` and `so3_left_jacobian` at the price of one: (..., 3) to (..., 3, 3) twice."""
    theta = np.asarray(theta, dtype=float)
    _, phi_1, phi_2, phi_3, _, _ = phis(_angle_squared(theta))
    w = skew(theta)
    ww = w @ w
    return _EYE + phi_1 * w + phi_2 * ww, _EYE + phi_2 * w + phi_3 * ww


def so3_left_jacobian_inverse(theta: Array) -> Array:
    """Inverse of `so3_left_jacobian` in closed form, finite for angles below 2 pi: (..., 3) to (..., 3, 3)."""
    theta = np.asarray(theta, dtype=float)
    _, _, phi_2, phi_3, phi_4, _ = phis(_angle_squared(theta))
    w = skew(theta)
    return _EYE - 0.5 * w + (phi_3 - 2.0 * phi_4) / (2.0 * phi_2) * (w @ w)


def so3_log(R: Array) -> Array:
    """Return the rotation vector (rad, angle in [0, pi]) of (..., 3, 3), accurate for every angle."""
    R = np.asarray(R, dtype=float)
    # Row c of `candidates` is 4 q_c q (components w, x, y, z); the row of the largest |q_c| is well conditioned.
    d0, d1, d2 = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    candidates = np.empty((*R.shape[:-2], 4, 4))
    candidates[..., 0, 0] = 1 + d0 + d1 + d2
    candidates[..., 1, 1] = 1 + d0 - d1 - d2
    candidates[..., 2, 2] = 1 - d0 + d1 - d2
    candidates[..., 3, 3] = 1 - d0 - d1 + d2
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        candidates[..., 0, k + 1] = candidates[..., k + 1, 0] = R[..., j, i] - R[..., i, j]
        candidates[..., i + 1, j + 1] = candidates[..., j + 1, i + 1] = R[..., j, i] + R[..., i, j]
    best = np.argmax(np.diagonal(candidates, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(candidates, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    half = np.arctan2(sine, q[..., :1])
    # theta / sin(theta/2) -> 2 at zero, where the quotient itself is 0/0.
    scale = np.where(sine > 0, 2.0 * half / np.where(sine > 0, sine, 1.0), 2.0)
    return scale * q[..., 1:]


def transform(R: Array, t: Array) -> Array:
    """Rigid transform ``[R t; 0 1]`` from rotation (..., 3, 3) and translation (..., 3): (..., 4, 4)."""
    T = np.zeros((*np.broadcast_shapes(np.shape(R)[:-2], np.shape(t)[:-1]), 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1.0
    return T


def nearest_rigid(T: Array) -> Array:
    """Return the transform (4, 4) with its rotation part replaced by the nearest rotation, unless it is one."""
    R = T[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() < 1e-14:
        return T
    U, _, Vt = np.linalg.svd(R)
    return transform(U @ Vt, T[:3, 3])


def inverse(T: Array) -> Array:
    """Inverse of a rigid transform, ``T_a_b`` to ``T_b_a``: (..., 4, 4) to (..., 4, 4)."""
    R_transposed = np.swapaxes(T[..., :3, :3], -1, -2)
    return transform(R_transposed, -(R_transposed @ T[..., :3, 3:])[..., 0])


def apply(T: Array, points: Array) -> Array:
    """``p_a = T_a_b p_b`` for points in rows: T (..., 4, 4) and points (..., 3) broadcast against each other."""
    return (T[..., :3, :3] @ points[..., None])[..., 0] + T[..., :3, 3]


def exp(xi: Array) -> Array:
    """Exponential of a tangent vector ``[rho; theta]``: (..., 6) to (..., 4, 4)."""
    xi = np.asarray(xi, dtype=float)
    R, J = so3_exp_and_left_jacobian(xi[..., 3:])
    return transform(R, (J @ xi[..., :3, None])[..., 0])


def log(T: Array) -> Array:
    """Logarithm ``[rho; theta]`` of a rigid transform: (..., 4, 4) to (..., 6)."""
    theta = so3_log(T[..., :3, :3])
    rho = (so3_left_jacobian_inverse(theta) @ T[..., :3, 3:])[..., 0]
    return np.concatenate([rho, theta], axis=-1)


def _blocks(top_left: Array, top_right: Array) -> Array:
    """Return ``[A B; 0 A]``, the form of every 6x6 matrix of this module."""
    out = np.zeros((*top_left.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = top_left
    out[..., :3, 3:] = top_right
    return out


def adjoint(T: Array) -> Array:
    """``Ad_T`` with ``T exp(xi^) T^-1 = exp((Ad_T xi)^)``: (..., 4, 4) to (..., 6, 6)."""
    R = T[..., :3, :3]
    return _blocks(R, skew(T[..., :3, 3]) @ R)


def _left_jacobian_corner(xi: Array) -> Array:
    """Upper right 3x3 block of the left Jacobian of SE(3) (Barfoot eq. 7.86)."""
    rho, theta = skew(xi[..., :3]), skew(xi[..., 3:])
    _, _, _, phi_3, phi_4, phi_5 = phis(_angle_squared(xi[..., 3:]))
    theta_rho, rho_theta = theta @ rho, rho @ theta
    sandwich = theta_rho @ theta
    return (
        0.5 * rho
        + phi_3 * (theta_rho + rho_theta + sandwich)
        + phi_4 * (theta @ theta_rho + rho_theta @ theta - 3.0 * sandwich)
        + 0.5 * (phi_4 - 3.0 * phi_5) * (sandwich @ theta + theta @ sandwich)
    )


def left_jacobian(xi: Array) -> Array:
    """``J_l`` with ``exp((xi + d)^) ~ exp((J_l d)^) exp(xi^)``: (..., 6) to (..., 6, 6)."""
    xi = np.asarray(xi, dtype=float)
    return _blocks(so3_left_jacobian(xi[..., 3:]), _left_jacobian_corner(xi))


def left_jacobian_inverse(xi: Array) -> Array:
    """Inverse of `left_jacobian` in closed form, finite for angles below 2 pi: (..., 6) to (..., 6, 6)."""
    xi = np.asarray(xi, dtype=float)
    J_inverse = so3_left_jacobian_inverse(xi[..., 3:])
    return _blocks(J_inverse, -J_inverse @ _left_jacobian_corner(xi) @ J_inverse)
