"""The engine is faster than the reference filter."""

from __future__ import annotations

import dataclasses
from time import process_time

import numpy as np
import pytest

from ekfslam.data.simulate import builtin
from ekfslam.engine import choice
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import one_thread, run_filter
from ekfslam.resolve import resolve

pytestmark = pytest.mark.skipif(bool(choice.MISSING), reason=f"engine: {choice.MISSING}")

LEAST_GAIN = 1.5  # the gain is above two; the clock is the processor's, which other programs hardly disturb


def test_the_median_frame_of_the_engine_is_faster_than_that_of_the_reference_filter():
    problem = resolve(builtin("city?frames=30&max_tracks=60"))
    filters = (
        JointEKF(problem.model, dataclasses.replace(problem.config.filter, engine=engine))
        for engine in ("engine", "reference")
    )
    with one_thread():  # frame by frame in turn, so that a slow moment of the machine hits both
        frames = list(zip(*(run_filter(ekf, problem.sequence, clock=process_time) for ekf in filters), strict=True))
    engine_ms, reference_ms = np.median([[frame.ms for frame in pair] for pair in frames[10:]], axis=0)
    assert LEAST_GAIN * engine_ms < reference_ms


def test_a_frame_of_the_engine_takes_no_longer_late_in_a_drive_than_early():
    """Views that only old landmarks depend on leave the matrix, which would grow by twelve columns a frame."""
    problem = resolve(builtin("city?frames=160&max_tracks=30"))
    ekf = JointEKF(problem.model, dataclasses.replace(problem.config.filter, engine="engine"))
    with one_thread():
        ms = [frame.ms for frame in run_filter(ekf, problem.sequence, clock=process_time)]
    assert np.median(ms[-40:]) < 3.0 * np.median(ms[20:60])
