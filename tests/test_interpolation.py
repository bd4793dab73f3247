"""Stretches that were never measured: found by their straight lines, named, kept, and left out of every NEES."""

import dataclasses

import numpy as np
import pytest
from support.helpers import synthetic_result, synthetic_sequence
from support.recordings import ece276a_fields, write_npz

from ekfslam import open_sequence
from ekfslam.cli import main
from ekfslam.data.interpolation import (
    SHORTEST,
    interpolated_intervals,
    interpolated_poses,
    known_intervals,
    stretches,
)
from ekfslam.data.readers import read_sequence, write_sequence
from ekfslam.data.truth_noise import TruthNoise
from ekfslam.evaluation.consistency import measured_truth, pose_nees
from ekfslam.evaluation.relative import relative_pose_nees
from ekfslam.evaluation.summary import summarise
from ekfslam.geometry import se3
from ekfslam.geometry.motion import integrate
from ekfslam.models.noise import GAP_STD
from ekfslam.storage.archive import read_archive, write_archive


def driven(frames=60, seed=0):
    rng = np.random.default_rng(seed)
    return np.array([8.0, 0.1, 0.0, 0.0, 0.0, 0.1]) + 0.01 * np.cumsum(rng.standard_normal((frames, 6)), axis=0)


def interpolated(twist, begin, end):
    """Velocities with a line drawn from sample ``begin`` to sample ``end``."""
    twist = twist.copy()
    share = np.linspace(0, 1, end - begin + 1)[:, None]
    twist[begin : end + 1] = (1 - share) * twist[begin] + share * twist[end]
    return twist


def test_intervals_between_the_measured_samples_are_found():
    twist = interpolated(interpolated(driven(), 0, 12), 30, 35)
    assert stretches(interpolated_intervals(twist)) == [(1, 12), (31, 35)]
    assert stretches(interpolated_intervals(interpolated(driven(), 50, 59))) == [(51, 59)]
    assert not interpolated_intervals(driven()).any()


def test_short_gaps_are_borne():
    assert not interpolated_intervals(interpolated(driven(), 20, 20 + SHORTEST)).any()
    assert interpolated_intervals(interpolated(driven(), 20, 21 + SHORTEST)).sum() == SHORTEST + 1
    assert interpolated_intervals(np.zeros((2, 6))).sum() == 0
    assert interpolated_intervals(np.zeros((0, 6))).shape == (0,)


def test_one_velocity_that_is_no_line_is_enough_not_to_be_one():
    twist = interpolated(driven(), 10, 30)
    twist[10:31, 5] += 1e-6 * np.random.default_rng(1).standard_normal(21)
    assert not interpolated_intervals(twist).any()


@pytest.mark.parametrize("size", [1e-4, 1.0, 1e4])
def test_rounding_is_that_of_the_largest_velocity(size):
    twist = interpolated(driven(), 10, 30)
    twist[10:31, :3] += 1e-9 * np.array([[1], [0], [-1]] * 7)  # the largest is 8 m/s: within rounding
    assert stretches(interpolated_intervals(size * twist)) == [(11, 30)]
    twist[10:31, :3] += 1e-6 * np.array([[1], [0], [-1]] * 7)
    assert not interpolated_intervals(size * twist).any()


def test_standing_still_and_constant_velocity_are_measured():
    twist = driven()
    twist[20:40] = 0.0
    assert not interpolated_intervals(twist).any()
    twist[20:40] = [5.0, 0, 0, 0, 0, 0.2]
    assert not interpolated_intervals(twist).any()


@pytest.mark.parametrize("world", ["city", "loop"])
@pytest.mark.parametrize("noise", ["", "&sigma_v_m_s=0&sigma_w_rad_s=0"])
def test_nothing_is_interpolated_in_the_built_in_worlds(world, noise):
    assert not open_sequence(f"builtin:{world}?seed=1{noise}").interpolated.any()


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("ece276a/0020.npz", [(1, 12)]),
        ("ece276a/0027.npz", []),
        ("ece276a/0042.npz", []),
        ("ece276a/0022_dense_noisy.npz", []),
        ("ece276a/0027_dense_noisy.npz", []),
        ("utias/dataset3.mat", []),
        ("utias/2011_09_26_drive_0001_sync_KLT.mat", []),
        # KITTI has no laser scans for its frames 177 to 180 either.
        ("utias/2011_09_26_drive_0009_sync_KLT.mat", [(178, 182)]),
        ("utias/2011_09_26_drive_0027_sync_KLT.mat", []),
        ("utias/2011_09_26_drive_0036_sync_KLT.mat", []),
        ("utias/2011_09_30_drive_0020_sync_KLT.mat", [(1, 12)]),
        ("utias/2011_09_30_drive_0027_sync_KLT.mat", []),
        ("utias/2011_10_03_drive_0042_sync_KLT.mat", []),
    ],
)
def test_stretches_of_the_recordings(data_path, name, expected):
    assert stretches(open_sequence(data_path(name)).interpolated) == expected


@pytest.mark.data
@pytest.mark.parametrize("name", ["2011_09_30_drive_0020", "2011_09_26_drive_0009"])
def test_the_truth_is_a_line_there_too(data_path, name):
    sequence = open_sequence(data_path(f"utias/{name}_sync_KLT.mat"))
    bends = np.linalg.norm(np.diff(sequence.truth.T_world_imu[:, :3, 3], 2, axis=0), axis=1)
    inside = sequence.interpolated[1:-1] & sequence.interpolated[2:]
    assert bends[inside].max() < 1e-7
    assert np.median(bends[~inside]) > 1e-3


@pytest.mark.slow
def test_a_recording_says_so_and_remembers_it(tmp_path, capsys):
    fields = ece276a_fields()
    twist = interpolated(np.vstack([fields["linear_velocity"], fields["rotational_velocity"]]).T, 1, 6).T
    fields |= {"linear_velocity": twist[:3], "rotational_velocity": twist[3:]}
    npz = write_npz(tmp_path / "a.npz", fields)
    sequence = open_sequence(npz)
    assert stretches(sequence.interpolated) == [(2, 6)]
    assert sequence.attributes["interpolated"] == "2-6"
    assert sum(note.startswith("The velocities of intervals 2 to 6 are interpolated") for note in sequence.notes) == 1
    noisy = dataclasses.replace(sequence, twist=sequence.twist + np.random.default_rng(0).normal(size=(7, 6)))
    write_sequence(noisy, tmp_path / "a.h5")
    np.testing.assert_array_equal(read_sequence(tmp_path / "a.h5").interpolated, sequence.interpolated)
    assert main(["info", str(npz)]) == 0
    assert "gaps          intervals 2 to 6 are interpolated" in capsys.readouterr().out
    assert main(["info", "builtin:loop?frames=12"]) == 0
    assert "gaps          none" in capsys.readouterr().out


def test_an_attribute_of_other_content_decides_nothing():
    twist = interpolated(driven(), 10, 20)
    assert stretches(known_intervals({"interpolated": "1-2 5-5"}, twist)) == [(1, 2), (5, 5)]
    for other in ("", "all of it", 7, "3-"):
        assert stretches(known_intervals({"interpolated": other}, twist)) == [(11, 20)]


def test_no_nees_is_taken_of_them(tmp_path):
    sequence = dataclasses.replace(synthetic_sequence(), attributes={"interpolated": "31-40"})
    result = synthetic_result(sequence)
    truth, plain = sequence.truth, dataclasses.replace(sequence, attributes={})
    poses = truth.T_world_imu.copy()
    poses[31:41, 0, 3] += 100.0
    wrong = dataclasses.replace(truth, T_world_imu=poses)
    measured = measured_truth(wrong, sequence.interpolated, sequence.time_s)
    np.testing.assert_array_equal(measured.frame, np.delete(np.arange(200), np.arange(31, 41)))
    np.testing.assert_array_equal(
        pose_nees(result, measured)[1], np.delete(pose_nees(result, truth)[1], np.arange(31, 41))
    )
    pairs, _ = relative_pose_nees(result, wrong, sequence.interpolated)
    everything, _ = relative_pose_nees(result, truth, plain.interpolated)
    across = (everything.first < 40) & (everything.second > 30)
    assert across.sum() > 3
    np.testing.assert_array_equal(pairs.first, everything.first[~across])
    found = summarise(dataclasses.replace(sequence, truth=wrong), result)
    assert found["pose_nees_mean"] < 20 and found["pose_nees_relative_10_mean"] < 20
    assert summarise(dataclasses.replace(plain, truth=wrong), result)["pose_nees_mean"] > 1e4
    write_archive(tmp_path / "a.h5", dataclasses.replace(sequence, truth=wrong), {"full": result})
    archive = read_archive(tmp_path / "a.h5")
    assert summarise(archive, archive.results["full"]) == found


def test_a_first_pose_within_a_stretch_is_trusted_less():
    sequence = dataclasses.replace(synthetic_sequence(), attributes={"interpolated": "1-12"})
    noise = TruthNoise(0.001, 0.002, 0.003, 0.1, position_m=0.01)
    truth = dataclasses.replace(sequence.truth, noise=noise)
    found = measured_truth(truth, sequence.interpolated, sequence.time_s).noise
    invented_s = sequence.time_s[12] - sequence.time_s[0]
    assert found.first_position_m == pytest.approx(np.hypot(0.1, GAP_STD[0] * invented_s))
    assert dataclasses.replace(found, first_position_m=0.1) == noise
    for later in ("2-12", "20-30"):
        other = dataclasses.replace(sequence, attributes={"interpolated": later})
        assert measured_truth(truth, other.interpolated, other.time_s).noise == noise
    exact = dataclasses.replace(truth, noise=None)
    assert measured_truth(exact, sequence.interpolated, sequence.time_s).noise is None


def test_poses_on_a_line_are_found_although_their_stamps_jitter():
    rng = np.random.default_rng(0)
    twist = np.array([1.0, 0, 0, 0, 0, 0.02]) + np.cumsum(rng.normal(0.0, 0.02, (60, 6)), axis=0)
    T = integrate(np.eye(4), twist, np.full(59, 0.1))
    assert not interpolated_poses(T).any()
    share = np.sort(rng.uniform(0.0, 1.0, 7))
    way = share[:, None] * np.append(T[28, :3, 3] - T[20, :3, 3], se3.so3_log(T[20, :3, :3].T @ T[28, :3, :3]))
    T[21:28, :3, 3] = np.round(T[20, :3, 3] + way[:, :3], 8)
    T[21:28, :3, :3] = T[20, :3, :3] @ se3.so3_exp(way[:, 3:])
    assert stretches(interpolated_poses(T)) == [(21, 28)]


def test_poses_at_rest_and_straight_lines_are_not_interpolated():
    assert not interpolated_poses(np.tile(np.eye(4), (20, 1, 1))).any()
    assert not interpolated_poses(
        integrate(np.eye(4), np.tile([1.0, 0, 0, 0, 0, 0.1], (20, 1)), np.full(19, 0.1))
    ).any()


def test_interpolated_true_poses_are_named_and_in_no_nees_without_velocities_that_show_them(tmp_path, capsys):
    world = synthetic_sequence(frames=60, landmarks=20)
    T = world.truth.T_world_imu.copy()
    share = np.arange(1, 8)[:, None] / 8
    T[21:28, :3, 3] = (1 - share) * T[20, :3, 3] + share * T[28, :3, 3]
    T[21:28, :3, :3] = T[20, :3, :3] @ se3.so3_exp(share * se3.so3_log(T[20, :3, :3].T @ T[28, :3, :3]))
    rng = np.random.default_rng(0)
    wavy = T @ se3.exp(np.where(np.arange(60)[:, None] // 10 == 2, 0.0, 1e-4) * rng.standard_normal((60, 6)))
    truth = dataclasses.replace(world.truth, T_world_imu=wavy, noise=TruthNoise(position_m=0.01))
    nothing = np.zeros(60, dtype=bool)
    kept = measured_truth(truth, nothing, world.time_s)
    assert set(range(60)) - set(kept.frame.tolist()) == set(range(21, 29))
    assert len(measured_truth(dataclasses.replace(truth, noise=None), nothing, world.time_s).frame) == 60
    result = synthetic_result(world, "dead-reckoning")
    pairs, _ = relative_pose_nees(result, truth, nothing)
    assert len(pairs.first)
    assert not ((pairs.first < 28) & (pairs.second > 20)).any()
    write_sequence(dataclasses.replace(world, truth=truth), tmp_path / "w.h5")
    assert main(["info", str(tmp_path / "w.h5")]) == 0
    assert "the true poses of frames 21 to 28 lie on a line" in capsys.readouterr().out
