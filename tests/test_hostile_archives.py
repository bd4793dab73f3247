"""Archives that somebody else has made or damaged: every wrong value is one named error, before anything uses it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.helpers import synthetic_result, synthetic_sequence
from support.running import WHOLE

from ekfslam.cli import main
from ekfslam.config import Config
from ekfslam.data.simulate import builtin
from ekfslam.errors import ArchiveError
from ekfslam.filters.result import Result
from ekfslam.runner import run
from ekfslam.storage.archive import add_result, open_result, read_archive, write_archive
from ekfslam.stored import layouts_of


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """An archive of a full run with everything in it."""
    path = tmp_path_factory.mktemp("hostile") / "whole.h5"
    world = builtin("loop?frames=12")
    config = Config().with_overrides({"calibration": {"lever_arm_m": 0.01}, "filter": {"relative_frames": 5}})
    write_archive(path, world, {"full": run(world, "full", config)})
    return path


def data_sets(path: Path) -> list[str]:
    names: list[str] = []
    with h5py.File(path) as h5file:
        h5file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
    return names


def altered(whole: Path, folder: Path, name: str, value: object) -> Path:
    """A copy with a data set replaced."""
    path = Path(shutil.copy(whole, folder / "copy.h5"))
    with h5py.File(path, "a") as h5file:
        del h5file[name]
        if value is not None:
            h5file[name] = value
    return path


def spoilt(value: np.ndarray, entry: float) -> np.ndarray:
    value = value.copy()
    value.reshape(-1)[-1] = entry
    return value


@pytest.mark.slow
def test_every_number_of_an_archive_is_looked_at(whole, tmp_path):
    """Each of the values; in the reduced form one a data set, in turn."""
    names = data_sets(whole)
    assert {"runs/full/log/frame", "runs/full/parameters/std", "runs/full/whitened/score", "truth/frame"} <= set(names)
    tried = 0
    for name in names:
        with h5py.File(whole) as h5file:
            value, is_coordinate = h5file[name][()], h5file[name].is_scale
        if value.size == 0 or value.dtype.kind not in "iuf":
            continue
        entries = [np.nan, np.inf, 1e200] if value.dtype.kind == "f" else [-(1 << 40), (1 << 62) + 1]
        entries = [2, 255] if value.dtype == np.uint8 else entries  # truth values
        entries = [
            entry for entry in entries[: 1 if is_coordinate else 3] if not (name.endswith("apart") and np.isnan(entry))
        ]
        for entry in entries if WHOLE else [entries[tried % len(entries)]]:
            path = altered(whole, tmp_path, name, spoilt(value, entry))
            with pytest.raises(ArchiveError, match=r"copy\.h5") as caught:
                read_archive(path)
                pytest.fail(f"{entry} in {name} is read")
            assert name.split("/")[-1] in str(caught.value), "the data set is named"
            tried += 1
    assert tried > (80 if WHOLE else 40)


@pytest.mark.parametrize(
    ("name", "entry"),
    [
        ("runs/full/log/frame", -1),  # crashed the interpreter
        ("runs/full/log/frame", 12),
        ("runs/full/log/landmark", -1),
        ("runs/full/log/landmark", 1 << 30),
        ("runs/full/log/previous", 1 << 30),
        ("runs/full/log/previous", -2),
        ("runs/full/log/variance", 0.0),
        ("runs/full/log/variance", -1.0),
        ("runs/full/log/tau", -0.1),
        ("runs/full/rejections/reason", 99),
        ("runs/full/whitened/frame", 12),
        ("runs/full/whitened/landmark", 1 << 20),
        ("runs/full/hygiene/rule", 7),
        ("runs/full/parameters/std", -1.0),
        ("runs/full/pairs/second", 400),
        ("runs/full/trajectory/time", 0.0),
        ("runs/full/trajectory/T_world_imu", 2.0),
        ("runs/full/trajectory/covariance", -1.0),
        ("runs/full/timing/ms_per_frame", 1e200),
        ("runs/full/innovation/dof", (1 << 62) + 1),
        ("runs/full/landmarks/covariance", -1.0),
        ("truth/frame", 12),
        ("truth/frame", -1),
        ("sequence/time", 0.0),
    ],
)
def test_values_out_of_their_range_are_named(whole, tmp_path, name, entry):
    with h5py.File(whole) as h5file:
        value = h5file[name][()]
    if value.size == 0:
        value = np.full((1, *value.shape[1:]), entry, dtype=value.dtype)
        pytest.skip(f"{name} has no entry in this run")
    path = altered(whole, tmp_path, name, spoilt(value, entry))
    with pytest.raises(ArchiveError, match=name.split("/")[-1]):
        read_archive(path)


def test_a_mirrored_pose_is_named(whole, tmp_path):
    with h5py.File(whole) as h5file:
        T = h5file["runs/full/trajectory/T_world_imu"][()]
    T[7, :3, 2] *= -1.0
    with pytest.raises(ArchiveError, match=r"T_world_imu\[7\]: must be a rigid transform"):
        read_archive(altered(whole, tmp_path, "runs/full/trajectory/T_world_imu", T))


def test_a_pair_of_one_frame_with_itself_is_named(whole, tmp_path):
    path = Path(shutil.copy(whole, tmp_path / "copy.h5"))
    with h5py.File(path, "a") as h5file:
        group = h5file["runs/full/pairs"]
        for name in list(group):
            del group[name]
        group["first"], group["second"], group["cross"] = [3], [3], np.zeros((1, 6, 6))
    with pytest.raises(ArchiveError, match="pairs holds frames that are no pair"):
        read_archive(path)


def test_a_difference_from_an_earlier_frame_than_the_one_before_is_named(whole, tmp_path):
    with h5py.File(whole) as h5file:
        frame, landmark, previous = (h5file[f"runs/full/log/{name}"][()] for name in ("frame", "landmark", "previous"))
    views = np.flatnonzero(landmark == landmark[frame == 5][0])
    later = views[frame[views] == 5][0]
    previous[later] = views[frame[views] < 4][0]
    with pytest.raises(ArchiveError, match=rf"previous\[{later}\] is no observation of the same landmark"):
        read_archive(altered(whole, tmp_path, "runs/full/log/previous", previous))


def test_a_difference_is_from_the_same_landmark_in_the_frame_before(whole, tmp_path):
    with h5py.File(whole) as h5file:
        frame, landmark, previous = (h5file[f"runs/full/log/{name}"][()] for name in ("frame", "landmark", "previous"))
    later = np.flatnonzero(frame == 5)[0]
    before = np.flatnonzero(frame == 4)
    same, other = (before[(landmark[before] == landmark[later]) == is_same][0] for is_same in (True, False))
    previous[later] = same
    read_archive(altered(whole, tmp_path, "runs/full/log/previous", previous))
    previous[later] = other
    with pytest.raises(ArchiveError, match=rf"previous\[{later}\] is no observation of the same landmark"):
        read_archive(altered(whole, tmp_path, "runs/full/log/previous", previous))


def test_a_stamp_that_comes_twice_is_named(whole, tmp_path):
    with h5py.File(whole) as h5file:
        time_s = h5file["runs/full/trajectory/time"][()]
    time_s[7] = time_s[6]
    path = altered(whole, tmp_path, "runs/full/trajectory/time", time_s)
    with pytest.raises(ArchiveError, match=r"time\[7\].*must be finite and ascend"):
        read_archive(path)


def test_a_covariance_that_is_not_symmetric_is_named(whole, tmp_path):
    with h5py.File(whole) as h5file:
        P = h5file["runs/full/trajectory/covariance"][()]
    P[7, 0, 3] *= 1.01
    path = altered(whole, tmp_path, "runs/full/trajectory/covariance", P)
    with pytest.raises(ArchiveError, match=r"covariance\[7\]: must be symmetric and positive semi-definite"):
        read_archive(path)


def test_a_correlation_above_one_is_named(whole, tmp_path):
    with h5py.File(whole) as h5file:
        P = h5file["runs/full/trajectory/covariance"][()]
    P[7, 0, 1] = P[7, 1, 0] = 1.001 * np.sqrt(P[7, 0, 0] * P[7, 1, 1])
    path = altered(whole, tmp_path, "runs/full/trajectory/covariance", P)
    with pytest.raises(ArchiveError, match=r"covariance\[7\]"):
        read_archive(path)


@pytest.mark.slow
def test_fields_of_a_log_that_contradict_each_other_are_named(whole, tmp_path):
    with h5py.File(whole) as h5file:
        log = {name: item[()] for name, item in h5file["runs/full/log"].items()}
    landmark = np.where(log["landmark"] == 3, 2, log["landmark"])
    with pytest.raises(ArchiveError, match=r"landmark_id\[3\] has no observation"):
        read_archive(altered(whole, tmp_path, "runs/full/log/landmark", landmark))
    later = int(np.flatnonzero(log["frame"] == 5)[0])
    previous = log["previous"].copy()
    previous[later] = 0
    with pytest.raises(ArchiveError, match=rf"previous\[{later}\] is no observation of the same landmark"):
        read_archive(altered(whole, tmp_path, "runs/full/log/previous", previous))
    before = np.flatnonzero((log["frame"] == 4) & (log["landmark"] != log["landmark"][later]))
    previous[later] = before[0]  # in the frame before, but another landmark
    with pytest.raises(ArchiveError, match=rf"previous\[{later}\] is no observation of the same landmark"):
        read_archive(altered(whole, tmp_path, "runs/full/log/previous", previous))


@pytest.mark.parametrize("columns", [1, 2, 4])
def test_a_curved_block_in_a_log_has_its_three_columns_or_none(whole, tmp_path, columns):
    path = altered(whole, tmp_path, "runs/full/log/curved", np.zeros((12, columns)))
    with h5py.File(path, "a") as h5file:
        del h5file["runs/full/log/curved_axis"]
    with pytest.raises(ArchiveError, match=f"log/curved has {columns} columns"):
        read_archive(path)


def test_a_log_with_the_coordinates_of_other_blocks_is_named(whole, tmp_path, capsys):
    path = Path(shutil.copy(whole, tmp_path / "copy.h5"))
    with h5py.File(path, "a") as h5file:
        log = h5file["runs/full/log"]
        for name in ("departed", "linear", "updated", "coordinate"):
            value = log[name][..., :-1]
            del log[name]
            log[name] = value
    assert main(["posterior", str(path), "--no-figures"]) == 2
    assert "coordinates of state blocks, expected" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["text", "empty", "compound", "reference", "variable length"])
def test_data_of_another_type_are_named(whole, tmp_path, kind):
    name = "runs/full/log/frame"
    with h5py.File(whole) as h5file:
        count = len(h5file[name])
    path = altered(whole, tmp_path, name, None)
    with h5py.File(path, "a") as h5file:
        if kind == "reference":
            h5file.create_dataset(name, data=[h5file["runs"].ref] * count, dtype=h5py.ref_dtype)
        elif kind == "variable length":
            h5file.create_dataset(name, (count,), dtype=h5py.vlen_dtype(np.int64))
        else:
            values = {
                "text": np.full(count, b"1"),
                "empty": h5py.Empty("i8"),
                "compound": np.zeros(count, dtype=[("a", "i8"), ("b", "f8")]),
            }
            h5file[name] = values[kind]
    with pytest.raises(ArchiveError, match="runs/full/log/frame is"):
        read_archive(path)


@pytest.mark.parametrize("kind", ["soft", "external", "storage", "virtual", "twice", "cycle", "type"])
def test_what_leads_out_of_the_file_or_round_in_it_is_refused(whole, tmp_path, kind):
    name = "runs/full/timing/ms_per_frame"
    path = altered(whole, tmp_path, name, None)
    shutil.copy(whole, tmp_path / "other.h5")
    with h5py.File(path, "a") as h5file:
        if kind == "soft":
            h5file[name] = h5py.SoftLink("/runs/full/trajectory/time")
        elif kind == "external":
            h5file[name] = h5py.ExternalLink("other.h5", name)
        elif kind == "storage":
            secret = tmp_path / "secret"
            secret.write_bytes(bytes(96))
            h5file.create_dataset(name, (12,), "f8", external=[(str(secret), 0, 96)])
        elif kind == "virtual":
            layout = h5py.VirtualLayout((12,), "f8")
            layout[:] = h5py.VirtualSource(tmp_path / "other.h5", name, (12,))
            h5file.create_virtual_dataset(name, layout)
        elif kind == "twice":
            h5file[name] = h5file["runs/full/trajectory/time"]
        elif kind == "cycle":
            h5file["runs/full/timing/ms_per_frame"] = h5file["runs"]
        else:
            h5file[name] = np.dtype("f8")
    words = {"soft": "is a link", "external": "is a link", "type": "neither"}
    words |= {"storage": "in another file", "virtual": "in another file", "twice": "twice", "cycle": "twice"}
    for read in (read_archive, lambda p: open_result(p, "full")):
        with pytest.raises(ArchiveError, match=words[kind]):
            read(path)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("config", "{" * 5 + '"a":' * 3, "no JSON object"),
        ("config", "[" * 100_000, "no JSON object"),
        ("config", json.dumps({"filter": []}), "must be a table"),
        ("config", json.dumps({"filter": {"iterations": "many"}}), "iterations must be a whole number"),
        ("config", json.dumps({"noise": {"sigma_px": float("nan")}}), "sigma_px must be finite"),
        ("config", json.dumps({"blocks": {"twist": 3}}), "must be a table"),
        ("counts", json.dumps({"accepted": -1}), "no count"),
        ("counts", json.dumps({"accepted": "7"}), "no count"),
        ("counts", h5py.Empty("S4"), "is empty"),
        ("noise_twist_std", np.full(6, np.nan), "twist_std"),
        ("noise_pixel_std_px", np.ones(3), "pixel_std_px"),
        ("noise_track_flow_px", -7.0, "track_flow_px"),
        ("noise_track_parallax", 0.0, "track_parallax"),
        ("format_version", "four", "format_version of runs/full is no whole number"),
    ],
)
def test_attributes_are_looked_at(whole, tmp_path, name, value, words):
    path = Path(shutil.copy(whole, tmp_path / "copy.h5"))
    with h5py.File(path, "a") as h5file:
        h5file["runs/full"].attrs[name] = np.bytes_(value.encode()) if isinstance(value, str) else value
    with pytest.raises(ArchiveError, match=words):
        read_archive(path)


@pytest.mark.parametrize("value", [np.ones(3), np.nan, np.inf])
def test_further_facts_are_texts_and_finite_numbers(whole, tmp_path, value):
    for group in ("runs/full/attributes", "sequence/attributes"):
        path = Path(shutil.copy(whole, tmp_path / "copy.h5"))
        with h5py.File(path, "a") as h5file:
            h5file[group].attrs["seed"] = value
        with pytest.raises(ArchiveError, match="attribute seed of"):
            read_archive(path)


def test_text_has_a_fixed_length_everywhere(whole):
    found: list[str] = []

    def visit(name: str, item: h5py.Group | h5py.Dataset) -> None:
        types = [item.attrs.get_id(key).dtype for key in item.attrs]
        types += [item.dtype] if isinstance(item, h5py.Dataset) else []
        texts = [h5py.check_string_dtype(dtype) for dtype in types]
        found.extend(name for text in texts if text is not None and text.length is None)

    with h5py.File(whole) as h5file:
        h5file.visititems(visit)
        visit("/", h5file)
    assert found == []


def test_what_could_not_be_read_again_is_not_written(tmp_path):
    sequence = synthetic_sequence(frames=20, landmarks=20)
    result = synthetic_result(sequence, "dead-reckoning")
    result.covariance[3, 2, 2] = -1.0
    with pytest.raises(ArchiveError, match=r"covariance\[3\]"):
        write_archive(tmp_path / "a.h5", sequence, {"dead-reckoning": result})
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_added_to_an_archive_that_is_not_valid(whole, tmp_path):
    sequence = synthetic_sequence(frames=12, landmarks=20)
    path = altered(whole, tmp_path, "runs/full/log/frame", None)
    before = path.read_bytes()
    with pytest.raises(ArchiveError, match="log/frame is missing"):
        add_result(path, synthetic_result(sequence, "dead-reckoning"))
    assert path.read_bytes() == before


@pytest.mark.parametrize("command", ["posterior", "check", "info", "plot", "export"])
def test_the_finding_that_crashed_the_interpreter_is_one_line(whole, tmp_path, capsys, command):
    with h5py.File(whole) as h5file:
        frame = h5file["runs/full/log/frame"][()]
    frame[0] = -1
    path = altered(whole, tmp_path, "runs/full/log/frame", frame)
    assert main([command, str(path), *(["--format", "tum"] if command == "export" else [])]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert "runs/full/log/frame[0] = -1: must be an index from 0 to T - 1" in line


@pytest.mark.parametrize("command", ["posterior", "check", "plot", "export"])
def test_an_archive_without_a_run_is_one_line(whole, tmp_path, capsys, command):
    path = altered(whole, tmp_path, "runs/full", None)
    assert main([command, str(path), *(["--format", "tum"] if command == "export" else [])]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert main(["info", str(path)]) == 0


def test_every_item_of_every_layout_has_a_check_that_can_fail():
    layouts = [layout for _, _, layout in layouts_of(Result)]
    assert len(layouts) >= 8
    for item in (item for layout in layouts for item in layout):
        bad = {"f": np.nan, "i": -(1 << 40)}.get(item.check.kinds)
        if bad is None or item.name == "apart":
            continue
        shape = tuple(4 if isinstance(n, str) else n for n in item.shape)
        assert not item.check.holds(np.full(shape, bad), {"T": 4, "M": 4, "L": 4, "K": 4}).all(), item.name
