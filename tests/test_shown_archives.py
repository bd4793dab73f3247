"""Figures and pages beside those of another archive: neither overwritten nor left when their archive changes."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from xml.etree import ElementTree

import pytest
from matplotlib.figure import Figure
from PIL import Image

from ekfslam.cli import main
from ekfslam.figures.older import archives_in, marked
from ekfslam.figures.style import png, vector

WORLD = "builtin:city?frames=25"


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("run") / "a.h5"
    assert main(["run", WORLD, "--out", str(path)]) == 0
    return path


def drawn(results, *_: object) -> dict[str, Figure]:
    return {name: Figure(figsize=(1, 1)) for name in ("map", *(["nis"] if "full" in results else []))}


@pytest.fixture
def two(run, tmp_path, undrawn, monkeypatch) -> tuple[Path, Path]:
    """Two archives in a folder; their figures are small and empty."""
    monkeypatch.setattr("ekfslam.figures.run.draw_figures", drawn)
    return Path(shutil.copy(run, tmp_path / "a.h5")), Path(shutil.copy(run, tmp_path / "b.h5"))


def pictures(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.suffix != ".h5"}


@pytest.mark.parametrize(
    ("command", "file"),
    [
        ("plot", "map.png"),
        ("plot --format svg", "map.svg"),
        ("plot --format pdf", "map.pdf"),
        ("report", "report.html"),
        ("animate --pictures 2", "drive.gif"),
        pytest.param("check", "check.png", marks=pytest.mark.slow),
        pytest.param("posterior", "sparsity.png", marks=pytest.mark.slow),
    ],
)
def test_what_shows_one_archive_is_not_overwritten_by_another(two, capsys, tmp_path, command, file):
    a, b = two
    name, *more = command.split()
    assert main([name, str(a), *more]) == 0
    before = pictures(tmp_path)
    assert file in before
    capsys.readouterr()
    assert main([name, str(b), *more]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "shows " in said and f"{a}, another archive; --out chooses another place" in said
    assert pictures(tmp_path) == before
    out = tmp_path / "of b" if (tmp_path / file).suffix != ".html" and name != "animate" else tmp_path / f"b.{file}"
    assert main([name, str(b), *more, "--out", str(out)]) == 0
    assert main([name, str(a), *more]) == 0, "its own are replaced"
    if "force" in said:
        assert main([name, str(b), *more, "--force"]) == 0
        assert archives_in(tmp_path / file) == {b}


def test_what_shows_an_archive_that_is_gone_may_be_replaced(two):
    a, b = two
    assert main(["plot", str(a)]) == 0
    a.rename(a.with_name("c.h5"))
    assert main(["plot", str(b)]) == 0


def test_marks_that_somebody_crafted_are_no_archives(two, tmp_path):
    a, _ = two
    (tmp_path / "loop.h5").symlink_to(tmp_path / "loop.h5")
    for name in (b"a%00b.h5", b"loop.h5", b"%FF%FE.h5", b"", b"/dev/zero", b"../" * 2000):
        (tmp_path / "map.png").write_bytes(b"ekfslam_shows:" + name + b";")
        assert main(["plot", str(a)]) == 0
    assert main(["plot", str(tmp_path / "loop.h5")]) == 2


def test_an_archive_whose_name_is_no_text_is_named(two, tmp_path):
    name = os.fsdecode(b"a\xff.h5")
    two[0].rename(tmp_path / name)
    for _ in range(2):
        assert main(["plot", str(tmp_path / name)]) == 0
    assert archives_in(tmp_path / "map.png") == {tmp_path / name}
    assert main(["plot", str(two[1])]) == 2


def test_a_page_of_more_archives_replaces_the_one_of_some(two):
    a, b = two
    assert main(["report", str(a)]) == 0
    assert main(["report", str(a), str(b)]) == 0
    assert archives_in(a.with_name("report.html")) == {a, b}
    assert main(["report", str(a)]) == 2


@pytest.mark.parametrize("again", ["a.h5", "b.h5"])
def test_a_run_removes_what_shows_its_archive_and_nothing_else(two, tmp_path, again):
    a, b = two
    for command in (["plot", a], ["report", b], ["animate", b, "--pictures", "2", "--out", tmp_path / "mine.gif"]):
        assert main([*map(str, command)]) == 0
    before = set(pictures(tmp_path))
    assert main(["run", WORLD, "--mode", "dead-reckoning", "--out", str(tmp_path / again)]) == 0
    gone = before - set(pictures(tmp_path))
    assert gone == ({"report.html"} if again == "b.h5" else {name for name in before if name.endswith(".png")})


def test_figures_of_modes_that_an_archive_no_longer_has_do_not_stay_elsewhere(two, tmp_path):
    a, _ = two
    figures = ["plot", str(a), "--out", str(tmp_path / "figures")]
    assert main(figures) == 0
    (tmp_path / "figures" / "mine.png").write_bytes(b"mine")
    assert main(["run", WORLD, "--mode", "dead-reckoning", "--out", str(a)]) == 0
    assert main(figures) == 0
    names = {path.name for path in (tmp_path / "figures").iterdir()}
    assert "nis.png" not in names and {"map.png", "mine.png"} <= names


def test_a_comparison_does_not_overwrite_figures_of_another_archive(two, tmp_path, capsys):
    a, _ = two
    out = tmp_path / "out"
    assert main(["plot", str(a), "--out", str(out / "city")]) == 0
    before = pictures(out / "city")
    compare = ["compare", WORLD, "--modes", "dead-reckoning", "--out", str(out)]
    assert main(compare) == 2
    assert "shows" in capsys.readouterr().err and pictures(out / "city") == before
    assert not (out / "city" / "archive.h5").exists()
    assert main([*compare, "--force"]) == 0


def test_a_folder_of_results_may_be_moved(two, tmp_path, capsys):
    assert main(["plot", str(two[0])]) == 0
    moved = tmp_path / "moved"
    moved.mkdir()
    for path in (p for p in tmp_path.iterdir() if p != moved):
        path.rename(moved / path.name)
    assert main(["plot", str(moved / "b.h5")]) == 2
    assert main(["plot", str(moved / "a.h5")]) == 0


@pytest.mark.parametrize("suffix", ["png", "svg", "pdf", "gif", "html", "mp4"])
@pytest.mark.parametrize("name", ["a.h5", "ü -- (1);,%2D>.h5", "-->.h5", "x" * 200 + ".h5"])
def test_a_mark_names_any_archive(tmp_path, suffix, name):
    path, archives = tmp_path / f"a.{suffix}", [tmp_path / "deep" / name, tmp_path / "other.h5"]
    figure = Figure(figsize=(1, 1))
    content = {"svg": lambda: vector(figure, "svg"), "pdf": lambda: vector(figure, "pdf")}
    data = content[suffix]() if suffix in content else png(figure) if suffix == "png" else b"GIF89a;"
    path.write_bytes(marked({path: data}, archives)[path])
    assert archives_in(path) == set(archives)
    if suffix == "svg":
        ElementTree.parse(path)
    if suffix == "png":
        with Image.open(path) as picture:
            picture.load()
            assert picture.info["Software"] == "ekfslam"
        with Image.open(path) as picture:
            picture.verify()  # the checksums, to the last block
