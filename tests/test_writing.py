"""Files that are written whole or not at all: full disks, kills, links, devices, and results of somebody else."""

from __future__ import annotations

import os
import resource
import signal
import stat
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.running import WHOLE, command, processes, seeds

from ekfslam import files
from ekfslam.cli import main
from ekfslam.errors import WriteError
from ekfslam.storage.archive import read_archive

CITY = "builtin:city?frames=25"
QUICK = ["--mode", "dead-reckoning"]


@contextmanager
def disk_of(size: int) -> Iterator[None]:
    """No file may grow beyond a size, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def one_line(capsys) -> str:
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    return line


def test_what_is_written_is_there_and_nothing_else(tmp_path):
    files.write(tmp_path / "a", "text")
    files.write(tmp_path / "a", b"other")
    assert contents(tmp_path) == {"a": b"other"}


def test_a_file_and_then_its_new_name_reach_the_disk(tmp_path, monkeypatch):
    reached, fsync = [], os.fsync
    monkeypatch.setattr(os, "fsync", lambda number: (reached.append(os.fstat(number).st_ino), fsync(number)))
    files.write(tmp_path / "a", "text")
    assert reached == [(tmp_path / "a").stat().st_ino, tmp_path.stat().st_ino]


def test_files_that_belong_together_appear_together(tmp_path):
    (tmp_path / "a").write_text("old")
    (tmp_path / "b").mkdir()
    with pytest.raises(WriteError, match="b: cannot be written: it is a folder"):
        files.write_all({tmp_path / "new" / "c": "c", tmp_path / "a": "a", tmp_path / "b": "b"})
    assert contents(tmp_path) == {"a": b"old"}
    assert not (tmp_path / "new").exists(), "the folder that was made goes again"


def test_permissions_stay_and_new_files_obey_the_mask(tmp_path):
    path = tmp_path / "a"
    files.write(path, "1")
    mask = os.umask(0)
    os.umask(mask)
    assert stat.S_IMODE(path.stat().st_mode) == 0o666 & ~mask
    path.chmod(0o640)
    files.write(path, "2")
    assert stat.S_IMODE(path.stat().st_mode) == 0o640


def test_a_symbolic_link_stays_one(tmp_path):
    (tmp_path / "deep").mkdir()
    link, real = tmp_path / "link", tmp_path / "deep" / "real"
    link.symlink_to(real)
    for text in ("not there yet", "there"):
        files.write(link, text)
        assert link.is_symlink()
        assert real.read_text() == text
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    with pytest.raises(WriteError, match="loop"):
        files.write(loop, "x")


@pytest.mark.parametrize("place", ["/dev/null", "/dev/full", "fifo", ".", "file/below", "a" * 300, "nul\0"])
def test_what_is_no_place_for_a_file_is_refused_before_the_work(tmp_path, capsys, monkeypatch, place):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("fifo")
    Path("file").touch()
    before = sorted(path.name for path in tmp_path.iterdir())
    monkeypatch.setattr("ekfslam.cli.commands.run.run_modes", lambda *_: pytest.fail("the work was done"))
    assert main(["run", CITY, *QUICK, "--out", place]) == 2
    assert "cannot be written" in one_line(capsys)
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_a_protected_file_is_refused(tmp_path, monkeypatch):
    files.write(tmp_path / "a", "1")
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK)  # who runs the tests may write everywhere
    with pytest.raises(WriteError, match="the file is protected"):
        files.write(tmp_path / "a", "2")
    assert (tmp_path / "a").read_text() == "1"


WRITING = {
    "run": ["run", CITY, *QUICK, "--out", "{folder}/run.h5"],
    "compare": ["compare", CITY, "--modes", "dead-reckoning", "--out", "{folder}"],
    "simulate": ["simulate", CITY, "--out", "{folder}/city.h5"],
    "posterior": ["posterior", "{archive}", "--out", "{folder}"],
    "check": ["check", "{archive}", "--out", "{folder}"],
    "plot": ["plot", "{archive}", "--out", "{folder}"],
    "export": ["export", "{archive}", "--format", "tum", "--out", "{folder}/poses.txt"],
    "consistency": [
        "consistency",
        "--runs",
        "1",
        "--variants",
        "invariant",
        "--executor",
        "serial",
        "--out",
        "{folder}",
    ],
}


@pytest.fixture(scope="module")
def archive(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("run") / "full.h5"
    assert main(["run", CITY, "--out", str(path)]) == 0
    return path


@pytest.fixture
def drawn_already(monkeypatch, undrawn) -> None:
    """Figures that are nothing but their files."""
    for place in ("cli.commands.posterior.draw_posterior_figures", "figures.run.draw_figures"):
        monkeypatch.setattr(f"ekfslam.{place}", lambda *_, **__: {"one": None, "another": None})
    monkeypatch.setattr("ekfslam.figures.check.plot_check", lambda *_: None)


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [
        name if name == "simulate" else pytest.param(name, marks=pytest.mark.slow)
        for name in WRITING
        if name != "consistency"
    ],
)
def test_a_full_disk_of_any_size(tmp_path, capsys, archive, drawn_already, command):
    here = tmp_path / "full.h5"
    here.write_bytes(archive.read_bytes())
    arguments = [part.format(folder=tmp_path / "out", archive=here) for part in WRITING[command]]
    assert main(arguments) == 0
    before = contents(tmp_path)
    largest = max(len(value) for name, value in before.items() if name.startswith("out"))
    if command == "posterior":
        largest = len(before["full.h5"])
    for size in [0, *np.geomspace(1, largest - 1, 20 if WHOLE else 4).astype(int)]:
        capsys.readouterr()
        with disk_of(int(size)):
            assert main(arguments) == 2
        assert "cannot be written: File too large" in one_line(capsys)
        assert contents(tmp_path) == before


def test_a_full_disk_leaves_no_folder_behind(tmp_path, capsys, drawn_already):
    with disk_of(100):
        assert main(["compare", CITY, "--modes", "dead-reckoning", "--out", str(tmp_path / "new" / "deep")]) == 2
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_full_disk_ends_a_study_with_one_line(tmp_path, capsys):
    arguments = [part.format(folder=tmp_path) for part in WRITING["consistency"]]
    with disk_of(1_000):
        assert main(arguments) == 2
    assert "File too large" in one_line(capsys)
    assert contents(tmp_path) == {}


@pytest.mark.slow
def test_a_full_output_is_one_line(tmp_path):
    done = subprocess.run(
        f"{sys.executable} -m ekfslam.cli info {CITY} > /dev/full", shell=True, capture_output=True, text=True
    )
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "No space left" in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    "closed", [">&- 2>&-", *(pytest.param(one, marks=pytest.mark.slow) for one in (">&-", "2>&-", "<&-"))]
)
def test_closed_streams_are_no_error(tmp_path, closed):
    done = subprocess.run(
        f"{sys.executable} -m ekfslam.cli run {CITY} --mode dead-reckoning --out {tmp_path}/a.h5 {closed}",
        shell=True,
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert list(read_archive(tmp_path / "a.h5").results) == ["dead-reckoning"]


def test_scraps_of_dead_processes_go_with_the_next_writing(tmp_path):
    program = (
        "import os, signal, ekfslam.files as f\n"
        "os.fsync = lambda _: os.kill(os.getpid(), signal.SIGKILL)\n"
        f"f.write({str(tmp_path / 'a')!r}, 'x' * 100)\n"
    )
    assert subprocess.run([sys.executable, "-c", program]).returncode == -signal.SIGKILL
    assert [path.suffix for path in tmp_path.iterdir()] == [".tmp"]
    alive = tmp_path / f".ekfslam.{os.getpid()}.77.tmp"
    alive.touch()
    files.write(tmp_path / "a", "whole")
    assert {path.name for path in tmp_path.iterdir()} == {"a", alive.name}


@pytest.mark.slow
@pytest.mark.xdist_group("processes")
def test_two_who_add_to_one_archive_lose_nothing(tmp_path, archive):
    here = tmp_path / "full.h5"
    here.write_bytes(archive.read_bytes())
    add = ["posterior", str(here), "--no-figures"]
    assert processes((command, add), (command, [*add, "--linearisation", "filtered"])) == [0, 0]
    assert sorted(read_archive(here).results) == ["as filtered", "full", "smoothed"]


@pytest.mark.slow
def test_a_posterior_is_not_added_to_another_run(tmp_path, archive, capsys, monkeypatch):
    here = tmp_path / "full.h5"
    here.write_bytes(archive.read_bytes())
    from ekfslam.cli.commands import posterior

    true_smooth = posterior.smooth

    def replaced_meanwhile(*arguments):
        assert main(["run", CITY, "--variant", "standard", "--out", str(here)]) == 0
        return true_smooth(*arguments)

    monkeypatch.setattr(posterior, "smooth", replaced_meanwhile)
    assert main(["posterior", str(here)]) == 2
    assert "its run 'full' was replaced meanwhile" in one_line(capsys)
    assert list(read_archive(here).results) == ["full"]


@pytest.mark.xdist_group("processes")
@pytest.mark.parametrize("seed", seeds(50, 6))
def test_a_kill_leaves_an_archive_or_none(tmp_path, seed):
    out = tmp_path / "a.h5"
    call = ["run", CITY, *QUICK, "--out", str(out)]
    assert processes((command, call, np.random.default_rng(seed).uniform(0.01, 0.08)))[0] in (-signal.SIGPROF, 0)
    if out.exists():
        read_archive(out)
    assert main(call) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["a.h5"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["text", "recording", "another seed", "damaged"])
def test_what_is_no_earlier_result_of_the_same_needs_force(tmp_path, capsys, drawn_already, kind):
    out = tmp_path / "city" / "archive.h5"
    out.parent.mkdir()
    if kind == "text":
        out.write_text("my notes\n")
    elif kind == "recording":
        main(["simulate", CITY, "--out", str(out)])
    else:
        main(["run", "builtin:city?frames=25&seed=7", *QUICK, "--out", str(out)])
        if kind == "damaged":
            out.write_bytes(out.read_bytes()[:-100])
    before = out.read_bytes()
    for arguments in (
        ["run", CITY, *QUICK, "--out", str(out)],
        ["compare", CITY, "--modes", "dead-reckoning", "--out", str(tmp_path)],
    ):
        capsys.readouterr()
        assert main(arguments) == 2
        assert "--force replaces it" in one_line(capsys)
        assert out.read_bytes() == before
    assert main([*arguments, "--force"]) == 0
    assert main(arguments) == 0, "the same again needs none"
    assert list(read_archive(out).results) == ["dead-reckoning"]


@pytest.mark.slow
@pytest.mark.parametrize("command", ["simulate", "tune", "export"])
def test_other_files_of_the_user_are_not_overwritten(tmp_path, capsys, archive, command):
    notes = tmp_path / "notes.txt"
    notes.write_text("my notes\n")
    arguments = {
        "simulate": ["simulate", CITY],
        "tune": ["tune", CITY],
        "export": ["export", str(archive), "--format", "tum"],
    }[command]
    assert main([*arguments, "--out", str(notes)]) == 2
    assert "notes.txt: exists, and is not an earlier result" in one_line(capsys)
    assert notes.read_text() == "my notes\n"
    if command != "tune":
        for more in (["--force"], []):
            assert main([*arguments, "--out", str(notes), *more]) == 0


@pytest.mark.slow
def test_figures_of_an_earlier_run_do_not_stay_beside_a_new_archive(tmp_path, undrawn):
    folder = tmp_path / "city"
    full = ["compare", CITY, "--out", str(tmp_path)]
    assert main([*full, "--modes", "full", "smoothed"]) == 0
    assert main(["check", str(folder / "archive.h5")]) == 0
    Image.new("RGB", (2, 2)).save(folder / "mine.png")
    assert {"map_before_and_after.png", "nis.png", "check.md"} <= {path.name for path in folder.iterdir()}
    assert main([*full, "--modes", "dead-reckoning"]) == 0
    names = {path.name for path in folder.iterdir()}
    assert names == {"archive.h5", "summary.json", "summary.md", "map.png", "side.png", "errors.png", "mine.png"}


def test_without_the_locks_of_posix_files_are_written_all_the_same(tmp_path):
    """Windows has neither fcntl nor fchmod and fchown, and its os.kill(process, 0) interrupts the process."""
    code = f"""
import os, sys
from pathlib import Path
sys.modules["fcntl"] = None
del os.fchmod, os.fchown, os.kill
import ekfslam
from ekfslam import files
folder = Path({str(tmp_path)!r})
scrap = folder / ".ekfslam.4194304.0.tmp"
scrap.write_text("unfinished")
for text in ("first", "second"):
    with files.alone(folder / "a.txt"):
        files.write(folder / "a.txt", text)
assert (folder / "a.txt").read_text() == "second" and scrap.exists()
try:
    with files.alone(folder / "none" / "a.txt"):
        raise AssertionError
except ekfslam.errors.WriteError:
    pass
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
