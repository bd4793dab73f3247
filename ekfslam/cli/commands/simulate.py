"""Write a simulated world as a recording."""

from __future__ import annotations

import argparse
from contextlib import AbstractContextManager
from pathlib import Path

from ekfslam import files
from ekfslam.cli.options import DEFAULT_DATA, declare, require_ours
from ekfslam.data.readers.hdf5 import is_recording_of, sequence_image
from ekfslam.data.readers.simulated import BUILTIN
from ekfslam.data.simulate import builtin

EXAMPLES = ("simulate city --out city.h5", "simulate 'loop?seed=7' --out loop.h5")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("world", nargs="?", default=DEFAULT_DATA, metavar="WORLD", help=f"default: {DEFAULT_DATA}")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.h5", help="recording to write")
    declare(parser, "--force")


def claims(options: argparse.Namespace) -> AbstractContextManager[None]:
    return files.claimed(options.out)


def command(options: argparse.Namespace) -> None:
    files.require_writable(options.out)
    sequence = builtin(options.world.removeprefix(BUILTIN))
    require_ours(options, options.out, lambda path: is_recording_of(path, sequence))
    files.write_all({options.out: sequence_image(sequence)})
    print(f"{len(sequence)} frames, {len(sequence.observations)} observations written to {options.out}")
