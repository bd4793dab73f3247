"""How the errors of reported poses hang together: cross-covariances of pairs, carried along by the filter.

The reported pose of frame j is cloned into *considered* columns of the covariance (Schmidt): what is observed later
changes its cross-covariance with the state, and neither its mean nor its own covariance. So it stays what was reported,
and its cross-covariance with the pose of a later frame k is ``cov(xi_j, xi_k)`` of the two reports.
"""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.filters.estimate import Estimate
from ekfslam.filters.result import PosePairs

_POSE = slice(0, 6)


class References:
    """Records the cross-covariances of pairs of reported poses while a filter runs.

    Args:
        estimate: The filter, before its first frame; gets the columns that the pairs need.
        first, second: (n,) frames of each pair, the earlier one first.
    """

    def __init__(self, estimate: Estimate, first: IntArray, second: IntArray) -> None:
        self._estimate, self._first, self._second = estimate, first, second
        self._cross = np.full((len(first), 6, 6), np.nan)
        begins = np.unique(first)
        self._ends = {int(j): int(second[first == j].max()) for j in begins}
        slots = max((sum(j <= k < end for j, end in self._ends.items()) for k in begins.tolist()), default=0)
        start = estimate.gaussian.consider(6 * slots)
        self._free = [slice(start + 6 * i, start + 6 * i + 6) for i in range(slots)]
        self._at: dict[int, slice] = {}
        self._own: dict[int, Array] = {}

    def record(self, frame: int) -> None:
        """After the update of a frame: what it has to do with the references, and a new one if it is one."""
        P = self._estimate.gaussian.body_covariance
        for i in np.flatnonzero(self._second == frame):
            j = int(self._first[i])
            # A map revival puts another covariance in place of the filter's, which knows nothing of references.
            if j in self._at and np.array_equal(P[self._at[j], self._at[j]], self._own[j]):
                self._cross[i] = P[self._at[j], _POSE]
        for j in [j for j in self._at if self._ends[j] <= frame]:
            self._free.append(self._at.pop(j))
        if frame in self._ends:
            self._at[frame] = self._free.pop()
            self._own[frame] = P[_POSE, _POSE].copy()
            self._estimate.gaussian.clone(_POSE, self._at[frame])

    def pairs(self) -> PosePairs:
        """The pairs that were recorded; those across a map revival are not."""
        known = np.isfinite(self._cross).all(axis=(1, 2))
        return PosePairs(self._first[known], self._second[known], self._cross[known])
