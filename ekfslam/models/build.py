"""State blocks for a sensor and its noise: the `Model` that filter and smoother share."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from collections.abc import Sequence as SequenceType
from typing import Any

from ekfslam.arrays import Array
from ekfslam.config import CalibrationConfig, FilterConfig, LandmarkCoordinates, require_setting
from ekfslam.data.inputs import InertialNoise
from ekfslam.data.noise import Noise
from ekfslam.errors import ConfigError
from ekfslam.geometry.camera import StereoCamera
from ekfslam.models.blocks import OPTIONAL_BLOCKS, Anchor, Calibration, Pose, PreviousView, StateBlock, Twist, Up, View
from ekfslam.models.blocks.calibration import prior_std
from ekfslam.models.blocks.imu_scale import ImuScale
from ekfslam.models.model import Model
from ekfslam.models.process import INERTIAL_BLOCKS, MakeProcess
from ekfslam.models.process.inertial import GRAVITY_M_S2, inertial
from ekfslam.models.process.velocities import velocities
from ekfslam.models.sensors.base import DelayedSensor, Sensor
from ekfslam.models.sensors.monocular import Monocular
from ekfslam.models.sensors.stereo import Rig


def model_of(
    sensor: Sensor,
    noise: Noise,
    T_imu_world: Array,
    covariance: Array,
    calibration: CalibrationConfig | None = None,
    blocks: SequenceType[StateBlock] = (),
    coordinates: LandmarkCoordinates = FilterConfig.landmark_coordinates,
    measures_twist: bool = True,
    make_process: MakeProcess = velocities,
) -> Model:
    """Return the model of a sensor, its noise and the calibration to estimate.

    Args:
        T_imu_world, covariance: (4, 4) first pose, and (6, 6) covariance of its error.
        calibration: Prior standard deviations of the calibration to estimate; None: it is not estimated.
        blocks: Further state blocks.
        coordinates: Coordinates of landmarks; ``image`` needs views in the state.
        measures_twist: Whether velocities are measured, see `Twist`.
        make_process: The process that moves the blocks; its own blocks besides the pose are among ``blocks``.
    """
    chosen: list[StateBlock] = [
        Pose(T_imu_world, covariance),
        *_blocks_of(sensor, noise, calibration or CalibrationConfig(), coordinates),
        *([Twist(noise.twist_walk_std, measures_twist)] if noise.twist_walk_std is not None else []),
        *([Up.of_first_pose(T_imu_world[:3, :3].T, noise)] if noise.tilt_rad else []),
        *([Anchor()] if isinstance(sensor, DelayedSensor) else []),
        *blocks,
    ]
    shared = [block for block in blocks if block.is_seen and block.per_frame]
    if shared and isinstance(sensor, DelayedSensor):
        raise ConfigError(f"{shared[0].name}: not with landmarks that wait for a second view")
    names = [block.name for block in chosen]
    if len(set(names)) < len(names):
        raise ConfigError(f"a state block is there twice: {', '.join(names)}")
    return Model(sensor, noise, tuple(chosen), make_process)


def _blocks_of(
    sensor: Sensor, noise: Noise, calibration: CalibrationConfig, coordinates: LandmarkCoordinates
) -> Iterator[StateBlock]:
    """Yield the blocks that observations of landmarks need: the views of two frames, and the calibration."""
    if noise.track_error is not None or has_image_coordinates(sensor, coordinates):
        yield View()
        yield PreviousView()
    std = prior_std(calibration)
    if std.any():
        if not isinstance(sensor, Rig):
            raise ConfigError(f"calibration: only a stereo rig has parameters to estimate, not {type(sensor).__name__}")
        yield Calibration(std)


def sensor_of(camera: StereoCamera, T_cam_imu: Array, noise: Noise) -> Rig | Monocular:
    """Return the sensor of a recording: a stereo rig, or one camera if there is no baseline."""
    return (Monocular if camera.is_monocular else Rig)(camera, T_cam_imu, noise)


def has_image_coordinates(sensor: Sensor, coordinates: LandmarkCoordinates) -> bool:
    """Return whether corrections act on landmarks in image coordinates, which only cameras have."""
    return coordinates == "image" and isinstance(sensor, Rig | Monocular)


def optional_blocks(
    settings: Mapping[str, Mapping[str, Any]], known_blocks: Mapping[str, type[StateBlock]] = OPTIONAL_BLOCKS
) -> tuple[StateBlock, ...]:
    """Return the blocks of the tables ``[blocks.<name>]`` of a configuration, given the classes by name."""
    chosen = []
    for name, values in settings.items():
        if name not in known_blocks:
            raise ConfigError(f"unknown block blocks.{name}; known: {', '.join(known_blocks)}")
        known = [field.name for field in dataclasses.fields(known_blocks[name])]  # type: ignore[arg-type]
        for key in values:
            if key not in known:
                raise ConfigError(f"unknown key blocks.{name}.{key}; known: {', '.join(known)}")
            require_setting(f"blocks.{name}.{key}", values[key], is_scale=key.startswith(("time", "length")))
        chosen.append(known_blocks[name](**values))
    return tuple(chosen)


def blocks_and_process(
    tables: Mapping[str, Mapping[str, Any]], densities: InertialNoise | None, gravity_m_s2: float = GRAVITY_M_S2
) -> tuple[tuple[StateBlock, ...], MakeProcess]:
    """Return the blocks of the tables ``[blocks.<name>]``, and the process: inertial if densities are given."""
    if densities is None:
        if ImuScale.name in tables:
            raise ConfigError(f"blocks.{ImuScale.name} needs inertial samples that move the state")
        return optional_blocks(tables), velocities
    tables = {name: {} for name in INERTIAL_BLOCKS} | dict(tables)
    return optional_blocks(tables, OPTIONAL_BLOCKS | INERTIAL_BLOCKS), inertial(densities, gravity_m_s2)
