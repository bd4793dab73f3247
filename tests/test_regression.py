"""Results are those of an earlier version, frozen by `frozen/make.py` (white noise) and `frozen/automatic.py`."""

from __future__ import annotations

import numpy as np
import pytest
from frozen import automatic
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
from support.running import WHOLE

from ekfslam.config import VARIANTS

TOLERANCE = 1e-9  # of the largest number of an entry
# The frozen program itself moves smoothed covariances of the automatic model by 7e-9, with the order of elimination.
SMOOTHED_COVARIANCE = 1e-8


def differences(found, frozen):
    """Entries that differ by too much, with by how much, relative to their scale; None where one is missing."""
    too_much = {}
    for name, value in frozen.items():
        if name not in found or np.size(found[name]) != value.size:
            too_much[name] = None
            continue
        off = np.abs(np.ravel(found[name]) - value).max() / np.abs(value).max(initial=np.finfo(float).tiny)
        is_loose = ": smoothed: " in name and name.endswith("covariances")
        if not off <= (SMOOTHED_COVARIANCE if is_loose else TOLERANCE):
            too_much[name] = float(off)
    return too_much


# Variants of the reduced form of the tests: one of each source, all of them together.
VARIANT = {"city": "invariant", "loop": "standard", "revival": "fej", "0027": "fej", "0020": "standard"}


def variants_of(name):
    return tuple(VARIANTS) if WHOLE else (VARIANT[name],)


def is_smoothed(name):
    return WHOLE or name != "city"


def frozen_of(name):
    """What was frozen of the modes without variants, and of the variants that are run."""
    left_out = [f", {variant}: " for variant in VARIANTS if variant not in variants_of(name)]
    left_out += [] if is_smoothed(name) else [": smoothed, "]
    return {key: x for key, x in read(HERE / f"{name}.npz").items() if not any(words in key for words in left_out)}


@pytest.mark.parametrize(
    "name", [name if name == "revival" else pytest.param(name, marks=pytest.mark.slow) for name in WORLDS]
)
def test_built_in_worlds(name):
    assert differences(of_world(name, variants_of(name), is_smoothed(name)), frozen_of(name)) == {}


@pytest.mark.slow
def test_records_of_a_study():
    found = {key: value for number in range(STUDY_RUNS) for key, value in of_study(number).items()}
    assert differences(found, read(HERE / "study.npz")) == {}


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize("name", RECORDINGS)
def test_recordings(name, data_path):
    found = of_recording(name, data_path(f"ece276a/{name}.npz"), variants_of(name))
    assert differences(found, frozen_of(name)) == {}


@pytest.mark.slow
@pytest.mark.data
def test_windows_of_starry_night(data_path):
    assert differences(of_starry_night(data_path(STARRY_NIGHT)), read(HERE / "starry_night.npz")) == {}


def frozen_automatic(name):
    """What was frozen of a source by the automatic model."""
    return {key: x for key, x in read(automatic.FILE).items() if key.startswith(f"{name}: ")}


@pytest.mark.slow
@pytest.mark.parametrize("name", automatic.WORLDS)
def test_the_automatic_model_on_built_in_worlds(name):
    assert differences(automatic.of_source(name, name), frozen_automatic(name)) == {}


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize("name", automatic.RECORDINGS)
def test_the_automatic_model_on_recordings(name, data_path):
    assert differences(automatic.of_source(name, data_path(name)), frozen_automatic(name)) == {}


def test_a_change_in_the_ninth_digit_shows():
    frozen = read(HERE / "loop.npz")
    for name, value in frozen.items():
        if value.any():
            changed = value.copy()
            changed[np.abs(value).argmax()] *= 1 + 3e-9
            assert list(differences({**frozen, name: changed}, frozen)) == [name]
    some = next(iter(frozen))
    assert differences({key: value for key, value in frozen.items() if key != some}, frozen) == {some: None}
