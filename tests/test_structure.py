"""The structure of errors and their sizes from innovations: what is put in is found, and honest where it is used."""

import dataclasses
import functools

import numpy as np
import pytest
import structure
from structure import Candidate, choose, highest, stated_candidates, value_at, with_value
from support.helpers import run_joint
from support.running import WHOLE, seeds

from ekfslam.config import Config, FilterConfig
from ekfslam.data.sequence import WITHOUT_TRACKS, Observations
from ekfslam.data.simulate import Loop, simulate
from ekfslam.errors import ConfigError, EmptyTracksError, InnovationError
from ekfslam.evaluation.consistency import chi2_bounds, nees, pose_error
from ekfslam.geometry import camera, se3
from ekfslam.resolve import resolve

JITTER_M, JITTER_DEG, TIME_S, WHITE_PX = 0.03, 0.4, 0.2, 0.8
FRAMES = 150 if WHOLE else 80
BLOCK = "blocks.camera_jitter."
CONFIG = Config(filter=FilterConfig(gate_probability=1.0, split_after=0, retire="never", revive=-1))
WHITE = Candidate("white", {"noise": {"sigma_px": 2.0}}, (), "noise.sigma_px")
SHARED = Candidate(
    "jitter",
    {
        "noise": {"sigma_px": 1.0},
        "blocks": {"camera_jitter": {"rotation_deg": 0.25, "translation_m": 0.02, "time_s": TIME_S}},
    },
    (BLOCK + "rotation_deg", BLOCK + "translation_m"),
    "noise.sigma_px",
)


def world(seed: int, jitter: bool = True, frames: int = FRAMES):
    """A loop whose camera is moved against the IMU, by errors that a Gauss-Markov process draws here."""
    made = Loop(frames=frames, landmarks=40, seed=seed, sigma_v_m_s=0.05, sigma_w_rad_s=0.005, sigma_px=WHITE_PX)
    sequence = simulate(made)
    if not jitter:
        return sequence
    rng, truth, seen = np.random.default_rng(1000 + seed), sequence.truth, sequence.observations
    std = np.repeat([JITTER_M, np.deg2rad(JITTER_DEG)], 3)
    n = np.empty((frames, 6))
    n[0] = std * rng.standard_normal(6)
    for k in range(1, frames):
        phi = np.exp(-(sequence.time_s[k] - sequence.time_s[k - 1]) / TIME_S)
        n[k] = phi * n[k - 1] + std * np.sqrt(1 - phi**2) * rng.standard_normal(6)
    where = {i: row for row, i in enumerate(truth.landmark.tolist())}
    m = truth.position_m[[where[i] for i in seen.landmark.tolist()]]
    T_imu_world = se3.inverse(np.concatenate([[np.eye(4)], truth.T_world_imu])[-frames:])
    q = se3.apply(sequence.T_cam_imu @ (se3.exp(n) @ T_imu_world)[seen.frame], m)
    pixels = camera.project(sequence.camera, q) + WHITE_PX * rng.standard_normal((len(q), 4))
    return dataclasses.replace(sequence, observations=Observations(seen.frame, seen.landmark, pixels))


def pose_nees_at_end(sequence, overrides) -> float:
    problem = resolve(sequence, CONFIG.with_overrides(overrides), "dead-reckoning")
    ekf, _, _ = run_joint(sequence, problem.model, problem.config.filter)
    return float(nees(pose_error(ekf.T_world_imu, sequence.truth.T_world_imu[-1]), ekf.P[:6, :6]))


# What is put in is found


@functools.cache
def found(seed):
    return choose(world(seed), CONFIG, [SHARED], runs=24)


@pytest.mark.slow
@pytest.mark.xdist_group("camera jitter")
@pytest.mark.parametrize("seed", seeds(8, 1))
def test_sizes_of_a_camera_jitter_are_found(seed):
    choice = found(seed)
    rotation, translation, white = choice.chosen.sizes.values()
    np.testing.assert_allclose([rotation, translation], [JITTER_DEG, JITTER_M], rtol=0.25)
    assert white == pytest.approx(WHITE_PX, rel=0.1)
    assert choice.chosen.nis_per_dof == pytest.approx(1.0, abs=0.1)
    assert set(choice.overrides) == {"noise", "blocks"} and set(choice.overrides["blocks"]) == {"camera_jitter"}


@pytest.mark.slow
@pytest.mark.xdist_group("camera jitter")
def test_the_covariance_is_honest_with_the_sizes_found_and_only_with_them():
    count = 16
    worlds = [world(100 + seed, frames=50) for seed in range(count)]
    low, high = chi2_bounds(6, 0.99, count)
    assert low < np.mean([pose_nees_at_end(one, found(0).overrides) for one in worlds]) < high
    # Noise that is as large, but white, is averaged away over landmarks.
    white = {"noise": {"sigma_px": 3.0}}
    assert np.mean([pose_nees_at_end(one, white) for one in worlds[:4]]) > 3 * high


@pytest.mark.slow
def test_white_noise_is_found_to_be_white():
    choice = choose(world(0, jitter=False), CONFIG, [SHARED, WHITE], runs=10)
    assert choice.chosen.name == "white" and choice.overrides["noise"] == choice.chosen.overrides["noise"]
    assert choice.chosen.sizes["noise.sigma_px"] == pytest.approx(WHITE_PX, rel=0.05)
    assert [tried.name for tried in choice.tried] == ["jitter", "white"]


# The search


@pytest.mark.parametrize("off", [-0.6, -0.2, 0.0, 0.3, 0.7])
def test_highest_finds_the_standard_deviation_of_gaussian_samples(off):
    def log_likelihood(x):  # of samples whose standard deviation has the logarithm off
        return -1000.0 * (x + 0.5 * np.exp(2.0 * (off - x)))

    step = np.log(2.0)
    assert highest(step, *(log_likelihood(x) for x in (-step, 0.0, step))) == pytest.approx(off, abs=0.15)
    step = np.log(1.3)
    values = [log_likelihood(off + x) for x in (0.1 - step, 0.1, 0.1 + step)]
    assert highest(step, *values) == pytest.approx(-0.1, abs=0.01)


def test_highest_takes_the_better_side_where_there_is_no_maximum():
    assert highest(0.5, 3.0, 2.0, 2.5) == -0.5 and highest(0.5, 2.5, 2.0, 3.0) == 0.5
    assert highest(0.5, -np.inf, 2.0, 1.0) == 0.5  # the filter broke down on one side


def test_numbers_at_dotted_names():
    config = Config().with_overrides({"blocks": {"camera_jitter": {"time_s": 2}}})
    assert value_at(config, "blocks.camera_jitter.time_s") == 2.0
    for name in ("noise.sigma_px", "blocks.camera_jitter.rotation_deg", "noise.unknown", "filter.variant"):
        with pytest.raises(ConfigError, match=f"{name} must start from a positive number"):
            value_at(config, name)
    before = {"noise": {"sigma_px": 1.0, "drift": 2.0}, "blocks": {"camera_jitter": {"time_s": 1.0}}}
    after = with_value(with_value(before, "noise.sigma_px", 3.0), "blocks.camera_jitter.time_s", 4.0)
    assert after == {"noise": {"sigma_px": 3.0, "drift": 2.0}, "blocks": {"camera_jitter": {"time_s": 4.0}}}
    assert before["noise"]["sigma_px"] == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("runs", [1, 2, 5, 9] if WHOLE else [1, 5])
def test_runs_are_bounded_and_the_outcome_is_the_same_again(runs):
    one = world(0, frames=20)
    choice, again = (choose(one, CONFIG, [WHITE, SHARED], runs=runs) for _ in range(2))
    assert choice == again
    assert 2 <= sum(tried.runs for tried in choice.tried) <= max(runs, 2)
    assert choice.frames == 20


@pytest.mark.slow
def test_candidates_are_judged_without_the_truth():
    one = world(0, frames=20)
    truth = dataclasses.replace(one.truth, T_world_imu=one.truth.T_world_imu @ se3.exp(np.full(6, 0.05)))
    first = [choose(s, CONFIG, [WHITE], runs=3) for s in (one, dataclasses.replace(one, truth=truth))]
    assert first[0].chosen.log_likelihood == pytest.approx(first[1].chosen.log_likelihood, abs=1e-6)
    assert first[0].chosen.sizes == first[1].chosen.sizes


@pytest.mark.slow
def test_a_candidate_under_which_the_filter_breaks_down_is_named_and_loses(monkeypatch):
    reports = structure.filter_reports

    def breaks_with_blocks(sequence, noise, config):
        if config.blocks:
            raise InnovationError(3, [1])
        return reports(sequence, noise, config)

    monkeypatch.setattr(structure, "filter_reports", breaks_with_blocks)
    one = world(0, frames=20)
    choice = choose(one, CONFIG, [SHARED, WHITE], runs=8)
    assert choice.chosen.name == "white"
    assert choice.lines[0].startswith("jitter: the filter broke down")
    with pytest.raises(InnovationError, match="3"):
        choose(one, CONFIG, [SHARED], runs=8)


def test_what_cannot_be_chosen_from_is_refused():
    one = world(0, frames=20)
    with pytest.raises(ConfigError, match="no candidates"):
        choose(one, CONFIG)
    with pytest.raises(ConfigError, match=r"noise\.sigma_px must start from"):
        choose(one, CONFIG, [Candidate("unknown size", {}, (), "noise.sigma_px")])
    nothing = Observations(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty((0, 4)))
    with pytest.raises(EmptyTracksError):
        choose(dataclasses.replace(one, observations=nothing, attributes=WITHOUT_TRACKS), CONFIG, [WHITE])


def test_candidates_of_stated_noise_keep_its_size():
    one = world(0, frames=20)
    white, shared = stated_candidates(one)
    assert not white.overrides and not white.sizes
    rotation = np.deg2rad(shared.overrides["blocks"]["camera_jitter"]["rotation_deg"])
    assert rotation * one.camera.fu_px == pytest.approx(WHITE_PX, rel=1e-9)
    assert choose(one, CONFIG, [white, shared], runs=6).lines[-1].startswith("chosen: ")
    with pytest.raises(ConfigError, match="states no noise"):
        stated_candidates(dataclasses.replace(one, noise=None))
