"""Find the noise of a recording from its innovations, without truth."""

from __future__ import annotations

import argparse
from contextlib import AbstractContextManager
from pathlib import Path
from typing import get_args

from ekfslam import files
from ekfslam.cli.options import DATA, config_file, declare, open_data, require_ours
from ekfslam.config import NoiseModel
from ekfslam.data.readers.text import first_row
from ekfslam.studies.tuning import toml_heading, tune

EXAMPLES = (
    "tune drive.mat",
    "tune drive.mat --out noise.toml && ekfslam run drive.mat --config noise.toml --out drive.h5",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    declare(parser, "data", "--force", *DATA)
    parser.add_argument(
        "--out", type=Path, metavar="FILE.toml", help="write the result, for --config of run and compare"
    )
    declare(parser, "--config", help="settings of the filter; sigmas are ignored")
    parser.add_argument(
        "--model",
        choices=[model for model in get_args(NoiseModel) if model != "tuned"],
        help="auto: sigmas of the automatic model; white: of white noise alone (default: as configured)",
    )
    parser.add_argument("--drift", action="store_true", help="search the drift of the tracks, too")


def claims(options: argparse.Namespace) -> AbstractContextManager[None]:
    return files.claimed(options.out)


def command(options: argparse.Namespace) -> None:
    config = config_file(options).with_overrides({"noise": {"model": options.model}})
    sequence = open_data(options, options.data)
    if options.out:
        files.require_writable(options.out)
        require_ours(options, options.out, lambda path: first_row(path, comment=None) == toml_heading(sequence.name))
    tuned = tune(sequence, config, drift=options.drift)
    print(tuned.table)
    if options.out:
        files.write_all({options.out: tuned.toml})
        print(f"written to {options.out}")
