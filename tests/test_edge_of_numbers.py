"""Recordings at the edge of what numbers and filters can hold: a truthful message or a finite result, never NaN."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from support.helpers import synthetic_result, synthetic_sequence

from ekfslam import reports
from ekfslam.cli import main
from ekfslam.config import Config
from ekfslam.data.readers import write_sequence
from ekfslam.data.simulate import builtin
from ekfslam.errors import ConfigError, FilterError, InnovationError, NonFiniteError, NonFiniteResultError
from ekfslam.filters.result import LINEAR_FROM_PX
from ekfslam.reports import compare
from ekfslam.runner import run
from ekfslam.stored import COVARIANCES

NOTHING_LEFT = {"hygiene": {"min_observations": 1000}}
OFF = {"min_disparity_sigma": 0.0, "max_row_mismatch_sigma": 0.0, "reused_id_sigma": 0.0, "restart_at_repeats": False}


@pytest.fixture(scope="module")
def result():
    return synthetic_result(synthetic_sequence(frames=20, landmarks=30))


@pytest.mark.parametrize("name", ["T_world_imu", "covariance", "time_s", "ms_per_frame"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_result_never_holds_nan(result, name, value):
    wrong = getattr(result, name).copy()
    wrong[7] = value
    with pytest.raises(NonFiniteResultError, match=rf"full: {name}\[7\] is not finite"):
        dataclasses.replace(result, **{name: wrong})


@pytest.mark.parametrize(
    ("part", "name"),
    [
        ("landmarks", "position_m"),
        ("landmarks", "covariance"),
        ("landmarks", "initial_position_m"),
        ("innovation", "nis"),
    ],
)
def test_nor_do_its_parts(result, part, name):
    record = getattr(result, part)
    wrong = getattr(record, name).copy()
    wrong[3] = np.nan
    with pytest.raises(NonFiniteResultError, match=rf"{part}\.{name}\[3\]"):
        dataclasses.replace(result, **{part: dataclasses.replace(record, **{name: wrong})})
    with pytest.raises(NonFiniteResultError, match="attributes"):
        dataclasses.replace(result, attributes={"log_likelihood": np.nan})


@pytest.mark.slow
@pytest.mark.parametrize("states_noise", [True, False])
def test_where_hygiene_leaves_nothing_every_mode_says_so(tmp_path, capsys, undrawn, states_noise):
    sequence = builtin("city?frames=15")
    sequence = sequence if states_noise else dataclasses.replace(sequence, noise=None)
    comparison = compare(sequence, config=Config().with_overrides(NOTHING_LEFT))
    assert list(comparison.results) == ["dead-reckoning", "mapping-only", "full", "smoothed"]
    for mode, found in comparison.results.items():
        assert bool(found.remarks) == (mode != "dead-reckoning")
        np.testing.assert_allclose(found.T_world_imu, comparison.results["dead-reckoning"].T_world_imu, atol=0.2)
    used = (
        "Note on mapping-only, full, smoothed: not one observation was used: the trajectory is that of dead reckoning"
    )
    assert comparison.table.count(used) == 1
    assert comparison.save(tmp_path)
    write_sequence(sequence, tmp_path / "a.h5")
    (tmp_path / "c.toml").write_text("[hygiene]\nmin_observations = 1000\n")
    arguments = ["run", str(tmp_path / "a.h5"), "--config", str(tmp_path / "c.toml"), "--out", str(tmp_path / "r.h5")]
    assert main(arguments) == 0
    assert "note: not one observation was used" in capsys.readouterr().out
    assert main(["info", str(tmp_path / "r.h5")]) == 0
    assert "full: note: not one observation was used" in capsys.readouterr().out


@pytest.mark.slow
def test_pixel_noise_of_zero_is_refused_by_name():
    sequence = builtin("city?frames=20")
    for std in (np.zeros(4), np.array([1.0, 0.0, 1.0, 1.0])):
        noise = dataclasses.replace(sequence.noise, pixel_std_px=std)
        exact = dataclasses.replace(sequence, noise=noise)
        for mode in ("mapping-only", "full", "smoothed"):
            with pytest.raises(ConfigError, match="city: the recording states a pixel noise of 0 px"):
                run(exact, mode)
        assert run(exact, "dead-reckoning").remarks == ()
        assert run(exact, "full", Config().with_overrides({"noise": {"sigma_px": 0.5}})).counts["accepted"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("world", ["city", "loop"])
@pytest.mark.parametrize("px", [0.001, 0.003])
def test_covariances_keep_their_digits_where_pixels_are_almost_exact(world, px):
    sequence = builtin(f"{world}?frames=40&sigma_px={px}&outlier_fraction=0")
    found = run(sequence, "full")
    assert COVARIANCES.holds(found.covariance, {}).all()
    assert COVARIANCES.holds(found.landmarks.covariance, {}).all()
    assert "is less than the errors of linearisation" in found.remarks[0]
    assert run(builtin(f"{world}?frames=20&sigma_px={LINEAR_FROM_PX}"), "full").remarks == ()


@pytest.mark.parametrize(("disparity_px", "states_noise"), [(0.0, True), (1e-12, False), (1e-3, True), (-5.0, False)])
def test_disparities_down_to_zero_without_hygiene(disparity_px, states_noise):
    sequence = builtin("city?frames=12")
    pixels = sequence.observations.pixels_px.copy()
    pixels[::3, 2] = pixels[::3, 0] - disparity_px
    observations = dataclasses.replace(sequence.observations, pixels_px=pixels)
    sequence = dataclasses.replace(sequence, observations=observations, noise=sequence.noise if states_noise else None)
    for mode, found in compare(sequence, config=Config().with_overrides({"hygiene": OFF})).results.items():
        assert np.isfinite(found.landmarks.covariance).all(), mode


@pytest.mark.parametrize(
    ("name", "value"), [("twist", 1e7), ("twist", -1e300), ("time_s", 1e13), ("truth", 1e10), ("pixels", 1e8)]
)
def test_quantities_beyond_all_sense_are_named(name, value):
    sequence = builtin("city?frames=20")
    with pytest.raises(NonFiniteError, match="values are larger than 1e"):
        if name == "truth":
            T = sequence.truth.T_world_imu.copy()
            T[3, 0, 3] = value
            dataclasses.replace(sequence, truth=dataclasses.replace(sequence.truth, T_world_imu=T))
        elif name == "pixels":
            pixels = sequence.observations.pixels_px.copy()
            pixels[5, 1] = value
            observations = dataclasses.replace(sequence.observations, pixels_px=pixels)
            dataclasses.replace(sequence, observations=observations)
        else:
            wrong = getattr(sequence, name).copy()
            wrong[-1] = value
            dataclasses.replace(sequence, **{name: wrong})


@pytest.mark.parametrize("scale", [1e3, 1e5])
def test_velocities_just_below_end_in_a_finite_result_or_a_named_error(scale):
    sequence = builtin("city?frames=20")
    sequence = dataclasses.replace(sequence, twist=np.clip(scale * sequence.twist, -1e6, 1e6))
    comparison = compare(sequence)
    assert "dead-reckoning" in comparison.results
    assert set(comparison.results) | set(comparison.skipped) == {"dead-reckoning", "mapping-only", "full", "smoothed"}


@pytest.mark.slow
def test_a_filter_that_cannot_go_on_does_not_keep_the_others(tmp_path, monkeypatch, undrawn):
    true_run = run

    def failing(sequence, mode, config, *rest, **more):
        if mode in ("full", "smoothed"):
            raise InnovationError(3, [1])
        return true_run(sequence, mode, config, *rest, **more)

    monkeypatch.setattr(reports, "run", failing)
    comparison = compare(builtin("city?frames=20"))
    assert list(comparison.results) == ["dead-reckoning", "mapping-only"]
    assert comparison.table.count("innovation covariance is not positive definite") == 2
    assert comparison.save(tmp_path)
    with pytest.raises(FilterError, match="no full: frame 3"):
        compare(builtin("city?frames=20"), ["full", "smoothed"])
