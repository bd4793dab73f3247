"""The figure of `ekfslam track`: tracks drawn into frames, and how they ended."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from ekfslam.data.images import Image, ImageRecording, LensCalibration
from ekfslam.data.sequence import Sequence
from ekfslam.figures.style import BAND_ALPHA, BLUE, GREY, SERIES, ZERO, styled
from ekfslam.frontend.rectify import rectification, undistortion
from ekfslam.frontend.track import TrackReport

_SHOWN = 3  # frames
_TRAIL = 8  # frames of the past that are drawn of a track
_COLOURS = "plasma"
_DEPTHS_M = (3.0, 60.0)


@styled
def plot_tracks(recording: ImageRecording, sequence: Sequence, report: TrackReport) -> Figure:
    """Draw left images with tracks, track lengths, losses by reason, and the rotation of a right camera."""
    calibration, is_one = recording.calibration, sequence.camera.is_monocular
    rectified = undistortion(calibration) if isinstance(calibration, LensCalibration) else rectification(calibration)
    frames = np.unique(np.linspace(min(_TRAIL, len(sequence) - 1), len(sequence) - 1, _SHOWN).round().astype(int))
    height, width = rectified.apply(*recording.load(0))[0].shape
    each = 9.0 * height / width + 0.25
    figure = Figure(figsize=(9.0, each * len(frames) + 2.8))
    grid = figure.add_gridspec(len(frames) + 1, 1, height_ratios=[*[each] * len(frames), 2.5])
    panels = []
    for i, frame in enumerate(frames.tolist()):
        panels.append(figure.add_subplot(grid[i]))
        _draw_frame(panels[-1], rectified.apply(*recording.load(frame))[0], sequence, frame)
    if not is_one:
        bar = figure.colorbar(panels[0].collections[-1], ax=panels, label="depth [m]", shrink=0.6, aspect=30, pad=0.01)
        bar.ax.minorticks_off()
        bar.ax.set_yticks([3, 5, 10, 20, 40, 60], labels=["3", "5", "10", "20", "40", "60"])
    widths = (1.0, 1.0) if is_one else (1.0, 1.0, 1.6)
    row = grid[-1].subgridspec(1, len(widths), width_ratios=widths)
    lower = [figure.add_subplot(row[i]) for i in range(len(widths))]
    _lengths(lower[0], report)
    _losses(lower[1], report)
    if not is_one:
        _rotation(lower[2], sequence, report)
    return figure


def _draw_frame(ax: Axes, image: Image, sequence: Sequence, frame: int) -> None:
    """Draw a left image, its features, and their places in earlier frames."""
    observations, camera = sequence.observations, sequence.camera
    ids, pixels = observations.at(frame)
    ax.imshow(image, cmap="gray", vmin=0, vmax=255)
    is_one = camera.is_monocular
    disparity = np.ones(len(pixels)) if is_one else np.maximum(pixels[:, 0] - pixels[:, 2], 1e-3)
    depth = np.full(len(pixels), _DEPTHS_M[0]) if is_one else camera.fu_px * camera.baseline_m / disparity
    before = (observations.frame >= frame - _TRAIL) & (observations.frame <= frame)
    before &= np.isin(observations.landmark, ids)
    trails = [observations.pixels_px[before & (observations.landmark == track), :2] for track in ids]
    norm = LogNorm(*_DEPTHS_M)
    ax.add_collection(LineCollection(trails, array=depth, cmap=_COLOURS, norm=norm, linewidths=1.3))
    ax.scatter(pixels[:, 0], pixels[:, 1], c=depth, cmap=_COLOURS, norm=norm, s=9, linewidths=0)
    ax.set(xlim=(0, image.shape[1] - 1), ylim=(image.shape[0] - 1, 0), xticks=[], yticks=[])
    seconds = sequence.time_s[frame] - sequence.time_s[0]
    ax.set_title(f"frame {frame}, {seconds:.1f} s: {len(ids)} features", loc="left")
    ax.grid(False)


def _lengths(ax: Axes, report: TrackReport) -> None:
    longest = int(report.lengths.max())
    ax.hist(report.lengths, bins=(np.arange(longest + 1) + 0.5).tolist(), color=BLUE)
    ax.set(xlabel="observations of a track", ylabel="tracks", title=f"{report.tracks} tracks", yscale="log")


def _losses(ax: Axes, report: TrackReport) -> None:
    reasons = sorted(report.losses, key=lambda reason: report.losses[reason])
    ax.barh(reasons, [report.losses[reason] for reason in reasons], color=GREY)
    ax.set(xlabel="tracks", title="why tracks ended")


def _rotation(ax: Axes, sequence: Sequence, report: TrackReport) -> None:
    time_s = sequence.time_s - sequence.time_s[0]
    for i, name in enumerate(("pitch", "yaw", "roll")):
        value, std = report.rotation_px[:, i], report.rotation_std_px[:, i]
        ax.plot(time_s, value, **SERIES[i], label=name)
        ax.fill_between(time_s, value - std, value + std, color=SERIES[i]["color"], alpha=BAND_ALPHA, linewidth=0)
    ax.axhline(0.0, **ZERO)
    largest = float(np.abs(report.rotation_px).max()) + 2.0 * float(report.rotation_std_px[-1].max())
    ax.set(xlabel="time [s]", ylabel="rotation x focal length [px]", title="right camera")
    ax.set_ylim(-1.4 * largest, largest)
    ax.legend(ncols=3, loc="lower center")
