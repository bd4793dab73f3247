"""Run one mode and write its result archive."""

from __future__ import annotations

import argparse
from pathlib import Path

from ekfslam import files
from ekfslam.cli.options import configured, declare, declare_run, open_data, print_warnings, table
from ekfslam.config import MODES
from ekfslam.data.sequence import Sequence
from ekfslam.evaluation.honesty import verdict_on
from ekfslam.evaluation.truth import with_truth_noise
from ekfslam.figures.older import older_figures, remove_figures
from ekfslam.filters.result import Result
from ekfslam.runner import run
from ekfslam.storage.archive import archive_image, require_same_origin
from ekfslam.timings import Timings

EXAMPLES = (
    "run --mode full --variant invariant --out city.h5",
    "run drive.mat --mode mapping-only --config noise.toml --out drive.h5",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    declare(parser, "data")
    parser.add_argument("--mode", choices=MODES, default="full", help="default: %(default)s")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.h5", help="archive to write")
    declare(parser, "--timings")
    declare_run(parser)


def command(options: argparse.Namespace) -> None:
    config, timings = configured(options), Timings()
    with timings.part("reading"):
        sequence = with_truth_noise(open_data(options, options.data), config.truth)
    files.require_writable(options.out)
    if not options.force:
        require_same_origin(options.out, sequence)
    with timings.part("automatic model"):
        print_warnings(sequence)
    result = run(sequence, options.mode, config, timings=timings)
    with timings.part("archive"):
        older = [] if _is_shared(options.out) else older_figures(options.out.parent)
        files.write_all({options.out: archive_image(sequence, {result.mode: result})})
        remove_figures(older, ())
    with timings.part("evaluation"):
        _print(sequence, result)
    print(f"written to {options.out}")
    if options.timings:
        print(timings.table)


def _print(sequence: Sequence, result: Result) -> None:
    """Print figures of merit, counts, parameters, the verdict and remarks."""
    print(table(sequence, len(sequence.observations.ids), {result.mode: result}))
    print(", ".join(f"{name} {count}" for name, count in result.counts.items()))
    if result.parameters is not None:
        print("\n".join(result.parameters.lines))
    if result.whitened is not None:
        print(f"verdict: {verdict_on(sequence, result)}")
    for remark in result.remarks:
        print(f"note: {remark}")


def _is_shared(archive: Path) -> bool:
    """Return whether figures in the folder of an archive may belong to another one."""
    return not archive.exists() or any(path != archive for path in archive.parent.glob("*.h5"))
