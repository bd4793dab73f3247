"""What the columns of X are in the conditional form: the body, groups of its former columns, promoted landmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray

_BODY, _LANDMARK = 0, -1


@dataclass(frozen=True)
class Push:
    """Body columns on which landmarks depend: carried within the body (c,), or copied right behind it (p,)."""

    carried_from: IntArray
    carried_to: IntArray
    pushed: IntArray


class Window:
    """The columns of X; ``promoted`` (n,) has the first column of each promoted landmark, -1 of the others."""

    def __init__(self, body: int, promoted: int = 0) -> None:
        self._body, self._groups = body, 0
        # Of each column: 0 body, g of the g-th group that has left the body, -1 landmark.
        self._group = np.concatenate([np.full(body, _BODY), np.full(3 * promoted, _LANDMARK)])
        self.promoted = body + 3 * np.arange(promoted)
        self._since = np.zeros(promoted, dtype=np.int64)  # the oldest group that a landmark may depend on
        self._is_referenced = np.zeros(body, dtype=bool)

    def refer(self, columns: BoolArray | IntArray | slice) -> None:
        """Mark body columns that some landmark depends on."""
        self._is_referenced[columns] = True

    def augment(self, landmarks: int, promoted: bool = False) -> None:
        """Add landmarks that depend on the body alone, or are the last columns of X."""
        first = len(self._group) + 3 * np.arange(landmarks) if promoted else np.full(landmarks, -1)
        self.promoted = np.concatenate([self.promoted, first])
        self._since = np.concatenate([self._since, np.full(landmarks, self._groups + 1)])
        if promoted:
            self._group = np.concatenate([self._group, np.full(3 * landmarks, _LANDMARK)])

    def promote(self, which: IntArray) -> None:
        """Make some landmarks the last columns of X."""
        self.promoted[which] = len(self._group) + 3 * np.arange(len(which))
        self._group = np.concatenate([self._group, np.full(3 * len(which), _LANDMARK)])

    def keep(self, columns: IntArray) -> None:
        """Keep only some columns of X."""
        new = np.full(len(self._group), -1)
        new[columns] = np.arange(len(columns))
        is_promoted = self.promoted >= 0
        self.promoted[is_promoted] = new[self.promoted[is_promoted]]
        self._group = self._group[columns]

    def forget(self, gone: BoolArray) -> IntArray:
        """Drop landmarks that are gone (n,), and return their columns, which stay."""
        own = self.promoted[gone & (self.promoted >= 0)]
        self.promoted, self._since = self.promoted[~gone], self._since[~gone]
        return (own[:, None] + np.arange(3)).ravel()

    def push(self, Phi: Array, Q: Array) -> Push:
        """Propagate the body by ``x+ = Phi x + w``, w with covariance Q."""
        carried_from, carried_to, pushed = self._split(Phi, Q)
        if len(pushed):
            self._groups += 1
            group, b = np.full(len(pushed), self._groups), self._body
            self._group = np.concatenate([self._group[:b], group, self._group[b:]])
            self.promoted[self.promoted >= 0] += len(pushed)
        self._is_referenced[:] = False
        self._is_referenced[carried_to] = True
        return Push(carried_from, carried_to, pushed)

    def _split(self, Phi: Array, Q: Array) -> tuple[IntArray, IntArray, IntArray]:
        """Return body columns on which landmarks depend: those that stay in the body, where, and those that leave."""
        is_copy = ((Phi != 0).sum(axis=1) == 1) & (Phi.max(axis=1) == 1.0) & ~Q.any(axis=1)
        source = Phi.argmax(axis=1)
        to = np.full(len(Phi), -1)
        copies = np.flatnonzero(is_copy)[::-1]
        to[source[copies]] = copies
        stays = is_copy & (source == np.arange(len(Phi)))
        to[stays] = np.flatnonzero(stays)
        carried = np.flatnonzero(self._is_referenced & (to >= 0))
        return carried, to[carried], np.flatnonzero(self._is_referenced & (to < 0))

    def cut(self) -> tuple[IntArray, IntArray]:
        """Return landmarks to promote, and columns that may leave then, so that X becomes smallest."""
        group = self._group[self._body :]
        numbers, widths = np.unique(group[group != _LANDMARK], return_counts=True)
        free = np.flatnonzero(self.promoted < 0)
        since = np.sort(self._since[free])
        # With the first c groups dropped: landmarks that may depend on the newest of these must be promoted.
        needed = np.searchsorted(since, numbers, side="right")
        size = np.concatenate([[0], 3 * needed]) - np.concatenate([[0], np.cumsum(widths)])
        if not (c := int(size.argmin())):
            return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
        newest = numbers[c - 1]
        leaving = (self._group <= newest) & (self._group > _BODY)
        return free[self._since[free] <= newest], np.flatnonzero(leaving)
