"""The number of threads of BLAS changes no bit of a result."""

from __future__ import annotations

import numpy as np
import pytest
from support.running import recording
from threadpoolctl import threadpool_limits

from ekfslam import open_sequence
from ekfslam.reports import run_modes
from ekfslam.resolve import resolve
from ekfslam.stored import values_of


def bits_of(sequence) -> dict[str, bytes]:
    """All numbers of a filtered and a smoothed run, except the times."""
    found = {}
    for mode, result in run_modes(sequence, ["full", "smoothed"]).items():
        found |= {f"{mode} {name}": np.asarray(value).tobytes() for name, _, value in values_of(result)}
    return {name: value for name, value in found.items() if "ms_per_frame" not in name}


def with_threads(threads: int, data: str, frames: int) -> tuple[dict[str, bytes], str]:
    with threadpool_limits(threads, user_api="blas"):
        sequence = open_sequence(data)[:frames]
        return bits_of(sequence), repr(resolve(sequence).config)


def test_a_run_and_its_posterior_do_not_depend_on_the_threads_of_blas():
    assert with_threads(1, "builtin:city?frames=40", 40) == with_threads(2, "builtin:city?frames=40", 40)


@pytest.mark.data
@pytest.mark.slow
def test_noise_that_is_found_does_not_depend_on_the_threads_of_blas():
    data = str(recording("utias/2011_09_26_drive_0001_sync_KLT.mat"))
    assert with_threads(1, data, 60) == with_threads(2, data, 60)
