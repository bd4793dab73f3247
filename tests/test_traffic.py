"""Tracks on traffic: found from whole tracks and noisy velocities together."""

import dataclasses

import numpy as np
import pytest
from support.helpers import synthetic_sequence, tracked
from support.reference import small_world

from ekfslam.config import Config
from ekfslam.data import traffic
from ekfslam.data.noise import TrackError
from ekfslam.data.sequence import Observations
from ekfslam.geometry import motion, se3
from ekfslam.geometry.camera import project
from ekfslam.runner import run

ERROR = TrackError(np.array([0.1, 0.1, 0.5]), np.array([0.15, 0.15, 0.1]), 30.0)
NOISY = {"twist_std": np.repeat([0.3, 0.01], 3), "twist_walk_std": np.repeat([0.1, 0.01], 3)}


def noise_of(world, **changes):
    # Hygiene takes errors as they add up in the long run: errors of tracks persist.
    tracks = {"track_first_px": ERROR.first_std, "track_walk_px": 3 * ERROR.walk_std, "track_flow_px": ERROR.flow_px}
    return dataclasses.replace(world.noise, **{**NOISY, **tracks, **changes})


def road(share, speed=0.2, seed=0, frames=60, landmarks=150):
    """A drive with noisy velocities on which a share of the landmarks travels along; also their ids."""
    world = synthetic_sequence(frames, landmarks, seed)
    ids = world.observations.ids
    movers = np.random.default_rng(seed).permutation(ids)[: int(share * len(ids))]
    world = tracked(world, ERROR, seed, movers, speed)
    return dataclasses.replace(world, noise=noise_of(world)), movers


def long(world, ids, least=6):
    """Return the ids with at least so many observations."""
    o = world.observations
    return ids[[(o.landmark == i).sum() >= least for i in ids]]


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.1, 0.3])
def test_tracks_that_travel_along_are_found_and_others_are_not(share):
    found, right, there = 0, 0, 0
    for seed in range(3):
        world, movers = road(share, seed=seed)
        accused = traffic.moving_tracks(world, world.observations, world.noise)
        found, right = found + len(accused), right + np.isin(accused, movers).sum()
        there += np.isin(long(world, movers), accused).mean() / 3
    assert right / found > 0.95
    assert there > 0.5


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.3, 0.6])
def test_velocities_decide_where_most_of_the_tracks_travel_along(speed):
    world, movers = road(0.6, speed)
    accused = traffic.moving_tracks(world, world.observations, world.noise)
    assert np.isin(accused, movers).mean() > 0.95
    assert np.isin(long(world, movers), accused).mean() > 0.9


@pytest.mark.slow
def test_nothing_moves_where_all_points_stand():
    for seed in range(3):
        world, _ = road(0.0, seed=seed)
        assert len(traffic.moving_tracks(world, world.observations, world.noise)) <= 0.02 * 150


def test_clean_velocities_and_white_pixels_leave_the_tracks_to_the_filter():
    world, _ = road(0.3)
    for changes in ({"twist_walk_std": None}, {"track_first_px": None, "track_walk_px": None}):
        assert not len(traffic.moving_tracks(world, world.observations, noise_of(world, **changes)))


def test_velocities_that_hardly_walk_are_smoothed_to_their_mean():
    world, _ = road(0.0, frames=21, landmarks=20)
    frames = np.arange(1, 21)
    prior = traffic.velocity_prior(world, frames, noise_of(world, twist_walk_std=np.zeros(6)))
    x = np.linalg.solve(prior.information.reshape(120, 120), prior.vector.ravel()).reshape(20, 6)
    twist = world.twist[frames]
    assert ((twist + x).std(axis=0) < 0.2 * twist.std(axis=0)).all()
    np.testing.assert_allclose(x.mean(axis=0), 0.0, atol=1e-9)


def test_derivatives_of_the_flow_are_those_of_its_residuals():
    world, _ = road(0.0, frames=12)
    o, at = world.observations, np.arange(12)
    flow = traffic.flow_of(world, o, ERROR)

    def residual(twist=world.twist, moved_m=0.0, sideways_m=0.0, disparity_px=0.0):
        """Residuals with other velocities, points that moved in the last interval, and an error of all disparities."""
        pixels = o.pixels_px - disparity_px * np.array([0.0, 0.0, 1.0, 0.0])
        seen = Observations(o.frame, o.landmark, pixels)
        return traffic.flow_of(world.with_velocities(twist), seen, ERROR).rows[..., 9]

    step = 1e-5
    for axis in range(6):
        by = step * np.eye(6)[axis]
        slope = (residual(world.twist - by) - residual(world.twist + by)) / (2 * step)
        np.testing.assert_allclose(flow.rows[..., axis], slope, rtol=1e-5, atol=1e-5 * np.abs(slope).max())
    slope = (residual(disparity_px=step) - residual(disparity_px=-step)) / (2 * step)
    # With the noise of the pixels in them, rows differ from the linearisation's by second order only.
    np.testing.assert_allclose(flow.rows[..., 8], slope, rtol=1e-4, atol=1e-4 * np.abs(slope).max())
    assert set(flow.frame) <= set(at)


def test_a_point_that_moves_leaves_its_velocity_times_the_derivative():
    world = small_world(frames=2, landmarks=60, sigma_v=0.0, sigma_w=0.0, sigma_px=0.0)
    tau_s, C = float(np.diff(world.time_s)[0]), world.T_cam_imu
    rng, o = np.random.default_rng(0), world.observations
    both = np.intersect1d(o.at(0)[0], o.at(1)[0])
    place = dict(zip(world.truth.landmark.tolist(), world.truth.position_m, strict=True))
    q = se3.apply(C @ se3.inverse(world.truth.T_world_imu[0]), np.array([place[i] for i in both.tolist()]))
    T = C @ motion.increment(world.twist[1], tau_s) @ se3.inverse(C)
    c = 1e-4 * rng.normal(size=(len(q), 2))
    after = se3.apply(T, q) + tau_s * np.column_stack([c[:, 1], np.zeros(len(c)), c[:, 0]])
    pixels = np.concatenate([project(world.camera, q), project(world.camera, after)])
    seen = Observations(np.repeat([0, 1], len(both)), np.tile(both, 2), pixels)
    flow = traffic.flow_of(world, seen, ERROR)
    np.testing.assert_array_equal(flow.track, both)
    expected = (flow.rows[..., 6:8] @ c[..., None])[..., 0]
    np.testing.assert_allclose(flow.rows[..., 9], expected, rtol=1e-4, atol=1e-3 * np.abs(expected).max())


def test_probabilities_equal_those_of_one_large_system():
    """Expectation propagation over all unknowns at once, without a Schur complement."""
    world, _ = road(0.3, frames=9, landmarks=30)
    flow, frames = traffic.flow_of(world, world.observations, ERROR), np.arange(1, 9)
    prior = traffic.velocity_prior(world, frames, world.noise)
    ids, m = np.unique(flow.track), len(frames)
    n, weight, moves = len(ids), np.ones(len(flow.track)), np.zeros(len(ids))
    J = np.zeros((len(flow.track), 3, 6 * m + 3 * n))
    for i, (frame, track) in enumerate(zip(flow.frame, flow.track, strict=True)):
        k, j = frame - 1, 6 * m + 3 * int(np.searchsorted(ids, track))
        J[i, :, 6 * k : 6 * k + 6], J[i, :, j : j + 3] = flow.rows[i, :, :6], flow.rows[i, :, 6:9]
    r, site, pull = flow.rows[..., 9], np.tile(1e-6 * np.eye(2), (n, 1, 1)), np.zeros((n, 2))
    for _ in range(8):
        N, b = np.einsum("kri,k,krj->ij", J, weight, J), np.einsum("kri,k,kr->i", J, weight, r)
        N[: 6 * m, : 6 * m] += prior.information.reshape(6 * m, 6 * m)
        b[: 6 * m] += prior.vector.ravel()
        places = [6 * m + 3 * j + np.arange(2) for j in range(n)]
        for j, at in enumerate(places):
            N[np.ix_(at, at)] += site[j]
            N[at[1] + 1, at[1] + 1] += 1 / ERROR.first_std[2] ** 2
            b[at] += pull[j]
        P, solved = np.linalg.inv(N), np.linalg.solve(N, b)
        free = solved.copy()
        for j, at in enumerate(places):
            marginal = np.linalg.inv(P[np.ix_(at, at)])
            information, vector = marginal - site[j], marginal @ solved[at] - pull[j]
            V = np.linalg.inv(information + 1e-6 * np.eye(2))
            c, density, mean, spread = V @ vector, [], [], []
            for std, share in ((0.1, 0.8), (15.0, 0.2)):
                S = V + std**2 * np.eye(2)
                density.append(share * np.exp(-0.5 * c @ np.linalg.solve(S, c)) / np.sqrt(np.linalg.det(S)))
                spread.append(np.linalg.inv(information + np.eye(2) / std**2))
                mean.append(spread[-1] @ vector)
            p = moves[j] = density[1] / sum(density)
            both, middle = (1 - p) * spread[0] + p * spread[1], (1 - p) * mean[0] + p * mean[1]
            both += (1 - p) * np.outer(mean[0] - middle, mean[0] - middle) + p * np.outer(
                mean[1] - middle, mean[1] - middle
            )
            found, found_pull = np.linalg.inv(both) - information, np.linalg.solve(both, middle) - vector
            if np.linalg.eigvalsh(found)[0] <= 0:
                found, found_pull = 1e-6 * np.eye(2), np.zeros(2)
            site[j], pull[j] = 0.5 * (site[j] + found), 0.5 * (pull[j] + found_pull)
            e = at[1] + 1
            free[e] -= N[e, at] @ (c - solved[at]) / N[e, e]
            free[at] = c
        weight = (1.0 + ((r - J @ free) ** 2).mean(axis=1) / 9.0) ** -2
    np.testing.assert_allclose(traffic.moving_probability(flow, frames, prior), moves, rtol=1e-5, atol=1e-8)
    assert moves.min() < 0.1 and moves.max() > 0.9


@pytest.mark.slow
def test_tracks_that_move_are_dropped_before_the_filter_and_counted():
    world, movers = road(0.3, frames=40, landmarks=90)
    on, off = (run(world, "full", Config().with_overrides({"hygiene": {"moving": switch}})) for switch in (True, False))
    assert off.counts["hygiene: moves"] == 0
    assert on.counts["hygiene: moves"] == on.hygiene.dropped > 0
    dropped = np.unique(on.hygiene.landmark)
    assert np.isin(dropped, movers).mean() > 0.8
    assert not np.isin(on.landmarks.id, dropped).any()
