"""Live use from images: near the run of the recording; pairs that cannot be tracked in time are dropped and counted."""

from __future__ import annotations

import contextlib
import dataclasses
import threading

import numpy as np
import pytest

pytest.importorskip("cv2")

from support.rendered import drive, recording

from ekfslam import LiveStereo
from ekfslam.config import Config, FrontEndConfig
from ekfslam.errors import ClockError, ConfigError, DataError, EkfslamError, EmptyTracksError, LateError
from ekfslam.frontend.track import track
from ekfslam.geometry import se3
from ekfslam.live_stereo import Learner, Line
from ekfslam.runner import run

FRAMES = 16


@pytest.fixture(scope="module")
def pairs():
    """A recording, and its images in memory."""
    found = recording(FRAMES, distorted=False, rotation_rad=np.zeros(3))
    return found, [found.load(k) for k in range(FRAMES)]


def new(found, **settings):
    return LiveStereo(found.calibration, found.T_cam_imu, **{"learn": 8, "delay_s": 0.0, **settings})


def sent(stereo, pairs, twist=None):
    found, images = pairs
    for k, t in enumerate(found.time_s.tolist()):
        if twist is not None:
            stereo.velocities(twist[k], t)
        stereo.images(*images[k], t)
    stereo.flush()
    return stereo


@pytest.mark.slow
@pytest.mark.parametrize("has_velocities", [False, True])
def test_it_is_near_the_run_of_the_same_images(pairs, has_velocities):
    found, _ = pairs
    noise = 0.02 * np.random.default_rng(0).standard_normal((FRAMES, 6)) * [1, 1, 1, 0.1, 0.1, 0.1]
    twist = drive(FRAMES) + noise if has_velocities else None
    stereo = sent(new(found), pairs, twist)
    sequence, _ = track(dataclasses.replace(found, twist=twist, truth=None))
    result = run(sequence, "full", Config().with_overrides({"filter": {"lag": 0}}))
    pose = stereo.live.pose()
    assert pose.time_s == found.time_s[-1] and not pose.is_held
    error = se3.log(se3.inverse(result.T_world_imu[-1]) @ pose.T_world_imu)
    std, own = (np.sqrt(np.diag(P)) for P in (result.covariance[-1], pose.covariance))
    assert (np.abs(error) < 0.5 * std).all()
    np.testing.assert_allclose(own, std, rtol=0.3)
    counts = stereo.live.counts
    assert (counts.taken_in, counts.held, counts.out_of_order, stereo.skipped) == (FRAMES, 0, 0, 0)
    assert stereo.problem.sequence.has_velocities == has_velocities


@pytest.mark.slow
def test_threads_lead_to_the_same_state(pairs):
    found, _ = pairs
    alone, stereo = sent(new(found), pairs), new(found, queue=FRAMES)
    with stereo:
        assert sent(stereo, pairs).skipped == 0
    np.testing.assert_array_equal(stereo.pose().T_world_imu, alone.pose().T_world_imu)
    np.testing.assert_array_equal(stereo.live.ekf.P, alone.live.ekf.P)


@pytest.mark.slow
def test_a_standstill_with_velocities_of_0_puts_the_start_off(pairs):
    found, images = pairs
    stereo, none = new(found, learn=4), np.zeros(6)
    for k in range(8):
        stereo.velocities(none, 0.1 * k)
        stereo.images(*images[0], 0.1 * k)
    assert stereo.live is None
    for k in range(1, 8):
        stereo.velocities(drive(FRAMES)[k], 0.7 + 0.1 * k)
        stereo.images(*images[k], 0.7 + 0.1 * k)
    assert stereo.problem.sequence.has_velocities and stereo.live.counts.taken_in >= 4


@pytest.mark.slow
def test_messages_that_cannot_be_used_are_named_or_counted(pairs):
    found, images = pairs
    stereo = new(found)
    left, right = images[0]
    for wrong in (left[:-1], left.astype(float), np.stack([left] * 3, axis=-1)):
        with pytest.raises(DataError, match="left"):
            stereo.images(wrong, right, 0.0)
    with pytest.raises(DataError, match="gyro"):
        stereo.imu([1.0, 2.0], np.zeros(3), 0.0)
    with pytest.raises(DataError, match="truth value"):
        stereo.images(left, right, True)
    with pytest.raises(LateError, match="no image has been processed yet"):
        stereo.pose()
    stereo.velocities(np.ones(6), 0.0)
    with pytest.raises(ConfigError, match="cannot take a sample"):
        stereo.imu(np.zeros(3), np.zeros(3), 0.01)
    stereo.images(left, right, 0.1)
    stereo.images(left, right, 0.1)
    stereo.images(left, right, 1e9)
    assert (stereo.counts.images, stereo.counts.late_images, stereo.counts.jumps) == (1, 1, 1)
    with pytest.raises(ClockError, match=r"call reset\(\)"):
        for k in range(12):
            stereo.images(left, right, 1e9 + k)
    stereo.reset()
    for k in range(8):
        stereo.images(*images[k], 1e9 + 0.1 * k)
    assert stereo.live.counts.taken_in == 8
    with pytest.raises(ConfigError, match="learn"):
        new(found, learn=1)


@pytest.mark.slow
def test_an_error_in_a_thread_is_raised_by_the_next_call(pairs):
    found, _ = pairs
    empty = np.zeros_like(found.load(0)[0])
    stereo = new(found, learn=2, front_end=FrontEndConfig(features=8))
    with stereo:
        for k in range(2):
            stereo.images(empty, empty, 0.1 * k)
        with pytest.raises(EmptyTracksError):
            stereo.flush()


@pytest.mark.slow
def test_pairs_that_are_dropped_under_load_widen_the_covariance_and_leave_the_pose_right(pairs):
    """Velocities go on while the tracker misses five pairs: the interval is that of all of them."""
    found, images = pairs
    noise = 0.2 * np.random.default_rng(0).standard_normal((FRAMES, 6)) * [1, 1, 1, 0.02, 0.02, 0.02]
    twist, lost = drive(FRAMES) + noise, range(9, 14)
    stereos = {name: new(found, queue=1) for name in ("whole", "loaded")}
    growth = {}
    for name, stereo in stereos.items():
        std = []
        for k, t in enumerate(found.time_s.tolist()):
            stereo.velocities(twist[k], t)
            if name == "whole" or k not in lost:
                stereo.images(*images[k], t)
            if k in (8, 13):
                stereo.flush()
                std.append(np.trace(stereo.live.pose(t).covariance[:3, :3]))
        stereo.flush()
        growth[name] = std[1] - std[0]
    whole, loaded = (stereo.live.pose() for stereo in stereos.values())
    apart = se3.log(se3.inverse(whole.T_world_imu) @ loaded.T_world_imu)
    assert (np.abs(apart) < 2.0 * np.sqrt(np.diag(loaded.covariance))).all()
    assert growth["loaded"] > 1.5 * growth["whole"] > 0
    assert stereos["loaded"].live.counts.taken_in == FRAMES - len(lost)


@pytest.mark.slow
def test_pairs_that_come_too_fast_for_the_tracker_are_counted(pairs):
    found, images = pairs
    with new(found, queue=1) as stereo:
        for k, t in enumerate(found.time_s.tolist()):
            stereo.velocities(drive(FRAMES)[k], t)
            stereo.images(*images[k], t)
            if k == 7:
                stereo.flush()
        stereo.flush()
    assert stereo.skipped > 0 and stereo.live.counts.taken_in + stereo.skipped == FRAMES


def test_pairs_beyond_the_queue_displace_the_oldest():
    tracked, has_begun, may_go = [], threading.Event(), threading.Event()

    def slow(left, right, t):
        has_begun.set()
        may_go.wait(10)
        tracked.append(t)

    line = Line(slow, most_pairs=2)
    line.start()
    line.offer(None, None, 0.0)
    has_begun.wait(10)
    for t in (1.0, 2.0, 3.0, 4.0):
        line.offer(None, None, t)
    may_go.set()
    line.stop()
    assert tracked == [0.0, 3.0, 4.0] and line.skipped == 2


def test_nothing_waits_after_a_line_has_stopped():
    line = Line(lambda *_: None, most_pairs=2)
    line.start()
    line.offer(None, None, 0.0)
    line.stop()
    waiting = threading.Thread(target=line.wait, daemon=True)
    waiting.start()
    waiting.join(10)
    assert not waiting.is_alive()


def test_velocities_before_the_first_frames_are_kept_for_them():
    learner, time_s = Learner(Config(), {}), 0.1 * np.arange(5)
    for k, t in enumerate(time_s):
        learner.require("velocity")
        learner.take(np.full(6, float(k)), t)
    twist, samples = learner.recorded(time_s, None)
    np.testing.assert_allclose(twist[1:], np.arange(1.0, 5.0)[:, None] * np.ones(6), atol=1e-9)
    assert samples is None


def test_pairs_offered_while_the_threads_end_are_tracked_and_none_waits_for_ever():
    tracked: list[float] = []
    line = Line(lambda t: tracked.append(t), most_pairs=1000)
    line.start()
    with pytest.raises(ConfigError, match="enter the context once"):
        line.start()
    others = [threading.Thread(target=lambda k=k: [line.offer(500.0 * k + i) for i in range(500)]) for k in range(3)]
    for thread in others:
        thread.start()
    line.stop()
    for thread in others:
        thread.join()
    waiter = threading.Thread(target=line.wait, daemon=True)
    waiter.start()
    waiter.join(10)
    assert not waiter.is_alive() and len(tracked) + line.skipped == 1500


@pytest.mark.parametrize("is_threaded", [False, True])
def test_memory_of_the_driver_may_be_used_again_at_once(pairs, is_threaded):
    found, images = pairs
    stereo, buffers = new(found, queue=FRAMES), [np.empty_like(image) for image in images[0]]
    with stereo if is_threaded else contextlib.nullcontext():
        for k, t in enumerate(found.time_s[:8].tolist()):
            for buffer, image in zip(buffers, images[k], strict=True):
                buffer[:] = image
            stereo.images(*buffers, t)
            for buffer in buffers:
                buffer[:] = 0
        stereo.flush()
    other = new(found)
    for k, t in enumerate(found.time_s[:8].tolist()):
        other.images(*images[k], t)
    np.testing.assert_array_equal(stereo.pose().T_world_imu, other.pose().T_world_imu)


@pytest.mark.slow
def test_resets_among_images_of_another_thread_leave_no_pair_of_the_time_before(pairs):
    found, images = pairs
    stereo, errors = new(found, queue=100), []

    def send():
        try:
            for k in range(60):
                stereo.images(*images[k % FRAMES], 0.1 * k)
        except EkfslamError as error:
            errors.append(error)

    with stereo:
        sender = threading.Thread(target=send)
        sender.start()
        while sender.is_alive():
            stereo.reset()
        stereo.reset()
        for k in range(8):
            stereo.images(*images[k], 0.1 * k)
        stereo.flush()
    assert not errors and (stereo.live.counts.taken_in, stereo.skipped) == (8, 0)


def test_inputs_of_another_kind_change_nothing(pairs):
    found, images = pairs
    stereo, other = new(found), new(found)
    for k, t in enumerate(found.time_s[:8].tolist()):
        for one in (stereo, other):
            one.velocities(drive(FRAMES)[k], t)
        if k:
            with pytest.raises(ConfigError, match="cannot take a sample"):
                stereo.imu(np.full(3, 5.0), np.full(3, 9.0), t - 0.05)
        for one in (stereo, other):
            one.images(*images[k], t)
    assert stereo.counts == other.counts
    np.testing.assert_array_equal(stereo.pose().T_world_imu, other.pose().T_world_imu)


@pytest.mark.parametrize("wrong", [{"gap_s": -1.0}, {"delay_s": np.nan}, {"backlog": 0}, {"history_s": "x"}])
def test_a_wrong_window_is_refused_before_the_first_frame(pairs, wrong):
    with pytest.raises(ConfigError, match="must"):
        new(pairs[0], **wrong)
