"""Find the noise of a recording from its innovations, without truth."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import get_args

from ekfslam import files
from ekfslam.cli.options import DEFAULT_DATA, add_data_options, add_force, open_data, require_ours
from ekfslam.config import Config, NoiseModel
from ekfslam.data.readers.text import first_row
from ekfslam.studies.tuning import toml_heading, tune

EXAMPLES = (
    "tune drive.mat",
    "tune drive.mat --out noise.toml && ekfslam run drive.mat --config noise.toml --out drive.h5",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("data", nargs="?", default=DEFAULT_DATA, metavar="DATA", help=f"default: {DEFAULT_DATA}")
    parser.add_argument(
        "--out", type=Path, metavar="FILE.toml", help="write the result, for --config of run and compare"
    )
    add_force(parser)
    parser.add_argument("--config", type=Path, metavar="FILE.toml", help="settings of the filter; sigmas are ignored")
    parser.add_argument(
        "--model",
        choices=[model for model in get_args(NoiseModel) if model != "tuned"],
        help="auto: sigmas of the automatic model; white: of white noise alone (default: as configured)",
    )
    parser.add_argument("--drift", action="store_true", help="search the drift of the tracks, too")
    add_data_options(parser)


def command(options: argparse.Namespace) -> None:
    config = Config.from_toml(options.config) if options.config else Config()
    config = config.with_overrides({"noise": {"model": options.model}})
    sequence = open_data(options, options.data)
    if options.out:
        files.require_writable(options.out)
        require_ours(options, options.out, lambda path: first_row(path, comment=None) == toml_heading(sequence.name))
    tuned = tune(sequence, config, drift=options.drift)
    print(tuned.table)
    if options.out:
        files.write_all({options.out: tuned.toml})
        print(f"written to {options.out}")
