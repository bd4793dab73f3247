"""Make one web page of archives: maps, errors, consistency, verdicts and settings, side by side."""

from __future__ import annotations

import argparse
from contextlib import AbstractContextManager
from pathlib import Path

from ekfslam import files
from ekfslam.cli.options import OTHERS, declare, others_of, require_ours
from ekfslam.figures.older import require_own
from ekfslam.page.report import is_report, report_contents

EXAMPLES = (
    "report results/local/city/archive.h5",
    "report results/*/archive.h5 --out report.html --title 'All drives'",
    "report city.h5 --with mine.tum --width column",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    declare(parser, "archive", nargs="+")
    declare(parser, "--force", "--width", *OTHERS)
    parser.add_argument("--out", type=Path, metavar="FILE", help="default: report.html in the first archive's folder")
    parser.add_argument("--title", default="", metavar="TEXT", help="heading; default: the names of the recordings")


def claims(options: argparse.Namespace) -> AbstractContextManager[None]:
    return files.claimed(_target(options), reads=options.archive)


def _target(options: argparse.Namespace) -> Path:
    return Path(options.out or options.archive[0].parent / "report.html")


def command(options: argparse.Namespace) -> None:
    path = _target(options)
    require_ours(options, path, is_report)
    files.require_writable(path)
    contents = report_contents(options.archive, path, options.title, others_of(options), options.width)
    if not options.force:
        require_own(contents, options.archive)
    files.write_all(contents)
    print("\n".join(map(str, contents)))
