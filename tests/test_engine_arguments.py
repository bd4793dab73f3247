"""Arguments of the engine's `Filter` that make no sense: a named error or an answer, never a crash."""

from __future__ import annotations

import numpy as np
import pytest
from support.compiled import Case, compiled

engine = pytest.importorskip("ekfslam.engine._engine", reason="the engine is not built")
from ekfslam.errors import EkfslamError  # noqa: E402

NAMED = (TypeError, ValueError, IndexError, KeyError, OverflowError, RuntimeError, MemoryError, EkfslamError)
MATRICES = [
    np.empty((0, 0)),
    np.empty((0, 4)),
    np.ones(3),
    np.ones((2, 4)),
    np.ones((4, 2)),
    np.full((2, 4), np.nan),
    np.ones((2, 4), dtype=np.float32),
    np.ones((2, 4), dtype=complex),
    np.ones((4, 8))[::2, ::2],
    np.asfortranarray(np.ones((2, 4))),
    np.ones((2, 2, 2)),
    "text",
    None,
]
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


@pytest.fixture(scope="module")
def made():
    e, P = Case().estimate(np.eye(4), np.random.default_rng(2))
    return e, compiled(engine, e, P)


def attempt(function, *arguments):
    """Call a function; only named errors pass."""
    try:
        function(*arguments)
    except NAMED as error:
        assert str(error)


@pytest.mark.parametrize("numbers", NUMBERS, ids=repr)
def test_ids_of_any_kind(made, numbers):
    for name in ("covariance_of", "landmark_blocks_of"):
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
