"""`tune`: the noise under which a recording's innovations are most likely, found without truth.

A filter that assumes the right noise predicts every observation with the right covariance. The log-likelihood of the
parameters is the sum over frames of ``log N(r; 0, S)``, innovation r and its covariance S: the prediction error
decomposition (Schweppe, "Evaluation of likelihood functions for Gaussian signals", IEEE Trans. Information Theory 11,
1965).

What a filter accepts depends on the parameters, so every observation must count whether it is accepted or not:

    log L = sum over accepted     log N(r; 0, S) + log(1 - e)
          + sum over rejected     log(e / w^3)

with a share e of wrong matches that fall anywhere within a window of w px in each of the three rows. Without the second
sum the maximum would be at no noise at all, with everything rejected. An observation that starts a landmark counts as 0
(its prior is flat), one that is rejected and splits its track is rejected first. Observations screened by their pixels
alone are so under all parameters, and are left out. So are tracks that travel with the rig: they are told once, under
the noise assumed without tuning.

The maximum over the logarithms of the parameters is found in rounds. Each decides anew, at the parameters so far, which
observations are wrong matches (judged by each other: velocities count for little there, or the noisiest frames would
be thrown away whole), and with these left out and no gate makes one Newton step: what is accepted is then the same for
all runs of a round, and the likelihood as smooth as the filter is. A step after which log L, with all that is rejected
by then, is less than before is halved. (With the gate inside of the likelihood, half a
frame is turned down at once where a velocity is off by three deviations, and the maximum is where that happens least.)

What it can say on real tracks is limited. Errors of tracks agree among tracks for many frames, which no model here
knows. So it wants far less pixel noise than serves the estimate, and what then does not fit is
laid at the door of the velocities. Standard errors are therefore those of the `sandwich`: where the model holds, they
are the inverse Hessian's, elsewhere the scatter of the frames' gradients makes them larger. Weighted by these,
likelihood and the differences of the velocities (`ekfslam.models.noise`) are put together. Both know the velocities, so
that the error of the two together is a little too small where they are in the state (`Noise.twist_walk_std`) and their
own innovations count, too.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.config import Config, NoiseConfig, NoiseModel
from ekfslam.data.hygiene import clean_tracks
from ekfslam.data.sequence import Noise, Observations, Sequence
from ekfslam.data.stretches import cut
from ekfslam.errors import EmptyTracksError
from ekfslam.evaluation.tables import MISSING, document, markdown_table
from ekfslam.filters.dead_reckoning import dead_reckon
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import one_thread, run_filter, solvable
from ekfslam.filters.reports import FrameReport
from ekfslam.geometry import se3
from ekfslam.models.build import optional_blocks
from ekfslam.models.noise import NOISY_FROM, VelocityNoise, velocity_noise, with_drift, with_error
from ekfslam.models.sensors.base import BEHIND_CAMERA, GATE, MOVING
from ekfslam.models.sensors.stereo import Rig
from ekfslam.names import printable
from ekfslam.progress import progress
from ekfslam.resolve import found_attributes, noise_of, settings_of

# Of wrong matches: how many there are, and how far off they may be.
OUTLIER_SHARE = 0.02
OUTLIER_WINDOW_PX = 100.0

_LOG_WRONG = float(np.log(OUTLIER_SHARE) - 3 * np.log(OUTLIER_WINDOW_PX))
_LOG_RIGHT = float(np.log1p(-OUTLIER_SHARE))
_WRONG = (GATE, BEHIND_CAMERA, MOVING)  # rejected for what the filter believes, not for what the pixels are

# What is looked for: its unit, and the range it is looked for in.
PARAMETERS = {
    "sigma_v_m_s": ("m/s", (1e-3, 10.0)),
    "sigma_w_rad_s": ("rad/s", (1e-5, 1.0)),
    "sigma_px": ("px", (0.05, 10.0)),
    "drift": ("px", (0.01, 3.0)),
}

_STRETCH = 50  # frames, of which there are as many as keep below the limit of observations
_LEAST_STRETCHES = 3
_MOST_ROUNDS = 12
_DIFFERENCE = 0.05  # of the logarithms, for derivatives
_LONGEST_STEP = 0.7
_SHORTEST_STEP = 0.05  # is the last: Newton's method leaves about its square
_LOOSE = 3.0  # factor on the noise of the velocities where wrong matches are told
_BLOCK = 10  # frames whose gradients may be correlated
_NEVER = 1e9  # deviations beyond which a track moves


@dataclass(frozen=True)
class Estimate:
    """One parameter.

    Args:
        name: As in `NoiseConfig`.
        value: The estimate, in the unit of `PARAMETERS`: likelihood and differences together, weighted by their errors.
        error: Its standard error; None where there is none.
        likely, likely_error: What the likelihood says alone; None where it was not asked, or has no maximum.
        remark: Why not, or what else is to be said.
    """

    name: str
    value: float
    error: float | None
    likely: float | None = None
    likely_error: float | None = None
    remark: str = ""


@dataclass(frozen=True)
class TunedNoise:
    """What `tune` found.

    Args:
        sequence: Name of the recording.
        model: That the estimates belong to, as in `NoiseConfig`: ``tuned`` or ``white``.
        estimates: The parameters, those that the likelihood did not look for included.
        found: What the differences of the velocities say.
        log_likelihood: At its maximum, without what the differences say.
        frames, runs: How many frames were filtered, and how many times.
        converged: False where the limit of runs came first.
    """

    sequence: str
    model: str
    estimates: tuple[Estimate, ...]
    found: VelocityNoise
    log_likelihood: float
    frames: int
    runs: int
    converged: bool

    @property
    def config(self) -> Config:
        """Settings to run with: the noise found, and the record of it."""
        values = {estimate.name: estimate.value for estimate in self.estimates}
        errors = {f"{estimate.name}_error": estimate.error for estimate in self.estimates}
        record = {
            "sequence": self.sequence,
            "frames": self.frames,
            "runs": self.runs,
            "log_likelihood": self.log_likelihood,
            **values,
            **errors,
            **found_attributes(self.found),
            "remarks": "; ".join(self.remarks) or None,
        }
        return Config().with_overrides({"noise": {"model": self.model, **values}, "tuning": record})

    @property
    def remarks(self) -> tuple[str, ...]:
        """What is to be said of the maximum, one sentence each."""
        remarks = [f"{estimate.name}: {estimate.remark}" for estimate in self.estimates if estimate.remark]
        if not self.converged:
            remarks.append(f"stopped after {self.runs} runs before the maximum was found")
        return tuple(remarks)

    @property
    def toml(self) -> str:
        """`config` as a TOML file: what of it is not a default."""
        lines = [toml_heading(self.sequence)]
        for table, values in (("noise", vars(self.config.noise)), ("tuning", self.config.tuning)):
            lines += ["", f"[{table}]"]
            lines += [f"{key} = {_toml_value(value)}" for key, value in values.items() if value is not None]
        return "\n".join(lines) + "\n"

    @property
    def table(self) -> str:
        """Estimates, their errors and units, by differences, by likelihood and together, as a Markdown table."""
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


def _toml_value(value: float | str) -> str:
    if isinstance(value, float):
        return repr(value)  # TOML spells inf and nan as Python does
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def toml_heading(sequence: str) -> str:
    """The first line of `TunedNoise.toml` for a recording of some name."""
    return f"# Noise of {printable(sequence)} as `ekfslam tune` found it; give this file to --config."


_NO_PART = "the likelihood does not depend on it where tracks err; not refined"
_UNSEEN = "the differences see none; not refined"
_BELOW_FLOOR = "below the errors of the motion that are assumed anyway; not refined"


@solvable()
def tune(
    sequence: Sequence, config: Config | None = None, *, drift: bool = False, observations: int = 15_000
) -> TunedNoise:
    """The noise under which the innovations of the joint filter are most likely.

    Looked for are the pixel noise, the white noise of the velocities where the differences find more of it than is
    there anyway, and on request the drift of tracks. All else of the noise is what `noise_of` says, the sigmas that the
    recording states excepted. They start from the differences of the velocities,
    and from twice the pixel noise assumed elsewhere: who starts with too little has good matches thrown away.

    Args:
        sequence: The recording; its truth is not looked at.
        config: Settings of the filter, and the model of the noise; sigmas in it are ignored.
        drift: Look for the drift of the tracks, too.
        observations: A longer recording is cut into stretches of 50 frames, evenly spread over it, with about this
            many observations together. Each is filtered on its own, from dead reckoning's pose, which is certain.

    Raises:
        EmptyTracksError: The recording has no observations.
        InnovationError: The filter breaks down.
    """
    if len(sequence.observations) == 0:
        raise EmptyTracksError("noise is tuned by observations, and there are none", source=sequence.source)
    config = settings_of(sequence, config or Config())
    model: NoiseModel = "white" if config.noise.model == "white" else "tuned"
    base = noise_of(sequence, dataclasses.replace(config, noise=NoiseConfig(model=model, drift=config.noise.drift)))
    found = velocity_noise(sequence.twist)
    start, free = _looked_for(base, found, drift)
    parts, gated, ungated = parts_of(sequence, config, base, observations)
    frames = sum(len(part) for part in parts)
    with one_thread():
        if not free:
            here = sum(float(log_likelihoods(part, base, gated).sum()) for part in parts)
            given = tuple(_as_it_is(name, start[name], found) for name in start)
            return TunedNoise(sequence.name, model, given, found, here, frames, len(parts), converged=True)
        problem = _Problem(parts, base, free, gated, ungated)
        peak = _climbed(problem, start, f"{sequence.name}: tuning")
    return TunedNoise(
        sequence=sequence.name,
        model=model,
        estimates=_estimates(start, free, peak, found),
        found=found,
        log_likelihood=peak.log_likelihood,
        frames=frames,
        runs=peak.runs,
        converged=peak.converged,
    )


def _looked_for(base: Noise, found: VelocityNoise, drift: bool) -> tuple[dict[str, float], list[str]]:
    """Where parameters start, and which of them the likelihood is asked for."""
    floor = base.motion_std[[0, 3]] if base.track_error is None else NOISY_FROM[[0, 3]]
    start = {
        "sigma_v_m_s": found.sigma[0] or base.twist_std[0],
        "sigma_w_rad_s": found.sigma[1] or base.twist_std[3],
        "sigma_px": (2.0 if base.track_error is None else 1.0) * float(base.pixel_std_px.mean()),
    }
    free = [name for name, sigma, least in zip(start, found.sigma, floor, strict=False) if sigma > least or not least]
    if base.track_error is None and not drift:
        free.append("sigma_px")
    if drift:
        start["drift"] = 0.2 if base.track_walk_px is None else float(base.track_walk_px[0])
        free.append("drift")
    return start, free


@dataclass(frozen=True)
class _Problem:
    """What is filtered, under which noise, with which parameters free, with the gate and without it."""

    parts: list[Sequence]
    base: Noise
    free: list[str]
    gated: Config
    ungated: Config

    @property
    def bounds(self) -> Array:
        """(n, 2) of the logarithms of the free parameters."""
        return np.log([PARAMETERS[name][1] for name in self.free])

    def judged(self, x: Array) -> Callable[[Array], Array]:
        """The terms of log L with what is rejected at x left out: of every frame, and last of all that is rejected."""
        noise = _loose(_with(self.base, self.free, x))
        kept, rejected = zip(*(without_rejected(part, noise, self.gated) for part in self.parts), strict=True)

        def terms(x: Array) -> Array:
            noise = _with(self.base, self.free, x)
            by_frame = [log_likelihoods(part, noise, self.ungated) for part in kept]
            return np.concatenate([*by_frame, [sum(rejected) * _LOG_WRONG]])

        return terms


@dataclass(frozen=True)
class _Peak:
    """The maximum of the likelihood: logarithms x (n,), and which of them lie ``inside`` of their bounds (m,).

    Of these are the Hessian H (m, m) and the gradients (m, T) of the frames.
    """

    x: Array
    inside: IntArray
    H: Array
    gradients: Array
    log_likelihood: float
    runs: int
    converged: bool


def _climbed(problem: _Problem, start: dict[str, float], label: str) -> _Peak:
    """The maximum, found in rounds as the module's docstring says."""
    bounds = problem.bounds
    x = np.clip(np.log([start[name] for name in problem.free]), *bounds.T)
    best, step, here, converged, runs = x, np.zeros(len(x)), -np.inf, False, 0
    for _ in progress(range(_MOST_ROUNDS), label, unit="round"):
        terms = problem.judged(x)
        now = terms(x)
        runs += 2
        if now.sum() <= here:
            step = step / 2  # more was thrown away than the rest has won
        else:
            here, best, at_best = float(now.sum()), x, terms
            gradients, curvature, beside = _derivatives(terms, x, here)
            gradient = gradients.sum(axis=1)
            runs += 2 * len(x)
            step = np.clip(gradient / np.maximum(np.abs(curvature), 1e-9), -_LONGEST_STEP, _LONGEST_STEP)
            step = np.clip(x + step, *bounds.T) - x
        x = best + step
        if np.abs(step).max() < _SHORTEST_STEP:
            converged = True
            break
    H = _hessian(at_best, best, here, curvature, beside)
    runs += len(x) * (len(x) - 1) // 2
    x = x if converged else best
    inside = np.flatnonzero((x > bounds[:, 0]) & (x < bounds[:, 1]))
    return _Peak(x, inside, H[np.ix_(inside, inside)], gradients[inside, :-1], here, runs, converged)


def _estimates(start: dict[str, float], free: list[str], peak: _Peak, found: VelocityNoise) -> tuple[Estimate, ...]:
    """All parameters with their standard errors: likelihood and differences, each alone and together."""
    likely: dict[str, tuple[float, float]] = {}
    together, errors = np.exp(peak.x), np.full(len(free), np.nan)
    if len(peak.inside) and np.linalg.eigvalsh(peak.H)[-1] < 0:
        names = [free[i] for i in peak.inside]
        C = sandwich(peak.H, peak.gradients)
        alone = together[peak.inside], np.sqrt(np.diag(C))
        likely = {name: (value, value * error) for name, value, error in zip(names, *alone, strict=True)}
        x, C = with_differences(peak.x[peak.inside], C, names, found)
        together[peak.inside] = np.exp(x)
        errors[peak.inside] = together[peak.inside] * np.sqrt(np.diag(C))
    pairs = zip(found.sigma.tolist(), found.sigma_error.tolist(), strict=True)
    differences = dict(zip(PARAMETERS, pairs, strict=False))
    estimates = []
    for name in start:
        sigma, sigma_error = differences.get(name, (0.0, 0.0))
        if name not in free:
            estimates.append(_as_it_is(name, start[name], found))
            continue
        i = free.index(name)
        if name in likely:
            value, error = likely[name]
            apart = abs(value - sigma) / np.hypot(error, sigma_error)
            remark = f"likelihood and differences are {apart:.1f} standard errors apart" if sigma and apart > 3 else ""
            a, b, c, d = (float(f"{number:.6g}") for number in (together[i], errors[i], value, error))
            estimates.append(Estimate(name, a, b, c, d, remark))
        else:
            at_bound = i not in peak.inside
            remark = "at the bound of what is looked for" if at_bound else "the likelihood has no maximum here"
            value = float(f"{together[i]:.6g}")
            estimates.append(Estimate(name, sigma or value, sigma_error or None, value, remark=remark))
    return tuple(estimates)


def _as_it_is(name: str, start: float, found: VelocityNoise) -> Estimate:
    """A parameter that the likelihood is not asked for."""
    if name == "sigma_px":
        return Estimate(name, start, None, remark=_NO_PART)
    i = list(PARAMETERS).index(name)
    sigma, error = float(found.sigma[i]), float(found.sigma_error[i])
    return Estimate(name, sigma, error or None, remark=_BELOW_FLOOR if sigma else _UNSEEN)


def log_likelihoods(sequence: Sequence, noise: Noise, config: Config) -> Array:
    """Log-likelihood of a noise, frame by frame (T,): of the joint filter's innovations, see the module's docstring.

    Args:
        sequence: Filtered from its first frame to its last.
        noise: What the filter assumes; that of the sequence and of the configuration is not looked at.
        config: Resolved settings of the filter.

    Raises:
        InnovationError: The filter breaks down.
    """
    return penalised(filter_reports(sequence, noise, config))


def penalised(reports: list[FrameReport]) -> Array:
    """Log-likelihoods (T,) of frames, all that was rejected included, see the module's docstring."""
    rejected = np.array([np.isin(report.reason, _WRONG).sum() + len(report.split) for report in reports])
    accepted = np.array([report.log_likelihood + report.dof // 3 * _LOG_RIGHT for report in reports])
    return accepted + rejected * _LOG_WRONG


def filter_reports(sequence: Sequence, noise: Noise, config: Config) -> list[FrameReport]:
    """What a filter that assumes a noise, and has the state blocks of a configuration, did with every frame.

    What comes back starts afresh.
    """
    rig = Rig(sequence.camera, sequence.T_cam_imu, noise)
    start, blocks = sequence.initial_T_world_imu, optional_blocks(config.blocks)
    ekf = JointEKF(rig, config.filter, start, calibration=config.calibration, blocks=blocks)
    return [frame.report for frame in run_filter(ekf, sequence)]


def without_rejected(
    sequence: Sequence, noise: Noise, config: Config, reasons: tuple[int, ...] = _WRONG
) -> tuple[Sequence, int]:
    """A sequence without the observations that a filter rejects for some of its reasons, and how many these are.

    A track that is split goes on under an id of its own, and counts as one more.

    Raises:
        InnovationError: The filter breaks down.
    """
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


def sandwich(H: Array, scores: Array) -> Array:
    """Covariance (n, n) of an estimate at the maximum of the likelihood, also where the model is not quite right.

    With A = -H and J the covariance of the gradient it is ``A^-1 J A^-1`` (Huber 1967; White, "Maximum likelihood
    estimation of misspecified models", Econometrica 50, 1982), scaled up where its diagonal is less than that of
    ``A^-1``. J comes from the scatter of the gradients of blocks of 10 frames. What is correlated for longer, it
    misses, and all that is wrong everywhere alike.

    Args:
        H: (n, n) Hessian, negative definite.
        scores: (n, T) gradient of the log-likelihood of each frame.
    """
    inverse = np.linalg.inv(-H)
    centred = scores - scores.mean(axis=1, keepdims=True)
    blocks = np.add.reduceat(centred, np.arange(0, centred.shape[1], _BLOCK), axis=1)
    count = blocks.shape[1]
    C = inverse @ (blocks @ blocks.T * (count / max(count - 1, 1))) @ inverse
    scale = np.sqrt(np.maximum(1.0, np.diag(inverse) / np.maximum(np.diag(C), np.finfo(float).tiny)))
    return np.where(np.diag(C).min() > 0, C * np.outer(scale, scale), inverse)


def with_differences(x: Array, C: Array, names: list[str], found: VelocityNoise) -> tuple[Array, Array]:
    """Logarithms (n,) of parameters and their covariance (n, n), together with what the differences say of them.

    Both are taken as independent, though the likelihood has seen the velocities, too.
    """
    at, value, variance = [], [], []
    for name, sigma, error in zip(PARAMETERS, found.sigma, found.sigma_error, strict=False):
        if name in names and sigma > 0 and np.isfinite(error):
            at.append(names.index(name))
            value.append(np.log(sigma))
            variance.append((error / sigma) ** 2)
    gain = C[:, at] @ np.linalg.inv(C[np.ix_(at, at)] + np.diag(variance))
    return x + gain @ (np.array(value) - x[at]), C - gain @ C[at]


def _settings(config: Config) -> tuple[Config, Config, Config]:
    """The filter's settings to tell moving tracks by, wrong matches, and those where nothing is rejected."""
    # A landmark that comes back would cost a smoothing each time; it starts afresh. The first pose is certain.
    gated = dataclasses.replace(
        config.filter,
        revive=-1,
        initial_position_std_m=0.0,
        initial_rotation_std_rad=0.0,
        moving_sigma=_NEVER,
    )
    moving = dataclasses.replace(gated, moving_sigma=config.filter.moving_sigma, split_after=0)
    ungated = dataclasses.replace(gated, gate_probability=1.0, split_after=0)
    first, second, third = (dataclasses.replace(config, filter=settings) for settings in (moving, gated, ungated))
    return first, second, third


def parts_of(
    sequence: Sequence, config: Config, base: Noise, observations: int
) -> tuple[list[Sequence], Config, Config]:
    """Stretches of a recording, its moving tracks left out; settings that tell wrong matches, and that reject nothing.

    Args:
        sequence, config, observations: As for `stretches`.
        base: The noise by which tracks are found to move.
    """
    moving, gated, ungated = _settings(config)
    parts = [without_rejected(part, base, moving, (MOVING,))[0] for part in stretches(sequence, config, observations)]
    return parts, gated, ungated


def stretches(sequence: Sequence, config: Config, observations: int) -> list[Sequence]:
    """A recording as it is filtered by `tune`: whole if it is small, else stretches spread evenly over it.

    Tracks are cleaned as in every run. Poses are those of dead reckoning, and the first of a stretch
    is its truth by definition: nothing else of the truth is left.

    Args:
        sequence: The recording.
        config: Resolved settings.
        observations: About as many observations are in the stretches together.
    """
    noise = noise_of(sequence, config)
    tracks, _ = clean_tracks(sequence, noise, config.hygiene)
    T_imu_world, _ = dead_reckon(sequence, noise, config.filter.initial_covariance)
    T_world_imu = se3.inverse(T_imu_world)
    frames = len(sequence)
    count = max(int(observations * frames / len(tracks)) // _STRETCH, _LEAST_STRETCHES)
    begins, length = np.zeros(1, dtype=np.int64), frames
    if count * _STRETCH < frames:
        begins, length = np.linspace(0, frames - _STRETCH, count).astype(np.int64), _STRETCH
    cleaned = dataclasses.replace(sequence, observations=tracks)
    parts = (cut(cleaned, begin, begin + length, T_world_imu[begin]) for begin in begins.tolist())
    return [part for part in parts if part is not None]


def _with(base: Noise, names: list[str], x: Array) -> Noise:
    """The noise with some parameters replaced, given by their logarithms (n,)."""
    value = dict(zip(names, np.exp(x).tolist(), strict=True))
    twist = np.array(base.twist_std, dtype=float)
    twist[:3] = value.get("sigma_v_m_s", twist[0])
    twist[3:] = value.get("sigma_w_rad_s", twist[3])
    pixels = np.full(4, value["sigma_px"]) if "sigma_px" in value else base.pixel_std_px
    noise = dataclasses.replace(base, twist_std=twist, pixel_std_px=pixels)
    return with_drift(noise, value["drift"]) if "drift" in value else noise


def _loose(noise: Noise) -> Noise:
    """The noise with velocities that are worth little: wrong is a match that other matches disagree with."""
    return dataclasses.replace(noise, twist_std=_LOOSE * noise.twist_std, motion_std=_LOOSE * noise.motion_std)


def _derivatives(function: Callable[[Array], Array], x: Array, here: float) -> tuple[Array, Array, Array]:
    """Central differences of a sum of m terms, a function of x (n,) to (m,).

    Args:
        function: The terms.
        x: Where.
        here: The sum at x.

    Returns:
        First differences (n, m) of the terms; second ones (n,) of the sum; the sum (n,) one step ahead.
    """
    steps = _DIFFERENCE * np.eye(len(x))
    ahead, behind = (np.array([function(x + sign * step) for step in steps]) for sign in (1.0, -1.0))
    sums = ahead.sum(axis=1), behind.sum(axis=1)
    return (ahead - behind) / (2 * _DIFFERENCE), (sums[0] + sums[1] - 2 * here) / _DIFFERENCE**2, sums[0]


def _hessian(function: Callable[[Array], Array], x: Array, here: float, diagonal: Array, ahead: Array) -> Array:
    """Second differences (n, n) of a sum of terms, given what `_derivatives` found."""
    H = np.diag(diagonal)
    steps = _DIFFERENCE * np.eye(len(x))
    for i in range(len(x)):
        for j in range(i):
            both = float(function(x + steps[i] + steps[j]).sum())
            H[i, j] = H[j, i] = (both + here - ahead[i] - ahead[j]) / _DIFFERENCE**2
    return H
