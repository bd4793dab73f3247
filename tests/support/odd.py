"""Arguments that make no sense, and calls that may refuse them by name."""

from __future__ import annotations

import numpy as np

from ekfslam.errors import EkfslamError

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
ODD = [
    None,
    -1,
    2**40,
    2**70,
    1.5,
    np.nan,
    np.inf,
    True,
    "text",
    [],
    {},
    np.ones(3),
    np.ones((9, 9)),
    np.full(3, np.nan),
]


def attempt(function, *arguments):
    """Call a function; only named errors pass."""
    try:
        function(*arguments)
    except NAMED as error:
        assert str(error)
