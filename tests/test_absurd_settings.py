"""Every setting with absurd values: a named error, or a result without NaN, in little time."""

from __future__ import annotations

import dataclasses
import itertools
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from support.running import WHOLE

from ekfslam.config import Config
from ekfslam.data.simulate import BUILTIN, builtin, numbers_of
from ekfslam.errors import ConfigError, EkfslamError
from ekfslam.models.blocks import OPTIONAL_BLOCKS
from ekfslam.reports import compare
from ekfslam.studies.executors import open_executor
from ekfslam.studies.study import LEVELS, Study

TABLES = {name: table for name, table in vars(Config()).items() if name not in ("blocks", "tuning")}
KEYS = [(table, field.name) for table, value in TABLES.items() for field in dataclasses.fields(value)]
BLOCKS = [(name, field.name) for name, block in OPTIONAL_BLOCKS.items() for field in dataclasses.fields(block)]
REFUSED: list[Any] = [np.nan, -1e308, 1e308, 10**400, -(10**400), [], {}, [1.0], b"x", 1j]
EXTREME: list[Any] = [0, 0.0, 1e-300, 1e-6, 1, 2.5, 1e6, 10**6, True, "x", float("inf"), -1]
FRAMES = 12 if WHOLE else 6
FIELDS = ("T_world_imu", "covariance", "time_s", "ms_per_frame")


def tried(overrides: dict[str, Any]) -> bool:
    """Whether a configuration is taken; then no mode that has a result has NaN in it."""
    try:
        config = Config().with_overrides(overrides)
        results = compare(builtin(f"city?frames={FRAMES}"), config=config).results
    except EkfslamError as error:
        assert str(error)
        return False
    for result in results.values():
        assert all(np.isfinite(getattr(result, name)).all() for name in FIELDS), (overrides, result.mode)
        assert np.isfinite(result.landmarks.position_m).all(), (overrides, result.mode)
        assert np.isfinite(result.landmarks.covariance).all(), (overrides, result.mode)
    return True


@pytest.mark.parametrize(("table", "key"), KEYS)
def test_what_is_no_setting_is_refused_by_name(table, key):
    for value in REFUSED:
        if (table, key) in (("filter", "moving_sigma"), ("filter", "moving_share")) and value in (1e308, 10**400):
            continue  # so many standard deviations: never
        try:
            Config().with_overrides({table: {key: value}})
        except ConfigError as error:
            assert key in str(error), value
        else:
            pytest.fail(f"{value!r} was taken")


def extremes(table: str, key: str) -> list[Any]:
    """Values that make different configurations; in the reduced form the two least and the greatest."""
    found: list[tuple[Config, Any]] = []
    for value in EXTREME:
        with suppress(ConfigError):
            config = Config().with_overrides({table: {key: value}})
            if all(config != other for other, _ in found):
                found.append((config, value))
    values = [value for _, value in found]
    if WHOLE or len(values) < 4:
        return values
    ordered = sorted(values)
    return [*ordered[:2], ordered[-1]]


# Settings of the front end decide nothing where there are no images.
@pytest.mark.slow
@pytest.mark.parametrize(("table", "key"), [pair for pair in KEYS if pair[0] not in ("truth", "front_end")])
def test_extreme_settings_end_in_a_named_error_or_a_result_without_nan(table, key):
    assert {tried({table: {key: value}}) for value in extremes(table, key)} <= {True, False}


@pytest.mark.parametrize("seed", range(12))
def test_extreme_settings_together(seed):
    rng = np.random.default_rng(seed)
    overrides: dict[str, dict[str, Any]] = {}
    for i in rng.choice(len(KEYS), 3, replace=False):
        table, key = KEYS[i]
        rule = dataclasses.fields(TABLES[table])[[f.name for f in dataclasses.fields(TABLES[table])].index(key)]
        taken = [value for value in EXTREME if _is_taken(rule.metadata["rule"], key, value)]
        if taken:
            overrides.setdefault(table, {})[key] = taken[rng.integers(len(taken))]
    tried(overrides)


def _is_taken(rule: Any, key: str, value: object) -> bool:
    try:
        rule.check(key, rule.plain(value))
    except ConfigError:
        return False
    return True


@pytest.mark.parametrize(("name", "key"), BLOCKS)
def test_settings_of_blocks_have_bounds(name, key):
    for value in (np.nan, -1.0, 1e308, float("inf"), "x", True, 10**400):
        assert not tried({"blocks": {name: {key: value}}}), value
    least = 1e-6 if key.startswith(("time", "length")) else 0.0
    for value in (least, 1e6):
        tried({"blocks": {name: {key: value}}})


@pytest.mark.parametrize("world", BUILTIN)
def test_parameters_of_worlds_have_bounds(world):
    for key, value in itertools.product(numbers_of(BUILTIN[world]), ("nan", "inf", "-1", "1e300", "1" + "0" * 40)):
        if key == "seed" and value.isdigit():
            continue
        with pytest.raises(EkfslamError, match=key):
            builtin(f"{world}?{key}={value}")


@pytest.mark.parametrize(
    "world",
    [
        "loop?frames=100000&landmarks=20000",
        "city?frames=100000&frame_period_s=100",
        "city?max_range_m=10000&landmarks_per_m=100",
    ],
)
def test_worlds_too_large_are_refused(world):
    with pytest.raises(ConfigError, match="too many"):
        builtin(world)


def test_updates_that_would_never_end_are_refused():
    with pytest.raises(ConfigError, match="iterations must be a whole number not below 1, nor above 100"):
        Config().with_overrides({"filter": {"iterations": 1e9}})


def test_studies_that_would_never_end_are_refused():
    with pytest.raises(ConfigError, match="too large"):
        Study({"mid": LEVELS["mid"]}, runs=10**9)
    with pytest.raises(ConfigError, match="workers"), open_executor("processes", 10**9):
        pass
