"""Consistency of relative poses: cross-covariances of reported poses, and what is made of them."""

import dataclasses

import h5py
import numpy as np
import pytest
from support.helpers import STEP_S, erring_truth, synthetic_result, synthetic_sequence

from ekfslam import open_sequence
from ekfslam.config import Config, PosteriorConfig
from ekfslam.data.sequence import Truth
from ekfslam.data.truth_noise import TruthNoise
from ekfslam.errors import ArchiveError
from ekfslam.evaluation.consistency import chi2_bounds
from ekfslam.evaluation.relative import (
    dead_reckoned_pairs,
    over_frames,
    over_path,
    relative_covariance,
    relative_pairs,
    relative_pose_nees,
)
from ekfslam.evaluation.summary import summarise
from ekfslam.filters.result import PosePairs
from ekfslam.geometry import motion
from ekfslam.runner import run
from ekfslam.smoother.posterior import posterior, smooth
from ekfslam.storage.archive import open_result, write_archive

# Where cross-covariances come from


def test_the_filters_cross_covariance_is_that_of_the_posterior_at_the_later_frame():
    """The error reported at k is uncorrelated with all data up to k, so smoothing j by these changes nothing."""
    world = open_sequence("builtin:loop?frames=41")
    # Frozen rows are the filter in xyz only, where iterations are refused.
    settings = {"variant": "standard", "retire": "never", "relative_frames": 40, "landmark_coordinates": "xyz"}
    settings |= {"initial_position_std_m": 0.1, "initial_rotation_std_rad": 0.02}
    result = run(world, "full", Config().with_overrides({"filter": settings}))
    found = posterior(result, PosteriorConfig(linearisation="filtered"))
    last = np.flatnonzero(result.pairs.second == 40)
    assert 30 in result.pairs.first[last] and len(last) >= 1
    for i in last:
        j = result.pairs.first[i]
        P = found.joint_covariance([j, 40])
        std = np.sqrt(np.diag(P))
        assert (np.abs(result.pairs.cross[i] - P[:6, 6:]) <= 1e-7 * np.outer(std[:6], std[6:])).all()
        assert np.abs(P[:6, 6:] / np.outer(std[:6], std[6:])).max() > 0.1


@pytest.mark.slow
def test_the_invariant_filters_motions_do_not_depend_on_where_the_world_is():
    """The world's place is gauge: however uncertain, it must cancel, through every correction in between."""
    found = []
    for position_m, rotation_rad in ((0.01, 0.001), (1.0, 0.3)):
        settings = {"initial_position_std_m": position_m, "initial_rotation_std_rad": rotation_rad}
        config = Config().with_overrides({"filter": {**settings, "gate_probability": 1.0, "relative_frames": 40}})
        result = run(open_sequence("builtin:loop?frames=90"), "full", config)
        found.append(relative_covariance(result, result.pairs)[1])
        assert np.diagonal(result.covariance[-1])[5] > 0.9 * rotation_rad**2
    std = np.sqrt(np.diagonal(found[0], axis1=1, axis2=2))
    assert len(std) == 8
    assert (np.abs(found[1] - found[0]) <= 1e-6 * std[:, :, None] * std[:, None, :]).all()


@pytest.mark.slow
def test_estimates_do_not_depend_on_references():
    world = open_sequence("builtin:city?frames=120")
    with_, without = (
        run(world, "full", Config().with_overrides({"filter": {"relative_frames": frames}})) for frames in (40, 0)
    )
    assert with_.pairs is not None and len(with_.pairs) > 8 and without.pairs is None
    np.testing.assert_allclose(with_.T_world_imu, without.T_world_imu, rtol=1e-13, atol=1e-12)
    np.testing.assert_allclose(with_.covariance, without.covariance, rtol=0, atol=1e-12)
    # Landmarks at a distance are known to metres: what rounding does to them is small beside that.
    std = np.sqrt(np.diagonal(without.landmarks.covariance, axis1=1, axis2=2))
    assert (np.abs(with_.landmarks.position_m - without.landmarks.position_m) <= 1e-9 * std).all()
    assert with_.counts == without.counts
    assert run(dataclasses.replace(world, truth=None), "full").pairs is None


@pytest.mark.slow
def test_pairs_across_a_map_revival_are_left_out():
    world = open_sequence("builtin:loop?frames=330")
    settings = {"retire": "unseen", "retire_after": 3, "variant": "standard", "relative_frames": 100}
    result = run(world, "full", Config().with_overrides({"filter": settings}))
    assert result.counts["revived"] > 0
    first, second = relative_pairs(world.truth, 100)
    assert 0 < len(result.pairs) < len(first)
    assert set(zip(result.pairs.first, result.pairs.second, strict=True)) < set(zip(first, second, strict=True))
    _, values = relative_pose_nees(result, world.truth, world.interpolated)
    assert np.isfinite(values).all()


def test_dead_reckoning_has_the_cross_covariances_of_its_recursion():
    sequence = synthetic_sequence(frames=60, landmarks=40)
    result = synthetic_result(sequence, "dead-reckoning")
    first, second = np.array([10, 10, 30]), np.array([20, 60 - 1, 31])
    found = dead_reckoned_pairs(first, second, result.T_world_imu, result.covariance)
    for i, (j, k) in enumerate(zip(first, second, strict=True)):
        cross = result.covariance[j]
        for step in range(j + 1, k + 1):
            cross = cross @ motion.error_jacobian(motion.increment(sequence.twist[step], STEP_S)).T
        np.testing.assert_allclose(found.cross[i], cross, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("mode", ["dead-reckoning", "mapping-only", "full", "smoothed"])
def test_every_mode_has_pairs_whose_joint_covariance_is_one(mode):
    world = open_sequence("builtin:loop?frames=60")
    result = run(world, mode, Config().with_overrides({"filter": {"relative_frames": 40}}))
    pairs, values = relative_pose_nees(result, world.truth, world.interpolated)
    assert len(pairs) >= 5
    assert np.isfinite(values).all()
    for j, k, cross in zip(pairs.first, pairs.second, pairs.cross, strict=True):
        joint = np.block([[result.covariance[j], cross], [cross.T, result.covariance[k]]])
        scale = np.sqrt(np.maximum(np.diag(joint), 1e-30))
        assert np.linalg.eigvalsh(joint / np.outer(scale, scale))[0] > -1e-9


@pytest.mark.slow
def test_smoothed_pairs_are_those_of_the_posterior():
    config = Config().with_overrides({"filter": {"relative_frames": 40}})
    result = run(open_sequence("builtin:loop?frames=60"), "full", config)
    found = posterior(result)
    smoothed = smooth(result, found=found)
    for j, k, cross in zip(smoothed.pairs.first, smoothed.pairs.second, smoothed.pairs.cross, strict=True):
        np.testing.assert_allclose(cross, found.joint_covariance([j, k])[:6, 6:], rtol=1e-9, atol=1e-15)


# Which pairs, and their NEES


def straight_truth(frames, step_m):
    T = np.tile(np.eye(4), (len(frames), 1, 1))
    T[:, 0, 3] = step_m * np.asarray(frames)
    return Truth(np.asarray(frames), T)


def test_pairs_are_so_many_frames_or_metres_apart_and_both_have_truth():
    truth = straight_truth(np.arange(201), 0.8)
    first, second = relative_pairs(truth, 100)
    assert set(first) == {0, 25, 50, 75, 100, 125, 150, 175}
    apart = second - first
    # 50 m are 62 or 63 frames, 100 m more than the 100 frames that references live.
    assert set(apart) == {10, 50, 62, 100}
    pairs = PosePairs(first, second, np.zeros((len(first), 6, 6)))
    assert over_frames(pairs, 100).sum() == 5
    np.testing.assert_array_equal(np.flatnonzero(over_path(pairs, truth, 50.0)), np.flatnonzero(apart == 62))
    assert not over_path(pairs, truth, 100.0).any()
    gap = straight_truth(np.delete(np.arange(201), [35, 50]), 0.8)
    first_gap, second_gap = relative_pairs(gap, 100)
    assert not np.isin([35, 50], [first_gap, second_gap]).any()
    assert len(relative_pairs(truth, 0)[0]) == 0
    assert len(relative_pairs(straight_truth(np.arange(0), 1.0), 100)[0]) == 0
    standing = relative_pairs(straight_truth(np.arange(201), 0.0), 100)
    assert set(standing[1] - standing[0]) == {10, 50, 100}


@pytest.mark.slow
def test_relative_nees_is_six_whatever_the_first_pose_and_with_the_noise_of_the_truth():
    noise = TruthNoise(0.1, 0.1, 0.3, 1.0, 0.005, 0.02, 0.002)
    exact, erring, blind = [], [], []
    for seed in range(60):
        sequence = synthetic_sequence(frames=41, landmarks=30, seed=seed)
        result = synthetic_result(sequence, "dead-reckoning")
        pairs = dead_reckoned_pairs(np.array([20]), np.array([40]), result.T_world_imu, result.covariance)
        result = dataclasses.replace(result, pairs=pairs)
        exact.append(relative_pose_nees(result, sequence.truth, sequence.interpolated)[1][0])
        truth = erring_truth(sequence.truth, sequence.time_s, noise, np.random.default_rng(seed))
        erring.append(relative_pose_nees(result, truth, sequence.interpolated)[1][0])
        blind.append(relative_pose_nees(result, dataclasses.replace(truth, noise=None), sequence.interpolated)[1][0])
    low, high = chi2_bounds(6, 0.999, runs=60)
    assert low < np.mean(exact) < high
    assert low < np.mean(erring) < high
    assert np.mean(blind) > 1.2 * np.mean(erring)


def test_a_covariance_that_is_too_small_shows():
    sequence = synthetic_sequence(frames=60, landmarks=30)
    result = synthetic_result(sequence, "dead-reckoning")
    pairs = dead_reckoned_pairs(*relative_pairs(sequence.truth, 40), result.T_world_imu, result.covariance)
    honest = dataclasses.replace(result, pairs=pairs)
    small = dataclasses.replace(
        honest, covariance=result.covariance / 9, pairs=dataclasses.replace(pairs, cross=pairs.cross / 9)
    )
    before, after = (summarise(sequence, one)["pose_nees_relative_10_mean"] for one in (honest, small))
    assert after == pytest.approx(9 * before, rel=1e-9)


# Archives


@pytest.mark.slow
def test_pairs_are_stored_and_archives_without_them_are_read(tmp_path):
    world = open_sequence("builtin:loop?frames=40")
    result = run(world, "full", Config().with_overrides({"filter": {"relative_frames": 20}}))
    write_archive(tmp_path / "a.h5", world, {"full": result})
    found = open_result(tmp_path / "a.h5", "full")
    for name in ("first", "second", "cross"):
        np.testing.assert_array_equal(getattr(found.pairs, name), getattr(result.pairs, name))
    assert summarise(world, found) == summarise(world, result)
    with h5py.File(tmp_path / "a.h5", "a") as h5file:
        h5file["runs/full/pairs/second"][0] = 400
    with pytest.raises(ArchiveError, match=r"runs/full/pairs/second\[0\] = 400"):
        open_result(tmp_path / "a.h5", "full")
    with h5py.File(tmp_path / "a.h5", "a") as h5file:
        del h5file["runs/full/pairs"]
    assert open_result(tmp_path / "a.h5", "full").pairs is None
    assert summarise(world, open_result(tmp_path / "a.h5", "full"))["pose_nees_relative_10_mean"] is None
