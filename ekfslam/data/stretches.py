"""Stretches of a recording as recordings."""

from __future__ import annotations

import dataclasses

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.sequence import Sequence, Truth


def cut(sequence: Sequence, begin: int, end: int, T_world_imu: Array) -> Sequence | None:
    """Return frames ``begin`` to ``end - 1`` of a recording, without truth; None if nothing is observed in them.

    Args:
        sequence: Recording.
        begin, end: First frame, and frame after the last.
        T_world_imu: (4, 4) first pose of the stretch, which counts as true.
    """
    seen = sequence.observations.frame
    if not ((seen >= begin) & (seen < end)).any():
        return None
    truth = Truth(np.zeros(1, dtype=np.int64), T_world_imu[None])
    return dataclasses.replace(sequence[begin:end], truth=truth)
