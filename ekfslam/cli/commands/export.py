"""Export an archive to the formats of other programs: trajectory, map, tables, graph, information."""

from __future__ import annotations

import argparse
from pathlib import Path

from ekfslam import files
from ekfslam.cli.options import declare, require_ours
from ekfslam.errors import ArchiveError
from ekfslam.names import components
from ekfslam.storage.archive import open_result, read_archive
from ekfslam.storage.exports import EXPORTS, is_export, truth_text

TRUTH = "truth"  # in place of a mode
EXAMPLES = (
    "export city.h5 --format tum",
    "export city.h5 --format tum --mode truth",
    "export city.h5 --format kitti --mode dead-reckoning --out poses.txt",
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
        "--out",
        type=Path,
        metavar="FILE",
        help="default: ARCHIVE with .MODE.FORMAT.txt, or with the ending of the format",
    )


def command(options: argparse.Namespace) -> None:
    archive = read_archive(options.archive)
    modes = list(archive.results)
    mode = options.mode or ("full" if "full" in modes or not modes else modes[0])
    export = EXPORTS[options.format]
    path = options.out or options.archive.with_suffix(f".{components([mode])[0]}.{export.ending}")
    files.require_writable(path)
    require_ours(options, path, lambda path: is_export(path, options.format))
    content: str | bytes
    if mode == TRUTH:
        if options.format not in ("tum", "kitti"):
            raise ArchiveError(f"{options.archive}: the truth is written as tum or kitti, not as {options.format}")
        poses, text = truth_text(archive, str(options.archive), options.format)
        found, content = f"{poses} poses", text
    else:
        content = export.write(open_result(options.archive, mode))
        found = f"{len(archive.time_s)} poses" if export.words.startswith("poses:") else export.words
    files.write_all({path: content})
    print(f"{found} written to {path}")
