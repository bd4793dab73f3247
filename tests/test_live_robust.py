"""Live use that goes wrong: bad arguments, threads, clocks that jump, backlogs. Nothing is lost in silence."""

from __future__ import annotations

import itertools
import threading
import time
from dataclasses import dataclass

import numpy as np
import pytest

from ekfslam import LiveEKF, Noise, StereoCamera
from ekfslam.config import FilterConfig
from ekfslam.errors import (
    BacklogError,
    ClockError,
    ConfigError,
    DataError,
    EkfslamError,
    LateError,
    PosteriorError,
    StampError,
)
from ekfslam.filters.joint import JointEKF
from ekfslam.geometry import se3
from ekfslam.geometry.camera import project
from ekfslam.models.sensors.stereo import Rig

CAMERA = StereoCamera(fu_px=400.0, fv_px=400.0, cu_px=320.0, cv_px=240.0, baseline_m=0.2)
T_CAM_IMU = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0.1], [0, 0, 0, 1]])
NOISE = Noise.isotropic(sigma_v_m_s=0.1, sigma_w_rad_s=0.01, sigma_px=0.5)
POINTS_M = np.random.default_rng(5).uniform([4, -2, -1], [9, 2, 1], (6, 3))
STEP_S = 0.02  # of velocities; there is an image at every fifth


def new(**window):
    return LiveEKF.from_rig(CAMERA, T_CAM_IMU, NOISE, **window)


def twist(t):
    return np.array([0.1 * np.cos(t), 0.05 * np.sin(t), 0.0, 0.0, 0.02 * np.cos(2 * t), 0.05 * np.sin(t)])


def view(t):
    """Ids and pixels of the landmarks from near the origin."""
    rng = np.random.default_rng(round(t / STEP_S))
    ids = np.sort(rng.permutation(len(POINTS_M))[:4])
    return ids, project(CAMERA, se3.apply(T_CAM_IMU, POINTS_M[ids])) + 0.3 * rng.standard_normal((4, 4))


def messages(count):
    """Velocities at all steps, and images between them, by name, arguments and stamp."""
    for i in range(count):
        t = i * STEP_S
        yield "predict", (twist(t),), t
        if i % 5 == 0:
            yield "update", view(t + 0.4 * STEP_S), t + 0.4 * STEP_S


def sent(live, stream):
    for name, arguments, t in stream:
        getattr(live, name)(*arguments, t)
    live.flush()
    return live


def assert_same(live, other, atol=0.0):
    assert live.time_s == other.time_s
    np.testing.assert_array_equal(live.ekf.ids, other.ekf.ids)
    np.testing.assert_allclose(live.ekf.T_world_imu, other.ekf.T_world_imu, rtol=0, atol=atol)
    np.testing.assert_allclose(live.ekf.P, other.ekf.P, rtol=0, atol=atol)


GOOD = np.array([[300.0, 200.0, 280.0, 200.0]])
BAD = {
    "five velocities": lambda live, t: live.predict(np.zeros(5), t),
    "a column of velocities": lambda live, t: live.predict(np.zeros((6, 1)), t),
    "boolean velocities": lambda live, t: live.predict(np.zeros(6, dtype=bool), t),
    "a list with a boolean": lambda live, t: live.predict([0.0, 0.0, True, 0.0, 0.0, 0.0], t),
    "complex velocities": lambda live, t: live.predict(np.zeros(6, dtype=complex), t),
    "text": lambda live, t: live.predict(["0"] * 6, t),
    "objects": lambda live, t: live.predict([None] * 6, t),
    "NaN": lambda live, t: live.predict([0, 0, 0, 0, 0, np.nan], t),
    "huge velocities": lambda live, t: live.predict(np.full(6, 1e200), t),
    "a boolean stamp": lambda live, t: live.predict(np.zeros(6), True),
    "a stamp as text": lambda live, t: live.predict(np.zeros(6), f"{t}"),
    "a stamp in a list": lambda live, t: live.predict(np.zeros(6), [t]),
    "no stamp": lambda live, t: live.predict(np.zeros(6), None),
    "an infinite stamp": lambda live, t: live.update([1], GOOD, np.inf),
    "nanoseconds": lambda live, t: live.update([1], GOOD, 1.7e18),
    "three pixels": lambda live, t: live.update([1], GOOD[:, :3], t),
    "five pixels": lambda live, t: live.update([1], np.ones((1, 5)), t),
    "flat pixels": lambda live, t: live.update([1], GOOD[0], t),
    "more ids than pixels": lambda live, t: live.update([1, 2], GOOD, t),
    "ids in a column": lambda live, t: live.update([[1]], GOOD, t),
    "an id that is none": lambda live, t: live.update([1.5], GOOD, t),
    "a boolean id": lambda live, t: live.update([True], GOOD, t),
    "an id as text": lambda live, t: live.update(["7"], GOOD, t),
    "a negative id": lambda live, t: live.update([-1], GOOD, t),
    "a huge id": lambda live, t: live.update([2**63], GOOD, t),
    "an id twice": lambda live, t: live.update([3, 3], np.vstack([GOOD, GOOD]), t),
    "infinite pixels": lambda live, t: live.update([1], GOOD * np.inf, t),
    "huge pixels": lambda live, t: live.update([1], GOOD * 1e20, t),
    "ragged pixels": lambda live, t: live.update([1, 2], [[1.0, 2.0, 3.0, 4.0], [1.0]], t),
    "boolean pixels": lambda live, t: live.update([1], GOOD > 0, t),
    "a pose at no time": lambda live, t: live.pose(np.nan),
    "a pose at a boolean": lambda live, t: live.pose(False),
}


def test_a_bad_argument_raises_a_named_error_and_changes_nothing():
    clean = sent(new(delay_s=0.05), messages(60))
    for kind, bad in BAD.items():
        live = new(delay_s=0.05)
        stream = list(messages(60))
        for at, (name, arguments, t) in enumerate(stream):
            getattr(live, name)(*arguments, t)
            if at in (20, 41):
                with pytest.raises(DataError):
                    pytest.fail(f"{kind} was accepted: {bad(live, t + 0.001)}")
        live.flush()
        assert_same(live, clean)
        assert live.counts == clean.counts, kind


class FailsOnce(Rig):
    """A rig whose Jacobian fails while ``broken``."""

    broken = False

    def jacobian(self, q):
        if type(self).broken:
            raise ZeroDivisionError("a bug of mine")
        return super().jacobian(q)


class Skips(JointEKF):
    """A filter without the update of a frame."""

    def update(self, frame, ids, measured):
        if frame == 4:
            raise ZeroDivisionError
        return super().update(frame, ids, measured)


def test_an_image_that_cannot_be_processed_leaves_the_prediction():
    arguments = FailsOnce(CAMERA, T_CAM_IMU, NOISE), FilterConfig(retire="unseen", retire_after=4), np.eye(4)
    filters = LiveEKF(JointEKF(*arguments)), LiveEKF(Skips(*arguments))
    for name, message, t in messages(40):
        FailsOnce.broken = is_bad = name == "update" and round(t / STEP_S) == 20
        for live in filters:
            if is_bad:
                with pytest.raises(ZeroDivisionError):
                    live.update(*message, t)
                assert live.pose().time_s == live.time_s == t
            else:
                getattr(live, name)(*message, t)
    live, clean = filters
    assert_same(live, clean)
    assert (live.counts.failed, live.counts.taken_in, live.dropped[-1].reason) == (1, 7, "failed")


def test_stamps_that_jump_are_refused_and_move_no_pose():
    live = sent(new(), messages(30))
    before = live.pose()
    for name, arguments in (("predict", (np.ones(6),)), ("update", view(0.0))):
        with pytest.raises(ClockError, match=r"is 1e\+09 s after the newest message"):
            getattr(live, name)(*arguments, 1e9)
    with pytest.raises(ClockError, match="after the newest"):
        live.pose(1e9)
    np.testing.assert_array_equal(live.pose().T_world_imu, before.T_world_imu)
    assert live.counts.jumps == 2 and [drop.reason for drop in live.dropped] == ["jump", "jump"]


@pytest.mark.parametrize("late", ["raise", "count"])
@pytest.mark.parametrize("shift_s", [-1e6, 1e6])
def test_a_clock_that_has_jumped_is_named_and_reset_starts_again(late, shift_s):
    live, others = sent(new(late=late), messages(30)), 0
    for i in range(20):
        t = 0.6 + shift_s + i * STEP_S
        try:
            assert live.predict(twist(t), t) == []
        except ClockError as error:
            others += "call reset()" in str(error)
        except LateError:
            assert shift_s < 0 and late == "raise"
    assert others == 11  # from the tenth on
    assert len(live.dropped) == 20
    live.reset()
    assert_same(sent(live, messages(30)), sent(new(), messages(30)))
    assert live.counts.resets == 1


def test_a_clock_of_images_alone_that_has_jumped_is_named():
    live, named = sent(new(), messages(30)), []
    for i in range(12):
        with pytest.raises(ClockError) as error:
            live.update(*view(0.1 * i), 1e6 + 0.1 * i)
        named.append("call reset()" in str(error.value))
    assert named == [False] * 9 + [True] * 3


def test_a_wrong_first_stamp_does_not_freeze_the_filter():
    live = new(late="count")
    live.predict(twist(0.0), 5e8)
    for name, arguments, t in messages(60):
        getattr(live, name)(*arguments, t)
    assert live.counts.resets == 1 and live.counts.taken_in >= 9
    assert live.counts.jumps == 9 + 2  # velocities until then, and images among them


def test_repeats_are_counted():
    live = new(late="count")
    for name, arguments, t in messages(30):
        getattr(live, name)(*arguments, t)
        getattr(live, name)(*arguments, t)
    assert_same(live, sent(new(), messages(30)))
    assert live.counts.repeated + live.counts.late_velocities + live.counts.late_images == 36
    raising = new()
    raising.predict(np.zeros(6), 0.0)
    with pytest.raises(StampError, match="two velocities at 0"):
        raising.predict(np.zeros(6), 0.0)


def test_a_backlog_is_refused_by_name():
    live = sent(new(backlog=200), messages(6))
    for i in range(6, 1000):
        try:
            live.predict(twist(i * STEP_S), i * STEP_S)
        except BacklogError as error:
            assert "reset() drops them" in str(error)
            break
    assert 190 < i < 210 and live.counts.refused == 1 and live.pose().time_s == (i - 1) * STEP_S
    # Before the first image, the oldest are dropped instead.
    early = new(backlog=200)
    for i in range(1000):
        early.predict(twist(i * STEP_S), i * STEP_S)
    early.update(*view(0.0), 999 * STEP_S)
    assert early.counts.refused == 0 and early.counts.taken_in == 1
    assert early.counts.unused == 8 * 101  # a half of those that wait, each time
    assert new(backlog=1).backlog == 1


def test_images_without_velocities_wait_up_to_a_bound(monkeypatch):
    monkeypatch.setattr("ekfslam.filters.live.MOST_IMAGES", 3)
    live = new()
    for i in range(3):
        live.update(*view(0.1 * i), 0.1 * i)
    with pytest.raises(BacklogError, match="too many images wait"):
        live.update(*view(0.3), 0.3)
    for t in (0.3, 0.05, -0.1):  # an older one waits no less
        with pytest.raises(BacklogError, match="too many images wait"):
            live.update(*view(0.3), t)
    assert (live.counts.images, live.counts.refused) == (3, 4)


def naive(live, log, t):
    """The prediction from the last image by all velocities at once."""
    then = live.ekf.without_landmarks()
    begin, stamps = live.time_s, sorted(s for s in log if s > live.time_s)
    T, at = then.T_world_imu, begin
    for s in stamps:
        T, at = T @ se3.exp(log[s] * (min(s, t) - at)), min(s, t)
        if s >= t:
            break
    return T @ se3.exp(log[stamps[-1]] * (t - at)) if at < t else T


def test_poses_far_from_the_last_image_are_those_of_all_velocities_in_any_order():
    rng, live = np.random.default_rng(0), sent(new(), messages(6))
    log, base = {}, live.time_s
    for _ in range(60):
        t = base + rng.uniform(0.01, 9.0)
        log[t] = rng.standard_normal(6)
        live.predict(log[t], t)
        for wanted in (live.newest_s, base + rng.uniform(0.02, 9.0)):
            np.testing.assert_allclose(live.pose(wanted).T_world_imu, naive(live, log, wanted), atol=1e-9)


def test_the_pose_costs_the_same_after_many_velocities():
    live, took = sent(new(), messages(6)), []
    for i in range(6, 12_006):
        live.predict(twist(i * STEP_S), i * STEP_S)
        if i % 50 == 0:
            begin = time.process_time()
            live.pose()
            took.append(time.process_time() - begin)
    assert np.median(took[-40:]) < 4.0 * np.median(took[:40])


def test_the_log_is_bounded_by_choice():
    live, other = new(log_frames=10), new(log_frames=np.inf)
    for name, arguments, t in messages(200):
        for each in (live, other):
            getattr(each, name)(*arguments, t)
    assert_same(live, other)
    assert live.counts.log_drops == 4 and other.ekf.log().frames == 40
    with pytest.raises(PosteriorError, match="log_frames"):
        live.ekf.log()
    assert len(live.ekf.landmarks().id) == len(live.ekf.ids)
    with pytest.raises(ConfigError, match="must be positive"):
        new(log_frames=0)


@dataclass
class Tape:
    """Messages that a filter accepted."""

    live: LiveEKF

    def __post_init__(self):
        self.accepted, self.refused = [], 0

    def send(self, name, arguments, t):
        try:
            getattr(self.live, name)(*arguments, t)
        except EkfslamError:
            self.refused += 1
        else:
            self.accepted.append((name, arguments, t))


def test_three_threads_give_the_state_of_a_clean_replay():
    tape, count = Tape(new(delay_s=0.4)), 1500
    barrier, failures = threading.Barrier(3), []

    def run(kind):
        try:
            for k, block in itertools.groupby(messages(count), key=lambda message: int(message[2] / 0.1)):
                barrier.wait(timeout=60)  # threads are never further apart than the delay
                for name, arguments, t in block:
                    if name == kind:
                        tape.send(name, arguments, t)
                    elif kind == "pose" and tape.live.time_s is not None:
                        found = tape.live.pose()
                        assert np.isfinite(found.T_world_imu).all() and np.linalg.eigvalsh(found.covariance)[0] > 0, k
        except Exception as error:
            failures.append(error)
            barrier.abort()

    threads = [threading.Thread(target=run, args=(kind,)) for kind in ("predict", "update", "pose")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    tape.live.flush()
    assert not failures and tape.refused == 0 and len(tape.accepted) == count + count // 5
    replay = sent(new(delay_s=0.4), sorted(tape.accepted, key=lambda message: message[2]))
    assert_same(tape.live, replay)
    assert tape.live.counts.held == 0


def disturbed(count, rng):
    """Messages with drops, repeats, swaps and jumps of stamps."""
    waiting = []
    for name, arguments, t in messages(count):
        chance = rng.random()
        if chance < 0.02:
            continue
        waiting.append((name, arguments, t + (1e9 if chance > 0.995 else -1e9 if chance > 0.99 else 0.0)))
        if chance > 0.97:
            waiting.append((name, arguments, t))
        if len(waiting) > 6:
            rng.shuffle(waiting)
            yield from waiting[:3]
            del waiting[:3]
    yield from waiting


def test_disturbed_messages_leave_the_state_of_a_clean_replay():
    tape = Tape(new(delay_s=0.3))
    for name, arguments, t in disturbed(1500, np.random.default_rng(2)):
        tape.send(name, arguments, t)
    tape.live.flush()
    replay = sent(new(delay_s=0.3), sorted(tape.accepted, key=lambda message: message[2]))
    assert_same(tape.live, replay)
    counts = tape.live.counts
    dropped = counts.jumps + counts.repeated + counts.late_velocities + counts.late_images
    assert tape.refused == dropped > 20 and counts.out_of_order > 100 and counts.held == 0
