"""Every dimension in a file has a name and a coordinate: xarray opens every group, and pandas every table."""

from __future__ import annotations

import importlib.util
import lzma
import shutil
import warnings
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.same import assert_same

from ekfslam.config import Config
from ekfslam.data.readers import read_sequence, write_sequence
from ekfslam.data.simulate import builtin
from ekfslam.errors import ArchiveError
from ekfslam.filters.result import Result
from ekfslam.geometry import se3
from ekfslam.runner import run
from ekfslam.smoother.posterior import smooth
from ekfslam.storage.archive import open_result, read_archive, write_archive
from ekfslam.stored import AXES, layouts_of
from ekfslam.studies.study import read_study, write_study

xarray = pytest.importorskip("xarray")
pytest.importorskip("h5netcdf")

OLD = Path(__file__).parent / "frozen" / "archives"


@pytest.fixture(scope="module")
def world():
    return builtin("loop?frames=12")


@pytest.fixture(scope="module")
def full(world):
    config = Config().with_overrides({"calibration": {"lever_arm_m": 0.01}, "filter": {"relative_frames": 5}})
    return run(world, "full", config)


@pytest.fixture(scope="module")
def files(world, full, tmp_path_factory) -> dict[str, Path]:
    """One file of each kind."""
    folder = tmp_path_factory.mktemp("dimensions")
    write_archive(folder / "archive.h5", world, {"full": full, "smoothed": smooth(full)})
    write_sequence(world, folder / "sequence.h5")
    write_study(folder / "study.h5", read_study(unpacked("study_1", folder)))
    return {path.stem: path for path in folder.glob("*.h5")}


def unpacked(name: str, folder: Path) -> Path:
    """A file of an earlier release."""
    path = folder / f"{name}.h5"
    path.write_bytes(lzma.decompress((OLD / f"{name}.h5.xz").read_bytes()))
    return path


def groups(path: Path) -> dict[str, dict[str, h5py.Dataset]]:
    """Names of all groups that hold data sets, and the values of these."""
    found: dict[str, dict[str, np.ndarray]] = {}

    def visit(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset):
            group, _, leaf = name.rpartition("/")
            found.setdefault(group, {})[leaf] = item[()]

    with h5py.File(path) as h5file:
        h5file.visititems(visit)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["archive", "sequence", "study"])
def test_xarray_opens_every_group(files, kind):
    found = groups(files[kind])
    assert len(found) >= {"archive": 15, "sequence": 4, "study": 2}[kind]
    for group, values in found.items():
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            opened = xarray.open_dataset(files[kind], group=group, engine="h5netcdf").load()
        opened.close()
        assert set(opened.variables) == set(values), group
        for name, value in values.items():
            there = opened[name].values
            if value.dtype.kind == "S":
                value = np.array([text.decode() for text in value.ravel()]).reshape(value.shape)
            np.testing.assert_array_equal(there, value, err_msg=f"{group}/{name}")
            assert "units" in opened[name].attrs
        for dimension in opened.dims:
            assert dimension in opened.coords, f"{group}: {dimension} has no coordinate"
            assert not str(dimension).startswith("phony")
        for name in set(opened.data_vars):
            series = opened[name].to_series() if opened[name].dims else None
            assert series is None or len(series) == values[name].size


@pytest.mark.slow
def test_values_are_taken_by_stamp_id_and_label(files, full):
    def opened(group):
        return xarray.open_dataset(files["archive"], group=f"runs/full/{group}", engine="h5netcdf").load()

    covariance = opened("trajectory").covariance
    assert covariance.dims == ("time", "xi", "xi_2")
    some = covariance.sel(time=full.time_s[7], xi="rho_y", xi_2="theta_z")
    assert some == full.covariance[7, 1, 5]
    assert opened("innovation").nis.sel(time=slice(full.time_s[3], full.time_s[6])).sizes == {"time": 4}
    landmark = full.landmarks.id[5]
    assert opened("landmarks").position.sel(id=landmark, axis="z") == full.landmarks.position_m[5, 2]
    parameters = opened("parameters")
    assert parameters["std"].sel(parameter=full.parameters.name[2]).values[-1] == full.parameters.std[-1, 2]
    assert opened("log").is_gap.dtype == bool


@pytest.mark.parametrize(
    ("name", "entry"),
    [
        ("runs/full/innovation/time", 1.0),
        ("runs/full/log/observation", 5),
        ("runs/full/landmarks/axis", b"q"),
        ("runs/full/parameters/parameter", b"something else"),
        ("truth/row", b"q"),
    ],
)
def test_a_coordinate_that_is_wrong_is_named(files, tmp_path, name, entry):
    path = Path(shutil.copy(files["archive"], tmp_path / "copy.h5"))
    with h5py.File(path, "a") as h5file:
        h5file[name][-1] = entry
    with pytest.raises(ArchiveError, match=rf"copy\.h5: {name} is not the coordinate of"):
        read_archive(path)


def test_names_of_dimensions_are_distinct():
    assert len({axis.name for axis in AXES.values()}) == len(AXES)


@pytest.mark.slow
@pytest.mark.parametrize("version", [1, 2, 3, 4, 5, 6])
def test_archives_of_every_version_are_read_and_written_again(version, tmp_path):
    """Files that those releases wrote; what is read of them is what is read after it was written in today's form."""
    old = read_archive(unpacked(f"archive_{version}", tmp_path))
    assert len(old.time_s) == 8 and {"dead-reckoning", "full"} <= set(old.results)
    assert (old.results["full"].log is None) == (version == 1)
    assert len(old.results["full"].landmarks) > 5
    write_archive(tmp_path / "new.h5", old, old.results)
    for mode, result in old.results.items():
        assert_same(open_result(tmp_path / "new.h5", mode), result, mode)


def test_a_frozen_archive_of_inertial_samples_is_smoothed_as_it_was(tmp_path):
    archive = read_archive(unpacked("inertial_6", tmp_path))
    found, frozen = smooth(archive.results["full"]), archive.results["smoothed"]
    assert archive.twist is None
    # The maximum is found by other steps than then, which end at another place within the tolerance on the cost.
    off = se3.log(se3.inverse(found.T_world_imu) @ frozen.T_world_imu)
    std = np.sqrt(np.diagonal(frozen.covariance, axis1=1, axis2=2))
    assert (np.abs(off) <= 1e-3 * std + 1e-9).all()
    np.testing.assert_allclose(found.covariance, frozen.covariance, rtol=1e-4, atol=1e-9)


def test_an_earlier_sequence_and_study_are_read(tmp_path):
    old = read_sequence(unpacked("sequence_1", tmp_path))
    write_sequence(old, tmp_path / "new.h5")
    assert_same(read_sequence(tmp_path / "new.h5").observations, old.observations)
    study = read_study(unpacked("study_1", tmp_path))
    write_study(tmp_path / "new_study.h5", study)
    again = read_study(tmp_path / "new_study.h5")
    assert study.complete and again.study == study.study
    for field, values in study.data["tiny"]["invariant"].items():
        np.testing.assert_array_equal(again.data["tiny"]["invariant"][field], values)


def test_the_page_on_the_format_is_that_of_the_code():
    """``python docs/make_archive.py`` writes it."""
    script = Path(__file__).resolve().parents[1] / "docs" / "make_archive.py"
    spec = importlib.util.spec_from_file_location("make_archive", script)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    page = module.page()
    assert page == module.PAGE.read_text(encoding="utf-8")
    names = [item.name for _, _, layout in layouts_of(Result) for item in layout]
    assert len(names) > 50 and all(f"`{name}`" in page for name in names)
