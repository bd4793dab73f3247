"""Truth, velocities and vision in stretches of 2 s: the one that stands alone is named, and doubts reach the NEES."""

import dataclasses

import numpy as np
import pytest
from support.helpers import synthetic_result, synthetic_sequence

from ekfslam import open_sequence
from ekfslam.cli import main
from ekfslam.data.readers import write_sequence
from ekfslam.data.truth_noise import Doubt, TruthNoise, doubt_attributes, doubts_of
from ekfslam.evaluation.consistency import chi2_bounds, pose_nees, pose_nees_apart
from ekfslam.evaluation.sources import (
    SOURCES,
    STRETCH_S,
    compare_sources,
    doubt_in_truth,
    first_of_each,
    in_words,
    visual_motion,
)
from ekfslam.geometry import se3
from ekfslam.geometry.camera import project
from ekfslam.runner import run

WORLD = "builtin:city?frames=400&seed={}"


def ramp(world, axis, size):
    """Middle frames two seconds apart, and the offset (T, 3) in world of a body axis that grows between them."""
    begin, time_s, T = len(world) // 2, world.time_s, world.truth.T_world_imu
    end = int(np.searchsorted(time_s, time_s[begin] + STRETCH_S))
    share = np.clip((time_s - time_s[begin]) / (time_s[end] - time_s[begin]), 0.0, 1.0)
    return begin, end, size * share[:, None] * T[begin, :3, axis]


def with_drift_of_truth(world, axis, size=2.0):
    T = world.truth.T_world_imu.copy()
    T[:, :3, 3] += ramp(world, axis, size)[2]
    return dataclasses.replace(world, truth=dataclasses.replace(world.truth, T_world_imu=T))


def with_jump_of_velocities(world, axis, size=4.0):
    begin, end, _ = ramp(world, axis, size)
    twist = world.twist.copy()
    twist[begin + 1 : end + 1, axis] += size / STRETCH_S
    return world.with_velocities(twist)


def with_traffic(world, axis, size=4.0):
    """Nine of ten landmarks move along."""
    begin, end, offset = ramp(world, axis, size)
    o, truth = world.observations, world.truth
    movers = np.random.default_rng(1).random(len(truth.landmark)) < 0.9
    place = np.searchsorted(truth.landmark, o.landmark, sorter=np.argsort(truth.landmark))
    place = np.argsort(truth.landmark)[place]
    seen = np.flatnonzero(movers[place] & (o.frame > begin) & (o.frame <= end))
    frame, m = o.frame[seen], truth.position_m[place[seen]]
    T_cam_world = (world.T_cam_imu @ se3.inverse(truth.T_world_imu))[frame]
    still, moved = se3.apply(T_cam_world, m), se3.apply(T_cam_world, m + offset[frame])
    ahead, pixels = (still[:, 2] > 1.0) & (moved[:, 2] > 1.0), o.pixels_px.copy()
    pixels[seen[ahead]] += (project(world.camera, moved) - project(world.camera, still))[ahead]
    return dataclasses.replace(world, observations=dataclasses.replace(o, pixels_px=pixels))


FAULTS = dict(zip(SOURCES, (with_drift_of_truth, with_jump_of_velocities, with_traffic), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("source", SOURCES)
def test_the_source_that_stands_alone_is_named_with_axis_and_time(source, seed):
    world, axis = open_sequence(WORLD.format(seed)), seed
    begin, end, _ = ramp(world, axis, 1.0)
    assert compare_sources(world).alone == ()
    (found,) = compare_sources(FAULTS[source](world, axis)).alone
    assert (SOURCES[found.source], found.axis) == (source, axis)
    assert abs(found.offset) > 1.0
    assert source == "vision" or found.offset > 0
    assert found.begin < end
    assert found.end > begin
    assert world.time_s[found.end] - world.time_s[found.begin] < 4 * STRETCH_S


def test_vision_finds_the_true_motion_where_velocities_are_wrong():
    world = open_sequence("builtin:loop?frames=40")
    truth = se3.log(se3.inverse(world.truth.T_world_imu[:-1]) @ world.truth.T_world_imu[1:])
    wrong = world.with_velocities(world.twist + np.array([1.0, 0.5, 0.0, 0.0, 0.0, 0.05]))
    twist, known = visual_motion(wrong)
    off = np.abs(twist[1:] * np.diff(world.time_s)[:, None] - truth)[known[1:]]
    assert known[1:].mean() > 0.8
    assert (np.median(off, axis=0) < [0.03, 0.03, 0.03, 0.003, 0.003, 0.003]).all()


def test_a_clock_of_years_takes_no_longer():
    world = open_sequence("builtin:city?frames=12")
    assert compare_sources(dataclasses.replace(world, time_s=world.time_s * 1e10)) is None
    stamps = np.array([0.0, 0.2, 0.6, 1.4, 1.5, 9.0, 9.4, 1e12])
    np.testing.assert_array_equal(first_of_each(stamps, 0.5), [0, 2, 3, 4, 5, 7])


def test_without_velocities_or_with_few_stretches_nothing_is_compared():
    world = open_sequence("builtin:loop?frames=40")
    assert compare_sources(world) is None
    assert compare_sources(dataclasses.replace(world, truth=None)) is None
    assert in_words(None, world.time_s) == ()
    assert doubt_in_truth(None, world.time_s) == {}


def test_doubts_are_kept_as_attributes():
    doubts = (Doubt(3, 40, 1, 0.25), Doubt(50, 60, 5, 1e-3))
    assert doubts_of(doubt_attributes(doubts, 0.2)) == (doubts, 0.2)
    assert doubts_of({}) == ((), 0.0)
    assert doubts_of({"truth_doubts": "3-x 1 much"}) == ((), 0.0)
    assert doubt_attributes((), 0.0) == {}


def test_nees_without_the_doubts_is_six_although_the_truth_has_moved():
    plain, apart = [], []
    for seed in range(40):
        world = synthetic_sequence(frames=40, landmarks=20, seed=seed)
        result, T = synthetic_result(world, "dead-reckoning"), world.truth.T_world_imu.copy()
        T[20:, :3, 3] += 3.0 * np.random.default_rng(seed).standard_normal() * T[10, :3, 1]
        truth = dataclasses.replace(world.truth, T_world_imu=T, noise=TruthNoise())
        doubtful = dataclasses.replace(result, attributes=doubt_attributes([Doubt(10, 20, 1, 3.0)], 0.0))
        frame, values = pose_nees_apart(doubtful, truth)
        assert not ((frame > 10) & (frame <= 20)).any()
        plain.append(pose_nees(result, truth)[1][-1])
        apart.append(values[-1])
        assert pose_nees_apart(result, truth) is None
    low, high = chi2_bounds(6, 0.999, runs=40)
    assert low < np.mean(apart) < high < np.mean(plain)


@pytest.mark.slow
def test_a_run_and_info_say_it(tmp_path, capsys):
    world = with_drift_of_truth(open_sequence(WORLD.format(0)), 0)
    result = run(world, "full")
    assert any("truth alone from" in remark and "forward" in remark for remark in result.remarks)
    ((doubt,), _) = doubts_of(result.attributes)
    assert doubt.axis == 0
    assert 1.0 < doubt.size < 4.0
    write_sequence(world, tmp_path / "w.h5")
    assert main(["info", str(tmp_path / "w.h5")]) == 0
    assert "sources       truth alone from" in capsys.readouterr().out


@pytest.mark.slow
def test_a_drift_of_the_truth_is_found_from_the_recording():
    world = open_sequence(WORLD.format(1))
    T, rng = world.truth.T_world_imu.copy(), np.random.default_rng(1)
    T[1:, :3, 3] += np.cumsum(
        0.5 * np.sqrt(np.diff(world.time_s))[:, None] * rng.standard_normal((len(T) - 1, 3)), axis=0
    )
    found = compare_sources(dataclasses.replace(world, truth=dataclasses.replace(world.truth, T_world_imu=T)))
    assert found.alone == ()
    assert found.drift_m_sqrt_s == pytest.approx(0.5, rel=0.3)
    assert "the truth drifts by about 0.4" in in_words(found, world.time_s)[-1]
    assert compare_sources(world).drift_m_sqrt_s == 0.0
