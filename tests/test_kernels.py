"""The compiled kernels against the plain ones, and both against what they are to compute."""

import os
import subprocess
import sys

import numpy as np
import pytest

from ekfslam import kernels
from ekfslam.geometry import se3
from ekfslam.kernels import plain, pose

compiled = pytest.importorskip("ekfslam.kernels.compiled", reason="there was no compiler")

N, K, D, WIDTH, SEEN = 9, 5, 3, 23, 8


def spd(rng, *shape):
    A = rng.normal(size=(*shape, shape[-1] + 2))
    return A @ A.swapaxes(-1, -2) + 0.1 * np.eye(shape[-1])


def points(rng):
    return rng.normal(size=(K, 3)) + np.array([0.0, 0.0, 6.0])


def view(rng):
    R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return (points(rng), points(rng), R, rng.normal(size=(6, 7)))


@pytest.fixture
def given():
    rng = np.random.default_rng(5)
    return {
        "K": rng.normal(size=(N, 3, WIDTH)),
        "S": spd(rng, N, 3),
        "row": rng.permutation(N)[:K],
        "H_x": rng.normal(size=(K, D, SEEN)),
        "H_m": rng.normal(size=(K, D, 3)),
        "variance": rng.uniform(0.1, 2.0, size=(K, D)),
        "L": np.linalg.cholesky(spd(rng, K, D)),
        "T": 0.1 * rng.normal(size=(K, D, WIDTH)),
        "residual": rng.normal(size=(K, D)),
        "B": rng.normal(size=(K, D, WIDTH)),
        "G": rng.normal(size=(K, 3, D)),
        "M": rng.normal(size=(K, 3, 3)),
        "C": spd(rng, K, D),
        "columns": rng.permutation(WIDTH)[:4],
        "by": rng.normal(size=(K, 3, 4)),
        "left": np.array([3, 0, 4]),
        "q": points(rng),
        "step": rng.normal(size=(K, 3)) * [0.1, 0.1, 3.0],
        "in_image": np.array([True, False, True, True, True]),
        "factor": 1.2,
        "before": view(rng),
        "after": view(rng),
    }


CALLS = {
    "whiten": ("K", "S", "row", "H_x", "H_m", "variance"),
    "own_variances": ("L", "T", "variance"),
    "given_others": ("L", "T", "variance"),
    "correct": ("K", "S", "row", "B", "G", "left"),
    "change": ("K", "S", "row", "M", "by", "columns"),
    "normalised_squares": ("C", "residual"),
    "squares_given_others": ("C", "residual", "variance"),
    "whitened": ("C", "residual"),
    "moved_by_image": ("q", "step", "in_image", "factor"),
    "change_by_image": ("before", "after", "in_image"),
}


def test_every_kernel_is_compared():
    assert set(CALLS) == set(kernels.__all__) - {"FORM", "plain"}


@pytest.mark.parametrize("name", CALLS)
def test_both_forms_agree(given, name):
    sides = []
    for form in (plain, compiled):
        arguments = copied(given, name)
        found = getattr(form, name)(*arguments)
        sides.append([*(found if isinstance(found, tuple) else (found,)), *arguments])
    for a, b in zip(*sides, strict=True):
        assert (a is None) == (b is None)
        if isinstance(a, np.ndarray):
            np.testing.assert_allclose(b, a, rtol=1e-10, atol=1e-12)


def copied(given, name):
    return [given[key].copy() if isinstance(given[key], np.ndarray) else given[key] for key in CALLS[name]]


def test_views_are_taken_as_they_are_meant(given):
    """Arguments that are not contiguous, as slices of larger arrays are."""
    wide = np.repeat(given["T"], 2, axis=2)[..., ::2]
    found = compiled.own_variances(given["L"], wide, given["variance"])
    np.testing.assert_allclose(found, plain.own_variances(given["L"], given["T"], given["variance"]), atol=1e-12)
    with pytest.raises(ValueError, match="not contiguous"):
        compiled.change(given["K"].swapaxes(1, 2).copy().swapaxes(1, 2), *(given[key] for key in CALLS["change"][1:]))


def test_no_change_of_the_landmark_itself(given):
    sides = []
    for form in (plain, compiled):
        K, S = given["K"].copy(), given["S"].copy()
        form.change(K, S, given["row"], None, given["by"], given["columns"])
        sides.append((K, S))
    for a, b in zip(*sides, strict=True):
        np.testing.assert_allclose(b, a, atol=1e-13)


@pytest.mark.parametrize("form", [plain, compiled])
def test_what_is_singular(given, form):
    """An error where a factor is needed, NaN or "cannot be judged" where it is a finding."""
    C = given["C"].copy()
    C[2] = np.outer([1.0, 2.0, 3.0], [1.0, 2.0, 3.0])
    assert np.flatnonzero(np.isnan(form.whitened(C, given["residual"])).any(axis=1)).tolist() == [2]
    squares, judged = form.squares_given_others(C, given["residual"], given["variance"])
    assert np.flatnonzero(~judged).tolist() == [2]
    assert squares[2] == 0
    C[2] = -np.eye(D)
    with pytest.raises(np.linalg.LinAlgError):
        form.normalised_squares(C, given["residual"])
    with pytest.raises(np.linalg.LinAlgError):
        form.whiten(*(given[key] for key in CALLS["whiten"][:-1]), -100.0 * given["variance"])


@pytest.mark.parametrize("row", [[0, 1, 2, 3, N], [-1, 0, 1, 2, 3]])
def test_places_out_of_range_are_refused(given, row):
    for name in ("whiten", "correct", "change"):
        arguments = [np.array(given[key]) if key != "row" else np.array(row) for key in CALLS[name]]
        with pytest.raises(IndexError):
            getattr(compiled, name)(*arguments)


def test_shapes_that_do_not_agree_are_refused(given):
    for name, keys in CALLS.items():
        for short in range(len(keys)):
            arguments = copied(given, name)
            if keys[short] not in ("left", "K", "S", "factor"):
                arguments[short] = arguments[short][:-1]
                with pytest.raises((ValueError, IndexError, np.linalg.LinAlgError)):
                    getattr(compiled, name)(*arguments)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, 1.4142, 1.4143, 3.1, np.pi, 5.0])
@pytest.mark.parametrize("name", ["so3_exp_and_left_jacobian", "exp", "left_jacobian", "inverse", "adjoint"])
def test_one_pose_is_as_in_a_stack(name, angle):
    rng = np.random.default_rng(7)
    axis = rng.normal(size=3)
    theta = angle * axis / np.linalg.norm(axis)
    xi = np.concatenate([rng.normal(size=3), theta])
    given = {"so3_exp_and_left_jacobian": theta, "exp": xi, "left_jacobian": xi}.get(name, se3.exp(xi[None])[0])
    one, stack = getattr(se3, name)(given), getattr(se3, name)(given[None])
    for a, b in zip(*((found if isinstance(found, tuple) else (found,)) for found in (one, stack)), strict=True):
        np.testing.assert_allclose(a, b[0], atol=2e-15, rtol=2e-15)
    assert name not in ("inverse", "adjoint") or getattr(pose, name)(given.T.copy().T) is not None


def test_series_and_closed_form_meet():
    at = [np.sqrt(2.0) * (1 + side * 1e-12) for side in (-1, 1)]
    below, above = (se3.left_jacobian(np.array([0.1, 0.2, 0.3, angle, 0.0, 0.0])) for angle in at)
    np.testing.assert_allclose(below, above, atol=1e-11)


@pytest.mark.parametrize(("wanted", "form"), [("plain", "plain"), ("", "compiled")])
def test_the_environment_chooses(wanted, form):
    done = subprocess.run(
        [sys.executable, "-c", "import ekfslam.kernels; print(ekfslam.kernels.FORM)"],
        env={**os.environ, "EKFSLAM_KERNELS": wanted},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == form
