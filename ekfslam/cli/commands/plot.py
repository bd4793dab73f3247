"""Draw the figures of an archive, or show it in the viewer Rerun."""

from __future__ import annotations

import argparse
from contextlib import AbstractContextManager
from pathlib import Path
from typing import get_args

from ekfslam import files
from ekfslam.cli.options import declare, require_ours
from ekfslam.errors import ArchiveError
from ekfslam.figures.older import FIGURES, marked, require_own
from ekfslam.figures.paper import draw_paper, paper_contents
from ekfslam.figures.run import save_figures
from ekfslam.figures.style import Format
from ekfslam.figures.viewer import is_viewer_file, show_archive, write_viewer_file
from ekfslam.storage.archive import read_archive

_OPENED = Path()  # no file: the viewer is opened
EXAMPLES = (
    "plot city.h5",
    "plot city.h5 --out figures --format pdf",
    "plot city.h5 --out figures --format pdf --width column",
    "plot city.h5 --viewer",
    "plot city.h5 --viewer city.rrd",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    declare(parser, "archive", "--out", "--force")
    parser.add_argument("--format", choices=get_args(Format), default="png", help="default: %(default)s")
    declare(parser, "--width")
    parser.add_argument(
        "--viewer",
        nargs="?",
        type=Path,
        const=_OPENED,
        metavar="FILE.rrd",
        help="show it in Rerun instead of drawing figures; with a name, write a file for Rerun",
    )


def claims(options: argparse.Namespace) -> AbstractContextManager[None]:
    written = _directory(options) / FIGURES if options.viewer is None else options.viewer
    return files.claimed(None if written == _OPENED else written, reads=[options.archive])


def _directory(options: argparse.Namespace) -> Path:
    return Path(options.out or options.archive.parent)


def command(options: argparse.Namespace) -> None:
    archive = read_archive(options.archive)
    if not archive.results:
        raise ArchiveError(f"{options.archive}: holds no run")
    if options.viewer == _OPENED:
        show_archive(archive)
        return
    if options.viewer is not None:
        require_ours(options, options.viewer, is_viewer_file)
        write_viewer_file(archive, options.viewer)
        print(options.viewer)
        return
    directory = _directory(options)
    files.require_writable(directory / f"map.{options.format}")
    drawn = (archive.results, archive.truth, archive.interpolated)
    if options.width:
        contents = paper_contents(directory, draw_paper(*drawn, options.width), options.format)
        if not options.force:
            require_own(contents, [options.archive])
        files.write_all(marked(contents, [options.archive]))
        print("\n".join(map(str, contents)))
        return
    for path in save_figures(directory, *drawn, options.format, shown=options.archive, force=options.force):
        print(path)
