"""Every recipe of the documentation does what it says."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from support.rendered import recording, write_kitti

import ekfslam
from ekfslam.models.blocks import OPTIONAL_BLOCKS

# All in one process, so that the page runs once.
pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("recipes")]

for package in ("cv2", "pandas", "xarray", "h5netcdf"):
    pytest.importorskip(package)

PAGE = (Path(__file__).resolve().parents[1] / "docs" / "recipes.md").read_text(encoding="utf-8")
RECIPES = [("imports", PAGE), *re.findall(r"^## (\d+)\. .*\n([\s\S]*?)(?=^## |\Z)", PAGE, re.MULTILINE)]


@pytest.fixture(scope="module")
def cooked(tmp_path_factory):
    """The names of each recipe after it has run, and the folder it ran in."""
    folder = tmp_path_factory.mktemp("recipes")
    write_kitti(recording(5, distorted=False, rotation_rad=np.zeros(3)), 5, folder / "images")
    known, names, found = dict(OPTIONAL_BLOCKS), {}, {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for number, text in RECIPES:
            code = re.findall(r"^```python\n([\s\S]*?)^```", text, re.MULTILINE)
            exec(compile(code[0], f"recipe {number}", "exec"), names)
            found[number] = dict(names)
    OPTIONAL_BLOCKS.clear()
    OPTIONAL_BLOCKS.update(known)
    return found, folder


def test_there_are_fifteen(cooked):
    assert list(cooked[0])[1:] == [str(i) for i in range(1, 16)]
    assert all(len(re.findall(r"^```python$", text, re.MULTILINE)) == 1 for _, text in RECIPES[1:])


def test_maps_and_covariances(cooked):
    found, _ = cooked
    assert found["1"]["result"].noise is not None and len(found["1"]["result"].landmarks) > 100
    joint = found["2"]
    assert joint["everything"].id[joint["rows"]].tolist() == [3, 17]
    assert 0 < np.linalg.eigvalsh(joint["of_difference"])[0] < np.trace(joint["P"])
    at = found["6"]
    assert abs(at["result"].time_s[at["k"]] - 3.0) < 0.06


def test_settings_studies_and_rejections(cooked):
    found, _ = cooked
    assert len(found["4"]["ate_m"]) == 10 and max(found["4"]["ate_m"].values()) < 0.1
    assert len(found["5"]["rejected"]) == found["5"]["result"].counts["rejected"] > 0
    assert 1.0 < np.nanmedian(found["7"]["nees"]) < 20.0
    assert repr(found["7"]["report"]).count("\n") < 6
    assert found["14"]["resumed"].table == found["7"]["report"].table


def test_files(cooked):
    found, folder = cooked
    assert np.loadtxt(folder / "drive.txt").shape == (40, 8)
    assert (folder / "drive.ply").read_bytes().startswith(b"ply")
    assert found["11"]["variance"].sizes == {"time": 40} and len(found["11"]["landmarks"]) > 100
    found["11"]["trajectory"].close()
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert all(variant in page for variant in ekfslam.VARIANTS)


def test_live_and_own_block(cooked):
    found, _ = cooked
    live, truth = found["9"]["live"], found["9"]["sequence"].truth
    assert live.counts.taken_in == 40 and live.counts.late_images == 0
    assert np.linalg.norm(live.pose().T_world_imu[:3, 3] - truth.T_world_imu[-1, :3, 3]) < 0.3
    biased = found["10"]["biased"].parameters
    assert biased.name == ("bias of w_z",) and abs(biased.value[-1, 0] - 0.03) < 3 * biased.std[-1, 0] < 0.05


def test_images_and_loops(cooked):
    found, _ = cooked
    assert not found["13"]["drive"].has_velocities and len(found["13"]["seen"].landmarks) > 20
    filtered, smoothed = (found["15"][name].position_std_world_m[80] for name in ("filtered", "smoothed"))
    assert (smoothed < 0.8 * filtered).all()


def test_what_is_asked_wrongly_is_named(cooked, tmp_path):
    found, _ = cooked
    result, everything = found["2"]["result"], found["2"]["everything"]
    with pytest.raises(ekfslam.EkfslamError, match="there is no landmark of id 99999"):
        everything.rows_of([3, 99999])
    with pytest.raises(ekfslam.EkfslamError, match="there is no landmark row 99999; there are"):
        everything.joint_covariance(landmarks=[99999])
    with pytest.raises(ekfslam.EkfslamError, match="70 s is not within 0 to"):
        result.frame_at(70.0)
    with pytest.raises(ekfslam.EkfslamError, match="there is no format 'pcd'; known: tum"):
        result.export(tmp_path / "a.pcd", "pcd")


def test_an_archive_that_is_open_elsewhere_is_read(cooked):
    import xarray

    _, folder = cooked
    with xarray.open_dataset(folder / "drive.h5", group="runs/full/landmarks", engine="h5netcdf") as landmarks:
        read = ekfslam.read_archive(folder / "drive.h5").results["full"]
        np.testing.assert_array_equal(read.landmarks.id, landmarks.id)
