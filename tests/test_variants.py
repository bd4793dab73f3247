"""The linearisation variants: what each gains along the directions that nothing observes, and the iterated update."""

import copy
import dataclasses

import numpy as np
import pytest
import scipy.optimize
from support.gauge import P0, drive, exact_motion, gauge_directions
from support.jacobians import POSES, central, measurement_jacobian, visible_points
from support.reference import small_world, stereo_matrix

from ekfslam.config import Config, FilterConfig
from ekfslam.errors import ConfigError
from ekfslam.filters.variants import VARIANTS
from ekfslam.geometry import se3

OPEN = FilterConfig(landmark_coordinates="xyz", gate_probability=1.0, split_after=0, retire="never", engine="reference")


def gauge_ratio(ekf, T_start, P0):
    """Eigenvalues of the information along the gauge directions, over those of the prior: 1 where none was gained."""
    T, m = ekf.linear_T_imu_world, ekf.linear_positions_m
    N = gauge_directions(T, m)
    now = N.T @ np.linalg.solve(ekf.P, N)
    prior = se3.adjoint(T_start).T @ np.linalg.solve(P0, se3.adjoint(T_start))
    return np.sort(np.linalg.eigvals(np.linalg.solve(prior, now)).real)


@pytest.mark.parametrize("retire", ["never", "unseen"])
@pytest.mark.parametrize(("variant", "iterations"), [("invariant", 1), ("invariant", 3), ("fej", 1)])
def test_consistent_variants_gain_no_information_about_the_gauge(variant, iterations, retire):
    world = exact_motion(small_world(seed=4, frames=60))
    ekf = drive(world, dataclasses.replace(OPEN, variant=variant, iterations=iterations, retire=retire))
    ratio = gauge_ratio(ekf, se3.inverse(world.initial_T_world_imu), P0)
    np.testing.assert_allclose(ratio, 1.0, atol=1e-6)
    if retire == "unseen":
        assert ekf.counts["retired"] > 10


def test_the_standard_variant_does():
    world = exact_motion(small_world(seed=4, frames=60))
    ekf = drive(world, dataclasses.replace(OPEN, variant="standard"))
    assert gauge_ratio(ekf, se3.inverse(world.initial_T_world_imu), P0).max() > 1e3


@pytest.mark.parametrize("variant", ["invariant", "fej"])
def test_gauge_directions_are_unobserved_by_every_row(variant):
    world = small_world(seed=4)
    ekf = drive(world, dataclasses.replace(OPEN, variant=variant), frames=12)
    ekf.predict(world.twist[12], 0.1)
    m = ekf.linear_positions_m
    H = measurement_jacobian(ekf, ekf.ids)
    N = gauge_directions(ekf.T_imu_world, m)
    assert np.abs(H @ N).max() < 1e-9 * np.abs(H.toarray()).max() * np.abs(N).max()


def relative(ekf):
    """What the gauge cannot change: the landmarks in the frame of the IMU."""
    return se3.apply(ekf.T_imu_world, ekf.positions_m)


@pytest.mark.parametrize("retire", ["never", "unseen"])
@pytest.mark.parametrize(("variant", "iterations"), [("invariant", 1), ("invariant", 3), ("fej", 1), ("standard", 1)])
def test_invariance_to_the_prior_of_the_gauge(variant, iterations, retire):
    """How well the world's place and heading are known must not change what is estimated relative to the rig."""
    world = small_world(seed=6, frames=40)
    config = dataclasses.replace(OPEN, variant=variant, iterations=iterations, retire=retire)
    known, vague = (drive(world, config, scale * P0) for scale in (1e-4, 1.0))
    difference = np.abs(relative(known) - relative(vague)).max()
    assert difference > 1e-4 if variant == "standard" else difference < 1e-8


def posterior_cost(world, ekf, frame):
    """Negative log posterior of one update as a function of the stored correction, from scratch."""
    variant, camera = ekf.variant, world.camera
    ids, pixels = world.observations.at(frame)
    known = np.isin(ids, ekf.ids)
    ids, pixels = ids[known], pixels[known]
    at = [ekf.ids.tolist().index(i) for i in ids]
    root = np.linalg.inv(np.linalg.cholesky(ekf.P))
    T0, m0 = ekf.T_imu_world, ekf.positions_m

    def residuals(correction):
        T, m = retract(variant, T0, m0, correction[:6], correction[6:].reshape(-1, 3))
        q = np.column_stack([se3.apply(world.T_cam_imu @ T, m[at]), np.ones(len(at))])
        predicted = (q / q[:, 2:3]) @ stereo_matrix(camera).T
        return np.concatenate([root @ correction, ((pixels - predicted) / world.noise.pixel_std_px).ravel()])

    return residuals, ids, pixels


def retract(variant, T, m, xi, d):
    """Pose and landmarks after a correction."""
    return se3.exp(xi) @ T, variant.retract_landmarks(m, -T[:3, :3].T @ xi[3:], d)


def updated(ekf, ids, pixels, iterations):
    """A copy of a filter after one update with so many iterations."""
    again = copy.deepcopy(ekf)
    again.config = dataclasses.replace(ekf.config, iterations=iterations)
    again.update(10, ids, pixels)
    return again


def before_a_large_update(variant):
    """A filter whose prediction is some 50 pixels off, the frame it is to see next, and that frame's posterior."""
    world = small_world(seed=12, sigma_v=2.0, sigma_w=0.4)
    ekf = drive(world, dataclasses.replace(OPEN, variant=variant), 1e-2 * P0, frames=10)
    ekf.predict(world.twist[10], world.time_s[10] - world.time_s[9])
    return ekf, *posterior_cost(world, ekf, 10)


def test_iterated_standard_update_reaches_the_maximum_of_the_posterior():
    ekf, residuals, ids, pixels = before_a_large_update("standard")
    start = np.zeros(len(ekf.P))
    best = scipy.optimize.least_squares(residuals, start, xtol=1e-14, ftol=1e-14, gtol=1e-14, jac="3-point")
    T_best, m_best = retract(ekf.variant, ekf.T_imu_world, ekf.positions_m, best.x[:6], best.x[6:].reshape(-1, 3))

    def distance(iterations):
        after = updated(ekf, ids, pixels, iterations)
        return max(np.abs(after.T_imu_world - T_best).max(), np.abs(after.positions_m - m_best).max())

    assert distance(1) > 1e-2
    assert distance(20) < 1e-6


def test_iterated_invariant_update_converges_to_a_better_fit():
    """It solves ``e = K(X) (r(X) + H(X) e)``: that respects the gauge, while the exact maximum does not."""
    ekf, _, ids, pixels = before_a_large_update("invariant")
    once, often, oftener = (updated(ekf, ids, pixels, iterations) for iterations in (1, 30, 31))
    np.testing.assert_allclose(often.T_imu_world, oftener.T_imu_world, atol=1e-9)
    assert np.abs(once.T_imu_world - oftener.T_imu_world).max() > 1e-4

    def misfit(after):
        q = se3.apply(ekf.sensor.T_cam_imu @ after.T_imu_world, after.positions_m)
        at = [after.ids.tolist().index(i) for i in ids]
        return np.sum((ekf.sensor.rows(pixels) - ekf.sensor.predict(q)[at]) ** 2)

    assert misfit(oftener) < 0.9 * misfit(once)


def derivatives(variant, T, T_after, m, m_after):
    """How pose and landmark errors before a correction become those after it: by pose, and of landmarks by rotation."""
    change = variant.change(T, np.eye(6), np.arange(len(m)), m_after - m)
    by_pose = np.zeros((len(m), 3, 6))
    by_pose[..., change.columns] = change.B
    assert change.M is None and not by_pose[..., :3].any()
    return variant.derivative(T, T_after), by_pose[..., 3:]


@pytest.mark.parametrize("T", POSES.values(), ids=POSES.keys())
def test_derivative_of_the_standard_retraction(T):
    variant, rng = VARIANTS["standard"], np.random.default_rng(5)
    m = visible_points(T, 4)
    at = rng.normal(size=18) * 0.3
    T_at, m_at = retract(variant, T, m, at[:6], at[6:].reshape(-1, 3))

    def moved(h):
        T_h, m_h = retract(variant, T, m, at[:6] + h[:6], (at + h)[6:].reshape(-1, 3))
        return np.concatenate([se3.log(T_h @ se3.inverse(T_at)), (m_h - m_at).ravel()])

    numeric = central(moved, 18)
    by_pose, by_rotation = derivatives(variant, T, T_at, m, m_at)
    np.testing.assert_allclose(numeric[:6, :6], by_pose, rtol=1e-6, atol=1e-6)
    for i in range(4):
        own = slice(6 + 3 * i, 9 + 3 * i)
        np.testing.assert_allclose(numeric[own, 3:6], by_rotation[i], atol=1e-6)
        np.testing.assert_allclose(numeric[own, own], np.eye(3), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("T", POSES.values(), ids=POSES.keys())
def test_invariant_derivative_carries_the_gauge_directions_along(T):
    variant, rng = VARIANTS["invariant"], np.random.default_rng(5)
    m = visible_points(T, 4)
    xi, d = rng.normal(size=6) * 0.3, rng.normal(size=(4, 3)) * 0.3
    T_after, m_after = retract(variant, T, m, xi, d)
    by_pose, by_rotation = derivatives(variant, T, T_after, m, m_after)
    before, after = gauge_directions(T, m), gauge_directions(T_after, m_after)
    np.testing.assert_allclose(by_pose @ before[:6], after[:6], atol=1e-9)
    carried = by_rotation @ before[3:6] + before[6:].reshape(4, 3, 6)
    np.testing.assert_allclose(carried, after[6:].reshape(4, 3, 6), atol=1e-9)


@pytest.mark.parametrize("iterations", [1, 3])
def test_a_frame_whose_every_landmark_is_rejected_changes_nothing(iterations):
    """Landmarks that pass the gate one by one but contradict each other: all go, and P is what it was."""
    world = small_world(seed=10, sigma_v=1.0, sigma_w=0.15)
    config = dataclasses.replace(OPEN, gate_probability=0.999, iterations=iterations)
    ekf = drive(world, config, 1e-2 * P0, frames=6)
    ekf.predict(world.twist[6], world.time_s[6] - world.time_s[5])
    before = ekf.T_imu_world.copy(), ekf.P.copy()
    ids, pixels = world.observations.at(6)
    some = np.flatnonzero(np.isin(ids, ekf.ids))[:6]
    apart = pixels[some] + 8.0 * np.array([[1, 1, 1, 1], [1, -1, 1, -1], [-1, 1, -1, 1]] * 2)
    report = ekf.update(6, ids[some], apart)
    assert (report.reason != -1).all()
    assert report.dof == 0
    np.testing.assert_allclose(ekf.T_imu_world, before[0], atol=1e-9)
    np.testing.assert_allclose(ekf.P, before[1], atol=1e-9)


def test_iterating_first_estimates_is_refused():
    with pytest.raises(ConfigError, match="first estimates"):
        Config().with_overrides({"filter": {"variant": "fej", "iterations": 2}})
