"""A call that raises an error leaves a joint filter as it was: state, covariance, log and counts."""

from __future__ import annotations

import copy
import dataclasses
import threading

import numpy as np
import pytest
from support.helpers import filter_of
from threadpoolctl import threadpool_info, threadpool_limits

from ekfslam.config import Config
from ekfslam.data.interval import Interval
from ekfslam.data.room import Room, simulate_room
from ekfslam.data.simulate import builtin
from ekfslam.engine import choice
from ekfslam.errors import DataError, EkfslamError, FilterError, InnovationError
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.logbook import LogBook
from ekfslam.filters.loop import run_filter
from ekfslam.models.process import Measured
from ekfslam.models.process.velocities import VelocityInputs
from ekfslam.models.sensors.monocular import Monocular
from ekfslam.resolve import resolve

ENGINES = ["reference", pytest.param("engine", marks=pytest.mark.skipif(bool(choice.MISSING), reason="no engine"))]
FRAMES = 6


def numbers(ekf):
    """Return everything that a caller can read from a filter, as arrays by name."""
    found = {f"value of {name}": value for name, value in ekf.values.items()}
    names = ("coordinates", "imu_twist", "P", "step", "ids", "positions_m", "updated_view")
    found |= {name: copy.deepcopy(getattr(ekf, name)) for name in names}
    found |= {f"motion {name}": getattr(ekf.motion, name) for name in ("T_departed", "T_predicted", "tau_s", "Q")}
    found |= {f"table {name}": column for name, column in ekf.table.columns(0).items()}
    found |= {f"log {field.name}": getattr(ekf.log(), field.name) for field in dataclasses.fields(ekf.log())}
    found |= {f"landmark {name}": array for name, array in vars(ekf.landmarks()).items()}
    return found | {"counts": np.array([*ekf.counts.values()]), "row_of": sorted(ekf.retired.row_of.items())}


def assert_equal(found, known):
    assert found.keys() == known.keys()
    for name, value in known.items():
        np.testing.assert_array_equal(found[name], value, err_msg=name)


def problem_of(kind):
    if kind == "inertial":
        return resolve(simulate_room(Room(frames=FRAMES + 3, seed=2)))
    settings = {"lag": {"filter": {"lag": 3}}, "walk": {}, "offset": {"calibration": {"time_s": 0.01}}}.get(kind, {})
    world = builtin(f"city?frames={FRAMES + 3}&max_tracks=25")
    if kind == "walk":
        noise = dataclasses.replace(world.noise, twist_walk_std=np.repeat([0.3, 0.03], 3))
        world = dataclasses.replace(world, noise=noise)
    return resolve(world, Config().with_overrides(settings))


def drive(ekf, problem, frames):
    return [frame.report for frame in run_filter(ekf, problem.sequence, frames)]


def go_on(ekf, problem, frames):
    """Predict and update for frames after the first ones."""
    for k in frames:
        ekf.predict(problem.sequence.interval(k, ekf.model.process.takes))
        ekf.update(k, *problem.sequence.observations.at(k))


PREDICTIONS = {
    "shape": (np.ones(5), 0.1),
    "text": ("fast", 0.1),
    "ragged": ([[1.0], [2.0, 3.0]], 0.1),
    "complex": (np.ones(6, dtype=complex), 0.1),
    "boolean": (np.ones(6, dtype=bool), 0.1),
    "nan": (np.array([0, 0, np.nan, 0, 0, 0]), 0.1),
    "no time": (np.ones(6), 0.0),
    "backwards": (np.ones(6), -0.1),
    "nan time": (np.ones(6), np.nan),
    "pieces": (Interval(0.1, np.array([0.2, -0.1]), np.ones((2, 6))), 0.0),
    "no pieces": (Interval(0.1, np.empty(0), np.empty((0, 6))), 0.0),
    "rows": (Interval(0.1, np.array([0.1]), np.ones((2, 6))), 0.0),
    "doubt": (Interval(0.1, np.array([0.1]), np.ones((1, 6)), doubt=-1.0), 0.0),
}
UPDATES = {
    "half an id": (5, np.array([0.5]), np.ones((1, 4))),
    "boolean ids": (5, np.array([True, False]), np.ones((2, 4))),
    "twice": (5, np.array([3, 3]), np.ones((2, 4))),
    "large ids": (5, np.array([2**63], dtype=np.uint64), np.ones((1, 4))),
    "ids in a square": (5, np.ones((1, 1), dtype=int), np.ones((1, 4))),
    "columns": (5, np.array([3]), np.ones((1, 3))),
    "rows": (5, np.array([3, 4]), np.ones((1, 4))),
    "nan": (5, np.array([3]), np.full((1, 4), np.nan)),
    "complex": (5, np.array([3]), np.ones((1, 4), dtype=complex)),
    "boolean": (5, np.array([3]), np.ones((1, 4), dtype=bool)),
    "text": (5, np.array([3]), [["a", "b", "c", "d"]]),
    "half a frame": (5.5, np.array([3]), np.ones((1, 4))),
    "boolean frame": (True, np.array([3]), np.ones((1, 4))),
    "negative frame": (-1, np.array([3]), np.ones((1, 4))),
}


@pytest.fixture(scope="module", params=ENGINES)
def begun(request):
    problem = problem_of("plain")
    ekf = filter_of(problem, request.param)
    drive(ekf, problem, range(FRAMES))
    return problem, ekf, numbers(ekf)


@pytest.mark.parametrize("name", PREDICTIONS)
def test_impossible_inputs_are_refused_and_change_nothing(begun, name):
    _, ekf, before = begun
    with pytest.raises(DataError):
        ekf.predict(*PREDICTIONS[name])
    assert_equal(numbers(ekf), before)


@pytest.mark.parametrize("name", UPDATES)
def test_impossible_observations_are_refused_and_change_nothing(begun, name):
    _, ekf, before = begun
    with pytest.raises(DataError):
        ekf.update(*UPDATES[name])
    assert_equal(numbers(ekf), before)


def impossible(ekf):
    """Return a covariance with which no frame can be solved: indefinite, or beyond what numbers can hold."""
    if ekf.engine is not None:
        return 1e307 * np.eye(len(ekf.P))
    P, n = ekf.P.copy(), len(ekf.ids)
    at = ekf.model.layout.body + 3 * np.arange(n)
    P[np.ix_(at, at)] -= 1e6 * (np.ones((n, n)) - np.eye(n))
    return P


@pytest.mark.parametrize("kind", ["plain", "lag", "walk", "inertial"])
@pytest.mark.parametrize("engine", ENGINES)
def test_a_frame_that_cannot_be_solved_changes_nothing_and_the_next_one_is_clean(engine, kind):
    problem = problem_of(kind)
    ekf, clean = filter_of(problem, engine), filter_of(problem, engine)
    for each in (ekf, clean):
        drive(each, problem, range(FRAMES))
        each.predict(problem.sequence.interval(FRAMES, each.model.process.takes))
    good = ekf.P.copy()
    ekf.P = impossible(ekf)
    before = numbers(ekf)
    with pytest.raises(InnovationError):
        ekf.update(FRAMES, *problem.sequence.observations.at(FRAMES))
    assert_equal(numbers(ekf), before)
    for each in (ekf, clean):  # the same covariance in the same form
        each.P = good.copy()
        each.update(FRAMES, *problem.sequence.observations.at(FRAMES))
        go_on(each, problem, range(FRAMES + 1, FRAMES + 3))
    assert_equal(numbers(ekf), numbers(clean))


class Failing(VelocityInputs):
    """A process of the user's that fails once."""

    fails = False

    def step(self, *arguments):
        if Failing.fails:
            raise ArithmeticError("no step")
        return super().step(*arguments)

    def imu_twist(self, *arguments):
        if Failing.fails:
            raise ArithmeticError("no velocity")
        return super().imu_twist(*arguments)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("call", ["predict", "update"])
def test_an_error_of_the_users_own_process_changes_nothing(engine, call):
    problem = problem_of("offset")
    model = dataclasses.replace(problem.model, make_process=lambda layout, noise: Failing(layout, noise.process))
    problem = dataclasses.replace(problem, model=model)
    ekf, clean = filter_of(problem, engine), filter_of(problem, engine)
    for each in (ekf, clean):
        drive(each, problem, range(FRAMES))
    if call == "update":
        for each in (ekf, clean):
            each.predict(problem.sequence.interval(FRAMES, each.model.process.takes))
    before = numbers(ekf)
    Failing.fails = True
    try:
        with pytest.raises(ArithmeticError):
            if call == "predict":
                ekf.predict(problem.sequence.interval(FRAMES, ekf.model.process.takes))
            else:
                ekf.update(FRAMES, *problem.sequence.observations.at(FRAMES))
    finally:
        Failing.fails = False
    assert_equal(numbers(ekf), before)
    for each in (ekf, clean):
        if call == "update":
            each.update(FRAMES, *problem.sequence.observations.at(FRAMES))
        go_on(each, problem, range(FRAMES + (call == "update"), FRAMES + 3))
    assert_equal(numbers(ekf), numbers(clean))


def fail(*_):
    raise MemoryError


@pytest.mark.parametrize("engine", ENGINES)
def test_an_error_after_a_further_sensor_has_corrected_the_velocity_changes_nothing(engine, monkeypatch):
    problem = problem_of("walk")
    ekf = filter_of(problem, engine)
    drive(ekf, problem, range(FRAMES))
    before, interval = numbers(ekf), problem.sequence.interval(FRAMES, ekf.model.process.takes)
    monkeypatch.setattr(LogBook, "predicted", fail)
    with pytest.raises(MemoryError):
        ekf.predict(interval, also=Measured(np.zeros(1, int), np.full(1, 7.0), np.full(1, 0.1), np.zeros(1, bool)))
    assert_equal(numbers(ekf), before)


class Watching(VelocityInputs):
    """A process that notes the threads of BLAS."""

    threads = frozenset()

    def step(self, *arguments):
        Watching.threads = blas_threads()
        return super().step(*arguments)


def blas_threads():
    """Threads of the libraries that a frame uses; a process of tests has loaded others, too."""
    libraries = [one for one in threadpool_info() if one["user_api"] == "blas"]
    own = [one for one in libraries if "numpy" in one["filepath"] or "scipy" in one["filepath"]]
    return {one["num_threads"] for one in own or libraries}


@pytest.mark.parametrize("engine", ENGINES)
def test_a_frame_has_one_thread_of_blas_and_gives_the_others_back(engine):
    problem = problem_of("plain")
    model = dataclasses.replace(problem.model, make_process=lambda layout, noise: Watching(layout, noise.process))
    ekf = filter_of(dataclasses.replace(problem, model=model), engine)
    with threadpool_limits(2, user_api="blas"):
        before = blas_threads()
        drive(ekf, problem, range(2))
        assert blas_threads() == before
    assert Watching.threads == {1}


@pytest.mark.parametrize("engine", ENGINES)
def test_tracks_that_wait_are_those_before_an_error(engine):
    world = builtin("city?frames=14&outlier_fraction=0&max_tracks=25")
    config = dataclasses.replace(resolve(world).config.filter, engine=engine, revive=-1)
    sensor = Monocular(world.camera, world.T_cam_imu, world.noise)
    ekf, clean = (JointEKF(sensor, config, world.initial_T_world_imu) for _ in range(2))
    for k, _ in enumerate(zip(run_filter(ekf, world, range(13)), run_filter(clean, world, range(13)), strict=True)):
        for bad in ((k, np.array([1, 1]), np.ones((2, 2))), (k, np.array([1]), np.ones((1, 1)))):
            with pytest.raises(EkfslamError):
                ekf.update(*bad)
    assert_equal(numbers(ekf), numbers(clean))


@pytest.mark.skipif(bool(choice.MISSING), reason="no engine")
def test_an_error_after_any_number_of_frames_changes_no_bit_of_the_engine():
    problem = resolve(builtin("city?frames=44&max_tracks=8&outlier_fraction=0.1"))
    ekf, clean = filter_of(problem, "engine"), filter_of(problem, "engine")
    for k, _ in enumerate(zip(*(run_filter(each, problem.sequence) for each in (ekf, clean)), strict=True)):
        if k in {0, 1, 30, 31, 32, 33, 43}:
            with pytest.raises(ValueError, match="distinct"):
                ekf.engine.filter.update(k, np.array([1, 1]), np.ones((2, 4)), False, None)
    assert_equal(numbers(ekf), numbers(clean))


@pytest.mark.skipif(bool(choice.MISSING), reason="no engine")
def test_a_second_thread_in_one_filter_is_refused_and_the_filter_stays_whole():
    problem = problem_of("plain")
    ekf, clean = filter_of(problem, "engine"), filter_of(problem, "engine")
    drive(clean, problem, range(FRAMES))
    found, stop = [], threading.Event()

    def read():
        while not stop.is_set():
            try:
                found.append(ekf.engine.P.shape)
            except FilterError as error:
                found.append(str(error))

    thread = threading.Thread(target=read)
    thread.start()
    refused = 0
    for k in range(FRAMES):
        while True:
            try:
                if k and ekf.step < k:
                    ekf.predict(problem.sequence.interval(k, ekf.model.process.takes))
                elif not k:
                    ekf.begin(problem.sequence.inputs_at(0, ekf.model.process.takes))
                ekf.update(k, *problem.sequence.observations.at(k))
                break
            except FilterError as error:
                assert "in use by another thread" in str(error)
                refused += 1
    stop.set()
    thread.join()
    assert all(not isinstance(one, str) or "in use by another thread" in one for one in found)
    np.testing.assert_array_equal(ekf.P, clean.P)


@pytest.mark.skipif(bool(choice.MISSING), reason="no engine")
def test_a_function_of_the_user_cannot_enter_the_filter_that_calls_it():
    problem = problem_of("offset")
    ekf = filter_of(problem, "engine")
    drive(ekf, problem, range(FRAMES))
    ekf.predict(problem.sequence.interval(FRAMES, ekf.model.process.takes))
    ids, pixels = problem.sequence.observations.at(FRAMES)
    with pytest.raises(FilterError, match="in use"):
        ekf.engine.update(FRAMES, ids, pixels, False, lambda _: ekf.engine.P[0, :6])
