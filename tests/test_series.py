"""The table of series: what figures and pages draw, with bounds, expected values and units."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.stats import chi2
from support.helpers import synthetic_result, synthetic_sequence

from ekfslam.figures import series
from ekfslam.filters.result import Parameters
from ekfslam.geometry import se3
from ekfslam.page.content import plotted, sections_of
from ekfslam.storage.archive import read_archive, write_archive


@pytest.fixture(scope="module")
def sequence():
    return synthetic_sequence(frames=40, landmarks=30)


@pytest.fixture(scope="module")
def result(sequence):
    return synthetic_result(sequence)


def test_pose_nees_has_the_bounds_of_six_degrees_of_freedom(sequence, result):
    found = series.nees(result, sequence.truth)
    assert found.levels == (6.0,)
    np.testing.assert_allclose([found.low[0], found.high[0]], chi2.ppf([0.025, 0.975], 6))


def test_lengths_of_errors_are_those_of_position_and_of_rotation(sequence, result):
    position, rotation = series.error_lengths(result, sequence.truth)
    T, true = result.T_world_imu[sequence.truth.frame], sequence.truth.T_world_imu
    np.testing.assert_allclose(position.y, np.linalg.norm(T[:, :3, 3] - true[:, :3, 3], axis=1), atol=1e-9)
    angle = np.linalg.norm(se3.so3_log(true[:, :3, :3].swapaxes(1, 2) @ T[:, :3, :3]), axis=1)
    np.testing.assert_allclose(rotation.y, np.degrees(angle), atol=1e-6)


def test_nis_has_the_bounds_of_the_degrees_of_freedom_of_each_frame(result):
    found, dof = series.nis(result), result.innovation.dof[result.innovation.dof > 0]
    assert found.levels == (1.0,)
    np.testing.assert_allclose(found.high, chi2.ppf(0.975, dof) / dof)


def test_levels_of_a_parameter_are_three_deviations_of_its_prior(result):
    frames = len(result.time_s)
    known = Parameters(("roll",), ("rad",), np.array([0.1]), np.zeros((frames, 1)), np.full((frames, 1), 0.05))
    (found,) = series.parameters(dataclasses.replace(result, parameters=known))
    assert found.levels == pytest.approx((-np.degrees(0.3), np.degrees(0.3)))
    assert found.labels == ("time [s]", "roll [deg]")


@pytest.mark.parametrize(("largest", "is_log"), [(19.0, False), (21.0, True)])
def test_an_axis_is_logarithmic_from_a_ratio_of_twenty(largest, is_log):
    one = series.Series("NIS", "", np.arange(2.0), np.array([1.0, largest]), is_positive=True)
    assert one.is_log == is_log
    assert not dataclasses.replace(one, is_positive=False).is_log


def test_only_the_heights_of_the_full_run_have_bounds_on_a_page(sequence, tmp_path):
    modes = ("dead-reckoning", "full")
    write_archive(tmp_path / "a.h5", sequence, {mode: synthetic_result(sequence, mode) for mode in modes})
    heights = plotted(sections_of({"a": read_archive(tmp_path / "a.h5")})[0])["plots"][0]["curves"]
    assert {curve["name"]: "low" in curve for curve in heights} == {
        "truth": False,
        "dead-reckoning": False,
        "full": True,
    }
