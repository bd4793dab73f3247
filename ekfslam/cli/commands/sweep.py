"""Run recordings x modes x variants x settings x seeds and write a table with one row per run."""

from __future__ import annotations

import argparse
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

from ekfslam import files
from ekfslam.cli.modes import Names
from ekfslam.cli.options import EXECUTOR, OTHERS, TABLE_WORDS, declare, table_file
from ekfslam.errors import ConfigError
from ekfslam.figures.paper import paper_contents
from ekfslam.figures.style import pngs
from ekfslam.figures.sweep import paper_sweep, plot_sweep
from ekfslam.others import Others
from ekfslam.studies.executors import open_executor
from ekfslam.studies.sweep import Sweep, run_sweep
from ekfslam.studies.sweep_table import SHOWN, SweepTable, read_table

EXAMPLES = (
    "sweep study.toml",
    "sweep study.toml --executor tls://scheduler:8786 --out results/local/all",
    "sweep study.toml --table paper.tex",
    "sweep --table --out results/local/all --figures ate_m nis_per_dof",
    "sweep --table --out results/local/all --only mode=full --plot ate_m noise.sigma_px --width column",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("study", nargs="?", type=Path, metavar="STUDY.toml", help="recordings, modes, variants, ...")
    words = f"{TABLE_WORDS}; without STUDY.toml of the runs in --out, and without FILE it is shown only"
    parser.add_argument("--table", nargs="?", type=table_file, const=None, default=False, metavar="FILE", help=words)
    parser.add_argument(
        "--figures",
        action=Names,
        default=list(SHOWN),
        metavar="COLUMN",
        help=f"columns to show (default: {' '.join(SHOWN)})",
    )
    parser.add_argument(
        "--only",
        nargs="+",
        action="append",
        default=[],
        type=_chosen,
        metavar="COLUMN=VALUE",
        help="show and draw only runs with one of the values in each named column",
    )
    parser.add_argument(
        "--plot",
        nargs=2,
        action="append",
        default=[],
        metavar=("FIGURE", "SETTING"),
        help="draw a column against another, a panel for each recording; may be given several times",
    )
    declare(parser, "--width", *OTHERS, *EXECUTOR)
    resumes = "default: %(default)s; an interrupted sweep there resumes"
    declare(parser, "--out", default=Path("results/local/sweep"), help=resumes)


def _chosen(text: str) -> tuple[str, str]:
    name, separator, value = text.partition("=")
    if not separator:
        raise argparse.ArgumentTypeError(f"{text!r} is not COLUMN=VALUE")
    return name, value


def claims(options: argparse.Namespace) -> AbstractContextManager[None]:
    return files.claimed(options.out / "sweep.h5", options.table or None)


def command(options: argparse.Namespace) -> None:
    path = options.out / "sweep.h5"
    if options.study is None and options.table is False:
        raise ConfigError("sweep needs a STUDY.toml, or --table")
    if options.table is None or options.study is None:
        table = read_table(path)
    else:
        sweep = _with_others(Sweep.from_toml(options.study), options)
        files.require_writable(path)
        with open_executor(options.executor, options.workers) as executor:
            table = run_sweep(sweep, path, executor)
    _show(options, table)


def _with_others(sweep: Sweep, options: argparse.Namespace) -> Sweep:
    """Return a sweep with the trajectories of the command line in place of those of its file, if there are any."""
    if not options.others:
        return sweep
    return replace(sweep, others=Others.parse(options.others, options.with_frame, options.with_world))


def _drawn(options: argparse.Namespace, table: SweepTable) -> dict[Path, str | bytes]:
    plots = {f"{figure}-{setting}": (table, figure, setting) for figure, setting in options.plot}
    if plots and options.width:
        return paper_contents(options.out, {name: paper_sweep(*of, options.width) for name, of in plots.items()})
    return pngs(options.out, {name: plot_sweep(*of) for name, of in plots.items()})


def _show(options: argparse.Namespace, table: SweepTable) -> None:
    whole, chosen = table, dict[str, list[str]]()
    for name, value in (pair for pairs in options.only for pair in pairs):
        chosen.setdefault(name, []).append(value)
    for name, values in chosen.items():
        table = table.where(name, *values)
    shown = table.markdown(options.figures)
    if chosen:
        shown += f"\nchosen from {len(whole)} of {whole.asked} runs\n"
    try:
        drawn = _drawn(options, table)
    except ValueError as error:
        print(shown)
        raise ConfigError(f"{error}; --only chooses runs") from None
    contents = {options.out / "sweep.md": shown, **drawn}
    if options.table:
        contents[options.table] = table.paper(options.table.suffix, options.figures)
    files.write_all(contents)
    held = [path.name for path in sorted(options.out.glob("sweep.[hp]*"))]
    print(
        f"{shown}\nin {options.out}: {', '.join([*held, *(path.name for path in contents if path != options.table)])}"
    )
    if options.table:
        print(f"table written to {options.table}")
