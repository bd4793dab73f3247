"""Choose the structure of a recording's errors and find their sizes, without truth.

A *candidate* is a set of settings: state blocks, white pixels or walking tracks, and first values of the sizes. The
joint filter runs over stretches of the recording under each, and its innovations decide:

- Sizes of what landmarks or frames share are those of the largest log-likelihood, the prediction error decomposition of
  `ekfslam.studies.tuning`, rejected observations included. They are found one after the other, by a parabola through
  three points, see `highest`.
- The size of what is each observation's own is that at which the normalised innovation squared (NIS) is 1 per degree of
  freedom. Likelihood asks for less: it pays to call errors that last for many frames small ones.
- The structure is the one of the largest ``log L - k log(n) / 2``, with k sizes found from n innovations: Schwarz,
  "Estimating the dimension of a model", Annals of Statistics 6, 1978.

The number of runs is bounded, and nothing is random.
"""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as SequenceType
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ekfslam.arrays import Array
from ekfslam.config import Config
from ekfslam.data.sequence import Sequence
from ekfslam.errors import ConfigError, EmptyTracksError, InnovationError
from ekfslam.filters.loop import one_thread
from ekfslam.models.blocks.camera_jitter import CameraJitter
from ekfslam.resolve import noise_of, settings_of
from ekfslam.studies.tuning import filter_reports, parts_of, penalised

Overrides = Mapping[str, Mapping[str, Any]]

_STEPS = (np.log(2.0), np.log(1.5), np.log(1.3))  # of the logarithms, sweep by sweep
_FARTHEST = np.log(50.0)  # that a size may get from where it starts
_LONGEST_NIS_STEP = np.log(4.0)
_NIS_TOLERANCE = 0.05  # of its logarithm
_NIS_RUNS = 4  # to find one size


@dataclass(frozen=True)
class Candidate:
    """A structure of errors, and the sizes to search.

    Args:
        name: In words.
        overrides: Settings ``{table: {key: value}}`` of the structure, with the first values of the sizes.
        by_likelihood: Sizes found by likelihood, such as ``blocks.camera_jitter.rotation_deg``.
        by_nis: Size found by NIS, such as ``noise.sigma_px``; "" for none.
    """

    name: str
    overrides: Overrides = field(default_factory=dict)
    by_likelihood: tuple[str, ...] = ()
    by_nis: str = ""

    @property
    def sizes(self) -> tuple[str, ...]:
        """Names of all sizes to search."""
        return (*self.by_likelihood, *([self.by_nis] if self.by_nis else []))


@dataclass(frozen=True)
class Tried:
    """A candidate with the sizes that were found.

    Args:
        name: Of the candidate.
        overrides: Its settings with these sizes.
        sizes: Those found, by name.
        log_likelihood: Of the innovations; minus infinity where the filter broke down.
        nis_per_dof: Mean NIS of the accepted innovations per degree of freedom.
        dof: Degrees of freedom.
        runs: Number of times that the stretches were filtered.
    """

    name: str
    overrides: Overrides
    sizes: Mapping[str, float]
    log_likelihood: float
    nis_per_dof: float
    dof: int
    runs: int

    @property
    def score(self) -> float:
        """``log L - k log(n) / 2``, the larger the better."""
        return self.log_likelihood - 0.5 * len(self.sizes) * np.log(max(self.dof, 1))

    @property
    def line(self) -> str:
        """The result as one line of text."""
        sizes = "".join(f", {name} {size:.3g}" for name, size in self.sizes.items())
        if not np.isfinite(self.log_likelihood):
            return f"{self.name}: the filter broke down{sizes}"
        fit = f"log-likelihood {self.log_likelihood:.0f}, NIS per degree of freedom {self.nis_per_dof:.2f}"
        return f"{self.name}: {fit}{sizes}"


@dataclass(frozen=True)
class Choice:
    """The structure that `choose` chose.

    Args:
        chosen: The best candidate.
        tried: All of them, in the order given.
        frames: Number of frames of each run.
    """

    chosen: Tried
    tried: tuple[Tried, ...]
    frames: int

    @property
    def overrides(self) -> Overrides:
        """Settings of the best candidate."""
        return self.chosen.overrides

    @property
    def lines(self) -> tuple[str, ...]:
        """The results and the choice, one line each."""
        runs = sum(tried.runs for tried in self.tried)
        lead = sorted(tried.score for tried in self.tried)
        ahead = f", log-likelihood {lead[-1] - lead[-2]:.0f} ahead for its number of sizes" if len(lead) > 1 else ""
        return (
            *(tried.line for tried in self.tried),
            f"chosen: {self.chosen.name}{ahead} ({runs} runs of {self.frames} frames)",
        )


def choose(
    sequence: Sequence,
    config: Config | None = None,
    candidates: SequenceType[Candidate] = (),
    *,
    frames: int = 300,
    runs: int = 30,
) -> Choice:
    """Return the candidate under which the innovations of the joint filter are most likely, with its sizes.

    Moving tracks and bad observations are found without the settings of the candidates, so all candidates are judged by
    the same observations. The truth is not used.

    Args:
        sequence: The recording.
        config: All other settings; None for the defaults.
        candidates: At least one.
        frames: Approximate number of frames of a run, in stretches of 50 that are spread over the recording.
        runs: Limit on the runs of all candidates together; each has at least one.

    Raises:
        ConfigError: No candidate; one of its settings is unknown or wrong, or a size has no value to start from.
        EmptyTracksError: The recording has no observations.
        InnovationError: The filter breaks down under every candidate.
    """
    if not candidates:
        raise ConfigError("no candidates to choose from")
    if len(sequence.observations) == 0:
        raise EmptyTracksError("structures are told by observations, and there are none", source=sequence.source)
    config = settings_of(sequence, config or Config())
    observations = int(np.ceil(frames * len(sequence.observations) / len(sequence)))
    found: dict[int, Tried] = {}
    error: InnovationError | None = None
    with one_thread():
        parts, gated, _ = parts_of(sequence, config, noise_of(sequence, config), observations)
        # Candidates with many sizes get the runs that simple ones leave.
        for left, i in enumerate(sorted(range(len(candidates)), key=lambda i: len(candidates[i].sizes))):
            spent = sum(tried.runs for tried in found.values())
            share = max((runs - spent) // (len(candidates) - left), 1)
            search = _Search(sequence, config, gated, parts, candidates[i], share)
            found[i] = search.tried()
            error = search.error or error
    tried = tuple(found[i] for i in range(len(candidates)))
    chosen = max(tried, key=lambda tried: tried.score)
    if error is not None and not np.isfinite(chosen.log_likelihood):
        raise error
    return Choice(chosen, tried, sum(len(part) for part in parts))


def stated_candidates(sequence: Sequence) -> tuple[Candidate, ...]:
    """Return the possible structures of the noise that a recording states.

    The file states the whole error of a pixel, but not which part of it is white and which part all landmarks of a
    frame share. The candidates keep the whole: ``white`` takes all of it as white, ``camera jitter`` takes it as
    rotations of the camera that move the image as far, plus white noise of the size that the NIS requires. The
    correlation time is the default of the block: a jitter slower than a stretch looks like a turned world, which costs
    nothing, so the likelihood would make every jitter that innovations do not show as slow as that.

    Raises:
        ConfigError: The recording states no noise.
    """
    if sequence.noise is None:
        raise ConfigError(f"{sequence.name} states no noise")
    whole_px, camera = float(np.sqrt(np.mean(sequence.noise.pixel_std_px**2))), sequence.camera
    jitter = {
        "rotation_deg": float(np.rad2deg(whole_px / np.sqrt(camera.fu_px * camera.fv_px))),
        "translation_m": CameraJitter.translation_m,
        "time_s": CameraJitter.time_s,
    }
    return (
        Candidate("white"),
        Candidate(
            "camera jitter",
            {"noise": {"sigma_px": whole_px}, "blocks": {CameraJitter.name: jitter}},
            (f"blocks.{CameraJitter.name}.translation_m",),
            "noise.sigma_px",
        ),
    )


def value_at(config: Config, name: str) -> float:
    """Return the number at a dotted name, such as ``noise.sigma_px``.

    Raises:
        ConfigError: There is none.
    """
    value: Any = config
    for key in name.split("."):
        value = value.get(key) if isinstance(value, Mapping) else getattr(value, key, None)
    if isinstance(value, bool) or not isinstance(value, int | float) or value <= 0:
        raise ConfigError(f"{name} must start from a positive number, found {value!r}")
    return float(value)


def with_value(overrides: Overrides, name: str, value: float) -> Overrides:
    """Return the settings with the number at a dotted name replaced."""
    key, *rest = name.split(".", 1)
    inner = overrides.get(key, {})
    return {**overrides, key: with_value(inner, rest[0], value) if rest else value}  # type: ignore[dict-item]


def highest(step: float, below: float, here: float, above: float) -> float:
    """Find the maximum of a likelihood from its values at ``-step, 0, step`` of the logarithm of a size.

    The log-likelihood of a standard deviation s has no third derivative at its maximum as a function of ``s^(-2/3)``.
    So the parabola is fitted in that variable. It is trusted up to 1.5 steps. Without a maximum, the step goes to the
    better side.
    """
    if np.isfinite(below + here + above):
        at = np.exp(-2 / 3 * np.array([-step, 0.0, step]))
        a, b, _ = np.polyfit(at, [below - here, 0.0, above - here], 2)
        if a < 0:
            return float(np.clip(-1.5 * np.log(max(-b / (2 * a), 1e-9)), -1.5 * step, 1.5 * step))
    return step if above > below else -step


class _Search:
    """The sizes of one candidate.

    Args:
        sequence, config: As for `choose`, the configuration resolved.
        gated: Settings of the filter, without the candidate's.
        parts: Stretches.
        candidate: Candidate.
        budget: Runs.
    """

    def __init__(
        self,
        sequence: Sequence,
        config: Config,
        gated: Config,
        parts: SequenceType[Sequence],
        candidate: Candidate,
        budget: int,
    ) -> None:
        self.sequence, self.config, self.gated, self.parts = sequence, config, gated, parts
        self.candidate, self.budget = candidate, budget
        starting = config.with_overrides(candidate.overrides)
        self.start = np.log([value_at(starting, name) for name in candidate.sizes])
        self.runs: dict[tuple[float, ...], tuple[float, float, int]] = {}
        self.error: InnovationError | None = None

    @property
    def left(self) -> int:
        """Runs that are left."""
        return self.budget - len(self.runs)

    def tried(self) -> Tried:
        """Return the candidate at the sizes found."""
        x, shared = self._white(self.start), len(self.candidate.by_likelihood)
        for step in _STEPS if shared else ():
            # A sweep costs three runs a size, and one at what comes out.
            if self.left < 3 * shared + 1:
                break
            for i in range(shared):
                x = self._better(x, i, step)
            x = self._white(x)
        log_likelihood, nis, dof = self._run(x)
        sizes = dict(zip(self.candidate.sizes, (float(f"{value:.4g}") for value in np.exp(x)), strict=True))
        name, runs = self.candidate.name, len(self.runs)
        return Tried(name, self._overrides(x), sizes, log_likelihood, nis / max(dof, 1), dof, runs)

    def _overrides(self, x: Array) -> Overrides:
        overrides = self.candidate.overrides
        for name, value in zip(self.candidate.sizes, np.exp(x), strict=True):
            overrides = with_value(overrides, name, float(f"{value:.4g}"))
        return overrides

    def _run(self, x: Array) -> tuple[float, float, int]:
        """Return log-likelihood, NIS and degrees of freedom at logarithms (n,) of the sizes."""
        key = tuple(x.tolist())
        if key not in self.runs:
            overrides = self._overrides(x)
            noise = noise_of(self.sequence, self.config.with_overrides(overrides))
            settings = self.gated.with_overrides(overrides)
            try:
                reports = [report for part in self.parts for report in filter_reports(part, noise, settings)]
                nis, dof = sum(report.nis for report in reports), sum(report.dof for report in reports)
                self.runs[key] = float(penalised(reports).sum()), float(nis), dof
            except InnovationError as error:
                self.error = error
                self.runs[key] = -np.inf, np.nan, 0
        return self.runs[key]

    def _better(self, x: Array, i: int, step: float) -> Array:
        """Improve size i by three runs."""
        unit = step * np.eye(len(x))[i]
        below, here, above = (self._run(at)[0] for at in (x - unit, x, x + unit))
        better = x.copy()
        better[i] += highest(step, below, here, above)
        return np.clip(better, self.start - _FARTHEST, self.start + _FARTHEST)

    def _white(self, x: Array) -> Array:
        """Move the last size to where the NIS is 1 per degree of freedom, by secants of its logarithm."""
        if not self.candidate.by_nis:
            return x
        slope, before = -2.0, None  # of the logarithm of the NIS: that where all of the innovation is this size's
        for _ in range(min(_NIS_RUNS, self.left - 1)):  # the last run is for what comes out
            _, nis, dof = self._run(x)
            if not dof or not nis > 0 or abs(np.log(nis / dof)) < _NIS_TOLERANCE:
                break
            excess = float(np.log(nis / dof))
            if before is not None and x[-1] != before[0]:
                slope = float(np.clip((excess - before[1]) / (x[-1] - before[0]), -3.0, -0.3))
            before = x[-1], excess
            x = x.copy()
            x[-1] += np.clip(-excess / slope, -_LONGEST_NIS_STEP, _LONGEST_NIS_STEP)
            x = np.clip(x, self.start - _FARTHEST, self.start + _FARTHEST)
        return x
