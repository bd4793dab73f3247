"""Configuration: defaults in code, overridden by a TOML file, then by flags; stored resolved with every result.

The metadata of each field hold the `Rule` of its setting.
"""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

import numpy as np
from scipy.special import gammaincinv

from ekfslam.errors import ConfigError, RetiredSettingWarning, UnknownFormatError
from ekfslam.limits import require_file, toml_values

Mode = Literal["dead-reckoning", "mapping-only", "full", "smoothed"]
Variant = Literal["invariant", "fej", "standard"]
LandmarkCoordinates = Literal["image", "xyz"]
Retire = Literal["auto", "unseen", "never"]
Engine = Literal["auto", "engine", "reference"]
Linearisation = Literal["map", "filtered"]
NoiseModel = Literal["auto", "tuned", "white"]
Kernel = Literal["huber", "cauchy", "none"]
BlockSetting = float | int | str | bool
Made = TypeVar("Made")

MODES: tuple[Mode, ...] = get_args(Mode)
VARIANTS: tuple[Variant, ...] = get_args(Variant)
ENGINES: tuple[Engine, ...] = get_args(Engine)
LEAST_PX = 1e-3  # least pixel noise with which covariances of landmarks keep digits

_KINDS: dict[type, str] = {float: "number", int: "whole number", str: "string", bool: "truth value"}


@dataclass(frozen=True)
class Rule:
    """Rule for the value of a setting."""

    kind: type  # float (any number), int, str or bool
    words: str = ""  # further condition, as it follows "must" in a message
    # Function that returns whether a value of the kind meets this condition.
    holds: Callable[[Any], bool] = lambda _: True

    def plain(self, value: Any) -> Any:
        """Return a value in its kind: a file may write the whole number 2 as 2.0."""
        return int(value) if self.kind is int and isinstance(value, float) and value.is_integer() else value

    def check(self, name: str, value: object) -> None:
        """Raise a `ConfigError` that names setting, rule and value, unless the value follows the rule."""
        kinds = (float, int) if self.kind is float else self.kind
        if not isinstance(value, kinds) or isinstance(value, bool) != (self.kind is bool):
            raise ConfigError(f"{name} must be a {_KINDS[self.kind]}, found {value!r}")
        if not self.holds(value):
            raise ConfigError(f"{name} must {self.words}, found {value!r}")


def _rule(kind: type, words: str = "", holds: Callable[[Any], bool] = lambda _: True) -> dict[str, Rule]:
    """Return the metadata of a field with a `Rule`."""
    return {"rule": Rule(kind, words, holds)}


def _range(words: str, least: float, most: float, kind: type = float) -> dict[str, Rule]:
    return _rule(kind, words, lambda value: least <= value <= most)  # no comparison holds for NaN


def _whole(least: int, most: int = 1_000_000) -> dict[str, Rule]:
    return _range(f"be a whole number not below {least}, nor above {most}", least, most, int)


def _one_of(literal: Any) -> dict[str, Rule]:
    names = get_args(literal)
    return _rule(str, f"be one of {', '.join(names)}", lambda value: value in names)


_TEXT, _SWITCH = _rule(str), _rule(bool)
_NUMBER = _rule(float, "be a number, not NaN", lambda value: abs(value) <= 1e300 or abs(value) == math.inf)
_POSITIVE = _range("be positive, from 1e-06 to 1e+06", 1e-6, 1e6)
_NOT_NEGATIVE = _range("not be negative", 0.0, math.inf)
# Standard deviations of any unit: their squares, and quotients by these, stay within the range of numbers.
_FINITE = _rule(
    float, "be finite and not negative: 0, or from 1e-12 to 1e+06", lambda value: value == 0 or 1e-12 <= value <= 1e6
)
_PIXELS = _range(
    f"be finite and positive, from {LEAST_PX:g} to 1e+06, or the innovation covariance is singular", LEAST_PX, 1e6
)
_PROBABILITY = _rule(float, "be in (0, 1]", lambda value: 0 < value <= 1)
_BETWEEN_0_AND_1 = _rule(float, "be between 0 and 1", lambda value: 0 < value < 1)

_CONSTANTS_OF_THE_FRONT_END = (
    *("refill", "refill_every", "corner_block", "corner_quality", "border", "bucket_columns", "bucket_rows"),
    *("match_patch", "match_score", "match_margin", "row_limit", "window", "backward_limit"),
    *("template", "template_score_left", "template_score_right", "template_shift", "kernel", "residual_limit"),
    *("strikes", "residual_drop", "samples", "rotation_gap", "settling"),
)
# Settings of earlier versions: files that name them are read, with a note.
RETIRED = {
    "filter.covariance_form": "the engine has one form of the covariance, which is linear in the number of landmarks",
    "blocks.stereo_rotation": "the block is gone: it improved nothing. Pitch and roll of the right camera are the mean "
    "of vL - vR over the tracks of a recording",
    "hygiene.restart_above_px": "no default used it, and it gained at most 5 %; every track is cut at a repeated frame",
    "posterior.max_iterations": "the optimiser stops after 50 iterations at most",
    **{f"front_end.{name}": "it is a constant of the front end now" for name in _CONSTANTS_OF_THE_FRONT_END},
}


@dataclass(frozen=True)
class NoiseConfig:
    """Standard deviations per sample; None takes the noise that the recording states.

    Args:
        sigma_v_m_s, sigma_w_rad_s, sigma_px: Linear and angular velocities, and pixels, each axis.
        drift: Random walk of track errors from frame to frame, px; 0 takes pixel noise as white.
        track_scale: Factor on that walk in the automatic model; None finds it from innovations (`ekfslam.resolve`).
        sampling_v, sampling_w: Factors on the sampling noise of linear and angular velocities in the automatic model.
            0: they are means over their intervals (integrated gyroscope, wheel encoders); 1: samples; more: they have
            noise that their differences cannot tell from motion. None finds them by the likelihood of innovations.
        shared: Whether the automatic model has state blocks for errors that all samples or all tracks share.
        tilt_deg: For velocities in a level frame, the prior standard deviation of roll and pitch, which the joint
            filter estimates. 0 takes them as velocities of the IMU.
        model: ``auto`` finds the noise from the data (`ekfslam.models.noise`) if the recording states none and no sigma
            is given here. ``tuned`` does so too, and sigmas given here replace the automatic ones. ``white`` takes
            0.05 m/s, 0.001 rad/s and 1 px, unless the recording or this table states other values.
    """

    sigma_v_m_s: float | None = field(default=None, metadata=_FINITE)
    sigma_w_rad_s: float | None = field(default=None, metadata=_FINITE)
    sigma_px: float | None = field(default=None, metadata=_PIXELS)
    drift: float | None = field(default=None, metadata=_FINITE)
    track_scale: float | None = field(default=None, metadata=_POSITIVE)
    sampling_v: float | None = field(default=None, metadata=_FINITE)
    sampling_w: float | None = field(default=None, metadata=_FINITE)
    shared: bool = field(default=True, metadata=_SWITCH)
    tilt_deg: float | None = field(default=None, metadata=_FINITE)
    model: NoiseModel = field(default="auto", metadata=_one_of(NoiseModel))


@dataclass(frozen=True)
class HygieneConfig:
    """Rules for bad tracks, applied before any filter sees them, see `ekfslam.data.hygiene`.

    False or 0 switches a rule off. Sigmas are standard deviations by the pixel noise of the run.

    Args:
        min_disparity_sigma: Drop observations with less disparity, in sigmas of a disparity: they have no depth. By
            default 1, but 3 in the automatic model, whose tracks have a constant error of their disparity.
        max_row_mismatch_sigma: Drop observations with larger ``|vL - vR|``, in sigmas of that difference.
        restart_at_repeats: Cut every track at a frame that repeats the pixels of the previous one while the rig moves.
        jump_sigma: Cut a track if its pixels jump so far off its course and that of the frame's other tracks.
        reused_id_sigma: Cut a track if it comes back after a gap so far off the pixels that the velocities predict.
        max_depth_error: Drop tracks whose depth is never known better than this, as a share of the depth.
        min_observations: Drop tracks, or pieces of cut tracks, with fewer observations.
        disparity_jump_sigma: Drop tracks across a frame in which most disparities jump so far from the prediction of
            the velocities.
        moving: If velocities are noisy, drop tracks that more probably move over the ground than stand.
    """

    min_disparity_sigma: float | None = field(default=None, metadata=_FINITE)
    max_row_mismatch_sigma: float = field(default=10.0, metadata=_FINITE)
    restart_at_repeats: bool = field(default=True, metadata=_SWITCH)
    jump_sigma: float = field(default=0.0, metadata=_FINITE)
    reused_id_sigma: float = field(default=3.0, metadata=_FINITE)
    max_depth_error: float = field(default=0.0, metadata=_FINITE)
    min_observations: int = field(default=0, metadata=_whole(0))
    disparity_jump_sigma: float = field(default=3.0, metadata=_FINITE)
    moving: bool = field(default=True, metadata=_SWITCH)


@dataclass(frozen=True)
class FilterConfig:
    """Linearisation, gates, start and retirement of landmarks.

    Args:
        variant: Linearisation rule of the joint filter, see `ekfslam.filters.variants`.
        landmark_coordinates: Coordinates in which a correction acts on landmarks. ``image``: their images in the last
            updated camera, see `ekfslam.filters.coordinates`; sensors that are not cameras use ``xyz``. ``xyz``:
            positions in world, the textbook's form.
        iterations: Gauss-Newton iterations of an update; 1 is the plain EKF. ``fej`` and ``xyz`` allow no more.
        lag: Number of frames n of the relinearised window: after each update, the factors of the last n frames are
            linearised again at their maximum a posteriori, see `ekfslam.smoother.fixed_lag`. 0 linearises each once. By
            default 10 for a recording without velocities whose motion changes fast (unless many landmarks come back,
            or ``fej``), else 0.
        retire: ``unseen`` marginalises a landmark when it is out of view, ``never`` keeps all. ``auto`` is ``never``
            for a recording of at most 1500 landmarks some of which come back, else ``unseen``.
        retire_after: Frames without a sighting after which ``unseen`` applies: by default 1, or 10 if some landmarks of
            the recording come back.
        dormant: With ``unseen``, number of landmarks out of view that stay in the state, those seen last: by default 0,
            or 1500 if ``auto`` has chosen ``unseen`` although landmarks come back.
        revive: A retired landmark that is seen again comes back with its exact mean and covariance, together with up to
            this many retired landmarks seen nearest to it in time. -1 starts it again, as the automatic lag does.
        gate_probability: Chi-square gate on each observation, against the prediction and (joint filter) against the
            prediction as corrected by the frame's other landmarks; 1 accepts everything.
        split_after: Rejected observations in a row after which a new landmark replaces that of the track; 0 never
            does. By default 3; 1 if errors of tracks walk, since each observation then continues the last one, except
            for tracks of the front end, which do not jump.
        moving_sigma, moving_share: If errors of tracks walk, a track that moves along with the rig is dropped for good:
            by more than this many standard deviations over all its observations, and this share of the way.
        min_depth_m: Reject observations of a landmark that is predicted nearer than this, or behind the camera.
        relative_frames: If truth is known, keep cross-covariances of reported poses up to this many frames apart, for
            the NEES of relative poses. It slows the filter down; estimates do not depend on it.
        initial_position_std_m, initial_rotation_std_rad: Standard deviations of the first pose, each axis.
        engine: Implementation of the joint filter; estimates are the same. ``engine``: in C++ (`ekfslam.engine`).
            ``reference``: in NumPy. ``auto`` takes the engine if it can run the model, see `ekfslam.engine.choice`.
    """

    variant: Variant = field(default="invariant", metadata=_one_of(Variant))
    landmark_coordinates: LandmarkCoordinates = field(default="image", metadata=_one_of(LandmarkCoordinates))
    iterations: int = field(default=1, metadata=_whole(1, 100))
    lag: int | None = field(default=None, metadata=_whole(0, 1000))
    retire: Retire = field(default="auto", metadata=_one_of(Retire))
    retire_after: int | None = field(default=None, metadata=_whole(1))
    dormant: int | None = field(default=None, metadata=_whole(0))
    revive: int = field(default=100, metadata=_whole(-1))
    gate_probability: float = field(default=0.999, metadata=_PROBABILITY)
    split_after: int | None = field(default=None, metadata=_whole(0))
    moving_sigma: float = field(default=1.5, metadata=_NOT_NEGATIVE)
    moving_share: float = field(default=0.05, metadata=_NOT_NEGATIVE)
    min_depth_m: float = field(default=0.1, metadata=_FINITE)
    relative_frames: int = field(default=0, metadata=_whole(0))
    initial_position_std_m: float = field(default=0.0, metadata=_FINITE)
    initial_rotation_std_rad: float = field(default=0.0, metadata=_FINITE)
    engine: Engine = field(default="auto", metadata=_one_of(Engine))

    @property
    def gate(self) -> float:
        """Chi-square threshold of the gate for 3 degrees of freedom."""
        return 2.0 * float(gammaincinv(1.5, self.gate_probability))

    def misses_to_split(self, tracks_walk: bool) -> int:
        """Return `split_after`, or its default if errors of tracks walk or do not; 0 means never."""
        return (1 if tracks_walk else 3) if self.split_after is None else self.split_after

    @property
    def initial_covariance(self) -> np.ndarray:
        """(6, 6) covariance of the first pose's error ``xi``."""
        return np.diag(np.repeat([self.initial_position_std_m, self.initial_rotation_std_rad], 3) ** 2)


@dataclass(frozen=True)
class CalibrationConfig:
    """Prior standard deviations of the calibration that the joint filter estimates; 0 takes a parameter as given.

    Args:
        rotation_deg: Rotation of the camera against the IMU, each axis. By default 0.4 in the automatic model, else 0.
        lever_arm_m: Position of the IMU in the camera frame, each axis.
        baseline: Length of the stereo baseline, as a share of it.
        disparity_px: Offset of all disparities. By default in the automatic model, the standard deviation of the right
            camera's yaw that the front end states, else 0.
        time_s: Delay of the exposure of images after their stamps.
    """

    rotation_deg: float | None = field(default=None, metadata=_FINITE)
    lever_arm_m: float = field(default=0.0, metadata=_FINITE)
    baseline: float = field(default=0.0, metadata=_FINITE)
    disparity_px: float | None = field(default=None, metadata=_FINITE)
    time_s: float = field(default=0.0, metadata=_FINITE)


@dataclass(frozen=True)
class InertialConfig:
    """Gyroscope and accelerometer, for recordings whose inertial samples move the state.

    Args:
        gyro, accel, gyro_walk, accel_walk: Densities of noise as in `ekfslam.InertialNoise`; None takes those that the
            recording states, or finds them from it if it states none or its samples are noisier by far.
        gravity_m_s2: Magnitude of gravity.
    """

    gyro: float | None = field(default=None, metadata=_FINITE)
    accel: float | None = field(default=None, metadata=_FINITE)
    gyro_walk: float | None = field(default=None, metadata=_FINITE)
    accel_walk: float | None = field(default=None, metadata=_FINITE)
    gravity_m_s2: float = field(default=9.81, metadata=_POSITIVE)


@dataclass(frozen=True)
class FrontEndConfig:
    """Settings of the front end, which tracks images, see `ekfslam.frontend`. Lengths are in rectified pixels.

    Args:
        features: Number of features wanted in a frame; about two thirds of them are seen.
        spacing: Least distance between features.
        min_disparity, max_disparity: Limits of the disparity of a new feature.
        levels: Number of levels of the image pyramid of Lucas-Kanade.
        pixel_std: Standard deviation of a pixel in the motion of the rig.
        rotation_deg: Prior standard deviation of the right camera's rotation against its calibration, each axis.
        seed: Seed of random samples.
    """

    features: int = field(default=120, metadata=_whole(8, 5000))
    spacing: int = field(default=10, metadata=_whole(1, 1000))
    min_disparity: float = field(default=2.0, metadata=_POSITIVE)
    max_disparity: float = field(default=180.0, metadata=_POSITIVE)
    levels: int = field(default=3, metadata=_whole(1, 8))
    pixel_std: float = field(default=0.2, metadata=_PIXELS)
    rotation_deg: float = field(default=0.2, metadata=_POSITIVE)
    seed: int = field(default=0, metadata=_whole(0))


@dataclass(frozen=True)
class PosteriorConfig:
    """Linearisation of the posterior over all poses and landmarks.

    Args:
        linearisation: ``map`` linearises all rows again at the maximum a posteriori; ``filtered`` keeps the
            linearisation of the filter.
        kernel: Robust kernel on the whitened residual of each observation (``map`` only).
        kernel_width: End of its parabola, in standard deviations; 5 % of Gaussian residuals exceed the default.
        tolerance: Levenberg-Marquardt stops when an iteration lowers the cost by a smaller share than this.
    """

    linearisation: Linearisation = field(default="map", metadata=_one_of(Linearisation))
    kernel: Kernel = field(default="huber", metadata=_one_of(Kernel))
    kernel_width: float = field(default=2.8, metadata=_POSITIVE)
    tolerance: float = field(default=1e-6, metadata=_BETWEEN_0_AND_1)


@dataclass(frozen=True)
class TruthConfig:
    """Standard deviations of the true poses; None takes those of their format, if any.

    Only the evaluation uses it, see `ekfslam.data.truth_noise.TruthNoise`.

    Args:
        roll_deg, pitch_deg, yaw_deg, first_position_m: First pose, about and along the axes of the IMU.
        stamp_s: Jitter of the stamps.
        position_m, attitude_deg: Each pose, each axis.
        world_tilt_deg, turn_deg: Vertical of the world, and axes of the body, about each axis.
        drift_m_sqrt_s: Random walk of the position, each axis.
        scale: All distances, as a share of them.
    """

    roll_deg: float | None = field(default=None, metadata=_FINITE)
    pitch_deg: float | None = field(default=None, metadata=_FINITE)
    yaw_deg: float | None = field(default=None, metadata=_FINITE)
    first_position_m: float | None = field(default=None, metadata=_FINITE)
    stamp_s: float | None = field(default=None, metadata=_FINITE)
    position_m: float | None = field(default=None, metadata=_FINITE)
    attitude_deg: float | None = field(default=None, metadata=_FINITE)
    world_tilt_deg: float | None = field(default=None, metadata=_FINITE)
    turn_deg: float | None = field(default=None, metadata=_FINITE)
    drift_m_sqrt_s: float | None = field(default=None, metadata=_FINITE)
    scale: float | None = field(default=None, metadata=_FINITE)


@dataclass(frozen=True)
class Config:
    """All settings of a run, and the record of tuning.

    Args:
        noise, filter, posterior, calibration, inertial, hygiene, front_end, truth: Tables of a file.
        tuning: Record of `ekfslam tune`, texts and numbers by name; results have it as attributes ``tuned_*``.
        blocks: Settings of optional state blocks by name, ``[blocks.<name>]`` in a file; `ekfslam.models.build` checks
            them.

    Raises:
        ConfigError: A value breaks its rule; the message names table and key, the rule, and the value.
    """

    noise: NoiseConfig = field(default_factory=NoiseConfig)
    filter: FilterConfig = field(default_factory=FilterConfig)
    posterior: PosteriorConfig = field(default_factory=PosteriorConfig)
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    inertial: InertialConfig = field(default_factory=InertialConfig)
    hygiene: HygieneConfig = field(default_factory=HygieneConfig)
    front_end: FrontEndConfig = field(default_factory=FrontEndConfig)
    truth: TruthConfig = field(default_factory=TruthConfig)
    tuning: Mapping[str, str | float] = field(default_factory=dict, hash=False)
    blocks: Mapping[str, Mapping[str, BlockSetting]] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        _check({table: getattr(settings, "__dict__", settings) for table, settings in vars(self).items()})
        object.__setattr__(self, "tuning", dict(self.tuning))
        object.__setattr__(self, "blocks", {name: dict(settings) for name, settings in self.blocks.items()})
        if self.filter.variant == "fej" and self.filter.iterations > 1:
            raise ConfigError("filter.iterations > 1 contradicts first estimates: choose invariant or standard")
        if self.filter.variant == "fej" and self.filter.lag:
            raise ConfigError("filter.lag contradicts first estimates: choose invariant or standard")
        if self.filter.landmark_coordinates == "xyz" and self.filter.iterations > 1:
            raise ConfigError(
                "filter.iterations > 1 with filter.landmark_coordinates = 'xyz' makes distances too short (0.26 % in "
                "builtin:city), since errors are not Gaussian in xyz: choose 'image', or one iteration"
            )

    def with_overrides(self, overrides: Mapping[str, Mapping[str, Any]]) -> Config:
        """Return this configuration with ``{table: {key: value}}`` replaced; None values are skipped.

        Settings of a state block leave its other settings. `RETIRED` ones are skipped with a `RetiredSettingWarning`.

        Raises:
            ConfigError: An unknown table or key, or a value of the wrong kind or range.
        """
        tables = dict(vars(self))
        for table, values in overrides.items():
            if table not in tables:
                raise ConfigError(f"unknown table [{table}]; known: {', '.join(tables)}")
            _require_table(table, values)
            given = _given(_without_retired(table, values))
            if table == "blocks":
                for name, settings in given.items():
                    _require_table(f"blocks.{name}", settings)
                    given[name] = {**self.blocks.get(name, {}), **_given(settings)}
            if isinstance(tables[table], Mapping):
                tables[table] = {**tables[table], **given}
            else:
                tables[table] = _replaced(table, tables[table], given)
        return Config(**tables)

    @staticmethod
    def from_toml(path: str | Path) -> Config:
        """Return the defaults, overridden by a TOML file whose tables are the fields of `Config`.

        Raises:
            ConfigError: The file is missing, is not TOML, or holds something unknown.
        """
        return of_toml(path, Config().with_overrides)

    @staticmethod
    def from_stored(tables: Mapping[str, Mapping[str, Any]]) -> Config:
        """Return the configuration of a stored result; retired settings are skipped without a warning."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RetiredSettingWarning)
            return Config().with_overrides(tables)


def of_toml(path: str | Path, made: Callable[[dict[str, Any]], Made]) -> Made:
    """Return what is made of the content of a TOML file; every `ConfigError` names the file."""
    try:
        require_file(path, is_text=True)
        return made(toml_values(Path(path).read_text(encoding="utf-8")))
    except UnknownFormatError as error:  # names the file
        raise ConfigError(str(error)) from None
    except (OSError, ValueError, RecursionError, ConfigError) as error:  # ValueError: no UTF-8, no TOML
        raise ConfigError(f"{path}: {error}") from None


def require_setting(name: str, value: object, is_scale: bool = False) -> None:
    """Raise a `ConfigError` unless a value is a finite standard deviation, or a positive time or length."""
    (_POSITIVE if is_scale else _FINITE)["rule"].check(name, value)


def check_stored(tables: Mapping[str, Any]) -> None:
    """Raise a `ConfigError` if a known setting of a stored configuration breaks its rule; None is no value."""
    for table in tables:
        _require_table(table, tables[table])
    _check({table: _given(settings) for table, settings in tables.items()})


def _check(tables: Mapping[str, Any]) -> None:
    """Raise a `ConfigError` if a setting breaks its rule; None is allowed if it is the default."""
    for table in dataclasses.fields(Config):
        settings = tables.get(table.name, {})
        if table.name == "blocks":
            _check_blocks(settings)
        elif table.name == "tuning":
            _check_record(settings)
        else:
            for setting in dataclasses.fields(table.default_factory):  # type: ignore[arg-type]
                value = settings.get(setting.name, setting.default)
                if value is not None or setting.default is not None:
                    setting.metadata["rule"].check(f"{table.name}.{setting.name}", value)


def _without_retired(table: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a table that still exist, with a warning for each that does not."""
    for key in values:
        if note := RETIRED.get(f"{table}.{key}"):
            warnings.warn(f"{table}.{key} is ignored: {note}", RetiredSettingWarning, stacklevel=3)
    return {key: value for key, value in values.items() if f"{table}.{key}" not in RETIRED}


def _require_table(name: str, value: object) -> None:
    if not isinstance(value, Mapping):
        raise ConfigError(f"[{name}] must be a table, found {value!r}")


def _given(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values that are not None."""
    return {key: value for key, value in values.items() if value is not None}


def _check_record(record: Mapping[str, Any]) -> None:
    """Raise a `ConfigError` unless a record of tuning holds texts and numbers under plain names."""
    _require_table("tuning", record)
    for key, value in record.items():
        if not key.isidentifier():
            raise ConfigError(f"tuning: {key!r} must be a plain name")
        (_TEXT if isinstance(value, str) else _NUMBER)["rule"].check(f"tuning.{key}", value)


def _check_blocks(blocks: Mapping[str, Any]) -> None:
    """Raise a `ConfigError` unless this is a table of tables of plain values."""
    _require_table("blocks", blocks)
    for name, settings in blocks.items():
        _require_table(f"blocks.{name}", settings)
        for key, value in settings.items():
            if not isinstance(value, BlockSetting) or value != value:  # NaN alone differs from itself
                raise ConfigError(f"blocks.{name}.{key} must be a number, a string or a truth value, found {value!r}")


def _replaced(table: str, settings: Any, given: Mapping[str, Any]) -> Any:
    """Return the settings of a table with the given values replaced."""
    rules = {setting.name: setting.metadata["rule"] for setting in dataclasses.fields(settings)}
    for key in given:
        if key not in rules:
            raise ConfigError(f"unknown key {table}.{key}; known: {', '.join(rules)}")
    return dataclasses.replace(settings, **{key: rules[key].plain(value) for key, value in given.items()})
