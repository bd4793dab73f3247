"""Configuration: defaults in code, overridden by a TOML file, then by flags; stored resolved with every result.

Every setting carries its `Rule` in the metadata of its field: what kind of value it is and what must hold for it.
"""

from __future__ import annotations

import dataclasses
import math
import tomllib
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from scipy.special import gammaincinv

from ekfslam.errors import ConfigError, RetiredSettingWarning, UnknownFormatError
from ekfslam.limits import require_file

Mode = Literal["dead-reckoning", "mapping-only", "full", "smoothed"]
Variant = Literal["invariant", "fej", "standard"]
LandmarkCoordinates = Literal["image", "xyz"]
Retire = Literal["auto", "unseen", "never"]
CovarianceForm = Literal["auto", "dense", "conditional"]
Linearisation = Literal["map", "filtered"]
NoiseModel = Literal["auto", "tuned", "white"]
Kernel = Literal["huber", "cauchy", "none"]
BlockSetting = float | int | str | bool

MODES: tuple[Mode, ...] = get_args(Mode)
VARIANTS: tuple[Variant, ...] = get_args(Variant)

_KINDS: dict[type, str] = {float: "number", int: "whole number", str: "string", bool: "truth value"}


@dataclass(frozen=True)
class Rule:
    """What a setting may be.

    Args:
        kind: ``float`` (any number), ``int``, ``str`` or ``bool``.
        words: What else must hold, as it follows "must".
        holds: Whether it holds for a value of the kind.
    """

    kind: type
    words: str = ""
    holds: Callable[[Any], bool] = lambda _: True

    def is_kind(self, value: object) -> bool:
        """Whether a value is of the kind; a whole number is a number, a truth value is none."""
        kinds = (float, int) if self.kind is float else self.kind
        return isinstance(value, kinds) and isinstance(value, bool) == (self.kind is bool)

    def plain(self, value: Any) -> Any:
        """A value as the kind has it: a file may write the whole number 2 as 2.0."""
        return int(value) if self.kind is int and isinstance(value, float) and value.is_integer() else value

    def check(self, name: str, value: object) -> None:
        """Raise a `ConfigError` that names the setting, the rule and the value, where the rule does not hold."""
        if not self.is_kind(value):
            raise ConfigError(f"{name} must be a {_KINDS[self.kind]}, found {value!r}")
        if not self.holds(value):
            raise ConfigError(f"{name} must {self.words}, found {value!r}")


def _rule(kind: type, words: str = "", holds: Callable[[Any], bool] = lambda _: True) -> dict[str, Rule]:
    """Metadata of a field."""
    return {"rule": Rule(kind, words, holds)}


def _whole(least: int, most: int = 1_000_000) -> dict[str, Rule]:
    return _rule(int, f"be a whole number not below {least}, nor above {most}", lambda value: least <= value <= most)


def _one_of(literal: Any) -> dict[str, Rule]:
    names = get_args(literal)
    return _rule(str, f"be one of {', '.join(names)}", lambda value: value in names)


LEAST_PX = 1e-3  # pixel noise with which covariances of landmarks keep digits, whatever they begin with

# No comparison holds for NaN, so the rules refuse it.
_TEXT, _SWITCH = _rule(str), _rule(bool)
_NUMBER = _rule(float, "be a number, not NaN", lambda value: abs(value) <= 1e300 or abs(value) == math.inf)
# Of any standard deviation, in any unit: its square is a number, and so is what that divides.
_LEAST, _LARGEST = 1e-12, 1e6
_POSITIVE = _rule(
    float, f"be positive, from {1 / _LARGEST:g} to {_LARGEST:g}", lambda value: 1 / _LARGEST <= value <= _LARGEST
)
_NOT_NEGATIVE = _rule(float, "not be negative", lambda value: value >= 0)
_FINITE = _rule(
    float,
    f"be finite and not negative: 0, or from {_LEAST:g} to {_LARGEST:g}",
    lambda value: value == 0 or _LEAST <= value <= _LARGEST,
)
_PIXELS = _rule(
    float,
    f"be finite and positive, from {LEAST_PX:g} to {_LARGEST:g}, or the innovation covariance is singular",
    lambda value: LEAST_PX <= value <= _LARGEST,
)
_PROBABILITY = _rule(float, "be in (0, 1]", lambda value: 0 < value <= 1)
_BETWEEN_0_AND_1 = _rule(float, "be between 0 and 1", lambda value: 0 < value < 1)


_CONSTANTS_OF_THE_FRONT_END = (
    *("refill", "refill_every", "corner_block", "corner_quality", "border", "bucket_columns", "bucket_rows"),
    *("match_patch", "match_score", "match_margin", "row_limit", "window", "backward_limit"),
    *("template", "template_score_left", "template_score_right", "template_shift", "kernel", "residual_limit"),
    *("strikes", "residual_drop", "samples", "rotation_gap", "settling"),
)
# Settings of earlier versions: a file that names them is read, and a note says what became of them.
RETIRED = {
    "blocks.stereo_rotation": "the block is gone: it improved nothing. Pitch and roll of the right camera are the mean "
    "of vL - vR over the tracks of a recording",
    **{f"front_end.{name}": "it is a constant of the front end now" for name in _CONSTANTS_OF_THE_FRONT_END},
}


@dataclass(frozen=True)
class NoiseConfig:
    """Standard deviations per sample; None takes what the sequence states.

    Args:
        sigma_v_m_s: Linear velocity, each axis.
        sigma_w_rad_s: Angular velocity, each axis.
        sigma_px: Pixels.
        drift: How far the error of a track walks in the image from one frame to the next, px; 0 takes pixel noise as
            white, None takes what the model says.
        track_scale: Factor on how far errors of tracks walk in the automatic model; None: it is found by their
            innovations, see `ekfslam.resolve`.
        shared: Whether errors that all samples or all tracks share (`ekfslam.models.noise.shared_errors`) are in the
            state of the automatic model.
        tilt_deg: Of velocities in a level frame: prior standard deviation of roll and pitch, which the joint filter
            estimates; 0 takes them as velocities of the IMU; None takes what the model says.
        model: ``auto`` finds the noise from the data (`ekfslam.models.noise`) where the sequence states none and no
            sigma is given here; sigmas given here are those of white noise. ``tuned`` is the same, but sigmas given
            here only replace those found: they were found by `ekfslam.studies.tuning` within the automatic model and
            mean nothing without the rest of it. ``white`` takes what is neither stated nor given from a clean
            recording: 0.05 m/s, 0.001 rad/s, 1 px.
    """

    sigma_v_m_s: float | None = field(default=None, metadata=_FINITE)
    sigma_w_rad_s: float | None = field(default=None, metadata=_FINITE)
    sigma_px: float | None = field(default=None, metadata=_PIXELS)
    drift: float | None = field(default=None, metadata=_FINITE)
    track_scale: float | None = field(default=None, metadata=_POSITIVE)
    shared: bool = field(default=True, metadata=_SWITCH)
    tilt_deg: float | None = field(default=None, metadata=_FINITE)
    model: NoiseModel = field(default="auto", metadata=_one_of(NoiseModel))


@dataclass(frozen=True)
class HygieneConfig:
    """What becomes of bad tracks before any filter sees them, see `ekfslam.data.hygiene`.

    False or 0 switches a rule off. Sigmas are standard deviations by the pixel noise that the run assumes.

    Args:
        min_disparity_sigma: Observations with less disparity, in sigmas of a disparity, are dropped: they have no
            depth. (The filters reject observations without disparity.) By default 1; 3 in the automatic model, whose
            tracks have a constant error of their disparity.
        max_row_mismatch_sigma: So are those with larger ``|vL - vR|``, in sigmas of that difference.
        restart_at_repeats: Where a frame repeats the pixels of the one before while the rig moves, every track is cut.
        restart_above_px: Of these, tracks that move by no more than this in the frames beside it are not cut: they show
            another point, but one close by. Where velocities are noisy the poses gain by it, the tracks lose.
        jump_sigma: A track is cut where its pixels jump so many sigmas out of its course, and out of that of the
            frame's other tracks.
        reused_id_sigma: A track is cut where it comes back after a gap so many sigmas from where the velocities say
            that it was.
        max_depth_error: Tracks are dropped whose depth is never known better than this, as a share of the depth.
        min_observations: Tracks, or pieces of tracks that were cut, with fewer observations are dropped.
        disparity_jump_sigma: Tracks are dropped as a whole that are seen across a frame in which the disparities of
            most tracks jump, by more than so many sigmas, away from what the velocities say: the right images are of
            other points than before, and nobody knows which are right.

    There is no rule for an id that is seen twice in one frame. Nobody can know which of the two is meant, so a
    `Sequence` refuses it with a `DuplicateObservationError`.
    """

    min_disparity_sigma: float | None = field(default=None, metadata=_FINITE)
    max_row_mismatch_sigma: float = field(default=10.0, metadata=_FINITE)
    restart_at_repeats: bool = field(default=True, metadata=_SWITCH)
    restart_above_px: float = field(default=0.0, metadata=_FINITE)
    jump_sigma: float = field(default=0.0, metadata=_FINITE)
    reused_id_sigma: float = field(default=3.0, metadata=_FINITE)
    max_depth_error: float = field(default=0.0, metadata=_FINITE)
    min_observations: int = field(default=0, metadata=_whole(0))
    disparity_jump_sigma: float = field(default=3.0, metadata=_FINITE)


@dataclass(frozen=True)
class FilterConfig:
    """How the filters linearise, gate, start and retire landmarks.

    Args:
        variant: Linearisation rule of the joint filter, see `ekfslam.filters.variants`.
        landmark_coordinates: In which coordinates a correction acts on landmarks. ``image``: as their images in the
            last updated camera, where their errors are Gaussian, see `ekfslam.filters.coordinates`; sensors that are no
            cameras have none and go by ``xyz``. ``xyz``: as positions in world, which is the textbook's form.
        covariance_form: How the joint covariance is kept; estimates are the same. ``dense``: as one matrix.
            ``conditional``: see `ekfslam.filters.conditional`, linear in the number of landmarks. ``auto`` takes what
            costs less for a sequence.
        iterations: Gauss-Newton iterations of an update; 1 is the plain EKF. Not for ``fej``, nor for ``xyz``, where
            they take the depth of landmarks at the wrong point and make all distances too short.
        retire: ``unseen`` marginalises a landmark when it is out of view, ``never`` keeps all; ``auto`` is ``never``
            for a sequence of at most 1500 landmarks some of which come back, else ``unseen``.
        retire_after: Frames without a sighting after which ``unseen`` applies. By default 1, or 10 in a sequence some
            of whose landmarks come back.
        dormant: With ``unseen``, so many landmarks out of view stay in the state, those seen last. By default 0, or
            1500 where ``auto`` has chosen ``unseen`` although landmarks come back.
        revive: A retired landmark that is seen again comes back with its exact mean, covariance and cross-covariance,
            together with up to this many retired landmarks that were seen nearest to it in time. -1 starts it afresh.
        gate_probability: Chi-square gate on each observation, once against the prediction and (joint filter) once
            against the prediction as corrected by the frame's other landmarks; 1 accepts everything.
        split_after: A track is split, its landmark retired and a new one started, when this many observations in a row
            fail the gate (or put it behind the camera): the tracker has jumped to another point. 0 never splits. By
            default 3; 1 where errors of tracks walk, of which each observation continues that of the last frame.
        moving_sigma, moving_share: Where the errors of tracks walk (`Noise.track_error`), a track is dropped for good
            when it moves along with the rig. Over all its observations it must do so by more than this share of the
            way, and by more than this many standard deviations (without their `Noise.margin`).
        min_depth_m: Observations of a landmark predicted nearer than this (or behind) are rejected.
        relative_frames: If truth is known, keep cross-covariances of reported poses up to this many frames apart, for
            the NEES of relative poses. 0 keeps none: the columns slow the filter down. Estimates do not depend on it.
        initial_position_std_m: Standard deviation of the first pose's translation, each axis.
        initial_rotation_std_rad: Standard deviation of the first pose's rotation, each axis.
    """

    variant: Variant = field(default="invariant", metadata=_one_of(Variant))
    landmark_coordinates: LandmarkCoordinates = field(default="image", metadata=_one_of(LandmarkCoordinates))
    covariance_form: CovarianceForm = field(default="auto", metadata=_one_of(CovarianceForm))
    iterations: int = field(default=1, metadata=_whole(1, 100))
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

    @property
    def gate(self) -> float:
        """Chi-square threshold of the gate, 3 degrees of freedom."""
        return 2.0 * float(gammaincinv(1.5, self.gate_probability))

    def misses_to_split(self, tracks_walk: bool) -> int:
        """`split_after`, or what is the default where errors of tracks walk, and where they do not; 0: never."""
        if self.split_after is not None:
            return self.split_after
        return 1 if tracks_walk else 3

    @property
    def initial_covariance(self) -> np.ndarray:
        """(6, 6) covariance of the first pose's error ``xi``."""
        return np.diag(np.repeat([self.initial_position_std_m, self.initial_rotation_std_rad], 3) ** 2)


@dataclass(frozen=True)
class CalibrationConfig:
    """What of the calibration the joint filter estimates, as prior standard deviations; 0 takes it as given.

    Args:
        rotation_deg: Rotation of the camera against the IMU, each axis. By default 0.3 in the automatic model, else 0.
        lever_arm_m: Position of the IMU in the camera frame, each axis.
        baseline: Length of the stereo baseline, as a share of it.
        disparity_px: Offset of all disparities.
        time_s: How much later than stamped the images are exposed.
    """

    rotation_deg: float | None = field(default=None, metadata=_FINITE)
    lever_arm_m: float = field(default=0.0, metadata=_FINITE)
    baseline: float = field(default=0.0, metadata=_FINITE)
    disparity_px: float = field(default=0.0, metadata=_FINITE)
    time_s: float = field(default=0.0, metadata=_FINITE)


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
    """How the posterior over all poses and landmarks is linearised.

    Args:
        linearisation: ``map`` linearises all rows again at the maximum a posteriori, found from the filter's estimate;
            ``filtered`` leaves them where the filter linearised them.
        kernel: Robust kernel on the whitened residual of each observation (``map`` only), see
            `ekfslam.smoother.posterior`.
        kernel_width: Where it leaves the parabola, in standard deviations. 5 % of Gaussian residuals exceed the
            default.
        max_iterations: Of Levenberg-Marquardt.
        tolerance: It stops when an iteration lowers the cost by a smaller share than this.
    """

    linearisation: Linearisation = field(default="map", metadata=_one_of(Linearisation))
    kernel: Kernel = field(default="huber", metadata=_one_of(Kernel))
    kernel_width: float = field(default=2.8, metadata=_POSITIVE)
    max_iterations: int = field(default=50, metadata=_whole(1, 10_000))
    tolerance: float = field(default=1e-6, metadata=_BETWEEN_0_AND_1)


@dataclass(frozen=True)
class TruthConfig:
    """How far the true poses may be wrong, as standard deviations; None takes what their format states, if anything.

    Only the evaluation uses it, see `ekfslam.data.truth_noise.TruthNoise`.

    Args:
        roll_deg, pitch_deg, yaw_deg: Attitude of the first pose, about the axes of the IMU.
        first_position_m: Position of the first pose, each axis.
        stamp_s: Jitter of the stamps.
        position_m: Position of each pose, each axis.
        attitude_deg: Attitude of each pose, each axis.
    """

    roll_deg: float | None = field(default=None, metadata=_FINITE)
    pitch_deg: float | None = field(default=None, metadata=_FINITE)
    yaw_deg: float | None = field(default=None, metadata=_FINITE)
    first_position_m: float | None = field(default=None, metadata=_FINITE)
    stamp_s: float | None = field(default=None, metadata=_FINITE)
    position_m: float | None = field(default=None, metadata=_FINITE)
    attitude_deg: float | None = field(default=None, metadata=_FINITE)


@dataclass(frozen=True)
class Config:
    """Everything that decides what a run does besides the data, and the record of what was tuned.

    Args:
        noise, filter, posterior, calibration, hygiene, front_end, truth: The tables of a file.
        tuning: Record of `ekfslam tune`: texts and numbers by name. It decides nothing and becomes attributes
            ``tuned_*`` of results.
        blocks: Name of an optional state block to its settings, ``[blocks.<name>]`` in a file. Here they are only
            plain values; `ekfslam.models.build` knows the blocks and what can be set of them.

    Raises:
        ConfigError: A value breaks its rule; the message names table and key, the rule, and the value.
    """

    noise: NoiseConfig = field(default_factory=NoiseConfig)
    filter: FilterConfig = field(default_factory=FilterConfig)
    posterior: PosteriorConfig = field(default_factory=PosteriorConfig)
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    hygiene: HygieneConfig = field(default_factory=HygieneConfig)
    front_end: FrontEndConfig = field(default_factory=FrontEndConfig)
    truth: TruthConfig = field(default_factory=TruthConfig)
    tuning: Mapping[str, str | float] = field(default_factory=dict, hash=False)
    blocks: Mapping[str, Mapping[str, BlockSetting]] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        for table, settings in vars(self).items():
            if table not in ("blocks", "tuning"):
                _check_table(table, settings)
        _check_record(self.tuning)
        _check_blocks(self.blocks)
        object.__setattr__(self, "tuning", dict(self.tuning))
        object.__setattr__(self, "blocks", {name: dict(settings) for name, settings in self.blocks.items()})
        if self.filter.variant == "fej" and self.filter.iterations > 1:
            raise ConfigError("filter.iterations > 1 contradicts first estimates: choose invariant or standard")
        if self.filter.landmark_coordinates == "xyz" and self.filter.iterations > 1:
            raise ConfigError(
                "filter.iterations > 1 with filter.landmark_coordinates = 'xyz' makes distances too short (0.26 % in "
                "builtin:city), since errors are not Gaussian in xyz: choose 'image', or one iteration"
            )

    def with_overrides(self, overrides: Mapping[str, Mapping[str, Any]]) -> Config:
        """Return this configuration with ``{table: {key: value}}`` replaced; None values are skipped.

        Settings of a state block replace those of the same block and leave its others and all other blocks. Settings
        in `RETIRED` are skipped, too, with a `RetiredSettingWarning`.

        Raises:
            ConfigError: An unknown table or key, or a value of the wrong kind or range.
        """
        tables = dict(vars(self))
        for table, values in overrides.items():
            if table not in tables:
                raise ConfigError(f"unknown table [{table}]; known: {', '.join(tables)}")
            _require_table(table, values)
            values = _without_retired(table, values)
            if table == "blocks":
                tables[table] = _replaced_blocks(self.blocks, values)
            elif table == "tuning":
                tables[table] = {**self.tuning, **_given(values)}
            else:
                tables[table] = _replaced(table, tables[table], values)
        return Config(**tables)

    @staticmethod
    def from_toml(path: str | Path) -> Config:
        """Defaults overridden by a TOML file with the tables that are the fields of `Config`.

        Raises:
            ConfigError: The file is missing, is not TOML, or holds something unknown.
        """
        try:
            require_file(path, is_text=True)
            text = Path(path).read_text(encoding="utf-8")
            return Config().with_overrides(tomllib.loads(text))
        except UnknownFormatError as error:  # names the file
            raise ConfigError(str(error)) from None
        except (OSError, ValueError, RecursionError, ConfigError) as error:  # ValueError: no UTF-8, no TOML
            raise ConfigError(f"{path}: {error}") from None


def require_setting(name: str, value: object, is_scale: bool = False) -> None:
    """Raise a `ConfigError` unless a value is a finite standard deviation, or a positive time or length."""
    (_POSITIVE if is_scale else _FINITE)["rule"].check(name, value)


def check_stored(tables: Mapping[str, Any]) -> None:
    """Raise a `ConfigError` where what a result was stored with breaks today's rules; keys unknown today may stand."""
    defaults = Config()
    for setting in dataclasses.fields(Config):
        settings = tables.get(setting.name, {})
        _require_table(setting.name, settings)
        if setting.name == "blocks":
            _check_blocks(settings)
            continue
        if setting.name == "tuning":
            _check_record(_given(settings))
            continue
        for known in dataclasses.fields(type(getattr(defaults, setting.name))):
            value = settings.get(known.name)
            if value is not None:
                known.metadata["rule"].check(f"{setting.name}.{known.name}", value)


def _without_retired(table: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a table that still exist, with a warning for each that does not."""
    retired = {key: RETIRED[f"{table}.{key}"] for key in values if f"{table}.{key}" in RETIRED}
    for key, note in retired.items():
        warnings.warn(f"{table}.{key} is ignored: {note}", RetiredSettingWarning, stacklevel=3)
    return {key: value for key, value in values.items() if key not in retired}


def _require_table(name: str, value: object) -> None:
    if not isinstance(value, Mapping):
        raise ConfigError(f"[{name}] must be a table, found {value!r}")


def _check_table(table: str, settings: Any) -> None:
    """Raise a `ConfigError` where a setting breaks its rule; None is allowed where it is the default."""
    for setting in dataclasses.fields(settings):
        value = getattr(settings, setting.name)
        if value is not None or setting.default is not None:
            setting.metadata["rule"].check(f"{table}.{setting.name}", value)


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
    """Raise a `ConfigError` where this is no table of tables of plain values."""
    _require_table("blocks", blocks)
    for name, settings in blocks.items():
        _require_table(f"blocks.{name}", settings)
        for key, value in settings.items():
            if not isinstance(value, BlockSetting) or value != value:  # NaN alone differs from itself
                raise ConfigError(f"blocks.{name}.{key} must be a number, a string or a truth value, found {value!r}")


def _replaced(table: str, settings: Any, values: Mapping[str, Any]) -> Any:
    """The settings of a table with the given values, those that are None left out."""
    rules = {setting.name: setting.metadata["rule"] for setting in dataclasses.fields(settings)}
    for key in values:
        if key not in rules:
            raise ConfigError(f"unknown key {table}.{key}; known: {', '.join(rules)}")
    given = {key: rules[key].plain(value) for key, value in _given(values).items()}
    return dataclasses.replace(settings, **given)


def _replaced_blocks(blocks: Mapping[str, Any], values: Mapping[str, Any]) -> Mapping[str, Any]:
    """The same for state blocks, one by one."""
    merged = dict(blocks)
    for name, settings in values.items():
        _require_table(f"blocks.{name}", settings)
        merged[name] = {**blocks.get(name, {}), **_given(settings)}
    return merged
