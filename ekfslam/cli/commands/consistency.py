"""Simulate many drives and test the consistency of the covariances."""

from __future__ import annotations

import argparse
from contextlib import AbstractContextManager
from pathlib import Path

from ekfslam import files
from ekfslam.cli.modes import Names
from ekfslam.cli.options import EXECUTOR, TABLE_WORDS, declare, table_file
from ekfslam.reports import check_consistency
from ekfslam.studies.study import COMPARED, LEVELS, STUDY_VARIANTS, Study
from ekfslam.studies.summary import FIGURES, study_runs

EXAMPLES = (
    "consistency --runs 20",
    "consistency --level all --variants invariant standard fej --out results/local/all",
    "consistency --runs 1000 --executor tls://scheduler:8786",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--runs", type=int, default=50, metavar="N", help="runs of each level (default: %(default)s)")
    parser.add_argument(
        "--level",
        action=Names,
        known=(*LEVELS, "all"),
        default=["mid"],
        metavar="NAME",
        help=f"{', '.join(LEVELS)}, or all (default: mid)",
    )
    parser.add_argument(
        "--variants",
        action=Names,
        known=STUDY_VARIANTS,
        default=list(COMPARED),
        metavar="VARIANT",
        help=f"{', '.join(STUDY_VARIANTS)} (default: {' '.join(COMPARED)}); textbook: standard with landmarks in xyz",
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of all runs (default: %(default)s)")
    parser.add_argument("--table", type=table_file, metavar="FILE", help=TABLE_WORDS)
    declare(parser, *EXECUTOR)
    resumes = "default: %(default)s; an interrupted study there resumes"
    declare(parser, "--out", default=Path("results/local/consistency"), help=resumes)


def claims(options: argparse.Namespace) -> AbstractContextManager[None]:
    return files.claimed(options.table)


def command(options: argparse.Namespace) -> None:
    levels = LEVELS if "all" in options.level else {name: LEVELS[name] for name in options.level}
    study = Study(levels, tuple(options.variants), options.runs, options.seed)
    report = check_consistency(study, options.out, options.executor, options.workers)
    print(f"{report.table}\nwritten to {options.out}: {', '.join(path.name for path in report.paths)}")
    if options.table:
        files.write(options.table, study_runs(report.archive).paper(options.table.suffix, FIGURES))
        print(f"table written to {options.table}")
