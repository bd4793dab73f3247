"""Functions of `ekfslam.geometry.se3` for one pose, in C: a filter asks for dozens of them a frame.

``EXISTS`` says whether they are there; where they are not, se3 uses its formulas for stacks.
"""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array
from ekfslam.kernels.chosen import FORM

EXISTS = FORM == "compiled"
if EXISTS:
    from ekfslam.kernels import _compiled


def is_one(array: Array, *shape: int) -> bool:
    """Whether an array is one vector or matrix that C can take."""
    return EXISTS and array.shape == shape and array.dtype == np.float64


def so3_exp_and_left_jacobian(theta: Array) -> tuple[Array, Array]:
    R, J = np.empty((3, 3)), np.empty((3, 3))
    _compiled.so3_exp_and_left_jacobian(np.ascontiguousarray(theta), R, J)
    return R, J


def exp(xi: Array) -> Array:
    T = np.empty((4, 4))
    _compiled.exp(np.ascontiguousarray(xi), T)
    return T


def inverse(T: Array) -> Array:
    out = np.empty((4, 4))
    _compiled.inverse(np.ascontiguousarray(T), out)
    return out


def adjoint(T: Array) -> Array:
    out = np.empty((6, 6))
    _compiled.adjoint(np.ascontiguousarray(T), out)
    return out


def left_jacobian(xi: Array) -> Array:
    out = np.empty((6, 6))
    _compiled.left_jacobian(np.ascontiguousarray(xi), out)
    return out
