"""Run several modes on the same data and compare them."""

from __future__ import annotations

import argparse
from pathlib import Path

from ekfslam import files
from ekfslam.cli.options import (
    DEFAULT_DATA,
    add_data_options,
    add_filter_options,
    add_force,
    add_resume,
    configured,
    open_data,
    print_warnings,
)
from ekfslam.config import MODES
from ekfslam.errors import ConfigError
from ekfslam.names import components
from ekfslam.reports import compare
from ekfslam.storage.archive import require_same_origin
from ekfslam.storage.checkpoint import Checkpoints

EXAMPLES = (
    "compare",
    "compare 0027.npz --truth poses/07.txt --out results/local",
    "compare a.mat b.mat --modes dead-reckoning full --sigma-v 0.5 --sigma-w 0.05",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("data", nargs="*", default=[DEFAULT_DATA], metavar="DATA", help=f"default: {DEFAULT_DATA}")
    parser.add_argument("--modes", nargs="+", choices=MODES, default=list(MODES), metavar="MODE", help=", ".join(MODES))
    parser.add_argument("--out", type=Path, default=Path("results/local"), metavar="DIR", help="default: %(default)s")
    add_force(parser)
    add_resume(parser)
    add_data_options(parser)
    add_filter_options(parser)


def command(options: argparse.Namespace) -> None:
    config = configured(options)
    if options.truth and len(options.data) > 1:
        raise ConfigError("--truth belongs to one recording, but several are given; compare them one by one")
    # Everything is read before anything is run: a mistyped last name should not cost the first hour.
    sequences = [open_data(options, data) for data in options.data]
    # Recordings of the same name do not overwrite each other.
    folders = [options.out / name for name in components(sequence.name for sequence in sequences)]
    for sequence, folder in zip(sequences, folders, strict=True):
        files.require_writable(folder / "archive.h5")
        if not options.force:
            require_same_origin(folder / "archive.h5", sequence)
    for sequence, folder in zip(sequences, folders, strict=True):
        for note in sequence.notes:
            print(f"{sequence.name}: {note}")
        print_warnings(sequence)
        with Checkpoints(folder / "unfinished.checkpoint", options.resume) as checkpoints:
            comparison = compare(sequence, options.modes, config, checkpoints)
            paths = comparison.save(folder, options.force)
        print(f"\n{comparison.table}\nwritten to {folder}: {', '.join(path.name for path in paths)}")
