"""Consensus of a frame: which are wrong, its landmarks or its velocity?"""

import dataclasses
from itertools import combinations

import numpy as np
import pytest
from support.everything import PRIOR, with_everything
from support.frozen import assert_equal_to_frozen_rows

from ekfslam import LiveEKF
from ekfslam.config import Config
from ekfslam.data.inputs import InertialNoise
from ekfslam.data.interval import Interval
from ekfslam.data.simulate import builtin
from ekfslam.engine import choice
from ekfslam.evaluation.consistency import pose_nees
from ekfslam.filters.consensus import DOUBT, agreeing, refined
from ekfslam.filters.gates import threshold
from ekfslam.filters.gaussian import Rows
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import run_filter
from ekfslam.geometry import se3
from ekfslam.models.blocks.base import Layout
from ekfslam.models.blocks.pose import Pose
from ekfslam.models.process import INERTIAL_BLOCKS
from ekfslam.models.process.inertial import inertial
from ekfslam.models.sensors.stereo import Rig
from ekfslam.resolve import resolve
from ekfslam.runner import run
from ekfslam.smoother.posterior import smooth


@pytest.fixture
def rng():
    return np.random.default_rng(7)


WILD = 12  # frame
GATE = threshold(0.999, 3)


def spoiled(world, frames=(WILD,), sigmas=10.0):
    """The world with velocities that are wrong in all six axes in some frames."""
    twist = world.twist.copy()
    signs = np.resize([1.0, -1.0, 1.0, -1.0, 1.0, 1.0], (len(frames), 6))
    twist[list(frames)] += sigmas * world.noise.twist_std * signs
    return dataclasses.replace(world, twist=twist)


def filtered(world, **settings):
    problem = resolve(world, Config().with_overrides({"filter": settings}))
    ekf = JointEKF(problem.model, problem.config.filter)
    return ekf, [frame.report for frame in run_filter(ekf, problem.sequence)]


def errors(world, poses):
    return np.linalg.norm(poses[:, :3, 3] - world.truth.T_world_imu[:, :3, 3], axis=1)


@pytest.mark.parametrize("variant", ["invariant", "standard", "fej"])
def test_a_wild_velocity_is_rejected_and_its_landmarks_are_kept(variant):
    world = spoiled(builtin("city?frames=16&max_tracks=20"))
    _, reports = filtered(world, variant=variant)
    assert [report.frame for report in reports if report.doubt > 1.0] == [WILD]
    of_frame = reports[WILD]
    assert of_frame.doubt == DOUBT
    assert (of_frame.reason == 0).sum() <= 2
    assert of_frame.nis < 2.0 * of_frame.dof


@pytest.mark.parametrize("tracks", [3, 4, 5])
def test_a_wild_velocity_is_rejected_with_few_landmarks(tracks):
    world = spoiled(builtin(f"loop?frames=20&max_tracks={tracks}&seed=1"))
    result = run(world)
    assert np.flatnonzero(result.log.doubt > 1.0).tolist() == [WILD]
    assert result.counts["rejected: velocities"] == 1
    assert pose_nees(result, world.truth)[1][-1] < 20.0


@pytest.mark.parametrize("seed", range(3))
def test_gross_landmarks_alone_do_not_open_a_frame(seed):
    world = builtin(f"city?frames=40&max_tracks=5&outlier_fraction=0.06&seed={seed}")
    _, reports = filtered(world)
    assert sum((report.reason == 0).sum() for report in reports) > 5
    assert all(report.doubt == 1.0 for report in reports)


@pytest.mark.parametrize(
    "engine",
    ["reference", pytest.param("engine", marks=pytest.mark.skipif(bool(choice.MISSING), reason="not built"))],
)
def test_traffic_that_most_landmarks_follow_does_not_reject_the_velocity(engine):
    """All landmarks of a frame move along by the same distance, while the velocities go on as before."""
    world = builtin("city?frames=16&max_tracks=30&sigma_v_m_s=0.05&sigma_w_rad_s=0.005")
    T_cam_imu, camera, pixels = world.T_cam_imu, world.camera, world.observations.pixels_px.copy()
    of_frame = world.observations.frame == WILD
    rig = Rig(camera, T_cam_imu, world.noise)
    q = rig.invert(rig.rows(pixels[of_frame])) + T_cam_imu[:3, :3] @ np.array([0.3, 0.0, 0.0])
    u = camera.fu_px * q[:, 0] / q[:, 2] + camera.cu_px
    v = camera.fv_px * q[:, 1] / q[:, 2] + camera.cv_px
    pixels[of_frame] = np.column_stack([u, v, u - camera.fu_px * camera.baseline_m / q[:, 2], v])
    observations = dataclasses.replace(world.observations, pixels_px=pixels)
    _, reports = filtered(dataclasses.replace(world, observations=observations), engine=engine)
    assert (reports[WILD].reason == 0).sum() > 5
    assert all(report.doubt == 1.0 for report in reports)


@pytest.mark.parametrize("variant", ["standard", "fej"])
def test_frozen_rows_believe_the_same_of_a_rejected_velocity(variant):
    world = spoiled(builtin("city?frames=16&max_tracks=20"))
    ekf, reports = filtered(world, variant=variant, retire="never", **PRIOR)
    assert reports[WILD].doubt == DOUBT
    assert_equal_to_frozen_rows(ekf)


def test_the_smoother_is_right_about_a_rejected_velocity():
    world = spoiled(builtin("city?frames=20&max_tracks=20"))
    smoothed, clean = (smooth(run(some)) for some in (world, builtin("city?frames=20&max_tracks=20")))
    assert errors(world, smoothed.T_world_imu).max() < 1.5 * errors(world, clean.T_world_imu).max()


@pytest.mark.parametrize("variant", ["standard", "fej"])
def test_a_wild_measurement_of_a_velocity_that_walks_is_weighted_down(variant):
    world = with_everything(spoiled(builtin("city?frames=16&max_tracks=20"), sigmas=20.0))
    ekf, reports = filtered(world, variant=variant, retire="never", **PRIOR)
    assert [report.frame for report in reports if report.doubt > 1.0] == [WILD]
    log = ekf.log()
    assert np.unique(log.measured_frame[log.measured_std > np.tile(world.noise.twist_std, 15)]).tolist() == [WILD]
    assert (log.doubt == 1.0).all()
    assert_equal_to_frozen_rows(ekf)


def test_live_use_rejects_the_same_velocities():
    world = spoiled(builtin("city?frames=16&max_tracks=20"))
    problem = resolve(world)
    batch, _ = filtered(world)
    live = LiveEKF(JointEKF(problem.model, problem.config.filter))
    reports = []
    for k, t in enumerate(world.time_s):
        reports += live.predict(world.twist[k], t)
        reports += live.update(*world.observations.at(k), t)
    reports += live.flush()
    assert [report.frame for report in reports if report.doubt > 1.0] == [WILD]
    np.testing.assert_array_equal(live.ekf.T_imu_world, batch.T_imu_world)


def test_wide_predictions_are_linearised_again_and_keep_their_landmarks():
    world = builtin("city?frames=20&max_tracks=20&outlier_fraction=0&sigma_w_rad_s=0.6&sigma_v_m_s=2")
    result = run(world)
    assert result.counts["rejected: gate"] <= 3
    assert "rejected: velocities" not in result.counts
    assert np.nanmean(pose_nees(result, world.truth)[1]) < 15.0


def test_two_runs_are_bit_equal():
    world = spoiled(builtin("city?frames=14&max_tracks=30"))
    one, two = (filtered(world)[0] for _ in range(2))
    np.testing.assert_array_equal(one.P, two.P)


def test_the_first_frame_and_frames_without_known_landmarks_are_left_alone():
    world = builtin("city?frames=10")
    few = world.observations.frame < 3
    observations = dataclasses.replace(
        world.observations,
        **{name: getattr(world.observations, name)[few] for name in ("frame", "landmark", "pixels_px")},
    )
    _, reports = filtered(dataclasses.replace(spoiled(world, (5,)), observations=observations))
    assert all(report.doubt == 1.0 for report in reports)


def test_doubt_multiplies_the_noise_of_every_process(rng):
    T = se3.exp(rng.normal(size=6))
    world = builtin("city?frames=4")
    model = resolve(world).model
    one, two = (
        model.process.step(model.initial_values(), Interval(0.1, np.array([0.1]), world.twist[1:2], gap, d), T, False).Q
        for gap, d in ((False, 1.0), (False, 7.0))
    )
    np.testing.assert_allclose(two, 49.0 * one, rtol=1e-12)
    blocks = (Pose(T, np.eye(6)), *(block() for block in INERTIAL_BLOCKS.values()))
    process = inertial(InertialNoise(1e-3, 1e-2, 1e-5, 1e-4))(Layout(blocks), world.noise)
    values = {block.name: block.initial() for block in blocks}
    inputs = rng.normal(size=(2, 6))
    one, two = (
        process.step(values, Interval(0.2, np.array([0.1, 0.1]), inputs, False, d), T, False).Q for d in (1.0, 7.0)
    )
    np.testing.assert_allclose(two, 49.0 * one, rtol=1e-9, atol=1e-18)


# --- the maths ------------------------------------------------------------------------------------------------------


def frame_of(rng, k=8, wrong=()):
    """Joint covariance and rows of k landmarks that share an uncertain motion, with gross errors of some of them."""
    J = rng.normal(size=(k, 3, 6)) * 100.0
    S = (J.reshape(-1, 6) * 0.2**2) @ J.reshape(-1, 6).T + 0.5 * np.eye(3 * k)
    r = np.linalg.cholesky(S) @ rng.normal(size=3 * k)
    r.reshape(k, 3)[list(wrong)] += rng.choice([-1.0, 1.0], (len(wrong), 3)) * rng.uniform(20, 60, (len(wrong), 3))
    H_x = np.concatenate([J[..., :3], 1e6 * J[..., 3:]], axis=2)  # nearly linear
    return S, Rows(np.arange(k), H_x, np.zeros((k, 3, 3)), r.reshape(k, 3), np.full((k, 3), 0.5))


def squares_given(S, residual, inside):
    """Normalised squares of innovations given those of all others inside, one conditional Gaussian at a time."""
    squares = []
    for i in range(len(residual)):
        others = [j for j in inside if j != i]
        a, b = (np.ravel(3 * np.array(some, dtype=int)[:, None] + np.arange(3)) for some in ([i], others))
        gain = S[np.ix_(a, b)] @ np.linalg.inv(S[np.ix_(b, b)])
        e = residual.ravel()[a] - gain @ residual.ravel()[b]
        squares.append(e @ np.linalg.solve(S[np.ix_(a, a)] - gain @ S[np.ix_(b, a)], e))
    return np.array(squares)


@pytest.mark.parametrize("seed", range(4))
def test_landmarks_that_agree_are_those_of_conditional_gaussians(seed):
    generator = np.random.default_rng(seed)
    S, rows = frame_of(generator, 9, generator.permutation(9)[:3])
    inside = generator.random(9) < 0.7
    expected = np.flatnonzero(inside)
    while len(expected):
        squares = squares_given(S, rows.residual, expected)
        worst = expected[squares[expected].argmax()]
        if squares[worst] <= GATE:
            break
        expected = expected[expected != worst]
    agree = refined(S, rows.residual, inside, GATE)
    assert agree.tolist() == [i in expected or squares[i] <= GATE for i in range(9)]


@pytest.mark.parametrize("k", [4, 5, 8, 30])
def test_the_majority_is_found_whatever_the_minority(rng, k):
    wrong = rng.permutation(k)[: (k - 2) // 2]
    S, rows = frame_of(rng, k, wrong)
    agree = refined(S, rows.residual, agreeing(S, rows, GATE, np.random.default_rng(0)), GATE)
    assert not agree[wrong].any()
    assert agree.sum() >= k - len(wrong) - 1


def test_one_wrong_landmark_does_not_mask_the_others(rng):
    S, rows = frame_of(rng, 4, [2])
    everything = np.ones(4, dtype=bool)
    assert (squares_given(S, rows.residual, np.arange(4)) > GATE).sum() > 1
    assert refined(S, rows.residual, everything, GATE).tolist() == [True, True, False, True]


def test_all_samples_are_tried_if_they_are_few(rng):
    S, rows = frame_of(rng, 7, [0, 5])
    found = {tuple(agreeing(S, rows, GATE, np.random.default_rng(seed))) for seed in range(3)}
    assert len(found) == 1
    assert len(list(combinations(range(7), 3))) == 35


@pytest.mark.slow
@pytest.mark.parametrize("tracks", [5, 66])
@pytest.mark.parametrize("name", ["city", "loop"])
def test_one_velocity_in_a_hundred_may_be_wrong_by_ten_deviations(name, tracks):
    nees = []
    for seed in range(4):
        world = builtin(f"{name}?frames=120&max_tracks={tracks}&seed={seed}")
        wild = 1 + np.random.default_rng(seed).permutation(119)[:1]
        nees.append(np.nanmean(pose_nees(run(spoiled(world, wild)), world.truth)[1]))
    assert 3.0 < np.mean(nees) < 9.0
