"""A drive in motion: trajectories grow, landmarks appear when they are first seen, as gif or mp4."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from io import BytesIO
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from ekfslam import files
from ekfslam.arrays import Array, IntArray
from ekfslam.data.sequence import Truth
from ekfslam.errors import ConfigError
from ekfslam.figures import maps
from ekfslam.figures.older import marked
from ekfslam.figures.style import LANDMARK_COLOR, TRUTH, line_of, style_of, styled
from ekfslam.filters.result import Result
from ekfslam.progress import progress

FORMATS = (".gif", ".mp4")
MOST_PICTURES = 2000
_DPI = 100
Update = Callable[[int], Iterable[Artist]]  # moves artists to a frame and returns them
_CODEC = ("-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "23", "-movflags", "+faststart")


def write_animation(
    path: str | Path,
    results: Mapping[str, Result],
    truth: Truth | None = None,
    *,
    pictures: int = 200,
    per_second: int = 20,
    shown: Path | None = None,
) -> None:
    """Write a drive as a moving map from above, ``.gif``, or ``.mp4``, which needs the program ffmpeg.

    A landmark appears in the frame of its first observation, at its last estimate: archives hold no earlier ones.
    ``pictures`` is their largest number, spread over the drive; ``per_second`` their rate. ``shown``
    is the archive that the file names as its source.
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
    moving = (_mp4 if path.suffix == ".mp4" else _gif)(drawn, per_second)
    files.write_all(marked({path: moving}, [] if shown is None else [shown]))


def animated(results: Mapping[str, Result], truth: Truth | None, pictures: int) -> Iterator[Image.Image]:
    """Yield at most ``pictures`` pictures of a drive, the last one of its last frame."""
    frames = len(next(iter(results.values())).time_s)
    updates: list[Update] = []
    figure = _still_map(results, truth, updates)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    still = canvas.copy_from_bbox(figure.bbox)
    for k in maps.spread(frames, pictures):
        canvas.restore_region(still)
        for update in updates:
            for artist in update(int(k)):
                figure.draw_artist(artist)
        yield Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")


@styled
def _still_map(results: Mapping[str, Result], truth: Truth | None, updates: list[Update]) -> Figure:
    """Return a map without its moving parts, and append the functions that move them to a frame."""
    mapper = maps.map_of(results)
    figure, ax, _ = maps.map_axes(results, truth, mapper.landmarks.position_m[:, :2])
    figure.set_dpi(_DPI)
    updates.append(_landmarks(ax, mapper))
    if truth is not None and len(truth.frame):
        ax.plot(*truth.T_world_imu[:, :2, 3].T, **TRUTH, alpha=0.35, label="truth")
    updates.extend(_vehicle(ax, mode, result) for mode, result in results.items())
    updates.append(_clock(ax, mapper))
    maps.legend_below(figure, ax)
    ax.set_title(f"{mapper.sequence_name}: {maps.SIGMAS:g}-sigma ellipses")
    return figure


def _landmarks(ax: Axes, mapper: Result) -> Update:
    """Return the update of landmarks: dots of all seen so far, ellipses of all in view."""
    landmarks = mapper.landmarks
    points = landmarks.position_m[:, :2]
    dots = maps.draw_dots(ax, points, f"landmarks of {mapper.mode}", alpha=0.6, animated=True)
    dots.set_markersize(1.5 * dots.get_markersize())
    axes = maps.ellipse_axes(landmarks.covariance[:, :2, :2])
    fits = axes[0] < 0.1 * maps.diagonal(ax)

    def update(k: int) -> Iterable[Artist]:
        seen = landmarks.first_frame <= k
        dots.set_data(*points[seen].T)
        now = np.flatnonzero(seen & (landmarks.last_frame >= k) & fits)
        return dots, _ellipses(ax, now, points, axes, LANDMARK_COLOR)

    return update


def _vehicle(ax: Axes, mode: str, result: Result) -> Update:
    """Return the update of a run: path so far, position with ellipse, and heading."""
    xy, forward, color = result.T_world_imu[:, :2, 3], result.T_world_imu[:, :2, 0], style_of(mode)["color"]
    (line,) = ax.plot(*xy.T, **line_of(mode), label=mode, animated=True)  # without data, arrows have no direction
    arrow = ax.quiver(*xy[0], *forward[0], color=color, angles="xy", scale=18, width=0.006, zorder=5, animated=True)
    axes = maps.ellipse_axes(maps.position_covariance(result.T_world_imu, result.covariance))

    def update(k: int) -> Iterable[Artist]:
        line.set_data(*xy[: k + 1].T)
        arrow.set_offsets(xy[k])
        arrow.set_UVC(*forward[k])
        return line, _ellipses(ax, np.array([k]), xy, axes, color), arrow

    return update


def _ellipses(ax: Axes, rows: IntArray, centres: Array, axes: tuple[Array, Array, Array], color: str) -> Artist:
    """Return ellipses that can be drawn without being added to the axes, where they would pile up."""
    long, short, angle = (values[rows] for values in axes)
    found = maps.ellipses(ax, centres[rows], (long, short, angle), color, linewidths=0.8)
    found.axes = ax
    found.set_figure(ax.get_figure())  # type: ignore[arg-type]
    found.set_clip_box(ax.bbox)
    return found


def _clock(ax: Axes, result: Result) -> Update:
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
    pictures = iter(pictures)
    first = next(pictures)
    width, height = (size - size % 2 for size in first.size)  # H.264 wants even sizes
    with TemporaryDirectory() as folder, (Path(folder) / "errors").open("w+b") as errors:
        target = Path(folder) / "drive.mp4"
        source = ("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(per_second), "-i", "-")
        call = ["ffmpeg", "-y", "-loglevel", "error", *source, *_CODEC, str(target)]
        with suppress(BrokenPipeError), subprocess.Popen(call, stdin=subprocess.PIPE, stderr=errors) as process:
            assert process.stdin is not None
            for picture in chain([first], pictures):
                process.stdin.write(picture.crop((0, 0, width, height)).tobytes())
        if process.returncode != 0 or not target.exists():
            errors.seek(0)
            said = " ".join(errors.read(2000).decode(errors="replace").split())
            raise ConfigError(f"ffmpeg makes no mp4: {said or 'no reason given'}")
        return target.read_bytes()
