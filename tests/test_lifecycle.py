"""When landmarks leave the state, and which of them come back with one that is seen again."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ekfslam import Config, FilterConfig, HygieneConfig, run
from ekfslam.data.sequence import Noise, Observations, Sequence, Truth
from ekfslam.data.simulate import CAMERA, T_CAM_IMU
from ekfslam.filters.lifecycle import PATIENCE
from ekfslam.geometry import se3

RAW = HygieneConfig(
    min_disparity_sigma=0.0,
    max_row_mismatch_sigma=0.0,
    restart_at_repeats=False,
    reused_id_sigma=0.0,
    disparity_jump_sigma=0.0,
    moving=False,
)
STEP_S = 0.1
NOISE = Noise.isotropic(0.1, 0.01, 0.5)
COMPANY = range(100, 106)  # landmarks that are seen in every frame


def scene(frames, seen):
    """A slow drive; landmarks ahead of it are seen in the frames asked for, and the company in all of them.

    Args:
        frames: How many.
        seen: Landmark id to frames.
    """
    rng = np.random.default_rng(3)
    seen = {**seen, **{i: range(frames) for i in COMPANY}}
    twist = np.tile([1.0, 0.0, 0.0, 0.0, 0.0, 0.05], (frames, 1))
    T_world_imu = [np.eye(4)]
    for u in twist[1:]:
        T_world_imu.append(T_world_imu[-1] @ se3.exp(STEP_S * u))
    T_world_imu = np.array(T_world_imu)
    place = {i: rng.uniform([12, -6, -2], [25, 6, 3]) for i in seen}
    frame, landmark = np.array([(k, i) for i, at in seen.items() for k in at]).T
    q = se3.apply(T_CAM_IMU @ se3.inverse(T_world_imu[frame]), np.array([place[i] for i in landmark.tolist()])[:, None])
    x, y, z = q[:, 0].T
    assert z.min() > 3
    u, v = CAMERA.fu_px * x / z + CAMERA.cu_px, CAMERA.fv_px * y / z + CAMERA.cv_px
    pixels = np.stack([u, v, u - CAMERA.fu_px * CAMERA.baseline_m / z, v], axis=-1)
    return Sequence(
        name="scene",
        source="tests",
        time_s=STEP_S * np.arange(frames),
        twist=twist + NOISE.twist_std * rng.standard_normal(twist.shape),
        camera=CAMERA,
        T_cam_imu=T_CAM_IMU,
        observations=Observations(frame, landmark, pixels + 0.5 * rng.standard_normal(pixels.shape)),
        truth=Truth(np.arange(frames), T_world_imu),
        noise=NOISE,
    )


def until(sequence, frames):
    """The first frames of a sequence."""
    o, truth = sequence.observations, sequence.truth
    early = o.frame < frames
    return dataclasses.replace(
        sequence,
        time_s=sequence.time_s[:frames],
        twist=sequence.twist[:frames],
        observations=Observations(o.frame[early], o.landmark[early], o.pixels_px[early]),
        truth=Truth(truth.frame[:frames], truth.T_world_imu[:frames]),
    )


def filtered(sequence, **settings):
    settings = {"retire": "unseen", "gate_probability": 1.0, "split_after": 0, **settings}
    return run(sequence, "full", Config(filter=FilterConfig(**settings), hygiene=RAW))


# --- leaving ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("after", [1, 2, 5])
def test_a_landmark_leaves_when_it_was_seen_last_so_many_frames_ago(after):
    last = 4
    world = scene(20, {7: range(last + 1)})
    for frame, has_left in ((last + after - 1, False), (last + after, True)):
        assert filtered(until(world, frame + 1), retire_after=after).counts["retired"] == has_left


@pytest.mark.parametrize(("revive", "count"), [(-1, "reappeared"), (0, "revived")])
@pytest.mark.parametrize("after", [1, 2, 5])
def test_a_landmark_that_is_seen_again_by_then_has_never_left(after, revive, count):
    last = 4
    for again, has_left in ((last + after, False), (last + after + 1, True)):
        world = scene(20, {7: [*range(last + 1), *range(again, 20)]})
        counts = filtered(world, retire_after=after, revive=revive).counts
        assert counts["retired"] == counts[count] == has_left
        assert counts["revived"] + counts["reappeared"] == has_left


def test_a_landmark_that_was_retired_twice_has_its_last_estimate():
    once, twice = range(5), [*range(5), *range(10, 15)]
    first, last = (filtered(scene(20, {7: seen}), retire_after=1, revive=0) for seen in (once, twice))
    assert (first.counts["retired"], last.counts["retired"], last.counts["revived"]) == (1, 2, 1)
    before, after = (result.landmarks.only(np.flatnonzero(result.landmarks.id == 7)) for result in (first, last))
    assert (before.last_frame.item(), after.last_frame.item()) == (4, 14)
    assert (before.observations.item(), after.observations.item()) == (5, 10)
    assert np.trace(after.covariance[0]) < np.trace(before.covariance[0])


# --- coming back ------------------------------------------------------------------------------------------------------

RETURN = 59
RETURNING = {40: range(10, 13), 3: range(30, 33)}
# Neither the order of their ids, nor that of their first or last frames, is that of their distances in time.
OTHERS = {
    21: range(4),
    8: range(14, 16),
    30: range(18, 21),
    2: range(21, 23),
    17: range(22, 28),
    25: range(31, 35),
    11: range(33, 37),
    5: range(41, 45),
    14: range(45, 51),
}


def distance_in_time(frames):
    """Frames between the nearest sightings of a landmark and of any that returns."""
    return min(abs(k - r) for k in frames for own in RETURNING.values() for r in own)


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["invariant", "fej"])
@pytest.mark.parametrize("revive", [0, 1, 2, 3, 5, 8, 100])
def test_those_seen_nearest_in_time_come_back_with_a_landmark(revive, variant):
    by_distance = sorted(OTHERS, key=lambda i: distance_in_time(OTHERS[i]))
    assert len({distance_in_time(frames) for frames in OTHERS.values()}) == len(OTHERS)
    world = scene(RETURN + 1, OTHERS | {i: [*frames, RETURN] for i, frames in RETURNING.items()})
    before, after = (
        filtered(part, variant=variant, retire_after=2, revive=revive).landmarks
        for part in (until(world, RETURN), world)
    )
    np.testing.assert_array_equal(before.id, after.id)
    # What is out of the state keeps its last estimate, to the last bit; what came back has learned from what followed.
    changed = set(after.id[(after.covariance != before.covariance).any(axis=(1, 2))].tolist())
    assert changed - set(COMPANY) == set(RETURNING) | set(by_distance[:revive])


@pytest.mark.parametrize("gap", [1, 4])
def test_a_neighbour_that_came_back_waits_twice_its_distance_in_time_to_be_seen(gap):
    first, back, after = 6, 12, 2
    leaves = back + 2 * gap + PATIENCE + after
    # Landmark 3 brings landmark 8 back, which was last seen so many frames before it and is not seen again.
    world = scene(leaves + 1, {8: [first - gap], 3: [first, first + 1, back]})
    early = filtered(until(world, leaves), retire_after=after, revive=1)
    late = filtered(world, retire_after=after, revive=1)
    assert early.counts["retired"] == 3, "landmark 8, and landmark 3 twice"
    assert late.counts["retired"] == 4, "now landmark 8 as well"
