"""Group axioms and calculus of SE(3), property based, with angles through 0 and up to pi."""

import functools

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from support.jacobians import hat

from ekfslam.geometry import se3

ANGLES = st.one_of(
    st.floats(0, np.pi - 1e-3),
    st.floats(0, 1e-3),
    st.sampled_from([0.0, 1e-300, 1e-16, 1e-9, 1e-6, np.sqrt(2.0), np.pi - 1e-6, np.pi - 1e-9]),
)
COORDINATES = st.floats(-50, 50)
UNIT = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-2)
EYE = np.eye(4)


@st.composite
def tangents(draw):
    axis = np.array(draw(UNIT))
    theta = draw(ANGLES) * axis / np.linalg.norm(axis)
    return np.concatenate([[draw(COORDINATES) for _ in range(3)], theta])


def numeric_left_jacobian(xi, step=1e-6):
    """Columns ``log(exp(xi + h) exp(xi - h)^-1) / 2h``, exact to second order."""
    columns = []
    for h in np.eye(6) * step:
        columns.append(se3.log(se3.exp(xi + h) @ se3.inverse(se3.exp(xi - h))) / (2 * step))
    return np.array(columns).T


@given(tangents())
def test_exp_is_the_matrix_exponential(xi):
    np.testing.assert_allclose(se3.exp(xi), scipy.linalg.expm(hat(xi)), atol=1e-12 * (1 + np.abs(xi).max()))


@given(tangents())
def test_log_inverts_exp(xi):
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=2e-13 * (1 + np.abs(xi).max()))


@given(tangents())
def test_exp_inverts_log_of_any_rotation(xi):
    T = se3.exp(xi) @ se3.exp(np.array([1.0, 2, 3, 0.4, -2.9, 0.3]))
    np.testing.assert_allclose(se3.exp(se3.log(T)), T, atol=1e-12 * (1 + np.abs(xi).max()))


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, -1, 0], [1, 2, -3], [-1, -1, -1]])
def test_log_of_a_half_turn_is_a_half_turn(axis):
    axis = np.array(axis) / np.linalg.norm(axis)
    R = 2 * np.outer(axis, axis) - np.eye(3)
    theta = se3.so3_log(R)
    np.testing.assert_allclose(np.linalg.norm(theta), np.pi, rtol=1e-15)
    np.testing.assert_allclose(se3.so3_exp(theta), R, atol=1e-15)


@given(tangents(), tangents(), tangents())
def test_group_axioms(a, b, c):
    A, B, C = se3.exp(a), se3.exp(b), se3.exp(c)
    scale = 1 + np.abs([a, b, c]).max()
    np.testing.assert_allclose((A @ B) @ C, A @ (B @ C), atol=1e-13 * scale)
    np.testing.assert_allclose(A @ se3.inverse(A), EYE, atol=1e-13 * scale)
    np.testing.assert_allclose(se3.inverse(A @ B), se3.inverse(B) @ se3.inverse(A), atol=1e-13 * scale)
    np.testing.assert_allclose(se3.exp(-a), se3.inverse(A), atol=1e-13 * scale)


@pytest.mark.slow
@given(tangents(), tangents())
def test_adjoint_is_conjugation_and_a_homomorphism(a, b):
    A, B = se3.exp(a), se3.exp(b)
    scale = (1 + np.abs([a, b]).max()) ** 2
    np.testing.assert_allclose(A @ hat(b) @ se3.inverse(A), hat(se3.adjoint(A) @ b), atol=1e-12 * scale)
    np.testing.assert_allclose(se3.adjoint(A @ B), se3.adjoint(A) @ se3.adjoint(B), atol=1e-12 * scale)


@settings(max_examples=60)
@given(tangents())
def test_left_jacobian_against_central_differences(xi):
    scale = 1 + np.abs(xi).max()
    np.testing.assert_allclose(se3.left_jacobian(xi), numeric_left_jacobian(xi), atol=3e-8 * scale)


@given(tangents())
def test_left_jacobian_inverse_and_its_adjoint_identity(xi):
    J = se3.left_jacobian(xi)
    scale = 1 + np.abs(xi).max()
    np.testing.assert_allclose(J @ se3.left_jacobian_inverse(xi), np.eye(6), atol=1e-11 * scale)
    # J_l(xi) = Ad_exp(xi) J_l(-xi): ties Jacobian, adjoint and exponential together.
    np.testing.assert_allclose(J, se3.adjoint(se3.exp(xi)) @ se3.left_jacobian(-xi), atol=1e-11 * scale)


@pytest.mark.parametrize("k", range(6))
def test_phi_is_smooth_across_the_switch_from_series_to_closed_form(k):
    below, above = np.nextafter(2.0, 0), np.nextafter(2.0, 3)
    np.testing.assert_allclose(se3.phis(np.array(below))[k], se3.phis(np.array(above))[k], rtol=1e-14)


@pytest.mark.parametrize("theta", [1e-8, 1e-4, 0.1, 1.0, 1.5, 3.0])
def test_phi_against_the_definition(theta):
    x = np.longdouble(theta)
    power_series = [
        sum((-1) ** n * x ** (2 * n) / np.longdouble(scipy.special.factorial(2 * n + k, exact=True)) for n in range(20))
        for k in range(6)
    ]
    found = se3.phis(np.array(theta**2))
    np.testing.assert_allclose(found, np.array(power_series, dtype=float), rtol=3e-15, atol=3e-16)


def test_everything_works_on_stacks():
    # One pose by itself goes another way, which sums in another order.
    same = functools.partial(np.testing.assert_allclose, rtol=2e-15, atol=2e-15)
    xi = np.random.default_rng(1).normal(size=(4, 5, 6))
    for function in (se3.exp, se3.left_jacobian, se3.left_jacobian_inverse):
        stacked = function(xi)
        same(stacked[2, 3], function(xi[2, 3]))
    T = se3.exp(xi)
    for function in (se3.log, se3.inverse, se3.adjoint):
        same(function(T)[1, 4], function(T[1, 4]))
    points = np.random.default_rng(2).normal(size=(4, 5, 3))
    np.testing.assert_allclose(se3.apply(T, points)[3, 1], T[3, 1, :3, :3] @ points[3, 1] + T[3, 1, :3, 3], atol=1e-14)


def test_one_vector_has_the_coefficients_of_a_stack():
    for x in (0.0, 1e-20, 0.3, 2.0, np.nextafter(2.0, 3.0), 9.0):
        one, stack = se3.phis(np.array([[x]])), se3.phis(np.full((2, 1, 1), x))
        for a, b in zip(one, stack, strict=True):
            np.testing.assert_allclose(a, b[0, 0, 0], rtol=1e-15)
