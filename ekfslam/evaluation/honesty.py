"""`judge`: one verdict on the covariance of a run, with its causes and the next step, from all evidence of the run."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from ekfslam.arrays import Array, BoolArray
from ekfslam.data.sequence import Sequence, Truth
from ekfslam.errors import HonestyError
from ekfslam.evaluation import evidence
from ekfslam.evaluation.causes import (
    Cause,
    Causes,
    causes_of,
    nis_causes,
    percent,
    rejection_causes,
    smoother_causes,
    truth_causes,
)
from ekfslam.evaluation.evidence import AXES, BLIND, LAGS, POSE_DOF, ROWS, Ratio, SharedInnovations
from ekfslam.evaluation.other_body import body_causes
from ekfslam.evaluation.systematic import Systematic, systematic_errors
from ekfslam.evaluation.tables import document, markdown_table, number
from ekfslam.filters.result import REASONS, Result
from ekfslam.models.sensors.base import WAITING
from ekfslam.smoother.posterior import Posterior
from ekfslam.storage.archive import Archive

_NOTABLE, _BAD = 1.3, 2.0  # factors
_MOSTLY = 0.4  # share of rejected observations from which the others are no evidence
_RIGHT = "about right"
_FEW_FIT = "too few observations fit the model to judge by them"


@dataclass(frozen=True)
class Honesty:
    """The verdict on a run, and its evidence; None for evidence that the run does not offer."""

    name: str  # name, frames: name of the recording, number of frames
    frames: int
    nis: Ratio | None  # NIS per degree of freedom
    shared: SharedInnovations | None  # shared, tracks, smoother, truth: the evidence
    tracks: evidence.TrackInnovations | None
    rejected: dict[str, float]  # share of all observations by reason of rejection
    systematic: tuple[Systematic, ...]  # errors that all frames show
    vision: Array | None  # (6,) share of the pose that vision decides, see `ekfslam.evaluation.evidence.vision_share`
    smoother: evidence.SmootherAgreement | None
    truth: evidence.TruthAgreement | None
    # smoother_skipped, innovations_skipped: Reason for a missing smoother or missing innovations; else empty.
    smoother_skipped: str
    innovations_skipped: str
    # (6,) ratio of errors to standard deviations of the pose, along `AXES`, by innovations alone. None if they do not
    # tell.
    factors: Array | None
    causes: tuple[Cause, ...]  # causes of a covariance that is too small or too large, worst first
    findings: tuple[Cause, ...]  # other defects

    @property
    def factor(self) -> float:
        """Root mean square of ``factors``; NaN if innovations do not tell."""
        return np.nan if self.factors is None else float(np.sqrt((self.factors**2).mean()))

    @property
    def true_factor(self) -> float:
        """The ratio of errors to standard deviations by the truth; 1 within the bounds of one drive, NaN without."""
        if self.truth is None:
            return np.nan
        is_usual = self.truth.low <= self.truth.nees <= self.truth.high
        return 1.0 if is_usual else float(np.sqrt(self.truth.nees / POSE_DOF))

    @property
    def is_judged(self) -> bool:
        """Whether there is any evidence."""
        return self.nis is not None or self.truth is not None

    @property
    def is_mostly_rejected(self) -> bool:
        """Whether so many observations are rejected that the others are no evidence."""
        return sum(share for name, share in self.rejected.items() if name != REASONS[WAITING]) > _MOSTLY

    @property
    def headline(self) -> str:
        """The verdict in one clause, without its reasons."""
        if not self.is_judged:
            return self.innovations_skipped
        true, by = self.true_factor, "NIS" if self.shared is None else "innovations"
        if np.isnan(true):
            return self._by_innovations(by)
        nees = ""
        if self.truth is not None:
            usual = f"{self.truth.low:.1f} to {self.truth.high:.1f} in 95 % of drives"
            nees = f"pose NEES {self.truth.nees:.3g}; {usual}"
        if not self.causes:
            if true == 1.0 and self.is_mostly_rejected:
                return f"{_FEW_FIT} ({nees})"
            if true == 1.0:
                known = "the truth of one drive" if self.nis is None else f"{by} and the truth of one drive"
                return f"consistent as far as {known} can tell ({nees})"
            reason = "" if self.nis is None else f", for a reason that {by} do not show"
            if any(finding.kind == "body" for finding in self.findings):
                reason = ", which is of another body"
            return f"standard deviations {_size(true)} by the truth ({nees}){reason}"
        they = "standard deviations" if self.shared is None else "they"
        said = f"by the truth {they} are {_size(true)}" if true != 1.0 else "the truth of one drive does not show it"
        head = self._by_innovations(by)
        if true == 1.0 and head.endswith(_RIGHT):
            said = "the truth of one drive agrees"
        return f"{head}; {said} ({nees})"

    @property
    def reasons(self) -> tuple[str, ...]:
        """Causes and other defects, each with its next step."""
        return tuple(c.text + (f"; {c.remedy}" if c.remedy else "") for c in (*self.causes, *self.findings))

    @property
    def verdict(self) -> str:
        """Headline and reasons: the words of ``check``, of the report page, and after a run."""
        return ". ".join((self.headline, *(text[0].upper() + text[1:] for text in self.reasons)))

    @property
    def grade(self) -> str:
        """``good``, ``fair`` or ``bad`` by the verdict, ``none`` without evidence."""
        if not self.is_judged:
            return "none"
        by_nis = (cause.factor for cause in self.causes if cause.kind == "nis")
        known = [f for f in (self.factor, self.true_factor, *by_nis) if not np.isnan(f)]
        if any(not 1 / _BAD < f < _BAD for f in known) or (self.causes and not known) or self.is_mostly_rejected:
            return "bad"
        return "fair" if self.causes or self.findings or any(f != 1.0 for f in known) else "good"

    @property
    def values(self) -> dict[str, Any]:
        """Everything as plain values for JSON; None replaces what is not a number."""
        words = {"verdict": self.verdict, "grade": self.grade, "factor": self.factor}
        words |= {"blind": BLIND, "axes": AXES, "rows": ROWS}
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
                ["variance of single ones, without the gate's cut", f"{self.tracks.scale:.3g}", "1"],
            ]
        rows += [[f"rejected: {name}", percent(share), ""] for name, share in self.rejected.items()]
        if self.smoother is not None:
            rows.append(["filter less smoother, deviations", f"{self.smoother.size:.3g}", "1"])
        return rows

    @property
    def brief(self) -> str:
        """Verdict, evidence and what innovations cannot show, as Markdown that is also legible on a terminal."""
        return document(*self._blocks, BLIND)

    @property
    def table(self) -> str:
        """`brief` with the errors by axis and by row."""
        return document(*self._blocks, *self._details, BLIND)

    @property
    def _blocks(self) -> list[str]:
        blocks = [
            f"# {self.name}: honesty of the covariance, {self.frames} frames",
            f"**Verdict: {self.verdict}.**",
            markdown_table(["per degree of freedom, or share", "found", "expected"], self.evidence, padded=True),
        ]
        if self.smoother is None:
            blocks.append(f"No comparison with the smoother: {self.smoother_skipped}.")
        return blocks

    @property
    def _details(self) -> list[str]:
        if self.shared is None or self.tracks is None:
            return []
        shared, tracks, unknown = self.shared, self.tracks, np.full(6, np.nan)
        of_axes = {"size": shared.std, **_lags(shared, 1, 5), "persists": shared.persistence}
        of_axes |= {"grows by": shared.factor, "at least": shared.factor_low}
        of_axes["vision"] = unknown if self.vision is None else self.vision
        of_axes["pose"] = unknown if self.factors is None else self.factors
        of_rows = {**_lags(tracks, 1, 5, LAGS), "persists": tracks.persistence, "grows by": tracks.factor}
        return [
            "Errors that the landmarks of a frame share, in standard deviations that the filter expects of them; "
            "share of the pose that vision decides; factor of the pose's standard deviations:",
            _table("axis", AXES, of_axes),
            "Errors of single observations, without those, along tracks:",
            _table("row", ROWS, of_rows),
        ]

    def _by_innovations(self, by: str) -> str:
        if not self.causes:
            return _FEW_FIT if self.is_mostly_rejected else f"consistent as far as {by} can tell"
        if self.shared is None:
            return "innovations do not fit their covariance"
        if self.factors is None:
            return f"standard deviations too small, {by} do not tell by how much"
        worst = int(np.argmax(np.abs(np.log(self.factors))))
        said = f"standard deviations {_size(self.factor)}"
        if self.is_mostly_rejected and said.endswith(_RIGHT):
            return _FEW_FIT
        is_uneven = abs(np.log(self.factors[worst] / self.factor)) > np.log(_NOTABLE)
        return f"{said} ({AXES[worst]} {_size(float(self.factors[worst]))})" if is_uneven else said


def judge(
    result: Result,
    smoothed: Posterior | None = None,
    skipped: str = "not required",
    truth: Truth | None = None,
    interpolated: BoolArray | None = None,
) -> Honesty:
    """Judge the covariance of a run by its innovations, and by its posterior and its truth if they are given."""
    rejected = evidence.rejected_shares(result)
    smoother = None if smoothed is None else evidence.smoother_agreement(result, smoothed)
    missing, innovation = _missing_innovations(result), result.innovation
    nis = evidence.ratio(innovation.nis, innovation.dof) if innovation.dof.sum() > 0 else None
    shared, tracks, vision, systematic = None, None, None, tuple[Systematic, ...]()
    found = Causes(None, tuple(nis_causes(nis)), ())
    if result.whitened is not None and not missing:
        examined = evidence.examined_frames(result)
        gate = float(result.config["filter"]["gate_probability"])
        tracks = evidence.track_innovations(result, examined, gate)
        systematic, rest = systematic_errors(result, examined)
        shared, vision = evidence.shared_innovations(rest, examined), evidence.vision_share(result)
        found = causes_of(result, shared, tracks, rejected, systematic, vision)
        alarm = tuple(smoother_causes(smoother))
        found = Causes(None, (*alarm, *found.causes), found.findings) if alarm else found
    agreed = evidence.truth_agreement(result, truth, interpolated)
    bodies = tuple(body_causes(result, truth, interpolated, agreed))
    return Honesty(
        name=result.sequence_name,
        frames=len(result.time_s),
        nis=nis,
        shared=shared,
        tracks=tracks,
        rejected=rejected,
        systematic=systematic,
        vision=vision,
        smoother=smoother,
        truth=agreed,
        smoother_skipped="" if smoother is not None else skipped,
        innovations_skipped=missing,
        factors=found.factors,
        causes=found.causes,
        findings=(
            *(bodies or truth_causes(agreed, found.factors)),
            *found.findings,
            *rejection_causes(result, rejected, found.causes),
        ),
    )


def verdict_on(sequence: Sequence | Archive, result: Result) -> str:
    """Return the verdict on a run of a recording, without its smoother."""
    return judge(result, truth=sequence.truth, interpolated=sequence.interpolated).verdict


def require_innovations(result: Result) -> None:
    """Raise `HonestyError` if a run has no whitened innovations, or too few frames with them."""
    missing = _missing_innovations(result)
    if missing:
        raise HonestyError(f"{result.sequence_name}: {missing}")


def _missing_innovations(result: Result) -> str:
    """Return why a run has no innovations to be judged by; empty if it has."""
    if result.is_other:
        return f"nothing to judge by: {result.mode!r} has no innovations, and no covariance to compare with a truth"
    if result.whitened is None:
        why = "was made before innovations were kept: run again" if result.mode == "full" else "has none: check 'full'"
        return f"no innovations to judge by: the result of {result.mode!r} {why}"
    frames = int(evidence.examined_frames(result).sum())
    return "" if frames > LAGS else f"only {frames} frames have innovations to judge by"


def _lags(found: evidence.Whiteness, *lags: int) -> dict[str, Array]:
    return {f"lag {lag}": found.correlation[lag] for lag in lags}


def _table(kind: str, names: tuple[str, ...], columns: dict[str, Array]) -> str:
    values = np.column_stack(list(columns.values())).tolist()
    rows = [
        [name, *(number(None if np.isnan(value) else value, ".2f") for value in row)]
        for name, row in zip(names, values, strict=False)
    ]
    return markdown_table([kind, *columns], rows, padded=True)


def _size(factor: float) -> str:
    if 1 / _NOTABLE < factor < _NOTABLE:
        return _RIGHT
    return f"about {max(factor, 1 / factor):.1f}x too {'small' if factor > 1 else 'large'}"


def _plain(value: Any) -> Any:
    """Return arrays as lists, and None for what is not a number."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [_plain(item) for item in value]
    value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(value, float) and not np.isfinite(value) else value
