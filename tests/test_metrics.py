"""Trajectory and map errors, NEES and its bounds, and the summary made of them."""

from __future__ import annotations

import dataclasses
import json
import re
from itertools import pairwise

import numpy as np
import pytest
from scipy.stats import chi2
from support.helpers import FULL_SCALE, INERTIAL_KEYS, SUMMARY_KEYS, synthetic_result, synthetic_sequence

from ekfslam.data.sequence import Truth
from ekfslam.evaluation.consistency import (
    chi2_bounds,
    nees,
    pose_error,
    pose_nees,
)
from ekfslam.evaluation.summary import compare_table, error_in_words, summarise, summarise_all
from ekfslam.evaluation.trajectory import (
    PARTS,
    absolute_trajectory_error,
    align_se3,
    error_parts,
    final_position_error,
    kitti_segment_errors,
    landmark_rmse,
    relative_pose_error_over_frames,
    relative_pose_error_over_path,
)
from ekfslam.filters.result import Landmarks
from ekfslam.filters.variants import VARIANTS
from ekfslam.geometry import se3
from ekfslam.stored import empty


def random_poses(rng: np.random.Generator, n: int) -> np.ndarray:
    return se3.exp(rng.normal(0, [5, 5, 5, 0.8, 0.8, 0.8], (n, 6)))


def straight_drive(n: int, step_m: float = 1.0) -> np.ndarray:
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, 0, 3] = step_m * np.arange(n)
    return T


def landmarks_at(ids: list[int], positions: np.ndarray, covariance: np.ndarray | None = None) -> Landmarks:
    n = len(ids)
    covariance = np.tile(np.eye(3), (n, 1, 1)) if covariance is None else covariance
    ones = np.ones(n, dtype=np.int64)
    return Landmarks(np.array(ids), positions, covariance, positions, ones, ones, ones)


def test_alignment_recovers_the_transform_and_reduces_the_error_to_nothing():
    rng = np.random.default_rng(0)
    T_true = random_poses(rng, 20)
    shift = random_poses(rng, 1)[0]
    T_est = se3.inverse(shift) @ T_true
    np.testing.assert_allclose(align_se3(T_est[:, :3, 3], T_true[:, :3, 3]), shift, atol=1e-12)
    assert absolute_trajectory_error(T_est, T_true, align=True) < 1e-12
    expected = np.sqrt(np.mean(np.sum((T_est[:, :3, 3] - T_true[:, :3, 3]) ** 2, axis=1)))
    assert absolute_trajectory_error(T_est, T_true, align=False) == pytest.approx(expected, rel=1e-14)


def test_alignment_returns_a_rotation_where_a_mirror_image_would_fit_better():
    points = np.random.default_rng(1).normal(size=(30, 3)) * [5, 3, 1]
    T = align_se3(points, points * [1, 1, -1])
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(T[:3, :3], np.eye(3), atol=0.2)


def test_aligned_error_does_not_absorb_scale():
    T_true = random_poses(np.random.default_rng(2), 50)
    T_est = T_true.copy()
    T_est[:, :3, 3] *= 1.1
    spread = T_true[:, :3, 3] - T_true[:, :3, 3].mean(axis=0)
    expected = 0.1 * np.sqrt(np.mean(np.sum(spread**2, axis=1)))
    assert absolute_trajectory_error(T_est, T_true, align=True) == pytest.approx(expected, rel=1e-12)


def test_final_position_error_is_a_distance():
    T_true = straight_drive(5)
    T_est = T_true.copy()
    T_est[-1, :3, 3] += [3.0, 4.0, 12.0]
    assert final_position_error(T_est, T_true) == pytest.approx(13.0)


def winding_drive(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Truth and an estimate of it that drifts; the vehicle stands still during a tenth of the steps."""
    motion = np.column_stack([rng.uniform(0.3, 1.5, n - 1), np.zeros((n - 1, 4)), 0.05 * np.sin(np.arange(n - 1) / 9)])
    motion[n // 3 : n // 3 + n // 10] = 0.0
    steps = se3.exp(motion)
    noisy = steps @ se3.exp(rng.normal(0, 0.01, (n - 1, 6)))
    T_true, T_est = [np.eye(4)], [np.eye(4)]
    for true_step, step in zip(steps, noisy, strict=True):
        T_true.append(T_true[-1] @ true_step)
        T_est.append(T_est[-1] @ step)
    return np.stack(T_true), np.stack(T_est)


def rms_of_relative_errors(T_true: np.ndarray, T_est: np.ndarray, pairs: list[tuple[int, int]]) -> tuple[float, float]:
    """Sturm et al. as they write it; metres and degrees."""
    lengths, angles = [], []
    for i, j in pairs:
        delta_true, delta_est = (np.linalg.inv(T[i]) @ T[j] for T in (T_true, T_est))
        error = np.linalg.inv(delta_true) @ delta_est
        lengths.append(np.linalg.norm(error[:3, 3]))
        angles.append(np.arccos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1)))
    return np.sqrt(np.mean(np.square(lengths))), np.degrees(np.sqrt(np.mean(np.square(angles))))


@pytest.mark.parametrize("frames", [1, 7])
def test_relative_error_over_frames_agrees_with_a_plain_loop(frames):
    T_true, T_est = winding_drive(np.random.default_rng(20), 120)
    expected = rms_of_relative_errors(T_true, T_est, [(i, i + frames) for i in range(120 - frames)])
    assert relative_pose_error_over_frames(T_est, T_true, frames) == pytest.approx(expected, rel=1e-9)


def test_relative_error_over_a_path_agrees_with_a_plain_loop():
    T_true, T_est = winding_drive(np.random.default_rng(21), 300)
    distance = [0.0]
    for a, b in pairwise(T_true):
        distance.append(distance[-1] + np.linalg.norm(b[:3, 3] - a[:3, 3]))
    pairs = []
    for i in range(300):
        later = [(abs(distance[j] - distance[i] - 5.0), j) for j in range(i + 1, 300)]
        if later and min(later)[0] <= 0.5:
            pairs.append((i, min(later)[1]))
    assert 200 < len(pairs) < 295, "some poses have no partner"
    expected = rms_of_relative_errors(T_true, T_est, pairs)
    assert relative_pose_error_over_path(T_est, T_true, 5.0) == pytest.approx(expected, rel=1e-9)


def test_relative_errors_of_a_scale_and_a_heading_error_do_not_depend_on_an_alignment():
    shift = random_poses(np.random.default_rng(22), 1)[0]
    T_true = straight_drive(60, 2.0)
    stretched = shift @ straight_drive(60, 2.04)
    assert relative_pose_error_over_frames(stretched, T_true) == pytest.approx((0.04, 0.0), abs=1e-6)
    assert relative_pose_error_over_path(stretched, T_true, 10.0) == pytest.approx((0.2, 0.0), abs=1e-6)
    turning = T_true.copy()
    turning[:, :3, :3] = se3.so3_exp(np.radians(0.1) * np.arange(60)[:, None] * [0, 0, 1])
    assert relative_pose_error_over_frames(shift @ turning, T_true)[1] == pytest.approx(0.1)
    assert relative_pose_error_over_path(shift @ turning, T_true, 10.0)[1] == pytest.approx(0.5)


def test_relative_errors_do_not_exist_without_a_pair():
    one = straight_drive(1)
    assert relative_pose_error_over_frames(one, one) is None
    assert relative_pose_error_over_path(one, one, 10.0) is None
    short, coarse = straight_drive(9), straight_drive(20, 7.0)
    assert relative_pose_error_over_frames(short, short, 8) == (0.0, 0.0)
    assert relative_pose_error_over_frames(short, short, 9) is None
    assert relative_pose_error_over_path(short, short, 10.0) is None
    assert relative_pose_error_over_path(coarse, coarse, 10.0) is None, "7 m and 14 m are no 10 m"


def test_kitti_errors_of_a_scale_error_are_its_percentage():
    # 0.5 m steps make segment lengths exact; the devkit ends a segment one pose after the nominal length.
    T_true = straight_drive(401, 0.5)
    T_est = T_true.copy()
    T_est[:, :3, 3] *= 1.02
    t_rel, r_rel = kitti_segment_errors(T_est, T_true)
    assert t_rel == pytest.approx(2.0 * 100.5 / 100, rel=1e-12)  # only the 100 m segments fit into 200 m
    assert r_rel == pytest.approx(0.0, abs=1e-9)


def test_kitti_errors_agree_with_a_plain_loop_after_the_devkit():
    rng = np.random.default_rng(3)
    steps = se3.exp(np.column_stack([np.full(600, 0.9), np.zeros((600, 4)), 0.01 * np.sin(np.arange(600) / 30)]))
    noisy = steps @ se3.exp(rng.normal(0, 0.002, (600, 6)))
    T_true, T_est = [np.eye(4)], [np.eye(4)]
    for true_step, step in zip(steps, noisy, strict=True):
        T_true.append(T_true[-1] @ true_step)
        T_est.append(T_est[-1] @ step)
    T_true, T_est = np.stack(T_true), np.stack(T_est)

    distance = [0.0]
    for a, b in pairwise(T_true):
        distance.append(distance[-1] + np.linalg.norm(b[:3, 3] - a[:3, 3]))
    errors = []
    for first in range(0, len(T_true), 10):
        for length in range(100, 801, 100):
            last = next((i for i in range(first, len(T_true)) if distance[i] > distance[first] + length), None)
            if last is None:
                continue
            delta_true = np.linalg.inv(T_true[first]) @ T_true[last]
            delta_est = np.linalg.inv(T_est[first]) @ T_est[last]
            error = np.linalg.inv(delta_est) @ delta_true
            angle = np.arccos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1))
            errors.append((np.linalg.norm(error[:3, 3]) / length, angle / length))
    mean = np.mean(errors, axis=0)
    t_rel, r_rel = kitti_segment_errors(T_est, T_true)
    assert t_rel == pytest.approx(100 * mean[0], rel=1e-9)
    assert r_rel == pytest.approx(100 * np.degrees(mean[1]), rel=1e-6)


def test_kitti_errors_do_not_exist_on_a_path_of_at_most_100_m():
    assert kitti_segment_errors(straight_drive(101), straight_drive(101)) is None
    assert kitti_segment_errors(straight_drive(102), straight_drive(102)) == (0.0, 0.0)


def test_landmark_rmse_matches_by_id_counts_repeats_and_ignores_the_unknown():
    truth = Truth(np.arange(0), np.empty((0, 4, 4)), np.array([9, 2, 5]), np.array([[9.0, 0, 0], [2, 0, 0], [5, 0, 0]]))
    estimate = landmarks_at([5, 7, 2, 5], np.array([[5.0, 1, 0], [0, 0, 0], [2, 0, 2], [5, 0, -3]]))
    assert landmark_rmse(estimate, truth) == pytest.approx(np.sqrt((1 + 4 + 9) / 3))
    assert landmark_rmse(landmarks_at([7], np.zeros((1, 3))), truth) is None
    assert landmark_rmse(empty(Landmarks), truth) is None


def test_pose_error_is_the_stored_one_and_a_linear_map_of_the_right_invariant_one():
    rng = np.random.default_rng(4)
    T_imu_world_est = random_poses(rng, 30)
    xi = rng.normal(0, 0.4, (30, 6))
    T_world_imu_true = se3.inverse(se3.exp(xi) @ T_imu_world_est)
    T_world_imu_est = se3.inverse(T_imu_world_est)
    np.testing.assert_allclose(pose_error(T_world_imu_est, T_world_imu_true), xi, atol=1e-12)
    right_invariant = se3.log(T_world_imu_true @ se3.inverse(T_world_imu_est))
    mapped = -(se3.adjoint(T_imu_world_est) @ right_invariant[..., None])[..., 0]
    np.testing.assert_allclose(mapped, xi, atol=1e-12)


def test_nees_equals_the_textbook_form_and_is_nan_where_the_covariance_is_singular():
    rng = np.random.default_rng(5)
    A = rng.normal(size=(4, 6, 6)) * [1, 1, 1, 1e-6, 1e-6, 1e-6]
    P = np.swapaxes(A, 1, 2) @ A
    e = rng.normal(size=(4, 6)) * [1, 1, 1, 1e-6, 1e-6, 1e-6]
    P[2] = 0.0
    P[3, 0] = P[3, :, 0] = 0.0
    values = nees(e, P)
    expected = [e[i] @ np.linalg.inv(P[i]) @ e[i] for i in range(2)]
    np.testing.assert_allclose(values[:2], expected, rtol=1e-6)
    assert np.isnan(values[2:]).all()


def test_nees_of_a_rank_deficient_covariance_is_nan_and_does_not_raise():
    v = np.random.default_rng(6).normal(size=(100, 3, 2))
    assert np.isnan(nees(np.ones((100, 3)), v @ np.swapaxes(v, 1, 2))).all()


def test_pose_nees_of_honest_dead_reckoning_is_six_on_average():
    values = []
    for seed in range(40):
        sequence = synthetic_sequence(frames=60, landmarks=40, seed=seed)
        frames, value = pose_nees(synthetic_result(sequence, "dead-reckoning"), sequence.truth)
        assert np.isnan(value[0]), "the first pose is known exactly"
        assert frames[0] == 0
        values.append(value[-1])
    low, high = chi2_bounds(6, 0.999, runs=40)
    assert low < np.mean(values) < high


def test_pose_nees_uses_the_frames_that_truth_has():
    sequence = synthetic_sequence(frames=50)
    result = synthetic_result(sequence)
    some = np.array([3, 10, 49])
    frames, values = pose_nees(result, Truth(some, sequence.truth.T_world_imu[some]))
    np.testing.assert_array_equal(frames, some)
    np.testing.assert_allclose(values, pose_nees(result, sequence.truth)[1][some], rtol=1e-12)


def test_invariant_landmark_error_inverts_the_retraction_of_equation_7():
    rng = np.random.default_rng(7)
    T_est = random_poses(rng, 1)[0]
    m_hat, d = rng.normal(0, 20, (8, 3)), rng.normal(0, 1, (8, 3))
    e_theta = np.array([0.3, -0.2, 0.5])
    T_true = T_est.copy()
    T_true[:3, :3] = se3.so3_exp(e_theta) @ T_est[:3, :3]
    e = d + np.cross(m_hat, e_theta)
    m_true = m_hat @ se3.so3_exp(e_theta).T + e @ se3.so3_left_jacobian(e_theta).T
    np.testing.assert_allclose(VARIANTS["invariant"].landmark_error(m_hat, m_true, T_est, T_true), d, atol=1e-12)


def test_invariant_landmark_error_is_the_plain_difference_to_first_order():
    rng = np.random.default_rng(8)
    m_hat, d = rng.normal(0, 20, (5, 3)), 1e-5 * rng.normal(size=(5, 3))
    T_est = random_poses(rng, 5)
    T_true = se3.exp(1e-5 * rng.normal(size=(5, 6))) @ T_est
    np.testing.assert_allclose(VARIANTS["invariant"].landmark_error(m_hat, m_hat + d, T_est, T_true), d, atol=1e-8)


@pytest.mark.parametrize("runs", [1, 50])
def test_chi2_bounds_hold_the_stated_probability_with_equal_tails(runs):
    low, high = chi2_bounds([3, 6, 600], 0.95, runs)
    dof = np.array([3, 6, 600]) * runs
    np.testing.assert_allclose(chi2.cdf(low * runs, dof), 0.025, rtol=1e-9)
    np.testing.assert_allclose(chi2.sf(high * runs, dof), 0.025, rtol=1e-9)


def test_summary_has_exactly_its_keys_in_plain_numbers():
    sequence = synthetic_sequence()
    result = synthetic_result(sequence)
    summary = summarise(sequence, result)
    assert set(summary) == SUMMARY_KEYS
    # The road has no 100 m within the 100 frames that a pair may be apart.
    assert {key for key, value in summary.items() if value is None} == INERTIAL_KEYS | {
        "pose_nees_relative_100_m_mean",
        "pose_nees_apart_mean",
    }
    assert all(type(value) in (int, float) for value in summary.values() if value is not None)
    assert json.loads(json.dumps(summary)) == summary
    assert summary["nis_per_dof"] == pytest.approx(1.0, abs=0.05)
    assert summary["landmark_rmse_m"] == landmark_rmse(result.landmarks, sequence.truth)
    assert summary["total_s"] == pytest.approx(result.ms_per_frame.sum() / 1000)


def test_summary_compares_modes_by_their_errors():
    sequence = synthetic_sequence()
    dead, full = (summarise(sequence, synthetic_result(sequence, mode)) for mode in ("dead-reckoning", "full"))
    assert full["ate_m"] == pytest.approx(FULL_SCALE * dead["ate_m"], rel=0.1)
    assert full["final_error_m"] == pytest.approx(FULL_SCALE * dead["final_error_m"], rel=0.1)
    assert full["pose_nees_mean"] == pytest.approx(dead["pose_nees_mean"], rel=1e-3)
    assert dead["nis_per_dof"] is None
    assert dead["landmark_rmse_m"] is None
    assert dead["accepted"] == 0


def test_summary_without_truth_leaves_errors_undefined():
    sequence = synthetic_sequence()
    result = synthetic_result(sequence)
    blind = summarise(dataclasses.replace(sequence, truth=None), result)
    undefined = {key for key, value in blind.items() if value is None}
    assert undefined == INERTIAL_KEYS | {
        "ate_m",
        "ate_aligned_m",
        "final_error_m",
        "rpe_1_frame_m",
        "rpe_1_frame_deg",
        "rpe_10_m_m",
        "rpe_10_m_deg",
        "t_rel_percent",
        "r_rel_deg_per_100m",
        *(key for key in SUMMARY_KEYS if key.startswith("pose_nees")),
        "landmark_rmse_m",
    }


def test_summary_takes_truth_of_some_frames_or_of_landmarks_only():
    sequence = synthetic_sequence()
    result = synthetic_result(sequence)
    truth = sequence.truth
    half = dataclasses.replace(sequence, truth=Truth(truth.frame[::2], truth.T_world_imu[::2]))
    T_est, T_true = result.T_world_imu[::2], truth.T_world_imu[::2]
    assert summarise(half, result)["ate_m"] == absolute_trajectory_error(T_est, T_true, align=False)
    assert summarise(half, result)["landmark_rmse_m"] is None
    none = np.empty(0, dtype=np.int64)
    map_only = dataclasses.replace(sequence, truth=Truth(none, np.empty((0, 4, 4)), truth.landmark, truth.position_m))
    assert summarise(map_only, result)["ate_m"] is None
    assert summarise(map_only, result)["landmark_rmse_m"] > 0


def test_table_has_a_row_a_mode_a_dash_for_nothing_and_no_empty_column():
    sequence = synthetic_sequence(frames=40)
    modes = {mode: summarise(sequence, synthetic_result(sequence, mode)) for mode in ("dead-reckoning", "full")}
    table = compare_table({"sequence": sequence.name, "frames": 40, "landmarks": 300, "modes": modes})
    lines = table.splitlines()
    assert "winding road" in lines[0]
    assert "t_rel" not in table, "no segment of 100 m fits"
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("| ")]
    assert rows[0] == ["", "dead-reckoning", "full"]
    assert len({len(line) for line in lines[2:]}) == 1
    cells = {row[0]: row[1:] for row in rows[1:]}
    assert cells["landmark RMSE [m]"][0] == "-"
    for heading, key, spec in (
        ("ATE [m], unaligned", "ate_m", ".3f"),
        ("ATE [m], SE(3)-aligned", "ate_aligned_m", ".3f"),
        ("RPE [m], 1 frame", "rpe_1_frame_m", ".4f"),
        ("RPE [deg], 1 frame", "rpe_1_frame_deg", ".4f"),
        ("RPE [m], 10 m", "rpe_10_m_m", ".4f"),
        ("RPE [deg], 10 m", "rpe_10_m_deg", ".4f"),
    ):
        assert cells[heading] == [format(modes[mode][key], spec) for mode in ("dead-reckoning", "full")]
    truth = Truth(sequence.truth.frame, sequence.truth.T_world_imu)
    poses_only = {"full": summarise(dataclasses.replace(sequence, truth=truth), synthetic_result(sequence))}
    table = compare_table({"sequence": sequence.name, "frames": 40, "landmarks": 300, "modes": poses_only})
    assert "landmark RMSE" not in table, "no true position of a landmark is known"


@pytest.mark.parametrize(("name", "value"), [("pitch", 0.02), ("yaw", -0.01), ("scale", 0.03), ("z", 2.0)])
def test_the_parts_of_an_error_name_what_is_wrong(name, value):
    T = synthetic_sequence(frames=150).truth.T_world_imu
    moved = T.copy()
    if name == "scale":
        moved[:, :3, 3] = T[0, :3, 3] + (1 + value) * (T[:, :3, 3] - T[0, :3, 3])
    elif name == "z":
        moved[:, 2, 3] += value
    else:
        turn = np.zeros(6)
        turn[PARTS.index(name) + 3] = value
        moved = T[0] @ se3.exp(turn) @ se3.inverse(T[0]) @ T
    moved[:, :3, 3] += 0.01 * np.random.default_rng(0).standard_normal((150, 3))
    (part,) = error_parts(moved, T)
    assert part.name == name
    assert part.value == pytest.approx(value, rel=0.1)
    assert part.share > 0.95


def test_an_error_of_shape_has_no_parts_and_no_error_none():
    T = synthetic_sequence(frames=150).truth.T_world_imu
    bent = T.copy()
    bent[:, 1, 3] += np.sin(np.arange(150))
    assert error_parts(bent, T) == ()
    assert error_parts(T, T) == ()


def test_an_error_is_said_in_words():
    sequence = synthetic_sequence(frames=150, landmarks=20)
    T = sequence.truth.T_world_imu
    pitched = T[0] @ se3.exp(np.array([0, 0, 0, 0, np.radians(1.6), 0])) @ se3.inverse(T[0]) @ T
    result = dataclasses.replace(synthetic_result(sequence), T_world_imu=pitched)
    words = error_in_words(result, sequence.truth)
    pitch = "of its square is the first pose's pitch of +1.6 deg"
    assert re.fullmatch(r"ATE 1\.\d\d m unaligned, 0\.\d+ m aligned: \d+% " + re.escape(pitch), words)
    assert error_in_words(result, None) == ""
    assert f"full: {words}." in compare_table(summarise_all(sequence, 20, {"full": result}))
