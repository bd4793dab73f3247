"""Draws from the posterior lie about its mean, and scatter as it says."""

from __future__ import annotations

import numpy as np
import pytest
from support.running import WHOLE

from ekfslam import Config, FilterConfig, PosteriorConfig, open_sequence, posterior, run
from ekfslam.geometry import se3

SIZE = 4000 if WHOLE else 1000


@pytest.fixture(
    scope="module", params=[("map", "invariant"), ("filtered", "standard"), ("filtered", "fej")], ids="-".join
)
def found(request):
    """A posterior; as filtered, its mean is not where it was linearised."""
    linearisation, variant = request.param
    sequence = open_sequence("builtin:loop?frames=40&landmarks=60&seed=2")
    result = run(sequence, "full", Config(filter=FilterConfig(variant, initial_position_std_m=0.1)))
    return posterior(result, PosteriorConfig(linearisation=linearisation))


def errors(found):
    """Stored errors of draws against the mean: of poses (size, T, 6), of landmarks (size, M, 3)."""
    poses, landmarks = found.sample(np.random.default_rng(1), SIZE)
    return se3.log(se3.inverse(poses) @ found.T_world_imu), landmarks - found.position_m


@pytest.mark.slow
def test_the_mean_of_samples_is_the_mean_of_the_posterior(found):
    xi, d = errors(found)
    for error, covariance in ((xi, found.pose_covariance), (d, found.landmark_covariance)):
        std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        known = std > 1e-9  # all but the rotation of the first pose, which is certain
        assert known.mean() > 0.9
        deviations = np.sqrt(SIZE) * error.mean(axis=0)[known] / std[known]
        # Hundreds of numbers that go together: none of them far out, and the lot of them as small as chance has it.
        assert np.abs(deviations).max() < 5
        assert np.sqrt(np.mean(deviations**2)) < 2
        np.testing.assert_allclose(error.mean(axis=0)[~known], 0.0, atol=1e-9)


def test_samples_scatter_by_the_joint_covariance_of_poses_and_landmarks(found):
    xi, d = errors(found)
    frames, landmarks = [1, 20, 39], [0, 7, 15, 20]
    together = np.concatenate([xi[:, frames].reshape(SIZE, -1), d[:, landmarks].reshape(SIZE, -1)], axis=1)
    expected = found.joint_covariance(frames, landmarks)
    std = np.sqrt(np.diag(expected))
    off = (together.T @ together / SIZE - expected) / np.outer(std, std)
    assert np.abs(off).max() < 5 * np.sqrt(2 / SIZE)  # standard errors, of correlations near 1
    # Poses and landmarks do go together, so that the sign of either matters.
    assert np.abs(expected / np.outer(std, std))[:18, 18:].max() > 0.5
