"""What stands on the terminal after a run: six rows, one verdict with its next step, and the same words elsewhere."""

import dataclasses
import functools
import itertools

import numpy as np
import pytest

import ekfslam
from ekfslam.cli import main
from ekfslam.cli.modes import joined_modes, modes_of
from ekfslam.data.simulate import builtin
from ekfslam.evaluation.brief import ATE, brief_rows, brief_table, next_step
from ekfslam.evaluation.causes import Cause
from ekfslam.evaluation.honesty import judge
from ekfslam.evaluation.trajectory import absolute_trajectory_error, align_yaw
from ekfslam.figures.run import plot_errors
from ekfslam.figures.sweep import words_of
from ekfslam.page.report import write_report
from ekfslam.storage.archive import read_archive

CITY = "builtin:city?frames=30"
ROWS = ["frames, way", ATE, "std of last position, heading", "observations used", "time"]


@functools.cache
def city():
    return builtin("city?frames=30")


@functools.cache
def compared():
    return ekfslam.compare(city(), ["dead-reckoning", "full", "smoothed"])


def test_a_run_has_five_rows_and_the_file():
    rows = brief_rows(compared().results["full"], city().truth)
    assert list(rows) == ROWS
    assert rows["frames, way"].startswith("30 in 2.9 s, ") and rows["time"].endswith("ms a frame")


def test_without_truth_there_is_no_row_of_errors():
    assert ATE not in brief_rows(compared().results["full"], None)


def test_the_aligned_error_of_an_inertial_unit_keeps_the_vertical():
    room = builtin("room?frames=30")
    result = ekfslam.run(room)
    aligned = absolute_trajectory_error(result.T_world_imu, room.truth.T_world_imu, align=True, by=align_yaw)
    assert brief_rows(result, room.truth)[ATE].endswith(f"({aligned:.3f} m)")


def test_the_standard_deviations_are_those_of_position_and_heading_along_world():
    result = compared().results["full"]
    P = result.position_covariance_world[-1], result.rotation_covariance_world[-1]
    std = f"{np.sqrt(np.trace(P[0])):.3g} m, {np.degrees(np.sqrt(P[1][2, 2])):.3g} deg"
    assert brief_rows(result, None)["std of last position, heading"] == std


def test_used_observations_count_those_of_hygiene_and_of_the_posterior():
    full = compared().results["full"]
    counts = {"dropped by hygiene": 7}
    accepted, rejected = (int(getattr(full.innovation, name).sum()) for name in ("accepted", "rejected"))
    total = accepted + rejected + 7
    said = dataclasses.replace(full, counts=counts).brief["observations used"]
    assert said == f"{100 * accepted / total:.1f} % of {total}"
    assert compared().results["dead-reckoning"].brief["observations used"] == "none"
    smoothed = compared().results["smoothed"].brief["observations used"]
    assert smoothed.startswith(f"all {accepted} of full, ") and smoothed.endswith("less than half their weight")


def test_a_posterior_has_no_count_of_accepted_observations():
    assert compared().summary["modes"]["smoothed"]["accepted"] is None


def test_more_landmarks_than_tracks_are_explained():
    full = compared().results["full"]
    doubled = dataclasses.replace(full, landmarks=ekfslam.filters.result.Landmarks.concatenate([full.landmarks] * 2))
    tracks = len(np.unique(full.landmarks.id))
    assert f"{2 * len(full.landmarks)} of {tracks} tracks: one that comes back or is cut starts another" in repr(
        doubled
    )


def test_the_next_step_is_the_remedy_of_the_first_cause_that_has_one():
    judged = judge(compared().results["full"], truth=city().truth)
    causes = tuple(
        Cause(kind, (), float("nan"), text, remedy)
        for kind, text, remedy in (("tracks", "tracks drift", ""), ("nis", "pixels are noisier", "raise sigma_px"))
    )
    found = dataclasses.replace(judged, causes=causes, findings=())
    assert next_step(found, "a.h5") == "pixels are noisier; raise sigma_px (1 more: ekfslam check a.h5)"
    clean = dataclasses.replace(judged, causes=(), findings=())
    assert next_step(clean, "a.h5") == "ekfslam report a.h5 draws map, errors and consistency"


def test_a_run_prints_its_rows_one_verdict_and_one_next_step(tmp_path, capsys):
    path = tmp_path / "a.h5"
    assert main(["run", CITY, "--out", str(path)]) == 0
    printed = capsys.readouterr().out
    assert printed.splitlines()[-1] == f"written to {path}"
    assert printed.count("verdict: ") == printed.count("next: ") == 1
    assert sum(line.startswith("| ") for line in printed.splitlines()) == 1 + len(ROWS)
    assert "NIS" not in printed.partition("verdict")[0] and "rejected: gate" not in printed


@pytest.mark.slow
def test_verbose_prints_all_figures_of_merit_and_counts(tmp_path, capsys):
    assert main(["run", CITY, "--verbose", "--out", str(tmp_path / "a.h5")]) == 0
    printed = capsys.readouterr().out
    assert "pose NEES (6)" in printed and "full: accepted " in printed and "RPE [m], 10 m" in printed


@pytest.mark.slow
def test_terminal_python_and_page_say_the_same(tmp_path, capsys):
    table = brief_table(city(), compared().results)
    assert table in compared().brief and "verdict: " in compared().brief
    compared().save(tmp_path, figures=False)
    archive = read_archive(tmp_path / "archive.h5")
    page = write_report([tmp_path / "archive.h5"], tmp_path / "a.html").read_text()
    for result in archive.results.values():
        for heading, value in brief_rows(result, archive.truth).items():
            assert f"<dt>{heading}</dt><dd>{value}</dd>" in page


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        (["run", "--mode", "full", "a.h5"], ["run", "--mode", "full", "a.h5"]),
        (["compare", "--modes", "full", "smoothed", "a.h5"], ["compare", "--modes", "full,smoothed", "a.h5"]),
        (["--mode", "full,smoothed", "dead-reckoning"], ["--mode", "full,smoothed,dead-reckoning"]),
        (["full", "--modes"], ["full", "--modes"]),
    ],
)
def test_modes_may_be_apart_by_blanks_or_commas(given, wanted):
    assert joined_modes(given) == wanted


def test_equal_modes_are_one():
    assert modes_of("full, smoothed,full") == ["full", "smoothed"]


@pytest.mark.slow
@pytest.mark.parametrize(("flag", "given"), [("--mode", ["full", "smoothed"]), ("--modes", ["full,smoothed"])])
def test_run_and_compare_take_modes_by_either_flag(tmp_path, flag, given):
    out = tmp_path / "a.h5"
    assert main(["run", flag, *given, CITY, "--out", str(out)]) == 0
    assert list(read_archive(out).results) == ["full", "smoothed"]
    assert main(["compare", flag, *given, CITY, "--no-figures", "--out", str(tmp_path)]) == 0
    assert list(read_archive(tmp_path / "city" / "archive.h5").results) == ["full", "smoothed"]


def test_an_unknown_mode_is_named_with_the_known_ones(capsys):
    with pytest.raises(SystemExit):
        main(["run", "--mode", "full,best", CITY, "--out", "a.h5"])
    assert "unknown mode 'best'; known: dead-reckoning, mapping-only, full, smoothed" in capsys.readouterr().err


def test_columns_of_sweeps_are_words_with_units():
    assert words_of("ate_m") == "ATE [m], unaligned"
    assert words_of("noise.sigma_px") == "noise sigma [px]"
    assert words_of("noise.sigma_w_rad_s") == "noise sigma w [rad/s]"
    assert words_of("variant") == "variant"


@pytest.mark.slow
def test_titles_of_errors_do_not_touch():
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    truth = dataclasses.replace(city().truth, noise=ekfslam.data.truth_noise.TruthNoise(position_m=0.01))
    results = {name: dataclasses.replace(r, mode=name) for name, r in compared().results.items()}
    figure = plot_errors(results, truth)
    FigureCanvasAgg(figure).draw()
    boxes = sorted((ax.title.get_window_extent() for ax in figure.axes if ax.get_title()), key=lambda box: box.x0)
    assert len(boxes) == 3
    assert all(right.x0 - left.x1 > 10 for left, right in itertools.pairwise(boxes))
    assert max(box.y1 for box in boxes) < figure.texts[0].get_window_extent().y0
