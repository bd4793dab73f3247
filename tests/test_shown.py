"""What a user meets first: short reprs, figures and covariances of a result, and modules that nothing hides."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import pkgutil
import subprocess
import sys

import numpy as np
import pytest
from support.same import assert_same

import ekfslam
from ekfslam.config import VARIANTS, Config
from ekfslam.data.images import ImageRecording, PairCalibration, side_by_side
from ekfslam.data.sequence import Truth
from ekfslam.data.simulate import builtin
from ekfslam.data.trajectory import from_left_error
from ekfslam.errors import ShapeError, TruthError
from ekfslam.evaluation.consistency import pose_error
from ekfslam.geometry import se3
from ekfslam.reports import compare
from ekfslam.runner import run
from ekfslam.smoother.posterior import posterior
from ekfslam.storage.archive import read_archive, write_archive
from ekfslam.studies.study import Study, StudyArchive

PAIR = PairCalibration(np.diag([500.0, 500.0, 1.0]), np.diag([500.0, 500.0, 1.0]), (640, 480), side_by_side(0.54))


@pytest.fixture(scope="module")
def world():
    return builtin("city?frames=60")


@pytest.fixture(scope="module")
def compared(world):
    return compare(world, ["dead-reckoning", "full"])


@pytest.fixture(scope="module")
def full(compared):
    return compared.results["full"]


@pytest.mark.slow
def test_everything_shows_itself_in_a_few_lines(world, compared, full, tmp_path):
    write_archive(tmp_path / "a.h5", world, compared.results)
    study = Study(runs=3)
    records = {
        "Sequence": (world, ["city", "60, 5.9 s", "stated", "ekfslam.run(sequence)"]),
        "Result": (full, ["full on city", "60 in 5.9 s", "+-", f"{len(full.landmarks)}", "NIS / dof", ".map()"]),
        "Comparison": (compared, ["dead-reckoning", "full", "ATE (aligned)", "print(comparison.table)"]),
        "Posterior": (posterior(full), ["maximum a posteriori", "60 poses", ".joint_covariance("]),
        "Archive": (read_archive(tmp_path / "a.h5"), ["city", "60 frames", "archive.results["]),
        "Velocities": (world.inputs[0], ["60 velocities (imu frame)", ".twist"]),
        "Trajectory": (
            from_left_error(full.time_s, full.T_world_imu, full.covariance),
            ["60 poses", "0 to 5.8", "of the body", "of every pose"],
        ),
        "ImageRecording": (
            ImageRecording("pair", "here", world.time_s, PAIR, lambda k: (), np.eye(4), world.twist),
            ["60, 5.9 s", "two, 0.54 m apart, 640 x 480 px", "in .twist", "ekfslam.track(recording)"],
        ),
        "Study": (study, ["3 runs", "large-heading", "invariant", "ekfslam.check_consistency(study"]),
        "StudyArchive": (
            StudyArchive(study, {"mid": np.array([True, False, True])}, {}),
            ["not complete", "2 of 3 runs"],
        ),
    }
    for name, (record, parts) in records.items():
        text, html = repr(record), record._repr_html_()
        assert text.startswith(f"{name}: ") and text.count("\n") < 10 and max(map(len, text.splitlines())) < 140
        assert all(part in text for part in parts), text
        assert html.startswith(f"<div><b>{name}</b>") and html.count("<tr>") >= 1


def test_names_from_files_are_no_markup(world):
    named = dataclasses.replace(world, name="<script>alert(1)</script>")
    assert "<script>" not in named._repr_html_() and "&lt;script&gt;" in named._repr_html_()


@pytest.mark.slow
@pytest.mark.parametrize("draw", ["map", "plot", "errors"])
def test_a_result_draws_itself_and_a_notebook_shows_it(world, full, draw):
    figure = getattr(full, draw)(world)
    assert figure._repr_png_().startswith(b"\x89PNG")
    assert full.sequence_name in (figure.get_suptitle() + "".join(ax.get_title() for ax in figure.axes))


def test_the_plot_shows_positions_and_angles_with_their_bands(world, full):
    axes = full.plot(world).axes
    x, roll = axes[0], axes[1]
    (truth, estimate) = (line.get_ydata() for line in x.lines)
    np.testing.assert_allclose(estimate, full.T_world_imu[:, 0, 3])
    np.testing.assert_allclose(truth, world.truth.T_world_imu[:, 0, 3])
    band = x.collections[0].get_datalim(x.transData)
    assert band.ymax >= estimate.max()
    assert roll.get_ylabel() == "roll [deg]" and np.abs(roll.lines[1].get_ydata()).max() < 20.0


def test_errors_without_truth_are_named(world, full):
    bare = dataclasses.replace(world, truth=None)
    with pytest.raises(TruthError, match="errors need true poses"):
        full.errors(bare)
    long = Truth(np.array([0, 200]), np.broadcast_to(np.eye(4), (2, 4, 4)))
    with pytest.raises(TruthError, match="the truth has frame 200, the result has 60 frames"):
        full.errors(long)
    with pytest.raises(TypeError, match="expected a Truth"):
        full.map("city")


@pytest.mark.parametrize("variant", VARIANTS)
def test_covariances_along_world_axes_are_those_of_the_errors(world, variant):
    """Draws of ``xi`` moved into poses: their positions scatter as ``position_covariance_world`` says."""
    result = run(world[:30], "full", Config().with_overrides({"filter": {"variant": variant}}))
    rng, k = np.random.default_rng(0), -1
    xi = 1e-2 * rng.multivariate_normal(np.zeros(6), result.covariance[k], 20_000)
    T = se3.inverse(se3.exp(xi) @ se3.inverse(result.T_world_imu[k]))
    np.testing.assert_allclose(pose_error(result.T_world_imu[k], T), xi, atol=1e-12)
    position = np.cov((T[:, :3, 3] - result.T_world_imu[k, :3, 3]).T) / 1e-4
    rotation = np.cov(se3.so3_log(T[:, :3, :3] @ result.T_world_imu[k, :3, :3].T).T) / 1e-4
    for found, wanted in ((position, result.position_covariance_world), (rotation, result.rotation_covariance_world)):
        std = np.sqrt(np.diag(wanted[k]))
        np.testing.assert_allclose(found / np.outer(std, std), wanted[k] / np.outer(std, std), atol=0.05)
    np.testing.assert_allclose(result.position_std_world_m**2, np.diagonal(result.position_covariance_world, 0, 1, 2))


def test_a_stretch_of_time_is_a_result_of_its_own(world, full, tmp_path):
    begin, end = float(world.time_s[20]), float(world.time_s[45])
    part = full.between(begin, end)
    np.testing.assert_array_equal(part.T_world_imu, full.T_world_imu[20:45])
    np.testing.assert_array_equal(part.innovation.nis, full.innovation.nis[20:45])
    assert len(part.rejections.frame) == full.innovation.rejected[20:45].sum()
    assert part.pairs is None or len(part.pairs) <= len(full.pairs)
    seen = (full.landmarks.first_frame < 45) & (full.landmarks.last_frame >= 20)
    np.testing.assert_array_equal(part.landmarks.id, full.landmarks.id[seen])
    assert part.landmarks.last_frame.max() == 24
    write_archive(tmp_path / "part.h5", world[20:45], {"full": part})
    assert_same(read_archive(tmp_path / "part.h5").results["full"], part)
    assert full.between(-1.0, 1e9).landmarks.id.tolist() == full.landmarks.id.tolist()
    with pytest.raises(ShapeError, match="there are no frames from 100 s to 200 s"):
        full.between(100.0, 200.0)


def test_no_function_hides_a_module_of_its_name():
    packages = ["ekfslam", *(m.name for m in pkgutil.walk_packages(ekfslam.__path__, "ekfslam.") if m.ispkg)]
    assert len(packages) > 10
    for package in map(importlib.import_module, packages):
        for module in pkgutil.iter_modules(package.__path__):
            place = f"{package.__name__}.{module.name}"
            is_public = module.name in getattr(package, "__all__", ())
            found = getattr(package, module.name) if is_public else vars(package).get(module.name, package)
            assert inspect.ismodule(found), f"{place} is hidden"


def test_the_package_is_the_program():
    done = subprocess.run([sys.executable, "-m", "ekfslam", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("ekfslam ")
