"""How landmarks leave the state and come back: retirement, map revival, and the books about both."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.filters.estimate import Estimate
from ekfslam.filters.landmarks import LandmarkTable
from ekfslam.filters.log import Log
from ekfslam.filters.result import Landmarks

# Frames that a neighbour fetched with a returning landmark stays without being seen, beyond twice its distance in time.
PATIENCE = 30


@dataclass(frozen=True)
class Marginal:
    """Mean and covariance of all blocks and of some landmarks, given everything in a log."""

    values: dict[str, Array]  # estimates of the blocks that change
    columns: IntArray  # columns, coordinates: (c,) body columns whose coordinates change, and their new coordinates
    coordinates: Array
    position_m: Array  # (n, 3) landmarks
    P: Array  # (body+3n, body+3n) covariance in the order of a filter's state


class Revival(Protocol):
    """Source of returning landmarks: `ekfslam.smoother.revival.MapRevival`, handed to the filter by its caller."""

    def neighbours(self, log: Log, returning: IntArray, candidates: IntArray) -> tuple[IntArray, IntArray]:
        """Return rows (c,) of candidates that come along, and their distances (c,) in frames from returning ones."""

    def marginal(self, log: Log, positions_m: Array, landmarks: IntArray) -> Marginal:
        """Return the marginal over the last frame's blocks and landmarks (n,), given as rows of the log."""


class Relinearised(Protocol):
    """The last frames, solved again: `ekfslam.smoother.fixed_lag.FixedLag`, handed to the filter by its caller."""

    first: int
    observed: int
    given_up: int

    @property
    def landmarks(self) -> IntArray:
        """Rows in the log of landmarks that are known before the observations of the window."""

    def marginal(self, e: Estimate, log: Log, rows: IntArray) -> Marginal | None:
        """Return the marginal over the present frame and all active landmarks, given the log since ``first``."""

    def start_over(self, e: Estimate) -> None:
        """Begin at the present frame."""

    def cross(self, step: int) -> Array | None:
        """Return the cross-covariance (6, 6) of the pose at a step and of the last one; None: it is out of reach."""


class Retired:
    """Landmarks that have left the state."""

    def __init__(self) -> None:
        self._parts: list[Landmarks] = []
        self._rows: list[IntArray] = []
        self.row_of: dict[int, int] = {}  # rows in the log of landmarks that may come back, by id
        self._verdicts: dict[int, tuple[int, Array]] = {}  # misses and evidence of moving, by row
        self.revived: list[int] = []  # ids of retired landmarks that were seen again and came back
        self.reappeared: list[int] = []  # those that were initialised as new ones
        self.moving: set[int] = set()  # ids of tracks that were found to move; they are not used again
        self._dropped = 0
        self._rows_before: dict[int, int | None] = {}  # entries of `row_of` that have changed since `mark`

    def mark(self) -> tuple[int, int, int, set[int]]:
        """Return a mark of this moment for `restore`; an earlier one is of no use any more."""
        self._rows_before = {}
        return len(self._parts), len(self.revived), len(self.reappeared), set(self.moving)

    def restore(self, mark: tuple[int, int, int, set[int]]) -> None:
        """Forget everything since a mark."""
        parts, revived, reappeared, self.moving = mark
        for grown, length in ((self._parts, parts), (self._rows, parts)):
            del grown[length:]
        del self.revived[revived:], self.reappeared[reappeared:]
        for i, row in self._rows_before.items():
            self.row_of.pop(i, None)
            if row is not None:
                self.row_of[i] = row

    def _leave(self, i: int) -> None:
        """Take an id from those that may come back."""
        self._rows_before.setdefault(i, self.row_of.pop(i))

    @property
    def counts(self) -> dict[str, int]:
        """Totals by name."""
        again = {name: len(getattr(self, name)) for name in ("revived", "reappeared", "moving")}
        return {"retired": self._dropped + sum(len(part) for part in self._parts), **again}

    def add(self, table: LandmarkTable, covariance: Array, gone: BoolArray, may_return: bool) -> None:
        """Add landmarks (n,) of a table that are gone, with their covariances (k, 3, 3)."""
        slot = np.flatnonzero(gone)
        columns = {name: getattr(table, name)[slot] for name in ("log_row", "misses", "evidence")}
        self.take(table.snapshot(slot, covariance), columns, may_return)

    def take(self, gone: Landmarks, columns: Mapping[str, Any], may_return: bool) -> None:
        """Add landmarks (k) that are gone, with the columns ``log_row``, ``misses`` and ``evidence`` of their table."""
        rows = columns["log_row"]
        self._parts.append(gone)
        self._rows.append(rows)
        if may_return:
            for i, row in zip(gone.id.tolist(), rows.tolist(), strict=True):
                self._rows_before.setdefault(i, self.row_of.get(i))
                self.row_of[i] = row
            verdicts = zip(columns["misses"].tolist(), columns["evidence"], strict=True)
            self._verdicts.update(zip(rows.tolist(), verdicts, strict=True))

    def among(self, ids: IntArray) -> list[int]:
        """Return the ids that were retired and may come back, ascending."""
        return sorted(self.row_of.keys() & set(ids.tolist())) if self.row_of else []

    def start_again(self, ids: IntArray) -> None:
        """Mark ids that are initialised again: landmarks retired under them do not come back."""
        again = self.among(ids)
        self.reappeared.extend(again)
        for i in again:
            self._leave(i)

    def drop(self) -> None:
        """Drop all landmarks that have left; they cannot come back. Tracks that move stay known."""
        self._dropped += sum(len(part) for part in self._parts)
        for kept in (self._parts, self._rows, self.row_of, self._verdicts):
            kept.clear()

    def all_landmarks(self, table: LandmarkTable, covariance: Array) -> Landmarks:
        """Return every landmark so far, in the order of the log; covariances (n, 3, 3) are for the table."""
        row = np.concatenate([*self._rows, table.log_row])
        everything = Landmarks.concatenate([*self._parts, table.snapshot(np.arange(len(table)), covariance)])
        # A landmark that came back and was retired again is there twice; its last estimate counts.
        _, last = np.unique(row[::-1], return_index=True)
        return everything.only(len(row) - 1 - last)

    def fetch(
        self, table: LandmarkTable, known: Landmarks, log: Log, ids: list[int], revival: Revival, frame: int
    ) -> None:
        """Put returning landmarks back into the table, and neighbours that will probably be seen next."""
        returning = np.array([self.row_of[i] for i in ids])
        retired = np.fromiter(self.row_of.values(), dtype=np.int64, count=len(self.row_of))
        neighbours, distance = revival.neighbours(log, returning, np.setdiff1d(retired, returning))
        back = np.concatenate([returning, neighbours])
        came = known.only(back)
        misses, evidence = zip(*(self._verdicts[row] for row in back.tolist()), strict=True)
        _, first_observation = np.unique(log.landmark, return_index=True)
        table.append(
            id=came.id,
            first_frame=came.first_frame,
            last_frame=came.last_frame,
            observations=came.observations,
            misses=np.array(misses),
            evidence=np.array(evidence),
            log_row=back,
            first_step=log.frame[first_observation[back]],
            last_step=np.full(len(back), -2),
            stay_until=frame + np.concatenate([np.zeros_like(returning), 2 * distance + PATIENCE]),
            position_m=came.position_m,
            initial_m=log.first_position_m[back],
        )
        for i in came.id.tolist():
            self._leave(i)
        self.revived.extend(ids)


def at_rest(out: BoolArray, table: LandmarkTable, limit: int | None) -> BoolArray:
    """Return which landmarks out of view (n,) stay, dormant: the last seen up to a limit; None: all."""
    stay = out.copy()
    if limit is not None and (excess := int(out.sum()) - limit) > 0:
        slot = np.flatnonzero(out)
        stay[slot[np.argsort(table.last_frame[slot], kind="stable")[:excess]]] = False
    return stay


def out_of_view(table: LandmarkTable, ids: IntArray, frame: int, after: int) -> BoolArray:
    """Return which landmarks (n,) have not been seen for ``after`` frames; ``ids`` are seen now."""
    unseen_for = frame - np.maximum(table.last_frame, table.stay_until)
    return (unseen_for >= after) & np.isin(table.id, ids, invert=True)
