"""The table of landmarks that a filter keeps: one row a landmark, in the order of their blocks in the state."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.filters.result import Landmarks

_WHOLE = ("id", "first_frame", "last_frame", "observations", "misses")  # with `_STEPS` the columns of whole numbers
_STEPS = ("log_row", "stay_until", "first_step", "last_step", "last_observation", "asleep")
_RECORDED = ("id", "position_m", "initial_m", "first_frame", "last_frame", "observations")
_REAL = ("position_m", "initial_m", "evidence", "seen_rows", "extra")


def _column(name: str) -> Any:
    """Return a property for a named column (n, ...): a view; assigned values are copied."""

    def assign(table: LandmarkTable, value: Array) -> None:
        table._rows[name] = value

    return property(lambda table: table._rows[name], assign)


class LandmarkTable:
    """Named columns, one row a landmark.

    Args:
        dimension: Rows d of an observation.
        extra: Width of the column ``extra``, for the filter's own use.

    Attributes:
        id: (n,) landmark ids.
        first_frame, last_frame: (n,) of the first and last accepted observation.
        observations: (n,) number of accepted observations.
        misses: (n,) observations in a row that spoke against the landmark.
        log_row: (n,) row of the landmark in the log.
        first_step, last_step: (n,) frames of the log with the first and the last accepted observation.
        last_observation: (n,) place of the last accepted observation in the log.
        asleep: (n,) 1 if the landmark is dormant: not seen before it is woken.
        stay_until: (n,) frame up to which the landmark stays without being seen.
        position_m, initial_m: (n, 3) estimate, and the one at landmark initialisation.
        seen_rows: (n, d) rows of the last accepted observation.
        evidence: (n, 2) of the test for moving tracks, see `ekfslam.filters.gates`.
    """

    def __init__(self, dimension: int = 3, extra: int = 0) -> None:
        widths = zip(_REAL, (3, 3, 2, dimension, extra), strict=True)
        whole = [(name, np.int64) for name in (*_WHOLE, *_STEPS)]
        self._rows = np.empty(0, dtype=[*whole, *((name, float, (width,)) for name, width in widths)])

    def __len__(self) -> int:
        return len(self._rows)

    id, first_frame, last_frame, observations, misses = map(_column, _WHOLE)
    log_row, stay_until, first_step, last_step, last_observation, asleep = map(_column, _STEPS)
    position_m, initial_m, evidence, seen_rows, extra = map(_column, _REAL)

    def append(self, **values: ArrayLike) -> None:
        """Append rows; columns not given are 0."""
        new = np.zeros(len(np.asarray(values["id"])), dtype=self._rows.dtype)
        for name, value in values.items():
            new[name] = value
        self._rows = np.concatenate([self._rows, new]) if len(self) else new

    def columns(self, first: int) -> dict[str, Array | IntArray]:
        """Return all columns but ``extra`` by name, from a row on."""
        return {name: np.ascontiguousarray(self._rows[name][first:]) for name in (*_WHOLE, *_STEPS, *_REAL[:-1])}

    def keep(self, stay: BoolArray) -> None:
        """Drop the rows that do not stay (n,)."""
        self._rows = self._rows[stay]

    def lookup(self, ids: IntArray) -> tuple[IntArray, BoolArray]:
        """Return the slot (k,) of each id, and whether (k,) it is in the table at all."""
        order = np.argsort(self.id, kind="stable")  # fast for ids that ascend already, as they mostly do
        index, is_known = lookup(self.id[order], ids)
        return (order[index] if len(order) else index), is_known

    def observed(self, slot: IntArray, step: int, rows: Array, places: IntArray) -> None:
        """Keep the last observation of landmarks (k,): rows (k, d), and places (k,) in the log."""
        self.last_step[slot], self.seen_rows[slot], self.last_observation[slot] = step, rows, places

    def accepted(self, slot: IntArray, frame: int) -> None:
        """Count an accepted observation of the landmarks at the slots."""
        self.last_frame[slot] = frame
        self.observations[slot] += 1
        self.misses[slot] = 0

    def snapshot(self, slot: IntArray, covariance: Array) -> Landmarks:
        """Return some landmarks as records of a result, with their covariances (k, 3, 3)."""
        return landmarks_of({name: self._rows[name][slot] for name in _RECORDED}, covariance)


def landmarks_of(columns: Mapping[str, Any], covariance: Array) -> Landmarks:
    """Return landmarks (k) as records of a result, given columns of a table and covariances (k, 3, 3)."""
    id, position_m, *others = (columns[name] for name in _RECORDED)
    return Landmarks(id, position_m, covariance, *others)


def lookup(sorted_ids: IntArray, ids: IntArray) -> tuple[IntArray, BoolArray]:
    """Return the index (n,) of each id in ``sorted_ids``, and whether (n,) it is there at all."""
    if len(sorted_ids) == 0:
        return np.zeros(len(ids), dtype=np.int64), np.zeros(len(ids), dtype=bool)
    index = np.minimum(np.searchsorted(sorted_ids, ids), len(sorted_ids) - 1)
    return index, sorted_ids[index] == ids
