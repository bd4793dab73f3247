"""The one palette and style of all figures: a mode or variant has the same colour, line and marker everywhere.

Colours are those of Okabe and Ito, which readers with colour-blindness tell apart, and greys. Line styles and markers
differ as well, so that figures are legible in grey. ``full`` looks like its default variant ``invariant``. An iterated
variant has the lighter shade of its colour. Modes in which the camera never corrects a pose are grey.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import wraps
from io import BytesIO
from pathlib import Path
from typing import Any, Literal, ParamSpec

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from matplotlib.transforms import ScaledTranslation
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from ekfslam import files
from ekfslam.figures.older import MADE_BY
from ekfslam.names import components

DPI = 150

BLACK, DARK_GREY, GREY = "black", "0.35", "0.60"
BLUE, SKY_BLUE = "#0072B2", "#56B4E9"
VERMILLION, ORANGE = "#D55E00", "#E69F00"
GREEN, PURPLE = "#009E73", "#CC79A7"
BROWN = "#8A5A00"

RC: Mapping[Any, Any] = {
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.labelsize": 9.0,
    "legend.fontsize": 8.0,
    "axes.grid": True,
    "grid.color": "0.88",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.framealpha": 0.9,
    "lines.linewidth": 1.4,
    "lines.markersize": 4.5,
    "axes.titley": 1.0,
    "figure.constrained_layout.use": True,
}

Style = Mapping[str, Any]  # keyword arguments of `Axes.plot`


def _style(color: str, linestyle: Any, marker: str) -> Style:
    return {"color": color, "linestyle": linestyle, "marker": marker}


MODES: Mapping[str, Style] = {
    "full": _style(BLUE, "-", "o"),
    "dead-reckoning": _style(DARK_GREY, "--", "^"),
    "mapping-only": _style(GREY, ":", "s"),
    "smoothed": _style(PURPLE, "-.", "D"),
}
VARIANTS: Mapping[str, Style] = {
    "invariant": _style(BLUE, "-", "o"),
    "fej": _style(GREEN, "-.", "s"),
    "standard": _style(VERMILLION, "--", "D"),
    "textbook": _style(BROWN, (0, (6, 2)), "X"),
    "invariant-iterated": _style(SKY_BLUE, (0, (4, 1, 1, 1)), "v"),
    "standard-iterated": _style(ORANGE, ":", "P"),
}
# Other programs, dense references, archives with names of their own.
OTHER: Style = _style(SKY_BLUE, "-.", "v")
_FURTHER = (_style(VERMILLION, (0, (4, 1, 1, 1)), "P"), _style(GREEN, (0, (6, 2)), "X"), _style(ORANGE, ":", "<"))
_TOLD_APART = {"as filtered": OTHER, "given": OTHER}  # and further names in the order in which they are drawn

TRUTH: Style = {"color": BLACK, "linestyle": "-", "linewidth": 2.2}
LANDMARK_COLOR, FIRST_LANDMARK_COLOR = BROWN, SKY_BLUE  # as estimated last, and as initialised

# References for a value: its expected value, zero, and the region that it keeps with some probability.
EXPECTED: Style = {"color": BLACK, "linewidth": 0.8}
ZERO: Style = {"color": "0.5", "linewidth": 0.6}
PRIOR: Style = {"color": "0.3", "linestyle": "--", "linewidth": 0.8}
REFERENCE: Style = {"color": "0.3", "linestyle": "-", "linewidth": 0.8}  # such as a ratio of 1
BOUNDS: Style = {"color": "0.85", "linewidth": 0}
WIDE_BOUNDS: Style = {"color": "0.92", "linewidth": 0}  # around `BOUNDS`
BAND_ALPHA = 0.2  # of the bands of an estimate, in its own colour

# Series of one kind, such as six axes, in this order.
SERIES: tuple[Style, ...] = (
    {"color": BLUE, "linestyle": "-"},
    {"color": VERMILLION, "linestyle": "--"},
    {"color": BLACK, "linestyle": ":"},
    {"color": GREEN, "linestyle": "-."},
    {"color": GREY, "linestyle": (0, (5, 1))},
    {"color": PURPLE, "linestyle": (0, (1, 1))},
)

RUN_COLORS = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY_BLUE)  # of runs whose modes do not tell them apart

P = ParamSpec("P")
Format = Literal["png", "svg", "pdf"]  # of files


def style_of(name: str) -> Style:
    """Return colour, line style and marker of a mode or variant; other names take turns, the first one is `OTHER`."""
    own = MODES.get(name) or VARIANTS.get(name)
    return own or _TOLD_APART.setdefault(name, (OTHER, *_FURTHER)[(len(_TOLD_APART) - 2) % 4])


def line_of(name: str) -> Style:
    """Return `style_of` without the marker, for lines of many points."""
    return {key: value for key, value in style_of(name).items() if key != "marker"}


def marker_of(name: str) -> Style:
    """Return `style_of` without the line, for single points."""
    return {**style_of(name), "linestyle": ""}


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Decorate a function to draw with the settings `RC` in place of the caller's, and names as plain text."""

    @wraps(draw)
    def drawn(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with mpl.rc_context(dict(RC)):
            figure = draw(*args, **kwargs)
        for text in _written(figure):
            text.set_parse_math(False)  # a "$" in a name begins no formula
        figure._repr_png_ = lambda: png(figure)  # type: ignore[attr-defined]  # how notebooks show it without pyplot
        return figure

    return drawn


def _written(figure: Figure) -> list[Text]:
    """Return titles, legends and texts of a figure; the numbers of its axes may be formulas."""
    legends = [*figure.legends, *(ax.get_legend() for ax in figure.axes)]
    in_legends = [text for legend in legends if legend is not None for text in legend.get_texts()]
    return [*figure.texts, *in_legends, *(text for ax in figure.axes for text in (ax.title, *ax.texts))]


def share_x(*column: Axes) -> None:
    """Give axes above each other the view of all along x; only the lowest has ticks, which are slow to draw."""
    *upper, lowest = column
    views = [ax.get_xlim() for ax in column]
    lowest.set_xlim(min(low for low, _ in views), max(high for _, high in views))
    low, high = lowest.get_xlim()
    lines = [((x, 0.0), (x, 1.0)) for x in lowest.get_xticks() if low <= x <= high]
    look = {"colors": RC["grid.color"], "linewidths": RC["grid.linewidth"], "zorder": 0.5}
    for ax in upper:
        ax.set(xlim=(low, high), xlabel="")
        ax.xaxis.set_visible(False)
        ax.add_collection(LineCollection(lines, transform=ax.get_xaxis_transform(), **look), autolim=False)


def legend_of(
    figure: Figure, axes: Iterable[Axes], columns: int, title: str | None = None, extra: Iterable[Line2D] = ()
) -> float:
    """Add a legend of several axes below them, one entry for equal labels, and return its height in inches."""
    found = [ax.get_legend_handles_labels() for ax in axes]
    handles = {label: handle for pair in found for handle, label in zip(*pair, strict=True)}
    shown = [*handles.values(), *extra]
    legend = figure.legend(handles=shown, loc="outside lower center", ncols=columns, title=title)
    for handle in legend.legend_handles:
        if isinstance(handle, Line2D) and handle.get_marker() == ".":
            handle.set_markersize(8.0)  # dots small enough for a map of thousands are invisible in a legend
    lines = -(-len(shown) // columns) + (title is not None)
    return 0.2 + 1.5 * RC["legend.fontsize"] / 72.0 * lines


def arrange(
    figure: Figure,
    left: float = 0.7,
    right: float = 0.15,
    bottom: float = 0.45,
    top: float = 0.3,
    gaps: tuple[float, float] = (0.7, 0.3),
) -> None:
    """Place a grid of axes at fixed margins and gaps (inches), and their labels: constrained layout is slow."""
    figure.set_layout_engine("none")
    size = figure.get_size_inches()
    for ax in figure.axes:
        place = ax.get_subplotspec()
        assert place is not None
        counts = np.array(place.get_gridspec().get_geometry()[::-1])
        each = (size - [left + right, bottom + top] - (counts - 1) * gaps) / counts
        corner = [left, bottom] + (each + gaps) * [place.colspan.start, counts[1] - place.rowspan.stop]
        ax.set_position((*(corner / size), *(each / size)))
        for axis, at, off in ((ax.xaxis, (0.5, 0.0), (0.0, -0.28)), (ax.yaxis, (0.0, 0.5), (0.2 - left, 0.0))):
            axis.set_label_coords(*at, ax.transAxes + ScaledTranslation(*off, figure.dpi_scale_trans))


def log_axis(ax: Axes, ticks: tuple[float, ...]) -> None:
    """Make the y axis logarithmic, with plain numbers at ``ticks`` times the powers of ten."""
    ax.set_yscale("log")
    ax.yaxis.set_major_locator(LogLocator(subs=ticks, numticks=20))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.yaxis.set_minor_formatter(NullFormatter())


def png(figure: Figure, packed: bool = False, dpi: int = DPI) -> bytes:
    """Return a figure as a PNG; ``packed`` (256 colours): a third of the size, twice the time."""
    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    content, made_by = BytesIO(), PngInfo()
    made_by.add_text("Software", MADE_BY)
    picture = Image.fromarray(np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3]))
    if packed:
        # The default median cut sacrifices rare colours, here a thin trajectory; this keeps all within 20 of 255.
        # Means (kmeans) then give large areas their exact colour: the grey of bounds must not turn blue.
        picture = picture.quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=1)
    # Level 3 takes two thirds of the time of the default, for files of the same size.
    picture.save(content, "PNG", dpi=(dpi, dpi), optimize=packed, compress_level=3, pnginfo=made_by)
    return content.getvalue()


def vector(figure: Figure, format: Literal["svg", "pdf"]) -> bytes:
    """Return a figure as lines and text, the same bytes each time."""
    content = BytesIO()
    named = {"Creator": MADE_BY, "Date" if format == "svg" else "CreationDate": None}
    with mpl.rc_context({**RC, "svg.fonttype": "none", "svg.hashsalt": MADE_BY, "pdf.fonttype": 42}):
        figure.savefig(content, format=format, metadata=named)
    return content.getvalue()


def pngs(
    directory: str | Path, figures: Mapping[str, Figure], packed: bool = False, format: Format = "png", dpi: int = DPI
) -> dict[Path, str | bytes]:
    """Return figures as files ``<name>.<format>`` of a folder, for `ekfslam.files.write_all`."""
    paths = [Path(directory) / f"{name}.{format}" for name in components(figures)]
    drawn = (png(figure, packed, dpi) if format == "png" else vector(figure, format) for figure in figures.values())
    return dict(zip(paths, drawn, strict=True))


def save_all(
    directory: str | Path, figures: Mapping[str, Figure], packed: bool = False, format: Format = "png"
) -> list[Path]:
    """Write the files of `pngs` into a folder, made if missing; return their paths."""
    contents = pngs(directory, figures, packed, format)
    files.write_all(contents)
    return list(contents)
