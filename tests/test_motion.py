"""Pictures for other eyes: files of the viewer, drives in motion, vector graphics, the drive from the side."""

from __future__ import annotations

import dataclasses
import itertools
import json
import shutil
import subprocess
import sys
from unittest.mock import MagicMock

import numpy as np
import pytest
from PIL import Image
from support.helpers import synthetic_result, synthetic_sequence

from ekfslam.cli import main
from ekfslam.errors import ConfigError
from ekfslam.evaluation.consistency import world_axes_std
from ekfslam.evaluation.trajectory import distance_along
from ekfslam.figures import viewer
from ekfslam.figures.animation import animated, write_animation
from ekfslam.figures.maps import plot_map, plot_side
from ekfslam.figures.style import save_all
from ekfslam.filters.result import Landmarks
from ekfslam.geometry import se3
from ekfslam.storage.archive import read_archive, write_archive


@pytest.fixture(scope="module")
def sequence():
    return synthetic_sequence(frames=40, landmarks=30)


@pytest.fixture(scope="module")
def path(sequence, tmp_path_factory):
    path = tmp_path_factory.mktemp("motion") / "archive.h5"
    write_archive(path, sequence, {mode: synthetic_result(sequence, mode) for mode in ("dead-reckoning", "full")})
    return path


@pytest.mark.slow
def test_a_viewer_file_holds_poses_landmarks_and_errors(path, tmp_path, capsys):
    chunks = pytest.importorskip("rerun.chunk", reason="Rerun is not installed: pip install 'ekfslam[viewer]'")
    target = tmp_path / "drive.rrd"
    assert main(["plot", str(path), "--viewer", str(target)]) == 0
    full = read_archive(path).results["full"]
    found = {}
    for chunk in chunks.RrdReader(target).stream():
        table = chunk.to_record_batch()
        found.setdefault(chunk.entity_path, {}).update({name: table.column(name) for name in table.schema.names})
    moves = found["/world/full/imu"]
    position = np.array(moves["Transform3D:translation"].to_pylist())[:, 0]
    np.testing.assert_allclose(position, full.T_world_imu[:, :3, 3], rtol=1e-6, atol=1e-6)
    seconds = np.array([value.total_seconds() for value in moves["time"].to_pylist()])
    np.testing.assert_allclose(seconds, full.time_s - full.time_s[0], atol=1e-6)
    points = np.array(found["/world/full/landmarks"]["Points3D:positions"].to_pylist()[0])
    np.testing.assert_allclose(points, full.landmarks.position_m, rtol=1e-6, atol=1e-6)
    assert {"/world/truth", "/errors/full", "/world/dead-reckoning/path"} <= set(found)
    target.write_text("mine")
    assert main(["plot", str(path), "--viewer", str(target)]) == 2
    assert "--force" in capsys.readouterr().err


def test_positions_sent_to_the_viewer_are_those_of_the_imu(path, monkeypatch):
    rerun, archive = MagicMock(), read_archive(path)
    monkeypatch.setitem(sys.modules, "rerun", rerun)
    viewer.log_archive(archive, MagicMock())
    sent = [call.kwargs["translation"] for call in rerun.Transform3D.columns.call_args_list]
    np.testing.assert_array_equal(sent, [result.T_world_imu[:, :3, 3] for result in archive.results.values()])


def test_ellipsoids_have_the_axes_of_their_covariance():
    rng = np.random.default_rng(3)
    A = rng.normal(size=(20, 3, 3))
    P = A @ np.swapaxes(A, 1, 2)
    axes, turns = viewer.ellipsoids(P)
    R = viewer.Rotation.from_quat(turns).as_matrix()
    again = np.einsum("nij,nj,nkj->nik", R, (axes / 2.0) ** 2, R)
    np.testing.assert_allclose(again, P, rtol=1e-4, atol=1e-4)


def test_without_rerun_one_line_says_what_to_install(path, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(__import__("sys").modules, "rerun", None)
    assert main(["plot", str(path), "--viewer", str(tmp_path / "a.rrd")]) == 2
    assert "pip install 'ekfslam[viewer]'" in capsys.readouterr().err


@pytest.mark.slow
def test_a_gif_shows_the_drive_to_its_end(path, tmp_path, capsys):
    target = tmp_path / "drive.gif"
    assert main(["animate", str(path), "--out", str(target), "--pictures", "5", "--per-second", "10"]) == 0
    with Image.open(target) as picture:
        assert picture.n_frames == 5
        assert picture.info["duration"] == 100
        shown = []
        for k in range(5):
            picture.seek(k)
            shown.append(np.asarray(picture.convert("RGB")).astype(int))
    # The longer it drives, the more is drawn: every picture differs from the one before.
    assert all((a != b).any() for a, b in itertools.pairwise(shown))
    drawn = [(np.abs(picture - [0, 114, 178]).sum(axis=2) < 60).sum() for picture in shown]
    assert drawn[-1] > drawn[0], "the line of the full mode grows"
    assert main(["animate", str(path), "--modes", "smoothed", "--out", str(target)]) == 2
    assert "smoothed" in capsys.readouterr().err


def test_arrows_of_an_animation_have_the_heading_also_without_truth(sequence):
    result = synthetic_result(sequence, "dead-reckoning")
    result = dataclasses.replace(result, covariance=np.zeros_like(result.covariance))
    turned = result.T_world_imu @ se3.exp(np.array([0, 0, 0, 0, 0, np.pi / 2]))
    pictures = []
    for T_world_imu in (result.T_world_imu, turned):
        changed = dataclasses.replace(result, T_world_imu=T_world_imu)
        *_, last = animated({"dead-reckoning": changed}, None, 2)
        pictures.append(np.asarray(last))
    assert (pictures[0] != pictures[1]).any(axis=2).sum() > 100


@pytest.mark.slow
def test_an_mp4_has_its_pictures(path, tmp_path):
    if shutil.which("ffmpeg") is None or shutil.which("ffprobe") is None:
        pytest.skip("ffmpeg is not installed")
    archive, target = read_archive(path), tmp_path / "drive.mp4"
    write_animation(target, archive.results, archive.truth, pictures=7, per_second=10)
    call = ["ffprobe", "-v", "error", "-count_frames", "-show_streams", "-of", "json", str(target)]
    (stream,) = json.loads(subprocess.run(call, capture_output=True, check=True).stdout)["streams"]
    assert (stream["codec_name"], stream["nb_read_frames"], stream["r_frame_rate"]) == ("h264", "7", "10/1")


@pytest.mark.parametrize(
    ("name", "numbers", "words"),
    [
        ("a.avi", {}, "ends in .gif or .mp4"),
        ("a.gif", {"pictures": 1}, "2 to"),
        ("a.gif", {"per_second": 0}, "1 to 60"),
    ],
)
def test_an_animation_that_cannot_be_is_a_named_error(sequence, tmp_path, name, numbers, words):
    with pytest.raises(ConfigError, match=words):
        write_animation(tmp_path / name, {"full": synthetic_result(sequence, "full")}, **numbers)


def test_without_ffmpeg_one_line_says_so(sequence, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ConfigError, match="needs the program ffmpeg"):
        write_animation(tmp_path / "a.mp4", {"full": synthetic_result(sequence, "full")})


@pytest.mark.slow
@pytest.mark.parametrize("format", ["svg", "pdf"])
def test_vector_graphics_are_the_same_each_time(path, tmp_path, format):
    results = {"full": read_archive(path).results["full"]}
    written = []
    for folder in ("a", "b"):
        (file,) = save_all(tmp_path / folder, {"map": plot_map(results)}, format=format)
        assert file.name == f"map.{format}"
        written.append(file.read_bytes())
    assert written[0] == written[1]
    assert (b"landmarks (full" in written[0]) if format == "svg" else written[0].startswith(b"%PDF")


def test_the_side_shows_heights_with_bands_and_landmarks_where_seen_last(sequence):
    result = synthetic_result(sequence, "full")
    (ax,) = plot_side({"full": result}, sequence.truth).axes
    lines = {line.get_label(): line.get_xydata() for line in ax.lines}
    way = distance_along(result.T_world_imu)
    np.testing.assert_allclose(lines["full"], np.column_stack([way, result.T_world_imu[:, 2, 3]]))
    (points,) = (data for name, data in lines.items() if "landmarks" in name)
    landmarks = result.landmarks
    np.testing.assert_allclose(points, np.column_stack([way[landmarks.last_frame], landmarks.position_m[:, 2]]))
    band = ax.collections[0].get_paths()[0].vertices
    half = 3.0 * world_axes_std(result.T_world_imu, result.covariance)[-1, 2]
    z = result.T_world_imu[-1, 2, 3]
    at_end = band[np.isclose(band[:, 0], way[-1])]
    np.testing.assert_allclose([at_end[:, 1].min(), at_end[:, 1].max()], [z - half, z + half])


def test_a_map_of_thousands_has_ellipses_of_some_and_says_so(sequence):
    result = synthetic_result(sequence, "full")
    many = Landmarks.concatenate([result.landmarks] * 40)
    figure = plot_map({"full": dataclasses.replace(result, landmarks=many)})
    ellipses = figure.axes[0].collections[0]
    assert 0 < len(ellipses.get_offsets()) <= 400
    texts = " ".join(text.get_text() for text in figure.legends[0].get_texts())
    assert f"{len(many)} landmarks" in texts
    assert f"{len(many) - len(ellipses.get_offsets())} without ellipse" in texts
    assert "86 % of a Gaussian" in figure.axes[0].get_title()
