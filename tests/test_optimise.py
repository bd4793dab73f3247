"""Where the search for the maximum a posteriori starts: landmarks at one estimate or another."""

import dataclasses

import numpy as np
import pytest
from support.helpers import run_joint
from support.reference import small_world

from ekfslam.config import FilterConfig, PosteriorConfig
from ekfslam.errors import IllPosedError
from ekfslam.models.sensors.stereo import Rig
from ekfslam.smoother.optimise import better_start, robust
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
