"""Smooth a full run: write the posterior over all poses and landmarks into its archive."""

from __future__ import annotations

import argparse
from contextlib import AbstractContextManager
from pathlib import Path
from typing import get_args

from ekfslam import files
from ekfslam.cli.options import declare, table
from ekfslam.config import Config, Kernel, Linearisation
from ekfslam.figures.older import FIGURES, WAY, marked, require_own
from ekfslam.figures.posterior import POSTERIOR_FIGURES, draw_posterior_figures
from ekfslam.figures.style import pngs
from ekfslam.smoother.posterior import posterior, smooth
from ekfslam.storage.archive import add_result, open_result, read_archive

EXAMPLES = ("posterior city.h5", "posterior city.h5 --linearisation filtered", "posterior city.h5 --kernel cauchy")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    declare(parser, "archive", "--out", "--no-figures")
    parser.add_argument(
        "--linearisation",
        choices=get_args(Linearisation),
        help="map: at the maximum a posteriori; filtered: where the filter linearised (default: as configured, map)",
    )
    parser.add_argument(
        "--kernel", choices=get_args(Kernel), help="robust kernel of map (default: as configured, huber)"
    )


def claims(options: argparse.Namespace) -> AbstractContextManager[None]:
    written = None if options.no_figures else _directory(options) / FIGURES
    return files.claimed(written, reads=[options.archive])  # results of several are merged


def _directory(options: argparse.Namespace) -> Path:
    return Path(options.out or options.archive.parent)


def command(options: argparse.Namespace) -> None:
    full = open_result(options.archive, "full")
    overrides = {"posterior": {"linearisation": options.linearisation, "kernel": options.kernel}}
    config = Config.from_stored(full.config).with_overrides(overrides).posterior
    directory = _directory(options)
    for path in (options.archive, directory / "sparsity.png"):
        files.require_writable(path)
    if not options.no_figures:
        require_own([directory / f"{name}.png" for name in POSTERIOR_FIGURES], [options.archive], WAY)
    found = posterior(full, config)
    smoothed = smooth(full, config, found)
    truth = read_archive(options.archive).truth
    drawn = {} if options.no_figures else draw_posterior_figures(full, smoothed, found.information, truth)
    figures = marked(pngs(directory, drawn), [options.archive])
    add_result(options.archive, smoothed, of=full, beside=figures)
    archive = read_archive(options.archive)
    print(table(archive, None, archive.results))
    print(", ".join(f"{name} {count}" for name, count in smoothed.counts.items()))
    for path in figures:
        print(path)
    print(f"{smoothed.mode} written to {options.archive}")
