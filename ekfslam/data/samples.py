"""Samples of velocities as a file has them, before they are brought to the stamps of a recording."""

from __future__ import annotations

from dataclasses import dataclass

from ekfslam.arrays import Array
from ekfslam.data.inputs import VelocityFrame


@dataclass(frozen=True)
class VelocitySamples:
    """Samples of body velocities.

    Args:
        source: File.
        time_s: (N,) increasing stamps.
        twist: (N, 6) ``[v; w]`` in ``velocity_frame``.
        velocity_frame: See `ekfslam.Sequence`.
        T_cam_imu: (4, 4) extrinsics of the recording that holds them; None for a text file.
        attributes: Attributes of that recording that concern velocities.
        notes: Findings, one sentence each.
    """

    source: str
    time_s: Array
    twist: Array
    velocity_frame: VelocityFrame
    T_cam_imu: Array | None
    attributes: dict[str, str | int | float]
    notes: tuple[str, ...]
