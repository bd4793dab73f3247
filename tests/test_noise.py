"""Noise from the data, and the filter that lives with it: velocities in the state, drifting and moving tracks."""

import dataclasses

import numpy as np
import pytest
from reference import small_world
from test_jacobians import central
from test_variants import gauge_directions

from ekfslam.config import Config, FilterConfig, NoiseConfig
from ekfslam.data.readers import open_sequence, write_sequence
from ekfslam.data.sequence import Observations
from ekfslam.data.simulate import builtin
from ekfslam.errors import PosteriorError
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.observing import MOVING, Rig
from ekfslam.filters.result import REASONS
from ekfslam.geometry import motion, se3
from ekfslam.geometry.camera import project
from ekfslam.models.build import noise_of
from ekfslam.models.noise import MOTION_STD, automatic_noise, velocity_noise
from ekfslam.runner import run
from ekfslam.smoother.posterior import posterior, smooth
from ekfslam.smoother.problem import aged
from ekfslam.storage.archive import open_result, write_archive

OPEN = FilterConfig(gate_probability=1.0, split_after=0)
WALK = np.repeat([0.2, 0.02], 3)
P0 = np.diag([0.1, 0.2, 0.3, 0.01, 0.02, 0.03]) ** 2


def with_noise(sequence, **changes):
    return dataclasses.replace(sequence, noise=dataclasses.replace(sequence.noise, **changes))


def without_noise(sequence):
    return dataclasses.replace(sequence, noise=None)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("world", ["city", "loop"])
def test_velocity_noise_of_simulations_is_recovered(world, seed):
    sequence = builtin(f"{world}?seed={seed}&frames=1000")
    found = velocity_noise(sequence.twist)
    np.testing.assert_allclose(found.sigma, [0.5, 0.05], rtol=0.15)
    assert (np.abs(found.sigma - [0.5, 0.05]) < 5 * found.sigma_error + 0.02 * np.array([0.5, 0.05])).all()
    quiet = builtin(f"{world}?seed={seed}&frames=1000&sigma_v_m_s=0.01&sigma_w_rad_s=0.001")
    assert (velocity_noise(quiet.twist).sigma < [0.03, 0.003]).all()


@pytest.mark.data
def test_velocity_noise_of_the_recordings(data_path):
    noisy = velocity_noise(open_sequence(data_path("ece276a/0027_dense_noisy.npz")).twist)
    np.testing.assert_allclose(noisy.sigma, [0.5, 0.05], rtol=0.15)
    for name in ("ece276a/0027.npz", "ece276a/0042.npz", "utias/2011_10_03_drive_0042_sync_KLT.mat"):
        clean = velocity_noise(open_sequence(data_path(name)).twist)
        assert (clean.sigma < [0.05, 0.005]).all()


def test_automatic_noise_is_for_recordings_that_state_none():
    stated = builtin("city?frames=200")
    assert noise_of(stated, Config()).drift == 0
    unstated = without_noise(stated)
    found = noise_of(unstated, Config())
    assert found.drift > 0
    assert found.twist_walk_std is not None
    np.testing.assert_allclose(found.twist_std[[0, 3]], velocity_noise(stated.twist).sigma)
    # Whatever is given by hand is white, and so is everything on request.
    for config in (Config(noise=NoiseConfig(sigma_px=2.0)), Config(noise=NoiseConfig(model="white"))):
        assert noise_of(unstated, config).drift == 0
        assert noise_of(unstated, config).twist_walk_std is None
    # Velocities that are cleaner than what is there anyway are not filtered.
    still = automatic_noise(np.zeros((100, 6)))
    assert still.twist_walk_std is None
    np.testing.assert_array_equal(still.velocity_std, MOTION_STD)


def test_misalignment_is_the_covariance_of_turned_velocities():
    twist, tau = np.array([8.0, 0.3, -0.1, 0.02, -0.03, 0.4]), 0.1

    def pose_error(angles):
        turned = np.concatenate([se3.so3_exp(angles) @ twist[:3], se3.so3_exp(angles) @ twist[3:]])
        return se3.log(motion.increment(turned, tau) @ se3.inverse(motion.increment(twist, tau)))

    J = central(pose_error, 3)
    Q = motion.process_noise(twist, tau, np.zeros(6), 0.01)
    np.testing.assert_allclose(Q, 1e-4 * J @ J.T, atol=1e-10 * np.abs(Q).max() + 1e-14)


def test_twist_jacobian_against_central_differences():
    twist, tau = np.array([8.0, 0.3, -0.1, 0.02, -0.03, 0.4]), 0.13
    numeric = central(
        lambda d: se3.log(motion.increment(twist + d, tau) @ se3.inverse(motion.increment(twist, tau))), 6
    )
    np.testing.assert_allclose(-motion.twist_jacobian(twist, tau), numeric, atol=1e-8)


class NaiveTwistFilter:
    """The standard variant with velocities in the state, written out with full matrices and explicit inverses."""

    def __init__(self, ekf, sequence):
        self.T, self.P, self.u, self.noise = ekf.T_imu_world, ekf.P.copy(), None, sequence.noise
        self.m = np.empty((0, 3))

    def predict(self, measured, tau):
        n = 3 * len(self.m)
        if self.u is None:
            self.u = measured.copy()
            assert not self.P[6:12].any()
            self.P[6:12, 6:12] = np.diag(self.noise.twist_std**2)
        else:
            H = np.zeros((6, 12 + n))
            H[:, 6:12] = np.eye(6)
            self.P[6:12, 6:12] += np.diag(self.noise.twist_walk_std**2)
            K = self.P @ H.T @ np.linalg.inv(H @ self.P @ H.T + np.diag(self.noise.twist_std**2))
            x = K @ (measured - self.u)
            self.P = self.P - K @ H @ self.P
            self.T, self.u = se3.exp(x[:6]) @ self.T, self.u + x[6:12]
            self.m = self.m + x[12:].reshape(-1, 3)
        E = motion.increment(self.u, tau)
        F = np.eye(12 + n)
        F[:6, :6], F[:6, 6:12] = se3.adjoint(E), -motion.twist_jacobian(self.u, tau)
        self.P = F @ self.P @ F.T
        self.P[:6, :6] += motion.process_noise(self.u, tau, self.noise.motion_std, self.noise.misalignment_rad)
        self.T = E @ self.T
        step = self.noise.drift * self.T[:3, :3].T @ self.u[:3] * tau
        for j in range(len(self.m)):
            own = slice(12 + 3 * j, 15 + 3 * j)
            self.P[own, own] += np.outer(step, step)


def test_prediction_with_velocities_in_the_state_equals_the_naive_one():
    world = with_noise(
        small_world(), twist_walk_std=WALK, motion_std=np.full(6, 0.01), misalignment_rad=0.02, drift=0.3
    )
    config = dataclasses.replace(OPEN, variant="standard", retire="never", moving_sigma=1e9)
    ekf = JointEKF(Rig(world.camera, world.T_cam_imu, world.noise), config, world.initial_T_world_imu, P0)
    ekf.update(0, *world.observations.at(0))
    naive = NaiveTwistFilter(ekf, world)
    naive.m = ekf.positions_m.copy()
    assert len(naive.m) > 5
    for k in range(1, 15):
        tau = world.time_s[k] - world.time_s[k - 1]
        ekf.predict(world.twist[k], tau)
        naive.predict(world.twist[k], tau)
        np.testing.assert_allclose(ekf.P, naive.P, atol=1e-10)
        np.testing.assert_array_equal(ekf.P, ekf.P.T)
        np.testing.assert_allclose(ekf.twist, naive.u, atol=1e-12)
        np.testing.assert_allclose(ekf.positions_m, naive.m, atol=1e-12)
        np.testing.assert_allclose(ekf.T_imu_world, naive.T, atol=1e-12)
        # What vision does to the rest of the state is tested elsewhere; here both go on from there.
        ekf.update(k, *world.observations.at(k))
        naive.T, naive.u, naive.P, naive.m = ekf.T_imu_world, ekf.twist.copy(), ekf.P.copy(), ekf.positions_m.copy()


def test_transition_and_measurement_jacobians_know_of_the_velocities():
    world = with_noise(small_world(), twist_walk_std=WALK)
    ekf = JointEKF(Rig(world.camera, world.T_cam_imu, world.noise), OPEN, world.initial_T_world_imu, P0)
    for k in range(3):
        if k:
            ekf.predict(world.twist[k], 0.1)
        ekf.update(k, *world.observations.at(k))
    F = ekf.transition_jacobian(ekf.twist, 0.1).toarray()
    np.testing.assert_allclose(F[:6, 6:12], -motion.twist_jacobian(ekf.twist, 0.1))
    np.testing.assert_array_equal(F[6:], np.eye(len(F))[6:])
    N = gauge_directions(ekf.T_imu_world, ekf.positions_m)
    N = np.vstack([N[:6], np.zeros((6, 6)), N[6:]])
    H = ekf.measurement_jacobian(ekf.ids)
    assert np.abs(H @ N).max() < 1e-9 * np.abs(H.toarray()).max() * np.abs(N).max()


@pytest.mark.parametrize("variant", ["standard", "invariant", "fej"])
def test_velocities_that_walk_freely_are_white(variant):
    """A walk much larger than the noise says nothing about the next velocity: the state without them, once more."""
    world = small_world()
    free = with_noise(world, twist_walk_std=np.full(6, 1e4))
    config = Config(filter=dataclasses.replace(OPEN, variant=variant))
    a, b = run(world, "full", config), run(free, "full", config)
    np.testing.assert_allclose(b.T_world_imu, a.T_world_imu, atol=2e-3)
    np.testing.assert_allclose(b.covariance[-1], a.covariance[-1], rtol=2e-2, atol=1e-5)


def test_knowing_how_velocities_walk_helps_where_little_is_seen():
    error = {"white": [], "walk": []}
    for seed in range(6):
        world = builtin(f"city?frames=300&max_tracks=2&seed={seed}")
        for name, walk in (("white", None), ("walk", velocity_noise(world.twist).walk.repeat(3))):
            result = run(with_noise(world, twist_walk_std=walk), "full")
            position = result.T_world_imu[:, :3, 3] - world.truth.T_world_imu[:, :3, 3]
            error[name].append(np.sqrt((position**2).sum(axis=1).mean()))
            assert result.covariance.shape == (300, 6, 6)
    assert np.mean(error["walk"]) < 0.8 * np.mean(error["white"])


@pytest.mark.parametrize("variant", ["invariant", "fej"])
def test_no_information_about_the_gauge_comes_with_velocities_and_drift(variant):
    world = with_noise(
        small_world(seed=4),
        twist_std=np.full(6, 1e-2),
        twist_walk_std=np.full(6, 1e-2),
        drift=0.05,
        misalignment_rad=1e-3,
    )
    config = dataclasses.replace(OPEN, variant=variant, moving_sigma=1e9)
    ekf = JointEKF(Rig(world.camera, world.T_cam_imu, world.noise), config, world.initial_T_world_imu, P0)
    prior = se3.adjoint(ekf.T_imu_world).T @ np.linalg.solve(P0, se3.adjoint(ekf.T_imu_world))
    for k in range(len(world)):
        if k:
            ekf.predict(world.twist[k], world.time_s[k] - world.time_s[k - 1])
        ekf.update(k, *world.observations.at(k))
        T, m = (ekf._T_predicted, ekf._initial_m) if variant == "fej" else (ekf.T_imu_world, ekf.positions_m)
        if k == 0:
            continue  # nothing is known of the velocities, and P is singular
        N = gauge_directions(T, m)
        N = np.vstack([N[:6], np.zeros((6, 6)), N[6:]])
        ratio = np.linalg.eigvals(np.linalg.solve(prior, N.T @ np.linalg.solve(ekf.P, N))).real
        assert ratio.max() < 1 + 1e-6


def moving_world(share=0.3, speed=0.3):
    """A small world in which some landmarks travel along with the rig; also their ids."""
    world = small_world(frames=80, landmarks=120, sigma_v=0.02, sigma_w=0.002)
    rng = np.random.default_rng(1)
    observations, truth = world.observations, world.truth
    movers = rng.permutation(observations.ids)[: int(share * len(observations.ids))]
    pixels = observations.pixels_px.copy()
    place = dict(zip(truth.landmark.tolist(), truth.position_m, strict=True))
    first = {}
    for i, (k, j) in enumerate(zip(observations.frame.tolist(), observations.landmark.tolist(), strict=True)):
        if j in movers:
            k0 = first.setdefault(j, k)
            travelled = truth.T_world_imu[k, :3, 3] - truth.T_world_imu[k0, :3, 3]
            q = se3.apply(world.T_cam_imu @ se3.inverse(truth.T_world_imu[k]), place[j] + speed * travelled)
            camera = world.camera
            u, v = camera.fu_px * q[0] / q[2] + camera.cu_px, camera.fv_px * q[1] / q[2] + camera.cv_px
            right = u - camera.fu_px * camera.baseline_m / q[2]
            pixels[i] = np.array([u, v, right, v]) + 0.8 * rng.normal(size=4)
    moved = Observations(observations.frame, observations.landmark, pixels)
    return dataclasses.replace(world, observations=moved), movers


def test_tracks_that_travel_with_the_rig_are_found_and_listed():
    world, movers = moving_world()
    world = with_noise(world, drift=0.02, motion_std=np.repeat([0.02, 0.002], 3))
    rejections = (result := run(world, "full", Config(filter=FilterConfig()))).rejections
    accused = np.unique(rejections.landmark[rejections.reason == REASONS.index("moving")])
    assert result.counts["moving"] == len(accused) > 10
    assert np.isin(accused, movers).mean() > 0.85
    # Of what is seen long enough to be judged most are found so, and the others at the gate.
    seen = np.bincount(np.searchsorted(world.observations.ids, world.observations.landmark))
    long = np.intersect1d(movers, world.observations.ids[seen > 6])
    assert np.isin(long, accused).mean() > 0.5
    assert np.isin(long, rejections.landmark).mean() > 0.9


def test_moving_is_for_good_and_never_without_drift():
    world, _ = moving_world()
    assert run(world, "full").counts["moving"] == 0
    ekf = JointEKF(
        Rig(world.camera, world.T_cam_imu, dataclasses.replace(world.noise, drift=0.02)),
        FilterConfig(),
        world.initial_T_world_imu,
    )
    banned = set()
    for k in range(len(world)):
        if k:
            ekf.predict(world.twist[k], world.time_s[k] - world.time_s[k - 1])
        report = ekf.update(k, *world.observations.at(k))
        assert not banned & set(ekf.ids.tolist())
        banned |= set(report.ids[report.reason == MOVING].tolist())
    assert banned


def test_bearing_drift_widens_landmarks_with_distance_and_nothing_else():
    world = small_world(frames=12)
    drifting = with_noise(world, bearing_drift_rad=2e-3)
    rigid, drifts = (
        JointEKF(Rig(world.camera, world.T_cam_imu, w.noise), OPEN, world.initial_T_world_imu, P0)
        for w in (world, drifting)
    )
    for ekf in (rigid, drifts):
        ekf.update(0, *world.observations.at(0))
        ekf.predict(world.twist[1], 0.1)
    np.testing.assert_array_equal(drifts.T_imu_world, rigid.T_imu_world)
    distance = np.linalg.norm(se3.apply(rigid.T_imu_world, rigid.positions_m), axis=1)
    driven = 0.1 * np.linalg.norm(world.twist[1, :3])
    grown = np.zeros(len(rigid.P))
    grown[6:] = np.repeat(2e-3**2 * driven * distance**2, 3)
    np.testing.assert_allclose(drifts.P - rigid.P, np.diag(grown), atol=1e-14)
    assert drifts.sensor.noise.landmarks_walk


def test_bearing_drift_is_the_same_for_any_frame_rate():
    """Ten short steps widen a landmark as much as one long one: it is a walk over the distance."""
    world = with_noise(small_world(frames=12), bearing_drift_rad=2e-3, twist_std=np.zeros(6))
    found = []
    for steps in (1, 10):
        rig = Rig(world.camera, world.T_cam_imu, world.noise)
        ekf = JointEKF(rig, OPEN, world.initial_T_world_imu, P0)
        ekf.update(0, *world.observations.at(0))
        for _ in range(steps):
            ekf.predict(np.array([0.5, 0, 0, 0, 0, 0]), 0.1 / steps)
        found.append(np.diag(ekf.P)[6:])
    np.testing.assert_allclose(*found, rtol=1e-2)


def test_the_whole_noise_is_stored(tmp_path):
    world = without_noise(builtin("city?frames=60"))
    result = run(world, "full")
    write_archive(tmp_path / "a.h5", world, {"full": result})
    read = open_result(tmp_path / "a.h5", "full").noise
    for name, value in vars(result.noise).items():
        np.testing.assert_array_equal(getattr(read, name), value)
    stated = dataclasses.replace(world, noise=result.noise)
    write_sequence(stated, tmp_path / "s.h5")
    for name, value in vars(open_sequence(tmp_path / "s.h5").noise).items():
        np.testing.assert_array_equal(value, getattr(result.noise, name))


def test_the_posterior_of_what_walks_is_the_map_only():
    result = run(without_noise(builtin("city?frames=60")), "full")
    assert smooth(result).mode == "smoothed"
    with pytest.raises(PosteriorError, match="only the linearisation 'map'"):
        posterior(result, dataclasses.replace(Config().posterior, linearisation="filtered"))


def test_observations_are_worth_less_the_further_the_rig_has_driven_since_first_sight():
    world = with_noise(small_world(frames=15), drift=0.1, bearing_drift_rad=2e-3)
    rig = Rig(world.camera, world.T_cam_imu, world.noise)
    result = run(world, "full", Config(filter=dataclasses.replace(OPEN, moving_sigma=1e9)))
    log = result.log
    found = aged(log, rig)
    first = {}
    position = se3.inverse(log.T_updated)[:, :3, 3]
    grown = 0
    for i, (k, j) in enumerate(zip(log.frame.tolist(), log.landmark.tolist(), strict=True)):
        k0 = first.setdefault(j, k)
        moved = np.zeros((3, 3))
        for step in np.diff(position[k0 : k + 1], axis=0):
            along = 0.1 * step
            distance = np.linalg.norm(se3.apply(world.T_cam_imu @ log.T_updated[k], log.position_m[i]))
            across = (2e-3 * distance) ** 2 * np.linalg.norm(step)
            moved += np.outer(along, along) + across * np.eye(3)

        def seen(m, k=k):
            return project(world.camera, se3.apply(world.T_cam_imu @ log.T_updated[k], m))[:3]

        H = central(lambda d, i=i, seen=seen: seen(log.position_m[i] + d), 3)
        np.testing.assert_allclose(found.variance[i], log.variance[i] + np.diag(H @ moved @ H.T), rtol=1e-6)
        grown += k > k0
    assert grown > 50
    stays = dataclasses.replace(rig, noise=dataclasses.replace(world.noise, drift=0.0, bearing_drift_rad=0.0))
    assert aged(log, stays) is log


def test_a_margin_of_the_noise_is_not_allowed_to_single_tracks():
    world, _ = moving_world()
    plain, wide = (with_noise(world, drift=0.02, margin=margin) for margin in (1.0, 3.0))
    found = [
        run(part, "full", Config(filter=FilterConfig(moving_sigma=sigma))).rejections
        for part, sigma in ((plain, 3.0), (wide, 9.0), (wide, 3.0))
    ]
    np.testing.assert_array_equal(found[1].landmark, found[0].landmark)
    assert (found[2].reason == MOVING).sum() > (found[0].reason == MOVING).sum()
