"""`check_consistency`: a Monte Carlo study as an archive, a table and figures."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ekfslam.evaluation.study import study_table, summarise_study
from ekfslam.figures.study import save_study_figures
from ekfslam.studies.executors import open_executor
from ekfslam.studies.study import Study, StudyArchive, run_study


@dataclass(frozen=True)
class ConsistencyReport:
    """What `check_consistency` found.

    Args:
        archive: All values of all runs.
        summary: Averages and their bounds, as written to ``summary.json``.
        paths: The files written.
    """

    archive: StudyArchive
    summary: dict[str, Any]
    paths: list[Path]

    @property
    def table(self) -> str:
        """The summary as a Markdown table."""
        return study_table(self.summary)


def check_consistency(
    study: Study, directory: str | Path, executor: str = "processes", workers: int | None = None
) -> ConsistencyReport:
    """Run a study, or what is missing of it, and write ``study.h5``, ``summary.json``, ``table.md`` and figures.

    Args:
        study: What to run.
        directory: Where to; made if missing. A study that was interrupted there goes on.
        executor, workers: See `open_executor`.

    Raises:
        ArchiveError: The directory holds another study, or cannot be written.
        ConfigError: The executor is unknown, not installed or not reachable.
    """
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    archive_path, summary_path, table_path = (directory / name for name in ("study.h5", "summary.json", "table.md"))
    with open_executor(executor, workers) as opened:
        archive = run_study(study, archive_path, opened)
    summary = summarise_study(archive)
    summary_path.write_text(json.dumps(summary, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    table_path.write_text(study_table(summary), encoding="utf-8")
    paths = [archive_path, summary_path, table_path, *save_study_figures(directory, archive)]
    return ConsistencyReport(archive, summary, paths)
