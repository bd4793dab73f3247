"""Both forms of the joint covariance are the same filter: estimates, covariance and counts, on whole drives."""

import numpy as np
import pytest
from support.everything import BLOCKS, CALIBRATION, PRIOR, with_everything
from support.running import WHOLE

from ekfslam import open_sequence
from ekfslam.config import Config
from ekfslam.data.simulate import builtin
from ekfslam.filters.conditional import ConditionalGaussian
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import one_thread, run_filter
from ekfslam.resolve import resolve
from ekfslam.runner import run
from ekfslam.smoother.revival import MapRevival


def drive(sequence, settings, form, frames):
    """The filter after so many frames, and what it reported of each."""
    settings = {**settings, "filter": {**settings.get("filter", {}), "covariance_form": form}}
    problem = resolve(sequence, Config().with_overrides(settings))
    revival = MapRevival(problem.model, problem.config.filter)
    ekf, reports = JointEKF(problem.model, problem.config.filter, revival=revival), []
    assert isinstance(ekf.gaussian, ConditionalGaussian) == (form == "conditional")
    with one_thread():
        for frame in run_filter(ekf, problem.sequence, range(frames)):
            reports.append(frame.report)
    return ekf, reports


def assert_same(sequence, settings, frames, tolerance=1e-9):
    dense, as_dense = drive(sequence, settings, "dense", frames)
    ekf, as_conditional = drive(sequence, settings, "conditional", frames)
    assert ekf.counts == dense.counts and ekf.ids.tolist() == dense.ids.tolist()
    for one, other in zip(as_conditional, as_dense, strict=True):
        np.testing.assert_array_equal(one.reason, other.reason)
        np.testing.assert_allclose([one.nis, one.log_likelihood], [other.nis, other.log_likelihood], rtol=1e-6)
        size = np.abs(other.innovations.information).max(initial=0.0)
        np.testing.assert_allclose(one.innovations.information, other.innovations.information, atol=1e-9 * size)
        np.testing.assert_allclose(one.innovations.apart, other.innovations.apart, atol=1e-6)
    np.testing.assert_allclose(ekf.T_imu_world, dense.T_imu_world, atol=tolerance)
    np.testing.assert_allclose(ekf.coordinates, dense.coordinates, atol=tolerance)
    std = np.sqrt(np.diag(dense.P))
    assert (np.abs(ekf.P - dense.P) <= tolerance * np.outer(std, std)).all()
    known, found = dense.landmarks(), ekf.landmarks()
    np.testing.assert_array_equal(found.id, known.id)
    scale = np.sqrt(np.einsum("nii->n", known.covariance))
    assert (np.abs(found.position_m - known.position_m) <= tolerance * scale[:, None] + tolerance).all()
    assert (np.abs(found.covariance - known.covariance) <= tolerance * scale[:, None, None] ** 2).all()
    return ekf


@pytest.mark.parametrize("coordinates", ["image", pytest.param("xyz", marks=pytest.mark.slow)])
@pytest.mark.parametrize("variant", ["invariant", "fej", "standard"])
def test_the_city(variant, coordinates):
    settings = {"filter": {"variant": variant, "landmark_coordinates": coordinates}}
    ekf = assert_same(builtin("city?frames=25"), settings, 25)
    assert ekf.gaussian.width < 200  # far less than the state has seen
    assert ekf.counts["retired"] > 20


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["invariant", "fej", "standard"])
def test_every_block_and_errors_of_tracks(variant):
    settings = {"filter": {"variant": variant, **PRIOR, "landmark_coordinates": "image"}}
    settings |= {"calibration": CALIBRATION, "blocks": BLOCKS}
    assert_same(with_everything(builtin("city?frames=15")), settings, 15, tolerance=1e-8)


@pytest.mark.slow
def test_iterated_updates():
    assert_same(builtin("city?frames=25"), {"filter": {"iterations": 3}}, 25)


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["invariant", "fej"])
def test_landmarks_that_come_back(variant):
    settings = {"filter": {"variant": variant, "retire": "unseen", "retire_after": 3, "landmark_coordinates": "xyz"}}
    # The invariant variant linearises all rows again, which ends where steps are small.
    tolerance = 1e-7 if variant == "invariant" else 1e-8
    ekf = assert_same(builtin("loop?frames=100&radius_m=10&landmarks=60"), settings, 100, tolerance)
    assert len(ekf.retired.revived) > 0


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize("name", ["utias/2011_09_26_drive_0001_sync_KLT.mat", "ece276a/0027_dense_noisy.npz"])
def test_recordings_with_the_automatic_model(data_path, name):
    assert_same(open_sequence(data_path(name)), {}, 60 if WHOLE else 25, tolerance=1e-8)


@pytest.mark.slow
def test_relative_poses_are_the_same():
    """What is only considered goes along in both forms."""
    world = builtin("city?frames=40")
    one, other = (
        run(world, "full", Config().with_overrides({"filter": {"covariance_form": form, "relative_frames": 20}}))
        for form in ("conditional", "dense")
    )
    assert len(one.pairs.first) > 2
    np.testing.assert_allclose(one.pairs.cross, other.pairs.cross, rtol=1e-6, atol=1e-12)


def test_auto_takes_what_is_cheaper():
    """The conditional form where many landmarks are seen for a short time, the dense one where few are."""
    few, many = builtin("city?frames=100"), builtin("city?frames=20&max_tracks=250&landmarks_per_m=20")
    assert resolve(few).config.filter.covariance_form == "dense"
    assert resolve(many).config.filter.covariance_form == "conditional"
    stated = Config().with_overrides({"filter": {"covariance_form": "conditional"}})
    assert resolve(few, stated).config.filter.covariance_form == "conditional"
