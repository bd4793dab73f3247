"""Interrupted runs go on from their checkpoints, and end in the same bits as undisturbed ones."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
from pathlib import Path

import h5py
import numpy as np
import pytest
from conftest import WHOLE, command, processes, seeds
from test_archive import assert_same
from test_montecarlo import short

from ekfslam import runner
from ekfslam.cli import main
from ekfslam.config import Config
from ekfslam.data.readers import open_sequence
from ekfslam.data.simulate import builtin
from ekfslam.errors import ArchiveError, ResumeError
from ekfslam.filters.landmarks import LandmarkTable
from ekfslam.runner import run
from ekfslam.storage import checkpoint
from ekfslam.storage.checkpoint import Checkpoints, image, read
from ekfslam.studies import study as montecarlo
from ekfslam.studies.executors import SerialExecutor
from ekfslam.studies.journal import Journal, _framed
from ekfslam.studies.study import Study, run_study

FRAMES = 60 if WHOLE else 36
CITY, LOOP = (f"builtin:{name}?frames={FRAMES}" for name in ("city", "loop"))
EVERYTHING = {
    "calibration": {"rotation_deg": 0.3, "lever_arm_m": 0.05, "disparity_px": 0.3},
    "blocks": {"twist_bias": {}, "camera_jitter": {}, "vision_drift": {}, "stereo_rotation": {}},
    "filter": {"relative_frames": 20},
}
DRIVES = {
    "city": (CITY, {}),
    "dense": (LOOP, {"filter": {"covariance_form": "dense", "retire": "unseen"}}),
    "conditional": (LOOP, {"filter": {"covariance_form": "conditional"}}),
    "dormant": (CITY, {"filter": {"covariance_form": "conditional", "retire": "never"}}),
    "standard": (CITY, {"filter": {"variant": "standard", "landmark_coordinates": "xyz"}}),
    "fej": (CITY, {"filter": {"variant": "fej"}}),
    "blocks": (CITY, EVERYTHING),
    "automatic": ("unstated", EVERYTHING),
}


def drive(name: str):
    source, settings = DRIVES[name]
    if source == "unstated":
        sequence = dataclasses.replace(builtin(f"city?frames={FRAMES}"), noise=None, velocity_frame="level")
    else:
        sequence = open_sequence(source)
    return sequence, Config().with_overrides(settings)


def untimed(result):
    """A result without the times that it took."""
    return dataclasses.replace(result, ms_per_frame=np.zeros(len(result.ms_per_frame)))


class Interrupted(BaseException):
    """As if the process were killed."""


def interrupt_at(monkeypatch, frame: int) -> None:
    true_filter = runner.run_filter

    def until(*arguments, **options):
        for found in true_filter(*arguments, **options):
            if found.number == frame:
                raise Interrupted
            yield found

    monkeypatch.setattr(runner, "run_filter", until)


@dataclasses.dataclass
class Thinned(Checkpoints):
    """Written after every frame, whatever time has passed; in the reduced form after frames 1, 6, 11, ... alone."""

    def keep(self, key, state, always=False) -> None:
        if WHOLE or state["frames"] % 5 == 1:
            super().keep(key, state, always=True)


def interrupted(path: Path, sequence, config: Config, frame: int) -> None:
    with pytest.MonkeyPatch.context() as patch:
        interrupt_at(patch, frame)
        with pytest.raises(Interrupted):
            run(sequence, "full", config, checkpoints=Thinned(path, True))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [name if name in ("city", "conditional") else pytest.param(name, marks=pytest.mark.slow) for name in DRIVES]
)
def test_an_interrupted_run_ends_in_the_same_bits(tmp_path, name):
    sequence, config = drive(name)
    whole, path = untimed(run(sequence, "full", config)), tmp_path / "a.checkpoint"
    for frame in (1, 13, 27):  # one interruption after the other
        interrupted(path, sequence, config, frame)
        assert path.exists()
    again = untimed(run(sequence, "full", config, checkpoints=Thinned(path, True)))
    assert_same(again, whole)


@pytest.fixture(scope="module")
def unfinished(tmp_path_factory) -> Path:
    """The checkpoint of a run that was interrupted at frame 13."""
    path = tmp_path_factory.mktemp("unfinished") / "a.checkpoint"
    interrupted(path, *drive("city"), 13)
    return path


@pytest.mark.slow
def test_a_checkpoint_is_what_is_gone_on_with(tmp_path, monkeypatch, unfinished):
    """No run from the beginning that happens to end the same."""
    path, frames = Path(shutil.copy(unfinished, tmp_path)), []
    true_filter = runner.run_filter

    def counted(*arguments, **options):
        for found in true_filter(*arguments, **options):
            frames.append(found.number)
            yield found

    monkeypatch.setattr(runner, "run_filter", counted)
    sequence, config = drive("city")
    run(sequence, "full", config, checkpoints=Checkpoints(path, True))
    assert frames == list(range(13 if WHOLE else 11, FRAMES))


@pytest.mark.parametrize("change", ["settings", "recording", "pixels", "key"])
def test_a_checkpoint_of_something_else_is_refused(monkeypatch, unfinished, change):
    sequence, config = drive("city")
    if change == "settings":
        config = config.with_overrides({"filter": {"min_depth_m": 0.2}})
    elif change == "recording":
        sequence = builtin(f"city?frames={FRAMES}&seed=1")
    elif change == "pixels":
        pixels = sequence.observations.pixels_px.copy()
        pixels[-1, 0] += 1e-9
        observations = dataclasses.replace(sequence.observations, pixels_px=pixels)
        sequence = dataclasses.replace(sequence, observations=observations)
    else:
        monkeypatch.setattr(runner, "versions", lambda: {"version_ekfslam": "0.0"})
    with pytest.raises(ResumeError, match="another recording, other settings or another release"):
        run(sequence, "full", config, checkpoints=Checkpoints(unfinished, True))


def nested() -> dict:
    array = np.asfortranarray(np.arange(12.0).reshape(3, 4))
    return {
        "array": array,
        "view": array[1:, ::2],
        "turned": array.T,
        "same": array,
        "empty": np.empty((0, 3)),
        "flags": np.array([True, False]),
        "fixed": np.broadcast_to(np.float64(2.0), (3,)).copy(),
        "plain": (1, -2.5, None, "é", True, float("inf"), np.int64(7), slice(1, None, 2), {3, 4}),
        7: [np.float64(0.1)],
        "table": LandmarkTable(),
    }


def test_objects_come_back_with_what_they_share(tmp_path):
    (tmp_path / "a").write_bytes(image("key", nested()))
    found = read(tmp_path / "a", "key")
    expected = nested()
    assert found.keys() == expected.keys()
    assert found["plain"] == expected["plain"]
    assert found["same"] is found["array"]
    for name in ("array", "view", "turned", "empty", "flags", "fixed"):
        np.testing.assert_array_equal(found[name], expected[name])
    assert found["array"].flags.f_contiguous and not found["array"].flags.c_contiguous
    found["array"][1, 2] = 99.0
    assert found["view"][0, 1] == 99.0 and found["turned"][2, 1] == 99.0, "views of the same memory"
    for name in ("view", "turned", "empty", "flags", "fixed"):
        assert found[name].strides == expected[name].strides
    assert type(found["table"]) is LandmarkTable


def damaged(folder: Path, change) -> Path:
    """A checkpoint whose structure was changed, with a digest that fits."""
    path = folder / "a"
    path.write_bytes(image("key", nested()))
    with h5py.File(path, "r+") as h5file:
        root, nodes = json.loads(h5file["structure"][()].tobytes())
        nodes = change(nodes) or nodes
        structure = np.frombuffer(json.dumps([root, nodes]).encode(), np.uint8)
        del h5file["structure"]
        h5file["structure"] = structure
        digest = checkpoint._digest(structure, h5file["memory"][()])
        h5file.attrs["digest"] = np.bytes_(digest.encode())
    return path


def replaced(kind: str, new: list):
    def change(nodes: list) -> None:
        nodes[next(i for i, node in enumerate(nodes) if node[0] == kind)] = new

    return change


@pytest.mark.parametrize(
    "change",
    [
        replaced("object", ["object", "os:_Environ", [], {}]),
        replaced("object", ["object", "subprocess:Popen", [], {}]),
        replaced("object", ["object", "ekfslam.runner:Config", [], {}]),
        replaced("object", ["object", "ekfslam.filters.landmarks:np", [], {}]),
        replaced("object", ["object", "ekfslam.filters.landmarks:Array", [], {}]),
        replaced("array", ["array", 0, 1 << 40, "<f8", [3], [8], True]),
        replaced("array", ["array", -8, 8, "<f8", [1], [8], True]),
        replaced("array", ["array", 0, 16, "<f8", [1000], [8], True]),
        replaced("array", ["array", 0, 16, "<f8", [2], [-800], True]),
        replaced("array", ["array", 0, 16, "|O", [2], [8], True]),
        replaced("view", ["view", 0, 0, "<f8", [1], [8], True]),
        replaced("list", ["list", [99999]]),
        replaced("list", ["list", [-1]]),
        replaced("list", ["__init__", [0]]),
        replaced("tuple", ["value", 0]),
        lambda nodes: nodes.__setitem__(0, ["list", [0]]),
        lambda nodes: [["list", [i + 1]] for i in range(10_000)],
        lambda nodes: [1, 2, 3],
        lambda nodes: {"a": 1},
    ],
)
def test_a_hostile_checkpoint_is_a_named_error(tmp_path, change):
    with pytest.raises(ResumeError, match=r"a: "):
        read(damaged(tmp_path, change), "key")


@pytest.mark.slow
def test_flipped_bytes_of_a_checkpoint_are_named_errors(tmp_path):
    content, rng = image("key", nested()), np.random.default_rng(0)
    refused = 0
    for _ in range(200):
        data = np.frombuffer(content, np.uint8).copy()
        data[rng.integers(0, len(data), 3)] ^= rng.integers(1, 256, 3).astype(np.uint8)
        (tmp_path / "a").write_bytes(data.tobytes())
        try:
            found = read(tmp_path / "a", "key")
        except ResumeError:
            refused += 1
        else:
            np.testing.assert_array_equal(found["array"], nested()["array"])  # the bytes were those of no content
    assert refused > 100


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


def killed(arguments: list[str], cpu_s: float) -> None:
    """A command that writes checkpoints half of the time."""
    checkpoint.EVERY_S, checkpoint.SHARE = 0.0, 1.0
    command(arguments, cpu_s)


@pytest.mark.slow
@pytest.mark.xdist_group("processes")
@pytest.mark.parametrize("name", ["run", "compare"])
@pytest.mark.parametrize("seed", seeds(4, 1))
def test_killed_and_resumed_ends_in_the_same_bits(tmp_path, name, seed):
    out = tmp_path / "out"
    target = out / "a.h5" if name == "run" else out / "city" / "archive.h5"
    more = [] if WHOLE or name == "run" else ["--no-figures"]
    arguments = [name, CITY, *more, "--out", str(target if name == "run" else out)]
    rng = np.random.default_rng(seed)
    for _ in range(3):
        call = (killed, [*arguments, "--resume"], rng.uniform(0.1, 0.5))
        assert processes(call)[0] in (-signal.SIGPROF, 0)
    assert not target.exists() and list(out.rglob("*checkpoint*"))
    assert main([*arguments, "--resume"]) == 0
    assert not list(out.rglob("*checkpoint*")) and not list(out.rglob(".ekfslam*"))
    resumed = Path(shutil.move(target, tmp_path / "resumed.h5"))
    assert main(arguments) == 0
    same_archives(resumed, target)


@pytest.mark.slow
def test_an_interruption_keeps_the_checkpoint_and_an_error_does_not(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(checkpoint, "EVERY_S", 0.0)
    out = tmp_path / "a.h5"
    arguments = ["run", "builtin:city?frames=12", "--out", str(out)]
    for error, kept in ((KeyboardInterrupt(), True), (ResumeError("of something else"), True), (OSError("gone"), True)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(runner, "collect", lambda reports, error=error: (_ for _ in ()).throw(error))
            assert main(arguments) in (2, 130)
        assert (tmp_path / "a.h5.checkpoint").exists() == kept
    assert main([*arguments, "--sigma-px", "2", "--resume"]) == 2
    assert "without --resume all begins anew" in capsys.readouterr().err
    assert (tmp_path / "a.h5.checkpoint").exists()
    assert main([*arguments, "--resume"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["a.h5"]


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
    journal.append("mid", 0, blank)
    assert [entry[:2] for entry in journal.entries()] == [("mid", 0)]
    bad = {"level": b'["x", 1]\n', "run": b'["mid", []]\n', "short": b'["mid", 1]\n1234', "no JSON": b"[" * 100_000}
    bad["long"] = b'["mid", 1]\n' + bytes(26)
    if kind == "another study":
        journal = Journal(tmp_path / "a.h5", {"seed": 2}, lambda level: blank)
    else:
        journal._write(_framed(bad[kind]))
    with pytest.raises(ArchiveError, match=r"a\.h5\.journal"):
        list(journal.entries())
