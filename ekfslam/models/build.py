"""From a recording and a configuration to the problem that the estimators solve: one place decides what is believed.

`build` resolves what is automatic, cleans the tracks, and chooses noise, sensor and state blocks. `ekfslam info` prints
what it chose.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from collections.abc import Sequence as SequenceType
from dataclasses import dataclass
from typing import Any

import numpy as np

from ekfslam.arrays import Array
from ekfslam.config import (
    LEAST_PX,
    CalibrationConfig,
    Config,
    CovarianceForm,
    FilterConfig,
    LandmarkCoordinates,
    require_setting,
)
from ekfslam.data.hygiene import HygieneReport, clean_tracks
from ekfslam.data.noise import Noise
from ekfslam.data.sequence import WITHOUT_TRACKS, Sequence
from ekfslam.errors import ConfigError
from ekfslam.geometry import se3
from ekfslam.models.blocks import (
    OPTIONAL_BLOCKS,
    Anchor,
    Calibration,
    Pose,
    Previous,
    PreviousPose,
    StateBlock,
    Twist,
    Up,
)
from ekfslam.models.blocks.calibration import prior_std
from ekfslam.models.form import is_conditional_cheaper
from ekfslam.models.model import Model
from ekfslam.models.noise import (
    CAMERA_ROTATION_DEG,
    MIN_DISPARITY_SIGMA,
    VelocityNoise,
    automatic_noise,
    shared_errors,
    velocity_noise,
    with_drift,
)
from ekfslam.models.odometry import vision_noise, with_odometry
from ekfslam.models.process import MakeProcess, velocities
from ekfslam.models.sensors.base import DelayedSensor, Sensor
from ekfslam.models.sensors.monocular import Monocular
from ekfslam.models.sensors.stereo import Rig

# How many landmarks "auto" keeps in the state when landmarks come back: their covariance takes 160 MB.
DORMANT_LIMIT = 1500


@dataclass(frozen=True)
class Problem:
    """Everything that an estimator needs.

    Args:
        sequence: The recording with cleaned tracks.
        config: Resolved configuration.
        model: State blocks, sensor, noise.
        hygiene: What was done to the tracks; None: they were not looked at.
        account: Attributes for a result that say where the noise comes from.
    """

    sequence: Sequence
    config: Config
    model: Model
    hygiene: HygieneReport | None
    account: Mapping[str, str | int | float]

    @property
    def lines(self) -> tuple[str, ...]:
        """What is believed, one line each."""
        model, settings = self.model, self.config.filter
        blocks = ", ".join(f"{block.name} ({block.size})" for block in model.layout.blocks)
        error = model.track_error
        tracks = "pixel errors are white"
        if error is not None:
            first, walk = (", ".join(f"{value:.2g}" for value in std) for std in (error.first_std, error.walk_std))
            tracks = f"errors of tracks (u, v, disparity) start with {first} px and walk by {walk} px a frame"
        back = "no landmark leaves the state"
        if settings.retire != "never":
            revived = "come back exactly" if settings.revive >= 0 else "start afresh when seen again"
            back = f"landmarks leave {settings.retire_after} frames after they were seen last, and {revived}"
        return f"{blocks}, 3 for each landmark", tracks, back


def build(
    sequence: Sequence, config: Config | None = None, blocks: SequenceType[StateBlock] = (), clean: bool = True
) -> Problem:
    """The problem of a recording.

    Args:
        sequence: The recording.
        config: Settings; defaults where None.
        blocks: State blocks besides those that configuration and noise ask for.
        clean: Whether to clean the tracks, see `ekfslam.data.hygiene`.

    Raises:
        ConfigError: An unknown block, or a setting that it does not have.
    """
    if not sequence.has_velocities:
        sequence = with_odometry(sequence)
    config = with_automatic_blocks(resolve(config or Config(), sequence), sequence)
    noise, account = noise_of(sequence, config), noise_account(sequence, config)
    hygiene = None
    if clean:
        _require_pixel_noise(sequence, noise)
        observations, hygiene = clean_tracks(sequence, noise, config.hygiene)
        attributes = sequence.attributes if len(observations) else {**sequence.attributes, **WITHOUT_TRACKS}
        sequence = dataclasses.replace(sequence, observations=observations, attributes=attributes)
    model = model_of(
        Rig(sequence.camera, sequence.T_cam_imu, noise),
        noise,
        se3.inverse(sequence.initial_T_world_imu),
        config.filter.initial_covariance,
        config.calibration,
        (*optional_blocks(config.blocks), *blocks),
        config.filter.landmark_coordinates,
        sequence.has_velocities,
    )
    config = _with_form(config, sequence, model)
    return Problem(sequence, config, model, hygiene, account)


def _require_pixel_noise(sequence: Sequence, noise: Noise) -> None:
    least = float(np.min(noise.pixel_std_px))
    if least < LEAST_PX:
        raise ConfigError(
            f"{sequence.name}: the recording states a pixel noise of {least:g} px, with which innovation "
            f"covariances are singular; give noise.sigma_px, at least {LEAST_PX:g}"
        )


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
    """The state blocks that a sensor and its noise ask for: which there are, is decided here and nowhere else.

    Args:
        sensor: Of landmarks.
        noise: Of velocities and tracks.
        T_imu_world, covariance: (4, 4) first pose and (6, 6) of its error.
        calibration: What of the sensor's calibration is estimated; None: nothing.
        blocks: Further ones.
        coordinates: Of landmarks: those in the last updated camera need its pose.
        measures_twist: Whether velocities are measured at all, see `Twist`.
        make_process: The process that moves the blocks; its own blocks besides the pose are among ``blocks``.

    Raises:
        ConfigError: A calibration to estimate, but no stereo rig; a block twice; or one that the sensor has no use for.
    """
    chosen: list[StateBlock] = [Pose(T_imu_world, covariance)]
    if noise.track_error is not None or has_image_coordinates(sensor, coordinates):
        chosen.append(PreviousPose())
    std = prior_std(calibration or CalibrationConfig())
    if std.any():
        if not isinstance(sensor, Rig):
            raise ConfigError(f"calibration: only a stereo rig has parameters to estimate, not {type(sensor).__name__}")
        chosen.append(Calibration(std))
    if noise.twist_walk_std is not None:
        chosen.append(Twist(noise.twist_walk_std, measures_twist))
    if noise.tilt_rad:
        chosen.append(Up(T_imu_world[:3, :3].T @ np.array([0.0, 0.0, 1.0]), noise.tilt_rad))
    if isinstance(sensor, DelayedSensor):
        chosen.append(Anchor())
    chosen.extend(blocks)
    shared = [block for block in blocks if block.is_seen and block.per_frame]
    if shared and isinstance(sensor, DelayedSensor):
        raise ConfigError(f"{shared[0].name}: not with landmarks that wait for a second view")
    if noise.track_error is not None:
        chosen.extend(Previous(block) for block in shared if _is_seen_before(block))
    names = [block.name for block in chosen]
    if len(set(names)) < len(names):
        raise ConfigError(f"a state block is there twice: {', '.join(names)}")
    return Model(sensor, noise, tuple(chosen), make_process)


def _is_seen_before(block: StateBlock) -> bool:
    """Whether the view from the frame before depends on a block, and not only what is new in this frame."""
    share = block.camera_share(np.ones(()), np.zeros((), dtype=bool))
    return share is None or bool(share != 0)


def has_image_coordinates(sensor: Sensor, coordinates: LandmarkCoordinates) -> bool:
    """Whether corrections act on landmarks as images: only cameras have any."""
    return coordinates == "image" and isinstance(sensor, Rig | Monocular)


def optional_blocks(settings: Mapping[str, Mapping[str, Any]]) -> tuple[StateBlock, ...]:
    """Blocks that the tables ``[blocks.<name>]`` of a configuration put into the state.

    Raises:
        ConfigError: An unknown block, or a setting that it does not have.
    """
    chosen = []
    for name, values in settings.items():
        if name not in OPTIONAL_BLOCKS:
            raise ConfigError(f"unknown block blocks.{name}; known: {', '.join(OPTIONAL_BLOCKS)}")
        known = [field.name for field in dataclasses.fields(OPTIONAL_BLOCKS[name])]  # type: ignore[arg-type]
        for key in values:
            if key not in known:
                raise ConfigError(f"unknown key blocks.{name}.{key}; known: {', '.join(known)}")
            require_setting(f"blocks.{name}.{key}", values[key], is_scale=key.startswith(("time", "length")))
        chosen.append(OPTIONAL_BLOCKS[name](**values))
    return tuple(chosen)


def resolve(config: Config, sequence: Sequence) -> Config:
    """A configuration with what is automatic decided for a sequence; noise is decided by `noise_of`."""
    retire, retire_after = config.filter.retire, config.filter.retire_after
    come_back = _landmarks_come_back(sequence)
    if retire == "auto":
        retire = "never" if come_back and len(sequence.observations.ids) <= DORMANT_LIMIT else "unseen"
    if retire_after is None:
        retire_after = 10 if come_back else 1
    dormant = config.filter.dormant
    if dormant is None:
        dormant = DORMANT_LIMIT if come_back and config.filter.retire == "auto" else 0
    settings = dataclasses.replace(config.filter, retire=retire, retire_after=retire_after, dormant=dormant)
    return dataclasses.replace(config, filter=settings)


def _with_form(config: Config, sequence: Sequence, model: Model) -> Config:
    """A configuration with the form of the covariance decided."""
    settings, layout = config.filter, model.layout
    if settings.covariance_form != "auto":
        return config
    # What has a clone stays for a frame: as its clone.
    moving = (block for block in layout.blocks if block.is_seen and (block.per_frame or block.clones))
    group = sum(block.size for block in moving if block.name not in layout.clones)
    kept = len(sequence.observations.ids) if settings.retire == "never" else settings.dormant or 0
    stay = settings.retire_after or 1
    cheaper = is_conditional_cheaper(sequence.observations, len(sequence), layout.body, group, stay, kept)
    form: CovarianceForm = "conditional" if cheaper else "dense"
    return dataclasses.replace(config, filter=dataclasses.replace(settings, covariance_form=form))


def noise_of(sequence: Sequence, config: Config) -> Noise:
    """The noise a filter shall assume: what the configuration says, else the sequence, else the data or a default."""
    given = config.noise
    if is_automatic(sequence, config):
        stated = automatic_noise(sequence.twist, sequence.velocity_frame, sequence.has_checked_tracks)
    else:
        stated = sequence.noise or Noise.isotropic(0.05, 0.001, 1.0)
    if not sequence.has_velocities:
        stated = vision_noise(stated, sequence.twist)
    twist, pixels = np.array(stated.twist_std, dtype=float), np.array(stated.pixel_std_px, dtype=float)
    if given.sigma_v_m_s is not None:
        twist[:3] = given.sigma_v_m_s
    if given.sigma_w_rad_s is not None:
        twist[3:] = given.sigma_w_rad_s
    if given.sigma_px is not None:
        pixels[:] = given.sigma_px
    if given.track_scale is not None and stated.track_walk_px is not None:
        stated = dataclasses.replace(stated, track_walk_px=given.track_scale * stated.track_walk_px)
    tilt = stated.tilt_rad if given.tilt_deg is None else float(np.deg2rad(given.tilt_deg))
    noise = dataclasses.replace(stated, twist_std=twist, pixel_std_px=pixels, tilt_rad=tilt)
    return noise if given.drift is None else with_drift(noise, given.drift)


def with_automatic_blocks(config: Config, sequence: Sequence) -> Config:
    """A configuration with the blocks and the calibration of the automatic model, where that is what is asked for.

    What the configuration says of a block goes before.
    """
    walks = noise_of(sequence, config).track_error is not None
    if not (is_automatic(sequence, config) and (walks or sequence.has_checked_tracks)):
        return config
    if walks and config.hygiene.min_disparity_sigma is None:
        hygiene = dataclasses.replace(config.hygiene, min_disparity_sigma=MIN_DISPARITY_SIGMA)
        config = dataclasses.replace(config, hygiene=hygiene)
    if not config.noise.shared:
        return config
    tables = shared_errors(sequence.twist if sequence.has_velocities else None, sequence.has_checked_tracks)
    shared = {name: {**table, **config.blocks.get(name, {})} for name, table in tables.items()}
    calibration = config.calibration
    # Without velocities nothing tells the camera's rotation against the IMU.
    if calibration.rotation_deg is None and sequence.has_velocities:
        calibration = dataclasses.replace(calibration, rotation_deg=CAMERA_ROTATION_DEG)
    return dataclasses.replace(config, blocks={**config.blocks, **shared}, calibration=calibration)


def is_automatic(sequence: Sequence, config: Config) -> bool:
    """Whether the model of the noise is that of `ekfslam.models.noise`, found from the data; see `NoiseConfig`."""
    noise = config.noise
    given = (noise.sigma_v_m_s, noise.sigma_w_rad_s, noise.sigma_px)
    is_asked_for = noise.model == "tuned" or (noise.model == "auto" and all(sigma is None for sigma in given))
    return sequence.noise is None and is_asked_for


def noise_account(sequence: Sequence, config: Config) -> dict[str, str | int | float]:
    """Attributes for a result that say where its noise comes from.

    ``found_*``: what the differences of the velocities say, with standard errors and limits, where the noise is
    automatic; ``tuned_*``: the record of tuning, if there is one.
    """
    account = found_attributes(velocity_noise(sequence.twist)) if is_automatic(sequence, config) else {}
    return {**account, **{f"tuned_{key}": value for key, value in config.tuning.items()}}


def found_attributes(found: VelocityNoise) -> dict[str, float]:
    """White noise of velocities, its standard errors and 95 % limits by name, the units in the names."""
    values: dict[str, float] = {}
    for i, name in enumerate(("sigma_v_m_s", "sigma_w_rad_s")):
        values[f"found_{name}"], values[f"found_{name}_error"] = float(found.sigma[i]), float(found.sigma_error[i])
        values[f"found_{name}_limit"] = float(found.limit[i])
    return values


def _landmarks_come_back(sequence: Sequence) -> bool:
    observations = sequence.observations
    order = np.lexsort((observations.frame, observations.landmark))
    same = np.diff(observations.landmark[order]) == 0
    return bool((same & (np.diff(observations.frame[order]) > 1)).any())
