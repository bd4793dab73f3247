"""A truth that errs: its noise in NEES, where it comes from, how it is stored, and how a user overrides it."""

import dataclasses
import math

import h5py
import numpy as np
import pytest
from support.helpers import erring_truth, synthetic_result, synthetic_sequence
from support.recordings import ece276a_fields, utias_fields, write_mat, write_npz

from ekfslam import open_sequence
from ekfslam.cli import main
from ekfslam.config import Config, TruthConfig
from ekfslam.data.readers import write_sequence
from ekfslam.data.truth_noise import KITTI_TRUTH_NOISE, TruthNoise
from ekfslam.errors import ConfigError, DataError
from ekfslam.evaluation.consistency import (
    chi2_bounds,
    first_pose_error_covariance,
    pose_error,
    pose_nees,
    pose_nees_by_axis,
    pose_noise_covariance,
    turned_body_covariance,
)
from ekfslam.evaluation.relative import relative_pose_nees
from ekfslam.evaluation.summary import summarise
from ekfslam.evaluation.truth import with_truth_noise
from ekfslam.figures.run import plot_errors
from ekfslam.geometry import se3
from ekfslam.reports import compare
from ekfslam.runner import run
from ekfslam.storage.archive import read_archive, write_archive

NOISE = TruthNoise(0.01, 0.02, 0.03, 0.1, 0.01, 0.05, 0.004)
SLOW = {
    "drift": TruthNoise(drift_m_sqrt_s=0.3),
    "world": TruthNoise(world_tilt_rad=0.03),
    "body": TruthNoise(turn_rad=0.02),
    "scale": TruthNoise(scale=0.1),
}


def with_noise(sequence, noise):
    return dataclasses.replace(sequence, truth=dataclasses.replace(sequence.truth, noise=noise))


# The equations


def test_an_error_of_the_first_pose_moves_the_whole_estimate():
    T_true = synthetic_sequence(frames=40).truth.T_world_imu
    stds = np.array([0.1, 0.1, 0.1, 0.01, 0.02, 0.03])
    expected = np.zeros((40, 6, 6))
    for axis, std in enumerate(stds):
        e0 = std * np.eye(6)[axis]
        # An estimate that makes no error of its own, from a first pose that is off by e0.
        T_imu_world = se3.inverse(T_true) @ T_true[0] @ se3.exp(-e0) @ se3.inverse(T_true[0])
        xi = pose_error(se3.inverse(T_imu_world), T_true)
        expected += xi[:, :, None] * xi[:, None, :]
    found = first_pose_error_covariance(NOISE, T_true)
    np.testing.assert_allclose(found[0], np.diag(stds**2), atol=1e-15)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
    assert found[-1, 1, 1] > 10 * found[0, 1, 1], "heading becomes distance"


def test_jitter_of_stamps_is_an_error_along_the_motion():
    time_s, u = np.array([0.0, 0.1, 0.25, 0.3]), np.array([8.0, 0.3, -0.1, 0.02, 0.05, 0.4])
    T = se3.exp(time_s[:, None] * u)
    dt = 0.01
    found = pose_noise_covariance(TruthNoise(stamp_s=dt), T, time_s)
    xi = pose_error(se3.exp((time_s[:, None] + dt) * u), T)
    np.testing.assert_allclose(found, xi[:, :, None] * xi[:, None, :], rtol=1e-9, atol=1e-14)
    white = pose_noise_covariance(TruthNoise(position_m=0.05, attitude_rad=0.004), T, time_s)
    np.testing.assert_allclose(white, np.broadcast_to(np.diag([0.05**2] * 3 + [0.004**2] * 3), (4, 6, 6)))
    np.testing.assert_allclose(pose_noise_covariance(NOISE, T[:1], time_s[:1])[0, 0, 0], 0.05**2)


def test_a_turned_body_is_an_error_of_the_motion_since_the_first_pose():
    T_true, e = synthetic_sequence(frames=30).truth.T_world_imu, np.array([0, 0, 0, 1e-5, -2e-5, 3e-5])
    turned = T_true @ se3.exp(e)
    T_est = turned[0] @ se3.inverse(T_true[0]) @ T_true  # the motion of the true body, from the first turned pose
    xi = pose_error(T_est, turned)
    A = se3.adjoint(se3.inverse(T_true) @ T_true[0])
    np.testing.assert_allclose(xi, (A - np.eye(6)) @ e, atol=1e-7)
    found = sum(turned_body_covariance(TruthNoise(turn_rad=1.0), A)[-1] @ np.eye(6)[i] for i in range(6))
    np.testing.assert_allclose(found, ((A - np.eye(6))[-1, :, 3:] @ (A - np.eye(6))[-1, :, 3:].T).sum(axis=1))


@pytest.mark.parametrize("kind", SLOW)
def test_nees_against_a_truth_that_drifts_or_is_turned_is_six_with_its_noise(kind):
    absolute, relative, without, noise = [], [], [], SLOW[kind]
    for seed in range(40):
        sequence = synthetic_sequence(frames=40, landmarks=20, seed=seed)
        result = synthetic_result(sequence, "dead-reckoning")
        truth = erring_truth(sequence.truth, sequence.time_s, noise, np.random.default_rng(1000 + seed))
        absolute.append(pose_nees(result, truth, with_truth_noise=True)[1][-1])
        without.append(pose_nees(result, truth)[1][-1])
        relative.append(np.nanmean(relative_pose_nees(result, truth, np.zeros(40, dtype=bool))[1]))
    low, high = chi2_bounds(6, 0.999, runs=40)
    assert low < np.mean(absolute) < high
    assert np.mean(without) > 2 * high
    assert low < np.mean(relative) < high


@pytest.mark.slow
def test_nees_against_a_truth_that_errs_is_six_with_its_noise_and_too_large_without():
    with_, without, axes = [], [], []
    for seed in range(60):
        sequence = synthetic_sequence(frames=50, landmarks=40, seed=seed)
        result = synthetic_result(sequence)
        truth = erring_truth(sequence.truth, sequence.time_s, NOISE, np.random.default_rng(1000 + seed))
        with_.append(pose_nees(result, truth, with_truth_noise=True)[1][-1])
        without.append(pose_nees(result, truth)[1][-1])
        axes.append(pose_nees_by_axis(result, truth)[-1])
    low, high = chi2_bounds(6, 0.999, runs=60)
    assert low < np.mean(with_) < high
    assert np.mean(without) > 3 * high
    low, high = chi2_bounds(1, 0.9999, runs=60)
    assert ((low < np.mean(axes, axis=0)) & (np.mean(axes, axis=0) < high)).all()


def test_both_nees_are_of_the_same_frames_and_agree_where_the_truth_is_exact():
    sequence = synthetic_sequence(frames=30, landmarks=40)
    result = synthetic_result(sequence, "dead-reckoning")
    for noise in (None, TruthNoise()):
        truth = dataclasses.replace(sequence.truth, noise=noise)
        np.testing.assert_array_equal(pose_nees(result, truth, True)[1], pose_nees(result, truth)[1])
    truth = dataclasses.replace(sequence.truth, noise=NOISE)
    np.testing.assert_array_equal(np.isnan(pose_nees(result, truth, True)[1]), np.isnan(pose_nees(result, truth)[1]))
    world = open_sequence("builtin:loop?frames=30")
    summary = summarise(world, run(world, "full"))
    assert summary["pose_nees_with_truth_noise_mean"] == summary["pose_nees_mean"]


def test_an_overconfident_axis_is_named():
    sequence = synthetic_sequence(frames=80, landmarks=40)
    result = synthetic_result(sequence)
    covariance = result.covariance.copy()
    covariance[:, 5] /= 10.0
    covariance[:, :, 5] /= 10.0
    honest, summary = (
        summarise(sequence, dataclasses.replace(result, covariance=P)) for P in (result.covariance, covariance)
    )
    assert summary["pose_nees_yaw_mean"] == pytest.approx(100 * honest["pose_nees_yaw_mean"], rel=1e-9)
    for axis in ("x", "y", "z", "roll", "pitch"):
        assert summary[f"pose_nees_{axis}_mean"] == honest[f"pose_nees_{axis}_mean"]


def test_the_figure_states_both():
    sequence = synthetic_sequence(frames=30, landmarks=40)
    results = {"full": synthetic_result(sequence)}
    exact = plot_errors(results, sequence.truth).axes[0].get_title()
    assert "NEES (6)" in exact and "truth noise" not in exact
    noisy = plot_errors(results, dataclasses.replace(sequence.truth, noise=NOISE)).axes[0].get_title()
    assert "NEES (6)" in noisy and "with truth noise" in noisy


# Where it comes from


def test_formats_of_kitti_state_the_noise_of_their_truth(tmp_path):
    assert open_sequence(write_mat(tmp_path / "a.mat", utias_fields())).truth.noise == KITTI_TRUTH_NOISE
    assert open_sequence(write_mat(tmp_path / "n.mat", utias_fields(starry_night=True))).truth.noise is None
    assert open_sequence("builtin:loop").truth.noise is None
    npz = write_npz(tmp_path / "a.npz", ece276a_fields())
    poses = tmp_path / "poses.txt"
    poses.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 7)
    assert open_sequence(npz, truth=poses).truth.noise == KITTI_TRUTH_NOISE
    tum = tmp_path / "tum.txt"
    tum.write_text("".join(f"{t!r} 0 0 0 0 0 0 1\n" for t in open_sequence(npz).time_s.tolist()))
    assert open_sequence(npz, truth=tum).truth.noise is None


def test_kitti_is_stated_in_the_units_it_was_found_in():
    noise = KITTI_TRUTH_NOISE
    angles = (noise.first_roll_rad, noise.first_pitch_rad, noise.first_yaw_rad, noise.attitude_rad)
    np.testing.assert_allclose(np.degrees(angles), [0.2, 0.2, 0.5, 0.1])
    assert (noise.first_position_m, noise.stamp_s, noise.position_m) == (0.0, 0.003, 0.02)
    first = "first pose 0.2, 0.2, 0.5 deg (roll, pitch, yaw), 0 m"
    assert noise.text == f"{first}; each pose 0.02 m, 0.1 deg, stamps 3 ms; scale 0.0015"


@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
def test_impossible_noise_is_refused(value):
    with pytest.raises(DataError, match=r"truth\.noise\.stamp_s"):
        with_noise(synthetic_sequence(frames=5, landmarks=20), TruthNoise(stamp_s=value))


# Storage


@pytest.mark.parametrize("noise", [None, NOISE, TruthNoise()])
def test_noise_of_the_truth_is_stored_with_recordings_and_archives(tmp_path, noise):
    sequence = with_noise(synthetic_sequence(frames=12, landmarks=30), noise)
    write_sequence(sequence, tmp_path / "s.h5")
    assert open_sequence(tmp_path / "s.h5").truth.noise == noise
    result = synthetic_result(sequence)
    write_archive(tmp_path / "a.h5", sequence, {"full": result})
    archive = read_archive(tmp_path / "a.h5")
    assert archive.truth.noise == noise
    assert summarise(archive, archive.results["full"]) == summarise(sequence, result)


def test_a_damaged_noise_of_the_truth_is_named(tmp_path):
    path = tmp_path / "s.h5"
    write_sequence(with_noise(synthetic_sequence(frames=12, landmarks=30), NOISE), path)
    with h5py.File(path, "a") as h5file:
        h5file["truth"].attrs["noise_stamp_s"] = "much"
    with pytest.raises(DataError, match="truth@noise_stamp_s"):
        open_sequence(path)


# Overriding


def test_a_configuration_overrides_what_it_gives_and_leaves_the_rest():
    sequence = with_noise(synthetic_sequence(frames=12, landmarks=30), NOISE)
    assert with_truth_noise(sequence, TruthConfig()) is sequence
    changed = with_truth_noise(sequence, TruthConfig(yaw_deg=2.0, stamp_s=0.0)).truth.noise
    assert changed == dataclasses.replace(NOISE, first_yaw_rad=math.radians(2.0), stamp_s=0.0)
    exact = with_noise(sequence, None)
    found = with_truth_noise(exact, TruthConfig(attitude_deg=1.0)).truth.noise
    assert found == TruthNoise(attitude_rad=math.radians(1.0))
    blind = dataclasses.replace(sequence, truth=None)
    assert with_truth_noise(blind, TruthConfig(attitude_deg=1.0)) is blind
    with pytest.raises(ConfigError, match=r"truth\.stamp_s must be finite and not negative"):
        Config(truth=TruthConfig(stamp_s=-1.0))


@pytest.mark.slow
def test_compare_takes_the_truth_noise_of_the_configuration(tmp_path):
    world = open_sequence("builtin:loop?frames=20")
    config = Config().with_overrides({"truth": {"position_m": 10.0, "attitude_deg": 50.0}})
    found = compare(world, ["dead-reckoning"], config)
    values = found.summary["modes"]["dead-reckoning"]
    assert values["pose_nees_with_truth_noise_mean"] < 0.1 * values["pose_nees_mean"]
    assert "pose NEES (6), with truth noise" in found.table
    found.save(tmp_path)
    noise = TruthNoise(position_m=10.0, attitude_rad=math.radians(50.0))
    assert read_archive(tmp_path / "archive.h5").truth.noise == noise


@pytest.mark.slow
def test_truth_noise_on_the_command_line(tmp_path, capsys):
    (tmp_path / "c.toml").write_text("[truth]\nyaw_deg = 1.0\nposition_m = 0.5\n")
    arguments = ["run", "builtin:loop?frames=12", "--mode", "dead-reckoning", "--out", str(tmp_path / "a.h5")]
    assert main([*arguments, "--config", str(tmp_path / "c.toml"), "--truth-noise", "yaw_deg=3", "stamp_s=0.01"]) == 0
    noise = TruthNoise(first_yaw_rad=math.radians(3), position_m=0.5, stamp_s=0.01)
    assert read_archive(tmp_path / "a.h5").truth.noise == noise
    capsys.readouterr()
    assert main(["info", "builtin:loop?frames=12", "--truth-noise", "pitch_deg=0.25"]) == 0
    assert "truth noise   first pose 0, 0.25, 0 deg" in capsys.readouterr().out
    assert main(["info", "builtin:loop?frames=12"]) == 0
    assert "truth noise   none stated: taken as exact" in capsys.readouterr().out
    assert main(["info", "builtin:loop?frames=12", "--truth-noise", "speed=1"]) == 2
    assert "unknown key truth.speed" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["info", "builtin:loop?frames=12", "--truth-noise", "yaw_deg"])


def test_axes_of_the_position_are_those_of_world():
    sequence = synthetic_sequence(frames=80, landmarks=40)
    result, truth = synthetic_result(sequence), sequence.truth
    turned = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.pi / 2]))
    T = turned @ truth.T_world_imu
    moved = dataclasses.replace(result, T_world_imu=turned @ result.T_world_imu)
    found = pose_nees_by_axis(moved, dataclasses.replace(truth, T_world_imu=T))
    np.testing.assert_allclose(found[1:], pose_nees_by_axis(result, truth)[1:][:, [1, 0, 2, 3, 4, 5]], rtol=1e-6)
