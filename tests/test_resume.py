"""The journal of finished runs, from which killed studies and sweeps resume; single runs start from the beginning."""

from __future__ import annotations

import numpy as np
import pytest
from support.studies import short

from ekfslam.cli import main
from ekfslam.errors import ArchiveError
from ekfslam.provenance import versions
from ekfslam.studies.executors import SerialExecutor
from ekfslam.studies.journal import Journal, framed
from ekfslam.studies.study import Study, run_one, run_study


@pytest.mark.parametrize("arguments", [["run", "--out", "a.h5"], ["compare", "--out", ".", "--no-figures"]])
def test_resume_of_a_run_is_accepted_with_a_note(tmp_path, monkeypatch, capsys, arguments):
    monkeypatch.chdir(tmp_path)
    assert main([*arguments, "--resume", "--frames", "0:4"]) == 0
    assert "note: --resume has no effect" in capsys.readouterr().out


@pytest.mark.parametrize("kind", ["another study", "level", "run", "short", "long", "no JSON"])
def test_a_journal_of_something_else_is_a_named_error(tmp_path, kind):
    blank = {"invariant": {"pose_nees": np.zeros(3), "diverged": np.zeros((), dtype=bool)}}
    journal = Journal(tmp_path / "a.h5", {"seed": 1}, lambda level: {"mid": blank}[level])
    journal.append(("mid", 0), blank)
    assert [key for key, _ in journal.entries()] == [("mid", 0)]
    bad = {"level": b'["x", 1]\n', "run": b'["mid", []]\n', "short": b'["mid", 1]\n1234', "no JSON": b"[" * 100_000}
    bad["long"] = b'["mid", 1]\n' + bytes(26)
    if kind == "another study":
        journal = Journal(tmp_path / "a.h5", {"seed": 2}, lambda level: blank)
    else:
        with journal.path.open("ab") as file:
            file.write(framed(bad[kind]))
    with pytest.raises(ArchiveError, match=r"a\.h5\.journal"):
        list(journal.entries())


@pytest.mark.parametrize(("changed", "kept"), [(0, 0), (1, 1)])
def test_an_entry_whose_content_does_not_fit_its_digest_ends_the_journal(tmp_path, changed, kept):
    blank = {"invariant": {"pose_nees": np.zeros(3)}}
    journal = Journal(tmp_path / "a.h5", {"seed": 1}, lambda level: blank)
    ends = []
    for run in range(2):
        journal.append(("mid", run), {"invariant": {"pose_nees": np.full(3, run + 1.0)}})
        ends.append(journal.path.stat().st_size)
    content = bytearray(journal.path.read_bytes())
    content[ends[changed] - 1] ^= 1
    journal.path.write_bytes(content)
    assert [run for (_, run), _ in journal.entries()] == list(range(kept))


def test_a_run_appended_after_an_incomplete_entry_is_read(tmp_path):
    blank = {"invariant": {"pose_nees": np.zeros(3)}}
    journal = Journal(tmp_path / "a.h5", {"seed": 1}, lambda level: blank)
    journal.append(("mid", 0), blank)
    with journal.path.open("ab") as file:
        file.write(framed(b"killed")[:-1])
    assert [run for (_, run), _ in journal.entries()] == [0]
    journal.append(("mid", 1), blank)
    assert [run for (_, run), _ in journal.entries()] == [0, 1]


def test_a_journal_of_a_longer_study_serves_a_shorter_one(tmp_path):
    longer = Study(short("mid", 6), ("invariant",), runs=3)
    record = run_one(longer, "mid", 2)
    journal = Journal(tmp_path / "a.h5", {**longer.parameters, "runs": None, **versions()}, lambda level: record)
    journal.append(("mid", 2), record)
    shorter = Study(longer.levels, longer.variants, runs=2)
    assert run_study(shorter, tmp_path / "a.h5", SerialExecutor(), False).complete
    assert [path.name for path in tmp_path.iterdir()] == ["a.h5"]
