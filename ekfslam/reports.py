"""Calls that run, and write archives, tables and figures.

`compare` runs several modes on one sequence. `check_consistency` judges covariances on simulations, whose truth is
known. `check` judges one run by its innovations, which need no truth.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Executor, Future
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ekfslam import files
from ekfslam.config import MODES, Config, Mode
from ekfslam.data.sequence import Sequence
from ekfslam.data.trajectory import Trajectory
from ekfslam.errors import ArchiveError, EkfslamError, FilterError, IllPosedError, PosteriorError, UnknownFormatError
from ekfslam.evaluation.brief import ATE, brief, brief_rows
from ekfslam.evaluation.honesty import Honesty, judge, require_innovations, verdict_on
from ekfslam.evaluation.summary import compare_table, summarise_all
from ekfslam.evaluation.truth import with_truth_noise
from ekfslam.figures.older import FIGURES, WAY, marked, older_figures, remove_figures, require_own
from ekfslam.filters.loop import one_thread
from ekfslam.filters.result import Result
from ekfslam.limits import require_file
from ekfslam.names import without_common_ends
from ekfslam.others import Others
from ekfslam.runner import require_arguments, run
from ekfslam.shown import Card, Shown, count
from ekfslam.smoother.posterior import posterior, smooth
from ekfslam.storage.archive import archive_image, open_result, read_archive, require_same_origin
from ekfslam.studies.executors import ONE_RUN_AT_A_TIME, completed, open_executor
from ekfslam.studies.sweep_table import SweepTable
from ekfslam.timings import Timings

if TYPE_CHECKING:
    from ekfslam.studies.study import Study, StudyArchive

Width = str | float | None  # of figures of a paper: column, page, or inches; None for those of the screen


@dataclass(frozen=True, repr=False)
class Comparison(Shown):
    """Results of `compare`.

    Args:
        sequence: The recording.
        results: Mode to result, in the order of the call.
        summary: The figures of merit as written to ``summary.json``.
        skipped: Mode to the reason why it has no result: an ill-posed posterior, or a filter that cannot continue.
    """

    sequence: Sequence
    results: dict[str, Result]
    summary: dict[str, Any]
    skipped: dict[str, str]

    def card(self) -> Card:
        """Return the card that ``repr`` and a notebook show."""
        facts = dict(self.skipped)
        for mode, result in self.results.items():
            said = brief_rows(result, self.sequence.truth)
            facts[mode] = ", ".join(
                f"{name} {said[name]}" for name in (ATE, "observations used", "time") if name in said
            )
        of = f"{self.sequence.name}, {count(len(self.sequence), 'frame')}"
        return Card(of, facts, ("print(comparison.brief)", "print(comparison.table)", 'comparison.save("out")'))

    @cached_property
    def brief(self) -> str:
        """A few rows a mode, the verdict on the full run with its next step, and remarks."""
        return brief(self.sequence, self.results, self.skipped, "ARCHIVE")

    @cached_property
    def table(self) -> str:
        """All figures of merit as a Markdown table, with reasons for missing modes, the verdict and remarks."""
        lines = [f"No {mode}: {reason}" for mode, reason in self.skipped.items()]
        if "full" in self.results:
            lines.append(f"Verdict on full: {verdict_on(self.sequence, self.results['full'])}")
        remarks: dict[str, list[str]] = {}
        for mode, result in self.results.items():
            for remark in result.remarks:
                remarks.setdefault(remark, []).append(mode)
        lines += [f"Note on {', '.join(modes)}: {remark}" for remark, modes in remarks.items()]
        return compare_table(self.summary) + "".join(f"\n{line}\n" for line in lines)

    def save(
        self,
        directory: str | Path,
        force: bool = False,
        figures: bool = True,
        timings: Timings | None = None,
        width: Width = None,
    ) -> list[Path]:
        """Write ``archive.h5``, ``summary.json``, ``summary.md`` and the figures into a folder; return their paths.

        All are written or none. Figures of an earlier run are removed. With a ``width`` (``column``, ``page`` or
        inches) the figures are those of a paper, as PDF, with ``captions.md``.

        Raises:
            WriteError: The folder cannot be written, another command writes or reads its archive, or it holds another
                recording or its figures and ``force`` is false.
        """
        with _claimed(Path(directory)):
            return self._write(Path(directory), force, figures, timings or Timings(), width)

    def _write(
        self, directory: Path, force: bool, figures: bool, timings: Timings, width: str | float | None
    ) -> list[Path]:
        archive, summary, table = (directory / name for name in ("archive.h5", "summary.json", "summary.md"))
        if not force:
            require_same_origin(archive, self.sequence)
        notes = "".join(f"- {note}\n" for note in self.sequence.notes)
        with timings.part("archive"):
            contents: dict[Path, str | bytes] = {archive: archive_image(self.sequence, self.results)}
        with timings.part("evaluation"):
            contents |= {summary: _json(self.summary)}
            contents |= {table: self.table + (f"\nThe reader notes:\n\n{notes}" if notes else "")}
        if figures:
            with timings.part("imports"):
                from ekfslam.figures.paper import draw_paper, paper_contents, width_of
                from ekfslam.figures.run import draw_figures
                from ekfslam.figures.style import pngs
            with timings.part("figures"):
                of = (self.results, self.sequence.truth, self.sequence.interpolated)
                if width:
                    drawn = paper_contents(directory, draw_paper(*of, width_of(width)))
                else:
                    drawn = pngs(directory, draw_figures(*of))
                contents |= marked(drawn, [archive])
            if not force:
                require_own(contents, [archive])
        with timings.part("archive"):
            older = older_figures(archive)
            files.write_all(contents)
            remove_figures(older, contents)
        return list(contents)


@one_thread()
def compare(
    sequence: Sequence,
    modes: Mode | Iterable[Mode] = MODES,
    config: Config | None = None,
    timings: Timings | None = None,
    others: Others | Mapping[str, Trajectory | str | Path] | None = None,
) -> Comparison:
    """Run several modes with one configuration; ``timings`` are those of `run`.

    ``others`` are trajectories of other programs by name, as files or `ekfslam.Trajectory`; they are results, too. See
    `ekfslam.others.Others` for their frame and world.

    Raises:
        ConfigError: Unknown mode, or a name that no trajectory can have.
        FilterError: No mode has a result; if some have, `Comparison.skipped` tells why others have none.
        TruthError: Fewer than three poses of a trajectory belong to frames. Others as of `ekfslam.others`.
    """
    require_arguments(sequence, config)
    others = Others.of(others)
    others.results(sequence)  # a mistake there should not cost the runs
    if config is not None:
        sequence = with_truth_noise(sequence, config.truth)
    timings = timings or Timings()
    wanted: list[Any] = [modes] if isinstance(modes, str) else list(modes)
    results, skipped = _run_all(sequence, wanted, config, timings)
    if skipped and not results:
        raise FilterError("; ".join(f"no {mode}: {reason}" for mode, reason in skipped.items()))
    with timings.part("evaluation"):
        results |= others.results(sequence, next(iter(results.values())))
        summary = summarise_all(sequence, len(sequence.observations.ids), results)
    return Comparison(sequence, results, summary, skipped)


def run_modes(
    sequence: Sequence, modes: Iterable[Mode], config: Config | None = None, timings: Timings | None = None
) -> dict[str, Result]:
    """Return the results of several modes; the filter runs once for ``full`` and ``smoothed``."""
    results, skipped = _run_all(sequence, list(modes), config, timings or Timings(), is_strict=True)
    assert not skipped
    return results


def _run_all(
    sequence: Sequence, modes: list[Mode], config: Config | None, timings: Timings, is_strict: bool = False
) -> tuple[dict[str, Result], dict[str, str]]:
    """Return the result of each mode, and the reason for each mode without one; ``is_strict`` raises it instead."""
    results: dict[str, Result] = {}
    skipped: dict[str, str] = {}
    for mode in dict.fromkeys(modes):
        if mode == "smoothed" and "full" in skipped:
            skipped[mode] = skipped["full"]
            continue
        try:
            if mode == "smoothed" and "full" in results:  # the filter need not run twice
                with timings.part(mode):
                    results[mode] = smooth(results["full"])
            else:
                results[mode] = run(sequence, mode, config, timings=timings)
        except (IllPosedError, FilterError) as error:
            if is_strict:
                raise
            skipped[mode] = str(error)
    return results, skipped


def compare_into(
    sequence: Sequence,
    folder: Path,
    modes: Iterable[Mode] = MODES,
    config: Config | None = None,
    *,
    force: bool = False,
    figures: bool = True,
    verbose: bool = False,
    timings: Timings | None = None,
    others: Others | None = None,
    width: Width = None,
) -> str:
    """Save `compare` into a folder, and return the text for a terminal: notes of the reader, `brief`, folder written.

    Paths of ``others`` may hold the name of the folder as ``{name}``.

    ``verbose`` adds all figures of merit, counts and parameters, and lists the files.
    """
    timings = timings or Timings()
    others = None if others is None else others.named(folder.name)
    with _claimed(folder):
        comparison = compare(sequence, modes, config, timings, others)
        paths = comparison.save(folder, force, figures, timings, width)
    notes = "".join(f"{sequence.name}: {note}\n" for note in sequence.notes)
    with timings.part("evaluation"):
        said = brief(sequence, comparison.results, comparison.skipped, folder / "archive.h5")
        if verbose:
            said += f"\n{comparison.table}\n{details(comparison.results)}"
    listed = f": {', '.join(path.name for path in paths)}" if verbose else f" ({count(len(paths), 'file')})"
    return f"{notes}\n{said}\nwritten to {folder}{listed}"


def _claimed(folder: Path) -> AbstractContextManager[None]:
    """Claim the files of a comparison."""
    return files.claimed(folder / "archive.h5", folder / "summary.json", folder / FIGURES)


# Figures of merit of the table of a paper.
PAPER = ("ate_m", "ate_aligned_m", "rpe_10_m_m", "rpe_10_m_deg", "t_rel_percent", "pose_nees_with_truth_noise_mean")


def compared_table(folders: Iterable[Path]) -> SweepTable:
    """Return the summaries that `compare_into` wrote into some folders as a table, one row a recording and mode.

    Names of recordings are without the words at their ends that all have.

    Raises:
        ArchiveError: A summary is missing or damaged.
    """
    folders, rows, notes = list(folders), [], list[str]()
    names = without_common_ends([folder.name for folder in folders])
    for folder, name in zip(folders, names, strict=True):
        try:
            require_file(folder / "summary.json", is_text=True)
            summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
            rows += [{"recording": name, "mode": mode, **figures} for mode, figures in summary["modes"].items()]
            for mode, missing in summary.get("without_pose", {}).items():
                of = f"{missing} of {summary['frames']} frames of {name}"
                notes.append(f"{mode} has no pose in {of}, and its figures are of the others")
        except (OSError, ValueError, LookupError, TypeError, AttributeError, UnknownFormatError) as error:
            raise ArchiveError(f"{folder / 'summary.json'}: no summary of compare ({error})") from None
    table = SweepTable.of_rows(rows, ("recording", "mode"), len(rows), {"mode": "estimator"})
    return replace(table, notes=tuple(notes))


def details(results: Mapping[str, Result]) -> str:
    """Return counts, estimated parameters and cleaned tracks of runs, one line each."""
    found = []
    for mode, result in results.items():
        lines = [", ".join(f"{name} {number}" for name, number in result.counts.items() if number)]
        lines += () if result.parameters is None else result.parameters.lines
        lines += () if result.inertial is None else result.inertial.lines
        cleaned = result.hygiene
        lines += () if cleaned is None else [f"hygiene: {line}" for line in cleaned.lines(result.config["hygiene"])]
        found += [f"{mode}: {line}" for line in lines if line]
    return "\n".join(found)


def compare_all(
    recordings: Mapping[Path, Sequence],
    executor: Executor,
    modes: Iterable[Mode] = MODES,
    config: Config | None = None,
    **options: Any,
) -> Iterator[str]:
    """Run `compare_into` for many recordings, by folder, in parallel, and yield the text of each as it finishes.

    Raises:
        FilterError: Some recordings cannot be compared; raised after all others are saved.
    """
    modes, failed = tuple(modes), []

    def submit(folder: Path) -> Future[tuple[str, str]]:
        return executor.submit(_compared, recordings[folder], folder, modes, config, options)

    for folder, (said, failure) in completed(recordings, submit):
        if failure:
            failed.append(f"{folder.name}: {failure}")
        else:
            yield said
    if failed:
        raise FilterError("; ".join(failed))


def _compared(
    sequence: Sequence, folder: Path, modes: Iterable[Mode], config: Config | None, options: Mapping[str, Any]
) -> tuple[str, str]:
    """Return the text of `compare_into` and the reason for failure; one of them is empty."""
    with ONE_RUN_AT_A_TIME:
        try:
            return compare_into(sequence, folder, modes, config, **options), ""
        except EkfslamError as error:
            return "", str(error)


@dataclass(frozen=True, repr=False)
class ConsistencyReport(Shown):
    """Results of `check_consistency`."""

    archive: StudyArchive  # all values of all runs
    summary: dict[str, Any]  # averages and their bounds, as written to summary.json
    paths: list[Path]  # files written

    def card(self) -> Card:
        facts = {"written": ", ".join(path.name for path in self.paths)}
        return Card(self.archive.card().title, facts, ("print(report.table)", "report.archive"))

    @property
    def table(self) -> str:
        """The summary as a Markdown table."""
        from ekfslam.studies.summary import study_table

        return study_table(self.summary)


def check_consistency(
    study: Study, directory: str | Path, executor: str = "processes", workers: int | None = None
) -> ConsistencyReport:
    """Run a study into a folder, or its missing part; write ``study.h5``, ``summary.json``, ``table.md`` and figures.

    ``executor`` and ``workers`` are those of `open_executor`.
    """
    from ekfslam.figures.study import draw_study_figures
    from ekfslam.figures.style import pngs
    from ekfslam.studies.study import run_study
    from ekfslam.studies.summary import study_table, summarise_study

    archive_path, summary_path, table_path = _targets(Path(directory), "study.h5", "summary.json", "table.md")
    with files.claimed(archive_path, summary_path):
        with open_executor(executor, workers) as opened:
            archive = run_study(study, archive_path, opened)
        summary = summarise_study(archive)
        figures = pngs(directory, draw_study_figures(archive))
        contents = {summary_path: _json(summary), table_path: study_table(summary), **figures}
        files.write_all(contents)
    return ConsistencyReport(archive, summary, [archive_path, *contents])


@dataclass(frozen=True)
class Check:
    """Results of `check`: verdict with evidence, and the files written."""

    honesty: Honesty
    paths: list[Path]


def check(
    archive: str | Path,
    mode: str = "full",
    directory: str | Path | None = None,
    say: Callable[[Honesty], None] = lambda _: None,
) -> Check:
    """Judge the covariance of a run, and write ``check.json``, ``check.md`` and ``check.png``.

    Innovations need no truth; if the archive has one, it is compared, too. The files go into ``directory``, by default
    the folder of the archive. ``say`` gets the verdict before they are written. Raise `HonestyError` if the run has no
    innovations.
    """
    from ekfslam.figures.check import plot_check
    from ekfslam.figures.style import png

    folder = Path(archive).parent if directory is None else Path(directory)
    values, table, figure = _targets(folder, "check.json", "check.md", "check.png")
    with files.claimed(values, reads=[archive]):
        result = open_result(archive, mode)
        require_innovations(result)
        recorded = read_archive(archive)
        smoothed, skipped = None, ""
        try:
            smoothed = posterior(result)
        except PosteriorError as error:
            skipped = str(error)
        found = judge(result, smoothed, skipped, recorded.truth, recorded.interpolated)
        say(found)
        require_own([figure], [Path(archive)], WAY)
        written: dict[Path, str | bytes] = {
            values: _json(found.values),
            table: found.table,
            figure: png(plot_check(result, found)),
        }
        files.write_all(marked(written, [Path(archive)]))
    return Check(found, [values, table, figure])


def _targets(directory: Path, *names: str) -> list[Path]:
    """Return the paths of files that can be written."""
    paths = [directory / name for name in names]
    for path in paths:
        files.require_writable(path)
    return paths


def _json(summary: dict[str, Any]) -> str:
    return json.dumps(summary, indent=2, allow_nan=False) + "\n"
