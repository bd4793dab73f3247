"""Resolve everything automatic: from a recording and a configuration to the problem that the estimators solve.

`resolve` decides in one order, and no module below it decides anything:

1. Velocities: beside inertial samples, they measure the velocity in the state (`Problem.beside`). Stereo odometry if
   the recording has none, also for linear or angular ones that were never filled in.
2. Landmarks: when they leave the state, and how many dormant ones stay (`settings_of`).
3. Noise: the configuration, else the recording, else what the data show (`noise_of`): white errors of tracks where
   residuals along tracks show them (`ekfslam.models.track_noise`), else errors that walk.
4. Automatic model: blocks of shared errors, calibration, least disparity (`settings_of`).
5. Tracks: cleaned by `ekfslam.data.hygiene`.
6. Noise and first state of an inertial unit, see `with_densities` and `first_state`.
7. Scale of the walk of track errors, from innovations of short stretches of the recording.

`ekfslam info` prints the outcome. A resolved configuration resolves to itself.

**Track scale.** From one frame to the next the scale of track errors is right if the normalised innovation squared
(NIS) per degree of freedom is `TARGET`. But the errors persist along tracks: over many frames they add up to
`PERSISTENCE` times as much. Clean velocities bridge the low frequencies, so the scale of a frame is taken; otherwise
vision carries them, and the scale is `PERSISTENCE`. NIS falls with the scale by a power of about ``1 / _EXPONENT``, so
one round suffices. Estimates from stretches of 8 frames in every 60 agree with those of the whole drive within 13 % on
ten recordings, in an eighth of the filter's time.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from collections.abc import Sequence as SequenceType
from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.config import LEAST_PX, BlockSetting, Config, Mode
from ekfslam.data.checks import require_scale
from ekfslam.data.hygiene import HygieneReport, clean_tracks
from ekfslam.data.inputs import InertialNoise, InertialSamples, Velocities
from ekfslam.data.interpolation import INTERPOLATED
from ekfslam.data.noise import Noise
from ekfslam.data.sequence import MEASURED_KINDS, TWIST_STD, WITHOUT_TRACKS, WITHOUT_VELOCITIES, YAW_STD_PX, Sequence
from ekfslam.engine.choice import in_words
from ekfslam.errors import ConfigError, InnovationError, ScaleError
from ekfslam.filters.loop import one_thread
from ekfslam.filters.result import UNUSED
from ekfslam.filters.stretches import run_stretches, stretches_of, thinned
from ekfslam.geometry import se3
from ekfslam.inertial.motion import in_motion
from ekfslam.inertial.noise import Densities, from_differences, is_refuted, likeliest_densities
from ekfslam.models.blocks import OPTIONAL_BLOCKS, StateBlock, TwistBias
from ekfslam.models.build import blocks_and_process, model_of, sensor_of
from ekfslam.models.inertial_start import FirstPrior, InertialStart, at_rest, rest_of, unknown
from ekfslam.models.model import Model
from ekfslam.models.noise import (
    CAMERA_ROTATION_DEG,
    MIN_DISPARITY_SIGMA,
    VELOCITY_STD,
    VelocityNoise,
    automatic_noise,
    shared_errors,
    velocity_noise,
    with_drift,
)
from ekfslam.models.odometry import missing_velocities, stereo_odometry, vision_noise, with_vision
from ekfslam.models.sensors.velocities import AXES, VelocitySource
from ekfslam.models.tilt import first_tilt
from ekfslam.models.track_noise import track_noise
from ekfslam.models.vehicle import odometry_text, slow_slip, with_vehicle

# Number of dormant landmarks kept in the state of a recording whose landmarks come back: their covariance has 160 MB.
DORMANT_LIMIT = 1500
# Frames for which a landmark of a recording whose landmarks come back stays in the state without being seen.
COME_BACK_AFTER = 10
# Relinearised window of a recording without velocities, frames; share of frames up to which landmarks may return there.
VISION_LAG, MOST_RETURNS = 10, 0.1
# Second-order error of a prediction, in standard deviations of a pixel, from which a window is worth its time.
CURVED = 0.1
# Square root of the long-run variance of errors along KLT tracks over that of a frame, as `ekfslam check` finds it.
PERSISTENCE = 3.0
# NIS per degree of freedom: below 1, since errors persist.
TARGET = 0.7
_EXPONENT, _LEAST_DOF, _SCALES = 0.83, 100, (0.3, 4.0)
_STRETCH, _EVERY, _MOST_STRETCHES = 8, 60, 25  # frames, frames, count
# Sampling noise: factors that are tried, stretches (frames, count), tracks in each, and how clear the gain must be. A
# logarithm of 20 is four times what Jeffreys calls decisive, because the model of tracks is approximate.
_SAMPLING = ("sampling_v", "sampling_w")
_FACTORS, _SAMPLING_STRETCHES, _SAMPLING_TRACKS = (0.0, 1.0, 2.0, 4.0), (10, 5), 25
_SURE, _LEAST_GAIN = 3.0, 20.0  # standard errors


_ADVICE = "begin at rest (half a second) or where it accelerates, or give both cameras"
_DENSITIES = tuple(field.name for field in dataclasses.fields(InertialNoise))


@dataclass(frozen=True)
class Problem:
    """Everything that an estimator needs."""

    sequence: Sequence  # recording with cleaned tracks
    config: Config
    model: Model
    hygiene: HygieneReport | None  # report of cleaning; None: tracks were not cleaned
    account: Mapping[str, str | int | float]  # attributes of a result that say where the noise comes from
    # Velocities that are measured beside inertial samples, such as those of wheels; None if there are none.
    beside: VelocitySource | None = None

    @property
    def lines(self) -> tuple[str, ...]:
        """The model in words, one line for each part."""
        model, settings = self.model, self.config.filter
        blocks = ", ".join(f"{block.name} ({block.size})" for block in model.layout.blocks)
        error = model.track_error
        tracks = f"pixel errors are white, {np.mean(model.noise.pixel_std_px):.3g} px"
        if error is not None:
            first, walk = (", ".join(f"{value:.2g}" for value in std) for std in (error.first_std, error.walk_std))
            tracks = f"errors of tracks (u, v, disparity) start with {first} px and walk by {walk} px a frame"
        back = "no landmark leaves the state"
        if settings.retire != "never":
            revived = "come back exactly" if settings.revive >= 0 else "start again when seen again"
            back = f"landmarks leave {settings.retire_after} frames after they were seen last, and {revived}"
        return f"{blocks}, 3 for each landmark", tracks, back

    @property
    def decisions(self) -> tuple[str, ...]:
        """The resolved values of settings that may be automatic, one line for each table."""
        config = self.config
        chosen = {
            "noise": ("sigma_px", "drift", "track_scale", *_SAMPLING),
            "filter": ("lag", "retire", "retire_after", "dormant"),
            "hygiene": ("min_disparity_sigma",),
            "calibration": ("rotation_deg", "disparity_px"),
            "inertial": _DENSITIES,
        }
        tables = {name: {key: getattr(getattr(config, name), key) for key in keys} for name, keys in chosen.items()}
        tables |= {f"blocks.{name}": dict(settings) for name, settings in config.blocks.items()}
        return tuple(f"{name}: {line}" for name, table in tables.items() if (line := _settings(table)))


@one_thread()
def resolve(
    sequence: Sequence, config: Config | None = None, mode: Mode = "full", blocks: SequenceType[StateBlock] = ()
) -> Problem:
    """Return the problem of a recording.

    Dead reckoning needs no clean tracks; only the joint filter needs the track scale. ``blocks`` are state blocks in
    addition to those of the configuration and the automatic model.
    """
    config = config or Config()
    if mode in ("full", "smoothed") and (apart := _apart(sequence, config)) is not None:
        return apart.added_to(resolve(apart.sequence, apart.config, mode, blocks))
    sequence = recording = sequence.once(with_odometry)
    account: dict[str, str | int | float] = {f"tuned_{key}": value for key, value in config.tuning.items()}
    if mode != "dead-reckoning" and _has_open_scale(sequence, config) and (tracks := sequence.once(track_noise)):
        account["found_tracks"] = tracks.text
        if tracks.is_white:
            white = {"model": "tuned", "sigma_px": tracks.sigma_px, "drift": 0.0}
            config = config.with_overrides({"noise": white})
    given, config = config, settings_of(sequence, config)
    noise, hygiene = noise_of(sequence, config), None
    if text := odometry_text(sequence.measured_axes, noise.twist_std):
        account["odometry"] = text
    if mode in ("full", "smoothed") and sequence.inertial is not None and not is_inertial(sequence):
        account[UNUSED] = "inertial samples are not used: velocities over level ground take precedence over them"
    if is_automatic(sequence, config):
        account |= found_attributes(noise_of_velocities(sequence))
    if mode != "dead-reckoning":
        sequence, hygiene = _cleaned(sequence, config, noise)
    if is_inertial(sequence):
        config, text = _with_inertial_noise(sequence, config, mode in ("full", "smoothed"))
        noise = noise_of(sequence, config)
        account |= {"inertial_noise": text, **{f"inertial_{key}": x for key, x in vars(densities_of(config)).items()}}
    model = _model(sequence, config, noise, blocks)
    if is_inertial(sequence):
        model, account["inertial_start"] = (start := first_state(sequence, config, model)).begun(model), start.text
    if mode in ("full", "smoothed"):
        account["engine"] = in_words(model, config.filter)
        if (sampling := _sampling(sequence, config)) is not None:
            # Other settings follow from it.
            again = resolve(recording, given.with_overrides({"noise": sampling}), mode, blocks)
            return dataclasses.replace(again, account={**account, **again.account})
        if _has_open_scale(sequence, config):
            scale = _track_scale(sequence, config, model)
            config = config.with_overrides({"noise": {"track_scale": scale}})
            model = _model(sequence, config, noise_of(sequence, config), blocks)
    return Problem(sequence, config, model, hygiene, account)


def _cleaned(sequence: Sequence, config: Config, noise: Noise) -> tuple[Sequence, HygieneReport]:
    """Return the recording with clean tracks."""
    if (least := float(np.min(noise.pixel_std_px))) < LEAST_PX:
        raise ConfigError(
            f"{sequence.name}: the recording states a pixel noise of {least:g} px, with which innovation covariances "
            f"are singular; give noise.sigma_px, at least {LEAST_PX:g}"
        )
    observations, hygiene = sequence.once(clean_tracks, _in_the_long_run(sequence, config, noise), config.hygiene)
    attributes = sequence.attributes if len(observations) else {**sequence.attributes, **WITHOUT_TRACKS}
    return dataclasses.replace(sequence, observations=observations, attributes=attributes), hygiene


@dataclass(frozen=True)
class _Apart:
    """A recording without its velocities, and these as a source that measures the velocity in the state."""

    sequence: Sequence
    config: Config
    source: VelocitySource | None  # None: angular velocities alone

    def added_to(self, problem: Problem) -> Problem:
        """Return the problem of the recording alone with the source, and its noise in words."""
        if self.source is None:
            return problem
        std = ", ".join(f"{axis} {std:.3g}" for axis, std in zip(self.source.axes, self.source.std, strict=True))
        account = {**problem.account, "beside": f"velocities are measured beside inertial samples: {std} m/s"}
        return dataclasses.replace(problem, beside=self.source, account=account)


def _apart(sequence: Sequence, config: Config) -> _Apart | None:
    """Return a recording of inertial samples and velocities apart; None if it has not both.

    Only linear velocities in the IMU frame are used: the gyroscope knows the angular ones better. They have the noise
    that they have without samples, and their slow bias as a block. Interpolated ones are left out.
    """
    axes = np.flatnonzero(sequence.measured_axes[:3])
    if sequence.inertial is None or not sequence.has_velocities or sequence.velocity_frame != "imu":
        return None
    if not len(axes):
        return _Apart(sequence.once(_without_velocities), config, None)
    wheels = sequence.once(_without_samples)
    std, found = noise_of(wheels, config).velocity_std[axes], noise_of_velocities(wheels, config)
    std = np.where(std > 0, std, automatic_noise(found).velocity_std[axes])
    if is_automatic(wheels, config) and config.noise.shared:
        bias = TwistBias.automatic(found.sigma, found.is_clean, False) or {}
        tables = {TwistBias.name: {**bias, **config.blocks.get(TwistBias.name, {})}}
        config = dataclasses.replace(config, blocks={**config.blocks, **tables})
    known = 1 + np.flatnonzero(~wheels.interpolated[1:])
    source = VelocitySource(
        wheels.time_s[known], tuple(AXES[axis] for axis in axes), wheels.twist[np.ix_(known, axes)], std, True
    )
    return _Apart(sequence.once(_without_velocities), config, source)


def _without_samples(sequence: Sequence) -> Sequence:
    inputs = tuple(each for each in sequence.inputs if isinstance(each, Velocities))
    return dataclasses.replace(sequence, inputs=inputs)


def _without_velocities(sequence: Sequence) -> Sequence:
    inputs = tuple(each for each in sequence.inputs if isinstance(each, InertialSamples))
    attributes = {**sequence.attributes, **WITHOUT_VELOCITIES}
    attributes.pop(TWIST_STD, None)
    attributes.pop(INTERPOLATED, None)
    return dataclasses.replace(sequence, inputs=inputs, attributes=attributes)


def with_odometry(sequence: Sequence) -> Sequence:
    """Return the recording with stereo odometry in place of velocities that were not measured or never filled in."""
    if sequence.camera.is_monocular:
        require_scale(sequence.name, sequence.inertial is not None or bool(sequence.measured_axes[:3].any()))
        return sequence
    measured = sequence.measured_axes.reshape(2, 3).any(axis=1)
    if measured.all() or sequence.attributes.get("velocities") in MEASURED_KINDS:
        return sequence
    found = stereo_odometry(sequence)
    if not measured.any():
        without = {**sequence.attributes, **WITHOUT_VELOCITIES}
        return dataclasses.replace(sequence, attributes=without).with_velocities(found, "imu")
    if not missing_velocities(sequence, found):
        return sequence
    kind = MEASURED_KINDS[int(np.argmax(measured))]
    twist = np.where(np.repeat(measured, 3), sequence.twist, found)
    return dataclasses.replace(sequence, attributes={**sequence.attributes, "velocities": kind}).with_velocities(twist)


def noise_of_velocities(sequence: Sequence, config: Config | None = None) -> VelocityNoise:
    """Return the noise of the measured velocities, as their differences and `NoiseConfig.sampling_v` say, or stated."""
    found = velocity_noise(sequence.twist, sequence.measured_axes, sequence.stated_twist_std)
    noise = (config or Config()).noise
    factors = [1.0 if factor is None else factor for factor in (noise.sampling_v, noise.sampling_w)]
    return found if factors == [1.0, 1.0] else found.scaled(factors)


def settings_of(sequence: Sequence, config: Config) -> Config:
    """Return a configuration with every automatic setting resolved that depends on the recording alone, but its noise.

    Explicit settings take precedence.
    """
    config = _with_retirement(sequence, config)
    if sequence.has_checked_tracks and config.filter.split_after is None:
        # They do not jump to another point: a new landmark would let a moving one in again.
        config = config.with_overrides({"filter": {"split_after": config.filter.misses_to_split(tracks_walk=False)}})
    walks, is_white = noise_of(sequence, config).track_error is not None, _is_white(sequence, config)
    if not (is_automatic(sequence, config) and (walks or is_white)):
        return config
    if walks and config.hygiene.min_disparity_sigma is None:
        config = config.with_overrides({"hygiene": {"min_disparity_sigma": MIN_DISPARITY_SIGMA}})
    if not config.noise.shared:
        return config
    found = noise_of_velocities(sequence, config) if sequence.has_velocities else None
    # Without velocities nothing observes the camera's rotation against the IMU, nor do noisy ones beside white tracks.
    is_observed = found is not None and (found.is_clean or not is_white) and not sequence.camera.is_monocular
    if config.calibration.rotation_deg is None and is_observed:
        config = config.with_overrides({"calibration": {"rotation_deg": CAMERA_ROTATION_DEG}})
    if config.calibration.disparity_px is None and (yaw_px := sequence.attributes.get(YAW_STD_PX)) is not None:
        config = config.with_overrides({"calibration": {"disparity_px": float(yaw_px)}})
    tables = shared_errors(found, sequence.has_checked_tracks)
    if is_white or sequence.camera.is_monocular:
        tables = {name: table for name, table in tables.items() if OPTIONAL_BLOCKS[name].coupling == "velocity"}
    if found is not None and not found.measured.all():
        bias = tables[TwistBias.name]
        tables[TwistBias.name] = bias | slow_slip(found.measured, sequence.twist, bias["sigma_v_m_s"])
    shared = {name: {**table, **config.blocks.get(name, {})} for name, table in tables.items()}
    return dataclasses.replace(config, blocks={**config.blocks, **shared})


def noise_of(sequence: Sequence, config: Config) -> Noise:
    """Return the noise of a filter: the configuration's, else the recording's, else the data's or a default."""
    given = config.noise
    if is_automatic(sequence, config):
        found = noise_of_velocities(sequence, config)
        stated = automatic_noise(found, sequence.velocity_frame, sequence.has_checked_tracks)
    else:
        stated = sequence.noise or Noise.isotropic(0.05, 0.001, 1.0)
    if not sequence.has_velocities:
        stated = vision_noise(stated, sequence.twist)
    if is_inertial(sequence):
        # The odometry does not move the state; its velocities err by as much as they walk.
        stated = dataclasses.replace(stated, twist_std=np.asarray(stated.twist_walk_std), twist_walk_std=None)
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
    if sequence.has_velocities:
        noise = with_unmeasured(sequence, noise)
    if tilt and is_automatic(sequence, config) and sequence.measured_axes.all():
        found = noise_of_velocities(sequence, config)
        bias = TwistBias(**(TwistBias.automatic(found.sigma, found.is_clean, False) or {}))
        noise = dataclasses.replace(noise, first_tilt=first_tilt(sequence, noise, bias))
    return noise if given.drift is None else with_drift(noise, given.drift)


def with_unmeasured(sequence: Sequence, noise: Noise) -> Noise:
    """Return the noise with that of a vehicle, or of stereo odometry, for velocities that are not measured."""
    measured = sequence.measured_axes
    if measured.all():
        return noise
    if sequence.noise is None:
        step_s = float(np.median(np.diff(sequence.time_s))) if len(sequence) > 1 else np.inf
        noise = dataclasses.replace(noise, twist_std=with_vehicle(noise.twist_std, measured, step_s))
    if sequence.attributes.get("velocities") in MEASURED_KINDS:
        noise = with_vision(noise, sequence.twist, np.repeat(~measured.reshape(2, 3).any(axis=1), 3))
    return noise


def is_inertial(sequence: Sequence) -> bool:
    """Return whether inertial samples move the state: the recording has some, and no velocities, see `_apart`."""
    return sequence.inertial is not None and not sequence.has_velocities


def is_automatic(sequence: Sequence, config: Config) -> bool:
    """Return whether the noise is found from the data by `ekfslam.models.noise`; see `NoiseConfig`."""
    noise = config.noise
    given = (noise.sigma_v_m_s, noise.sigma_w_rad_s, noise.sigma_px)
    is_wanted = noise.model == "tuned" or (noise.model == "auto" and all(sigma is None for sigma in given))
    return sequence.noise is None and is_wanted


def found_attributes(found: VelocityNoise) -> dict[str, float]:
    """Return white noise of velocities, standard errors and 95 % limits by name, with the units in the names."""
    kinds = {"": found.sigma, "_error": found.sigma_error, "_limit": found.limit}
    names = ("sigma_v_m_s", "sigma_w_rad_s")
    return {f"found_{name}{kind}": float(pair[i]) for i, name in enumerate(names) for kind, pair in kinds.items()}


def _with_retirement(sequence: Sequence, config: Config) -> Config:
    """Return a configuration with the lag, and when landmarks leave the state."""
    config = _with_lag(sequence, config)
    settings, come_back = config.filter, bool(len(_returns(sequence)))
    retire, retire_after, dormant = settings.retire, settings.retire_after, settings.dormant
    if retire == "auto":
        are_few = len(sequence.observations.ids) <= DORMANT_LIMIT
        retire = "never" if come_back and are_few and not settings.lag else "unseen"
    if retire_after is None:
        retire_after = COME_BACK_AFTER if come_back else 1
    if dormant is None:
        # In a relinearised window they would cost as much as landmarks in view: there they come back by map revival.
        dormant = DORMANT_LIMIT if come_back and settings.retire == "auto" and not settings.lag else 0
    return config.with_overrides({"filter": {"retire": retire, "retire_after": retire_after, "dormant": dormant}})


def _with_lag(sequence: Sequence, config: Config) -> Config:
    """Return a configuration with the lag of the relinearised window."""
    if config.filter.lag is not None:
        return config
    # A map revival solves the whole log, and a new window begins. So few landmarks that come back start again instead;
    # with many of them, dormant landmarks serve better than a window.
    many = len(_returns(sequence, after=COME_BACK_AFTER)) > MOST_RETURNS * len(sequence)
    has_window = config.filter.variant != "fej" and not many and _curvature(sequence, config) > CURVED
    return config.with_overrides({"filter": {"lag": VISION_LAG, "revive": -1} if has_window else {"lag": 0}})


def _curvature(sequence: Sequence, config: Config) -> float:
    """Return the second-order error of a prediction without velocities, in standard deviations of a pixel; else 0.

    With predictions that are wrong by s pixels it is about ``s^2 / f``. If s is tens of pixels, frames that are
    linearised once are believed too much.
    """
    if sequence.has_velocities or is_inertial(sequence) or len(sequence) < 2 or not len(sequence.observations):
        return 0.0
    noise, camera = noise_of(sequence, config), sequence.camera
    assert noise.twist_walk_std is not None
    change = float(np.median(np.diff(sequence.time_s))) * noise.twist_walk_std
    disparity_px = np.median(sequence.observations.pixels_px[:, 0] - sequence.observations.pixels_px[:, 2])
    wrong_px = np.hypot(camera.fu_px * change[3:].max(), change[:3].max() * disparity_px / camera.baseline_m)
    return float(wrong_px**2 / camera.fu_px / np.min(noise.pixel_std_px))


def _returns(sequence: Sequence, after: int = 1) -> IntArray:
    """Return the frames, distinct, in which a landmark is seen again more than some frames after it was seen last."""
    observations = sequence.observations
    order = np.lexsort((observations.frame, observations.landmark))
    frame, landmark = observations.frame[order], observations.landmark[order]
    return np.unique(frame[1:][(np.diff(landmark) == 0) & (np.diff(frame) > after)])


def _model(sequence: Sequence, config: Config, noise: Noise, blocks: SequenceType[StateBlock]) -> Model:
    densities = densities_of(config) if is_inertial(sequence) else None
    chosen, process = blocks_and_process(config.blocks, densities, config.inertial.gravity_m_s2)
    return model_of(
        sensor_of(sequence.camera, sequence.T_cam_imu, noise),
        noise,
        se3.inverse(sequence.initial_T_world_imu),
        config.filter.initial_covariance,
        config.calibration,
        (*(block.begun_by(sequence) for block in chosen), *blocks),
        config.filter.landmark_coordinates,
        sequence.has_velocities,
        process,
    )


def _with_inertial_noise(sequence: Sequence, config: Config, is_searched: bool) -> tuple[Config, str]:
    """Return a configuration with track scale and densities of an inertial recording, and where these come from."""
    by_frame = config
    if is_searched and _has_open_scale(sequence, config):
        config = config.with_overrides({"noise": {"track_scale": PERSISTENCE}})
    # Innovations of one camera see its errors from one frame to the next: larger ones would hide those of the unit.
    searched = by_frame if sequence.camera.is_monocular else config
    return with_densities(sequence, config, searched if is_searched else None)


def with_densities(sequence: Sequence, config: Config, searched: Config | None) -> tuple[Config, str]:
    """Return a configuration with the densities of an inertial unit, and where they come from.

    They are the configuration's, else those that the recording states. If it states none, or its samples are noisier by
    far, those are taken by which innovations are likeliest (`ekfslam.inertial.noise`), with the other settings of
    ``searched`` if it is given.
    """
    samples, given = sequence.inertial, vars(config.inertial)
    assert samples is not None
    missing = [name for name in _DENSITIES if given[name] is None]
    if not missing:
        return config, "as given"
    found = None
    if samples.noise is not None and not is_refuted(samples):
        found = Densities(samples.noise, "as stated")
    elif searched is not None:
        found = _likeliest_densities(sequence, searched)
    if found is None and searched is not None and sequence.camera.is_monocular and _rest(sequence) is None:
        raise ScaleError(
            f"{sequence.name}: the rig of one camera moves from the first frame on, and no start explains its tracks "
            f"from frame to frame, so that its scale and the noise of its unit are unknown: {_ADVICE}"
        )
    if found is None:
        found = Densities(from_differences(samples), "from differences of samples: no stretch shows them otherwise")
    return config.with_overrides({"inertial": {name: getattr(found.noise, name) for name in missing}}), found.text


def _likeliest_densities(sequence: Sequence, config: Config) -> Densities | None:
    """Return the densities by which innovations are likeliest; None: they are not found."""

    def begun(part: Sequence, noise: InertialNoise) -> Callable[[InertialNoise], Model]:
        def model(noise: InertialNoise) -> Model:
            densities = config.with_overrides({"inertial": vars(noise)})
            return _model(part, densities, noise_of(part, densities), ())

        start = first_state(part, config.with_overrides({"inertial": vars(noise)}), model(noise))
        return lambda noise: start.begun(model(noise))

    return likeliest_densities(sequence, config.filter, begun)


def _rest(sequence: Sequence) -> tuple[float, float] | None:
    """Return begin and end of a rest at the first frame; noisier tracks of one camera may rest, too."""
    return rest_of(sequence) or (rest_of(sequence, is_loose=True) if sequence.camera.is_monocular else None)


def first_state(sequence: Sequence, config: Config, model: Model) -> InertialStart:
    """Return the first state of an inertial process and how it was found: at rest, in motion, or not at all."""
    samples = sequence.inertial
    assert samples is not None
    prior = FirstPrior.of(sequence.initial_T_world_imu, model, config.inertial.gravity_m_s2)
    is_monocular = sequence.camera.is_monocular
    if (rest := _rest(sequence)) is not None:
        return at_rest(samples, *rest, prior, densities_of(config))
    start, refused = in_motion(sequence, model, prior, config.filter)
    if is_monocular and start is None:
        raise ScaleError(
            f"{sequence.name}: the rig of one camera moves from the first frame on, and its scale and velocity are not "
            f"found ({refused}): {_ADVICE}"
        )
    return start or unknown(samples, float(sequence.time_s[0]), prior, refused or "in motion")


def densities_of(config: Config) -> InertialNoise:
    """Return the densities of a resolved configuration."""
    return InertialNoise(*(float(getattr(config.inertial, name)) for name in _DENSITIES))


def _has_open_scale(sequence: Sequence, config: Config) -> bool:
    """Return whether the track scale is automatic and not known yet; a tuned file was found with scale 1."""
    noise = config.noise
    is_open = noise.track_scale is None and noise.drift is None and noise.model == "auto"
    return is_open and is_automatic(sequence, config) and not sequence.has_checked_tracks


def _track_scale(sequence: Sequence, config: Config, model: Model) -> float:
    """Return the scale of the walk of track errors, given a model with scale 1."""
    if not sequence.has_velocities or not noise_of_velocities(sequence, config).carries_motion:
        return PERSISTENCE
    count = min(max(1, round(len(sequence) / _EVERY)), _MOST_STRETCHES)
    stretches = stretches_of(len(sequence), _STRETCH, count)
    try:
        found = run_stretches(model, config.filter, sequence, stretches)
    except InnovationError:  # the run itself raises it, if it breaks down there too
        return 1.0
    nis, dof = sum(each.nis for each in found), sum(each.dof for each in found)
    return 1.0 if dof < _LEAST_DOF else float(np.clip((nis / dof / TARGET) ** _EXPONENT, *_SCALES))


def _is_white(sequence: Sequence, config: Config) -> bool:
    """Return whether errors of tracks were found to be white, or are taken as white on request."""
    return config.noise.drift == 0.0 and not (config.tuning or sequence.has_checked_tracks)


def _sampling(sequence: Sequence, config: Config) -> dict[str, float] | None:
    """Return the factors on the noise of velocities that are clearly likelier than 1; None: not open, or known."""
    noise, found, is_white = config.noise, noise_of_velocities(sequence), _is_white(sequence, config)
    given = (noise.sampling_v, noise.sampling_w, noise.sigma_v_m_s, noise.sigma_w_rad_s)
    is_open = all(value is None for value in given) and (noise.model == "auto" or is_white)
    is_open &= is_automatic(sequence, config) and sequence.has_velocities and not sequence.stated_twist_std.any()
    is_open &= not sequence.camera.is_monocular
    white = np.where(found.sigma > _SURE * found.sigma_error, found.sigma, 0.0)
    matters = found.sampling.reshape(2, 3).max(axis=1) > np.hypot(white, VELOCITY_STD[[0, 3]])
    if not (is_open and matters.any()):
        return None
    # The scale of a walk of tracks is found for given velocities and could hide their noise: only its absence shows.
    tried = [(_FACTORS if is_white else _FACTORS[:2]) if each else (1.0,) for each in matters]
    return dict(zip(_SAMPLING, _likeliest_sampling(sequence, config, tried), strict=True))


def _likeliest_sampling(
    sequence: Sequence, config: Config, tried: SequenceType[SequenceType[float]]
) -> tuple[float, float]:
    """Return the factors on the noise of linear and angular velocities, by a search along one axis after the other."""
    stretches = stretches_of(len(sequence), *_SAMPLING_STRETCHES)
    few, scores = thinned(sequence, stretches, _SAMPLING_TRACKS), dict[tuple[float, float], Array]()

    def score(factors: tuple[float, float]) -> float:
        if factors not in scores:
            given = config.with_overrides({"noise": dict(zip(_SAMPLING, factors, strict=True))})
            model = _model(sequence, given, noise_of(sequence, given), ())
            try:
                found = run_stretches(model, config.filter, few, stretches)
                scores[factors] = np.array([each.log_likelihood for each in found])
            except InnovationError:
                scores[factors] = np.full(len(stretches), -np.inf)
        return float(scores[factors].sum())

    best, before = (1.0, 1.0), None
    while best != before:
        before = best
        best = max(((v, best[1]) for v in tried[0]), key=score)
        best = max(((best[0], w) for w in tried[1]), key=score)
    gain = scores[best] - scores[1.0, 1.0]
    error = np.sqrt(len(gain)) * float(gain.std())
    return best if gain.sum() > max(_SURE * error, _LEAST_GAIN) else (1.0, 1.0)


def _in_the_long_run(sequence: Sequence, config: Config, noise: Noise) -> Noise:
    """Return the noise with the errors of tracks as they add up over many frames, unless their scale is given."""
    if noise.track_walk_px is None or not _has_open_scale(sequence, config):
        return noise
    return dataclasses.replace(noise, track_walk_px=PERSISTENCE * noise.track_walk_px)


def _settings(table: Mapping[str, BlockSetting | None]) -> str:
    """Return the settings of a table that have a value as text."""
    return ", ".join(
        f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}"
        for key, value in table.items()
        if value is not None
    )
