"""Each kind of model is refused by the engine, or gives what the reference filter gives."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from support.compiled import assert_same_state

from ekfslam.config import Config, FilterConfig
from ekfslam.data.simulate import builtin
from ekfslam.engine import choice
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import run_filter
from ekfslam.models.build import model_of
from ekfslam.models.sensors.monocular import Monocular
from ekfslam.resolve import resolve

pytestmark = pytest.mark.skipif(bool(choice.MISSING), reason=f"engine: {choice.MISSING}")

VARIANTS, COORDINATES = ("invariant", "standard"), ("image", "xyz")
WALKING = {"track_first_px": np.array([0.5, 0.6, 1.0]), "track_walk_px": np.full(3, 0.3), "track_flow_px": 20.0}
CALIBRATIONS = {
    "none": {},
    "camera": {"rotation_deg": 0.3, "lever_arm_m": 0.05},
    "intrinsics": {"baseline": 0.01, "disparity_px": 0.3},
    "time": {"time_s": 0.01},
    "all": {"rotation_deg": 0.3, "lever_arm_m": 0.05, "baseline": 0.01, "disparity_px": 0.3, "time_s": 0.01},
}
BLOCKS = {"none": {}, "jitter": {"camera_jitter": {}}, "drift": {"vision_drift": {}, "camera_jitter": {}}}
PROCESSES = {"white": {}, "walking": {"twist_walk_std": np.repeat([0.3, 0.03], 3), "tilt_rad": 0.03}}
RIGS = list(itertools.product(VARIANTS, COORDINATES, (False, True), CALIBRATIONS, BLOCKS, PROCESSES))
EVERY_RIG = [pytest.param(*rig, marks=[] if at % 20 == 7 else [pytest.mark.slow]) for at, rig in enumerate(RIGS)]


def assert_refused_or_same(model, config, sequence):
    """Compare filters of a model frame by frame; a model that the engine refuses has a reason in words."""
    if reason := choice.obstacle(model, config):
        assert "landmarks in xyz" in reason
        return
    one, other = (JointEKF(model, dataclasses.replace(config, engine=name)) for name in ("engine", "reference"))
    for found, known in zip(run_filter(one, sequence), run_filter(other, sequence), strict=True):
        np.testing.assert_array_equal(found.report.reason, known.report.reason)
        assert_same_state(one, other, floor=1e-16)
    assert len(one.ids) > 3


@pytest.mark.parametrize(("variant", "coordinates", "walks", "calibration", "blocks", "process"), EVERY_RIG)
def test_a_stereo_rig(variant, coordinates, walks, calibration, blocks, process):
    world = builtin("city?frames=6&max_tracks=9&seed=4")
    changes = {**PROCESSES[process], **(WALKING if walks else {})}
    world = dataclasses.replace(world, noise=dataclasses.replace(world.noise, **changes))
    settings = {"filter": {"variant": variant, "landmark_coordinates": coordinates, "revive": -1}}
    settings |= {"calibration": CALIBRATIONS[calibration], "blocks": BLOCKS[blocks]}
    problem = resolve(world, Config().with_overrides(settings))
    assert_refused_or_same(problem.model, problem.config.filter, problem.sequence)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("coordinates", COORDINATES)
def test_one_camera(variant, coordinates):
    world = builtin("city?frames=16&outlier_fraction=0")
    sensor = Monocular(world.camera, world.T_cam_imu, world.noise, parallax_rad=np.deg2rad(0.5))
    config = FilterConfig(retire="unseen", variant=variant, landmark_coordinates=coordinates)
    T_imu_world, covariance = np.linalg.inv(world.initial_T_world_imu), config.initial_covariance
    model = model_of(sensor, world.noise, T_imu_world, covariance, coordinates=coordinates)
    assert_refused_or_same(model, config, world)


@pytest.mark.parametrize(
    ("variant", "coordinates", "blocks"),
    [
        ("invariant", "image", "none"),
        ("standard", "image", "jitter"),
        ("invariant", "image", "drift"),
        ("standard", "xyz", "none"),
        ("invariant", "xyz", "none"),
        ("invariant", "xyz", "jitter"),
    ],
)
def test_inertial_samples(variant, coordinates, blocks):
    settings = {"filter": {"variant": variant, "landmark_coordinates": coordinates, "revive": -1}}
    problem = resolve(builtin("room?frames=8"), Config().with_overrides(settings | {"blocks": BLOCKS[blocks]}))
    assert_refused_or_same(problem.model, problem.config.filter, problem.sequence)
