"""Settings: every one has a rule, state blocks have tables of their own, and everything survives its archive."""

from __future__ import annotations

import dataclasses
import json
import math
import warnings

import pytest

from ekfslam.cli import main
from ekfslam.config import RETIRED, Config, FilterConfig
from ekfslam.errors import ConfigError, RetiredSettingWarning

SETTINGS = [
    (table.name, setting)
    for table in dataclasses.fields(Config)
    if table.name not in ("blocks", "tuning")
    for setting in dataclasses.fields(getattr(Config(), table.name))
]
BLOCKS = {"twist_bias": {"sigma_v_m_s": 0.03, "steps": 2, "is_on": True}, "clone": {"kind": "pose"}}


@pytest.mark.parametrize(("table", "setting"), SETTINGS, ids=[f"{table}.{s.name}" for table, s in SETTINGS])
def test_every_setting_refuses_another_kind_and_nan(table, setting):
    wrong = [math.nan, [1.0]] + ([] if setting.metadata["rule"].kind is str else ["word"])
    for value in wrong:
        with pytest.raises(ConfigError, match=rf"{table}\.{setting.name} must .*, found "):
            Config().with_overrides({table: {setting.name: value}})


@pytest.mark.parametrize("name", ["iterations", "retire_after", "revive", "split_after"])
def test_whole_numbers(name):
    with pytest.raises(ConfigError, match=rf"filter\.{name} must be a whole number, found 2\.5"):
        Config().with_overrides({"filter": {name: 2.5}})
    with pytest.raises(
        ConfigError, match=rf"filter\.{name} must be a whole number not below -?\d, nor above \d+, found -7"
    ):
        Config().with_overrides({"filter": {name: -7}})
    assert type(getattr(Config().with_overrides({"filter": {name: 2.0}}).filter, name)) is int


def test_none_is_skipped_in_overrides_and_refused_where_it_means_nothing():
    assert Config().with_overrides({"filter": {"iterations": None}}) == Config()
    with pytest.raises(ConfigError, match=r"filter\.iterations must be a whole number, found None"):
        Config(filter=FilterConfig(iterations=None))  # type: ignore[arg-type]


def test_settings_of_state_blocks_from_a_file_and_through_an_archive(tmp_path):
    path = tmp_path / "config.toml"
    path.write_text("[blocks.twist_bias]\nsigma_v_m_s = 0.03\nsteps = 2\nis_on = true\n[blocks.clone]\nkind = 'pose'\n")
    config = Config.from_toml(path)
    assert config.blocks == BLOCKS
    assert Config().with_overrides(json.loads(json.dumps(dataclasses.asdict(config)))) == config


def test_overrides_of_state_blocks_merge_block_by_block():
    config = Config(blocks=BLOCKS).with_overrides({"blocks": {"twist_bias": {"steps": 3, "is_on": None}, "new": {}}})
    assert config.blocks == {"twist_bias": {**BLOCKS["twist_bias"], "steps": 3}, "clone": {"kind": "pose"}, "new": {}}
    assert Config(blocks=BLOCKS).with_overrides({"noise": {"sigma_px": 2.0}}).blocks == BLOCKS


@pytest.mark.parametrize(
    ("blocks", "message"),
    [
        (3, r"\[blocks\] must be a table"),
        ({"twist_bias": 0.03}, r"\[blocks\.twist_bias\] must be a table, found 0\.03"),
        ({"twist_bias": {"sigma": [1.0]}}, r"blocks\.twist_bias\.sigma must be a number, a string or a truth value"),
        ({"twist_bias": {"sigma": math.nan}}, r"blocks\.twist_bias\.sigma must .*, found nan"),
    ],
)
def test_bad_tables_of_state_blocks_are_named(blocks, message):
    with pytest.raises(ConfigError, match=message):
        Config().with_overrides({"blocks": blocks})
    with pytest.raises(ConfigError, match=message):
        Config(blocks=blocks)


@pytest.mark.parametrize("name", RETIRED)
def test_a_retired_setting_is_skipped_with_a_warning(name):
    table, key = name.split(".")
    with pytest.warns(RetiredSettingWarning, match=rf"^{name} is ignored: "):
        config = Config().with_overrides({table: {key: {} if table == "blocks" else 1}})
    assert config == Config()


def test_retired_settings_of_a_stored_configuration_are_skipped_without_a_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        stored = Config.from_stored({"front_end": {"settling": 20, "features": 90}, "filter": {"variant": "fej"}})
    assert (stored.front_end.features, stored.filter.variant) == (90, "fej")


def test_the_command_line_prints_a_retired_setting_as_a_note(tmp_path, capsys):
    path = tmp_path / "old.toml"
    path.write_text("[blocks.stereo_rotation]\ntime_s = 5.0\n")
    assert main(["run", "nothing.mat", "--config", str(path), "--out", str(tmp_path / "o.h5")]) == 2
    assert capsys.readouterr().err.startswith("ekfslam: note: blocks.stereo_rotation is ignored: the block is gone")


def test_a_record_of_tuning_is_kept_as_it_was_written(tmp_path):
    (tmp_path / "noise.toml").write_text('[tuning]\nsequence = "city"\nruns = 9\nlog_likelihood = -2.5\n')
    assert Config.from_toml(tmp_path / "noise.toml").tuning == {"sequence": "city", "runs": 9, "log_likelihood": -2.5}


@pytest.mark.parametrize(
    ("record", "message"),
    [
        (3, r"\[tuning\] must be a table"),
        ({"runs": [1.0]}, r"tuning\.runs must be a number"),
        ({"runs": math.nan}, r"tuning\.runs must be a number, not NaN"),
        ({"a/b": 1.0}, "'a/b' must be a plain name"),
    ],
)
def test_a_bad_record_of_tuning_is_named(record, message):
    with pytest.raises(ConfigError, match=message):
        Config().with_overrides({"tuning": record})
