"""Stretches of a recording, as recordings of their own."""

from __future__ import annotations

import dataclasses

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.interpolation import without_interpolation
from ekfslam.data.sequence import Observations, Sequence, Truth


def cut(sequence: Sequence, begin: int, end: int, T_world_imu: Array) -> Sequence | None:
    """Frames ``begin`` to ``end - 1`` of a recording, without truth; None where nothing is observed in them.

    Args:
        sequence: The recording.
        begin, end: Frames of it.
        T_world_imu: (4, 4) pose that the stretch starts from, its truth by definition.
    """
    tracks = sequence.observations
    within = (tracks.frame >= begin) & (tracks.frame < end)
    if not within.any():
        return None
    return dataclasses.replace(
        sequence,
        time_s=sequence.time_s[begin:end],
        twist=sequence.twist[begin:end],
        observations=Observations(tracks.frame[within] - begin, tracks.landmark[within], tracks.pixels_px[within]),
        truth=Truth(np.zeros(1, dtype=np.int64), T_world_imu[None]),
        attributes=without_interpolation(sequence.attributes),
    )
