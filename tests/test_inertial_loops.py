"""Loops with inertial states: landmarks that come back after a turn of the room revive from the batch problem."""

import dataclasses
import functools

import numpy as np
import pytest
from inertial import FILTER, Prior, model_from_prior
from scipy.spatial.transform import Rotation
from support.frozen import assert_equal_to_frozen_rows

import ekfslam
from ekfslam.config import Config
from ekfslam.data.interval import Intervals
from ekfslam.data.room import Room, simulate_room
from ekfslam.data.sequence import Observations
from ekfslam.evaluation.inertial import inertial_nees
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import run_filter

FRAMES, FIRST, LAST = 130, 12, 118


def write_turn(path):
    """A TUM file of a turn about the room in 10 s that ends where it began, with some bounce; the x axis leads."""
    time_s = np.arange(0.0, 16.0, 0.05)
    angle = 2 * np.pi * np.clip((time_s - 1.0) / 11.0, 0.0, 1.0)
    angle -= np.sin(2 * angle) / 4
    sway = np.clip(time_s - 1.0, 0.0, 1.0)
    place = [np.sin(angle), 1 - np.cos(angle), 1.5 + 0.1 * sway * np.sin(3 * time_s)]
    euler = np.column_stack([angle, 0.1 * sway * np.sin(2 * time_s), 0.1 * sway * np.cos(2.5 * time_s)])
    quaternion = Rotation.from_euler("ZYX", euler).as_quat()
    np.savetxt(path, np.column_stack([time_s, *place, quaternion]), fmt="%.9f")


@functools.cache
def turn(folder, seed):
    """The recording of a turn; landmarks of its first frames have their ids again in its last ones, no others."""
    path = folder / "turn.txt"
    write_turn(path)
    sequence = simulate_room(Room(frames=FRAMES, seed=seed, trajectory=str(path), landmarks=800, max_tracks=25))
    seen, truth = sequence.observations, sequence.truth
    position = truth.position_m[np.searchsorted(truth.landmark, seen.landmark)].round(9)
    rows = list(zip(map(tuple, position.tolist()), seen.landmark.tolist(), seen.frame.tolist(), strict=True))
    known = {place: one for place, one, frame in rows if frame < FIRST}
    again = [known.get(place, one) if frame >= LAST else one for place, one, frame in rows]
    return dataclasses.replace(sequence, observations=Observations(seen.frame, np.array(again), seen.pixels_px))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("turn")


def ran(sequence, **settings):
    chosen = {"retire": "unseen", "dormant": 0, **settings}
    return ekfslam.run(sequence, "full", Config().with_overrides({"filter": chosen}))


@functools.cache
def closing(folder, seed):
    """The recording, and its runs without and with map revival."""
    sequence = turn(folder, seed)
    return sequence, ran(sequence, revive=-1), ran(sequence, revive=20)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 2])
def test_landmarks_that_come_back_take_the_drift_of_an_inertial_unit_away(folder, seed):
    sequence, apart, closed = closing(folder, seed)
    assert apart.counts["revived"] == 0 and closed.counts["revived"] > 15
    assert (closed.position_std_world_m[-1] < 0.5 * apart.position_std_world_m[-1]).all()
    heading = [run.rotation_covariance_world[-1, 2, 2] for run in (closed, apart)]
    assert heading[0] < 0.1 * heading[1]
    true = sequence.truth.T_world_imu[-1, :3, 3]
    assert np.linalg.norm(closed.T_world_imu[-1, :3, 3] - true) < np.linalg.norm(apart.T_world_imu[-1, :3, 3] - true)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 2])
def test_all_inertial_states_stay_consistent_when_landmarks_come_back(folder, seed):
    sequence, _, closed = closing(folder, seed)
    mean = {part: float(np.mean(values[LAST:])) for part, values in inertial_nees(closed, sequence.truth).items()}
    assert mean["pose"] < 12.0 and mean["all"] < 27.0
    assert all(mean[part] < 8.0 for part in ("velocity", "gyro_bias", "accel_bias"))


@pytest.mark.slow
def test_velocity_and_biases_after_a_return_are_those_of_the_batch_problem(folder):
    _, _, closed = closing(folder, 0)
    smoothed, filtered = ekfslam.posterior(closed).inertial, closed.inertial
    for part in ("velocity", "gyro_bias", "accel_bias"):
        off = (smoothed.value(part)[-1] - filtered.value(part)[-1]) / smoothed.std(part)[-1]
        assert np.abs(off).max() < 0.3
        np.testing.assert_allclose(smoothed.std(part)[-1], filtered.std(part)[-1], rtol=0.1)


def some_tracks_in_any_order(sequence, share=0.6):
    """The recording with other ids in random order, and a random part of the observations of each frame."""
    rng, seen = np.random.default_rng(0), sequence.observations
    order = rng.permutation(len(seen.ids))
    kept = rng.random(len(seen)) < share
    ids = order[np.searchsorted(seen.ids, seen.landmark)]
    return dataclasses.replace(sequence, observations=Observations(seen.frame[kept], ids[kept], seen.pixels_px[kept]))


@pytest.mark.parametrize("variant", ["standard", "fej"])
def test_frozen_rows_of_any_part_of_the_landmarks_are_those_of_the_filter(variant):
    sequence = some_tracks_in_any_order(simulate_room(Room(frames=25, seed=2)))
    config = dataclasses.replace(FILTER, variant=variant, landmark_coordinates="xyz", retire="never")
    prior = Prior(position_m=0.004, tilt_rad=0.02, yaw_rad=0.02, rest_s=0.0)
    ekf = JointEKF(model_from_prior(sequence, prior, np.random.default_rng(0)), config)
    for _ in run_filter(ekf, sequence):
        pass
    last, known = sequence.observations.at(len(sequence) - 1)[0], ekf.table.id
    assert set(last) < set(known.tolist()) and not np.isin(known[: len(last)], last).all()
    assert_equal_to_frozen_rows(ekf)


def test_the_residual_integrates_the_samples_again_at_other_biases():
    sequence = simulate_room(Room(frames=12, seed=1))
    model = model_from_prior(sequence, Prior(), np.random.default_rng(0))
    process, rng = model.process, np.random.default_rng(1)
    intervals = [sequence.interval(k, ekfslam.InertialSamples) for k in range(1, len(sequence))]
    before = {name: np.array([value] * len(intervals)) for name, value in model.initial_values().items()}
    before["gyro_bias"] = before["gyro_bias"] + rng.normal(0, 0.05, before["gyro_bias"].shape)
    before["accel_bias"] = before["accel_bias"] + rng.normal(0, 0.5, before["accel_bias"].shape)
    after = [
        process.step({n: v[k] for n, v in before.items()}, one, before["pose"][k], False).values
        for k, one in enumerate(intervals)
    ]
    start = np.cumsum([0, *(len(one.dt_s) for one in intervals)])
    flat = Intervals(
        np.array([one.tau_s for one in intervals]),
        np.zeros(len(intervals), dtype=bool),
        start,
        np.concatenate([one.dt_s for one in intervals]),
        np.concatenate([one.inputs for one in intervals]),
    )
    moved = {name: np.array([values[name] for values in after]) for name in process.own}
    np.testing.assert_allclose(process.residual(before, moved, flat).error, 0.0, atol=1e-12)
    others = {**before, "accel_bias": before["accel_bias"] + 0.1}
    assert np.abs(process.residual(others, moved, flat).error[:, 6:9]).max() > 1e-3
