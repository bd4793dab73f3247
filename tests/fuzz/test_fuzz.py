"""Hostile inputs, reduced: some of every generator; `python tests/fuzz/long.py` tries as many as one likes."""

from __future__ import annotations

from pathlib import Path

import pytest
from generators import GENERATORS, Valid, case_of
from oracle import verdict
from support.running import WHOLE

# In one process, so that the valid ones are made once.
pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("hostile inputs")]

EACH = 14 if WHOLE else 6


@pytest.fixture(scope="module")
def valid() -> Valid:
    return Valid.prepared()


@pytest.mark.parametrize("family", range(len(GENERATORS)), ids=[one.__name__ for one in GENERATORS])
def test_every_input_is_taken_or_refused_by_name(valid, tmp_path, monkeypatch, family):
    monkeypatch.setattr("ekfslam.figures.style.png", lambda *_: b"")
    for i in range(EACH):
        seed = family + len(GENERATORS) * i
        case = case_of(valid, seed)
        assert verdict(case, tmp_path / "work") == "", (seed, case.arguments)


def test_valid_files_are_taken(valid, tmp_path):
    from generators import Case

    for name, content in valid.recordings.items():
        assert verdict(Case({name: content}, ["info", name]), tmp_path / "work") == ""
    assert Path(tmp_path / "work" / "own").exists()
