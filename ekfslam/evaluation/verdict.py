"""`judge`: the evidence of `ekfslam.evaluation.honesty` in one verdict, with its causes."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ekfslam.errors import HonestyError
from ekfslam.evaluation.honesty import (
    AXES,
    BLIND,
    LAGS,
    LEAST_DOF,
    ROWS,
    SURE,
    PriorAgreement,
    Ratio,
    RejectedShares,
    SharedInnovations,
    SmootherAgreement,
    TrackInnovations,
    prior_agreement,
    ratio,
    rejected_shares,
    shared_innovations,
    smoother_agreement,
    track_innovations,
)
from ekfslam.evaluation.tables import document, markdown_table, number, plus_minus
from ekfslam.filters.result import Result, WhitenedInnovations
from ekfslam.smoother.posterior import Posterior

NOTABLE = 1.3  # factor from which a deviation is worth a word
_LEAST_LOW = 1.15  # of the factor, with near certainty
_PERSISTS, _LEAST_SLOW = 2.0, 1.5  # persistence from which errors of tracks, and those that all share, are called slow
_LEAST_MEAN, _SURE_OF_MEAN = 0.3, 4.5  # of a constant error: standard deviations of a frame, standard errors
_LEAST_OUTLIERS, _LEAST_MOVING = 0.01, 0.1  # shares of the observations
_LEAST_AGREEMENT = 1.5  # ratio of standard deviations
_PULL = 3.5  # standard deviations from its prior that speak against a block
_SMOOTHER = 3.0  # normalised square per degree of freedom: that of an EKF in XYZ may be 2


@dataclass(frozen=True)
class Cause:
    """Something that is wrong with the model.

    Args:
        kind: ``bias``, ``shared drift``, ``shared noise``, ``pixel noise``, ``tracks``, ``agreement``,
            ``outliers``, ``moving``, ``prior`` or ``smoother``.
        where: Axes, rows, or names of parameters.
        factor: By which errors exceed the covariance there, beyond what single observations explain; below 1: by which
            they are smaller; 1: it says nothing.
        text: In words.
    """

    kind: str
    where: tuple[str, ...]
    factor: float
    text: str

    @property
    def is_shared(self) -> bool:
        """Whether landmarks agree on it, so that it has axes."""
        return self.kind in ("bias", "shared drift", "shared noise")


@dataclass(frozen=True)
class Honesty:
    """What `judge` found.

    Args:
        name: Of the recording.
        frames: Number of frames.
        nis: Per degree of freedom.
        shared, tracks, rejections, priors, smoother: The evidence.
        smoother_skipped: Why there is no comparison with the smoother; empty where there is.
        factor: By which the covariance is too small (in standard deviations), about; below 1: too large.
        causes: Why the covariance is too small or too large, the worst first.
        findings: What else is wrong.
    """

    name: str
    frames: int
    nis: Ratio
    shared: SharedInnovations
    tracks: TrackInnovations
    rejections: RejectedShares
    priors: tuple[PriorAgreement, ...]
    smoother: SmootherAgreement | None
    smoother_skipped: str
    factor: float
    causes: tuple[Cause, ...]
    findings: tuple[Cause, ...]

    @property
    def agreement(self) -> float:
        """Size of shared errors against that of single observations, by what the model says of it."""
        return _agreement(self.shared, self.tracks)

    @property
    def verdict(self) -> str:
        """The judgement in words."""
        if self.factor > 1 and self.causes:
            worst = self.causes[0]
            where = f" in {_axes(worst.where)}" if worst.is_shared else ""
            text = f"{factor_text(self.factor)}{where}"
        elif self.causes:
            text = f"{factor_text(self.factor)}, as far as innovations can tell"
        else:
            text = "honest as far as innovations can tell"
        if self.causes:
            text += f"; cause: {'; '.join(cause.text for cause in self.causes)}"
        return text + (f". Also: {'; '.join(cause.text for cause in self.findings)}" if self.findings else "")

    @property
    def values(self) -> dict[str, Any]:
        """Everything as plain values for JSON; what is not a number is None."""
        words = {
            "verdict": self.verdict,
            "agreement": self.agreement,
            "blind": BLIND,
            "axes": list(AXES),
            "rows": list(ROWS),
        }
        return {**words, **_plain(dataclasses.asdict(self))}

    @property
    def table(self) -> str:
        """Verdict and evidence as Markdown that reads as well on a terminal."""
        blocks = [
            f"# {self.name}: honesty of the covariance, {self.frames} frames",
            f"**Verdict: {self.verdict}.**",
            markdown_table(["per degree of freedom, or share", "found", "expected"], self.overview, padded=True),
            "Errors that the landmarks of a frame share, in standard deviations that the filter expects of them:",
            markdown_table(_SHARED_HEADINGS, self._shared_rows(), padded=True),
            "Errors of single observations, without those, along tracks:",
            markdown_table(_TRACK_HEADINGS, self._track_rows(), padded=True),
        ]
        if self.priors:
            rows = [[prior.name, number(prior.pull, ".2f"), number(prior.increment, ".2f")] for prior in self.priors]
            blocks.append(markdown_table(["block", "from its prior [sigma]", "steps [sigma]"], rows, padded=True))
        return document(*blocks, BLIND)

    @property
    def overview(self) -> list[list[str]]:
        """What was found and what is expected: three cells a row, the last row on the smoother."""
        rows = [
            ["NIS", ratio_text(self.nis), "1"],
            ["NIS shared by the landmarks of a frame", ratio_text(self.shared.size), "1"],
            ["NIS of single observations, without that", ratio_text(self.tracks.size), "1"],
            ["shared errors against single ones (deviations)", f"{self.agreement:.2f}", "1"],
            ["variance of single ones, without the gate's cut", f"{self.tracks.scale:.3g}", "1"],
            ["rejected by gates, calm frames", percent(self.rejections.gate), percent(self.rejections.expected)],
        ]
        rows += [[f"rejected: {name}", percent(share), ""] for name, share in self.rejections.reasons.items()]
        if self.smoother is None:
            return [*rows, [f"filter less smoother: {self.smoother_skipped}", number(None), "1"]]
        return [*rows, ["filter less smoother", ratio_text(self.smoother.size), "1"]]

    def _shared_rows(self) -> list[list[str]]:
        found = self.shared
        return [
            [
                AXES[a],
                f"{found.std[a]:.2f}",
                f"{found.correlation[1, a]:.2f}",
                f"{found.correlation[5, a]:.2f}",
                plus_minus(f"{found.mean[a]:.2f}", f"{found.mean_error[a]:.2f}"),
                f"{found.persistence[a]:.1f}",
                f"{found.factor[a]:.2f}",
                f"{found.factor_low[a]:.2f}",
            ]
            for a in range(len(AXES))
        ]

    def _track_rows(self) -> list[list[str]]:
        found = self.tracks
        return [
            [
                name,
                *(f"{found.correlation[lag, i]:.2f}" for lag in (1, 5, LAGS)),
                f"{found.persistence[i]:.1f}",
                f"{found.factor[i]:.2f}",
            ]
            for i, name in enumerate(ROWS[: len(found.factor)])
        ]


_SHARED_HEADINGS = ("axis", "size", "lag 1", "lag 5", "mean", "persists", "grows by", "at least")
_TRACK_HEADINGS = ("row", "lag 1", "lag 5", f"lag {LAGS}", "persists", "grows by")


def innovations_of(result: Result) -> WhitenedInnovations:
    """The whitened innovations of a result.

    Raises:
        HonestyError: It has none.
    """
    if result.whitened is None:
        why = "was made before innovations were kept: run again" if result.mode == "full" else "has none: check 'full'"
        raise HonestyError(f"{result.sequence_name}: no innovations to judge by: the result of {result.mode!r} {why}")
    return result.whitened


def judge(result: Result, smoothed: Posterior | None = None, skipped: str = "not asked for") -> Honesty:
    """Whether the covariance of a full run is honest, from its innovations.

    Args:
        result: Of mode ``full``, with its whitened innovations.
        smoothed: Its posterior, to compare with.
        skipped: Why there is none.

    Raises:
        HonestyError: The result has no whitened innovations, or too few frames with them.
    """
    whitened, innovation = innovations_of(result), result.innovation
    looked_at = np.isfinite(whitened.shared_nis) & (innovation.dof > LEAST_DOF)
    if looked_at.sum() <= LAGS:
        raise HonestyError(f"{result.sequence_name}: only {looked_at.sum()} frames have innovations to judge by")
    gate = float(result.config["filter"]["gate_probability"])
    shared = shared_innovations(whitened, looked_at, np.diff(result.time_s, prepend=result.time_s[:1]))
    tracks = track_innovations(whitened, innovation, looked_at, gate)
    rejections = rejected_shares(result, looked_at, gate, tracks.scale)
    priors = () if result.parameters is None else prior_agreement(result.parameters)
    smoother = None if smoothed is None else smoother_agreement(result, smoothed)
    factor, causes, aside = _causes(shared, tracks, smoother)
    aside = (*aside, *_agreement_causes(shared, tracks, causes))
    return Honesty(
        name=result.sequence_name,
        frames=len(result.time_s),
        nis=ratio(innovation.nis, innovation.dof),
        shared=shared,
        tracks=tracks,
        rejections=rejections,
        priors=priors,
        smoother=smoother,
        smoother_skipped="" if smoother is not None else skipped,
        factor=factor,
        causes=causes,
        findings=(*aside, *_rejection_causes(rejections), *_prior_causes(priors)),
    )


def _causes(
    shared: SharedInnovations, tracks: TrackInnovations, smoother: SmootherAgreement | None
) -> tuple[float, tuple[Cause, ...], tuple[Cause, ...]]:
    """By which factor the covariance is too small; the causes of that; and what is wrong the other way."""
    found = (*_shared_causes(shared, tracks), *_track_causes(tracks))
    small, large = (tuple(cause for cause in found if (cause.factor > 1) == way) for way in (True, False))
    small = tuple(sorted(small, key=lambda cause: -cause.factor)) or _smoother_causes(smoother)
    if small:
        return small[0].factor, small, large
    factor = max(float(np.sqrt((shared.factor**2).mean())), float(tracks.factor.max()), float(np.sqrt(tracks.scale)))
    return (factor, large, ()) if factor < 1 / NOTABLE and large else (factor, (), large)


def _shared_causes(shared: SharedInnovations, tracks: TrackInnovations) -> list[Cause]:
    """Shared errors, beyond what errors of single observations explain: averages over landmarks inherit these."""
    explained = max(1.0, float(np.sqrt(tracks.scale)), _grown(tracks))
    order, mean, factor = shared.order, np.abs(shared.mean), shared.factor / explained
    large = (factor > NOTABLE) & (shared.factor_low > _LEAST_LOW * explained)
    constant = (mean > _LEAST_MEAN) & (mean > _SURE_OF_MEAN * shared.mean_error)
    rest = order[(large & ~constant)[order]]
    # An error that is new in each frame shows at once, a slow one only in sums.
    slow = np.log(shared.persistence[rest])
    fast = 2.0 * np.log(factor[rest]) - slow
    is_slow = len(rest) and slow.mean() > max(np.log(_LEAST_SLOW), fast.mean())
    groups = {"bias": order[(large & constant)[order]], "shared drift" if is_slow else "shared noise": rest}
    return [
        Cause(kind, tuple(AXES[a] for a in axes), float(factor[axes[0]]), _spoken(kind, shared, axes.tolist()))
        for kind, axes in groups.items()
        if len(axes)
    ]


def _grown(tracks: TrackInnovations) -> float:
    """Largest factor of the rows whose errors persist along tracks; 0 where none does."""
    return float(tracks.factor[tracks.persistence > _PERSISTS].max(initial=0.0))


def _spoken(kind: str, shared: SharedInnovations, axes: Sequence[int]) -> str:
    agree = f"innovations agree across landmarks in {_axes([AXES[a] for a in axes])}"
    if kind == "bias":
        sizes = _listed([_rate(shared.rate[a], a) for a in axes])
        return f"{agree} and are constant: a bias of the velocities (up to {sizes})"
    if kind == "shared drift":
        return f"{agree} and persist over frames: a slow error of all tracks or of the velocities"
    return f"{agree}, anew in each frame: velocities noisier than stated, or a jitter of all tracks"


def _rate(rate: float, axis: int) -> str:
    return f"{rate:+.2g} m/s" if axis < 3 else f"{np.degrees(rate):+.2g} deg/s"


def _track_causes(tracks: TrackInnovations) -> list[Cause]:
    pixels, names, causes = float(np.sqrt(tracks.scale)), ROWS[: len(tracks.factor)], []
    slow = np.flatnonzero(tracks.persistence > _PERSISTS)
    grown = _grown(tracks)
    if grown > NOTABLE:
        where = tuple(names[i] for i in slow)
        text = f"errors persist along tracks in {_listed(where)}, where the model takes them as new in each frame"
        causes.append(Cause("tracks", where, grown, text))
    if abs(np.log(pixels)) > np.log(NOTABLE) and abs(tracks.size.value - 1.0) > SURE * tracks.size.error:
        word = "larger" if pixels > 1 else "smaller"
        text = f"errors of single observations are about {max(pixels, 1 / pixels):.1f}x {word} than stated"
        if pixels < 1 and len(slow):
            text += f", yet persist along tracks, so that in sums they are {grown:.1f}x what is stated"
        causes.append(Cause("pixel noise", names, pixels, text))
    return causes


def _agreement(shared: SharedInnovations, tracks: TrackInnovations) -> float:
    return float(np.sqrt(shared.size.value / tracks.size.value))


def _agreement_causes(shared: SharedInnovations, tracks: TrackInnovations, causes: Sequence[Cause]) -> list[Cause]:
    """Landmarks that agree more than the model says, where the sizes of their errors do not tell it already."""
    agreement = _agreement(shared, tracks)
    if agreement < _LEAST_AGREEMENT or any(cause.is_shared for cause in causes):
        return []
    text = (
        f"the landmarks of a frame agree: errors that they share are {agreement:.1f}x as large, "
        "against those of single observations, as the model says"
    )
    return [Cause("agreement", (), 1.0, text)]


def _rejection_causes(rejections: RejectedShares) -> list[Cause]:
    causes = []
    # Two gates, and a tail that is not quite Gaussian, reject somewhat more than one gate should.
    if rejections.gate > 3.0 * rejections.expected + _LEAST_OUTLIERS:
        found, expected = percent(rejections.gate), percent(rejections.expected)
        text = f"the gates reject {found} of the observations, where {expected} are expected: outliers"
        causes.append(Cause("outliers", (), 1.0, text))
    moving = rejections.reasons.get("moving", 0.0)
    if moving > _LEAST_MOVING:
        text = f"{percent(moving)} of the observations are thrown out as moving along"
        causes.append(Cause("moving", (), 1.0, text))
    return causes


def _prior_causes(priors: Sequence[PriorAgreement]) -> list[Cause]:
    off = [prior for prior in priors if max(abs(prior.pull or 0.0), prior.increment or 0.0) > _PULL]
    if not off:
        return []
    names = tuple(prior.name for prior in off)
    text = f"disagreement with the prior of {_listed(names)}, or steps larger than its deviation allows"
    return [Cause("prior", names, 1.0, text)]


def _smoother_causes(smoother: SmootherAgreement | None) -> tuple[Cause, ...]:
    if smoother is None or not smoother.size.value > max(_SMOOTHER, 1.0 + SURE * smoother.size.error):
        return ()
    factor = float(np.sqrt(smoother.size.value))
    text = f"filter and smoother differ {factor:.1f}x more than their covariances allow, which no innovation explains"
    return (Cause("smoother", (), factor, text),)


def _axes(names: Sequence[str]) -> str:
    return "all axes" if len(names) == len(AXES) else _listed(names)


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def factor_text(factor: float) -> str:
    """By how much a covariance is too small or too large, in words; a factor of standard deviations."""
    if factor > 1:
        return f"covariance optimistic by about {factor:.1f}x"
    return f"covariance pessimistic by about {1 / factor:.1f}x"


def percent(share: float) -> str:
    """A share in words."""
    return f"{100 * share:.2g} %"


def ratio_text(found: Ratio) -> str:
    """A ratio and its standard error in words."""
    return plus_minus(f"{found.value:.3g}", f"{found.error:.2g}")


def _plain(value: Any) -> Any:
    """Arrays as lists, not-a-numbers as None."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [_plain(item) for item in value]
    value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(value, float) and not np.isfinite(value) else value
