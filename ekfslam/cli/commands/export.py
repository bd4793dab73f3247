"""Export an archive to the formats of other programs: trajectory, map, tables, graph, information."""

from __future__ import annotations

import argparse
from contextlib import AbstractContextManager
from pathlib import Path
from typing import get_args

from ekfslam import files
from ekfslam.cli.options import declare, require_ours
from ekfslam.data.trajectory import Moving
from ekfslam.filters.result import Result
from ekfslam.names import components
from ekfslam.storage.archive import open_result, read_archive
from ekfslam.storage.exports import EXPORTS, Poses, contents, is_export, trajectory_of, true_trajectory

TRUTH = "truth"  # in place of a mode
EXAMPLES = (
    "export city.h5 --format tum",
    "export city.h5 --format tum --mode truth",
    "export city.h5 --format kitti --mode dead-reckoning --out poses.txt",
    "export city.h5 --format tum --frame camera",
    "export city.h5 --format bag",
    "export city.h5 --format ply",
    "export city.h5 --format csv-landmarks",
    "export city.h5 --format information",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    declare(parser, "archive", "--force")
    formats = "; ".join(f"{name}: {export.words}" for name, export in EXPORTS.items())
    parser.add_argument("--format", choices=tuple(EXPORTS), required=True, help=formats)
    parser.add_argument(
        "--mode", help=f"any in the archive (default: full, or else its first), or {TRUTH} for the true poses"
    )
    parser.add_argument(
        "--frame",
        choices=get_args(Moving),
        help="moving frame of poses: the body (IMU), or the left camera (default: camera for kitti, otherwise body)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="default: ARCHIVE with .MODE.FORMAT.txt, or with the ending of the format",
    )


def claims(options: argparse.Namespace) -> AbstractContextManager[None]:
    return files.claimed(options.out, reads=[options.archive])


def command(options: argparse.Namespace) -> None:
    archive = read_archive(options.archive)
    modes = list(archive.results)
    mode = options.mode or ("full" if "full" in modes or not modes else modes[0])
    export = EXPORTS[options.format]
    path = options.out or options.archive.with_suffix(f".{components([mode])[0]}.{export.ending}")
    files.require_writable(path)
    data: Result | Poses
    if mode == TRUTH:
        data = true_trajectory(archive, str(options.archive), options.format)
    else:
        data = open_result(options.archive, mode)
        data = data if export.poses is None else trajectory_of(data)
    written = contents(data, path, options.format, options.frame)
    with files.claimed(*written):
        for place in written:
            require_ours(options, place, lambda path: is_export(path, options.format))
        files.write_all(written)
    found = f"{len(data.trajectory.time_s)} poses" if isinstance(data, Poses) else export.words
    beside = "".join(f", their covariances to {place}" for place in written if place != path)
    print(f"{found} written to {path}{beside}")
