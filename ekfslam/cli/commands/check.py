"""Judge whether the covariance of a run is honest, from its innovations, and name causes and next steps."""

from __future__ import annotations

import argparse

from ekfslam.cli.options import declare
from ekfslam.evaluation.honesty import Honesty
from ekfslam.reports import check

EXAMPLES = ("check city.h5", "check drive.h5 --out figures")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    declare(parser, "archive", "--out")
    parser.add_argument("--mode", default="full", help="mode in the archive (default: %(default)s)")
    declare(parser, "--verbose", help="print the errors by axis and along tracks, as in check.md")


def command(options: argparse.Namespace) -> None:
    def say(found: Honesty) -> None:
        print(found.table if options.verbose else found.brief)

    paths = check(options.archive, options.mode, options.out, say).paths
    print("written to " + ", ".join(map(str, paths)))
