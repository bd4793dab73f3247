"""Show the entry of this version for BibTeX."""

from __future__ import annotations

import argparse

from ekfslam.provenance import bibtex

EXAMPLES = ("cite", "cite >> references.bib")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    del parser


def command(options: argparse.Namespace) -> None:
    del options
    print(bibtex(), end="")
