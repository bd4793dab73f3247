"""Every Jacobian against central differences through the retraction.

States: random, near the identity, and near half turns; extrinsics far from trivial; several landmarks at once.
"""

import numpy as np
import pytest
from support.jacobians import POSES, RNG, TWISTS, central, visible_points
from support.reference import CAMERA, T_CAM_IMU, jacobian_of_pi, small_world, stereo_matrix, triangulate_least_squares

from ekfslam.data.sequence import Noise
from ekfslam.filters.gaussian import Gaussian
from ekfslam.filters.variants import VARIANTS
from ekfslam.geometry import camera as cam
from ekfslam.geometry import motion, se3
from ekfslam.models.build import model_of
from ekfslam.models.observation import initialise, linearise
from ekfslam.models.sensors.stereo import Rig

poses = pytest.mark.parametrize("T", POSES.values(), ids=POSES.keys())
RIG = Rig(CAMERA, T_CAM_IMU, Noise(np.full(6, 0.1), np.array([0.7, 0.9, 1.1, 1.3])))


def from_one_sight(rig, T, z):
    return initialise(rig, T, z, rig.variance(z), T)


def retract_invariant(T, m, xi, d):
    return se3.exp(xi) @ T, VARIANTS["invariant"].retract_landmarks(m, -T[:3, :3].T @ xi[3:], d)


def transport_invariant(P, T, T_after, moved):
    """P (b+3n, b+3n) carried along by a correction that moves landmarks by ``moved`` (n, 3)."""
    model = model_of(RIG, RIG.noise, T, np.eye(6), coordinates="xyz")
    gaussian = Gaussian(np.eye(6), 6)
    gaussian.replace(P.copy())
    variant, before = VARIANTS["invariant"], {"pose": T}
    change = variant.change(T, np.eye(6), np.arange(len(moved)), moved)
    variant.transport(gaussian, model, before, {"pose": T_after}, [change])
    return gaussian.P


def rows(T_imu_world, m):
    return cam.project(CAMERA, se3.apply(T_CAM_IMU @ T_imu_world, m))[:, :3].ravel()


def test_projection_is_the_report_s():
    q = RNG.uniform([-3, -2, 1], [3, 2, 30], (20, 3))
    M = stereo_matrix(CAMERA)
    for point, z in zip(q, cam.project(CAMERA, q), strict=True):
        rounding = 1e-14 * np.abs(M) @ np.abs(np.append(point, 1)) / point[2]  # of the terms: their sum may cancel
        assert np.all(np.abs(z - M @ np.append(point, 1) / point[2]) <= rounding)


def test_projection_jacobian():
    q = RNG.uniform([-3, -2, 1], [3, 2, 30], (20, 3))
    for point, J in zip(q, cam.projection_jacobian(CAMERA, q), strict=True):
        numeric = central(lambda d, p=point: cam.project(CAMERA, p + d), 3)
        np.testing.assert_allclose(J, numeric, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(J, (stereo_matrix(CAMERA) @ jacobian_of_pi(np.append(point, 1)))[:, :3], rtol=1e-13)


@poses
def test_measurement_jacobians_by_pose_and_landmark(T):
    m = visible_points(T)
    _, H_x, H_m = linearise(RIG, T, m, T, m)
    by_pose = central(lambda xi: rows(se3.exp(xi) @ T, m), 6)
    np.testing.assert_allclose(H_x.reshape(-1, 6), by_pose, rtol=1e-5, atol=1e-4)
    for i in range(len(m)):
        by_landmark = central(lambda d, i=i: rows(T, m[i : i + 1] + d), 3)
        np.testing.assert_allclose(H_m[i], by_landmark, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("twist", TWISTS)
@poses
def test_motion_jacobian_and_noise(T, twist):
    tau = 0.1
    E = motion.increment(twist, tau)
    by_pose = central(lambda xi: se3.log(E @ se3.exp(xi) @ T @ se3.inverse(E @ T)), 6)
    np.testing.assert_allclose(motion.error_jacobian(E), by_pose, rtol=1e-6, atol=2e-6)
    # The true velocity is the measured one less the noise; only the outer product shows in Q.
    by_noise = central(lambda n: se3.log(motion.increment(twist - n, tau) @ T @ se3.inverse(E @ T)), 6)
    std = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    Q = motion.process_noise(twist, tau, std)
    np.testing.assert_allclose(Q, by_noise @ np.diag(std**2) @ by_noise.T, rtol=1e-5, atol=1e-8)


@poses
def test_new_landmarks(T):
    """Position, its derivative by the pose, and its covariance, of several first sightings at once."""
    m = visible_points(T)
    pixels = cam.project(CAMERA, se3.apply(T_CAM_IMU @ T, m)) + RNG.normal(size=(len(m), 4)) * [0.5, 0.1, 0.5, 0.1]
    z = RIG.rows(pixels)
    position, G, covariance = from_one_sight(RIG, T, z)
    by_pose = central(lambda xi: from_one_sight(RIG, se3.exp(xi) @ T, z)[0].ravel(), 6)
    np.testing.assert_allclose(G.reshape(-1, 6), by_pose, rtol=1e-6, atol=1e-6)
    for i in range(len(m)):
        by_pixel = central(lambda d, i=i: from_one_sight(RIG, T, z[i : i + 1] + d)[0][0], 3)
        expected = by_pixel @ np.diag(RIG.variance_px2) @ by_pixel.T
        np.testing.assert_allclose(covariance[i], expected, rtol=1e-5, atol=1e-9)
    reprojected = cam.project(CAMERA, se3.apply(T_CAM_IMU @ T, position))[:, :3]
    np.testing.assert_allclose(reprojected, z, atol=1e-6)


def test_three_rectified_rows_carry_what_four_pixels_carry():
    std = np.array([0.7, 0.9, 1.1, 1.3])
    q = RNG.uniform([-3, -2, 2], [3, 2, 30], (10, 3))
    _, variance = cam.rectified_rows(np.zeros(4), std)
    J4, J3 = cam.projection_jacobian(CAMERA, q), cam.rectified_jacobian(CAMERA, q)
    information_4 = np.swapaxes(J4, 1, 2) @ np.diag(std**-2) @ J4
    information_3 = np.swapaxes(J3, 1, 2) @ np.diag(1 / variance) @ J3
    np.testing.assert_allclose(information_3, information_4, rtol=1e-12)


def test_triangulation_is_the_least_squares_point():
    pixels = cam.project(CAMERA, np.array([[1.0, -0.5, 9.0]])) + np.array([0.3, 0.4, -0.2, -0.1])
    q, covariance = triangulate_least_squares(CAMERA, pixels[0], 0.9)
    z, _ = cam.rectified_rows(pixels, np.full(4, 0.9))
    found = cam.triangulate(CAMERA, z)
    np.testing.assert_allclose(found[0], q, rtol=1e-12)
    rig = Rig(CAMERA, np.eye(4), Noise(np.zeros(6), np.full(4, 0.9)))
    np.testing.assert_allclose(from_one_sight(rig, np.eye(4), z)[2][0], covariance, rtol=1e-10)


def invariant_retraction(T_imu_world, m, e):
    """``exp(e) X`` of the right-invariant error in world, e = [e_rho, e_theta, e_1, ...]."""
    R, J = se3.so3_exp(e[3:6]), se3.so3_left_jacobian(e[3:6])
    return T_imu_world @ se3.exp(-e[:6]), m @ R.T + e[6:].reshape(-1, 3) @ J.T


def stored_error(T_imu_world, m, T_hat, m_hat):
    return np.concatenate([se3.log(T_imu_world @ se3.inverse(T_hat)), (m - m_hat).ravel()])


@poses
def test_transport_of_the_covariance_keeps_the_invariant_error(T):
    """J of eq. (7) = L(X+) L(X)^-1, with L = d(stored error)/d(invariant error) by central differences."""
    m = visible_points(T, 4)
    size = 6 + m.size
    correction = RNG.normal(size=size) * 0.2
    T_plus, m_plus = retract_invariant(T, m, correction[:6], correction[6:].reshape(-1, 3))

    def L(T_hat, m_hat):
        return central(lambda e: stored_error(*invariant_retraction(T_hat, m_hat, e), T_hat, m_hat), size)

    J = L(T_plus, m_plus) @ np.linalg.inv(L(T, m))
    root = RNG.normal(size=(size, size))
    P = root @ root.T
    expected = J @ P @ J.T
    P = transport_invariant(P, T, T_plus, m_plus - m)
    np.testing.assert_allclose(P, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())
    np.testing.assert_array_equal(P, P.T)


@poses
def test_invariant_retraction_is_the_group_exponential_in_stored_coordinates(T):
    m = visible_points(T, 4)
    xi, d = RNG.normal(size=6) * 0.2, RNG.normal(size=(4, 3)) * 0.2
    e_pose = -se3.adjoint(se3.inverse(T)) @ xi
    e = d + np.cross(m, e_pose[3:])
    T_plus, m_plus = retract_invariant(T, m, xi, d)
    T_expected, m_expected = invariant_retraction(T, m, np.concatenate([e_pose, e.ravel()]))
    np.testing.assert_allclose(T_plus, T_expected, atol=1e-11)
    np.testing.assert_allclose(m_plus, m_expected, atol=1e-11)


def test_small_world_has_the_geometry_that_catches_wrong_blocks():
    world = small_world()
    ids, _ = world.observations.at(20)
    assert len(ids) >= 3
    assert world.observations.ids[0] not in ids
