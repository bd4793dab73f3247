"""Each axis of a velocity has its own noise; axes that are exactly 0 throughout are not measured."""

import dataclasses
import re

import numpy as np
import pytest

from ekfslam import Sequence, run
from ekfslam.cli import main
from ekfslam.config import Config, NoiseConfig
from ekfslam.data.inputs import is_measured
from ekfslam.data.readers import write_sequence
from ekfslam.data.sequence import MEASURED_KINDS, TWIST_STD
from ekfslam.data.simulate import builtin
from ekfslam.evaluation.consistency import pose_nees
from ekfslam.evaluation.sanity import inspect_sequence
from ekfslam.evaluation.trajectory import absolute_trajectory_error
from ekfslam.models.blocks import TwistBias
from ekfslam.models.noise import velocity_noise
from ekfslam.models.odometry import missing_velocities
from ekfslam.models.vehicle import odometry_text, slow_slip, up_axis, vehicle_std
from ekfslam.resolve import noise_of, resolve, settings_of, with_odometry

DRIVE, HOLONOMIC, OPTICAL = (0, 5), (0, 1, 5), (2, 4)  # measured axes; the last is forward and down of a camera


def world(frames: int = 60, seed: int = 0) -> Sequence:
    return dataclasses.replace(builtin(f"city?frames={frames}&seed={seed}"), noise=None)


def only(sequence: Sequence, axes: tuple[int, ...]) -> Sequence:
    return sequence.with_velocities(np.where(mask(axes), sequence.twist, 0.0))


def mask(axes: tuple[int, ...]) -> np.ndarray:
    return np.isin(np.arange(6), axes)


def walk(frames: int = 600) -> np.ndarray:
    return np.cumsum(np.random.default_rng(0).normal(0, np.repeat([0.05, 0.002], 3), (frames, 6)), axis=0)


def test_axes_that_agree_share_their_noise_and_another_has_its_own():
    rng = np.random.default_rng(1)
    std = np.array([1.5, 0.3, 0.3, 0.02, 0.02, 0.1])
    found = velocity_noise(walk() + std * rng.standard_normal((600, 6)))
    np.testing.assert_allclose(found.axes, std, rtol=0.15)
    assert found.axes[1] == found.axes[2] == found.sigma[0] and found.axes[3] == found.axes[4] == found.sigma[1]
    assert found.texts[0].startswith("v_x 1.")


@pytest.mark.parametrize(("odometry", "missing"), [(0.15, ("linear",)), (0.05, ())])
def test_linear_velocities_of_0_are_missing_if_odometry_exceeds_a_tenth_of_a_metre_a_second(odometry, missing):
    still = only(world(5), (3, 4, 5))
    assert missing_velocities(still, np.where(mask((0,)), odometry, 0.0) * np.ones((5, 1))) == missing


def test_exact_zeros_do_not_dilute_the_noise_of_the_measured_axes():
    rng = np.random.default_rng(2)
    noisy = walk() + np.repeat([0.5, 0.05], 3) * rng.standard_normal((600, 6))
    found, everything = velocity_noise(np.where(mask(DRIVE), noisy, 0.0)), velocity_noise(noisy)
    np.testing.assert_array_equal(found.measured, mask(DRIVE))
    np.testing.assert_allclose(found.sigma, [0.5, 0.05], rtol=0.15)
    np.testing.assert_allclose(found.walk, everything.walk, rtol=0.6)
    assert not found.axes[~mask(DRIVE)].any() and not found.is_clean
    assert velocity_noise(np.where(mask(HOLONOMIC[:2]), noisy, 0.0)).texts[1].startswith("not measured")


def test_clean_velocities_carry_slow_motions_only_if_all_six_are_measured():
    complete, planar = velocity_noise(walk()), velocity_noise(np.where(mask(DRIVE), walk(), 0.0))
    assert complete.is_clean and planar.is_clean and complete.carries_motion and not planar.carries_motion


@pytest.mark.parametrize(
    ("axes", "up", "words"),
    [
        (DRIVE, 2, r"planar odometry \(differential drive\): v_x, w_z"),
        (HOLONOMIC, 2, r"planar odometry \(holonomic\): v_x, v_y, w_z"),
        (OPTICAL, 1, r"planar odometry \(differential drive\): v_z, w_y"),
        ((0, 1, 2, 5), None, "partly measured velocities: v_x, v_y, v_z, w_z"),
        ((0,), None, "partly measured velocities: v_x"),
    ],
)
def test_planar_odometry_is_recognised_about_any_axis(axes, up, words):
    measured = mask(axes)
    assert up_axis(measured) == up
    std = vehicle_std(measured, 0.1)
    assert re.match(words, odometry_text(measured, std))
    assert (std > 0).all() and (up is None or std[up] > std[(up + 1) % 3])


def test_all_axes_measured_or_none_are_no_odometry_of_a_vehicle():
    assert odometry_text(np.ones(6, dtype=bool), np.ones(6)) == odometry_text(np.zeros(6, dtype=bool), np.ones(6)) == ""


def test_slip_is_the_same_motion_at_any_rate():
    slow, fast = (vehicle_std(mask(DRIVE), step_s) for step_s in (0.1, 0.025))
    np.testing.assert_allclose(slow**2 * 0.1**2 * 10, fast**2 * 0.025**2 * 40)


@pytest.mark.parametrize(("axes", "names"), [(DRIVE, "yz"), (HOLONOMIC, "z"), (OPTICAL, "xy")])
def test_slow_slip_is_a_bias_of_the_zeros_that_grows_with_the_speed(axes, names):
    measured = mask(axes)
    slow, fast = (slow_slip(measured, speed * np.ones((50, 6)), 0.02) for speed in (4.0, 8.0))
    assert slow.keys() == {f"slip_{name}_m_s" for name in names}
    assert all(fast[key] == pytest.approx(2.0 * value) for key, value in slow.items())
    vertical = f"slip_{'xyz'[up_axis(measured)]}_m_s"
    assert all(slow[vertical] > 3.0 * value for key, value in slow.items() if key != vertical)
    std = np.diag(TwistBias(**slow).prior_covariance()) ** 0.5
    np.testing.assert_allclose(std[:3], [slow.get(f"slip_{name}_m_s", 0.05) for name in "xyz"])


def test_slow_slip_is_in_the_model_of_planar_odometry_and_gives_way_to_settings():
    settings = Config().with_overrides({"blocks": {"twist_bias": {"slip_y_m_s": 0.7}}})
    biased = settings_of(only(world(), DRIVE), settings).blocks["twist_bias"]
    assert biased["slip_y_m_s"] == 0.7 and biased["slip_z_m_s"] > 0.1
    assert not any(key.startswith("slip") for key in settings_of(world(), Config()).blocks["twist_bias"])


@pytest.mark.parametrize("axes", [DRIVE, HOLONOMIC])
def test_zeros_have_the_noise_of_a_vehicle_and_measured_axes_that_of_the_data(axes):
    planar = only(world(), axes)
    noise, found = noise_of(planar, Config()), velocity_noise(planar.twist)
    np.testing.assert_allclose(noise.twist_std[mask(axes)], found.axes[mask(axes)])
    expected = vehicle_std(mask(axes), float(np.median(np.diff(planar.time_s))))
    np.testing.assert_allclose(noise.twist_std[~mask(axes)], expected[~mask(axes)])


def test_noise_that_a_user_gives_is_that_of_the_measured_axes():
    noise = noise_of(only(world(), DRIVE), Config(noise=NoiseConfig(sigma_v_m_s=0.07, sigma_w_rad_s=0.007)))
    assert noise.twist_std[0] == 0.07 and noise.twist_std[5] == 0.007
    assert (noise.twist_std[[1, 2]] > 0.2).all() and (noise.twist_std[[3, 4]] > 0.05).all()


def test_noise_that_a_recording_states_is_kept_for_each_axis():
    std = np.array([0.4, 0.01, 0.02, 0.001, 0.002, 0.06])
    stated = builtin("city?frames=30")
    stated = dataclasses.replace(only(stated, DRIVE), noise=dataclasses.replace(stated.noise, twist_std=std))
    np.testing.assert_array_equal(noise_of(stated, Config()).twist_std, std)


def test_noise_of_velocities_that_a_sensor_states_holds_for_each_axis():
    calm = world().with_velocities(walk(60))
    stated = "0.4 0.0 0.3 0.02 inf 0.06"
    given = dataclasses.replace(calm, attributes={**calm.attributes, TWIST_STD: stated})
    np.testing.assert_array_equal(given.measured_axes, [True, True, True, True, False, True])
    noise = noise_of(given, Config())
    np.testing.assert_allclose(noise.twist_std[[0, 2, 3, 5]], [0.4, 0.3, 0.02, 0.06])
    assert noise.twist_std[4] > 0.05 and noise.twist_walk_std is not None
    # White noise that the velocities show is there, whatever is stated.
    loud = given.with_velocities(walk(60) + np.random.default_rng(3).normal(0, 1.0, (60, 6)))
    assert noise_of(loud, Config()).twist_std[0] > 0.7


def test_info_and_a_run_say_that_odometry_is_planar(tmp_path, capsys):
    planar = only(world(30), DRIVE)
    write_sequence(planar, tmp_path / "planar.h5")
    assert main(["info", str(tmp_path / "planar.h5")]) == 0
    printed = capsys.readouterr().out
    assert "planar odometry (differential drive): v_x, w_z are measured" in printed
    assert run(planar, "dead-reckoning").attributes["odometry"] in printed


def test_dead_reckoning_by_planar_odometry_knows_that_it_may_slip():
    every, planar = (run(each, "dead-reckoning") for each in (world(), only(world(), DRIVE)))
    std = [np.sqrt(np.diagonal(result.covariance[-1]))[:3] for result in (every, planar)]
    assert (std[1] > 0.3 * std[0]).all()


# --- velocities that were never filled in -----------------------------------------------------------------------------


def test_a_twist_of_zeros_is_named_and_not_used():
    zeros, none = only(world(12), ()), world(12)
    none = dataclasses.replace(none, inputs=(), attributes={**none.attributes, "velocities": "none"})
    assert not zeros.has_velocities
    (line,) = inspect_sequence(zeros).warnings
    assert line.startswith("linear and angular velocities look as if they were never filled in")
    found, expected = run(zeros), run(none)
    np.testing.assert_array_equal(found.T_world_imu, expected.T_world_imu)
    assert found.remarks[0] == line and found.attributes["velocities"] == "none"


def test_zeros_at_rest_are_no_mistake():
    moving = world(25)
    first = moving.observations.at(0)
    rng = np.random.default_rng(0)
    pixels = first[1] + rng.normal(0, 0.3, (25, len(first[0]), 4))
    rest = Sequence.from_tracks(moving.time_s, pixels, moving.camera, twist=np.zeros((25, 6)), T_cam_imu=np.eye(4))
    assert inspect_sequence(rest).warnings == () and not rest.has_velocities


@pytest.mark.parametrize(("axes", "missing"), [((0, 1, 2), "angular"), ((3, 4, 5), "linear")])
def test_velocities_of_one_kind_are_used_where_the_other_was_never_filled_in(axes, missing):
    partly = only(world(135)[110:135], axes)  # the car turns
    (line,) = inspect_sequence(partly).warnings
    assert line.startswith(f"{missing} velocities look as if they were never filled in")
    filled = with_odometry(partly)
    np.testing.assert_array_equal(filled.twist[:, mask(axes)], partly.twist[:, mask(axes)])
    np.testing.assert_array_equal(filled.measured_axes, mask(axes))
    assert filled.attributes["velocities"] in MEASURED_KINDS and is_measured(filled.twist).all()
    assert with_odometry(filled) is filled
    problem = resolve(partly)
    walks = problem.model.noise.twist_walk_std
    assert (walks > 0).all() and problem.sequence.has_velocities


def test_velocities_of_another_recording_are_blamed_and_not_the_truth_or_the_extrinsics():
    mine, other = builtin("city?frames=200"), builtin("loop?frames=200&seed=3")
    wrong = mine.with_velocities(other.twist[::-1] * [1, 1, 1, -1, 1, -4])
    assert not any(word in line for line in inspect_sequence(wrong).warnings for word in ("truth", "T_cam_imu"))
    assert inspect_sequence(mine).warnings == ()


@pytest.mark.slow
def test_planar_odometry_is_as_good_as_six_axes_in_the_city():
    errors, nees = {}, {}
    for name, axes in (("six", tuple(range(6))), ("planar", DRIVE)):
        found = [(each, run(only(each, axes))) for each in (world(80, seed) for seed in (0, 1))]
        errors[name] = [
            absolute_trajectory_error(result.T_world_imu[each.truth.frame], each.truth.T_world_imu, align=False)
            for each, result in found
        ]
        nees[name] = np.mean([np.nanmean(pose_nees(result, each.truth)[1]) for each, result in found])
    assert np.mean(errors["planar"]) < 1.4 * np.mean(errors["six"])
    assert 1.0 < nees["planar"] < 9.0
