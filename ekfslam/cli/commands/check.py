"""Judge whether the covariance of a run is honest, from its innovations, and name causes and next steps."""

from __future__ import annotations

import argparse

from ekfslam.cli.options import declare
from ekfslam.reports import check

EXAMPLES = ("check city.h5", "check drive.h5 --out figures")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    declare(parser, "archive", "--out")
    parser.add_argument("--mode", default="full", help="mode in the archive (default: %(default)s)")


def command(options: argparse.Namespace) -> None:
    found = check(options.archive, options.mode, options.out)
    print(found.honesty.table)
    print("written: " + ", ".join(map(str, found.paths)))
