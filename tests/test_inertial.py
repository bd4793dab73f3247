"""The inertial process: its step, its noise, and the residual that the smoother uses."""

import dataclasses
import functools

import numpy as np
import pytest
from support.gauge import gauge_directions
from support.jacobians import POSES, central
from support.reference import CAMERA, T_CAM_IMU

from ekfslam.data.inputs import InertialNoise, InertialSamples
from ekfslam.data.interval import Intervals
from ekfslam.data.noise import Noise
from ekfslam.errors import LostDataError
from ekfslam.geometry import se3
from ekfslam.geometry.preintegration import gammas, increments
from ekfslam.models.blocks import AccelBias, GyroBias, ImuScale, Velocity
from ekfslam.models.build import model_of
from ekfslam.models.process.inertial import inertial
from ekfslam.models.sensors.stereo import Rig

NOISE = Noise(np.full(6, 0.1), np.full(4, 1.0))
DENSITIES = InertialNoise(1.7e-4, 2e-3, 1.9e-5, 3e-3)
G = np.array([0.0, 0.0, -9.81])
U, BIAS = np.array([0.8, -0.5, 0.3]), 0.05 * np.arange(6)


@functools.cache
def model():
    blocks = (Velocity(), GyroBias(), AccelBias())
    make = inertial(DENSITIES)
    return model_of(Rig(CAMERA, T_CAM_IMU, NOISE), NOISE, np.eye(4), np.eye(6), None, blocks, make_process=make)


def wave(time_s):
    """Angular rates and specific forces (n, 6) of a lively motion."""
    phase = np.outer(time_s, np.arange(3.0, 9.0)) + np.arange(6)
    return np.sin(phase) * [1.0, 1.5, 0.8, 2.0, 3.0, 1.0] + [0.1, 0.2, 0.0, 0.0, 1.0, 9.5]


def samples(rate_hz=200.0, end_s=1.0):
    time_s = np.arange(-1.5 / rate_hz, end_s + 2.0 / rate_hz, 1.0 / rate_hz)
    found = wave(time_s)
    return InertialSamples(time_s, found[:, :3], found[:, 3:], DENSITIES)


INTERVAL = samples().interval(0.2013, 0.3021)
ALL = Intervals(
    np.full(2, INTERVAL.tau_s),
    np.zeros(2, dtype=bool),
    np.array([0, 12, 21]),
    *(
        np.concatenate([a, b])
        for a, b in ((INTERVAL.dt_s[:12], INTERVAL.dt_s[12:]), (INTERVAL.inputs[:12], INTERVAL.inputs[12:]))
    ),
)


DENSITY = np.repeat([DENSITIES.gyro, DENSITIES.accel, 0.0, DENSITIES.gyro_walk, DENSITIES.accel_walk], 3)


def pieces(which=slice(None)):
    inputs = INTERVAL.inputs[which] - BIAS
    return increments(INTERVAL.dt_s[which], inputs[:, :3], inputs[:, 3:], DENSITY)


def values(T, u=U):
    return {"view": T, "previous_view": T, "pose": T, "velocity": u, "gyro_bias": BIAS[:3], "accel_bias": BIAS[3:]}


def moved(before, x, columns):
    wide = np.zeros(model().layout.body)
    wide[columns] = x
    return model().retract(before, wide)


def error_of(after, reference):
    """Own errors (15,) of one state as seen from another."""
    others = [after[name] - reference[name] for name in ("velocity", "gyro_bias", "accel_bias")]
    return np.concatenate([se3.log(after["pose"] @ se3.inverse(reference["pose"])), *others])


def navigation(F):
    return F[:9, model().process.columns[:9]]


@pytest.mark.parametrize("phi", [0.0, 1e-9, 1e-4, 1e-3, 0.3, 1.4, 1.5, 3.1])
def test_gammas_equal_their_series(phi):
    axis = np.array([0.6, -0.48, 0.64])
    W, found = se3.skew(phi * axis), gammas(phi * axis)
    for n in range(3):
        expected, term = np.zeros((3, 3)), np.eye(3) / np.prod(np.arange(1.0, n + 1))
        for k in range(1, 40):
            expected, term = expected + term, term @ W / (k + n)
        np.testing.assert_allclose(found[n], expected, rtol=0, atol=2e-15)


@pytest.mark.parametrize("T", POSES.values(), ids=POSES)
def test_the_transition_equals_central_differences(T):
    before, process, own = values(T), model().process, model().process.columns
    step = process.step(before, INTERVAL, T, False)

    def after(x):
        return error_of(process.step(moved(before, x, own), INTERVAL, T, False).values, step.values)

    scale = max(1.0, np.linalg.norm(T[:3, 3]))
    np.testing.assert_allclose(step.Phi[:, own], central(after, 15), atol=1e-8 * scale)


def right_invariant(T_0, T_1, tau_s):
    """F (9, 9) by the transition of right-invariant errors, which depends on neither state nor samples."""

    def to_world(T):
        L, R = np.zeros((9, 9)), T[:3, :3].T
        L[:3, :3] = L[3:6, 3:6] = -R
        L[:3, 3:6], L[6:, 6:] = -se3.skew(-R @ T[:3, 3]) @ R, R
        return L

    Phi = np.eye(9)
    Phi[:3, 6:], Phi[:3, 3:6], Phi[6:, 3:6] = tau_s * np.eye(3), tau_s**2 / 2 * se3.skew(G), tau_s * se3.skew(G)
    return np.linalg.solve(to_world(T_1), Phi @ to_world(T_0))


@pytest.mark.parametrize("first_estimates", [False, True])
@pytest.mark.parametrize("T", [POSES["identity"], POSES["random 0"], POSES["near pi 0"]])
def test_the_transition_is_that_of_right_invariant_errors(T, first_estimates):
    T_linear = se3.exp(np.full(6, 0.02)) @ T
    step = model().process.step(values(T), INTERVAL, T_linear, first_estimates)
    expected = right_invariant(T_linear if first_estimates else T, step.values["pose"], INTERVAL.tau_s)
    scale = max(1.0, np.abs(expected).max())
    np.testing.assert_allclose(navigation(step.Phi), expected, atol=1e-14 * scale)


@pytest.mark.parametrize("first_estimates", [False, True])
def test_position_and_turns_about_gravity_stay_unobservable(first_estimates):
    T = POSES["random 1"]
    T_linear = se3.exp(np.full(6, 0.02)) @ T

    def directions(T):
        world = np.zeros((6, 4))
        world[:3, :3], world[5, 3] = np.eye(3), -1.0
        return np.vstack([gauge_directions(T, np.empty((0, 3))) @ world, np.zeros((9, 4))])

    step = model().process.step(values(T), INTERVAL, T_linear, first_estimates)
    before = directions(T_linear if first_estimates else T)
    found = step.Phi[:, model().process.columns] @ before
    np.testing.assert_allclose(found, directions(step.values["pose"]), atol=2e-14 * np.abs(found).max())


def divided(interval, parts):
    return dataclasses.replace(
        interval, dt_s=np.repeat(interval.dt_s / parts, parts), inputs=np.repeat(interval.inputs, parts, axis=0)
    )


def test_the_step_is_exact_for_constant_pieces():
    before, process = values(POSES["random 2"]), model().process
    found = process.step(before, INTERVAL, before["pose"], False)
    fine = process.step(before, divided(INTERVAL, 50), before["pose"], False)
    np.testing.assert_allclose(error_of(found.values, fine.values), 0.0, atol=1e-13)
    np.testing.assert_allclose(found.Q, fine.Q, rtol=0, atol=1e-12 * np.abs(fine.Q).max())


def test_noise_equals_that_of_euler_steps():
    """Left-invariant errors by 4000 Euler steps a piece converge to Q at first order."""
    piece = pieces(slice(3, 4))
    w, f = INTERVAL.inputs[3, :3] - BIAS[:3], INTERVAL.inputs[3, 3:] - BIAS[3:]
    A, at = np.zeros((15, 15)), [slice(3 * i, 3 * i + 3) for i in range(5)]
    A[at[0], at[0]] = A[at[1], at[1]] = A[at[2], at[2]] = -se3.skew(w)
    A[at[1], at[0]], A[at[2], at[1]], A[at[0], at[3]], A[at[1], at[4]] = -se3.skew(f), np.eye(3), -np.eye(3), -np.eye(3)
    Q, dt = np.zeros((15, 15)), INTERVAL.dt_s[3] / 4000
    for _ in range(4000):
        Q = Q + dt * (A @ Q + Q @ A.T + np.diag(DENSITY**2))
    std = np.sqrt(np.diag(Q))
    assert np.abs((piece.Q[0] - Q) / np.outer(std, std)).max() < 1e-3


def test_the_tree_of_increments_equals_the_loop():
    parts = pieces()
    for n in (1, 2, 3, 8, len(parts.tau_s)):
        whole = parts[0]
        for k in range(1, n):
            whole = whole.then(parts[k])
        for name, value in vars(parts[:n].total()).items():
            expected = getattr(whole, name)
            np.testing.assert_allclose(
                value, expected, rtol=0, atol=1e-14 * max(np.abs(expected).max(), 1e-30), err_msg=name
            )


def test_noise_has_full_rank_after_one_sample():
    parts = pieces()
    std = np.sqrt(np.diagonal(parts.Q[2]))
    assert np.linalg.cond(parts.Q[2] / np.outer(std, std)) < 100


def test_noise_grows_in_a_gap():
    lost = samples()
    keep = (lost.time_s < 0.23) | (lost.time_s > 0.26)
    gapped = dataclasses.replace(
        lost, time_s=lost.time_s[keep], gyro_rad_s=lost.gyro_rad_s[keep], accel_m_s2=lost.accel_m_s2[keep]
    )
    interval, T = gapped.interval(0.2013, 0.3021), np.eye(4)
    assert interval.is_gap and not INTERVAL.is_gap and not gapped.interval(0.3021, 0.4).is_gap
    found, usual = (model().process.step(values(T), some, T, False).Q for some in (interval, INTERVAL))
    assert np.sqrt(found[3, 3] / usual[3, 3]) > 5.0


def test_samples_are_means_between_stamps_and_linear_to_the_ends():
    line = InertialSamples(np.arange(6.0), np.outer(np.arange(6.0), np.ones(3)), np.zeros((6, 3)))
    found = line.interval(0.5, 2.25)
    np.testing.assert_allclose(found.dt_s, [0.5, 1.0, 0.25])
    np.testing.assert_allclose(found.inputs[:, 0], [0.75, 1.5, 2.125])


def test_an_interval_without_samples_is_refused():
    with pytest.raises(LostDataError, match="no samples from 3"):
        samples().interval(3.0, 3.1)


def test_midpoints_drift_less_than_held_samples():
    """Integration over 1 s at 200 Hz against 6400 Hz."""

    def position(rate_hz, hold=False):
        interval = samples(rate_hz).interval(0.0, 1.0)
        if hold:
            time_s = np.concatenate([[0.0], np.cumsum(interval.dt_s)[:-1]])
            interval = dataclasses.replace(interval, inputs=wave(time_s))
        return model().process.step(values(np.eye(4)), interval, np.eye(4), False).values["pose"][:3, 3]

    exact = position(6400.0)
    assert np.linalg.norm(position(200.0) - exact) < 2e-4 < 2e-3 < np.linalg.norm(position(200.0, hold=True) - exact)


def states(seed):
    rng = np.random.default_rng(seed)
    drawn = [moved(values(POSES["random 3"]), 0.1 * rng.normal(size=15), model().process.columns) for _ in range(2)]
    return {name: np.array([some[name] for some in drawn]) for name in drawn[0]}


def test_residual_derivatives_equal_central_differences():
    process, own, before, after = model().process, model().process.columns, states(0), states(1)
    found = process.residual(before, after, ALL)
    by_before = central(lambda x: process.residual(moved(before, x, own), after, ALL).error.ravel(), 15)
    by_after = central(lambda x: process.residual(before, moved(after, x, own), ALL).error.ravel(), 15)
    np.testing.assert_allclose(found.by_before[..., own].reshape(-1, 15), by_before, atol=1e-7)
    np.testing.assert_allclose(found.by_after[..., own].reshape(-1, 15), by_after, atol=1e-7)


def test_the_residual_of_a_step_is_zero_and_has_its_transition():
    process, before = model().process, states(2)
    step = process.step(before, ALL, before["pose"], False)
    found = process.residual(before, {**before, **step.values}, ALL)
    np.testing.assert_allclose(found.error, 0.0, atol=1e-12)
    np.testing.assert_allclose(found.by_before, -step.Phi, atol=1e-12)


def test_the_way_is_driven_at_the_speed_before_the_interval():
    found = model().process.way_m(values(np.eye(4)), INTERVAL)
    assert found == pytest.approx(np.linalg.norm(U) * (0.3021 - 0.2013))


def test_the_rate_at_the_image_is_that_of_the_samples_there():
    before = values(np.eye(4))
    found = model().process.imu_twist(before, before, INTERVAL)
    np.testing.assert_allclose(found[:3], U)
    np.testing.assert_allclose(found[3:], wave(np.array([0.3021]))[0, :3] - BIAS[:3], atol=2e-4)


SCALE = 0.02 * np.random.default_rng(3).normal(size=15)


@functools.cache
def scaled_process():
    blocks = (Velocity(), GyroBias(), AccelBias(), ImuScale())
    rig = Rig(CAMERA, T_CAM_IMU, NOISE)
    return model_of(rig, NOISE, np.eye(4), np.eye(6), None, blocks, make_process=inertial(DENSITIES)).process


@pytest.mark.parametrize("T", [POSES["random 1"], POSES["near pi 2"]])
def test_a_step_with_matrices_of_the_unit_has_the_derivative_of_central_differences(T):
    process = scaled_process()
    step = process.step({**values(T), "imu_scale": SCALE}, INTERVAL, T, False)

    def after(x):
        found = process.step({**values(T), "imu_scale": SCALE + x}, INTERVAL, T, False)
        return np.concatenate([error_of(found.values, step.values), found.imu_twist])

    by = central(after, 15)
    np.testing.assert_allclose(step.Phi[:, process.layout["imu_scale"]], by[:15], atol=1e-8 * 20)
    assert np.linalg.norm(by[18:, :9]) > 1.0  # the rate at the image is that of the corrected samples


def test_a_step_with_matrices_of_the_unit_is_one_of_corrected_samples():
    D_g, D_a = SCALE[:9].reshape(3, 3), np.zeros((3, 3))
    D_a[np.tril_indices(3)] = SCALE[9:]
    corrected = np.hstack([INTERVAL.inputs[:, :3] @ (np.eye(3) + D_g).T, INTERVAL.inputs[:, 3:] @ (np.eye(3) + D_a).T])
    T = POSES["random 0"]
    found = scaled_process().step({**values(T), "imu_scale": SCALE}, INTERVAL, T, False)
    expected = model().process.step(values(T), dataclasses.replace(INTERVAL, inputs=corrected), T, False)
    for name, value in expected.values.items():
        np.testing.assert_allclose(found.values[name], value, atol=1e-12)
    np.testing.assert_allclose(found.imu_twist, expected.imu_twist, atol=1e-12)


def test_the_residual_with_matrices_of_the_unit_has_the_derivative_of_central_differences():
    process, before, after = scaled_process(), states(0), states(1)

    def error(x):
        matrices = np.broadcast_to(SCALE + x, (2, 15))
        return process.residual(before, {**after, "imu_scale": matrices}, ALL).error.ravel()

    found = process.residual(before, {**after, "imu_scale": np.broadcast_to(SCALE, (2, 15))}, ALL)
    by_scale = found.by_after[..., process.layout["imu_scale"]].reshape(-1, 15)
    np.testing.assert_allclose(by_scale, central(error, 15), atol=1e-7)
