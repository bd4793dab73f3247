"""The noise of a recording's truth as a configuration has it."""

from __future__ import annotations

import dataclasses
import math

from ekfslam.config import TruthConfig
from ekfslam.data.sequence import Sequence
from ekfslam.data.truth_noise import TruthNoise


def with_truth_noise(sequence: Sequence, settings: TruthConfig) -> Sequence:
    """Return the recording with the truth noise of the settings; open settings keep the noise of the format."""
    asked = {
        "first_roll_rad": _radians(settings.roll_deg),
        "first_pitch_rad": _radians(settings.pitch_deg),
        "first_yaw_rad": _radians(settings.yaw_deg),
        "first_position_m": settings.first_position_m,
        "stamp_s": settings.stamp_s,
        "position_m": settings.position_m,
        "attitude_rad": _radians(settings.attitude_deg),
    }
    given = {name: value for name, value in asked.items() if value is not None}
    if sequence.truth is None or not given:
        return sequence
    noise = dataclasses.replace(sequence.truth.noise or TruthNoise(), **given)
    return dataclasses.replace(sequence, truth=dataclasses.replace(sequence.truth, noise=noise))


def _radians(degrees: float | None) -> float | None:
    return None if degrees is None else math.radians(degrees)
