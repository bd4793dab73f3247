"""The figure of `ekfslam check`: evidence of the innovations of a run on its covariance."""

from __future__ import annotations

from textwrap import wrap

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ekfslam.arrays import Array, IntArray
from ekfslam.evaluation.evidence import AXES, LAGS, ROWS, Whiteness
from ekfslam.evaluation.honesty import Honesty
from ekfslam.figures import series
from ekfslam.figures.series import PROBABILITY, draw_series
from ekfslam.figures.style import BOUNDS, SERIES, ZERO, arrange, line_of, styled
from ekfslam.filters.result import REASONS, Result

_SIGMAS = 1.96  # of white noise, with `PROBABILITY`
_BINS = 60  # of the time axis, in which rejections are counted


@styled
def plot_check(result: Result, found: Honesty) -> Figure:
    """Draw six panels: NIS, rejections, autocorrelation along tracks and of shared innovations, and these over time."""
    assert found.shared is not None and found.tracks is not None
    figure = Figure(figsize=(11.0, 9.6))
    panels = figure.subplots(3, 2)
    _nis(panels[0, 0], result)
    _rejections(panels[0, 1], result)
    _correlation(panels[1, 0], found.tracks, found.tracks.pairs, ROWS, "along tracks, shared motion removed")
    _correlation(panels[1, 1], found.shared, np.full(LAGS + 1, found.shared.frames), AXES, "of shared innovations")
    shared, time_s = _shared(result)
    for ax, axes, title in zip(panels[2], (range(3), range(3, 6)), ("translation", "rotation"), strict=True):
        _over_time(ax, time_s, shared, axes)
        ax.set_title(f"shared innovation, {title}: mean of {LAGS} frames")
    words = wrap(f"{found.name}: {found.verdict}".replace(" %", "\N{NO-BREAK SPACE}%"), 130)
    figure.suptitle("\n".join(words), fontsize=10)
    arrange(figure, top=0.55 + 0.17 * len(words), gaps=(0.8, 0.8))
    return figure


def _nis(ax: Axes, result: Result) -> None:
    nis, color = series.nis(result), line_of("full")["color"]
    draw_series(ax, nis, color, {"color": color, "marker": ".", "markersize": 2.5, "linestyle": ""}, label="frame")
    ax.set(xlabel=nis.labels[0], title=f"NIS: mean {nis.mean:.2f} (1 expected)")
    ax.margins(x=0.01, y=0.25)
    ax.legend(loc="upper right", ncols=3)


def _rejections(ax: Axes, result: Result) -> None:
    time_s, innovation = result.time_s - result.time_s[0], result.innovation
    edges = np.linspace(0.0, max(time_s[-1], 1e-9), min(_BINS, len(time_s)) + 1)
    total = np.histogram(time_s, edges, weights=innovation.accepted + innovation.rejected)[0]
    present = [code for code in range(len(REASONS)) if (result.rejections.reason == code).any()]
    for code, style in zip(present, SERIES, strict=False):
        at = time_s[result.rejections.frame[result.rejections.reason == code]]
        share = 100.0 * np.histogram(at, edges)[0] / np.maximum(total, 1)
        ax.step((edges[1:] + edges[:-1]) / 2, share, where="mid", **style, label=REASONS[code])
    share = innovation.rejected.sum() / max(total.sum(), 1)
    ax.set(xlabel="time [s]", ylabel="of all observations [%]", title=f"rejections: {100 * share:.2g} %")
    ax.set_ylim(0.0, 1.4 * max(ax.get_ylim()[1], 0.1))
    ax.margins(x=0.01)
    if present:
        ax.legend(loc="upper right")


def _correlation(ax: Axes, found: Whiteness, samples: IntArray, names: tuple[str, ...], title: str) -> None:
    lags, values = np.arange(LAGS + 1), found.correlation
    bound = _SIGMAS / np.sqrt(np.maximum(samples, 1))
    ax.fill_between(lags, -bound, bound, **BOUNDS, label=f"{100 * PROBABILITY:g} % if white")
    ax.axhline(0.0, **ZERO)
    for i in range(values.shape[1]):
        ax.plot(lags[1:], values[1:, i], **SERIES[i], label=names[i])
    ax.set(xlabel="lag [frames]", ylabel="correlation [-]", xticks=lags[::5], title=f"autocorrelation {title}")
    ax.set_ylim(min(-0.3, 1.1 * values[1:].min()), max(0.8, 1.6 * values[1:].max()))
    ax.legend(loc="upper right", ncols=2)


def _shared(result: Result) -> tuple[Array, Array]:
    """Return sums over `LAGS` frames (n, 6) divided by their expected deviation, and the times (n,) of their middle."""
    assert result.whitened is not None
    known = np.isfinite(result.whitened.shared).all(axis=1)
    total = np.cumsum(np.vstack([np.zeros(6), result.whitened.shared[known]]), axis=0)
    sums = (total[LAGS:] - total[:-LAGS]) / np.sqrt(LAGS)
    return sums, (result.time_s - result.time_s[0])[known][LAGS // 2 :][: len(sums)]


def _over_time(ax: Axes, time_s: Array, shared: Array, axes: range) -> None:
    ax.axhspan(-_SIGMAS, _SIGMAS, **BOUNDS, label=f"{100 * PROBABILITY:g} % if white")
    ax.axhline(0.0, **ZERO)
    for a in axes:
        ax.plot(time_s, shared[:, a], **SERIES[a], label=AXES[a])
    limit = max(3.0, 1.1 * float(np.abs(shared).max()))
    ax.set(xlabel="time [s]", ylabel="in expected deviations [-]", ylim=(-limit, 1.25 * limit))
    ax.margins(x=0.01)
    ax.legend(loc="upper right", ncols=4)
