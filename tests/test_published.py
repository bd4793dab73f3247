"""The consistency experiments: their sensor, worlds and statistics, in the small."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy.signal import lfilter
from threadpoolctl import threadpool_limits

from ekfslam import open_sequence
from ekfslam.data.simulate import Loop, simulate
from ekfslam.evaluation.consistency import chi2_bounds
from ekfslam.geometry import se3

EXPERIMENTS = Path(__file__).resolve().parents[1] / "experiments"


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXPERIMENTS / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


published, starry_night = load("published_results"), load("starry_night")


def position_sensor(rng: np.random.Generator, n: int = 5):
    noise = published.Noise(np.ones(6), np.ones(4))
    return published.PositionSensor(noise, rng.normal(0, 5, (n, 3)), rng.uniform(0.1, 1, (n, 3)))


def test_position_sensor_jacobian_matches_finite_differences_and_inverse():
    rng = np.random.default_rng(0)
    sensor, q, h = position_sensor(rng), rng.normal(0, 5, (4, 3)), 1e-6
    differences = [(sensor.predict(q + h * e) - sensor.predict(q - h * e)) / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose(sensor.jacobian(q), np.stack(differences, axis=-1), atol=1e-8)
    np.testing.assert_array_equal(sensor.invert(sensor.predict(q)), q)


def test_position_sensor_finds_the_variance_of_each_measurement_in_any_order():
    sensor = position_sensor(np.random.default_rng(1))
    some = [3, 0, 4]
    np.testing.assert_array_equal(sensor.variance(sensor.measured_m[some]), sensor.std_m[some] ** 2)


def test_box_path_is_closed_inside_the_box_and_follows_its_odometry():
    world = published.box_world(0.01, 0.05, 501, seed=0)
    T = world.T_world_imu
    np.testing.assert_allclose(T[500], T[0], atol=1e-12)
    assert (np.abs(T[:, :3, 3]) < published.BOX_M / 2).all()
    np.testing.assert_allclose(T[:-1] @ se3.exp(world.odometry[1:]), T[1:], atol=1e-12)
    np.testing.assert_allclose(world.odometry_std, 0.01 * np.abs(world.odometry))
    np.testing.assert_allclose(world.position_std(np.array([[20.0, -4.0, 0.01]])), [[1.0, 0.2, 0.005]])


def test_box_vehicle_sees_what_is_near_and_ahead():
    world = published.box_world(0.01, 0.01, 2, seed=0)
    q = np.array([[19.0, 0, 0], [21.0, 0, 0], [-5.0, 0, 0], [5.0, 8.0, 0], [5.0, 9.0, 0]])
    assert world.sees(q).tolist() == [True, False, False, True, False]


@pytest.mark.slow
def test_box_experiment_stays_bounded_for_the_invariant_variant():
    for seed in range(2):
        world = published.box_world(0.05, 0.05, 60, seed)
        with threadpool_limits(1, user_api="blas"):
            track = published.drive(world, np.random.default_rng(seed), ["invariant"])["invariant"]
        figures = track.figures(planar=False)
        assert all(np.isfinite(value) for value in figures.values())
        assert figures["pose_nees_per_dof"] < 3.0
        assert figures["position_mean_square_m2"] < 1.0


@pytest.mark.slow
def test_circle_experiment_stays_in_the_plane_and_consistent():
    world = published.circle_world(300)
    np.testing.assert_allclose(world.T_world_imu[240], world.T_world_imu[0], atol=1e-9)
    with threadpool_limits(1, user_api="blas"):
        track = published.drive(world, np.random.default_rng(0), ["invariant"])["invariant"]
    out_of_plane = [2, 3, 4]
    np.testing.assert_allclose(track.xi[:, out_of_plane], 0.0, atol=1e-12)
    np.testing.assert_allclose(track.covariance[:, out_of_plane], 0.0, atol=1e-12)
    np.testing.assert_allclose(track.position_m[:, 2], 0.0, atol=1e-12)
    figures = track.figures(planar=True)
    assert 0.02 < figures["orientation_nees_per_dof"] < 5.0
    assert figures["position_mean_square_m2"] < 1.0


def test_summary_pairs_runs_and_takes_roots_of_mean_squares():
    def run(nees: float, square: float) -> dict[str, float]:
        return {"pose_nees_per_dof": nees, "position_mean_square_m2": square}

    runs = [
        {"invariant": run(1.0, 1.0), "fej": run(2.0, 4.0), "standard": run(4.0, 4.0)},
        {"invariant": run(3.0, 7.0), "fej": run(4.0, 4.0), "standard": run(2.0, 4.0)},
    ]
    summary = published.summarise(runs)
    assert summary["invariant"]["pose_nees_per_dof"] == pytest.approx([2.0, 3.0])
    assert summary["invariant"]["position_rms_m"][0] == pytest.approx(2.0)
    assert summary["fej"]["pose_nees_per_dof_minus_invariant"] == pytest.approx([1.0, 0.0])
    assert published.ordering(summary).startswith(
        "Pose NEES, same runs: FEJ is above RI, standard is not distinguishable from RI"
    )


def test_autocorrelation_pairs_only_equal_lags_of_the_same_group():
    frame = np.array([0, 1, 3, 0, 1])
    group = np.array([7, 7, 7, 8, 8])
    values = np.array([[1.0], [-2.0], [4.0], [-1.0], [-2.0]])
    rho = starry_night.autocorrelation(values, 3, group, frame)
    # Means of products: lag 1 (-2 and 2), lag 2 (-8), lag 3 (4), over the mean square 26/5.
    np.testing.assert_allclose(rho[:, 0], np.array([26 / 5, 0.0, -8.0, 4.0]) / (26 / 5), atol=1e-15)


def test_inflation_of_white_and_of_first_order_noise():
    noise = np.random.default_rng(0).standard_normal((50_000, 2))
    noise[:, 1] = lfilter([1.0], [1.0, -0.6], noise[:, 1])
    rho = starry_night.autocorrelation(noise, 40, np.zeros(len(noise), dtype=int), np.arange(len(noise)))
    np.testing.assert_allclose(rho[1:4, 1], [0.6, 0.36, 0.216], atol=0.03)
    np.testing.assert_allclose(starry_night.inflation(rho), [1.0, 2.0], atol=0.1)  # sqrt((1 + a) / (1 - a))


@pytest.mark.parametrize("variant", [None, "invariant", "fej"])
def test_window_of_a_simulated_loop_is_consistent(variant):
    sequence = simulate(Loop("loop", frames=60))
    window = starry_night.run_window(sequence, variant, 20, 50, sequence.noise, np.random.default_rng(0))
    assert len(window.pose_nees) == 30
    low, high = chi2_bounds(6, 0.999)
    assert low < window.pose_nees.mean() < high
    assert (len(window.landmark_nees) == 0) == (variant is None)
    if variant is not None:
        # They share the error of the pose, and so count as little more than one sample.
        low, high = chi2_bounds(3, 0.999)
        assert low < window.landmark_nees.mean() < high


@pytest.mark.slow
def test_windows_start_at_a_draw_from_the_prior_of_the_filter():
    sequence = simulate(Loop("loop", frames=30))
    rng = np.random.default_rng(1)
    first = [starry_night.run_window(sequence, None, 20, 22, sequence.noise, rng).pose_nees[0] for _ in range(100)]
    low, high = chi2_bounds(6, 0.999, runs=100)
    assert low < np.mean(first) < high


def test_starry_night_without_recordings_says_so_and_succeeds(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["starry_night.py", "--data", str(tmp_path), "--out", str(tmp_path / "out")])
    assert starry_night.main() == 0
    assert "EKFSLAM_DATA" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.data
def test_starry_night_residuals_have_the_stated_size_but_are_not_white(data_path):
    table = starry_night.noise_table(open_sequence(data_path("utias/dataset3.mat")))
    assert table["pixels"]["uL"]["std"] == pytest.approx(6.2, rel=0.02)
    assert table["pixels"]["vL"]["std"] == pytest.approx(11.4, rel=0.02)
    for row in ("uL", "vL", "uR", "vR"):
        assert table["pixels"][row]["std"] == pytest.approx(table["pixels"][row]["stated_std"], rel=0.001)
    assert table["pixels"]["vL"]["autocorrelation_1"] > 0.9
    assert abs(table["velocities"]["v_x"]["autocorrelation_1"]) < 0.1
