"""Studies, sweeps and journals that somebody crafted, with right keys and digests, are refused by name.

No traceback, no attribute looked up by a name in a file, no value that an archive would not hold.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from support.studies import short

from ekfslam.errors import ArchiveError
from ekfslam.evaluation.summary import KEYS
from ekfslam.provenance import versions
from ekfslam.studies.executors import SerialExecutor
from ekfslam.studies.journal import Journal, framed
from ekfslam.studies.study import Study, read_study, run_one, run_study
from ekfslam.studies.sweep import Recording, Sweep, run_sweep
from ekfslam.studies.sweep_table import read_table

STUDY = Study(short("mid", 6), ("invariant",), runs=1)
LOOP = (Recording("builtin:loop?frames=4", "loop"),)
SWEEP = Sweep(LOOP, modes=("dead-reckoning", "mapping-only"))
DEEP = "[" * 60_000


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A folder with a finished study and a finished sweep."""
    folder = tmp_path_factory.mktemp("crafted")
    run_study(STUDY, folder / "study.h5", SerialExecutor(), False)
    run_sweep(SWEEP, folder / "sweep.h5", SerialExecutor(), False)
    return folder


def altered(made: Path, folder: Path, name: str, alter: Callable[[h5py.File], object]) -> Path:
    path = Path(shutil.copy(made / name, folder / name))
    with h5py.File(path, "a") as h5file:
        alter(h5file)
    return path


STUDIES: list[dict[str, Any]] = [
    {"runs": "1"},
    {"runs": 1.0},
    {"runs": True},
    {"runs": [1]},
    {"runs": -1},
    {"runs": 10**12},
    {"seed": 0.5},
    {"seed": None},
    {"variants": "invariant"},
    {"variants": None},
    {"variants": [["invariant"]]},
    {"variants": ["__class__"]},
    {"levels": []},
    {"levels": None},
    {"levels": {"__init__": {}}},
    {"levels": {"mid": None}},
    {"levels": {"mid": 5}},
    {"__class__": 1},
]
LEVELS: list[dict[str, Any]] = [
    {"frames": 6.0},
    {"frames": "6"},
    {"frames": True},
    {"frames": 10**9},
    {"name": "\x1b[2J"},
    {"name": 5},
    {"sigma_px": "1"},
    {"sigma_px": None},
    {"sigma_px": [1.0]},
    {"sigma_px": float("nan")},
    {"initial_position_std_m": None},
    {"__dict__": {}},
]


@pytest.mark.parametrize("changes", [*STUDIES, *({"mid": level} for level in LEVELS), "[]", "null", "{", DEEP], ids=str)
def test_parameters_of_a_study_are_validated(made, tmp_path, changes):
    text = changes
    if isinstance(changes, dict):
        found = json.loads(json.dumps(STUDY.parameters))
        found["levels"]["mid"] |= changes.pop("mid", {})
        text = json.dumps(found | changes)
    path = altered(made, tmp_path, "study.h5", lambda f: f.attrs.__setitem__("study", np.bytes_(text)))
    before = path.read_bytes()
    with pytest.raises(ArchiveError, match=r"study\.h5"):
        read_study(path)
    with pytest.raises(ArchiveError, match=r"study\.h5"):
        run_study(STUDY, path, SerialExecutor(), False)
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("invariant/pose_nees", -1.0),
        ("invariant/nis", np.inf),
        ("invariant/three_sigma", -1.0),
        ("invariant/nis_dof", -1),
        ("invariant/position_error", np.nan),
        ("done", 2),
        ("time", 9.0),
    ],
)
def test_values_of_a_study_are_validated(made, tmp_path, name, value):
    path = altered(made, tmp_path, "study.h5", lambda f: f[f"levels/mid/{name}"].__setitem__(..., value))
    with pytest.raises(ArchiveError, match=r"study\.h5"):
        run_study(STUDY, path, SerialExecutor(), False)


def content_of(run: dict[str, np.ndarray], **changes: float) -> bytes:
    return b"".join(
        np.full_like(value, changes[name]).tobytes() if name in changes else value.tobytes()
        for name, value in run.items()
    )


RUN = run_one(STUDY, "mid", 0)["invariant"]
GOOD = content_of(RUN)


@pytest.mark.parametrize(
    ("key", "content"),
    [
        *((key, GOOD) for key in ('["zzz", 0]', '["__class__", 0]', '["mid", -1]', '["mid", true]', '["mid", 1.7]')),
        *((key, GOOD) for key in ('["mid", "1"]', '["mid", NaN]', '["mid", Infinity]', '["mid", 0, 1]', "[{}, 0]")),
        *((key, GOOD) for key in ('{"mid": 0, "x": 1}', '[["mid"], 0]', '"mi"', "5", DEEP, "\xff", "")),
        *(('["mid", 0]', content) for content in (GOOD[:-1], GOOD + b"1", GOOD[:-1] + b"\x07", b"")),
        *(('["mid", 0]', content_of(RUN, pose_nees=value)) for value in (np.inf, -1.0, 1e300)),
        *(('["mid", 0]', content_of(RUN, nis_dof=value)) for value in (-1, 2**62 + 5)),
        ('["mid", 0]', content_of(RUN, three_sigma=-1.0)),
        ('["mid", 0]', content_of(RUN, position_error=np.nan)),
    ],
    ids=lambda value: str(value)[:20],
)
def test_entries_of_the_journal_of_a_study_are_validated(tmp_path, key, content):
    path = tmp_path / "study.h5"
    journal = Journal(path, {**STUDY.parameters, "runs": None, **versions()}, lambda _: {"invariant": RUN})
    entries = [json.dumps({**STUDY.parameters, "runs": None, **versions()}, sort_keys=True).encode()]
    entries += [key.encode("latin-1") + b"\n" + content]
    journal.path.write_bytes(b"".join(framed(entry) for entry in entries))
    with pytest.raises(ArchiveError, match=r"study\.h5"):
        run_study(STUDY, path, SerialExecutor(), False)
    assert [p.name for p in tmp_path.iterdir()] == [journal.path.name], "it is left as it was"


def figures(value: float, error: bytes = b"") -> bytes:
    return np.full(len(KEYS), value).tobytes() + error.ljust(400, b"\0")


@pytest.mark.parametrize(
    "entries",
    [
        [figures(-1.0)],
        [figures(np.inf)],
        [figures(1.5)],  # of counts
        [figures(1.0, b"an error")],
        [figures(np.nan)],
        [figures(np.nan, b"\x1b[2J")],
        [figures(np.nan, b"a\0b")],
        [figures(1.0), figures(2.0)],
    ],
    ids=["negative", "infinite", "no count", "error and figures", "nothing", "control", "zero", "twice"],
)
def test_entries_of_the_journal_of_a_sweep_are_validated(tmp_path, entries):
    path = tmp_path / "sweep.h5"
    key = json.dumps([SWEEP.tasks[0].key, 0]).encode() + b"\n"
    journal = Journal(path, "sweep", lambda _: {})
    journal.path.write_bytes(framed(b'"sweep"') + b"".join(framed(key + entry) for entry in entries))
    with pytest.raises(ArchiveError, match=r"sweep\.h5"):
        run_sweep(SWEEP, path, SerialExecutor(), False)


def column(name: str, value: object) -> Callable[[h5py.File], None]:
    def alter(h5file: h5py.File) -> None:
        if name in h5file["table"]:
            del h5file["table"][name]
        if value is not None:
            h5file["table"][name] = value

    return alter


def first(name: str, value: object) -> Callable[[h5py.File], None]:
    return lambda h5file: h5file["table"][name].__setitem__(0, value)


def attribute(name: str, value: object) -> Callable[[h5py.File], None]:
    return lambda h5file: h5file.attrs.__setitem__(name, value)


@pytest.mark.parametrize(
    "alter",
    [
        *(first("ate_m", value) for value in (-1.0, np.inf)),
        first("accepted", 1.5),
        *(column("ate_m", value) for value in ([b"a", b"b"], [1, 2], np.zeros((2, 2)), [0.0], None)),
        *(column(name, np.zeros(2)) for name in ("key", "error")),
        column("key", [b"same", b"same"]),
        column("error", [b"an error"] * 2),
        lambda h5file: h5file["table"].create_group("evil"),
        *(attribute("swept", np.bytes_(text)) for text in ("{", "{}", "5", "[[1]]", '"mode"', '["__class__"]', DEEP)),
        *(attribute("runs", value) for value in (np.bytes_("x"), np.zeros(3), np.nan, -1, 1.5)),
    ],
)
def test_the_table_of_a_sweep_is_validated(made, tmp_path, alter):
    path = altered(made, tmp_path, "sweep.h5", alter)
    before = path.read_bytes()
    with pytest.raises(ArchiveError, match=r"sweep\.h5"):
        run_sweep(SWEEP, path, SerialExecutor(), False)
    assert path.read_bytes() == before


def test_what_is_as_it_was_is_taken(made, tmp_path):
    for name in ("study.h5", "sweep.h5"):
        shutil.copy(made / name, tmp_path / name)
    assert run_study(STUDY, tmp_path / "study.h5", SerialExecutor(), False).complete
    table = run_sweep(SWEEP, tmp_path / "sweep.h5", SerialExecutor(), False)
    assert table.rows() == read_table(made / "sweep.h5").rows()
