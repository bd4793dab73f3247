"""The truth that a run is compared with: its noise as a configuration has it, its frames those of the run."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from ekfslam.arrays import BoolArray
from ekfslam.config import TruthConfig
from ekfslam.data.interpolation import stretches_of
from ekfslam.data.observations import TrueMotion, Truth
from ekfslam.data.sequence import Sequence
from ekfslam.data.truth_noise import TruthNoise
from ekfslam.filters.result import OTHER_MISSING, Result


def with_truth_noise(sequence: Sequence, settings: TruthConfig) -> Sequence:
    """Return the recording with the truth noise of the settings; settings that are None keep that of the format."""
    angles_deg = {
        "first_roll_rad": settings.roll_deg,
        "first_pitch_rad": settings.pitch_deg,
        "first_yaw_rad": settings.yaw_deg,
        "attitude_rad": settings.attitude_deg,
        "world_tilt_rad": settings.world_tilt_deg,
        "turn_rad": settings.turn_deg,
    }
    given = {name: math.radians(angle) for name, angle in angles_deg.items() if angle is not None}
    names = ("first_position_m", "stamp_s", "position_m", "drift_m_sqrt_s", "scale")
    others = {name: getattr(settings, name) for name in names}
    given |= {name: value for name, value in others.items() if value is not None}
    if sequence.truth is None or not given:
        return sequence
    noise = dataclasses.replace(sequence.truth.noise or TruthNoise(), **given)
    return dataclasses.replace(sequence, truth=dataclasses.replace(sequence.truth, noise=noise))


def without_pose(result: Result) -> BoolArray:
    """Return the frames (T,) without an estimate: none, but for the gaps of another program."""
    missing = stretches_of(str(result.attributes.get(OTHER_MISSING, "")), len(result.time_s))
    return np.zeros(len(result.time_s), dtype=bool) if missing is None else missing


def estimated(result: Result, truth: Truth) -> Truth:
    """Return the true poses of frames that have an estimate."""
    missing = without_pose(result)
    if not missing[truth.frame].any():
        return truth
    kept = ~missing[truth.frame]
    motion = truth.motion and TrueMotion(*(value[kept] for value in vars(truth.motion).values()))
    frame, T_world_imu = truth.frame[kept], truth.T_world_imu[kept]
    return dataclasses.replace(truth, frame=frame, T_world_imu=T_world_imu, motion=motion)
