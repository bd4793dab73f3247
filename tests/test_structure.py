"""The structure of errors and their sizes from innovations: what is put in is found, and honest where it is used."""

import dataclasses

import numpy as np
import pytest
from helpers import run_joint

from ekfslam.config import Config, FilterConfig
from ekfslam.data.sequence import Observations
from ekfslam.data.simulate import Loop, simulate
from ekfslam.errors import ConfigError, EmptyTracksError, InnovationError
from ekfslam.evaluation.consistency import nees, pose_error
from ekfslam.geometry import camera, se3
from ekfslam.models.build import build
from ekfslam.studies import structure
from ekfslam.studies.structure import Candidate, choose, highest, stated_candidates, value_at, with_value

JITTER_M, JITTER_DEG, TIME_S, WHITE_PX = 0.03, 0.4, 0.4, 0.8
FRAMES = 150
BLOCK = "blocks.camera_jitter."
CONFIG = Config(filter=FilterConfig(gate_probability=1.0, split_after=0, retire="never", revive=-1))
WHITE = Candidate("white", {"noise": {"sigma_px": 2.0}}, (), "noise.sigma_px")
SHARED = Candidate(
    "jitter",
    {"noise": {"sigma_px": 2.0}, "blocks": {"camera_jitter": {"rotation_deg": 0.15, "translation_m": 0.01}}},
    (BLOCK + "rotation_deg", BLOCK + "translation_m"),
    "noise.sigma_px",
)


def world(seed: int, jitter: bool = True, frames: int = FRAMES):
    """A loop whose camera is moved against the IMU, by errors that a Gauss-Markov process draws here."""
    made = Loop(frames=frames, landmarks=25, seed=seed, sigma_v_m_s=0.1, sigma_w_rad_s=0.01, sigma_px=WHITE_PX)
    sequence = simulate(made)
    if not jitter:
        return sequence
    rng, truth, seen = np.random.default_rng(1000 + seed), sequence.truth, sequence.observations
    std = np.repeat([JITTER_M, np.deg2rad(JITTER_DEG)], 3)
    n = np.empty((frames, 6))
    n[0] = std * rng.standard_normal(6)
    for k in range(1, frames):
        phi = np.exp(-(sequence.time_s[k] - sequence.time_s[k - 1]) / TIME_S)
        n[k] = phi * n[k - 1] + std * np.sqrt(1 - phi**2) * rng.standard_normal(6)
    where = {i: row for row, i in enumerate(truth.landmark.tolist())}
    m = truth.position_m[[where[i] for i in seen.landmark.tolist()]]
    T_imu_world = se3.inverse(np.concatenate([[np.eye(4)], truth.T_world_imu])[-frames:])
    q = se3.apply(sequence.T_cam_imu @ (se3.exp(n) @ T_imu_world)[seen.frame], m)
    pixels = camera.project(sequence.camera, q) + WHITE_PX * rng.standard_normal((len(q), 4))
    return dataclasses.replace(sequence, observations=Observations(seen.frame, seen.landmark, pixels))


def pose_nees_at_end(sequence, overrides) -> float:
    problem = build(sequence, CONFIG.with_overrides(overrides), clean=False)
    ekf, _, _ = run_joint(sequence, problem.model, problem.config.filter)
    return float(nees(pose_error(ekf.T_world_imu, sequence.truth.T_world_imu[-1]), ekf.P[:6, :6]))
