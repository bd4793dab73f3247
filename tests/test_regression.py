"""Results are those of an earlier version, frozen by `frozen/make.py`; all of them with white, stated noise."""

from __future__ import annotations

import numpy as np
import pytest
from frozen.make import (
    HERE,
    RECORDINGS,
    STARRY_NIGHT,
    STUDY_RUNS,
    WORLDS,
    of_recording,
    of_starry_night,
    of_study,
    of_world,
    read,
)

TOLERANCE = 1e-9  # of the largest number of an entry


def differences(found, frozen):
    """Entries that differ by too much, with by how much, relative to their scale; None where one is missing."""
    too_much = {}
    for name, value in frozen.items():
        if name not in found or np.size(found[name]) != value.size:
            too_much[name] = None
            continue
        off = np.abs(np.ravel(found[name]) - value).max() / np.abs(value).max(initial=np.finfo(float).tiny)
        if not off <= TOLERANCE:
            too_much[name] = float(off)
    return too_much


@pytest.mark.parametrize("name", WORLDS)
def test_built_in_worlds(name):
    assert differences(of_world(name), read(HERE / f"{name}.npz")) == {}


def test_records_of_a_study():
    found = {key: value for number in range(STUDY_RUNS) for key, value in of_study(number).items()}
    assert differences(found, read(HERE / "study.npz")) == {}


@pytest.mark.data
@pytest.mark.parametrize("name", RECORDINGS)
def test_recordings(name, data_path):
    assert differences(of_recording(name, data_path(f"ece276a/{name}.npz")), read(HERE / f"{name}.npz")) == {}


@pytest.mark.data
def test_windows_of_starry_night(data_path):
    assert differences(of_starry_night(data_path(STARRY_NIGHT)), read(HERE / "starry_night.npz")) == {}


def test_a_change_in_the_ninth_digit_shows():
    frozen = read(HERE / "loop.npz")
    for name, value in frozen.items():
        if value.any():
            changed = value.copy()
            changed[np.abs(value).argmax()] *= 1 + 3e-9
            assert list(differences({**frozen, name: changed}, frozen)) == [name]
    some = next(iter(frozen))
    assert differences({key: value for key, value in frozen.items() if key != some}, frozen) == {some: None}
