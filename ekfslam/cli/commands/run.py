"""Run a mode, or several, and write the result archive."""

from __future__ import annotations

import argparse
from contextlib import AbstractContextManager
from pathlib import Path

from ekfslam import files
from ekfslam.cli.modes import declare_modes
from ekfslam.cli.options import configured, declare, declare_run, open_data, print_warnings, table
from ekfslam.evaluation.brief import brief
from ekfslam.evaluation.truth import with_truth_noise
from ekfslam.figures.older import older_figures, remove_figures
from ekfslam.reports import details, run_modes
from ekfslam.storage.archive import archive_image, require_same_origin
from ekfslam.timings import Timings

EXAMPLES = (
    "run --mode full --variant invariant --out city.h5",
    "run drive.mat --mode mapping-only --config noise.toml --out drive.h5",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    declare(parser, "data")
    declare_modes(parser, ["full"])
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.h5", help="archive to write")
    declare(parser, "--verbose", "--timings")
    declare_run(parser)


def claims(options: argparse.Namespace) -> AbstractContextManager[None]:
    return files.claimed(options.out)


def command(options: argparse.Namespace) -> None:
    config, timings = configured(options), Timings()
    with timings.part("reading"):
        sequence = with_truth_noise(open_data(options, options.data), config.truth)
    files.require_writable(options.out)
    if not options.force:
        require_same_origin(options.out, sequence)
    with timings.part("automatic model"):
        print_warnings(sequence)
    results = run_modes(sequence, options.modes, config, timings)
    with timings.part("archive"):
        older = older_figures(options.out)
        files.write_all({options.out: archive_image(sequence, results)})
        remove_figures(older, ())
    with timings.part("evaluation"):
        print(brief(sequence, results, {}, options.out))
        if options.verbose:
            print(table(sequence, len(sequence.observations.ids), results))
            print(details(results))
    print(f"written to {options.out}")
    if options.timings:
        print(timings.table)
