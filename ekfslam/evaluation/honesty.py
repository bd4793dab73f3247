"""`judge`: verdicts on the covariance of a run, with their causes, from all evidence that the run offers.

A full run is judged by its innovations. Other modes and older archives keep none: only NIS and truth remain.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ekfslam.arrays import Array, BoolArray
from ekfslam.data.sequence import Truth
from ekfslam.errors import HonestyError
from ekfslam.evaluation import evidence
from ekfslam.evaluation.evidence import AXES, BLIND, LAGS, POSE_DOF, ROWS, SURE, Ratio, SharedInnovations
from ekfslam.evaluation.tables import document, markdown_table, number
from ekfslam.filters.result import Result
from ekfslam.smoother.posterior import Posterior

_NOTABLE = 1.3  # factor from which a deviation is reported
_LEAST_LOW = 1.15  # of the factor, minus three standard errors
_PERSISTS, _LEAST_SLOW = 2.0, 1.5  # persistence from which errors of tracks, and shared errors, are called slow
_LEAST_MEAN, _SURE_OF_MEAN = 0.3, 4.5  # of a constant error: standard deviations of a frame, standard errors
_LEAST_OUTLIERS, _LEAST_MOVING = 0.01, 0.1  # shares of the observations
_LEAST_AGREEMENT = 1.5  # ratio of standard deviations
_PULL = 3.5  # standard deviations from its prior that speak against a block
_SMOOTHER = 3.0  # normalised square per degree of freedom: that of an EKF in XYZ may be 2
_BAD = 2.0  # factor
_SHARED = {
    "bias": " and are constant: a bias of the velocities (up to {})",
    "shared drift": " and persist over frames: a slow error of all tracks or of the velocities",
    "shared noise": ", independently in each frame: velocities noisier than stated, or a jitter of all tracks",
}


@dataclass(frozen=True)
class Cause:
    """A defect of the model.

    Args:
        kind: ``bias``, ``shared drift``, ``shared noise``, ``pixel noise``, ``tracks``, ``agreement``, ``outliers``,
            ``moving``, ``prior`` or ``smoother``.
        where: Axes, rows, or names of parameters.
        factor: Ratio of errors to covariance that single observations do not explain; 1 if it does not apply.
        text: Description.
    """

    kind: str
    where: tuple[str, ...]
    factor: float
    text: str


@dataclass(frozen=True)
class Judgement:
    """A verdict from one kind of evidence.

    Args:
        text: The verdict in words.
        reasons: Causes, or the figures behind it.
        factor: Ratio of errors to covariance, in standard deviations; 1 if nothing speaks against the covariance.
    """

    text: str
    reasons: tuple[str, ...]
    factor: float


@dataclass(frozen=True)
class Honesty:
    """All verdicts on a run, and their evidence; None for evidence that the run does not offer.

    Args:
        name, frames: Name of the recording, number of frames.
        nis: NIS per degree of freedom.
        shared, tracks, rejections, priors, smoother, truth: The evidence.
        smoother_skipped, innovations_skipped: Reason for a missing smoother or missing innovations; else empty.
        factor: Approximate ratio of errors to covariance, in standard deviations, by innovations.
        causes: Causes of a covariance that is too small or too large, worst first.
        findings: Other defects.
    """

    name: str
    frames: int
    nis: Ratio | None
    shared: SharedInnovations | None
    tracks: evidence.TrackInnovations | None
    rejections: evidence.RejectedShares
    priors: tuple[evidence.PriorAgreement, ...]
    smoother: evidence.SmootherAgreement | None
    truth: evidence.TruthAgreement | None
    smoother_skipped: str
    innovations_skipped: str
    factor: float
    causes: tuple[Cause, ...]
    findings: tuple[Cause, ...]

    @property
    def agreement(self) -> float:
        """Ratio of shared errors to those of single observations, in standard deviations; 1 expected."""
        return np.nan if self.shared is None or self.tracks is None else _agreement(self.shared, self.tracks)

    @property
    def judgements(self) -> list[Judgement]:
        """The verdicts, the main one first; empty without any evidence."""
        found = [*self._by_innovations(), *self._by_truth()]
        # Defects come first. Without any, the truth says more than the size of the NIS.
        if len(found) == 2 and self.shared is None and found[0].factor == 1.0:
            found.reverse()
        return found

    @property
    def verdict(self) -> str:
        """The main verdict and its reasons in one sentence."""
        if not self.judgements:
            return self.innovations_skipped
        text = self.judgements[0].text
        if self.causes:
            text += f"; cause: {'; '.join(cause.text for cause in self.causes)}"
        return text + (f". Also: {'; '.join(cause.text for cause in self.findings)}" if self.findings else "")

    @property
    def grade(self) -> str:
        """``good``, ``fair`` or ``bad`` by the largest factor of the verdicts, ``none`` without verdicts."""
        factors = [judgement.factor for judgement in self.judgements]
        if not factors:
            return "none"
        return "bad" if max(factors) >= _BAD else "fair" if any(factor != 1 for factor in factors) else "good"

    @property
    def values(self) -> dict[str, Any]:
        """Everything as plain values for JSON; None replaces what is not a number."""
        words = {"verdict": self.verdict, "agreement": self.agreement, "blind": BLIND, "axes": AXES, "rows": ROWS}
        return {name: _plain(value) for name, value in {**words, **dataclasses.asdict(self)}.items()}

    @property
    def evidence(self) -> list[list[str]]:
        """Rows of three cells: name of a figure, value found, value expected."""
        rows = []
        if self.truth is not None:
            expected = f"{POSE_DOF}, of one drive {self.truth.low:.1f} to {self.truth.high:.1f}"
            rows.append(["pose NEES, with truth noise", f"{self.truth.nees:.3g}", expected])
        if self.nis is not None:
            rows.append(["NIS", str(self.nis), "1"])
        if self.shared is not None and self.tracks is not None:
            rows += [
                ["NIS shared by the landmarks of a frame", str(self.shared.size), "1"],
                ["NIS of single observations, without that", str(self.tracks.size), "1"],
                ["shared errors against single ones (deviations)", f"{self.agreement:.2f}", "1"],
                ["variance of single ones, without the gate's cut", f"{self.tracks.scale:.3g}", "1"],
                ["rejected by gates, calm frames", *map(_percent, (self.rejections.gate, self.rejections.expected))],
            ]
        rows += [[f"rejected: {name}", _percent(share), ""] for name, share in self.rejections.reasons.items()]
        return rows if self.smoother is None else [*rows, ["filter less smoother", str(self.smoother.size), "1"]]

    @property
    def table(self) -> str:
        """Verdict and evidence as Markdown that is also legible on a terminal."""
        blocks = [
            f"# {self.name}: honesty of the covariance, {self.frames} frames",
            f"**Verdict: {self.verdict}.**",
            markdown_table(["per degree of freedom, or share", "found", "expected"], self.evidence, padded=True),
        ]
        if self.smoother is None:
            blocks.append(f"No comparison with the smoother: {self.smoother_skipped}.")
        if self.shared is not None and self.tracks is not None:
            shared, tracks = self.shared, self.tracks
            of_axes = {"size": shared.std, **_lags(shared, 1, 5), "mean": shared.mean, "+-": shared.mean_error}
            of_axes |= {"persists": shared.persistence, "grows by": shared.factor, "at least": shared.factor_low}
            of_rows = {**_lags(tracks, 1, 5, LAGS), "persists": tracks.persistence, "grows by": tracks.factor}
            blocks += [
                "Errors that the landmarks of a frame share, in standard deviations that the filter expects of them:",
                _table("axis", AXES, of_axes),
                "Errors of single observations, without those, along tracks:",
                _table("row", ROWS, of_rows),
            ]
        if self.priors:
            rows = [[prior.name, number(prior.pull, ".2f"), number(prior.increment, ".2f")] for prior in self.priors]
            blocks.append(markdown_table(["block", "from its prior [sigma]", "steps [sigma]"], rows, padded=True))
        return document(*blocks, BLIND)

    def _by_innovations(self) -> Iterator[Judgement]:
        """Yield the verdict by whitened innovations, else by the size of the NIS."""
        if self.shared is not None:
            reasons = tuple(cause.text for cause in (*self.causes, *self.findings))
            if not self.causes:
                yield Judgement("honest as far as innovations can tell", reasons, 1.0)
                return
            worst = self.causes[0]
            where = f" in {_axes(worst.where)}" if worst.kind in _SHARED else ""
            limit = "" if self.factor > 1 else ", as far as innovations can tell"
            yield Judgement(f"{_factor(self.factor)}{where}{limit}", reasons, self.factor)
        elif self.nis is not None:
            factor = float(np.sqrt(self.nis.value))
            figures = (f"NIS {self.nis} per degree of freedom, where 1 is expected",)
            if abs(self.nis.value - 1.0) <= SURE * self.nis.error or 1 / _NOTABLE <= factor <= _NOTABLE:
                yield Judgement("innovations are as large as expected", figures, 1.0)
                return
            size = f"{factor:.1f}x larger" if factor > 1 else f"{1 / max(factor, 1e-3):.1f}x smaller"
            yield Judgement(f"innovations are about {size} than expected", figures, factor)

    def _by_truth(self) -> Iterator[Judgement]:
        """Yield the verdict by the truth."""
        if self.truth is None:
            return
        nees, low, high = dataclasses.astuple(self.truth)
        figures = (f"pose NEES {nees:.3g}, where one honest drive has {low:.1f} to {high:.1f}",)
        if low <= nees <= high:
            yield Judgement("honest as far as the truth of one drive can tell", figures, 1.0)
        else:
            factor = float(np.sqrt(nees / POSE_DOF))
            yield Judgement(f"{_factor(factor)} against the truth", figures, factor)


def judge(
    result: Result,
    smoothed: Posterior | None = None,
    skipped: str = "not required",
    truth: Truth | None = None,
    interpolated: BoolArray | None = None,
) -> Honesty:
    """Judge the covariance of a run by its innovations, and by its smoother and its truth if they are given.

    Args:
        result: A run of any mode.
        smoothed: Its posterior.
        skipped: Reason for a missing posterior.
        truth: Truth of the recording.
        interpolated: (T,) interpolated intervals; the frames after them are not compared with truth.
    """
    shared, tracks, rejections = None, None, evidence.RejectedShares(evidence.reasons_of(result))
    priors = () if result.parameters is None else evidence.prior_agreement(result.parameters)
    smoother = None if smoothed is None else evidence.smoother_agreement(result, smoothed)
    missing, whitened, innovation = _missing_innovations(result), result.whitened, result.innovation
    factor, causes, findings = 1.0, tuple[Cause, ...](), tuple[Cause, ...]()
    if whitened is not None and not missing:
        examined = evidence.examined_frames(result)
        gate = float(result.config["filter"]["gate_probability"])
        tau_s = np.diff(result.time_s, prepend=result.time_s[0])
        shared = evidence.shared_innovations(whitened, examined, tau_s)
        tracks = evidence.track_innovations(result, examined, gate)
        rejections = evidence.rejected_shares(result, examined, gate, tracks.scale)
        factor, causes, findings = _causes(shared, tracks, smoother)
    return Honesty(
        name=result.sequence_name,
        frames=len(result.time_s),
        nis=evidence.ratio(innovation.nis, innovation.dof) if innovation.dof.sum() > 0 else None,
        shared=shared,
        tracks=tracks,
        rejections=rejections,
        priors=priors,
        smoother=smoother,
        truth=evidence.truth_agreement(result, truth, interpolated),
        smoother_skipped="" if smoother is not None else skipped,
        innovations_skipped=missing,
        factor=factor,
        causes=causes,
        findings=(*findings, *_rejection_causes(rejections), *_prior_causes(priors)),
    )


def require_innovations(result: Result) -> None:
    """Raise `HonestyError` if a run has no whitened innovations, or too few frames with them."""
    missing = _missing_innovations(result)
    if missing:
        raise HonestyError(f"{result.sequence_name}: {missing}")


def _missing_innovations(result: Result) -> str:
    """Return why a run has no innovations to be judged by; empty if it has."""
    if result.whitened is None:
        why = "was made before innovations were kept: run again" if result.mode == "full" else "has none: check 'full'"
        return f"no innovations to judge by: the result of {result.mode!r} {why}"
    frames = int(evidence.examined_frames(result).sum())
    return "" if frames > LAGS else f"only {frames} frames have innovations to judge by"


def _causes(
    shared: SharedInnovations, tracks: evidence.TrackInnovations, smoother: evidence.SmootherAgreement | None
) -> tuple[float, tuple[Cause, ...], tuple[Cause, ...]]:
    """Return the ratio of errors to covariance, its causes, and the causes that act the other way."""
    found = (*_shared_causes(shared, tracks), *_track_causes(tracks))
    small, large = (tuple(cause for cause in found if (cause.factor > 1) == way) for way in (True, False))
    small = tuple(sorted(small, key=lambda cause: -cause.factor)) or tuple(_smoother_causes(smoother))
    if small:
        factor, causes, aside = small[0].factor, small, large
    else:
        factor = float(max(np.sqrt((shared.factor**2).mean()), np.sqrt(tracks.scale), tracks.factor.max()))
        causes, aside = (large, ()) if factor < 1 / _NOTABLE else ((), large)
    agreement = _agreement(shared, tracks)
    if agreement >= _LEAST_AGREEMENT and not any(cause.kind in _SHARED for cause in causes):
        text = f"relative to single errors, shared errors are {agreement:.1f}x too large"
        aside = (*aside, Cause("agreement", (), 1.0, f"the landmarks of a frame agree: {text}"))
    return factor, causes, aside


def _shared_causes(shared: SharedInnovations, tracks: evidence.TrackInnovations) -> Iterator[Cause]:
    """Yield causes of shared errors that errors of single observations do not explain."""
    explained = max(1.0, float(np.sqrt(tracks.scale)), _grown(tracks))
    order, mean, factor = shared.order, np.abs(shared.mean), shared.factor / explained
    large = (factor > _NOTABLE) & (shared.factor_low > _LEAST_LOW * explained)
    constant = (mean > _LEAST_MEAN) & (mean > _SURE_OF_MEAN * shared.mean_error)
    rest = order[(large & ~constant)[order]]
    # An error that is independent in each frame is large at once, a slow one only in sums.
    slow = np.log(shared.persistence[rest])
    fast = 2.0 * np.log(factor[rest]) - slow
    is_slow = len(rest) and slow.mean() > max(np.log(_LEAST_SLOW), fast.mean())
    groups = {"bias": order[(large & constant)[order]], "shared drift" if is_slow else "shared noise": rest}
    for kind, axes in groups.items():
        if len(axes):
            where, rates = tuple(AXES[a] for a in axes), _listed([_rate(shared.rate[a], a) for a in axes])
            text = f"innovations agree across landmarks in {_axes(where)}{_SHARED[kind].format(rates)}"
            yield Cause(kind, where, float(factor[axes[0]]), text)


def _track_causes(tracks: evidence.TrackInnovations) -> Iterator[Cause]:
    pixels, names = float(np.sqrt(tracks.scale)), ROWS[: len(tracks.factor)]
    slow, grown = np.flatnonzero(tracks.persistence > _PERSISTS), _grown(tracks)
    if grown > _NOTABLE:
        where = tuple(names[i] for i in slow)
        text = f"errors persist along tracks in {_listed(where)}, where the model expects independent ones"
        yield Cause("tracks", where, grown, text)
    if abs(np.log(pixels)) > np.log(_NOTABLE) and abs(tracks.size.value - 1.0) > SURE * tracks.size.error:
        word = "larger" if pixels > 1 else "smaller"
        text = f"errors of single observations are about {max(pixels, 1 / pixels):.1f}x {word} than stated"
        if pixels < 1 and len(slow):
            text += f", yet persist along tracks, so that in sums they are {grown:.1f}x larger than stated"
        yield Cause("pixel noise", names, pixels, text)


def _rejection_causes(rejections: evidence.RejectedShares) -> Iterator[Cause]:
    gate, expected, moving = rejections.gate, rejections.expected, rejections.reasons.get("moving", 0.0)
    # Two gates and a tail that is not quite Gaussian reject slightly more than one gate should.
    if gate is not None and expected is not None and gate > 3.0 * expected + _LEAST_OUTLIERS:
        text = f"the gates reject {_percent(gate)} of the observations ({_percent(expected)} expected): outliers"
        yield Cause("outliers", (), 1.0, text)
    if moving > _LEAST_MOVING:
        yield Cause("moving", (), 1.0, f"{_percent(moving)} of the observations are rejected as moving points")


def _prior_causes(priors: Sequence[evidence.PriorAgreement]) -> Iterator[Cause]:
    names = tuple(prior.name for prior in priors if max(abs(prior.pull or 0.0), prior.increment or 0.0) > _PULL)
    if names:
        text = f"disagreement with the prior of {_listed(names)}, or steps larger than its deviation allows"
        yield Cause("prior", names, 1.0, text)


def _smoother_causes(smoother: evidence.SmootherAgreement | None) -> Iterator[Cause]:
    if smoother is not None and smoother.size.value > max(_SMOOTHER, 1.0 + SURE * smoother.size.error):
        factor = float(np.sqrt(smoother.size.value))
        text = f"filter and smoother differ {factor:.1f}x more than their covariances allow, unexplained by innovations"
        yield Cause("smoother", (), factor, text)


def _grown(tracks: evidence.TrackInnovations) -> float:
    """Return the largest factor of the rows whose errors persist along tracks; 0 if there is none."""
    return float(tracks.factor[tracks.persistence > _PERSISTS].max(initial=0.0))


def _agreement(shared: SharedInnovations, tracks: evidence.TrackInnovations) -> float:
    return float(np.sqrt(shared.size.value / tracks.size.value))


def _lags(found: evidence.Whiteness, *lags: int) -> dict[str, Array]:
    return {f"lag {lag}": found.correlation[lag] for lag in lags}


def _table(kind: str, names: Sequence[str], columns: dict[str, Array]) -> str:
    values = np.column_stack(list(columns.values())).tolist()
    rows = [[name, *(f"{value:.2f}" for value in row)] for name, row in zip(names, values, strict=False)]
    return markdown_table([kind, *columns], rows, padded=True)


def _rate(rate: float, axis: int) -> str:
    return f"{rate:+.2g} m/s" if axis < 3 else f"{np.degrees(rate):+.2g} deg/s"


def _axes(names: Sequence[str]) -> str:
    return "all axes" if len(names) == len(AXES) else _listed(names)


def _listed(names: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(names[:-1]), *names[-1:])))


def _factor(factor: float) -> str:
    word, size = ("optimistic", factor) if factor > 1 else ("pessimistic", 1 / factor)
    return f"covariance {word} by about {size:.1f}x"


def _percent(share: float | None) -> str:
    return number(None if share is None else 100 * share, ".2g") + " %"


def _plain(value: Any) -> Any:
    """Return arrays as lists, and None for what is not a number."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [_plain(item) for item in value]
    value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(value, float) and not np.isfinite(value) else value
