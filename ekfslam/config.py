"""Configuration: defaults in code, overridden by a TOML file, then by flags; stored resolved with every result."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from scipy.special import gammaincinv

from ekfslam.errors import ConfigError

Mode = Literal["dead-reckoning", "mapping-only", "full", "smoothed"]
Variant = Literal["invariant", "fej", "standard"]
Retire = Literal["auto", "unseen", "never"]
Linearisation = Literal["map", "filtered"]
NoiseModel = Literal["auto", "tuned", "white"]
Kernel = Literal["huber", "cauchy", "none"]

MODES: tuple[Mode, ...] = get_args(Mode)
VARIANTS: tuple[Variant, ...] = get_args(Variant)



@dataclass(frozen=True)
class NoiseConfig:
    """Standard deviations per sample; None takes what the sequence states.

    Args:
        sigma_v_m_s: Linear velocity, each axis.
        sigma_w_rad_s: Angular velocity, each axis.
        sigma_px: Pixels.
        drift: How far the error of a track walks in the image from one frame to the next, px; 0 takes pixel noise as
            white, None takes what the model says.
        tilt_deg: Of velocities in a level frame: prior deviation of roll and pitch, which the joint filter estimates; 0
            takes them as velocities of the IMU; None takes what the model says.
        model: ``auto``: where the sequence states no noise and no sigma is given here, it is found from the data, see
            `ekfslam.models.noise`; sigmas given here are those of white noise. ``tuned``: as ``auto``, but sigmas given
            here only replace those found, and the rest of the automatic model stays (drift, misalignment, errors of the
            motion, walk of the velocities): they were found within it, by `ekfslam.studies.tuning`, and mean nothing
            without. ``white``: what is neither stated nor given is that of a clean recording, 0.05 m/s, 0.001 rad/s, 1
            px.
    """

    sigma_v_m_s: float | None = None
    sigma_w_rad_s: float | None = None
    sigma_px: float | None = None
    drift: float | None = None
    tilt_deg: float | None = None
    model: NoiseModel = "auto"


@dataclass(frozen=True)
class HygieneConfig:
    """What becomes of bad tracks before any filter sees them, see `ekfslam.data.hygiene`; false or 0 switches a rule
    off.

    Deviations are those of the pixel noise that the run assumes.

    Args:
        min_disparity_sigma: Observations with less disparity, in deviations of a disparity, are dropped: they have no
            depth. (What has no disparity at all the filters reject anyway.)
        max_row_mismatch_sigma: So are those with larger ``|vL - vR|``, in deviations of that difference.
        restart_at_repeats: Where a frame repeats the pixels of the one before while the rig moves, every track is cut.
        restart_above_px: Of these, tracks that move by no more than this in the frames beside it are not cut: they show
            another point, but one close by. Where velocities are noisy the poses gain by it, the tracks lose.
        jump_sigma: A track is cut where its pixels jump out of its course, and out of that of the frame's other
            tracks, by so many deviations.
        reused_id_sigma: A track is cut where it comes back after a gap so many deviations from where the velocities
            say that it was.
        max_depth_error: Tracks are dropped whose depth is never known better than this, as a share of the depth.
        min_observations: Tracks, or pieces of tracks that were cut, with fewer observations are dropped.

    No rule is for an id that is seen twice in one frame: which of the two is meant nobody can know, so a `Sequence`
    refuses it with a `DuplicateObservationError`.
    """

    min_disparity_sigma: float = 1.0
    max_row_mismatch_sigma: float = 10.0
    restart_at_repeats: bool = True
    restart_above_px: float = 0.0
    jump_sigma: float = 0.0
    reused_id_sigma: float = 3.0
    max_depth_error: float = 0.0
    min_observations: int = 0


@dataclass(frozen=True)
class FilterConfig:
    """How the filters linearise, gate, start and retire landmarks.

    Args:
        variant: Linearisation rule of the joint filter, see `ekfslam.filters.variants`.
        iterations: Gauss-Newton iterations of an update; 1 is the plain EKF. Not for ``fej``.
        retire: ``unseen`` marginalises a landmark when it is out of view, ``never`` keeps all; ``auto`` is ``never``
            for a sequence of at most 300 landmarks some of which come back, else ``unseen``.
        retire_after: Frames without a sighting after which ``unseen`` applies. By default 1, or 10 in a sequence some
            of whose landmarks come back.
        revive: A retired landmark that is seen again comes back with its exact mean, covariance and cross-covariance,
            together with up to this many retired landmarks that were seen nearest to it in time. -1 starts it afresh.
        gate_probability: Chi-square gate on each landmark's three rows, once against the prediction and (joint filter)
            once against the prediction as corrected by the frame's other landmarks; 1 accepts everything.
        split_after: A track is split, its landmark retired and a new one started, when this many observations in a row
            fail the gate (or put it behind the camera): the tracker has jumped to another point. 0 never splits.
        moving_sigma, moving_share: Where tracks may drift (`Noise.landmarks_walk`), one is dropped for good when over
            all its observations it moves along with the rig by more than this share of the way, beyond that many
            deviations (without their `Noise.margin`).
        min_depth_m: Observations of a landmark predicted nearer than this (or behind) are rejected.
        initial_position_std_m: Deviation of the first pose's translation, each axis.
        initial_rotation_std_rad: Deviation of the first pose's rotation, each axis.
    """

    variant: Variant = "invariant"
    iterations: int = 1
    retire: Retire = "auto"
    retire_after: int | None = None
    revive: int = 100
    gate_probability: float = 0.999
    split_after: int = 3
    moving_sigma: float = 3.0
    moving_share: float = 0.1
    min_depth_m: float = 0.1
    initial_position_std_m: float = 0.0
    initial_rotation_std_rad: float = 0.0

    @property
    def gate(self) -> float:
        """Chi-square threshold of the gate, 3 degrees of freedom."""
        return 2.0 * float(gammaincinv(1.5, self.gate_probability))

    @property
    def initial_covariance(self) -> np.ndarray:
        """(6, 6) covariance of the first pose's error ``xi``."""
        return np.diag(np.repeat([self.initial_position_std_m, self.initial_rotation_std_rad], 3) ** 2)


@dataclass(frozen=True)
class CalibrationConfig:
    """What of the calibration the joint filter estimates, as prior deviations; 0 takes it as given.

    Args:
        rotation_deg: Rotation of the camera against the IMU, each axis.
        lever_arm_m: Position of the IMU in the camera frame, each axis.
        baseline: Length of the stereo baseline, as a share of it.
        disparity_px: Offset of all disparities.
        time_s: How much later than stamped the images are exposed.
    """

    rotation_deg: float = 0.0
    lever_arm_m: float = 0.0
    baseline: float = 0.0
    disparity_px: float = 0.0
    time_s: float = 0.0


@dataclass(frozen=True)
class PosteriorConfig:
    """How the posterior over all poses and landmarks is linearised.

    Args:
        linearisation: ``map`` linearises all rows again at the maximum a posteriori, found from the filter's estimate;
            ``filtered`` leaves them where the filter linearised them.
        kernel: Robust kernel on the whitened residual of each observation (``map`` only), see
        `ekfslam.smoother.posterior`. kernel_width: Where it leaves the parabola, in standard deviations. The default is
            exceeded by 5 % of Gaussian residuals.
        max_iterations: Of Levenberg-Marquardt.
        tolerance: It stops when an iteration lowers the cost by a smaller share than this.
    """

    linearisation: Linearisation = "map"
    kernel: Kernel = "huber"
    kernel_width: float = 2.8
    max_iterations: int = 50
    tolerance: float = 1e-6


@dataclass(frozen=True)
class TuningRecord:
    """Where the noise of a tuned file comes from; it decides nothing, but is kept with every result.

    Args:
        sequence: Name of the recording that it was found on.
        frames, runs: How many frames of it were filtered, and how many times.
        log_likelihood: Of the innovations, at the maximum.
        sigma_v_m_s, sigma_w_rad_s, sigma_px, drift: The estimates; those without ``_error`` have none.
        found_sigma_v_m_s, found_sigma_w_rad_s: What the differences of the velocities say alone.
        remarks: What is to be said of the maximum, such as an estimate at its bound.
    """

    sequence: str | None = None
    frames: int | None = None
    runs: int | None = None
    log_likelihood: float | None = None
    sigma_v_m_s: float | None = None
    sigma_v_m_s_error: float | None = None
    sigma_w_rad_s: float | None = None
    sigma_w_rad_s_error: float | None = None
    sigma_px: float | None = None
    sigma_px_error: float | None = None
    drift: float | None = None
    drift_error: float | None = None
    found_sigma_v_m_s: float | None = None
    found_sigma_v_m_s_error: float | None = None
    found_sigma_v_m_s_limit: float | None = None
    found_sigma_w_rad_s: float | None = None
    found_sigma_w_rad_s_error: float | None = None
    found_sigma_w_rad_s_limit: float | None = None
    remarks: str | None = None


@dataclass(frozen=True)
class Config:
    """Everything that decides what a run does besides the data, and the record of what was tuned."""

    noise: NoiseConfig = field(default_factory=NoiseConfig)
    filter: FilterConfig = field(default_factory=FilterConfig)
    posterior: PosteriorConfig = field(default_factory=PosteriorConfig)
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    hygiene: HygieneConfig = field(default_factory=HygieneConfig)
    tuning: TuningRecord = field(default_factory=TuningRecord)
    blocks: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        noise, filter_, posterior = self.noise, self.filter, self.posterior
        for name, value in dataclasses.asdict(noise).items():
            if name != "model" and value is not None and not (np.isfinite(value) and value >= 0):
                raise ConfigError(f"noise.{name} must be finite and not negative, found {value}")
        if noise.sigma_px == 0:
            raise ConfigError("noise.sigma_px must be positive: the innovation covariance would be singular")
        for table, name, value, allowed in (
            ("noise", "model", noise.model, get_args(NoiseModel)),
            ("filter", "variant", filter_.variant, VARIANTS),
            ("filter", "retire", filter_.retire, get_args(Retire)),
            ("posterior", "linearisation", posterior.linearisation, get_args(Linearisation)),
            ("posterior", "kernel", posterior.kernel, get_args(Kernel)),
        ):
            if value not in allowed:
                raise ConfigError(f"{table}.{name} must be one of {', '.join(allowed)}, found {value!r}")
        if not posterior.kernel_width > 0:
            raise ConfigError(f"posterior.kernel_width must be positive, found {posterior.kernel_width}")
        if posterior.max_iterations != int(posterior.max_iterations) or posterior.max_iterations < 1:
            raise ConfigError(
                f"posterior.max_iterations must be a whole number not below 1, found {posterior.max_iterations}"
            )
        if not 0 < posterior.tolerance < 1:
            raise ConfigError(f"posterior.tolerance must be between 0 and 1, found {posterior.tolerance}")
        if not 0 < filter_.gate_probability <= 1:
            raise ConfigError(f"filter.gate_probability must be in (0, 1], found {filter_.gate_probability}")
        for name, smallest in (("split_after", 0), ("iterations", 1), ("retire_after", 1), ("revive", -1)):
            value = getattr(filter_, name)
            if value is None:
                continue
            if value != int(value) or value < smallest:
                raise ConfigError(f"filter.{name} must be a whole number not below {smallest}, found {value}")
        if filter_.variant == "fej" and filter_.iterations > 1:
            raise ConfigError("filter.iterations > 1 contradicts first estimates: choose invariant or standard")
        for name in (
            "moving_sigma",
            "moving_share",
            "min_depth_m",
            "initial_position_std_m",
            "initial_rotation_std_rad",
        ):
            if not getattr(filter_, name) >= 0:
                raise ConfigError(f"filter.{name} must not be negative, found {getattr(filter_, name)}")
        for name, value in dataclasses.asdict(self.calibration).items():
            if not (np.isfinite(value) and value >= 0):
                raise ConfigError(f"calibration.{name} must be finite and not negative, found {value}")
        for name, value in dataclasses.asdict(self.hygiene).items():
            if name != "restart_at_repeats" and not (np.isfinite(value) and value >= 0):
                raise ConfigError(f"hygiene.{name} must be finite and not negative, found {value}")
        if self.hygiene.min_observations != int(self.hygiene.min_observations):
            raise ConfigError(f"hygiene.min_observations must be a whole number, found {self.hygiene.min_observations}")

    def with_overrides(self, overrides: Mapping[str, Mapping[str, Any]]) -> Config:
        """This configuration with ``{table: {key: value}}`` replaced; None values are skipped.

        Raises:
            ConfigError: An unknown table or key, or a value of the wrong type or range.
        """
        tables: dict[str, Any] = {
            "noise": self.noise,
            "filter": self.filter,
            "posterior": self.posterior,
            "calibration": self.calibration,
            "hygiene": self.hygiene,
            "tuning": self.tuning,
        }
        blocks = {name: dict(values) for name, values in self.blocks.items()}
        for table, values in overrides.items():
            if table == "blocks":
                for name, settings in values.items():
                    if not isinstance(settings, Mapping):
                        raise ConfigError(f"[blocks.{name}] must be a table, found {settings!r}")
                    blocks[name] = {**blocks.get(name, {}), **settings}
                continue
            if table not in tables:
                raise ConfigError(f"unknown table [{table}]; known: {', '.join([*tables, 'blocks'])}")
            if not isinstance(values, Mapping):
                raise ConfigError(f"[{table}] must be a table, found {values!r}")
            known = [f.name for f in dataclasses.fields(tables[table])]
            for key, value in values.items():
                if key not in known:
                    raise ConfigError(f"unknown key {table}.{key}; known: {', '.join(known)}")
                is_text = key in ("model", "variant", "retire", "linearisation", "kernel", "sequence", "remarks")
                kind: Any = str if is_text else bool if key == "restart_at_repeats" else (int, float)
                wanted = isinstance(value, kind) and (kind is bool or not isinstance(value, bool))
                if value is not None and not wanted:
                    name = "string" if is_text else "truth value" if kind is bool else "number"
                    raise ConfigError(f"{table}.{key} must be a {name}, found {value!r}")
            given = {key: value for key, value in values.items() if value is not None}
            tables[table] = dataclasses.replace(tables[table], **given)
        return Config(**tables, blocks=blocks)

    @staticmethod
    def from_toml(path: str | Path) -> Config:
        """Defaults overridden by a TOML file with the tables that are the fields of `Config`.

        Raises:
            ConfigError: The file is missing, is not TOML, or holds something unknown.
        """
        try:
            text = Path(path).read_text(encoding="utf-8")
            return Config().with_overrides(tomllib.loads(text))
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, ConfigError) as error:
            raise ConfigError(f"{path}: {error}") from None
