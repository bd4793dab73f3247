"""What the columns of X are in the conditional form: the body, groups of its former columns, promoted landmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray

_BODY, _LANDMARK = 0, -1


@dataclass(frozen=True)
class Move:
    """How the columns of X change in a propagation: body, then former columns that are kept, then new ones.

    Args:
        carried_from, carried_to: (c,) body columns on which landmarks depend, whose values are in the body afterwards.
        kept: (n,) columns before the propagation that stay as they were; those of the body join the window.
        promoted: (p,) slots of landmarks that join X.
    """

    carried_from: IntArray
    carried_to: IntArray
    kept: IntArray
    promoted: IntArray


class Window:
    """The columns of X, and what landmarks depend on.

    Args:
        body: Number of body columns.
        promoted: Number of landmarks, all promoted, in the order of their columns.

    Attributes:
        promoted: (n,) first column of each promoted landmark; -1 of the others.
    """

    def __init__(self, body: int, promoted: int = 0) -> None:
        self._body, self._groups = body, 0
        # Of each column: 0 body, g of the g-th group that has left the body, -1 landmark.
        self._group = np.concatenate([np.full(body, _BODY), np.full(3 * promoted, _LANDMARK)])
        self.promoted = body + 3 * np.arange(promoted)
        self._since = np.zeros(promoted, dtype=np.int64)  # the oldest group that a landmark may depend on
        self._is_referenced = np.zeros(body, dtype=bool)

    def refer(self, columns: BoolArray | IntArray) -> None:
        """Some landmark depends on these body columns from now on."""
        self._is_referenced[columns] = True

    def augment(self, landmarks: int) -> None:
        """New landmarks, which depend on the body alone."""
        self.promoted = np.concatenate([self.promoted, np.full(landmarks, -1)])
        self._since = np.concatenate([self._since, np.full(landmarks, self._groups + 1)])

    def propagate(self, Phi: Array, Q: Array) -> Move:
        """``x+ = Phi x + w`` on the body, w with covariance Q."""
        carried_from, carried_to, pushed = self._split(Phi, Q)
        if len(pushed):
            self._groups += 1
        group = np.concatenate([np.full(len(pushed), self._groups), self._group[self._body :]])
        column = np.concatenate([pushed, np.arange(self._body, len(self._group))])
        oldest, joined = self._cut(group)
        stays = (group == _LANDMARK) | (group >= oldest)
        kept, group = column[stays], group[stays]
        self._move(np.concatenate([np.arange(self._body), kept]), moved=slice(self._body, None))
        self.promoted[joined] = self._body + len(kept) + 3 * np.arange(len(joined))
        own = np.full(3 * len(joined), _LANDMARK)
        self._group = np.concatenate([np.full(self._body, _BODY), group, own])
        self._is_referenced[:] = False
        self._is_referenced[carried_to] = True
        return Move(carried_from, carried_to, kept, joined)

    def marginalise(self, stay: BoolArray) -> IntArray:
        """Landmarks that do not stay (n,) leave; returns the columns of X that are left."""
        gone = self.promoted[~stay & (self.promoted >= 0)]
        kept = np.delete(np.arange(len(self._group)), (gone[:, None] + np.arange(3)).ravel())
        self.promoted, self._since = self.promoted[stay], self._since[stay]
        self._group = self._group[kept]
        self._move(kept)
        return kept

    def _move(self, kept: IntArray, moved: slice = slice(None)) -> None:
        """Landmarks that are promoted have other columns where only those ``kept`` are left."""
        new = np.full(int(kept.max(initial=0)) + 1, -1)
        new[kept[moved]] = np.arange(len(kept))[moved]
        is_promoted = self.promoted >= 0
        self.promoted[is_promoted] = new[self.promoted[is_promoted]]

    def _split(self, Phi: Array, Q: Array) -> tuple[IntArray, IntArray, IntArray]:
        """Body columns on which landmarks depend: those whose values stay in the body, where, and those that leave."""
        is_copy = ((Phi != 0).sum(axis=1) == 1) & (Phi.max(axis=1) == 1.0) & ~Q.any(axis=1)
        source = Phi.argmax(axis=1)
        to = np.full(len(Phi), -1)
        copies = np.flatnonzero(is_copy)[::-1]
        to[source[copies]] = copies
        stays = is_copy & (source == np.arange(len(Phi)))
        to[stays] = np.flatnonzero(stays)
        carried = np.flatnonzero(self._is_referenced & (to >= 0))
        return carried, to[carried], np.flatnonzero(self._is_referenced & (to < 0))

    def _cut(self, group: IntArray) -> tuple[int, IntArray]:
        """The oldest group that stays, so that X is smallest, and the landmarks that are promoted for it."""
        numbers, widths = np.unique(group[group != _LANDMARK], return_counts=True)
        free = np.flatnonzero(self.promoted < 0)
        since = np.sort(self._since[free])
        # With the first c groups dropped: landmarks that may depend on the newest of these must be promoted.
        needed = np.searchsorted(since, numbers, side="right")
        size = np.concatenate([[0], 3 * needed]) + widths.sum() - np.concatenate([[0], np.cumsum(widths)])
        c = int(size.argmin())
        if c == 0:
            return 0, np.empty(0, dtype=np.int64)
        return int(numbers[c - 1]) + 1, free[self._since[free] <= numbers[c - 1]]
