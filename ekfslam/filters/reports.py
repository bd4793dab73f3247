"""What a frame's observations did, and the reports of a run as flat arrays."""

from __future__ import annotations

from collections.abc import Sequence as SequenceType
from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import BoolArray, IntArray
from ekfslam.filters.innovations import FrameInnovations
from ekfslam.filters.result import REASONS, Innovation, Rejections
from ekfslam.models.sensors.base import ACCEPTED, BEHIND_CAMERA, GATE, WAITING


@dataclass(frozen=True)
class FrameReport:
    """Outcome of one frame's observations."""

    frame: int  # frame index
    ids: IntArray  # (n,) landmark ids seen
    reason: IntArray  # (n,) `ACCEPTED` or an index into `REASONS`
    nis: float  # normalised innovation squared of the accepted updates
    dof: int  # degrees of freedom of the NIS
    split: IntArray  # ids of tracks that were split: their observation starts a new landmark
    # Log-density of the accepted innovations, and of measured velocities if these are in the state.
    log_likelihood: float
    innovations: FrameInnovations | None = None  # whitened innovations of the accepted updates (joint filter only)
    doubt: float = 1.0  # factor of the inputs' standard deviations; above 1 if the landmarks contradicted them
    # Whether the tracks rest, so that the velocity was taken as 0; False: something contradicts it. None: they move, or
    # the velocity is not in the state.
    standing: bool | None = None


def log_density(nis: float, log_det: float, dof: int) -> float:
    """Return ``log N(r; 0, S) = -(r^T S^-1 r + log det S + n log 2 pi) / 2`` from the NIS, ``log det S`` and n.

    Summed over a run it is the log-likelihood of the filter's parameters: the prediction error decomposition, Schweppe,
    "Evaluation of likelihood functions for Gaussian signals", IEEE Trans. Information Theory 11, 1965.
    """
    return -0.5 * float(nis + log_det + dof * np.log(2 * np.pi))


def missed(reason: IntArray) -> BoolArray:
    """Return whether (n,) an observation is evidence against its landmark, not merely against itself."""
    return (reason == GATE) | (reason == BEHIND_CAMERA)


def collect(reports: SequenceType[FrameReport]) -> tuple[Innovation, Rejections, dict[str, int]]:
    """Return the reports of a run as flat arrays, and the totals: accepted, rejected, rejected per reason."""
    ids = np.concatenate([report.ids for report in reports])
    reason = np.concatenate([report.reason for report in reports])
    frame = np.repeat([report.frame for report in reports], [len(report.ids) for report in reports])
    rejected = reason != ACCEPTED
    rejections = Rejections(frame[rejected], ids[rejected], reason[rejected])
    innovation = Innovation(
        nis=np.array([report.nis for report in reports]),
        dof=np.array([report.dof for report in reports], dtype=np.int64),
        accepted=np.array([(report.reason == ACCEPTED).sum() for report in reports], dtype=np.int64),
        rejected=np.array([(report.reason != ACCEPTED).sum() for report in reports], dtype=np.int64),
    )
    split = sum(len(report.split) for report in reports)
    counts = {"accepted": int((~rejected).sum()), "rejected": int(rejected.sum()), "split": split}
    for code, name in enumerate(REASONS):
        count = int((reason == code).sum())
        if code != WAITING or count:
            counts[f"rejected: {name}"] = count
    if doubted := sum(report.doubt > 1.0 for report in reports):
        counts["rejected: velocities"] = doubted
    for name, is_standing in (("frames at rest", True), ("rejected: zero velocity", False)):
        if count := sum(report.standing is is_standing for report in reports):
            counts[name] = count
    return innovation, rejections, counts
