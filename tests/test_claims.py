"""Two commands at once into one place: who comes second is told, before any work, and nothing is lost."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

import pytest
from support.images import write_euroc
from support.running import processes

from ekfslam import files
from ekfslam.cli import main
from ekfslam.errors import WriteError

WORLD, PLACE = "builtin:city?frames=25", "city"  # the folder that `compare` makes of it
SWEEP = 'recordings = ["builtin:loop?frames=4"]\nmodes = ["dead-reckoning"]\n'

# Command: its arguments, files that it claims for writing, and for reading. {x} is an archive.
COMMANDS: dict[str, tuple[str, set[str], set[str]]] = {
    "run": (f"run {WORLD} --out {{x}}", {"archive.h5"}, set()),
    "simulate": (f"simulate {WORLD} --force --out {{x}}", {"archive.h5"}, set()),
    "track": ("track {images} --force --out {x}", {"archive.h5", "archive.png"}, set()),
    "tune": (f"tune {WORLD} --force --out {{x}}", {"archive.h5"}, set()),
    "covariance": (
        f"covariance {WORLD} --trajectory {{tum}} --force --out {{x}}",
        {"archive.h5", "archive.txt"},
        set(),
    ),
    "compare": (
        f"compare {WORLD} --out {{out}} --table {{folder}}/paper.tex",
        {"archive.h5", "summary.json", "*.png", "paper.tex"},
        set(),
    ),
    "posterior": ("posterior {x}", {"*.png"}, {"archive.h5"}),
    "plot": ("plot {x}", {"*.png"}, {"archive.h5"}),
    "check": ("check {x}", {"check.json"}, {"archive.h5"}),
    "animate": ("animate {x} --pictures 2", {"drive.gif"}, {"archive.h5"}),
    "report": ("report {x}", {"report.html"}, {"archive.h5"}),
    "export": ("export {x} --format tum --out {x}.txt", {"archive.h5.txt"}, {"archive.h5"}),
    "consistency": (
        "consistency --runs 1 --variants invariant --executor serial --out {folder} --table {folder}/paper.tex",
        {"study.h5", "summary.json", "paper.tex"},
        set(),
    ),
    "sweep": (
        "sweep {study} --executor serial --out {folder} --table {folder}/paper.tex",
        {"sweep.h5", "paper.tex"},
        set(),
    ),
}


def conflict(first: str, second: str) -> bool:
    (_, writes, reads), (_, others, read) = COMMANDS[first], COMMANDS[second]
    return bool(writes & (others | read) or reads & others)


@contextmanager
def claimed_elsewhere(*writes: Path, reads: tuple[Path, ...] = ()) -> Iterator[None]:
    """Let another thread claim files."""
    begun, over = threading.Event(), threading.Event()

    def claim() -> None:
        with files.claimed(*writes, reads=reads):
            begun.set()
            over.wait(60)

    thread = threading.Thread(target=claim)
    thread.start()
    assert begun.wait(60)
    try:
        yield
    finally:
        over.set()
        thread.join()


def contents(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in folder.iterdir() if not p.name.startswith(".ekfslam.")}


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A folder with an archive, a trajectory, images and a sweep."""
    folder = tmp_path_factory.mktemp("claims")
    assert main(["compare", WORLD, "--modes", "full", "--no-figures", "--out", str(folder)]) == 0
    assert main(["export", str(folder / PLACE / "archive.h5"), "--format", "tum", "--out", f"{folder}/tum.txt"]) == 0
    (folder / "study.toml").write_text(SWEEP)
    write_euroc(folder / "images")
    return folder


def arguments(made: Path, command: str, x: Path) -> list[str]:
    places = {"x": x, "folder": x.parent, "out": x.parent.parent, "tum": made / "tum.txt", "images": made / "images"}
    return [part.format(**places, study=made / "study.toml") for part in COMMANDS[command][0].split()]


@pytest.mark.parametrize("second", COMMANDS)
def test_who_comes_second_is_told_whatever_came_first(made, capsys, second):
    x = made / PLACE / "archive.h5"
    before = contents(x.parent)
    for first, (_, writes, reads) in COMMANDS.items():
        if not conflict(first, second):
            continue
        with claimed_elsewhere(*(x.parent / w for w in writes), reads=tuple(x.parent / r for r in reads)):
            assert main(arguments(made, second, x)) == 2, first
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and "another command is writing or reading it; wait for its end" in said
        assert contents(x.parent) == before
    assert not list(x.parent.glob(".ekfslam.*"))


@pytest.mark.slow
@pytest.mark.parametrize("command", [name for name in COMMANDS if name != "track"])
def test_a_command_holds_its_claims_until_its_files_are_written(made, tmp_path, monkeypatch, undrawn, command):
    x = tmp_path / PLACE / "archive.h5"
    x.parent.mkdir()
    x.write_bytes((made / PLACE / "archive.h5").read_bytes())
    _, writes, reads = COMMANDS[command]
    true_write, refused = files.write_all, []

    def observed(contents, **more):
        def claim() -> None:
            for name in writes | reads:
                try:
                    with files.claimed(x.parent / name):
                        pass
                except WriteError:
                    refused.append(name)
            if command != "compare":  # two comparisons in one process take turns
                with redirect_stderr(StringIO()), redirect_stdout(StringIO()):
                    assert main(arguments(made, command, x)) == 2
                refused.append(command)

        thread = threading.Thread(target=claim)
        thread.start()
        thread.join(60)
        true_write(contents, **more)

    monkeypatch.setattr(files, "write_all", observed)
    assert main(arguments(made, command, x)) == 0
    assert set(refused) == writes | reads | ({command} - {"compare"})
    assert not list(x.parent.glob(".ekfslam.*"))


def test_commands_into_different_files_of_a_folder_do_not_hinder_each_other(made, tmp_path):
    x = made / PLACE / "archive.h5"
    with claimed_elsewhere(tmp_path / "a.h5", x.parent / "check.json", reads=(x,)):
        assert main(["simulate", WORLD, "--out", str(tmp_path / "b.h5")]) == 0
        assert main(["export", str(x), "--format", "tum", "--out", str(tmp_path / "b.txt")]) == 0


def killed_while_it_claims(path: Path) -> None:
    with files.claimed(path):
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.xdist_group("processes")
def test_a_claim_ends_with_its_process(tmp_path):
    path = tmp_path / "new" / "a.h5"
    assert processes((killed_while_it_claims, path)) == [-signal.SIGKILL]
    assert [p.name for p in path.parent.iterdir()] == [".ekfslam.a.h5.lock"]
    with files.claimed(path):
        pass
    assert list(path.parent.iterdir()) == []
    assert processes((killed_while_it_claims, path)) == [-signal.SIGKILL]
    files.write(path.with_name("other"), "x")
    assert [p.name for p in path.parent.iterdir()] == ["other"], "the next writing removes it"


def test_claims_go_by_the_file_and_not_by_its_name(tmp_path):
    (tmp_path / "deep").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "deep" / "a.h5")
    same = files.claimed(tmp_path / "deep" / ".." / "deep" / "a.h5")
    with claimed_elsewhere(tmp_path / "link"), pytest.raises(WriteError, match="another command"), same:
        pass
    assert not list((tmp_path / "deep").iterdir())


def test_readers_share_a_file_and_the_last_one_removes_the_lock(tmp_path):
    path = tmp_path / "a.h5"
    path.touch()
    with claimed_elsewhere(reads=(path,)):
        with files.claimed(reads=[path]):
            pass
        with pytest.raises(WriteError, match="another command"), files.claimed(path):
            pass
    with files.claimed(path):
        pass
    assert [p.name for p in tmp_path.iterdir()] == ["a.h5"]


def test_a_claim_takes_all_of_its_files_or_none(tmp_path):
    with claimed_elsewhere(tmp_path / "b"), pytest.raises(WriteError), files.claimed(tmp_path / "a", tmp_path / "b"):
        pass
    with files.claimed(tmp_path / "a"):
        assert [p.name for p in tmp_path.iterdir()] == [".ekfslam.a.lock"]


@pytest.mark.parametrize("name", ["x" * 250, "ü" * 120, "*.png", "-"])
def test_any_name_of_a_file_can_be_claimed(tmp_path, name):
    claim = files.claimed(tmp_path / name)
    with claimed_elsewhere(tmp_path / name), pytest.raises(WriteError, match="another command"), claim:
        pass


def test_a_claim_leaves_no_folder_that_it_made(tmp_path, capsys):
    assert main(["run", str(tmp_path / "missing.npz"), "--out", str(tmp_path / "new" / "deep" / "a.h5")]) == 2
    assert "missing.npz" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_lock_of_a_journal_does_not_remove_the_one_of_its_successor(tmp_path):
    path = tmp_path / ".a.journal"
    with files.held(path):
        path.unlink()  # the study is saved
        with files.held(path):
            pass
        successor = path.open("x")
    assert path.exists()
    successor.close()


@pytest.mark.slow
@pytest.mark.xdist_group("processes")
def test_of_many_runs_into_one_file_each_ends_well_or_is_told(tmp_path):
    call = [sys.executable, "-m", "ekfslam", "run", WORLD, "--out", str(tmp_path / "new" / "a.h5")]
    begun = [subprocess.Popen(call, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) for _ in range(3)]
    said = [(process.communicate()[1], process.returncode) for process in begun]
    assert {code for _, code in said} <= {0, 2} and 0 in {code for _, code in said}
    assert all("another command is writing or reading it" in text for text, code in said if code == 2)
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["a.h5"]
