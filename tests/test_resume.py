"""Interrupted studies resume and end in the same bits as undisturbed ones; runs start from the beginning."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.running import processes
from support.studies import short

from ekfslam.cli import main
from ekfslam.errors import ArchiveError
from ekfslam.provenance import versions
from ekfslam.studies import study as montecarlo
from ekfslam.studies.executors import SerialExecutor
from ekfslam.studies.journal import Journal, framed
from ekfslam.studies.study import Study, run_one, run_study


@pytest.mark.parametrize("arguments", [["run", "--out", "a.h5"], ["compare", "--out", ".", "--no-figures"]])
def test_resume_of_a_run_is_accepted_with_a_note(tmp_path, monkeypatch, capsys, arguments):
    monkeypatch.chdir(tmp_path)
    assert main([*arguments, "--resume", "--frames", "0:4"]) == 0
    assert "note: --resume has no effect" in capsys.readouterr().out


def same_archives(a: Path, b: Path) -> None:
    """All data sets but the times are the same bits."""
    found: list[dict[str, bytes]] = []
    for path in (a, b):
        data: dict[str, bytes] = {}
        with h5py.File(path) as h5file:
            h5file.visititems(
                lambda name, item, data=data: data.update({name: item[()].tobytes()} if hasattr(item, "dtype") else {})
            )
        found.append({name: value for name, value in data.items() if "timing" not in name})
    assert found[0] == found[1]


def study_killed(path: Path, after: int) -> None:
    began, true_run = path.with_name("began"), montecarlo.run_one

    def counted(study, level, run):
        with began.open("a") as log:
            log.write(f"{level} {run}\n")
        if len(began.read_text().splitlines()) > after:
            os.kill(os.getpid(), signal.SIGKILL)
        return true_run(study, level, run)

    montecarlo.run_one = counted
    run_study(Study(short("mid", 6), ("invariant",), runs=6, seed=2), path, SerialExecutor(), False)


def study_process(path: Path, after: int) -> list[str]:
    """The runs that a process began which is killed in the midst of one."""
    assert processes((study_killed, path, after))[0] in (0, -signal.SIGKILL)
    began = path.with_name("began")
    lines = began.read_text().splitlines()
    began.unlink()
    return lines


@pytest.mark.slow
@pytest.mark.xdist_group("processes")
def test_a_killed_study_keeps_every_finished_run(tmp_path):
    assert study_process(tmp_path / "a.h5", 2) == ["mid 0", "mid 1", "mid 2"]
    assert [path.name for path in tmp_path.iterdir()] == [".a.h5.journal"], "no archive yet: it was too quick"
    assert study_process(tmp_path / "a.h5", 1) == ["mid 2", "mid 3"]
    journal = tmp_path / ".a.h5.journal"
    journal.write_bytes(journal.read_bytes()[:-7])  # as if killed in the midst of writing
    assert study_process(tmp_path / "a.h5", 99) == [f"mid {i}" for i in range(2, 6)]
    assert study_process(tmp_path / "b.h5", 99) == [f"mid {i}" for i in range(6)]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.h5", "b.h5"]
    same_archives(tmp_path / "a.h5", tmp_path / "b.h5")


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
