"""Verdicts and evidence on the covariance of any run, from whatever there is: innovations, NIS, truth.

`ekfslam.evaluation.verdict` judges full runs by their innovations. Other modes keep none, and older archives neither.
There the NIS of the frames, what was rejected, and the truth are what remains. Words are those of `ekfslam check`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import BoolArray
from ekfslam.data.sequence import Truth
from ekfslam.evaluation.consistency import chi2_bounds, measured_truth, pose_nees
from ekfslam.evaluation.honesty import SURE, Ratio, ratio
from ekfslam.evaluation.verdict import NOTABLE, Honesty, factor_text, percent, ratio_text
from ekfslam.filters.result import REASONS, Result

PROBABILITY = 0.95  # of the bounds of NEES
_POSE_DOF = 6


@dataclass(frozen=True)
class TruthAgreement:
    """Errors against the truth, in what the covariance says of them.

    The frames of a drive hang together, so that one drive counts as one sample.

    Args:
        nees: Mean of the pose NEES over the frames, the noise of the truth included; 6 expected.
        low, high: Bounds within which the NEES of one pose lies with 95 %.
    """

    nees: float
    low: float
    high: float

    @property
    def is_within(self) -> bool:
        return self.low <= self.nees <= self.high

    @property
    def factor(self) -> float:
        """By which the covariance is too small, in standard deviations, about; below 1: too large."""
        return float(np.sqrt(self.nees / _POSE_DOF))

    @property
    def verdict(self) -> str:
        """The judgement in words."""
        if self.is_within:
            return "honest as far as the truth of one drive can tell"
        return f"{factor_text(self.factor)} against the truth"

    @property
    def figures(self) -> str:
        """What it rests on, in words."""
        return f"pose NEES {self.nees:.3g}, where one honest drive has {self.low:.1f} to {self.high:.1f}"


@dataclass(frozen=True)
class InnovationSize:
    """Innovations of a run, in what their covariance says of them.

    Args:
        nis: Per degree of freedom.
    """

    nis: Ratio

    @property
    def factor(self) -> float:
        """By which they are larger than expected, in standard deviations."""
        return float(np.sqrt(self.nis.value))

    @property
    def is_expected(self) -> bool:
        """Whether they are not notably larger or smaller than expected, or may be so by chance."""
        return abs(self.nis.value - 1.0) <= SURE * self.nis.error or 1 / NOTABLE <= self.factor <= NOTABLE

    @property
    def verdict(self) -> str:
        """The judgement in words."""
        if self.is_expected:
            return "innovations are as large as expected"
        size = f"{self.factor:.1f}x larger" if self.factor > 1 else f"{1 / max(self.factor, 1e-3):.1f}x smaller"
        return f"innovations are about {size} than expected"

    @property
    def figures(self) -> str:
        """What it rests on, in words."""
        return f"NIS {ratio_text(self.nis)} per degree of freedom, where 1 is expected"


def truth_agreement(result: Result, truth: Truth | None, interpolated: BoolArray) -> TruthAgreement | None:
    """A run against the truth; None where no pose can be compared.

    Args:
        result: Of any mode.
        truth: Of the recording.
        interpolated: (T,) its interpolated intervals, after which nothing is judged.
    """
    if truth is None or not len(truth.frame):
        return None
    _, nees = pose_nees(result, measured_truth(truth, interpolated, result.time_s), with_truth_noise=True)
    if not np.isfinite(nees).any():
        return None
    low, high = chi2_bounds(_POSE_DOF, PROBABILITY)
    return TruthAgreement(float(np.nanmean(nees)), float(low), float(high))


def innovation_size(result: Result) -> InnovationSize | None:
    """How large the innovations of a run are; None where there are none."""
    innovation = result.innovation
    return InnovationSize(ratio(innovation.nis, innovation.dof)) if innovation.dof.sum() > 0 else None


def evidence_of(result: Result, truth: TruthAgreement | None, honesty: Honesty | None) -> dict[str, tuple[str, str]]:
    """What the verdicts on a run rest on, in words: from a figure's name to what was found, and what is expected."""
    rows = {}
    if truth is not None:
        expected = f"{_POSE_DOF}, of one drive {truth.low:.1f} to {truth.high:.1f}"
        rows["pose NEES, with truth noise"] = (f"{truth.nees:.3g}", expected)
    if honesty is not None:
        known = honesty.overview[: len(honesty.overview) - (honesty.smoother is None)]
        return rows | {name: (found, expected) for name, found, expected in known}
    size = innovation_size(result)
    if size is not None:
        rows["NIS"] = (ratio_text(size.nis), "1")
    total = int((result.innovation.accepted + result.innovation.rejected).sum())
    for code, name in enumerate(REASONS):
        share = float((result.rejections.reason == code).sum()) / max(total, 1)
        if share > 0:
            rows[f"rejected: {name}"] = (percent(share), "")
    return rows
