"""A reader and an exporter are one file each, added here from outside the package."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

import ekfslam
from ekfslam.cli import main
from ekfslam.data import readers
from ekfslam.data.simulate import builtin
from ekfslam.runner import run
from ekfslam.storage.archive import write_archive
from ekfslam.storage.exports import EXPORTS

READER = '''
"""Stereo tracks as rows of plain text: frame, id, uL, vL, uR, vR."""

import numpy as np

from ekfslam import Sequence, StereoCamera
from ekfslam.data.readers.registry import Reader


def tracks(source):
    rows = np.loadtxt(source.path, skiprows=1)
    camera = StereoCamera(500.0, 500.0, 300.0, 200.0, 0.5)
    time_s = 0.1 * np.arange(rows[:, 0].max() + 1)
    return Sequence.from_tracks(time_s, rows[:, 2:], camera, frame=rows[:, 0], landmark=rows[:, 1])


READER = Reader("rows", "a file of rows", lambda source: source.head.startswith(b"ROWS"), tracks)
'''

EXPORTER = '''
"""The last position as text."""

from ekfslam.storage.exports import EXPORTS, Export


def last_position(result):
    return "last position: " + " ".join(map(str, result.T_world_imu[-1, :3, 3].tolist()))


EXPORTS["last"] = Export("last.txt", "last position", last_position, b"last position: ")
'''


def test_a_reader_is_one_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "rows_of_text.py").write_text(READER, encoding="utf-8")
    monkeypatch.setattr(readers, "__path__", [*readers.__path__, str(tmp_path)])
    rows = [[k, i, 300.0 + i, 200.0, 290.0 + i, 200.0] for k in range(3) for i in range(4)]
    np.savetxt(tmp_path / "drive.txt", rows, header="ROWS", comments="")
    sequence = ekfslam.open_sequence(tmp_path / "drive.txt")
    assert (len(sequence), len(sequence.observations)) == (3, 12)


def test_an_exporter_is_one_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "last.py").write_text(EXPORTER, encoding="utf-8")
    spec = importlib.util.spec_from_file_location("last", tmp_path / "last.py")
    assert spec is not None and spec.loader is not None
    monkeypatch.setitem(EXPORTS, "last", EXPORTS["tum"])  # replaced below, removed afterwards
    spec.loader.exec_module(importlib.util.module_from_spec(spec))
    world = builtin("loop?frames=5")
    result = run(world, "dead-reckoning")
    result.export(tmp_path / "python.txt", "last")
    write_archive(tmp_path / "a.h5", world, {"dead-reckoning": result})
    command = ["export", str(tmp_path / "a.h5"), "--format", "last", "--out", str(tmp_path / "cli.txt")]
    assert main(command) == 0
    expected = "last position: " + " ".join(map(str, result.T_world_imu[-1, :3, 3].tolist()))
    assert [(tmp_path / f"{name}.txt").read_text() for name in ("python", "cli")] == [expected] * 2
    assert main(command) == 0, "an earlier export is replaced"
