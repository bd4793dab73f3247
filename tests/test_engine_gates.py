"""Gates and consensus of the compiled filter against those of the reference filter."""

import numpy as np
import pytest

from ekfslam.errors import InnovationError
from ekfslam.filters import consensus, gates
from ekfslam.filters.correction import focal_lengths
from ekfslam.filters.gaussian import Rows

engine = pytest.importorskip("ekfslam.engine._engine", reason="the engine is not built").gates

GATE = gates.threshold(0.999, 3)


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def covariances(rng, n, d):
    A = rng.normal(size=(n, d, d + 2))
    return A @ A.swapaxes(-1, -2)


def rows_of(rng, k, d, residual=None):
    residual = rng.normal(size=(k, d)) if residual is None else residual
    H_x = 300.0 * rng.normal(size=(k, d, 12))
    return Rows(np.arange(k), H_x, rng.normal(size=(k, d, 3)), residual, rng.uniform(0.2, 2.0, (k, d)))


def frame_of(rng, k, wrong=(), d=3):
    """Joint covariance and rows of k landmarks that share an uncertain motion; some of them are wrong."""
    rows = rows_of(rng, k, d)
    J = rows.H_x.reshape(k * d, -1)[:, :6]
    motion = 0.02 * rng.normal(size=6)
    S = J @ (0.02**2 * np.eye(6)) @ J.T + np.diag(rows.variance.ravel())
    residual = (J @ motion).reshape(k, d) + np.sqrt(rows.variance) * rng.normal(size=(k, d))
    residual[list(wrong)] += 30.0
    return S, Rows(rows.slot, rows.H_x, rows.H_m, residual, rows.variance)


@pytest.mark.parametrize("d", [2, 3])
def test_squares_are_those_of_the_reference(rng, d):
    S, residual = covariances(rng, 7, d), rng.normal(size=(7, d))
    expected = gates.normalised_squares(S, residual, 0, np.arange(7))
    np.testing.assert_allclose(engine.normalised_squares(S, residual), expected, rtol=1e-12)


def test_a_block_that_is_not_positive_definite_is_an_error(rng):
    S = covariances(rng, 5, 3)
    S[3] *= -1.0
    with pytest.raises(InnovationError):
        gates.normalised_squares(S, np.ones((5, 3)), 0, np.arange(5))
    with pytest.raises(RuntimeError, match="not positive definite"):
        engine.normalised_squares(S, np.ones((5, 3)))


@pytest.mark.parametrize("d", [2, 3])
def test_squares_given_others_and_their_bound_are_those_of_the_reference(rng, d):
    rows, S = rows_of(rng, 6, d), covariances(rng, 6, d)
    C = np.linalg.inv(S) * np.sqrt(rows.variance)[:, :, None] * np.sqrt(rows.variance)[:, None, :]
    C[4] = 1e-8 * np.eye(d)
    squares, judged = gates.agrees_with_others(rows, C)
    found, found_judged = engine.agrees_with_others(rows.residual, rows.variance, C)
    np.testing.assert_allclose(found, squares, rtol=1e-9)
    np.testing.assert_array_equal(found_judged, judged)
    assert not judged[4] and judged.sum() == 5
    most = gates.most_given_others(rows, S)
    np.testing.assert_allclose(engine.most_given_others(rows.residual, rows.variance, S), most, rtol=1e-12)


def test_whitened_innovations_have_the_covariance_one_and_none_where_it_is_singular(rng):
    S = covariances(rng, 5, 3)
    S[2, 2] = S[2, :, 2] = 0.0
    residual = rng.normal(size=(5, 3))
    found = engine.whitened(S, residual)
    assert np.isnan(found[2]).all()
    kept = np.delete(np.arange(5), 2)
    expected = np.linalg.solve(np.linalg.cholesky(S[kept]), residual[kept, :, None])[..., 0]
    np.testing.assert_allclose(found[kept], expected, rtol=1e-9)


def test_innovations_are_whitened_if_their_correlation_is_nearly_singular_but_not_if_it_is_more_so(rng):
    """Smallest eigenvalues of 3e-6 and 3e-7 are on both sides of the bound; the next one is small, too."""
    S = np.where(np.eye(3, dtype=bool), 1.0, 0.9) + np.zeros((2, 1, 1))
    S[:, 0, 1] = S[:, 1, 0] = 1.0 - np.array([3e-6, 3e-7])
    assert np.isnan(engine.whitened(S, rng.normal(size=(2, 3)))).all(axis=1).tolist() == [False, True]


@pytest.mark.parametrize("k", [1, 2, 3, 4, 9, 10, 40])
def test_samples_are_those_of_the_reference(k):
    """All of them if they are few, and else those of NumPy's generator, seeded by the frame."""
    frame = 11

    def uniform(seed, rows, columns):
        return np.random.default_rng(seed).random((rows, columns))

    expected = consensus.samples_of(k, np.random.default_rng(frame))
    found = engine.samples_of(k, frame, uniform)
    assert [sorted(sample) for sample in found] == [sorted(sample) for sample in expected.tolist()]


@pytest.mark.parametrize(
    ("k", "wrong"), [(2, ()), (3, (1,)), (5, (0, 3)), (12, (2, 5, 6, 11)), (30, tuple(range(0, 30, 3)))]
)
def test_the_landmarks_that_agree_are_those_of_the_reference(rng, k, wrong):
    S, rows = frame_of(rng, k, wrong)
    samples = consensus.samples_of(k, np.random.default_rng(5))
    expected = consensus.agreeing(S, rows, GATE, np.random.default_rng(5))
    found = np.array(engine.agreeing(S, rows.residual, focal_lengths(rows), GATE, samples.tolist()))
    np.testing.assert_array_equal(found, expected)
    if k > 3:
        assert not np.isin(wrong, np.flatnonzero(found)).any() and found.sum() > k // 2


def test_landmarks_that_a_sample_moves_far_are_judged_less_strictly(rng):
    """The term of second order of a rotation is large where the focal length is small."""
    S, rows = frame_of(rng, 12, (2, 7))
    samples, focal = consensus.samples_of(12, np.random.default_rng(5)).tolist(), focal_lengths(rows)
    strict, lenient = (engine.agreeing(S, rows.residual, factor * focal, GATE, samples) for factor in (1.0, 1e-3))
    bent = Rows(rows.slot, 1e-3 * rows.H_x, rows.H_m, rows.residual, rows.variance)
    np.testing.assert_array_equal(lenient, consensus.agreeing(S, bent, GATE, np.random.default_rng(5)))
    assert sum(lenient) > sum(strict)


@pytest.mark.parametrize("inside", ["all", "some", "none"])
@pytest.mark.parametrize("d", [2, 3])
def test_refined_landmarks_are_those_of_the_reference(rng, inside, d):
    S, rows = frame_of(rng, 14, (1, 4, 9), d)
    start = {"all": np.ones(14, dtype=bool), "some": np.arange(14) % 3 > 0, "none": np.zeros(14, dtype=bool)}[inside]
    expected = consensus.refined(S, rows.residual, start, GATE)
    np.testing.assert_array_equal(engine.refined(S, rows.residual, start.tolist(), GATE), expected)
    if inside != "none":
        assert not expected[[1, 4, 9]].any() and expected.sum() > 7
