"""A small Monte Carlo study: which filter states a true covariance, on worlds of one's own.

One learns how to make levels of noise and variants into a `Study`, where it runs (here two processes; a Dask cluster or
MPI is another word for `open_executor`), that its archive goes on where it was stopped, and how to read its table.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import ekfslam
from ekfslam.studies.executors import open_executor
from ekfslam.studies.study import run_study
from ekfslam.studies.summary import study_table, summarise_study

SHORT = replace(ekfslam.LEVELS["low"], frames=60, landmarks=60)
LEVELS = {"sharp": SHORT, "blurred": replace(SHORT, sigma_px=2.0)}


def main() -> None:
    study = ekfslam.Study(LEVELS, ("invariant", "standard"), runs=3)
    with tempfile.TemporaryDirectory() as folder, open_executor("processes", workers=2) as executor:
        path = Path(folder) / "study.h5"
        run_study(study, path, executor)
        archive = run_study(replace(study, runs=8), path, executor)  # five more of each level
    summary = summarise_study(archive)
    print(study_table(summary))
    for level, variants in summary["levels"].items():
        for variant, found in variants.items():
            print(f"{level}, {variant}: orientation NEES {found['orientation_nees']['mean']:.2f} (3 expected)")


if __name__ == "__main__":  # the processes import this file, too
    main()
