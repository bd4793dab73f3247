"""Track hygiene: every rule on tracks made for it and on the recording that motivated it, and its report everywhere."""

import dataclasses
import json

import h5py
import numpy as np
import pytest
from reprojection import reprojection_errors
from support.reference import small_world
from support.same import assert_same

from ekfslam import open_sequence
from ekfslam.cli import main
from ekfslam.config import Config, FilterConfig, HygieneConfig
from ekfslam.data.hygiene import RULES, clean_tracks, jumps
from ekfslam.data.sequence import Noise, Observations
from ekfslam.data.simulate import builtin
from ekfslam.data.tracks import cut_tracks, inspect_tracks, repeated_frames, successive
from ekfslam.errors import ArchiveError, DuplicateObservationError, TruthError
from ekfslam.geometry import se3
from ekfslam.geometry.camera import project
from ekfslam.resolve import noise_of
from ekfslam.runner import run
from ekfslam.smoother.posterior import posterior
from ekfslam.storage.archive import open_result, write_archive

OFF = HygieneConfig(
    restart_at_repeats=False,
    jump_sigma=0.0,
    reused_id_sigma=0.0,
    min_disparity_sigma=0.0,
    max_row_mismatch_sigma=0.0,
    max_depth_error=0.0,
    min_observations=0,
    disparity_jump_sigma=0.0,
    moving=False,
)
NOISE = Noise(np.zeros(6), np.ones(4))


def only(**rule):
    return dataclasses.replace(OFF, **rule)


def with_tracks(sequence, observations):
    return dataclasses.replace(sequence, observations=observations)


def with_pixels(sequence, pixels):
    o = sequence.observations
    return with_tracks(sequence, Observations(o.frame, o.landmark, pixels))


def found_by(report, name):
    """(frame, landmark, continuation) of the findings of one rule."""
    which = report.rule == RULES.index(name)
    return list(
        zip(
            report.frame[which].tolist(),
            report.landmark[which].tolist(),
            report.continuation[which].tolist(),
            strict=True,
        )
    )


def assert_nothing_is_silent(before, after, report):
    """Dropped observations are listed, all others are there with their pixels, and under their ids unless cut."""
    assert report.observations == len(before) == len(after) + report.dropped
    listed = {(k, i) for k, i, new in zip(report.frame, report.landmark, report.continuation, strict=True) if new < 0}
    assert len(listed) == report.dropped
    cuts = {}
    for k, i, new in zip(report.frame, report.landmark, report.continuation, strict=True):
        if new >= 0:
            cuts.setdefault(int(i), []).append((int(k), int(new)))
    expected = {}
    for k, i, z in zip(before.frame, before.landmark, before.pixels_px, strict=True):
        if (k, i) not in listed:
            id_there = max([(start, new) for start, new in cuts.get(int(i), []) if start <= k], default=(0, int(i)))[1]
            expected[int(k), id_there] = z
    assert expected.keys() == set(zip(after.frame.tolist(), after.landmark.tolist(), strict=True))
    for k, i, z in zip(after.frame.tolist(), after.landmark.tolist(), after.pixels_px, strict=True):
        np.testing.assert_array_equal(expected[k, i], z)


def track(world, least=8):
    """The longest track of a world: its id and the rows of its observations."""
    o = world.observations
    ids, count = np.unique(o.landmark, return_counts=True)
    assert count.max() >= least
    i = int(ids[np.argmax(count)])
    return i, np.flatnonzero(o.landmark == i)


# The pieces


def test_a_track_is_cut_before_what_is_marked():
    frame = np.array([0, 1, 2, 3, 0, 1, 2, 1])
    landmark = np.array([4, 4, 4, 4, 2, 2, 2, 9])
    o = Observations(frame, landmark, np.zeros((8, 4)))
    starts = np.isin(o.frame, [1, 3]) & (o.landmark == 4) | (o.frame == 2) & (o.landmark == 2)
    cut = cut_tracks(o, starts, 50)
    got = {(int(k), int(i)): int(new) for k, i, new in zip(o.frame, o.landmark, cut, strict=True)}
    assert got == {
        (0, 4): 4, (1, 4): 51, (2, 4): 51, (3, 4): 52, (0, 2): 2, (1, 2): 2, (2, 2): 50, (1, 9): 9
    }  # fmt: skip


def test_switched_off_nothing_is_done():
    world = small_world()
    observations, report = clean_tracks(world, world.noise, OFF)
    assert observations is world.observations
    assert len(report.rule) == 0 and not any(report.counts.values())
    assert all(line.endswith("switched off") for line in report.lines(dataclasses.asdict(OFF))[:-1])


@pytest.mark.parametrize("world", ["city", "loop"])
def test_simulated_worlds_keep_all_they_have(world):
    sequence = builtin(world)
    observations, report = clean_tracks(sequence, sequence.noise, HygieneConfig())
    assert_same(observations, sequence.observations)
    assert not any(report.counts.values())


def test_rules_do_not_stumble_over_missing_tracks():
    none = Observations(np.empty(0, int), np.empty(0, int), np.empty((0, 4)))
    bare = dataclasses.replace(small_world(), observations=none, attributes={"tracks": "none"})
    everything = HygieneConfig(jump_sigma=5.0, max_depth_error=0.5, min_observations=2)
    observations, report = clean_tracks(bare, NOISE, everything)
    assert len(observations) == 0 and not any(report.counts.values())


def test_a_run_goes_on_when_hygiene_leaves_nothing():
    world = small_world(frames=10)
    result = run(world, "full", Config(hygiene=only(min_observations=1000)))
    assert result.counts["dropped by hygiene"] == len(world.observations)
    np.testing.assert_allclose(result.T_world_imu, run(world, "dead-reckoning").T_world_imu, atol=1e-12)


# Repeated frames


def test_tracks_are_cut_where_a_frame_repeats_the_one_before():
    frame = np.array([0, 1, 2, 3, 4, 5, 0, 1, 2, 3, 3, 4])
    landmark = np.array([7, 7, 7, 7, 7, 7, 3, 3, 3, 3, 9, 9])
    pixels = np.random.default_rng(0).uniform(100, 200, (12, 4))
    pixels[2], pixels[8] = pixels[1], pixels[7]  # frame 2 repeats frame 1
    pixels[4], pixels[11] = pixels[3], pixels[10]  # frame 4 repeats frame 3
    observations = Observations(frame, landmark, pixels)
    twist = np.tile([5.0, 0, 0, 0, 0, 0], (6, 1))
    moving = with_tracks(dataclasses.replace(small_world(frames=6), twist=twist), observations)
    np.testing.assert_array_equal(repeated_frames(observations, twist), [2, 4])
    cut, report = clean_tracks(moving, NOISE, only(restart_at_repeats=True))
    by_id = {i: cut.frame[cut.landmark == i].tolist() for i in cut.ids.tolist()}
    found = found_by(report, "repeated frame")
    assert sorted((old, k) for k, old, _ in found) == [(3, 2), (7, 2), (7, 4), (9, 4)]
    assert report.counts["hygiene: repeated frame"] == 4 and report.dropped == 0
    new = {(old, k): i for k, old, i in found}
    assert by_id[3] == [0, 1] and by_id[new[3, 2]] == [2, 3]
    assert by_id[7] == [0, 1] and by_id[new[7, 2]] == [2, 3] and by_id[new[7, 4]] == [4, 5]
    assert by_id[9] == [3] and by_id[new[9, 4]] == [4]
    assert_nothing_is_silent(observations, cut, report)
    standing = dataclasses.replace(moving, twist=np.zeros((6, 6)))
    assert not any(clean_tracks(standing, NOISE, only(restart_at_repeats=True))[1].counts.values())


@pytest.mark.data
def test_repeated_frames_of_the_reports_recording(data_path):
    sequence = open_sequence(data_path("ece276a/0027.npz"))
    noise = noise_of(sequence, Config())
    observations, report = clean_tracks(sequence, noise, HygieneConfig())
    assert_nothing_is_silent(sequence.observations, observations, report)
    frames = {k for k, _, _ in found_by(report, "repeated frame")}
    assert len(frames) == 91
    np.testing.assert_array_equal(sorted(frames), repeated_frames(sequence.observations, sequence.twist))
    # No track leads across any more, where each had the very same pixels before.
    assert not np.isin(observations.frame[successive(observations)[1]], list(frames)).any()


def test_a_run_without_the_rule_has_fewer_and_longer_tracks():
    world = small_world(frames=10)
    o = world.observations
    pixels = o.pixels_px.copy()
    earlier, later = successive(o)
    here = o.frame[later] == 4
    pixels[later[here]] = pixels[earlier[here]]
    spoilt = with_pixels(world, pixels)
    loose = FilterConfig(gate_probability=1.0, split_after=0)
    on = run(spoilt, "full", Config(filter=loose))
    off = run(spoilt, "full", Config(filter=loose, hygiene=HygieneConfig(restart_at_repeats=False)))
    assert on.counts["hygiene: repeated frame"] > 3
    assert off.counts["hygiene: repeated frame"] == 0
    assert len(on.landmarks) > len(off.landmarks)


# Limits of disparity, row mismatch and depth


@pytest.mark.parametrize("sigma_px", [0.5, 2.0])
def test_limits_follow_the_pixel_noise(sigma_px):
    world = small_world(sigma_px=0.01)
    noise = Noise.isotropic(0.1, 0.01, sigma_px)
    pixels, deviation = world.observations.pixels_px.copy(), np.sqrt(2.0) * sigma_px
    pixels[0, 2] = pixels[0, 0] - 2.99 * deviation
    pixels[1, 2] = pixels[1, 0] - 3.01 * deviation
    pixels[2, 2] = pixels[2, 0] + 1.0
    pixels[3:, 2] = pixels[3:, 0] - 4.0 * deviation
    pixels[:, 3] = pixels[:, 1]
    pixels[4, 3] -= 9.9 * deviation
    pixels[5, 3] -= 10.1 * deviation
    pixels[6, 3] += 10.1 * deviation
    spoilt = with_pixels(world, pixels)
    ids = world.observations.landmark
    assert (world.observations.frame[:7] == 0).all()
    rules = only(min_disparity_sigma=3.0, max_row_mismatch_sigma=10.0)
    observations, report = clean_tracks(spoilt, noise, rules)
    assert found_by(report, "disparity") == [(0, ids[0], -1), (0, ids[2], -1)]
    assert found_by(report, "row mismatch") == [(0, ids[5], -1), (0, ids[6], -1)]
    assert report.counts["dropped by hygiene"] == 4
    assert_nothing_is_silent(spoilt.observations, observations, report)


@pytest.mark.data
def test_disparities_without_depth_on_the_highway(data_path):
    sequence = open_sequence(data_path("ece276a/0042.npz"))
    noise, z = noise_of(sequence, Config()), sequence.observations.pixels_px
    deviation = np.sqrt(2.0) * noise.pixel_std_px[0]
    disparity = z[:, 0] - z[:, 2]
    assert (disparity <= 0).mean() == pytest.approx(0.065, abs=0.002)
    observations, report = clean_tracks(sequence, noise, HygieneConfig())
    cut = (report.continuation >= 0).sum()  # where the dropping leaves a gap
    assert report.counts["hygiene: disparity"] - cut == report.dropped == (disparity <= deviation).sum()
    assert cut > 0
    assert inspect_tracks(observations, sequence.twist).returning_tracks == 0
    assert report.counts["hygiene: row mismatch"] == 0  # |vL - vR| is never above 1 px
    strict, _ = clean_tracks(sequence, noise, only(max_row_mismatch_sigma=0.5))
    assert np.abs(strict.pixels_px[:, 1] - strict.pixels_px[:, 3]).max() <= 0.5 * deviation
    assert 0 < len(strict) < len(sequence.observations)
    assert_nothing_is_silent(sequence.observations, observations, report)


@pytest.mark.data
def test_tracks_whose_depth_is_never_known_can_be_dropped_as_a_whole(data_path):
    sequence = open_sequence(data_path("ece276a/0042.npz"))
    noise = noise_of(sequence, Config())
    observations, report = clean_tracks(sequence, noise, only(max_depth_error=0.25))

    def nearest(o):
        return {i: (z := o.pixels_px[o.landmark == i])[:, 0].max() and (z[:, 0] - z[:, 2]).max() for i in o.ids}

    limit = 4.0 * np.sqrt(2.0) * noise.pixel_std_px[0]  # a deviation of a quarter of the disparity
    before = nearest(sequence.observations)
    assert {i for i, d in before.items() if d >= limit} == set(observations.ids.tolist())
    assert report.dropped == np.isin(sequence.observations.landmark, [i for i in before if before[i] < limit]).sum() > 0
    assert (observations.pixels_px[:, 0] - observations.pixels_px[:, 2]).min() < limit  # the rest is kept whole
    assert_nothing_is_silent(sequence.observations, observations, report)


# Jumps


def course(frames=20, tracks=8, seed=0):
    """Tracks that flow, faster and faster, each in its own direction; pixel noise of 1 px."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames)
    flow = rng.uniform(-4, 4, (tracks, 2))
    u = 600 + flow[:, :1] * t + 0.1 * flow[:, :1] * t**2
    v = 180 + flow[:, 1:] * t
    z = np.stack([u, v, u - 15, v], axis=-1) + rng.normal(size=(tracks, frames, 4))
    landmark, frame = np.divmod(np.arange(tracks * frames), frames)
    return Observations(frame, landmark, z.reshape(-1, 4))


def moved(o, which, by):
    pixels = o.pixels_px.copy()
    pixels[which] += by
    return Observations(o.frame, o.landmark, pixels)


@pytest.mark.parametrize("tracks", [2, 8])  # alone, and in company
def test_a_track_that_jumps_is_cut_and_a_bad_observation_is_not(tracks):
    o = course(tracks=tracks)
    assert not jumps(o, NOISE, 5.0).any()
    by = np.array([20.0, -12.0, 18.0, -12.0])
    for start in (3, 10, 17):
        found = jumps(moved(o, (o.landmark == 1) & (o.frame >= start), by), NOISE, 5.0)
        assert list(zip(o.frame[found], o.landmark[found], strict=True)) == [(start, 1)]
    for bad in range(20):
        for size in (1.0, 3.0, 10.0):
            assert not jumps(moved(o, (o.landmark == 1) & (o.frame == bad), size * by), NOISE, 5.0).any()
    # Less than the noise allows, or of all tracks at once, is no jump.
    assert not jumps(moved(o, (o.landmark == 1) & (o.frame >= 10), by / 5), NOISE, 5.0).any()
    if tracks == 8:
        assert not jumps(moved(o, o.frame >= 10, by), NOISE, 5.0).any()


def test_a_jump_cuts_the_track_in_two():
    world = small_world(sigma_px=0.3)
    i, rows = track(world)
    start = len(rows) // 2
    pixels = world.observations.pixels_px.copy()
    pixels[rows[start:]] += [150.0, 0, 150.0, 0]
    spoilt = with_pixels(world, pixels)
    observations, report = clean_tracks(spoilt, world.noise, only(jump_sigma=5.0))
    k = int(world.observations.frame[rows[start]])
    assert (k, i) in {(k, i) for k, i, _ in found_by(report, "jump")}
    assert_nothing_is_silent(spoilt.observations, observations, report)
    assert report.dropped == 0


@pytest.mark.data
def test_what_jumps_on_the_highway_has_jumped(data_path):
    """Few tracks jump in the recordings, but what is found would be off by tens of pixels at the true poses."""
    sequence = open_sequence(data_path("ece276a/0042.npz"), truth=data_path("kitti_odometry_poses/01.txt"))
    noise = noise_of(sequence, Config())
    o = sequence.observations
    found = np.flatnonzero(jumps(o, noise, 5.0) & (o.pixels_px[:, 0] - o.pixels_px[:, 2] > 2.0))
    assert 1 <= len(found) <= 10
    T_cam_world = sequence.T_cam_imu @ se3.inverse(sequence.truth.T_world_imu)
    for j in found:
        before = np.flatnonzero((o.landmark == o.landmark[j]) & (o.frame == o.frame[j] - 1))[0]
        uL, vL, uR, _ = o.pixels_px[before]
        camera = sequence.camera
        depth = camera.fu_px * camera.baseline_m / (uL - uR)
        q = depth * np.array([(uL - camera.cu_px) / camera.fu_px, (vL - camera.cv_px) / camera.fv_px, 1.0])
        point = se3.apply(se3.inverse(T_cam_world[o.frame[before]]), q[None])
        error = project(camera, se3.apply(T_cam_world[o.frame[j]], point))[0] - o.pixels_px[j]
        assert np.linalg.norm(error[:3]) > 10.0
    assert clean_tracks(sequence, noise, only(jump_sigma=5.0))[1].counts["hygiene: jump"] >= len(found)


# Right images


def with_doubled_disparities(world, frame):
    """Tracks seen in ``frame`` and in the one before, with twice their disparity from there on; and which they are."""
    o = world.observations
    there = np.intersect1d(o.landmark[o.frame == frame - 1], o.landmark[o.frame == frame])
    pixels = o.pixels_px.copy()
    later = np.isin(o.landmark, there) & (o.frame >= frame)
    pixels[later, 2] -= pixels[later, 0] - pixels[later, 2]
    return with_pixels(world, pixels), there


@pytest.mark.parametrize("frame", [1, 12])
@pytest.mark.parametrize("speed_error", [0.0, 0.5])
def test_tracks_are_dropped_whose_disparities_jump_together(frame, speed_error):
    world = small_world(sigma_px=0.3, sigma_v=0.05, sigma_w=0.002)
    noise = dataclasses.replace(world.noise, twist_std=np.hypot(world.noise.twist_std, np.repeat([speed_error, 0], 3)))
    twist = world.twist + speed_error * np.random.default_rng(1).standard_normal(world.twist.shape) * (
        [1] * 3 + [0] * 3
    )
    world, rule = dataclasses.replace(world, twist=twist), only(disparity_jump_sigma=3.0)
    assert not any(clean_tracks(world, noise, rule)[1].counts.values())
    jumped, ids = with_doubled_disparities(world, frame)
    observations, report = clean_tracks(jumped, noise, rule)
    assert len(ids) >= 5
    np.testing.assert_array_equal(np.unique(report.landmark), ids)
    assert not np.isin(observations.landmark, ids).any()
    assert_nothing_is_silent(jumped.observations, observations, report)
    assert clean_tracks(jumped, noise, OFF)[0] is jumped.observations


def test_disparities_that_change_in_every_frame_are_no_jump():
    """As those of traffic do; nor is the jump of a minority one, which tells nothing of the frame."""
    world, rule = small_world(sigma_px=0.3, sigma_v=0.05, sigma_w=0.002), only(disparity_jump_sigma=3.0)
    o = world.observations
    ids, since, frames = o.ids, np.zeros(len(o)), np.bincount(np.searchsorted(o.ids, o.landmark))
    for i in ids:
        since[o.landmark == i] = o.frame[o.landmark == i] - o.frame[o.landmark == i].min()
    pixels = o.pixels_px.copy()
    pixels[:, 2] -= 8.0 * since  # px of disparity a frame
    assert frames.max() > 3
    assert not any(clean_tracks(with_pixels(world, pixels), world.noise, rule)[1].counts.values())
    jumped, there = with_doubled_disparities(world, 12)
    few = np.isin(o.landmark, there[: len(there) // 3])
    pixels = np.where(few[:, None], jumped.observations.pixels_px, o.pixels_px)
    assert not any(clean_tracks(with_pixels(world, pixels), world.noise, rule)[1].counts.values())


@pytest.mark.data
@pytest.mark.parametrize(("name", "tracks"), [("09_26_drive_0001", 48), ("09_26_drive_0009", 0)])
def test_first_disparities_of_the_drives_are_half_of_what_follows(data_path, name, tracks):
    """On all but one; by the flow the first ones are right, and all depths after them half of the true."""
    sequence = open_sequence(data_path(f"utias/2011_{name}_sync_KLT.mat"))
    _, report = clean_tracks(sequence, noise_of(sequence, Config()), only(disparity_jump_sigma=3.0))
    assert len(np.unique(report.landmark)) == tracks
    o = sequence.observations
    for i in np.unique(report.landmark):
        assert o.frame[o.landmark == i].min() == 0


# Ids


def test_an_id_that_comes_back_elsewhere_is_another_one():
    world = small_world(sigma_px=0.3, sigma_v=0.05, sigma_w=0.002)
    o = world.observations
    i, rows = track(world, least=12)
    gap, back = rows[4:7], rows[7:]
    keep = np.setdiff1d(np.arange(len(o)), gap)
    truthful = with_tracks(world, Observations(o.frame[keep], o.landmark[keep], o.pixels_px[keep]))
    _, report = clean_tracks(truthful, world.noise, only(reused_id_sigma=3.0))
    assert not any(report.counts.values())
    pixels = o.pixels_px.copy()
    pixels[back] += [200.0, 40.0, 200.0, 40.0]
    reused = with_tracks(world, Observations(o.frame[keep], o.landmark[keep], pixels[keep]))
    observations, report = clean_tracks(reused, world.noise, only(reused_id_sigma=3.0))
    assert [(k, old) for k, old, _ in found_by(report, "re-used id")] == [(int(o.frame[back[0]]), i)]
    assert_nothing_is_silent(reused.observations, observations, report)
    # The same without a gap is not its business, nor is a gap when it is switched off.
    assert not any(clean_tracks(with_pixels(world, pixels), world.noise, only(reused_id_sigma=3.0))[1].counts.values())
    assert clean_tracks(reused, world.noise, OFF)[0] is reused.observations


@pytest.mark.data
def test_landmarks_that_come_back_in_starry_night_are_no_re_used_ids(data_path):
    sequence = open_sequence(data_path("utias/dataset3.mat"))
    earlier, later = successive(sequence.observations)
    gaps = sequence.observations.frame[later] - sequence.observations.frame[earlier] > 1
    assert gaps.sum() > 200
    _, report = clean_tracks(sequence, noise_of(sequence, Config()), only(reused_id_sigma=3.0))
    assert not any(report.counts.values())
    # Were the landmarks to swap their ids, it would show where the gap is short and they are far apart.
    o = sequence.observations
    swapped = np.where(o.frame >= 300, o.ids.max() - o.landmark, o.landmark)
    swapped_tracks = with_tracks(sequence, Observations(o.frame, swapped, o.pixels_px))
    _, report = clean_tracks(swapped_tracks, noise_of(sequence, Config()), only(reused_id_sigma=3.0))
    assert report.counts["hygiene: re-used id"] > 0
    assert (report.frame >= 300).all()


def test_an_id_twice_in_a_frame_is_refused():
    world = small_world()
    o = world.observations
    twice = Observations(
        np.append(o.frame, o.frame[5]),
        np.append(o.landmark, o.landmark[5]),
        np.vstack([o.pixels_px, o.pixels_px[5] + 1]),
    )
    with pytest.raises(DuplicateObservationError, match=rf"landmark {o.landmark[5]} is observed twice in frame 0"):
        with_tracks(world, twice)


# Short tracks


def test_short_tracks_are_dropped_pieces_included():
    world = small_world()
    o = world.observations
    length = np.bincount(o.landmark)[o.landmark]
    observations, report = clean_tracks(world, world.noise, only(min_observations=5))
    assert report.counts["hygiene: too short"] == report.dropped == (length < 5).sum() > 0
    assert np.bincount(observations.landmark)[observations.ids].min() == 5
    assert_nothing_is_silent(o, observations, report)


@pytest.mark.data
def test_short_pieces_after_cuts_are_dropped_under_their_first_id(data_path):
    sequence = open_sequence(data_path("ece276a/0027.npz"))
    rules = HygieneConfig(min_observations=3)
    observations, report = clean_tracks(sequence, noise_of(sequence, Config()), rules)
    assert np.unique(observations.landmark, return_counts=True)[1].min() == 3
    assert report.counts["hygiene: too short"] > 0
    assert np.isin(report.landmark, sequence.observations.ids).all()
    assert_nothing_is_silent(sequence.observations, observations, report)


# Where it shows


@pytest.fixture(scope="module")
def spoilt():
    """A small world in which every rule has something to do."""
    world = small_world(frames=30, sigma_px=0.3)
    pixels = world.observations.pixels_px.copy()
    pixels[0, 2] = pixels[0, 0] - 0.1
    pixels[1, 3] += 30.0
    earlier, later = successive(world.observations)
    here = world.observations.frame[later] == 12
    pixels[later[here]] = pixels[earlier[here]]
    return with_pixels(world, pixels)


@pytest.mark.parametrize("mode", ["full", "mapping-only"])
def test_every_observation_is_accounted_for(spoilt, mode):
    result = run(spoilt, mode, Config(hygiene=HygieneConfig(min_observations=3)))
    counts = result.counts
    assert counts["hygiene: disparity"] == counts["hygiene: row mismatch"] == 1
    assert counts["hygiene: repeated frame"] > 0 and counts["hygiene: too short"] > 0
    assert counts["dropped by hygiene"] == 2 + counts["hygiene: too short"]
    assert counts["accepted"] + counts["rejected"] + counts["dropped by hygiene"] == len(spoilt.observations)


def test_dead_reckoning_looks_at_no_tracks(spoilt):
    assert run(spoilt, "dead-reckoning").hygiene is None


@pytest.mark.slow
def test_the_report_comes_back_from_the_archive_and_info_prints_it(spoilt, tmp_path, capsys):
    path = tmp_path / "a.h5"
    config = Config(hygiene=HygieneConfig(min_observations=3))
    results = {mode: run(spoilt, mode, config) for mode in ("full", "dead-reckoning")}
    write_archive(path, spoilt, results)
    read = open_result(path, "full")
    assert_same(read.hygiene, results["full"].hygiene)
    assert read.counts == results["full"].counts
    assert len(read.hygiene.rule) > 10
    assert open_result(path, "dead-reckoning").hygiene is None
    assert main(["info", str(path)]) == 0
    printed = capsys.readouterr().out
    lines = read.hygiene.lines(read.config["hygiene"])
    assert all(f"full: hygiene: {line}\n" in printed for line in lines)
    assert "disparity: 1 observations dropped, in 1 tracks, 1 frames from 0 to 0" in lines
    assert "jump: switched off" in lines and "re-used id: nothing found" in lines
    with h5py.File(path, "r+") as h5file:
        del h5file["runs/full/hygiene/continuation"]
    with pytest.raises(ArchiveError, match="hygiene/continuation is missing"):
        open_result(path, "full")


@pytest.mark.data
def test_info_of_a_recording_prints_the_report_of_the_defaults(data_path, capsys):
    assert main(["info", str(data_path("ece276a/0042.npz"))]) == 0
    assert "hygiene       disparity: 812 observations dropped and 13 cuts" in capsys.readouterr().out
    assert main(["info", str(data_path("ece276a/0027.npz"))]) == 0
    printed = capsys.readouterr().out
    assert "hygiene       repeated frame: 225 cuts, in 118 tracks, 91 frames from 14 to 1089\n" in printed
    assert "hygiene       disparity: 349 observations dropped, in 7 tracks" in printed
    assert "hygiene       too short: switched off\n" in printed


@pytest.mark.slow
def test_archives_from_before_hygiene_still_open(spoilt, tmp_path):
    path = tmp_path / "old.h5"
    result = run(spoilt, "full")
    write_archive(path, spoilt, {"full": result})
    with h5py.File(path, "r+") as h5file:
        h5file.attrs["format_version"] = np.int64(2)
        group = h5file["runs/full"]
        del group["hygiene"]
        config = json.loads(group.attrs["config"])
        del config["hygiene"]
        config["filter"] |= {"restart_at_repeats": True, "min_disparity_px": 2.0, "max_row_mismatch_px": 20.0}
        group.attrs["config"] = json.dumps(config)
    old = open_result(path, "full")
    assert old.hygiene is None
    deviation = np.sqrt(2.0) * 0.3
    hygiene = Config().with_overrides(old.config).hygiene
    assert hygiene.restart_at_repeats and hygiene.reused_id_sigma == 0
    assert hygiene.min_disparity_sigma == pytest.approx(2.0 / deviation)
    assert hygiene.max_row_mismatch_sigma == pytest.approx(20.0 / deviation)
    np.testing.assert_allclose(posterior(old).position_m, posterior(result).position_m, atol=1e-9)


# Reprojection at true poses


def test_reprojection_errors_of_clean_and_of_moved_pixels():
    world = small_world(sigma_px=0.0)
    np.testing.assert_allclose(reprojection_errors(world), 0.0, atol=1e-8)
    i, rows = track(world)
    pixels = world.observations.pixels_px.copy()
    pixels[rows[3]] += [30.0, 40.0, 30.0, 40.0]
    errors = reprojection_errors(with_pixels(world, pixels))
    assert errors[rows[3]] == pytest.approx(50.0, abs=2.0)
    assert np.delete(errors, rows[3]).max() < 2.5  # the kernel bounds what one bad observation does to its track
    # Tracks that never have a depth, and frames without truth, have no error.
    pixels[rows, 2] = pixels[rows, 0] + 1.0
    known = np.arange(5, 40)
    truth = dataclasses.replace(world.truth, frame=known, T_world_imu=world.truth.T_world_imu[known])
    errors = reprojection_errors(dataclasses.replace(with_pixels(world, pixels), truth=truth))
    unknown = (world.observations.landmark == i) | ~np.isin(world.observations.frame, known)
    np.testing.assert_array_equal(np.isnan(errors), unknown)
    with pytest.raises(TruthError):
        reprojection_errors(dataclasses.replace(world, truth=None))


@pytest.mark.slow
@pytest.mark.data
def test_hygiene_brings_down_the_reprojection_errors_of_the_dense_recording(data_path):
    sequence = open_sequence(data_path("ece276a/0027_dense_noisy.npz"), truth=data_path("kitti_odometry_poses/07.txt"))
    clean, report = clean_tracks(sequence, noise_of(sequence, Config()), HygieneConfig(moving=False))
    before, after = (reprojection_errors(sequence, o) for o in (sequence.observations, clean))
    assert np.nanpercentile(before, 95) == pytest.approx(22.1, abs=0.5)
    assert np.nanpercentile(after, 95) <= 4.5
    assert (before > 5).sum() / np.isfinite(before).sum() > 0.2
    assert (after > 5).sum() / np.isfinite(after).sum() < 0.045
    assert report.dropped < 0.06 * len(sequence.observations)
