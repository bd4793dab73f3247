"""Configurations with every block in the state."""

from __future__ import annotations

import dataclasses

import numpy as np

PRIOR = {
    "landmark_coordinates": "xyz",
    "moving_sigma": 20.0,
    "initial_position_std_m": 0.1,
    "initial_rotation_std_rad": 0.05,
}
CALIBRATION = {"rotation_deg": 0.3, "lever_arm_m": 0.05, "baseline": 0.01, "disparity_px": 0.3, "time_s": 0.01}
BLOCKS = {"twist_bias": {}, "camera_jitter": {}, "vision_drift": {}}

EVERYTHING = {
    "twist_walk_std": np.repeat([0.3, 0.03], 3),
    "motion_std": np.repeat([0.02, 0.002], 3),
    "tilt_rad": 0.03,
    "track_first_px": np.array([0.5, 0.6, 1.0]),
    "track_walk_px": np.array([0.3, 0.35, 0.2]),
    "track_flow_px": 20.0,
}


def with_everything(world):
    """A world whose stated noise puts every state block into the state."""
    return dataclasses.replace(world, noise=dataclasses.replace(world.noise, **EVERYTHING))
