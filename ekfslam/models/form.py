"""The cheaper form of the joint covariance for a recording, counted in floating-point operations.

With k landmarks seen in a frame, the dense form costs some ``2.3 (3k)^3 + 3k N^2`` operations a frame for a state of N
columns; the conditional form (`ekfslam.filters.conditional`) ``12 k n^2 + 2.7 n^3`` for X of n columns.
"""

from __future__ import annotations

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.data.sequence import Observations

# Operations of the conditional form take twice as long: measured on `builtin:city` at 80 to 100 observations a frame.
_COST = 2.0


def is_conditional_cheaper(
    observations: Observations, frames: int, body: int, group: int, stay: int, kept: int
) -> bool:
    """Return whether the conditional form takes fewer operations, over all frames.

    Args:
        observations, frames: Observations of landmarks, and the number of frames.
        body: Number of body columns.
        group: Number of body columns that observations depend on and each frame changes.
        stay: Frames that a landmark is active after it was seen last.
        kept: Number of dormant landmarks.
    """
    _, place = np.unique(observations.landmark, return_inverse=True)
    first, last = np.full(place.max(initial=-1) + 1, frames), np.full(place.max(initial=-1) + 1, -1)
    np.minimum.at(first, place, observations.frame)
    np.maximum.at(last, place, observations.frame)
    seen = np.bincount(observations.frame, minlength=frames).astype(float)
    chosen = np.unique(np.linspace(0, frames - 1, min(frames, 50)).astype(int))
    dense, conditional = np.zeros(len(chosen)), np.zeros(len(chosen))
    for i, frame in enumerate(chosen.tolist()):
        age = np.sort(frame - first[(first < frame) & (last + stay > frame)])
        asleep = min(kept, int(((first < frame) & (last + stay <= frame)).sum()))
        n, k = body + _smallest_window(age, group), seen[frame]
        conditional[i] = 12.0 * k * n**2 + 2.7 * n**3
        dense[i] = 2.3 * (3.0 * k) ** 3 + 3.0 * k * (body + 3.0 * (len(age) + asleep)) ** 2
    return bool(_COST * conditional.sum() < dense.sum())


def _smallest_window(age: IntArray | Array, group: int) -> float:
    """Return the fewest columns of w past frames and of older landmarks, whose ages (n,) ascend."""
    past = np.arange(int(age[-1]) + 1) if len(age) else np.zeros(1, dtype=np.int64)
    return float((group * past + 3 * (len(age) - np.searchsorted(age, past, side="right"))).min())
