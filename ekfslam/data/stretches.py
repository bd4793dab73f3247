"""Stretches of a recording, as recordings of their own."""

from __future__ import annotations

import dataclasses

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.sequence import Sequence, Truth


def cut(sequence: Sequence, begin: int, end: int, T_world_imu: Array) -> Sequence | None:
    """Frames ``begin`` to ``end - 1`` of a recording, without truth; None where nothing is observed in them.

    Args:
        sequence: The recording.
        begin, end: Frames of it.
        T_world_imu: (4, 4) pose that the stretch starts from, its truth by definition.
    """
    seen = sequence.observations.frame
    if not ((seen >= begin) & (seen < end)).any():
        return None
    truth = Truth(np.zeros(1, dtype=np.int64), T_world_imu[None])
    return dataclasses.replace(sequence[begin:end], truth=truth)
