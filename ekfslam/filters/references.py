"""Cross-covariances between reported poses, for the NEES of relative poses.

With a relinearised window, that is their cross-covariance given all observations so far, which the window has. Else
the filter clones the reported pose of frame j into *considered* columns of the covariance (`Gaussian.consider`). The
clone stays as reported, so its cross-covariance with the pose of a later frame k is ``cov(xi_j, xi_k)`` of the reports.
"""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.lifecycle import Relinearised
from ekfslam.filters.result import PosePairs

_POSE = slice(0, 6)


class References:
    """Cross-covariances of pairs of reported poses, ``first`` before ``second``, recorded while a new filter runs."""

    def __init__(self, estimate: JointEKF, first: IntArray, second: IntArray) -> None:
        self._gaussian, self._window, self._first, self._second = estimate.gaussian, estimate.window, first, second
        self._cross = np.full((len(first), 6, 6), np.nan)
        self._clones: dict[int, tuple[slice, Array]] = {}  # by frame: the columns of the clone, and its covariance
        self._free: list[slice] = []

    def record(self, frame: int) -> None:
        """Record the pairs that end in a frame, after its update, and clone its pose if a pair begins there."""
        if self._window is not None:
            self._record_window(self._window, frame)
            return
        P = self._gaussian.body_covariance
        for i in np.flatnonzero(self._second == frame):
            at, own = self._clones[int(self._first[i])]
            # A map revival replaces the covariance of the filter by one without the clones.
            if np.allclose(P[at, at], own, rtol=1e-6, atol=0.0) or np.array_equal(P[at, at], own):
                self._cross[i] = P[at, _POSE]
        needed = set(self._first[self._second > frame].tolist())
        for j in self._clones.keys() - needed:
            self._free.append(self._clones.pop(j)[0])
        if frame in needed:
            if not self._free:
                start = self._gaussian.consider(6)
                self._free.append(slice(start, start + 6))
            at = self._free.pop()
            self._gaussian.clone(_POSE, at)
            self._clones[frame] = at, P[_POSE, _POSE]

    def _record_window(self, window: Relinearised, frame: int) -> None:
        """Record pairs that a relinearised window still holds; it replaces the covariance in each frame."""
        for i in np.flatnonzero(self._second == frame):
            cross = window.cross(int(self._first[i]))
            if cross is not None:
                self._cross[i] = cross

    def pairs(self) -> PosePairs:
        """Return the recorded pairs; those across a map revival, or longer than a relinearised window, are left out."""
        known = np.isfinite(self._cross).all(axis=(1, 2))
        return PosePairs(self._first[known], self._second[known], self._cross[known])
