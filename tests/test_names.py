"""Names from inside files: they never become paths, TOML, formulas or commands to a terminal."""

from __future__ import annotations

import dataclasses
import json
import os
import tomllib
from pathlib import Path

import h5py
import matplotlib.pyplot as plt
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.helpers import synthetic_result, synthetic_sequence
from support.recordings import ece276a_fields, write_npz

from ekfslam.cli import main
from ekfslam.config import Config
from ekfslam.data.readers import write_sequence
from ekfslam.data.simulate import builtin
from ekfslam.errors import ArchiveError
from ekfslam.evaluation.tables import markdown_table
from ekfslam.figures import style
from ekfslam.figures.maps import plot_map
from ekfslam.names import components, printable
from ekfslam.storage.archive import read_archive, write_archive
from ekfslam.studies.tuning import toml_heading, toml_value

QUICK = ["--modes", "dead-reckoning", "--no-figures"]
NASTY = ["../../x", "/etc/x", "..", ".", "", "a/b\\c", "x\0y", "new\nline", "\x1b[31m", "$x_$", "{0.__class__}", "%n%s"]


@given(st.lists(st.text(st.characters(codec=None, categories=None)), max_size=6))
def test_components_are_single_distinct_and_short(names):
    found = components(names)
    assert len(set(found)) == len(names)
    for name in found:
        assert Path(name).name == name
        assert name not in ("", ".", "..") and not name.startswith(".")
        assert name.isprintable() and len(os.fsencode(name)) < 120


def test_components_of_usual_names_are_the_names():
    names = ["0027", "winding road", "2011_09_26_drive_0001", "city-2", "Größe"]
    assert components(names) == names


def test_collisions_end_in_distinct_components():
    assert components(["a", "a", "a-2", "A", "a/b", "a_b"]) == ["a", "a-2", "a-2-2", "A-3", "a_b", "a_b-2"]


@given(st.text(st.characters(codec=None, categories=None)))
def test_what_is_printable_can_be_printed_and_written(text):
    shown = printable(text)
    assert shown.isprintable()
    shown.encode()
    if text.isprintable():
        assert shown == text


@pytest.mark.parametrize("name", NASTY)
def test_no_name_leads_out_of_the_folder(tmp_path, name):
    out = tmp_path / "in" / "out"
    write_sequence(dataclasses.replace(builtin("city?frames=5"), name=name), tmp_path / "a.h5")
    assert main(["compare", str(tmp_path / "a.h5"), *QUICK, "--out", str(out)]) == 0
    assert [path.name for path in tmp_path.iterdir() if path.name != "a.h5"] == ["in"]
    (folder,) = out.iterdir()
    assert json.loads((folder / "summary.json").read_text())["sequence"] == printable(name)
    assert read_archive(folder / "archive.h5").name == printable(name)


@pytest.mark.slow
def test_recordings_of_colliding_names_have_folders_of_their_own(tmp_path):
    paths = []
    for i, name in enumerate(("a", "a", "a-2")):
        paths.append(str(tmp_path / f"{i}.h5"))
        write_sequence(dataclasses.replace(builtin(f"city?frames=5&seed={i}"), name=name), paths[-1])
    out = tmp_path / "out"
    assert main(["compare", *paths, *QUICK, "--executor", "serial", "--out", str(out)]) == 0
    assert {path.name for path in out.iterdir()} == {"a", "a-2", "a-2-2"}
    seeds = [read_archive(out / name / "archive.h5").attributes["seed"] for name in ("a", "a-2", "a-2-2")]
    assert seeds == [0, 1, 2]


@pytest.mark.slow
def test_names_that_are_no_utf_8_work(tmp_path, capsys):
    npz = tmp_path / os.fsdecode(b"a\xff.npz")
    write_npz(npz, ece276a_fields())
    assert main(["info", str(npz)]) == 0
    assert "a\\udcff" in capsys.readouterr().out
    out = tmp_path / os.fsdecode(b"out\xfe")
    assert main(["compare", str(npz), *QUICK, "--out", str(out)]) == 0
    archive = out / "a_udcff" / "archive.h5"
    assert read_archive(archive).name == "a\\udcff"
    assert main(["compare", str(npz), *QUICK, "--out", str(out)]) == 0, "of the same origin"
    assert main(["export", str(archive), "--format", "kitti", "--out", str(tmp_path / os.fsdecode(b"\xfd.txt"))]) == 0
    assert main(["info", str(tmp_path / os.fsdecode(b"none\xff"))]) == 2
    assert "\\udcff" in capsys.readouterr().err


def test_text_of_a_file_is_no_command_to_the_terminal(tmp_path, capsys):
    sequence = dataclasses.replace(
        builtin("city?frames=5"), notes=("\x1b]0;title\x07",), attributes={"made_by": "\x1b[2J", "seed": 1}
    )
    write_sequence(sequence, tmp_path / "a.h5")
    assert main(["info", str(tmp_path / "a.h5")]) == 0
    printed = capsys.readouterr().out
    assert "\\x1b[2J" in printed and "\x1b" not in printed and "\x07" not in printed


@pytest.mark.parametrize("kind", ["mode", "attribute"])
def test_members_whose_names_cannot_be_printed_are_refused(tmp_path, kind):
    sequence = synthetic_sequence(frames=20, landmarks=20)
    write_archive(tmp_path / "a.h5", sequence, {"full": synthetic_result(sequence)})
    with h5py.File(tmp_path / "a.h5", "a") as h5file:
        if kind == "mode":
            h5file.move("runs/full", "runs/\x1b[2J")
        else:
            h5file["sequence/attributes"].attrs["\x1b[2J"] = 1
    with pytest.raises(ArchiveError, match="cannot be printed"):
        read_archive(tmp_path / "a.h5")


@pytest.mark.slow
def test_modes_of_an_archive_become_no_paths(tmp_path, undrawn):
    sequence = synthetic_sequence(frames=20, landmarks=20)
    results = {mode: synthetic_result(sequence, mode) for mode in ("..", "$a_$")}
    write_archive(tmp_path / "a.h5", sequence, results)
    assert main(["plot", str(tmp_path / "a.h5"), "--out", str(tmp_path / "out")]) == 0
    assert main(["export", str(tmp_path / "a.h5"), "--format", "kitti", "--mode", ".."]) == 0
    assert main(["export", str(tmp_path / "a.h5"), "--format", "kitti", "--mode", "x/../../y"]) == 2
    assert {path.name for path in tmp_path.iterdir()} == {"a.h5", "out", "a.unnamed.kitti.txt"}


@pytest.mark.parametrize("name", [*NASTY, 'a"\n[noise]\nsigma_px = 9', "\x7f", "\udcff"])
def test_no_name_becomes_toml(name):
    text = f"{toml_heading(name)}\n[tuning]\nsequence = {toml_value(name)}\n".encode("utf-8", "replace").decode()
    assert set(tomllib.loads(text)) == {"tuning"}
    assert Config().with_overrides(tomllib.loads(text)).noise == Config().noise


@pytest.mark.parametrize("value", [np.inf, -np.inf, 1e-300, 3.0, 1e22])
def test_numbers_of_toml_come_back(value):
    assert tomllib.loads(f"a = {toml_value(value)}")["a"] == value


@pytest.mark.parametrize("name", ["$x_$", "$\\frac{$", "a$b$c", "\\$"])
def test_a_dollar_begins_no_formula(tmp_path, name):
    sequence = dataclasses.replace(synthetic_sequence(frames=20, landmarks=20), name=name)
    figure = plot_map({name: synthetic_result(sequence)}, sequence.truth)
    style.save_all(tmp_path, {"map": figure})
    assert name in figure.axes[0].get_title()
    assert not figure.axes[0].title.get_parse_math()
    plt.close("all")


def test_a_bar_in_a_name_makes_no_column():
    assert markdown_table(["a|b"], [["c\nd"]]).splitlines() == ["| a\\|b |", "|---|", "| c d |"]
