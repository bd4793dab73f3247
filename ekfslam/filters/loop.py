"""The one loop over the frames of a recording, for runner, studies, tuning and experiments."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from time import perf_counter
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from ekfslam.data.sequence import Sequence
from ekfslam.errors import FilterError
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.mapping import IndependentLandmarks
from ekfslam.filters.reports import FrameReport
from ekfslam.models.sensors.velocities import Both, VelocitySource


class Frame(NamedTuple):
    """One processed frame: its number, the report on its observations, and the wall-clock time in ms."""

    number: int
    report: FrameReport
    ms: float


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit BLAS to one thread; also a decorator.

    For small dense matrices a second one costs three times what it saves. Their number changes the last bits.
    """
    with threadpool_limits(1, user_api="blas"):
        yield


@contextmanager
def solvable() -> Iterator[None]:
    """Raise `FilterError` for a matrix that cannot be inverted or decomposed; also a decorator."""
    try:
        yield
    except np.linalg.LinAlgError as error:
        reason = f"{str(error)[:1].lower()}{str(error)[1:]}"
        raise FilterError(f"velocities, pixels or their noise are beyond what numbers can hold: {reason}") from error


def run_filter(
    estimator: JointEKF | IndependentLandmarks,
    sequence: Sequence,
    frames: Iterable[int] | None = None,
    further: VelocitySource | Both | None = None,
    clock: Callable[[], float] = perf_counter,
) -> Iterator[Frame]:
    """Feed a recording to an estimator frame by frame; its state can be read in between.

    Args:
        estimator: New estimator, which begins at the first of the frames.
        sequence: The recording.
        frames: Successive frames, all by default (or wrapped in a progress bar).
        further: Velocity measurements of another sensor.
        clock: Function that returns seconds; by default wall-clock time.
    """
    begun = False
    for k in range(len(sequence)) if frames is None else frames:
        begin = clock()
        if isinstance(estimator, JointEKF):
            if begun:
                before, now = float(sequence.time_s[k - 1]), float(sequence.time_s[k])
                also = None if further is None else further.during(before, now)
                estimator.predict(sequence.interval(k, estimator.model.process.takes), also=also)
            else:
                estimator.begin(sequence.inputs_at(k, estimator.model.process.takes))
        begun = True
        report = estimator.update(k, *sequence.observations.at(k))
        yield Frame(k, report, 1e3 * (clock() - begin))
