"""Covariance of a trajectory of another program: true for better and worse ones, in any world and frame."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import ekfslam
from ekfslam.cli import main
from ekfslam.data.observations import Observations
from ekfslam.data.simulate import builtin
from ekfslam.data.trajectory import Trajectory
from ekfslam.errors import PosteriorError, TruthError
from ekfslam.geometry import se3
from ekfslam.smoother.given import compared
from ekfslam.storage.exports import export

FRAMES = 60


@pytest.fixture(scope="module")
def worlds():
    return [builtin(f"city?seed={seed}&frames={FRAMES}") for seed in range(5)]


def nees(covered):
    """Return the mean pose NEES from the fifth frame on."""
    result, truth = covered.result, covered.sequence.truth
    xi = se3.log(se3.inverse(truth.T_world_imu) @ result.T_world_imu)[5:]
    return np.mean([e @ np.linalg.solve(P, e) for e, P in zip(xi, result.covariance[5:], strict=True)])


def of_a_third(world, rng):
    """Return the smoothed poses from a third of the landmarks."""
    o = world.observations
    kept = np.isin(o.landmark, rng.permutation(o.ids)[: len(o.ids) // 3])
    third = Observations(o.frame[kept], o.landmark[kept], o.pixels_px[kept])
    return ekfslam.run(dataclasses.replace(world, observations=third), "smoothed").T_world_imu


def walked(world, rng):
    """Return the true poses with errors that walk, as those of an odometry."""
    true, found = world.truth.T_world_imu, [np.eye(4)]
    for step in se3.inverse(true[:-1]) @ true[1:]:
        found.append(found[-1] @ step @ se3.exp(rng.normal(0.0, 1.0, 6) * ([0.01] * 3 + [4e-4] * 3)))
    return np.array(found)


@pytest.mark.slow
@pytest.mark.parametrize("estimate", [of_a_third, walked])
def test_the_covariance_is_true_for_estimates_that_are_worse(worlds, estimate):
    found, naive = [], []
    for seed, world in enumerate(worlds):
        rng = np.random.default_rng(seed)
        # A world of its own, which nothing depends on.
        T = se3.exp(np.concatenate([rng.normal(0, 5, 3), rng.normal(0, 1, 3)])) @ estimate(world, rng)
        covered = ekfslam.trajectory_covariance(world, Trajectory(world.time_s, T))
        np.testing.assert_array_equal(covered.trajectory.T_world, T)
        found.append(nees(covered))
        scale = [covered.result.attributes[f"given_scale_{part}"] for part in ("position", "rotation")]
        assert min(scale) > 1.2
        naive.append(found[-1] * min(scale) ** 2)
    assert 4.0 < np.mean(found) < 9.0 and max(found) < 15.0
    assert np.mean(naive) > 15.0  # the marginals of the best estimate alone


@dataclasses.dataclass
class Best:
    """The part of a posterior that a given trajectory is compared with."""

    T_world_imu: np.ndarray
    pose_covariance: np.ndarray


def test_poses_and_factors_of_a_given_trajectory_are_those_of_the_definition():
    rng, key = np.random.default_rng(3), np.array([0, 2, 3, 6])
    ours = [se3.exp(rng.normal(size=6))]
    for _ in range(7):
        ours.append(ours[-1] @ se3.exp(rng.normal(size=6) * 0.3))
    root = rng.normal(size=(8, 6, 6)) * 0.1
    root[0] = 0.0
    best = Best(np.array(ours), root @ root.swapaxes(1, 2))
    error = [se3.exp(rng.normal(size=6) * 0.05 * (k > 0)) for k in key]
    elsewhere = se3.exp(np.array([3.0, -1.0, 2.0, 0.5, 2.0, -1.0]))
    given = compared(best, key, np.array([elsewhere @ ours[k] @ e for k, e in zip(key, error, strict=True)]))
    before = [0, 0, 1, 2, 2, 2, 3, 3]  # the given pose that a frame goes on from
    expected = [ours[key[i]] @ error[i] @ se3.inverse(ours[key[i]]) @ T for i, T in zip(before, ours, strict=True)]
    np.testing.assert_allclose(given.T_world_imu, expected, atol=1e-12)
    L = [np.linalg.cholesky(P) for P in best.pose_covariance[1:]]
    y = [np.linalg.solve(L[k - 1], se3.log(e)) for k, e in zip(key[1:], error[1:], strict=True)]
    M = sum(np.outer(one, one) for one in y) / len(y)
    np.testing.assert_array_equal(given.G[0], np.eye(6))
    for k in range(1, 8):
        P = given.G[k] @ best.pose_covariance[k] @ given.G[k].T
        np.testing.assert_allclose(P, L[k - 1] @ (np.eye(6) + M) @ L[k - 1].T, rtol=1e-9, atol=1e-12)
    theirs, own = (sum(np.linalg.norm(np.diff([T[k][:3, 3] for k in key], axis=0), axis=1)) for T in (expected, ours))
    assert given.length == pytest.approx(theirs / own)


@pytest.mark.parametrize("frame", [[0, 1], [1, 2, 3]])
def test_too_few_poses_or_none_of_the_first_frame_are_named(frame):
    best = Best(np.array([np.eye(4)] * 4), np.array([np.eye(6)] * 4))
    with pytest.raises(PosteriorError, match=f"from the first frame on, found {len(frame)}"):
        compared(best, np.array(frame), np.array([np.eye(4)] * len(frame)))


def test_the_best_estimate_keeps_its_covariance_in_any_frame(worlds):
    smoothed = ekfslam.run(worlds[0], "smoothed")
    body = Trajectory(smoothed.time_s, smoothed.T_world_imu)
    covered = ekfslam.trajectory_covariance(worlds[0], body.of_camera(worlds[0].T_cam_imu))
    np.testing.assert_allclose(covered.result.covariance, smoothed.covariance, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(covered.trajectory.T_world, smoothed.T_world_imu, atol=1e-9)


def test_keyframes_get_covariances_and_frames_between_them_follow(worlds):
    smoothed = ekfslam.run(worlds[1], "smoothed")
    keys = np.arange(6, 55, 7)
    covered = ekfslam.trajectory_covariance(worlds[1], Trajectory(smoothed.time_s[keys], smoothed.T_world_imu[keys]))
    assert len(covered.trajectory.time_s) == len(keys) and len(covered.sequence) == 43
    assert covered.result.attributes["given_poses"] == len(keys)
    assert (
        not covered.trajectory.covariance[0].any() and np.linalg.eigvalsh(covered.trajectory.covariance[1:]).min() > 0
    )


def test_a_wrong_scale_or_clock_is_named(worlds):
    smoothed = ekfslam.run(worlds[0], "smoothed")
    doubled = smoothed.T_world_imu.copy()
    doubled[:, :3, 3] *= 2.0
    covered = ekfslam.trajectory_covariance(worlds[0], Trajectory(smoothed.time_s, doubled))
    assert any("2 times as long" in line for line in covered.result.remarks)
    with pytest.raises(TruthError, match="0 of 60 poses belong to frames: its stamps are 1000"):
        ekfslam.trajectory_covariance(worlds[0], Trajectory(smoothed.time_s + 1000.0, smoothed.T_world_imu))


def test_the_command_writes_poses_covariances_and_an_archive(worlds, tmp_path, capsys):
    export(ekfslam.run(worlds[0], "full"), tmp_path / "theirs.txt", "tum", frame="camera")
    (tmp_path / "theirs.cov.txt").unlink()
    arguments = ["--trajectory", str(tmp_path / "theirs.txt"), "--frame", "camera", "--out", str(tmp_path / "t.h5")]
    data = f"builtin:city?seed=0&frames={FRAMES}"
    assert main(["covariance", data, *arguments]) == 0 and main(["covariance", data, *arguments]) == 0
    assert f"{FRAMES} poses of {FRAMES} frames" in capsys.readouterr().out
    theirs, written = (ekfslam.read_trajectory(tmp_path / name, frame="camera") for name in ("theirs.txt", "t.txt"))
    np.testing.assert_allclose(written.T_world, theirs.T_world, atol=1e-9)
    assert written.covariance.shape == (FRAMES, 6, 6)
    assert list(ekfslam.read_archive(tmp_path / "t.h5").results) == ["given"]
