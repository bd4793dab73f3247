"""Poses of another body: the constant pose between the body of a truth and that of an estimate."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import ekfslam
from ekfslam.data.opening import with_truth_frame
from ekfslam.errors import ConfigError
from ekfslam.evaluation.brief import verdict_lines
from ekfslam.evaluation.honesty import judge
from ekfslam.evaluation.other_body import other_body
from ekfslam.geometry import se3
from ekfslam.others import Others

BASE = se3.exp(np.array([0.11, 0.0, 0.0, 0.0, 0.0, np.radians(2.0)]))
TURNED = se3.transform(np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]), np.array([0.3, 0.1, -0.2]))


def drive(noise: float = 0.0, late_s: float = 0.0, scale: float = 1.0, seed: int = 0):
    """Stamps, and poses with and without errors, of a body that turns about all axes."""
    rng, t = np.random.default_rng(seed), 0.05 * np.arange(400)

    def poses(at):
        w = np.stack([0.3 * np.sin(0.7 * at), 0.2 * np.sin(1.1 * at), 0.6 * np.sin(0.5 * at)], axis=1)
        v = np.stack([1.0 + 0.5 * np.sin(0.9 * at), 0.2 * np.sin(1.3 * at), 0.3 * np.cos(0.8 * at)], axis=1)
        T = [np.eye(4)]
        for twist in np.hstack([v, w])[1:]:
            T.append(T[-1] @ se3.exp(0.05 * twist))
        return np.array(T)

    T_true = poses(t)
    T_est = T_true if late_s == 0.0 else poses(t + late_s)
    T_est = T_est @ se3.exp(noise * rng.standard_normal((len(t), 6)))
    T_est[:, :3, 3] *= scale
    return t, T_est, T_true


@pytest.mark.parametrize("X", [BASE, TURNED, se3.exp(np.array([0.0, 0.1, 0.05, 0.0, 0.0, 0.0]))])
@pytest.mark.parametrize("seed", range(2))
def test_the_pose_of_another_body_is_found_within_its_error(X, seed):
    t, T_est, T_true = drive(noise=0.002, seed=seed)
    found = other_body(t, T_est, T_true @ X)
    off = se3.log(se3.inverse(X) @ found.T)
    assert np.linalg.norm(off[:3]) < 4 * found.std_m + 1e-3 and np.linalg.norm(off[3:]) < 4 * found.std_rad + 1e-3


@pytest.mark.parametrize("errors", [{}, {"late_s": 0.05}, {"scale": 1.05}, {"noise": 0.02}])
def test_late_stamps_and_a_wrong_scale_are_no_other_body(errors):
    assert other_body(*drive(**{"noise": 0.002, **errors})) is None


@cache
def simulated():
    sequence = ekfslam.open_sequence("builtin:room?frames=150")
    return sequence, ekfslam.run(sequence)


def test_the_verdict_names_another_body_and_the_flag_that_states_it():
    sequence, result = simulated()
    base = replace(sequence.truth, T_world_imu=sequence.truth.T_world_imu @ BASE, motion=None)
    found = judge(result, truth=base)
    assert "by the truth" in found.headline and "of another body" in found.headline
    verdict, step = verdict_lines(replace(sequence, truth=base), result)
    assert "of another body" in verdict and "0.11 +- " in step
    numbers = [float(word) for word in step.split("--truth-frame ")[1].split()[:7]]
    stated = with_truth_frame(replace(sequence, truth=base), numbers)
    assert judge(result, truth=stated.truth).truth.nees < 0.1 * found.truth.nees
    assert not [defect for defect in judge(result, truth=sequence.truth).findings if defect.kind == "body"]


def test_a_run_that_began_at_the_pose_of_the_other_body_is_judged_likewise():
    sequence, _ = simulated()
    base = replace(sequence, truth=replace(sequence.truth, T_world_imu=sequence.truth.T_world_imu @ BASE, motion=None))
    verdict, step = verdict_lines(base, ekfslam.run(base))
    assert "of another body" in verdict and "--truth-frame 0.1" in step


def test_a_trajectory_of_another_body_is_named_without_covariances():
    sequence, result = simulated()
    theirs = ekfslam.Trajectory(sequence.time_s, result.T_world_imu @ BASE)
    found = Others({"wheels": theirs}).results(sequence)["wheels"].remarks
    assert any("poses of another body, 0.11 +- " in line for line in found)
    same = Others({"ours": replace(theirs, T_world=result.T_world_imu)}).results(sequence)["ours"].remarks
    assert not any("another body" in line for line in same)


def test_a_truth_of_the_camera_is_named():
    sequence, result = simulated()
    T = sequence.truth.T_world_imu @ se3.inverse(sequence.T_cam_imu)
    of_camera = replace(sequence, truth=replace(sequence.truth, T_world_imu=T, motion=None))
    assert "--truth-frame camera states" in verdict_lines(of_camera, result)[1]


def test_a_truth_of_the_camera_becomes_that_of_the_body():
    sequence, _ = simulated()
    T = sequence.truth.T_world_imu
    of_camera = replace(sequence, truth=replace(sequence.truth, T_world_imu=T @ se3.inverse(sequence.T_cam_imu)))
    np.testing.assert_allclose(with_truth_frame(of_camera, "camera").truth.T_world_imu, T, atol=1e-9)
    assert with_truth_frame(sequence, "body") is sequence


@pytest.mark.parametrize("frame", ["base", [1.0, 2.0], [0, 0, 0, 0, 0, 0, 0.0], [np.nan, 0, 0]])
def test_a_frame_that_is_none_is_named(frame):
    with pytest.raises(ConfigError, match="x y z qx qy qz qw"):
        with_truth_frame(simulated()[0], frame)
