"""Figures: geometry of ellipses, mapping of covariances into world, labels and units, files."""

from __future__ import annotations

import dataclasses
import re

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from support.helpers import synthetic_result, synthetic_sequence
from support.running import WHOLE

from ekfslam.cli import main
from ekfslam.figures import series
from ekfslam.figures.maps import ellipse_axes, plot_landmark_arrows, plot_map
from ekfslam.figures.paper import WIDTHS, draw_paper, width_of
from ekfslam.figures.run import draw_figures, plot_errors, plot_nis, plot_parameters, save_figures
from ekfslam.figures.views import plot_trajectory
from ekfslam.filters.result import Parameters, Result
from ekfslam.geometry import se3
from ekfslam.geometry.motion import world_axes_covariance
from ekfslam.storage.archive import write_archive

MODES = ("dead-reckoning", "mapping-only", "full")


@pytest.fixture(scope="module")
def sequence():
    return synthetic_sequence(frames=60, landmarks=80)


@pytest.fixture(scope="module")
def results(sequence) -> dict[str, Result]:
    return {mode: synthetic_result(sequence, mode) for mode in MODES}


def legend_texts(figure: Figure) -> str:
    return " | ".join(text.get_text() for legend in figure.legends for text in legend.get_texts())


def test_ellipse_outline_has_the_stated_mahalanobis_distance():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(50, 2, 2))
    P = A @ np.swapaxes(A, 1, 2) + 1e-3 * np.eye(2)
    long, short, angle = ellipse_axes(P, sigmas=2.0)
    assert (long >= short).all()
    for phase in np.linspace(0, 2 * np.pi, 7):
        x, y = 0.5 * long * np.cos(phase), 0.5 * short * np.sin(phase)
        c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        e = np.stack([c * x - s * y, s * x + c * y], axis=-1)
        distance = np.einsum("ni,nij,nj->n", e, np.linalg.inv(P), e)
        np.testing.assert_allclose(distance, 4.0, rtol=1e-9)


def test_ellipse_of_a_diagonal_covariance_lies_along_the_axes():
    long, short, angle = ellipse_axes(np.diag([1.0, 9.0]), sigmas=2.0)
    assert (long, short) == (pytest.approx(12.0), pytest.approx(4.0))
    assert abs(angle) == pytest.approx(90.0)


def test_covariance_along_world_axes_is_that_of_sampled_errors(results):
    result = results["full"]
    k, rng = 50, np.random.default_rng(1)
    P = 1e-4 * result.covariance[k]
    R = np.linalg.cholesky(P)
    T_imu_world = se3.inverse(result.T_world_imu[k])
    T_world_imu = se3.inverse(se3.exp((R @ rng.standard_normal((40_000, 6, 1)))[..., 0]) @ T_imu_world)
    position = T_world_imu[:, :3, 3] - result.T_world_imu[k, :3, 3]
    rotation = se3.so3_log(T_world_imu[:, :3, :3] @ result.T_world_imu[k, :3, :3].T)
    for sampled, covariance in zip(
        (position, rotation), world_axes_covariance(result.T_world_imu, result.covariance), strict=True
    ):
        expected = 1e-4 * covariance[k]
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        np.testing.assert_allclose(np.cov(sampled.T) / scale, expected / scale, atol=0.03)


@pytest.mark.parametrize("kind", ["map", "landmarks"])
def test_views_from_above_have_equal_aspect_and_metres_on_their_axes(sequence, results, kind):
    figure = {
        "map": lambda: plot_map(results, sequence.truth),
        "landmarks": lambda: plot_landmark_arrows(results["full"], sequence.truth),
    }[kind]()
    (ax,) = figure.axes
    assert ax.get_aspect() == 1.0
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x [m]", "y [m]")
    assert "truth" in legend_texts(figure)
    assert "winding road" in ax.get_title()


def test_map_shows_every_mode_in_its_own_style_and_an_ellipse_for_what_fits(sequence, results):
    figure = plot_map(results, sequence.truth)
    (ax,) = figure.axes
    styles = {
        (line.get_color(), line.get_linestyle(), line.get_marker())
        for line in ax.lines
        if line.get_label() in (*MODES, "truth")
    }
    assert len(styles) == 4
    assert len({style[0] for style in styles}) == 4
    assert len({style[2] for style in styles}) == 4
    ellipses = [c for c in ax.collections if isinstance(c, EllipseCollection)]
    assert len(ellipses) == 1 + len(MODES)
    landmarks = results["full"].landmarks
    expected, _, _ = ellipse_axes(landmarks.covariance[:, :2, :2], 2.0)
    drawn = expected <= 0.1 * np.hypot(np.ptp(ax.get_xlim()), np.ptp(ax.get_ylim()))
    assert drawn.mean() > 0.8
    np.testing.assert_array_equal(ellipses[0].get_offsets(), landmarks.position_m[drawn, :2])
    np.testing.assert_allclose(ellipses[0].get_widths(), expected[drawn])
    assert (f"{(~drawn).sum()} without ellipse" in legend_texts(figure)) == (~drawn).any()


def test_map_works_without_truth_and_without_landmarks(results):
    figure = plot_map({"dead-reckoning": results["dead-reckoning"]})
    assert "truth" not in legend_texts(figure)
    assert "landmarks" not in legend_texts(figure)


@pytest.mark.parametrize("draw", ["map", "landmarks"])
def test_far_outliers_do_not_decide_the_view_but_are_counted(results, draw):
    full = results["full"]
    position = full.landmarks.position_m.copy()
    position[0] = [1e6, -1e6, 0]
    result = dataclasses.replace(full, landmarks=dataclasses.replace(full.landmarks, position_m=position))
    figure = plot_map({"full": result}) if draw == "map" else plot_landmark_arrows(result)
    low, high = figure.axes[0].get_xlim()
    path = full.T_world_imu[:, 0, 3]
    assert low < path.min() < path.max() < high
    assert high - low < 500
    (x_low, x_high), (y_low, y_high) = figure.axes[0].get_xlim(), figure.axes[0].get_ylim()
    x, y = position[:, :2].T
    outside = int(((x < x_low) | (x > x_high) | (y < y_low) | (y > y_high)).sum())
    assert outside >= 1
    assert f"{outside} outside the view" in legend_texts(figure)


def test_a_vehicle_that_stands_still_can_be_drawn(results):
    full = results["full"]
    still = dataclasses.replace(full, T_world_imu=np.tile(np.eye(4), (len(full.time_s), 1, 1)))
    plot_map({"full": still}).canvas.draw()


def test_arrows_lead_from_first_to_final_estimate(results):
    landmarks = results["full"].landmarks
    (ax,) = plot_landmark_arrows(results["full"]).axes
    (lines,) = (c for c in ax.collections if isinstance(c, LineCollection))
    segments = {tuple(np.ravel(segment)) for segment in lines.get_segments()}
    ends = np.hstack([landmarks.initial_position_m[:, :2], landmarks.position_m[:, :2]])
    assert segments <= {tuple(row) for row in ends}
    assert len(segments) > 0.8 * len(landmarks)


def test_errors_have_a_row_an_axis_and_a_column_a_trajectory(sequence, results):
    figure = plot_errors(results, sequence.truth)
    axes = np.array(figure.axes).reshape(6, 2)
    assert [ax.get_ylabel() for ax in axes[:, 0]] == [
        *(f"position {axis} [m]" for axis in "xyz"),
        *(f"rotation {axis} [deg]" for axis in "xyz"),
    ]
    assert axes[-1, 0].get_xlabel() == "time [s]"
    assert axes[0, 0].get_title().startswith("dead-reckoning, mapping-only"), "the two share their trajectory"
    assert axes[0, 1].get_title().startswith("full")


def test_errors_are_drawn_with_their_bounds(sequence, results):
    figure = plot_errors({"full": results["full"]}, sequence.truth)
    for ax, error in zip(figure.axes, series.errors(results["full"], sequence.truth), strict=True):
        band, *_ = ax.collections
        vertices = band.get_paths()[0].vertices
        assert [vertices[:, 1].min(), vertices[:, 1].max()] == pytest.approx([error.low.min(), error.high.max()])
        np.testing.assert_array_equal(ax.lines[-1].get_ydata(), error.y)


def test_errors_are_estimate_minus_truth_within_three_sigma_in_world(sequence, results):
    full = results["full"]
    errors = series.errors(full, sequence.truth)
    position_covariance, rotation_covariance = world_axes_covariance(full.T_world_imu, full.covariance)
    y, yaw = errors[1], errors[5]
    np.testing.assert_allclose(y.high, 3 * np.sqrt(position_covariance[:, 1, 1]), rtol=1e-12)
    np.testing.assert_allclose(y.low, -y.high)
    np.testing.assert_allclose(y.y, full.T_world_imu[:, 1, 3] - sequence.truth.T_world_imu[:, 1, 3], atol=1e-12)
    np.testing.assert_allclose(yaw.high, np.degrees(3 * np.sqrt(rotation_covariance[:, 2, 2])), rtol=1e-12)
    # The vehicle turns about z alone, so the heading error is the rotation error about z to first order.
    heading = [np.arctan2(T[:, 1, 0], T[:, 0, 0]) for T in (full.T_world_imu, sequence.truth.T_world_imu)]
    np.testing.assert_allclose(yaw.y, np.degrees(heading[0] - heading[1]), atol=2e-3)


def test_errors_take_truth_of_some_frames(sequence, results):
    truth = dataclasses.replace(
        sequence.truth, frame=sequence.truth.frame[::7], T_world_imu=sequence.truth.T_world_imu[::7]
    )
    ax = plot_errors({"full": results["full"]}, truth).axes[0]
    np.testing.assert_allclose(ax.lines[-1].get_xdata(), sequence.time_s[::7])


@pytest.mark.slow
def test_nis_says_how_many_frames_are_inside_their_bounds(results):
    figure = plot_nis(results)
    assert len(figure.axes) == 2, "dead reckoning has no innovation"
    assert figure.axes[0].get_ylabel() == "NIS per dof [-]"
    assert figure.axes[-1].get_xlabel() == "time [s]"
    title = figure.axes[1].get_title()
    assert title.startswith("full: ")
    share = float(title.split()[1])
    assert 85 < share <= 100
    innovation = results["full"].innovation
    overconfident = dataclasses.replace(
        results["full"], innovation=dataclasses.replace(innovation, nis=9 * innovation.nis)
    )
    assert float(plot_nis({"full": overconfident}).axes[0].get_title().split()[1]) < 5
    with pytest.raises(ValueError, match="no mode"):
        plot_nis({"dead-reckoning": results["dead-reckoning"]})


@pytest.mark.slow
def test_files_are_written_and_small(sequence, results, tmp_path):
    paths = save_figures(tmp_path / "new" / "folder", results, sequence.truth)
    names = {"map", "side", "errors", "nis", "landmarks_mapping-only", "landmarks_full"}
    assert {path.name for path in paths} == {f"{name}.png" for name in names}
    for path in paths:
        assert path.read_bytes().startswith(b"\x89PNG")
        assert 5_000 < path.stat().st_size < 400_000, path.name


@pytest.mark.slow
def test_only_figures_with_content_are_written(results, tmp_path):
    paths = save_figures(tmp_path, {"dead-reckoning": results["dead-reckoning"]})
    assert [path.name for path in paths] == ["map.png", "side.png"]


def boxes(figure: Figure) -> list[tuple[str, np.ndarray]]:
    """Return the texts of a figure with their corners (2, 2) in pixels; tick labels and legends as a whole each."""
    FigureCanvasAgg(figure).draw()
    texts = [*figure.texts, *(text for ax in figure.axes for text in (ax.title, ax.xaxis.label, ax.yaxis.label))]
    found = [(text.get_text(), text.get_window_extent()) for text in texts if text.get_text()]
    found += [("legend", legend.get_window_extent()) for legend in figure.legends]
    for axis in (axis for ax in figure.axes for axis in (ax.xaxis, ax.yaxis)):
        low, high = sorted(axis.get_view_interval())
        inside = [tick.label1 for tick in axis.get_major_ticks() if low <= tick.get_loc() <= high]
        shown = [label.get_window_extent() for label in inside if label.get_visible()]
        found += [("numbers of an axis", Bbox.union(shown))] if shown else []
    return [(text, box.get_points()) for text, box in found]


@pytest.mark.parametrize("modes", [MODES, ("full",)])
@pytest.mark.parametrize("scale", [1.0, 1e-4])
def test_no_text_is_cut_or_lies_on_another(sequence, results, modes, scale):
    value = np.tile(np.linspace(-scale, scale, len(sequence))[:, None], 7)
    names = tuple(f"bias of v_{i}" for i in range(7))
    parameters = Parameters(names, ("rad/s",) * 7, np.full(7, scale), value, np.abs(value))
    named = "2011_09_26_drive_0001_sync_KLT"
    runs = {mode: dataclasses.replace(results[mode], sequence_name=named) for mode in modes}
    runs["full"] = dataclasses.replace(runs["full"], parameters=parameters)
    drawn = draw_figures(runs, sequence.truth) | {"trajectory": plot_trajectory(runs["full"], sequence.truth)}
    assert {"map", "side", "errors", "nis", "parameters", "landmarks_full"} <= set(drawn)
    require_legible(drawn)


def require_legible(drawn: dict[str, Figure]) -> None:
    """Fail if a text of a figure is cut or lies on another."""
    for name, figure in drawn.items():
        all_of_it = figure.get_size_inches() * figure.dpi
        found = boxes(figure)
        for i, (text, (low, high)) in enumerate(found):
            assert (low > -1.0).all() and (high < all_of_it + 1.0).all(), f"{name}: {text!r} is cut"
            for other, (begin, end) in found[:i]:
                assert not ((low < end) & (begin < high)).all(), f"{name}: {text!r} lies on {other!r}"


@pytest.mark.slow
@pytest.mark.parametrize("width", ["column", "page"] if WHOLE else ["column"])
def test_figures_of_papers_have_their_width_and_letters_of_eight_points(sequence, results, width):
    drawn = {name: one.figure for name, one in draw_paper(results, sequence.truth, None, width_of(width)).items()}
    assert {"map", "side", "errors", "errors_full", "nees", "nis"} <= drawn.keys()
    require_legible(drawn)
    for figure in drawn.values():
        assert figure.get_figwidth() == WIDTHS[width]
        assert {text.get_fontsize() for text in figure.findobj(Text) if text.get_text()} == {8.0}
        assert not [text for text in (figure.get_suptitle(), *(ax.get_title() for ax in figure.axes)) if text]


def test_figures_of_papers_tell_estimators_apart_in_grey(sequence, results):
    (upper, _) = draw_paper(results, sequence.truth, None, 3.5)["errors"].figure.axes
    looks = [(line.get_marker(), line.get_linestyle()) for line in upper.lines]
    assert len(set(looks)) == len(looks) > 1


@pytest.mark.slow
def test_plot_writes_figures_of_papers_with_captions_as_pdf(sequence, results, tmp_path, capsys):
    write_archive(tmp_path / "a.h5", sequence, {"full": results["full"]})
    arguments = ["plot", str(tmp_path / "a.h5"), "--format", "pdf", "--width"]
    assert main([*arguments, "3.25"]) == 0
    names = {path.name for path in tmp_path.glob("*.pdf")}
    assert {"map.pdf", "errors_full.pdf", "nees.pdf"} <= names
    assert re.search(rb"/MediaBox \[ 0 0 234 ", (tmp_path / "map.pdf").read_bytes())
    captions = (tmp_path / "captions.md").read_text()
    assert "**nees**: Pose NEES on" in captions and "6 expected" in captions
    with pytest.raises(SystemExit):
        main([*arguments, "wide"])
    assert "a width of figures is column, page, or 2.5 to 20 inches" in capsys.readouterr().err


def test_drawing_leaves_no_global_state_behind(sequence, results):
    before = dict(mpl.rcParams)
    plot_map(results, sequence.truth)
    assert dict(mpl.rcParams) == before
    assert plt.get_fignums() == []


@pytest.mark.slow
def test_parameters_have_a_panel_each_with_units_and_what_was_not_observed(results, tmp_path):
    frames = len(results["full"].time_s)
    value = np.linspace(0, 1, 2 * frames).reshape(frames, 2)
    std = np.column_stack([np.linspace(0.5, 0.01, frames), np.full(frames, 0.5)])
    parameters = Parameters(("roll", "time offset"), ("rad", "s"), np.full(2, 0.5), value, std)
    found = dataclasses.replace(results["full"], parameters=parameters)
    figure = plot_parameters(found)
    roll, time = figure.axes
    assert (roll.get_title(), roll.get_ylabel()) == ("roll", "[deg]")
    assert (time.get_title(), time.get_ylabel()) == ("time offset (not observable)", "[s]")
    assert "s]" in time.get_xlabel()
    np.testing.assert_allclose(roll.lines[-1].get_ydata(), np.rad2deg(value[:, 0]))
    top = time.collections[0].get_paths()[0].vertices[:, 1].max()
    assert top == pytest.approx(value[-1, 1] + 1.5)
    assert tmp_path / "parameters.png" in save_figures(tmp_path, {"full": found})
    with pytest.raises(ValueError, match="no parameters"):
        plot_parameters(results["full"])


@pytest.mark.parametrize("yaw_deg", [30, 179])
def test_truth_is_drawn_beside_the_estimate(sequence, results, yaw_deg):
    """A yaw of 179 degrees and one of -179 are two degrees apart."""

    def turned(T_world_imu, degrees):
        return se3.exp(np.array([0, 0, 0, 0, 0, np.radians(degrees)])) @ T_world_imu

    first = np.degrees(np.arctan2(*sequence.truth.T_world_imu[0, 1::-1, 0]))
    result = dataclasses.replace(results["full"], T_world_imu=turned(sequence.truth.T_world_imu, yaw_deg - first))
    truth = dataclasses.replace(sequence.truth, T_world_imu=turned(sequence.truth.T_world_imu, yaw_deg + 2 - first))
    yaw = next(ax for ax in plot_trajectory(result, truth).axes if ax.get_ylabel().startswith("yaw"))
    true, estimate = (line.get_ydata() for line in yaw.lines)
    np.testing.assert_allclose(true - estimate, 2.0, atol=1e-6)
