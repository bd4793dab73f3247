"""Show what this installation has, what it lacks, and the command that installs it."""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, requires, version

from threadpoolctl import threadpool_info

from ekfslam.engine.choice import MISSING
from ekfslam.provenance import versions
from ekfslam.smoother.sparse import solvers

EXAMPLES = ("doctor",)
# Extras for users, in words; `pyproject.toml` has their packages.
EXTRAS = {
    "images": "tracking features in stereo images",
    "ros": "ROS 1, ROS 2 and MCAP bags",
    "paper": "results as tables of pandas and xarray",
    "cluster": "studies on many machines",
    "viewer": "a viewer in three dimensions",
    "cholmod": "a faster smoother; needs libsuitesparse-dev and a C compiler",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    del parser


def command(options: argparse.Namespace) -> None:
    del options
    print_build()
    if MISSING:
        print("              several times faster with the engine: install again with a C++17 compiler")
    for extra, words in EXTRAS.items():
        packages = {name: _version(name) for name in _packages(extra)}
        lacking = [name for name, found in packages.items() if not found]
        have = ", ".join(f"{name} {found}" for name, found in packages.items() if found)
        advice = f"lacks {', '.join(lacking)}: pip install 'ekfslam[{extra}]'" if lacking else ""
        print(f"{extra:13s} {words}: {'; '.join(part for part in (have, advice) if part)}")
    data = os.environ.get("EKFSLAM_DATA", "")
    print(f"EKFSLAM_DATA  {data or 'not set: experiments and tests with recordings look in ../shared/data'}")


def print_build() -> None:
    """Print engine, solver, libraries and their threads."""
    print(f"engine        {MISSING or 'compiled, C++'}")
    print(f"smoother      {solvers.describe()}")
    for name, found in versions().items():
        print(f"{name.removeprefix('version_'):13s} {found}")
    for library in threadpool_info():
        if library["user_api"] == "blas":
            print(f"BLAS          {library['internal_api']} {library['version']}, {library['num_threads']} threads")


def _packages(extra: str) -> Iterator[str]:
    """Yield the packages of an extra."""
    for line in requires("ekfslam") or ():
        name = re.match(r"[\w.-]+", line)
        if name and re.search(rf"extra\s*==\s*['\"]{extra}['\"]", line):
            yield name.group()


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""
