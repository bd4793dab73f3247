"""A drive in motion: trajectories grow, landmarks appear when they are first seen, as gif or mp4."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Iterable, Iterator, Mapping
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image

from ekfslam import files
from ekfslam.arrays import IntArray
from ekfslam.data.sequence import Truth
from ekfslam.errors import ConfigError
from ekfslam.figures.maps import SIGMAS, dot_size, ellipse_axes, map_axes, map_of, spread
from ekfslam.figures.style import LANDMARK_COLOR, TRUTH, line_of, style_of, styled
from ekfslam.filters.result import Result
from ekfslam.geometry.motion import world_axes_covariance
from ekfslam.progress import progress

FORMATS = (".gif", ".mp4")
MOST_PICTURES = 2000
_DPI = 100
_CODEC = ("-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "23", "-movflags", "+faststart")


def write_animation(
    path: str | Path,
    results: Mapping[str, Result],
    truth: Truth | None = None,
    *,
    pictures: int = 200,
    per_second: int = 20,
) -> None:
    """Write a drive as a moving map from above.

    A landmark appears in the frame of its first observation, at its last estimate: archives hold no earlier ones.

    Args:
        path: Ends in ``.gif``, or in ``.mp4``, for which the program ffmpeg is needed.
        results: Mode to result.
        truth: Known poses.
        pictures: How many, at most; they are spread over the drive.
        per_second: How fast they follow each other.

    Raises:
        ConfigError: Another ending, a number out of range, or ffmpeg is missing or fails.
        WriteError: The file cannot be written.
    """
    path = Path(path)
    if path.suffix not in FORMATS:
        raise ConfigError(f"{path}: an animation ends in {' or '.join(FORMATS)}")
    if not (2 <= pictures <= MOST_PICTURES and 1 <= per_second <= 60):
        raise ConfigError(f"an animation has 2 to {MOST_PICTURES} pictures, 1 to 60 a second")
    if path.suffix == ".mp4" and shutil.which("ffmpeg") is None:
        raise ConfigError(f"{path}: mp4 needs the program ffmpeg, which is not installed; gif does not")
    files.require_writable(path)
    drawn = progress(animated(results, truth, pictures), "animate", "picture", total=pictures)
    files.write_all({path: (_mp4 if path.suffix == ".mp4" else _gif)(drawn, per_second)})


def animated(results: Mapping[str, Result], truth: Truth | None, pictures: int) -> Iterator[Image.Image]:
    """Yield at most so many pictures of a drive, the last of its last frame."""
    frames = len(next(iter(results.values())).time_s)
    figure, update = _moving_map(results, truth)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # places everything that does not move
    still = canvas.copy_from_bbox(figure.bbox)
    for k in spread(frames, pictures):
        canvas.restore_region(still)
        for artist in update(int(k)):
            figure.draw_artist(artist)
        yield Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")


def _moving_map(results: Mapping[str, Result], truth: Truth | None) -> tuple[Figure, Callable[[int], Iterable[Artist]]]:
    """Return a map without its moving parts, and a function that updates these to a frame."""
    parts: list[Callable[[int], Iterable[Artist]]] = []

    @styled
    def draw() -> Figure:
        paths = [result.T_world_imu[:, :2, 3] for result in results.values()]
        if truth is not None and len(truth.frame):
            paths.append(truth.T_world_imu[:, :2, 3])
        mapper = map_of(results)
        ax, _ = map_axes(np.concatenate(paths), mapper.landmarks.position_m[:, :2])
        figure = ax.get_figure()
        assert isinstance(figure, Figure)
        figure.set_dpi(_DPI)
        parts.append(_landmarks(ax, mapper))
        if truth is not None and len(truth.frame):
            ax.plot(*truth.T_world_imu[:, :2, 3].T, **TRUTH, alpha=0.35, label="truth")
        parts.extend(_vehicle(ax, mode, result) for mode, result in results.items())
        parts.append(_clock(ax, mapper))
        legend = figure.legend(loc="outside lower center", ncols=3)
        for handle in legend.legend_handles:
            if isinstance(handle, Line2D) and handle.get_marker() == ".":
                handle.set_markersize(8.0)
        ax.set_title(f"{mapper.sequence_name}: {SIGMAS:g}-sigma ellipses")
        return figure

    figure = draw()
    return figure, lambda k: [artist for part in parts for artist in part(k)]


def _landmarks(ax: Axes, mapper: Result) -> Callable[[int], Iterable[Artist]]:
    """Return the updates of landmarks: dots of all seen so far, ellipses of all in view."""
    landmarks = mapper.landmarks
    points = landmarks.position_m[:, :2]
    (dots,) = ax.plot([], [], ".", color=LANDMARK_COLOR, markersize=1.5 * dot_size(len(points)), markeredgewidth=0)
    dots.set(animated=True, label=f"landmarks of {mapper.mode}", alpha=0.6)
    long, short, angle = ellipse_axes(landmarks.covariance[:, :2, :2], SIGMAS)
    fits = long < 0.1 * np.hypot(np.ptp(ax.get_xlim()), np.ptp(ax.get_ylim()))

    def update(k: int) -> Iterable[Artist]:
        seen = landmarks.first_frame <= k
        dots.set_data(*points[seen].T)
        now = np.flatnonzero(seen & (landmarks.last_frame >= k) & fits)
        return dots, _ellipses(ax, now, points, long, short, angle, LANDMARK_COLOR)

    return update


def _vehicle(ax: Axes, mode: str, result: Result) -> Callable[[int], Iterable[Artist]]:
    """Return the updates of a run: path so far, position with ellipse, and heading."""
    xy, forward, color = result.T_world_imu[:, :2, 3], result.T_world_imu[:, :2, 0], style_of(mode)["color"]
    (line,) = ax.plot([], [], **line_of(mode), label=mode, animated=True)
    arrow = ax.quiver(*xy[0], *forward[0], color=color, angles="xy", scale=18, width=0.006, zorder=5, animated=True)
    axes = ellipse_axes(world_axes_covariance(result.T_world_imu, result.covariance)[0][:, :2, :2], SIGMAS)

    def update(k: int) -> Iterable[Artist]:
        line.set_data(*xy[: k + 1].T)
        arrow.set_offsets(xy[k])
        arrow.set_UVC(*forward[k])
        return line, _ellipses(ax, np.array([k]), xy, *axes, color), arrow

    return update


def _ellipses(
    ax: Axes, rows: IntArray, centres: Any, long: Any, short: Any, angle: Any, color: str
) -> EllipseCollection:
    """Return ellipses of some rows that are ready to be drawn on axes, but not added to them."""
    found = EllipseCollection(
        long[rows],
        short[rows],
        angle[rows],
        units="xy",
        offsets=centres[rows],
        offset_transform=ax.transData,
        facecolors="none",
        edgecolors=color,
        linewidths=0.8,
    )
    figure = ax.get_figure()
    assert figure is not None
    found.axes = ax
    found.set_figure(figure)
    found.set_clip_box(ax.bbox)
    return found


def _clock(ax: Axes, result: Result) -> Callable[[int], Iterable[Artist]]:
    text = ax.text(0.015, 0.985, "", transform=ax.transAxes, va="top", animated=True)

    def update(k: int) -> Iterable[Artist]:
        text.set_text(f"{result.time_s[k] - result.time_s[0]:.1f} s")
        return (text,)

    return update


def _gif(pictures: Iterable[Image.Image], per_second: int) -> bytes:
    """Return a gif with the palette of its last picture, which has every colour."""
    drawn = list(pictures)
    palette = drawn[-1].quantize(64, Image.Quantize.MAXCOVERAGE)
    first, *others = (picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in drawn)
    packed = BytesIO()
    first.save(packed, "GIF", save_all=True, append_images=others, duration=round(1000 / per_second), loop=0)
    return packed.getvalue()


def _mp4(pictures: Iterable[Image.Image], per_second: int) -> bytes:
    """Return an mp4 made by ffmpeg; pictures are piped to it as they are drawn."""
    with TemporaryDirectory() as folder:
        target = Path(folder) / "drive.mp4"
        iterator = iter(pictures)
        first = next(iterator)
        width, height = (size - size % 2 for size in first.size)  # H.264 wants even sizes
        source = ("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(per_second), "-i", "-")
        call = ["ffmpeg", "-y", "-loglevel", "error", *source, *_CODEC, str(target)]
        with (Path(folder) / "errors").open("w+b") as errors:
            process = subprocess.Popen(call, stdin=subprocess.PIPE, stderr=errors)
            assert process.stdin is not None
            try:
                process.stdin.write(first.crop((0, 0, width, height)).tobytes())
                for picture in iterator:
                    process.stdin.write(picture.crop((0, 0, width, height)).tobytes())
                process.stdin.close()
            except BrokenPipeError:
                pass  # what ffmpeg says is told below
            if process.wait() != 0 or not target.exists():
                errors.seek(0)
                said = " ".join(errors.read(2000).decode(errors="replace").split())
                raise ConfigError(f"ffmpeg makes no mp4: {said or 'no reason given'}")
        return target.read_bytes()
