"""Arguments of the engine's functions that make no sense: a named error or an answer, never a crash."""

from __future__ import annotations

import numpy as np
import pytest
from support.compiled import Case, compiled
from support.odd import MATRICES, ODD, attempt

engine = pytest.importorskip("ekfslam.engine._engine", reason="the engine is not built")

FAR = (2**62, -(2**62), 2**63 - 1, -(2**63))
STACKS = [
    np.ones((3, 3, 3)),
    np.ones((2, 2, 2)),
    np.ones((2, 4, 4)),
    np.ones((3, 0, 0)),
    np.empty((0, 3, 3)),
    np.full((3, 3, 3), np.nan),
    np.ones((6, 6, 6))[::2, ::2, ::2],
    np.ones((3, 3, 3), dtype=np.float32),
]
ROWS = [np.ones((3, 3)), np.ones((3, 2)), np.ones((2, 3)), np.ones((3, 1)), np.ones((3, 0)), np.full((3, 3), -1.0)]
SAMPLES = [[], [[]], [[0]], [[0, 0]], [[0, 1, 2]], [[0, 1, 2, 0]], [[3]], [[-1]], [[2**40]], None]


def three(shape):
    """Return positive definite blocks for three landmarks, or their joint matrix."""
    return np.stack([np.eye(3) * 2.0] * 3) if shape == "blocks" else np.eye(9) * 2.0


GATES = {
    "normalised_squares": [three("blocks"), np.ones((3, 3))],
    "agrees_with_others": [np.ones((3, 3)), np.ones((3, 3)), three("blocks")],
    "most_given_others": [np.ones((3, 3)), np.ones((3, 3)), three("blocks")],
    "whitened": [three("blocks"), np.ones((3, 3))],
    "samples_of": [3, 7, lambda frame, rows, columns: np.ones((rows, columns))],
    "agreeing": [three("joint"), np.ones((3, 3)), np.ones(3), 9.0, [[0, 1], [1, 2]]],
    "refined": [three("joint"), np.ones((3, 3)), [True, True, False], 9.0],
}


@pytest.mark.parametrize("name", GATES)
def test_each_argument_of_a_gate_may_be_anything(name):
    call, fits = getattr(engine.gates, name), GATES[name]
    call(*fits)
    for place in range(len(fits)):
        for odd in (*ODD, *MATRICES, *STACKS, *ROWS, *SAMPLES, *FAR, 0, 4000):
            attempt(call, *fits[:place], odd, *fits[place + 1 :])


@pytest.mark.parametrize("d", [0, 4, 9])
def test_rows_of_another_dimension_are_refused(d):
    residual, S = np.ones((3, d)), np.eye(3 * d)
    with pytest.raises(ValueError, match="one to three"):
        engine.gates.agreeing(S, residual, np.ones(3), 9.0, [[0, 1]])
    with pytest.raises(ValueError, match="one to three"):
        engine.gates.refined(S, residual, [True] * 3, 9.0)


@pytest.mark.parametrize("sample", [[], [0, 0], [0, 1, 2, 3], [5]])
def test_samples_that_are_no_one_to_three_landmarks_are_refused(sample):
    with pytest.raises(ValueError, match="sample"):
        engine.gates.agreeing(np.eye(15), np.ones((5, 3)), np.ones(5), 9.0, [sample])


@pytest.mark.parametrize("k", [0, -3, 2**40, 2**62])
def test_samples_of_an_impossible_number_of_landmarks_are_refused(k):
    with pytest.raises(ValueError, match="landmarks"):
        engine.gates.samples_of(k, 7, lambda frame, rows, columns: np.ones((rows, columns)))


def test_samples_need_random_numbers_of_the_right_shape():
    with pytest.raises(ValueError, match="shape"):
        engine.gates.samples_of(30, 7, lambda frame, rows, columns: np.ones((rows, columns - 1)))


@pytest.mark.parametrize("name", ["agrees_with_others", "most_given_others"])
@pytest.mark.parametrize("shape", [(3, 2), (2, 3), (0, 0), (3, 0)])
def test_variances_of_another_shape_are_refused(name, shape):
    _, variance, blocks = GATES[name]
    with pytest.raises(ValueError, match="variance"):
        getattr(engine.gates, name)(variance, np.ones(shape), blocks)


@pytest.mark.parametrize("name", ["exp", "log", "inverse", "adjoint", "left_jacobian", "left_jacobian_inverse"])
def test_poses_and_twists_may_be_anything(name):
    call = getattr(engine.se3, name)
    for odd in (*ODD, *MATRICES, *ROWS, np.full(6, 1e300), np.full(6, np.nan), np.full((4, 4), np.inf), np.zeros(6)):
        attempt(call, odd)
    for strided in (np.ones(12)[::2], np.ones((8, 8))[::2, ::2]):
        attempt(call, strided)


def test_each_argument_of_a_factorisation_or_an_alignment_may_be_anything():
    points = np.array([[300.0, 200.0, 280.0], [350.0, 250.0, 320.0], [200.0, 210.0, 150.0]])
    fits = [np.array([400.0, 400.0, 320.0, 240.0, 0.5]), points, points, np.eye(4), 0.5, 3.0]
    engine.align(*fits)
    for place in range(len(fits)):
        for odd in (*ODD, *MATRICES, *ROWS, np.empty((0, 3)), np.full((3, 3), np.nan), np.zeros((3, 3)), 0.0, 1e300):
            attempt(engine.align, *fits[:place], odd, *fits[place + 1 :])
    for odd in (*ODD, *MATRICES, np.empty((0, 0)), -np.eye(3), np.full((3, 3), np.nan), np.eye(8)[::2, ::2]):
        attempt(engine.cholesky, odd)


# --- functions of a filter --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=[False, True], ids=["stereo", "one camera"])
def made(request):
    case = Case(tracks=False, calibration=False, blocks=False, monocular=True) if request.param else Case()
    e, P = case.estimate(np.eye(4), np.random.default_rng(2))
    return e, compiled(engine, e, P)


def functions(e):
    """Return the arguments that fit each function of a filter, by name."""
    slots, size = np.array([5, 1, 2]), e.model.layout.body + 3 * len(e.table)
    rows = e.table.seen_rows[slots]
    return {
        "camera": [True],
        "observe": [slots, rows],
        "observe_after": [np.zeros(size), slots, rows],
        "retract": [np.full(size, 1e-3)],
        "set_updated": ["view"],
        "start": [9, np.array([90, 91, 92]), rows],
        "lead": [],
    }


IDS = [np.array([5, 5, 5]), np.array([-1, 3, 1]), np.array(FAR), np.array([5, 1]), np.arange(12)[::4], np.zeros(0, int)]


@pytest.mark.parametrize("name", ["camera", "observe", "observe_after", "retract", "set_updated", "start", "lead"])
def test_each_argument_of_a_function_of_a_filter_may_be_anything(made, name):
    e, filter_ = made
    call, fits = getattr(engine, name), functions(e)[name]
    call(filter_.copy(), *fits)
    for odd in ODD:
        attempt(call, odd, *fits)
    for place in range(len(fits)):
        like = np.shape(fits[place])
        for odd in (*ODD, *MATRICES, *IDS, *FAR, np.full(like, np.nan), np.full(like, 1e300), np.full(like, -1e300)):
            other = filter_.copy()
            attempt(call, other, *fits[:place], odd, *fits[place + 1 :])
            attempt(other.rest, 9, np.array([10, 11]))
            other.body_covariance()


def test_numbers_whose_differences_exceed_64_bits_are_refused(made):
    e, filter_ = made
    ids, table = e.table.id[:1], filter_.table()
    pixels = np.column_stack([e.table.seen_rows[:1, :2], e.table.seen_rows[:1, :2]])
    for far in (2**60 + 1, -(2**63)):
        with pytest.raises(ValueError, match="frame must be at most 2"):
            filter_.copy().rest(far, ids)
        with pytest.raises(ValueError, match="frame must be at most 2"):
            filter_.copy().update(far, ids, pixels, False, None)
        with pytest.raises(ValueError, match="last_step must be at most 2"):
            filter_.copy().revive({**table, "last_step": np.full_like(table["last_step"], far)})
    filter_.copy().rest(2**60, ids)


@pytest.mark.parametrize("far", FAR)
def test_numbers_of_frames_and_landmarks_may_be_far(made, far):
    e, filter_ = made
    ids, rows = e.table.id[[5, 1, 2]], e.table.seen_rows[[5, 1, 2]]
    measured = np.column_stack([rows[:, :2], rows[:, 0] - 20.0, rows[:, 1]])
    for frame in (far, 0):
        other = filter_.copy()
        for call in (lambda o, f: o.rest(f, ids), lambda o, f: o.update(f, ids, measured, False, None)):
            attempt(call, other, frame)
            attempt(call, other, far)
            attempt(call, other, 9)
    table = filter_.table()
    for column, values in table.items():
        if values.dtype == np.int64:
            spoilt = {**table, column: np.full_like(values, far)}
            other = filter_.copy()
            attempt(other.revive, spoilt)
            n, body = other.landmarks(), e.model.layout.body
            attempt(other.adopt, other.values(), e.coordinates, other.table()["position_m"], np.eye(body + 3 * n))
            attempt(other.update, 9, ids, measured, False, None)
            attempt(other.rest, 9, ids)
