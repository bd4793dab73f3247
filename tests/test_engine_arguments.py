"""Arguments of the engine's `Filter` that make no sense: a named error or an answer, never a crash."""

from __future__ import annotations

import numpy as np
import pytest
from support.compiled import Case, arguments, driven
from support.odd import MATRICES, ODD, attempt
from support.predicting import inertial_filters, walking_filters

engine = pytest.importorskip("ekfslam.engine._engine", reason="the engine is not built")
from ekfslam.engine.face import Engine, process_of  # noqa: E402

NUMBERS = [
    np.empty(0, dtype=np.int64),
    np.array([1, 1]),
    np.array([-1, 3]),
    np.array([2**62, 0]),
    np.arange(8)[::4],
    np.array([1.5, 2.5]),
    np.array([[1, 2]]),
    np.array([True, False]),
    ["a"],
    None,
]
WHOLE = [-1, 0, 2**40, 2**70, 1.5, None]
FAR = (2**62, -(2**62), 2**63 - 1, -(2**63))


@pytest.fixture(scope="module")
def made():
    """Return a filter in the middle of a drive, and the compiled one inside."""
    ekf = driven(Case())
    return ekf, ekf.engine.filter


@pytest.mark.parametrize("numbers", NUMBERS, ids=repr)
def test_ids_of_any_kind(made, numbers):
    for name in ("covariance", "landmark_blocks"):
        attempt(getattr(made[1].copy(), name), numbers)
    attempt(made[1].copy().rest, 9, numbers)
    for matrix in MATRICES:
        attempt(made[1].copy().update, 9, numbers, matrix, False, None)


@pytest.mark.parametrize("matrix", MATRICES, ids=lambda matrix: f"{np.shape(matrix)} {getattr(matrix, 'dtype', '')}")
def test_matrices_of_any_kind(made, matrix):
    for name, arity in (("propagate", 2), ("measure", 5), ("adopt", 4), ("look_again", 1), ("replace", 1)):
        attempt(getattr(made[1].copy(), name), *[matrix] * arity)
    moments = [(0.1, 1.0, 1.0), None], [None, (matrix, 0.1)], [(0.1,), None]
    for numbers, last in moments:
        attempt(made[1].copy().arrive, *[matrix] * 8, numbers, last, matrix)


@pytest.mark.parametrize("name", ["values", "coordinates", "imu_twist", "Phi", "Q", "T_departed", "noise", "shares"])
@pytest.mark.parametrize("wrong", [np.ones((2, 3)), np.empty(0)], ids=["(2, 3)", "(0,)"])
def test_one_array_of_a_wrong_shape_in_an_arrival(made, name, wrong):
    e, body = made[0], made[0].model.layout.body
    fits = {
        "values": made[1].values(),
        "coordinates": e.coordinates,
        "imu_twist": e.imu_twist,
        "Phi": np.eye(body),
        "Q": np.eye(body),
        "T_departed": np.eye(4),
        "T_predicted": np.eye(4),
        "noise": np.eye(body),
        "numbers": (0.1, 1.0, 1.0),
        "last": None,
        "shares": np.ones((2, 3)),
    }
    made[1].copy().arrive(**fits)
    if name != "shares" or wrong.size == 0:
        with pytest.raises((TypeError, ValueError)):
            made[1].copy().arrive(**(fits | {name: wrong}))


@pytest.mark.parametrize("whole", WHOLE)
def test_whole_numbers_of_any_kind(made, whole):
    pixels, none = np.ones((1, 4)), np.empty(0, dtype=np.int64)
    attempt(made[1].copy().update, whole, np.array([3]), pixels, False, None)
    attempt(made[1].copy().rest, whole, none)
    for place in range(3):
        attempt(made[1].copy().clone, *(whole if i == place else 1 for i in range(3)))
    attempt(made[1].copy().consider, whole)


@pytest.mark.parametrize("change", [{"id": np.arange(3)}, {"position_m": np.ones((2, 2))}, {"asleep": None}, {"id": 3}])
def test_a_table_that_does_not_fit(made, change):
    table = made[1].table()
    with pytest.raises((TypeError, ValueError, RuntimeError)):
        made[1].copy().revive(table | change)
    with pytest.raises(KeyError):
        made[1].copy().revive({key: value for key, value in table.items() if key not in change})


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_pixels_that_are_no_numbers(made, value):
    ids = made[1].table()["id"][[3, 1]]
    attempt(made[1].copy().update, 9, ids, np.full((2, 4), value), False, None)


def test_a_time_offset_needs_velocities_by_corrected_values(made):
    def fails(values):
        raise ArithmeticError("no velocity")

    e, seen = made[0], [1, 2, 5]
    q = e.table.seen_rows[seen]
    pixels = np.column_stack([q[:, :2], q[:, 0] - q[:, 2], q[:, 1]])
    for function, error, words in ((fails, ArithmeticError, "no velocity"), (None, ValueError, "twist_after")):
        other = made[1].copy()
        with pytest.raises(error, match=words):
            other.update(9, e.table.id[seen], pixels, False, function)
        assert np.isfinite(other.values()).all()


@pytest.mark.parametrize("arguments", [(-1, 1, 0), (0, 2**40, 0), (0, 6, 0), (2**40, 1, 0)])
def test_clones_of_columns_that_are_not_there_are_refused(made, arguments):
    with pytest.raises(ValueError, match=r"columns.* must be among"):
        made[1].copy().clone(*arguments)


@pytest.mark.parametrize("columns", [-1, 2**40])
def test_an_impossible_number_of_considered_columns_is_refused(made, columns):
    with pytest.raises(ValueError, match=r"columns.* must be among"):
        made[1].copy().consider(columns)


def test_landmarks_that_were_revived_and_not_adopted_are_named(made):
    filter_ = made[1].copy()
    filter_.revive(filter_.table())
    for call in (filter_.covariance, filter_.landmark_blocks, lambda: filter_.rest(9, np.array([1]))):
        with pytest.raises(ValueError, match="adopt must follow"):
            call()


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


def test_each_argument_of_an_alignment_may_be_anything():
    points = np.array([[300.0, 200.0, 280.0], [350.0, 250.0, 320.0], [200.0, 210.0, 150.0]])
    fits = [np.array([400.0, 400.0, 320.0, 240.0, 0.5]), points, points, np.eye(4), 0.5, 3.0]
    engine.align(*fits)
    for place in range(len(fits)):
        for odd in (*ODD, *MATRICES, np.empty((0, 3)), np.full((3, 3), np.nan), np.zeros((3, 3)), 0.0, 1e300):
            attempt(engine.align, *fits[:place], odd, *fits[place + 1 :])


# --- the constructor --------------------------------------------------------------------------------------------------


def settings_of_filter():
    """Return the arguments of a `Filter`."""
    (ekf,) = Case().filters(np.eye(4), ("engine",))
    return arguments(ekf.model, ekf.config)


@pytest.mark.parametrize("place", range(8))
def test_each_argument_of_the_constructor_may_be_anything(place):
    given = settings_of_filter()
    for odd in ODD:
        attempt(engine.Filter, *given[:place], odd, *given[place + 1 :])
    if isinstance(given[place], dict):
        for key in given[place]:
            for odd in ODD:
                attempt(engine.Filter, *given[:place], given[place] | {key: odd}, *given[place + 1 :])
            left = {name: value for name, value in given[place].items() if name != key}
            with pytest.raises(KeyError):
                engine.Filter(*given[:place], left, *given[place + 1 :])


@pytest.mark.parametrize("which", range(4))
def test_each_entry_of_a_block_may_be_anything(which):
    blocks, *others = settings_of_filter()
    for key in blocks[which]:
        for odd in ODD:
            changed = [{**block, key: odd} if i == which else block for i, block in enumerate(blocks)]
            attempt(engine.Filter, changed, *others)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"at": 1}, "must follow"),
        ({"value_at": 3}, "must follow"),
        ({"size": 5}, "six columns"),
        ({"kind": "direction"}, "another size"),
        ({"name": "view"}, "first block"),
    ],
)
def test_blocks_that_do_not_fit_are_named(change, words):
    blocks, *others = settings_of_filter()
    with pytest.raises(ValueError, match=words):
        engine.Filter([{**blocks[0], **change}, *blocks[1:]], *others)


# --- predictions ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def predicting():
    """Return a filter of each kind that predicts in C++, with the arguments of its `set_process`."""
    made = []
    for ekf in (inertial_filters()[0], walking_filters(True)[0]):
        laws = [block.as_data() for block in ekf.model.layout.blocks]
        made.append((Engine(ekf.model, ekf.config).filter, laws, process_of(ekf.model)))
    return made


@pytest.mark.parametrize("kind", range(2))
def test_each_entry_of_a_process_may_be_anything(predicting, kind):
    filter_, laws, settings = predicting[kind]
    for odd in ODD:
        attempt(filter_.copy().set_process, laws, odd)
        attempt(filter_.copy().set_process, odd, settings)
        for key in settings:
            other = filter_.copy()
            attempt(other.set_process, laws, settings | {key: odd})
            attempt(other.predict, 0.1, np.array([0.1]), np.ones((1, 6)), False, 1.0)
        for i in range(len(laws)):
            for key in laws[i]:
                other = filter_.copy()
                attempt(other.set_process, [*laws[:i], {**laws[i], key: odd}, *laws[i + 1 :]], settings)
                attempt(other.predict, 0.1, np.array([0.1]), np.ones((1, 6)), False, 1.0)


@pytest.mark.parametrize("kind", range(2))
def test_each_argument_of_a_prediction_may_be_anything(predicting, kind):
    filter_ = predicting[kind][0]
    fits = [0.1, np.array([0.04, 0.06]), np.ones((2, 6)), False, 1.0]
    misaligned = np.frombuffer(bytes(8 * 12 + 1), dtype=np.uint8)[1:].view(float).reshape(2, 6)
    filter_.copy().predict(*fits)
    filter_.copy().predict(*fits[:2], misaligned, *fits[3:])
    filter_.copy().predict(*fits[:2], np.ones((4, 12))[::2, ::2], *fits[3:])
    for place in range(5):
        for odd in (*ODD, *MATRICES, -1.0, 1e300):
            attempt(filter_.copy().predict, *fits[:place], odd, *fits[place + 1 :])
