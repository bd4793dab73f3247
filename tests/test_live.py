"""Live use is the recording in order, whatever order the messages come in; what comes too late is named."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
from support.compiled import assert_same_state
from support.everything import with_everything
from support.helpers import filter_of

from ekfslam import LiveEKF
from ekfslam.config import Config
from ekfslam.data.simulate import builtin
from ekfslam.errors import (
    ConfigError,
    DataError,
    DuplicateObservationError,
    LateError,
    MissingVelocityError,
    StampError,
)
from ekfslam.filters.loop import run_filter
from ekfslam.geometry import motion, se3
from ekfslam.resolve import resolve

FRAMES = 40


def problem_of(name="city", **settings):
    world = builtin(f"{name}?frames={FRAMES}")
    if settings.pop("walks", False):  # velocities are in the state, and errors of tracks
        world = with_everything(world)
    return resolve(world, Config().with_overrides(settings))


def batch(problem):
    """The filter over the recording, and its poses and their covariances after each frame."""
    ekf, poses = filter_of(problem), []
    for _ in run_filter(ekf, problem.sequence):
        poses.append((ekf.T_world_imu, ekf.gaussian.body_covariance[:6, :6].copy()))
    return ekf, poses


def messages(sequence):
    """Velocities and images as they are stamped, velocities first."""
    for k, t in enumerate(sequence.time_s.tolist()):
        yield t, "predict", (sequence.twist[k],)
        yield t, "update", sequence.observations.at(k)


def assert_same(live, ekf):
    assert live.ekf.step == ekf.step
    assert_same_state(live.ekf, ekf, floor=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("settings", [{}, {"walks": True}, {"filter": {"variant": "standard"}}])
def test_in_order_it_is_the_batch_filter(settings):
    problem = problem_of(**settings)
    ekf, poses = batch(problem)
    live = LiveEKF(filter_of(problem))
    for k, t in enumerate(problem.sequence.time_s.tolist()):
        assert live.predict(problem.sequence.twist[k], t) == []
        (report,) = live.update(*problem.sequence.observations.at(k), t)
        assert report.frame == k
        now = live.pose()
        assert now.time_s == t and not now.is_held
        np.testing.assert_allclose(now.T_world_imu, poses[k][0], atol=1e-9)
        np.testing.assert_allclose(now.covariance, poses[k][1], atol=1e-12)
    assert_same(live, ekf)
    assert (live.counts.taken_in, live.counts.held, live.counts.out_of_order) == (FRAMES, 0, 0)


@pytest.mark.slow
@pytest.mark.parametrize("settings", [{}, {"walks": True}])
def test_delayed_within_the_window_it_is_the_filter_in_order(settings):
    problem, rng = problem_of(**settings), np.random.default_rng(3)
    ekf, _ = batch(problem)
    delay_s = 0.35
    live = LiveEKF(filter_of(problem), delay_s)
    arriving = sorted(messages(problem.sequence), key=lambda message: message[0] + rng.uniform(0, 0.95 * delay_s))
    for t, name, arguments in arriving:
        if name == "update":  # a tracker may have its ids in any order
            order = rng.permutation(len(arguments[0]))
            arguments = tuple(value[order] for value in arguments)
        getattr(live, name)(*arguments, t)
    assert live.counts.taken_in < FRAMES
    live.flush()
    assert_same(live, ekf)
    assert live.counts.out_of_order > 10
    assert live.counts.late_images == live.counts.late_velocities == live.counts.held == 0


@pytest.mark.slow
def test_between_images_the_pose_is_the_filters_prediction():
    problem = problem_of()
    sequence = problem.sequence
    live = LiveEKF(filter_of(problem), history_s=0.25)
    ekf, poses = batch(problem)
    for t, name, arguments in messages(sequence):
        getattr(live, name)(*arguments, t)
    ahead = filter_of(problem)
    for _ in run_filter(ahead, sequence, range(FRAMES - 1)):
        pass
    begin, end = sequence.time_s[-2:]
    middle = float(begin + end) / 2
    ahead.predict(sequence.twist[-1], middle - begin)
    found = live.pose(middle)
    np.testing.assert_allclose(found.T_world_imu, ahead.T_world_imu, atol=1e-9)
    np.testing.assert_allclose(found.covariance, ahead.gaussian.body_covariance[:6, :6], atol=1e-12)
    np.testing.assert_allclose(live.pose(float(begin)).T_world_imu, poses[-2][0], atol=1e-9)
    later = live.pose(float(end) + 0.5)
    assert later.is_held and np.trace(later.covariance) > np.trace(live.pose().covariance)
    assert repr(later).startswith(f"Pose at {end + 0.5:.6f} s: position ") and repr(later).endswith("inputs held")
    np.testing.assert_array_equal(live.ekf.P, ekf.P)  # asking changes nothing
    with pytest.raises(LateError, match=r"pose at .* comes too late") as late:
        live.pose(float(sequence.time_s[0]))
    oldest_s = late.value.least_s
    (k,) = np.flatnonzero(sequence.time_s == oldest_s)
    np.testing.assert_allclose(live.pose(oldest_s).T_world_imu, poses[k][0], atol=1e-9)


def test_velocities_at_another_rate_lead_to_the_pose_that_they_make():
    """Three velocities and a bit between two images, none at the stamp of an image."""
    problem, rng = problem_of(), np.random.default_rng(0)
    images = problem.sequence.time_s[:3]
    stamps = np.linspace(images[0] - 0.01, images[-1] + 0.02, 9)
    twists = problem.sequence.twist[:9] + 0.3 * rng.standard_normal((9, 6))
    live = LiveEKF(filter_of(problem), delay_s=1.0)
    for twist, t in zip(twists, stamps, strict=True):
        live.predict(twist, float(t))
    none = np.empty(0, dtype=int), np.empty((0, 4))
    for t in images.tolist():
        live.update(*none, t)
    live.flush()
    T = se3.inverse(problem.model.initial_values()["pose"])
    fine = np.unique(np.concatenate([images, stamps[(stamps > images[0]) & (stamps < images[-1])]]))
    for begin, end in itertools.pairwise(fine):
        T = T @ se3.inverse(motion.increment(twists[np.searchsorted(stamps, end)], end - begin))
    np.testing.assert_allclose(live.ekf.T_world_imu, T, atol=1e-12)
    assert live.counts.held == 0 and live.ekf.step == 2


@pytest.mark.slow
def test_gaps_and_velocities_that_do_not_come_are_counted_and_worth_less():
    world = builtin(f"city?frames={FRAMES}")
    noise = dataclasses.replace(world.noise, gap_std=np.repeat([1.0, 0.1], 3))
    problem = resolve(dataclasses.replace(world, noise=noise))
    sequence = problem.sequence
    traces = []
    for left_out in (range(0), range(8, 14)):
        live = LiveEKF(filter_of(problem), gap_s=0.25)
        for k, t in enumerate(sequence.time_s[:20].tolist()):
            if k not in left_out:
                live.predict(sequence.twist[k], t)
            live.update(*([], []) if 7 < k < 14 else sequence.observations.at(k), t)
            if k == 13:
                traces.append(np.trace(live.ekf.gaussian.body_covariance[:6, :6]))
        assert live.counts.held == len(left_out)
        assert live.counts.gaps == (1 if left_out else 0)
    assert traces[1] > 2.0 * traces[0]


def test_a_held_velocity_is_trusted_as_little_as_one_across_a_gap():
    world = builtin("city?frames=2")
    noise = dataclasses.replace(world.noise, gap_std=np.repeat([1.0, 0.1], 3))
    problem = resolve(dataclasses.replace(world, noise=noise))
    twist, covariances = problem.sequence.twist[1], {}
    for name, gap_s, arrives in (("measured", 1.0, True), ("across a gap", 0.25, True), ("held", 1.0, False)):
        live = LiveEKF(filter_of(problem), gap_s=gap_s)
        live.predict(twist, 0.0)
        live.update([], [], 0.0)
        if arrives:
            live.predict(twist, 0.3)
        pose = live.pose(0.3)
        assert pose.is_held == (name == "held")
        covariances[name] = pose.covariance
    np.testing.assert_array_equal(covariances["held"], covariances["across a gap"])
    assert (np.diag(covariances["held"]) > 1.1 * np.diag(covariances["measured"])).all()


def test_what_comes_too_late_is_named_or_counted():
    problem = problem_of()
    sequence = problem.sequence
    for late in ("raise", "count"):
        live = LiveEKF(filter_of(problem), delay_s=0.15, late=late)
        for t, name, arguments in messages(sequence[:10]):
            getattr(live, name)(*arguments, t)
        step, t = live.ekf.step, float(sequence.time_s[5]) + 0.01
        if late == "raise":
            with pytest.raises(LateError, match=r"velocity at 0\.5.* s comes too late: the filter is at 0\.7"):
                live.predict(sequence.twist[5], t)
            with pytest.raises(LateError, match="image at"):
                live.update(*sequence.observations.at(5), t)
        else:
            assert live.predict(sequence.twist[5], t) == live.update(*sequence.observations.at(5), t) == []
        assert (live.counts.late_velocities, live.counts.late_images, live.ekf.step) == (1, 1, step)


def test_messages_that_cannot_be_right_are_named_and_leave_everything_as_it_was():
    problem = problem_of()
    live = LiveEKF(filter_of(problem))
    with pytest.raises(MissingVelocityError, match="no velocity has arrived yet"):
        live.update([1], [[10.0, 5.0, 4.0, 5.0]], 0.0) or live.flush()
    with pytest.raises(LateError, match="no image has been processed yet"):
        live.pose()
    for wrong in (lambda: live.predict([1.0, 2.0], 1.0), lambda: live.predict(np.full(6, np.nan), 1.0)):
        with pytest.raises(DataError, match="velocities"):
            wrong()
    with pytest.raises(DataError, match="t: 1 values are NaN"):
        live.predict(np.zeros(6), np.nan)
    with pytest.raises(DataError, match="pixels"):
        live.update([1, 2], [[1.0, 2.0, 3.0, 4.0]], 1.0)
    with pytest.raises(DuplicateObservationError, match="landmark 7 is observed twice"):
        live.update([7, 7], np.ones((2, 4)), 1.0)
    with pytest.raises(StampError, match="two images at 0"):
        live.update([1], [[10.0, 5.0, 4.0, 5.0]], 0.0)
    live.predict(np.zeros(6), 0.5)
    with pytest.raises(StampError, match=r"two velocities at 0\.5"):
        live.predict(np.zeros(6), 0.5)
    assert (live.counts.velocities, live.counts.images, live.counts.taken_in) == (1, 1, 1)
    with pytest.raises(ConfigError, match="delay_s"):
        LiveEKF(filter_of(problem), delay_s=-1.0)


def test_the_page_on_live_use_runs():
    page = (Path(__file__).resolve().parents[1] / "docs" / "live.md").read_text(encoding="utf-8")
    code = page.partition("```python\n")[2].partition("```")[0]
    found: dict = {}
    exec(compile(code, "live.md", "exec"), found)
    assert found["live"].counts.taken_in == 1 and found["live"].ekf.ids.tolist() == [7]
    assert found["now"].time_s == 0.1 and found["now"].T_world_imu[0, 3] == pytest.approx(1.0, abs=1e-3)
