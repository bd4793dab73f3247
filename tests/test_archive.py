"""Result archives: exact round trip, and a named error for every way a file can be wrong."""

from __future__ import annotations

import dataclasses
import json
import shutil
import warnings
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.former import age_log
from support.helpers import synthetic_result, synthetic_sequence
from support.same import assert_same

from ekfslam import hdf5
from ekfslam.config import Config
from ekfslam.data.readers import read_sequence, write_sequence
from ekfslam.data.simulate import builtin
from ekfslam.errors import ArchiveError, PosteriorError, WriteError
from ekfslam.filters.result import ERROR_CONVENTION, Result
from ekfslam.geometry import se3
from ekfslam.runner import run
from ekfslam.smoother.posterior import posterior
from ekfslam.storage.archive import (
    FORMAT_VERSION,
    add_result,
    open_result,
    read_archive,
    require_same_origin,
    write_archive,
)
from ekfslam.storage.exports import export
from ekfslam.stored import layouts_of

MODES = ("full", "dead-reckoning", "mapping-only")
# Data sets that every run has, below its group.
OF_A_RUN = [
    f"{group}/{item.name}".strip("/")
    for group, _, layout in layouts_of(Result)
    for item in layout
    if group in ("", "landmarks", "innovation", "rejections")
]


@pytest.fixture(scope="module")
def sequence():
    return synthetic_sequence(frames=40, landmarks=60)


@pytest.fixture(scope="module")
def results(sequence):
    return {mode: synthetic_result(sequence, mode) for mode in MODES}


@pytest.fixture(scope="module")
def with_log(tmp_path_factory) -> Path:
    """An archive of a real run, whose full mode has a log."""
    world = builtin("loop?frames=12")
    path = tmp_path_factory.mktemp("log") / "log.h5"
    write_archive(path, world, {"full": run(world, "full")})
    return path


@pytest.fixture(scope="module")
def written(sequence, results, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("archive") / "result.h5"
    write_archive(path, sequence, results)
    return path


@pytest.fixture
def copy(written, tmp_path) -> Path:
    return Path(shutil.copy(written, tmp_path / "copy.h5"))


@pytest.mark.slow
def test_results_come_back_bit_for_bit(written, results):
    read = read_archive(written)
    assert tuple(read.results) == MODES
    for mode in MODES:
        assert_same(read.results[mode], results[mode], mode)
        assert_same(open_result(written, mode), results[mode], mode)


@pytest.mark.slow
def test_the_log_comes_back_bit_for_bit_and_in_units(with_log):
    result = run(builtin("loop?frames=12"), "full")
    assert_same(open_result(with_log, "full").log, result.log)
    with h5py.File(with_log) as h5file:
        log = h5file["runs/full/log"]
        assert all(log[name].attrs["units"] and log[name].attrs["frame"] for name in log)


@pytest.mark.slow
def test_a_damaged_log_is_named(with_log, tmp_path):
    for name in ("rows", "T_imu_world_linear", "landmark"):
        path = Path(shutil.copy(with_log, tmp_path / "copy.h5"))
        with h5py.File(path, "a") as h5file:
            del h5file["runs/full/log"][name]
        with pytest.raises(ArchiveError, match=rf"copy\.h5: runs/full/log/{name} is missing"):
            open_result(path, "full")
    path = Path(shutil.copy(with_log, tmp_path / "copy.h5"))
    with h5py.File(path, "a") as h5file:
        log = h5file["runs/full/log"]
        short = log["landmark_id"][:-1]
        del log["landmark_id"]
        log["landmark_id"] = short
    with pytest.raises(ArchiveError, match=r"log/first_position has shape"):
        open_result(path, "full")


@pytest.mark.slow
def test_a_log_of_another_map_is_named(with_log, tmp_path):
    result = open_result(with_log, "full")
    known = np.arange(len(result.landmarks) - 1)
    path = tmp_path / "other.h5"
    write_archive(
        path,
        read_archive(with_log),
        {"full": dataclasses.replace(result, landmarks=result.landmarks.only(known), whitened=None)},
    )
    with pytest.raises(ArchiveError, match=r"log/landmark_id has \d+ entries, but the map has \d+ landmarks"):
        open_result(path, "full")


@pytest.mark.slow
def test_adding_a_result_keeps_the_others_and_replaces_its_own(copy, sequence, results):
    added = dataclasses.replace(results["full"], mode="smoothed")
    add_result(copy, added)
    add_result(copy, dataclasses.replace(added, ms_per_frame=added.ms_per_frame + 1))
    read = read_archive(copy).results
    assert tuple(read) == (*MODES, "smoothed")
    for mode in MODES:
        assert_same(read[mode], results[mode], mode)
    np.testing.assert_array_equal(read["smoothed"].ms_per_frame, added.ms_per_frame + 1)
    assert list(copy.parent.iterdir()) == [copy]


def test_adding_to_no_archive_is_a_named_error(tmp_path, results):
    (tmp_path / "text.h5").write_text("no archive")
    with pytest.raises(ArchiveError, match=r"text\.h5"):
        add_result(tmp_path / "text.h5", results["full"])
    assert (tmp_path / "text.h5").read_text() == "no archive"


def test_settings_come_back_as_they_were(tmp_path):
    world = builtin("city?frames=3")
    config = Config().with_overrides({"hygiene": {"min_observations": 3, "reused_id_sigma": 7.0}})
    result = run(world, "full", config)
    write_archive(tmp_path / "a.h5", world, {"full": result})
    assert read_archive(tmp_path / "a.h5").results["full"].config == result.config


def test_an_archive_of_the_same_recording_elsewhere_may_be_replaced_and_one_of_another_not(tmp_path, sequence, results):
    here = dataclasses.replace(sequence, attributes={"checksum_sha256": "a", "note": 1})
    write_archive(tmp_path / "a.h5", here, results)
    moved = dataclasses.replace(here, source="/elsewhere", attributes={"checksum_sha256": "a", "note": 2})
    require_same_origin(tmp_path / "a.h5", moved)
    for attributes in ({"checksum_sha256": "b", "note": 1}, {"note": 1}):
        with pytest.raises(WriteError, match="a result of another recording"):
            require_same_origin(tmp_path / "a.h5", dataclasses.replace(here, attributes=attributes))


def test_sequence_and_truth_come_back_bit_for_bit(written, sequence):
    read = read_archive(written)
    for name in ("name", "source", "time_s", "twist", "camera", "T_cam_imu", "truth", "noise", "notes", "attributes"):
        assert_same(getattr(read, name), getattr(sequence, name), name)


@pytest.mark.parametrize("name", ["config", "counts"])
@pytest.mark.parametrize("text", ["[]", "3", "not JSON"])
def test_what_is_no_table_is_named(copy, name, text):
    with h5py.File(copy, "a") as h5file:
        h5file["runs/full"].attrs[name] = text
    with pytest.raises(ArchiveError, match=rf"copy\.h5: attribute {name} of runs/full is no JSON object"):
        open_result(copy, "full")


def test_sequence_without_truth_and_noise_comes_back_without(sequence, results, tmp_path):
    bare = dataclasses.replace(sequence, truth=None, noise=None)
    write_archive(tmp_path / "bare.h5", bare, results)
    read = read_archive(tmp_path / "bare.h5")
    assert read.truth is None
    assert read.noise is None


def test_every_data_set_states_units_and_frame(written):
    names = []

    def visit(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset):
            names.append(name)
            assert item.attrs["units"], name
            assert item.attrs["frame"], name

    with h5py.File(written) as h5file:
        h5file.visititems(visit)
        assert h5file.attrs["error_convention"].decode() == ERROR_CONVENTION
        assert h5file["runs/full/attributes"].attrs["seed"] == 0
        assert h5file["runs/full/attributes"].attrs["version_ekfslam"] == b"0.1.0"
        assert "observations" not in h5file["sequence"]
    assert {"truth/T_world_imu", "runs/full/trajectory/covariance", "runs/full/timing/ms_per_frame"} <= set(names)


@pytest.mark.parametrize("item", [*OF_A_RUN, "attributes"])
def test_missing_data_set_is_named(copy, item):
    with h5py.File(copy, "a") as h5file:
        del h5file[f"runs/full/{item}"]
    with pytest.raises(ArchiveError, match=rf"copy\.h5.*runs/full/{item} is missing"):
        read_archive(copy)
    assert open_result(copy, "dead-reckoning").mode == "dead-reckoning", "other modes stay readable"


@pytest.mark.parametrize("item", ["runs", "sequence/twist", "sequence/camera", "truth/T_world_imu", "sequence"])
def test_missing_group_is_named(copy, item):
    with h5py.File(copy, "a") as h5file:
        del h5file[item]
    with pytest.raises(ArchiveError, match=rf"copy\.h5.*{item}"):
        read_archive(copy)


@pytest.mark.parametrize("name", ["config", "counts", "noise_twist_std", "sequence_name"])
def test_missing_attribute_is_named(copy, name):
    with h5py.File(copy, "a") as h5file:
        del h5file["runs/full"].attrs[name]
    with pytest.raises(ArchiveError, match=rf"copy\.h5.*{name} of runs/full"):
        open_result(copy, "full")


def test_data_set_of_another_length_is_named(copy):
    with h5py.File(copy, "a") as h5file:
        group = h5file["runs/full/innovation"]
        nis = group["nis"][:-1]
        del group["nis"]
        group["nis"] = nis
    with pytest.raises(ArchiveError, match=r"runs/full/innovation/nis has shape \(39,\), expected \(40,\)"):
        open_result(copy, "full")


def test_unknown_mode_is_named_with_those_there_are(copy):
    with h5py.File(copy, "a") as h5file:
        del h5file["runs/full"]
    with pytest.raises(ArchiveError, match=r"copy\.h5: runs/full is missing.*dead-reckoning, mapping-only"):
        open_result(copy, "full")


def test_newer_version_is_refused(copy):
    with h5py.File(copy, "a") as h5file:
        h5file.attrs["format_version"] = FORMAT_VERSION + 1
    with pytest.raises(ArchiveError, match=rf"copy\.h5.*version {FORMAT_VERSION + 1}.*up to version {FORMAT_VERSION}"):
        read_archive(copy)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.999])
def test_truncated_file_is_refused(copy, share):
    content = copy.read_bytes()
    copy.write_bytes(content[: int(share * len(content))])
    with pytest.raises(ArchiveError, match=r"copy\.h5"):
        read_archive(copy)


def test_foreign_and_missing_files_are_refused(tmp_path):
    text, hdf5 = tmp_path / "notes.h5", tmp_path / "other.h5"
    text.write_text("not an archive")
    h5py.File(hdf5, "w").close()
    for path in (text, hdf5, tmp_path / "absent.h5", tmp_path):
        with pytest.raises(ArchiveError, match=path.name):
            read_archive(path)


def test_interrupted_write_keeps_the_old_archive_and_leaves_no_scrap(copy, sequence, results, monkeypatch):
    before = copy.read_bytes()

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(hdf5, "write_record", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_archive(copy, sequence, results)
    assert copy.read_bytes() == before
    assert [p.name for p in copy.parent.iterdir()] == [copy.name]


def test_rewriting_replaces_the_archive(copy, sequence, results):
    write_archive(copy, sequence, {"full": results["full"]})
    assert list(read_archive(copy).results) == ["full"]


def test_writing_into_a_missing_folder_is_a_named_error(sequence, results, tmp_path):
    with pytest.raises(ArchiveError, match=r"absent.result\.h5: cannot be written"):
        write_archive(tmp_path / "absent" / "result.h5", sequence, results)
    with pytest.raises(ArchiveError, match=r"absent.poses\.txt: cannot be written"):
        export(results["full"], tmp_path / "absent" / "poses.txt", "kitti")


def test_tum_export_holds_stamps_positions_and_quaternions(results, tmp_path):
    result = results["full"]
    export(result, tmp_path / "poses.txt", "tum")
    rows = np.loadtxt(tmp_path / "poses.txt")
    np.testing.assert_array_equal(rows[:, 0], result.time_s)
    np.testing.assert_array_equal(rows[:, 1:4], result.T_world_imu[:, :3, 3])
    # Rotation vector of a unit quaternion (x, y, z, w), by hand.
    vector, w = rows[:, 4:7], rows[:, 7:]
    sine = np.linalg.norm(vector, axis=1, keepdims=True)
    theta = 2 * np.arctan2(sine, w) * vector / np.where(sine > 0, sine, 1)
    np.testing.assert_allclose(se3.so3_exp(theta), result.T_world_imu[:, :3, :3], atol=1e-12)


def test_kitti_export_holds_the_upper_rows_exactly(results, tmp_path):
    result = results["full"]
    export(result, tmp_path / "poses.txt", "kitti", frame="body")
    rows = np.loadtxt(tmp_path / "poses.txt")
    np.testing.assert_array_equal(rows.reshape(-1, 3, 4), result.T_world_imu[:, :3])


# Files of earlier releases


@pytest.mark.slow
def test_adding_to_an_archive_of_an_earlier_version_keeps_its_runs_readable(with_log, tmp_path):
    added = run(builtin("loop?frames=12"), "dead-reckoning")
    path = Path(shutil.copy(with_log, tmp_path / "old.h5"))
    with h5py.File(path, "a") as h5file:
        h5file.attrs["format_version"] = 3
        age_log(h5file["runs/full/log"], version=3)
    before = open_result(path, "full")
    for name in ("first", "second"):
        add_result(path, dataclasses.replace(added, mode=name))
        assert_same(open_result(path, "full"), before)
    with h5py.File(path) as h5file:
        assert h5file.attrs["format_version"] == FORMAT_VERSION
        assert "T_imu_world_departed" in h5file["runs/full/log"], "a file has one version"


def test_a_log_with_velocities_alone_is_read_as_inputs_of_a_process(with_log, tmp_path):
    path = Path(shutil.copy(with_log, tmp_path / "old.h5"))
    with h5py.File(path, "a") as h5file:
        h5file.attrs["format_version"] = 5
        age_log(h5file["runs/full/log"], version=5)
    before, found = open_result(with_log, "full").log, open_result(path, "full").log
    for name in vars(before):
        if name != "initial_covariance":
            np.testing.assert_allclose(getattr(found, name), getattr(before, name), atol=1e-12, err_msg=name)
    np.testing.assert_array_equal(found.initial_covariance, before.initial_covariance[:6, :6])


def test_drift_of_an_earlier_version_is_not_taken_for_pixels(copy):
    with h5py.File(copy, "a") as h5file:
        h5file.attrs["format_version"] = 3
        attributes = h5file["runs/full"].attrs
        config = json.loads(attributes["config"])
        config["noise"]["drift"] = 0.4  # of the distance driven
        attributes["config"], attributes["noise_drift"] = json.dumps(config), 0.4
    assert open_result(copy, "full").config["noise"]["drift"] is None


def test_noise_that_no_model_uses_any_more_is_noted(sequence, tmp_path):
    write_sequence(sequence, tmp_path / "old.h5")
    with h5py.File(tmp_path / "old.h5", "a") as h5file:
        h5file["sequence/noise"].attrs.update(drift=0.4, bearing_drift_rad=0.0)
    again = read_sequence(tmp_path / "old.h5")
    assert_same(again.noise, sequence.noise)
    assert again.notes == (*sequence.notes, "The noise states drift 0.4, which no model uses any more.")


@pytest.mark.parametrize(("name", "value"), [("misalignment_rad", 0.01), ("track_memory", 0.9)])
def test_a_result_with_noise_that_no_longer_exists_is_read_but_not_smoothed(with_log, tmp_path, name, value):
    path = Path(shutil.copy(with_log, tmp_path / "old.h5"))
    with h5py.File(path, "a") as h5file:
        h5file["runs/full"].attrs[f"noise_{name}"] = value
    with pytest.raises(PosteriorError, match=rf"had the noise {name} {value}, which no longer exists"):
        posterior(open_result(path, "full"))


def test_an_archive_of_this_version_is_read_and_smoothed_without_notes(with_log):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = open_result(with_log, "full")
        posterior(result)
    assert "retired_noise" not in result.attributes
    assert read_archive(with_log).notes == ()
