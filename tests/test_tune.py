"""Noise from the innovations: the likelihood itself, what it finds in simulations, and the way of a tuned file."""

import copy
import dataclasses
import tomllib

import numpy as np
import pytest
from support.helpers import run_joint, tracked
from support.jacobians import measurement_jacobian
from support.reference import small_world
from support.running import WHOLE

from ekfslam import open_sequence
from ekfslam.cli import main
from ekfslam.config import Config, FilterConfig, HygieneConfig, NoiseConfig
from ekfslam.data.readers import write_sequence
from ekfslam.data.sequence import Noise, Observations
from ekfslam.data.simulate import builtin
from ekfslam.errors import ConfigError, EmptyTracksError
from ekfslam.filters import consensus
from ekfslam.filters.dead_reckoning import dead_reckon
from ekfslam.filters.gaussian import Gaussian
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import run_filter
from ekfslam.filters.mapping import IndependentLandmarks
from ekfslam.geometry import motion
from ekfslam.models.noise import VelocityNoise, velocity_noise, with_drift
from ekfslam.models.sensors.base import MOVING
from ekfslam.models.sensors.stereo import Rig
from ekfslam.resolve import noise_of, settings_of
from ekfslam.runner import run
from ekfslam.storage.archive import open_result
from ekfslam.studies import tuning
from ekfslam.studies.tuning import (
    LOG_WRONG,
    OUTLIER_SHARE,
    Likelihood,
    Peak,
    estimates_of,
    log_likelihoods,
    parts_of,
    sandwich,
    stretches,
    tune,
    with_differences,
    without_rejected,
)

OPEN = FilterConfig(landmark_coordinates="xyz", gate_probability=1.0, split_after=0)
WHITE = Config(noise=NoiseConfig(model="white"))


def without_noise(sequence):
    return dataclasses.replace(sequence, noise=None)


def with_outliers(world, share=0.08, size=30.0):
    """The world with some observations grossly wrong."""
    rng = np.random.default_rng(5)
    pixels = world.observations.pixels_px.copy()
    wrong = rng.random(len(pixels)) < share
    pixels[wrong] += size * rng.choice([-1, 1], wrong.sum())[:, None]
    observations = Observations(world.observations.frame, world.observations.landmark, pixels)
    return dataclasses.replace(world, observations=observations)


def dense_log_density(ekf, report, measured):
    """log N(r; 0, S) of the accepted, known observations of a frame from the state before it; explicit inverses."""
    known = (report.reason == -1) & np.isin(report.ids, ekf.ids) & ~np.isin(report.ids, report.split)
    ids = report.ids[known]
    if len(ids) == 0:
        return 0.0
    H = measurement_jacobian(ekf, ids).toarray()
    rows = ekf.sensor.rows(measured[known])
    slot = [ekf.ids.tolist().index(i) for i in ids]
    q = (ekf.sensor.T_cam_imu @ ekf.T_imu_world)[:3] @ np.c_[ekf.positions_m[slot], np.ones(len(ids))].T
    r = (rows - ekf.sensor.predict(q.T)).ravel()
    S = H @ ekf.P @ H.T + np.diag(np.tile(ekf.sensor.variance_px2, len(ids)))
    return -0.5 * (r @ np.linalg.inv(S) @ r + np.log(np.linalg.eigvalsh(S)).sum() + len(r) * np.log(2 * np.pi))


@pytest.mark.slow
@pytest.mark.parametrize("gate", [1.0, 0.99])
def test_log_likelihood_equals_the_dense_one_also_where_rows_are_taken_out_again(gate, monkeypatch):
    # Where the pose is uncertain the first gate passes outliers that the second then finds, and takes out. It is
    # certain enough that no frame is linearised again.
    world = with_outliers(small_world(sigma_v=1.0, sigma_w=0.03), 0.0 if gate == 1.0 else 0.08, 12.0)
    config = FilterConfig(gate_probability=gate, split_after=0, retire="never", engine="reference")
    ekf = JointEKF(Rig(world.camera, world.T_cam_imu, world.noise), config, world.initial_T_world_imu)
    solve, solved, taken_out = Gaussian.solve, [], False

    def spy(gaussian, projection, *arguments):
        solved.append(len(projection.rows.slot))
        return solve(gaussian, projection, *arguments)

    for k in range(len(world)):
        if k:
            ekf.predict(world.twist[k], world.time_s[k] - world.time_s[k - 1])
        ids, pixels = world.observations.at(k)
        before = copy.deepcopy(ekf)
        solved.clear()
        with monkeypatch.context() as patch:
            patch.setattr(Gaussian, "solve", spy)
            report = ekf.update(k, ids, pixels)
        taken_out |= len(solved) > 1 and solved[-1] < solved[0]
        np.testing.assert_allclose(
            report.log_likelihood, dense_log_density(before, report, pixels), rtol=1e-7, atol=1e-6
        )
    assert taken_out == (gate < 1)


@pytest.mark.slow
def test_log_likelihood_of_a_wide_frame_is_that_of_its_accepted_rows_as_linearised_last(monkeypatch):
    world = with_outliers(small_world(sigma_v=1.0, sigma_w=0.1), 0.08, 12.0)
    config = FilterConfig(gate_probability=0.99, split_after=0, retire="never", engine="reference")
    ekf = JointEKF(Rig(world.camera, world.T_cam_imu, world.noise), config, world.initial_T_world_imu)
    solve, correct, solved, found = Gaussian.solve, consensus.correct, [], []

    def spy(gaussian, projection, *arguments):
        solution = solve(gaussian, projection, *arguments)
        solved.append((solution, projection.rows, gaussian.P.copy()))
        return solution

    def kept(*arguments):
        found.append(correct(*arguments))
        return found[-1]

    monkeypatch.setattr(Gaussian, "solve", spy)
    monkeypatch.setattr(consensus, "correct", kept)
    again = 0
    for k in range(len(world)):
        if k:
            ekf.predict(world.twist[k], world.time_s[k] - world.time_s[k - 1])
        predicted = ekf.T_imu_world
        report = ekf.update(k, *world.observations.at(k))
        if np.array_equal(found[-1].linear.values["pose"], predicted):
            continue
        again += 1
        rows, P = next((rows, P) for solution, rows, P in solved if solution is found[-1].solution)
        np.testing.assert_array_equal(rows.slot, found[-1].slot)
        H = np.zeros((*rows.residual.shape, len(P)))
        H[..., : rows.H_x.shape[-1]] = rows.H_x
        for i, slot in enumerate(rows.slot):
            own = ekf.gaussian.body + 3 * slot
            H[i, :, own : own + 3] = rows.H_m[i]
        H, r = H.reshape(-1, len(P)), rows.residual.ravel()
        S = H @ P @ H.T + np.diag(rows.variance.ravel())
        expected = -0.5 * (r @ np.linalg.inv(S) @ r + np.log(np.linalg.eigvalsh(2 * np.pi * S)).sum())
        np.testing.assert_allclose(report.log_likelihood, expected, rtol=1e-7, atol=1e-6)
    assert again > 3


def test_measured_velocities_count_where_they_are_in_the_state():
    world = small_world()
    noise = dataclasses.replace(world.noise, twist_walk_std=np.repeat([0.2, 0.02], 3))
    ekf = JointEKF(Rig(world.camera, world.T_cam_imu, noise), OPEN, world.initial_T_world_imu)
    P, u, total = np.diag(noise.twist_std**2), None, 0.0
    for k in range(1, 30):
        ekf.predict(world.twist[k], 0.1)
        none = np.empty(0, dtype=np.int64)
        total += ekf.update(k, none, np.empty((0, 4))).log_likelihood
        if u is None:
            u, expected = world.twist[k], 0.0
            continue
        P = P + np.diag(noise.twist_walk_std**2)
        S, r = P + np.diag(noise.twist_std**2), world.twist[k] - u
        expected -= 0.5 * (r @ np.linalg.inv(S) @ r + np.log(np.linalg.det(2 * np.pi * S)))
        u, P = u + P @ np.linalg.inv(S) @ r, P - P @ np.linalg.inv(S) @ P
    np.testing.assert_allclose(total, expected, rtol=1e-10)


def test_mapping_and_the_joint_filter_agree_where_nothing_but_landmarks_is_uncertain():
    world = small_world()
    noise = Noise.isotropic(0.0, 0.0, 0.8)
    config = settings_of(world, Config(filter=OPEN))
    rig = Rig(world.camera, world.T_cam_imu, noise)
    reports = run_joint(world, rig, config.filter)[2]
    T, _ = dead_reckon(world, noise, np.zeros((6, 6)))
    other = [frame.report for frame in run_filter(IndependentLandmarks(rig, config.filter, T), world)]
    np.testing.assert_allclose([a.log_likelihood for a in reports], [b.log_likelihood for b in other], rtol=1e-6)


@pytest.mark.slow
def test_rejecting_everything_does_not_pay():
    world = builtin("city?frames=20")
    config = settings_of(world, Config())
    right = log_likelihoods(world, world.noise, config).sum()
    for factor in (0.02, 0.2, 5.0):
        wrong = Noise.isotropic(0.5 * factor, 0.05 * factor, 0.7 * factor)
        assert log_likelihoods(world, wrong, config).sum() < right - 1000


@pytest.mark.slow
def test_wrong_matches_are_left_out_and_splits_go_on_as_new_tracks():
    world = builtin("city?frames=30&max_tracks=30&outlier_fraction=0.05")
    config = settings_of(world, Config())
    kept, rejected = without_rejected(world, world.noise, config)
    result = run(world, "full")
    assert (
        rejected == result.counts["rejected: gate"] + result.counts["rejected: behind camera"] + result.counts["split"]
    )
    assert len(kept.observations) == len(world.observations) - rejected + result.counts["split"]
    assert len(kept.observations.ids) >= len(world.observations.ids) + result.counts["split"] - 20
    # Nothing is left to reject, but for what the others' removal brings to light.
    again = without_rejected(kept, world.noise, config)[1]
    assert again < 0.05 * rejected


@pytest.mark.slow
def test_long_recordings_are_filtered_in_stretches_spread_over_them():
    world = without_noise(builtin("city?frames=700"))
    config = settings_of(world, Config())
    parts = stretches(world, config, 10_000)
    assert [len(part) for part in parts] == [50] * len(parts)
    begins = [int(np.flatnonzero(world.time_s == part.time_s[0])[0]) for part in parts]
    assert begins[0] == 0 and begins[-1] == 650 and len(begins) == 3
    for begin, part in zip(begins, parts, strict=True):
        np.testing.assert_array_equal(part.twist, world.twist[begin : begin + 50])
        a, b = part.observations.at(40), world.observations.at(begin + 40)
        np.testing.assert_array_equal(a[1], b[1])
    # Dead reckoning from one stretch's pose leads to the next one's.
    T = np.linalg.inv(parts[0].truth.T_world_imu[0])
    for k in range(1, begins[1] + 1):
        T = motion.increment(world.twist[k], world.time_s[k] - world.time_s[k - 1]) @ T
    np.testing.assert_allclose(np.linalg.inv(T), parts[1].truth.T_world_imu[0], atol=1e-8)
    whole = stretches(world, config, 10**6)
    assert [len(part) for part in whole] == [700]


def test_the_sandwich_widens_errors_where_gradients_are_correlated_and_never_narrows_them():
    rng = np.random.default_rng(0)
    H = -4000 * np.array([[2.0, 0.6], [0.6, 1.0]])
    scores = np.linalg.cholesky(-H / 4000) @ rng.standard_normal((2, 4000))
    inverse = np.linalg.inv(-H)
    np.testing.assert_allclose(np.sqrt(np.diag(sandwich(H, scores))), np.sqrt(np.diag(inverse)), rtol=0.1)
    np.testing.assert_allclose(np.diag(sandwich(H, 1e-3 * scores)), np.diag(inverse), rtol=1e-9)
    # Ten frames in a row with the same gradient are worth as much as one.
    again = sandwich(H, np.repeat(scores[:, :400], 10, axis=1))
    np.testing.assert_allclose(np.sqrt(np.diag(again)), np.sqrt(10 * np.diag(inverse)), rtol=0.12)
    assert (np.linalg.eigvalsh(again) > 0).all()


def test_what_is_rejected_counts_in_the_likelihood_of_a_round():
    world = builtin("city?frames=12&outlier_fraction=0.2")
    config = settings_of(world, Config())
    base = noise_of(world, config)
    parts, gated, ungated = parts_of(world, config, base, 10_000)
    likelihood = Likelihood(parts, base, ["sigma_px"], gated, ungated)
    x = np.log([1.0])
    noise = likelihood.noise(x)
    loose = dataclasses.replace(noise, twist_std=3.0 * noise.twist_std, motion_std=3.0 * noise.motion_std)
    rejected = sum(without_rejected(part, loose, gated)[1] for part in parts)
    assert rejected > 20
    assert likelihood.judged(x)(x)[-1] == pytest.approx(rejected * LOG_WRONG)


def test_without_free_parameters_the_likelihood_is_that_of_the_noise_as_it_is():
    world = builtin("city?frames=12")
    config = settings_of(world, Config())
    base = noise_of(world, config)
    parts, gated, ungated = parts_of(world, config, base, 10_000)
    peak = Likelihood(parts, base, [], gated, ungated).climb({}, "")
    assert peak.log_likelihood == sum(log_likelihoods(part, base, gated).sum() for part in parts) < 0
    assert peak.runs == len(parts) and peak.converged


def test_where_the_likelihood_has_no_maximum_the_differences_count():
    found = VelocityNoise(np.array([0.2, 0.0]), np.array([0.01, 0.0]), np.zeros(2), np.zeros(2))
    free = ["sigma_v_m_s", "sigma_w_rad_s", "sigma_px"]
    start = {"sigma_v_m_s": 0.2, "sigma_w_rad_s": 0.02, "sigma_px": 1.0}
    flat = Peak(np.log([0.3, 0.03, 2.0]), np.array([0, 2]), np.eye(2), np.zeros((2, 50)), 0.0, 9, converged=False)
    linear, angular, pixels = estimates_of(start, free, flat, found)
    assert (linear.value, linear.error, linear.likely) == (0.2, 0.01, pytest.approx(0.3))
    assert (angular.value, angular.error) == (pytest.approx(0.03), None) and "at the bound" in angular.remark
    assert (pixels.value, pixels.error) == (pytest.approx(2.0), None) and "no maximum" in pixels.remark


def test_differences_and_likelihood_are_weighted_by_their_information():
    x, C = np.log([0.6, 0.2]), np.array([[0.01, -0.004], [-0.004, 0.02]])
    found = VelocityNoise(np.array([0.5, 0.0]), np.array([0.03, 0.0]), np.array([0.6, 0.01]), np.zeros(2))
    together, covariance = with_differences(x, C, ["sigma_v_m_s", "sigma_px"], found)
    information = np.linalg.inv(C) + np.diag([(0.5 / 0.03) ** 2, 0.0])
    mean = np.linalg.solve(information, np.linalg.solve(C, x) + np.array([(0.5 / 0.03) ** 2 * np.log(0.5), 0.0]))
    np.testing.assert_allclose(covariance, np.linalg.inv(information), atol=1e-12)
    np.testing.assert_allclose(together, mean, atol=1e-12)
    # Where the differences see nothing, the likelihood is left alone.
    np.testing.assert_array_equal(with_differences(x, C, ["sigma_w_rad_s", "sigma_px"], found)[0], x)


def test_velocity_noise_is_below_its_limit_also_where_none_is_seen():
    below, unseen = 0, 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        walk = np.cumsum(rng.normal(0, [0.2] * 3 + [0.02] * 3, (500, 6)), axis=0)
        found = velocity_noise(walk + rng.normal(0, [0.03] * 3 + [0.003] * 3, (500, 6)))
        below += np.sum(found.limit > [0.03, 0.003])
        unseen += np.sum(found.sigma == 0)
        assert (found.limit > found.sigma).all() and (found.limit < [0.2, 0.02]).all()
        assert (found.texts[0].startswith("below")) == (found.sigma[0] == 0)
    assert below >= 185 and unseen > 20


@pytest.mark.slow
def test_a_run_keeps_the_log_likelihood_of_its_innovations():
    world = builtin("city?frames=40&outlier_fraction=0")
    config = Config(filter=OPEN)
    expected = log_likelihoods(world, world.noise, settings_of(world, config)).sum()
    result = run(world, "full", dataclasses.replace(config, hygiene=HygieneConfig(min_disparity_sigma=0)))
    of_right = result.innovation.dof.sum() // 3 * np.log1p(-OUTLIER_SHARE)
    np.testing.assert_allclose(result.attributes["log_likelihood"], expected - of_right)
    assert "log_likelihood" not in run(world, "dead-reckoning").attributes


def test_moving_tracks_can_be_left_out_alone():
    world = with_outliers(small_world())
    config = settings_of(world, Config())
    assert without_rejected(world, world.noise, config)[1] > 50
    split_none = dataclasses.replace(config, filter=dataclasses.replace(config.filter, split_after=0))
    same, rejected = without_rejected(world, world.noise, split_none, (MOVING,))
    assert rejected == 0 and len(same.observations) == len(world.observations)


@pytest.mark.slow
@pytest.mark.parametrize(
    "query",
    [
        "frames=150&seed=0&sigma_px=1.0",
        "frames=150&seed=1&sigma_px=0.5",
        "frames=150&seed=2",
        "frames=60&sigma_px=0.3&outlier_fraction=0",
    ]
    if WHOLE
    else ["frames=60&seed=1&sigma_px=0.5"],
)
def test_the_noise_of_simulations_is_recovered(query):
    """With many landmarks every velocity is known afterwards: 3 (T - 1) samples, relative error (6 (T - 1))^-1/2.

    That is 0.05 after 60 frames, so that 0.15 are three standard errors of the reduced form.
    """
    world = builtin(f"city?{query}")
    tuned = tune(without_noise(world), WHITE)
    true = {"sigma_v_m_s": 0.5, "sigma_w_rad_s": 0.05, "sigma_px": world.noise.pixel_std_px[0]}
    assert tuned.converged and not tuned.remarks
    for estimate in tuned.estimates:
        assert abs(estimate.value / true[estimate.name] - 1) < 0.15, estimate
        assert 0 < estimate.error < 0.08 * estimate.value
    for estimate in tuned.estimates[:2]:
        assert 0.8 < estimate.error / estimate.value * np.sqrt(6 * (len(world) - 1)) < 1.15


@pytest.mark.slow
@pytest.mark.parametrize("sigma_px", [0.5, pytest.param(2.0, marks=pytest.mark.slow)])
def test_little_noise_and_much_are_told_apart_without_outliers(sigma_px):
    world = without_noise(builtin(f"city?frames=24&max_tracks=10&outlier_fraction=0&sigma_px={sigma_px}"))
    tuned = tune(world, WHITE)
    values = {estimate.name: estimate for estimate in tuned.estimates}
    assert abs(values["sigma_px"].value / sigma_px - 1) < 0.1
    assert abs(values["sigma_v_m_s"].value - 0.5) < 4 * values["sigma_v_m_s"].error
    assert abs(values["sigma_w_rad_s"].value - 0.05) < 4 * values["sigma_w_rad_s"].error


# The likelihood's Hessian is singular with a drift: no standard errors, or any.


@pytest.mark.slow
@pytest.mark.parametrize(
    ("drift_px", "size"),
    [(0.1, "frames=60&max_tracks=12"), (0.4, "frames=60&max_tracks=12")]
    if WHOLE
    else [(0.2, "frames=45&max_tracks=8")],
)
@pytest.mark.filterwarnings("ignore:invalid value")
def test_how_errors_of_tracks_walk_is_recovered(drift_px, size):
    """Of a drive through a town whose tracks err by so much more from frame to frame."""
    world = builtin(f"city?{size}&outlier_fraction=0")
    world = without_noise(tracked(world, with_drift(world.noise, drift_px).track_error))
    found = {estimate.name: estimate for estimate in tune(world, WHITE, drift=True).estimates}
    for name, true in (("sigma_v_m_s", 0.5), ("sigma_w_rad_s", 0.05), ("drift", drift_px)):
        assert abs(found[name].value / true - 1) < 0.15
        assert abs(found[name].value - true) < 4 * found[name].error
        assert 0.01 < found[name].error / true < 0.1
        assert "bound" not in found[name].remark


@pytest.mark.slow
@pytest.mark.data
def test_the_noise_added_to_a_recording_is_recovered(data_path, monkeypatch):
    """The reduced form filters 45 of 1106 frames; its likelihood alone has a relative error of 0.06."""
    if not WHOLE:
        monkeypatch.setattr(tuning, "STRETCH_FRAMES", 15)
    tuned = tune(open_sequence(data_path("ece276a/0027_dense_noisy.npz")), observations=15_000 if WHOLE else 1)
    for estimate, true in zip(tuned.estimates[:2], [0.5, 0.05], strict=True):
        assert abs(estimate.value / true - 1) < 0.15
        assert abs(estimate.likely / true - 1) < 0.2


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize("name", ["ece276a/0027.npz", "ece276a/0042.npz"])
def test_clean_recordings_have_little_noise(data_path, name, monkeypatch):
    monkeypatch.setattr(tuning, "STRETCH_FRAMES", 10)  # what is looked at are the velocities, all of them
    tuned = tune(open_sequence(data_path(name)), observations=1)
    v, w, px = tuned.estimates
    assert v.value < 0.05 and w.value < 0.005
    assert "not refined" in v.remark and "not refined" in w.remark
    assert 0.05 < px.value < 5


@pytest.mark.slow
def test_a_tuned_file_goes_from_tune_to_run(tmp_path, capsys):
    recording, file, archive = tmp_path / "city.h5", tmp_path / "noise.toml", tmp_path / "run.h5"
    world = without_noise(builtin("city?frames=20&max_tracks=8"))
    write_sequence(world, recording)
    assert main(["tune", str(recording), "--out", str(file)]) == 0
    printed = capsys.readouterr().out
    assert "| sigma_v_m_s | m/s |" in printed and "| sigma_px | px |" in printed and "+-" in printed
    # The likelihood has a maximum where tracks err, too.
    rows = [line.split("|")[1:-1] for line in printed.splitlines() if line.startswith("| sigma_")]
    assert ["+-" in by_likelihood for _, _, _, by_likelihood, _ in rows] == [True, True, False]
    stored = tomllib.loads(file.read_text())
    assert stored["noise"]["model"] == "tuned"
    for key in ("sigma_v_m_s", "sigma_w_rad_s"):
        assert f"{stored['noise'][key]:.3g} +- {stored['tuning'][f'{key}_error']:.2g}" in printed

    assert main(["run", str(recording), "--config", str(file), "--out", str(archive)]) == 0
    result = open_result(archive, "full")
    # The sigmas are the tuned ones, and the rest of the automatic model is still there.
    automatic = noise_of(world, Config())
    assert automatic.track_error is not None
    sigmas = [stored["noise"][key] for key in ("sigma_v_m_s", "sigma_w_rad_s")]
    np.testing.assert_array_equal(result.noise.twist_std[[0, 3]], sigmas)
    np.testing.assert_array_equal(result.noise.pixel_std_px, stored["noise"]["sigma_px"])
    for name in vars(automatic).keys() - {"twist_std", "pixel_std_px"}:
        np.testing.assert_array_equal(getattr(result.noise, name), getattr(automatic, name))
    for key, value in stored["tuning"].items():
        assert result.attributes[f"tuned_{key}"] == value
    assert result.attributes["tuned_runs"] > 5 and result.attributes["tuned_log_likelihood"] < 0


def test_every_automatic_run_keeps_what_was_found(tmp_path):
    world = without_noise(builtin("city?frames=40"))
    found = velocity_noise(world.twist)
    attributes = run(world, "dead-reckoning").attributes
    assert attributes["found_sigma_v_m_s"] == found.sigma[0]
    assert attributes["found_sigma_w_rad_s_error"] == found.sigma_error[1] > 0
    assert not any(key.startswith("tuned") for key in attributes)
    # Nothing is found where noise is stated or white.
    for sequence, config in ((builtin("city?frames=40"), Config()), (world, WHITE)):
        assert not any(key.startswith("found") for key in run(sequence, "dead-reckoning", config).attributes)


def test_the_models_of_noise():
    world = without_noise(builtin("city?frames=100"))
    automatic = noise_of(world, Config())
    by_hand = noise_of(world, Config(noise=NoiseConfig(sigma_px=2.0)))
    tuned = noise_of(world, Config(noise=NoiseConfig(sigma_px=2.0, model="tuned")))
    assert by_hand.track_error is None and by_hand.twist_walk_std is None
    assert automatic.track_error is not None
    for name in ("track_first_px", "track_walk_px", "track_flow_px"):
        np.testing.assert_array_equal(getattr(tuned, name), getattr(automatic, name))
    np.testing.assert_array_equal(tuned.twist_std, automatic.twist_std)
    np.testing.assert_array_equal(tuned.pixel_std_px, 2.0)
    # Drift alone leaves the model as it is; what a recording states stays, too.
    drifting = noise_of(world, Config(noise=NoiseConfig(drift=0.3)))
    assert drifting.twist_walk_std is not None
    np.testing.assert_allclose(drifting.track_walk_px, automatic.track_walk_px * 0.3 / automatic.track_walk_px[0])
    np.testing.assert_array_equal(drifting.track_first_px, automatic.track_first_px)
    assert noise_of(world, Config(noise=NoiseConfig(drift=0.0))).track_error is None
    stated = noise_of(builtin("city?frames=100"), Config(noise=NoiseConfig(sigma_px=2.0, model="tuned")))
    assert stated.track_error is None and stated.twist_std[0] == 0.5 and stated.pixel_std_px[0] == 2.0
    with pytest.raises(ConfigError, match="drift"):
        Config(noise=NoiseConfig(drift=-1.0))


def test_without_observations_there_is_nothing_to_tune():
    world = builtin("city?frames=10")
    none = Observations(np.empty(0), np.empty(0), np.empty((0, 4)))
    with pytest.raises(EmptyTracksError, match="tuned by observations"):
        tune(dataclasses.replace(world, observations=none, attributes={"tracks": "none"}))
