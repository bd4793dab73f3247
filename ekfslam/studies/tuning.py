"""Tune the noise of a recording: find the noise under which its innovations are most likely, without truth.

The log-likelihood is the prediction error decomposition, the sum of ``log N(r; 0, S)`` over frames (Schweppe,
"Evaluation of likelihood functions for Gaussian signals", IEEE Trans. Information Theory 11, 1965), with a term for
each rejected observation, see `penalised`. `Likelihood.climb` finds its maximum, `sandwich` the standard errors.
`with_differences` combines both with the differences of the velocities (`ekfslam.models.noise`). The likelihood knows
the velocities, too, so the combined error is slightly too small with velocities in the state.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.config import Config, NoiseConfig, NoiseModel
from ekfslam.data.sequence import Noise, Observations, Sequence, cut
from ekfslam.errors import EmptyTracksError
from ekfslam.evaluation.tables import MISSING, document, markdown_table
from ekfslam.filters.dead_reckoning import dead_reckon
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import one_thread, run_filter, solvable
from ekfslam.filters.reports import FrameReport
from ekfslam.geometry import se3
from ekfslam.models.build import optional_blocks
from ekfslam.models.noise import NOISY_FROM, VelocityNoise, with_drift, with_error
from ekfslam.models.sensors.base import BEHIND_CAMERA, GATE, MOVING
from ekfslam.models.sensors.stereo import Rig
from ekfslam.names import printable
from ekfslam.progress import progress
from ekfslam.resolve import found_attributes, noise_of, noise_of_velocities, resolve, settings_of
from ekfslam.smoother.fixed_lag import FixedLag

# Share of wrong matches, and the window in which they fall.
OUTLIER_SHARE = 0.02
OUTLIER_WINDOW_PX = 100.0
LOG_WRONG = float(np.log(OUTLIER_SHARE) - 3 * np.log(OUTLIER_WINDOW_PX))
_LOG_RIGHT = float(np.log1p(-OUTLIER_SHARE))
_WRONG = (GATE, BEHIND_CAMERA, MOVING)  # rejected because of the filter's belief, not because of the pixels alone

# Parameters with unit and search range. The first two are also found by differences.
PARAMETERS = {
    "sigma_v_m_s": ("m/s", (1e-3, 10.0)),
    "sigma_w_rad_s": ("rad/s", (1e-5, 1.0)),
    "sigma_px": ("px", (0.05, 10.0)),
    "drift": ("px", (0.01, 3.0)),
}

STRETCH_FRAMES = 50
_LEAST_STRETCHES = 3
_MOST_ROUNDS = 12
_DIFFERENCE = 0.05  # of the logarithms, for derivatives
_LONGEST_STEP = 0.7
_SHORTEST_STEP = 0.05  # the last step: Newton's method leaves about its square
_LOOSE = 3.0  # factor on the noise of the velocities while wrong matches are found
_BLOCK = 10  # frames whose gradients may be correlated
_NEVER = 1e9  # deviations beyond which a track moves

_NO_PART = "the likelihood does not depend on it where tracks err; not refined"
_UNSEEN = "the differences see none; not refined"
_AT_BOUND = "at the bound of the search range"
_BELOW_FLOOR = "below the errors of the motion that are assumed anyway; not refined"


@dataclass(frozen=True)
class Estimate:
    """Estimate of a parameter of `PARAMETERS` with its error, combined and by likelihood (if searched)."""

    name: str
    value: float
    error: float | None
    likely: float | None = None
    likely_error: float | None = None
    remark: str = ""


@dataclass(frozen=True)
class TunedNoise:
    """Result of `tune`."""

    sequence: str  # name of the recording
    model: str  # model of the noise as in `NoiseConfig`: tuned or white
    estimates: tuple[Estimate, ...]  # all parameters, searched by likelihood or not
    found: VelocityNoise  # noise of the velocities by their differences
    log_likelihood: float  # maximum of the likelihood alone
    frames: int  # number of frames in a run
    runs: int  # number of runs
    converged: bool  # whether the maximum was found within the limit of runs

    @property
    def config(self) -> Config:
        """Settings with the tuned noise and the record of its origin."""
        values = {estimate.name: estimate.value for estimate in self.estimates}
        errors = {f"{estimate.name}_error": estimate.error for estimate in self.estimates}
        record = {name: getattr(self, name) for name in ("sequence", "frames", "runs", "log_likelihood")}
        record |= {**values, **errors, **found_attributes(self.found), "remarks": "; ".join(self.remarks) or None}
        return Config().with_overrides({"noise": {"model": self.model, **values}, "tuning": record})

    @property
    def remarks(self) -> tuple[str, ...]:
        """Remarks on the maximum, one sentence each."""
        late = () if self.converged else (f"stopped after {self.runs} runs before the maximum was found",)
        return (*(f"{estimate.name}: {estimate.remark}" for estimate in self.estimates if estimate.remark), *late)

    @property
    def toml(self) -> str:
        """`config` as a TOML file, without defaults."""
        lines = [toml_heading(self.sequence)]
        for table, values in (("noise", vars(self.config.noise)), ("tuning", self.config.tuning)):
            lines += ["", f"[{table}]"]
            lines += [f"{key} = {toml_value(value)}" for key, value in values.items() if value is not None]
        return "\n".join(lines) + "\n"

    @property
    def table(self) -> str:
        """Estimates by differences, by likelihood and combined, with errors and units, as a Markdown table."""
        differences = dict(zip(PARAMETERS, self.found.texts, strict=False))
        rows = []
        for estimate in self.estimates:
            likely = MISSING if estimate.likely is None else with_error(estimate.likely, estimate.likely_error)
            found = differences.get(estimate.name, MISSING)
            together = found if estimate.likely is None else with_error(estimate.value, estimate.error)
            rows.append([estimate.name, PARAMETERS[estimate.name][0], found, likely, together])
        headings = ("parameter", "unit", "by differences", "by likelihood", "together")
        fit = f"model {self.model}, log-likelihood {self.log_likelihood:.1f}, {self.runs} runs of {self.frames} frames"
        return document(markdown_table(headings, rows, left=len(headings)), "\n".join([fit, *self.remarks])).rstrip()


def toml_value(value: float | str) -> str:
    """Return a number or a text in TOML."""
    if isinstance(value, float):
        return repr(value)  # TOML spells inf and nan as Python does
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def toml_heading(sequence: str) -> str:
    """Return the first line of `TunedNoise.toml` for the name of a recording."""
    return f"# Noise of {printable(sequence)} as `ekfslam tune` found it; give this file to --config."


@one_thread()
@solvable()
def tune(
    sequence: Sequence, config: Config | None = None, *, drift: bool = False, observations: int = 15_000
) -> TunedNoise:
    """Find the noise under which the innovations of the joint filter are most likely.

    The parameters are the pixel noise, the white noise of the velocities if the differences find more of it than is
    assumed anyway, and on request the drift of tracks. `noise_of` decides all else, without the stated sigmas.

    Args:
        sequence: Recording; its truth is not used.
        config: Settings of the filter and the model of the noise; sigmas in it are ignored.
        drift: Whether to search the drift of the tracks, too.
        observations: Approximate number of observations used. A longer recording is cut into stretches of 50 frames,
            evenly spread over it. Each is filtered from the pose of dead reckoning, which is taken as certain.

    Raises:
        EmptyTracksError: The recording has no observations.
        InnovationError: The filter breaks down.
    """
    if len(sequence.observations) == 0:
        raise EmptyTracksError("noise is tuned by observations, and there are none", source=sequence.source)
    config = settings_of(sequence, config or Config())
    model: NoiseModel = "white" if config.noise.model == "white" else "tuned"
    base = noise_of(sequence, dataclasses.replace(config, noise=NoiseConfig(model=model, drift=config.noise.drift)))
    found = noise_of_velocities(sequence)
    start, free = _start(base, found, drift)
    parts, gated, ungated = parts_of(sequence, config, base, observations)
    peak = Likelihood(parts, base, free, gated, ungated, found.measured).climb(start, f"{sequence.name}: tuning")
    estimates, frames = estimates_of(start, free, peak, found), sum(len(part) for part in parts)
    return TunedNoise(
        sequence.name, model, estimates, found, peak.log_likelihood, frames, peak.runs, converged=peak.converged
    )


def _start(base: Noise, found: VelocityNoise, drift: bool) -> tuple[dict[str, float], list[str]]:
    """Return the parameters at the start, and the names of those to search."""
    floor = base.motion_std[[0, 3]] if base.track_error is None else NOISY_FROM[[0, 3]]
    start = {
        "sigma_v_m_s": found.sigma[0] or base.twist_std[0],
        "sigma_w_rad_s": found.sigma[1] or base.twist_std[3],
        # White noise starts from twice the usual pixel noise: with too little, good matches would be rejected.
        "sigma_px": (2.0 if base.track_error is None else 1.0) * float(base.pixel_std_px.mean()),
    }
    free = [name for name, sigma, least in zip(start, found.sigma, floor, strict=False) if sigma > least or not least]
    if drift:
        start["drift"] = 0.2 if base.track_walk_px is None else float(base.track_walk_px[0])
        free.append("drift")
    elif base.track_error is None:
        free.append("sigma_px")
    return start, free


# --- The maximum -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Peak:
    """The maximum of a likelihood."""

    x: Array  # (n,) logarithms of the free parameters
    inside: IntArray  # (m,) indices of the parameters inside their search range
    H: Array  # (m, m) Hessian of these
    gradients: Array  # (m, T) gradients of the frames
    log_likelihood: float  # value at the maximum
    runs: int  # number of runs
    converged: bool  # whether the last step was short


@dataclass(frozen=True)
class Likelihood:
    """Likelihood of the innovations as a function of the logarithms of some parameters."""

    parts: list[Sequence]  # stretches of the recording
    base: Noise  # noise whose parameters are replaced
    free: list[str]  # names of the parameters
    gated: Config  # settings of the filter that reject wrong matches
    ungated: Config  # settings that reject nothing
    measured: BoolArray = field(default_factory=lambda: np.ones(6, dtype=bool))  # (6,) velocities with these parameters

    def noise(self, x: Array) -> Noise:
        """Return the noise at logarithms (n,) of the parameters."""
        value = dict(zip(self.free, np.exp(x).tolist(), strict=True))
        twist = np.array(self.base.twist_std, dtype=float)
        for name, kind in (("sigma_v_m_s", slice(3)), ("sigma_w_rad_s", slice(3, 6))):
            twist[kind] = np.where(self.measured[kind], value.get(name, twist[kind]), twist[kind])
        pixels = np.full(4, value["sigma_px"]) if "sigma_px" in value else self.base.pixel_std_px
        noise = dataclasses.replace(self.base, twist_std=twist, pixel_std_px=pixels)
        return with_drift(noise, value["drift"]) if "drift" in value else noise

    def judged(self, x: Array) -> Callable[[Array], Array]:
        """Return the terms of log L as a function: of each frame, and last of the observations rejected at x."""
        noise = self.noise(x)
        # With velocities that say little, a wrong match is one that other matches contradict.
        noise = dataclasses.replace(noise, twist_std=_LOOSE * noise.twist_std, motion_std=_LOOSE * noise.motion_std)
        kept, rejected = zip(*(without_rejected(part, noise, self.gated) for part in self.parts), strict=True)

        def terms(x: Array) -> Array:
            noise = self.noise(x)
            by_frame = [log_likelihoods(part, noise, self.ungated) for part in kept]
            return np.concatenate([*by_frame, [sum(rejected) * LOG_WRONG]])

        return terms

    def climb(self, start: dict[str, float], label: str) -> Peak:
        """Find the maximum in rounds.

        A round first rejects wrong matches, with loose velocities. Then it makes one Newton step without them and
        without a gate: all its runs accept the same observations, so the likelihood is smooth. A step that lowers
        log L, rejected observations included, is halved.
        """
        if not self.free:
            here = sum(float(log_likelihoods(part, self.base, self.gated).sum()) for part in self.parts)
            none, empty = np.zeros(0), np.zeros((0, 0))
            return Peak(none, none.astype(np.int64), empty, empty, here, len(self.parts), converged=True)
        bounds = np.log([PARAMETERS[name][1] for name in self.free])
        x = np.clip(np.log([start[name] for name in self.free]), *bounds.T)
        best, step, here, converged, runs = x, np.zeros(len(x)), -np.inf, False, 0
        steps = _DIFFERENCE * np.eye(len(x))
        for _ in progress(range(_MOST_ROUNDS), label, unit="round"):
            terms = self.judged(x)
            now = terms(x)
            runs += 2
            if now.sum() <= here:
                step = step / 2  # the newly rejected observations cost more than the rest has won
            else:
                here, best, at_best = float(now.sum()), x, terms
                ahead, behind = (np.array([terms(x + sign * step) for step in steps]) for sign in (1.0, -1.0))
                runs += 2 * len(x)
                gradients = (ahead - behind) / (2 * _DIFFERENCE)
                curvature = (ahead.sum(axis=1) + behind.sum(axis=1) - 2 * here) / _DIFFERENCE**2
                step = gradients.sum(axis=1) / np.maximum(np.abs(curvature), 1e-9)
                step = np.clip(x + np.clip(step, -_LONGEST_STEP, _LONGEST_STEP), *bounds.T) - x
            x = best + step
            if np.abs(step).max() < _SHORTEST_STEP:
                converged = True
                break
        H = np.diag(curvature)
        for i, j in zip(*np.tril_indices(len(x), -1), strict=True):
            both = float(at_best(best + steps[i] + steps[j]).sum())
            H[i, j] = H[j, i] = (both + here - ahead[i].sum() - ahead[j].sum()) / _DIFFERENCE**2
            runs += 1
        x = x if converged else best
        inside = np.flatnonzero((x > bounds[:, 0]) & (x < bounds[:, 1]))
        return Peak(x, inside, H[np.ix_(inside, inside)], gradients[inside, :-1], here, runs, converged)


# --- Estimates and their errors --------------------------------------------------------------------------------------


def estimates_of(start: dict[str, float], free: list[str], peak: Peak, found: VelocityNoise) -> tuple[Estimate, ...]:
    """Return all parameters with errors: by likelihood (``free`` ones, at their ``peak``), differences, both."""
    pairs = zip(found.sigma.tolist(), found.sigma_error.tolist(), strict=True)
    differences = dict(zip(PARAMETERS, pairs, strict=False))
    at_peak = dict(zip(free, np.exp(peak.x).tolist(), strict=True))
    combined: dict[str, list[float]] = {}  # value and error, then those of the likelihood alone
    if len(peak.inside) and np.linalg.eigvalsh(peak.H)[-1] < 0:
        names, columns = [free[i] for i in peak.inside], []
        alone = peak.x[peak.inside], sandwich(peak.H, peak.gradients)
        for x, C in (with_differences(*alone, names, found), alone):
            columns += [np.exp(x), np.exp(x) * np.sqrt(np.diag(C))]
        rows = zip(names, np.transpose(columns), strict=True)
        combined = {name: [float(f"{number:.6g}") for number in row] for name, row in rows}
    estimates = []
    for name, value in start.items():
        sigma, sigma_error = differences.get(name, (0.0, 0.0))
        if name in combined:
            value, total_error, likely, error = combined[name]
            apart = abs(likely - sigma) / np.hypot(error, sigma_error)
            remark = f"likelihood and differences are {apart:.1f} standard errors apart" if sigma and apart > 3 else ""
            estimates.append(Estimate(name, value, total_error, likely, error, remark))
        elif name in free:
            remark = "the likelihood has no maximum here" if free.index(name) in peak.inside else _AT_BOUND
            likely = float(f"{at_peak[name]:.6g}")
            estimates.append(Estimate(name, sigma or likely, sigma_error or None, likely, remark=remark))
        else:
            remark = _NO_PART if name == "sigma_px" else _BELOW_FLOOR if sigma else _UNSEEN
            estimates.append(Estimate(name, differences.get(name, (value,))[0], sigma_error or None, remark=remark))
    return tuple(estimates)


def sandwich(H: Array, scores: Array) -> Array:
    """Return the covariance (n, n) of a maximum-likelihood estimate under a model that need not be right.

    With A = -H (n, n) and J the covariance of the gradient it is ``A^-1 J A^-1`` (Huber 1967; White, "Maximum
    likelihood estimation of misspecified models", Econometrica 50, 1982), scaled up where its diagonal is less than
    that of ``A^-1``. J is the scatter of the gradients ``scores`` (n, T) of blocks of 10 frames. It misses longer
    correlations, and errors that all frames share.
    """
    inverse = np.linalg.inv(-H)
    centred = scores - scores.mean(axis=1, keepdims=True)
    blocks = np.add.reduceat(centred, np.arange(0, centred.shape[1], _BLOCK), axis=1)
    count = blocks.shape[1]
    C = inverse @ (blocks @ blocks.T * (count / max(count - 1, 1))) @ inverse
    scale = np.sqrt(np.maximum(1.0, np.diag(inverse) / np.maximum(np.diag(C), np.finfo(float).tiny)))
    return np.where(np.diag(C).min() > 0, C * np.outer(scale, scale), inverse)


def with_differences(x: Array, C: Array, names: list[str], found: VelocityNoise) -> tuple[Array, Array]:
    """Combine logarithms (n,) of parameters, with covariance (n, n), with the differences of the velocities."""
    at, value, variance = [], [], []
    for name, sigma, error in zip(PARAMETERS, found.sigma, found.sigma_error, strict=False):
        if name in names and sigma > 0 and np.isfinite(error):
            at.append(names.index(name))
            value.append(np.log(sigma))
            variance.append((error / sigma) ** 2)
    gain = C[:, at] @ np.linalg.inv(C[np.ix_(at, at)] + np.diag(variance))
    return x + gain @ (np.array(value) - x[at]), C - gain @ C[at]


# --- The likelihood of one noise -------------------------------------------------------------------------------------


def log_likelihoods(sequence: Sequence, noise: Noise, config: Config) -> Array:
    """Return the log-likelihood (T,) of a noise, which replaces that of recording and resolved settings."""
    return penalised(filter_reports(sequence, noise, config))


def penalised(reports: list[FrameReport]) -> Array:
    """Return the log-likelihoods (T,) of frames with their rejected observations.

    What a filter accepts depends on the noise, so rejected observations count, too. Without them the maximum would be
    at no noise, with everything rejected. A share e of wrong matches falls anywhere in a window of w px in each of
    three rows: an accepted match adds ``log(1 - e)``, a rejected one ``log(e / w^3)``. Observations that start a
    landmark count as 0, since its prior is flat. Observations rejected by their pixels alone are left out.
    """
    rejected = np.array([np.isin(report.reason, _WRONG).sum() + len(report.split) for report in reports])
    accepted = np.array([report.log_likelihood + report.dof // 3 * _LOG_RIGHT for report in reports])
    return accepted + rejected * LOG_WRONG


def filter_reports(sequence: Sequence, noise: Noise, config: Config) -> list[FrameReport]:
    """Return the reports of a filter that assumes a noise and has the state blocks of a configuration."""
    rig = Rig(sequence.camera, sequence.T_cam_imu, noise)
    start, blocks = sequence.initial_T_world_imu, optional_blocks(config.blocks)
    ekf = JointEKF(rig, config.filter, start, calibration=config.calibration, blocks=blocks, window=FixedLag)
    return [frame.report for frame in run_filter(ekf, sequence)]


def without_rejected(
    sequence: Sequence, noise: Noise, config: Config, reasons: tuple[int, ...] = _WRONG
) -> tuple[Sequence, int]:
    """Remove the observations that a filter rejects for some reasons, and count them; a split track is one more."""
    reports = filter_reports(sequence, noise, config)
    tracks = sequence.observations
    # Reports are in the order of the observations: by frame and, within a frame, by id.
    keep = ~np.isin(np.concatenate([report.reason for report in reports]), reasons)
    landmark = tracks.landmark.copy()
    for report in reports:
        for old in report.split.tolist():
            landmark[(tracks.landmark == old) & (tracks.frame >= report.frame)] = landmark.max() + 1
    kept = Observations(tracks.frame[keep], landmark[keep], tracks.pixels_px[keep])
    rejected = int((~keep).sum()) + sum(len(report.split) for report in reports)
    return dataclasses.replace(sequence, observations=kept), rejected


def parts_of(
    sequence: Sequence, config: Config, base: Noise, observations: int
) -> tuple[list[Sequence], Config, Config]:
    """Return `stretches` without moving tracks, and settings that reject wrong matches and that reject nothing."""
    # A revival would cost a smoothing each time, so landmarks that return start as new ones. The first pose is certain.
    gated = {"revive": -1, "initial_position_std_m": 0.0, "initial_rotation_std_rad": 0.0, "moving_sigma": _NEVER}
    moving = {**gated, "moving_sigma": config.filter.moving_sigma, "split_after": 0}
    ungated = {**gated, "gate_probability": 1.0, "split_after": 0}
    first, second, third = (config.with_overrides({"filter": settings}) for settings in (moving, gated, ungated))
    parts = [without_rejected(part, base, first, (MOVING,))[0] for part in stretches(sequence, config, observations)]
    return parts, second, third


def stretches(sequence: Sequence, config: Config, observations: int) -> list[Sequence]:
    """Cut a recording into stretches that are spread evenly over it; a small one stays whole.

    Tracks are cleaned as in every run. The first pose of a stretch, by dead reckoning, is its only truth. All stretches
    together have about so many ``observations``.
    """
    noise, tracks = noise_of(sequence, config), resolve(sequence, config, "mapping-only").sequence.observations
    T_imu_world, _ = dead_reckon(sequence, noise, config.filter.initial_covariance)
    T_world_imu = se3.inverse(T_imu_world)
    frames = len(sequence)
    count = max(int(observations * frames / len(tracks)) // STRETCH_FRAMES, _LEAST_STRETCHES)
    begins, length = np.zeros(1, dtype=np.int64), frames
    if count * STRETCH_FRAMES < frames:
        begins, length = np.linspace(0, frames - STRETCH_FRAMES, count).astype(np.int64), STRETCH_FRAMES
    cleaned = dataclasses.replace(sequence, observations=tracks)
    parts = (cut(cleaned, begin, begin + length, T_world_imu[begin]) for begin in begins.tolist())
    return [part for part in parts if part is not None]
