"""The joint filter with the inertial process, on the world ``room``."""

import dataclasses
import functools

import numpy as np
import pytest
from inertial import FILTER, LARGE, Prior, model_from_prior, outcomes
from support.frozen import assert_equal_to_frozen_rows
from support.gauge import gauge_directions

import ekfslam
from ekfslam.data.room import Room, simulate_room
from ekfslam.errors import ConfigError
from ekfslam.evaluation.consistency import nees, pose_error
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import run_filter
from ekfslam.models.build import blocks_and_process
from ekfslam.resolve import resolve
from ekfslam.smoother.posterior import smooth

FREE = Prior(position_m=0.5, tilt_rad=0.2, yaw_rad=0.2, rest_s=0.0)


@functools.cache
def room(frames=60):
    return simulate_room(Room(frames=frames, seed=2))


def gauge_information(ekf):
    """Information (4, 4) along position and turns about gravity."""
    world = np.zeros((6, 4))
    world[:3, :3], world[5, 3] = np.eye(3), 1.0
    own, body = ekf.model.process.columns, ekf.model.layout.body
    columns = np.concatenate([own, np.arange(body, len(ekf.P))])
    directions = gauge_directions(ekf.linear_T_imu_world, ekf.linear_positions_m) @ world
    N = np.vstack([directions[:6], np.zeros((9, 4)), directions[6:]])
    return N.T @ np.linalg.solve(ekf.P[np.ix_(columns, columns)], N)


def gauge_ratio(variant, coordinates):
    """Eigenvalues of the information after the last frame over that before the first one."""
    config = dataclasses.replace(FILTER, variant=variant, landmark_coordinates=coordinates, gate_probability=1.0)
    model = model_from_prior(room(), FREE, np.random.default_rng(0), noise_free=True)
    ekf = JointEKF(model, config)
    first = gauge_information(ekf)
    for _ in run_filter(ekf, room()):
        pass
    return np.sort(np.linalg.eigvals(np.linalg.solve(first, gauge_information(ekf))).real)


@pytest.mark.parametrize("coordinates", ["image", "xyz"])
@pytest.mark.parametrize("variant", ["invariant", "fej"])
def test_consistent_variants_gain_no_information_about_position_and_heading(variant, coordinates):
    np.testing.assert_allclose(gauge_ratio(variant, coordinates), 1.0, atol=1e-6)


def test_the_standard_variant_gains_information_about_the_heading():
    assert gauge_ratio("standard", "xyz").max() > 10.0


def test_a_recording_with_samples_alone_runs_by_them():
    sequence = room()
    result = ekfslam.run(sequence, "full")
    error_m = np.linalg.norm(result.T_world_imu[:, :3, 3] - sequence.truth.T_world_imu[:, :3, 3], axis=1)
    assert error_m.max() < 0.05
    assert 0.9 < result.innovation.nis.sum() / result.innovation.dof.sum() < 1.1


def test_the_prior_of_the_accelerometer_bias_is_a_setting_and_bounds_the_first_tilt():
    tilt = []
    for std in (0.1, 0.2):
        model = resolve(room(8), ekfslam.Config(blocks={"accel_bias": {"std_m_s2": std}})).model
        level = model.initial_values()["pose"][:3, 0]
        P = model.prior_covariance[model.layout["pose"], model.layout["pose"]][3:, 3:]
        tilt.append(np.sqrt(level @ P @ level))
    np.testing.assert_allclose(tilt, [0.1 / 9.81, 0.2 / 9.81], rtol=0.01)


@pytest.mark.parametrize("variant", ["standard", "fej"])
def test_frozen_steps_have_the_state_of_the_filter_as_solution(variant):
    config = dataclasses.replace(FILTER, variant=variant, landmark_coordinates="xyz", retire="never")
    prior = Prior(position_m=0.004, tilt_rad=0.02, yaw_rad=0.02, rest_s=0.0)
    ekf = JointEKF(model_from_prior(room(), prior, np.random.default_rng(0)), config)
    for _ in run_filter(ekf, room(), range(40)):
        pass
    assert_equal_to_frozen_rows(ekf)


@pytest.mark.slow
def test_a_run_with_samples_is_smoothed_from_its_archive(tmp_path):
    sequence = room()
    filtered = ekfslam.run(sequence, "full")
    ekfslam.write_archive(tmp_path / "room.h5", sequence, {"full": filtered})
    smoothed = smooth(ekfslam.read_archive(tmp_path / "room.h5").results["full"])
    truth = sequence.truth.T_world_imu
    error = nees(pose_error(smoothed.T_world_imu, truth), smoothed.covariance)[1:]
    assert 2.0 < error.mean() < 12.0
    trace = [np.trace(result.covariance[len(truth) // 2]) for result in (smoothed, filtered)]
    assert trace[0] < 0.8 * trace[1]


@pytest.mark.slow
def test_errors_are_what_the_covariance_says():
    """Six runs of 12 s: each mean NEES within three standard errors of `experiments/inertial.py` (20 runs)."""
    found = outcomes(Room(frames=120), Prior(), FILTER, 6)
    mean = {part: np.mean([outcome.nees[part] for outcome in found]) for part in found[0].nees}
    assert 4.0 < mean["pose"] < 8.0 and 12.0 < mean["all"] < 18.0
    assert all(1.8 < mean[part] < 4.2 for part in ("velocity", "gyro bias", "accel bias"))


@pytest.mark.slow
def test_only_the_invariant_variant_survives_a_large_tilt():
    mean = {}
    for variant in ("invariant", "standard"):
        found = outcomes(Room(frames=150), LARGE, dataclasses.replace(FILTER, variant=variant), 6)
        mean[variant] = np.mean([outcome.nees["pose"] for outcome in found])
    assert 4.0 < mean["invariant"] < 8.0 and mean["standard"] > 100.0


@pytest.mark.slow
def test_stamps_that_are_late_are_found():
    sequence = simulate_room(Room(frames=150))
    samples = dataclasses.replace(sequence.inertial, time_s=sequence.inertial.time_s - 0.005)
    config = ekfslam.Config().with_overrides({"calibration": {"time_s": 0.01, "rotation_deg": 0.3}})
    found = ekfslam.run(dataclasses.replace(sequence, inputs=(samples,)), "full", config).parameters
    assert found.value[-1, found.name.index("time offset")] == pytest.approx(-0.005, abs=3e-4)


def spoiled(sequence, seed):
    """A recording whose unit has matrices with errors of 1 %, and these errors (15,)."""
    D = 0.01 * np.random.default_rng(seed).normal(size=15)
    M_g, M_a = np.eye(3) + D[:9].reshape(3, 3), np.eye(3)
    M_a[np.tril_indices(3)] += D[9:]
    samples = sequence.inertial
    gyro, accel = (np.linalg.solve(M, x.T).T for M, x in ((M_g, samples.gyro_rad_s), (M_a, samples.accel_m_s2)))
    return dataclasses.replace(sequence, inputs=(dataclasses.replace(samples, gyro_rad_s=gyro, accel_m_s2=accel),)), D


SCALED = ekfslam.Config(blocks={"imu_scale": {}})


@pytest.mark.slow
def test_scale_and_misalignment_of_the_unit_are_found_and_leave_errors_as_the_covariance_says():
    of_poses, of_matrices = [], []
    for seed in range(2):
        sequence, D = spoiled(simulate_room(Room(frames=110, seed=seed)), seed)
        result = ekfslam.run(sequence, "full", SCALED)
        at = [i for i, name in enumerate(result.parameters.name) if name.startswith(("gyroscope", "accelerometer"))]
        error, P = pose_error(result.T_world_imu, sequence.truth.T_world_imu)[1:], result.covariance[1:]
        of_poses.append(nees(error, P + 1e-14 * np.eye(6)).mean())
        of_matrices.append((((D - result.parameters.value[-1, at]) / result.parameters.std[-1, at]) ** 2).sum())
        assert result.parameters.std[-1, at].max() < 0.005
    assert 2.0 < np.mean(of_poses) < 12.0 and 6.0 < np.mean(of_matrices) < 27.0


def test_engine_and_reference_filter_agree_on_matrices_of_the_unit():
    sequence, _ = spoiled(room(20), 0)
    config = SCALED.with_overrides({"calibration": {"time_s": 0.01}})
    found = [
        ekfslam.run(sequence, "full", config.with_overrides({"filter": {"engine": e}})) for e in ("auto", "reference")
    ]
    np.testing.assert_allclose(found[0].T_world_imu, found[1].T_world_imu, atol=1e-9)
    np.testing.assert_allclose(found[0].parameters.value, found[1].parameters.value, atol=1e-9)


def test_frozen_steps_with_matrices_of_the_unit_have_the_state_of_the_filter_as_solution():
    sequence, _ = spoiled(room(), 0)
    config = dataclasses.replace(FILTER, variant="standard", landmark_coordinates="xyz", retire="never")
    model = resolve(sequence, SCALED.with_overrides({"filter": {"landmark_coordinates": "xyz"}})).model
    ekf = JointEKF(model, config)
    for _ in run_filter(ekf, sequence, range(25)):
        pass
    assert_equal_to_frozen_rows(ekf)


def test_matrices_of_the_unit_need_samples():
    with pytest.raises(ConfigError, match="imu_scale needs inertial samples"):
        blocks_and_process(SCALED.blocks, None)
