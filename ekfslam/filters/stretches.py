"""Innovations of short stretches of a recording, by which automatic settings are decided."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from ekfslam.config import FilterConfig
from ekfslam.data.sequence import Observations, Sequence
from ekfslam.filters import gates
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import one_thread, run_filter
from ekfslam.models.model import Model
from ekfslam.models.sensors.base import GATE


class Stretch(NamedTuple):
    """Sums over a stretch: NIS and degrees of freedom, and the log-likelihood, see `run_stretches`."""

    nis: float
    dof: int
    log_likelihood: float


def stretches_of(frames: int, length: int, count: int) -> list[range]:
    """Return ``count`` stretches of ``length`` frames, in the middle of as many equal parts of a recording."""
    begins = ((np.arange(count) + 0.5) * frames / count - length / 2).astype(int).clip(0)
    return [range(begin, min(begin + length, frames)) for begin in begins.tolist()]


def run_stretches(model: Model, config: FilterConfig, sequence: Sequence, stretches: list[range]) -> list[Stretch]:
    """Return what the joint filter without a lag finds in each stretch, which it starts anew.

    A rejected observation has the log-density of one at the gate: otherwise a noise that is too small would be the
    likelier the more it rejects.
    """
    found, config, d = [], dataclasses.replace(config, lag=0), model.sensor.dimension
    gate = gates.threshold(config.gate_probability, d)
    with one_thread():
        for frames in stretches:
            # Without a revival: what comes back within a stretch starts again.
            reports = [frame.report for frame in run_filter(JointEKF(model, config), sequence, frames)]
            nis, dof = sum(report.nis for report in reports), sum(report.dof for report in reports)
            density = sum(report.log_likelihood for report in reports)
            rejected = sum(int((report.reason == GATE).sum()) for report in reports)
            at_gate = 0.5 * (gate + (-2.0 * density - nis) * d / max(dof, 1))
            found.append(Stretch(nis, dof, density - rejected * at_gate))
    return found


def thinned(sequence: Sequence, stretches: list[range], most: int) -> Sequence:
    """Return the recording with the ``most`` longest tracks of each stretch alone."""
    o = sequence.observations
    keep = np.zeros(len(o), dtype=bool)
    for frames in stretches:
        inside = np.flatnonzero((o.frame >= frames.start) & (o.frame < frames.stop))
        _, which, count = np.unique(o.landmark[inside], return_inverse=True, return_counts=True)
        keep[inside[np.isin(which, np.argsort(-count, kind="stable")[:most])]] = True
    chosen = Observations(o.frame[keep], o.landmark[keep], o.pixels_px[keep])
    return dataclasses.replace(sequence, observations=chosen)
