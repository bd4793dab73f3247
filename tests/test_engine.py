"""The engine is the reference filter: estimates, covariance, verdicts, counts and logs, on whole drives."""

from __future__ import annotations

import copy
import dataclasses
import threading
from pathlib import Path

import numpy as np
import pytest
from support.compiled import assert_same_covariance, assert_same_report
from support.everything import BLOCKS, CALIBRATION, PRIOR, with_everything
from support.helpers import filter_of
from support.running import DATA, WHOLE

from ekfslam import open_sequence
from ekfslam.config import Config, FilterConfig
from ekfslam.data.simulate import builtin
from ekfslam.engine import choice
from ekfslam.errors import DataError
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.live import LiveEKF
from ekfslam.filters.loop import one_thread, run_filter
from ekfslam.models.sensors.monocular import Monocular
from ekfslam.resolve import resolve
from ekfslam.runner import run

pytestmark = pytest.mark.skipif(bool(choice.MISSING), reason=f"engine: {choice.MISSING}")


def drive(problem, engine, frames):
    """Return a filter after so many frames, and its reports."""
    ekf = filter_of(problem, engine)
    with one_thread():
        reports = [frame.report for frame in run_filter(ekf, problem.sequence, range(frames))]
    return ekf, reports


def assert_same_reports(found, known):
    for one, other in zip(found, known, strict=True):
        assert_same_report(one, other, rtol=1e-6)
        if other.dof > 24 and other.doubt == 1.0:  # else some are known to rounding alone
            np.testing.assert_allclose(one.innovations.apart, other.innovations.apart, atol=1e-6)


def assert_same_logs(found, known, layout, tolerance):
    views = np.concatenate([np.empty(0, dtype=int), layout.columns(layout.views)])  # functions of the other columns
    for field in dataclasses.fields(known):
        one, other = getattr(found, field.name), getattr(known, field.name)
        if field.name in ("departed", "linear", "updated"):
            one, other = np.delete(one, views, axis=1), np.delete(other, views, axis=1)
        np.testing.assert_allclose(one, other, rtol=tolerance, atol=tolerance, err_msg=field.name)


def assert_same_estimates(found, known, tolerance):
    assert found.counts == known.counts
    np.testing.assert_array_equal(found.ids, known.ids)
    for name, value in known.values.items():
        np.testing.assert_allclose(found.values[name], value, atol=tolerance, err_msg=name)
    assert_same_covariance(found.P, known.P, tolerance)
    one, other = found.landmarks(), known.landmarks()
    np.testing.assert_array_equal(one.id, other.id)
    np.testing.assert_array_equal(one.observations, other.observations)
    scale = np.sqrt(np.einsum("nii->n", other.covariance))
    assert (np.abs(one.position_m - other.position_m) <= tolerance * (1.0 + scale[:, None])).all()
    assert (np.abs(one.covariance - other.covariance) <= tolerance * scale[:, None, None] ** 2).all()


def assert_same(sequence, settings, frames, tolerance=1e-9, model=None):
    problem = resolve(sequence, Config().with_overrides(settings))
    if model is not None:
        problem = dataclasses.replace(problem, model=model)
    known, as_known = drive(problem, "reference", frames)
    found, as_found = drive(problem, "engine", frames)
    assert_same_reports(as_found, as_known)
    assert_same_estimates(found, known, tolerance)
    assert_same_logs(found.log(), known.log(), found.model.layout, 10 * tolerance)
    return found


COORDINATES = ["image", pytest.param("xyz", marks=pytest.mark.slow)]


@pytest.mark.parametrize("coordinates", COORDINATES)
@pytest.mark.parametrize("variant", ["invariant", "standard"])
def test_the_city(variant, coordinates):
    settings = {"filter": {"variant": variant, "landmark_coordinates": coordinates}}
    ekf = assert_same(builtin("city?frames=15"), settings, 15)
    assert ekf.counts["retired"] > 5


@pytest.mark.slow
@pytest.mark.parametrize("coordinates", COORDINATES)
@pytest.mark.parametrize("variant", ["invariant", "standard"])
def test_every_block_and_errors_of_tracks(variant, coordinates):
    settings = {"filter": {"variant": variant, **PRIOR, "landmark_coordinates": coordinates}}
    settings |= {"calibration": CALIBRATION, "blocks": BLOCKS}
    assert_same(with_everything(builtin("city?frames=15")), settings, 15, tolerance=1e-8)


@pytest.mark.slow
def test_calibration_with_white_pixels():
    assert_same(builtin("city?frames=15"), {"calibration": CALIBRATION}, 15, tolerance=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("coordinates", COORDINATES)
@pytest.mark.parametrize("variant", ["invariant", "standard"])
def test_landmarks_that_come_back(variant, coordinates):
    settings = {"filter": {"variant": variant, "retire": "unseen", "retire_after": 3}}
    settings["filter"]["landmark_coordinates"] = coordinates
    # All rows are linearised again, which ends where steps are small.
    tolerance = 1e-8 if (variant, coordinates) == ("standard", "xyz") else 1e-7
    ekf = assert_same(builtin("loop?frames=100&radius_m=10&landmarks=60"), settings, 100, tolerance)
    assert len(ekf.retired.revived) > 0


@pytest.mark.slow
@pytest.mark.parametrize("dormant", [20, 1000])
def test_dormant_landmarks(dormant):
    settings = {"filter": {"retire": "unseen", "retire_after": 2, "dormant": dormant, "revive": -1}}
    assert_same(builtin("loop?frames=100&radius_m=10&landmarks=60"), settings, 100, 1e-8)


@pytest.mark.slow
def test_landmarks_that_never_leave():
    assert_same(builtin("loop?frames=60"), {"filter": {"retire": "never"}}, 60, 1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["loop", "room"])
def test_other_worlds(name):
    assert_same(builtin(f"{name}?frames=40"), {}, 40, tolerance=1e-8)


@pytest.mark.slow
def test_one_camera_waits_for_parallax():
    world = builtin("city?frames=30&outlier_fraction=0")
    sensor = Monocular(world.camera, world.T_cam_imu, world.noise, parallax_rad=0.2)
    ekf = [
        JointEKF(sensor, FilterConfig(retire="unseen", engine=engine), world.initial_T_world_imu)
        for engine in ("engine", "reference")
    ]
    reports = [[frame.report for frame in run_filter(each, world)] for each in ekf]
    assert_same_reports(*reports)
    assert_same_estimates(*ekf, 1e-8)
    assert_same_logs(*(each.log() for each in ekf), ekf[0].model.layout, 1e-8)
    assert len(ekf[0].ids) > 10


@pytest.mark.slow
def test_a_wild_velocity_is_doubted_alike():
    world = builtin("city?frames=20&outlier_fraction=0")
    twist = world.twist.copy()
    twist[10] += [8.0, 3.0, 0.0, 0.0, 0.0, 0.3]
    ekf = assert_same(dataclasses.replace(world, twist=twist), {}, 20, 1e-8)
    assert (ekf.log().doubt > 1).sum() == 1


@pytest.mark.slow
def test_a_relinearised_window():
    assert_same(builtin("city?frames=20&max_tracks=20"), {"filter": {"lag": 4}}, 20, 1e-7)


@pytest.mark.slow
def test_relative_poses_are_the_same():
    world = builtin("city?frames=40")
    one, other = (
        run(world, "full", Config().with_overrides({"filter": {"engine": engine, "relative_frames": 20}}))
        for engine in ("engine", "reference")
    )
    np.testing.assert_array_equal(one.pairs.first, other.pairs.first)
    scale = np.abs(other.pairs.cross).max()
    np.testing.assert_allclose(one.pairs.cross, other.pairs.cross, atol=1e-8 * scale)
    assert other.attributes["engine"] == "reference filter (as requested)" and one.attributes["engine"] == "engine"


def recordings():
    names = [path.relative_to(DATA) for kind in ("*/*.npz", "*/*.mat") for path in sorted(DATA.glob(kind))]
    return [str(name) for name in names if "sim" not in str(name)] or ["none"]


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize("name", recordings())
def test_recordings_with_the_automatic_model(data_path, name):
    sequence = open_sequence(data_path(name))
    frames = len(sequence) if WHOLE else min(60, len(sequence))
    tolerance = 1e-6 if Path(name).stem == "0027_dense_noisy" else 1e-8
    assert_same(sequence, {}, frames, tolerance)


def test_live_is_the_run():
    problem = resolve(builtin("city?frames=12"))
    ekf, live = filter_of(problem, "engine"), LiveEKF(filter_of(problem, "engine"))
    for k, t in enumerate(problem.sequence.time_s.tolist()):
        live.predict(problem.sequence.twist[k], t)
        live.update(*problem.sequence.observations.at(k), t)
    for _ in run_filter(ekf, problem.sequence):
        pass
    assert_same_estimates(live.ekf, ekf, 1e-9)
    ahead = live.pose(live.time_s + 0.05)
    assert np.trace(ahead.covariance) > np.trace(live.pose().covariance)


def test_two_filters_in_two_threads_do_not_disturb_each_other():
    problem = resolve(builtin("city?frames=12"))
    filters = [filter_of(problem, "engine") for _ in range(3)]

    def work(ekf):
        for _ in run_filter(ekf, problem.sequence):
            pass

    threads = [threading.Thread(target=work, args=(ekf,)) for ekf in filters[:2]]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    work(filters[2])
    for ekf in filters[:2]:
        np.testing.assert_array_equal(ekf.P, filters[2].P)


def test_a_copy_goes_its_own_way():
    problem = resolve(builtin("city?frames=8"))
    ekf = filter_of(problem, "engine")
    for _ in run_filter(ekf, problem.sequence, range(6)):
        pass
    other, P = copy.deepcopy(ekf), ekf.P
    other.predict(problem.sequence.interval(6, other.model.process.takes))
    np.testing.assert_array_equal(ekf.P, P)
    assert other.step == ekf.step + 1 and (other.P != P).any()


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_an_impossible_covariance_is_refused(value):
    ekf = filter_of(resolve(builtin("city?frames=3")), "engine")
    P = ekf.P
    P[2, 2] = value
    with pytest.raises(ValueError, match="P must"):
        ekf.P = P


@pytest.mark.parametrize(
    ("ids", "pixels", "words"),
    [
        (np.array([3, 3]), np.ones((2, 4)), "observed twice"),
        (np.array([3]), np.ones((2, 4)), "expected shape 1"),
        (np.array([3]), np.ones((1, 2)), "expected 4 numbers"),
    ],
)
def test_arguments_of_a_wrong_shape_are_refused(ids, pixels, words):
    problem = resolve(builtin("city?frames=3"))
    with pytest.raises(DataError, match=words):
        filter_of(problem, "engine").update(0, ids, pixels)
