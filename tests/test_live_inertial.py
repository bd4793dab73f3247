"""Live use with an inertial unit is the run of the recording; poses come at the rate of the samples."""

from __future__ import annotations

import numpy as np
import pytest
from support.compiled import assert_same_state
from support.helpers import filter_of

from ekfslam import LiveEKF
from ekfslam.config import Config
from ekfslam.data.inputs import InertialNoise, InertialSamples
from ekfslam.data.simulate import builtin
from ekfslam.errors import ConfigError, LateError
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import run_filter
from ekfslam.geometry import se3
from ekfslam.resolve import resolve
from ekfslam.runner import run

FRAMES = 25


@pytest.fixture(scope="module")
def problem():
    return resolve(builtin(f"room?frames={FRAMES}"), Config())


def messages(sequence, jitter_s=0.0, rng=None):
    """Samples and images in the order of their stamps, or each delayed by up to a jitter."""
    samples = sequence.inertial
    found = [
        (t, "imu", (gyro, accel))
        for t, gyro, accel in zip(samples.time_s.tolist(), samples.gyro_rad_s, samples.accel_m_s2, strict=True)
    ]
    found += [(t, "update", sequence.observations.at(k)) for k, t in enumerate(sequence.time_s.tolist())]
    delay = [0.0] * len(found) if rng is None else rng.uniform(0.0, jitter_s, len(found)).tolist()
    return [message for _, message in sorted(zip(delay, found, strict=True), key=lambda pair: pair[0] + pair[1][0])]


def sent(live, stream):
    for t, name, arguments in stream:
        getattr(live, name)(*arguments, t)
    return live


@pytest.mark.slow
@pytest.mark.parametrize("jitter_s", [0.0, 0.19])
def test_it_is_the_run_of_the_recording(problem, jitter_s):
    sequence = problem.sequence
    live = LiveEKF(filter_of(problem), delay_s=0.2 if jitter_s else 0.0)
    poses = []
    for t, name, arguments in messages(sequence, jitter_s, np.random.default_rng(1) if jitter_s else None):
        for report in getattr(live, name)(*arguments, t):
            poses.append((report.frame, live.pose(live.time_s)))
    live.flush()
    ekf = filter_of(problem)
    for _ in run_filter(ekf, sequence):
        pass
    assert_same_state(live.ekf, ekf, floor=1e-9)
    assert (live.counts.taken_in, live.counts.held, live.counts.gaps) == (FRAMES, 0, 0)
    assert (live.counts.out_of_order > 50) == (jitter_s > 0)
    result = run(builtin(f"room?frames={FRAMES}"), "full")
    for frame, pose in poses:
        np.testing.assert_allclose(pose.T_world_imu, result.T_world_imu[frame], rtol=0, atol=1e-9)
        np.testing.assert_allclose(pose.covariance, result.covariance[frame], rtol=0, atol=1e-9)
    assert len(poses) >= FRAMES - 3


def test_an_image_waits_for_the_first_sample_after_its_stamp(problem):
    live, sequence = LiveEKF(filter_of(problem)), problem.sequence
    t = float(sequence.time_s[0])
    for stamp, gyro, accel in ((t - 0.004, 0.1, 9.0), (t + 0.001, 0.2, 9.2)):
        assert live.time_s is None
        if stamp > t:
            assert live.update(*sequence.observations.at(0), t) == []
        reports = live.imu([gyro, 0.0, 0.0], [0.0, 0.0, accel], stamp)
    assert len(reports) == 1 and live.time_s == t
    # The rate at the image is between the samples.
    assert live.ekf.imu_twist[3] == pytest.approx(0.18 - live.ekf.values["gyro_bias"][0])
    with pytest.raises(LateError, match="sample at"):
        live.imu(np.zeros(3), np.zeros(3), t + 0.0005)


def test_images_older_than_all_samples_are_counted(problem):
    sequence = problem.sequence
    live = LiveEKF(filter_of(problem))
    for k in range(2):
        live.update(*sequence.observations.at(k), float(sequence.time_s[k]))
    stream = [message for message in messages(sequence) if message[0] > sequence.time_s[1] + 0.05]
    sent(live, stream[:60])
    assert live.counts.unused == 2 and live.counts.taken_in >= 1
    assert [drop.reason for drop in live.dropped] == ["before the first sample"] * 2


def test_poses_at_the_rate_of_samples_are_predictions_from_the_last_image(problem):
    sequence = problem.sequence
    stream = [message for message in messages(sequence) if message[1] == "imu" or message[0] < sequence.time_s[3]]
    live = sent(LiveEKF(filter_of(problem), gap_s=1.0), stream[:40])
    rows = [message for message in stream[40:240] if message[1] == "imu"]
    for t, _, (gyro, accel) in rows:
        live.imu(gyro, accel, t)
        found = live.pose()
        assert found.time_s == t and not found.is_held
    then = live.ekf.without_landmarks()
    end = live.newest_s
    assert end - live.time_s > 0.8  # so that predictions were kept
    ahead = JointEKF(problem.model, problem.config.filter)
    step = ahead.model.process.step(
        then.values, sequence.inertial.interval(live.time_s, end), then.T_imu_world, first_estimates=False
    )
    np.testing.assert_allclose(se3.inverse(found.T_world_imu), step.values["pose"], atol=1e-9)
    for name in ("velocity", "gyro_bias", "accel_bias"):
        value, covariance = live.block(name)
        np.testing.assert_allclose(value, step.values[name], atol=1e-9)
        assert np.linalg.eigvalsh(covariance)[0] > 0
    # Its covariance is that of one prediction over all samples.
    alone = live.pose(end).covariance
    own = list(step.values)
    columns = np.concatenate([np.arange(*then.model.layout[name].indices(10**6)) for name in own])
    P = then.gaussian.body_covariance
    np.testing.assert_allclose(alone, (step.Phi @ P @ step.Phi.T + step.Q)[:6, :6], rtol=1e-6, atol=1e-15)
    assert len(columns) == 15


def test_a_sample_between_others_changes_the_prediction(problem):
    sequence = problem.sequence
    stream = [message for message in messages(sequence) if message[1] == "imu" or message[0] < sequence.time_s[3]]
    late = stream.pop(150)
    live = sent(LiveEKF(filter_of(problem), gap_s=1.0), stream[:239])
    live.pose()
    live.imu(*late[2], late[0])
    whole = sent(LiveEKF(filter_of(problem), gap_s=1.0), sorted([*stream[:239], late], key=lambda m: m[0]))
    np.testing.assert_allclose(live.pose().T_world_imu, whole.pose().T_world_imu, atol=1e-12)


def test_velocities_and_samples_are_not_mixed(problem):
    live = LiveEKF(filter_of(problem))
    with pytest.raises(ConfigError, match="call imu"):
        live.predict(np.zeros(6), 0.0)
    with pytest.raises(ConfigError, match="no state block 'twist'"):
        live.block("twist")
    with pytest.raises(ConfigError, match="no state block"):
        live.block(np.zeros(3))
    sequence = problem.sequence
    velocities = LiveEKF.from_rig(sequence.camera, sequence.T_cam_imu, sequence.noise)
    with pytest.raises(ConfigError, match="call predict"):
        velocities.imu(np.zeros(3), np.zeros(3), 0.0)


def test_a_rig_with_an_inertial_unit_from_a_given_start(problem):
    sequence = problem.sequence
    densities = InertialNoise(1.7e-4, 2e-3, 1.9e-5, 3e-3)
    start = sequence.truth.T_world_imu[0]
    live = LiveEKF.from_rig(sequence.camera, sequence.T_cam_imu, sequence.noise, start, imu=densities)
    sent(live, messages(sequence))
    error = se3.log(se3.inverse(live.pose(live.time_s).T_world_imu) @ sequence.truth.T_world_imu[-1])
    assert np.linalg.norm(error[:3]) < 0.05 and live.counts.taken_in == FRAMES


def test_a_rest_gives_tilt_and_biases(problem):
    """Its samples, one second of them, lead to the truth from a pose without the tilt."""
    sequence, rng = problem.sequence, np.random.default_rng(3)
    densities, true = InertialNoise(1.7e-4, 2e-3, 1.9e-5, 3e-3), sequence.truth
    T, t = true.T_world_imu[0], float(sequence.time_s[0]) - 1.0 + 0.005 * np.arange(200)
    noise = np.sqrt(200.0) * np.repeat([densities.gyro, densities.accel], 3) * rng.standard_normal((200, 6))
    gyro = true.motion.gyro_bias_rad_s[0] + noise[:, :3]
    accel = T[:3, :3].T @ [0.0, 0.0, 9.81] + true.motion.accel_bias_m_s2[0] + noise[:, 3:]
    tilted = T @ se3.transform(se3.so3_exp(np.array([0.2, -0.1, 0.0])), np.zeros(3))
    rest = InertialSamples(t, gyro, accel)
    live = LiveEKF.from_rig(sequence.camera, sequence.T_cam_imu, sequence.noise, tilted, imu=densities, rest=rest)
    up = live.ekf.T_imu_world[:3, 2] @ (T[:3, :3].T @ [0.0, 0.0, 1.0])
    assert up > np.cos(0.03)  # the bias of the accelerometer, 0.1 m/s^2, looks like a tilt of 0.01
    np.testing.assert_allclose(live.ekf.values["gyro_bias"], true.motion.gyro_bias_rad_s[0], atol=1e-3)
    sent(live, messages(sequence))
    value, covariance = live.block("gyro_bias")
    error = value - true.motion.gyro_bias_rad_s[-1]
    assert error @ np.linalg.solve(covariance, error) < 16.3
