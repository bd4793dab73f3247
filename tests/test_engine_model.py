"""Cameras, rows, retraction and new landmarks of the engine: equal to the reference filter, and true derivatives."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from support.compiled import Case, arrive, compiled, flat
from support.jacobians import POSES, central

from ekfslam.filters import starting
from ekfslam.filters.observing import look, moment, observe
from ekfslam.filters.retraction import carried_back, retract, retracted
from ekfslam.geometry import se3
from ekfslam.geometry import stereo_motion as stereo
from ekfslam.geometry.camera import StereoCamera, project

engine = pytest.importorskip("ekfslam.engine._engine", reason="the engine is not built")

CASES = {
    "all": Case(),
    "standard": Case(variant="standard"),
    "xyz": Case(coordinates="xyz"),
    "xyz, standard": Case(coordinates="xyz", variant="standard"),
    "no calibration": Case(calibration=False),
    "no blocks": Case(blocks=False),
    "white pixels": Case(tracks=False),
    "plain": Case(tracks=False, calibration=False, blocks=False),
    "plain, xyz": Case(tracks=False, calibration=False, blocks=False, coordinates="xyz"),
    "one camera": Case(tracks=False, calibration=False, blocks=False, monocular=True),
}
PLACES = {name: POSES[name] for name in ("near identity", "random 0", "near pi 3")}
SLOTS = np.array([5, 2, 6, 1])  # no first one, not in order; the last one does not follow an observation
every_case = pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
every_place = pytest.mark.parametrize("T", PLACES.values(), ids=PLACES.keys())


class NoLog:
    """A log that forgets."""

    def started(self, ids, positions_m, *views, follows):
        return np.zeros(len(ids), dtype=np.int64)

    def last(self, count):
        return np.zeros(count, dtype=np.int64)


def close(found, wanted, tolerance=1e-12):
    """Assert that arrays are equal but for rounding, by their largest number."""
    wanted = np.asarray(wanted, dtype=float)
    scale = np.abs(wanted).max(initial=1e-300)
    np.testing.assert_allclose(np.asarray(found, dtype=float) / scale, wanted / scale, rtol=0, atol=tolerance)


def measured_near(e, rng):
    return e.table.seen_rows[SLOTS] + rng.normal(size=(len(SLOTS), e.sensor.dimension)) * 3


def both(case, T, seed=3):
    """Return a reference estimate, a compiled filter in its state, and a generator."""
    rng = np.random.default_rng(seed)
    e, P = case.estimate(T, rng)
    made = compiled(engine, e, P)
    e.gaussian.start_over(made.covariance().copy())  # P with the view as a function of the body
    return e, made, rng


def by_body(e, made, H):
    """Return rows over the leading columns of the engine as rows over the body."""
    lead, layout = engine.lead(made), e.model.layout
    out = np.zeros((len(H), layout.body))
    out[:, e.model.observer.intrinsic] = H[:, : len(e.model.observer.intrinsic)]
    for name, is_difference in (("drifted", True), ("view", False)):
        if lead[name] >= 0:
            out += H[:, lead[name] : lead[name] + 6] @ engine.camera(made, is_difference)[1]
    if lead["previous"] >= 0:
        out[:, layout["previous_view"]] += H[:, lead["previous"] : lead["previous"] + 6]
    return out


# --- geometry ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("T", POSES.values(), ids=POSES.keys())
def test_functions_of_se3_equal_the_reference(T):
    xi = se3.log(T)
    np.testing.assert_allclose(engine.se3.log(T), xi, rtol=1e-13, atol=1e-14)
    for name in ("exp", "left_jacobian", "left_jacobian_inverse"):
        close(getattr(engine.se3, name)(xi), getattr(se3, name)(xi), 1e-14)
    for name in ("adjoint", "inverse"):
        close(getattr(engine.se3, name)(T), getattr(se3, name)(T), 1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1.0, np.sqrt(2.0), 1.5, np.pi, 6.0])
def test_series_and_closed_forms_equal_the_reference(angle):
    xi = np.array([1.0, -2.0, 3.0, 0.6 * angle, 0.0, -0.8 * angle])
    for name in ("exp", "left_jacobian", "left_jacobian_inverse"):
        close(getattr(engine.se3, name)(xi), getattr(se3, name)(xi), 1e-13)


# --- cameras and rows -------------------------------------------------------------------------------------------------


@every_place
@every_case
def test_cameras_and_rows_equal_the_reference(case, T):
    e, made, rng = both(case, T)
    layout, now = e.model.layout, e.model.observer.cameras(moment(e, e.mean))
    for is_difference in (False, True):
        W, Y = engine.camera(made, is_difference)
        close(W, now.T_cam_imu[int(is_difference)] @ e.T_imu_world)
        close(Y[:, : layout.seen], now.by[int(is_difference)])
    measured = measured_near(e, rng)
    sight, rows = observe(e, e.mean, SLOTS, measured)
    q, H_x, H_m, residual, variance, alone = engine.observe(made, SLOTS, measured)
    close(q, sight.q)
    close(by_body(e, made, H_x)[:, : layout.seen], rows.H_x.reshape(-1, layout.seen))
    close(H_m, rows.H_m.reshape(-1, 3))
    close(alone, sight.H_m.reshape(-1, 3))
    close(residual, rows.residual)
    close(variance, rows.variance)


@every_place
@pytest.mark.parametrize("is_difference", [False, True])
def test_the_error_of_a_camera_is_a_derivative(T, is_difference):
    e, made, _ = both(CASES["all"], T)
    layout = e.model.layout
    W, Y = engine.camera(made, is_difference)

    def moved(x):
        there = compiled(engine, e, values=e.model.retract(e.values, x))
        return se3.log(engine.camera(there, is_difference)[0] @ se3.inverse(W))

    close(Y, central(moved, layout.body, 1e-5), 1e-8)


@every_place
def test_rows_are_derivatives_by_body_and_landmarks(T):
    e, made, rng = both(CASES["all"], T)
    measured, body = measured_near(e, rng), e.model.layout.body
    _, H_x, H_m, *_ = engine.observe(made, SLOTS, measured)

    def predicted(x):
        position_m = e.table.position_m.copy()
        position_m[SLOTS] += x[body:]
        there = compiled(engine, e, values=e.model.retract(e.values, x[:body]), position_m=position_m)
        return -engine.observe(there, SLOTS, measured)[3].ravel()

    H = central(predicted, body + 3, 1e-5)
    close(by_body(e, made, H_x), H[:, :body], 1e-7)
    close(H_m, H[:, body:], 1e-7)


# --- corrections ------------------------------------------------------------------------------------------------------


def far_and_near(e, W):
    """Move landmarks to places without an image: behind the camera, far off its axis, without disparity."""
    e.table.position_m[:3] = se3.apply(se3.inverse(W), np.array([[1.0, 0, -5], [50, 1, 5], [3, 2, 3000]]))


def correction_of(e, made, rng):
    """Return a correction of all columns, in which one landmark comes too near for its image."""
    layout = e.model.layout
    correction = np.concatenate([rng.normal(size=layout.body) * 0.02, rng.normal(size=3 * len(e.table)) * 0.3])
    W, Y = engine.camera(made, False)
    if "view" in layout:
        correction[layout["view"]] = Y @ correction[: layout.body]
    correction[layout.body + 9 : layout.body + 12] = -100.0 * W[2, :3]
    return correction


@every_place
@every_case
@pytest.mark.parametrize("view", ["previous_view", "view", None])
def test_a_correction_equals_that_of_the_reference(case, T, view):
    rng = np.random.default_rng(5)
    e, P = case.estimate(T, rng)
    e.updated_view = view
    far_and_near(e, e.values.get(view or "view", np.eye(4)))
    e.table.asleep[[1, 4]] = 1
    made = compiled(engine, e, P)
    e.gaussian.start_over(made.covariance().copy())
    correction = correction_of(e, made, rng)
    retract(e, correction)
    engine.retract(made, correction)
    for found, wanted in zip(made.table()["position_m"], e.table.position_m, strict=True):
        close(found, wanted)
    close(made.values(), flat(e))
    close(made.covariance(), e.P)


@every_place
@every_case
def test_rows_after_a_correction_equal_those_of_the_reference(case, T):
    e, made, rng = both(case, T)
    layout, measured, correction = e.model.layout, measured_near(e, rng), correction_of(e, made, rng)
    moved = retracted(e, correction)
    back = carried_back(e, observe(e, moved.mean, SLOTS, measured, e.mean)[1], moved)
    H_x, H_m, residual = engine.observe_after(made, correction, SLOTS, measured)
    wanted = np.zeros((len(H_m), layout.body))
    wanted[:, : layout.seen] = back.H_x.reshape(len(H_m), -1)
    if "view" in layout:
        wanted += wanted[:, layout["view"]] @ engine.camera(made, False)[1]
        wanted[:, layout["view"]] = 0.0
    close(by_body(e, made, H_x), wanted)
    close(H_m, back.H_m.reshape(-1, 3))
    close(residual, back.residual)


# --- new landmarks ----------------------------------------------------------------------------------------------------


@every_place
@pytest.mark.parametrize("name", [name for name in CASES if name != "one camera"])
def test_new_landmarks_equal_those_of_the_reference(name, T):
    e, made, rng = both(CASES[name], T)
    q = rng.normal(size=(5, 3)) * [3, 2, 6] + [0, 0, 16]
    rows, ids = e.model.observer.sensor_at(moment(e, e.mean).calibration).predict(q), np.array([40, 99, 31, 77, 60])
    if e.model.observer.calibration is not None:
        rows[2, 2] = -2.0 if CASES[name].tracks else rows[2, 0] + 2.0  # beyond infinity
    started = starting.start(e, NoLog(), 9, ids, rows)
    np.testing.assert_array_equal(engine.start(made, 9, ids, rows), started)
    table = made.table()
    for column in ("id", "first_frame", "observations", "first_step", "last_step", "position_m", "seen_rows"):
        close(table[column], getattr(e.table, column))
    close(made.covariance(), e.P)


def drive(e, made, xi):
    """Move the pose of both filters by xi: the view becomes the previous one, and the view of the new pose opens."""
    layout, body = e.model.layout, e.model.layout.body
    pose, Phi, Q, clone = layout["pose"], np.eye(body), np.zeros((body, body)), np.eye(body)
    Phi[pose, pose], Q[pose, pose] = se3.adjoint(se3.exp(xi)), 1e-5 * np.eye(6)
    clone[layout["previous_view"]] = np.eye(body)[layout["view"]]
    e.values = {**e.values, "previous_view": e.values["view"], "pose": se3.exp(xi) @ e.values["pose"]}
    e.step, e.updated_view = e.step + 1, None
    E = look(e)
    e.gaussian.propagate(E @ Phi @ clone, E @ Q @ E.T)
    arrive(made, e, flat(e), Phi, Q)


@pytest.mark.parametrize(("variant", "tracks"), [("invariant", False), ("standard", False), ("invariant", True)])
def test_tracks_wait_for_a_second_view_as_in_the_reference(variant, tracks):
    rng = np.random.default_rng(8)
    e, P = dataclasses.replace(CASES["one camera"], variant=variant, tracks=tracks).estimate(PLACES["random 0"], rng)
    sensor = dataclasses.replace(e.sensor, parallax_rad=0.1, patience=2)
    e.model = dataclasses.replace(e.model, sensor=sensor)
    made = compiled(engine, e, P * 0.05, waiting_gate=37.3)  # of probability 1 - 1e-9
    e.gaussian.start_over(made.covariance().copy())
    waiting, ids = starting.Waiting(sensor, 1.0 - 1e-9), np.arange(50, 56)
    points = se3.apply(se3.inverse(e.values["view"]), rng.uniform([-3, -2, 4], [3, 2, 10], (6, 3)))
    count = []
    for frame in range(5):
        seen = sensor.predict(se3.apply(e.values["view"], points)) + rng.normal(size=(6, 2)) * 0.3
        new = np.flatnonzero(~np.isin(ids, e.table.id))
        started = waiting.start(e, NoLog(), frame, ids[new], seen[new])
        np.testing.assert_array_equal(engine.start(made, frame, ids[new], seen[new]), started)
        close(made.table()["position_m"], e.table.position_m)
        close(made.values(), flat(e))
        close(made.covariance(), e.P)
        count.append(started.sum())
        drive(e, made, rng.normal(size=6) * ([0.5] * 3 + [0.02] * 3))  # sideways
    assert 0 in count
    assert max(count) >= 3


@pytest.mark.parametrize("seed", range(5))
def test_an_alignment_of_two_frames_is_that_of_numpy(seed):
    rng = np.random.default_rng(seed)
    camera, n = StereoCamera(500.0, 510.0, 320.0, 240.0, 0.3), 40
    points = rng.uniform((-4, -2, 2), (4, 2, 20), (n, 3))
    T = se3.exp(np.r_[rng.normal(0, 0.3, 3), rng.normal(0, 0.05, 3)])
    before, now = (project(camera, q)[:, :3] + rng.normal(0, 0.2, (n, 3)) for q in (points, se3.apply(T, points)))
    now[:5] += rng.normal(0, 20, (5, 3))
    start = np.eye(4)
    start[2, 3] = -2.2  # the nearest points are behind the camera there
    for first in (np.eye(4), start):
        found, expected = (
            align(camera, before, now, first, 0.2, 2.0) for align in (stereo.align, stereo.align_in_numpy)
        )
        for name, value in vars(expected).items():
            np.testing.assert_allclose(getattr(found, name), value, rtol=1e-8, atol=1e-9, err_msg=name)
