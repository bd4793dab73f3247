"""Whitened innovations against their naive form, with the joint innovation covariance written out."""

import numpy as np
import pytest

from ekfslam.config import Config
from ekfslam.data.simulate import builtin
from ekfslam.filters.gates import diagonal
from ekfslam.filters.gaussian import Gaussian, Rows
from ekfslam.filters.innovations import innovations_of, whitened
from ekfslam.runner import run

LANDMARKS, SEEN, BODY, D = 7, 12, 15, 3


@pytest.fixture(params=range(3))
def prior(request):
    """A Gaussian over body and landmarks, and rows of some of its landmarks."""
    rng = np.random.default_rng(request.param)
    size = BODY + 3 * LANDMARKS
    A = rng.normal(size=(size, size))
    gaussian = Gaussian(np.zeros((BODY, BODY)), SEEN)
    gaussian.replace(A @ A.T)
    slot = rng.permutation(LANDMARKS)[:6]
    rows = Rows(
        slot,
        rng.normal(size=(6, D, SEEN)),
        rng.normal(size=(6, D, 3)),
        rng.normal(size=(6, D)),
        rng.uniform(0.5, 2.0, size=(6, D)),
    )
    return gaussian, rows


def dense(gaussian, rows):
    """H (kd, n), S (kd, kd), r (kd,)."""
    k = len(rows.slot)
    H = np.zeros((k, D, len(gaussian.P)))
    H[..., :SEEN] = rows.H_x
    for i, slot in enumerate(rows.slot):
        H[i, :, BODY + 3 * slot : BODY + 3 * slot + 3] = rows.H_m[i]
    H = H.reshape(k * D, -1)
    return H, H @ gaussian.P @ H.T + np.diag(rows.variance.ravel()), rows.residual.ravel()


def test_equals_the_joint_innovation_covariance_written_out(prior):
    gaussian, rows = prior
    kept = np.arange(len(rows.slot)) >= 2
    accepted = rows.only(kept)
    H, S, r = dense(gaussian, accepted)
    J, inverse = H[:, :6], np.linalg.inv(S)

    projection = gaussian.project(rows, 0, rows.slot)
    S_own = projection.variances[kept] + diagonal(accepted.variance)
    solution = gaussian.solve(projection.only(np.flatnonzero(kept)), 0, rows.slot[kept])
    done = solution.done
    left = accepted.corrected(done.correction[:SEEN], done.correction[BODY:].reshape(-1, 3))
    found = innovations_of(solution, accepted.slot, accepted, S_own, left.residual)

    np.testing.assert_allclose(found.score, J.T @ inverse @ r, atol=1e-9)
    np.testing.assert_allclose(found.information, J.T @ inverse @ J, atol=1e-9)
    xi = np.linalg.solve(J.T @ inverse @ J, J.T @ inverse @ r)
    rest, covariance = r - J @ xi, S - J @ np.linalg.inv(J.T @ inverse @ J) @ J.T
    for i in range(kept.sum()):
        own = slice(D * i, D * i + D)
        np.testing.assert_allclose(found.alone[i], np.linalg.solve(np.linalg.cholesky(S[own, own]), r[own]))
        apart = np.linalg.solve(np.linalg.cholesky(covariance[own, own]), rest[own])
        np.testing.assert_allclose(found.apart[i], apart, atol=1e-8)


def test_where_nothing_is_left_there_is_no_number():
    S, residual = np.zeros((2, 3, 3)), np.ones((2, 3))
    S[1] = np.eye(3)
    np.testing.assert_array_equal(whitened(S, residual), [[np.nan] * 3, [1.0] * 3])


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["invariant", "fej"])
def test_a_run_keeps_them(variant):
    world = builtin("city?frames=80&outlier_fraction=0.03")
    result = run(world, "full", Config().with_overrides({"filter": {"variant": variant}}))
    found, innovation = result.whitened, result.innovation
    assert (np.bincount(found.frame, minlength=80) * 3 == innovation.dof).all()
    updated = innovation.dof > 30
    # The shared part is a part of the whole, and independent of the rest.
    rest = innovation.nis[updated] - found.shared_nis[updated]
    assert (rest > 0).all()
    if variant == "invariant":
        assert 0.85 < rest.sum() / (innovation.dof[updated] - 6).sum() < 1.1
        assert 0.6 < np.nanmean(found.shared**2) < 1.4
    # Each landmark's observations but the first, which initialised it.
    first = np.unique(result.log.landmark, return_index=True)[1]
    others = np.setdiff1d(np.arange(result.log.observations), first)
    np.testing.assert_array_equal(np.sort(result.log.landmark[others]), np.sort(found.landmark))
    np.testing.assert_array_equal(np.sort(result.log.frame[others]), found.frame)
