"""The table of landmarks that a filter keeps: one row a landmark, in the order of their blocks in the state."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.filters.result import Landmarks


class LandmarkTable:
    """Named columns, one row a landmark.

    Attributes:
        id: (n,) landmark ids.
        first_frame, last_frame: (n,) of the first and last accepted observation.
        observations: (n,) number of accepted observations.
        misses: (n,) observations in a row that spoke against the landmark.
        log_row: (n,) row of the landmark in the log.
        first_step, last_step: (n,) frames of the log with the first and the last accepted observation.
        last_observation: (n,) place of the last accepted observation in the log.
        stay_until: (n,) frame up to which the landmark stays without being seen.
        position_m, initial_m: (n, 3) estimate, and the one at landmark initialisation.
        seen_rows: (n, d) rows of the last accepted observation.
        evidence: (n, 2) of the test for moving tracks, see `ekfslam.filters.gates`.
    """

    def __init__(self, dimension: int = 3) -> None:
        self.id = self.first_frame = self.last_frame = self.observations = np.empty(0, dtype=np.int64)
        self.misses = self.log_row = self.stay_until = np.empty(0, dtype=np.int64)
        self.first_step = self.last_step = self.last_observation = np.empty(0, dtype=np.int64)
        self.position_m = self.initial_m = np.empty((0, 3))
        self.seen_rows, self.evidence = np.empty((0, dimension)), np.empty((0, 2))

    def __len__(self) -> int:
        return len(self.id)

    @property
    def columns(self) -> dict[str, NDArray]:
        """All columns by name."""
        return vars(self)

    def append(self, **values: Any) -> None:
        """Append rows; columns not given are 0."""
        n = len(values["id"])
        for name, column in self.columns.items():
            new = np.broadcast_to(values.get(name, 0), (n, *column.shape[1:]))
            setattr(self, name, np.concatenate([column, new.astype(column.dtype)]))

    def keep(self, stay: BoolArray) -> None:
        """Drop the rows that do not stay (n,)."""
        for name, column in self.columns.items():
            setattr(self, name, column[stay])

    def lookup(self, ids: IntArray) -> tuple[IntArray, BoolArray]:
        """Slot (k,) of each id, and whether (k,) it is in the table at all."""
        order = np.argsort(self.id)
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
        """Some landmarks as a result has them, with covariances (n, 3, 3) of all."""
        return Landmarks(
            self.id[slot],
            self.position_m[slot],
            covariance[slot],
            self.initial_m[slot],
            self.first_frame[slot],
            self.last_frame[slot],
            self.observations[slot],
        )


def lookup(sorted_ids: IntArray, ids: IntArray) -> tuple[IntArray, BoolArray]:
    """Index (n,) of each id in ``sorted_ids``, and whether (n,) it is there at all."""
    if len(sorted_ids) == 0:
        return np.zeros(len(ids), dtype=np.int64), np.zeros(len(ids), dtype=bool)
    index = np.minimum(np.searchsorted(sorted_ids, ids), len(sorted_ids) - 1)
    return index, sorted_ids[index] == ids
