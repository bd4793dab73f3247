"""Where the search for the maximum a posteriori starts: landmarks at one estimate or another."""

import dataclasses
from functools import partial

import numpy as np
import pytest
from support.helpers import run_joint
from support.reference import small_world

from ekfslam.config import FilterConfig, PosteriorConfig
from ekfslam.errors import IllPosedError
from ekfslam.geometry import se3
from ekfslam.models.blocks import CameraJitter, VisionDrift
from ekfslam.models.sensors.stereo import Rig
from ekfslam.smoother.landmarks import moved_in_image, settled
from ekfslam.smoother.optimise import better_start, evaluate, robust
from ekfslam.smoother.problem import BatchProblem
from ekfslam.smoother.revival import continued

CONFIG = PosteriorConfig(kernel="cauchy")
OPEN = FilterConfig(landmark_coordinates="xyz", gate_probability=1.0, split_after=0, retire="never")
NEAREST_M = 0.1


@pytest.fixture(scope="module")
def filtered():
    world = small_world(frames=12, landmarks=20)
    ekf, _, _ = run_joint(world, Rig(world.camera, world.T_cam_imu, world.noise), OPEN)
    return BatchProblem(ekf.log(), ekf.model), ekf.landmarks().position_m


@pytest.fixture(scope="module")
def problem(filtered):
    return filtered[0]


@pytest.fixture
def state(filtered):
    """The filter's last estimates, every third landmark moved half a metre away."""
    problem, positions_m = filtered
    away = np.where(np.arange(problem.log.landmarks) % 3 == 0, 0.5, 0.0)
    return problem.filtered_state(positions_m + away[:, None])


def cost_of_landmarks(problem, state):
    s = problem.observations.at(state).norms()
    cost = robust(CONFIG, s)[0]
    return np.array([cost[problem.log.landmark == i].sum() for i in range(problem.log.landmarks)])


def test_every_landmark_starts_where_it_fits_its_observations_better(problem, state):
    first = dataclasses.replace(state, positions_m=problem.log.first_position_m)
    here, there = cost_of_landmarks(problem, state), cost_of_landmarks(problem, first)
    assert 3 < (here < there).sum() < problem.log.landmarks - 3
    found = better_start(problem, state, CONFIG, NEAREST_M)
    expected = np.where((here <= there)[:, None], state.positions_m, first.positions_m)
    np.testing.assert_array_equal(found.positions_m, expected)
    np.testing.assert_allclose(cost_of_landmarks(problem, found), np.minimum(here, there))


@pytest.fixture(scope="module")
def chained():
    """Tracks that walk, a jitter and a drift: single observations and differences see through different cameras."""
    world = small_world(frames=12, landmarks=20)
    px = np.full(3, 0.3)
    world = dataclasses.replace(world, noise=dataclasses.replace(world.noise, track_first_px=px, track_walk_px=px))
    blocks = [CameraJitter(), VisionDrift(length_m=20.0)]
    ekf, _, _ = run_joint(world, Rig(world.camera, world.T_cam_imu, world.noise), OPEN, blocks=blocks)
    problem = BatchProblem(ekf.log(), ekf.model)
    assert (problem.log.previous >= 0).any()
    return problem, problem.filtered_state(ekf.landmarks().position_m)


@pytest.mark.parametrize("kernel", ["huber", "cauchy"])
def test_settled_landmarks_fit_best_given_the_cameras(chained, kernel):
    problem, state = chained
    config, o = PosteriorConfig(kernel=kernel), problem.observations
    away = np.where(np.arange(problem.log.landmarks) % 3 == 1, 0.3, 0.0)[:, None]
    state = dataclasses.replace(state, positions_m=state.positions_m + away)
    here = evaluate(problem, state, config, NEAREST_M)
    found = settled(o, state, partial(robust, config), NEAREST_M, 1e-4)
    np.testing.assert_array_equal(found.T_imu_world, state.T_imu_world)
    there = evaluate(problem, found, config, NEAREST_M)
    assert there.cost < 0.9 * here.cost
    # What was remembered of those that stayed and those that moved is what is seen there.
    o.at(state)
    fresh = evaluate(problem, dataclasses.replace(found), config, NEAREST_M)
    assert there.cost == pytest.approx(fresh.cost, rel=1e-12)
    for one, other in zip(there.system.factors, fresh.system.factors, strict=True):
        np.testing.assert_allclose(one.r, other.r, atol=1e-12)
        for term, same in zip(one.terms, other.terms, strict=True):
            np.testing.assert_allclose(term.J, same.J, rtol=1e-12, atol=1e-12)
    # No small step of a single landmark is better by much.
    rng = np.random.default_rng(0)
    for number in rng.permutation(problem.log.landmarks)[:5]:
        for step in 1e-3 * np.concatenate([np.eye(3), -np.eye(3)]):
            positions = found.positions_m.copy()
            positions[number] += step
            moved = evaluate(problem, dataclasses.replace(found, positions_m=positions), config, NEAREST_M)
            assert moved.cost > there.cost - 1e-2


def test_landmarks_stay_if_one_is_behind_a_camera(problem, state):
    behind = state.positions_m.copy()
    behind[4] -= 100.0 * state.T_imu_world[problem.observations.first_frame[4], 0, :3]
    state = dataclasses.replace(state, positions_m=behind)
    assert settled(problem.observations, state, partial(robust, CONFIG), NEAREST_M, 1e-4) is state


def test_landmarks_move_linearly_in_the_image_of_the_camera(problem):
    rng, sensor = np.random.default_rng(1), problem.model.sensor
    T = se3.exp(np.concatenate([rng.normal(size=(2, 3)), rng.normal(size=(2, 3))], axis=1))
    q = np.array([[1.0, -2.0, 10.0], [0.5, 0.2, 4.0], [9.0, 1.0, 2.0], [0.3, 0.1, -5.0], [1.0, 1.0, 10.0]])
    by = np.concatenate([0.3 * rng.normal(size=(4, 3)), [[0.0, 0.0, 12.0]]])
    before, after = (np.broadcast_to(one, (5, 4, 4)) for one in T)
    found = moved_in_image(sensor, before, after, se3.apply(se3.inverse(before), q), by)

    def image(q):
        return np.concatenate([q[:, :2], np.ones((len(q), 1))], axis=1) / q[:, 2:]

    h = 1e-6
    moved = image(q) + (image(q + h * by) - image(q - h * by)) / (2 * h)
    # Too oblique, behind the camera, and a depth that the step would turn around: these move in space.
    expected = np.concatenate([image(moved[:2]), (q + by)[2:]])
    np.testing.assert_allclose(se3.apply(after, found), expected, atol=1e-7)


def test_a_landmark_behind_a_camera_starts_at_its_initialisation(problem, state):
    behind = state.positions_m.copy()
    behind[4] -= 100.0 * state.T_imu_world[problem.observations.first_frame[4], 0, :3]
    found = better_start(problem, dataclasses.replace(state, positions_m=behind), CONFIG, NEAREST_M)
    np.testing.assert_array_equal(found.positions_m[4], problem.log.first_position_m[4])


def test_a_landmark_behind_a_camera_at_both_estimates_is_named(problem, state):
    behind = state.positions_m.copy()
    behind[4] -= 100.0 * state.T_imu_world[problem.observations.first_frame[4], 0, :3]
    log = dataclasses.replace(problem.log, first_position_m=behind)
    with pytest.raises(IllPosedError, match=rf"behind a camera that saw them \[{log.id[4]}\]"):
        better_start(
            BatchProblem(log, problem.model), dataclasses.replace(state, positions_m=behind), CONFIG, NEAREST_M
        )


def test_a_maximum_is_continued_by_estimates_of_everything_seen_since(problem, state):
    """It was found after the prediction to its last frame, before what was observed there."""
    log, known = problem.log, 8
    landmarks = int((problem.observations.first_frame < known - 1).sum())
    last = dataclasses.replace(
        state,
        T_imu_world=state.T_imu_world[:known] + 1.0,
        positions_m=state.positions_m[:landmarks] + 1.0,
        shared=state.shared[:known],
        aux=state.aux[:known],
    )
    found = continued(last, state, log)
    last_seen = np.array([log.frame[log.landmark == i].max() for i in range(log.landmarks)])
    at_maximum = np.arange(log.landmarks)[:landmarks][last_seen[:landmarks] < known - 1]
    seen_there = np.flatnonzero(last_seen == known - 1)
    assert len(at_maximum)
    assert len(seen_there)
    expected = state.positions_m.copy()
    expected[at_maximum] += 1.0
    np.testing.assert_array_equal(found.positions_m, expected)
    np.testing.assert_array_equal(found.T_imu_world[:known], last.T_imu_world)
    np.testing.assert_array_equal(found.T_imu_world[known:], state.T_imu_world[known:])
