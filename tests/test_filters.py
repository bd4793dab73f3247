"""The filters against slow literal implementations, against each other, and at their limits."""

import dataclasses

import numpy as np
import pytest
from support.jacobians import measurement_jacobian
from support.literal import Literal, filter_of, side_by_side
from support.reference import report_mapping, small_world

from ekfslam.config import Config, FilterConfig, HygieneConfig, NoiseConfig
from ekfslam.data.sequence import Observations
from ekfslam.errors import ConfigError, InnovationError
from ekfslam.filters.dead_reckoning import dead_reckon
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import run_filter
from ekfslam.filters.result import REASONS
from ekfslam.geometry import se3
from ekfslam.models.sensors.stereo import Rig
from ekfslam.runner import run

OPEN = FilterConfig(landmark_coordinates="xyz", gate_probability=1.0, split_after=0)
REFERENCE = dataclasses.replace(OPEN, engine="reference")  # its covariance can be written to
P0 = np.diag([0.1, 0.2, 0.3, 0.01, 0.02, 0.03]) ** 2


def settings(**changes):
    return Config(filter=dataclasses.replace(OPEN, **changes))


@pytest.fixture(scope="module")
def world():
    return small_world()


@pytest.mark.parametrize("variant", ["standard", "invariant"])
@pytest.mark.parametrize("prior", [np.zeros((6, 6)), P0], ids=["certain start", "uncertain start"])
def test_joint_filter_equals_the_literal_one(world, variant, prior):
    ekf = filter_of(world, settings(variant=variant, retire="never").filter, P=prior)
    side_by_side(ekf, Literal(world, variant, P=prior), world, 1e-9, frames=30)
    # The comparison means something only if vision moved the pose and landmarks share information.
    assert np.abs(ekf.T_imu_world - dead_reckon(world, world.noise, prior)[0][29]).max() > 0.1
    assert np.abs(ekf.P[6:9, 9:]).max() > 1e-6


def test_the_variants_differ(world):
    one, two = (filter_of(world, settings(variant=variant).filter, P=P0) for variant in ("standard", "invariant"))
    poses = [[ekf.T_imu_world for _ in run_filter(ekf, world)] for ekf in (one, two)]
    assert np.abs(np.subtract(*poses)).max() > 1e-4


def test_mapping_only_equals_the_report_s_loop_over_landmarks(world):
    result = run(world, "mapping-only", settings())
    expected = report_mapping(world, se3.inverse(result.T_world_imu), world.noise.pixel_std_px[0])
    assert sorted(expected) == result.landmarks.id.tolist()
    for i, identifier in enumerate(result.landmarks.id.tolist()):
        mean, covariance = expected[identifier]
        np.testing.assert_allclose(result.landmarks.position_m[i], mean[:3], atol=1e-10)
        np.testing.assert_allclose(result.landmarks.covariance[i], covariance, atol=1e-10)


@pytest.mark.parametrize(("variant", "gated"), [("standard", True), ("invariant", True), ("invariant", False)])
def test_mapping_only_is_the_joint_filter_without_pose_uncertainty(variant, gated):
    """P_xx(0) = 0 and W = 0; with gate and split in force the decisions must agree as well."""
    world = with_outliers(small_world(seed=3)) if gated else small_world(seed=3)
    filter_config = FilterConfig(landmark_coordinates="xyz") if gated else OPEN
    config = Config(NoiseConfig(0.0, 0.0, None), dataclasses.replace(filter_config, variant=variant, retire="never"))
    mapping, full = run(world, "mapping-only", config), run(world, "full", config)
    np.testing.assert_allclose(full.T_world_imu, mapping.T_world_imu, atol=1e-9)
    order = [np.lexsort((part.landmarks.first_frame, part.landmarks.id)) for part in (full, mapping)]
    for name in ("id", "position_m", "covariance", "initial_position_m", "first_frame", "last_frame", "observations"):
        a, b = (getattr(p.landmarks, name)[o] for p, o in zip((full, mapping), order, strict=True))
        np.testing.assert_allclose(a, b, atol=1e-9, err_msg=name)
    np.testing.assert_allclose(full.innovation.nis, mapping.innovation.nis, atol=1e-6)
    np.testing.assert_array_equal(full.rejections.landmark, mapping.rejections.landmark)
    if gated:
        assert full.counts["split"] == mapping.counts["split"] > 0
        assert full.counts["rejected: gate"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["standard", "invariant"])
def test_retired_and_never_retired_filters_agree_in_every_pose(variant):
    world = with_outliers(small_world(seed=5, frames=60, landmarks=80))
    base = Config(filter=FilterConfig(variant=variant, retire="unseen"))
    unseen = run(world, "full", base)
    never = run(world, "full", base.with_overrides({"filter": {"retire": "never"}}))
    np.testing.assert_allclose(unseen.T_world_imu, never.T_world_imu, atol=1e-9)
    np.testing.assert_allclose(unseen.covariance, never.covariance, atol=1e-9)
    assert unseen.counts["retired"] > never.counts["retired"]
    assert sorted(unseen.landmarks.id) == sorted(never.landmarks.id)


def with_outliers(world, fraction=0.03, seed=11):
    """Single gross outliers, and one track that from its middle on follows another landmark."""
    rng = np.random.default_rng(seed)
    frame, landmark, pixels = (np.array(value) for value in vars(world.observations).values())
    longest = np.bincount(landmark).argmax()
    hit = (rng.uniform(size=len(pixels)) < fraction) & (landmark != longest)
    pixels[hit] += rng.uniform(20, 60, (hit.sum(), 1)) * [1, 0, 1, 0]
    frames = frame[landmark == longest]
    after = frame >= frames[len(frames) // 2]
    other = np.bincount(landmark[after & (landmark != longest) & ~hit]).argmax()
    after &= frame >= frame[landmark == other].min()
    lost = after & (landmark == longest)
    landmark[after & (landmark == other)] = longest
    return dataclasses.replace(world, observations=Observations(frame[~lost], landmark[~lost], pixels[~lost]))


@pytest.mark.parametrize("mode", ["full", "mapping-only"])
def test_landmarks_count_the_observations_that_were_accepted(mode):
    result = run(with_outliers(small_world(seed=5)), mode)
    assert result.landmarks.observations.sum() == result.counts["accepted"]


def test_outliers_are_rejected_listed_and_a_jumped_track_is_split():
    world = with_outliers(small_world(seed=5))
    result = run(world, "full", Config(filter=FilterConfig()))
    longest = np.bincount(world.observations.landmark).argmax()
    pieces = np.flatnonzero(result.landmarks.id == longest)
    assert len(pieces) == 2
    assert result.landmarks.last_frame[pieces[0]] < result.landmarks.first_frame[pieces[1]]
    truth = world.truth.position_m[world.truth.landmark.tolist().index(longest)]
    assert np.linalg.norm(result.landmarks.position_m[pieces[0]] - truth) < 1.0
    assert result.counts["split"] >= 1
    assert len(result.rejections.frame) == result.counts["rejected"] == result.innovation.rejected.sum()
    assert result.counts["accepted"] + result.counts["rejected"] == len(world.observations)
    codes = np.bincount(result.rejections.reason, minlength=len(REASONS))
    assert codes.tolist() == [result.counts.get(f"rejected: {name}", 0) for name in REASONS]


@pytest.mark.parametrize("variant", ["standard", "invariant"])
def test_conditional_gate_equals_leaving_each_landmark_out(variant):
    """Brute force: each landmark tested against the posterior of all others, dense and with explicit inverses."""
    world = small_world(seed=10, sigma_v=1.0, sigma_w=0.07)
    config = Config(filter=FilterConfig(variant=variant, landmark_coordinates="xyz", split_after=0))
    rig, tau = Rig(world.camera, world.T_cam_imu, world.noise), np.diff(world.time_s, prepend=np.nan)
    ekf, free = (JointEKF(rig, f, world.initial_T_world_imu) for f in (config.filter, settings(variant=variant).filter))
    for filter_ in (ekf, free):
        filter_.P = P0.copy()
        for _ in run_filter(filter_, world, range(6)):
            pass
    np.testing.assert_array_equal(ekf.P, free.P)  # nothing was rejected so far
    for filter_ in (ekf, free):
        filter_.predict(world.twist[6], tau[6])

    ids, pixels = world.observations.at(6)
    known = np.isin(ids, ekf.ids)
    ids, pixels = ids[known], pixels[known].copy()
    assert len(ids) >= 5
    # Too small for the marginal gate, whose S holds the pose's uncertainty; plain beside the others.
    pixels[2] += [6.0, 4.0, 6.0, 4.0]
    H = measurement_jacobian(ekf, ids).toarray()
    V = np.diag(np.tile(rig.variance_px2, len(ids)))
    at = [ekf.ids.tolist().index(i) for i in ids]
    q = se3.apply(rig.T_cam_imu @ ekf.T_imu_world, ekf.positions_m[at])
    u = rig.camera.fu_px * q[:, 0] / q[:, 2] + rig.camera.cu_px
    v = rig.camera.fv_px * q[:, 1] / q[:, 2] + rig.camera.cv_px
    predicted = np.column_stack([u, v, u - rig.camera.fu_px * rig.camera.baseline_m / q[:, 2]])
    r = (np.column_stack([pixels[:, 0], pixels[:, [1, 3]].mean(axis=1), pixels[:, 2]]) - predicted).ravel()
    S = H @ ekf.P @ H.T + V
    marginal, conditional = np.zeros(len(ids)), np.zeros(len(ids))
    for i in range(len(ids)):
        own, rest = np.arange(3 * i, 3 * i + 3), np.setdiff1d(np.arange(len(r)), np.arange(3 * i, 3 * i + 3))
        gain = S[np.ix_(own, rest)] @ np.linalg.inv(S[np.ix_(rest, rest)])
        e, C = r[own] - gain @ r[rest], S[np.ix_(own, own)] - gain @ S[np.ix_(rest, own)]
        marginal[i] = r[own] @ np.linalg.inv(S[np.ix_(own, own)]) @ r[own]
        conditional[i] = e @ np.linalg.inv(C) @ e
    expected = conditional <= config.filter.gate
    assert (marginal <= config.filter.gate).all()
    assert not expected[2]
    assert expected.sum() >= 3

    report = ekf.update(6, ids, pixels)
    np.testing.assert_array_equal(report.reason == -1, expected)
    reference = free.update(6, ids[expected], pixels[expected])
    np.testing.assert_allclose(ekf.T_imu_world, free.T_imu_world, atol=1e-10)
    kept = [ekf.ids.tolist().index(i) for i in free.ids]
    columns = np.concatenate([np.arange(6), *(6 + 3 * i + np.arange(3) for i in kept)])
    np.testing.assert_allclose(ekf.P[np.ix_(columns, columns)], free.P, atol=1e-10)
    np.testing.assert_allclose(report.nis, reference.nis, rtol=1e-9)
    assert report.dof == reference.dof


@pytest.mark.slow
def test_a_landmark_that_comes_back_is_revived_or_starts_afresh_and_is_counted():
    world = small_world()
    observations = world.observations
    longest = np.bincount(observations.landmark).argmax()
    track = np.flatnonzero(observations.landmark == longest)
    keep = np.ones(len(observations), dtype=bool)
    keep[track[5:8]] = False
    gapped = dataclasses.replace(
        world,
        observations=Observations(observations.frame[keep], observations.landmark[keep], observations.pixels_px[keep]),
    )
    afresh = run(gapped, "full", settings(retire="unseen", retire_after=1, revive=-1))
    assert (afresh.counts["revived"], afresh.counts["reappeared"]) == (0, 1)
    assert (afresh.landmarks.id == longest).sum() == 2
    revived = run(gapped, "full", settings(retire="unseen", retire_after=1))
    assert (revived.counts["revived"], revived.counts["reappeared"]) == (1, 0)
    assert (revived.landmarks.id == longest).sum() == 1
    # Kept for some frames it is still there when it comes back.
    patient = run(gapped, "full", settings(retire="unseen"))
    assert patient.config["filter"]["retire_after"] == 10
    assert (patient.counts["revived"], patient.counts["reappeared"]) == (0, 0)
    # Left to "auto", a small world with returning landmarks keeps them all.
    automatic = run(gapped, "full", settings(retire="auto"))
    assert automatic.config["filter"]["retire"] == "never"
    assert automatic.counts["retired"] == 0


@pytest.mark.parametrize(("split_after", "splits"), [(2, True), (3, False)])
def test_misses_in_a_row_count_on_after_a_landmark_was_away(split_after, splits):
    world = small_world()
    observations = world.observations
    longest = np.bincount(observations.landmark).argmax()
    track = np.flatnonzero(observations.landmark == longest)
    pixels = observations.pixels_px.copy()
    pixels[track[[4, 8]]] += 60.0  # the last before it goes, the first afterwards
    keep = np.delete(np.arange(len(observations)), track[5:8])
    gapped = Observations(observations.frame[keep], observations.landmark[keep], pixels[keep])
    config = Config().with_overrides(
        {"filter": {"retire": "unseen", "retire_after": 1, "split_after": split_after}, "hygiene": {"jump_sigma": 0.0}}
    )
    result = run(dataclasses.replace(world, observations=gapped), "full", config)
    assert result.counts["revived"] == 1
    assert ((result.landmarks.id == longest).sum() > 1) == splits


def test_what_has_no_depth_is_rejected_whatever_hygiene_does():
    world = small_world()
    pixels = world.observations.pixels_px.copy()
    pixels[0, 2] = pixels[0, 0] + 1.0
    pixels[1, 2] = pixels[1, 0]
    bad = dataclasses.replace(
        world, observations=Observations(world.observations.frame, world.observations.landmark, pixels)
    )
    for mode in ("mapping-only", "full"):
        result = run(bad, mode, Config(filter=OPEN, hygiene=HygieneConfig(min_disparity_sigma=0.0)))
        found = {(int(f), int(i)): REASONS[r] for f, i, r in zip(*vars(result.rejections).values(), strict=True)}
        assert found[(0, int(world.observations.landmark[0]))] == "disparity"
        assert found[(0, int(world.observations.landmark[1]))] == "disparity"


def test_a_frame_without_observations_is_a_prediction():
    world = small_world()
    keep = (world.observations.frame != 30) & (world.observations.frame != 0)
    observations = Observations(
        world.observations.frame[keep], world.observations.landmark[keep], world.observations.pixels_px[keep]
    )
    result = run(dataclasses.replace(world, observations=observations), "full", settings())
    step = se3.inverse(result.T_world_imu[30]) @ result.T_world_imu[29]
    tau = world.time_s[30] - world.time_s[29]
    np.testing.assert_allclose(se3.log(step), -tau * world.twist[30], atol=1e-9)
    assert result.innovation.dof[30] == 0


def test_non_positive_innovation_covariance_names_frame_and_landmarks(world):
    rig = Rig(world.camera, world.T_cam_imu, world.noise)
    ekf = JointEKF(rig, REFERENCE, world.initial_T_world_imu)
    ids, pixels = world.observations.at(0)
    ekf.update(0, ids, pixels)
    ekf.P[9:12, 9:12] = -np.eye(3)
    with pytest.raises(InnovationError, match="frame 1") as caught:
        ekf.update(1, ids, pixels)
    assert caught.value.frame == 1
    assert caught.value.ids == (ekf.ids[1],)


def test_indefinite_as_a_whole_is_an_error_too(world):
    rig = Rig(world.camera, world.T_cam_imu, world.noise)
    ekf = JointEKF(rig, REFERENCE, world.initial_T_world_imu)
    ids, pixels = world.observations.at(0)
    ekf.update(0, ids, pixels)
    ekf.P[6:9, 9:12] = ekf.P[9:12, 6:9] = 50 * np.eye(3)
    with pytest.raises(InnovationError) as caught:
        ekf.update(1, ids, pixels)
    assert set(caught.value.ids) == set(ekf.ids.tolist())


def test_measurement_jacobian_of_an_unknown_landmark(world):
    ekf = JointEKF(Rig(world.camera, world.T_cam_imu, world.noise), OPEN, np.eye(4))
    with pytest.raises(KeyError, match="12345"):
        measurement_jacobian(ekf, np.array([12345]))


def test_dead_reckoning_covariance_is_that_of_sampled_runs(world):
    """The spread of xi over 2000 runs with sampled velocity noise matches the covariance carried along."""
    rng = np.random.default_rng(2)
    short = slice(0, 15)
    T_hat, P = dead_reckon(world, world.noise, P0)
    start = se3.exp(rng.multivariate_normal(np.zeros(6), P0, 2000)) @ T_hat[0]
    for k in range(1, 15):
        noise = rng.normal(size=(2000, 6)) * world.noise.twist_std
        tau = world.time_s[k] - world.time_s[k - 1]
        start = se3.exp(-tau * (world.twist[short][k] - noise)) @ start
    sampled = np.cov(se3.log(start @ se3.inverse(T_hat[14])).T)
    scale = np.sqrt(np.diag(P[14]))
    np.testing.assert_allclose(sampled / np.outer(scale, scale), P[14] / np.outer(scale, scale), atol=0.12)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"noise": {"sigma_px": 0.0}}, "sigma_px"),
        ({"noise": {"sigma_v_m_s": float("nan")}}, "sigma_v_m_s"),
        ({"noise": {"sigma_v_m_s": -1.0}}, "sigma_v_m_s"),
        ({"noise": {"sigma": 1.0}}, r"unknown key noise\.sigma"),
        ({"gates": {}}, "unknown table"),
        ({"noise": 3}, "must be a table"),
        ({"filter": {"variant": "best"}}, "variant"),
        ({"filter": {"variant": 3}}, "must be a string"),
        ({"filter": {"gate_probability": 0.0}}, "gate_probability"),
        ({"filter": {"gate_probability": "high"}}, "must be a number"),
        ({"filter": {"min_disparity_px": 2.0}}, "min_disparity_px"),
        ({"hygiene": {"min_disparity_sigma": -1.0}}, "min_disparity_sigma"),
        ({"hygiene": {"jump_sigma": float("inf")}}, "jump_sigma"),
        ({"hygiene": {"min_observations": 2.5}}, "min_observations"),
        ({"hygiene": {"restart_at_repeats": 1}}, "must be a truth value"),
        ({"filter": {"split_after": 1.5}}, "split_after"),
        ({"filter": {"split_after": -1}}, "split_after"),
    ],
)
def test_bad_configuration_is_named(overrides, message):
    with pytest.raises(ConfigError, match=message):
        Config().with_overrides(overrides)


def test_unknown_mode(world):
    with pytest.raises(ConfigError, match="unknown mode"):
        run(world, "smoothing")


def test_configuration_from_toml(tmp_path):
    path = tmp_path / "config.toml"
    path.write_text('[noise]\nsigma_px = 2\n[filter]\nvariant = "standard"\n')
    config = Config.from_toml(path)
    assert config.noise.sigma_px == 2
    assert config.filter.variant == "standard"
    path.write_text("[noise\n")
    with pytest.raises(ConfigError, match=r"config\.toml"):
        Config.from_toml(path)
    with pytest.raises(ConfigError, match="absent"):
        Config.from_toml(tmp_path / "absent.toml")
