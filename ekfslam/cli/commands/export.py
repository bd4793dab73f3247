"""Write a trajectory of an archive, estimated or true, as text."""

from __future__ import annotations

import argparse
from pathlib import Path

from ekfslam import files
from ekfslam.cli.options import add_force, require_ours
from ekfslam.data.readers.text import first_line
from ekfslam.names import components
from ekfslam.storage.archive import open_result, read_archive
from ekfslam.storage.exports import trajectory_text, truth_text

TRUTH = "truth"  # what `export` takes beside the modes
EXAMPLES = (
    "export city.h5 --format tum",
    "export city.h5 --format tum --mode truth",
    "export city.h5 --format kitti --mode dead-reckoning --out poses.txt",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("archive", type=Path, metavar="ARCHIVE")
    parser.add_argument("--format", choices=("tum", "kitti"), required=True, help="poses of the IMU in world")
    parser.add_argument(
        "--mode", help=f"any in the archive (default: full, or else its first), or {TRUTH} for the true poses"
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help="default: ARCHIVE with .MODE.FORMAT.txt")
    add_force(parser)


def command(options: argparse.Namespace) -> None:
    archive = read_archive(options.archive)
    modes = list(archive.results)
    mode = options.mode or ("full" if "full" in modes or not modes else modes[0])
    path = options.out or options.archive.with_suffix(f".{components([mode])[0]}.{options.format}.txt")
    files.require_writable(path)
    require_ours(options, path, lambda path: len(first_line(path).split()) == (8 if options.format == "tum" else 12))
    if mode == TRUTH:
        poses, text = truth_text(archive, str(options.archive), options.format)
    else:
        result = open_result(options.archive, mode)
        poses, text = len(result.time_s), trajectory_text(result, options.format)
    files.write_all({path: text})
    print(f"{poses} poses written to {path}")
