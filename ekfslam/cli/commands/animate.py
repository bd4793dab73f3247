"""Make a moving map of an archive: gif, or mp4 if ffmpeg is installed."""

from __future__ import annotations

import argparse
from contextlib import AbstractContextManager
from pathlib import Path

from ekfslam import files
from ekfslam.cli.options import declare, require_ours
from ekfslam.errors import ArchiveError
from ekfslam.figures.animation import FORMATS, write_animation
from ekfslam.figures.older import require_own
from ekfslam.storage.archive import read_archive

EXAMPLES = ("animate city.h5", "animate city.h5 --modes full --out drive.mp4 --pictures 600 --per-second 30")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    declare(parser, "archive", "--force")
    parser.add_argument("--modes", nargs="+", metavar="MODE", help="modes to show (default: all)")
    parser.add_argument("--out", type=Path, metavar="FILE", help="*.gif or *.mp4; default: drive.gif in its folder")
    parser.add_argument("--pictures", type=int, default=200, metavar="N", help="most pictures (default: %(default)s)")
    parser.add_argument(
        "--per-second", type=int, default=20, metavar="N", help="pictures per second (default: %(default)s)"
    )


def claims(options: argparse.Namespace) -> AbstractContextManager[None]:
    return files.claimed(_target(options), reads=[options.archive])


def command(options: argparse.Namespace) -> None:
    archive = read_archive(options.archive)
    modes = options.modes or list(archive.results)
    missing = [mode for mode in modes if mode not in archive.results]
    if missing or not modes:
        raise ArchiveError(f"{options.archive}: holds no run {', '.join(missing)}".rstrip())
    path = _target(options)
    require_ours(options, path, _is_animation)
    if not options.force:
        require_own([path], [options.archive])
    results = {mode: archive.results[mode] for mode in modes}
    numbers = {"pictures": options.pictures, "per_second": options.per_second}
    write_animation(path, results, archive.truth, **numbers, shown=options.archive)
    print(path)


def _target(options: argparse.Namespace) -> Path:
    return Path(options.out or options.archive.parent / "drive.gif")


def _is_animation(path: Path) -> bool:
    """Return whether a file is an animation; its content does not say which program wrote it."""
    with path.open("rb") as file:
        head = file.read(12)
    return path.suffix in FORMATS and (head.startswith(b"GIF8") or head[4:8] == b"ftyp")
