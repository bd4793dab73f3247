"""Draw the figures of an archive."""

from __future__ import annotations

import argparse
from pathlib import Path

from ekfslam import files
from ekfslam.errors import ArchiveError
from ekfslam.figures.run import save_figures
from ekfslam.storage.archive import read_archive

EXAMPLES = ("plot city.h5", "plot city.h5 --out figures")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("archive", type=Path, metavar="ARCHIVE")
    parser.add_argument("--out", type=Path, metavar="DIR", help="default: the folder of the archive")


def command(options: argparse.Namespace) -> None:
    archive = read_archive(options.archive)
    if not archive.results:
        raise ArchiveError(f"{options.archive}: holds no run")
    directory = options.out or options.archive.parent
    files.require_writable(directory / "map.png")
    for path in save_figures(directory, archive.results, archive.truth, archive.interpolated):
        print(path)
