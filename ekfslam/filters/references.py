"""Cross-covariances between reported poses, for the NEES of relative poses.

The filter clones the reported pose of frame j into *considered* columns of the covariance (Schmidt). Later observations
change its cross-covariance with the state, but neither its mean nor its own covariance. The clone therefore stays as
reported, and its cross-covariance with the pose of a later frame k is ``cov(xi_j, xi_k)`` of the two reports.
"""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.filters.estimate import Estimate
from ekfslam.filters.result import PosePairs

_POSE = slice(0, 6)


class References:
    """Cross-covariances of pairs of reported poses, recorded while a filter runs.

    Args:
        estimate: Filter before its first frame; it gets the columns that the pairs need.
        first: (n,) earlier frame of each pair.
        second: (n,) later frame of each pair.
    """

    def __init__(self, estimate: Estimate, first: IntArray, second: IntArray) -> None:
        self._estimate, self._first, self._second = estimate, first, second
        self._cross = np.full((len(first), 6, 6), np.nan)
        self._ending: dict[int, list[int]] = {}  # pairs by their later frame
        for i, frame in enumerate(second.tolist()):
            self._ending.setdefault(frame, []).append(i)
        begins, place = np.unique(first, return_inverse=True)
        ends = np.zeros(len(begins), dtype=np.int64)
        np.maximum.at(ends, place, second)
        self._ends = dict(zip(begins.tolist(), ends.tolist(), strict=True))
        slots = int((np.arange(1, len(begins) + 1) - np.searchsorted(np.sort(ends), begins, "right")).max(initial=0))
        start = estimate.gaussian.consider(6 * slots)
        self._free = [slice(start + 6 * i, start + 6 * i + 6) for i in range(slots)]
        self._at: dict[int, slice] = {}
        self._own: dict[int, Array] = {}

    def record(self, frame: int) -> None:
        """Record the pairs that end in a frame, after its update, and clone its pose if a pair begins there."""
        P = self._estimate.gaussian.body_covariance
        for i in self._ending.get(frame, ()):
            j = int(self._first[i])
            # A map revival replaces the covariance of the filter by one without the clones.
            if j in self._at and np.array_equal(P[self._at[j], self._at[j]], self._own[j]):
                self._cross[i] = P[self._at[j], _POSE]
        for j in [j for j in self._at if self._ends[j] <= frame]:
            self._free.append(self._at.pop(j))
        if frame in self._ends:
            self._at[frame] = self._free.pop()
            self._own[frame] = P[_POSE, _POSE].copy()
            self._estimate.gaussian.clone(_POSE, self._at[frame])

    def pairs(self) -> PosePairs:
        """Return the recorded pairs; pairs across a map revival are left out."""
        known = np.isfinite(self._cross).all(axis=(1, 2))
        return PosePairs(self._first[known], self._second[known], self._cross[known])
