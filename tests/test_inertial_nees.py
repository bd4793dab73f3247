"""Errors and NEES of an inertial unit, with yaw and position free."""

import dataclasses
import functools

import numpy as np

import ekfslam
from ekfslam.data.room import Room, simulate_room
from ekfslam.evaluation.inertial import aligned_at_first, free_pose_errors, gauge_covariance, inertial_nees
from ekfslam.evaluation.metrics import METRICS
from ekfslam.evaluation.summary import compare_table, summarise_all
from ekfslam.evaluation.trajectory import absolute_trajectory_error, align_yaw
from ekfslam.geometry import se3

GAUGE = [0, 1, 2, 5]


@functools.cache
def room():
    return simulate_room(Room(frames=60, seed=6))


@functools.cache
def full():
    return ekfslam.run(room(), "full")


def moved_truth(shift, yaw):
    """The truth of the room in another world, turned about the vertical and shifted."""
    truth, motion = room().truth, room().truth.motion
    W = se3.transform(se3.so3_exp(np.array([0.0, 0.0, yaw])), np.array(shift))
    motion = dataclasses.replace(motion, velocity_m_s=motion.velocity_m_s @ W[:3, :3].T)
    return dataclasses.replace(truth, T_world_imu=W @ truth.T_world_imu, motion=motion)


def test_an_alignment_in_yaw_and_position_finds_the_turn_about_the_vertical():
    rng = np.random.default_rng(0)
    p = rng.normal(size=(20, 3))
    W = se3.transform(se3.so3_exp(np.array([0.0, 0.0, 2.5])), rng.normal(size=3))
    np.testing.assert_allclose(align_yaw(p, se3.apply(W, p)), W, atol=1e-12)


def test_an_alignment_in_yaw_and_position_has_the_least_squares():
    rng = np.random.default_rng(1)
    p, q = rng.normal(size=(2, 20, 3))
    best = align_yaw(p, q)

    def squares(step):
        turn = se3.so3_exp(np.array([0.0, 0.0, step[3]]))
        return (((p @ best[:3, :3].T) @ turn.T + best[:3, 3] + step[:3] - q) ** 2).sum()

    least = squares(np.zeros(4))
    assert all(squares(step) > least for step in 0.01 * np.vstack([np.eye(4), -np.eye(4)]))


def test_a_tilt_remains_in_an_error_aligned_in_yaw_and_position():
    T = room().truth.T_world_imu
    tilted = se3.exp(np.array([0, 0, 0, 0.05, 0, 0])) @ T
    assert absolute_trajectory_error(tilted, T, align=True) < 1e-9
    assert absolute_trajectory_error(tilted, T, align=True, by=align_yaw) > 1e-3


def test_another_yaw_and_position_of_the_true_world_change_no_nees():
    here, there = (inertial_nees(full(), truth) for truth in (room().truth, moved_truth([5.0, -2.0, 1.0], 2.0)))
    for part, values in here.items():
        np.testing.assert_allclose(values[1:], there[part][1:], rtol=1e-6, err_msg=part)


def test_a_tilt_of_the_true_world_changes_the_nees():
    truth = room().truth
    tilted = dataclasses.replace(truth, T_world_imu=se3.exp(np.array([0, 0, 0, 0.02, 0, 0])) @ truth.T_world_imu)
    assert np.nanmean(inertial_nees(full(), tilted)["pose"]) > 10 * np.nanmean(inertial_nees(full(), truth)["pose"])


def test_the_alignment_keeps_the_velocity_in_the_frame_of_the_imu():
    aligned = aligned_at_first(moved_truth([1.0, 2.0, 3.0], -1.0), room().truth.T_world_imu)
    np.testing.assert_allclose(aligned.T_world_imu, room().truth.T_world_imu, atol=1e-9)
    np.testing.assert_allclose(aligned.motion.velocity_m_s, room().truth.motion.velocity_m_s, atol=1e-9)


def test_uncertainty_of_position_and_yaw_of_the_first_pose_is_taken_off():
    """A world moved by delta gives each pose the error -Ad(T) delta; the rest keeps position and yaw of the first."""
    rng, truth = np.random.default_rng(2), room().truth
    T = se3.inverse(full().T_world_imu)
    A = rng.normal(size=(4, 4))
    J = -se3.adjoint(T)[:, :, GAUGE]
    rest = np.zeros((len(T), 6, 6))
    R = T[0, :3, :3]
    rest[0, 3:, 3:] = R @ np.diag([0.1, 0.2, 0.0]) @ R.T
    rest[1:] = np.eye(6)
    result = dataclasses.replace(full(), covariance=J @ A @ A.T @ J.swapaxes(1, 2) + rest)
    np.testing.assert_allclose(gauge_covariance(result, truth), J @ A @ A.T @ J.swapaxes(1, 2), atol=1e-9)
    np.testing.assert_allclose(free_pose_errors(result, truth)[1], rest, atol=1e-9)


def test_a_pose_that_moves_with_its_world_has_no_free_error():
    truth = room().truth
    W = se3.exp(np.array([0.3, -0.1, 0.2, 0.0, 0.0, 0.4]))
    result = dataclasses.replace(full(), T_world_imu=W @ truth.T_world_imu)
    np.testing.assert_allclose(free_pose_errors(result, truth)[0], 0.0, atol=1e-9)


def test_each_nees_is_that_of_its_own_errors():
    truth, states = room().truth, full().inertial
    found = inertial_nees(full(), truth)
    e = truth.motion.accel_bias_m_s2 - states.accel_bias_m_s2
    expected = [one @ np.linalg.solve(P, one) for one, P in zip(e, states.covariance[:, 12:, 12:], strict=True)]
    np.testing.assert_allclose(found["accel_bias"], expected, rtol=1e-9)
    u = np.einsum("tji,tj->ti", truth.T_world_imu[:, :3, :3], truth.motion.velocity_m_s) - states.velocity_m_s
    expected = [one @ np.linalg.solve(P, one) for one, P in zip(u, states.covariance[:, 6:9, 6:9], strict=True)]
    np.testing.assert_allclose(found["velocity"], expected, rtol=1e-9)


def test_without_true_motion_there_is_the_nees_of_the_pose_alone():
    truth = dataclasses.replace(room().truth, motion=None)
    assert list(inertial_nees(full(), truth)) == ["pose"]


def test_metrics_of_an_inertial_unit_state_expected_value_and_definition():
    summary = summarise_all(room(), 1, {"full": full()})
    values = summary["modes"]["full"]
    for key, dof in (("pose_nees_free", 6), ("velocity_nees", 3), ("accel_bias_nees", 3), ("inertial_nees", 15)):
        metric = METRICS[f"{key}_mean"]
        assert f"({dof})" in metric.heading and metric.definition.endswith(".")
        assert 0.1 * dof < values[f"{key}_mean"] < 3 * dof
        assert f"{metric.heading}: {metric.definition}" in compare_table(summary)


def test_runs_without_an_inertial_unit_have_no_such_rows():
    values = summarise_all(room(), 1, {"full": dataclasses.replace(full(), inertial=None)})["modes"]["full"]
    assert values["velocity_nees_mean"] is None and values["ate_aligned_4dof_m"] is None


def test_a_truth_that_begins_later_aligns_at_its_own_first_pose():
    first, found = 20, []
    for seed in range(6, 10):
        world = simulate_room(Room(frames=60, seed=seed))
        truth = world.truth
        motion = dataclasses.replace(truth.motion, **{k: value[first:] for k, value in vars(truth.motion).items()})
        part = dataclasses.replace(
            truth, frame=truth.frame[first:], T_world_imu=truth.T_world_imu[first:], motion=motion
        )
        found.append(np.nanmean(inertial_nees(ekfslam.run(world, "full"), part)["pose"]))
    assert 0.1 < np.mean(found) < 12.0
