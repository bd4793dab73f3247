"""The table of landmarks that a filter keeps: one row a landmark, in the order of their blocks in the state."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.filters.result import Landmarks

_INTS = (
    "id",
    "first_frame",
    "last_frame",
    "observations",
    "misses",
    "log_row",
    "stay_until",
    "first_step",
    "last_step",
    "last_observation",
    "asleep",
)


def _column(name: str) -> Any:
    """Return a property for a named column (n,) of whole numbers: a view that can be written to."""
    at = _INTS.index(name)
    return property(lambda table: table._ints[at, : table._rows])


def _columns(start: int, stop: int | None) -> Any:
    """Named columns (n, k) of real numbers: a view; what is assigned is copied."""

    def replace(table: LandmarkTable, value: Array) -> None:
        table._floats[: table._rows, start:stop] = value

    return property(lambda table: table._floats[: table._rows, start:stop], replace)


class LandmarkTable:
    """Named columns, one row a landmark.

    Args:
        dimension: Rows d of an observation.
        extra: Number of further columns.

    Attributes:
        id: (n,) landmark ids.
        first_frame, last_frame: (n,) of the first and last accepted observation.
        observations: (n,) number of accepted observations.
        misses: (n,) observations in a row that spoke against the landmark.
        log_row: (n,) row of the landmark in the log.
        first_step, last_step: (n,) frames of the log with the first and the last accepted observation.
        last_observation: (n,) place of the last accepted observation in the log.
        asleep: (n,) 1 where it is out of view: it will not be seen before it is woken.
        stay_until: (n,) frame up to which the landmark stays without being seen.
        position_m, initial_m: (n, 3) estimate, and the one at landmark initialisation.
        seen_rows: (n, d) rows of the last accepted observation.
        extra: (n, extra) whatever a filter keeps besides.
        evidence: (n, 2) of the test for moving tracks, see `ekfslam.filters.gates`.
    """

    def __init__(self, dimension: int = 3, extra: int = 0) -> None:
        # Two matrices and not a dozen arrays, with room to grow: a frame that starts or drops landmarks costs little.
        self._ints = np.empty((len(_INTS), 0), dtype=np.int64)
        self._floats = np.empty((0, 8 + dimension + extra))
        self._rows, self._dimension = 0, dimension

    def __len__(self) -> int:
        return self._rows

    id, first_frame, last_frame, observations, misses = (_column(name) for name in _INTS[:5])
    log_row, stay_until, first_step, last_step, last_observation, asleep = (_column(name) for name in _INTS[5:])
    position_m, initial_m = _columns(0, 3), _columns(3, 6)
    evidence = _columns(6, 8)

    @property
    def seen_rows(self) -> Array:
        return self._floats[: len(self), 8 : 8 + self._dimension]

    @property
    def extra(self) -> Array:
        return self._floats[: len(self), 8 + self._dimension :]

    def append(self, **values: ArrayLike) -> None:
        """Append rows; columns not given are 0."""
        before = len(self)
        after = before + len(np.asarray(values["id"]))
        if after > len(self._floats):
            self._floats = _wider(self._floats[:before], after)
            self._ints = np.ascontiguousarray(_wider(self._ints[:, :before].T, after).T)
        self._ints[:, before:after], self._floats[before:after], self._rows = 0, 0.0, after
        for name, value in values.items():
            getattr(self, name)[before:] = value

    def keep(self, stay: BoolArray) -> None:
        """Drop the rows that do not stay (n,)."""
        self._ints, self._floats = self._ints[:, : len(self)][:, stay], self._floats[: len(self)][stay]
        self._rows = len(self._floats)

    def lookup(self, ids: IntArray) -> tuple[IntArray, BoolArray]:
        """Slot (k,) of each id, and whether (k,) it is in the table at all."""
        order = np.argsort(self.id, kind="stable")  # fast where ids ascend already, as they mostly do
        index, is_known = lookup(self.id[order], ids)
        return (order[index] if len(order) else index), is_known

    def observed(self, slot: IntArray, step: int, rows: Array, places: IntArray) -> None:
        """Remember what was seen of landmarks (k,) for the next frame: rows (k, d), and places (k,) in the log."""
        self.last_step[slot], self.seen_rows[slot], self.last_observation[slot] = step, rows, places

    def accepted(self, slot: IntArray, frame: int) -> None:
        """Count an accepted observation of the landmarks at the slots."""
        self.last_frame[slot] = frame
        self.observations[slot] += 1
        self.misses[slot] = 0

    def snapshot(self, slot: IntArray, covariance: Array) -> Landmarks:
        """Return some landmarks as records of a result, with their covariances (k, 3, 3)."""
        return Landmarks(
            self.id[slot],
            self.position_m[slot],
            covariance,
            self.initial_m[slot],
            self.first_frame[slot],
            self.last_frame[slot],
            self.observations[slot],
        )


def _wider(rows: NDArray, least: int) -> NDArray:
    """Return a copy of the rows (n, k) with room for 1.5 times a least number of rows."""
    room = np.empty((least + least // 2, rows.shape[1]), dtype=rows.dtype)
    room[: len(rows)] = rows
    return room


def lookup(sorted_ids: IntArray, ids: IntArray) -> tuple[IntArray, BoolArray]:
    """Index (n,) of each id in ``sorted_ids``, and whether (n,) it is there at all."""
    if len(sorted_ids) == 0:
        return np.zeros(len(ids), dtype=np.int64), np.zeros(len(ids), dtype=bool)
    index = np.minimum(np.searchsorted(sorted_ids, ids), len(sorted_ids) - 1)
    return index, sorted_ids[index] == ids
