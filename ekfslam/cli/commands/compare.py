"""Run several modes on the same data and compare them."""

from __future__ import annotations

import argparse
import os
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from ekfslam import files
from ekfslam.cli.modes import Names, declare_modes
from ekfslam.cli.options import (
    DEFAULT_DATA,
    EXECUTOR,
    OTHERS,
    TABLE_WORDS,
    configured,
    declare,
    declare_run,
    open_data,
    others_of,
    print_warnings,
    table_file,
)
from ekfslam.config import MODES
from ekfslam.errors import ConfigError
from ekfslam.evaluation.metrics import METRICS
from ekfslam.names import components
from ekfslam.others import NAME
from ekfslam.reports import PAPER, compare_all, compared_table
from ekfslam.storage.archive import require_same_origin
from ekfslam.studies.executors import open_executor
from ekfslam.timings import Timings

EXAMPLES = (
    "compare",
    "compare 0027.npz --truth poses/07.txt --out results/local",
    "compare drives/*.mat --workers 8 --no-figures",
    "compare a.mat b.mat --modes dead-reckoning full --sigma-v 0.5 --sigma-w 0.05",
    "compare drives/*.mat --with 'orb=theirs/{name}.txt' --with-frame camera --table paper.tex",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    declare(parser, "data", nargs="*", default=[DEFAULT_DATA])
    declare_modes(parser, MODES)
    declare(parser, "--out", default=Path("results/local"), help="default: %(default)s")
    parser.add_argument("--table", type=table_file, metavar="FILE", help=TABLE_WORDS)
    words = f"figures in it (default: {' '.join(PAPER)})"
    parser.add_argument("--columns", action=Names, default=list(PAPER), metavar="KEY", help=words)
    declare(parser, "--no-figures", "--width", "--verbose", "--timings", *OTHERS, *EXECUTOR)
    declare_run(parser)


def claims(options: argparse.Namespace) -> AbstractContextManager[None]:
    return files.claimed(options.table)


def command(options: argparse.Namespace) -> None:
    config = configured(options)
    if len(options.data) > 1:
        if options.timings:
            raise ConfigError("--timings belongs to one recording, but several are given; compare them one by one")
        if options.truth and NAME not in str(options.truth):
            message = f"one file for {len(options.data)} recordings; write {NAME} for their names in {options.truth}"
            raise ConfigError(f"--truth: {message}")
    for key in options.columns:
        if key not in METRICS:
            raise ConfigError(f"there is no column {key!r}; known: {', '.join(METRICS)}")
    timings, others = Timings(), others_of(options, len(options.data))
    # Read everything first: a mistyped last name should not cost the first hour.
    with timings.part("reading"):
        sequences = [open_data(options, data) for data in options.data]
    folders = [options.out / name for name in components(sequence.name for sequence in sequences)]
    for sequence, folder in zip(sequences, folders, strict=True):
        files.require_writable(folder / "archive.h5")
        others.named(folder.name).results(sequence)
        if not options.force:
            require_same_origin(folder / "archive.h5", sequence)
    with timings.part("automatic model"):
        for sequence in sequences:
            print_warnings(sequence)
    recordings = dict(zip(folders, sequences, strict=True))
    where = "serial" if len(recordings) == 1 and options.executor == "processes" else options.executor
    workers = options.workers or min(len(recordings), os.cpu_count() or 1)
    chosen: dict[str, Any] = {"force": options.force, "figures": not options.no_figures, "verbose": options.verbose}
    chosen |= {"others": others, "width": options.width}
    if where == "serial":  # the clock is that of this process
        chosen["timings"] = timings
    with open_executor(where, workers) as executor:
        for said in compare_all(recordings, executor, options.modes, config, **chosen):
            print(said)
    if options.table:
        table = compared_table(folders)
        files.write(options.table, table.paper(options.table.suffix, options.columns))
        print(f"table written to {options.table}")
    if options.timings:
        print(timings.table)
