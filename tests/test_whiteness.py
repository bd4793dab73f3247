"""Statistics of series against naive forms and against what is known of simulated ones."""

import numpy as np
import pytest

from ekfslam.evaluation import whiteness


def test_autocovariance_is_the_mean_product_of_known_samples():
    series = np.random.default_rng(0).normal(size=(50, 2))
    series[[3, 17], 0] = np.nan
    found = whiteness.autocovariance(series, 4)
    for lag in range(5):
        products = [series[k, 0] * series[k + lag, 0] for k in range(50 - lag)]
        assert found[lag, 0] == pytest.approx(np.nansum(products) / 48)


@pytest.mark.parametrize("phi", [-0.4, 0.0, 0.7])
def test_long_run_variance_is_that_of_sums(phi):
    rng = np.random.default_rng(1)
    w, series = rng.normal(size=40_000), np.zeros(40_000)
    for k in range(1, len(w)):
        series[k] = phi * series[k - 1] + w[k]
    lags = 60
    found = whiteness.long_run_variance(whiteness.autocovariance(series[:, None], lags))[0]
    true = 1.0 / (1.0 - phi) ** 2
    assert found == pytest.approx(true, abs=3 * whiteness.relative_error(len(w), lags) * true + 0.03 * true)
    assert whiteness.relative_error(len(w), lags) == pytest.approx(np.sqrt(4 * lags / 3 / len(w)))


def test_a_constant_counts_as_many_times_as_there_are_lags():
    found = whiteness.long_run_variance(whiteness.autocovariance(np.full((5000, 1), 0.5), 20))[0]
    assert found == pytest.approx(0.25 * 21, rel=0.01)


def test_products_along_tracks_equal_a_loop():
    rng = np.random.default_rng(2)
    frame, landmark = (index.ravel() for index in np.meshgrid(np.arange(12), np.arange(5), indexing="ij"))
    kept = rng.random(60) < 0.7
    frame, landmark = frame[kept], landmark[kept]
    values = rng.normal(size=(len(frame), 3))
    values[4, 1] = np.nan
    order = rng.permutation(len(frame))
    found, pairs = whiteness.along_tracks(frame[order], landmark[order], values[order], 3)
    for lag in range(4):
        products = [
            values[i] * values[j]
            for i in range(len(frame))
            for j in range(len(frame))
            if landmark[i] == landmark[j] and frame[j] == frame[i] + lag
        ]
        products = [product for product in products if np.isfinite(product).all()]
        assert pairs[lag] == len(products)
        np.testing.assert_allclose(found[lag], np.mean(products, axis=0))


def test_no_tracks_have_no_pairs():
    none = np.empty(0, dtype=int)
    found, pairs = whiteness.along_tracks(none, none, np.empty((0, 3)), 2)
    np.testing.assert_array_equal(pairs, 0)
    np.testing.assert_array_equal(found, np.zeros((3, 3)))


@pytest.mark.parametrize("scale", [0.1, 1.0, 2.0, 4.0])
def test_scale_behind_a_gate_is_found(scale):
    squares = scale * np.random.default_rng(3).chisquare(3, 200_000)
    gate = 16.266  # chi-square, 3 degrees of freedom, 99.9 %
    accepted = squares[squares <= gate]
    assert whiteness.gated_scale(accepted.mean() / 3, 3, 0.999) == pytest.approx(scale, rel=0.03)


def test_without_a_gate_the_mean_is_the_scale():
    assert whiteness.gated_scale(5.0, 3, 1.0) == 5.0
    assert whiteness.gated_scale(3.24, 3, 0.999) > 50  # nearly as if uniform up to the gate


@pytest.mark.slow
def test_error_of_a_ratio_is_its_scatter():
    rng, found, errors = np.random.default_rng(4), [], []
    dof = rng.integers(30, 90, 300)
    for _ in range(400):
        gain = np.ones(300)
        for k in range(1, 300):
            gain[k] = 1.0 + 0.8 * (gain[k - 1] - 1.0) + 0.1 * rng.normal()
        values = gain * rng.chisquare(dof)
        found.append(values.sum() / dof.sum())
        errors.append(whiteness.ratio_error(values, dof, 20))
    assert np.mean(errors) == pytest.approx(np.std(found), rel=0.2)
    white = [whiteness.ratio_error(rng.chisquare(dof).astype(float), dof, 20) for _ in range(50)]
    assert np.min(white) >= 0.95 * np.sqrt(2 / dof.sum())


def test_lags_beyond_the_series_have_no_covariance():
    series = np.array([[1.0], [-2.0], [3.0]])
    np.testing.assert_allclose(whiteness.autocovariance(series, 5)[:, 0], np.array([14.0, -8.0, 3.0, 0, 0, 0]) / 3)
