"""On simulations whose model is wrong in a known way, `judge` names error and size; on true ones it finds none."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from support.helpers import synthetic_result, synthetic_sequence
from support.running import WHOLE, seeds

from ekfslam.data.sequence import Noise, Sequence
from ekfslam.data.simulate import CAMERA, T_CAM_IMU, City, Loop, simulate
from ekfslam.errors import HonestyError
from ekfslam.evaluation import evidence
from ekfslam.evaluation.brief import next_step
from ekfslam.evaluation.causes import Cause, truth_causes
from ekfslam.evaluation.consistency import pose_error, pose_nees_by_axis
from ekfslam.evaluation.honesty import Honesty, judge, require_innovations
from ekfslam.figures.check import plot_check
from ekfslam.filters.result import OTHER, REASONS, Result, WhitenedInnovations
from ekfslam.geometry import se3
from ekfslam.geometry.camera import project
from ekfslam.reports import compare
from ekfslam.runner import run
from ekfslam.smoother.posterior import posterior

SIGMA_V, SIGMA_W, SIGMA_PX = 0.1, 0.004, 0.7
STATED = Noise.isotropic(SIGMA_V, SIGMA_W, SIGMA_PX)
SEEDS = pytest.mark.parametrize("seed", seeds(3, 1))


def world(seed, **changes):
    small = {"frames": 300 if WHOLE else 200, "max_tracks": 40, "outlier_fraction": 0.0, "loss_probability": 0.02}
    noise = {"sigma_v_m_s": SIGMA_V, "sigma_w_rad_s": SIGMA_W, "sigma_px": SIGMA_PX}
    return dataclasses.replace(simulate(City(seed=seed, **{**small, **noise, **changes})), noise=STATED)


def displaced(sequence, shift_px):
    seen = sequence.observations
    return dataclasses.replace(sequence, observations=dataclasses.replace(seen, pixels_px=seen.pixels_px + shift_px))


def with_yaw_bias(seed, bias=0.004):
    true = world(seed)
    return dataclasses.replace(true, twist=true.twist + bias * np.eye(6)[5])


def with_turning_camera(seed, std_deg=0.3, time_frames=20):
    """All tracks of a frame are displaced alike, as by a camera that slowly turns to and fro."""
    true, rng = world(seed), np.random.default_rng(1000 + seed)
    angle, rate = np.zeros((2, len(true), 3))
    for k in range(1, len(true)):
        rate[k] = (1 - 1 / time_frames) * rate[k - 1] + rng.normal(size=3)
        angle[k] = (1 - 1 / time_frames) * angle[k - 1] + rate[k]
    angle *= np.deg2rad(std_deg) / angle.std()
    seen, T_imu_world = true.observations, se3.inverse(true.truth.T_world_imu)
    points = true.truth.position_m[np.searchsorted(true.truth.landmark, seen.landmark)]
    q = se3.apply(T_CAM_IMU @ T_imu_world[seen.frame], points)
    turned = (se3.so3_exp(angle[seen.frame]) @ q[..., None])[..., 0]
    return displaced(true, project(CAMERA, turned) - project(CAMERA, q))


def with_walking_tracks(seed, step_px=(0.25, 0.25, 0.15)):
    """The errors (u, v, disparity) of each track walk by themselves, where the model takes them as white."""
    true, rng = world(seed, sigma_px=0.3), np.random.default_rng(2000 + seed)
    seen = true.observations
    order = np.lexsort((seen.frame, seen.landmark))
    walk = np.cumsum(rng.normal(size=(len(order), 3)) * step_px, axis=0)
    _, first, count = np.unique(seen.landmark[order], return_index=True, return_counts=True)
    error = np.empty_like(walk)
    error[order] = walk - np.repeat(walk[first], count, axis=0)
    u, v, disparity = error.T
    return displaced(true, np.stack([u, v, u - disparity, v], axis=1))


def with_twist(sequence, change):
    return dataclasses.replace(sequence, twist=change(sequence.twist))


def late(twist):
    return np.concatenate([twist[:1], twist[:-1]])


def turned(sequence, axis, angle_deg):
    R = se3.transform(se3.so3_exp(np.deg2rad(angle_deg) * np.eye(3)[axis]), np.zeros(3))
    return dataclasses.replace(sequence, T_cam_imu=R @ sequence.T_cam_imu)


def longer(sequence, share):
    camera = dataclasses.replace(sequence.camera, baseline_m=sequence.camera.baseline_m * (1 + share))
    return dataclasses.replace(sequence, camera=camera)


def judged(sequence) -> Honesty:
    return judge(run(sequence))


def kinds(found) -> list[str]:
    return [cause.kind for cause in found.causes]


@pytest.mark.slow
@SEEDS
def test_a_true_model_is_consistent(seed):
    found = judged(world(seed))
    assert not found.causes and not found.findings
    assert found.verdict == "consistent as far as innovations can tell" and found.grade == "good"
    assert found.factors is None and np.isnan(found.factor)  # nothing predicts it
    assert abs(found.nis.value - 1) < 4 * found.nis.error < 0.1


@pytest.mark.slow
@SEEDS
def test_pixel_noise_understated_twice(seed):
    found = judged(world(seed, sigma_px=2 * SIGMA_PX))
    assert kinds(found) == ["pixel noise"] and not found.findings  # it explains what the gates reject
    assert found.factors == pytest.approx(np.full(6, 2.0), abs=0.25)
    assert "about 2.0x too small" in found.verdict and "give [noise] sigma_px = 1.4" in found.verdict


@pytest.mark.slow
@SEEDS
def test_velocities_understated_three_times_hardly_matter_where_vision_decides(seed):
    found = judged(world(seed, sigma_v_m_s=3 * SIGMA_V))
    assert kinds(found) == ["shared noise"] and {"forward", "lateral", "vertical"} >= set(found.causes[0].where)
    assert 1.0 < found.factor < 1.3
    assert found.verdict.startswith("standard deviations about right")
    assert "give [noise] sigma_v_m_s = 0.2" in found.verdict


@pytest.mark.slow
@SEEDS
@pytest.mark.parametrize("sign", [1, -1] if WHOLE else [-1])
def test_a_constant_bias_of_the_yaw_rate(seed, sign):
    found = judged(with_yaw_bias(seed, sign * 0.004))
    assert kinds(found) == ["bias"] and found.causes[0].where == ("yaw",)
    (error,) = found.systematic
    assert error.value == pytest.approx(sign * 0.004, rel=0.2)
    assert found.factors is None and "do not tell by how much" in found.verdict
    assert "deg/s in yaw: a bias of the velocities" in found.verdict and "[blocks.twist_bias]" in found.verdict


@pytest.mark.slow
@SEEDS
def test_a_camera_that_is_mounted_turned(seed):
    found = judged(turned(world(seed), 0, 0.5))
    assert kinds(found) == ["direction"]
    assert found.systematic[0].value == pytest.approx(np.deg2rad(-0.5), rel=0.4)
    assert found.factor > 5 and np.argmax(found.factors) == 2  # height
    assert "T_cam_imu" in found.verdict


@pytest.mark.slow
@SEEDS
def test_a_baseline_that_is_too_long(seed):
    found = judged(longer(world(seed), 0.03))
    assert {found.systematic[0].kind, *found.systematic[0].also} >= {"scale"}
    assert found.systematic[0].value < 0  # the way by velocities is shorter
    assert found.grade == "bad"


@pytest.mark.slow
@SEEDS
def test_velocities_that_come_late(seed):
    found = judged(with_twist(world(seed), late))
    assert kinds(found)[0] == "delay"
    assert found.systematic[0].value == pytest.approx(0.1, rel=0.3)
    assert "s late: a time offset" in found.verdict


@pytest.mark.slow
@SEEDS
def test_a_slow_drift_that_all_tracks_share(seed):
    found = judged(with_turning_camera(seed))
    assert kinds(found) == ["shared drift"]
    assert {"pitch", "yaw"} & set(found.causes[0].where)
    assert found.tracks.scale == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
@SEEDS
def test_tracks_whose_errors_walk(seed):
    found = judged(with_walking_tracks(seed))
    assert kinds(found) == ["tracks"]
    assert found.causes[0].where == ("u", "v", "disparity")
    assert 2.0 < found.factor < 3.5
    assert (found.tracks.correlation[1] > 0.5).all()


@pytest.mark.slow
@SEEDS
def test_outliers(seed):
    found = judged(world(seed, outlier_fraction=0.1))
    assert not found.causes and [finding.kind for finding in found.findings] == ["outliers"]
    assert found.rejected["gate"] == pytest.approx(0.1, abs=0.025)


@pytest.mark.slow
@SEEDS
def test_a_model_that_fears_too_much(seed):
    stated = Noise.isotropic(3 * SIGMA_V, 3 * SIGMA_W, 3 * SIGMA_PX)
    found = judged(dataclasses.replace(world(seed), noise=stated))
    assert kinds(found) == ["pixel noise", "shared noise"]
    assert found.factors == pytest.approx(np.full(6, 1 / 3), abs=0.07)
    assert "x too large" in found.verdict


@pytest.mark.slow
def test_a_rig_at_rest_is_not_pessimistic():
    still = simulate(Loop(speed_m_s=1e-6, frames=80, sigma_v_m_s=SIGMA_V, sigma_w_rad_s=SIGMA_W, sigma_px=SIGMA_PX))
    found = judged(still)
    assert not found.causes and not found.systematic and found.grade == "good"


# --- the verdict ------------------------------------------------------------------------------------------------------


def test_velocities_whose_noise_was_found_are_not_better_than_stated():
    """On a circle the velocities are constant, which the steps of a walk overestimate."""
    rng, T = np.random.default_rng(0), 60
    step = se3.exp(0.1 * np.array([3.0, 0, 0, 0, 0, 0.3]))
    poses = np.array([np.linalg.matrix_power(step, k) for k in range(T)])
    angle, away = rng.uniform(0, 2 * np.pi, 150), rng.uniform(12, 25, 150)
    points = np.column_stack([away * np.cos(angle), 10 + away * np.sin(angle), rng.uniform(-2, 4, 150)])
    q = se3.apply((T_CAM_IMU @ se3.inverse(poses))[:, None], points)
    pixels = project(CAMERA, np.where(q[..., 2:] > 1, q, np.nan))
    pixels[(pixels[..., 0] < 0) | (pixels[..., 0] > 1240)] = np.nan
    twist = np.tile([3.0, 0, 0, 0, 0, 0.3], (T, 1)) + rng.normal(size=(T, 6)) * np.repeat([0.2, 0.02], 3)
    pixels += rng.normal(size=pixels.shape)
    sequence = Sequence.from_tracks(0.1 * np.arange(T), pixels, CAMERA, twist=twist, T_cam_imu=T_CAM_IMU)
    result = run(sequence, "full")
    assert result.noise.twist_walk_std is not None
    said = " ".join(judge(result).reasons)
    assert "smoother than the noise found" in said and "stated" not in said and "give" not in said


def test_a_truth_far_from_what_innovations_say_is_doubted():
    far, near = evidence.TruthAgreement(6.0 * 20.0**2, 1.2, 14.4), evidence.TruthAgreement(6.0 * 5.0**2, 1.2, 14.4)
    (cause,) = truth_causes(far, np.full(6, 1.0))
    assert "20x larger than innovations say" in cause.text and "base_link" in cause.remedy
    assert not [*truth_causes(near, np.ones(6)), *truth_causes(far, np.full(6, 4.0)), *truth_causes(far, None)]


def test_the_next_step_of_a_run_with_an_inverted_camera_is_the_camera():
    true = world(0, frames=30)
    inverted = dataclasses.replace(true, T_cam_imu=se3.inverse(true.T_cam_imu))
    compared = compare(inverted, "full")
    said = compared.brief.partition("next: ")[2]
    assert "T_cam_imu looks inverted" in said.splitlines()[0] and said.count("T_cam_imu looks inverted") == 2
    rejected = judge(compared.results["full"])
    few = dataclasses.replace(rejected, rejected={"gate": 0.3, "moving": 0.2}, causes=(), truth=None)
    assert few.headline == "too few observations fit the model to judge by them" and few.grade == "bad"
    right = dataclasses.replace(few, causes=(Cause("shared noise", (), 1.0, "noise"),), factors=np.ones(6))
    assert right.headline == few.headline
    assert next_step(dataclasses.replace(few, innovations_skipped="none"), "A", ("images look swapped",)) == (
        "images look swapped"
    )


@pytest.mark.slow
def test_truth_and_innovations_make_one_verdict(one_run):
    found = judge(one_run)
    honest = dataclasses.replace(found, truth=evidence.TruthAgreement(6.0, 1.2, 14.4))
    assert honest.headline.startswith("consistent as far as innovations and the truth of one drive can tell")
    off = dataclasses.replace(found, truth=evidence.TruthAgreement(150.0, 1.2, 14.4))
    assert off.headline.startswith("standard deviations about 5.0x too small by the truth") and off.grade == "bad"
    cause = Cause("bias", ("yaw",), np.nan, "a bias", "remove it")
    both = dataclasses.replace(off, causes=(cause,))
    assert "by the truth they are about 5.0x too small" in both.headline
    assert "consistent" not in both.verdict and both.verdict.endswith("A bias; remove it")
    right = dataclasses.replace(honest, causes=(Cause("shared noise", (), 1.0, "noise"),), factors=np.ones(6))
    assert right.headline.startswith("standard deviations about right; the truth of one drive agrees (pose NEES 6;")
    unseen = dataclasses.replace(honest, causes=(cause,))
    assert "the truth of one drive does not show it" in unseen.headline and unseen.grade == "fair"


@pytest.mark.slow
def test_failed_linearisation_shows_between_filter_and_smoother(one_run):
    smoothed = posterior(one_run)
    beside = 30.0 * np.sqrt(np.diagonal(one_run.covariance, axis1=1, axis2=2))
    bold = dataclasses.replace(one_run, T_world_imu=one_run.T_world_imu @ se3.exp(beside))
    found = judge(bold, smoothed)
    assert kinds(found)[0] == "smoother" and found.factors is None
    assert "failed linearisation" in found.verdict and "filter.lag = 10" in found.verdict


@pytest.mark.slow
def test_vision_decides_nothing_when_blocks_hold_what_tracks_share(one_run):
    assert (evidence.vision_share(one_run) > 0.5).all()
    config = {**one_run.config, "blocks": {"vision_drift": {}}}
    assert evidence.vision_share(dataclasses.replace(one_run, config=config)) is None


# --- the evidence -----------------------------------------------------------------------------------------------------


def shared_of(mean=0.0, size=1.0, frames=400, seed=0):
    """Whitened innovations with scores drawn from their information, two observations a frame."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(frames, 6, 6))
    C = A @ A.swapaxes(1, 2) + 0.5 * np.eye(6)
    xi = np.linalg.solve(C, (np.linalg.cholesky(C) @ rng.normal(size=(frames, 6, 1))))[..., 0] * size + mean
    rows = rng.normal(size=(2 * frames, 3))
    frame = np.repeat(np.arange(frames), 2)
    return WhitenedInnovations(frame, np.zeros_like(frame), rows, rows, (C @ xi[..., None])[..., 0], C)


def test_components_given_others_are_those_of_the_conditional():
    found, given = shared_of(frames=5), np.array([5, 1])
    z = evidence.partial(found, 2, given)
    for k in range(5):
        c, C = found.score[k], found.information[k]
        weight = np.linalg.solve(C[np.ix_(given, given)], C[given, 2])
        expected = (c[2] - weight @ c[given]) / np.sqrt(C[2, 2] - weight @ C[given, 2])
        assert z[k] == pytest.approx(expected)
    np.testing.assert_allclose(evidence.partial(found, 0, given[:0]), found.shared[:, 0])


def test_shared_squares_are_those_of_the_score():
    found = shared_of(frames=4)
    inverse = np.linalg.inv(found.information)
    np.testing.assert_allclose(found.shared_nis, np.einsum("ta,tab,tb->t", found.score, inverse, found.score))
    none = dataclasses.replace(found, score=np.zeros((4, 6)), information=np.zeros((4, 6, 6)))
    assert np.isnan(none.shared).all() and np.isnan(none.shared_nis).all()


def test_one_constant_motion_is_blamed_on_its_axis_alone():
    found = evidence.shared_innovations(shared_of(0.4 * np.eye(6)[4]), np.ones(400, dtype=bool))
    assert found.order[0] == 4
    assert found.factor[4] > 2 * np.delete(found.factor, 4).max()


def test_errors_of_any_size_are_found():
    found = evidence.shared_innovations(shared_of(size=2.5), np.ones(400, dtype=bool))
    np.testing.assert_allclose(found.std, 2.5, rtol=0.15)
    assert found.size.value == pytest.approx(6.25, rel=0.1)
    np.testing.assert_allclose(found.factor, 2.5, rtol=0.4)


def test_a_factor_is_exceeded_by_three_standard_errors_of_its_variance():
    found = evidence.shared_innovations(shared_of(), np.ones(400, dtype=bool))
    error = np.sqrt(4 * 40 / 3 / 400)  # of a long-run variance over 40 lags
    np.testing.assert_allclose(found.factor_low, found.factor / np.sqrt(1 + 3 * error))


@pytest.fixture(scope="module")
def one_run() -> Result:
    return run(world(0, frames=80))


@pytest.mark.slow
def test_rounding_of_a_known_pose_is_no_disagreement(one_run):
    known = one_run.covariance.copy()
    known[0] = 1e-36 * np.eye(6)
    smoothed, exact = posterior(one_run), dataclasses.replace(one_run, covariance=known)
    assert judge(exact, smoothed).smoother.size == pytest.approx(judge(one_run, smoothed).smoother.size, rel=0.05)
    truth = world(0, frames=80).truth
    assert np.isnan(pose_nees_by_axis(exact, truth)[0]).all()


@pytest.mark.slow
def test_smoother_against_filter(one_run):
    smoothed = posterior(one_run)
    found = evidence.smoother_agreement(one_run, smoothed)
    assert 0.7 < found.size < 1.6
    difference = pose_error(one_run.T_world_imu, smoothed.T_world_imu)
    for axis, std in enumerate(found.std):
        shares = []
        for P, after, d in zip(one_run.covariance, smoothed.pose_covariance, difference, strict=True):
            turned = se3.adjoint(se3.exp(-d))
            gain = (P - turned @ after @ turned.T)[axis, axis]
            if P[axis, axis] > 0 and gain > 0.05 * P[axis, axis]:
                shares.append(d[axis] ** 2 / gain)
        assert std == pytest.approx(np.sqrt(np.mean(shares)), rel=1e-6)
    # Poses that are beside where they should be, but promise as much as before.
    beside = np.full(6, 3.0) * np.sqrt(one_run.covariance[:, [0], 0])
    bold = dataclasses.replace(one_run, T_world_imu=one_run.T_world_imu @ se3.exp(beside))
    assert evidence.smoother_agreement(bold, smoothed).size > 1.7 * found.size


def test_values_table_and_figure_say_the_same(one_run):
    found = judge(one_run, posterior(one_run))
    values = json.loads(json.dumps(found.values, allow_nan=False))
    assert values["verdict"] == found.verdict and values["axes"] == list(evidence.AXES)
    assert values["shared"]["factor"] == pytest.approx(found.shared.factor)
    assert found.verdict in found.table and evidence.BLIND in found.table
    assert f"{found.nis.value:.3g}" in found.table
    figure = plot_check(one_run, found)
    assert len(figure.axes) == 6
    dots = next(line for line in figure.axes[0].lines if line.get_label() == "frame")
    seen = one_run.innovation.dof > 0
    np.testing.assert_allclose(dots.get_ydata(), (one_run.innovation.nis / np.maximum(one_run.innovation.dof, 1))[seen])
    drawn = next(ax for ax in figure.axes if ax.get_title().startswith("rejections"))
    for line in drawn.lines:
        count = (one_run.rejections.reason == REASONS.index(line.get_label())).sum()
        assert 0 < (line.get_ydata() > 0).sum() <= count
    assert len(drawn.lines) == len(np.unique(one_run.rejections.reason))
    for ax in figure.axes:
        assert "[" in ax.get_xlabel() and "[" in ax.get_ylabel() and ax.get_title()
    assert found.verdict[:20] in figure.get_suptitle()


def test_neither_a_truth_without_poses_nor_a_run_without_covariance_is_compared():
    sequence = synthetic_sequence(frames=5)
    result, truth = synthetic_result(sequence), sequence.truth
    assert evidence.truth_agreement(result, truth, None) is not None
    none = dataclasses.replace(truth, frame=truth.frame[:0], T_world_imu=truth.T_world_imu[:0])
    assert evidence.truth_agreement(result, none, None) is None
    unsure = dataclasses.replace(result, covariance=np.zeros_like(result.covariance), attributes={OTHER: "theirs"})
    assert evidence.truth_agreement(unsure, truth, None) is None


@pytest.mark.parametrize(
    ("changes", "words"),
    [({"whitened": None}, "run again"), ({"whitened": None, "mode": "smoothed"}, "check 'full'")],
)
def test_results_without_innovations_are_refused(one_run, changes, words):
    changed = dataclasses.replace(one_run, **changes)
    with pytest.raises(HonestyError, match=words):
        require_innovations(changed)
    assert judge(changed).shared is None


def test_a_recording_too_short_to_judge_is_refused():
    with pytest.raises(HonestyError, match="only 14 frames"):
        require_innovations(run(world(0, frames=15)))
