"""The palette: one style for each mode and variant, told apart in colour and in grey, and no other colours anywhere."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image

from ekfslam import config
from ekfslam.figures import style
from ekfslam.figures.study import plot_study_errors
from ekfslam.studies.study import STUDY_VARIANTS

ROOT = Path(__file__).parents[1]


def test_every_mode_and_variant_has_its_own_style():
    assert set(style.MODES) == set(config.MODES)
    assert set(style.VARIANTS) == {*config.VARIANTS, *STUDY_VARIANTS}
    # The full mode is the filter, whose default variant is the invariant one.
    assert style.MODES["full"] == style.VARIANTS["invariant"]
    styles = [*style.MODES.values(), *(s for name, s in style.VARIANTS.items() if name != "invariant")]
    colors = {to_rgb(s["color"]) for s in styles}
    assert len(colors) == len(styles)
    assert to_rgb(style.TRUTH["color"]) not in colors
    # In grey, lines and marks tell apart what one figure shows together.
    for together in (style.MODES, style.VARIANTS):
        assert len({str(s["linestyle"]) for s in together.values()}) == len(together)
        assert len({s["marker"] for s in together.values()}) == len(together)


def test_other_names_have_a_style_too():
    assert style.style_of("as filtered") == style.OTHER
    assert "marker" not in style.line_of("full")
    assert style.marker_of("fej")["linestyle"] == ""


def test_no_other_file_has_colours_of_its_own():
    files = [*(ROOT / "ekfslam" / "figures").glob("*.py"), *(ROOT / "experiments").glob("*.py")]
    assert len(files) > 10
    for path in files:
        if path.name != "style.py":
            found = re.findall(r"#[0-9A-Fa-f]{6}\b", path.read_text(encoding="utf-8"))
            assert not found, f"{path.name}: {found}"


def test_figures_are_drawn_in_this_style_whatever_the_settings_of_the_caller(tmp_path):
    seen = {}

    @style.styled
    def draw() -> Figure:
        seen.update(mpl.rcParams)
        return Figure(figsize=(1.0, 1.0))

    with mpl.rc_context({"font.size": 30.0}):
        figure = draw()
        assert mpl.rcParams["font.size"] == 30.0
    assert {key: seen[key] for key in style.RC} == dict(style.RC)
    (path,) = style.save_all(tmp_path / "new", {"empty": figure})
    assert path == tmp_path / "new" / "empty.png" and path.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("packed", [False, True])
def test_files_keep_the_colour_of_large_areas(tmp_path, packed):
    figure = Figure(figsize=(3.0, 2.0))
    ax = figure.subplots()
    ax.axhspan(0.2, 0.8, **style.BOUNDS)
    for name in style.VARIANTS:
        ax.plot(np.random.default_rng(0).random(50), **style.style_of(name))
    style.save_all(tmp_path, {"a": figure}, packed)
    written = np.asarray(Image.open(tmp_path / "a.png").convert("RGB"))
    grey = np.round(255 * np.array(to_rgb(style.BOUNDS["color"]))).astype(np.uint8)
    assert (written == grey).all(axis=-1).mean() > 0.2


def test_errors_of_a_study_are_x_y_and_yaw_with_their_bounds():
    rng = np.random.default_rng(0)
    values = {"position_error": rng.normal(size=(3, 9, 3)), "rotation_error": rng.normal(size=(3, 9, 3))}
    values["three_sigma"] = rng.uniform(1.0, 2.0, (3, 9, 6))
    study = SimpleNamespace(
        finished=lambda level: {"invariant": values}, time_s=lambda level: np.arange(9.0), done={"low": np.ones(3)}
    )
    drawn = [[line.get_ydata() for line in ax.lines] for ax in plot_study_errors(study, "low").axes]
    turned = np.degrees(values["rotation_error"][..., 2])
    for found, errors in zip(drawn, [*np.moveaxis(values["position_error"][..., :2], -1, 0), turned], strict=True):
        np.testing.assert_allclose(found[:3], errors)
    bounds = np.median(values["three_sigma"][..., [0, 1, 5]], axis=0).T * [[1.0], [1.0], [np.degrees(1.0)]]
    np.testing.assert_allclose([found[-1] for found in drawn], bounds)


def test_axes_above_each_other_share_their_view_and_the_ticks_of_the_lowest():
    upper, lower = Figure().subplots(2, 1)
    upper.plot([0.0, 10.0], [0.0, 1.0])
    lower.plot([2.0, 30.0], [0.0, 1.0])
    style.share_x(upper, lower)
    assert upper.get_xlim() == lower.get_xlim()
    assert lower.get_xlim()[0] < 0.0 and lower.get_xlim()[1] > 30.0
    assert lower.xaxis.get_visible() and not upper.xaxis.get_visible()
    (grid,) = upper.collections
    assert {path.vertices[0, 0] for path in grid.get_paths()} == {0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0}
